"""States and poses become each other, and steps are what lies between states."""

from __future__ import annotations

from functools import cache

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body import kinematics
from rtof_kin.body.metrics import hinges
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve.joint_space.state import Limits, StateSpace

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
INNER = [name for j, name in enumerate(BODY.names) if j in BODY.parents]
HINGED = [BODY.names[j] for j in hinges(BODY)]
FREE, BENT = StateSpace(BODY, BODY.names, hinged=False), StateSpace(BODY, BODY.names, hinged=True)


def random_states(space: StateSpace, frames: int, seed: int = 0) -> Array:
    rest = np.zeros((frames, 3 + 4 * len(space.joints)))
    rest[:, 3::4] = 1.0
    return space.retract(rest, np.random.default_rng(seed).normal(size=(frames, space.size)))


def test_hinges_are_the_knees_and_elbows_about_their_flexion_axis() -> None:
    axes = {name: int(a) for name, a in zip(BENT.names, BENT.hinge_axis, strict=True) if a >= 0}
    assert set(axes) == set(HINGED) == {"LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm"}
    assert all(FREE.hinge_axis == -1)
    # In the T-pose knees turn about y (to the left), elbows about z (up).
    assert axes == {"LeftLeg": 1, "RightLeg": 1, "LeftForeArm": 2, "RightForeArm": 2}


@pytest.mark.parametrize("space", [FREE, BENT], ids=["free", "hinged"])
def test_states_and_poses_round_trip(space: StateSpace) -> None:
    x = random_states(space, 30)
    p, R = space.poses(x)
    again = space.from_poses(p[:, 0], R)
    np.testing.assert_allclose(again[:, :3], x[:, :3], atol=1e-15)
    difference = quat.multiply(quat.conjugate(space.rotations(x)), space.rotations(again))
    np.testing.assert_allclose(quat.log(difference), 0, atol=1e-7)


def test_fixed_joints_follow_their_parents() -> None:
    truth = planted.moving(BODY, 6)
    space = StateSpace(BODY, INNER, hinged=False)
    p, R = space.poses(space.from_poses(truth.poses.p_world_joint[:, 0], truth.poses.R_world_bone))
    np.testing.assert_allclose(p, truth.poses.p_world_joint, atol=1e-12)
    for j, name in enumerate(BODY.names):
        expected = truth.poses.R_world_bone[:, j if name in INNER else BODY.parents[j]]
        np.testing.assert_allclose(R[:, j], expected, atol=1e-12)


def test_hinge_keeps_its_flexion_only() -> None:
    rng = np.random.default_rng(1)
    for name in HINGED:
        (j,) = BODY.index(name)
        axis = int(BENT.hinge_axis[BENT.joints.index(j)])
        flexion = rng.uniform(-2.5, 2.5, 20)
        local = np.tile(np.eye(3), (20, len(BODY.names), 1, 1))
        local[:, j] = so3.about_axis("xyz"[axis], flexion) @ so3.exp(0.1 * rng.normal(size=(20, 3)))
        R = kinematics.world_rotations(BODY.parents, local)
        _, R_bent = BENT.poses(BENT.from_poses(np.zeros((20, 3)), R))
        bent = kinematics.local_rotations(BODY.parents, R_bent)[:, j]
        vector = so3.log(bent)
        np.testing.assert_allclose(np.delete(vector, axis, axis=1), 0, atol=1e-12)
        assert np.abs(vector[:, axis] - flexion).max() < 0.35


@pytest.mark.parametrize("space", [FREE, BENT], ids=["free", "hinged"])
def test_step_moves_the_root_in_world_and_joints_in_their_own_frames(space: StateSpace) -> None:
    x = random_states(space, 4)
    d = 0.5 * np.random.default_rng(2).normal(size=(4, space.size))
    y = space.retract(x, d)
    np.testing.assert_allclose(y[:, :3], x[:, :3] + d[:, :3], atol=1e-15)
    at = 3
    for a, axis in enumerate(space.hinge_axis):
        before, after = (Rotation.from_quat(space.rotations(s)[:, a], scalar_first=True) for s in (x, y))
        vector = np.zeros((4, 3))
        columns = [0, 1, 2] if axis < 0 else [int(axis)]
        vector[:, columns] = d[:, at : at + len(columns)]
        at += len(columns)
        expected = before * Rotation.from_rotvec(vector)
        np.testing.assert_allclose(after.as_matrix(), expected.as_matrix(), atol=1e-12)
    assert at == space.size


def test_blend_follows_the_shorter_arc() -> None:
    x = random_states(BENT, 5)
    d = 0.4 * np.random.default_rng(3).normal(size=(5, BENT.size))
    y, half = BENT.retract(x, d), BENT.retract(x, d / 2)
    flipped = y.copy()
    flipped[:, 3:] *= -1  # the same rotations by their other names
    for other in (y, flipped):
        p, R = BENT.poses(BENT.blend(x, other, np.full(5, 3.0), np.full(5, 3.0)))
        p_half, R_half = BENT.poses(half)
        np.testing.assert_allclose(p, p_half, atol=1e-12)
        np.testing.assert_allclose(R, R_half, atol=1e-12)


def test_a_twisted_shank_or_forearm_keeps_the_flexion_of_its_bone() -> None:
    x = random_states(BENT, 30)
    p, R = BENT.poses(x)
    for j in hinges(BODY):
        child = kinematics.children_of(BODY.parents, j)[0]
        R[:, j] = R[:, j] @ so3.exp(np.pi * so3.unit(BODY.joint_offsets[child]))
    bent = np.flatnonzero(BENT.hinge_axis >= 0)
    found = BENT.rotations(BENT.from_poses(p[:, 0], R))[:, bent]
    apart = quat.multiply(quat.conjugate(BENT.rotations(x)[:, bent]), found)
    np.testing.assert_allclose(quat.log(apart), 0, atol=1e-7)


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
    body = SkeletonModel(BODY.table)
    bounds = np.array(body.limits)
    bounds[body.dof_names.index("LeftLeg_y")] = low, high
    vars(body)["limits"] = bounds
    with pytest.raises(InvalidInputError, match="LeftLeg_y"):
        Limits(StateSpace(body, body.names, True))


def test_angles_beyond_a_limit_are_moved_onto_it_and_others_stay() -> None:
    q = configurations(40, share=1.3)
    x = limits().within(states_of(q))
    low, high = limits().lower, limits().upper
    np.testing.assert_allclose(limits().values(x), np.clip(q[:, columns()], low, high), atol=1e-9)
    inside = configurations(40)
    same = StateSpace(BODY, BODY.names, True).poses(limits().within(states_of(inside)))[1]
    np.testing.assert_allclose(same, BODY.forward_kinematics(inside)[1], atol=1e-9)
