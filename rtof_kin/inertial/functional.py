"""Calibration by movement: with a knee bent or an arm raised, no pose is trusted about the vertical.

Gravity, while somebody stands, gives a segment's inclination. The axis about which a segment then turns
gives the rest (`rtof_kin.inertial.axes`): of a hinge between two sensors, of one segment alone. Both work
whatever headings the sensors' references have. Which way round an axis points is told by anatomy: a knee
only flexes, and meanwhile the thigh goes forwards rather than back; an arm is raised forwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.metrics import hinges
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import CalibrationError, ShapeError, UnknownNameError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial.alignment import Held, PoseCalibration, hold
from rtof_kin.inertial.axes import LEAST_RATE, hinge_axis, principal_axis, rms_rate
from rtof_kin.inertial.poses import flexion_axis, pose_rotations, turned_to
from rtof_kin.inertial.stillness import angular_velocity

Array = NDArray[np.float64]
POSE_DEG, AXIS_DEG = 5.0, 5.0
"""What error of inclination while standing, and of an axis of movement, is to be expected."""
LEAST_SHARE = 0.6
"""Share of the turning that must be about one axis."""
_PLANAR = 1.0
_UPRIGHT_SHARE = np.sin(np.radians(30.0))


@dataclass(frozen=True)
class Movement:
    """A joint that was bent and stretched, several times, away from the pose and back."""

    joint: str
    """The joint, by the segment that it moves: 'LeftLeg' is the left knee, 'LeftUpLeg' the left hip."""
    start: float
    """s"""
    stop: float
    """s"""

    def __post_init__(self) -> None:
        if not self.stop - self.start >= 0.5:
            raise ShapeError(
                f"movement of {self.joint}: from {self.start:g} to {self.stop:g} s is too short; half a "
                "second at least, better five"
            )


def calibrate_by_movement(
    imus: ImuSequence | SensorLog,
    joints: Mapping[str, str],
    movements: Sequence[Movement],
    skeleton: SkeletonModel,
    *,
    pose: str = "N",
    world_facing: float = 0.0,
    still: tuple[float, float] | None = None,
    headings: Literal["shared", "own"] = "shared",
    levers: Mapping[str, ArrayLike] | None = None,
) -> PoseCalibration:
    """How each sensor sits on its segment, from a moment of standing and movements about known axes.

    The pose gives inclinations only; where the segment points about the vertical comes from the axis of
    its movement, which the anatomy names: knees and elbows bend about their hinges where both sensors
    beside them are there; any other segment is flexed, or raised forwards and back, alone.

    Args:
        imus, joints, still, levers: as for `calibrate_by_pose`.
        movements: of knees and elbows, which serve both sensors beside them, and of other segments.
        pose: named pose of the moment of standing, arms and legs stretched.
        world_facing: heading of the person in world while standing, rad.
        headings: 'shared': one reference for all sensors, turned so that segments face ahead in the mean;
            sensors of which no movement is named then are aligned by the pose. 'own': each segment is
            taken to face straight ahead while standing.

    Raises:
        CalibrationError: a movement is about no one axis, too small, or its axis upright; or of a sensor
            with a heading of its own no movement is named.
    """
    if headings not in ("shared", "own"):
        raise UnknownNameError("kind of headings", [headings], ["shared", "own"])
    held = hold(imus, joints, skeleton, still, levers)
    R_all = turned_to(pose_rotations(pose, skeleton), world_facing)
    standing = _Standing(skeleton, held, R_all)
    known: dict[str, float] = {}
    for movement in movements:
        known |= standing.headings(movement)
    missing = [joint for joint in held.joints if joint not in known]
    if missing and (headings == "own" or not known):
        raise CalibrationError(
            f"no movement tells the heading of the sensors on {', '.join(missing)}; name one of each, or "
            "say that all sensors share one reference (headings='shared')"
        )
    mean = float(np.angle(np.sum(np.exp(1j * np.array(list(known.values()))))))
    angles = np.array([known.get(joint, mean) for joint in held.joints])
    calibration = held.aligned(angles, R_all[skeleton.index(*held.joints)])
    if headings == "shared":
        R_shared = np.tile(so3.about_axis("z", mean), (len(angles), 1, 1))
        calibration = replace(calibration, R_world_inertial=R_shared)
    sigmas_deg = [AXIS_DEG if joint in known else 2 * AXIS_DEG for joint in held.joints]
    return PoseCalibration(
        calibration=calibration,
        pose=f"{pose} and movement",
        still=held.still,
        facing=world_facing,
        sensors=held.reports(sigmas_deg, POSE_DEG),
    )


# --- parts ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Standing:
    """Sensors while somebody stands, and the pose that is stood in."""

    skeleton: SkeletonModel
    held: Held
    R_pose: Array
    """(J, 3, 3) R_world_bone"""

    def headings(self, movement: Movement) -> dict[str, float]:
        """Headings, rad, of the references of the sensors that a movement is about."""
        j = self.skeleton.index(movement.joint)[0]
        parent = self.skeleton.names[self.skeleton.parents[j]] if j else ""
        if movement.joint not in self.held.joints:
            raise CalibrationError(f"movement of {movement.joint}: no sensor is mapped to that segment")
        if j in hinges(self.skeleton) and parent in self.held.joints:
            return self._of_hinge(movement, parent)
        return self._of_one(movement)

    def _of_hinge(self, movement: Movement, parent: str) -> dict[str, float]:
        child = movement.joint
        times, w_parent = self._turning(movement, parent)
        own_times, w_own = self._turning(movement, child)
        w_child = signals.interpolate(own_times, w_own, times, max_gap=0.1)
        axis = hinge_axis(w_parent, w_child, _PLANAR)
        signs = list(product((1.0, -1.0), repeat=2))
        costs = [self._unlikely(movement, parent, s * axis.axis_1, t * axis.axis_2) for s, t in signs]
        s, t = signs[int(np.argmin(costs))]
        return {
            parent: self._heading(parent, child, s * axis.axis_1),
            child: self._heading(child, child, t * axis.axis_2),
        }

    def _of_one(self, movement: Movement) -> dict[str, float]:
        joint = movement.joint
        w = self._turning(movement, joint)[1]
        if rms_rate(w) < LEAST_RATE:
            raise CalibrationError(
                f"movement of {joint}: it turns by {rms_rate(w):.2g} rad/s only; move it more"
            )
        axis, share = principal_axis(w)
        if share < LEAST_SHARE:
            raise CalibrationError(
                f"movement of {joint}: only {100 * share:.0f} % of its turning is about one axis; flex "
                "it, or raise it forwards and back, and nothing else"
            )
        stream = self._stream(joint)
        assert stream.R_inertial_sensor is not None
        R = stream.R_inertial_sensor[(stream.times >= movement.start) & (stream.times <= movement.stop)]
        R = R[np.isfinite(R).all(axis=(-2, -1))]
        away = so3.log(self._R_held(joint).T @ R) @ axis  # rad from the pose, about the axis
        return {joint: self._heading(joint, joint, axis if away.sum() >= 0 else -axis)}

    def _stream(self, joint: str) -> SensorStream:
        return self.held.streams[self.held.joints.index(joint)]

    def _R_held(self, joint: str) -> Array:
        return np.asarray(self.held.R_inertial_sensor[self.held.joints.index(joint)])

    def _turning(self, movement: Movement, joint: str) -> tuple[Array, Array]:
        """Times (T,) and angular velocity (T, 3) during a movement."""
        stream = self._stream(joint)
        during = (stream.times >= movement.start) & (stream.times <= movement.stop)
        if np.count_nonzero(during) < 10:
            raise CalibrationError(
                f"movement of {joint}: its sensor has fewer than ten samples between {movement.start:g} "
                f"and {movement.stop:g} s"
            )
        return stream.times[during], angular_velocity(stream)[during]

    def _heading(self, joint: str, moved: str, axis_sensor: Array) -> float:
        """Heading of a sensor's reference under which an axis of it is that of the movement."""
        axis_inertial = self._R_held(joint) @ axis_sensor
        axis_world = flexion_axis(moved, self.skeleton, self.R_pose)
        if np.linalg.norm(axis_inertial[:2]) < _UPRIGHT_SHARE:
            raise CalibrationError(
                f"movement of {moved}: the axis found is nearly vertical at {joint} while standing, so "
                "it tells no heading; check that the right joint was moved"
            )
        angles = (np.arctan2(axis[1], axis[0]) for axis in (axis_world, axis_inertial))
        return float(np.subtract(*angles))

    def _unlikely(self, movement: Movement, parent: str, axis_1: Array, axis_2: Array) -> float:
        """How little, rad^2, two sensors with signs chosen look like a hinge that only flexes, on a
        segment that is only raised forwards.
        """
        child = movement.joint
        times, R_parent = self._read(movement, parent, axis_1)
        child_times, R_child = self._read(movement, child, axis_2)
        R_child = signals.interpolate_rotations(child_times, R_child[:, None], times, 0.1)[:, 0]
        R_pose = [self.R_pose[self.skeleton.index(joint)[0]] for joint in (parent, child)]
        cost = 0.0
        for R, joint, R_rest in (
            (np.swapaxes(R_parent, -1, -2) @ R_child, child, R_pose[1]),
            (R_pose[0].T @ R_parent, parent, R_pose[0]),
        ):
            turned = so3.log(R[np.isfinite(R).all(axis=(-2, -1))])
            flexion = turned @ (R_rest.T @ flexion_axis(joint, self.skeleton, self.R_pose))
            across = np.sum(turned**2, axis=-1) - flexion**2 if joint == child else 0.0
            cost += float(np.mean(across + np.minimum(flexion, 0.0) ** 2))
        return cost

    def _read(self, movement: Movement, joint: str, axis: Array) -> tuple[Array, Array]:
        """Times (T,) and R_world_bone (T, 3, 3) during a movement if this is the axis in sensor axes."""
        stream = self._stream(joint)
        assert stream.R_inertial_sensor is not None
        during = (stream.times >= movement.start) & (stream.times <= movement.stop)
        turn = so3.about_axis("z", self._heading(joint, movement.joint, axis))
        R_pose = self.R_pose[self.skeleton.index(joint)[0]]
        R_from_held = stream.R_inertial_sensor[during] @ self._R_held(joint).T
        return stream.times[during], turn @ R_from_held @ turn.T @ R_pose
