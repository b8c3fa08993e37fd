"""Heading and mounting of sensors from an image, without a calibration pose.

The image gives the orientation of a segment, noisy and biased, the sensor its own, exact but for the
heading h of its reference and its mounting on the segment. They are found from

    R_world_bone(t) = Rz(h) R_inertial_sensor(t) R_sensor_bone,

a hand-eye problem with a rotation about the vertical on one side (Park and Martin 1994 solve it for two free
rotations): for each heading of a grid the mounting is a robust mean, and the heading's likelihood shows
whether the motion determines it. The self-calibration (`rtof_kin.calibration`) then refines all sensors
together, by the keypoints, the joints between the segments and the pose prior.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
import scipy

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration, across
from rtof_kin.calibration.straight_legs import LEGS, NEVER_STILL, straight_legs
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import CalibrationError, RtofError
from rtof_kin.core.jobs import side_by_side
from rtof_kin.data.imu import BoneImuSequence, ImuCalibration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import wrapped
from rtof_kin.inertial.orientation import log_with_orientation
from rtof_kin.inertial.pose_calibration import usual_lever
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.sensor_files import imus_of_log

Refine = Callable[[Recording, None, CalibrationPriors], SelfCalibration]
"""Calibrates a recording, on its own skeleton, from its motion."""
_RATE_HZ: Final = 20.0
_LEAST_SECONDS: Final = 2.0
_LONGEST_GAP: Final = 0.1
_SWING: Final = float(np.radians(10.0))
_TWIST = float(np.radians(30.0))  # [rad] Standard deviations of lifted orientations across the bone and about it
_FREEDOM = 3.0  # Degrees of freedom of Student's t
_GRID: Final = 36
_MEMORY = 0.6  # [s] Correlation time of the differences
_BIAS = float(np.radians(6.0))  # [rad] Error of a heading from lifted orientations that does not average out
_CHANCE = 1e-3  # Largest probability that headings agree by chance, where sensors are taken to share a reference
_SHARED_SIGMA = float(np.radians(6.0))  # [rad] Spread of headings in a shared, magnetic reference
_PRIORS: Final = CalibrationPriors(
    sigma_heading=float(np.radians(20.0)),
    sigma_swing=float(np.radians(10.0)),
    sigma_twist=float(np.radians(20.0)),
    sigma_size=0.02,
    sigma_proportion=0.03,
)
SURE: Final = float(np.radians(4.0))  # [rad] Largest standard deviation of a heading that is not in doubt
_MARGIN = 3.0  # [nats] Least margin of a heading over those more than 45 degrees away


@dataclass(frozen=True)
class SensorAlignment:
    """How well one sensor's heading and mounting are known."""

    sensor: str
    joint: str  # Segment that carries it
    heading: float  # [rad] About z from the sensor's own reference to world
    sigma_heading: float  # [rad]
    sigma_mounting: float  # [rad] About an axis across the bone, with the error of the detector's places
    doubt: str = ""  # What may be wrong and what to do, in a sentence; empty where sure


@dataclass(frozen=True)
class Alignment:
    """Calibration of sensors from an image."""

    calibration: ImuCalibration
    sensors: tuple[SensorAlignment, ...]
    shared_reference: bool  # True if the sensors' headings agree, as those of magnetometers do
    warnings: tuple[str, ...] = ()
    refined: SelfCalibration | None = None  # The self-calibration that refined heading and mounting; None without one

    @property
    def delay(self) -> Quantity | None:
        """Delay of the video that is left, to be added to the clock's offset; None where in doubt."""
        delay = None if self.refined is None else self.refined["delay", "video"]
        return None if delay is None or delay.doubt else delay


@dataclass(frozen=True)
class _Start:
    """Heading and mounting of one sensor from the orientations alone."""

    heading: float
    sigma: float
    margin: float
    R_sensor_bone: Array


def align_sensors(
    poses: PoseSequence,
    keypoints: KeypointSequence,
    log: SensorLog,
    joints: Mapping[str, str],
    skeleton: SkeletonModel,
    refine: Refine | None = None,
) -> Alignment:
    """Estimate heading and mounting of each sensor. `UnknownNameError`: an unknown sensor or segment;
    `CalibrationError`: a sensor and the video have less than two seconds in common; `InvalidInputError`: a sensor has
    neither orientation nor what it is estimated from.

    Args:
        log: sensors on the video's clock, each with a reference of its own.
        joints: sensor -> segment that carries it; other sensors are ignored.
        refine: `calibrate_recording`, which takes about as long as the video; None: orientations alone are used.
    """
    skeleton.check_joints(poses.names)
    segments = tuple(joints.values())
    index = skeleton.index(*segments)
    log = log_with_orientation(_near(log.select(list(joints)), float(poses.times[0]), float(poses.times[-1])))
    shown = np.flatnonzero(poses.valid.any(axis=1) & keypoints.seen.any(axis=1))
    frames = np.asarray(shown[:: max(1, round(poses.rate_hz / _RATE_HZ))])
    data = [
        (*_together(poses, stream, j, frames), so3.unit(skeleton.table.joints[j].end))
        for stream, j in zip(log.streams, index, strict=True)
    ]
    starts = [_start(*own) for own in data]
    if (shared := _shared(starts)) is not None:
        starts = [_Start(shared, _SHARED_SIGMA, np.inf, _mounted(*own, shared)[0]) for own in data]
    calibration = ImuCalibration(
        log.names,
        segments,
        so3.about_axis("z", np.array([start.heading for start in starts])),
        np.stack([start.R_sensor_bone for start in starts]),
        np.stack([usual_lever(joint, skeleton) for joint in segments]),
    )
    refined, warnings = None, tuple[str, ...]()
    if refine is not None:
        priors = _PRIORS if shared is None else replace(_PRIORS, sigma_heading=_SHARED_SIGMA)
        calibration, refined, warnings = _refined(calibration, keypoints, log, skeleton, refine, priors)
        warnings += _never_still(calibration, poses, log)
    sensors = _judged(calibration, starts, refined, skeleton)
    stated = np.degrees([sensor.sigma_mounting for sensor in sensors]).round(1)
    calibration = replace(calibration, mounting_sd_deg=stated)
    for doubt in dict.fromkeys(sensor.doubt for sensor in sensors if sensor.doubt):
        warnings += (f"sensor {', '.join(s.sensor for s in sensors if s.doubt == doubt)}: {doubt}",)
    return Alignment(calibration, sensors, shared is not None, warnings, refined)


def _near(log: SensorLog, start: float, stop: float) -> SensorLog:
    """The samples during the video and a second around it."""
    kept = []
    for stream in log.streams:
        part = stream.between(start - 1.0, stop + 1.0)
        if part is None or part.times[-1] - part.times[0] < _LEAST_SECONDS:
            raise CalibrationError(
                f"sensor {stream.name} and the video have less than {_LEAST_SECONDS:g} s in common; find the "
                "clock first, or leave the sensor out"
            )
        kept.append(part)
    return replace(log, streams=tuple(kept))


def _together(poses: PoseSequence, stream: SensorStream, joint: int, frames: Index) -> tuple[Array, Array]:
    """Orientations (N, 3, 3) of a segment by the image and of its sensor at the same instants."""
    assert stream.R_inertial_sensor is not None
    R = stream.R_inertial_sensor[:, None]
    sensed = signals.interpolate_rotations(stream.times, R, poses.times[frames], _LONGEST_GAP)[:, 0]
    seen = poses.R_world_bone[frames, joint]
    known = np.isfinite(sensed).all(axis=(1, 2)) & np.isfinite(seen).all(axis=(1, 2))
    if known.sum() < _LEAST_SECONDS * _RATE_HZ / 2:
        raise CalibrationError(
            f"sensor {stream.name}: its segment is seen for less than {_LEAST_SECONDS:g} s while it "
            "measures; leave it out, or use a longer video"
        )
    return seen[known], sensed[known]


def _start(seen: Array, sensed: Array, axis: Array) -> _Start:
    """Best heading on a grid, refined together with the mounting."""
    grid = 2 * np.pi / _GRID * np.arange(_GRID)
    fits = [_mounted(seen, sensed, axis, float(h)) for h in grid]
    costs = np.array([cost for _, cost in fits])
    best = int(np.argmin(costs))
    nats = (costs[best] - costs) / (_MEMORY * _RATE_HZ)
    weights = np.exp(nats)
    length = np.abs(np.sum(weights * np.exp(1j * grid))) / weights.sum()
    far = np.abs(wrapped(grid - grid[best])) > np.pi / 4
    M, scale = fits[best][0], _scale(axis)

    def residuals(x: Array) -> Array:
        R = so3.about_axis("z", grid[best] + x[0]) @ sensed @ M @ so3.exp(x[1:])
        return np.asarray((so3.log(np.swapaxes(R, -1, -2) @ seen) @ scale).ravel())

    x = scipy.optimize.least_squares(residuals, np.zeros(4), loss="cauchy", f_scale=1.5).x
    sigma = np.sqrt(max(-2 * np.log(np.clip(length, 0.05, 1.0)), 0.0))
    heading = float(wrapped(grid[best] + x[0]))
    return _Start(heading, float(np.hypot(sigma, _BIAS)), float(-nats[far].max()), M @ so3.exp(x[1:]))


def _scale(axis: Array) -> Array:
    """Matrix (3, 3) that divides rotation vectors in bone axes by their standard deviations."""
    along = np.outer(axis, axis)
    return np.asarray((np.eye(3) - along) / _SWING + along / _TWIST)


def _mounted(seen: Array, sensed: Array, axis: Array, heading: float) -> tuple[Array, float]:
    """Robust mean of R_sensor_bone under a heading, and its cost, nats."""
    R = so3.about_axis("z", heading) @ sensed
    each, scale = np.swapaxes(R, -1, -2) @ seen, _scale(axis)
    weights, M, square = np.ones(len(seen)), np.eye(3), np.zeros(len(seen))
    for _ in range(4):
        M = so3.nearest_rotation(np.einsum("t,tij->ij", weights, each))
        square = ((so3.log(M.T @ each) @ scale) ** 2).sum(axis=-1)
        weights = (_FREEDOM + 1) / (_FREEDOM + square)
    return M, float(((_FREEDOM + 1) / 2 * np.log1p(square / _FREEDOM)).sum())


def _shared(starts: list[_Start]) -> float | None:
    """The common heading of sensors that agree more than by chance; None where they do not.

    n uniform angles lie within a range w with probability n (w / 2 pi)^(n - 1).
    """
    sure = np.array([start.heading for start in starts if start.margin > _MARGIN])
    weights = np.array([1 / start.sigma**2 for start in starts if start.margin > _MARGIN])
    n = len(sure)
    if n < 3:
        return None
    ordered = np.sort(sure % (2 * np.pi))
    spread = 2 * np.pi - np.diff(ordered, append=ordered[0] + 2 * np.pi).max()
    if n * (spread / (2 * np.pi)) ** (n - 1) > _CHANCE:
        return None
    return float(np.angle(np.sum(weights * np.exp(1j * sure))))


def _refined(
    calibration: ImuCalibration,
    keypoints: KeypointSequence,
    log: SensorLog,
    skeleton: SkeletonModel,
    refine: Refine,
    priors: CalibrationPriors,
) -> tuple[ImuCalibration, SelfCalibration | None, tuple[str, ...]]:
    carriers = {joint for joint, _ in skeleton.sensors.values()}
    used = [s for s, joint in enumerate(calibration.joints) if joint in carriers]
    if not used:
        return calibration, None, ("heading and mounting are not refined: no sensor is on a usual segment",)
    names = tuple(calibration.sensors[s] for s in used)
    recording = Recording(
        name="alignment",
        keypoints=keypoints,
        calibration=calibration.select(names),
        imus=imus_of_log(log.select(names)),
        skeleton_table=skeleton.name,
        joint_offsets=skeleton.joint_offsets,
    )
    try:
        (found,) = side_by_side(partial(refine, recording, None), [priors])  # whose memory another process may have
    except RtofError as error:
        return calibration, None, (f"heading and mounting are not refined: {error}",)
    refined = found.apply(recording).calibration
    assert refined is not None
    R_world_inertial, R_sensor_bone = calibration.R_world_inertial.copy(), calibration.R_sensor_bone.copy()
    R_world_inertial[used], R_sensor_bone[used] = refined.R_world_inertial, refined.R_sensor_bone
    whole = replace(calibration, R_world_inertial=R_world_inertial, R_sensor_bone=R_sensor_bone)
    return whole, found, ()


def _never_still(calibration: ImuCalibration, poses: PoseSequence, log: SensorLog) -> tuple[str, ...]:
    """Return the request for a still second where legs have sensors and the person never stands."""
    imus = BoneImuSequence.joined([calibration.apply(imus_of_log(log))], poses.times)
    legs = straight_legs([(imus, poses)], imus.joints)
    if any(leg.still for leg in legs) or not any({*leg} <= {*imus.joints} for leg in LEGS):
        return ()
    by = "is that of other people who walk" if legs else "is as good as the detector's points"
    return (
        f"{NEVER_STILL}: the zero of knee flexion {by}; let the person stand upright with straight knees for two "
        "seconds at the start or at the end",
    )


def _judged(
    calibration: ImuCalibration, starts: list[_Start], refined: SelfCalibration | None, skeleton: SkeletonModel
) -> tuple[SensorAlignment, ...]:
    out, known = [], {} if refined is None else {(q.kind, q.item): q.sigma for q in refined.quantities if q.observed}
    for s, (sensor, joint, start) in enumerate(zip(calibration.sensors, calibration.joints, starts, strict=True)):
        heading = float(so3.heading(calibration.R_world_inertial[s]))
        sigma = float(known.get(("heading", joint), [start.sigma])[0])
        axes = known.get(("mounting", joint))
        mounting = _SWING if axes is None else across(skeleton, joint, axes)
        doubt = ""
        if start.margin < _MARGIN:
            doubt = (
                "its motion hardly determines its heading, which may be wrong by any angle; record a turn, "
                "an arm raise or a deep bend of this segment"
            )
        elif sigma > SURE:
            doubt = (
                f"its heading is not known to {np.degrees(SURE):.0f} degrees; record a turn, an arm raise or "
                "a longer video"
            )
        elif abs(wrapped(heading - start.heading)) > 3 * float(np.hypot(start.sigma, _SWING)):
            doubt = (
                "image and joints disagree about its heading; check that it sits on the segment named and did not slip"
            )
        out.append(SensorAlignment(sensor, joint, heading, sigma, mounting, doubt))
    return tuple(out)
