"""The fixed-lag smoother: equal to a fragment without marginalisation, and consistent with it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.choices import Compile
from rtof_kin.core.errors import SolverError
from rtof_kin.inertial.root_path import FEET, ContactPoints
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.initial_guess import InertialGuidedIK, InitialGuess, initial_guess
from rtof_kin.solve.joint_space.fixed_lag import FixedLagSmoother, marginalised
from rtof_kin.solve.joint_space.fragment import MEMORY, MarginalPrior
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T = 30
EXACTLY = JointSpaceSettings(sigma_reprojection=3.0, tolerance=1e-14, max_iterations=200)


@cache
def scene() -> tuple[InitialGuess, Any, Any]:
    """Initial guess, keypoints and sensors of a short motion."""
    truth = planted.human(BODY, T, 0)
    seen = planted.keypoints(truth.poses, 3.0)
    imus = planted.bone_imus(BODY, truth.poses, planted.LIMBS, 3.0, 0.4)
    start = InertialGuidedIK(BODY).refine(planted.lifted_poses(truth), imus)
    return initial_guess(start, seen, imus, BODY), seen, imus


def observations(settings: JointSpaceSettings = EXACTLY) -> Observations:
    guess, seen, imus = scene()
    nowhere = ContactPoints(FEET, np.full((T, len(FEET), 3), np.nan))
    return Observations(BODY, T, settings, guess, seen, imus, nowhere)


def row(data: Observations, t: int) -> dict[str, Array]:
    """Observations of a frame, landmarks weighted by confidence alone."""
    rows = {name: values[t] for name, values in data.rows.items()}
    return rows | {"w_visual": data.confidence[t] * (rows["w_visual"] > 0)}


def fed(
    data: Observations,
    frames: int,
    stop: int = T,
    iterations: int = 2,
    start: Array | None = None,
    solved: int | None = None,
) -> FixedLagSmoother:
    """A smoother after the first `stop` frames, begun at `start` or at its own predictions."""
    smoother = FixedLagSmoother(data, frames, solved)
    for t in range(stop):
        x = smoother.predicted() if start is None and t > 1 else (data.start if start is None else start)[t]
        smoother.append(x, row(data, t), data.a_world[t], data.w_acceleration[t])
        if iterations:
            smoother.iterate(iterations)
    return smoother


def apart(data: Observations, x: Array, y: Array) -> float:
    """Largest difference of states, m or rad."""
    return float(np.abs(data.space.difference(x, y)).max())


def farthest(data: Observations, x: Array, y: Array) -> float:
    """Largest distance of a joint between states, m."""
    ends = [data.space.poses(states)[0] for states in (x, y)]
    return float(np.linalg.norm(ends[0] - ends[1], axis=-1).max())


def test_a_window_as_long_as_the_recording_gives_the_result_of_one_fragment() -> None:
    guess, seen, imus = scene()
    data = observations()
    batch = FragmentSolver(BODY, 2 * T, EXACTLY).solve(guess, seen, imus).poses
    smoother = fed(data, T)
    assert smoother.finish(200)
    expected = data.space.from_poses(batch.p_world_joint[:, 0], batch.R_world_bone)
    assert apart(data, smoother.x, expected) < 1e-6


def test_marginalisation_keeps_the_covariance_of_the_remaining_frames() -> None:
    """At the same states and weights the Schur complement loses nothing."""
    data = observations()
    long, short = fed(data, 12, 12, 0, data.start), fed(data, 8, 12, 0, data.start)
    long.finish(1), short.finish(1)
    long.solved, short.solved = data.start[:12].copy(), data.start[4:12].copy()
    expected, found = long.covariance(4), short.covariance(0)
    scale = np.sqrt(np.einsum("tii->ti", expected))
    np.testing.assert_allclose(
        found / (scale[:, :, None] * scale[:, None]), expected / (scale[:, :, None] * scale[:, None]), rtol=0, atol=2e-3
    )


def test_marginalisation_keeps_the_step_of_the_remaining_frames() -> None:
    """Newton's step of all frames and of those that remain, at the same states."""
    data = observations(replace(EXACTLY, limits=False))
    whole = fed(data, 9, 9, 0, data.start)
    whole._early[:] = 1.0
    whole._window.bind(whole._data())
    whole._leaving.bind(whole._first_terms())
    slope = whole.prior.at(data.space, whole.x[:MEMORY])[1]
    prior = marginalised(whole.prior, slope, whole._leaving, None, whole.x[:4], np.zeros((4, 0)))[0]
    whole._window.condition(whole.prior)
    gradient = whole._window.linearise(whole.x)[1]
    step = whole._window.factorise(1e-9).solve(-gradient)
    rest = fed(data, 8, 9, 0, data.start)
    rest._early[:] = 1.0
    np.testing.assert_allclose(rest.prior.precision, prior.precision, rtol=1e-9, atol=1e-3)
    rest._window.bind(rest._data())
    rest._window.condition(rest.prior)
    found_gradient = rest._window.linearise(rest.x)[1]
    found = rest._window.factorise(1e-9).solve(-found_gradient)
    np.testing.assert_allclose(found, step[1:], rtol=0, atol=1e-6)


def test_frames_before_the_solved_ones_follow_as_in_a_step_of_all() -> None:
    """At the same states: Newton's step, and the covariances."""
    data = observations(replace(EXACTLY, limits=False))
    whole, part = (fed(data, 14, 14, 0, data.start, solved) for solved in (None, 8))
    for smoother in (whole, part):
        smoother._early[:] = 1.0
        smoother._window.bind(smoother._data())
        smoother._window.condition(smoother.prior)
    expected, found = whole.covariance(0), part.covariance(0)
    scale = np.sqrt(np.einsum("tii->ti", expected))
    np.testing.assert_allclose((found - expected) / (scale[:, :, None] * scale[:, None]), 0.0, rtol=0, atol=2e-3)
    np.testing.assert_allclose(part.covariance(3), found[3:], rtol=1e-9, atol=1e-12)
    for smoother in (whole, part):
        gradient = smoother._window.linearise(smoother.solved)[1]
        step = smoother._window.factorise(1e-9).solve(-gradient)
        smoother.solved, smoother._smoothed = data.space.retract(smoother.solved, step), None
    assert apart(data, part.x, whole.x) < 1e-5
    assert apart(data, part.x, data.start[:14]) > 1e-2
    part.iterate(20)
    settled = part.x
    for smoother in (whole, part):
        before, shift = smoother.solved[:, :3], np.array([0.1, 0.0, 0.0])
        smoother.translate(shift)
        np.testing.assert_allclose(smoother.solved[:, :3], before + shift, rtol=0, atol=1e-9)
    part.iterate(20)
    assert np.abs(part.x[:, :3] - settled[:, :3]).max() < 0.03, "what is known from before was not moved"


def test_frames_that_are_solved_once_end_where_all_of_them_do() -> None:
    data = observations()
    part, whole = fed(data, T, solved=16), fed(data, T)
    assert part.first == T - 16
    part.finish(20), whole.finish(20)
    assert farthest(data, part.x, whole.x) < 0.02


def test_a_short_window_follows_all_frames() -> None:
    data = observations()
    short, whole = fed(data, 8, iterations=1), fed(data, T)
    short.finish(5)
    assert whole.finish(200)
    assert apart(data, short.x[-1:], whole.x[-1:]) < np.radians(0.5)


def test_the_gradient_of_the_prior_is_that_of_its_energy() -> None:
    data, rng = observations(), np.random.default_rng(0)
    space, size = data.space, MEMORY * data.space.size
    root = rng.normal(size=(size, size))
    prior = MarginalPrior(data.start[:MEMORY], root @ root.T, rng.normal(size=size))
    x = space.retract(prior.x, 0.2 * rng.normal(size=(MEMORY, space.size)))
    gradient = prior.at(space, x)[1]
    direction = rng.normal(size=gradient.shape)
    h = 1e-6
    ahead, behind = (prior.at(space, space.retract(x, s * h * direction))[0] for s in (1, -1))
    assert np.sum(gradient * direction) == pytest.approx((ahead - behind) / (2 * h), rel=1e-5)


def test_compiled_and_plain_windows_agree() -> None:
    kinds: tuple[Compile, Compile] = ("auto", "never")
    ends = [fed(observations(replace(EXACTLY, compile=kind)), 6, 12, 2).x for kind in kinds]
    assert apart(observations(), *ends) < 1e-8


def test_frames_without_observations_go_on_and_come_back() -> None:
    data = observations()
    smoother = fed(data, 8, 14)
    for _ in range(4):
        smoother.append(smoother.predicted(), {"w_prior": np.ones(())}, np.zeros((8, 3)), np.zeros(8))
        assert np.isfinite(smoother.x).all()
        smoother.iterate(1)
    for t in range(18, T):
        smoother.append(smoother.predicted(), row(data, t), data.a_world[t], data.w_acceleration[t])
        smoother.iterate(2)
    whole = fed(data, T)
    whole.finish(200)
    assert farthest(data, smoother.x[-1:], whole.x[-1:]) < 0.05


def test_a_restart_forgets_the_past() -> None:
    data = observations()
    smoother = fed(data, 8, 14)
    smoother.restart(data.start[14])
    assert not smoother.inside.any()
    assert not smoother.prior.precision.any()
    for t in range(14, T):
        smoother.append(data.start[t], row(data, t), data.a_world[t], data.w_acceleration[t])
        smoother.iterate(2)
    whole = fed(data, T)
    whole.finish(200)
    assert farthest(data, smoother.x[-1:], whole.x[-1:]) < 0.05


def test_the_size_of_the_landmarks_errors_is_estimated() -> None:
    smoother = fed(observations(JointSpaceSettings()), 10)
    assert 2.0 < smoother.sigma_px < 5.0


def test_states_that_are_not_finite_are_refused() -> None:
    data = observations()
    smoother = fed(data, 8, 10)
    before = smoother.x.copy()
    smoother.rows["uv_px"][-1] = np.nan
    with pytest.raises(SolverError):
        smoother.iterate(1)
    np.testing.assert_array_equal(smoother.x, before)
