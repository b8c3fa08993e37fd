"""The compiled problem against the one on whole arrays: energy, gradient, Hessian, steps."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace

import joint_space_support as js
import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics import c_compiler as compiled
from rtof_kin.core.numerics import simd
from rtof_kin.core.numerics.banded import Store
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.compiled.fragment_energy import built_energy
from rtof_kin.solve.compiled.simd_problem import SimdFunctions, SimdProblem
from rtof_kin.solve.energy.frame_energy import FrameEnergy, Shape
from rtof_kin.solve.energy.problem import JointProblem
from rtof_kin.solve.energy.state import StateSpace
from rtof_kin.solve.joint_space.limits import Limits

Array = NDArray[np.float64]
MOVING = ("Hips", "Spine", "LeftArm", "LeftForeArm", "RightUpLeg", "RightLeg")
SEEN = ("Hips", "LeftForeArm", "LeftHand", "RightLeg", "RightFoot", "LeftToe", "Nose")


def a_body(sensors: tuple[str, ...], hinged: bool, anchored: bool, seen: tuple[str, ...] = SEEN) -> js.Built:
    """A body whose trunk, arm and leg alone move: little to compile. Unseen, it has a foothold."""
    index, landmarks = js.BODY.index, js.BODY.landmarks
    shape = Shape(
        landmarks=tuple((index(landmarks[n][0])[0], n in js.BODY.names) for n in seen),
        sensors=tuple(index(*sensors)), torso=tuple(index("Hips")) if anchored else (),
        bones=(tuple(index("RightLeg", "RightFoot")),) if anchored else (),  # type: ignore[arg-type]
        feet=tuple(index("RightFoot")) if anchored else (),
        robust_orientation=js.DELTA_ORIENTATION, floor_cutoff=js.CUTOFF,
        contacts=() if seen else tuple(index("RightFoot")),
    )  # fmt: skip
    space = StateSpace(js.BODY, MOVING, hinged)
    return js.Built(space, shape, FrameEnergy(space, shape), seen)


KINDS = {
    "whole": lambda: a_body(("Hips", "LeftForeArm", "RightUpLeg", "RightLeg"), True, True),
    "balls": lambda: a_body(("LeftForeArm",), False, True),
    "bare": lambda: a_body((), True, False),
    "feet": lambda: a_body(("Hips", "RightLeg"), True, False, ()),
}


class Both:
    """A kind of body with its two problems of N frames."""

    def __init__(self, kind: str) -> None:
        self.built, self._plain, self._simd = KINDS[kind](), {}, {}  # type: ignore[var-annotated]
        self.limits = Limits(self.built.space)
        functions = SimdFunctions.compiled(self.built.energy, js.DELTA_ACCELERATION)
        assert functions is not None
        self.functions = functions

    def problems(self, frames: int) -> tuple[JointProblem, SimdProblem]:
        if frames not in self._plain:
            b, sigma = self.built, js.sigma_jerk(self.built.space)
            self._plain[frames] = JointProblem(
                b.space, b.energy.functions(), b.energy, frames, sigma, js.DELTA_ACCELERATION
            )
            self._simd[frames] = SimdProblem(self.functions, b.energy, frames, sigma)
        return self._plain[frames], self._simd[frames]

    def bound(
        self, frames: int = 11, step: float = 0.05, seed: int = 0
    ) -> tuple[JointProblem, SimdProblem, Array]:
        """Both with the same data, and a state beside where those come from."""
        x = js.states(self.built.space, frames, seed, step)
        data = js.random_data(self.built, x, seed + 50)
        d = 0.02 * np.random.default_rng(seed).normal(size=(frames, self.built.space.size))
        for problem in self.problems(frames):
            problem.bind(data)
        return *self.problems(frames), self.built.space.retract(x, d)


@pytest.fixture(scope="module", params=list(KINDS))
def both(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Both]:
    if not any(map(shutil.which, compiled.COMPILERS)):
        pytest.skip("there is no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("RTOF_KIN_COMPILE", raising=False)
        patch.setattr(simd, "_OPTIONS", ("-O1", "-fno-math-errno"))
        if not Store.available():
            pytest.skip("banded systems are not compiled on this machine")
        yield Both(request.param)


def assert_same(own: Array, expected: Array, share: float = 1e-10) -> None:
    np.testing.assert_allclose(own, expected, rtol=0, atol=share * (1e-9 + np.abs(expected).max()))


# --- energy, gradient, Hessian -------------------------------------------------------------------


@pytest.mark.parametrize("frames", [8, 11, 16])
@pytest.mark.parametrize("step", [0.0, 0.05, 0.8])
def test_energy_and_gradient_are_those_on_whole_arrays(both: Both, frames: int, step: float) -> None:
    plain, own, x = both.bound(frames, step)
    energy, residuals = own.value(x)
    expected, expected_residuals = plain.value(x)
    assert energy == pytest.approx(expected, rel=1e-11, abs=1e-11)
    np.testing.assert_allclose(residuals, expected_residuals, atol=1e-9)
    assert own.total(x) == pytest.approx(plain.total(x), rel=1e-12)
    assert_same(own.gradient(x), plain.gradient(x))


@pytest.mark.parametrize("frames", [8, 11, 16])
@pytest.mark.parametrize("step", [0.0, 0.05, 0.8])
def test_the_hessian_is_that_on_whole_arrays(both: Both, frames: int, step: float) -> None:
    plain, own, x = both.bound(frames, step)
    for problem in (plain, own):
        energy, gradient = problem.linearise(x)
        assert energy == pytest.approx(plain.total(x), rel=1e-12)
        assert_same(gradient, plain.gradient(x))
    for k in range(4):
        expected = plain.lower_block(k)
        assert np.abs(expected).max() > 0
        assert_same(own.lower_block(k), expected, 1e-12)


def test_the_gradient_is_that_of_the_energy_by_finite_differences(both: Both) -> None:
    _, own, x = both.bound()
    gradient, rng = own.gradient(x), np.random.default_rng(0)
    for _ in range(10):
        d = rng.normal(size=gradient.shape)
        plus, minus = (own.total(own.retract(x, s * 1e-6 * d)) for s in (1, -1))
        assert (plus - minus) / 2e-6 == pytest.approx(np.sum(gradient * d), rel=1e-4)


def test_a_state_moves_as_in_its_space(both: Both) -> None:
    _, own, x = both.bound()
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-12, 1e-7, 1e-3, 1.0, 4.0):
        d = size * rng.normal(size=(len(x), own.space.size))
        np.testing.assert_allclose(own.retract(x, d), own.space.retract(x, d), atol=1e-14)
    d[3:5] = 0.0  # nothing beside something
    np.testing.assert_allclose(own.retract(x, d), own.space.retract(x, d), atol=1e-14)


def test_other_weights_and_other_data_are_taken_up(both: Both) -> None:
    plain, own, x = both.bound()
    before = own.total(x)
    weights = np.random.default_rng(1).uniform(0, 2, (len(x), len(both.built.shape.landmarks)))
    for problem in (plain, own):
        problem.reweigh("w_visual", weights)
        problem.reweigh("knee_visual", np.full(len(x), 0.7))
        problem.reweigh("w_prior", np.full(len(x), 0.3))
    assert own.total(x) == pytest.approx(plain.total(x), rel=1e-12)
    assert own.total(x) != pytest.approx(before, rel=1e-6)
    data = js.random_data(both.built, x, 9)
    changed = replace(data, rate_hz=50.0, w_jerk=np.linspace(0, 1, len(x) - 3))
    for problem in (plain, own):
        problem.bind(changed)
        problem.linearise(x)
    assert own.total(x) == pytest.approx(plain.total(x), rel=1e-12)
    for k in range(4):
        assert_same(own.lower_block(k), plain.lower_block(k), 1e-12)


def test_two_problems_of_other_lengths_do_not_disturb_each_other(both: Both) -> None:
    _, one, x = both.bound(11)
    energy, gradient = one.total(x), one.gradient(x)
    _, two, y = both.bound(16, seed=3)
    two.linearise(y)
    one.bind(js.random_data(both.built, js.states(both.built.space, 11, 0), 50))
    assert one.total(x.copy()) == energy
    np.testing.assert_array_equal(one.gradient(x.copy()), gradient)


# --- the banded system ---------------------------------------------------------------------------


@pytest.mark.parametrize("damping", [1e-3, 10.0])
def test_steps_are_those_of_the_dense_system(both: Both, damping: float) -> None:
    _, own, x = both.bound()
    _, gradient = own.linearise(x)
    N, D = gradient.shape
    H = np.zeros((N, D, N, D))
    for k in range(4):
        for t, block in enumerate(own.lower_block(k)):
            H[t + k, :, t, :], H[t, :, t + k, :] = block, block.T
    dense = H.reshape(N * D, N * D) + damping * np.eye(N * D)
    for _ in range(2):  # the Hessian stays
        solved = own.factorise(damping).solve(gradient).ravel()
        residual = dense @ solved - gradient.ravel()
        assert np.abs(residual).max() < 1e-9 * np.abs(dense).max() * np.abs(solved).max()


def test_what_is_added_to_the_diagonal_blocks_is_there(both: Both) -> None:
    plain, own, x = both.bound()
    rng, D, N = np.random.default_rng(0), both.built.space.size, len(x)
    frames = np.array([0, 3, 3, N - 1])[:, None, None]
    first = rng.integers(0, D - 3, 4)[:, None, None]
    values = rng.normal(size=(4, 3, 3))
    values = 1e4 * (values + np.swapaxes(values, 1, 2))
    where = frames, first + np.arange(3)[:, None], first + np.arange(3)
    for problem in (plain, own):
        problem.linearise(x)
        problem.add_to_diagonal(*where, values)
    for k in range(2):
        assert_same(own.lower_block(k), plain.lower_block(k), 1e-12)
    own.linearise(x)
    before = own.lower_block(0)
    plain.linearise(x)
    assert_same(before, plain.lower_block(0), 1e-12)


def test_a_hessian_that_is_not_positive_is_refused(both: Both) -> None:
    _, own, x = both.bound()
    own.linearise(x)
    i = np.arange(both.built.space.size)
    own.add_to_diagonal(np.array([[5]]), i, i, np.full((1, len(i)), -1e12))
    with pytest.raises(SolverError, match="not positive definite"):
        own.factorise(1e-3)


# --- all together --------------------------------------------------------------------------------


def test_fragments_are_solved_alike(both: Both) -> None:
    plain, own, x = both.bound(16)
    expected = LevenbergMarquardt(plain, both.limits).solve(x, 40, 1e-6)
    solved = LevenbergMarquardt(own, both.limits).solve(x, 40, 1e-6)
    assert solved.iterations == expected.iterations
    assert own.total(solved.x) == pytest.approx(plain.total(expected.x), rel=1e-8)


def test_a_problem_without_code_is_the_one_on_whole_arrays(both: Both) -> None:
    shape = both.built.shape
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_COMPILE", "never")
        jerk = (1.25,) * (1 + len(StateSpace(js.BODY, MOVING, True).names))
        made = built_energy(js.BODY.name, shape, MOVING, 8, True, "auto", jerk, 2.0)
    assert type(made) is JointProblem
