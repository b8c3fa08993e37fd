"""IPOPT on the joint-space problem: the other solver's optimum, true derivatives, limits that hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import joint_space_support as js
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.solve.joint_space.fragment import FragmentData
from rtof_kin.solve.joint_space.ipopt import Ipopt
from rtof_kin.solve.joint_space.state import Limits

Array = NDArray[np.float64]
N = 12
TIGHT = 1e-8
NO_VIOLATION = np.radians(1e-3)
"""Violation of limits that counts as none, rad."""


class Start:
    """A problem whose data are about one motion, with few contradictions, and a state near it."""

    def __init__(self, kind: str = "bare", seed: int = 1, frames: int = N) -> None:
        self.built, self.problem = js.built(kind), js.problem(kind, frames)
        space, rng = self.built.space, np.random.default_rng(seed)
        poses = planted.moving(js.BODY, frames, seed).poses
        truth = space.from_poses(poses.p_world_joint[:, 0], poses.R_world_bone)
        self.data = gentle(self.built, truth, seed, rng)
        self.problem.bind(self.data)
        self.x = space.retract(truth, np.tile(0.05 * rng.normal(size=space.size), (frames, 1)))
        self.limits = Limits(space)
        self.limits.lower = self.limits.lower + 0.15  # above where the free optimum has them

    def ipopt(self, limited: bool, most: int = 200, tolerance: float = TIGHT) -> Solved:
        return Ipopt(self.problem, self.limits if limited else None).solve(self.x, most, tolerance)

    def real_time(self, limited: bool) -> Solved:
        solver = LevenbergMarquardt(self.problem, self.limits if limited else None)
        return solver.solve(self.x, 400, 1e-9 if limited else 1e-12)

    def excess(self, x: Array) -> Array:
        return self.limits.excess(self.limits.values(x))

    def lagrangian(self, solved: Solved) -> Array:
        """(N, D) gradient, the limits' part by finite differences."""
        space, h, gradient = self.problem.space, 1e-6, np.array(self.problem.gradient(solved.x))
        for c, step in enumerate(h * np.eye(space.size)):
            steps = np.tile(step, (len(solved.x), 1))
            after, before = (self.limits.values(space.retract(solved.x, s * steps)) for s in (1, -1))
            gradient[:, c] += np.sum(solved.multipliers * (after - before), axis=1) / (2 * h)
        return gradient


def gentle(b: js.Built, x: Array, seed: int, rng: np.random.Generator) -> FragmentData:
    """Random data whose landmarks and orientations are those of states, the first with 2 px of noise."""
    data = js.random_data(b, x, seed + 7)
    p, R = js.poses(b, x)
    places = data.constant["places"].T
    points = [p[:, j] + R[:, j] @ at for (j, _), at in zip(b.shape.landmarks, places, strict=True)]
    uv = np.swapaxes(js.CAMERA.project(np.array(points)), 0, 1)
    joints = len(b.space.joints) - 1
    observation = {
        **data.observation,
        "uv_px": uv + 2 * rng.normal(size=uv.shape),
        "quat_sensor": so3.to_quat_wxyz(R[:, list(b.shape.sensors)]),
        "quat_torso": so3.to_quat_wxyz(R[:, list(b.shape.torso)]),
        "w_visual": np.full(uv.shape[:2], 1 / 9),
    }
    rest = np.tile([[1.0], [0.0], [0.0], [0.0]], joints)
    constant = {**data.constant, "precision": 10 * np.eye(3 * joints), "quat_mean": rest}
    return replace(data, observation=observation, constant=constant)


def compare(start: Start, limited: bool) -> tuple[Solved, Solved]:
    """Solutions of both; they have to be one."""
    one, two = start.ipopt(limited), start.real_time(limited)
    assert one.converged
    assert two.converged
    p, q = (start.problem.space.poses(solved.x)[0] for solved in (one, two))
    assert np.linalg.norm(p - q, axis=-1).max() < 1e-4
    energy, other = (start.problem.total(solved.x) for solved in (one, two))
    if limited:  # what is left of a violation is worth its multiplier
        other += float(np.sum(two.multipliers * start.excess(two.x)))
    assert energy == pytest.approx(other, rel=1e-6)
    return one, two


@pytest.mark.parametrize("kind, seed", [("bare", 3), ("whole", 3)])
def test_backends_find_the_same_minimum_and_multipliers_with_limits(kind: str, seed: int) -> None:
    start = Start(kind, seed)
    free = start.real_time(limited=False)
    assert np.abs(start.excess(free.x)).max() > np.radians(1), "there is nothing to hold"
    ipopt, real_time = compare(start, limited=True)
    assert start.problem.total(ipopt.x) > start.problem.total(free.x)
    # Frames share out what a limit pushes, and hardly mind how.
    pushes = [solved.multipliers.sum(axis=0) for solved in (ipopt, real_time)]
    np.testing.assert_allclose(*pushes, atol=0.02 * np.abs(pushes[0]).max())


@pytest.mark.parametrize("seed", [1, 2])
def test_limits_are_kept_and_only_active_ones_have_multipliers(seed: int) -> None:
    start = Start("bare", seed)
    solved = start.ipopt(limited=True)
    values, m = start.limits.values(solved.x), solved.multipliers
    assert np.abs(start.excess(solved.x)).max() < NO_VIOLATION
    pushes = np.abs(m) > 1e-2
    assert m.shape == values.shape
    assert 0 < np.count_nonzero(pushes) < pushes.size
    slack = np.where(m > 0, start.limits.upper - values, values - start.limits.lower)
    assert slack[pushes].max() < NO_VIOLATION, "positive at upper limits, negative at lower ones"
    first = np.abs(start.problem.gradient(start.x)).max()
    assert np.abs(start.lagrangian(solved)).max() < 1e-5 * first


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("most", [0, 3])
def test_iteration_limit_is_kept(limited: bool, most: int) -> None:
    start = Start()
    solved = start.ipopt(limited, most)
    assert solved.iterations == most
    assert not solved.converged
    if most:
        assert start.problem.total(solved.x) < start.problem.total(start.x)
    else:
        np.testing.assert_allclose(solved.x, start.x, atol=1e-12)


class Oracles:
    """The functions IPOPT calls, at variables a tenth of a radian or more from the start."""

    def __init__(self, limited: bool = True, kind: str = "whole", frames: int = 8) -> None:
        self.start = Start(kind, 2, frames)
        self.ipopt = Ipopt(self.start.problem, self.start.limits if limited else None)
        self.ipopt.solve(self.start.x, 0, TIGHT)  # sets the state that steps are from
        self.size = frames * self.start.problem.space.size
        gradient = self.start.problem.gradient(self.start.x).ravel()
        own = self("grad_f", np.zeros(self.size))[1].ravel()
        self.unit = float(own @ gradient / (gradient @ gradient))
        """m and rad of a variable: at the start the two are the same but for it."""
        np.testing.assert_allclose(own, self.unit * gradient, rtol=1e-9, atol=1e-9)
        self.y = 0.2 * np.random.default_rng(5).normal(size=self.size) / self.unit

    def __call__(self, name: str, y: Array, *more: Any) -> list[Array]:
        out = self.ipopt._functions[name](y, np.zeros((0, 0)), *more)
        return [np.asarray(v) for v in (out if isinstance(out, tuple | list) else [out])]

    def state(self, y: Array) -> Array:
        space = self.start.problem.space
        return space.retract(self.start.x, self.unit * y.reshape(-1, space.size))

    def along(self, y: Array, direction: Array) -> tuple[Array, Array]:
        """Derivatives of energy and limits in a direction."""
        h = 1e-6 / self.unit
        after, before = (self("nlp", y + s * h * direction) for s in (1, -1))
        f, g = ((a - b) / (2 * h) for a, b in zip(after, before, strict=True))
        return f.ravel(), g.ravel()


def directions(size: int, count: int) -> Array:
    return np.random.default_rng(1).normal(size=(count, size))


def test_energy_and_limits_are_those_after_the_step() -> None:
    oracles = Oracles()
    x, start = oracles.state(oracles.y), oracles.start
    energy, angles = oracles("nlp", oracles.y)
    assert energy.item() == pytest.approx(start.problem.total(x), rel=1e-9)
    np.testing.assert_allclose(angles.reshape(8, -1), start.limits.values(x), atol=1e-9)


def test_gradient_and_jacobian_equal_finite_differences() -> None:
    oracles = Oracles()
    gradient, jacobian = (oracles(name, oracles.y)[1] for name in ("grad_f", "jac_g"))
    assert jacobian.shape == (8 * len(oracles.start.limits.names), oracles.size)
    for direction in directions(oracles.size, 12):
        f, g = oracles.along(oracles.y, direction)
        assert float(gradient.ravel() @ direction) == pytest.approx(f.item(), rel=1e-5)
        np.testing.assert_allclose(jacobian @ direction, g, atol=1e-6 * np.abs(g).max())


def test_hessian_is_the_upper_gauss_newton_triangle() -> None:
    frames = 5
    oracles = Oracles(kind="bare", frames=frames)
    sparse = oracles.ipopt._functions["hess_lag"](
        oracles.y, np.zeros((0, 0)), 1.0, np.ones(frames * len(oracles.start.limits.names))
    )
    upper = np.asarray(sparse)
    assert sparse.sparsity().is_triu()
    np.testing.assert_array_equal(upper, np.triu(upper))
    about = js.terms_about(oracles.start.built, oracles.start.x, oracles.start.data)
    _, expected = js.derivatives(lambda d: about(oracles.unit * (oracles.y + d)), oracles.size, 1e-5 / oracles.unit)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(upper / scale, np.triu(expected) / scale, atol=2e-4)
    # Entries outside the sparsity pattern are zero.
    D, pattern = oracles.start.problem.space.size, np.zeros(upper.shape, dtype=bool)
    pattern[tuple(np.array(sparse.sparsity().get_triplet()))] = True
    assert np.abs((np.triu(expected) / scale)[~pattern]).max() < 2e-4
    frame = np.arange(oracles.size) // D
    assert not pattern[np.abs(frame[:, None] - frame) > 3].any()
    twice = oracles("hess_lag", oracles.y, 2.0, np.zeros(frames * len(oracles.start.limits.names)))[0]
    np.testing.assert_allclose(twice, 2 * upper)
