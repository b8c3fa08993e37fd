"""The real-time Cartesian energy: the programme's own numbers in a narrow band, IPOPT's own answers."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from cartesian_support import BODY, SMALL, SMALL_SENSORS, Inspected, Scene, parameters
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.numerics import c_compiler as compiled
from rtof_kin.solve.cartesian.banded import BandedProblem
from rtof_kin.solve.cartesian.problem import FragmentProblem
from rtof_kin.solve.fragment_solver import FragmentReport, SolverStatus
from rtof_kin.solve.settings import CartesianSettings

Array = NDArray[np.float64]
N = 8
TREE = (-1, 0, 1, 1, 3, 0, 5)
"""A small body: two siblings on the root, two on joint 1."""
J = len(TREE)
BONES = ((1, 2), (1, 3), (5, 6))
PRINTED = CartesianSettings.paper()
GIVEN = CartesianSettings(sigma_reprojection=8.0, refit_root=False, max_iterations=200)
"""One solver call a fragment, from the start as it is given."""
COMBINATIONS = {
    f"{jerk} jerk, prior on {prior}, {lengths} lengths, {huber or 'no'} huber": CartesianSettings(
        jerk_target=jerk, prior=prior, bone_lengths=lengths, huber_reprojection=huber
    )
    for jerk, prior, lengths, huber in product(
        ("zero", "sensor"), ("bones", "positions"), ("free", "weighted"), (None, 2.0)
    )
}


@cache
def problem_of(set_: CartesianSettings, bones: tuple[tuple[int, int], ...] = BONES) -> FragmentProblem:
    return FragmentProblem(TREE, N, bones, set_)


def fragment(problem: FragmentProblem, seed: int = 0) -> tuple[Array, dict[str, Array]]:
    """Positions (N 3J,), and parameters with weights of every size and gaps."""
    rng = np.random.default_rng(seed)
    offsets = rng.normal(size=(J, 3)) * 0.3
    p = np.tile([0.0, 0.0, 1.0], (J, 1))
    for joint, parent in enumerate(TREE[1:], start=1):
        p[joint] = p[parent] + offsets[joint]
    X = p + planted.smooth_noise(seed, (N, J, 3), 5, 0.05)
    values = parameters(problem, X, seed)
    values["K"] = values["K"] + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])
    return X.ravel() + rng.normal(size=X.size) * 0.02, values


def bound(problem: FragmentProblem, values: dict[str, Array], compile: str = "never") -> BandedProblem:
    banded = BandedProblem(problem, compile)
    banded.bind(values, problem.pack(values))
    return banded


def dense(banded: BandedProblem) -> Array:
    """The Hessian that is kept, in the order of the positions."""
    band = banded._band
    size, width = band.shape
    H = np.zeros((size, size))
    for below in range(width):
        at = np.arange(size - below)
        H[at, at + below] = H[at + below, at] = band[at, below]
        assert np.all(band[size - below :, below] == 0), "entries below the last row"
    place = banded.positions(np.arange(float(size))).astype(int)
    return np.asarray(H[np.ix_(place, place)])


def check_numbers(problem: FragmentProblem, x: Array, values: dict[str, Array]) -> None:
    """Energy, gradient and Hessian are those that IPOPT is given."""
    p, banded = problem.pack(values), bound(problem, values)
    unknowns = banded.ordered(x)
    energy, gradient = banded.linearise(unknowns)
    assert energy == pytest.approx(float(np.array(problem.energy(x, p)).sum()), rel=1e-10)
    assert banded.total(unknowns) == energy
    np.testing.assert_array_equal(banded.gradient(unknowns), gradient)
    expected = np.array(problem.gradient(x, p)).ravel()
    scale = np.abs(expected).max()
    np.testing.assert_allclose(banded.positions(gradient), expected, rtol=1e-9, atol=1e-11 * scale)
    upper = np.array(problem.solver.get_function("nlp_hess_l")(x, p, 1.0, []))
    H = upper + np.triu(upper, 1).T
    assert np.abs(dense(banded) - H).max() < 1e-12 * np.abs(H).max()


@pytest.mark.parametrize("name", COMBINATIONS)
def test_energy_gradient_and_hessian_equal_ipopts(name: str) -> None:
    problem = problem_of(COMBINATIONS[name])
    for seed in range(3):
        check_numbers(problem, *fragment(problem, seed))


def test_binding_replaces_the_previous_fragment() -> None:
    problem = problem_of(CartesianSettings())
    (x, one), (_, two) = fragment(problem, 0), fragment(problem, 1)
    banded = bound(problem, one)
    unknowns = banded.ordered(x)
    answers = []
    for values in (one, two, one):
        p = problem.pack(values)
        banded.bind(values, p)
        energy, gradient = banded.linearise(unknowns)
        assert energy == pytest.approx(float(np.array(problem.energy(x, p)).sum()), rel=1e-10)
        answers.append((energy, gradient, dense(banded)))
    for first, again in zip(answers[0], answers[2], strict=True):
        np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("set_", [PRINTED, CartesianSettings()], ids=["printed", "default"])
@pytest.mark.parametrize("damping", [1e-3, 1e3])
def test_a_factor_solves_the_damped_hessian(set_: CartesianSettings, damping: float) -> None:
    problem = problem_of(set_)
    x, values = fragment(problem)
    banded = bound(problem, values)
    banded.linearise(banded.ordered(x))
    kept = dense(banded)
    damping += max(0.0, -2 * float(np.linalg.eigvalsh(kept)[0]))
    right = np.random.default_rng(0).normal(size=x.shape)
    step = banded.factorise(damping).solve(banded.ordered(right))
    expected = np.linalg.solve(kept + damping * np.eye(len(x)), right)
    np.testing.assert_allclose(banded.positions(step), expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(dense(banded), kept)


def test_energy_is_accurate_far_from_the_origin() -> None:
    problem = problem_of(PRINTED)
    x, values = fragment(problem)
    away = np.array([300.0, -300.0, 0.0])
    values["t_camera_world"] = values["t_camera_world"] - values["R_camera_world"] @ away
    values["p_prior"] = values["p_prior"] + np.tile(away, J)[:, None]
    x = (x.reshape(-1, 3) + away).ravel()
    banded, p = bound(problem, values), problem.pack(values)
    energy = float(np.array(problem.energy(x, p)).sum())
    assert banded.total(banded.ordered(x)) == pytest.approx(energy, rel=1e-10)


def bones_of(skeleton: SkeletonModel, joints: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    return tuple(
        (joint, child) for joint in skeleton.index(*joints) for child in kinematics.children_of(skeleton.parents, joint)
    )


def body_problem(joints: tuple[str, ...], set_: CartesianSettings, frames: int = N) -> BandedProblem:
    return BandedProblem(FragmentProblem(BODY.parents, frames, bones_of(BODY, joints), set_), "never")


@pytest.mark.parametrize(
    "joints, change, frames, group",
    [
        (planted.LIMBS, {}, 8, 3),
        (planted.LIMBS[:2], {"jerk_target": "zero", "huber_reprojection": 2.0}, 12, 2),
        ((), {}, 8, 1),
        (planted.LIMBS, {"bone_lengths": "weighted"}, 8, 21),
        ((), {"prior": "bones"}, 8, 21),
    ],
)
def test_bandwidth_by_group(joints: tuple[str, ...], change: dict[str, Any], frames: int, group: int) -> None:
    # 27 below the diagonal for the printed energy with eight limb sensors, 189 with lengths.
    banded = body_problem(joints, replace(PRINTED, **change), frames)
    assert banded.at[1].max() == 9 * group
    assert banded._band.shape == (frames * 63, 9 * group + 1)


@pytest.fixture
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and compilation turned on."""
    if not any(map(shutil.which, compiled.COMPILERS)):
        pytest.skip("there is no C compiler")
    monkeypatch.setenv("RTOF_KIN_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("RTOF_KIN_COMPILE", raising=False)
    return tmp_path / "cache"


def test_compiled_elements_equal_interpreted_ones(cache_folder: Path) -> None:
    # Several at once: their functions have the same names.
    settings_ = [CartesianSettings(), CartesianSettings(huber_reprojection=1.0), PRINTED]
    machine = []
    for set_ in settings_:
        x, values = fragment(problem_of(set_))
        machine.append(bound(problem_of(set_), values, "auto"))
    assert len(list(cache_folder.glob("energy_*.so"))) == 3
    for set_, fast in zip(settings_, machine, strict=True):
        x, values = fragment(problem_of(set_))
        slow = bound(problem_of(set_), values, "never")
        unknowns = fast.ordered(x)
        energy, gradient = fast.linearise(unknowns)
        assert energy == pytest.approx(slow.linearise(unknowns)[0], rel=1e-13)
        expected = slow.gradient(unknowns)
        np.testing.assert_allclose(gradient, expected, atol=1e-13 * np.abs(expected).max())
        np.testing.assert_allclose(dense(fast), dense(slow), atol=1e-13 * np.abs(dense(slow)).max())
        steps = [banded.factorise(1e5).solve(gradient) for banded in (fast, slow)]
        np.testing.assert_allclose(*steps, rtol=1e-8, atol=1e-12)
        for banded in (fast, slow):
            changed = values | {"sigma_reprojection": np.array([3.0])}
            banded.bind(changed, problem_of(set_).pack(changed))
        assert fast.total(unknowns) == pytest.approx(slow.total(unknowns), rel=1e-13)
        assert fast.total(unknowns) != pytest.approx(energy, rel=1e-9)


def inspected(backend: str, set_: CartesianSettings = GIVEN) -> Inspected:
    return Inspected(SMALL, N, replace(set_, backend=backend), SMALL_SENSORS)


def cases(scene: Scene) -> list[dict[str, Any]]:
    """All observations; without sensors, from an initial guess further away."""
    observed = {"start": scene.start, "keypoints": scene.seen, "bone_imus": scene.imus}
    return [observed, observed | {"bone_imus": None, "start": scene.lifted}]


def total(report: FragmentReport) -> float:
    return sum(report.energy.values())


def check_agreement(solvers: list[Inspected], observed: dict[str, Any]) -> None:
    """Both converge; energies are within 1e-6 relative, positions within 0.1 mm."""
    for solver in solvers:
        solver.answers.clear()
    fragments = [solver.solve(**observed).fragments for solver in solvers]
    assert len(fragments[0]) == 4
    for a, b, X, Y in zip(*fragments, *(s.answers for s in solvers), strict=True):
        assert a.status is b.status is SolverStatus.CONVERGED
        assert a.first_frame == b.first_frame
        assert abs(total(a) - total(b)) <= 1e-6 * total(a)
        assert 1000 * np.linalg.norm(X - Y, axis=-1).max() < 0.1


AGREEING = {
    "default": GIVEN,
    "printed": replace(PRINTED, max_iterations=200),
    "free": replace(GIVEN, bone_lengths="free", padding="replicate"),
    "plain squares": replace(GIVEN, huber_reprojection=None),
    "printed and robust": replace(PRINTED, huber_reprojection=2.0, max_iterations=200),
}


@pytest.mark.parametrize("name", AGREEING)
def test_real_time_and_ipopt_find_the_same_minimum(name: str) -> None:
    solvers = [inspected(backend, AGREEING[name]) for backend in ("ipopt", "realtime")]
    for seed in range(2):
        for observed in cases(Scene(SMALL, 12, seed, gappy=seed > 0)):
            check_agreement(solvers, observed)


def test_bone_lengths_as_constraints_need_ipopt() -> None:
    message = "bone_lengths 'constraint' needs backend 'ipopt', or take 'weighted'"
    constraint = replace(GIVEN, bone_lengths="constraint")
    with pytest.raises(InvalidInputError, match=message):
        inspected("realtime", constraint)
    with pytest.raises(InvalidInputError, match=message):
        BandedProblem(problem_of(constraint))
    with pytest.raises(InvalidInputError, match="backend: 'quick' is none of"):
        inspected("quick")
