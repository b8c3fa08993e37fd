"""Every kind of unknown: derivatives against finite differences."""

from __future__ import annotations

from dataclasses import replace

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.calibration.shared_fragments import SharedFragments
from rtof_kin.data.keypoints import detector_point
from rtof_kin.vision.image_points import detector_points, image_points

Array = NDArray[np.float64]
T = 24


def open_fragments(*kinds: str) -> SharedFragments:
    truth = cs.motion(T)
    recording = planted.recording(truth, sigma_px=4.0, degrees=4.0)
    if "place" in kinds:  # which joints do not have
        names = tuple(detector_point("mediapipe33", point) for point in detector_points("mediapipe33"))
        p, R = truth.poses.p_world_joint, truth.poses.R_world_bone
        uv = recording.video.camera.project(image_points(cs.BODY, names).positions(p, R))
        uv = uv + planted.smooth_noise(3, uv.shape, 5, 4.0)
        seen = replace(recording.video, uv_px=uv, confidence=np.ones(uv.shape[:2]), names=names)
        recording = replace(recording, keypoints=seen)
    return cs.fragments(recording, truth.poses, cs.only(*kinds))


def some_unknowns(shared: SharedFragments, size: float = 0.5) -> Array:
    root = np.linalg.cholesky(np.linalg.inv(shared.prior))
    return np.asarray(size * root @ np.random.default_rng(4).normal(size=len(root)))


def energy(shared: SharedFragments, y: Array, first: int, x: Array) -> float:
    problem = shared.bound(shared.corrected(y), first)
    return problem.total(x.copy())


def by_differences(shared: SharedFragments, y: Array, first: int, x: Array) -> Array:
    step = 1e-3 * np.sqrt(np.diag(np.linalg.inv(shared.prior)))
    return np.array(
        [(energy(shared, y + e, first, x) - energy(shared, y - e, first, x)) / (2 * e.sum()) for e in np.diag(step)]
    )


@pytest.mark.parametrize("kind", [k for k in cs.OPEN if k != "delay"])
def test_gradient_of_each_kind_equals_finite_differences(kind: str) -> None:
    shared = open_fragments(kind)
    shared.begin()
    y = some_unknowns(shared)
    x = shared.states(0)
    gradient = shared.unknowns_hessian(shared.corrected(y), 0, x, y).gradient
    numeric = by_differences(shared, y, 0, x)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


def test_gradient_by_a_delay_approximates_finite_differences() -> None:
    """Samples in between are interpolated: the two agree to their curvature."""
    shared = open_fragments("delay")
    shared.begin()
    y = np.array([0.004])
    x = shared.states(0)
    gradient = shared.unknowns_hessian(shared.corrected(y), 0, x, y).gradient
    numeric = by_differences(shared, y, 0, x)
    np.testing.assert_allclose(gradient, numeric, rtol=0.3, atol=0.3 * np.abs(numeric).max())


def test_hessian_equals_finite_differences_for_zero_residuals() -> None:
    """With exact data the Gauss-Newton Hessian is the Hessian."""
    truth = cs.motion(T)
    recording = planted.recording(truth)
    kinds = [k for k in cs.OPEN if k != "delay"]
    shared = cs.fragments(recording, truth.poses, cs.only(*kinds))
    shared.begin()
    space, y = shared.data.space, np.zeros(len(shared.prior))
    x = space.from_poses(truth.poses.p_world_joint[:12, 0], truth.poses.R_world_bone[:12])
    border = shared.unknowns_hessian(shared.corrected(y), 0, x, y)
    rng = np.random.default_rng(1)
    direction = np.sqrt(np.diag(np.linalg.inv(shared.prior))) * rng.normal(size=len(y)) * 1e-4

    def gradients(y: Array) -> tuple[Array, Array]:
        evidence = shared.corrected(y)
        by_y = shared.unknowns_hessian(evidence, 0, x, y).gradient
        return shared.bound(evidence, 0).gradient(x), by_y

    (x_up, y_up), (x_down, y_down) = gradients(direction), gradients(-direction)
    expected, expected_y = border.columns @ direction, border.corner @ direction
    np.testing.assert_allclose((x_up - x_down) / 2, expected, atol=1e-2 * np.abs(expected).max())
    np.testing.assert_allclose((y_up - y_down) / 2, expected_y, atol=3e-3 * np.abs(expected_y).max())


def test_white_errors_close_the_prior_of_biases() -> None:
    shared = open_fragments("image bias", "mounting")
    mounting, bias = shared.unknowns
    assert mounting.limited(0.0) is mounting
    assert np.sqrt(np.diag(bias.limited(0.0).covariance)).max() < 0.1
    assert np.sqrt(np.diag(bias.limited(2.0).covariance)).max() == pytest.approx(2.0)
    np.testing.assert_array_equal(bias.limited(50.0).covariance, bias.covariance)
