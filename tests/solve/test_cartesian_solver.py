"""The fragment solver in Cartesian space: what it minimises, reports, and does not remember."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import SolverError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.solve.cartesian.problem import TERMS, rigid_pairs
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import FragmentReport, FragmentSolution, FragmentSolver, SolverStatus
from rtof_kin.solve.inertial_ik import InertialGuidedIK

Array = NDArray[np.float64]
BODY, SMALL = SkeletonModel.default(), SkeletonModel.human36m()
SMALL_SENSORS = ("LElbow", "RKnee", "LHip", "Hip")
N = 16
DEFAULT = CartesianSettings()
PLAIN = CartesianSettings(sigma_reprojection=8.0, refit_root=False)
"""One solver call a fragment, from the start as it is given."""


class Inspected(FragmentSolver):
    """A solver that keeps the answer of each fragment before they are blended."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.answers: list[Array] = []
        solver: Any = self._solver
        solve = solver._solve_fragment

        def kept(*arguments: Any) -> tuple[Array, FragmentReport]:
            X, report = solve(*arguments)
            self.answers.append(X)
            return X, report

        solver._solve_fragment = kept


@cache
def body(set_: CartesianSettings = DEFAULT, frames: int = N) -> FragmentSolver:
    return FragmentSolver(BODY, frames, set_)


class Scene:
    """A motion, what was observed of it, and poses to start from."""

    def __init__(self, skeleton: SkeletonModel, frames: int, sigma_px: float = 4.0, seed: int = 0) -> None:
        joints = planted.LIMBS if skeleton is BODY else SMALL_SENSORS
        self.truth: MotionSequence = planted.moving(skeleton, frames, seed)
        self.seen = planted.keypoints(self.truth.poses, sigma_px)
        self.imus = planted.bone_imus(skeleton, self.truth.poses, joints, 4.0, 0.4)
        self.lifted = planted.lifted_poses(self.truth)
        self.start = InertialGuidedIK(skeleton).refine(self.lifted, self.imus)

    @property
    def p(self) -> Array:
        return self.truth.poses.p_world_joint

    def part(self, frames: slice) -> tuple[PoseSequence, KeypointSequence, BoneImuSequence]:
        return self.start[frames], self.seen[frames], self.imus[frames]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(BODY, 60)


@pytest.fixture(scope="module")
def solution(scene: Scene) -> FragmentSolution:
    return body().solve(scene.start, scene.seen, scene.imus)


def jerk_error(p: Array, p_true: Array) -> float:
    """m/s^3"""
    third = np.diff(p - p_true, n=3, axis=0) * planted.RATE_HZ**3
    return float(np.linalg.norm(third, axis=-1).mean())


def length_errors(p: Array, skeleton: SkeletonModel) -> Array:
    """(T, pairs) m"""
    rest = skeleton.forward_kinematics(skeleton.t_pose()[None])[0][0]
    a, b = np.array(rigid_pairs(skeleton.parents)).T
    true = np.linalg.norm(rest[b] - rest[a], axis=-1)
    return np.asarray(np.linalg.norm(p[:, b] - p[:, a], axis=-1) - true)


# --- what is minimised ---------------------------------------------------------------------------


def numeric_gradient(residuals: Callable[[Array], dict[str, Array]], x: Array) -> Array:
    """Central differences of the sum of squares."""

    def total(x: Array) -> float:
        return sum(float(np.sum(r**2)) for r in residuals(x).values())

    steps = np.eye(len(x)) * 1e-5
    return np.array([(total(x + step) - total(x - step)) / 2e-5 for step in steps])


def documented(
    scene: Scene, set_: CartesianSettings, frames: int, part: slice = slice(None)
) -> Callable[[Array], dict[str, Array]]:
    """x -> residuals of the frames of one fragment that lie inside the recording."""
    start, seen, imus = scene.part(part)

    def residuals(x: Array) -> dict[str, Array]:
        X = x.reshape(len(start), -1, 3)
        return planted.documented_residuals(X, start, seen, imus, SMALL, set_, frames, sigma_px=8.0)

    return residuals


@pytest.mark.parametrize("change, max_iterations", [
    ({}, 60),
    ({"prior": "positions", "huber_reprojection": None, "k_V": 0.3, "k_S": 0.1, "k_I": 0.9}, 2),
])  # fmt: skip
def test_every_report_is_the_documented_energy_and_its_true_gradient(
    change: dict[str, Any], max_iterations: int
) -> None:
    s = Scene(SMALL, 12)
    confidence = np.random.default_rng(0).uniform(0.2, 1.0, s.seen.confidence.shape)
    s.seen = planted.unseen(replace(s.seen, confidence=confidence), slice(2, 6), [3, 4])
    R = np.array(s.imus.R_world_bone)
    R[7, 1] = np.nan
    s.imus = replace(s.imus, R_world_bone=R)
    set_ = replace(PLAIN, **change, max_iterations=max_iterations)
    solver = Inspected(SMALL, 8, set_, SMALL_SENSORS)
    reports = solver.solve(s.start, s.seen, s.imus).fragments
    assert [report.first_frame for report in reports] == [-4, 0, 4, 8]
    for report, answer in zip(reports, solver.answers, strict=True):
        part = slice(max(report.first_frame, 0), min(report.first_frame + 8, 12))
        x = answer[part.start - report.first_frame : part.stop - report.first_frame].ravel()
        residuals = documented(s, set_, 8, part)
        energy = {term: float(np.sum(r**2)) for term, r in residuals(x).items()}
        assert report.energy == pytest.approx(energy, rel=1e-8, abs=1e-12)
        gradient = np.abs(numeric_gradient(residuals, x)).max()
        assert report.optimality == pytest.approx(gradient, rel=1e-4, abs=2e-6)
        stopped = SolverStatus.ITERATION_LIMIT if max_iterations == 2 else SolverStatus.CONVERGED
        assert report.status is stopped
        assert (report.optimality < 5e-6) == (max_iterations == 60)


@pytest.mark.parametrize("bone_lengths, off", [("free", None), ("weighted", 0.005)])
def test_scipy_reaches_the_same_minimum(bone_lengths: str, off: float | None) -> None:
    # Four frames in N = 8: either fragment holds them all, and padding is coupled to nothing. With
    # lengths there are several minima (a bone may lean to or from the camera): SciPy starts near.
    s, set_ = Scene(SMALL, 4), replace(PLAIN, bone_lengths=bone_lengths)
    solution = FragmentSolver(SMALL, 8, set_, SMALL_SENSORS).solve(s.start, s.seen, s.imus)
    x, residuals = solution.poses.p_world_joint.ravel(), documented(s, set_, 8)
    x0 = s.start.p_world_joint.ravel()
    assert np.abs(x - x0).max() > 0.02
    if off is not None:
        x0 = x + off * np.random.default_rng(0).normal(size=x.shape)

    def stacked(x: Array) -> Array:
        return np.concatenate([r.ravel() for r in residuals(x).values()])

    peer = least_squares(stacked, x0, ftol=1e-10)
    for report in solution.fragments:
        assert sum(report.energy.values()) == pytest.approx(2 * peer.cost, rel=1e-8)
    np.testing.assert_allclose(x, peer.x, atol=1e-5)


def test_exact_observations_of_the_truth_leave_the_truth(scene: Scene) -> None:
    imus = planted.bone_imus(BODY, scene.truth.poses)
    exact = planted.keypoints(scene.truth.poses)
    still = body(replace(DEFAULT, k_S=0.0)).solve(scene.truth.poses, exact, imus)
    np.testing.assert_allclose(still.poses.p_world_joint, scene.p, atol=1e-7)
    smoothed = body().solve(scene.truth.poses, exact, imus)
    assert planted.mpjpe_mm(smoothed.poses.p_world_joint, scene.p) < 1.0


def test_somebody_who_stands_still_is_found_exactly() -> None:
    truth = planted.standing(BODY, 20)
    start = replace(truth.poses, p_world_joint=truth.poses.p_world_joint + 0.03)
    imus = planted.bone_imus(BODY, truth.poses)
    seen = planted.keypoints(truth.poses)
    out = body().solve(start, seen, imus).poses.p_world_joint
    assert planted.mpjpe_mm(start.p_world_joint, truth.poses.p_world_joint) > 50
    assert planted.mpjpe_mm(out, truth.poses.p_world_joint) < 5
    assert np.abs(np.diff(out, axis=0)).max() < 2e-3


def test_the_optimum_beats_sf2_and_sf2_beats_the_lifter(scene: Scene, solution: FragmentSolution) -> None:
    out = solution.poses.p_world_joint
    errors = [
        planted.root_relative_mm(p, scene.p)
        for p in (out, scene.start.p_world_joint, scene.lifted.p_world_joint)
    ]
    assert errors[0] < 0.6 * errors[1] < 0.6 * errors[2]
    absolute = [planted.mpjpe_mm(p, scene.p) for p in (out, scene.start.p_world_joint)]
    assert absolute[0] < 0.5 * absolute[1]


def test_vision_alone_beats_the_lifter_and_sensors_add_to_it(
    scene: Scene, solution: FragmentSolution
) -> None:
    start = InertialGuidedIK(BODY).refine(scene.lifted)
    rto = body().solve(start, scene.seen)
    assert {f.energy["acceleration"] for f in rto.fragments} == {0.0}
    assert {f.energy["bone"] for f in rto.fragments} == {0.0}
    before = planted.root_relative_mm(start.p_world_joint, scene.p)
    after = planted.root_relative_mm(rto.poses.p_world_joint, scene.p)
    assert planted.root_relative_mm(solution.poses.p_world_joint, scene.p) < after < 0.9 * before
    (hand,) = BODY.index("LeftHand")
    assert np.all(rto.poses.provenance[:, hand] == Provenance.CAMERA)


@pytest.mark.parametrize("weight", ["k_V", "k_I", "k_A", "k_B", "k_S"])
def test_a_weight_of_zero_leaves_its_term_out(weight: str) -> None:
    s = Scene(SMALL, 8)
    change: dict[str, Any] = {weight: 0.0}
    off = replace(DEFAULT, **change)
    solution = FragmentSolver(SMALL, 8, off, SMALL_SENSORS).solve(s.start, s.seen, s.imus)
    gone = {
        "k_V": {"visual"}, "k_I": {"acceleration", "bone", "smooth"},
        "k_A": {"acceleration"}, "k_B": {"bone"}, "k_S": {"smooth"},
    }[weight]  # fmt: skip
    assert {term for term in TERMS if solution.energy[term] == 0.0} == gone
    assert solution.status is SolverStatus.CONVERGED


def test_turning_and_moving_the_whole_scene_turns_and_moves_the_answer(
    scene: Scene, solution: FragmentSolution
) -> None:
    R, t = so3.exp([0.2, -0.4, 1.3]), np.array([3.0, -1.0, 0.4])
    cam = scene.seen.camera
    R_camera = cam.R_camera_world @ R.T
    moved_camera = replace(cam, R_camera_world=R_camera, t_camera_world=cam.t_camera_world - R_camera @ t)
    start = replace(
        scene.start,
        p_world_joint=scene.start.p_world_joint @ R.T + t,
        R_world_bone=R @ scene.start.R_world_bone,
    )
    imus = replace(scene.imus, R_world_bone=R @ scene.imus.R_world_bone, a_world=scene.imus.a_world @ R.T)
    out = body().solve(start, replace(scene.seen, camera=moved_camera), imus)
    np.testing.assert_allclose(out.poses.p_world_joint, solution.poses.p_world_joint @ R.T + t, atol=1e-5)


def test_a_lens_with_distortion_gives_the_same_answer(scene: Scene, solution: FragmentSolution) -> None:
    seen = scene.seen
    lens = replace(seen.camera, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))
    rays = seen.camera.rays_world(seen.uv_px) + seen.camera.center_world
    bent = replace(seen, camera=lens, uv_px=lens.project(rays))
    assert np.abs(bent.uv_px - seen.uv_px).max() > 2
    out = body().solve(scene.start, bent, scene.imus)
    np.testing.assert_allclose(out.poses.p_world_joint, solution.poses.p_world_joint, atol=1e-5)


def test_half_the_frame_rate_is_not_another_unit() -> None:
    slow = planted.moving(BODY, 60)
    half = slow.poses[::2]
    imus = planted.bone_imus(BODY, half)
    out = body().solve(half, planted.keypoints(half), imus)
    assert half.rate_hz == pytest.approx(30.0)
    assert out.energy["acceleration"] < 0.01
    assert planted.mpjpe_mm(out.poses.p_world_joint, half.p_world_joint) < 1.0


# --- the estimated sigma -------------------------------------------------------------------------


@pytest.mark.parametrize("sigma_px", [3.0, 7.0])
def test_the_sigma_of_the_landmarks_is_estimated_as_twice_their_error(sigma_px: float) -> None:
    truth = planted.moving(BODY, 32)
    seen, imus = planted.keypoints(truth.poses, sigma_px), planted.bone_imus(BODY, truth.poses)
    reports = body().solve(truth.poses, seen, imus).fragments
    sigmas = [r.sigma_reprojection for r in reports]
    # The fit follows some of the noise, so that the residuals are a little smaller.
    assert 0.75 * 2 * sigma_px < np.mean(sigmas) < 2 * sigma_px


def test_the_estimated_sigma_stays_in_its_range_and_a_given_one_is_kept(scene: Scene) -> None:
    start, seen, imus = scene.part(slice(8))
    narrow = replace(DEFAULT, sigma_reprojection_range=(3.0, 4.0))
    for report in body(narrow).solve(start, seen, imus).fragments:
        assert report.sigma_reprojection == 4.0
    for report in body(PLAIN).solve(start, seen, imus).fragments:
        assert report.sigma_reprojection == 8.0


def test_landmarks_that_were_not_seen_say_nothing_about_the_sigma() -> None:
    truth = planted.moving(BODY, 8)
    imus, exact = planted.bone_imus(BODY, truth.poses), planted.keypoints(truth.poses)
    half_seen = planted.unseen(exact, slice(None), slice(8, 21))
    for report in body().solve(truth.poses, half_seen, imus).fragments:
        assert report.sigma_reprojection == 2.0  # the least of the range
    hardly_seen = planted.unseen(exact, slice(None), slice(2, 21))
    for report in body().solve(truth.poses, hardly_seen, imus).fragments:
        assert report.sigma_reprojection == DEFAULT.sigma_reprojection_first


def test_the_iterations_of_both_calls_are_counted() -> None:
    s = Scene(SMALL, 4)
    solver = FragmentSolver(SMALL, 8, replace(DEFAULT, max_iterations=3), SMALL_SENSORS)
    assert [f.iterations for f in solver.solve(s.start, s.seen, s.imus).fragments] == [6, 6]


# --- equal calls, equal answers ------------------------------------------------------------------


def test_equal_calls_give_equal_answers_whatever_was_solved_between(scene: Scene) -> None:
    solver = FragmentSolver(BODY, N, DEFAULT)
    first = solver.solve(*scene.part(slice(20)))
    other = Scene(BODY, 9, seed=3)
    solver.solve(other.start, other.seen, None)
    FragmentSolver(BODY, N, DEFAULT).solve(other.start, other.seen, other.imus)
    again = solver.solve(*scene.part(slice(20)))
    np.testing.assert_array_equal(again.poses.p_world_joint, first.poses.p_world_joint)
    np.testing.assert_array_equal(again.poses.R_world_bone, first.poses.R_world_bone)
    for a, b in zip(again.fragments, first.fragments, strict=True):
        assert replace(a, seconds=0.0) == replace(b, seconds=0.0)


def test_a_second_body_of_the_same_tree_is_not_mistaken_for_the_first() -> None:
    tall = BODY.with_height(1.95)
    truth = planted.moving(tall, 8)
    imus = planted.bone_imus(tall, truth.poses)
    body()
    solver = FragmentSolver(tall, N, replace(DEFAULT, k_S=0.0))
    out = solver.solve(truth.poses, planted.keypoints(truth.poses), imus)
    np.testing.assert_allclose(out.poses.p_world_joint, truth.poses.p_world_joint, atol=1e-6)


@pytest.mark.parametrize("frames", [1, 7, 8, 30])
@pytest.mark.parametrize("faster", [False, True])
def test_the_stream_is_the_solution(scene: Scene, frames: int, faster: bool) -> None:
    start, seen, imus = scene.part(slice(frames))
    if faster:
        start, seen = start[::2], seen[::2]
    whole = body().solve(start, seen, imus).poses
    blocks = list(body().stream(start, seen, imus))
    assert all(len(block) == N // 2 for block in blocks[:-1])
    for field in ("times", "p_world_joint", "provenance", "valid", "orientation_observed"):
        joined = np.concatenate([getattr(block, field) for block in blocks])
        np.testing.assert_array_equal(joined, getattr(whole, field), err_msg=field)
    R = np.concatenate([block.R_world_bone for block in blocks])
    np.testing.assert_allclose(R, whole.R_world_bone, atol=1e-12)


def test_a_block_of_the_stream_comes_after_two_fragments() -> None:
    s = Scene(SMALL, 16)
    solver = Inspected(SMALL, 8, PLAIN, SMALL_SENSORS)
    stream = solver.stream(s.start, s.seen, s.imus)
    assert not solver.answers
    next(stream)
    assert len(solver.answers) == 2
    next(stream)
    assert len(solver.answers) == 3


# --- frames --------------------------------------------------------------------------------------


@pytest.mark.parametrize("T", [1, 2, 3, 4, 7, 8, 9, 15, 16, 17, 24, 29])
@pytest.mark.parametrize("padding", ["masked", "replicate"])
def test_any_number_of_frames_is_solved(T: int, padding: str) -> None:
    truth = planted.moving(BODY, T)
    imus = planted.bone_imus(BODY, truth.poses)
    told: list[tuple[int, int]] = []
    solution = body(replace(DEFAULT, padding=padding)).solve(
        truth.poses, planted.keypoints(truth.poses), imus, lambda *at: told.append(at)
    )
    np.testing.assert_array_equal(solution.poses.times, truth.poses.times)
    limit = 5.0 if padding == "masked" else 30.0  # copies ask a moving person to stand
    assert planted.mpjpe_mm(solution.poses.p_world_joint, truth.poses.p_world_joint) < limit
    fragments = -(-T // 8) + 1
    assert [f.first_frame for f in solution.fragments] == [8 * i - 8 for i in range(fragments)]
    assert told == [(i + 1, fragments) for i in range(fragments)]


def test_masked_padding_does_not_drag_on_the_ends() -> None:
    truth = planted.moving(BODY, 40, radians=0.5)
    imus, seen = planted.bone_imus(BODY, truth.poses), planted.keypoints(truth.poses)
    ends = {}
    for padding in ("masked", "replicate"):
        out = body(replace(DEFAULT, padding=padding)).solve(truth.poses, seen, imus)
        error = out.poses.p_world_joint - truth.poses.p_world_joint
        ends[padding] = np.linalg.norm(error[[0, 1, -2, -1]], axis=-1).mean()
    assert ends["masked"] < 0.5 * ends["replicate"]


def test_frames_far_from_the_ends_do_not_know_of_the_padding(scene: Scene) -> None:
    settings_ = [replace(DEFAULT, padding=padding) for padding in ("masked", "replicate")]
    one, two = (body(s).solve(scene.start, scene.seen, scene.imus) for s in settings_)
    np.testing.assert_array_equal(one.poses.p_world_joint[8:48], two.poses.p_world_joint[8:48])
    assert np.abs(one.poses.p_world_joint[:8] - two.poses.p_world_joint[:8]).max() > 1e-4


def test_a_tapered_blend_is_smoother_than_the_mean_of_the_same_fragments(scene: Scene) -> None:
    tapered, average = (
        body(replace(DEFAULT, blend=blend)).solve(scene.start, scene.seen, scene.imus)
        for blend in ("tapered", "average")
    )
    for a, b in zip(tapered.fragments, average.fragments, strict=True):
        assert a.energy == b.energy
    smooth = jerk_error(tapered.poses.p_world_joint, scene.p)
    assert smooth < 0.7 * jerk_error(average.poses.p_world_joint, scene.p)


def test_the_mean_is_the_mean_of_both_fragments_and_the_taper_lies_between() -> None:
    s = Scene(SMALL, 12)
    for blend in ("average", "tapered"):
        solver = Inspected(SMALL, 8, replace(PLAIN, blend=blend), SMALL_SENSORS)
        out = solver.solve(s.start, s.seen, s.imus).poses.p_world_joint
        for block in range(3):
            before, after = solver.answers[block][4:], solver.answers[block + 1][:4]
            frames = out[4 * block : 4 * block + 4]
            if blend == "average":
                np.testing.assert_allclose(frames, (before + after) / 2, atol=1e-12)
                continue
            share = np.sum((frames - before) * (after - before), axis=(1, 2))
            share /= np.sum((after - before) ** 2, axis=(1, 2))
            np.testing.assert_allclose(share + share[::-1], 1.0, atol=1e-9)
            assert np.all(np.diff(share) > 0)
            assert share[0] < 0.05


# --- bone lengths --------------------------------------------------------------------------------


def test_weighted_lengths_hold_to_millimetres_and_free_ones_do_not(
    scene: Scene, solution: FragmentSolution
) -> None:
    weighted = np.abs(length_errors(solution.poses.p_world_joint, BODY))
    assert weighted.mean() < 0.002
    assert weighted.max() < 0.012
    free = body(replace(DEFAULT, bone_lengths="free")).solve(scene.start, scene.seen, scene.imus)
    assert np.abs(length_errors(free.poses.p_world_joint, BODY)).max() > 0.03
    assert {f.infeasibility for f in free.fragments} == {0.0}


def test_constrained_lengths_hold_in_every_fragment() -> None:
    s = Scene(BODY, 20)
    solver = Inspected(BODY, 8, replace(DEFAULT, bone_lengths="constraint"))
    solution = solver.solve(s.start, s.seen, s.imus)
    assert solution.status is SolverStatus.CONVERGED
    for answer, report in zip(solver.answers, solution.fragments, strict=True):
        assert np.abs(length_errors(answer, BODY)).max() < 1e-6
        assert report.infeasibility < 1e-7
        assert report.optimality < 1e-5
        assert report.energy["length"] == 0.0
    assert np.abs(length_errors(solution.poses.p_world_joint, BODY)).max() < 0.005


def test_violated_lengths_are_reported_as_they_are() -> None:
    s = Scene(SMALL, 4)
    set_ = replace(PLAIN, bone_lengths="constraint", max_iterations=0)
    solution = FragmentSolver(SMALL, 8, set_, SMALL_SENSORS).solve(s.lifted, s.seen, s.imus)
    p = s.lifted.p_world_joint
    a, b = np.array(rigid_pairs(SMALL.parents)).T
    true = np.linalg.norm(p[:, b] - p[:, a], axis=-1) - length_errors(p, SMALL)
    violation = np.abs(np.sum((p[:, b] - p[:, a]) ** 2, axis=-1) - true**2).max()
    assert solution.status is SolverStatus.ITERATION_LIMIT
    for report in solution.fragments:
        assert report.infeasibility == pytest.approx(violation, rel=1e-9)


# --- missing observations ------------------------------------------------------------------------


def test_joints_and_frames_that_were_not_seen_are_bridged(scene: Scene) -> None:
    seen = planted.unseen(scene.seen, slice(20, 32))
    seen = planted.unseen(seen, slice(None), BODY.index("LeftHand", "Head"))
    out = body().solve(scene.start, seen, scene.imus).poses.p_world_joint
    assert np.isfinite(out).all()
    hand, head = BODY.index("LeftHand", "Head")
    for joint in (hand, head):
        error = np.linalg.norm(out[:, joint] - scene.p[:, joint], axis=-1).mean()
        before = np.linalg.norm(scene.start.p_world_joint[:, joint] - scene.p[:, joint], axis=-1)
        assert error < 0.6 * before.mean()
    gap, start_gap = (
        planted.root_relative_mm(p[20:32], scene.p[20:32]) for p in (out, scene.start.p_world_joint)
    )
    assert gap < start_gap


def test_a_recording_that_saw_nobody_stays_near_its_start(scene: Scene) -> None:
    start, seen, imus = scene.part(slice(16))
    blind = planted.unseen(seen, slice(None))
    solution = body().solve(start, blind, imus)
    assert solution.status is SolverStatus.CONVERGED
    assert solution.energy["visual"] == 0.0
    moved = planted.mpjpe_mm(solution.poses.p_world_joint, start.p_world_joint)
    assert moved < planted.mpjpe_mm(scene.p[:16], start.p_world_joint)


@pytest.mark.parametrize("rate", [1, 2])
def test_samples_that_are_nan_are_as_if_the_sensor_were_not_there(scene: Scene, rate: int) -> None:
    imus = scene.imus
    silent = replace(
        imus,
        R_world_bone=np.where(np.arange(8)[:, None, None] < 3, np.nan, imus.R_world_bone),
        a_world=np.where(np.arange(8)[:, None] < 3, np.nan, imus.a_world),
    )
    start, seen = scene.start[:24:rate], scene.seen[:24:rate]
    one = body().solve(start, seen, silent)
    two = body().solve(start, seen, imus.select(imus.joints[3:]))
    np.testing.assert_allclose(one.poses.p_world_joint, two.poses.p_world_joint, atol=1e-9)
    np.testing.assert_array_equal(one.poses.provenance, two.poses.provenance)


@settings(max_examples=8, deadline=None)
@given(joints=st.sets(st.sampled_from(["Hips", "Spine3", "Head", "LeftFoot", *planted.LIMBS])))
def test_any_subset_of_sensors_is_taken(joints: set[str]) -> None:
    truth = planted.moving(BODY, 8)
    imus = planted.bone_imus(BODY, truth.poses, sorted(joints))
    seen = planted.keypoints(truth.poses)
    solution = body().solve(truth.poses, seen, imus)
    assert planted.mpjpe_mm(solution.poses.p_world_joint, truth.poses.p_world_joint) < 3.0
    has_bone = joints - {"Head", "LeftFoot"}
    assert (solution.energy["acceleration"] > 0) == bool(has_bone)


def test_the_lever_arm_of_a_sensor_matters(scene: Scene) -> None:
    truth = scene.truth.poses[:24]
    seen, imus = planted.keypoints(truth), planted.bone_imus(BODY, truth)
    right, wrong = (
        body().solve(truth, seen, replace(imus, p_bone_sensor=lever)).poses.p_world_joint
        for lever in (imus.p_bone_sensor, np.zeros((8, 3)))
    )
    error = planted.mpjpe_mm(wrong, truth.p_world_joint)
    assert error > 5 * planted.mpjpe_mm(right, truth.p_world_joint)


def test_sensors_at_another_rate_are_brought_to_the_frames() -> None:
    truth = planted.moving(BODY, 121)
    imus = planted.bone_imus(BODY, truth.poses)
    frames = slice(20, 80, 4)
    poses = truth.poses[frames]
    out = body().solve(poses, planted.keypoints(poses), imus)
    assert poses.rate_hz == pytest.approx(15.0)
    assert planted.mpjpe_mm(out.poses.p_world_joint, poses.p_world_joint) < 10
    assert out.energy["acceleration"] < 0.05
    assert out.poses.orientation_observed[:, BODY.index(*planted.LIMBS)].all()


# --- the start -----------------------------------------------------------------------------------


def test_refitting_the_root_first_mends_a_start_that_stands_elsewhere() -> None:
    truth = planted.moving(BODY, 16)
    seen, imus = planted.keypoints(truth.poses), planted.bone_imus(BODY, truth.poses)
    away = replace(truth.poses, p_world_joint=truth.poses.p_world_joint + np.array([0.5, 0.3, -0.2]))
    refitted, as_it_is = (
        planted.mpjpe_mm(
            body(replace(DEFAULT, refit_root=refit)).solve(away, seen, imus).poses.p_world_joint,
            truth.poses.p_world_joint,
        )
        for refit in (True, False)
    )
    assert refitted < 0.8 * as_it_is


def test_a_prior_on_bones_does_not_bend_the_pose_where_the_root_is_wrong() -> None:
    truth = planted.moving(BODY, 24)
    seen, imus = planted.keypoints(truth.poses), planted.bone_imus(BODY, truth.poses)
    start = replace(truth.poses, p_world_joint=truth.poses.p_world_joint + np.array([0.5, 0.0, 0.0]))
    bent = {}
    for prior in ("bones", "positions"):
        set_ = replace(DEFAULT, prior=prior, refit_root=False)
        out = body(set_).solve(start, seen, imus).poses.p_world_joint
        bent[prior] = planted.root_relative_mm(out, truth.poses.p_world_joint)
    assert bent["bones"] < bent["positions"]


# --- the answer ----------------------------------------------------------------------------------


def test_orientations_agree_with_the_positions_and_provenance_with_the_sensors(
    scene: Scene, solution: FragmentSolution
) -> None:
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


def test_the_solution_sums_up_its_fragments(solution: FragmentSolution) -> None:
    fragments = solution.fragments
    assert solution.iterations == sum(f.iterations for f in fragments) > len(fragments)
    assert solution.seconds == pytest.approx(sum(f.seconds for f in fragments))
    assert solution.optimality == max(f.optimality for f in fragments)
    for term in TERMS:
        mean = np.mean([f.energy[term] for f in fragments])
        assert solution.energy[term] == pytest.approx(mean)
    assert solution.status is SolverStatus.CONVERGED


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_fragment_that_fails_gives_back_its_start_and_says_so() -> None:
    s = Scene(SMALL, 8)
    uv = np.array(s.seen.uv_px)
    uv[6] = 1e200  # its square is not a number any more
    plain = replace(PLAIN, huber_reprojection=None)
    solver = FragmentSolver(SMALL, 8, plain, SMALL_SENSORS)
    solution = solver.solve(s.start, replace(s.seen, uv_px=uv), s.imus)
    assert [f.status for f in solution.fragments] == [
        SolverStatus.CONVERGED, SolverStatus.FAILED, SolverStatus.FAILED,
    ]  # fmt: skip
    assert solution.status is SolverStatus.FAILED
    np.testing.assert_allclose(solution.poses.p_world_joint[4:], s.start.p_world_joint[4:], atol=1e-12)
    assert "starting poses" in SolverStatus.FAILED.value


def test_whatever_a_solver_that_gave_up_returns_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    s = Scene(SMALL, 8)
    solver = FragmentSolver(SMALL, 8, PLAIN, SMALL_SENSORS)

    class GaveUp:
        def __call__(self, x0: Array, **arguments: object) -> dict[str, Array]:
            return {"x": x0 + 1.0, "lam_g": np.zeros(0)}

        def stats(self) -> dict[str, object]:
            return {"return_status": "Restoration_Failed", "iter_count": 7}

    monkeypatch.setattr(solver._solver._problem, "solver", GaveUp())
    solution = solver.solve(s.start, s.seen, s.imus)
    assert solution.status is SolverStatus.FAILED
    assert solution.iterations == 3 * 7
    np.testing.assert_allclose(solution.poses.p_world_joint, s.start.p_world_joint, atol=1e-12)


# --- the paper's reading -------------------------------------------------------------------------


def test_the_papers_settings_find_a_minimum_too(scene: Scene) -> None:
    solution = body(CartesianSettings.paper()).solve(scene.start, scene.seen, scene.imus)
    assert solution.status is SolverStatus.CONVERGED
    assert solution.energy["length"] == 0.0
    before = planted.mpjpe_mm(scene.start.p_world_joint, scene.p)
    assert planted.mpjpe_mm(solution.poses.p_world_joint, scene.p) < before


def test_the_sensors_jerk_as_target_follows_the_truth_that_smoothing_flattens() -> None:
    truth = planted.moving(BODY, 40, radians=0.6)
    seen, imus = planted.keypoints(truth.poses, 2.0), planted.bone_imus(BODY, truth.poses)
    smooth = {}
    for target in ("sensor", "zero"):
        out = body(replace(DEFAULT, jerk_target=target)).solve(truth.poses, seen, imus)
        smooth[target] = out.energy["smooth"]
    assert smooth["sensor"] < smooth["zero"]


def test_a_gap_in_a_sensor_is_no_jerk() -> None:
    # Differentiated into a gap, an acceleration of 5 m/s^2 would ask for 300 m/s^3.
    truth = planted.moving(BODY, 32, radians=0.5)
    seen, imus = planted.keypoints(truth.poses), planted.bone_imus(BODY, truth.poses)
    a = np.array(imus.a_world)
    a[14:18] = np.nan

    def smoothness(target: str, imus: BoneImuSequence) -> float:
        """Of the truth itself."""
        set_ = replace(PLAIN, jerk_target=target, padding="masked", max_iterations=0)
        return body(set_).solve(truth.poses, seen, imus).energy["smooth"]

    whole, gap, without = (
        smoothness("sensor", imus),
        smoothness("sensor", replace(imus, a_world=a)),
        smoothness("zero", imus),
    )
    assert whole < gap < without


# --- what is refused -----------------------------------------------------------------------------


def test_keypoints_of_nothing_in_the_skeleton_are_refused(scene: Scene) -> None:
    strangers = replace(scene.seen, names=tuple(f"point {i}" for i in range(21)))
    with pytest.raises(SolverError, match="none of the landmarks is a joint of the skeleton"):
        body().solve(scene.start, strangers)
