"""`FragmentEnergy`: the compiled implementation against the reference, for every kind of residual."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace

import joint_space_support as js
import numpy as np
import pytest
from numpy.typing import NDArray

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
        sensors=tuple(index(*sensors)),
        torso=tuple(index("Hips")) if anchored else (),
        bones=(tuple(index("RightLeg", "RightFoot")),) if anchored else (),  # type: ignore[arg-type]
        feet=tuple(index("RightFoot")) if anchored else (),
        robust_orientation=js.DELTA_ORIENTATION,
        floor_cutoff=js.CUTOFF,
        contacts=() if seen else tuple(index("RightFoot")),
    )
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
        self.functions = functions

    def problems(self, frames: int) -> tuple[JointProblem, SimdProblem]:
        if frames not in self._plain:
            b, sigma = self.built, js.sigma_jerk(self.built.space)
            self._plain[frames] = JointProblem(
                b.space, b.energy.functions(), b.energy, frames, sigma, js.DELTA_ACCELERATION
            )
            self._simd[frames] = SimdProblem(self.functions, b.energy, frames, sigma)
        return self._plain[frames], self._simd[frames]

    def bound(self, frames: int = 11, step: float = 0.05, seed: int = 0) -> tuple[JointProblem, SimdProblem, Array]:
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


@pytest.mark.parametrize("frames", [8, 11, 16])
@pytest.mark.parametrize("step", [0.0, 0.05, 0.8])
def test_both_implementations_give_the_same_numbers(both: Both, frames: int, step: float) -> None:
    plain, own, x = both.bound(frames, step)
    (energy, residuals), (expected, expected_residuals) = own.value(x), plain.value(x)
    assert energy == pytest.approx(expected, rel=1e-11, abs=1e-11)
    np.testing.assert_allclose(residuals, expected_residuals, atol=1e-9)
    for total, gradient in (own.linearise(x), plain.linearise(x)):
        assert total == pytest.approx(plain.total(x), rel=1e-12)
        assert_same(gradient, plain.gradient(x))
    assert_same(own.gradient(x), plain.gradient(x))
    for k in range(4):
        assert np.abs(plain.lower_block(k)).max() > 0
        assert_same(own.lower_block(k), plain.lower_block(k), 1e-12)
    right = np.ones_like(own.gradient(x))
    steps = [problem.factorise(10.0).solve(right).ravel() for problem in (own, plain)]
    assert_same(*steps, 1e-6)


def test_retraction_equals_the_state_spaces(both: Both) -> None:
    _, own, x = both.bound()
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-12, 1e-7, 1e-3, 1.0, 4.0):
        d = size * rng.normal(size=(len(x), own.space.size))
        np.testing.assert_allclose(own.retract(x, d), own.space.retract(x, d), atol=1e-14)
    d[3:5] = 0.0  # nothing beside something
    np.testing.assert_allclose(own.retract(x, d), own.space.retract(x, d), atol=1e-14)


def test_other_weights_and_data_give_the_same_numbers(both: Both) -> None:
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


def test_both_solve_a_fragment_alike(both: Both) -> None:
    plain, own, x = both.bound(16)
    expected = LevenbergMarquardt(plain, both.limits).solve(x, 40, 1e-6)
    solved = LevenbergMarquardt(own, both.limits).solve(x, 40, 1e-6)
    assert solved.iterations == expected.iterations
    assert own.total(solved.x) == pytest.approx(plain.total(expected.x), rel=1e-8)


def test_energy_without_a_compiler_is_the_reference(both: Both) -> None:
    shape = both.built.shape
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_COMPILE", "never")
        jerk = (1.25,) * (1 + len(StateSpace(js.BODY, MOVING, True).names))
        prior = js.BODY.table.prior
        rougher = replace(prior, sigma_jerk=2 * prior.sigma_jerk, sigma_root_jerk=3 * prior.sigma_root_jerk)
        made, rough = (
            built_energy(js.BODY.name, shape, MOVING, 8, True, "auto", jerk, 2.0, p) for p in (prior, rougher)
        )
    assert type(made) is JointProblem
    np.testing.assert_allclose(rough.sigma_jerk[3:] / made.sigma_jerk[3:], 2.0)
    np.testing.assert_allclose(rough.sigma_jerk[:3] / made.sigma_jerk[:3], 3.0)
