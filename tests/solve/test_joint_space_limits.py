"""Angles of hinges, their limits, and their derivatives."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve.joint_space.state import Limits, StateSpace

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
HINGES = {"LeftLeg_y", "RightLeg_y", "LeftForeArm_z", "RightForeArm_z"}


@cache
def limits() -> Limits:
    return Limits(StateSpace(BODY, BODY.names, True))


def states_of(q: Array) -> Array:
    p, R = BODY.forward_kinematics(q)
    return StateSpace(BODY, BODY.names, True).from_poses(p[:, 0], R)


def configurations(frames: int, seed: int = 0, share: float = 1.0) -> Array:
    """(T, nq) with all angles drawn within this share of their limits, knees and elbows as hinges."""
    rng = np.random.default_rng(seed)
    low, high = BODY.limits.T
    middle, half = (low + high) / 2, share * (high - low) / 2
    q = np.tile(BODY.t_pose(), (frames, 1))
    q[:, 7:] = middle + half * rng.uniform(-1, 1, (frames, len(low)))
    for i, name in enumerate(BODY.dof_names):
        joint = name.rsplit("_", 1)[0]
        if any(hinge.startswith(joint + "_") for hinge in HINGES) and name not in HINGES:
            q[:, 7 + i] = 0.0
    return q


def columns() -> list[int]:
    return [7 + BODY.dof_names.index(name) for name in limits().names]


def test_knees_and_elbows_have_the_limits_of_the_urdf() -> None:
    assert set(limits().names) == HINGES
    rows = [BODY.dof_names.index(name) for name in limits().names]
    np.testing.assert_allclose([limits().lower, limits().upper], BODY.limits[rows].T)


def test_values_are_the_angles_of_the_configuration() -> None:
    q = configurations(200)
    np.testing.assert_allclose(limits().values(states_of(q)), q[:, columns()], atol=1e-9)
    assert not limits().excess(limits().values(states_of(q))).any()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_angle_beyond_its_limit_is_out_by_the_difference(sign: float) -> None:
    for m, column in enumerate(columns()):
        q = configurations(1, seed=m, share=0.5)
        q[0, column] = (limits().upper if sign > 0 else limits().lower)[m] + sign * 0.05
        excess = limits().excess(limits().values(states_of(q)))
        assert excess[0, m] == pytest.approx(sign * 0.05, abs=1e-6)
        assert np.count_nonzero(excess) == 1


def test_force_and_curvature_are_products_with_the_jacobian() -> None:
    found, rng = limits(), np.random.default_rng(0)
    x, space = states_of(configurations(6, 2, 0.9)), StateSpace(BODY, BODY.names, True)
    steps = 1e-6 * np.eye(space.size)
    J = np.stack([found.values(space.retract(x, d + 0 * x[:, :1])) - found.values(x) for d in steps], axis=-1)
    J = J / 1e-6
    push = rng.normal(size=J.shape[:2]) * (rng.uniform(size=J.shape[:2]) < 0.4)
    np.testing.assert_allclose(found.force(x, push), np.einsum("tm,tmd->td", push, J), atol=1e-6)
    H = np.zeros((6, J.shape[2], J.shape[2]))
    frames, rows, at, values = found.curvature(x, push != 0)
    np.add.at(H, (frames, rows, at), values)
    chosen = J * (push != 0)[..., None]
    np.testing.assert_allclose(H, np.swapaxes(chosen, 1, 2) @ chosen, atol=1e-6)


@pytest.mark.parametrize("low, high", [(0.5, 0.2), (0.3, 0.3), (np.nan, 1.0)])
def test_limits_that_contradict_each_other_are_refused_by_name(low: float, high: float) -> None:
    body = SkeletonModel.default()
    bounds = np.array(body.limits)
    bounds[body.dof_names.index("LeftLeg_y")] = low, high
    vars(body)["limits"] = bounds
    with pytest.raises(InvalidInputError, match="LeftLeg_y"):
        Limits(StateSpace(body, body.names, True))


def test_limits_of_a_hinge_that_does_not_move_are_not_asked_for() -> None:
    moving = [name for name in BODY.names if name != "LeftForeArm"]
    assert set(Limits(StateSpace(BODY, moving, True)).names) == HINGES - {"LeftForeArm_z"}


def test_angles_beyond_a_limit_are_moved_onto_it_and_others_stay() -> None:
    q = configurations(40, share=1.3)
    x = limits().within(states_of(q))
    low, high = limits().lower, limits().upper
    np.testing.assert_allclose(limits().values(x), np.clip(q[:, columns()], low, high), atol=1e-9)
    inside = configurations(40)
    same = StateSpace(BODY, BODY.names, True).poses(limits().within(states_of(inside)))[1]
    np.testing.assert_allclose(same, BODY.forward_kinematics(inside)[1], atol=1e-9)
