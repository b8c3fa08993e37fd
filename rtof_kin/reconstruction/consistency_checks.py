"""Declarations of a recording that contradict each other or the self-calibration."""

from __future__ import annotations

import numpy as np

from rtof_kin.calibration.result import SelfCalibration, Verdict
from rtof_kin.core.errors import CalibrationError
from rtof_kin.recording.recording import Recording

_HEIGHT_SHARE = 0.1
"""Largest relative difference of a declared height from that of the bones: five standard deviations of
people with the same sum of bone lengths."""
_SIGMAS = 6.0
"""Prior standard deviations beyond which an estimate contradicts the prior; sensors that slip all through
a short recording reach four in one of three."""


def check_height(recording: Recording) -> None:
    """Raise where a declared height and declared bone lengths are of different bodies.

    Args:
        recording: its height may be missing.

    Raises:
        CalibrationError: the heights differ by more than 10 %; names both.
    """
    declared, made = recording.height, recording.skeleton.height
    if declared is not None and abs(made / declared - 1) > _HEIGHT_SHARE:
        raise CalibrationError(
            f"recording {recording.name}: its declared height is {declared:.2f} m, but its bone lengths "
            f"make a body {made:.2f} m tall; measure again, or give only one of the two"
        )


def consistency_warnings(recording: Recording, calibration: SelfCalibration) -> tuple[str, ...]:
    """Describe estimates that contradict their priors or the declared height."""
    found = []
    for q, row in zip(calibration.quantities, calibration.table(), strict=True):
        if q.doubt:
            found.append(f"{row[0]} of {row[1]}: {row[2]} is unreliable: {q.doubt}")
        away = float(np.max(np.abs(q.value) / q.sigma_prior))
        if q.verdict is not Verdict.PRIOR and away > _SIGMAS:
            kind, item, value, _, prior, _ = row
            found.append(
                f"{kind} of {item}: {value} is {away:.0f} times its prior standard deviation {prior}; "
                "its declared value is wrong, or another declaration is"
            )
    declared = recording.height
    if declared is not None and any(line.startswith("bones") for line in found):
        made = calibration.apply(recording).skeleton.height
        found.append(f"the declared height is {declared:.2f} m; the estimated bones make {made:.2f} m")
    return tuple(found)
