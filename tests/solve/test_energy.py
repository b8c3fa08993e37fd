"""The joint-space energy, interpreted and compiled: NumPy's description, finite differences, dense linear algebra."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import joint_space_support as js
import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics import c_compiler, simd
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.joint_space import fragment as fragment_module
from rtof_kin.solve.joint_space.fragment import MADE_BY, FragmentData, FragmentEnergy, built_energy, made_of
from rtof_kin.solve.joint_space.state import Limits, StateSpace
from rtof_kin.solve.joint_space.terms import BUILT_IN, jerk_sigma
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.terms import MotionTerm, PointTerm, position

Array = NDArray[np.float64]
N = 8
KINDS = ("bare", "whole", "balls", "feet")


@pytest.fixture(scope="module")
def compiling(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compilation turned on, quickly."""
    if not any(map(shutil.which, c_compiler.COMPILERS)):
        pytest.skip("there is no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RTOF_KIN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("RTOF_KIN_COMPILE", raising=False)
        patch.setattr(simd, "_OPTIONS", ("-O0",))
        yield


class Fragment:
    """A problem with random data bound to it, at random states a little away from where those were made."""

    def __init__(self, kind: str, compile: str = "never", frames: int = N, step: float = 0.05, seed: int = 0) -> None:
        self.built, self.problem = js.built(kind), js.problem(kind, frames, compile)  # type: ignore[arg-type]
        x = js.states(self.built.space, frames, seed, step)
        self.data = js.random_data(self.built, x, seed + 50)
        d = 0.02 * np.random.default_rng(seed).normal(size=(frames, self.built.space.size))
        self.x = self.built.space.retract(x, d)
        self.problem.bind(self.data)

    def terms(self, d: Array) -> list[js.Reference]:
        return js.terms_about(self.built, self.x, self.data)(d)


@pytest.fixture(params=KINDS)
def fragment(request: pytest.FixtureRequest) -> Fragment:
    return Fragment(request.param)


@pytest.fixture(scope="module", params=["whole", "feet"])
def kind(request: pytest.FixtureRequest, compiling: None) -> str:
    return str(request.param)


def both(kind: str, frames: int = 11, step: float = 0.05) -> tuple[FragmentEnergy, FragmentEnergy, Array]:
    """The interpreted and the compiled problem with the same data, and a state."""
    plain, own = (Fragment(kind, compile, frames, step) for compile in ("never", "auto"))
    assert own.problem._functions.code
    assert not plain.problem._functions.code
    return plain.problem, own.problem, plain.x


def assert_same(own: Array, expected: Array, share: float = 1e-10) -> None:
    np.testing.assert_allclose(own, expected, rtol=0, atol=share * (1e-9 + np.abs(expected).max()))


def test_energy_equals_the_numpy_reference(fragment: Fragment) -> None:
    expected = js.value(fragment.terms(np.zeros(N * fragment.built.space.size)))
    energy, residuals = fragment.problem.value(fragment.x)
    assert set(energy) == {*BUILT_IN}
    for name, value in energy.items():
        assert value == pytest.approx(expected.get(name, 0.0), rel=1e-9, abs=1e-9), name
    assert fragment.problem.total(fragment.x) == pytest.approx(sum(expected.values()))
    assert residuals.shape == (N, len(fragment.built.names), 2)
    s = fragment.data.observation["w_visual"] * np.sum(residuals**2, axis=-1)
    assert 0.5 * js.pseudo_huber(js.DELTA_PX)(s)[0].sum() == pytest.approx(expected.get("visual", 0.0))


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_and_hessian_equal_finite_differences(kind: str) -> None:
    fragment = Fragment(kind, frames=5)  # jerk joins four
    g, H = js.derivatives(fragment.terms, fragment.x.shape[0] * fragment.built.space.size)
    energy, gradient = fragment.problem.linearise(fragment.x)
    assert energy == pytest.approx(fragment.problem.total(fragment.x), rel=1e-12)
    np.testing.assert_allclose(gradient.ravel(), g, atol=1e-6 * np.abs(g).max())
    np.testing.assert_allclose(fragment.problem.gradient(fragment.x), gradient, rtol=1e-9, atol=1e-9)
    scale = np.sqrt(np.outer(np.diag(H), np.diag(H))) + 1e-3
    assert np.abs((fragment.problem.hessian() - H) / scale).max() < 2e-5


@pytest.mark.parametrize(("frames", "step"), [(8, 0.0), (11, 0.05), (16, 0.8)])
def test_interpreted_and_compiled_give_the_same_numbers(kind: str, frames: int, step: float) -> None:
    plain, own, x = both(kind, frames, step)
    (energy, residuals), (expected, expected_residuals) = own.value(x), plain.value(x)
    assert energy == pytest.approx(expected, rel=1e-11, abs=1e-11)
    np.testing.assert_allclose(residuals, expected_residuals, atol=1e-9)
    for total, gradient in (own.linearise(x), plain.linearise(x)):
        assert total == pytest.approx(plain.total(x), rel=1e-12)
        assert_same(gradient, plain.gradient(x))
    assert_same(own.gradient(x), plain.gradient(x))
    hessians = [problem.hessian().reshape(frames, -1, frames, plain.space.size) for problem in (own, plain)]
    for k in range(4):
        blocks = [H[np.arange(k, frames), :, np.arange(frames - k)] for H in hessians]
        assert np.abs(blocks[1]).max() > 0
        assert_same(*blocks, 1e-12)
    right = np.ones_like(own.gradient(x))
    assert_same(*(problem.factorise(10.0).solve(right).ravel() for problem in (own, plain)), 1e-6)


def test_interpreted_and_compiled_solve_a_fragment_alike(kind: str) -> None:
    plain, own, x = both(kind, 16)
    limits = Limits(plain.space)
    expected, solved = (LevenbergMarquardt(problem, limits).solve(x, 40, 1e-6) for problem in (plain, own))
    assert solved.iterations == expected.iterations
    assert own.total(solved.x) == pytest.approx(plain.total(expected.x), rel=1e-8)


@pytest.mark.parametrize("compile", ["never", "auto"])
@pytest.mark.usefixtures("compiling")
def test_retraction_equals_the_state_spaces(compile: str) -> None:
    fragment, rng = Fragment("whole", compile), np.random.default_rng(0)
    own, x = fragment.problem, fragment.x
    for size in (0.0, 1e-12, 1e-7, 1e-3, 1.0, 4.0):
        d = size * rng.normal(size=(len(x), own.space.size))
        np.testing.assert_allclose(own.retract(x, d), own.space.retract(x, d), atol=1e-14)
    d[3:5] = 0.0  # nothing beside something
    np.testing.assert_allclose(own.retract(x, d), own.space.retract(x, d), atol=1e-14)


def outputs(fragment: Fragment, changed: dict[str, Array]) -> list[Array]:
    """Those of `FrameEnergy.full` in the first frame, with other observations."""
    energy, O, C = fragment.built.energy, js.one_frame(fragment.data, 0).observation | changed, fragment.data.constant
    rows = np.concatenate([O[name].ravel() for name in energy.layout.observation])
    constant = np.concatenate([np.ravel(C[name], order="F") for name in energy.layout.constant])
    return [np.array(v).squeeze() for v in energy.full.call([fragment.x[0], rows, constant])]


def test_prior_at_its_mean_has_the_precision_as_hessian() -> None:
    fragment = Fragment("balls", seed=3)
    O, C, x = js.one_frame(fragment.data, 0).observation, fragment.data.constant, fragment.x
    x[0, 7:] = C["quat_mean"].T.ravel()
    nothing = {name: np.zeros_like(O[name]) for name in O if name.startswith("w_")}
    energies, g, H, *_ = outputs(fragment, nothing | {"w_prior": np.array([0.25])})
    np.testing.assert_allclose(energies, 0, atol=1e-15)
    np.testing.assert_allclose(g, 0, atol=1e-6)
    np.testing.assert_allclose(H[6:, 6:], np.tril(0.25 * C["precision"]), atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sensor_half_a_turn_off_gives_finite_forces(axis: int) -> None:
    fragment = Fragment("balls", seed=3)
    fragment.x[:, 3:] = np.tile(np.eye(4)[0], len(fragment.built.space.joints))
    for out in outputs(fragment, {"quat_sensor": np.repeat(np.eye(4)[None, None, 1 + axis], 2, axis=1)}):
        assert np.isfinite(out).all()


@pytest.mark.parametrize("damping", [1e-3, 10.0])
def test_banded_solution_equals_the_dense_one(fragment: Fragment, damping: float) -> None:
    problem = fragment.problem
    problem.linearise(fragment.x)
    H = problem.hessian() + damping * np.eye(N * problem.space.size)
    right = np.random.default_rng(0).normal(size=(N, problem.space.size))
    solved = problem.factorise(damping).solve(right)
    assert np.abs(H @ solved.ravel() - right.ravel()).max() < 1e-6 * np.abs(H).max() * np.abs(solved).max()
    np.testing.assert_allclose(solved.ravel(), np.linalg.solve(H, right.ravel()), atol=1e-5 * np.abs(solved).max())


def test_values_are_added_to_blocks_of_the_hessian(fragment: Fragment) -> None:
    problem, size = fragment.problem, fragment.problem.space.size
    problem.linearise(fragment.x)
    before = problem.hessian()
    frames, rows, columns = np.array([[0], [0], [5]]), np.array([[3], [3], [7]]), np.arange(3)
    values = 1e3 * np.arange(1.0, 10.0).reshape(3, 3)
    problem.add_to_diagonal(frames, rows, columns, values)
    added = (problem.hessian() - before).reshape(N, size, N, size)
    expected = np.zeros_like(added)
    expected[0, 3, 0, :3] = values[0] + values[1]  # at the same place twice
    expected[0, :3, 0, 3] = values[0] + values[1]
    expected[5, 7, 5, :3] = expected[5, :3, 5, 7] = values[2]
    np.testing.assert_allclose(added, expected, atol=1e-8 * np.abs(before).max())
    root = np.random.default_rng(0).normal(size=(3 * size, 3 * size))
    before = problem.hessian()
    problem.add_to_first(root @ root.T)
    added = (problem.hessian() - before)[: 3 * size, : 3 * size]
    np.testing.assert_allclose(added, root @ root.T, atol=1e-8 * np.abs(before).max())
    problem.linearise(fragment.x)  # what was added is gone
    problem.linearise(fragment.x)


def test_indefinite_hessian_is_a_solver_error(fragment: Fragment) -> None:
    problem, i = fragment.problem, np.arange(fragment.problem.space.size)
    problem.linearise(fragment.x)
    problem.add_to_diagonal(np.arange(N)[:, None], i, i, np.full((N, len(i)), -1e9))
    with pytest.raises(SolverError, match="Hessian is not positive definite"):
        problem.factorise(1e-3)


@pytest.mark.parametrize("name", ["w_visual", "knee_visual", "w_prior", "w_root", "w_torso", "w_bone"])
def test_reweighing_equals_binding_other_weights(name: str) -> None:
    fragment = Fragment("whole")
    new = np.random.default_rng(5).uniform(0.1, 2, fragment.data.observation[name].shape)

    def numbers() -> list[Array]:
        problem = fragment.problem
        return [problem.linearise(fragment.x)[1], problem.gradient(fragment.x), np.array(problem.total(fragment.x))]

    before = numbers()
    fragment.problem.reweigh(name, new)
    reweighed = numbers()
    observation = {**fragment.data.observation, name: new}
    fragment.problem.bind(replace(fragment.data, observation=observation))
    for one, two, old in zip(reweighed, numbers(), before, strict=True):
        np.testing.assert_array_equal(one, two)
        assert not np.array_equal(one, old)


def test_rate_and_weights_of_the_jerk_are_bound_again() -> None:
    fragment = Fragment("whole")
    again = FragmentData(**{**vars(fragment.data), "rate_hz": 50.0, "w_jerk": np.linspace(0, 1, N - 3)})
    fragment.problem.bind(again)
    once = fragment.problem.linearise(fragment.x)[1]
    fresh = Fragment("whole").problem
    fresh.bind(again)
    np.testing.assert_array_equal(fresh.linearise(fragment.x)[1], once)
    np.testing.assert_array_equal(fresh.hessian(), fragment.problem.hessian())


def test_an_energy_is_built_once_and_interpreted_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    b = js.built("bare")
    terms, sigma = b.shape.terms(b.space), js.sigma_jerk(b.space)
    one, two = (built_energy(js.BODY.name, terms, js.MOVING, n, True, "auto", sigma) for n in (8, 10))
    assert one.energy is two.energy
    assert not one._functions.code


OF_ITS_OWN = """
import sys
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.solve.joint_space.fragment import FragmentFunctions
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.joint_space.terms import Acceleration, Root, Visual
space = StateSpace(SkeletonModel.default(), ("RightUpLeg", "RightLeg"), True)
terms = (Visual(((0, True),)), Root(), Acceleration((1,), 3.0))
made = FragmentFunctions.of(space, terms)
print(made.layout, made.groups["coupled"].tolist(), *made.code)
print([vars(function) | {"expression": None} for function in made.frames.values()])
print("casadi" in sys.modules, file=sys.stderr)
"""


@pytest.mark.usefixtures("compile_cache")
def test_an_energy_that_was_compiled_is_loaded_without_casadi() -> None:
    runs = [subprocess.run([sys.executable, "-c", OF_ITS_OWN], capture_output=True, text=True) for _ in range(2)]
    assert [run.stderr.split()[-1] for run in runs] == ["True", "False"]
    assert runs[0].stdout == runs[1].stdout != ""


def test_what_makes_expressions_is_among_what_an_energy_is_built_anew_for() -> None:
    folder = Path(fragment_module.__file__).parent
    symbolic = {path.stem for path in folder.glob("*.py") if "casadi as ca" in path.read_text(encoding="utf-8")}
    assert symbolic == {"energy", "stencils", "terms"}
    assert symbolic < {*MADE_BY} == {path.stem for path in folder.glob("*.py")} & {*MADE_BY}


def test_energies_of_other_terms_bodies_and_functions_from_outside_are_told_apart() -> None:
    space = js.built("bare").space
    ball, terms = StateSpace(js.BODY, js.MOVING, False), js.built("bare").shape.terms(space)
    own = (*terms, MotionTerm("m", "Hips", 1))
    texts = [made_of(space, terms), made_of(ball, terms), made_of(space, terms[1:]), made_of(space, own)]
    assert len({*texts}) == 4
    assert all(texts)
    assert made_of(space, (*terms, PointTerm("p", "Hips", position, 3))) == ""


def test_sigma_of_the_jerk_is_the_priors_times_a_factor() -> None:
    space, prior = js.built("whole").space, js.BODY.table.prior
    settings = JointSpaceSettings(jerk=2.0, jerk_without_sensors=0.5)
    sigma = jerk_sigma(space, settings, {"LeftForeArm"})
    np.testing.assert_allclose(sigma[:3], 2.0 * prior.sigma_root_jerk)
    unsensed = space.columns(SkeletonModel.default().names.index("RightLeg"))
    joint = prior.joints.index("RightLeg")
    np.testing.assert_allclose(sigma[unsensed], 0.5 * prior.sigma_jerk[joint])
    np.testing.assert_allclose(jerk_sigma(space, settings, ())[:3], 0.5 * prior.sigma_root_jerk)
