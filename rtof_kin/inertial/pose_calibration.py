"""Calibration by a pose: somebody holds a T, N or seated pose, and from then on the sensors are aligned.

In the pose the orientation of every segment is known, so

    R_sensor_bone = (R_world_inertial R_inertial_sensor)^T R_world_bone.

**What a pose tells and what not.** It gives R_sensor_bone once R_world_inertial is known, and nothing
about R_world_inertial: any heading fits the pose equally well, and what differs is how later movement is
read (`rtof_kin.inertial.headings`). Inclination needs no assumption, gravity gives it. So one angle must
come from elsewhere if the sensors share one reference (magnetometers, or sensors aligned with each other
before they were put on): the direction the person faces in that reference. If each sensor has a heading
of its own (no magnetometer), one angle a sensor must. Both can be told by the movement after the pose,
where there is enough of it: bending and stretching of what carries the sensors. In a T-pose the elbows'
axes are vertical and tell nothing of headings; prefer an N-pose or a seated one where they must be found.

An error of the pose (an arm 10 degrees too low) becomes an error of the calibration, of the same size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import CalibrationError, ShapeError, UnknownNameError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.inertial.alignment import Held, PoseCalibration, calibrated, hold
from rtof_kin.inertial.headings import Headings, own_headings, shared_heading, wrapped
from rtof_kin.inertial.likelihood import MotionLikelihood
from rtof_kin.inertial.poses import facing_of, pose_rotations, turned_to
from rtof_kin.inertial.segment_motion import segment_motions

Array = NDArray[np.float64]
NAMED_POSE_DEG, MEASURED_POSE_DEG = 10.0, 3.0
"""How far segments of people who hold a named pose are from it, and from a measured one."""
LEAST_TURNING = 0.5
"""Movement slower than this, rad/s, tells no heading."""
LONGEST = 40.0
"""So many seconds from the pose on are looked at."""
_AXES = {"x": (0, 1.0), "y": (1, 1.0), "z": (2, 1.0), "-x": (0, -1.0), "-y": (1, -1.0), "-z": (2, -1.0)}


def calibrate_by_pose(
    imus: ImuSequence | SensorLog,
    joints: Mapping[str, str],
    pose: str | ArrayLike,
    skeleton: SkeletonModel,
    *,
    facing: float | tuple[str, str] | None = None,
    world_facing: float | None = None,
    still: tuple[float, float] | None = None,
    headings: Literal["shared", "own"] = "shared",
    levers: Mapping[str, ArrayLike] | None = None,
) -> PoseCalibration:
    """How each sensor sits on its segment, from a pose that was held for a second or more.

    Args:
        imus: with orientation; more sensors than `joints` names are passed over.
        joints: sensor -> segment that carries it, by its proximal joint.
        pose: 'T', 'N', 'seated', or R_world_bone (J, 3, 3) measured while it was held.
        facing: the direction in which the person faces in the sensors' shared reference: an angle, rad
            about z from x; or a sensor and the axis of it that points forward, e.g. ('Pelvis', '-z');
            None: told by the movement in `imus`. It cannot be given of sensors with own headings.
        world_facing: heading of the person in the world that results, rad. By default with shared
            headings the world is the sensors' reference; with own headings, or a measured pose, it is
            the pose's (named ones face x).
        still: (start, stop) s when the pose was held; None: the first second that all sensors are still.
        headings: 'shared': one reference for all sensors. 'own': each has its own, told by the movement.
        levers: sensor -> position of the sensor in the segment's frame (3,), m; by default the usual
            place on that segment, or the middle of the segment where there is none.

    Raises:
        UnknownNameError: a sensor, segment, pose or axis is not known.
        CalibrationError: nobody is still, a sensor has no orientation then, two sensors sit on one
            segment, or headings cannot be told because nobody moves.
    """
    if headings not in ("shared", "own"):
        raise UnknownNameError("kind of headings", [headings], ["shared", "own"])
    if headings == "own" and facing is not None:
        raise CalibrationError(
            "facing has no meaning for sensors with headings of their own: they share no reference; give "
            "world_facing, or headings='shared'"
        )
    held = hold(imus, joints, skeleton, still, levers)
    R_all = pose_rotations(pose, skeleton)
    faces = facing_of(R_all) if world_facing is None else world_facing
    R_pose = turned_to(R_all, faces)[skeleton.index(*held.joints)]
    if facing is None:
        found = _told_by_movement(imus, held, R_pose, skeleton, headings)
    else:
        given = np.full(len(held.joints), faces - _forward(facing, held))
        found = Headings(given, np.zeros(len(given)), np.inf)
    angles, named = found.angles, isinstance(pose, str)
    if headings == "shared" and world_facing is None and named:
        # The world is the sensors' own reference: not they are turned but the person.
        faces, angles, R_pose = faces - angles[0], 0 * angles, so3.about_axis("z", -angles[0]) @ R_pose
    return PoseCalibration(
        calibration=held.aligned(angles, R_pose),
        pose=str(pose) if named else "measured",
        still=held.still,
        facing=float(wrapped(faces)),
        sensors=held.reports(np.degrees(found.sigmas), NAMED_POSE_DEG if named else MEASURED_POSE_DEG),
        heading_margin=found.margin if facing is None else None,
    )


# --- parts ---------------------------------------------------------------------------------------


def _forward(facing: float | tuple[str, str], held: Held) -> float:
    """Heading, rad, of the person in the sensors' shared reference."""
    if not isinstance(facing, tuple):
        if not np.isfinite(facing):
            raise ShapeError(f"facing: {facing} is no angle; give radians about z from the x axis")
        return float(facing)
    sensor, axis = facing
    s = indices_of("sensor of facing", [sensor], [stream.name for stream in held.streams])[0]
    if axis not in _AXES:
        raise UnknownNameError("axis of facing", [axis], list(_AXES))
    column, sign = _AXES[axis]
    forward = sign * held.R_inertial_sensor[s][:, column]
    if np.hypot(forward[0], forward[1]) < np.sin(np.radians(20.0)):
        raise CalibrationError(
            f"the axis {axis} of {sensor} is within 20 degrees of vertical in the pose, so it does not "
            "point forward; name another axis"
        )
    return float(np.arctan2(forward[1], forward[0]))


def _told_by_movement(
    imus: ImuSequence | SensorLog, held: Held, R_pose: Array, skeleton: SkeletonModel, headings: str
) -> Headings:
    as_if_upright = held.aligned(np.zeros(len(held.joints)), R_pose)
    bone_imus = calibrated(imus, as_if_upright)
    first = max(bone_imus.times[0], min(held.still[0], bone_imus.times[-1] - LONGEST))
    near = (bone_imus.times >= first) & (bone_imus.times <= first + LONGEST)
    start, stop = (int(i) for i in np.flatnonzero(near)[[0, -1]])
    motions = segment_motions(bone_imus[start : stop + 1])
    fastest = max(float(np.nanmax(np.linalg.norm(m.w_world, axis=-1))) for m in motions)
    if fastest < LEAST_TURNING:
        raise CalibrationError(
            f"headings cannot be told: no sensor turns faster than {fastest:.2g} rad/s, and a pose alone "
            "does not tell them; record some bending and stretching after it"
            + (", or give facing" if headings == "shared" else "")
        )
    search = own_headings if headings == "own" else shared_heading
    return search(MotionLikelihood(skeleton), motions, R_pose)
