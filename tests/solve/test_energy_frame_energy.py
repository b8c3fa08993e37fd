"""One frame's energy against its description in NumPy, its derivatives against finite differences."""

from __future__ import annotations

import joint_space_support as js
import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.solve.energy.frame_energy import TERMS

Array = NDArray[np.float64]
KINDS = ("bare", "whole", "balls", "feet")


class Frame:
    """The functions of one frame at a random state, and the same from the description."""

    def __init__(self, kind: str, seed: int) -> None:
        self.built = b = js.built(kind)
        self.x = js.states(b.space, 1, seed)
        x = js.states(b.space, 4, seed)  # acceleration and jerk need four; frame 0 is looked at
        self.data = js.one_frame(js.random_data(b, x, seed + 100), 0)
        O, C = self.data.observation, self.data.constant
        self.inputs = (
            self.x.ravel(),
            np.concatenate([O[name].ravel() for name in b.energy.observation]),
            np.concatenate([np.ravel(C[name], order="F") for name in b.energy.constant]),
        )

    def terms(self, d: Array) -> list[js.Term]:
        return js.frame_terms(self.built, self.built.space.retract(self.x, d[None]), self.data)


@pytest.fixture(params=[(kind, seed) for kind in KINDS for seed in (0, 1)], ids=str)
def frame(request: pytest.FixtureRequest) -> Frame:
    return Frame(*request.param)


def outputs(function: object, inputs: tuple[Array, ...]) -> list[Array]:
    return [np.array(v).squeeze() for v in function.call(list(inputs))]  # type: ignore[attr-defined]


def test_terms_equal_the_numpy_reference(frame: Frame) -> None:
    expected = js.value(frame.terms(np.zeros(frame.built.space.size)))
    energies, *_ = outputs(frame.built.energy.value, frame.inputs)
    for name, energy in zip(TERMS, energies, strict=True):
        assert energy == pytest.approx(expected.get(name, 0.0), rel=1e-9, abs=1e-9), name


def test_gradient_and_hessian_equal_finite_differences(frame: Frame) -> None:
    D = frame.built.space.size
    gradient, hessian = js.derivatives(frame.terms, D)
    _, g, H, *_ = outputs(frame.built.energy.full, frame.inputs)
    np.testing.assert_allclose(g, gradient, atol=1e-6 * np.abs(gradient).max())
    np.testing.assert_allclose(H, np.tril(hessian), atol=1e-6 * np.abs(hessian).max())


def test_gradient_equals_that_of_the_energy(frame: Frame) -> None:
    space, energy = frame.built.space, frame.built.energy
    _, g, *_ = outputs(energy.full, frame.inputs)

    def total(d: Array) -> float:
        x = space.retract(frame.x, d[None]).ravel()
        return float(outputs(energy.value, (x, *frame.inputs[1:]))[0].sum())

    steps = 1e-6 * np.eye(space.size)
    numeric = np.array([(total(d) - total(-d)) / 2e-6 for d in steps])
    np.testing.assert_allclose(g, numeric, atol=1e-5 * np.abs(g).max())


def test_the_sensors_positions_and_their_jacobian_are_those_of_the_lever_arms(frame: Frame) -> None:
    b, levers = frame.built, frame.data.constant["levers"]

    def sensors(d: Array) -> Array:
        p, R = js.poses(b, b.space.retract(frame.x, d[None]))
        points = [p[0, j] + R[0, j] @ levers[:, s] for s, j in enumerate(b.shape.sensors)]
        return np.array(points).ravel()

    out = [np.array(v) for v in b.energy.full.call(list(frame.inputs))]
    np.testing.assert_allclose(out[3].ravel(), sensors(np.zeros(b.space.size)), atol=1e-12)
    steps = 1e-6 * np.eye(b.space.size)
    numeric = np.array([(sensors(d) - sensors(-d)) / 2e-6 for d in steps]).T
    np.testing.assert_allclose(out[4], numeric.reshape(out[4].shape), atol=1e-8)


def test_an_opposite_quaternion_is_the_same_orientation(frame: Frame) -> None:
    b, O = frame.built, dict(frame.data.observation)
    for name in ("quat_sensor", "quat_torso"):
        O[name] = -O[name]
    rows = np.concatenate([O[name].ravel() for name in b.energy.observation])
    for one, two in zip(
        outputs(b.energy.full, frame.inputs),
        outputs(b.energy.full, (frame.inputs[0], rows, frame.inputs[2])),
        strict=True,
    ):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12)


def test_prior_at_its_mean_has_the_precision_as_hessian() -> None:
    b = js.built("balls")
    data = js.one_frame(js.random_data(b, js.states(b.space, 4), 3), 0)
    x = js.states(b.space, 1)
    x[0, 7:] = data.constant["quat_mean"].T.ravel()
    O = {n: np.zeros_like(v) if n.startswith("w_") else v for n, v in data.observation.items()}
    O["w_prior"] = np.array([0.25])
    rows = np.concatenate([O[name].ravel() for name in b.energy.observation])
    fixed = np.concatenate([np.ravel(data.constant[n], order="F") for n in b.energy.constant])
    energies, g, H, *_ = outputs(b.energy.full, (x.ravel(), rows, fixed))
    np.testing.assert_allclose(energies, 0, atol=1e-15)
    np.testing.assert_allclose(g, 0, atol=1e-6)
    np.testing.assert_allclose(H[6:, 6:], np.tril(0.25 * data.constant["precision"]), atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sensor_half_a_turn_off_gives_finite_forces(axis: int) -> None:
    b = js.built("balls")
    data = js.one_frame(js.random_data(b, js.states(b.space, 4), 3), 0)
    x = js.states(b.space, 1)
    O = dict(data.observation)
    half_turn = np.eye(4)[None, None, 1 + axis]
    O["quat_sensor"] = np.repeat(half_turn, 2, axis=1)
    x[:, 3:] = np.tile(np.eye(4)[0], len(b.space.joints))
    rows = np.concatenate([O[name].ravel() for name in b.energy.observation])
    fixed = np.concatenate([np.ravel(data.constant[n], order="F") for n in b.energy.constant])
    for out in outputs(b.energy.full, (x.ravel(), rows, fixed)):
        assert np.isfinite(out).all()
