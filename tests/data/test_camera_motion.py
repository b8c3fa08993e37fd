"""Keypoints of a camera that turns, mapped to one that stands still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.data.keypoints import KeypointSequence

T = 30
TIMES = np.arange(T) / 30
STILL = replace(Camera.looking_at([4.0, 1.0, 1.5], [0, 0, 1.0], 1100.0), distortion=[0.05, -0.02, 0.001, 0, 0])
POINTS = np.random.default_rng(0).uniform([-0.5, -0.5, 0], [0.5, 0.5, 1.8], (T, 6, 3))


def turning(degrees: float = 15.0) -> CameraMotion:
    """A pan with some roll."""
    swing = np.radians(degrees) * np.sin(2 * np.pi * TIMES)[:, None]
    return CameraMotion(TIMES, so3.exp(swing * [0.1, 1.0, 0.3]))


def filmed(motion: CameraMotion) -> KeypointSequence:
    """What the camera sees whose mean orientation is that of `STILL`."""
    uv = []
    for R, points in zip(motion.R_first_camera, POINTS, strict=True):
        R_still_camera = motion.R_first_still.T @ R
        turned = replace(
            STILL,
            R_camera_world=R_still_camera.T @ STILL.R_camera_world,
            t_camera_world=R_still_camera.T @ STILL.t_camera_world,
        )
        uv.append(turned.project(points))
    names = tuple("abcdef")
    return KeypointSequence(STILL, TIMES, np.array(uv), np.ones((T, 6)), names)


def test_stabilised_points_are_those_of_a_camera_without_distortion_that_stands_still() -> None:
    keypoints = stabilised(filmed(turning()), turning())
    assert keypoints.camera.stabilised
    assert not np.any(keypoints.camera.distortion)
    np.testing.assert_allclose(keypoints.camera.R_camera_world, STILL.R_camera_world)
    np.testing.assert_allclose(keypoints.uv_px, STILL.undistorted().project(POINTS), atol=1e-3)


def test_rotations_are_interpolated_to_the_times_of_the_keypoints() -> None:
    fine = np.linspace(0, 1, 400)
    swing = np.radians(15.0) * np.sin(2 * np.pi * fine)[:, None] * [0, 1.0, 0]
    coarse = CameraMotion(fine, so3.exp(swing))
    motion = CameraMotion(TIMES, so3.exp(np.radians(15.0) * np.sin(2 * np.pi * TIMES)[:, None] * [0, 1.0, 0]))
    expected, found = stabilised(filmed(motion), motion), stabilised(filmed(motion), coarse)
    relative = coarse.R_first_still.T @ motion.R_first_still  # their means differ a little
    rays = [so3.unit(k.camera.rays_world(k.uv_px) @ STILL.R_camera_world.T) for k in (expected, found)]
    np.testing.assert_allclose(rays[0] @ relative.T, rays[1], atol=1e-4)


def test_points_without_a_rotation_or_far_from_the_axis_are_missing() -> None:
    motion = turning()
    R = motion.R_first_camera.copy()
    R[5:20] = np.nan  # half a second
    gone = stabilised(filmed(motion), CameraMotion(TIMES, R)).seen
    assert not gone[6:19].any()
    assert gone[:5].all()
    assert gone[20:].all()
    away = stabilised(filmed(turning(5)), turning(80)).seen
    assert not away[7].any()
    assert away[0].all()


def test_measured_gravity_replaces_the_tilt_and_keeps_heading_and_place() -> None:
    wrong = so3.exp(np.radians([6.0, 0.0, -4.0])) @ STILL.R_camera_world
    declared = replace(STILL, R_camera_world=wrong, t_camera_world=-wrong @ STILL.center_world)
    motion = turning()
    up = motion.R_first_still @ STILL.R_camera_world[:, 2]
    keypoints = stabilised(replace(filmed(motion), camera=declared), replace(motion, up_first=up))
    camera = keypoints.camera
    np.testing.assert_allclose(camera.R_camera_world[:, 2], STILL.R_camera_world[:, 2], atol=1e-12)
    np.testing.assert_allclose(camera.center_world, STILL.center_world, atol=1e-12)
    assert np.degrees(so3.angle_between(camera.R_camera_world, STILL.R_camera_world)) < 1.0  # of 7 before


def test_angles_are_from_the_mean_orientation() -> None:
    assert np.degrees(turning(15.0).angles.max()) == pytest.approx(15.0 * np.linalg.norm([0.1, 1, 0.3]), rel=0.02)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"sigma": -1.0}, "no standard deviation"),
        ({"focal_px": 0.0}, "not positive"),
        ({"up_first": [0, 0, 2.0]}, "not a unit vector"),
        ({"R_first_camera": np.full((T, 3, 3), np.nan)}, "no rotation is known"),
        ({"R_first_camera": np.tile(2 * np.eye(3), (T, 1, 1))}, "R_first_camera"),
    ],
)
def test_nonsense_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        replace(turning(), **changes)  # type: ignore[arg-type]
