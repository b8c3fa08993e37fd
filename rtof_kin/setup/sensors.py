"""Sensors of a take: clock, segments, headings and mounting, found from the motion in a video or a still pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.alignment import Alignment, align_sensors
from rtof_kin.calibration.assignment import assign_sensors, check_assignment
from rtof_kin.calibration.clocks import ClockEstimate, find_clock
from rtof_kin.calibration.offset_scan import APART
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UndecidedError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.sensors.sensor_map import matched, read_sensor_map
from rtof_kin.inertial.orientation import log_with_orientation
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.inertial.segment_names import known_segment, segments_of
from rtof_kin.reconstruction.self_calibration import CLOCK_DOUBT, DAYS_APART, calibrate_recording
from rtof_kin.recording.sensor_files import IMUS, calibration_table, imus_of_log
from rtof_kin.setup.recording_text import Field, Origin, Tables

_STILL = np.radians(8.0)  # [rad/s] 95th percentile of the angular speed below which a sensor does not move
_STEP = 0.1  # [s] over which that speed is measured, so that noise is no motion
_SURE = 0.95  # Probability of a segment below which a sensor is left out: lower ones are stated too high
_USUAL_REACH, _NEAR = 600.0, 60.0
"""[s] Offsets that are searched: at least, and, beside the video's length, about the one that files state."""
_BELONGING = 0.15  # [1] Part of the image's motion below which sensors are of another take; of right ones 0.2 at least
_JUDGED: Final = 600.0  # [s] around the video of which it is judged which sensor is where, where it is shorter
_SAME_DAY: Final = timedelta(days=1)
_LEAST_COMMON = 2.0  # [s] Least time that video and sensors have in common


@dataclass(frozen=True)
class SetupSensors:
    """Sensors of a recording, the table ``[imus]`` that describes them, and what is in doubt."""

    imus: ImuSequence  # On the sensors' clock, which begins at 0
    fields: Tables
    doubts: tuple[str, ...]
    places: Mapping[str, tuple[str, float]]
    """Likeliest segment of each sensor of the files, '' where there is none, and its probability."""


def set_up_sensors(
    log: SensorLog,
    sensor_map: Path | None,
    poses: PoseSequence,
    keypoints: KeypointSequence,
    skeleton: SkeletonModel,
    start_utc: datetime | None = None,
) -> SetupSensors:
    """Find clock, segments, headings and mounting of the sensors of a video.

    `sensor_map`: file of two columns, sensor and segment; None: the sensors' names say it, or their motion.
    `start_utc`: when the video began, if known. `InvalidInputError`: no sensor moves, or video and sensors have nothing
    in common. `CalibrationError`: nothing relates the sensors to the video. Errors of the map.
    """
    search = partial(find_clock, poses, keypoints, skeleton=skeleton)
    places = known_places(log, sensor_map, skeleton)
    likely = _stated(log.names, {} if places is None else {name: str(one.value) for name, one in places.items()})
    log = log if places is None else log.select(list(places))
    log, still = _moving(log_with_orientation(log))
    first = min(stream.times[0] for stream in log.streams)
    log = _on_clock(log, lambda times: times - first)
    joints = None if places is None else {name: str(places[name].value) for name in log.names}
    clock = _clock(partial(search, log=log, joints=joints), log, float(np.ptp(poses.times)), start_utc)
    return_free_memory()
    apart = _days_apart(log.start_utc, start_utc)
    if clock.explained < _BELONGING or (apart and clock.doubt):
        raise InvalidInputError(
            f"{log.path}: its sensors do not move as the video shows at any offset (they explain "
            f"{100 * clock.explained:.0f} % of the motion){'; ' if apart else ''}{apart}; give the sensors' "
            "files of this take, or leave them out and use the camera alone"
        )
    _check_overlap(clock.apply(log), keypoints.times)
    doubts = [apart, *still, f"{CLOCK_DOUBT}: {clock.doubt}" if clock.doubt else ""]
    if places is None or joints is None:
        places, unsure, found_places = _assigned(_around(clock.apply(log), poses.times), skeleton, poses)
        likely |= found_places
        joints = {name: str(field.value) for name, field in places.items()}
        log = log.select(list(joints))
        # With the segments known, within half a stride; a doubt of the first search stays.
        again = search(log=log, joints=joints, around=clock.offset, reach=APART)
        sigma = clock.sigma if clock.doubt else min(clock.sigma, again.sigma)
        clock = replace(again, doubt=clock.doubt, sigma=sigma)
        doubts += unsure
    else:
        checked = check_assignment(_around(clock.apply(log), poses.times), joints, skeleton, poses)
        doubts += [f"sensor {wrong}; correct the map, or the name" for wrong in checked.wrong]
        doubts += [f"which sensor is where: {checked.doubt}"] if checked.doubt else []
    found = align_sensors(poses, keypoints, clock.apply(log), joints, skeleton, calibrate_recording)
    doubts += found.warnings
    if (delay := found.delay) is not None:  # what the self-calibration has left
        sigma = clock.sigma if clock.doubt else float(delay.sigma[0])
        clock = replace(clock, offset=clock.offset + float(delay.value[0]), sigma=sigma)
    return_free_memory()
    imus = imus_of_log(_on_clock(log, lambda times: times * (1 + clock.drift)))  # without drift, still from 0 on
    fields = _fields(imus, clock, found, places)
    return SetupSensors(imus, fields, tuple(dict.fromkeys(doubt for doubt in doubts if doubt)), likely)


def _stated(names: Sequence[str], joints: Mapping[str, str]) -> dict[str, tuple[str, float]]:
    """Return the places of sensors of which a map or their names state some."""
    return {name: (joints.get(name, ""), float(name in joints)) for name in names}


def _on_clock(log: SensorLog, clock: Callable[[Array], Array]) -> SensorLog:
    return replace(log, streams=tuple(replace(s, times=clock(s.times)) for s in log.streams))


def _clock(
    search: Callable[..., ClockEstimate], log: SensorLog, seconds: float, start_utc: datetime | None
) -> ClockEstimate:
    if start_utc is not None and log.start_utc is not None:
        stated = (log.start_utc - start_utc).total_seconds()
        with suppress(CalibrationError):
            near = search(around=stated, reach=_NEAR + seconds)
            if not near.doubt:
                return near
    return search(reach=max(_USUAL_REACH, *(float(stream.times[-1]) for stream in log.streams)))


def _days_apart(sensors: datetime | None, video: datetime | None) -> str:
    """Return a sentence where the files state days that differ; empty where not, or where one is unknown."""
    if sensors is None or video is None or abs(sensors - video) < _SAME_DAY:
        return ""
    days = abs(sensors - video).days
    return f"{DAYS_APART}: the video of {video:%Y-%m-%d}, the sensors of {sensors:%Y-%m-%d}, {days} days apart"


def known_places(log: SensorLog, sensor_map: Path | None, skeleton: SkeletonModel) -> dict[str, Field] | None:
    """Return the segments that a map or the sensors' own names say; None where they do not say all.
    `FileFormatError`: the map is damaged; `UnknownNameError`: a place is no segment.
    """
    if sensor_map is not None:
        places = matched(read_sensor_map(sensor_map), log.names, sensor_map)
        return {
            name: Field(known_segment(place, skeleton, sensor_map), Origin.FILE, sensor_map.name)
            for name, place in places.items()
        }
    named = segments_of(log.names, skeleton)
    if len(named) < len(log.names):
        return None
    return {name: Field(joint, Origin.FILE, "by the sensor's name") for name, joint in named.items()}


def _moving(log: SensorLog) -> tuple[SensorLog, list[str]]:
    moving = [stream.name for stream in log.streams if _speed(stream) > _STILL]
    still = [name for name in log.names if name not in moving]
    if not moving:
        raise InvalidInputError(
            f"{log.path}: none of its {len(still)} sensors moves; give the file of the sensors that the "
            "person wore in this video, and check that they were recording"
        )
    if not still:
        return log, []
    what = ", ".join(still)
    return log.select(moving), [f"{what}: does not move and is left out; check that it was on the person and recording"]


def _speed(stream: SensorStream) -> float:
    assert stream.R_inertial_sensor is not None
    every = max(1, round(_STEP * stream.rate_hz))
    R, times = stream.R_inertial_sensor[::every], stream.times[::every]
    speed = so3.angle_between(R[1:], R[:-1]) / np.diff(times)
    return float(np.nanpercentile(speed, 95)) if np.isfinite(speed).any() else 0.0


def _check_overlap(log: SensorLog, times: Array) -> None:
    """Check that the sensors, on the video's clock, recorded while the video did."""
    first = max(stream.times[0] for stream in log.streams)
    last = min(stream.times[-1] for stream in log.streams)
    common = min(last, times[-1]) - max(first, times[0])
    if common < min(_LEAST_COMMON, 0.5 * (times[-1] - times[0])):
        raise InvalidInputError(
            f"{log.path}: its sensors recorded from {first:.1f} to {last:.1f} s of the video's clock, the "
            f"video from {times[0]:.1f} to {times[-1]:.1f} s; give the files of one take"
        )


def _around(log: SensorLog, times: Array) -> SensorLog:
    """Return the samples of `_JUDGED` seconds around the video, or of all of it."""
    margin = max(1.0, (_JUDGED - float(np.ptp(times))) / 2)
    parts = [stream.between(times[0] - margin, times[-1] + margin) or stream for stream in log.streams]
    return replace(log, streams=tuple(parts))


def _assigned(
    log: SensorLog, skeleton: SkeletonModel, poses: PoseSequence
) -> tuple[dict[str, Field], list[str], dict[str, tuple[str, float]]]:
    """Return the segments of the sensors that are sure, sentences about the others, and the likeliest segment of all.
    `UndecidedError`: none is sure.
    """
    found = assign_sensors(log, skeleton, poses)
    likely = {name: (joint, found.probabilities[name]) for name, joint in found.joints.items()}
    places, left = dict[str, Field](), list[str]()
    for name, joint in found.joints.items():
        sure = found.probabilities[name]
        percent = f"{100 * sure:.0f} %"
        if sure >= _SURE:
            summary = f"sensor {name} is on {joint} ({percent})"
            places[name] = Field(joint, Origin.FOUND, f"by its motion, {percent} sure", summary)
        else:
            left.append(f"{name} (on {joint}: {percent})")
    if not left:
        return places, [found.doubt], likely
    remedy = "name their segments in a file of two columns, --map FILE"
    if not places:
        raise UndecidedError(
            f"{log.path}: the motion does not tell which sensor is where, {', '.join(left)}; {remedy}", likely
        )
    return places, [f"left out, as their segments are not sure: {', '.join(left)}; {remedy}"], likely


def _fields(imus: ImuSequence, clock: ClockEstimate, found: Alignment, places: Mapping[str, Field]) -> Tables:
    """Return the table ``[imus]``."""
    start = clock.offset - clock.drift * clock.middle
    sigma = f"± {clock.sigma:.1f} s" if clock.doubt else f"± {1000 * clock.sigma:.0f} ms"
    origin, why = (Origin.ASSUMED, "other offsets fit too") if clock.doubt else (Origin.FOUND, "by their motion")
    drift = f"; {1e6 * clock.drift:+.0f} ppm of their clock are in {IMUS}" if clock.drift else ""
    began = Field(
        round(start, 5),
        origin,
        f"{sigma}, {why}; {IMUS} is on the sensors' clock{drift}",
        f"the sensors began {abs(start):.{1 if clock.doubt else 3}f} s "
        f"{'after' if start >= 0 else 'before'} the video, {sigma}{f', {why}' if clock.doubt else ''}",
    )
    tables = calibration_table(found.calibration)
    notes = {
        sensor.sensor: (
            f"heading ± {round(float(np.degrees(sensor.sigma_heading)), 1):g} degrees",
            "mounting, by the video",
            Field(tables[sensor.sensor]["mounting_sd_deg"], Origin.FOUND, "about each axis"),
        )
        for sensor in found.sensors
    }
    sensors = _sensors(tables, places, notes)
    return {"file": Field(IMUS), "names": Field(list(imus.names)), "start_s": began, "sensors": sensors}


def _sensors(
    tables: Mapping[str, Any], places: Mapping[str, Field], notes: Mapping[str, tuple[str, str, Field]]
) -> Tables:
    """Return the tables ``[imus.sensors]``.

    `tables`: of the calibration. `notes`: on heading and mounting of each sensor, and the mounting's deviation.
    """
    return {
        name: {
            "joint": places[name],
            "lever_arm_m": Field(tables[name]["lever_arm_m"], Origin.ASSUMED, "the usual place on this segment"),
            "R_world_inertial": Field(tables[name]["R_world_inertial"], Origin.FOUND, heading),
            "R_sensor_bone": Field(tables[name]["R_sensor_bone"], Origin.FOUND, mounting),
            "mounting_sd_deg": sigma,
        }
        for name, (heading, mounting, sigma) in notes.items()
    }


def sensors_by_pose(
    log: SensorLog, sensor_map: Path | None, pose: Literal["N", "T", "seated"], skeleton: SkeletonModel
) -> SetupSensors:
    """Find headings and mounting of sensors without a video: the person stands still in a known pose for a second.
    `UndecidedError`: which sensor is where is not known. `CalibrationError`: the sensors never rest, or two are on one
    segment. Errors of the map.
    """
    places = known_places(log, sensor_map, skeleton)
    if places is None:
        raise UndecidedError(
            f"{log.path}: without a video it must be known which sensor is where; name their segments in a "
            "file of two columns, --map FILE",
            _stated(log.names, segments_of(log.names, skeleton)),
        )
    likely = _stated(log.names, {name: str(one.value) for name, one in places.items()})
    log = log.select(list(places))
    found = calibrate_by_pose(log, {sensor: str(place.value) for sensor, place in places.items()}, pose, skeleton)
    imus = imus_of_log(log)
    first = float(imus.times[0])
    start, stop = (at - first for at in found.still)
    held = f"{found.pose}-pose from {start:.1f} to {stop:.1f} s"
    notes = {}
    for report in found.sensors:
        off, sigma = f"± {report.expected_deg:.0f} degrees", round(report.expected_deg / np.sqrt(3), 1)
        spread = Field(sigma, Origin.ASSUMED, f"about each axis, {off} in all")
        notes[report.sensor] = "heading", f"mounting {off}, by the pose", spread
    usual = float(np.mean([report.expected_deg for report in found.sensors]))
    summary = f"mounting of {len(notes)} sensors, ± {usual:.0f} degrees, by the pose"
    names = f"the person stood in the {held}; --pose takes another one"
    fields: Tables = {
        "file": Field(IMUS, Origin.FOUND, "", summary),
        "names": Field(list(imus.names), Origin.ASSUMED, held, names),
        "sensors": _sensors(calibration_table(found.calibration), places, notes),
    }
    return SetupSensors(replace(imus, times=imus.times - first), fields, found.warnings, likely)
