"""Derivatives of the energy of markers agree with finite differences, and its Hessian with that of the residuals."""

from __future__ import annotations

import numpy as np
import pytest
from marker_support import planted

from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.markers.energy import MarkerModel, MarkerTrial, pose_precision


@pytest.fixture(scope="module")
def trial() -> tuple[MarkerTrial, Array]:
    truth = planted(3, frames=5)
    places = truth.places
    model = MarkerModel(truth.skeleton, places.segments, np.array(places.p_bone_marker), places.sigma_skin, 1.0)
    x = model.space.from_poses(truth.p[:, 0], truth.R)
    observed = np.array(truth.markers.p_world)
    observed[2, 3], observed[1, 5] = np.nan, observed[1, 5] + 0.2  # one is missing, one is elsewhere
    return MarkerTrial(model, observed, 60.0), model.space.retract(
        x, 0.05 * np.random.default_rng(0).standard_normal((5, model.space.size))
    )


def test_gradient_is_that_of_finite_differences(trial: tuple[MarkerTrial, Array]) -> None:
    problem, x = trial
    energy, gradient = problem.linearise(x)
    assert energy == pytest.approx(problem.total(x))
    step = 1e-6
    for frame, column in [(0, 0), (1, 4), (2, 8), (2, 30), (3, 47), (4, 65), (0, 21), (4, 12)]:
        d = np.zeros_like(gradient)
        d[frame, column] = step
        numeric = (problem.total(problem.retract(x, d)) - problem.total(problem.retract(x, -d))) / (2 * step)
        assert gradient[frame, column] == pytest.approx(numeric, rel=1e-5, abs=1e-3)


def test_rates_are_those_of_the_markers(trial: tuple[MarkerTrial, Array]) -> None:
    problem, x = trial
    model = problem.model
    rates = model.linearise(x, problem.observed).rates
    d = 1e-6 * np.random.default_rng(1).standard_normal((len(x), model.space.size))
    moved = model.points(*model.poses(model.space.retract(x, d))) - model.points(*model.poses(x))
    np.testing.assert_allclose(moved, np.einsum("tkid,td->tki", rates, d), atol=1e-10)


def test_solution_has_no_slope(trial: tuple[MarkerTrial, Array]) -> None:
    problem, x = trial
    start = np.abs(problem.gradient(x)).max()
    solved = LevenbergMarquardt(problem).solve(x, 100, 1e-12)
    assert solved.converged
    assert np.abs(problem.gradient(solved.x)).max() < 1e-4 * start


def test_prior_holds_evenness_and_hinges(trial: tuple[MarkerTrial, Array]) -> None:
    space = trial[0].model.space
    precision = pose_precision(space)
    at = {name: 3 * (i - 1) for i, name in enumerate(space.names)}
    bent = np.zeros(len(precision))
    bent[[at[name] + 1 for name in ("Spine", "Spine1", "Spine2", "Spine3")]] = 0.1
    alone = np.zeros(len(precision))
    alone[at["Spine1"] + 1] = 0.4
    assert bent @ precision @ bent < 0.1 * (alone @ precision @ alone)
    knee = at["LeftLeg"]
    assert precision[knee, knee] > 100 * precision[knee + 1, knee + 1]
    wide = pose_precision(space, 5.0)
    assert wide[knee + 1, knee + 1] == pytest.approx(precision[knee + 1, knee + 1] / 25)
    assert wide[knee, knee] == precision[knee, knee]
