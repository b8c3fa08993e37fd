"""Every kind of unknown: derivatives against finite differences."""

from __future__ import annotations

from dataclasses import replace

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.pose_prior import CLAVICLES, HIPS, JOINTS, SPINE, NeutralPosture
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.calibration.shared_fragments import SharedFragments
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
T = 24


def open_fragments(*kinds: str) -> SharedFragments:
    truth = cs.motion(T)
    recording = planted.recording(truth, sigma_px=4.0, degrees=4.0)
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
    kinds = [k for k in cs.OPEN if k not in ("delay", "posture")]
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
    np.testing.assert_allclose((y_up - y_down) / 2, expected_y, atol=2e-3 * np.abs(expected_y).max())


def test_white_errors_close_the_prior_of_biases() -> None:
    shared = open_fragments("image bias", "mounting")
    mounting, bias = shared.unknowns
    assert mounting.limited(0.0) is mounting
    assert np.sqrt(np.diag(bias.limited(0.0).covariance)).max() < 0.1
    assert np.sqrt(np.diag(bias.limited(2.0).covariance)).max() == pytest.approx(2.0)
    np.testing.assert_array_equal(bias.limited(50.0).covariance, bias.covariance)


PRIOR = cs.BODY.table.prior
TURNS = {joint: 0.1 * np.random.default_rng(i).normal(size=3) for i, joint in enumerate(JOINTS)}


def test_hessian_by_states_equals_finite_differences_at_the_means() -> None:
    truth = cs.motion(24)
    shared = cs.fragments(planted.recording(truth), truth.poses, cs.only(sigma_posture=0.1))
    shared.begin()
    space, y = shared.data.space, np.zeros(len(shared.prior))
    x = space.from_poses(truth.poses.p_world_joint[:12, 0], truth.poses.R_world_bone[:12])
    space.rotations(x)[:, 1:] = shared.data.constant["quat_mean"].T
    direction = 1e-4 * np.random.default_rng(1).normal(size=len(y))
    border = shared.unknowns_hessian(shared.corrected(y), 0, x, y)
    up, down = (shared.bound(shared.corrected(s * direction), 0).gradient(x.copy()) for s in (1, -1))
    expected = border.columns @ direction
    np.testing.assert_allclose((up - down) / 2, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("joints", [SPINE, CLAVICLES, HIPS])
def test_moved_means_are_those_about_the_moved_posture(joints: tuple[str, ...]) -> None:
    turns = {joint: TURNS[joint] for joint in joints}
    R = so3.exp(0.2 * np.random.default_rng(9).normal(size=(len(joints), 3)))
    posture = NeutralPosture(joints, so3.to_quat_wxyz(R))
    other = replace(posture, quat_wxyz=so3.to_quat_wxyz(so3.exp(np.array(list(turns.values()))) @ R))
    moved = so3.from_quat_wxyz(PRIOR.about(posture).moved(turns).mean_quat_wxyz)
    np.testing.assert_allclose(moved, so3.from_quat_wxyz(PRIOR.about(other).mean_quat_wxyz), atol=1e-9)


def test_a_calibration_moves_the_means_of_a_recording() -> None:
    recording = planted.recording(cs.motion(12))
    sigma = np.full(3, 0.01)
    found = SelfCalibration(tuple(Quantity("posture", j, turn, sigma, 10 * sigma, 0.99) for j, turn in TURNS.items()))
    expected = so3.from_quat_wxyz(PRIOR.moved(TURNS).mean_quat_wxyz)

    def mean(given: object) -> np.ndarray:
        return so3.from_quat_wxyz(found.apply(given).skeleton.table.prior.mean_quat_wxyz)

    np.testing.assert_allclose(mean(recording), expected, atol=1e-9)
    R = so3.exp(0.2 * np.random.default_rng(9).normal(size=(len(JOINTS), 3)))
    told = NeutralPosture(JOINTS, so3.to_quat_wxyz(R))
    about = so3.from_quat_wxyz(PRIOR.about(told).moved(TURNS).mean_quat_wxyz)
    np.testing.assert_allclose(mean(replace(recording, posture=told)), about, atol=1e-9)
