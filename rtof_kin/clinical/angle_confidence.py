"""Standard deviations of clinical angles, and which of their samples are reliable.

Standard deviations follow from the covariance of the relative rotation by first-order propagation: the
error of an angle is linear in the small rotation vector of the child's rotation in its parent. Near a
singular posture the outer two angles amplify it without bound, so they are capped at `UNIFORM_SIGMA`.

A sample is reliable if the half width of its 95 % band is at most `WIDEST_BAND` and the joint does not turn
faster than is physiologically possible. Unreliable samples keep their value and standard deviation but are
excluded from ranges of motion, peaks and gait.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical import joint_coordinate_systems as jcs
from rtof_kin.clinical.angle_table import AngleTable, JointCoordinateSystem
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import BAND_95, Confidence

UNIFORM_SIGMA: Final = np.pi / np.sqrt(3)
"""[rad] standard deviation of an angle uniformly distributed on the circle, the largest value reported."""
_STEP: Final = 1e-5  # [rad] of the central differences
WIDEST_BAND: Final = np.radians(30.0)  # [rad] largest half width of the 95 % band of a reliable sample
FASTEST: Final = {"pelvis": 2000.0, "spine": 1200.0, "hip": 1200.0, "knee": 2500.0, "ankle": 2500.0}
"""[deg/s] upper bounds of angular speed: kicks reach 750 at the hip and 1,700 at the knee, throws 1,200
between pelvis and upper trunk, spins 1,800 of the pelvis. Arms have no bound."""
_MARGIN: Final = 0.1  # [s] before and after a sample that is too fast, excluded too


def angle_sigmas(R: dict[str, Array], table: AngleTable, skeleton: SkeletonModel, confidence: Confidence) -> Array:
    """Return standard deviations (T, A) rad of all angles of a table, in its order.

    Args:
        R: rotations (T, 3, 3) of each joint coordinate system, from `jcs.relative_rotations`.
        confidence: of the motion; angles of segment pairs that it does not contain are NaN.
    """
    frames, columns = jcs.isb_frames(skeleton, table), []
    for joint in table.joints:
        axes = frames[skeleton.names.index(joint.child)].T
        if joint.side == "left":  # rotation vectors are axial vectors
            axes = -jcs.MIRROR[:, None] * axes
        covariance = confidence.turn(joint.parent, joint.child)
        known = np.asarray(np.isfinite(R[joint.name] + covariance).all(axis=(1, 2)))
        J = angle_rates(joint.sequence, R[joint.name][known]) @ axes
        variance = np.einsum("tai,tij,taj->ta", J, covariance[known], J)
        sigma = np.full((len(known), 3), np.nan)
        sigma[known] = np.minimum(np.sqrt(np.maximum(variance, 0.0)), UNIFORM_SIGMA)
        columns.append(sigma)
    return np.concatenate(columns, axis=1)


def angle_rates(sequence: str, R: Array) -> Array:
    """Return derivatives (T, 3, 3) of three angles by a rotation vector e in ``R @ exp(e)``, numerically.

    Args:
        sequence: as in `jcs.decompose`. R: rotations (T, 3, 3).
    """
    columns = []
    for axis in np.eye(3):
        after, before = (jcs.decompose(sequence, R @ so3.exp(s * _STEP * axis)) for s in (1, -1))
        columns.append(((after - before + np.pi) % (2 * np.pi) - np.pi) / (2 * _STEP))
    return np.stack(columns, axis=-1)


def reliable_samples(
    table: AngleTable, times: Array, too_fast: Mask, sigma: Array | None, known: Mask
) -> tuple[Mask, str]:
    """Return a mask (T, A) of reliable samples, and a sentence on the others; empty if there are none.

    Args:
        times: (T,) s. too_fast: (T, joints) from `turns_too_fast`.
        sigma: (T, A) rad; None if the motion has no confidence. known: (T, A) samples with a value.
    """
    reliable = np.repeat(np.stack([_around(times, own) for own in too_fast.T], axis=1), 3, axis=1)
    if sigma is not None:
        reliable &= ~(sigma > WIDEST_BAND / BAND_95)
    excluded = known & ~reliable
    if not excluded.any():
        return reliable, ""
    share = excluded.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    worst = int(share.argmax())
    spans = [f"{times[a]:.2f} to {times[b - 1]:.2f} s" for a, b in signals.runs(excluded[:, worst])]
    more = f" and {len(spans) - 3} more" if len(spans) > 3 else ""
    count = int(np.count_nonzero(excluded.any(axis=0)))
    return reliable, (
        f"{count} angles have unreliable samples, which are excluded from ranges, peaks and gait: 95 % bands "
        f"beyond +-{np.degrees(WIDEST_BAND):.0f} deg, or implausibly fast rotation; most of "
        f"{table.rows[worst].name}: {100 * share[worst]:.0f} % of them, at {', '.join(spans[:3])}{more}"
    )


def turns_too_fast(joint: JointCoordinateSystem, times: Array, R: Array) -> Mask:
    """Return a mask (T,) of frames from which the rotation to the next one is implausibly fast.

    Args:
        times: (T,) s. R: (T, 3, 3), NaN where unknown.
    """
    fastest = next((v for name, v in FASTEST.items() if name in joint.name), np.inf)
    out = np.zeros(len(R), dtype=np.bool_)
    known: Mask = np.asarray(np.isfinite(R).all(axis=(1, 2)))
    both = known[1:] & known[:-1]
    steps = np.zeros(both.shape)
    steps[both] = so3.angle_between(R[1:][both], R[:-1][both])
    out[:-1] = np.degrees(steps) > fastest * np.diff(times)
    return out


def _around(times: Array, too_fast: Mask) -> Mask:
    """(T,) False around the frames from which a rotation is too fast."""
    out = np.ones(len(times), dtype=np.bool_)
    at = np.flatnonzero(too_fast)
    first = np.searchsorted(times, times[at] - _MARGIN, side="left")
    last = np.searchsorted(times, times[np.minimum(at + 1, len(times) - 1)] + _MARGIN, side="right")
    for start, stop in zip(first, last, strict=True):
        out[start:stop] = False
    return out
