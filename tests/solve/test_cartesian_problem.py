"""The programme's functions: energy, gradient and Hessian of random fragments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from cartesian_support import parameters
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve.cartesian.problem import TERMS, FragmentProblem, fragment_problem, rigid_pairs
from rtof_kin.solve.settings import CartesianSettings

Array = NDArray[np.float64]
SKELETON = SkeletonModel.human36m()
N, J = 8, len(SKELETON.names)
BONES = tuple(
    (joint, kinematics.children_of(SKELETON.parents, joint)[0]) for joint in SKELETON.index("LElbow", "RKnee", "LHip")
)
RATE, SIGMA_PX = 60.0, 7.0
SETTINGS = {
    "default": CartesianSettings(),
    "plain squares, no visual": CartesianSettings(k_V=0.0, huber_reprojection=None),
    "printed": CartesianSettings.paper(),
}


def problem_of(settings: CartesianSettings) -> FragmentProblem:
    return fragment_problem(SKELETON.parents, N, BONES, settings)


def fragment(problem: FragmentProblem, seed: int = 0) -> tuple[Array, dict[str, Array]]:
    """Positions (N, J, 3) off the truth by centimetres, and parameters with weights of every size."""
    X = planted.moving(SKELETON, N, seed).poses.p_world_joint
    return X + np.random.default_rng(seed).normal(size=X.shape) * 0.02, parameters(problem, X, seed)


def numpy_terms(problem: FragmentProblem, X: Array, v: dict[str, Array]) -> dict[str, float]:
    """The six weighted terms, written once more from the module's text."""
    s, cam = problem.settings, planted.camera()
    uv = v["uv_px"].T.reshape(N, J, 2)
    squared = np.sum((cam.project(X) - uv) ** 2, axis=-1) / SIGMA_PX**2
    if s.huber_reprojection is not None:
        d2 = s.huber_reprojection**2
        squared = 2 * d2 * (np.sqrt(1 + squared / d2) - 1)
    acceleration = bone = 0.0
    for k, (j, child) in enumerate(BONES):
        rows = slice(3 * k, 3 * k + 3)
        point = X[:, j] + v["shares"][k] * (X[:, child] - X[:, j])
        r = np.diff(point, n=2, axis=0) * RATE**2 - v["a_world"][rows].T
        acceleration += np.sum(v["w_acceleration"][k] @ r**2) / s.sigma_acceleration**2
        r = X[:, child] - X[:, j] - v["b_world"][rows].T
        bone += np.sum(v["w_bone"][k] @ r**2) / s.sigma_bone**2
    jerk = np.diff(X, n=3, axis=0) * RATE**3
    if s.as_printed:
        jerk = jerk - v["j_world"].T.reshape(N - 3, J, 3)
    a, b = np.array(problem.pairs).T
    length = np.linalg.norm(X[:, b] - X[:, a], axis=-1) - v["lengths"]
    P = v["p_prior"].T.reshape(N, J, 3)
    if s.as_printed:
        prior = (X - P) / s.sigma_prior
    else:
        parents = list(SKELETON.parents[1:])
        bones, theirs = X[:, 1:] - X[:, parents], P[:, 1:] - P[:, parents]
        root = (X[:, :1] - P[:, :1]) / s.sigma_prior
        prior = np.concatenate([root, (bones - theirs) / s.sigma_prior_bone], axis=1)
    values = {
        "visual": float(v["w_visual"] @ squared.ravel()),
        "acceleration": acceleration,
        "bone": bone,
        "smooth": float(v["w_smooth"] @ np.sum(jerk**2, axis=(1, 2))) / s.sigma_jerk**2,
        "length": float(v["w_length"] @ np.sum(length**2, axis=1)) / s.sigma_length**2 * (not s.as_printed),
        "prior": float(np.mean(prior**2)),
    }
    return {term: k * values[term] for term, k in zip(TERMS, v["k"], strict=True)}


def value(problem: FragmentProblem, X: Array, p: Array) -> tuple[Array, Array]:
    """Energy of each term, and the gradient (n,) frame by frame."""
    energy, ordered = (np.array(one).ravel() for one in problem.value(X.ravel()[problem.order], p))
    gradient = np.empty_like(ordered)
    gradient[problem.order] = ordered
    return energy, gradient


def central_differences(f: Callable[[Array], Array], x: Array, step: float) -> Array:
    """Derivative (..., n) of f at x."""
    columns = []
    for i in range(len(x)):
        d = np.zeros(len(x))
        d[i] = step
        columns.append((f(x + d) - f(x - d)) / (2 * step))
    return np.stack(columns, axis=-1)


def hessian(problem: FragmentProblem, X: Array, p: Array) -> Array:
    """The full symmetric matrix, frame by frame."""
    lower = np.array(problem.hessian(X.ravel()[problem.order], p))
    natural = np.argsort(problem.order)
    return np.asarray(lower + np.tril(lower, -1).T)[np.ix_(natural, natural)]


@pytest.mark.parametrize("name", SETTINGS)
def test_terms_equal_numpy(name: str) -> None:
    problem = problem_of(SETTINGS[name])
    X, values = fragment(problem)
    energy, _ = value(problem, X, problem.pack(values))
    peer = numpy_terms(problem, X, values)
    assert tuple(peer) == TERMS
    np.testing.assert_allclose(energy, list(peer.values()), rtol=1e-10, atol=1e-12)
    assert energy[-1] > 0


@pytest.mark.parametrize("name", SETTINGS)
def test_gradient_equals_finite_differences(name: str) -> None:
    problem = problem_of(SETTINGS[name])
    X, values = fragment(problem, seed=1)
    p = problem.pack(values)
    gradient = value(problem, X, p)[1]
    peer = central_differences(lambda x: value(problem, x, p)[0].sum(), X.ravel(), 1e-6)
    np.testing.assert_allclose(gradient, peer, rtol=1e-6, atol=1e-7 * np.abs(gradient).max())


def test_hessian_is_exact_for_linear_residuals() -> None:
    # Distances are not linear, but their Hessian is taken exactly.
    problem = problem_of(SETTINGS["plain squares, no visual"])
    X, values = fragment(problem, seed=2)
    p = problem.pack(values)
    peer = central_differences(lambda x: value(problem, x, p)[1], X.ravel(), 1e-5)
    H = hessian(problem, X, p)
    np.testing.assert_allclose(H, peer, atol=1e-6 * np.abs(peer).max())


def test_visual_hessian_is_exact_for_zero_residuals_and_positive() -> None:
    problem = problem_of(CartesianSettings(as_printed=True, k_I=0.0))
    X, values = fragment(problem, seed=3)
    assert np.linalg.eigvalsh(hessian(problem, X, problem.pack(values))).min() > 0
    values["uv_px"] = planted.camera().project(X).reshape(-1, 2).T
    p = problem.pack(values)
    peer = central_differences(lambda x: value(problem, x, p)[1], X.ravel(), 1e-6)
    np.testing.assert_allclose(hessian(problem, X, p), peer, atol=1e-5 * np.abs(peer).max())


def test_a_problem_without_sensors_has_no_inertial_terms() -> None:
    problem = fragment_problem(SKELETON.parents, N, (), CartesianSettings())
    assert problem.parameters["a_world"].shape == (0, N - 2)
    X, values = fragment(problem)
    energy = dict(zip(TERMS, value(problem, X, problem.pack(values))[0], strict=True))
    assert energy["acceleration"] == energy["bone"] == 0
    assert energy["visual"] > 0


def test_problem_is_built_once_per_tree() -> None:
    taller = SKELETON.with_height(1.9)
    same = fragment_problem(taller.parents, N, BONES, CartesianSettings())
    assert same is problem_of(CartesianSettings())
    assert same is problem_of(CartesianSettings(k_V=0.5, k_S=0.0))
    assert same is not problem_of(CartesianSettings(sigma_jerk=100.0))


def test_rigid_pairs_have_constant_distances() -> None:
    p = planted.moving(SKELETON, 50, radians=0.6).poses.p_world_joint
    spread = np.linalg.norm(p[:, :, None] - p[:, None], axis=-1).std(axis=0)
    rigid = {(a, b) for a in range(J) for b in range(a + 1, J) if spread[a, b] < 1e-9}
    assert {(min(pair), max(pair)) for pair in rigid_pairs(SKELETON.parents)} == rigid
    assert len(rigid_pairs(SKELETON.parents)) == len(rigid)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"k_V": -0.1}, "k_V must not be negative"),
        ({"k_A": np.inf}, "k_A must not be negative, and finite"),
        ({"huber_reprojection": 0.0}, "huber_reprojection must be positive; None stands for plain"),
        ({"sigma_reprojection_range": (9.0, 2.0)}, "the smaller one first"),
        ({"sigma_bone": 0.0}, "sigma_bone must be positive"),
        ({"sigma_prior": np.nan}, "sigma_prior must be positive"),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"max_iterations": -1}, "max_iterations not negative"),
    ],
)
def test_invalid_settings_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        replace(CartesianSettings(), **change)


def test_paper_settings() -> None:
    s = CartesianSettings.paper()
    assert s.huber_reprojection is None
    weights = {"visual": 0.9, "acceleration": 0.05, "bone": 0.02, "smooth": 0.03, "length": 0.0, "prior": 1.0}
    assert s.term_weights() == pytest.approx(weights)
