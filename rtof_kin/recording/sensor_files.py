"""The table ``[imus]`` of a recording: samples of sensors in files of this package or of makers, and calibration.

The format is described in docs/recording.md and docs/sensors.md.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, blocks_of
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnknownNameError, reading
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.files.text import beginning
from rtof_kin.core.over_time import ALL, Stream
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.data.imu_stream import CHOICES, SensorLog
from rtof_kin.formats.sensors.files import format_of, read_sensor_log
from rtof_kin.formats.sensors.sensor_map import matched, read_sensor_map
from rtof_kin.formats.sensors.sensor_text import cells
from rtof_kin.inertial.orientation import log_with_orientation
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.recording.streams import Source, csv_names, data_path, naming, needed, times_of
from rtof_kin.recording.tables import OF_MAKERS, ImusTable, SensorTable

IMUS: Final = "imus.npz"  #: File of a recording's sensors that this package writes
_QUATERNION_TOLERANCE: Final = 1e-3
_IMU_COLUMNS: Final = ("_qw", "_qx", "_qy", "_qz", "_fx", "_fy", "_fz")
_IMU_AXES: Final = {"quat_wxyz": 3, "R_inertial_sensor": 4, "f_sensor": 3, "times": 1}  #: Number of axes of the arrays
_log = logging.getLogger(__name__)


def imu_stream(
    table: ImusTable, skeleton: SkeletonModel, source: Source
) -> tuple[Stream[ImuSequence] | None, ImuCalibration | None]:
    """Open sensor data, where the table names a file, and return their calibration, where it has one."""
    calibration = calibration_of(table.sensors, skeleton)
    if table.file is None:
        return None, calibration
    names, imus = _opened(table, calibration, skeleton, source)
    if calibration is not None:
        indices_of(f"sensor (it has no table [imus.sensors.*] in {table.path})", names, calibration.sensors)
    return imus, calibration


def _opened(
    table: ImusTable, calibration: ImuCalibration | None, skeleton: SkeletonModel, source: Source
) -> tuple[tuple[str, ...], Stream[ImuSequence]]:
    """Return the names of the sensors and their samples."""
    path = data_path(table, or_folder=True)
    is_csv = _is_own_csv(path)
    if (log := maker_log(table, skeleton, calibration.sensors if calibration is not None else ())) is not None:
        with naming(path):
            imus = imus_of_log(log)
        return imus.names, source.keep(imus.times, (imus[rows] for rows in blocks_of(len(imus))))
    if is_csv:
        for field in OF_MAKERS:
            if table.has(field):
                raise table.error(field, "is for the files of sensors' makers; leave it out, or name such a file")
        if table.names is not None:
            raise table.error("names", "a .csv names its sensors itself; leave the names out")
        names, arrays = source.csv(path, _arranged)
    else:
        arrays = source.npz(path, _IMU_AXES)
        listed = table.names
        if listed is None and calibration is not None:
            listed = calibration.sensors
        if listed is None:
            raise table.error("names", "missing; list the sensors in the file's order")
        names = listed
    T, S = needed(path, arrays.shapes, "f_sensor", "(T, S, 3)")[:2]
    if len(names) != S:
        raise table.error("names", f"{len(names)} sensors are named, but {path} has {S}; list them in the file's order")
    with naming(path):
        _check_rotations(path, arrays.shapes, len(names))
        times, drift = times_of(table, path, arrays, T), table.clock_drift
    times = times if drift == 0 else times + drift * (times - table.start_s)

    def part(rows: slice) -> ImuSequence:
        own = arrays.rows(rows)
        with naming(path):
            R = _imu_rotations(path, own, names)
            return ImuSequence(times[rows], R, own["f_sensor"], names, unit_checked=rows != ALL)

    return names, Stream(times, part)


# --- calibration of sensors on their segments -----------------------------------------------------


def calibration_of(sensors: Mapping[str, SensorTable], skeleton: SkeletonModel) -> ImuCalibration | None:
    """Return the calibration in the tables of sensors by name; None without any. Segment and position default to those
    of the skeleton table's sensor of that name. `FileFormatError`: a missing or invalid field, which is named;
    `UnknownNameError`: unknown segment.
    """
    joints, levers = [], []
    for name, own in sensors.items():
        usual_joint, usual_lever = skeleton.sensors.get(name, (None, None))
        joint = usual_joint if own.joint is None else own.joint
        if joint is None:
            raise own.error("joint", 'missing; add e.g. joint = "..."')
        if joint not in skeleton.names:
            raise UnknownNameError("joint", [joint], skeleton.names, own.path, own.where("joint"))
        lever = usual_lever if own.lever_arm_m is None and joint == usual_joint else own.lever_arm_m
        if lever is None:
            raise own.error("lever_arm_m", "missing; add 3 numbers")
        joints.append(joint)
        levers.append(lever)
    if not joints:
        return None
    tables = sensors.values()
    stated = [own.mounting_sd_deg for own in tables]
    with reading(next(iter(tables)).path, "{}", CalibrationError, InvalidInputError):
        return ImuCalibration(
            sensors=tuple(sensors),
            joints=tuple(joints),
            R_world_inertial=np.array([_rotation(own, "world_inertial") for own in tables]),
            R_sensor_bone=np.array([_rotation(own, "sensor_bone") for own in tables]),
            p_bone_sensor=np.array(levers),
            mounting_sd_deg=None if set(stated) == {None} else np.array(stated, dtype=np.float64),
        )


def _rotation(table: SensorTable, frames: str) -> Array:
    """Return a rotation from the matrix ``R_<frames>`` or from ``quat_wxyz_<frames>``."""
    quat: Array | None = getattr(table, f"quat_wxyz_{frames}")
    if quat is None:
        return np.asarray(getattr(table, f"R_{frames}"))
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1) > _QUATERNION_TOLERANCE:
        raise table.error(f"quat_wxyz_{frames}", f"has norm {norm:.6g}, not 1; normalise it")
    return so3.from_quat_wxyz(quat)


def calibration_table(calibration: ImuCalibration) -> dict[str, Any]:
    """Return the tables of the sensors, by name, which `calibration_of` reads back to the same bits."""
    tables: dict[str, Any] = {
        name: {
            "joint": calibration.joints[s],
            "lever_arm_m": calibration.p_bone_sensor[s].tolist(),
            "R_world_inertial": calibration.R_world_inertial[s].tolist(),
            "R_sensor_bone": calibration.R_sensor_bone[s].tolist(),
        }
        for s, name in enumerate(calibration.sensors)
    }
    if calibration.mounting_sd_deg is not None:
        for own, sd in zip(tables.values(), calibration.mounting_sd_deg, strict=True):
            own |= {} if np.isnan(sd) else {"mounting_sd_deg": float(sd)}
    return tables


# --- files of sensors' makers --------------------------------------------------------------------


def maker_log(table: ImusTable, skeleton: SkeletonModel, named: Sequence[str] = ()) -> SensorLog | None:
    """Read the sensor files of a recording: those in use, by the segments that carry them, on the recording's clock;
    None where they are this package's own. Errors name file, field and remedy.
    """
    path = data_path(table, or_folder=True)
    if path.suffix.lower() == ".npz" or _is_own_csv(path):
        return None
    declared = {name: getattr(table, name) for name in ("rate_hz", *CHOICES)}
    log = read_sensor_log(path, **declared)
    with naming(table.path):
        log = _mapped(table, log, skeleton, named)
    selected = table.names or log.names
    unknown = [name for name in selected if name not in log.names]
    if unknown:
        raise UnknownNameError("sensor", unknown, log.names, table.path, table.where("names"))
    log = log.select(selected)
    for note in log.notes:
        _log.info("%s: %s", path, note)
    drift, shift = table.clock_drift, table.start_s
    if table.first_sample_s is not None:
        first = min(float(stream.times[0]) for stream in log.streams)
        shift = table.first_sample_s - first * (1 + drift)
    return replace(log, streams=tuple(replace(one, times=one.times * (1 + drift) + shift) for one in log.streams))


def _mapped(table: ImusTable, log: SensorLog, skeleton: SkeletonModel, named: Sequence[str]) -> SensorLog:
    """Return the sensors that a map names, under the names of their segments; all where there is no map."""
    if table.sensor_map is None and not table.map:
        return log
    if table.sensor_map is not None and table.map:
        raise table.error("sensor_map", "stands beside [imus.map]; give only one of the two")
    file = None if table.sensor_map is None else data_path(table, field="sensor_map")
    segments = table.map if file is None else read_sensor_map(file)
    for segment in segments.values():
        if segment not in named:
            known_segment(segment, skeleton, file or table.path)
    found = matched(segments, log.names, file)
    left = [name for name in log.names if name not in found]
    if left:
        _log.info("%s: the map of sensors leaves out %s", table.path, ", ".join(left))
    return log.select(list(found)).renamed(found)


def imus_of_log(log: SensorLog) -> ImuSequence:
    """Return orientation and specific force of all sensors at common times.

    Orientations that are missing are estimated by VQF; a sensor of orientation alone has NaN for its specific force.
    Sensors of other times are resampled to even times at the fastest sensor's rate. `InvalidInputError`: a sensor has
    neither an orientation nor what it is estimated from.
    """
    streams = log_with_orientation(log).streams
    unknown = {one.name: np.full((len(one), 3), np.nan) for one in streams if one.f_sensor is None}
    complete = [replace(one, f_sensor=unknown.get(one.name, one.f_sensor)) for one in streams]
    return ImuSequence.joined([one.imu() for one in complete])


# --- this package's own files --------------------------------------------------------------------


def write_imus(path: Path, imus: ImuSequence) -> None:
    """Write sensors as `imu_stream` reads them back exactly, with their names in the table."""
    write_npz(path, imu_arrays(imus))


def imu_arrays(imus: ImuSequence) -> dict[str, Any]:
    """Return the arrays of a file of sensors."""
    return {"R_inertial_sensor": imus.R_inertial_sensor, "f_sensor": imus.f_sensor, "times": imus.times}


def _is_own_csv(path: Path) -> bool:
    """Return whether a .csv has the columns of a recording's own, or none of a sensor file's."""
    if path.suffix.lower() != ".csv":
        return False
    head = beginning(path).decode("utf-8-sig", errors="replace")
    names = [name for name in cells(head.split("\n", 1)[0], ",") if name != "time"]
    return all(name.endswith(_IMU_COLUMNS) for name in names) or format_of(path) is None


def _check_rotations(path: Path, shapes: Mapping[str, tuple[int, ...]], S: int) -> None:
    """Check that there are rotations of all sensors, in one of two forms."""
    if ("quat_wxyz" in shapes) == ("R_inertial_sensor" in shapes):
        raise FileFormatError(path, "give one of quat_wxyz (T, S, 4) and R_inertial_sensor")
    if "R_inertial_sensor" in shapes:
        needed(path, shapes, "R_inertial_sensor", "(T, S, 3, 3)")
        return
    shape = (shapes["f_sensor"][0], S, 4)
    if needed(path, shapes, "quat_wxyz", "(T, S, 4)") != shape:
        raise FileFormatError(path, f"quat_wxyz: expected shape {shape}, got {shapes['quat_wxyz']}")


def _imu_rotations(path: Path, arrays: dict[str, Array], names: Sequence[str]) -> Array:
    if "R_inertial_sensor" in arrays:
        return arrays["R_inertial_sensor"]
    quat = arrays["quat_wxyz"]
    norm = np.linalg.norm(quat, axis=-1)
    known = ~np.isnan(norm)
    wrong = known & ~(np.abs(norm - 1) <= _QUATERNION_TOLERANCE)
    if np.any(wrong):
        t, s = (int(i) for i in np.argwhere(wrong)[0])
        raise FileFormatError(
            path,
            f"quat_wxyz: sample {t} of {names[s]} has norm {norm[t, s]:.6g}, not 1; normalise "
            "it, or write NaN where a sample is missing",
        )
    return so3.known_from_quat_wxyz(quat)


def _arranged(path: Path, columns: dict[str, Array]) -> tuple[tuple[str, ...], dict[str, Array]]:
    """Return names and arrays of the columns of a .csv file."""
    arrays = {"times": columns["time"]} if "time" in columns else {}
    names = csv_names(path, [name for name in columns if name != "time"], _IMU_COLUMNS)
    values = np.stack([[columns[n + end] for end in _IMU_COLUMNS] for n in names]).transpose(2, 0, 1)
    return names, arrays | {"quat_wxyz": values[..., :4], "f_sensor": values[..., 4:]}
