"""The bundle adjustment of two cameras: derivatives, and a planted camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.setup.second_camera import DELAY, FOCAL, MOVE, SIZE, TURN, Adjusted, BundleSettings, Images, adjust

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
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
