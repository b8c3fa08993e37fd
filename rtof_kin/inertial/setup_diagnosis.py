"""Ways in which people get a sensor setup wrong, each as the correction that it calls for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.inertial.alignment import usual_lever
from rtof_kin.inertial.segment_motion import SegmentMotion

Array = NDArray[np.float64]
_QUARTERS_DEG = (90, -90, 180)
_NEAR = 2
"""Segments so many joints apart are taken for each other."""
_SIDES = ("Left", "Right")
_SAME = np.eye(3)


class FaultKind(Enum):
    """What people get wrong."""

    FACING = "the person faced another way during the calibration pose than was assumed"
    MOUNTING = "the sensor is turned on its segment against its calibration"
    SIDES = "left and right sensors are swapped"
    NEIGHBOURS = "the sensors of two neighbouring segments are swapped"
    SWAPPED = "the sensors of two segments that are no neighbours are swapped"
    STREAMS = "the samples of sensors are filed under each other's names"
    SEGMENT = "the sensor is on another segment than declared"
    WORLD = "the sensors' world is turned about the vertical against the camera's"


@dataclass(frozen=True, eq=False)
class Change:
    """How one sensor would have to be read."""

    declared: str
    """The segment that it was declared on."""
    joint: str
    """The segment that it is on."""
    R_bone_new: Array
    """(3, 3) R_sensor_bone is to be multiplied by this from the right."""
    p_bone_sensor: Array
    """(3,) its lever arm there, m."""
    R_world_new: Array = field(default_factory=lambda: _SAME)
    """(3, 3) its R_world_inertial is to be multiplied by this from the left."""


@dataclass(frozen=True, eq=False)
class Fault:
    """One thing that is likely wrong; of several, what is left when those before it are corrected."""

    kind: FaultKind
    what: str
    """What is likely, in words: which sensors, and how they are."""
    remedy: str
    """What to do about it."""
    changes: tuple[Change, ...]
    """Sensors that are to be read otherwise."""
    R_world_new: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) that R_world_inertial of all sensors is to be multiplied by from the left."""
    log_likelihood_ratio: float = 0.0
    """Nats by which this explains the movement better than the calibration as declared."""
    alternatives: tuple[str, ...] = ()
    """Other things that explain it nearly as well."""

    def __str__(self) -> str:
        others = f"; or else: {'; '.join(self.alternatives)}" if self.alternatives else ""
        ratio = f"log-likelihood ratio {self.log_likelihood_ratio:.0f}"
        return f"{self.what} ({ratio}{others}). {self.remedy}."

    def corrected(self, calibration: ImuCalibration) -> ImuCalibration:
        """The calibration without the fault.

        Raises:
            CalibrationError: it has no sensor on a segment that is concerned.
        """
        missing = [c.declared for c in self.changes if c.declared not in calibration.joints]
        if missing:
            raise CalibrationError(
                f"the calibration has no sensor on {', '.join(missing)}, which the fault is about; give "
                "the one under which it was found"
            )
        joints, levers = list(calibration.joints), np.array(calibration.p_bone_sensor)
        R_sensor_bone = np.array(calibration.R_sensor_bone)
        R_world_inertial = self.R_world_new @ calibration.R_world_inertial
        for change in self.changes:
            s = calibration.joints.index(change.declared)
            joints[s], levers[s] = change.joint, change.p_bone_sensor
            R_sensor_bone[s] = R_sensor_bone[s] @ change.R_bone_new
            R_world_inertial[s] = change.R_world_new @ R_world_inertial[s]
        return replace(
            calibration,
            joints=tuple(joints),
            R_sensor_bone=R_sensor_bone,
            p_bone_sensor=levers,
            R_world_inertial=R_world_inertial,
        )

    def read(self, motions: Sequence[SegmentMotion]) -> tuple[SegmentMotion, ...]:
        """Sensors as they are to be read if this is what is wrong."""
        changes = {change.declared: change for change in self.changes}
        out = []
        for motion in motions:
            if motion.joint in changes:
                change = changes[motion.joint]
                if change.R_world_new is not _SAME:
                    motion = motion.turned(change.R_world_new)
                motion = motion.moved(change.joint, change.R_bone_new, change.p_bone_sensor)
            if self.kind is FaultKind.WORLD:
                motion = motion.turned(self.R_world_new)
            out.append(motion)
        return tuple(out)


# --- all of them ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Setup:
    """Sensors as declared, and the pose in which they were calibrated."""

    skeleton: SkeletonModel
    levers: dict[str, Array]
    """Segment -> lever arm (3,), m, of each sensor."""
    R_pose: Array
    """(J, 3, 3) R_world_bone of all segments, facing x."""
    calibration: ImuCalibration | None = None
    """What the sensors' samples are read with; None where it is not known."""

    def possible_faults(self, seen: bool) -> Iterator[Fault]:
        """Everything that is looked for; `seen`: a camera tells how the world is turned."""
        yield from self._facings(seen)
        yield from self._mountings()
        yield from self._swaps()
        if self.calibration is not None:
            yield from self._streams()
        yield from self._elsewhere()

    def is_lone(self, fault: Fault) -> bool:
        """Whether no sensor that a fault is about has another on the next segment."""
        if fault.kind in (FaultKind.FACING, FaultKind.WORLD):
            return False
        parents = self.skeleton.parents
        own = {self._index(joint) for joint in self.levers}
        concerned = {self._index(change.declared) for change in fault.changes}
        return not any(parents[j] in own or any(parents[k] == j for k in own) for j in concerned)

    # --- kinds -----------------------------------------------------------------------------------

    def _facings(self, seen: bool) -> Iterator[Fault]:
        for angle in _QUARTERS_DEG:
            turn = so3.about_axis("z", np.radians(angle))
            R_pose = {joint: self.R_pose[self._index(joint)] for joint in self.levers}
            yield Fault(
                FaultKind.FACING,
                f"in the calibration pose the person faced {_way(angle)} where it was assumed",
                "Calibrate again with the right facing, or let movement tell it (facing=None)",
                tuple(self._turned(joint, R.T @ turn @ R) for joint, R in R_pose.items()),
            )
            if seen:
                yield Fault(
                    FaultKind.WORLD,
                    f"the sensors' world has to be turned by {angle} degrees about the vertical to be "
                    "the camera's",
                    "Turn the sensors' references, or the camera's calibration, by that angle",
                    (),
                    turn,
                )

    def _mountings(self) -> Iterator[Fault]:
        for joint in self.levers:
            for axis in "xyz":
                for angle in _QUARTERS_DEG:
                    yield Fault(
                        FaultKind.MOUNTING,
                        f"the sensor on {joint} sits turned by {angle} degrees about the segment's "
                        f"{axis} axis against its calibration",
                        "Put it back as it was, or calibrate again as it sits now",
                        (self._turned(joint, so3.about_axis(axis, np.radians(angle))),),
                    )

    def _swaps(self) -> Iterator[Fault]:
        remedy = "Swap the two names, or the sensors, and calibrate again"
        for kind, what, pairs in self._groups():
            yield Fault(kind, f"{what} are swapped", remedy, self._exchanged(pairs))

    def _streams(self) -> Iterator[Fault]:
        """Samples that were taken for another sensor's, so that they are read with its calibration."""
        remedy = "Swap the two names where the samples are filed"
        for _, what, pairs in self._groups():
            changes = tuple(self._refiled(*way) for a, b in pairs for way in ((a, b), (b, a)))
            what = f"the samples of {what.removeprefix('the sensors of ')}"
            yield Fault(FaultKind.STREAMS, f"{what} are swapped", remedy, changes)

    def _groups(self) -> Iterator[tuple[FaultKind, str, list[tuple[str, str]]]]:
        """Pairs of segments whose sensors are taken for each other, together."""
        pairs = [(a, _mirrored(a)) for a in self.levers if a.startswith(_SIDES[0])]
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
        for a in self.levers:
            for b in self.levers:
                if self._index(a) < self._index(b) and b != _mirrored(a):
                    kind = FaultKind.NEIGHBOURS if self._near(a, b) else FaultKind.SWAPPED
                    yield kind, f"the sensors of {a} and {b}", [(a, b)]

    def _elsewhere(self) -> Iterator[Fault]:
        carriers = {joint for joint, _ in self.skeleton.sensors.values()}
        for a in self.levers:
            for b in sorted(carriers - set(self.levers)):
                if self._near(a, b) or b == _mirrored(a):
                    yield Fault(
                        FaultKind.SEGMENT,
                        f"the sensor declared on {a} sits on {b}",
                        f"Declare it on {b}, or move it to {a}, and calibrate again",
                        (self._moved(a, b),),
                    )

    # --- parts -----------------------------------------------------------------------------------

    def _turned(self, joint: str, R_bone_new: Array) -> Change:
        return Change(joint, joint, R_bone_new, self.levers[joint])

    def _moved(self, declared: str, joint: str) -> Change:
        """A sensor read on another segment: in the pose it was aligned as if on the declared one."""
        R_declared, R_joint = self.R_pose[self._index(declared)], self.R_pose[self._index(joint)]
        lever = self.levers.get(joint)
        lever = usual_lever(joint, self.skeleton) if lever is None else lever
        return Change(declared, joint, R_declared.T @ R_joint, lever)

    def _exchanged(self, pairs: Sequence[tuple[str, str]]) -> tuple[Change, ...]:
        return tuple(self._moved(*way) for a, b in pairs for way in ((a, b), (b, a)))

    def _refiled(self, declared: str, joint: str) -> Change:
        """Samples of the sensor on `declared` read with the calibration of the one on `joint`."""
        calibration = self.calibration
        assert calibration is not None
        a, b = (calibration.joints.index(name) for name in (declared, joint))
        R, W = calibration.R_sensor_bone, calibration.R_world_inertial
        return Change(declared, joint, R[a].T @ R[b], self.levers[joint], W[b] @ W[a].T)

    def _index(self, joint: str) -> int:
        return self.skeleton.names.index(joint)

    def _near(self, a: str, b: str) -> bool:
        lines = (set(kinematics.line_to_root(self.skeleton.parents, self._index(j))) for j in (a, b))
        return len(set.symmetric_difference(*lines)) <= _NEAR

    def _trunk_of(self, joint: str) -> str:
        """The nearest segment towards the root that has no side."""
        line = kinematics.line_to_root(self.skeleton.parents, self._index(joint))
        return next(n for n in (self.skeleton.names[j] for j in line) if not n.startswith(_SIDES))


def _mirrored(joint: str) -> str:
    left, right = _SIDES
    return joint.replace(left, right) if joint.startswith(left) else joint.replace(right, left)


def _way(angle_deg: int) -> str:
    ways = {90: "90 degrees to the left of", -90: "90 degrees to the right of", 180: "180 degrees from"}
    return ways[angle_deg]
