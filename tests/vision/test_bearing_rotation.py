"""Rotation and focal length from points of two images."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.vision.background_motion import Pair, bearings, focal_factor, turn_between, with_focal

CAMERA = Camera.looking_at([0.0, 0, 1], [1.0, 0, 1], 500.0, 640, 360)


def pair(rng: np.random.Generator, R_a_b: np.ndarray, sigma_px: float = 0.2, count: int = 40) -> Pair:
    """Points of a distant wall in two images."""
    uv = rng.uniform([60, 40], [580, 320], (count, 2))
    b = bearings(CAMERA, uv) @ R_a_b.T
    seen = b[:, :2] / b[:, 2:] * CAMERA.K[0, 0] + CAMERA.K[:2, 2]
    return Pair(seen + sigma_px * rng.normal(size=uv.shape), uv + sigma_px * rng.normal(size=uv.shape))


def test_rotation_is_recovered_beside_a_third_of_outliers_and_its_sigma_is_honest() -> None:
    rng = np.random.default_rng(0)
    errors, sigmas = [], []
    for _ in range(50):
        R = so3.exp(np.radians(5) * rng.normal(size=3))
        points = pair(rng, R, count=90)
        points.uv_b[:30] += rng.uniform(5, 50, (30, 2))
        a, b = (bearings(CAMERA, uv) for uv in points)
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
    factor, sigma = focal_factor(with_focal(CAMERA, wrong), pairs, 0.3)
    assert factor * wrong == pytest.approx(1, abs=0.03)
    assert abs(factor * wrong - 1) < 2.5 * sigma
    assert sigma < 0.05


def test_focal_length_stays_open_without_turns() -> None:
    rng = np.random.default_rng(2)
    assert focal_factor(CAMERA, [], 0.2) == (1.0, 0.2)
    still = [pair(rng, np.eye(3)) for _ in range(4)]
    factor, sigma = focal_factor(CAMERA, still, 0.2)
    assert sigma > 0.1
    assert abs(factor - 1) < 0.2
