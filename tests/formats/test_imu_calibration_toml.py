"""Calibrations of IMUs in TOML: round trip, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.formats.imu_calibration_toml import read_imu_calibration_toml, write_imu_calibration_toml

ONE = """
[sensors.L_UpArm]
quat_wxyz_world_inertial = [1, 0, 0, 0]
R_sensor_bone = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""


def calibration() -> ImuCalibration:
    rng = np.random.default_rng(0)
    return ImuCalibration(
        sensors=("00B42D", 'odd "name"'),
        joints=("LeftLeg", "Hips"),
        R_world_inertial=so3.about_axis("z", rng.uniform(-3, 3, 2)),
        R_sensor_bone=so3.exp(rng.standard_normal((2, 3))),
        p_bone_sensor=rng.uniform(-0.1, 0.1, (2, 3)),
    )


def test_written_calibration_is_read_back_to_the_same_bits(tmp_path: Path, skeleton: SkeletonModel) -> None:
    path = tmp_path / "calibration.toml"
    write_imu_calibration_toml(path, calibration())
    back = read_imu_calibration_toml(path, skeleton)
    assert (back.sensors, back.joints) == (calibration().sensors, calibration().joints)
    for field in ("R_world_inertial", "R_sensor_bone", "p_bone_sensor"):
        np.testing.assert_array_equal(getattr(back, field), getattr(calibration(), field))
    assert back.mounting_sd_deg is None
    assert "mounting_sd_deg" not in path.read_text()


def test_standard_deviation_of_a_mounting_is_kept_for_the_sensors_that_state_it(
    tmp_path: Path, skeleton: SkeletonModel
) -> None:
    path, stated = tmp_path / "calibration.toml", replace(calibration(), mounting_sd_deg=[6.1, np.nan])
    write_imu_calibration_toml(path, stated)
    assert path.read_text().count("mounting_sd_deg = 6.1") == 1
    back = read_imu_calibration_toml(path, skeleton).select(('odd "name"', "00B42D"))
    np.testing.assert_array_equal(back.mounting_sd_deg, [np.nan, 6.1])


def test_known_sensor_has_default_segment_and_position(tmp_path: Path, skeleton: SkeletonModel) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(ONE)
    read = read_imu_calibration_toml(path, skeleton)
    assert read.joints == ("LeftArm",)
    np.testing.assert_allclose(read.p_bone_sensor, [[0.03, 0.225, 0.012]])
