"""Diagnosis of a sensor setup: swapped or turned sensors, wrong segments, a wrong facing in the pose.

Each possible fault is a hypothetical correction of the calibration. Its log-likelihood ratio against the
calibration as declared is computed from movement (`rtof_kin.inertial.likelihood`), and it is reported if the
ratio is large. Swapped left and right sensors are only observable with a sensor on a neighbouring segment; a world that
is turned about the vertical is measured against the image (`rtof_kin.reconstruction.checks.causes`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, cached_property
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu import BoneImuSequence, ImuCalibration
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import MotionLikelihood, SegmentMotion, even_times, seen_bones, segment_motions
from rtof_kin.inertial.pose_calibration import pose_rotations, turned_to, usual_lever
from rtof_kin.inertial.segment_names import other_side

LEAST_RATIO: Final = 10.0  # [nats] log-likelihood ratio from which a fault is reported
_LONE_FACTOR = 2.5  # multiple of it for sensors without one on a neighbouring segment
_LONGEST = 20.0  # [s] longer movements have the weight of this duration
_SAME_RATIO, _MOST_ALTERNATIVES = 3.0, 3  # [nats] to the likeliest fault, and number of alternatives
_QUARTERS_DEG = {90: "90 degrees to the left of", -90: "90 degrees to the right of", 180: "180 degrees from"}
_NEAR = 2  # joints between segments that are confused with each other
_SIDES = ("Left", "Right")
_Total = Callable[[Sequence[SegmentMotion]], float]  # Motions -> log-likelihood, nats


class FaultKind(Enum):
    """Kinds of faults of a setup."""

    FACING = "the person faced another way during the calibration pose than was assumed"
    MOUNTING = "the sensor is turned on its segment against its calibration"
    SIDES = "left and right sensors are swapped"
    NEIGHBOURS = "the sensors of two neighbouring segments are swapped"
    SWAPPED = "the sensors of two segments that are no neighbours are swapped"
    STREAMS = "the samples of sensors are filed under each other's names"
    SEGMENT = "the sensor is on another segment than declared"


@dataclass(frozen=True, eq=False)
class _Change:
    """Correction of one sensor's calibration."""

    declared: str  # segment
    joint: str  # actual segment
    R_bone_new: Array  # (3, 3) factor of R_sensor_bone from the right
    p_bone_sensor: Array  # (3,) m, lever arm on the actual segment
    R_world_new: Array | None = None  # (3, 3) factor of R_world_inertial from the left


@dataclass(frozen=True, eq=False)
class Fault:
    """A likely fault of the setup, after the correction of those reported before it."""

    kind: FaultKind  #: Kind of the fault
    what: str  #: Description with the sensors concerned
    remedy: str  #: What to do about it
    changes: tuple[_Change, ...]  #: Corrections of single sensors
    log_likelihood_ratio: float = 0.0  #: Against the calibration as declared, nats
    alternatives: tuple[str, ...] = ()  #: Descriptions of other faults that are nearly as likely

    def __str__(self) -> str:
        others = f"; or else: {'; '.join(self.alternatives)}" if self.alternatives else ""
        ratio = f"log-likelihood ratio {self.log_likelihood_ratio:.0f}"
        return f"{self.what} ({ratio}{others}). {self.remedy}."

    def corrected(self, calibration: ImuCalibration) -> ImuCalibration:
        """Return the calibration without the fault. `CalibrationError`: it has no sensor on one of the segments
        concerned.
        """
        missing = [c.declared for c in self.changes if c.declared not in calibration.joints]
        if missing:
            problem = f"has no sensor on {', '.join(missing)}; give the one that was diagnosed"
            raise CalibrationError(f"the calibration {problem}")
        joints, levers = list(calibration.joints), np.array(calibration.p_bone_sensor)
        R_sensor_bone, R_world_inertial = (calibration.R_sensor_bone.copy(), calibration.R_world_inertial.copy())
        for change in self.changes:
            s = calibration.joints.index(change.declared)
            joints[s], levers[s] = change.joint, change.p_bone_sensor
            R_sensor_bone[s] = R_sensor_bone[s] @ change.R_bone_new
            if change.R_world_new is not None:
                R_world_inertial[s] = change.R_world_new @ R_world_inertial[s]
        return replace(
            calibration,
            joints=tuple(joints),
            R_world_inertial=R_world_inertial,
            R_sensor_bone=R_sensor_bone,
            p_bone_sensor=levers,
        )

    def _read(self, motions: Sequence[SegmentMotion]) -> tuple[SegmentMotion, ...]:
        """The motions under the corrected calibration."""
        changes, out = {change.declared: change for change in self.changes}, []
        for motion in motions:
            if (change := changes.get(motion.joint)) is not None:
                motion = motion if change.R_world_new is None else motion.turned(change.R_world_new)
                motion = motion.moved(change.joint, change.R_bone_new, change.p_bone_sensor)
            out.append(motion)
        return tuple(out)


def diagnose_setup(
    bone_imus: BoneImuSequence,
    skeleton: SkeletonModel,
    *,
    pose: str | ArrayLike = "T",
    visual: PoseSequence | None = None,
    calibration: ImuCalibration | None = None,
    kinds: Collection[FaultKind] = tuple(FaultKind),
    most: int = 3,
) -> tuple[Fault, ...]:
    """Return the likely faults of calibrated sensors, the likeliest first.

    Args:
        bone_imus: calibrated sensors over some seconds of movement. skeleton: the subject's. pose: calibration pose as
        in `calibrate_by_pose`; 'T' where the calibration used no pose. visual: poses of the same movement from a
        camera; their bone directions are compared. calibration: the calibration of the sensors, required to find
        swapped streams. most: largest number of faults; each is searched after correction of those before it.
    """
    R_pose = turned_to(pose_rotations(pose, skeleton), 0.0)
    motions = segment_motions(bone_imus)
    total = _total(bone_imus, skeleton, visual)
    found: list[Fault] = []
    while len(found) < most:
        setup = _Setup(skeleton, {m.joint: m.p_bone_sensor for m in motions}, R_pose, calibration)
        faults = [f for f in setup.possible_faults() if f.kind in kinds]
        fault = _likeliest(total, motions, setup, faults)
        if fault is None:
            break
        found.append(fault)
        motions = fault._read(motions)
        calibration = None if calibration is None else fault.corrected(calibration)
    return tuple(found)


def setup_log_likelihood(
    bone_imus: BoneImuSequence, skeleton: SkeletonModel, visual: PoseSequence | None = None
) -> float:
    """Return the log-likelihood, nats, of the movement of calibrated sensors, to compare calibrations; see
    `diagnose_setup`.
    """
    return _total(bone_imus, skeleton, visual)(segment_motions(bone_imus))


def _total(bone_imus: BoneImuSequence, skeleton: SkeletonModel, visual: PoseSequence | None) -> _Total:
    """Return the total log-likelihood as a function of motions."""
    times = even_times(bone_imus)
    seen = None if visual is None else seen_bones(visual, skeleton, times)
    likelihood = MotionLikelihood(skeleton, seen=seen)
    weight = min(1.0, _LONGEST / (times[-1] - times[0]))
    single, pair = cache(likelihood.single), cache(likelihood.pair)  # each term is computed once

    def total(motions: Sequence[SegmentMotion]) -> float:
        by_joint = {motion.joint: motion for motion in motions}
        out = sum(single(motion) for motion in motions)
        out += sum(pair(by_joint[a], by_joint[b]) for a, b in likelihood.tree(sorted(by_joint)))
        return float(weight * out)

    return total


def _likeliest(total: _Total, motions: Sequence[SegmentMotion], setup: _Setup, faults: Sequence[Fault]) -> Fault | None:
    base = total(motions)
    ratios = np.array([total(fault._read(motions)) - base for fault in faults])
    least = [LEAST_RATIO * (_LONE_FACTOR if setup.is_lone(fault) else 1.0) for fault in faults]
    enough = np.flatnonzero(ratios >= least)
    if not len(enough):
        return None
    best = int(enough[np.argmax(ratios[enough])])
    close = [i for i in np.argsort(-ratios) if ratios[i] > ratios[best] - _SAME_RATIO and i != best]
    others = tuple(faults[i].what for i in close[:_MOST_ALTERNATIVES])
    return replace(faults[best], log_likelihood_ratio=float(ratios[best]), alternatives=others)


@dataclass(frozen=True)
class _Setup:
    """Sensors as declared, the calibration pose, and the faults that are possible."""

    skeleton: SkeletonModel
    levers: dict[str, Array]  # segment -> lever arm (3,), m, of each sensor
    R_pose: Array  # (J, 3, 3) R_world_bone, facing x
    calibration: ImuCalibration | None

    @cached_property
    def index(self) -> dict[str, int]:
        """Index of each segment."""
        return {name: j for j, name in enumerate(self.skeleton.names)}

    def possible_faults(self) -> Iterator[Fault]:
        """Generate all faults."""
        for angle, way in _QUARTERS_DEG.items():
            turn = so3.about_axis("z", np.radians(angle))
            R_pose = {joint: self.R_pose[self.index[joint]] for joint in self.levers}
            yield Fault(
                FaultKind.FACING,
                f"in the calibration pose the person faced {way} where it was assumed",
                "Calibrate again with the right facing, or estimate it from movement (facing=None)",
                tuple(self._turned(joint, R.T @ turn @ R) for joint, R in R_pose.items()),
            )
        for joint, axis, angle in product(self.levers, "xyz", _QUARTERS_DEG):
            yield Fault(
                FaultKind.MOUNTING,
                f"the sensor on {joint} sits turned by {angle} degrees about the segment's {axis} axis against its "
                "calibration",
                "Put it back as it was, or calibrate again as it sits now",
                (self._turned(joint, so3.about_axis(axis, np.radians(angle))),),
            )
        yield from self._swaps()
        carriers = {joint for joint, _ in self.skeleton.sensors.values()}
        for a, b in product(self.levers, sorted(carriers - set(self.levers))):
            if self._near(a, b) or b == other_side(a):
                what = f"the sensor declared on {a} sits on {b}"
                remedy = f"Declare it on {b}, or move it to {a}, and calibrate again"
                yield Fault(FaultKind.SEGMENT, what, remedy, (self._moved(a, b),))

    def is_lone(self, fault: Fault) -> bool:
        """Return whether no sensor concerned has another one on a neighbouring segment."""
        if fault.kind is FaultKind.FACING:
            return False
        parents = self.skeleton.parents
        own = {self.index[joint] for joint in self.levers}
        concerned = {self.index[change.declared] for change in fault.changes}
        return not any(parents[j] in own or any(parents[k] == j for k in own) for j in concerned)

    def _swaps(self) -> Iterator[Fault]:
        groups = [(kind, what, [*pairs, *((b, a) for a, b in pairs)]) for kind, what, pairs in self._groups()]
        remedy = "Swap the two names, or the sensors, and calibrate again"
        for kind, what, ways in groups:
            yield Fault(kind, f"{what} are swapped", remedy, tuple(self._moved(*way) for way in ways))
        remedy = "Swap the two names where the samples are filed"
        for _, what, ways in groups if self.calibration is not None else ():
            what = f"the samples of {what.removeprefix('the sensors of ')} are swapped"
            yield Fault(FaultKind.STREAMS, what, remedy, tuple(self._refiled(*way) for way in ways))

    def _groups(self) -> Iterator[tuple[FaultKind, str, list[tuple[str, str]]]]:
        """Generate the pairs of segments whose sensors may be swapped together."""
        pairs = [(a, other_side(a)) for a in self.levers if a.startswith(_SIDES[0])]
        pairs = [(a, b) for a, b in pairs if b in self.levers]
        for a, b in pairs:
            yield FaultKind.SIDES, f"the sensors of {a} and {b}", [(a, b)]
        limbs = {self._trunk_of(a) for a, _ in pairs}
        for trunk in sorted(limbs):
            group = [(a, b) for a, b in pairs if self._trunk_of(a) == trunk]
            if len(group) > 1:
                names = ", ".join(a.removeprefix(_SIDES[0]) for a, _ in group)
                yield FaultKind.SIDES, f"all left and right sensors of {names}", group
        if len(limbs) > 1:
            yield FaultKind.SIDES, "all left and right sensors", pairs
        for a, b in product(self.levers, repeat=2):
            if self.index[a] < self.index[b] and b != other_side(a):
                kind = FaultKind.NEIGHBOURS if self._near(a, b) else FaultKind.SWAPPED
                yield kind, f"the sensors of {a} and {b}", [(a, b)]

    def _turned(self, joint: str, R_bone_new: Array) -> _Change:
        return _Change(joint, joint, R_bone_new, self.levers[joint])

    def _moved(self, declared: str, joint: str) -> _Change:
        """Assign a sensor to another segment; the pose had aligned it with the declared one."""
        R_declared, R_joint = self.R_pose[self.index[declared]], self.R_pose[self.index[joint]]
        lever = self.levers[joint] if joint in self.levers else usual_lever(joint, self.skeleton)
        return _Change(declared, joint, R_declared.T @ R_joint, lever)

    def _refiled(self, declared: str, joint: str) -> _Change:
        """Read the samples of the sensor on `declared` with the calibration of the one on `joint`."""
        calibration = self.calibration
        assert calibration is not None
        a, b = (calibration.joints.index(name) for name in (declared, joint))
        R, W = calibration.R_sensor_bone, calibration.R_world_inertial
        return _Change(declared, joint, R[a].T @ R[b], self.levers[joint], W[b] @ W[a].T)

    def _near(self, a: str, b: str) -> bool:
        lines = (set(kinematics.line_to_root(self.skeleton.parents, self.index[j])) for j in (a, b))
        return len(set.symmetric_difference(*lines)) <= _NEAR

    def _trunk_of(self, joint: str) -> str:
        """Return the nearest segment towards the root that has no side."""
        line = kinematics.line_to_root(self.skeleton.parents, self.index[joint])
        return next(n for n in (self.skeleton.names[j] for j in line) if not n.startswith(_SIDES))
