"""The fragment solver in Cartesian space: what it minimises, reports, and does not remember."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import planted
import pytest
from cartesian_support import BODY, SMALL, SMALL_SENSORS, Inspected, Scene
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import Provenance
from rtof_kin.solve.cartesian.problem import rigid_pairs
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver, SolverStatus
from rtof_kin.solve.settings import CartesianSettings

Array = NDArray[np.float64]
N = 16
DEFAULT = CartesianSettings()
PLAIN = CartesianSettings(sigma_reprojection=8.0, refit_root=False)
"""One solver call a fragment, from the start as it is given."""


@cache
def body(set_: CartesianSettings = DEFAULT, frames: int = N) -> FragmentSolver:
    return FragmentSolver(BODY, frames, set_)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(BODY, 60)


@pytest.fixture(scope="module")
def solution(scene: Scene) -> FragmentSolution:
    return body().solve(scene.start, scene.seen, scene.imus)


def length_errors(p: Array, skeleton: SkeletonModel) -> Array:
    """(T, pairs) m"""
    rest = skeleton.forward_kinematics(skeleton.t_pose()[None])[0][0]
    a, b = np.array(rigid_pairs(skeleton.parents)).T
    true = np.linalg.norm(rest[b] - rest[a], axis=-1)
    return np.asarray(np.linalg.norm(p[:, b] - p[:, a], axis=-1) - true)


def test_exact_observations_recover_the_truth(scene: Scene) -> None:
    imus = planted.bone_imus(BODY, scene.truth.poses)
    exact = planted.keypoints(scene.truth.poses)
    still = body(replace(DEFAULT, k_S=0.0)).solve(scene.truth.poses, exact, imus)
    np.testing.assert_allclose(still.poses.p_world_joint, scene.p, atol=1e-7)
    smoothed = body().solve(scene.truth.poses, exact, imus)
    assert planted.mpjpe_mm(smoothed.poses.p_world_joint, scene.p) < 1.0


def test_errors_decrease_from_lifter_to_sf2_to_optimum(scene: Scene, solution: FragmentSolution) -> None:
    out = solution.poses.p_world_joint
    errors = [
        planted.root_relative_mm(p, scene.p) for p in (out, scene.start.p_world_joint, scene.lifted.p_world_joint)
    ]
    assert errors[0] < 0.6 * errors[1] < 0.6 * errors[2]
    absolute = [planted.mpjpe_mm(p, scene.p) for p in (out, scene.start.p_world_joint)]
    assert absolute[0] < 0.5 * absolute[1]


@pytest.mark.parametrize("settings", [CartesianSettings.paper(), PLAIN])
def test_ipopt_finds_the_same_minima(scene: Scene, settings: CartesianSettings) -> None:
    own, peer = (
        body(replace(settings, ipopt=ipopt)).solve(scene.start, scene.seen, scene.imus) for ipopt in (False, True)
    )
    assert own.count(SolverStatus.CONVERGED) == peer.count(SolverStatus.CONVERGED) == len(own.fragments)
    for a, b in zip(own.fragments, peer.fragments, strict=True):
        assert sum(a.energy.values()) == pytest.approx(sum(b.energy.values()), rel=1e-7)
        assert a.optimality < 1e-3
        assert b.optimality < 1e-6
    np.testing.assert_allclose(own.poses.p_world_joint, peer.poses.p_world_joint, atol=3e-4)


def test_uncoupled_joints_make_a_narrow_band() -> None:
    def band(settings: CartesianSettings) -> int:
        rows, columns = body(settings)._solver._problem.entries  # type: ignore[union-attr]
        return int(np.max(rows - columns))

    assert band(DEFAULT) == 3 * 3 * len(BODY.names)
    assert band(CartesianSettings.paper()) < band(DEFAULT) / 2


@pytest.mark.parametrize("sigma_px", [3.0, 7.0])
def test_estimated_sigma_is_twice_the_reprojection_error(sigma_px: float) -> None:
    truth = planted.moving(BODY, 32)
    seen, imus = planted.keypoints(truth.poses, sigma_px), planted.bone_imus(BODY, truth.poses)
    reports = body().solve(truth.poses, seen, imus).fragments
    sigmas = [r.sigma_reprojection for r in reports]
    # The fit follows some of the noise, so that the residuals are a little smaller.
    assert 0.75 * 2 * sigma_px < np.mean(sigmas) < 2 * sigma_px


def test_the_estimated_sigma_stays_in_its_range_and_a_given_one_is_kept(scene: Scene) -> None:
    start, seen, imus = scene.start[:8], scene.seen[:8], scene.imus[:8]
    narrow = replace(DEFAULT, sigma_reprojection_range=(3.0, 4.0))
    for report in body(narrow, 8).solve(start, seen, imus).fragments:
        assert report.sigma_reprojection == 4.0
    for report in body(PLAIN, 8).solve(start, seen, imus).fragments:
        assert report.sigma_reprojection == 8.0


def test_blends_are_means_or_tapered_weights_of_both_fragments() -> None:
    s = Scene(SMALL, 12)
    for as_printed in (True, False):
        solver = Inspected(SMALL, 8, replace(PLAIN, as_printed=as_printed), SMALL_SENSORS)
        out = solver.solve(s.start, s.seen, s.imus).poses.p_world_joint
        for block in range(3):
            before, after = solver.answers[block][4:], solver.answers[block + 1][:4]
            frames = out[4 * block : 4 * block + 4]
            if as_printed:
                np.testing.assert_allclose(frames, (before + after) / 2, atol=1e-12)
                continue
            share = np.sum((frames - before) * (after - before), axis=(1, 2))
            share /= np.sum((after - before) ** 2, axis=(1, 2))
            np.testing.assert_allclose(share + share[::-1], 1.0, atol=1e-9)
            assert np.all(np.diff(share) > 0)
            assert share[0] < 0.05


def test_weighted_lengths_are_kept_to_millimetres(scene: Scene, solution: FragmentSolution) -> None:
    weighted = np.abs(length_errors(solution.poses.p_world_joint, BODY))
    assert weighted.mean() < 0.002
    assert weighted.max() < 0.012
    free = body(replace(DEFAULT, as_printed=True)).solve(scene.start, scene.seen, scene.imus)
    assert np.abs(length_errors(free.poses.p_world_joint, BODY)).max() > 0.03
    assert {f.infeasibility for f in free.fragments} == {0.0}


def test_unobserved_joints_and_frames_are_bridged(scene: Scene) -> None:
    seen = planted.unseen(scene.seen, slice(20, 32))
    seen = planted.unseen(seen, slice(None), BODY.index("LeftHand", "Head"))
    out = body().solve(scene.start, seen, scene.imus).poses.p_world_joint
    assert np.isfinite(out).all()
    hand, head = BODY.index("LeftHand", "Head")
    for joint in (hand, head):
        error = np.linalg.norm(out[:, joint] - scene.p[:, joint], axis=-1).mean()
        before = np.linalg.norm(scene.start.p_world_joint[:, joint] - scene.p[:, joint], axis=-1)
        assert error < 0.6 * before.mean()
    gap, start_gap = (planted.root_relative_mm(p[20:32], scene.p[20:32]) for p in (out, scene.start.p_world_joint))
    assert gap < start_gap


def test_orientations_follow_positions_and_sensors(scene: Scene, solution: FragmentSolution) -> None:
    poses = solution.poses
    for joint in planted.LIMBS:
        (j,) = BODY.index(joint)
        child = BODY.parents.index(j)
        bone = so3.unit(poses.p_world_joint[:, child] - poses.p_world_joint[:, j])
        rest = poses.R_world_bone[:, j] @ so3.unit(BODY.joint_offsets[child])
        np.testing.assert_allclose(rest, bone, atol=1e-9)
        assert np.all(poses.provenance[:, child] == Provenance.CAMERA_AND_IMU)
    limbs = BODY.index(*planted.LIMBS)
    angles = so3.angle_between(poses.R_world_bone[:, limbs], scene.truth.poses.R_world_bone[:, limbs])
    assert np.degrees(angles.mean()) < 8


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("ipopt", [False, True])
def test_failed_fragment_returns_the_initial_poses(ipopt: bool) -> None:
    s = Scene(SMALL, 8)
    uv = np.array(s.seen.uv_px)
    uv[6] = 1e200  # its square is not a number any more
    plain = replace(PLAIN, huber_reprojection=None, ipopt=ipopt)
    solver = FragmentSolver(SMALL, 8, plain, SMALL_SENSORS)
    solution = solver.solve(s.start, replace(s.seen, uv_px=uv), s.imus)
    assert [f.status for f in solution.fragments] == [SolverStatus.CONVERGED, SolverStatus.FAILED, SolverStatus.FAILED]
    assert solution.status is SolverStatus.FAILED
    np.testing.assert_allclose(solution.poses.p_world_joint[4:], s.start.p_world_joint[4:], atol=1e-12)
