"""Which samples of a clinical angle ranges, peaks and gait may go by.

A sample is trusted where its 95 % band is at most `WIDEST_BAND` to either side and its joint turns no
faster than people can. What is not trusted keeps its value and standard deviation; it makes no extreme.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angle_table import AngleRow, JointCoordinateSystem
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.data.confidence import BAND_95

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
WIDEST_BAND = np.radians(30.0)
"""[rad] half width of the 95 % band beyond which an angle tells hardly more than its usual range."""
FASTEST = {"pelvis": 2000.0, "spine": 1200.0, "hip": 1200.0, "knee": 2500.0, "ankle": 2500.0}
"""[deg/s] turning speed that a joint does not exceed: kicks reach 750 at the hip and 1,700 at the knee,
throws 1,200 between pelvis and upper trunk, spins 1,800 of the pelvis. Arms may be faster than any limit
that would tell an error."""
_NEAR = 0.1
"""[s] before and after a turn that is too fast, for which the angle is not trusted either."""


def trusted_turns(joint: JointCoordinateSystem, times: Array, R: Array) -> Mask:
    """(T,) whether rotations (T, 3, 3) of a joint, NaN where unknown, are clear of turns too fast."""
    fastest = next((v for name, v in FASTEST.items() if name in joint.name), np.inf)
    out = np.ones(len(R), dtype=np.bool_)
    if len(R) < 2 or np.isinf(fastest):
        return out
    steps = np.full(len(R) - 1, 0.0)
    known = np.asarray(np.isfinite(R).all(axis=(1, 2)))
    both = known[1:] & known[:-1]
    steps[both] = so3.angle_between(R[1:][both], R[:-1][both])
    for k in np.flatnonzero(np.degrees(steps) > fastest * np.diff(times)):
        out[(times >= times[k] - _NEAR) & (times <= times[k + 1] + _NEAR)] = False
    return out


def trusted_bands(sigma: Array | None, shape: tuple[int, ...]) -> Mask:
    """(T, A) whether standard deviations (T, A) rad are small enough; without any, all are."""
    if sigma is None:
        return np.ones(shape, dtype=np.bool_)
    with np.errstate(invalid="ignore"):
        return np.asarray(~(BAND_95 * sigma > WIDEST_BAND))


def untrusted_note(times: Array, rows: Sequence[AngleRow], known: Mask, trusted: Mask) -> str:
    """One sentence on what ranges, peaks and gait leave out; empty where that is nothing."""
    doubtful = known & ~trusted
    if not doubtful.any():
        return ""
    share = doubtful.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    worst = int(share.argmax())
    spans = [f"{times[a]:.2f} to {times[b - 1]:.2f} s" for a, b in signals.runs(doubtful[:, worst])]
    more = f" and {len(spans) - 3} more" if len(spans) > 3 else ""
    count = int(np.count_nonzero(doubtful.any(axis=0)))
    return (
        f"{count} angles have samples that are not trusted, which ranges, peaks and gait leave out: 95 % "
        f"bands beyond +-{np.degrees(WIDEST_BAND):.0f} deg, or turns faster than people make; most of "
        f"{rows[worst].name}: {100 * share[worst]:.0f} % of it, at {', '.join(spans[:3])}{more}"
    )
