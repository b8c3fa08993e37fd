"""What every way to calibrate sensors shares: from held orientations to a calibration and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial.segment_motion import RATE_HZ
from rtof_kin.inertial.stillness import find_still, streams_of

Array = NDArray[np.float64]
LEAST_MARGIN = 3.0
"""Nats by which headings from movement must beat those further than 45 degrees away."""
_RESTLESS_DEG = 5.0


@dataclass(frozen=True)
class SensorReport:
    """How well one sensor was calibrated."""

    sensor: str
    joint: str
    """The segment that carries it."""
    spread_deg: float
    """Root mean square angle of its orientation to the mean while the pose was held."""
    heading_sigma_deg: float
    """Standard deviation of its heading, where movement told it; 0 where it was given."""
    expected_deg: float
    """What error to expect of the calibration: of the pose, of the spread, of the heading."""


@dataclass(frozen=True)
class PoseCalibration:
    """A calibration, and what there is to say about it."""

    calibration: ImuCalibration
    pose: str
    """Name of the pose or movement."""
    still: tuple[float, float]
    """(start, stop) s, when the pose was held."""
    facing: float
    """Heading of the person in world during the pose, rad about z from x."""
    sensors: tuple[SensorReport, ...]
    heading_margin: float | None = None
    """Nats by which movement told the headings from those further than 45 degrees away; None where they
    were given."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about what to distrust."""
        out = [
            f"{report.sensor} turned by {report.spread_deg:.1f} degrees while the pose was held; hold it "
            "still, or choose another moment with still=(start, stop)"
            for report in self.sensors
            if report.spread_deg > _RESTLESS_DEG
        ]
        if self.heading_margin is not None and self.heading_margin < LEAST_MARGIN:
            out.append(
                f"the movement hardly tells the headings ({self.heading_margin:.1f} nats): a quarter or "
                "half turn is possible; record more bending of knees, elbows and trunk, or give facing"
            )
        return tuple(out)


@dataclass(frozen=True)
class Held:
    """S sensors on segments of somebody who holds still."""

    streams: tuple[SensorStream, ...]
    joints: tuple[str, ...]
    """The segments that carry them."""
    still: tuple[float, float]
    """(start, stop) s"""
    R_inertial_sensor: Array
    """(S, 3, 3) mean orientations then"""
    spreads_deg: Array
    """(S,) root mean square angles to them"""
    levers: Array
    """(S, 3) places of the sensors in their segments' frames, m"""

    def aligned(self, headings: Array, R_pose: Array) -> ImuCalibration:
        """The calibration under which references with headings (S,), rad, give segments orientated as
        R_pose (S, 3, 3) while the pose is held.
        """
        R_world_inertial = so3.about_axis("z", headings)
        R_world_sensor = R_world_inertial @ self.R_inertial_sensor
        return ImuCalibration(
            sensors=tuple(stream.name for stream in self.streams),
            joints=self.joints,
            R_world_inertial=R_world_inertial,
            R_sensor_bone=np.swapaxes(R_world_sensor, -1, -2) @ R_pose,
            p_bone_sensor=self.levers,
        )

    def reports(self, heading_sigmas_deg: ArrayLike, pose_deg: float) -> tuple[SensorReport, ...]:
        """One for each sensor, by the spread (S,) of its heading and what people miss the pose by."""
        sigmas = np.asarray(heading_sigmas_deg, dtype=float)
        expected = np.sqrt(self.spreads_deg**2 + sigmas**2 + pose_deg**2)
        rows = np.stack([self.spreads_deg, sigmas, expected], axis=-1).tolist()
        return tuple(
            SensorReport(stream.name, joint, *row)
            for stream, joint, row in zip(self.streams, self.joints, rows, strict=True)
        )


def hold(
    imus: ImuSequence | SensorLog,
    joints: Mapping[str, str],
    skeleton: SkeletonModel,
    still: tuple[float, float] | None = None,
    levers: Mapping[str, ArrayLike] | None = None,
) -> Held:
    """The sensors of a mapping while somebody holds still.

    Args:
        imus: sensors, more than are mapped perhaps. joints: sensor -> segment. skeleton: whose segments.
        still: (start, stop) s; the first second in which all are still where not given.
        levers: sensor -> place in its segment's frame (3,), m; by default the usual one, or mid-segment.

    Raises:
        UnknownNameError: a sensor or segment is not known.
        CalibrationError: there are none, two are on one segment, nobody is still, or a sensor has no
            orientation then.
    """
    if not joints:
        raise CalibrationError("no sensor is mapped to a segment; give joints={sensor: segment, ...}")
    segments = tuple(joints.values())
    skeleton.index(*segments)
    double = sorted({joint for joint in segments if segments.count(joint) > 1})
    if double:
        raise CalibrationError(f"several sensors are mapped to {', '.join(double)}; a segment takes one")
    streams, given = _selected(imus, list(joints)), levers or {}
    indices_of("sensor", list(given), list(joints))
    still = find_still(streams) if still is None else still
    held = [_mean_orientation(stream, still) for stream in streams]
    places = [
        readonly(f"lever arm of {sensor}", given[sensor], (3,)) if sensor in given
        else usual_lever(joint, skeleton)
        for sensor, joint in joints.items()
    ]  # fmt: skip
    R, spreads = (np.array(values) for values in zip(*held, strict=True))
    return Held(streams, segments, still, R, spreads, np.array(places))


def usual_lever(joint: str, skeleton: SkeletonModel) -> Array:
    """Where on a segment a sensor usually sits (3,), m: by the skeleton's table, or else its middle."""
    usual = {carrier: lever for carrier, lever in skeleton.sensors.values()}
    return usual.get(joint, skeleton.table.joints[skeleton.index(joint)[0]].end / 2)


def calibrated(imus: ImuSequence | SensorLog, calibration: ImuCalibration) -> BoneImuSequence:
    """The calibrated sensors, at `RATE_HZ` over the time that they have in common, whatever times each
    has; acceleration is NaN of those that have none.

    Raises:
        UnknownNameError: one is not there. CalibrationError: one has no orientation.
    """
    streams = _selected(imus, calibration.sensors)
    parts = []
    for stream in streams:
        f = np.full((len(stream), 3), np.nan) if stream.f_sensor is None else stream.f_sensor
        R = _orientations(stream)
        imu = ImuSequence(stream.times, R[:, None], f[:, None], (stream.name,))
        parts.append(calibration.apply(imu))
    start, stop = max(s.times[0] for s in streams), min(s.times[-1] for s in streams)
    return BoneImuSequence.joined(parts, np.arange(start, stop + 1e-9, 1 / RATE_HZ))


# --- parts ---------------------------------------------------------------------------------------


def _selected(imus: ImuSequence | SensorLog, sensors: Sequence[str]) -> tuple[SensorStream, ...]:
    streams = streams_of(imus)
    index = indices_of("sensor", sensors, [stream.name for stream in streams])
    return tuple(streams[i] for i in index)


def _orientations(stream: SensorStream) -> Array:
    if stream.R_inertial_sensor is None:
        raise CalibrationError(
            f"sensor {stream.name} has no orientation, which calibration needs; make one of its "
            "gyroscope and accelerometer first (rtof_kin.inertial.orientation)"
        )
    return stream.R_inertial_sensor


def _mean_orientation(stream: SensorStream, still: tuple[float, float]) -> tuple[Array, float]:
    """Mean (3, 3), and root mean square angle to it, degrees."""
    R = _orientations(stream)[(stream.times >= still[0]) & (stream.times <= still[1])]
    R = R[np.isfinite(R).all(axis=(-2, -1))]
    if not len(R):
        raise CalibrationError(
            f"sensor {stream.name} has no orientation between {still[0]:g} and {still[1]:g} s, when the "
            f"pose was held; its samples are from {stream.times[0]:g} to {stream.times[-1]:g} s"
        )
    mean = so3.nearest_rotation(R.mean(axis=0))
    return mean, float(np.degrees(np.sqrt(np.mean(so3.angle_between(R, mean) ** 2))))
