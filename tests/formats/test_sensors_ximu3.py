"""x-IMU3 folders: messages of different rates, names, and damage."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sensor_files import lines, truth, write_ximu3

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.files import read_sensor_log

TRUTHS = [truth(1), truth(2)]


def trial(tmp_path: Path) -> tuple[Path, list[Path]]:
    folder = write_ximu3(tmp_path, TRUTHS)
    return folder, sorted(one for one in folder.iterdir() if one.is_dir())


def test_other_rates_are_interpolated_to_the_inertial_samples(tmp_path: Path) -> None:
    _, (own, _) = trial(tmp_path)
    angle = np.linspace(0, 9, 31)
    quat = np.stack([np.cos(angle / 2), *np.sin(angle / 2) * np.array([[0.6], [0], [0.8]])], axis=1)
    quat[::2] *= -1  # the same rotations
    stamps = 917_000_000 + 33334 * np.arange(31) - 8000
    rows = lines(np.column_stack([stamps, quat]), ",")
    (own / "Quaternion.csv").write_text("\n".join(["Timestamp (us),W,X,Y,Z", *rows]))
    stream = read_sensor_log(own).streams[0]
    at = np.interp(stream.times, stamps / 1e6, angle)
    R = stream.R_inertial_sensor
    np.testing.assert_allclose(np.trace(R, axis1=1, axis2=2), 1 + 2 * np.cos(at), atol=1e-3)


def test_long_gaps_are_not_interpolated(tmp_path: Path) -> None:
    _, (own, _) = trial(tmp_path)
    for kind in ("Quaternion", "Magnetometer"):
        rows = (own / f"{kind}.csv").read_text().splitlines()
        (own / f"{kind}.csv").write_text("\n".join([*rows[:5], *rows[20:]]))
    stream = read_sensor_log(own).streams[0]
    R, m = stream.R_inertial_sensor, stream.m_sensor
    assert np.isnan(R[5:18]).all()
    assert np.isfinite([*R[:4], *R[19:]]).all()
    assert np.isfinite(m).all()  # 0.27 s: the field changes slowly


def test_without_other_messages_orientation_and_field_are_absent(tmp_path: Path) -> None:
    _, (own, _) = trial(tmp_path)
    for kind in ("Quaternion", "Magnetometer"):
        (own / f"{kind}.csv").unlink()
    assert read_sensor_log(own).streams[0].holds == ("f_sensor", "w_sensor")


@pytest.mark.parametrize(
    "command", ["", "{", "[]", "[1]", "{}", '[{"ping": 3}]', '[{"ping": {"name": 3, "sn": "1"}}]', "[" * 5000, "\0"]
)
def test_folder_names_the_sensor_where_the_device_does_not(tmp_path: Path, command: str) -> None:
    _, (own, _) = trial(tmp_path)
    (own / "Command.json").write_text(command)
    assert read_sensor_log(own).names == ("00B40001",)


def test_devices_of_one_name_get_their_serial_numbers(tmp_path: Path) -> None:
    folder, devices = trial(tmp_path)
    for device, serial in zip(devices, ("64F619FB", "64F0EDBF"), strict=True):
        ping = {"ping": {"interface": "UDP", "name": "x-IMU3", "sn": serial}}
        (device / "Command.json").write_text(json.dumps([ping]))
    assert read_sensor_log(folder).names == ("x-IMU3 64F619FB", "x-IMU3 64F0EDBF")


@pytest.mark.parametrize(
    ("kind", "old", "new", "message"),
    [
        ("Inertial", "917016667", "17016667", "line 3: Timestamp .us. goes from .* started anew"),
        ("Inertial", "Accelerometer X (g)", "Acc X", "line 1: has no columns Gyroscope X"),
        ("Inertial", "917016667", "x", "line 3: column Timestamp .us.: 'x' is not a number"),
        ("Quaternion", ",W,", ",Q,", "Quaternion.csv, line 1: has no columns W, X, Y, Z"),
    ],
)
def test_damage_names_file_and_line(tmp_path: Path, kind: str, old: str, new: str, message: str) -> None:
    _, (own, _) = trial(tmp_path)
    path = own / f"{kind}.csv"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(FileFormatError, match=message):
        read_sensor_log(own)


def test_folder_without_inertial_messages_is_refused(tmp_path: Path) -> None:
    folder, (own, _) = trial(tmp_path)
    (own / "Inertial.csv").unlink()
    with pytest.raises(FileFormatError, match=r"\(UDP\): has no Inertial.csv"):
        read_sensor_log(folder)
