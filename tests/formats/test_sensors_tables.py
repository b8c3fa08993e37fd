"""Plain CSV, OpenSense .sto, MATLAB structs and Total Capture's sensors: values and mistakes."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from sensor_files import REAL, G, lines, truth, write_csv, write_mat, write_ximu3

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.formats.sensors import imu_mat
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.imu_mat import read_imu_mat
from rtof_kin.formats.sensors.tables import (
    phone_files,
    read_imu_csv,
    read_opensense_sto,
    read_phone,
    write_opensense_sto,
)

TRUTHS = [truth(1), truth(2)]
ONE = truth(1, T=6)


# --- Motion-BIDS ---------------------------------------------------------------------------------


def test_bids_takes_units_of_the_channels_and_its_rate_from_a_file_above(tmp_path: Path) -> None:
    """In the style of motion_systemvalidation of bids-examples, without latencies, in g, the JSON inherited."""
    folder = tmp_path / "sub-1" / "motion"
    folder.mkdir(parents=True)
    path = folder / "sub-1_task-walk_tracksys-imu_motion.tsv"
    path.write_text("0\t0\t1\t180\t0\tn/a\t7\n" * 2)
    names = [f"a_b_{kind}_{axis}\t{axis}\t{kind}\ta_b" for kind in ("ACCEL", "GYRO") for axis in "xyz"]
    units = ["g"] * 3 + ["deg/s"] * 3
    table = [f"{name}\t{unit}" for name, unit in zip(names, units, strict=True)]
    table = ["name\tcomponent\ttype\ttracked_point\tunits", *table, "a_yaw\tx\tORNT\ta_b\tdeg", ""]
    with pytest.raises(FileFormatError, match=r"channels\.tsv is neither beside it nor above"):
        read_sensor_log(path)
    (tmp_path / "task-walk_channels.tsv").write_text("\n".join(table))
    (tmp_path / "task-run_motion.json").write_text('{"SamplingFrequency": 50}')
    (tmp_path / "task-walk_tracksys-imu_motion.json").write_text('{"SamplingFrequency": 200}')
    log = read_sensor_log(path)
    (stream,) = log.streams
    assert (log.names, stream.rate_hz, stream.holds) == (("a_b",), 200, ("f_sensor", "w_sensor"))
    np.testing.assert_allclose(stream.f_sensor, [[0, 0, STANDARD_GRAVITY]] * 2)
    np.testing.assert_allclose(stream.w_sensor, [[np.pi, 0, np.nan]] * 2)
    assert "channels left out: a_yaw" in log.notes


# --- plain CSV -----------------------------------------------------------------------------------


def csv(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "walk.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_csv_columns_are_the_sensors_arrays(tmp_path: Path) -> None:
    log = read_imu_csv(
        csv(
            tmp_path,
            "time,left thigh_fx,left thigh_fy,left thigh_fz,hip_wx,hip_wy,hip_wz,hip_mx,hip_my,hip_mz",
            "0.5,0,0,9.81,1,2,3,,nan,0.4",
            "0.6,0,0,9.81,1,2,3,0.1,0.2,0.3",
        )
    )
    assert (log.names, log.notes) == (("left thigh", "hip"), ())
    assert [stream.holds for stream in log.streams] == [("f_sensor",), ("w_sensor", "m_sensor")]
    np.testing.assert_array_equal(log.streams[0].times, [0.5, 0.6])
    np.testing.assert_array_equal(log.streams[1].m_sensor, [[np.nan, np.nan, 0.4], [0.1, 0.2, 0.3]])


def test_csv_units_and_rate_can_be_declared(tmp_path: Path) -> None:
    path = csv(tmp_path, "a_fx,a_fy,a_fz,a_wx,a_wy,a_wz", "0,0,1000,180,0,0", "0,0,1000,180,0,0")
    stream = read_imu_csv(path, acceleration_unit="mg", angular_unit="deg/s", rate_hz=10).streams[0]
    np.testing.assert_allclose(stream.f_sensor, [[0, 0, STANDARD_GRAVITY]] * 2)
    np.testing.assert_allclose(stream.w_sensor, [[np.pi, 0, 0]] * 2)
    np.testing.assert_array_equal(stream.times, [0, 0.1])


@pytest.mark.parametrize(
    ("lines", "line", "message"),
    [
        (["time,a_fx,a_fy", "0,1,2"], 1, "no z; send all 3"),
        (["time,a_fx,a_fy,a_fz,b", "0,1,2,3,4"], 1, "column 'b': expected time"),
        (["time,a_fx,a_fy,a_fz", "0,1,2,3", "0,1,2,3"], 3, "time 0 s"),
        (["time,a_fx,a_fy,a_fz"], None, "no packet"),
    ],
)
def test_csv_mistake_is_an_error(tmp_path: Path, lines: list[str], line: int | None, message: str) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        read_imu_csv(csv(tmp_path, *lines))
    assert caught.value.line == line


# --- OpenSense .sto ------------------------------------------------------------------------------


def test_sto_round_trip_of_real_and_planted_sensors(tmp_path: Path) -> None:
    for log in (read_sensor_log(write_csv(tmp_path, TRUTHS)), read_sensor_log(REAL / "opensense_mtw8")):
        log = log.renamed({log.names[0]: "pelvis"})
        write_opensense_sto(tmp_path / "out.sto", log)
        back = read_opensense_sto(tmp_path / "out.sto")
        assert back.names == log.names
        for own, again in zip(log.streams, back.streams, strict=True):
            np.testing.assert_array_equal(own.times, again.times)
            np.testing.assert_allclose(own.R_inertial_sensor, again.R_inertial_sensor, atol=1e-14)
        head = (tmp_path / "out.sto").read_text().splitlines()[:5]
        assert head[1:4] == ["DataType=Quaternion", "version=3", "endheader"]
        assert head[4].startswith("time\tpelvis_imu\t")


def test_sto_refuses_missing_orientation_and_different_times(tmp_path: Path) -> None:
    log = read_sensor_log(write_csv(tmp_path, TRUTHS))
    a, b = log.streams
    R = np.array(a.R_inertial_sensor)
    R[3] = np.nan
    for stream, message in (
        (replace(a, R_inertial_sensor=None), "00B40001 has no orientation"),
        (replace(a, R_inertial_sensor=R), "00B40001 has no orientation"),
        (replace(a, times=a.times + 1), "00B40001 and 00B40002 .*different times"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            write_opensense_sto(tmp_path / "out.sto", replace(log, streams=(stream, b)))
    assert not (tmp_path / "out.sto").exists()


# --- MATLAB structs ------------------------------------------------------------------------------


def mat(tmp_path: Path, **content: object) -> Path:
    path = tmp_path / "trial.mat"
    scipy.io.savemat(path, content)
    return path


def test_mat_ignores_other_variables_and_converts_numbers(tmp_path: Path) -> None:
    other = {"subject": "S1", "settings": {"rate": 3.0}, "table": np.eye(4)}
    listed = np.array([{"acc": 1}, 2], dtype=object)
    whole = {"acc": np.array([[0, 0, 10]] * 6, np.int16), "name": "hip"}
    log = read_imu_mat(mat(tmp_path, time=np.arange(6) / 100, hip=whole, list=listed, **other))
    assert log.names == ("hip",)
    (stream,) = log.streams
    assert (stream.holds, stream.rate_hz) == (("f_sensor",), pytest.approx(100))
    np.testing.assert_array_equal(stream.f_sensor, [[0.0, 0, 10]] * 6)


def test_mat_of_version_7_3_is_refused_with_a_remedy(tmp_path: Path) -> None:
    path = tmp_path / "trial.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + b" " * 100 + b"\x89HDF")
    with pytest.raises(FileFormatError, match="MATLAB 7.3, .*'-v7'"):
        read_imu_mat(path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_imu_mat(tmp_path / "other.mat")


@pytest.mark.parametrize("order", ["little", "big"])
def test_mat_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str) -> None:
    monkeypatch.setattr(imu_mat, "LARGEST_BYTES", 2**20)
    bomb = zlib.compress(bytes(2**22), 9)
    mark = b"IM" if order == "little" else b"MI"
    tag = b"".join(n.to_bytes(4, order) for n in (15, len(bomb)))  # type: ignore[arg-type]
    path = tmp_path / "bomb.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1" + mark + tag + bomb)
    with pytest.raises(FileFormatError, match="would fill more than 1 MiB"):
        read_imu_mat(path)
    whole = write_mat(tmp_path, [ONE, ONE]).read_bytes()
    path.write_bytes(whole[:132] + (2**32 - 1).to_bytes(4, "little") + whole[136:])
    with pytest.raises(FileFormatError, match="damaged|would fill"):
        read_imu_mat(path)


# --- Total Capture -------------------------------------------------------------------------------


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


XIMU3_TRUTHS = [truth(1), truth(2)]


def trial(tmp_path: Path) -> tuple[Path, list[Path]]:
    folder = write_ximu3(tmp_path, XIMU3_TRUTHS)
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


def test_folder_without_inertial_messages_is_refused(tmp_path: Path) -> None:
    folder, (own, _) = trial(tmp_path)
    (own / "Inertial.csv").unlink()
    with pytest.raises(FileFormatError, match=r"\(UDP\): has no Inertial.csv"):
        read_sensor_log(folder)


NORAXON_ONE = truth(4, T=12)
NORAXON_TIMES = np.arange(12) / 200


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
        numbers = [*(NORAXON_ONE.f[i] / G * 1000), *np.rad2deg(NORAXON_ONE.w[i])]
        cells = [f"{NORAXON_TIMES[i]:.6f}", '"walk, fast"', "", "12.5", "1.5", *(f"{x:.9f}" for x in numbers)]
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
    np.testing.assert_allclose(stream.f_sensor, NORAXON_ONE.f, atol=1e-8)
    np.testing.assert_allclose(stream.w_sensor, NORAXON_ONE.w, atol=1e-8)
    np.testing.assert_allclose(stream.times, NORAXON_TIMES)
    assert stream.R_inertial_sensor is None


THIGH = ("Thigh Accel Sensor AXIS LT (mG)", "Thigh Gyro AXIS LT (deg/s)")


def test_decimal_commas_between_semicolons_are_read(tmp_path: Path) -> None:
    stream = the_sensor(written(tmp_path, *THIGH, delimiter=";", decimal=","))
    assert stream.f_sensor is not None
    np.testing.assert_allclose(stream.f_sensor, NORAXON_ONE.f, atol=1e-8)


def test_other_units_are_read_by_their_names(tmp_path: Path) -> None:
    accel, gyro = THIGH
    path = written(tmp_path, accel.replace("mG", "G"), gyro.replace("deg/s", "rad/s"))
    declaration = read_sensor_log(path).declaration
    assert (declaration.acceleration_unit, declaration.angular_unit) == ("g", "rad/s")
    with pytest.raises(FileFormatError, match="unknown unit 'counts'; give m/s2 or g or mg"):
        read_sensor_log(written(tmp_path, accel.replace("mG", "counts"), gyro))


def test_the_rate_can_be_declared_where_there_is_no_time(tmp_path: Path) -> None:
    path = written(tmp_path, *THIGH, time="Sample")
    with pytest.raises(FileFormatError, match="no column time"):
        read_sensor_log(path)
    assert the_sensor(path, rate_hz=100).rate_hz == pytest.approx(100)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Accel Sensor Z LT", "Accel Sensor Z RT", "Thigh LT: its acceleration has channels .* and no z"),
        ("Accel Sensor Y LT (mG)", "Accel Sensor Y LT (G)", "is in g, others in mg; give one unit"),
        ('"LT Knee Flexion (deg)"', '"LT Thigh Accel Sensor X (mG)"', "are both x of the acceleration of Thigh LT"),
        ("0.010000", "0.001000", "is not after the one above"),
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
