"""A fragment's energy, gradient, Hessian and band against NumPy, finite differences and SciPy."""

from __future__ import annotations

from dataclasses import replace

import joint_space_support as js
import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.errors import SolverError
from rtof_kin.solve.energy.problem import TERMS, JointProblem

Array = NDArray[np.float64]
N = 8
KINDS = ("bare", "whole", "balls", "feet")


class Fragment:
    """A problem with random data bound to it, at random states."""

    def __init__(self, kind: str, step: float = 0.05, seed: int = 0, frames: int = N) -> None:
        self.built, self.problem = js.built(kind), js.problem(kind, frames)
        self.x = js.states(self.built.space, frames, seed, step)
        self.data = js.random_data(self.built, self.x, seed + 50)
        # A little away from where the observations were made.
        d = 0.02 * np.random.default_rng(seed).normal(size=(frames, self.built.space.size))
        self.x = self.built.space.retract(self.x, d)
        self.bind()

    def bind(self) -> JointProblem:
        self.problem.bind(self.data)
        return self.problem

    def terms(self, d: Array) -> list[js.Term]:
        return js.terms_about(self.built, self.x, self.data)(d)


@pytest.fixture(params=KINDS)
def fragment(request: pytest.FixtureRequest) -> Fragment:
    return Fragment(request.param)


def dense(problem: JointProblem) -> Array:
    """(N D, N D) of the Hessian that is kept."""
    N, size = problem.frames, problem.space.size
    H = np.zeros((N, size, N, size))
    for k in range(4):
        for t, block in enumerate(problem.lower_block(k)):
            H[t + k, :, t, :] = block
            H[t, :, t + k, :] = block.T
    return H.reshape(N * size, N * size)


def test_energy_equals_the_numpy_reference(fragment: Fragment) -> None:
    expected = js.value(fragment.terms(np.zeros(N * fragment.built.space.size)))
    energy, residuals = fragment.bind().value(fragment.x)
    assert tuple(energy) == TERMS
    for name, value in energy.items():
        assert value == pytest.approx(expected.get(name, 0.0), rel=1e-9, abs=1e-9), name
    assert fragment.problem.total(fragment.x) == pytest.approx(sum(expected.values()))
    assert residuals.shape == (N, len(fragment.built.names), 2)
    w = fragment.data.observation["w_visual"]
    s = w * np.sum(residuals**2, axis=-1)
    assert 0.5 * js.pseudo_huber(js.DELTA_PX)(s)[0].sum() == pytest.approx(expected.get("visual", 0.0))


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_and_hessian_equal_finite_differences(kind: str) -> None:
    fragment = Fragment(kind, frames=5)  # jerk joins four
    size = fragment.x.shape[0] * fragment.built.space.size
    g, H = js.derivatives(fragment.terms, size)
    energy, gradient = fragment.bind().linearise(fragment.x)
    assert energy == pytest.approx(fragment.problem.total(fragment.x), rel=1e-12)
    np.testing.assert_allclose(gradient.ravel(), g, atol=1e-6 * np.abs(g).max())
    np.testing.assert_allclose(fragment.problem.gradient(fragment.x), gradient, rtol=1e-9, atol=1e-9)
    scale = np.sqrt(np.outer(np.diag(H), np.diag(H))) + 1e-3
    assert np.abs((dense(fragment.problem) - H) / scale).max() < 2e-5


@pytest.mark.parametrize("damping", [1e-3, 10.0])
def test_banded_solution_equals_the_dense_one(fragment: Fragment, damping: float) -> None:
    problem = fragment.bind()
    problem.linearise(fragment.x)
    H = dense(problem) + damping * np.eye(N * problem.space.size)
    right = np.random.default_rng(0).normal(size=(N, problem.space.size))
    solved = problem.factorise(damping).solve(right)
    residual = H @ solved.ravel() - right.ravel()
    assert np.abs(residual).max() < 1e-6 * np.abs(H).max() * np.abs(solved).max()
    np.testing.assert_allclose(solved.ravel(), np.linalg.solve(H, right.ravel()), atol=1e-5 * np.abs(solved).max())


def test_values_are_added_to_the_diagonal_blocks(fragment: Fragment) -> None:
    problem = fragment.bind()
    problem.linearise(fragment.x)
    before, size = dense(problem), problem.space.size
    frames, rows, columns = np.array([[0], [0], [5]]), np.array([[3], [3], [7]]), np.arange(3)
    values = 1e3 * np.arange(1.0, 10.0).reshape(3, 3)
    problem.add_to_diagonal(frames, rows, columns, values)
    added = (dense(problem) - before).reshape(N, size, N, size)
    expected = np.zeros_like(added)
    expected[0, 3, 0, :3] = values[0] + values[1]  # at the same place twice
    expected[0, :3, 0, 3] = values[0] + values[1]
    expected[5, 7, 5, :3] = expected[5, :3, 5, 7] = values[2]
    np.testing.assert_allclose(added, expected, atol=1e-8 * np.abs(before).max())


def test_indefinite_hessian_is_a_solver_error(fragment: Fragment) -> None:
    problem = fragment.bind()
    problem.linearise(fragment.x)
    i = np.arange(problem.space.size)
    problem.add_to_diagonal(np.arange(N)[:, None], i, i, np.full((N, len(i)), -1e9))
    with pytest.raises(SolverError, match="Hessian is not positive definite"):
        problem.factorise(1e-3)


@pytest.mark.parametrize("name", ["w_visual", "w_prior", "w_root", "w_torso", "w_bone"])
def test_reweighing_equals_binding_other_weights(name: str) -> None:
    fragment = Fragment("whole")
    old = fragment.data.observation[name]
    new = np.random.default_rng(5).uniform(0, 2, old.shape)
    fragment.problem.reweigh(name, new)
    reweighed = fragment.problem.linearise(fragment.x), fragment.problem.value(fragment.x)[0]
    gradient = fragment.problem.gradient(fragment.x)
    data = replace(fragment.data, observation={**fragment.data.observation, name: new})
    fragment.problem.bind(data)
    bound = fragment.problem.linearise(fragment.x), fragment.problem.value(fragment.x)[0]
    assert reweighed[0][0] == bound[0][0]
    np.testing.assert_array_equal(reweighed[0][1], bound[0][1])
    np.testing.assert_allclose(gradient, bound[0][1], rtol=1e-9, atol=1e-9)
    assert reweighed[1] == bound[1]
