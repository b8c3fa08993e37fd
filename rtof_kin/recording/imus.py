"""The IMUs of a recording folder and their calibration; `rtof_kin.recording.recording` documents the format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.core.files.section import Section
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.formats.imu_calibration_toml import calibration_of, calibration_table
from rtof_kin.recording.files import csv_names, data_path, naming, needed, read_arrays, read_times

Array = NDArray[np.float64]
_COLUMNS = ("_qw", "_qx", "_qy", "_qz", "_fx", "_fy", "_fz")
_QUATERNION_TOLERANCE = 1e-3


def read_imus(section: Section, skeleton: SkeletonModel) -> tuple[ImuSequence | None, ImuCalibration | None]:
    """The sensors' data, where the section names a file, and their calibration, where it has one."""
    calibration = calibration_of(section.table("sensors"), skeleton)
    imus = _imu_sequence(section, calibration) if section.has("file") else None
    if imus is not None and calibration is not None:
        missing = [name for name in imus.names if name not in calibration.sensors]
        if missing:
            where = f"sensor (it has no table [imus.sensors.*] in {section.path})"
            raise UnknownNameError(where, missing, calibration.sensors)
    section.close()
    return imus, calibration


def _imu_sequence(section: Section, calibration: ImuCalibration | None) -> ImuSequence:
    path = data_path(section)
    if path.suffix.lower() == ".csv":
        names, arrays = _imu_csv(path)
    else:
        arrays = read_arrays(path, ("quat_wxyz", "R_inertial_sensor", "f_sensor", "times"))
        given = section.optional_names("names")
        if given is None and calibration is None:
            raise section.error("names", "missing; list the sensors in the file's order")
        names = given if given is not None else calibration.sensors  # type: ignore[union-attr]
    f = needed(path, arrays, "f_sensor", "(T, S, 3)")
    if f.shape[1] != len(names):
        raise section.error(
            "names", f"{len(names)} sensors are named, but {path} has {f.shape[1]}; list them in the "
            "file's order"
        )  # fmt: skip
    with naming(path):
        R = _imu_rotations(path, arrays, names)
        return ImuSequence(read_times(section, path, arrays, len(f)), R, f, names)


def _imu_rotations(path: Path, arrays: dict[str, Array], names: Sequence[str]) -> Array:
    if ("quat_wxyz" in arrays) == ("R_inertial_sensor" in arrays):
        raise FileFormatError(path, "give one of quat_wxyz (T, S, 4) and R_inertial_sensor")
    if "R_inertial_sensor" in arrays:
        return needed(path, arrays, "R_inertial_sensor", "(T, S, 3, 3)")
    quat = needed(path, arrays, "quat_wxyz", "(T, S, 4)")
    shape = (len(arrays["f_sensor"]), len(names), 4)
    if quat.shape != shape:
        raise FileFormatError(path, f"quat_wxyz: expected shape {shape}, got {quat.shape}")
    norm = np.linalg.norm(quat, axis=-1)
    wrong = ~np.isnan(norm) & ~(np.abs(norm - 1) <= _QUATERNION_TOLERANCE)
    if np.any(wrong):
        t, s = (int(i) for i in np.argwhere(wrong)[0])
        raise FileFormatError(
            path, f"quat_wxyz: sample {t} of {names[s]} has norm {norm[t, s]:.6g}, not 1; normalise "
            "it, or write NaN where a sample is missing"
        )  # fmt: skip
    R = np.full((*quat.shape[:2], 3, 3), np.nan)
    known = ~np.isnan(norm)
    R[known] = so3.from_quat_wxyz(quat[known])
    return R


def _imu_csv(path: Path) -> tuple[tuple[str, ...], dict[str, Array]]:
    columns = read_csv(path)
    arrays = {"times": columns.pop("time")} if "time" in columns else {}
    names = csv_names(path, list(columns), _COLUMNS)

    def stacked(endings: Sequence[str]) -> Array:
        return np.stack([[columns[n + end] for end in endings] for n in names]).transpose(2, 0, 1)

    arrays["quat_wxyz"], arrays["f_sensor"] = stacked(_COLUMNS[:4]), stacked(_COLUMNS[4:])
    return names, arrays


def imu_table(calibration: ImuCalibration | None) -> dict[str, Any]:
    """The table ``[imus.sensors]`` that `read_imus` reads back to the same bits."""
    return {} if calibration is None else calibration_table(calibration)
