"""Unknowns of a whole fragment: derivatives against NumPy, steps against dense ones, planted errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from unittest import mock

import joint_space_support as js
import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rtof_kin.core.errors import ShapeError, SolverError, UnknownNameError
from rtof_kin.core.numerics.banded import factorise
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.energy.frame_energy import UNKNOWNS, FrameEnergy
from rtof_kin.solve.energy.problem import FragmentData, JointProblem
from rtof_kin.solve.joint_space.bordered import BorderedLimits, BorderedProblem
from rtof_kin.solve.joint_space.limits import Limits

Array = NDArray[np.float64]
N = 4
SIGMA = {"scale": 0.03, "delay": 0.03, "heading": 0.2, "mounting": 0.2, "landmarks": 0.03}
PLAIN_POSES = js.poses


@cache
def built(kind: str, unknowns: tuple[str, ...]) -> js.Built:
    b = js.built(kind)
    shape = replace(b.shape, unknowns=unknowns)
    return replace(b, shape=shape, energy=FrameEnergy(b.space, shape))


@cache
def problem(kind: str, unknowns: tuple[str, ...], frames: int) -> JointProblem:
    """A fragment's problem, interpreted."""
    b = built(kind, unknowns)
    sigma = js.sigma_jerk(b.space)
    return JointProblem(b.space, b.energy.functions(), b.energy, frames, sigma, js.DELTA_ACCELERATION)


def sigma(b: js.Built) -> Array:
    out = np.zeros(b.shape.unknown_count)
    for name, part in b.shape.columns.items():
        out[part] = SIGMA[name]
    return out


# --- unknowns, from their description ------------------------------------------------------------


@contextmanager
def scaled(scale: float) -> Iterator[None]:
    """Everything that is built on poses sees a body of another size."""

    def poses(b: js.Built, x: Array) -> tuple[Array, Array]:
        p, R = PLAIN_POSES(b, x)
        return p[:, :1] + (1 + scale) * (p - p[:, :1]), R

    with mock.patch.object(js, "poses", poses):
        yield


def named(b: js.Built, y: Array) -> dict[str, Array]:
    """Unknowns by name: scale (1), delay (1), heading (S), mounting (S, 3), landmarks (L, 3)."""
    S, L = len(b.shape.sensors), len(b.names)
    shapes = {"scale": (), "delay": (), "heading": (S,), "mounting": (S, 3), "landmarks": (L, 3)}
    parts = b.shape.columns
    return {n: y[parts[n]].reshape(shape) if n in parts else np.zeros(shape) for n, shape in shapes.items()}


def corrected(b: js.Built, x: Array, data: FragmentData, y: Array) -> FragmentData:
    """What would have been observed and known, had nothing been wrong; but for the size of the body."""
    v, O, C = named(b, y), data.observation, data.constant
    p, _ = PLAIN_POSES(b, x)
    turn = Rotation.from_rotvec(np.outer(v["heading"], [0.0, 0.0, 1.0]))
    quat = np.zeros_like(O["quat_sensor"])
    for s in range(len(b.shape.sensors)):
        measured = Rotation.from_quat(O["quat_sensor"][:, s], scalar_first=True)
        actual = turn[s] * measured * Rotation.from_rotvec(v["mounting"][s])
        quat[:, s] = actual.as_quat(scalar_first=True)
    # Bones of the start are compared as they are, whatever the body's size.
    longer = [float(v["scale"]) * (p[:, c] - p[:, j]) for j, c in b.shape.bones]
    b_world = O["b_world"] + (np.stack(longer, axis=1) if longer else 0)
    duv = O.get("duv_px", np.zeros_like(O["uv_px"]))
    a = [turn[s].apply(data.a_world[:, s]) for s in range(len(b.shape.sensors))]
    return replace(
        data,
        observation={
            **O, "uv_px": O["uv_px"] + v["delay"] * duv, "quat_sensor": quat, "b_world": b_world
        },
        constant={
            **C, "levers": (1 + v["scale"]) * C["levers"],
            "places": (1 + v["scale"]) * C["places"] + v["landmarks"].T,
        },
        a_world=np.stack(a, axis=1) if a else data.a_world,
    )  # fmt: skip


class Fragment:
    """A problem with random data and random unknowns, and the same from the description."""

    def __init__(self, kind: str, unknowns: tuple[str, ...], frames: int = N) -> None:
        self.built, self.problem = built(kind, unknowns), problem(kind, unknowns, frames)
        b, rng = self.built, np.random.default_rng(3)
        self.x = js.states(b.space, frames, 0)
        data = js.random_data(b, self.x, 50)
        if "delay" in unknowns:
            data.observation["duv_px"] = 300 * rng.normal(size=data.observation["uv_px"].shape)
        self.y = sigma(b) * rng.normal(size=b.shape.unknown_count)
        self.data = replace(data, constant={**data.constant, "unknowns": self.y})
        self.x = b.space.retract(self.x, 0.02 * rng.normal(size=(frames, b.space.size)))
        self.problem.bind(self.data)
        self.bordered = BorderedProblem(self.problem, sigma(b))
        self.flat = self.bordered.pack(self.x, self.y)

    def terms(self, d: Array) -> list[js.Term]:
        b, G = self.built, len(self.y)
        x = b.space.retract(self.x, d[: len(d) - G].reshape(len(self.x), -1))
        y = self.y + d[len(d) - G :]
        data = corrected(b, x, self.data, y)
        places = tuple((j, False) for j, _ in b.shape.landmarks)
        loose = replace(b, shape=replace(b.shape, landmarks=places))
        with scaled(float(named(b, y)["scale"])):
            return js.frame_terms(loose, x, data) + js.temporal_terms(loose, x, data)

    def dense(self) -> Array:
        """(N D + G, N D + G) Hessian that is kept, with the unknowns' prior."""
        frames, D, G = self.problem.frames, self.problem.space.size, len(self.y)
        H = np.zeros((frames, D, frames, D))
        for k in range(min(4, frames)):
            for t, block in enumerate(self.problem.lower_block(k)):
                H[t + k, :, t, :] = block
                H[t, :, t + k, :] = block.T
        _, C, corner = self.problem.border()
        C = C.reshape(frames * D, G)
        corner = corner + np.diag(1 / self.bordered.sigma**2)
        return np.block([[H.reshape(frames * D, -1), C], [C.T, corner]])


# --- derivatives ---------------------------------------------------------------------------------


def test_energy_gradient_and_hessian_are_those_of_the_description() -> None:
    f = Fragment("whole", UNKNOWNS)
    G, D = len(f.y), f.problem.space.size
    some = np.random.default_rng(0).integers(N, size=D) * D + np.arange(D)  # each in one of the frames

    def terms(e: Array) -> list[js.Term]:
        d = np.zeros(N * D + G)
        d[some], d[N * D :] = e[:D], e[D:]
        return f.terms(d)

    expected = js.value(terms(np.zeros(D + G)))
    energy, _ = f.problem.value(f.x)
    for name, value in energy.items():
        assert value == pytest.approx(expected.get(name, 0.0), rel=1e-8, abs=1e-8), name
    gradient, hessian = js.derivatives(terms, D + G)
    f.problem.linearise(f.x)
    by_y, C, corner = f.problem.border()
    scale = np.sqrt(np.diag(hessian)) + 1e-3
    error = np.abs(by_y - gradient[D:]) / scale[D:]
    assert error.max() < 1e-4 * np.abs(gradient / scale).max()
    error = np.abs(C.reshape(-1, G)[some] - hessian[:D, D:]) / np.outer(scale[:D], scale[D:])
    assert error.max() < 2e-5
    error = np.abs(corner - hessian[D:, D:]) / np.outer(scale[D:], scale[D:])
    assert error.max() < 2e-5


@pytest.mark.parametrize("name", UNKNOWNS)
def test_an_unknown_alone_has_the_border_that_it_has_among_others(name: str) -> None:
    alone, together = Fragment("whole", (name,)), Fragment("whole", UNKNOWNS)
    part = together.built.shape.columns[name]
    y = np.zeros_like(together.y)
    y[part] = alone.y
    if name == "delay":
        together.data.observation["duv_px"][:] = alone.data.observation["duv_px"]
    together.problem.bind(together.data)
    together.problem.set_unknowns(y)
    energy, _ = together.problem.linearise(alone.x)
    assert alone.problem.linearise(alone.x)[0] == pytest.approx(energy, rel=1e-9)
    by_y, C, corner = together.problem.border()
    for one, other in zip(
        alone.problem.border(), (by_y[part], C[:, :, part], corner[part, part]), strict=True
    ):
        assert np.abs(one).max() > 0
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8 * np.abs(one).max())


@pytest.mark.parametrize("kind", ["balls", "whole"])
def test_the_gradient_is_that_of_the_energy_itself(kind: str) -> None:
    f = Fragment(kind, UNKNOWNS)
    _, gradient = f.bordered.linearise(f.flat)
    np.testing.assert_allclose(f.bordered.gradient(f.flat), gradient, rtol=1e-8, atol=1e-7)
    rng, G = np.random.default_rng(0), len(f.y)
    for i in range(12):
        d = rng.normal(size=gradient.size)
        d[-G:] *= f.bordered.sigma
        if i % 2:
            d[:-G] = 0
        plus, minus = (f.bordered.total(f.bordered.retract(f.flat, s * 1e-6 * d)) for s in (1, -1))
        assert (plus - minus) / 2e-6 == pytest.approx(gradient @ d, rel=1e-4)


@pytest.mark.parametrize("kind", ["balls", "whole", "bare"])
def test_without_unknowns_the_functions_are_what_they_were(kind: str) -> None:
    plain, bordered = js.built(kind).energy, built(kind, UNKNOWNS).energy
    assert [f.n_out() for f in plain.functions()] == [6, 3, 1]
    assert [f.n_out() for f in bordered.functions()] == [10, 3, 2]
    assert "duv_px" not in plain.observation
    assert "unknowns" not in plain.constant
    f = Fragment(kind, UNKNOWNS)
    before = js.problem(kind, N)
    before.bind(f.data)
    f.problem.set_unknowns(np.zeros_like(f.y))
    (energy, gradient), (energy_y, gradient_y) = before.linearise(f.x), f.problem.linearise(f.x)
    assert energy == pytest.approx(energy_y, rel=1e-9)
    np.testing.assert_allclose(gradient, gradient_y, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(before.lower_block(0), f.problem.lower_block(0), rtol=1e-9, atol=1e-6)
    assert [v.size for v in before.border()] == [0, 0, 0]
    assert before.gradients(f.x)[1].size == 0


def test_the_unknowns_bound_or_set_are_those_asked_about() -> None:
    f = Fragment("balls", UNKNOWNS)
    first = f.problem.total(f.x), f.problem.gradients(f.x)
    f.problem.set_unknowns(0 * f.y)
    assert f.problem.total(f.x) != first[0]
    f.problem.set_unknowns(f.y)
    assert f.problem.total(f.x) == first[0]
    f.problem.set_unknowns(0 * f.y)
    f.problem.bind(f.data)
    for one, other in zip(f.problem.gradients(f.x), first[1], strict=True):
        np.testing.assert_array_equal(one, other)


# --- steps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping", [1e-3, 10.0])
@pytest.mark.parametrize("kind", ["balls", "whole", "bare"])
def test_a_step_is_the_dense_solution(kind: str, damping: float) -> None:
    f = Fragment(kind, UNKNOWNS)
    f.bordered.linearise(f.flat)
    H = f.dense()
    H += damping * np.eye(len(H))
    right = np.random.default_rng(1).normal(size=len(H))
    solved = f.bordered.factorise(damping).solve(right)
    expected = np.linalg.solve(H, right)
    np.testing.assert_allclose(solved, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_a_factor_outlives_what_the_problem_does_next() -> None:
    f = Fragment("balls", UNKNOWNS)
    _, gradient = f.bordered.linearise(f.flat)
    factor = f.bordered.factorise(1.0)
    before, kept = factor.solve(gradient), gradient.copy()
    other = f.bordered.pack(js.states(f.problem.space, N, 9), 0 * f.y)
    f.bordered.linearise(other)
    f.bordered.factorise(5.0)
    np.testing.assert_array_equal(gradient, kept)
    np.testing.assert_array_equal(factor.solve(gradient), before)


def test_several_right_hand_sides_are_solved_as_one_by_one() -> None:
    rng = np.random.default_rng(0)
    band = np.c_[np.full(7, 4.0), rng.uniform(-1, 1, (7, 2))]
    factor, right = factorise(band), rng.normal(size=(7, 3))
    expected = np.stack([factor.solve(column) for column in right.T], axis=1)
    np.testing.assert_allclose(factor.solve_columns(right), expected, rtol=1e-12)
    assert factor.solve_columns(right[:, :0]).shape == (7, 0)
    for wrong in (right[:6], right[:, 0]):
        with pytest.raises(SolverError, match="for a system of 7"):
            factor.solve_columns(wrong)


def test_unpacking_is_the_inverse_of_packing() -> None:
    f = Fragment("balls", UNKNOWNS)
    x, y = f.bordered.unpack(f.flat)
    np.testing.assert_array_equal(x, f.x)
    np.testing.assert_array_equal(y, f.y)


def test_a_border_that_is_not_positive_definite_is_a_solver_error() -> None:
    f = Fragment("balls", UNKNOWNS)
    f.bordered.linearise(f.flat)
    f.problem.border()[1][0] *= 100.0
    with pytest.raises(SolverError, match="unknowns' Hessian is not positive definite"):
        f.bordered.factorise(1e-3)


# --- hostile inputs ------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_a_sigma_that_is_none_is_a_shape_error(wrong: float) -> None:
    given = sigma(built("balls", UNKNOWNS))
    given[3] = wrong
    with pytest.raises(ShapeError, match=r"sigma\[3\] \(heading\) is .*: give a positive, finite"):
        BorderedProblem(problem("balls", UNKNOWNS, N), given)


@pytest.mark.parametrize("shape", [(), (1,), (2, 1), (3,)])
def test_a_sigma_of_wrong_length_is_a_shape_error(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"one for each of the 2 unknowns \(heading\)"):
        BorderedProblem(problem("balls", ("heading",), N), np.ones(shape))


def test_unknowns_of_wrong_length_are_a_shape_error() -> None:
    with pytest.raises(ShapeError, match=r"unknowns \(3,\): give all 2"):
        problem("balls", ("heading",), N).set_unknowns(np.zeros(3))


def test_an_unknown_that_there_is_not_is_named() -> None:
    shape = js.built("balls").shape
    with pytest.raises(UnknownNameError, match="'headings'.* Did you mean 'heading'"):
        replace(shape, unknowns=("headings",))
    with pytest.raises(ShapeError, match="name each once"):
        replace(shape, unknowns=("scale", "scale"))


# --- planted errors ------------------------------------------------------------------------------

FRAMES = 24
PRIOR = 1e-4
"""1 / rad^2, of joints that nothing tells apart, as in the spine."""
LOOSE = ("Nose", "LeftHeel", "LeftToe")
"""Landmarks that may be off, on segments whose sensor tells how they are turned."""
TRUTH = planted.human(js.BODY, FRAMES + 4, seed=2)


def exact_data(b: js.Built, x: Array, uv: Array, wrong: Array) -> FragmentData:
    """Everything seen and measured without noise, but for what is wrong; no anchors, hardly a prior.

    Args:
        uv: (N + 2, L, 2) px of the frames, and one to each side. wrong: (G,) as it shall be found.
    """
    v, count, S = named(b, wrong), len(x), len(b.shape.sensors)
    base = js.random_data(b, x)
    levers = base.constant["levers"]
    with scaled(float(v["scale"])):
        p, R = js.poses(b, x)
    sensors = [p[:, j] + (1 + v["scale"]) * R[:, j] @ levers[:, s] for s, j in enumerate(b.shape.sensors)]
    back = Rotation.from_rotvec(np.outer(-v["heading"], [0.0, 0.0, 1.0]))
    quat = np.zeros((count, S, 4))
    for s, j in enumerate(b.shape.sensors):
        actual = Rotation.from_matrix(R[:, j])
        measured = back[s] * actual * Rotation.from_rotvec(-v["mounting"][s])
        quat[:, s] = measured.as_quat(scalar_first=True)
    a = [back[s].apply(np.diff(at, n=2, axis=0) * js.RATE**2) for s, at in enumerate(sensors)]
    off = {n: np.zeros_like(w) for n, w in base.observation.items() if n.startswith("w_")}
    white = np.eye(3).ravel() / 0.02
    return replace(
        base,
        observation={
            **base.observation, **off, "uv_px": uv[1:-1], "w_visual": np.ones((count, len(b.names))),
            "knee_visual": np.full(count, 50.0), "quat_sensor": quat, "w_sensor": np.ones((count, S)),
            "duv_px": (uv[2:] - uv[:-2]) * js.RATE / 2, "w_prior": np.full(count, PRIOR),
        },
        constant={
            **base.constant, "whitening": np.tile(white[:, None], S), "unknowns": np.zeros(len(wrong)),
            "precision": np.eye(len(base.constant["precision"])),
        },
        a_world=np.stack(a, axis=1), w_acceleration=np.full((count - 2, S), 1 / 0.2**2),
        w_jerk=np.zeros(count - 3),
    )  # fmt: skip


def seen(b: js.Built, x: Array, wrong: Array) -> Array:
    """(T, L, 2) px of landmarks that are not quite where the skeleton has them."""
    v = named(b, wrong)
    places = np.array([js.BODY.landmarks[n][1] for n in b.names])
    with scaled(float(v["scale"])):
        p, R = js.poses(b, x)
    return np.stack(
        [
            js.CAMERA.project(p[:, j] + R[:, j] @ ((1 + v["scale"]) * place + more))
            for (j, _), place, more in zip(b.shape.landmarks, places, v["landmarks"], strict=True)
        ],
        axis=1,
    )


class Planted:
    """The error of some unknowns, what is found of it, and the truth of the states."""

    def __init__(self, unknowns: tuple[str, ...], wrong: dict[str, Array], frames_late: int = 0) -> None:
        self.built, p = built("whole", unknowns), problem("whole", unknowns, FRAMES)
        b = self.built
        self.wrong = np.zeros(b.shape.unknown_count)
        for name, value in wrong.items():
            self.wrong[b.shape.columns[name]] = np.ravel(value)
        poses = TRUTH.poses
        x = b.space.from_poses(poses.p_world_joint[:, 0], poses.R_world_bone)
        first = 3 - frames_late  # the pictures came late: what they show was before
        uv = seen(b, x, self.wrong)[first - 1 : first + FRAMES + 1]
        self.x = x[3 : 3 + FRAMES]
        self.data = exact_data(b, self.x, uv, self.wrong)
        p.bind(self.data)
        loose = 100 * sigma(b)
        if "landmarks" in unknowns:  # were all loose, the body could go anywhere
            offsets = loose[b.shape.columns["landmarks"]].reshape(-1, 3)
            offsets[[name not in LOOSE for name in b.names]] = 1e-4
        self.bordered = BorderedProblem(p, loose)
        d = 0.02 * np.random.default_rng(0).normal(size=(1, b.space.size))
        self.start = b.space.retract(self.x, np.repeat(d, FRAMES, axis=0))

    def solved(self) -> tuple[Array, dict[str, Array]]:
        """States and, by name, how far the unknowns are from what was planted; from a start of zero."""
        flat = self.bordered.pack(self.start, 0 * self.wrong)
        result = LevenbergMarquardt(self.bordered).solve(flat, 60, 1e-12)
        assert result.converged
        x, y = self.bordered.unpack(result.x)
        parts = self.built.shape.columns
        return x, {name: np.abs(y - self.wrong)[part].max() for name, part in parts.items()}

    def positions_off(self, x: Array) -> float:
        """Largest error of the joints, m."""
        poses = self.built.space.poses
        return float(np.abs(poses(x)[0] - poses(self.x)[0]).max())


HEADING = np.where(np.array(js.ALL_SENSORS) == "RightForeArm", np.radians(12.0), 0.0)
MOUNTING = np.where(np.array(js.ALL_SENSORS)[:, None] == "LeftForeArm", [0.1, -0.08, 0.12], 0.0)
OFFSETS = np.where(np.isin((*js.BODY.names, *js.EXTRA), LOOSE)[:, None], [0.02, -0.015, 0.01], 0.0)
WRONG = {"scale": np.array(0.03), "heading": HEADING, "mounting": MOUNTING, "landmarks": OFFSETS}


@pytest.mark.parametrize(
    ("name", "tolerance"), [("scale", 1e-5), ("heading", 1e-5), ("mounting", 5e-4), ("landmarks", 1e-5)]
)
def test_what_was_wrong_is_found_from_exact_observations(name: str, tolerance: float) -> None:
    case = Planted((name,), {name: WRONG[name]})
    x, off = case.solved()
    assert np.abs(case.wrong).max() > 100 * tolerance
    assert off[name] < tolerance
    assert case.positions_off(x) < 5e-5


def test_pictures_one_frame_late_are_found_to_a_tenth_of_a_millisecond() -> None:
    case = Planted(("delay",), {"delay": np.array(1 / js.RATE)}, frames_late=1)
    x, off = case.solved()
    assert off["delay"] < 1e-4
    assert case.positions_off(x) < 4e-3  # the pictures are moved along a straight line


def test_late_pictures_moved_by_what_was_found_leave_nothing_for_the_size_to_explain() -> None:
    names = ("scale", "delay", "heading")
    wrong = {"scale": WRONG["scale"], "heading": HEADING, "delay": np.array(1 / js.RATE)}
    case = Planted(names, wrong, frames_late=1)
    b, poses, start, total = case.built, TRUTH.poses, case.start, 0.0
    states = b.space.from_poses(poses.p_world_joint[:, 0], poses.R_world_bone)
    pictures = CubicSpline(poses.times, seen(b, states, case.wrong))
    y, delay = 0 * case.wrong, b.shape.columns["delay"]
    off = []
    for _ in range(2):
        shown = poses.times[3 : 3 + FRAMES] - 1 / js.RATE + total
        moved = {"uv_px": pictures(shown), "duv_px": pictures(shown, 1)}
        data = replace(case.data, observation={**case.data.observation, **moved})
        case.bordered.problem.bind(data)
        y[delay] = 0.0
        flat = case.bordered.pack(start, y)
        solved = LevenbergMarquardt(case.bordered).solve(flat, 60, 1e-10)
        start, y = (part.copy() for part in case.bordered.unpack(solved.x))
        total += float(y[delay][0])
        off.append(abs(y[b.shape.columns["scale"]][0] - 0.03))
    assert total == pytest.approx(1 / js.RATE, abs=1e-6)
    assert off[0] > 1e-3  # a straight line is not enough for a whole frame
    assert off[1] < 1e-5


def test_several_errors_at_once_are_told_apart() -> None:
    case = Planted(
        ("landmarks", "scale", "delay", "heading"),
        {name: WRONG[name] for name in ("scale", "heading", "landmarks")},
    )
    x, off = case.solved()
    assert off["scale"] < 1e-5
    assert off["delay"] < 1e-6
    assert off["heading"] < 1e-4
    assert off["landmarks"] < 1e-5
    assert case.positions_off(x) < 5e-5


def test_a_tight_prior_keeps_an_unknown_where_it_is() -> None:
    case = Planted(("scale",), {"scale": np.array(0.03)})
    tight = BorderedProblem(case.bordered.problem, [1e-6])
    result = LevenbergMarquardt(tight).solve(tight.pack(case.start, [0.0]), 60, 1e-9)
    assert abs(tight.unpack(result.x)[1][0]) < 1e-5


def test_limits_hold_while_unknowns_move() -> None:
    case = Planted(("scale",), {"scale": np.array(0.03)})
    data = case.data
    weaker = {name: 0.01 * data.observation[name] for name in ("w_visual", "w_sensor")}
    case.bordered.problem.bind(
        replace(
            data, observation={**data.observation, **weaker},
            w_acceleration=0.01 * data.w_acceleration,
        )
    )  # fmt: skip
    own = Limits(case.built.space)
    m = own.names.index("LeftForeArm_z")
    own.upper[m] = 0.1
    assert (own.values(case.x)[:, m] - 0.1).max() > np.radians(3)
    limits = BorderedLimits(case.bordered, own)
    flat = case.bordered.pack(case.start, [0.0])
    none = np.zeros((FRAMES, len(limits.names)))
    result = LevenbergMarquardt(case.bordered, limits).solve(flat, 100, 1e-8, none)
    assert result.converged
    x, y = case.bordered.unpack(result.x)
    assert y[0] > 0.02
    assert own.excess(own.values(x)).max() < np.radians(0.15)
    assert result.multipliers[:, m].max() > 0
    before = np.abs(case.bordered.gradient(flat)).max()
    left = case.bordered.gradient(result.x) + limits.force(result.x, result.multipliers)
    assert np.abs(left).max() < 1e-3 * before
