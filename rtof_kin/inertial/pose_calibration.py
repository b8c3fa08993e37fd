"""Calibration of sensors by a pose (T, N, seated or measured) that is kept for a second or more.

In the pose the orientation of every segment is known, so

    R_sensor_bone = (R_world_inertial R_inertial_sensor)^T R_world_bone

for a known R_world_inertial. Its inclination is given by gravity, but any heading fits the pose equally well.
Sensors with one reference leave one angle unobserved, the facing of the person in that reference; sensors
with headings of their own leave one angle each. These are given, or estimated from the movement after the
pose (`rtof_kin.inertial.likelihood`). In a T-pose the elbows' axes are vertical and do not determine headings:
prefer an N-pose or a seated one. An error of the pose becomes an error of the calibration, of the same size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import uniform_filter1d

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_rotations, indices_of, readonly
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.data.imu import BoneImuSequence, ImuCalibration, ImuSequence
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial.likelihood import (
    RATE_HZ,
    Headings,
    MotionLikelihood,
    orientation_rate,
    own_headings,
    segment_motions,
    shared_heading,
    wrapped,
)

POSES: Final[Mapping[str, str]] = {
    "T": "standing upright, feet and palms as in the skeleton's table: arms sideways, palms down",
    "N": "standing upright, arms hanging, palms towards the thighs",
    "seated": "sitting upright, hips and knees at right angles, feet flat, arms hanging",
}
_RIGHT_ANGLES = ("hip flexion", "knee flexion")  # of the seated pose


def pose_rotations(pose: str | ArrayLike, skeleton: SkeletonModel) -> Array:
    """Return R_world_bone (J, 3, 3) of a calibration pose: one of `POSES`, or measured orientations (J, 3, 3), e.g.
    ``poses.R_world_bone[frame]``. `UnknownNameError`: unknown pose; `InvalidInputError`: not (J, 3, 3), or not
    rotations.
    """
    if not isinstance(pose, str):
        R = readonly("calibration pose", pose, (len(skeleton.names), 3, 3))
        if np.isnan(R).any():
            bad = skeleton.names[int(np.argwhere(np.isnan(R))[0][0])]
            raise InvalidInputError(f"calibration pose: {bad} is missing; give a complete frame")
        checked_rotations("calibration pose", R)
        return np.asarray(R)
    if pose not in POSES:
        raise UnknownNameError("calibration pose", [pose], list(POSES))
    q = skeleton.t_pose() if pose == "T" else skeleton.n_pose()
    for joint in skeleton.table.joints if pose == "seated" else ():
        for dof in joint.dofs:
            if dof.clinical.endswith(_RIGHT_ANGLES):
                sign = -1.0 if dof.clinical.startswith("-") else 1.0
                q[7 + skeleton.dof_names.index(dof.urdf)] = sign * np.pi / 2
    return np.asarray(skeleton.forward_kinematics(q[None])[1][0])


def facing_of(R_world_bone: Array) -> float:
    """Return the heading of the root's forward axis in R_world_bone (J, 3, 3) of a pose, rad about z from x;
    `InvalidInputError` where it is vertical.
    """
    forward = R_world_bone[0, :, 0]
    if np.hypot(forward[0], forward[1]) < np.sin(np.radians(10.0)):
        raise InvalidInputError("calibration pose: the root's forward axis is vertical")
    return float(np.arctan2(forward[1], forward[0]))


def turned_to(R_world_bone: Array, facing: float) -> Array:
    """Return a pose (J, 3, 3) with another heading, rad about z from x."""
    turn = so3.about_axis("z", facing - facing_of(R_world_bone))
    return np.asarray(turn @ R_world_bone)


_LEAST_MARGIN = 3.0  # [nats] of headings from movement over those more than 45 degrees away
_RESTLESS_DEG = 5.0  # RMS angle during the pose that is warned of
_NAMED_POSE_DEG, _MEASURED_POSE_DEG = 10.0, 3.0  # usual error of a segment in a named and a measured pose
_LEAST_TURNING = 0.5  # [rad/s] of movement that determines headings
_LONGEST = 40.0  # [s] of movement from the pose on
_STILL_RATE = 0.2  # [rad/s] of a sensor on a person who stands still
_STILL_SECONDS = 1.0  # [s]
_GRID_HZ, _LONGEST_STEP = 50.0, 0.2  # [Hz], [s]
_UNKNOWN_RATE = 100.0  # [rad/s] assumed in gaps
_AXES = ("x", "y", "z", "-x", "-y", "-z")


@dataclass(frozen=True)
class SensorReport:
    """Quality of one sensor's calibration."""

    sensor: str
    joint: str  #: Segment of the sensor
    spread_deg: float  #: RMS angle of its orientation to the mean during the pose
    heading_sigma_deg: float  #: Standard deviation of its heading; 0 if given
    expected_deg: float  #: Expected error of the calibration, from pose, spread and heading


@dataclass(frozen=True)
class PoseCalibration:
    """A calibration and its report."""

    calibration: ImuCalibration
    pose: str  #: Name of the pose
    still: tuple[float, float]  #: (start, stop) s of the pose
    facing: float  #: Heading of the person in world during the pose, rad about z from x
    sensors: tuple[SensorReport, ...]
    heading_margin: float | None = None
    """Log-likelihood ratio, nats, of headings from movement to those more than 45 degrees away."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Quality warnings."""
        out = [
            f"{report.sensor} turned by {report.spread_deg:.1f} degrees while the pose was held; hold it "
            "still, or choose another moment with still=(start, stop)"
            for report in self.sensors
            if report.spread_deg > _RESTLESS_DEG
        ]
        if self.heading_margin is not None and self.heading_margin < _LEAST_MARGIN:
            out.append(
                f"the movement hardly determines the headings ({self.heading_margin:.1f} nats): a quarter or "
                "half turn is possible; record more bending of knees, elbows and trunk, or give facing"
            )
        return tuple(out)


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
) -> PoseCalibration:
    """Calibrate sensors by a pose. `UnknownNameError`: unknown sensor, segment, pose or axis; `CalibrationError`: the
    sensors never rest, one has no orientation then, two sensors are on one segment, or the movement is too small for
    headings.

    Args:
        imus: with orientation; sensors that `joints` does not name are ignored.
        joints: sensor -> segment that carries it, by its proximal joint.
        pose: 'T', 'N', 'seated', or R_world_bone (J, 3, 3) measured during the pose.
        facing: direction of the person in the sensors' shared reference: an angle, rad about z from x, or a sensor
            and its axis that points forward, e.g. ('Pelvis', '-z'); None: from the movement.
        world_facing: heading of the person in the resulting world, rad. By default the world is the shared reference;
            with own headings or a measured pose it is the pose's (named ones face x).
        still: (start, stop) s of the pose; the first second without rotation if None.
        headings: 'shared': one reference for all sensors. 'own': one each, estimated from the movement.
    """
    if headings not in ("shared", "own"):
        raise UnknownNameError("kind of headings", [headings], ["shared", "own"])
    if headings == "own" and facing is not None:
        raise CalibrationError("facing needs headings='shared'; give world_facing for headings='own'")
    samples = _hold(imus, joints, skeleton, still)
    R_all, named = pose_rotations(pose, skeleton), isinstance(pose, str)
    faces = facing_of(R_all) if world_facing is None else world_facing
    R_pose = turned_to(R_all, faces)[skeleton.index(*samples.joints)]
    if facing is None:
        found = _from_movement(imus, samples, R_pose, skeleton, headings)
    else:
        given = np.full(len(samples.joints), faces - _forward(facing, samples))
        found = Headings(given, np.zeros(len(given)), np.inf)
    angles = found.angles
    if headings == "shared" and world_facing is None and named:
        # The world is the sensors' own reference: turn the person instead.
        faces, angles, R_pose = faces - angles[0], 0 * angles, so3.about_axis("z", -angles[0]) @ R_pose
    pose_deg, sigmas_deg = _NAMED_POSE_DEG if named else _MEASURED_POSE_DEG, np.degrees(found.sigmas)
    expected = np.sqrt(samples.spreads_deg**2 + sigmas_deg**2 + pose_deg**2)
    columns = samples.spreads_deg.tolist(), sigmas_deg.tolist(), expected.tolist()
    return PoseCalibration(
        calibration=samples.aligned(angles, R_pose),
        pose=str(pose) if named else "measured",
        still=samples.still,
        facing=float(wrapped(faces)),
        sensors=tuple(map(SensorReport, joints, samples.joints, *columns)),
        heading_margin=found.margin if facing is None else None,
    )


def _forward(facing: float | tuple[str, str], samples: _PoseSamples) -> float:
    """Return the heading, rad, of the person in the sensors' shared reference."""
    if not isinstance(facing, tuple):
        if not np.isfinite(facing):
            raise InvalidInputError(f"facing: {facing} is no angle; give radians about z from the x axis")
        return float(facing)
    sensor, axis = facing
    (s,) = indices_of("sensor of facing", [sensor], [stream.name for stream in samples.streams])
    if axis not in _AXES:
        raise UnknownNameError("axis of facing", [axis], list(_AXES))
    forward = samples.R_inertial_sensor[s][:, "xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)
    if np.hypot(forward[0], forward[1]) < np.sin(np.radians(20.0)):
        problem = "is within 20 degrees of vertical in the pose; name another axis"
        raise CalibrationError(f"the axis {axis} of {sensor} {problem}")
    return float(np.arctan2(forward[1], forward[0]))


def _from_movement(
    imus: ImuSequence | SensorLog, samples: _PoseSamples, R_pose: Array, skeleton: SkeletonModel, headings: str
) -> Headings:
    bone_imus = calibrated(imus, samples.aligned(np.zeros(len(samples.joints)), R_pose))
    first = max(bone_imus.times[0], min(samples.still[0], bone_imus.times[-1] - _LONGEST))
    near = (bone_imus.times >= first) & (bone_imus.times <= first + _LONGEST)
    start, stop = (int(i) for i in np.flatnonzero(near)[[0, -1]])
    motions = segment_motions(bone_imus[start : stop + 1])
    fastest = max(float(np.nanmax(np.linalg.norm(m.w_world, axis=-1))) for m in motions)
    if fastest < _LEAST_TURNING:
        raise CalibrationError(
            f"headings are not observable: no sensor turns faster than {fastest:.2g} rad/s; record some "
            f"bending and stretching after the pose{', or give facing' if headings == 'shared' else ''}"
        )
    search = own_headings if headings == "own" else shared_heading
    return search(MotionLikelihood(skeleton), motions, R_pose)


def usual_lever(joint: str, skeleton: SkeletonModel) -> Array:
    """Return the usual position (3,) of a sensor on a segment, m: from the skeleton's table, or its middle."""
    usual = {carrier: lever for carrier, lever in skeleton.sensors.values()}
    return usual.get(joint, skeleton.table.joints[skeleton.index(joint)[0]].end / 2)


def calibrated(imus: ImuSequence | SensorLog, calibration: ImuCalibration) -> BoneImuSequence:
    """Apply a calibration to sensors on any times. `UnknownNameError`: a sensor is missing; `CalibrationError`: one has
    no orientation.

    Returns:
        The sensors at `RATE_HZ` over their common time; a_world is NaN without accelerometer.
    """
    streams = _selected(imus, calibration.sensors)
    parts = []
    for stream in streams:
        f = np.full((len(stream), 3), np.nan) if stream.f_sensor is None else stream.f_sensor
        imu = ImuSequence(stream.times, _orientations(stream)[:, None], f[:, None], (stream.name,))
        parts.append(calibration.apply(imu))
    start, stop = max(s.times[0] for s in streams), min(s.times[-1] for s in streams)
    return BoneImuSequence.joined(parts, np.arange(start, stop + 1e-9, 1 / RATE_HZ))


@dataclass(frozen=True)
class _PoseSamples:
    """S sensors on segments during a pose."""

    streams: tuple[SensorStream, ...]
    joints: tuple[str, ...]  # their segments
    still: tuple[float, float]  # (start, stop) s
    R_inertial_sensor: Array  # (S, 3, 3) mean orientations
    spreads_deg: Array  # (S,) RMS angles to them
    levers: Array  # (S, 3) m, positions of the sensors in the segments' frames

    def aligned(self, headings: Array, R_pose: Array) -> ImuCalibration:
        """Return the calibration for headings (S,), rad, under which R_world_bone is R_pose (S, 3, 3)."""
        R_world_inertial = so3.about_axis("z", headings)
        R_world_sensor = R_world_inertial @ self.R_inertial_sensor
        R_sensor_bone = np.swapaxes(R_world_sensor, -1, -2) @ R_pose
        sensors = tuple(stream.name for stream in self.streams)
        return ImuCalibration(sensors, self.joints, R_world_inertial, R_sensor_bone, self.levers)


def _hold(
    imus: ImuSequence | SensorLog, joints: Mapping[str, str], skeleton: SkeletonModel, still: tuple[float, float] | None
) -> _PoseSamples:
    if not joints:
        raise CalibrationError("no sensor is mapped to a segment; give joints={sensor: segment, ...}")
    segments = tuple(joints.values())
    skeleton.index(*segments)
    double = sorted({joint for joint in segments if segments.count(joint) > 1})
    if double:
        raise CalibrationError(f"several sensors are mapped to {', '.join(double)}; a segment takes one")
    streams = _selected(imus, list(joints))
    still = _find_still(streams) if still is None else still
    R, spreads = zip(*(_mean_orientation(stream, still) for stream in streams), strict=True)
    levers = np.stack([usual_lever(joint, skeleton) for joint in segments])
    return _PoseSamples(streams, segments, still, np.array(R), np.array(spreads), levers)


def _selected(imus: ImuSequence | SensorLog, sensors: Sequence[str]) -> tuple[SensorStream, ...]:
    log = imus if isinstance(imus, SensorLog) else SensorLog.of_imus(imus, "imus")
    return log.select(sensors).streams


def _orientations(stream: SensorStream) -> Array:
    if stream.R_inertial_sensor is None:
        problem = "has no orientation; estimate it first (rtof_kin.inertial.orientation)"
        raise CalibrationError(f"sensor {stream.name} {problem}")
    return stream.R_inertial_sensor


def _mean_orientation(stream: SensorStream, still: tuple[float, float]) -> tuple[Array, float]:
    """Return the mean orientation (3, 3) and the RMS angle to it, degrees."""
    R = _orientations(stream)[(stream.times >= still[0]) & (stream.times <= still[1])]
    R = R[np.isfinite(R).all(axis=(-2, -1))]
    if not len(R):
        raise CalibrationError(
            f"sensor {stream.name} has no orientation between {still[0]:g} and {still[1]:g} s, when the "
            f"pose was held; its samples are from {stream.times[0]:g} to {stream.times[-1]:g} s"
        )
    mean = so3.nearest_rotation(R.mean(axis=0))
    return mean, float(np.degrees(np.sqrt(np.mean(so3.angle_between(R, mean) ** 2))))


def _find_still(streams: Sequence[SensorStream]) -> tuple[float, float]:
    """Return (start, stop), s, of the first second in which the mean rate of the fastest sensor is small."""
    seconds = _STILL_SECONDS
    start, stop = max(s.times[0] for s in streams), min(s.times[-1] for s in streams)
    if stop - start < seconds:
        raise CalibrationError(
            f"the sensors have {max(stop - start, 0):.2g} s in common, too short for a pose held for "
            f"{seconds:g} s; record the pose, with all sensors on one clock"
        )
    times = np.arange(start, stop + 1e-9, 1 / _GRID_HZ)
    rates = np.stack([_rate(stream, times) for stream in streams])
    width = min(round(seconds * _GRID_HZ) + 1, len(times))
    inside = slice(width // 2, len(times) - (width - 1) // 2)
    centres, mean = times[inside], uniform_filter1d(rates.max(axis=0), width)[inside]
    still = signals.runs(mean < _STILL_RATE)
    if not still:
        best = int(np.argmin(mean))
        restless = streams[int(np.argmax(rates[:, inside][:, best]))].name
        raise CalibrationError(
            f"no {seconds:g} s without rotation: even around {centres[best]:.2f} s sensors turn at "
            f"{np.degrees(mean[best]):.0f} deg/s, {restless} most; hold the pose longer, or give its time "
            "with still=(start, stop)"
        )
    first, end = still[0]
    if centres[end - 1] - centres[first] >= seconds:
        return float(centres[first]), float(centres[end - 1])
    stillest = float(centres[first + int(np.argmin(mean[first:end]))])
    return stillest - seconds / 2, stillest + seconds / 2


def _rate(stream: SensorStream, times: Array) -> Array:
    """Return the angular speed, rad/s, of the gyroscope or else of the orientation."""
    w = stream.w_sensor
    if w is None:
        w = orientation_rate(stream.times, _orientations(stream))
    on_grid = signals.interpolate(stream.times, np.linalg.norm(w, axis=-1), times, max_gap=_LONGEST_STEP)
    return np.minimum(np.nan_to_num(on_grid, nan=_UNKNOWN_RATE), _UNKNOWN_RATE)
