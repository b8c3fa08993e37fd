"""Pinocchio, the library of rigid bodies."""

from rtof_kin.core.packages import optional

pin = optional(
    "pinocchio",
    "",
    "a skeleton",
    "pip install pin (Linux, macOS), or conda install -c conda-forge pinocchio (Windows too)",
)
