"""Number of threads of the numerical libraries.

The BLAS of NumPy and SciPy, CasADi and torch read the environment when they are loaded. Matrices here are
small: a second thread doubles the processor time and gains nothing.
"""

from __future__ import annotations

import os
import sys

from rtof_kin.core.errors import InvalidInputError

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
USUAL = 1
"""Default number of threads."""


def threads() -> int | None:
    """Return the number of threads set in the environment; None if unset."""
    text = os.environ.get(VARIABLES[0], "")
    return int(text) if text.isdecimal() else None


def limit_threads(count: int | None) -> None:
    """Set the number of threads of libraries that are loaded from now on.

    Args:
        count: if None, the number set in the environment, else `USUAL`.

    Raises:
        InvalidInputError: less than one, or libraries are loaded already with another number.
    """
    if count is not None and count < 1:
        raise InvalidInputError(f"threads: {count}; give 1 or more")
    if "numpy" in sys.modules:
        if count not in (None, threads()):
            raise InvalidInputError(
                f"threads: numerical libraries are loaded already; set {VARIABLES[0]}={count} before Python starts"
            )
        return
    for name in VARIABLES:
        os.environ[name] = str(count or threads() or USUAL)
