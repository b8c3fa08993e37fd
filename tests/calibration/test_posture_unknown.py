"""The neutral posture as an unknown."""

from __future__ import annotations

from dataclasses import replace

import calibration_support as cs
import numpy as np
import planted
import pytest

from rtof_kin.body.pose_prior import CLAVICLES, HIPS, JOINTS, SPINE, NeutralPosture
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core import rotations as so3

PRIOR = cs.BODY.table.prior
TURNS = {joint: 0.1 * np.random.default_rng(i).normal(size=3) for i, joint in enumerate(JOINTS)}


def test_gradient_equals_finite_differences() -> None:
    truth = cs.motion(24)
    recording = planted.recording(truth, sigma_px=3.0, degrees=3.0)
    shared = cs.fragments(recording, truth.poses, cs.only("mounting", sigma_posture=0.1))
    shared.begin()
    y, x = 0.1 * np.random.default_rng(0).normal(size=len(shared.prior)), shared.states(0)
    gradient = shared.unknowns_hessian(shared.corrected(y), 0, x, y).gradient

    def energy(y: np.ndarray) -> float:
        return shared.bound(shared.corrected(y), 0).total(x.copy())

    numeric = [(energy(y + e) - energy(y - e)) / 2e-4 for e in 1e-4 * np.eye(len(y))]
    np.testing.assert_allclose(gradient, numeric, atol=1e-6 * np.abs(numeric).max())
    own = shared.columns[-1]
    assert np.abs(gradient[own]).max() > 0


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
