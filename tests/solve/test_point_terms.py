"""Further residuals: energies against finite differences, one minimum by both backends, wrong input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.joint_space.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.point_terms import PointData, PointTerm, point_rows

Array = NDArray[np.float64]
BODY, N = SkeletonModel.default(), 8
POSES = planted.seen(BODY, N).poses
ANCHOR = np.array([2.0, -1.0, 1.5])


def to_anchor(p: Any, observed: Any) -> Any:
    return ca.norm_2(p - observed[:3]) - observed[3]


RANGE = PointTerm("anchor", "LeftHand", to_anchor, 4, robust=1.5)


def ranges(poses: PoseSequence = POSES, error: float = 0.0) -> Array:
    """Observations of `RANGE` (T, 4), one of them missing."""
    p = poses.p_world_joint[:, poses.names.index("LeftHand")]
    distances = np.linalg.norm(p - ANCHOR, axis=1) + error
    distances[3] = np.nan
    return np.column_stack([np.tile(ANCHOR, (len(p), 1)), distances])


def energy(squared: Array) -> Array:
    """Half the pseudo-Huber loss of squared whitened residuals."""
    return 1.5**2 * (np.sqrt(1 + squared / 1.5**2) - 1)


def observations(compile: str) -> tuple[Observations, Any]:
    settings = JointSpaceSettings(compile=compile)  # type: ignore[arg-type]
    data = Observations(
        BODY,
        N,
        settings,
        InitialGuess(POSES, np.zeros(N)),
        planted.keypoints(POSES),
        None,
        terms=(RANGE,),
        observed={"anchor": PointData(ranges(error=0.3), 0.1)},
    )
    _, _, values = data.fragment(0)
    data.problem.bind(values)
    return data, data.problem


def test_the_joint_space_energy_is_that_of_the_residual_and_its_gradient_the_derivative() -> None:
    data, problem = observations("never")
    rng = np.random.default_rng(0)
    x = data.space.retract(data.start, 0.1 * rng.normal(size=(N, data.space.size)))
    p, _ = data.space.poses(x)
    off = np.linalg.norm(p[:, BODY.names.index("LeftHand")] - ANCHOR, axis=1) - ranges(error=0.3)[:, 3]
    assert problem.value(x)[0]["anchor"] == pytest.approx(np.nansum(energy((off / 0.1) ** 2)), rel=1e-9)
    gradient, step = problem.gradient(x), 1e-6
    for t, d in ((0, 1), (3, 4), (5, data.space.size - 1), (7, 20)):
        move = np.zeros((N, data.space.size))
        move[t, d] = step
        ends = [problem.total(data.space.retract(x, sign * move)) for sign in (1, -1)]
        assert gradient[t, d] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4, abs=1e-3)


def test_frames_in_the_padding_have_no_observation() -> None:
    data, _ = observations("never")
    _, inside, values = data.fragment(-3)
    assert np.array_equal(values.observation["w_point_anchor"] > 0, inside & (np.arange(-3, N - 3) != 3))


@pytest.mark.parametrize("backend", ["ipopt", "realtime"])
def test_the_cartesian_solver_follows_the_observations(backend: Any) -> None:
    settings = CartesianSettings(backend=backend, sigma_reprojection=5.0)
    solver = FragmentSolver(BODY, N, settings, sensor_joints=(), terms=[RANGE])
    wanted, off = ranges(error=0.1), []
    for observed in ({}, {"anchor": PointData(wanted, 0.002)}):
        solution = solver.solve(POSES, planted.keypoints(POSES), observed=observed)
        hand = solution.poses.p_world_joint[:, BODY.names.index("LeftHand")]
        off.append(np.abs(np.linalg.norm(hand - ANCHOR, axis=1) - wanted[:, 3]))
        assert set(solution.energy) >= {"visual", "anchor"}
    assert np.nanmean(off[1]) < 0.5 * np.nanmean(off[0])


def test_both_cartesian_backends_have_the_same_minimum() -> None:
    found = []
    for backend in ("ipopt", "realtime"):
        settings = CartesianSettings(backend=backend, sigma_reprojection=5.0, tolerance=1e-9)  # type: ignore[arg-type]
        solver = FragmentSolver(BODY, N, settings, sensor_joints=(), terms=[RANGE])
        data = {"anchor": PointData(ranges(error=0.1), 0.02)}
        found.append(solver.solve(POSES, planted.keypoints(POSES), observed=data).poses.p_world_joint)
    np.testing.assert_allclose(found[0], found[1], atol=2e-4)


def test_rows_are_zero_where_nothing_was_observed() -> None:
    rows = point_rows([RANGE], {"anchor": PointData(ranges(), np.linspace(0.1, 0.2, N))}, N)
    assert rows["w_point_anchor"][3] == 0
    assert not rows["point_anchor"][3].any()
    assert rows["w_point_anchor"][0] == pytest.approx(100)
    assert not point_rows([RANGE], {}, N)["w_point_anchor"].any()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"ancor": PointData(ranges(), 0.1)}, "ancor"),
        ({"anchor": PointData(ranges()[:3], 0.1)}, "shape"),
        ({"anchor": PointData(ranges(), 0.0)}, "sigma must be positive"),
        ({"anchor": PointData(ranges(), np.ones(3))}, "sigma"),
    ],
)
def test_wrong_observations_are_named(data: dict[str, PointData], message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        point_rows([RANGE], data, N)


def test_wrong_terms_are_named() -> None:
    for wrong in (replace(RANGE, name="visual"), replace(RANGE, name="two")):
        with pytest.raises(InvalidInputError, match="another"):
            FragmentSolver(BODY, N, terms=[wrong, replace(RANGE, name="two")])
    with pytest.raises(UnknownNameError, match="LeftHand"):
        FragmentSolver(BODY, N, terms=[replace(RANGE, joint="LeftHnd")])
    with pytest.raises(InvalidInputError, match="letters"):
        replace(RANGE, name="my anchor")
    with pytest.raises(InvalidInputError, match="positive"):
        replace(RANGE, size=0)
