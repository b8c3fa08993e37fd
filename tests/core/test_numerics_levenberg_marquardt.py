"""Levenberg-Marquardt: SciPy's optimum without limits, conditions of optimality with limits."""

from __future__ import annotations

import joint_space_support as js
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.solve.joint_space.fragment import FragmentEnergy
from rtof_kin.solve.joint_space.state import Limits

Array = NDArray[np.float64]
N = 8
FINE = 1e-9


class Start:
    """A problem with data of one motion, and an initial state 0.1 rad away."""

    def __init__(self, kind: str = "all bare", frames: int = N) -> None:
        self.built, self.problem = js.built(kind), js.problem(kind, frames)
        truth = js.states(self.built.space, frames, 0, 0.02)
        self.data = js.random_data(self.built, truth, 7)
        d = 0.1 * np.random.default_rng(0).normal(size=self.built.space.size)
        self.x = self.built.space.retract(truth, np.tile(d, (frames, 1)))
        self.limits = Limits(self.built.space)
        self.limits.lower = self.limits.lower + 0.15  # violated by the free optimum
        self.problem.bind(self.data)


@pytest.fixture
def start() -> Start:
    return Start()


def apart(problem: FragmentEnergy, x: Array, y: Array) -> float:
    """Largest distance of joints, m."""
    return float(np.abs(problem.space.poses(x)[0] - problem.space.poses(y)[0]).max())


def lagrangian_gradient(start: Start, solved: Solved) -> Array:
    force = start.limits.force(solved.x, solved.multipliers)
    return np.asarray(start.problem.gradient(solved.x) + force)


# --- without limits ------------------------------------------------------------------------------


def test_minimum_is_that_of_scipy() -> None:
    start = Start(frames=5)
    problem = start.problem
    solved = LevenbergMarquardt(problem, None).solve(start.x, 400, 1e-12)
    assert solved.converged
    assert solved.multipliers.shape == (5, 0)
    assert np.abs(problem.gradient(solved.x)).max() < 1e-3
    about, D = js.terms_about(start.built, solved.x, start.data), problem.space.size

    def robust(d: Array) -> Array:
        """Residuals whose plain squares are the losses."""
        out = []
        for term in about(d):
            squared = np.sum(term.residuals**2, axis=-1, keepdims=True)
            share = np.sqrt(term.loss(squared)[0] / np.maximum(squared, 1e-30))
            out.append((share * term.residuals).ravel())
        return np.concatenate(out)

    away = np.tile(0.02 * np.random.default_rng(1).normal(size=D), 5)
    before = 0.5 * np.sum(robust(away) ** 2)
    peer = least_squares(robust, away, ftol=1e-12, max_nfev=5)
    assert before > 1.03 * peer.cost
    assert problem.total(solved.x) == pytest.approx(peer.cost, rel=1e-4)
    assert problem.total(solved.x) <= peer.cost * (1 + 1e-12)
    # SciPy has not converged after five evaluations.
    assert apart(problem, solved.x, problem.space.retract(solved.x, peer.x.reshape(5, D))) < 0.05


@pytest.mark.parametrize("kind", ["all bare", "all whole", "all balls"])
def test_energy_decreases_and_gradient_vanishes(kind: str) -> None:
    start = Start(kind)
    problem = start.problem
    solved = LevenbergMarquardt(problem, None).solve(start.x, 300, FINE)
    before = np.abs(problem.gradient(start.x)).max()
    assert solved.converged
    assert problem.total(solved.x) < 0.5 * problem.total(start.x)
    assert np.abs(problem.gradient(solved.x)).max() < 1e-4 * before


@pytest.mark.parametrize("limited", [False, True])
def test_no_iteration_increases_the_energy(start: Start, limited: bool) -> None:
    solver = LevenbergMarquardt(start.problem, start.limits if limited else None)
    energies, x = [], start.x
    for _ in range(12):
        x = solver.solve(x, 1, 0.0).x
        energies.append(solver._energy(x, np.zeros((N, 1))))
    assert np.all(np.diff(energies) <= 1e-9)


def test_iterations_are_counted_and_limited(start: Start) -> None:
    solver, before = LevenbergMarquardt(start.problem, start.limits), start.x.copy()
    for most in (0, 1, 5):
        solved = solver.solve(start.x, most, 1e-12)
        assert solved.iterations == most
        assert solved.out_of_iterations
        assert not solved.converged
    np.testing.assert_array_equal(solver.solve(start.x, 0, 1e-12).x, before)


def test_looser_tolerance_stops_earlier_and_an_optimum_takes_no_iteration(start: Start) -> None:
    solver = LevenbergMarquardt(start.problem, None)
    loose, tight = (solver.solve(start.x, 400, t) for t in (1e-2, 1e-12))
    assert loose.converged
    assert loose.iterations < tight.iterations
    again = solver.solve(tight.x, 400, 1e-9)
    assert again.converged
    assert again.iterations == 0
    np.testing.assert_array_equal(again.x, tight.x)


def test_equal_calls_give_equal_results_whatever_was_solved_between(start: Start) -> None:
    solver = LevenbergMarquardt(start.problem, start.limits)
    first = solver.solve(start.x, 30, 1e-6)
    solver.solve(js.states(start.problem.space, N, 3), 10, 1e-6)
    again = solver.solve(start.x, 30, 1e-6)
    np.testing.assert_array_equal(again.x, first.x)
    np.testing.assert_array_equal(again.multipliers, first.multipliers)
    assert again.iterations == first.iterations


# --- with limits ---------------------------------------------------------------------------------


def check_optimality(start: Start, solved: Solved) -> None:
    """Check the Karush-Kuhn-Tucker conditions."""
    limits, m = start.limits, solved.multipliers
    values = limits.values(solved.x)
    tolerance = np.radians(0.15)
    assert np.abs(limits.excess(values)).max() < tolerance
    slack = np.where(m > 0, limits.upper - values, np.where(m < 0, values - limits.lower, 0.0))
    assert np.abs(slack).max() < tolerance, "an inactive limit has a multiplier"
    first = np.abs(start.problem.gradient(start.x)).max()
    assert np.abs(lagrangian_gradient(start, solved)).max() < 1e-4 * first


@pytest.mark.parametrize("kind", ["all bare", "all whole"])
def test_limits_are_satisfied_with_the_multipliers_of_an_optimum(kind: str) -> None:
    start = Start(kind)
    free = LevenbergMarquardt(start.problem, None).solve(start.x, 300, FINE)
    beyond = np.abs(start.limits.excess(start.limits.values(free.x))).max()
    assert np.degrees(beyond) > 5
    solved = LevenbergMarquardt(start.problem, start.limits).solve(start.x, 400, 1e-8)
    assert solved.converged
    assert np.count_nonzero(solved.multipliers) > 2
    check_optimality(start, solved)
    assert start.problem.total(solved.x) > start.problem.total(free.x)


def test_inactive_limits_do_not_change_the_solution(start: Start) -> None:
    wide = Limits(start.built.space)
    wide.lower, wide.upper = wide.lower - 3.0, wide.upper + 3.0
    one, two = (LevenbergMarquardt(start.problem, limits).solve(start.x, 300, FINE) for limits in (wide, None))
    assert np.all(one.multipliers == 0)
    np.testing.assert_array_equal(one.x, two.x)


def test_multipliers_of_a_solution_warm_start_the_next(start: Start) -> None:
    solver = LevenbergMarquardt(start.problem, start.limits)
    solved = solver.solve(start.x, 400, 1e-8)
    again = solver.solve(solved.x, 400, 1e-8, solved.multipliers)
    assert again.iterations <= solved.iterations / 4
    assert apart(start.problem, again.x, solved.x) < 1e-3
    check_optimality(start, again)


def test_unrelated_multiplier_does_not_change_the_optimum(start: Start) -> None:
    # A multiplier of a start 30 degrees beyond a limit that is 10 degrees away at the optimum.
    free = LevenbergMarquardt(start.problem, None).solve(start.x, 300, FINE)
    limits, column = start.limits, 2
    limits.lower, limits.upper = limits.lower - 3.0, limits.upper + 3.0
    limits.upper[column] = limits.values(free.x)[:, column].max() + np.radians(10)
    wrong = np.zeros((N, len(limits.names)))
    wrong[:, column] = 1700.0
    solved = LevenbergMarquardt(start.problem, limits).solve(start.x, 400, 1e-8, wrong)
    check_optimality(start, solved)
    assert start.problem.total(solved.x) == pytest.approx(start.problem.total(free.x), rel=1e-6)


def test_convergence_is_not_claimed_with_violated_limits(start: Start) -> None:
    for tolerance in (1e-1, 1e-2, 1e-4):
        solved = LevenbergMarquardt(start.problem, start.limits).solve(start.x, 400, tolerance)
        excess = np.abs(start.limits.excess(start.limits.values(solved.x))).max()
        assert not (solved.converged and np.degrees(excess) > 0.1), np.degrees(excess)
