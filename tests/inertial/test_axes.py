"""Axes of joints, planted in angular velocities."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError
from rtof_kin.inertial.axes import hinge_axis, principal_axis

Array = NDArray[np.float64]


def hinge(seed: int, noise: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Angular velocities of two sensors beside a hinge, and its axis in the axes of each."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 20, 0.02)
    w_1 = np.sin(np.outer(t, [1.1, 1.7, 2.3]) + rng.uniform(0, 6, 3))
    j_1, R_2_1 = so3.unit(rng.standard_normal(3)), so3.exp(rng.standard_normal(3))
    angle, rate = 1 + np.cos(2.9 * t), -2.9 * np.sin(2.9 * t)
    # The second segment turns with the first and about the axis, whose place in it is fixed.
    R_bent_1 = R_2_1 @ so3.exp(-angle[:, None] * j_1)
    w_2 = np.einsum("tij,tj->ti", R_bent_1, w_1 + rate[:, None] * j_1)
    off = noise * rng.standard_normal((2, len(t), 3))
    return w_1 + off[0], w_2 + off[1], j_1, R_2_1 @ j_1


def apart_deg(a: Array, b: Array) -> float:
    """Angle between two lines."""
    return float(np.degrees(np.arccos(min(1.0, abs(float(a @ b))))))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("noise", "within"), [(0.0, 3.0), (0.1, 4.0)])
def test_a_hinge_is_found_in_both_sensors(seed: int, noise: float, within: float) -> None:
    w_1, w_2, j_1, j_2 = hinge(seed, noise)
    found = hinge_axis(w_1, w_2)
    assert apart_deg(found.axis_1, j_1) < within
    assert apart_deg(found.axis_2, j_2) < within
    assert found.residual < 0.2


def test_a_knock_does_not_turn_the_axis() -> None:
    w_1, w_2, j_1, _ = hinge(1)
    w_1, w_2 = w_1.copy(), w_2.copy()
    w_2[100:110] += 30.0
    w_1[300] = np.nan
    assert apart_deg(hinge_axis(w_1, w_2).axis_1, j_1) < 4


def test_turning_in_one_plane_has_an_axis_too() -> None:
    t = np.arange(0, 10, 0.02)
    j = so3.unit(np.array([1.0, 2.0, -1.0]))
    found = hinge_axis(np.sin(t)[:, None] * j, -2 * np.sin(3 * t)[:, None] * j[::-1])
    assert apart_deg(found.axis_1, j) < 0.1
    assert apart_deg(found.axis_2, j[::-1]) < 0.1


def test_a_joint_that_hardly_moves_has_none() -> None:
    w = 0.01 * np.ones((100, 3))
    with pytest.raises(CalibrationError, match="turn by 0.017 rad/s only; bend the joint more"):
        hinge_axis(w, w)
    with pytest.raises(CalibrationError, match="there are 5 instants"):
        hinge_axis(np.ones((5, 3)), np.ones((5, 3)))


def test_the_principal_axis_is_that_of_most_turning() -> None:
    rng = np.random.default_rng(0)
    axis = so3.unit(rng.standard_normal(3))
    w = rng.standard_normal((500, 1)) * axis + 0.2 * rng.standard_normal((500, 3))
    w[7] = np.nan
    found, share = principal_axis(w)
    assert apart_deg(found, axis) < 2
    assert 0.85 < share < 0.95
