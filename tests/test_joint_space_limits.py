"""The URDF's angles of states, their limits, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import planted
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.errors import ShapeError
from rtof_kin.joint_space.limits import Limits
from rtof_kin.joint_space.state import StateSpace
from rtof_kin.skeleton import SkeletonModel

Array = NDArray[np.float64]
BODY = SkeletonModel.default()


@cache
def limits(hinged: bool = True) -> Limits:
    return Limits(StateSpace(BODY, BODY.names, hinged))


def states_of(q: Array, hinged: bool = True) -> Array:
    p, R = BODY.forward_kinematics(q)
    return limits(hinged).space.from_poses(p[:, 0], R)


def configurations(frames: int, seed: int = 0, share: float = 1.0) -> Array:
    """(T, nq) with angles drawn within this share of their limits, knees and elbows as hinges."""
    rng = np.random.default_rng(seed)
    low, high = BODY.limits.T
    middle, half = (low + high) / 2, share * (high - low) / 2
    q = np.tile(BODY.t_pose(), (frames, 1))
    q[:, 7:] = middle + half * rng.uniform(-1, 1, (frames, len(low)))
    for name in set(BODY.dof_names) - set(limits().names):
        q[:, 7 + BODY.dof_names.index(name)] = 0.0
    return q


def regular(limits: Limits, x: Array) -> NDArray[np.bool_]:
    """(T, M) angles whose joint is at least 15 degrees from a singular posture, and middle ones."""
    out = np.ones((len(x), len(limits.names)), dtype=bool)
    for a, j in enumerate(limits.space.joints[1:], start=1):
        joint = BODY.table.joints[j]
        if limits.space.hinge_axis[a] < 0:
            angles = so3.matrix_to_euler(joint.axes, so3.from_quat_wxyz(limits.space.rotations(x)[:, a]))
            columns = [limits.names.index(dof.urdf) for dof in joint.dofs]
            out[:, columns[::2]] = (np.abs(np.cos(angles[:, 1])) > np.sin(np.radians(15)))[:, None]
    return out


def of(limits: Limits, rows: Array) -> Array:
    """The columns of angles (T, dofs) that belong to the limits' names."""
    return rows[:, [BODY.dof_names.index(name) for name in limits.names]]


# --- angles --------------------------------------------------------------------------------------


def test_every_angle_of_the_urdf_has_its_limits_and_hinges_have_one() -> None:
    assert set(limits(False).names) == set(BODY.dof_names)
    gone = set(BODY.dof_names) - set(limits().names)
    assert {name.rsplit("_", 1)[0] for name in gone} == {
        "LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm"
    }  # fmt: skip
    assert len(gone) == 8
    for hinged in (True, False):
        bounds = of(limits(hinged), BODY.limits.T)
        expected = [limits(hinged).lower, limits(hinged).upper]  # the URDF has 12 digits
        np.testing.assert_allclose(bounds, expected, atol=1e-11)


@pytest.mark.parametrize("hinged", [True, False])
def test_angles_within_the_limits_are_the_configurations(hinged: bool) -> None:
    q, found = configurations(200), limits(hinged)
    x = states_of(q, hinged)
    values, clear = found.values(x), regular(found, x)
    assert np.all(found.excess(values) == 0)
    # A shoulder's limits have room for both names of some rotations.
    one_name = [not name.startswith(("LeftArm", "RightArm")) for name in found.names]
    same = np.abs(values - of(found, q[:, 7:])) < 1e-6
    assert same[:, one_name][clear[:, one_name]].all()
    assert clear[:, one_name].mean() > 0.9
    assert same.all(axis=1).mean() > 0.3


def test_angles_are_those_of_inverse_kinematics() -> None:
    truth = planted.human(BODY, 40)
    x = limits().space.from_poses(truth.poses.p_world_joint[:, 0], truth.poses.R_world_bone)
    q = BODY.inverse_kinematics(truth.poses.p_world_joint, truth.poses.R_world_bone)
    clear = regular(limits(), x)
    assert clear.mean() > 0.9
    np.testing.assert_allclose(limits().values(x)[clear], of(limits(), q[:, 7:])[clear], atol=1e-6)


@given(seed=st.integers(0, 2**32 - 1))
def test_any_angles_give_back_the_rotation_they_are_of(seed: int) -> None:
    found = limits(False)
    rest = np.zeros((3, 3 + 4 * 21))
    rest[:, 3::4] = 1.0
    x = found.space.retract(rest, 2 * np.random.default_rng(seed).normal(size=(3, found.space.size)))
    q = np.tile(BODY.t_pose(), (3, 1))
    values, clear = found.values(x), regular(found, x)
    for column, name in enumerate(found.names):
        q[:, 7 + BODY.dof_names.index(name)] = values[:, column]
    local = kinematics.local_rotations(BODY.parents, BODY.forward_kinematics(q)[1])
    expected = so3.from_quat_wxyz(found.space.rotations(x))
    for j in range(1, 21):
        columns = [i for i, name in enumerate(found.names) if name.startswith(BODY.names[j] + "_")]
        fine = clear[:, columns].all(axis=1)
        np.testing.assert_allclose(local[fine, j], expected[fine, j], atol=1e-7)


def test_a_shoulder_beyond_a_right_angle_is_named_within_its_limits() -> None:
    # 110 degrees about the middle axis, which a shoulder reaches and an Euler angle in its usual
    # range does not.
    names = [dof.urdf for dof in BODY.table.joints[BODY.index("LeftArm")[0]].dofs]
    q = np.tile(BODY.t_pose(), (1, 1))
    angles = np.radians([20.0, 110.0, 30.0])
    q[0, [7 + BODY.dof_names.index(name) for name in names]] = angles
    values = limits().values(states_of(q))
    np.testing.assert_allclose(values[0, [limits().names.index(n) for n in names]], angles, atol=1e-9)
    assert np.all(limits().excess(values) == 0)


# --- excess --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_angle_beyond_its_limit_is_out_by_the_difference(sign: float) -> None:
    found = limits()
    for column in range(len(found.names)):
        q = configurations(1, seed=column, share=0.5)
        edge = found.upper[column] if sign > 0 else found.lower[column]
        q[0, 7 + BODY.dof_names.index(found.names[column])] = edge + sign * 0.05
        excess = found.excess(found.values(states_of(q)))
        assert excess[0, column] == pytest.approx(sign * 0.05, abs=1e-6), found.names[column]
        assert np.count_nonzero(excess) == 1


def test_an_overstretched_knee_is_out_and_a_bent_one_is_not() -> None:
    column = limits().names.index("LeftLeg_y")
    for degrees, out in ((90.0, False), (-12.0, True)):
        q = BODY.t_pose()[None].copy()
        q[0, 7 + BODY.dof_names.index("LeftLeg_y")] = np.radians(degrees)
        assert (limits().excess(limits().values(states_of(q)))[0, column] != 0) == out


# --- derivatives ---------------------------------------------------------------------------------


def numeric(values: Callable[[Array], Array], size: int, step: float = 1e-6) -> Array:
    """(T, M, D) central differences, every frame by its own step."""
    columns = []
    for i in range(size):
        d = np.zeros(size)
        d[i] = step
        columns.append((values(d) - values(-d)) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("hinged", [True, False])
@pytest.mark.parametrize("share", [0.9, 1.3])
def test_the_jacobian_is_that_of_the_values(hinged: bool, share: float) -> None:
    found = limits(hinged)
    x = states_of(configurations(30, 1, share), hinged)
    J = found.jacobian(x)
    space = found.space
    expected = numeric(lambda d: found.values(space.retract(x, np.tile(d, (30, 1)))), space.size)
    smooth = np.abs(expected).max(axis=-1) < 50  # elsewhere the angles jump to another name
    assert smooth.mean() > 0.98
    np.testing.assert_allclose(J[smooth], expected[smooth], atol=1e-4)


def test_force_and_curvature_are_products_with_the_jacobian() -> None:
    found, rng = limits(), np.random.default_rng(0)
    x = states_of(configurations(6, 2))
    J = found.jacobian(x)
    push = rng.normal(size=J.shape[:2]) * (rng.uniform(size=J.shape[:2]) < 0.2)
    np.testing.assert_allclose(found.force(x, push), np.einsum("tm,tmd->td", push, J), atol=1e-12)
    size = found.space.size
    H = np.zeros((6, size, size))
    frames, rows, columns, values = found.curvature(x, push != 0)
    np.add.at(H, (frames, rows, columns), values)
    chosen = J * (push != 0)[..., None]
    np.testing.assert_allclose(H, np.swapaxes(chosen, 1, 2) @ chosen, atol=1e-12)
    assert not found.force(x, 0 * push).any()


def test_the_root_has_no_limits() -> None:
    J = limits().jacobian(states_of(configurations(3)))
    assert J.shape == (3, len(limits().names), limits().space.size)
    assert np.all(J[:, :, :6] == 0)


def shoulder(degrees: float) -> tuple[Array, list[int]]:
    """A state with the left arm's middle angle, the others well beyond their limits."""
    (j,) = BODY.index("LeftArm")
    names = [dof.urdf for dof in BODY.table.joints[j].dofs]
    q = BODY.t_pose()[None].copy()
    q[0, [7 + BODY.dof_names.index(name) for name in names]] = [2.5, np.radians(degrees), 2.5]
    return states_of(q), [limits().names.index(name) for name in names]


@pytest.mark.parametrize("degrees", [-94.0, -86.0, 86.0, 90.001, 94.0])
def test_near_a_singular_posture_the_middle_angle_alone_is_bounded(degrees: float) -> None:
    x, rows = shoulder(degrees)
    values, J = limits().values(x), limits().jacobian(x)
    assert np.isfinite(J).all()
    middle = (limits().lower + limits().upper)[rows] / 2
    np.testing.assert_allclose(values[0, rows[::2]], middle[::2], atol=1e-12)
    assert np.all(J[0, rows[::2]] == 0)
    assert np.linalg.norm(J[0, rows[1]]) == pytest.approx(1.0, abs=1e-3)


def test_on_the_way_to_a_singular_posture_values_and_derivatives_stay_moderate() -> None:
    for degrees in np.arange(60.0, 120.0, 0.5):
        J = limits().jacobian(shoulder(degrees)[0])
        assert np.abs(J).max() < 40


# --- what is refused -----------------------------------------------------------------------------


def with_limits(joint: str, row: int, low: float, high: float) -> SkeletonModel:
    (j,) = BODY.index(joint)
    body = SkeletonModel.default()
    bounds = np.array(body.limits)
    bounds[body.dof_names.index(BODY.table.joints[j].dofs[row].urdf)] = low, high
    vars(body)["limits"] = bounds
    return body


@pytest.mark.parametrize("low, high", [(0.5, 0.2), (0.3, 0.3), (np.nan, 1.0)])
def test_limits_that_contradict_each_other_are_refused_by_name(low: float, high: float) -> None:
    body = with_limits("LeftUpLeg", 1, low, high)
    name = body.table.joints[body.index("LeftUpLeg")[0]].dofs[1].urdf
    with pytest.raises(ShapeError, match=f"limits of {name} contradict each other: lower is not below"):
        Limits(StateSpace(body, body.names, True))


def test_limits_of_a_joint_that_does_not_move_are_not_asked_for() -> None:
    body = with_limits("LeftHand", 0, 0.5, 0.2)
    inner = [name for j, name in enumerate(body.names) if j in body.parents]
    found = Limits(StateSpace(body, inner, True))
    assert not any(name.startswith("LeftHand") for name in found.names)


def test_every_angle_is_named_by_the_turn_nearest_to_the_middle_of_its_limits() -> None:
    found = limits(False)
    values = found.values(states_of(configurations(20, 3, 2.0), False))
    assert np.all(np.abs(values - (found.lower + found.upper) / 2) <= np.pi + 1e-9)
