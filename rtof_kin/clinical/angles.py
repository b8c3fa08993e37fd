"""`ClinicalAngles`: the joint angles of a motion by clinical name, with who saw each of them when.

An angle that nobody saw is NaN, never the number that a prior or a parent's twist happens to give. What
an angle needs follows from its place in the sequence, because the child's long axis is the last one:

=========  ======================================  =========================================
angle      needs of the parent segment             needs of the child segment
=========  ======================================  =========================================
first      the direction of its bone               the direction of its bone
second     its whole orientation                   the direction of its bone
third      its whole orientation                   its whole orientation
=========  ======================================  =========================================

The whole orientation is seen where `PoseSequence.orientation_observed` says so (several bones, or a
sensor, whoever saw where the joint is); the direction where the joint and its only child were seen. A
leaf without a sensor (hand, foot) has neither. And an angle of a knee or elbow that stands still while
the joint flexes was fixed by the model that made the motion, not seen by anybody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.observability import DIRECTION, WHOLE, segment_levels
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical import joint_coordinate_systems as jcs
from rtof_kin.clinical.angle_confidence import angle_sigmas
from rtof_kin.clinical.angle_table import AngleRow, AngleTable, JointCoordinateSystem, angle_table
from rtof_kin.clinical.trust import trusted_bands, trusted_turns, untrusted_note
from rtof_kin.core import signals
from rtof_kin.core.checks import checked_times, indices_of, readonly
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.poses import PoseSequence, Provenance

Array = NDArray[np.float64]
_NEEDS = {"parent": (DIRECTION, WHOLE, WHOLE), "child": (DIRECTION, DIRECTION, WHOLE)}


@dataclass(frozen=True)
class ClinicalAngles:
    """Joint angles over time by clinical name."""

    times: Array
    """(T,) seconds, strictly increasing."""
    values: Array
    """(T, A) radians; NaN where nobody saw the angle. Continuous within every stretch without a gap."""
    provenance: NDArray[np.uint8]
    """(T, A) `Provenance` of each value: the weaker of its two segments'; a segment's that was seen to
    turn is at least IMU. PRIOR where the pose is known but nobody saw this angle of it."""
    singular: NDArray[np.bool_]
    """(T, A) whether the angle is one of two whose sum alone is defined in this posture, nearly."""
    rows: tuple[AngleRow, ...]
    """A rows of the table: name, sign, range, OpenSim coordinate."""
    notes: tuple[str, ...] = ()
    """What could not be told, and why."""
    sigma: Array | None = None
    """(T, A) rad, standard deviation of each value; NaN where there is no value or nobody knows how good
    it is. None where the motion has no confidence."""
    trusted: NDArray[np.bool_] | None = None
    """(T, A) whether ranges, peaks and gait may go by a value (`clinical.trust`); None for all."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", checked_times("angle times", self.times))
        shape = (len(self.times), len(self.rows))
        set_(self, "values", readonly("angle values", self.values, shape))
        set_(self, "provenance", readonly("angle provenance", self.provenance, shape, np.uint8))
        set_(self, "singular", readonly("angle singular", self.singular, shape, np.bool_))
        if self.sigma is not None:
            sigma: Array = readonly("angle sigma", self.sigma, shape)
            if np.any(sigma < 0) or np.isinf(sigma).any():
                raise ShapeError("angle sigma: negative or infinite; write NaN where it is not known")
            set_(self, "sigma", sigma)
        if self.trusted is not None:
            set_(self, "trusted", readonly("angle trusted", self.trusted, shape, np.bool_))

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, name: str) -> Array:
        """(T,) radians of one angle; `UnknownNameError` if there is none of that name."""
        return np.asarray(self.values[:, indices_of("clinical angle", [name], self.names)[0]])

    @property
    def names(self) -> tuple[str, ...]:
        """A names, e.g. 'right_knee_flexion'."""
        return tuple(row.name for row in self.rows)

    @property
    def values_deg(self) -> Array:
        """(T, A) degrees."""
        return np.asarray(np.degrees(self.values))

    @property
    def known(self) -> NDArray[np.bool_]:
        """(T, A) whether there is a value."""
        return np.isfinite(self.values)

    @property
    def trusted_values(self) -> Array:
        """(T, A) radians; NaN also where a value is not trusted."""
        return self.values if self.trusted is None else np.where(self.trusted, self.values, np.nan)

    @property
    def rate_hz(self) -> float:
        """Frames per second, from the median step; 60 for a single frame."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else 60.0

    def select(self, names: Sequence[str]) -> Self:
        """The angles named, in that order."""
        index = indices_of("clinical angle", names, self.names)
        return replace(
            self,
            values=self.values[:, index],
            provenance=self.provenance[:, index],
            singular=self.singular[:, index],
            rows=tuple(self.rows[i] for i in index),
            sigma=None if self.sigma is None else self.sigma[:, index],
            trusted=None if self.trusted is None else self.trusted[:, index],
        )


def clinical_angles(
    motion: MotionSequence | PoseSequence, skeleton: SkeletonModel | None = None
) -> ClinicalAngles:
    """Clinical joint angles from segment orientations.

    Args:
        motion: a motion, or poses of `skeleton`'s joints. Poses without any provenance (all NOBODY) are
            believed where they are `valid`; `orientation_observed` counts all the same.
        skeleton: of the poses; a motion brings its own.

    Returns:
        Every angle of the table, radians, against the anatomical standing posture.

    Raises:
        ShapeError: poses without a skeleton, or joints missing.
        UnknownNameError: the skeleton has no clinical table.
    """
    poses = motion.poses if isinstance(motion, MotionSequence) else motion
    if isinstance(motion, MotionSequence):
        skeleton = motion.skeleton
    if skeleton is None:
        raise ShapeError("clinical_angles: poses do not bring a skeleton; give the one they are of")
    skeleton.check_joints(poses.names)
    table = angle_table(skeleton.table)
    R = jcs.relative_rotations(poses.R_world_bone, skeleton, table)
    levels = segment_levels(poses, skeleton)
    seen_by = _seen_by(poses, skeleton, levels)
    parts = [_joint_angles(joint, R[joint.name], poses.names, seen_by, levels) for joint in table.joints]
    values, provenance, singular = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    sigma = None
    if isinstance(motion, MotionSequence) and motion.confidence is not None:
        sigma = np.where(np.isfinite(values), angle_sigmas(R, table, skeleton, motion.confidence), np.nan)
    turns = [trusted_turns(joint, poses.times, R[joint.name]) for joint in table.joints]
    trusted = trusted_bands(sigma, values.shape) & np.repeat(np.stack(turns, axis=1), 3, axis=1)
    notes = _notes(table, values, provenance)
    if note := untrusted_note(poses.times, table.rows, np.isfinite(values), trusted):
        notes += (note,)
    return ClinicalAngles(poses.times, values, provenance, singular, table.rows, notes, sigma, trusted)


def all_observed(poses: PoseSequence) -> PoseSequence:
    """The same poses, declared to be seen in all three angles: motion capture, or a planted motion."""
    return replace(poses, orientation_observed=np.ones(len(poses.names), dtype=np.bool_))


def _seen_by(poses: PoseSequence, skeleton: SkeletonModel, levels: NDArray[np.int_]) -> NDArray[np.uint8]:
    """(T, J) `Provenance` of each segment: its joint's; where nobody saw that but all of its turn, who
    saw its far ends, or the sensor of one that has none.
    """
    out = np.array(poses.provenance)
    for j in range(len(skeleton.names) if out.any() else 0):
        ends = poses.provenance[:, kinematics.children_of(skeleton.parents, j)]
        turned = (levels[:, j] == WHOLE) & (out[:, j] < Provenance.IMU)
        out[turned, j] = ends[turned].max(axis=1, initial=Provenance.IMU)
    return out


def _joint_angles(
    joint: JointCoordinateSystem, R: Array, names: tuple[str, ...], seen_by: NDArray[np.uint8],
    levels: NDArray[np.int_],
) -> tuple[Array, NDArray[np.uint8], NDArray[np.bool_]]:  # fmt: skip
    """Values, provenance and singular flags (T, 3) of one joint coordinate system."""
    child = names.index(joint.child)
    parent = names.index(joint.parent) if joint.urdf else child
    child_level = levels[:, child]
    parent_level = levels[:, parent] if joint.urdf else np.full(len(levels), WHOLE)
    observed = (parent_level[:, None] >= _NEEDS["parent"]) & (child_level[:, None] >= _NEEDS["child"])
    posed: NDArray[np.bool_] = np.asarray(np.isfinite(R).all(axis=(-2, -1)))
    signs = np.array([row.sign for row in joint.angles])
    center = signs * np.array([np.mean(row.range) for row in joint.angles])
    raw = np.full((len(R), 3), np.nan)
    singular = np.zeros((len(R), 3), dtype=np.bool_)
    for start, stop in signals.runs(posed & observed.any(axis=1)):
        angles = jcs.decompose(joint.sequence, R[start:stop])
        singular[start:stop, ::2] = jcs.near_singular(joint.sequence, angles)[:, None]
        raw[start:stop] = jcs.continuous(joint.sequence, angles, center)
    observed &= posed[:, None]
    if joint.hinge:
        raw[:, 0] = np.where(parent_level < WHOLE, _bend(raw), raw[:, 0])
        observed &= ~_fixed(raw)
    provenance = _provenance(seen_by[:, [parent, child]], posed, observed)
    return np.where(observed, signs * raw, np.nan), provenance, singular & observed


def _provenance(
    seen_by: NDArray[np.uint8], posed: NDArray[np.bool_], observed: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """(T, 3) of the angles between two segments, seen by (T, 2): posed (T,), some observed (T, 3)."""
    weaker = seen_by.min(axis=1)
    # Two segments may be seen and an angle between them not: that one is whatever a prior made of it.
    both_seen = (weaker >= Provenance.IMU) | (not seen_by.any())
    unseen = np.where(posed, np.where(both_seen, Provenance.PRIOR, weaker), Provenance.NOBODY)
    return np.where(observed, weaker[:, None], unseen[:, None]).astype(np.uint8)


def _bend(raw: Array) -> Array:
    """(T,) the angle between the long axes, which no twist of the parent changes, signed as the first."""
    between = np.arccos(np.clip(np.cos(raw[:, 0]) * np.cos(raw[:, 1]), -1, 1))
    return np.asarray(np.copysign(between, raw[:, 0]))


def _fixed(raw: Array) -> NDArray[np.bool_]:
    """(3,) which angles stand still to a thousandth of a degree while the first one moves: no joint of a
    person does that, so the model that made the motion has a hinge there.
    """
    known = raw[np.isfinite(raw).all(axis=1)]
    if len(known) == 0:
        return np.zeros(3, dtype=np.bool_)
    span = np.degrees(np.ptp(known, axis=0))
    return np.asarray((span < 1e-3) & (span[0] > 1.0))


def _notes(table: AngleTable, values: Array, provenance: NDArray[np.uint8]) -> tuple[str, ...]:
    """One sentence for the angles that nobody ever saw, one for those seen only at times."""
    share = np.isfinite(values).mean(axis=0)
    names = np.array([row.name for row in table.rows])
    notes = []
    never = share == 0
    if never.any():
        posed = (provenance == Provenance.PRIOR).any(axis=0)
        why = "not in the data"
        if posed[never].all():
            why = "no sensor and no landmark shows that turn, or the model that made the motion fixes it"
        notes.append(f"no value at all ({why}): {', '.join(names[never])}")
    at_times = (share > 0) & (share < 1)
    if at_times.any():
        worst = int(np.argmin(np.where(at_times, share, 2)))
        missing = 100 * (1 - share[worst])
        notes.append(
            f"{at_times.sum()} angles have gaps where nobody saw them, the largest share "
            + ("under 1" if missing < 1 else f"{missing:.0f}") + f" % of the time: {names[worst]}"
        )  # fmt: skip
    return tuple(notes)
