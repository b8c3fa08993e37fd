"""Two recordings of one take, joined: clocks, views, notes and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.second_camera import SecondCamera
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.setup import join
from rtof_kin.setup.join import join_recordings

BODY = SkeletonModel.default()
TRUTH = planted.moving(BODY, 240, radians=0.5)
SIDE = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], focal_px=1100.0)
LATER = 7.3
FIRST = Recording("one", planted.keypoints(TRUTH.poses, 3.0))
UNSURE = CameraUncertainty(focal=0.1, tilt=0.05, height=0.3, k1=0.05)


def second(later: float = LATER) -> Recording:
    uv = SIDE.project(TRUTH.poses.p_world_joint)
    seen = KeypointSequence(SIDE, TRUTH.times + later, uv, np.ones(uv.shape[:2]), BODY.names)
    return Recording("two", seen)


class Lifters:
    """Lifts each of two videos of one motion at its own times."""

    def predict(self, keypoints: KeypointSequence, *given: Any, **named: Any) -> Any:
        lifter: Any = planted.PlantedLifter(TRUTH)
        lifter.times = TRUTH.times + (keypoints.times[0] - TRUTH.times[0])
        return lifter.predict(keypoints, *given, **named)


def test_calibrated_cameras_keep_their_places_and_get_one_clock() -> None:
    joined = join_recordings(FIRST, second(), Lifters())
    (view,) = joined.views
    np.testing.assert_allclose(view.times, TRUTH.times, atol=0.01)
    assert view.camera == SIDE
    assert joined.notes.startswith("found: second camera: as calibrated")


def test_synchronised_cameras_keep_their_times_however_short_the_take(tmp_path: Path) -> None:
    short = replace(FIRST, keypoints=FIRST.video[:40])
    joined = join_recordings(short, second(0.0), Lifters(), synchronised=True)
    joined.save(tmp_path / "joined")
    again = Recording.load(tmp_path / "joined")
    assert np.array_equal(again.views[0].times, TRUTH.times)
    assert again.notes == joined.notes


def test_an_uncalibrated_camera_is_found_and_its_place_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def find(first: Recording, seen: KeypointSequence, lifter: object, *, around: float | None) -> SecondCamera:
        asked.append(around)
        view = replace(seen, times=seen.times - LATER)
        sigmas = np.full(3, 0.1), np.full(3, np.radians(2.0)), np.full(2, 0.05)
        return SecondCamera(first.video.camera, view, -LATER, 0.004, *sigmas, "look at it")

    monkeypatch.setattr(join, "find_second_camera", find)
    unsure = replace(FIRST, keypoints=replace(FIRST.video, camera=replace(FIRST.video.camera, uncertainty=UNSURE)))
    joined = join_recordings(unsure, second())
    apart = so3.angle_between(FIRST.video.camera.R_camera_world, SIDE.R_camera_world)
    axes = FIRST.video.camera.R_camera_world[2] @ SIDE.R_camera_world[2]
    assert 0 < np.arccos(axes) <= apart + 1e-9
    assert f"looking {np.degrees(np.arccos(axes)):.0f} degrees apart" in joined.notes
    assert "position ± 0.10 m, orientation ± 2.0 degrees" in joined.notes
    assert "moved by -7.300 ± 0.004 s" in joined.notes
    assert joined.notes.splitlines()[0] == "doubtful: second camera: look at it"
    assert joined.notes.splitlines()[-1].startswith("found: second camera: ")
    join_recordings(unsure, second(), synchronised=True)
    assert asked == [None, 0.0]


def test_sensors_belong_to_the_first_recording() -> None:
    T = len(TRUTH.times)
    imus = ImuSequence(TRUTH.times, np.tile(np.eye(3), (T, 1, 1, 1)), np.tile([0, 0, 9.81], (T, 1, 1)), ("a",))
    with pytest.raises(InvalidInputError, match="recording two: has sensors; give the one with sensors as the first"):
        join_recordings(FIRST, replace(second(0.0), imus=imus))
