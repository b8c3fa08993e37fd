"""Terms from outside against finite differences in both spaces, wrong input; every residual against NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import casadi as ca
import joint_space_support as js
import numpy as np
import planted
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.numerics import simd
from rtof_kin.core.numerics.simd import GROUP, Columns, FrameFunction, Over
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve import terms
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.energy import Frame
from rtof_kin.solve.joint_space.fragment import FragmentFunctions
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.terms import MotionTerm, ObservedTerm, PointData, PointTerm, Term, observed_rows

Array = NDArray[np.float64]
BODY, N = SkeletonModel.default(), 8
POSES = planted.seen(BODY, N).poses
ANCHOR = np.array([2.0, -1.0, 1.5])


def to_anchor(p: Any, observed: Any) -> Any:
    return ca.norm_2(p - observed[:3]) - observed[3]


def apart(p: Any, q: Any, observed: Any) -> Any:
    return ca.norm_2(p - q) - observed


@dataclass(frozen=True)
class Inclination(ObservedTerm):
    """Vertical in a segment's axes minus that of an inclinometer."""

    joint: str = "Spine3"
    size: int = 3
    robust: float = 2.0

    def add(self, frame: Frame) -> None:
        (j,) = frame.index(self.joint)
        loss = terms.pseudo_huber_loss(self.robust)
        residual = partial(_tilt, frame, j, frame.O[self.observed])
        frame.turn(self, j, residual, frame.O[self.weight], loss)


def _tilt(frame: Frame, j: int, measured: Any, e: Any) -> Any:
    return terms.quat_matrix(frame.turned(j, e))[2, :].T - measured


RANGE = PointTerm("anchor", "LeftHand", to_anchor, 4, robust=1.5)
REACH = PointTerm("reach", ("LeftHand", "RightFoot"), apart, robust=1.5)
SPEED = MotionTerm("speed", "LeftForeArm", 1, (0.05, 0.02, 0.1), robust=1.5)
SHAKE = MotionTerm("shake", "RightLeg", 2, robust=1.5)
TILT = Inclination("tilt")
EVERY = (RANGE, REACH, SPEED, SHAKE, TILT)
RATE_HZ = POSES.rate_hz


def ranges(poses: PoseSequence = POSES, error: float = 0.0) -> Array:
    """Observations of `RANGE` (T, 4), one of them missing."""
    p = poses.p_world_joint[:, poses.names.index("LeftHand")]
    distances = np.linalg.norm(p - ANCHOR, axis=1) + error
    distances[3] = np.nan
    return np.column_stack([np.tile(ANCHOR, (len(p), 1)), distances])


def measured() -> dict[str, PointData]:
    """Observations of every term, a few of their sigmas off."""
    rng = np.random.default_rng(1)
    three = [PointData(rng.normal(size=(N, 3)), sigma) for sigma in (1.0, 20.0, 0.3)]
    return {
        "anchor": PointData(ranges(error=0.3), 0.1),
        "reach": PointData(np.full((N, 1), 1.2), np.linspace(0.1, 0.2, N)),
        **dict(zip(("speed", "shake", "tilt"), three, strict=True)),
    }


def residuals(x: Array, data: Observations) -> dict[str, Array]:
    """Whitened residuals (n, ...) of every term, from its description."""
    p, R = data.space.poses(x)
    at, seen = BODY.names.index, {name: d.values for name, d in measured().items()}
    arm = p[:, at("LeftForeArm")] + R[:, at("LeftForeArm")] @ SPEED.p_bone_point
    shank = p[:, at("RightLeg")]
    out = {
        "anchor": (np.linalg.norm(p[:, at("LeftHand")] - ANCHOR, axis=1) - seen["anchor"][:, 3])[:, None] / 0.1,
        "reach": np.linalg.norm(p[:, at("LeftHand")] - p[:, at("RightFoot")], axis=1)[:, None] - seen["reach"],
        "speed": (arm[2:] - arm[:-2]) / 2 * RATE_HZ - seen["speed"][1:-1],
        "shake": (np.diff(shank, n=2, axis=0) * RATE_HZ**2 - seen["shake"][1:-1]) / 20,
        "tilt": (R[:, at("Spine3"), 2] - seen["tilt"]) / 0.3,
    }
    out["reach"] = out["reach"] / np.linspace(0.1, 0.2, N)[:, None]
    return out


def energy(squared: Array, robust: float = 1.5) -> Array:
    """Half the pseudo-Huber loss of squared whitened residuals."""
    return robust**2 * (np.sqrt(1 + squared / robust**2) - 1)


def observations(compile: str, own: tuple[Term, ...] = EVERY) -> tuple[Observations, Any]:
    settings = JointSpaceSettings(compile=compile)  # type: ignore[arg-type]
    guess, seen = InitialGuess(POSES, np.zeros(N)), planted.keypoints(POSES)
    known = {term.name: measured()[term.name] for term in own}
    data = Observations(BODY, N, settings, guess, seen, None, terms=own, observed=known)
    data.problem.bind(data.fragment(0)[2])
    return data, data.problem


def test_the_energy_of_every_kind_of_term_is_that_of_its_residual_and_its_gradient_the_derivative() -> None:
    data, problem = observations("never")
    x = data.space.retract(data.start, 0.1 * np.random.default_rng(0).normal(size=(N, data.space.size)))
    values = problem.value(x)[0]
    for name, r in residuals(x, data).items():
        expected = energy(np.sum(r**2, axis=1), 2.0 if name == "tilt" else 1.5)
        assert values[name] == pytest.approx(np.nansum(expected), rel=1e-9), name
        assert values[name] > 0
    gradient, step = problem.gradient(x), 1e-6
    direction = np.random.default_rng(1).normal(size=gradient.shape)
    for move in (direction, *(direction * (np.arange(N) == t)[:, None] for t in range(N))):
        ends = [problem.total(data.space.retract(x, sign * step * move)) for sign in (1, -1)]
        assert np.sum(gradient * move) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4, abs=1e-3)


def test_the_hessian_of_terms_from_outside_is_that_of_gauss_and_newton() -> None:
    """The difference of the Hessians with and without terms, along directions, from the residuals' derivatives."""
    (data, problem), (_, without) = observations("never"), observations("never", ())
    rng = np.random.default_rng(2)
    x = data.space.retract(data.start, 0.1 * rng.normal(size=(N, data.space.size)))
    problem.linearise(x), without.linearise(x)
    H = problem.hessian() - without.hessian()
    for _ in range(3):
        d, step = rng.normal(size=(N, data.space.size)), 1e-6
        ends = [residuals(data.space.retract(x, sign * step * d), data) for sign in (1, -1)]
        expected = 0.0
        for name, r in residuals(x, data).items():
            delta = 2.0 if name == "tilt" else 1.5
            slope = 1 / np.sqrt(1 + np.sum(r**2, axis=1) / delta**2)
            moved = (ends[0][name] - ends[1][name]) / (2 * step)
            expected += float(np.nansum(slope * np.sum(moved**2, axis=1)))
        assert d.ravel() @ H @ d.ravel() == pytest.approx(expected, rel=1e-5)


def evaluated(code: Any, frame: FrameFunction, values: list[Array]) -> list[Array]:
    """Outputs of a function for N frames; groups of placed ones side by side."""
    columns, (*before, last) = Columns(N), frame.outputs
    outputs = [columns.at(columns.zeros(n)) for n in before]
    outputs += [np.zeros((N, last)) if frame.placed else columns.at(columns.zeros(last))]
    inputs = [v if i in frame.shared else columns.at(columns.given(v)) for i, v in enumerate(values)]
    Over(code, frame, N, inputs, outputs, np.arange(0, last, GROUP) if frame.placed else None)()
    return outputs


def test_terms_from_outside_are_compiled_as_they_are_interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RTOF_KIN_COMPILE", raising=False)
    monkeypatch.setattr(simd, "_OPTIONS", ("-O0",))  # compiled quickly
    own, plain = (FragmentFunctions.of(StateSpace(BODY, js.MOVING, True), EVERY, how) for how in ("auto", "never"))
    assert set(own.code) == set(plain.frames)
    assert not plain.code
    for name, frame in plain.frames.items():
        rng = np.random.default_rng(0)
        values = [rng.uniform(0.1, 1.0, n if i in frame.shared else (N, n)) for i, n in enumerate(frame.inputs)]
        pairs = zip(*(evaluated(code, frame, values) for code in (own.code[name], None)), strict=True)
        for x, y in pairs:
            assert np.isfinite(y).all()
            np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9, err_msg=name)


def test_frames_in_the_padding_have_no_observation() -> None:
    data, _ = observations("never", (RANGE,))
    _, inside, values = data.fragment(-3)
    assert np.array_equal(values.observation["w_point_anchor"] > 0, inside & (np.arange(-3, N - 3) != 3))


def test_the_cartesian_solver_follows_the_observations() -> None:
    settings = CartesianSettings(sigma_reprojection=5.0)
    solver = FragmentSolver(BODY, N, settings, sensor_joints=(), terms=[RANGE])
    wanted, off = ranges(error=0.1), []
    for observed in ({}, {"anchor": PointData(wanted, 0.002)}):
        solution = solver.solve(POSES, planted.keypoints(POSES), observed=observed)
        hand = solution.poses.p_world_joint[:, BODY.names.index("LeftHand")]
        off.append(np.abs(np.linalg.norm(hand - ANCHOR, axis=1) - wanted[:, 3]))
        assert set(solution.energy) >= {"visual", "anchor"}
    assert np.nanmean(off[1]) < 0.5 * np.nanmean(off[0])


def test_rows_are_zero_where_nothing_was_observed() -> None:
    rows = observed_rows([RANGE], {"anchor": PointData(ranges(), np.linspace(0.1, 0.2, N))}, N)
    assert rows["w_point_anchor"][3] == 0
    assert not rows["point_anchor"][3].any()
    assert rows["w_point_anchor"][0] == pytest.approx(100)
    assert not observed_rows([RANGE], {}, N)["w_point_anchor"].any()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"ancor": PointData(ranges(), 0.1)}, "ancor"),
        ({"anchor": PointData(ranges()[:3], 0.1)}, "shape"),
        ({"anchor": PointData(ranges(), 0.0)}, "sigma must be positive"),
        ({"anchor": PointData(ranges(), np.ones(3))}, "sigma"),
    ],
)
def test_wrong_observations_are_named(data: dict[str, PointData], message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        terms.check_observed([RANGE], data)
        observed_rows([RANGE], data, N)


def test_wrong_terms_are_named() -> None:
    for wrong in (replace(RANGE, name="visual"), replace(RANGE, name="two")):
        with pytest.raises(InvalidInputError, match="another"):
            FragmentSolver(BODY, N, terms=[wrong, replace(RANGE, name="two")])
    with pytest.raises(UnknownNameError, match="LeftHand"):
        FragmentSolver(BODY, N, terms=[replace(RANGE, joint="LeftHnd")])
    with pytest.raises(InvalidInputError, match="letters"):
        replace(RANGE, name="my anchor")
    with pytest.raises(InvalidInputError, match="positive"):
        replace(RANGE, size=0)
    with pytest.raises(InvalidInputError, match="derivative must be 1"):
        replace(SPEED, derivative=3)
    with pytest.raises(InvalidInputError, match="'speed': space 'cartesian' has positions alone"):
        FragmentSolver(BODY, N, CartesianSettings(), terms=[SPEED])


RATE = 50.0
RNG = np.random.default_rng(0)
K = np.array([[1200.0, 3.0, 960.0], [0.0, 1180.0, 540.0], [0.0, 0.0, 1.0]])
P = RNG.normal(size=(3, 6)) * 0.3 + np.array([[0.0], [0.2], [4.0]])
Q = P + RNG.normal(size=(3, 6)) * 0.4
UV = RNG.normal(size=(2, 6)) * 50 + 500
ACCELERATION, JERK = RNG.normal(size=(3, 4)) * 3, RNG.normal(size=(3, 3)) * 100
LENGTH = np.full((1, 6), 0.4)


def pixels(p: Array) -> Array:
    image = K @ p
    return np.asarray(image[:2] / image[2])


CASES: dict[str, tuple[Callable[[Any], Any], Callable[[Array], Array]]] = {
    "reprojection": (lambda p: terms.reprojection(p, UV, K), lambda p: pixels(p) - UV),
    "acceleration": (
        lambda p: terms.acceleration(p, ACCELERATION, RATE),
        lambda p: np.diff(p, n=2, axis=1) * RATE**2 - ACCELERATION,
    ),
    "velocity": (
        lambda p: terms.velocity(p, ACCELERATION, RATE),
        lambda p: (p[:, 2:] - p[:, :-2]) / 2 * RATE - ACCELERATION,
    ),
    "bone_vector_of_the_joint": (lambda p: terms.bone_vector(p, Q, P), lambda p: Q - p - P),
    "bone_vector_of_the_child": (lambda p: terms.bone_vector(Q, p, P), lambda p: p - Q - P),
    "jerk": (lambda p: terms.jerk(p, JERK, RATE), lambda p: np.diff(p, n=3, axis=1) * RATE**3 - JERK),
    "distance": (
        lambda p: terms.distance(p, Q, LENGTH),
        lambda p: np.linalg.norm(Q - p, axis=0, keepdims=True) - LENGTH,
    ),
    "position": (lambda p: terms.position(p, Q), lambda p: p - Q),
}


@pytest.mark.parametrize("name", CASES)
def test_residual_equals_numpy(name: str) -> None:
    symbolic, numeric = CASES[name]
    np.testing.assert_allclose(np.array(symbolic(ca.DM(P))), numeric(P), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_derivative_equals_finite_differences(name: str) -> None:
    symbolic, numeric = CASES[name]
    p = ca.SX.sym("p", *P.shape)
    J = np.array(ca.Function("J", [p], [ca.jacobian(ca.vec(symbolic(p)), ca.vec(p))])(P))
    step, columns = 1e-6, []
    for i in range(P.size):
        d = np.zeros(P.size)
        d[i] = step
        shift = d.reshape(P.shape, order="F")
        columns.append(((numeric(P + shift) - numeric(P - shift)) / (2 * step)).ravel(order="F"))
    np.testing.assert_allclose(J, np.stack(columns, axis=1), rtol=1e-6, atol=1e-6 * np.abs(J).max())


@given(residual=st.floats(0, 1e4), delta=st.floats(0.1, 10))
def test_pseudo_huber_lies_below_the_square_and_below_its_asymptote(residual: float, delta: float) -> None:
    value = float(terms.pseudo_huber(ca.DM(residual**2), delta))
    assert value <= residual**2 + 1e-9
    assert value <= 2 * delta * residual + 1e-9
    assert value >= -1e-12


@given(squared=st.floats(0.0, 1e3), delta=st.floats(0.1, 10))
def test_pseudo_hubers_weight_is_its_derivative(squared: float, delta: float) -> None:
    s = ca.SX.sym("s")
    slope = ca.Function("slope", [s], [ca.gradient(terms.pseudo_huber(s, delta), s)])
    weight = float(terms.pseudo_huber_weight(ca.DM(squared), delta))
    assert weight == pytest.approx(float(slope(squared)), rel=1e-9)
