"""How many threads the numerical libraries may use.

NumPy's and SciPy's BLAS, CasADi and torch read it when they are loaded. The matrices here are small: a
second thread takes as much processor time again and gains nothing.
"""

from __future__ import annotations

import os
import sys

from rtof_kin.core.errors import ShapeError

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
USUAL = 1


def threads() -> int | None:
    """How many they may use; None where they decide themselves."""
    text = os.environ.get(_VARIABLES[0], "")
    return int(text) if text.isdecimal() else None


def limit_threads(count: int | None) -> None:
    """Say how many threads the libraries may use that are loaded from now on.

    Args:
        count: where not given, what the environment says stands, else `USUAL`.

    Raises:
        ShapeError: fewer than one; or libraries are loaded already, that were told otherwise.
    """
    if count is not None and count < 1:
        raise ShapeError(f"threads: {count}; give 1 or more")
    if "numpy" in sys.modules:
        if count not in (None, threads()):
            raise ShapeError(
                f"threads: numerical libraries are loaded already; set {_VARIABLES[0]}={count} before "
                "Python starts"
            )
        return
    wanted = count or threads() or USUAL
    for name in _VARIABLES:
        os.environ[name] = str(wanted)
