"""Gyroscope and accelerometer of a phone from what its applications write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.tables import phone_files, read_phone

TIMES = np.arange(50) / 100
W = np.random.default_rng(0).normal(size=(50, 3)).round(6)
F = np.random.default_rng(1).normal([0, 9.8, 0], size=(50, 3)).round(6)


def table(path: Path, header: str, *columns: np.ndarray) -> None:
    rows = (",".join(f"{v:.6f}" for v in row) for row in np.column_stack(columns))
    path.write_text("\n".join([header, *rows]) + "\n")


def by_hand(folder: Path) -> Path:
    table(folder / "gyro.csv", "time,wx,wy,wz,fx,fy,fz", TIMES, W, F)
    return folder / "gyro.csv"


def by_phyphox(folder: Path) -> Path:
    gyroscope = ",".join(f"Gyroscope {axis} (rad/s)" for axis in "xyz")
    table(folder / "Gyroscope.csv", f"Time (s),{gyroscope},Absolute (rad/s)", TIMES, W, W[:, 0])
    force = ",".join(f"Acceleration {axis} (m/s^2)" for axis in "xyz")
    table(folder / "Accelerometer.csv", f"Time (s),{force}", TIMES, F)
    return folder


def by_sensor_logger(folder: Path) -> Path:
    for name, values in (("Gyroscope", W), ("TotalAcceleration", F), ("Gravity", 0 * F)):
        table(folder / f"{name}.csv", "time,seconds_elapsed,z,y,x", 1e18 + TIMES, TIMES, values[:, ::-1])
    (folder / "Metadata.csv").write_text("version,device name\n3,phone\n")
    return folder


@pytest.mark.parametrize("write", [by_hand, by_phyphox, by_sensor_logger])
def test_gyroscope_and_accelerometer_are_read(write, tmp_path: Path) -> None:
    log = read_phone(phone_files(write(tmp_path)))
    stream = log.streams[0]
    assert log.names == ("phone",)
    np.testing.assert_allclose(stream.times, TIMES)
    np.testing.assert_allclose(stream.w_sensor, W)
    np.testing.assert_allclose(stream.f_sensor, F, atol=1e-9)
    assert ("left aside: Gravity.csv" in " ".join(log.notes)) == (write is by_sensor_logger)


def test_other_files_are_none_of_a_phone_and_a_gyroscope_is_needed(tmp_path: Path) -> None:
    table(tmp_path / "imu.csv", "time,s_fx,s_fy,s_fz", TIMES, F)
    assert phone_files(tmp_path / "imu.csv") == []
    table(tmp_path / "a.csv", "time,fx,fy,fz", TIMES, F)
    with pytest.raises(FileFormatError, match="no gyroscope"):
        read_phone(phone_files(tmp_path))
