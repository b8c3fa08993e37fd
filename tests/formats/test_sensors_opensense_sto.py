"""OpenSense .sto: a round trip, and what is refused on either way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sensor_files import REAL, truth, write_csv, write_sto

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.opensense_sto import read_opensense_sto, write_opensense_sto

TRUTHS = [truth(1), truth(2)]


def test_a_log_comes_back_to_the_last_digits(tmp_path: Path) -> None:
    log = read_sensor_log(write_csv(tmp_path, TRUTHS)).renamed({"00B40001": "pelvis"})
    write_opensense_sto(tmp_path / "out.sto", log)
    back = read_opensense_sto(tmp_path / "out.sto")
    assert back.names == ("pelvis", "00B40002")
    for own, again in zip(log.streams, back.streams, strict=True):
        np.testing.assert_array_equal(own.times, again.times)
        np.testing.assert_allclose(own.R_inertial_sensor, again.R_inertial_sensor, atol=1e-14)
    head = (tmp_path / "out.sto").read_text().splitlines()[:5]
    assert head[:4] == ["DataRate=60.000000", "DataType=Quaternion", "version=3", "endheader"]
    assert head[4] == "time\tpelvis_imu\t00B40002_imu"


def test_real_sensors_can_be_handed_to_opensim(tmp_path: Path) -> None:
    log = read_sensor_log(REAL / "opensense_mtw8").renamed({"00B42279": "pelvis", "00B42268": "torso"})
    write_opensense_sto(tmp_path / "walk.sto", log)
    back = read_sensor_log(tmp_path / "walk.sto")
    np.testing.assert_allclose(
        log.streams[0].R_inertial_sensor, back.streams[0].R_inertial_sensor, atol=1e-14
    )
    assert back.streams[0].holds == ("R_inertial_sensor",)


def test_a_log_that_the_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    log = read_sensor_log(write_csv(tmp_path, TRUTHS))
    a, b = log.streams
    R = np.array(a.R_inertial_sensor)
    R[3] = np.nan
    for stream, message in (
        (replace(a, R_inertial_sensor=None), "00B40001 has no orientation in every sample"),
        (replace(a, R_inertial_sensor=R), "00B40001 has no orientation in every sample"),
        (replace(a, times=a.times + 1), "00B40001 and 00B40002 were sampled at different times"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            write_opensense_sto(tmp_path / "out.sto", replace(log, streams=(stream, b)))
    assert not (tmp_path / "out.sto").exists()


def test_axes_that_opensim_turned_already_can_be_declared(tmp_path: Path) -> None:
    path = write_sto(tmp_path, TRUTHS)
    R = read_opensense_sto(path, inertial_axes="y up").streams[0].R_inertial_sensor
    assert R is not None
    x, y, z = TRUTHS[0].R.as_matrix().transpose(1, 0, 2)
    np.testing.assert_allclose(R, np.stack([x, -z, y], axis=1), atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("endheader", "end", "line 100: no endheader|no endheader"),
        ("time\t", "t\t", "line 6: expected time and sensors' names after endheader"),
        ("\t00B40001_imu", "", "line 7: 3 cells under 2 column names"),
        ("00B40001_imu", "00B40002_imu", "00B40002 stands there more than once"),
        ("\n0\t", "\nzero\t", "line 7: holds something else than numbers"),
        ("\n0\t", "\n0\t1,", "line 7: a cell has not four numbers w,x,y,z"),
        ("\n0\t", "\n1e300\t", "1e[+]300 in times is no measurement"),
        ("\n0\t", "\n5\t", "time does not increase from index 0"),
    ],
)
def test_damage_is_an_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_sto(tmp_path, TRUTHS)
    path.write_text(path.read_text().replace(old, new, 1) + "\n" * 100)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_opensense_sto(path)
    assert "trial.sto" in str(caught.value)


def test_names_without_rows_are_an_error(tmp_path: Path) -> None:
    path = tmp_path / "trial.sto"
    path.write_text("DataType=Quaternion\nendheader\ntime\tpelvis_imu\n")
    with pytest.raises(FileFormatError, match="line 3: holds names and no row"):
        read_opensense_sto(path)
