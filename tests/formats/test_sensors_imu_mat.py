"""MATLAB structs: what is a sensor, what is not, and files that are made to harm."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from sensor_files import REAL, truth, write_mat

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors import imu_mat
from rtof_kin.formats.sensors.imu_mat import read_imu_mat

ONE = truth(1, T=6)


def saved(tmp_path: Path, **content: object) -> Path:
    path = tmp_path / "trial.mat"
    scipy.io.savemat(path, content)
    return path


def test_what_is_no_sensor_is_left_aside(tmp_path: Path) -> None:
    path = saved(
        tmp_path, time=np.arange(6) / 100, hip={"acc": ONE.f, "name": "hip"}, subject="S1",
        settings={"rate": 3.0}, table=np.eye(4), list=np.array([{"acc": 1}, 2], dtype=object),
    )  # fmt: skip
    log = read_imu_mat(path)
    assert log.names == ("hip",)
    assert log.streams[0].holds == ("f_sensor",)
    assert log.streams[0].rate_hz == pytest.approx(100)


def test_whole_numbers_and_single_precision_are_read_too(tmp_path: Path) -> None:
    values = np.array([[0, 0, 10]] * 3)
    path = saved(tmp_path, t=np.arange(3), a={"acc": values.astype(np.int16)},
                 b={"acc": values.astype(np.float32)})  # fmt: skip
    assert {s.f_sensor.dtype for s in read_imu_mat(path).streams if s.f_sensor is not None} == {
        np.dtype(np.float64)
    }


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"t": np.arange(6)}, "no struct in it has a field acc, gyr, mag, quat"),
        ({"t": np.arange(6), "hip": {"acc": ONE.f.T}}, r"hip.acc has shape \(3, 6\), not \(T, 3\)"),
        ({"t": np.arange(6), "hip": {"acc": "high"}}, "hip.acc holds no numbers"),
        ({"t": np.arange(6), "hip": {"acc": ONE.f + 1j}}, "hip.acc holds no numbers"),
        ({"t": np.arange(5), "hip": {"acc": ONE.f}}, "5 times for 6 samples"),
        ({"hip": {"acc": ONE.f}}, "no vector t or time, s; add it, or declare rate_hz"),
        ({"t": "now", "hip": {"acc": ONE.f}}, "no vector t or time"),
        ({"t": np.zeros(6), "hip": {"acc": ONE.f}}, "time does not increase"),
        ({"t": np.arange(6), "hip": {"acc": ONE.f, "gyr": ONE.w[:4]}}, r"lengths: \[4, 6\]"),
        ({"t": np.arange(6), "hip": {"acc": ONE.f * 1e300}}, "sample 0: .* in acceleration is no meas"),
    ],
)
def test_structs_that_are_no_sensors_data_are_an_error(
    tmp_path: Path, content: dict[str, object], message: str
) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_imu_mat(saved(tmp_path, **content))


def test_a_declared_rate_replaces_the_times(tmp_path: Path) -> None:
    path = saved(tmp_path, hip={"acc": ONE.f})
    np.testing.assert_allclose(read_imu_mat(path, rate_hz=50).streams[0].times, np.arange(6) / 50)


def test_hdf5_of_matlab_7_3_is_refused_with_advice(tmp_path: Path) -> None:
    path = tmp_path / "trial.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + b" " * 100 + b"\x89HDF")
    with pytest.raises(FileFormatError, match="of MATLAB 7.3, which is not read; save it with .* '-v7'"):
        read_imu_mat(path)
    with pytest.raises(FileFormatError, match="there is no such file"):
        read_imu_mat(tmp_path / "other.mat")


@pytest.mark.parametrize("order", ["little", "big"])
def test_a_small_file_that_would_fill_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str
) -> None:
    monkeypatch.setattr(imu_mat, "LARGEST_BYTES", 2**20)
    bomb = zlib.compress(bytes(2**22), 9)
    mark, byteorder = (b"IM", "little") if order == "little" else (b"MI", "big")
    tag = b"".join(n.to_bytes(4, byteorder) for n in (15, len(bomb)))  # type: ignore[arg-type]
    path = tmp_path / "bomb.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1" + mark + tag + bomb)
    assert path.stat().st_size < 2**14
    with pytest.raises(FileFormatError, match="would fill more than 1 MiB of memory"):
        read_imu_mat(path)


def test_a_large_claim_without_the_bytes_is_refused(tmp_path: Path) -> None:
    whole = write_mat(tmp_path, [ONE, ONE]).read_bytes()
    path = tmp_path / "claim.mat"
    path.write_bytes(whole[:132] + (2**32 - 1).to_bytes(4, "little") + whole[136:])
    with pytest.raises(FileFormatError, match="damaged|would fill"):
        read_imu_mat(path)


def test_the_real_recording_keeps_its_own_clock() -> None:
    log = read_imu_mat(REAL / "qmt_fullbody_16imu" / "two_of_sixteen.mat")
    assert log.streams[0].times[0] == 40.0
    assert log.streams[0].holds == ("f_sensor", "w_sensor", "R_inertial_sensor")
