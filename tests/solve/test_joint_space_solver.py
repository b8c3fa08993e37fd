"""The joint-space solver on whole recordings: what it recovers, estimates, reports and does not mind."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.metrics import flexion, hinges
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver, SolverStatus
from rtof_kin.solve.initial_guess import InertialGuidedIK
from rtof_kin.solve.joint_space import solver as solver_module
from rtof_kin.solve.joint_space.terms import BUILT_IN
from rtof_kin.solve.settings import JointSpaceSettings

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
N, T = 16, 40
DEFAULT = JointSpaceSettings()
GIVEN = replace(DEFAULT, sigma_reprojection=3.0)
QUICK = replace(DEFAULT, annealing=3, max_iterations=3)
EXACT = replace(
    DEFAULT,
    sigma_reprojection=0.5,
    sigma_swing=0.01,
    sigma_twist=0.01,
    sigma_acceleration=0.2,
    prior_inflation=20.0,
    sigma_torso=None,
    sigma_bone=None,
    max_iterations=100,
)
"""Settings for exact observations."""
LIMIT = np.radians(0.1)
"""By how much a limit may be missed, rad."""


def body(set_: JointSpaceSettings = DEFAULT, frames: int = N) -> FragmentSolver:
    return FragmentSolver(BODY, frames, set_)


class Scene:
    """A motion as people move, what was observed of it, and poses to start from."""

    def __init__(self, frames: int = T, seed: int = 0) -> None:
        self.truth: Motion = planted.human(BODY, frames, seed)
        poses = self.truth.poses
        self.exact, self.seen = planted.keypoints(poses), planted.keypoints(poses, 3.0)
        self.exact_imus = planted.bone_imus(BODY, poses)
        self.imus = planted.bone_imus(BODY, poses, planted.LIMBS, 3.0, 0.4)
        self.start = InertialGuidedIK(BODY).refine(planted.lifted_poses(self.truth), self.imus)

    def solve(
        self, solver: FragmentSolver | JointSpaceSettings = DEFAULT, frames: int = T, **given: Any
    ) -> FragmentSolution:
        """From its start and noisy observations, or from those given."""
        observed: dict[str, Any] = {"start": self.start, "keypoints": self.seen, "bone_imus": self.imus, **given}
        cut: dict[str, Any] = {k: v and v[:frames] for k, v in observed.items()}
        return (solver if isinstance(solver, FragmentSolver) else body(solver)).solve(**cut)

    def mm(self, poses: PoseSequence) -> float:
        return planted.mpjpe_mm(poses.p_world_joint, self.truth.poses.p_world_joint)

    def relative_mm(self, poses: PoseSequence) -> float:
        return planted.root_relative_mm(poses.p_world_joint, self.truth.poses.p_world_joint)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def solution(scene: Scene) -> FragmentSolution:
    return scene.solve()


@pytest.fixture(scope="module")
def alone(scene: Scene) -> FragmentSolution:
    """Without sensors."""
    return scene.solve(bone_imus=None)


def assert_same_positions(one: FragmentSolution, two: FragmentSolution, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(one.poses.p_world_joint, two.poses.p_world_joint, rtol=0, atol=atol)


def sigmas(solution: FragmentSolution) -> list[float]:
    return [f.sigma_reprojection for f in solution.fragments]


def changed(array: Array, where: Any, value: Any) -> Array:
    out = np.array(array)
    out[where] = value
    return out


def test_exact_observations_recover_the_truth(scene: Scene) -> None:
    out = scene.solve(EXACT, keypoints=scene.exact, bone_imus=scene.exact_imus)
    assert scene.mm(scene.start) > 150
    assert scene.mm(out.poses) < 0.5
    assert out.status is SolverStatus.CONVERGED
    assert scene.mm(scene.solve(keypoints=scene.exact, bone_imus=scene.exact_imus).poses) < 5.0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_errors_are_far_smaller_than_those_of_the_initial_guess(seed: int) -> None:
    s = Scene(seed=seed)
    out = s.solve()
    assert out.status is SolverStatus.CONVERGED
    assert s.relative_mm(out.poses) < 0.25 * s.relative_mm(s.start)
    assert s.mm(out.poses) < 0.15 * s.mm(s.start)
    result, start, true = (flexion(poses.p_world_joint, BODY) for poses in (out.poses, s.start, s.truth.poses))
    assert np.nanmean(np.abs(result - true)) < 0.7 * np.nanmean(np.abs(start - true))
    assert 1.5 < min(sigmas(out)) < max(sigmas(out)) < 4.5, "it is 3 px"


def test_vision_only_improves_on_sf2_and_sensors_on_vision(scene: Scene, alone: FragmentSolution) -> None:
    assert alone.energy["orientation"] == alone.energy["acceleration"] == 0.0
    assert min(alone.energy["bone"], alone.energy["root"]) > 0
    sensed = scene.solve(bone_imus=scene.exact_imus)
    assert sensed.energy["root"] == 0.0 < sensed.energy["acceleration"]
    errors = [scene.relative_mm(poses) for poses in (sensed.poses, alone.poses, scene.start)]
    assert errors[0] < errors[1] < 0.5 * errors[2]


def test_bones_are_rigid_and_knees_and_elbows_hinges(scene: Scene, solution: FragmentSolution) -> None:
    def across(R: Array) -> float:
        """Largest turn of knees and elbows about the two axes they turn least about, rad."""
        local = so3.log(kinematics.local_rotations(BODY.parents, R)[:, hinges(BODY)])
        return float(np.sort(np.abs(local).max(axis=0), axis=-1)[:, :2].max())

    p, R = solution.poses.p_world_joint, solution.poses.R_world_bone
    assert so3.is_rotation(R, tolerance=1e-9)
    rigid = kinematics.positions(BODY.parents, BODY.joint_offsets, p[:, 0], R)
    np.testing.assert_allclose(p, rigid, atol=1e-9)
    free = scene.solve(replace(DEFAULT, hinges=False)).poses
    assert across(R) < 1e-7 < 0.01 < across(free.R_world_bone)
    assert scene.relative_mm(free) < 0.4 * scene.relative_mm(scene.start)


def test_anatomical_limits_are_kept() -> None:
    # A knee that is seen overstretched by 15 degrees.
    truth, dof = planted.human(BODY, N), BODY.dof_names.index("LeftLeg_y")
    low = BODY.limits[dof, 0]
    p, R = BODY.forward_kinematics(changed(truth.q, np.s_[:, 7 + dof], low - np.radians(15.0)))
    poses = replace(truth.poses, p_world_joint=p, R_world_bone=R)
    seen, imus = planted.keypoints(poses, 1.0), planted.bone_imus(BODY, poses)
    beyond = {}
    for limited in (True, False):
        out = body(replace(DEFAULT, limits=limited)).solve(poses, seen, imus)
        q = BODY.inverse_kinematics(out.poses.p_world_joint, out.poses.R_world_bone)
        beyond[limited] = np.degrees(low - q[:, 7 + dof])
        assert max(f.infeasibility for f in out.fragments) <= (LIMIT if limited else 0.0)
    assert beyond[True].max() < 0.2
    assert beyond[False].mean() > 5


def test_report_has_every_term_and_counts_iterations(solution: FragmentSolution) -> None:
    assert [f.first_frame for f in solution.fragments] == [-8, 0, 8, 16, 24, 32]
    for f in solution.fragments:
        assert tuple(f.energy) == BUILT_IN
        assert min(f.energy.values()) >= 0
        assert f.infeasibility <= LIMIT
        assert 0 < f.optimality < np.inf
        assert 0 < f.iterations <= DEFAULT.annealing + DEFAULT.max_iterations


@pytest.mark.parametrize("annealing, most", [(0, 0), (0, 1), (2, 0), (2, 1)])
def test_iteration_limit_is_reported(scene: Scene, annealing: int, most: int) -> None:
    out = scene.solve(replace(DEFAULT, annealing=annealing, max_iterations=most), 12)
    assert out.status is SolverStatus.ITERATION_LIMIT
    assert {f.iterations for f in out.fragments} == {annealing + most}


@pytest.mark.parametrize("sigma_px", [3.0, 8.0])
def test_sigma_of_white_errors_is_estimated(scene: Scene, sigma_px: float) -> None:
    seen = planted.keypoints(scene.truth.poses, sigma_px)
    for start in (scene.start, scene.truth.poses):
        found = sigmas(scene.solve(start=start, keypoints=seen, bone_imus=scene.exact_imus))
        assert np.mean(found) == pytest.approx(sigma_px, rel=0.25), found
        assert max(found) < 1.5 * sigma_px, found


def test_autocorrelated_errors_increase_sigma(scene: Scene) -> None:
    drift = planted.smooth_noise(3, (T, 21, 2), 15, 5.0)
    assert drift.std() == pytest.approx(5.0, rel=0.1)
    seen, mean = replace(scene.exact, uv_px=scene.exact.uv_px + drift), {}
    for factor in (2.5, 1.0):
        set_ = replace(DEFAULT, largest_correlation_factor=factor)
        mean[factor] = np.mean(sigmas(scene.solve(set_, keypoints=seen, bone_imus=scene.exact_imus)))
    assert 1.5 * 5.0 < mean[2.5] <= 2.5 * 5.0
    assert mean[1.0] < 1.1 * 5.0


def test_sigma_stays_in_its_range_unless_given(scene: Scene) -> None:
    within = scene.solve(replace(QUICK, sigma_reprojection_range=(5.0, 6.0)))
    assert 5.0 <= min(sigmas(within)) <= max(sigmas(within)) <= 6.0
    assert set(sigmas(scene.solve(replace(QUICK, sigma_reprojection=7.5)))) == {7.5}


def test_landmarks_are_weighted_by_confidence(scene: Scene) -> None:
    # The left half of the body is 40 px off, with a low confidence.
    left = [name.startswith("Left") for name in BODY.names]
    uv, errors = scene.exact.uv_px + 40.0 * np.array(left)[:, None], []
    for trust in (1.0, 1e-4):
        confidence = changed(np.ones((T, 21)), np.s_[:, left], trust)
        seen = replace(scene.exact, uv_px=uv, confidence=confidence)
        out = scene.solve(replace(GIVEN, robust_reprojection=1e3), keypoints=seen)
        errors.append(scene.relative_mm(out.poses))
    assert errors[1] < 0.5 * errors[0]


ENDS = ("Head", "LeftFoot", "RightFoot")
MARKS = ("LeftHeel", "LeftToe", "RightHeel", "RightToe", "Nose", "LeftEar", "RightEar")


def with_marks(seen: KeypointSequence, poses: PoseSequence) -> KeypointSequence:
    """The assert_same_positions keypoints and heels, toes, nose and ears."""
    every = BODY.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    at = [list(BODY.landmarks).index(name) for name in MARKS]
    uv = np.concatenate([seen.uv_px, seen.camera.project(every[:, at])], axis=1)
    return replace(seen, uv_px=uv, confidence=np.ones(uv.shape[:2]), names=(*seen.names, *MARKS))


def test_landmarks_or_sensors_orient_feet_and_head() -> None:
    poses, index = planted.human(BODY, 20).poses, list(BODY.index(*ENDS))
    exact, parents = planted.keypoints(poses), [BODY.parents[j] for j in index]
    eleven = planted.bone_imus(BODY, poses, (*planted.LIMBS, *ENDS))
    eight, degrees = eleven.select(planted.LIMBS), []
    for seen, imus in ((exact, eight), (with_marks(exact, poses), eight), (exact, eleven)):
        out = body().solve(poses, seen, imus).poses
        R, shown = out.R_world_bone, out.orientation_observed[:, index]
        assert shown.all() if seen is not exact else not shown.any()
        angles = so3.angle_between(R[:, index], poses.R_world_bone[:, index])
        degrees.append(float(np.degrees(angles.mean())))
        rigid = np.allclose(R[:, index], R[:, parents], atol=1e-9)
        assert rigid == (seen is exact and imus is eight)
    assert degrees[0] > 4
    assert max(degrees[1:]) < 0.5 * degrees[0]


def test_unobserved_joints_and_frames_are_bridged(scene: Scene) -> None:
    gap = slice(18, 26)
    seen = planted.unseen(scene.seen, gap)
    out = scene.solve(keypoints=planted.unseen(seen, slice(None), BODY.index("LeftHand", "Head")))
    assert out.status is SolverStatus.CONVERGED
    p, start, true = (x.p_world_joint for x in (out.poses, scene.start, scene.truth.poses))
    before = planted.root_relative_mm(start[gap], true[gap])
    assert planted.root_relative_mm(p[gap], true[gap]) < 0.6 * before
    fastest = [np.linalg.norm(np.diff(x, axis=0), axis=-1).max() for x in (p, true)]
    assert fastest[0] < 3 * fastest[1]


def test_unobserved_fragments_are_reported(scene: Scene) -> None:
    out = scene.solve(keypoints=planted.unseen(scene.seen, slice(16, T)), bone_imus=None)
    expected = [SolverStatus.CONVERGED] * 3 + [SolverStatus.UNOBSERVED] * 3
    assert [f.status for f in out.fragments] == expected
    assert out.status is SolverStatus.UNOBSERVED
    for report in out.fragments[3:]:
        assert report.energy["visual"] == report.energy["orientation"] == 0.0
    assert scene.mm(out.poses) < scene.mm(scene.start)


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
@pytest.mark.parametrize("size", [1e100, 1e160, 1e300])
@pytest.mark.parametrize("what", ["keypoint", "acceleration"])
def test_overflow_affects_its_own_fragments_only(scene: Scene, what: str, size: float) -> None:
    seen, imus = scene.seen, scene.imus
    if what == "keypoint":
        seen = replace(seen, uv_px=changed(seen.uv_px, (20, 3), size))
    else:
        imus = replace(imus, a_world=changed(imus.a_world, (20, 3), size))
    unfiltered = replace(DEFAULT, smooth_start_hz=30.0)
    out = scene.solve(unfiltered, keypoints=seen, bone_imus=imus)
    assert np.isfinite(out.poses.p_world_joint).all()
    clean = [f.status is SolverStatus.CONVERGED for f in out.fragments]
    assert clean[:2] + clean[4:] == [True] * 4
    for f in out.fragments[2:4]:
        overflows = not np.isfinite(sum(f.energy.values()))
        assert overflows == (f.status is SolverStatus.FAILED) == (size > 1e154)
    if size > 1e154:
        hips, of_start = out.poses.R_world_bone[16:24, 0], scene.start.R_world_bone[16:24, 0]
        np.testing.assert_allclose(hips, of_start, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize(
    "field",
    [
        "sigma_reprojection",
        "sigma_swing",
        "sigma_acceleration",
        "robust_orientation",
        "jerk",
        "prior_inflation",
        "tolerance",
    ],
)
def test_settings_must_be_positive_and_finite(field: str, value: float) -> None:
    change: dict[str, Any] = {field: value}
    with pytest.raises(InvalidInputError, match=f"{field} must be positive and finite"):
        replace(DEFAULT, **change)


def test_known_floor_limits_the_height_of_the_feet() -> None:
    # Standing still, with keypoints 10 % too large: the body is too near, thus too high.
    q = np.tile(BODY.n_pose(), (N, 1))
    q[:, 2] += 0.95
    p, R = BODY.forward_kinematics(q)
    poses = PoseSequence(np.arange(N) / 60, p, R, BODY.names)
    feet = list(BODY.index("LeftFoot", "RightFoot"))
    ankle, exact, height = float(p[:, feet, 2].mean()), planted.keypoints(poses), {}
    center = exact.uv_px.mean(axis=1, keepdims=True)
    seen = replace(exact, uv_px=center + 1.1 * (exact.uv_px - center))
    for floor in (None, 0.0):
        set_ = replace(GIVEN, floor_height=floor, ankle_height=ankle, sigma_floor=0.005)
        out = body(set_).solve(poses, seen, planted.bone_imus(BODY, poses))
        height[floor] = np.abs(out.poses.p_world_joint[:, feet, 2] - ankle).mean()
        assert (out.energy["floor"] > 0) == (floor == 0.0)
    assert height[None] > 0.03
    assert height[0.0] < 0.5 * height[None]


def bent_over(start: PoseSequence, frames: slice) -> PoseSequence:
    """Poses whose trunk, head and all, lies backwards for a while."""
    R = start.R_world_bone.copy()
    for j in BODY.index("Spine", "Spine1", "Spine2", "Spine3", "Neck", "Head"):
        R[frames, j] = R[frames, j] @ so3.about_axis("y", -2.2)
    p = kinematics.positions(BODY.parents, BODY.joint_offsets, start.p_world_joint[:, 0], R)
    return replace(start, R_world_bone=R, p_world_joint=p)


@pytest.mark.parametrize("frames", [slice(18, 40), slice(0, 18)])
def test_local_minimum_is_retried(scene: Scene, frames: slice, monkeypatch: pytest.MonkeyPatch) -> None:
    start = bent_over(scene.start, frames)
    given_: dict[str, Any] = {"start": start, "keypoints": scene.exact, "bone_imus": scene.imus}
    found = scene.solve(**given_)
    monkeypatch.setattr(solver_module, "_LOCAL_MINIMUM", np.inf)
    caught = scene.solve(**given_)
    assert max(f.sigma_reprojection for f in caught.fragments) > 3.5
    assert max(f.sigma_reprojection for f in found.fragments) < 2.5
    usual = scene.solve(keypoints=scene.exact, bone_imus=scene.imus)
    assert scene.mm(found.poses) < scene.mm(usual.poses) + 1.0 < scene.mm(caught.poses) - 2.0
