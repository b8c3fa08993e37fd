"""What every way to calibrate sensors shares: from held orientations to a calibration and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin import rotations as so3
from rtof_kin.calibration import ImuCalibration
from rtof_kin.checks import indices_of, readonly
from rtof_kin.errors import CalibrationError
from rtof_kin.inertial.stillness import streams_of
from rtof_kin.inertial.streams import SensorLog, SensorStream
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, ImuSequence

Array = NDArray[np.float64]
RATE_HZ = 60.0
"""Rate that sensors with times of their own are brought to."""
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


def reports(
    calibration: ImuCalibration, spreads_deg: ArrayLike, sigmas_deg: ArrayLike, pose_deg: float
) -> tuple[SensorReport, ...]:
    """A report for each sensor.

    Args:
        spreads_deg: (S,) while the pose was held. sigmas_deg: (S,) of the headings.
        pose_deg: how far people are from the pose.
    """
    spreads, sigmas = np.asarray(spreads_deg, dtype=float), np.asarray(sigmas_deg, dtype=float)
    expected = np.sqrt(spreads**2 + sigmas**2 + pose_deg**2)
    rows = zip(spreads.tolist(), sigmas.tolist(), expected.tolist(), strict=True)
    names = zip(calibration.sensors, calibration.joints, strict=True)
    return tuple(SensorReport(*name, *row) for name, row in zip(names, rows, strict=True))


def aligned(
    streams: Sequence[SensorStream],
    joints: Sequence[str],
    angles: Array,
    R_held: Array,
    R_pose: Array,
    levers: Array,
) -> ImuCalibration:
    """The calibration under which sensors held as R_held (S, 3, 3), in references with headings `angles`
    (S,), give segments orientated as R_pose (S, 3, 3)."""
    R_world_inertial = so3.about_axis("z", angles)
    R_sensor_bone = np.swapaxes(R_world_inertial @ R_held, -1, -2) @ R_pose
    names = tuple(stream.name for stream in streams)
    return ImuCalibration(names, tuple(joints), R_world_inertial, R_sensor_bone, levers)


def chosen_streams(
    imus: ImuSequence | SensorLog, joints: Mapping[str, str], skeleton: SkeletonModel
) -> tuple[SensorStream, ...]:
    """The streams of the sensors that are mapped to segments, in that order.

    Raises:
        UnknownNameError: a sensor or segment is not known. CalibrationError: there are none, or two are
            on one segment.
    """
    if not joints:
        raise CalibrationError("no sensor is mapped to a segment; give joints={sensor: segment, ...}")
    skeleton.index(*joints.values())
    double = sorted({joint for joint in joints.values() if list(joints.values()).count(joint) > 1})
    if double:
        raise CalibrationError(f"several sensors are mapped to {', '.join(double)}; a segment takes one")
    streams = streams_of(imus)
    index = indices_of("sensor", list(joints), [stream.name for stream in streams])
    return tuple(streams[i] for i in index)


def lever_arms(
    streams: Sequence[SensorStream],
    joints: Sequence[str],
    given: Mapping[str, ArrayLike],
    skeleton: SkeletonModel,
) -> Array:
    """Positions (S, 3) of sensors in their segments' frames, m: given, or usual, or mid-segment.

    Raises:
        UnknownNameError: one is given of a sensor that is not there.
    """
    names = [stream.name for stream in streams]
    indices_of("sensor", list(given), names)
    return np.array([
        readonly(f"lever arm of {name}", given[name], (3,)) if name in given
        else usual_lever(joint, skeleton)
        for name, joint in zip(names, joints, strict=True)
    ])  # fmt: skip


def usual_lever(joint: str, skeleton: SkeletonModel) -> Array:
    """Where on a segment a sensor usually sits (3,), m: by the skeleton's table, or else its middle."""
    usual = {carrier: lever for carrier, lever in skeleton.sensors.values()}
    return usual.get(joint, skeleton.table.joints[skeleton.index(joint)[0]].end / 2)


def calibrated(streams: Sequence[SensorStream], calibration: ImuCalibration) -> BoneImuSequence:
    """All streams under a calibration, at `RATE_HZ` over the time that they have in common; acceleration
    is NaN of those that have none."""
    start, stop = max(s.times[0] for s in streams), min(s.times[-1] for s in streams)
    parts = []
    for stream in streams:
        f = np.full((len(stream), 3), np.nan) if stream.f_sensor is None else stream.f_sensor
        assert stream.R_inertial_sensor is not None
        imu = ImuSequence(stream.times, stream.R_inertial_sensor[:, None], f[:, None], (stream.name,))
        parts.append(calibration.apply(imu))
    return BoneImuSequence.joined(parts, np.arange(start, stop + 1e-9, 1 / RATE_HZ))
