"""Plain CSV, OpenSense .sto, MATLAB structs and Total Capture's sensors: values and mistakes."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from sensor_files import REAL, truth, write_csv, write_mat, write_sto, write_total_capture

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.formats.sensors import imu_mat
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.imu_mat import read_imu_mat
from rtof_kin.formats.sensors.tables import read_imu_csv, read_opensense_sto, write_opensense_sto
from rtof_kin.formats.total_capture import read_sensor_log as read_total_capture_sensors

TRUTHS = [truth(1), truth(2)]
ONE = truth(1, T=6)


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
        (["time,a_fx,a_fy", "0,1,2"], 1, "no column a_fz"),
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


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("endheader", "end", "no endheader"),
        ("\t00B40001_imu", "", "line 7: 3 cells under 2 column names"),
        ("\n0\t", "\n0\t1,", "line 7: .*four numbers"),
        ("\n0\t", "\n5\t", "time does not increase"),
    ],
)
def test_sto_damage_is_an_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_sto(tmp_path, TRUTHS)
    path.write_text(path.read_text().replace(old, new, 1) + "\n" * 100)
    with pytest.raises(FileFormatError, match=f"trial.sto.*{message}"):
        read_opensense_sto(path)


def test_sto_without_rows_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "trial.sto"
    path.write_text("DataType=Quaternion\nendheader\ntime\tpelvis_imu\n")
    with pytest.raises(FileFormatError, match="line 3: .*no row"):
        read_opensense_sto(path)


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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"t": np.arange(6)}, "no struct in it has a field acc, gyr, mag, quat"),
        ({"t": np.arange(6), "hip": {"acc": ONE.f + 1j}}, "hip.acc holds no numbers"),
        ({"t": "now", "hip": {"acc": ONE.f}}, "no vector t or time"),
        ({"t": np.arange(6), "hip": {"acc": ONE.f * 1e300}}, "sample 0: .* in acceleration"),
    ],
)
def test_mat_of_other_structs_is_an_error(tmp_path: Path, content: dict[str, object], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_imu_mat(mat(tmp_path, **content))


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


def test_total_capture_has_60_frames_a_second_unless_declared(tmp_path: Path) -> None:
    path = write_total_capture(tmp_path, TRUTHS)
    log = read_total_capture_sensors(path)
    assert log.declaration.rate_hz == 60
    np.testing.assert_allclose(log.streams[1].times, np.arange(40) / 60)
    np.testing.assert_allclose(log.streams[1].f_sensor, TRUTHS[1].f, atol=1e-9)
    assert read_total_capture_sensors(path, rate_hz=30).streams[0].rate_hz == pytest.approx(30)
