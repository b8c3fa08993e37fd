"""A second camera planted beside a recording: found with a planted lifter, told on, refused."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration import second_camera
from rtof_kin.calibration.second_camera import (
    DELAY,
    FOCAL,
    MOVE,
    SIZE,
    TURN,
    Adjusted,
    BundleSettings,
    Images,
    SecondCamera,
    adjust,
)
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.setup import join
from rtof_kin.setup.join import find_second_camera

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

    monkeypatch.setattr(join, "reconstruct", reconstruct)


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
    return replace(made, **changes)


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


Array = NDArray[np.float64]
NAMES = ("Head", "LeftArm", "LeftForeArm", "LeftHand", "RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg")
BONES = ((1, 2), (2, 3), (4, 5), (5, 6))
SECOND = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], focal_px=1100.0)
SETTINGS = BundleSettings()


def truth(frames: int = 60) -> Array:
    """(F, n, 3) joints of a person who also walks about."""
    p = planted.moving(BODY, 10 * frames, radians=0.5).poses.p_world_joint[::10][:, BODY.index(*NAMES)]
    return np.asarray(p + 0.5 * planted.smooth_noise(3, (frames, 1, 3), 8, 1.0) * [1.0, 1.0, 0.1])


def images(p: Array, sigma_px: float = 0.0, shape_m: float = 0.0, shapes_turned: float = 0.0) -> Images:
    rng = np.random.default_rng(0)
    uv = np.stack([camera.project(p) for camera in (planted.camera(), SECOND)])
    shapes = np.stack([p, p @ so3.exp([0.0, 0.0, shapes_turned]).T])
    return Images(
        uv_px=uv + sigma_px * rng.normal(size=uv.shape),
        weight=np.ones(uv.shape[:-1]),
        drift=np.gradient(uv[1], 0.1, axis=0),
        bones=[(a, b, float(np.linalg.norm(p[0, a] - p[0, b]))) for a, b in BONES],
        shapes=shapes + shape_m * rng.normal(size=shapes.shape),
    )


def wrong(camera: Camera, turn: Array, move: Array, focal: float) -> Camera:
    R = camera.R_camera_world @ so3.exp(-turn)
    K = camera.K * np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])
    return replace(camera, K=K, R_camera_world=R, t_camera_world=-R @ (camera.center_world + move))


OFF = np.array([0.03, -0.04, 0.25]), np.array([0.5, -0.4, 0.2])


def adjusted(seen: Images, p: Array, **changes: Any) -> Adjusted:
    start = p + 0.1 * np.random.default_rng(1).normal(size=p.shape)
    cameras = planted.camera(), wrong(SECOND, *OFF, 1.08)
    return adjust(cameras, seen, start, replace(SETTINGS, **changes))


def test_a_planted_camera_is_found_from_exact_images() -> None:
    p = truth()
    seen = images(p)
    # The shape is told in the axes of the camera's start.
    seen = replace(seen, shapes=np.stack([p, p @ so3.exp(OFF[0]).T]))
    found = adjusted(seen, p, sigma_tilt=1.0, sigma_focal=(1e-6, 5.0))
    camera = found.cameras[1]
    assert so3.angle_between(camera.R_camera_world, SECOND.R_camera_world) < 2e-3
    np.testing.assert_allclose(camera.center_world, SECOND.center_world, atol=0.02)
    assert camera.K[0, 0] == pytest.approx(1100.0, rel=5e-3)
    assert found.x[DELAY] == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(found.p_world_joint, p, atol=0.02)


def test_noise_is_stated_in_the_covariance() -> None:
    p, errors = truth(30), []
    for seed in range(5):
        seen = images(p)
        rng = np.random.default_rng(seed)
        seen = replace(
            seen,
            uv_px=seen.uv_px + 0.006 * 1200 * rng.normal(size=seen.uv_px.shape),
            shapes=np.stack([p, p @ so3.exp(OFF[0]).T]) + 0.06 * rng.normal(size=seen.shapes.shape),
        )
        found = adjusted(seen, p, sigma_tilt=1.0, sigma_focal=(1e-6, 0.1))
        sigma = np.sqrt(np.diag(found.covariance))
        error = found.cameras[1].center_world - SECOND.center_world
        errors.append(error / sigma[MOVE])
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 2.0


def test_a_known_focal_length_stays() -> None:
    p = truth(30)
    found = adjusted(images(p, 5.0, 0.03), p, sigma_focal=(0.0, 0.0))
    assert found.x[FOCAL] == pytest.approx(0.0, abs=1e-4)


def test_the_delay_of_the_second_video_is_found() -> None:
    p, late = truth(), 0.02
    seen = images(p)
    seen = replace(
        seen,
        uv_px=seen.uv_px - late * np.stack([0 * seen.drift, seen.drift]),
        shapes=np.stack([p, p @ so3.exp(OFF[0]).T]),
    )
    found = adjusted(seen, p, sigma_tilt=1.0)
    assert found.x[DELAY] == pytest.approx(late, abs=2e-3)


def test_unseen_joints_do_not_count() -> None:
    p = truth(40)
    seen, blind = images(p, 3.0, 0.02), np.random.default_rng(4).random((2, 40, len(NAMES))) < 0.3
    spoilt = replace(seen, weight=np.where(blind, 0.0, seen.weight), uv_px=np.where(blind[..., None], 1e4, seen.uv_px))
    zeroed = replace(spoilt, uv_px=np.where(blind[..., None], 0.0, spoilt.uv_px))
    np.testing.assert_allclose(adjusted(spoilt, p).x, adjusted(zeroed, p).x, atol=1e-9)


def test_more_frames_and_independent_ones_are_surer() -> None:
    seen = [images(p, 5.0, 0.03) for p in (truth(20), truth(60))]
    few, many = (np.diag(adjusted(s, p).covariance) for s, p in zip(seen, (truth(20), truth(60)), strict=True))
    assert np.all(many[TURN] < few[TURN])
    as_one = np.diag(adjusted(seen[1], truth(60), frames_as_one=10.0).covariance)
    assert np.all(as_one[MOVE] > many[MOVE])
    assert as_one[SIZE] <= BundleSettings().sigma_size ** 2 * (1 + 1e-9)
