"""Angles of each joint coordinate system frame by frame, as `angles` makes clinical angles from them.

**Frames.** ISB segment frames, and the three angles of a rotation between two of them.

A link frame is x forward, y left, z up in the T-pose with palms down. An ISB frame is x forward, y up, z
right in the anatomical standing posture (arms hanging, palms forward) and fixed in the segment by the
constant `R_bone_isb`. So each angle is 0 in the anatomical posture, whatever the skeleton's own zero.

**Confidence.** Standard deviations of clinical angles, and which of their samples are reliable.

Standard deviations follow from the covariance of the relative rotation by first-order propagation: the
error of an angle is linear in the small rotation vector of the child's rotation in its parent. Near a
singular posture the outer two angles amplify it without bound, so they are capped at `UNIFORM_SIGMA`.

A sample is reliable if the half width of its 95 % band is at most `WIDEST_BAND` and the joint does not turn
faster than is physiologically possible. Unreliable samples keep their value and standard deviation but are
excluded from ranges of motion, peaks and gait.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SINGULAR_MARGIN, SkeletonModel
from rtof_kin.clinical.angle_table import AngleTable, JointCoordinateSystem
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import some
from rtof_kin.data.confidence import BAND_95, Confidence
from rtof_kin.data.poses import PoseSequence

UNIFORM_SIGMA: Final = np.pi / np.sqrt(3)
"""[rad] standard deviation of an angle uniformly distributed on the circle, the largest value reported."""
_STEP: Final = 1e-5  # [rad] of the central differences
WIDEST_BAND: Final = np.radians(30.0)  # [rad] largest half width of the 95 % band of a reliable sample
FASTEST: Final = {"pelvis": 2000.0, "spine": 1200.0, "hip": 1200.0, "knee": 2500.0, "ankle": 2500.0}
"""[deg/s] upper bounds of angular speed: kicks reach 750 at the hip and 1,700 at the knee, throws 1,200
between pelvis and upper trunk, spins 1,800 of the pelvis. Arms have no bound."""
_MARGIN: Final = 0.1  # [s] before and after a sample that is too fast, excluded too


def angle_sigmas(R: dict[str, Array], table: AngleTable, skeleton: SkeletonModel, confidence: Confidence) -> Array:
    """Return standard deviations (T, A) rad of all angles of a table, in its order; R: rotations (T, 3, 3) of each
    joint coordinate system, from `relative_rotations`; confidence: of the motion; angles of segment pairs that it does
    not contain are NaN.
    """
    frames, columns = isb_frames(skeleton, table), []
    for joint in table.joints:
        axes = frames[skeleton.names.index(joint.child)].T
        if joint.side == "left":  # rotation vectors are axial vectors
            axes = -MIRROR[:, None] * axes
        covariance = confidence.turn(joint.parent, joint.child)
        known = np.asarray(np.isfinite(R[joint.name] + covariance).all(axis=(1, 2)))
        J = angle_rates(joint.sequence, R[joint.name][known]) @ axes
        variance = np.einsum("tai,tij,taj->ta", J, covariance[known], J)
        sigma = np.full((len(known), 3), np.nan)
        sigma[known] = np.minimum(np.sqrt(np.maximum(variance, 0.0)), UNIFORM_SIGMA)
        columns.append(sigma)
    return np.concatenate(columns, axis=1)


def angle_rates(sequence: str, R: Array) -> Array:
    """Return derivatives (T, 3, 3) of three angles by a rotation vector e in ``R @ exp(e)``, numerically; sequence: as
    in `decompose`; R: rotations (T, 3, 3).
    """
    columns = []
    for axis in np.eye(3):
        after, before = (decompose(sequence, R @ so3.exp(s * _STEP * axis)) for s in (1, -1))
        columns.append(((after - before + np.pi) % (2 * np.pi) - np.pi) / (2 * _STEP))
    return np.stack(columns, axis=-1)


def reliable_samples(
    table: AngleTable, times: Array, too_fast: Mask, sigma: NDArray[np.float32] | None, known: Mask
) -> tuple[Mask, str]:
    """Return a mask (T, A) of reliable samples, and a sentence on the others; empty if there are none; times: (T,) s;
    too_fast: (T, joints) from `turns_too_fast`; sigma: (T, A) rad; None if the motion has no confidence; known: (T, A)
    samples with a value.
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
    count = int(np.count_nonzero(excluded.any(axis=0)))
    return reliable, (
        f"{count} angles have unreliable samples, which are excluded from ranges, peaks and gait: 95 % bands "
        f"beyond +-{np.degrees(WIDEST_BAND):.0f} deg, or implausibly fast rotation; most of "
        f"{table.rows[worst].name}: {100 * share[worst]:.0f} % of them, at {some(spans)}"
    )


def turns_too_fast(joint: JointCoordinateSystem, times: Array, R: Array) -> Mask:
    """Return a mask (T,) of frames from which R (T, 3, 3), NaN where unknown, turns implausibly fast to the next."""
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


R_ROS_ISB: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""ISB axes (x forward, y up, z right) in axes x forward, y left, z up."""
MIRROR: Final = np.array([1.0, 1.0, -1.0])  # reflection in the sagittal plane, in ISB axes


def anatomical_posture(skeleton: SkeletonModel, table: AngleTable) -> Array:
    """Return R_world_bone (J, 3, 3) of the anatomical standing posture facing world x.

    It is the N-pose (palms to the thighs) with forearms and hands supinated by 90 degrees.
    """
    R_posture = np.array(skeleton.forward_kinematics(skeleton.n_pose()[None])[1][0])
    for side, quarter in (("right", -np.pi / 2), ("left", np.pi / 2)):
        for word in ("forearm", "hand"):
            (j,) = skeleton.index(table.segments[f"{side} {word}"])
            R_posture[j] = so3.about_axis("z", quarter) @ R_posture[j]
    return R_posture


def isb_frames(skeleton: SkeletonModel, table: AngleTable) -> Array:
    """Return the constant R_bone_isb (J, 3, 3) of all segments."""
    return np.asarray(np.swapaxes(anatomical_posture(skeleton, table), -1, -2) @ R_ROS_ISB)


def decompose(sequence: str, R: Array) -> Array:
    """Return the angles (..., 3) in radians of rotations in ISB axes.

    At a singular posture the first angle is 0 and the third is the sum.

    Args:
        sequence: three different axes, the middle angle then in [-pi/2, pi/2]; or 'yxy', the middle
            angle then in [-pi, 0] (Wu et al. 2005: elevation is a negative rotation).
        R: R_parent_child (..., 3, 3).
    """
    if sequence != "yxy":
        return so3.matrix_to_euler(sequence, R)
    sine = np.hypot(R[..., 0, 1], R[..., 2, 1])
    elevation = np.arctan2(sine, R[..., 1, 1])
    singular = sine < 1e-12
    first = np.where(singular, 0.0, np.arctan2(-R[..., 0, 1], -R[..., 2, 1]))
    third = np.arctan2(-R[..., 1, 0], R[..., 1, 2])
    third = np.where(singular, np.arctan2(R[..., 0, 2], R[..., 0, 0]), third)
    return np.stack([first, -elevation, third], axis=-1)


def near_singular(sequence: str, angles: Array) -> Mask:
    """Return a mask (...) of postures within 5 degrees of one where only the sum of the outer two is defined; sequence:
    as in `decompose`; angles: (..., 3) radians.
    """
    distance = np.abs(np.sin(angles[..., 1]) if sequence == "yxy" else np.cos(angles[..., 1]))
    return np.asarray(distance < np.sin(SINGULAR_MARGIN))


def continuous(sequence: str, angles: Array, center: Array) -> Array:
    """Remove jumps over time, except at singular postures.

    The angles of a rotation are ambiguous by whole turns and by (a + pi, pi - b, c + pi). Each stretch
    between two singular postures gets one choice, that whose median is nearest to the middle of the ranges.
    The middle angle of 'yxy' keeps its sign.

    Args:
        sequence: as in `decompose`. angles: (T, 3) radians without NaN. center: (3,) middle of the ranges.
    """
    out = np.empty_like(angles)
    singular = near_singular(sequence, angles)
    starts = [0, *(stop for _, stop in signals.runs(singular) if stop < len(angles))]
    for start, stop in pairwise([*starts, len(angles)]):
        choices = [np.unwrap(angles[start:stop], axis=0)]
        if sequence != "yxy":
            choices.append(choices[0] * [1, -1, 1] + np.pi)
        turns = [np.round((np.median(choice, axis=0) - center) / (2 * np.pi)) for choice in choices]
        choices = [choice - 2 * np.pi * turn for choice, turn in zip(choices, turns, strict=True)]
        distances = [np.sum((np.median(choice, axis=0) - center) ** 2) for choice in choices]
        out[start:stop] = choices[int(np.argmin(distances))]
    return out


def relative_rotations(R_world_bone: Array, skeleton: SkeletonModel, table: AngleTable) -> dict[str, Array]:
    """Return R_parent_child (T, 3, 3) in ISB frames of all joint systems, mirrored if left, of (T, J, 3, 3)."""
    R_world_isb = R_world_bone @ isb_frames(skeleton, table)
    out = {}
    for joint in table.joints:
        R_parent = R_world_isb[:, skeleton.index(joint.parent)[0]] if joint.urdf else R_ROS_ISB
        R = np.swapaxes(R_parent, -1, -2) @ R_world_isb[:, skeleton.index(joint.child)[0]]
        out[joint.name] = MIRROR[:, None] * R * MIRROR if joint.side == "left" else R
    return out


class DecomposedAngles:
    """Angles, their standard deviations and too fast turns of a whole motion, added block by block.

    Attributes:
        skeleton: of the motion. table: its J joints and A angles. times: (T,) s.
        angles: (T, A) rad, not continuous over time, without signs; NaN where a segment is unknown.
        sigma: (T, A) rad; None until a block has a confidence. too_fast: (T, J) of `turns_too_fast`.
    """

    def __init__(self, skeleton: SkeletonModel, table: AngleTable, times: Array):
        """Allocate the angles; times: (T,) s."""
        self.skeleton, self.table, self.times = skeleton, table, times
        self.angles: Array = np.full((len(times), len(table.rows)), np.nan)
        self.sigma: NDArray[np.float32] | None = None
        self.too_fast: Mask = np.zeros((len(times), len(table.joints)), dtype=np.bool_)

    def add(self, frames: slice, poses: PoseSequence, own: slice, confidence: Confidence | None) -> None:
        """Add a block; poses: these and, if there is one, the next frame; own: `frames` in poses."""
        self.skeleton.check_joints(poses.names)
        R = relative_rotations(poses.R_world_bone, self.skeleton, self.table)
        for j, joint in enumerate(self.table.joints):
            known = np.isfinite(R[joint.name]).all(axis=(-2, -1))
            angles = np.full((len(poses), 3), np.nan)
            angles[known] = decompose(joint.sequence, R[joint.name][known])
            self.angles[frames, 3 * j : 3 * j + 3] = angles[own]
            self.too_fast[frames, j] = turns_too_fast(joint, poses.times, R[joint.name])[own]
        if confidence is not None:
            if self.sigma is None:
                self.sigma = np.full(self.angles.shape, np.nan, np.float32)
            self.sigma[frames] = angle_sigmas(R, self.table, self.skeleton, confidence)[own]
