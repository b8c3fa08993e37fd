"""Files of a phone and sensors that are written of a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, OutputExistsError
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import ImuSequence
from rtof_kin.formats.cameras import read_camera
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.sensor_map import read_sensor_map
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.sources import Sources
from rtof_kin.simulation.simulate import write_raw_files
from rtof_kin.vision.keypoints import read_detector_keypoints


@pytest.fixture(scope="module")
def demo() -> Recording:
    return Recording.load(model_path("demo")).between(0.0, 1.5)


def test_files_are_recognised_and_hold_what_was_recorded(tmp_path: Path, demo: Recording) -> None:
    take = tmp_path / "take"
    write_raw_files(demo, take)
    found = Sources.of(take.glob("[!.]*"))
    assert found.keypoints is not None
    assert found.camera is not None
    assert found.sensor_map is not None
    assert demo.imus is not None
    assert demo.calibration is not None

    camera = read_camera(found.camera)
    np.testing.assert_allclose(camera.R_camera_world, demo.video.camera.R_camera_world, atol=1e-12)
    seen = read_detector_keypoints(found.keypoints, camera).keypoints
    np.testing.assert_allclose(seen.select(demo.video.names).uv_px, demo.video.uv_px, atol=1e-2)

    imus = ImuSequence.joined(read_sensor_log(found.sensors).imus())
    np.testing.assert_allclose(imus.times - imus.times[0], demo.imus.times - demo.imus.times[0], atol=2e-6)
    assert imus.times[0] - demo.imus.times[0] > 30  # a clock of their own
    assert so3.angle_between(imus.R_inertial_sensor, demo.imus.R_inertial_sensor).max() < 1e-6
    np.testing.assert_allclose(imus.f_sensor, demo.imus.f_sensor, atol=1e-4)
    places = read_sensor_map(found.sensor_map)
    joints = [known_segment(places[name], SkeletonModel.default()) for name in imus.names]
    assert joints == list(demo.calibration.select(demo.imus.names).joints)


def test_nothing_is_replaced_and_sensors_need_places(tmp_path: Path, demo: Recording) -> None:
    write_raw_files(replace(demo, imus=None, calibration=None), tmp_path / "take")
    assert not (tmp_path / "take" / "dots").exists()
    with pytest.raises(OutputExistsError):
        write_raw_files(demo, tmp_path / "take")
    with pytest.raises(InvalidInputError, match="places"):
        write_raw_files(replace(demo, calibration=None), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_the_demo_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--demo", "--only", "files", "-o", str(tmp_path / "take"), "--seconds", "1"]) == 0
    assert "rtof-kin run" in capsys.readouterr().out
    assert len(list((tmp_path / "take" / "dots").iterdir())) == 8
