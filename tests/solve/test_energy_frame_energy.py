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

    def inputs(self, O: dict[str, Array]) -> tuple[Array, ...]:
        """State, observations and constants as the functions take them."""
        energy, C = self.built.energy, self.data.constant
        return (
            self.x.ravel(),
            np.concatenate([O[name].ravel() for name in energy.observation]),
            np.concatenate([np.ravel(C[name], order="F") for name in energy.constant]),
        )

    def full(self, O: dict[str, Array] | None = None) -> list[Array]:
        return outputs(self.built.energy.full, self.inputs(O or self.data.observation))

    def terms(self, d: Array) -> list[js.Term]:
        return js.frame_terms(self.built, self.built.space.retract(self.x, d[None]), self.data)


@pytest.fixture(params=[(kind, seed) for kind in KINDS for seed in (0, 1)], ids=str)
def frame(request: pytest.FixtureRequest) -> Frame:
    return Frame(*request.param)


def outputs(function: object, inputs: tuple[Array, ...]) -> list[Array]:
    return [np.array(v).squeeze() for v in function.call(list(inputs))]  # type: ignore[attr-defined]


def test_terms_equal_the_numpy_reference(frame: Frame) -> None:
    expected = js.value(frame.terms(np.zeros(frame.built.space.size)))
    energies, *_ = outputs(frame.built.energy.value, frame.inputs(frame.data.observation))
    for name, energy in zip(TERMS, energies, strict=True):
        assert energy == pytest.approx(expected.get(name, 0.0), rel=1e-9, abs=1e-9), name


def test_gradient_and_hessian_equal_finite_differences(frame: Frame) -> None:
    D = frame.built.space.size
    gradient, hessian = js.derivatives(frame.terms, D)
    _, g, H, *_ = frame.full()
    np.testing.assert_allclose(g, gradient, atol=1e-6 * np.abs(gradient).max())
    np.testing.assert_allclose(H, np.tril(hessian), atol=1e-6 * np.abs(hessian).max())


def test_the_sensors_positions_and_their_jacobian_are_those_of_the_lever_arms(frame: Frame) -> None:
    b, levers = frame.built, frame.data.constant["levers"]

    def sensors(d: Array) -> Array:
        p, R = js.poses(b, b.space.retract(frame.x, d[None]))
        points = [p[0, j] + R[0, j] @ levers[:, s] for s, j in enumerate(b.shape.sensors)]
        return np.array(points).ravel()

    out = [np.array(v) for v in b.energy.full.call(list(frame.inputs(frame.data.observation)))]
    np.testing.assert_allclose(out[3].ravel(), sensors(np.zeros(b.space.size)), atol=1e-12)
    steps = 1e-6 * np.eye(b.space.size)
    numeric = np.array([(sensors(d) - sensors(-d)) / 2e-6 for d in steps]).T
    np.testing.assert_allclose(out[4], numeric.reshape(out[4].shape), atol=1e-8)


def test_an_opposite_quaternion_is_the_same_orientation(frame: Frame) -> None:
    O = frame.data.observation
    opposite = O | {name: -O[name] for name in ("quat_sensor", "quat_torso")}
    for one, two in zip(frame.full(O), frame.full(opposite), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12)


def test_prior_at_its_mean_has_the_precision_as_hessian() -> None:
    frame = Frame("balls", 3)
    O, C, x = dict(frame.data.observation), frame.data.constant, frame.x
    x[0, 7:] = C["quat_mean"].T.ravel()
    O |= {name: np.zeros_like(O[name]) for name in O if name.startswith("w_")}
    energies, g, H, *_ = frame.full(O | {"w_prior": np.array([0.25])})
    np.testing.assert_allclose(energies, 0, atol=1e-15)
    np.testing.assert_allclose(g, 0, atol=1e-6)
    np.testing.assert_allclose(H[6:, 6:], np.tril(0.25 * C["precision"]), atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sensor_half_a_turn_off_gives_finite_forces(axis: int) -> None:
    frame = Frame("balls", 3)
    frame.x[:, 3:] = np.tile(np.eye(4)[0], len(frame.built.space.joints))
    half_turn = np.eye(4)[None, None, 1 + axis]
    turned = {"quat_sensor": np.repeat(half_turn, 2, axis=1)}
    for out in frame.full(frame.data.observation | turned):
        assert np.isfinite(out).all()
