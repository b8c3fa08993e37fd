"""Pinhole camera: validation, projection, distortion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera, CameraUncertainty

Array = NDArray[np.float64]
K = np.array([[1200.0, 0, 960], [0, 1100.0, 540], [0, 0, 1]])
UPRIGHT = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""A camera that looks along world x: right is -y, down is -z."""


def pinhole(**changes: Any) -> Camera:
    return replace(Camera(K, UPRIGHT, np.zeros(3), 1920, 1080), **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": np.eye(2)}, r"K: expected shape \(3, 3\), got \(2, 2\)"),
        ({"R_camera_world": np.eye(3) * 1.1}, "R_camera_world: not a rotation"),
        ({"R_camera_world": np.diag([1.0, 1, -1])}, "R_camera_world: not a rotation"),
        ({"t_camera_world": np.zeros((3, 1))}, r"t_camera_world: expected shape \(3\), got"),
        ({"t_camera_world": np.array([0, np.nan, 0])}, "t_camera_world: not finite"),
        ({"K": K * [[0], [1], [1]]}, "K: singular; it needs positive focal lengths"),
        ({"K": K * [[1], [1], [0]]}, "K: singular.*0, 0, 1 as its last row"),
        ({"K": np.diag([np.inf, 1.0, 1.0])}, "K: not finite"),
        ({"distortion": np.zeros(4)}, r"distortion: expected shape \(5\), got \(4,\)"),
        ({"distortion": np.array([0, 0, np.nan, 0, 0])}, "distortion: not finite"),
        ({"width_px": 0}, "width_px and height_px must be positive"),
    ],
)
def test_invalid_camera_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=f"camera.*{message}"):
        pinhole(**changes)


def test_projection_divides_by_depth_with_x_right_and_y_down() -> None:
    # 4 m ahead, 1 m to the left (world +y), 0.5 m up.
    np.testing.assert_allclose(pinhole().project([4.0, 1.0, 0.5]), [960 - 300, 540 - 137.5])


def test_camera_looking_at_a_point_is_upright_and_centred() -> None:
    camera = Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 1.0], 1000.0, 640, 480)
    np.testing.assert_allclose(camera.project([0.0, 0.0, 1.0]), [320, 240])
    np.testing.assert_allclose(camera.center_world, [4, 1, 1.5])
    above = camera.project([0.0, 0.0, 1.2])
    assert above[0] == pytest.approx(320)
    assert above[1] < 240
    assert camera.to_camera([0.0, 0.0, 1.0])[2] == pytest.approx(np.sqrt(17.25))


def test_points_behind_the_camera_are_nan() -> None:
    uv = pinhole().project([[1.0, 0, 0], [-1.0, 0, 0], [0.0, 1, 0], [np.nan, 0, 0]])
    np.testing.assert_array_equal(np.isnan(uv).all(axis=-1), [False, True, True, True])


@pytest.mark.parametrize("distortion", [np.zeros(5), np.array([-0.28, 0.08, 0.001, -0.0015, -0.01])])
def test_rays_pass_through_the_projected_points(camera: Camera, distortion: Array) -> None:
    camera = replace(camera, distortion=distortion)
    p = np.random.default_rng(0).uniform([-0.8, -0.8, 0.2], [0.8, 0.8, 1.8], (7, 9, 3))
    rays = camera.rays_world(camera.project(p))
    np.testing.assert_allclose(rays, so3.unit(p - camera.center_world), atol=1e-9)
    xy = camera.normalise(camera.project(p))
    ideal = camera.undistorted()
    np.testing.assert_allclose(ideal.project(p), xy @ ideal.K[:2, :2].T + ideal.K[:2, 2])


def test_distortion_is_the_formula_of_opencv() -> None:
    k1, k2, p1, p2, k3 = distortion = np.array([-0.3, 0.1, 0.002, -0.001, 0.02])
    camera = Camera(np.eye(3), np.eye(3), np.zeros(3), 10, 10, distortion)
    x, y = 0.3, -0.2
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y]
    np.testing.assert_allclose(camera.project([2 * x, 2 * y, 2.0]), expected)


@pytest.mark.parametrize("name", ["focal", "tilt", "height", "k1"])
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_an_uncertainty_is_a_standard_deviation(name: str, value: float) -> None:
    with pytest.raises(InvalidInputError, match=f"camera uncertainty {name}.*no standard deviation"):
        CameraUncertainty(**{name: value})


def test_a_camera_is_carried_along_with_another_ones_correction() -> None:
    first = Camera.looking_at([4.0, 0.6, 1.5], [0.0, 0.0, 1.0], 1250.0)
    second = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], 900.0)
    moved = Camera.looking_at([3.0, 1.0, 2.0], [0.2, 0.0, 1.1], 1250.0)
    carried = second.carried(first, moved)
    p = np.random.default_rng(0).normal(size=(5, 3)) + np.array([0.0, 0.0, 1.0])
    same = (first.to_camera(p) - moved.t_camera_world) @ moved.R_camera_world  # as the first camera sees it
    np.testing.assert_allclose(carried.project(same), second.project(p), atol=1e-8)
