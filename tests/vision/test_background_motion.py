"""The turning of a camera from rendered backgrounds with a person in front."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.turning_video import pan_and_shake, write_turning_video
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.vision.background_motion import (
    Pair,
    bearings,
    estimate_camera_motion,
    focal_factor,
    turn_between,
    with_focal,
)

# OpenCV's wheel needs a system library that machines without a screen may lack.
cv2: Any = pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("av", exc_type=ImportError)

CAMERA = Camera.looking_at([0.0, 0, 1], [1.0, 0, 1], 400.0, 480, 270)
RATE, T = 30.0, 60
TIMES = np.arange(T) / RATE
BOXES = np.linspace([80.0, 60, 130, 240], [330.0, 60, 380, 240], T)  # a person who walks through the image
PERSON = KeypointSequence(CAMERA, TIMES, BOXES.reshape(T, 2, 2), np.ones((T, 2)), ("a", "b"))


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Array]:
    """A video of a pan with shake, and its rotations from the first frame."""
    R = pan_and_shake(np.random.default_rng(3), TIMES)
    path = tmp_path_factory.mktemp("video") / "handheld.mp4"
    write_turning_video(path, R, CAMERA, RATE, BOXES)
    return path, R[0].T @ R


def degrees_off(R: Array, R_true: Array) -> Array:
    return np.degrees(so3.angle_between(R, R_true))


def test_pan_and_shake_are_recovered(turned: tuple[Path, Array]) -> None:
    path, R_true = turned
    found = estimate_camera_motion(path, PERSON, CAMERA)
    off = degrees_off(found.motion.R_first_camera, R_true)
    assert np.degrees(found.motion.angles.max()) > 7
    assert found.known == 1
    assert off.max() < 0.1
    assert np.sqrt(np.mean(off**2) / 3) < 2 * np.degrees(found.motion.sigma) < 0.1
    assert found.camera.K[0, 0] == CAMERA.K[0, 0]
    assert found.turning().failed
    assert "did not stand still" in found.turning().message


def test_wrong_focal_length_is_refined(turned: tuple[Path, Array]) -> None:
    path, R_true = turned
    guess = replace(CAMERA, K=np.array([[460.0, 0, 240], [0, 460, 135], [0, 0, 1]]))
    found = estimate_camera_motion(path, PERSON, guess, sigma_focal=0.2)
    assert found.camera.K[0, 0] == pytest.approx(400, rel=0.02)
    assert found.motion.focal_px == found.camera.K[0, 0]
    assert found.sigma_focal < 0.03
    assert degrees_off(found.motion.R_first_camera, R_true).max() < 0.15


def test_person_who_fills_half_of_the_image_is_left_out(tmp_path: Path) -> None:
    R = pan_and_shake(np.random.default_rng(4), TIMES[:30], 4.0, 1.0)
    boxes = np.tile([120.0, 0, 360, 270], (30, 1))
    write_turning_video(tmp_path / "near.mp4", R, CAMERA, RATE, boxes)
    person = replace(PERSON[:30], uv_px=boxes.reshape(30, 2, 2) * [[[1, 1], [1, 1]]] + [[[25, 20], [-25, -20]]])
    found = estimate_camera_motion(tmp_path / "near.mp4", person, CAMERA)
    assert degrees_off(found.motion.R_first_camera, R[0].T @ R).max() < 0.1


def test_tripod_is_recognised(tmp_path: Path) -> None:
    write_turning_video(tmp_path / "tripod.mp4", np.tile(np.eye(3), (30, 1, 1)), CAMERA, RATE, BOXES)
    found = estimate_camera_motion(tmp_path / "tripod.mp4", PERSON, CAMERA, sigma_focal=0.1)
    assert found.turning().passed
    assert found.sigma_focal > 0.05  # nothing turned


def test_plain_background_and_a_camera_of_another_size_are_refused(tmp_path: Path) -> None:
    film = cv2.VideoWriter(str(tmp_path / "plain.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (480, 270))
    for _ in range(5):
        film.write(np.full((270, 480, 3), 90, np.uint8))
    film.release()
    with pytest.raises(InvalidInputError, match="too little of the background"):
        estimate_camera_motion(tmp_path / "plain.mp4", None, CAMERA)
    with pytest.raises(InvalidInputError, match="480 x 270 px, its camera 640 x 270"):
        estimate_camera_motion(tmp_path / "plain.mp4", None, replace(CAMERA, width_px=640))


CAMERA_BEARING_ROTATION = Camera.looking_at([0.0, 0, 1], [1.0, 0, 1], 500.0, 640, 360)


def pair(rng: np.random.Generator, R_a_b: np.ndarray, sigma_px: float = 0.2, count: int = 40) -> Pair:
    """Points of a distant wall in two images."""
    uv = rng.uniform([60, 40], [580, 320], (count, 2))
    b = bearings(CAMERA_BEARING_ROTATION, uv) @ R_a_b.T
    seen = b[:, :2] / b[:, 2:] * CAMERA_BEARING_ROTATION.K[0, 0] + CAMERA_BEARING_ROTATION.K[:2, 2]
    return Pair(seen + sigma_px * rng.normal(size=uv.shape), uv + sigma_px * rng.normal(size=uv.shape))


def test_rotation_is_recovered_beside_a_third_of_outliers_and_its_sigma_is_honest() -> None:
    rng = np.random.default_rng(0)
    errors, sigmas = [], []
    for _ in range(50):
        R = so3.exp(np.radians(5) * rng.normal(size=3))
        points = pair(rng, R, count=90)
        points.uv_b[:30] += rng.uniform(5, 50, (30, 2))
        a, b = (bearings(CAMERA_BEARING_ROTATION, uv) for uv in points)
        found = turn_between(a, b, 2.0 / 500, rng)
        assert found.inliers[30:].mean() > 0.9
        errors.append(so3.log(R.T @ found.R_a_b))
        sigmas.append(found.sigma)
    worst = np.sqrt(np.mean(np.square(errors), axis=0)).max()
    assert worst < np.radians(0.05)
    assert 0.5 < worst / np.mean(sigmas) < 2


@pytest.mark.parametrize("wrong", [0.8, 1.3])
def test_focal_length_follows_from_turns(wrong: float) -> None:
    rng = np.random.default_rng(1)
    pairs = [pair(rng, so3.exp(np.radians(5) * np.array([0.2, s, 0.1]))) for s in (1, -1, 0.8, -0.7)]
    factor, sigma = focal_factor(with_focal(CAMERA_BEARING_ROTATION, wrong), pairs, 0.3)
    assert factor * wrong == pytest.approx(1, abs=0.03)
    assert abs(factor * wrong - 1) < 2.5 * sigma
    assert sigma < 0.05


def test_focal_length_stays_open_without_turns() -> None:
    rng = np.random.default_rng(2)
    assert focal_factor(CAMERA_BEARING_ROTATION, [], 0.2) == (1.0, 0.2)
    still = [pair(rng, np.eye(3)) for _ in range(4)]
    factor, sigma = focal_factor(CAMERA_BEARING_ROTATION, still, 0.2)
    assert sigma > 0.1
    assert abs(factor - 1) < 0.2
