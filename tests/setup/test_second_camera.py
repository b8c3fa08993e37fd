"""A second camera planted beside a recording: found with a planted lifter, told on, refused."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.setup import second_camera
from rtof_kin.setup.second_camera import SecondCamera, find_second_camera

BODY = SkeletonModel.default()
TRUTH = planted.moving(BODY, 240, radians=0.5)
SIDE = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], focal_px=1100.0)
HEADING, LATER = 1.2, 7.3
TILT = np.array([0.04, 0.0, -0.03])


LIFTER: Any = planted.PlantedLifter(TRUTH)
LIFTER.times = TRUTH.times + LATER
R_OWN = so3.about_axis("z", HEADING)
LIFTER.p = (planted.lifted(TRUTH, radians=0.1, seed=30) - SIDE.center_world * [1.0, 1.0, 0.0]) @ R_OWN.T
"""Lifts the second video in its own world, over whose origin its camera stands."""


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first camera alone gives the motion with small errors, and is not solved for each test."""
    p = planted.lifted(TRUTH, radians=0.05, metres=0.05, seed=40)

    def reconstruct(given: Recording, **_: object) -> SimpleNamespace:
        motion = SimpleNamespace(poses=replace(TRUTH.poses, p_world_joint=p))
        return SimpleNamespace(keypoints=given.keypoints, motion=motion)

    monkeypatch.setattr(second_camera, "reconstruct", reconstruct)


def second() -> KeypointSequence:
    """What the second camera sees, in a world and on a clock of its own, tilted a little wrongly."""
    uv = SIDE.project(TRUTH.poses.p_world_joint)
    uv += 3.0 * np.random.default_rng(2).normal(size=uv.shape)
    R = so3.exp(TILT) @ SIDE.R_camera_world @ R_OWN.T
    camera = replace(SIDE, R_camera_world=R, t_camera_world=-R @ np.array([0.0, 0.0, 1.2]))
    return KeypointSequence(camera, TRUTH.times + LATER, uv, np.ones(uv.shape[:2]), BODY.names)


def recording(**changes: object) -> Recording:
    """The first camera, without sensors."""
    made = Recording("one", planted.keypoints(TRUTH.poses, 3.0))
    return replace(made, **changes)  # type: ignore[arg-type]


@pytest.fixture
def found() -> SecondCamera:
    return find_second_camera(recording(), second(), LIFTER)


def test_the_planted_camera_is_found_within_a_few_stated_sigmas(found: SecondCamera) -> None:
    camera = found.view.camera
    turn = so3.log(SIDE.R_camera_world.T @ camera.R_camera_world)
    assert np.degrees(np.linalg.norm(turn)) < 4.0
    assert np.all(np.abs(turn) < 4 * found.sigma_turn)
    moved = camera.center_world - SIDE.center_world
    assert np.linalg.norm(moved) < 0.5
    assert np.all(np.abs(moved) < 4 * found.sigma_position)
    assert found.offset == pytest.approx(-LATER, abs=0.015)
    np.testing.assert_allclose(found.view.times, TRUTH.times, atol=0.015)
    assert found.doubt == ""
    assert any("second camera" in words for words in camera.assumed)


def test_it_becomes_a_view_of_the_recording(found: SecondCamera) -> None:
    with_view = found.apply(recording())
    assert with_view.views == (found.view,)
    assert with_view.video.camera is found.first
    np.testing.assert_array_equal(with_view.video.uv_px, recording().video.uv_px)


def test_priors_are_those_that_the_cameras_state(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(second_camera, "adjust", lambda *given: asked.append(given[-1]) or 1 / 0)
    other = second()
    known = replace(other.camera, uncertainty=CameraUncertainty(focal=0.0, tilt=0.05))
    with pytest.raises(ZeroDivisionError):
        find_second_camera(recording(), replace(other, camera=known), LIFTER)
    assert asked[0].sigma_focal == (0.1, 0.0)
    assert asked[0].sigma_tilt == pytest.approx(0.05)


def test_cameras_that_never_see_the_person_together_are_refused() -> None:
    first = recording().video
    hidden = planted.unseen(first, slice(100, None), slice(3, None))
    with pytest.raises(CalibrationError, match="together in"):
        find_second_camera(recording(keypoints=hidden), planted.unseen(second(), slice(0, 100), slice(3, None)), LIFTER)
