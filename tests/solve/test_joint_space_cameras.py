"""Several cameras in the joint-space problem: the sum of what each one says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError, SolverError, ViewError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
N = 8
SETTINGS = JointSpaceSettings(compile="never", refit_root=False)
POSES = planted.human(BODY, N, size=0.5).poses
SIDE = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], focal_px=900.0)


def seen(camera: Camera = SIDE, sigma_px: float = 0.0, seed: int = 0) -> KeypointSequence:
    uv = camera.project(POSES.p_world_joint)
    uv = uv + sigma_px * np.random.default_rng(seed).normal(size=uv.shape)
    return KeypointSequence(camera, POSES.times, uv, np.ones(uv.shape[:2]), POSES.names)


def observed(first: KeypointSequence, *views: KeypointSequence) -> Observations:
    return Observations(BODY, N, SETTINGS, InitialGuess(POSES, np.zeros(N)), first, None, views=views)


def visual(data: Observations, x: Array) -> float:
    data.problem.bind(data.fragment(0)[2])
    return data.problem.value(x)[0]["visual"]


def solved(*views: KeypointSequence, first: KeypointSequence | None = None) -> FragmentSolution:
    off = replace(POSES, p_world_joint=POSES.p_world_joint + 0.1)
    solver = FragmentSolver(BODY, N, SETTINGS)
    return solver.solve(off, first or planted.keypoints(POSES, 2.0), confidence=True, views=views)


def test_the_energy_of_two_cameras_is_the_sum_of_each_ones() -> None:
    front, side = planted.keypoints(POSES, 3.0), seen(sigma_px=3.0)
    both = observed(front, side)
    x = both.space.retract(both.start, 0.05 * np.ones((N, both.space.size)))
    assert visual(both, x) == pytest.approx(visual(observed(front), x) + visual(observed(side), x))
    assert visual(observed(front, front), x) == pytest.approx(2 * visual(observed(front), x))


def test_the_gradient_of_two_cameras_equals_finite_differences() -> None:
    data = observed(planted.keypoints(POSES, 3.0), seen(sigma_px=3.0))
    data.problem.bind(data.fragment(0)[2])
    x, rng = data.start.copy(), np.random.default_rng(1)
    gradient, step = data.problem.gradient(x), rng.normal(size=(N, data.space.size))
    h = 1e-6
    ends = [data.problem.total(data.space.retract(x, sign * h * step)) for sign in (1, -1)]
    assert np.vdot(gradient, step) == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-5)


def test_each_camera_has_a_sigma_of_its_own() -> None:
    data = observed(planted.keypoints(POSES, 2.0), seen(sigma_px=9.0))
    values = data.fragment(0)[2]
    data.problem.bind(values)
    annealing = Annealing(SETTINGS, data.problem, data.confidence, data.points.sizes, values.observation)
    weights: dict[str, Array] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data.problem, "reweigh", weights.__setitem__)
        assert annealing(data.start)
    sharp, blurred = np.split(np.sqrt(1 / weights["w_visual"][0]), 2)
    assert sharp == pytest.approx(2.0, rel=0.5)
    assert blurred == pytest.approx(9.0, rel=0.5)
    assert annealing.sigma == pytest.approx((sharp[0] + blurred[0]) / 2)


def test_a_second_camera_gives_the_depth_and_narrows_the_bands() -> None:
    one, two = solved(), solved(seen(sigma_px=2.0))
    errors = [planted.mpjpe_mm(s.poses.p_world_joint, POSES.p_world_joint) for s in (one, two)]
    assert errors[1] < min(10.0, 0.5 * errors[0])
    assert one.confidence is not None
    assert two.confidence is not None
    sizes = [np.trace(s.confidence.position_covariance, axis1=2, axis2=3) for s in (one, two)]
    assert np.all(sizes[1] < sizes[0])


def test_joints_that_only_the_second_camera_sees_are_found() -> None:
    arm = BODY.index("LeftForeArm", "LeftHand")
    blind = planted.unseen(planted.keypoints(POSES), slice(None), arm)
    found = solved(seen(), first=blind).poses.p_world_joint[:, arm]
    assert planted.mpjpe_mm(found, POSES.p_world_joint[:, arm]) < 25.0


def test_views_that_cannot_be_used_are_refused() -> None:
    with pytest.raises(SolverError, match="cameras.*joint"):
        FragmentSolver(BODY, N, space="cartesian").solve(POSES, planted.keypoints(POSES), views=(seen(),))
    with pytest.raises(InvalidInputError, match="view 1.*times"):
        solved(replace(seen(), times=POSES.times + 0.1))
    away = Camera.looking_at([4.0, 0.6, 1.5], [8.0, 0.0, 1.0], 1250.0)
    with pytest.raises(ViewError, match="view 1"):
        solved(replace(seen(), camera=away))
