"""Noraxon's CSV in the spellings that its software has had, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_files import G, truth

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.formats.sensors.files import read_sensor_log

ONE = truth(4, T=12)
TIMES = np.arange(12) / 200


def written(
    folder: Path, accel: str, gyro: str, delimiter: str = ",", head: str = "", time: str = "time", decimal: str = "."
) -> Path:
    """A file of one sensor; `accel` and `gyro` name its columns, with AXIS for X or x."""
    names = [time, "Activity", "Marker", "LT Knee Flexion (deg)", "Thigh course LT (deg)"]
    names += [accel.replace("AXIS", a) for a in "XYZ"] + [gyro.replace("AXIS", a) for a in "XYZ"]
    if "scope" in gyro:
        names[-3:] = [gyro.replace("AXIS", a) for a in "xyz"]
    rows = []
    for i in range(12):
        numbers = [*(ONE.f[i] / G * 1000), *np.rad2deg(ONE.w[i])]
        cells = [f"{TIMES[i]:.6f}", '"walk, fast"', "", "12.5", "1.5", *(f"{x:.9f}" for x in numbers)]
        rows.append(delimiter.join(cell.replace(".", decimal) for cell in cells))
    path = folder / "trial.csv"
    header = delimiter.join(f'"{name}"' for name in names)
    path.write_text(head + "\n".join([header, *rows, ""]), encoding="utf-8")
    return path


def the_sensor(path: Path, **declared: object) -> SensorStream:
    log = read_sensor_log(path, **declared)
    assert log.format == "Noraxon CSV"
    (stream,) = log.streams
    return stream


@pytest.mark.parametrize("head", ["", '"type","name","last_name"\n"a","b","c"\n\n'])
@pytest.mark.parametrize(
    ("accel", "gyro", "name"),
    [
        ("Thigh Accel Sensor AXIS LT (mG)", "Noraxon MyoMotion-Segments-Thigh LT-Gyroscope-AXIS (deg/s)", "Thigh LT"),
        ("RT Upper arm Accel Sensor AXIS (mG)", "RT Upper arm Gyro AXIS (deg/s)", "Upper arm RT"),
        ("Foot Accel Sensor AXIS RT,mG", "Foot Gyro AXIS RT,deg/s", "Foot RT"),
        ("Pelvis Accel Sensor AXIS (mG)", "MyoMotion-Segments-Pelvis-Gyroscope-AXIS (deg/s)", "Pelvis"),
    ],
)
def test_every_spelling_is_read(tmp_path: Path, accel: str, gyro: str, name: str, head: str) -> None:
    stream = the_sensor(written(tmp_path, accel, gyro, head=head))
    assert stream.name == name
    assert stream.f_sensor is not None
    assert stream.w_sensor is not None
    np.testing.assert_allclose(stream.f_sensor, ONE.f, atol=1e-8)
    np.testing.assert_allclose(stream.w_sensor, ONE.w, atol=1e-8)
    np.testing.assert_allclose(stream.times, TIMES)
    assert stream.R_inertial_sensor is None


THIGH = ("Thigh Accel Sensor AXIS LT (mG)", "Thigh Gyro AXIS LT (deg/s)")


def test_decimal_commas_between_semicolons_are_read(tmp_path: Path) -> None:
    stream = the_sensor(written(tmp_path, *THIGH, delimiter=";", decimal=","))
    assert stream.f_sensor is not None
    np.testing.assert_allclose(stream.f_sensor, ONE.f, atol=1e-8)


def test_other_units_are_read_by_their_names(tmp_path: Path) -> None:
    accel, gyro = THIGH
    path = written(tmp_path, accel.replace("mG", "G"), gyro.replace("deg/s", "rad/s"))
    declaration = read_sensor_log(path).declaration
    assert (declaration.acceleration_unit, declaration.angular_unit) == ("g", "rad/s")
    with pytest.raises(FileFormatError, match=r"its unit is not one of mG, G, m/s\^2"):
        read_sensor_log(written(tmp_path, accel.replace("mG", "counts"), gyro))


def test_the_rate_can_be_declared_where_there_is_no_time(tmp_path: Path) -> None:
    path = written(tmp_path, *THIGH, time="Sample")
    with pytest.raises(FileFormatError, match="no column time"):
        read_sensor_log(path)
    assert the_sensor(path, rate_hz=100).rate_hz == pytest.approx(100)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Accel Sensor Z LT", "Accel Sensor Z RT", "acceleration of Thigh LT needs x, y and z once each"),
        ("Accel Sensor Y LT (mG)", "Accel Sensor Y LT (G)", "have different units"),
        ('"LT Knee Flexion (deg)"', '"LT Thigh Accel Sensor X (mG)"', "needs x, y and z once each"),
        ("0.010000", "0.001000", "increas"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(tmp_path: Path, old: str, new: str, problem: str) -> None:
    path = written(tmp_path, *THIGH)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(FileFormatError, match=problem):
        read_sensor_log(path)


def test_segments_accelerations_alone_are_no_sensors(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    names = ",".join(f"Noraxon MyoMotion-Segments-Foot LT-Acceleration-{a} (mG)" for a in "xyz")
    path.write_text(f"time,{names}\n0,1,2,3\n")
    with pytest.raises(FileFormatError, match="no file of sensors that is known"):
        read_sensor_log(path)
