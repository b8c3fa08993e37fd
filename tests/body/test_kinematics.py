"""Kinematics of a tree: chains, SolveRotation, and continuity of the twist near 180 degrees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import LIMBS, LUMBAR_PITCH, bare, both_bones_sensed, shared_frames, to_shared
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
RNG = np.random.default_rng(2)
PARENTS = (-1, 0, 1, 1, 0, 4)
OFFSETS = np.array([[0, 0, 0], [0, 0, 0.3], [0, 0.4, 0], [0.1, -0.4, 0], [0, 0.1, -0.4], [0.2, 0, -0.3]])
DOWN = np.array([0.0, 0.0, -0.4])


def random_rotations(*shape: int, seed: int = 0) -> Array:
    R = Rotation.random(int(np.prod(shape)), rng=np.random.default_rng(seed)).as_matrix()
    return np.asarray(R).reshape(*shape, 3, 3)


def assert_close(a: Array, b: Array, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


def test_positions_follow_the_parent_segments() -> None:
    R, root = random_rotations(7, 6), RNG.normal(size=(7, 3))
    p = kinematics.positions(PARENTS, OFFSETS, root, R)
    assert_close(p[:, 0], root)
    for t in range(7):
        for child, parent in list(enumerate(PARENTS))[1:]:
            assert_close(p[t, child], p[t, parent] + R[t, parent] @ OFFSETS[child])


def test_local_and_world_rotations_are_inverse_for_any_batch() -> None:
    R = random_rotations(4, 3, 6)
    local = kinematics.local_rotations(PARENTS, R)
    assert_close(kinematics.world_rotations(PARENTS, local), R)
    assert_close(local[..., 0, :, :], R[..., 0, :, :])
    assert_close(local[..., 5, :, :], np.swapaxes(R[..., 4, :, :], -1, -2) @ R[..., 5, :, :])
    assert kinematics.positions(PARENTS, OFFSETS, np.zeros((4, 3, 3)), R).shape == (4, 3, 6, 3)


def test_several_children_determine_a_segment_like_scipy() -> None:
    p = RNG.normal(size=(5, 6, 3))
    R_parent = random_rotations(5)
    R = kinematics.segment_rotation(PARENTS, OFFSETS, 1, p, R_parent)
    for t in range(5):
        bones = p[t, [2, 3]] - p[t, 1]
        expected, _ = Rotation.align_vectors(bones, OFFSETS[[2, 3]])
        assert_close(R[t], expected.as_matrix(), 1e-7)
    leaf = kinematics.segment_rotation(PARENTS, OFFSETS, 5, p, R_parent)
    assert_close(leaf, R_parent, 0)


def test_one_child_determines_the_swing_and_the_twist_follows_the_parent() -> None:
    p, R_parent = RNG.normal(size=(50, 6, 3)), random_rotations(50)
    R = kinematics.segment_rotation(PARENTS, OFFSETS, 4, p, R_parent)
    bone = so3.unit(p[:, 5] - p[:, 4])
    assert_close((R @ so3.unit(OFFSETS[5])[:, None])[..., 0], bone)
    turn = so3.log(R @ np.swapaxes(R_parent, -1, -2))
    expected = R_parent @ so3.unit(OFFSETS[5])
    assert np.abs(np.sum(so3.unit(turn) * (expected + bone), axis=-1)).max() < 1e-6  # no twist
    assert_close(np.linalg.norm(turn, axis=-1), np.arccos(np.sum(expected * bone, axis=-1)), 1e-6)


def test_rotations_without_twist_are_recovered_from_positions() -> None:
    """Swings only, leaves as their parents: what positions determine."""
    skeleton = SkeletonModel.default()
    T, J = 20, len(skeleton.names)
    rest, local = skeleton.joint_offsets, np.tile(np.eye(3), (T, J, 1, 1))
    for j in range(J):
        children = kinematics.children_of(skeleton.parents, j)
        if len(children) > 1:
            local[:, j] = so3.exp(0.8 * RNG.normal(size=(T, 3)))
        elif children:
            axis = np.cross(rest[children[0]], RNG.normal(size=(T, 3)))
            local[:, j] = so3.exp(0.8 * so3.unit(axis) * RNG.normal(size=(T, 1)))
    R = kinematics.world_rotations(skeleton.parents, local)
    p = kinematics.positions(skeleton.parents, rest, RNG.normal(size=(T, 3)), R)
    for scale in (1.0, 2.5):  # bone lengths do not matter
        assert_close(kinematics.rotations_from_positions(skeleton.parents, rest, scale * p), R, 1e-9)


def passing(miss_deg: float, frames: int = 161, reach_deg: float = 80.0) -> Array:
    """Unit vectors on a great circle that misses straight up by some degrees, DOWN's opposite."""
    along = np.radians(np.linspace(-reach_deg, reach_deg, frames))
    path = np.stack([np.sin(along), np.zeros(frames), np.cos(along)], axis=-1)
    return path @ so3.about_axis("x", np.radians(miss_deg)).T


def steps_deg(R: Array) -> Array:
    return np.degrees(so3.angle_between(R[1:], R[:-1]))


STILL = np.tile(np.eye(3), (161, 1, 1))


@pytest.mark.parametrize("miss_deg", [0.0, 1e-9, 0.01, 0.5, 2.0, 5.0, 8.0, 9.99])
def test_bone_that_swings_past_its_opposite_does_not_flip(miss_deg: float) -> None:
    observed = passing(miss_deg)
    R = kinematics.swing(STILL, DOWN, observed)
    assert_close((R @ so3.unit(DOWN)[:, None])[..., 0], observed)
    # The bone rotates by one degree a frame; the returning twist adds five, or outside ten degrees the
    # smallest rotation itself adds tan(170 / 2). The smallest rotation alone flips.
    assert steps_deg(so3.minimal_rotation(DOWN, passing(0.5))).max() > 60
    assert steps_deg(R).max() < (6.1 if miss_deg <= 5 else np.hypot(1, np.tan(np.radians(85))) + 0.1)


def test_twist_returns_to_the_parents_afterwards() -> None:
    observed = np.vstack([passing(5.0), np.repeat(passing(5.0)[-1:], 40, axis=0)])
    R_parent = np.tile(np.eye(3), (len(observed), 1, 1))
    R = kinematics.swing(R_parent, DOWN, observed)
    smallest = so3.minimal_rotation(DOWN, observed)
    assert_close(R[-1], smallest[-1])
    assert_close(R[:60], smallest[:60])  # before, it is the smallest rotation
    far = passing(12.0)
    assert_close(kinematics.swing(STILL, DOWN, far), so3.minimal_rotation(DOWN, far))


def test_twist_of_an_opposite_first_frame_is_carried_over_and_returns() -> None:
    observed = passing(5.0)[83:]  # starts seven degrees from opposite and leaves
    R = kinematics.swing(STILL[: len(observed)], DOWN, observed)
    assert steps_deg(R).max() < 6.1
    assert_close(R[-1], so3.minimal_rotation(DOWN, observed[-1]))
    leaving = passing(0.5)[[80, 100, 101]]  # one frame opposite, the next twenty degrees further
    R = kinematics.swing(STILL[:3], DOWN, leaving)
    assert steps_deg(R)[0] < 20 + 5 + 0.5


def test_rotating_parent_carries_the_twist() -> None:
    """Bone opposite in the parent's frame all the time, the parent spinning: a rigid body."""
    R_parent = so3.about_axis("z", np.radians(3.0) * np.arange(60))
    observed = np.repeat([[0.0, 0.02, 1.0]], 60, axis=0)
    observed = (R_parent @ observed[..., None])[..., 0]
    R = kinematics.swing(R_parent, DOWN, observed)
    relative = np.swapaxes(R_parent, -1, -2) @ R
    assert_close(relative, np.repeat(relative[:1], 60, axis=0), 1e-9)


ARM = {"LeftArm", "LeftForeArm", "LeftHand"}


def test_limb_with_any_sensor_is_not_bare() -> None:
    everything = {name for limb in LIMBS for name in limb}
    assert bare(()) == bare(("Hips", "Head")) == everything
    assert all(bare((name,)) == everything - ARM for name in ARM)


@pytest.mark.parametrize(
    ("sensors", "both"),
    [
        ((), False),
        (("LeftArm", "RightForeArm"), False),
        (("LeftForeArm", "LeftHand"), False),
        (("RightUpLeg", "Hips", "RightLeg"), True),
    ],
)
def test_both_bones_must_be_of_one_limb(sensors: tuple[str, ...], both: bool) -> None:
    assert both_bones_sensed(sensors) is both


BODY = SkeletonModel.default()
NAMES, PARENTS_SHARED_FRAMES = BODY.names, BODY.parents


def test_the_lumbar_joint_and_the_limbs_have_their_directions() -> None:
    offsets = to_shared(shared_frames(NAMES, BODY.joint_offsets), PARENTS_SHARED_FRAMES, BODY.joint_offsets)
    own = dict(zip(NAMES, offsets, strict=True))
    up = own["Spine"] - (own["LeftUpLeg"] + own["RightUpLeg"]) / 2
    np.testing.assert_allclose(np.arctan2(up[0], up[2]), LUMBAR_PITCH, atol=1e-12)
    np.testing.assert_allclose((own["LeftUpLeg"] - own["RightUpLeg"])[[0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(so3.unit(own["LeftFoot"]), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(so3.unit(own["RightHand"]), [0, -1, 0], atol=1e-12)


def test_a_pelvis_frame_that_is_turned_against_the_joints_gives_the_same_body() -> None:
    turned = np.array(BODY.joint_offsets)
    R_old_new = so3.exp(np.radians([3.0, -8.0, 2.0]))
    of_pelvis = [j for j, parent in enumerate(PARENTS_SHARED_FRAMES) if parent == 0]
    turned[of_pelvis] = turned[of_pelvis] @ R_old_new
    old, new = (shared_frames(NAMES, offsets) for offsets in (BODY.joint_offsets, turned))
    np.testing.assert_allclose(R_old_new @ new[0], old[0], atol=1e-12)
    np.testing.assert_allclose(
        to_shared(new, PARENTS_SHARED_FRAMES, turned)[of_pelvis],
        to_shared(old, PARENTS_SHARED_FRAMES, BODY.joint_offsets)[of_pelvis],
        atol=1e-12,
    )


def test_a_straight_spine_and_unknown_joints_keep_their_link_frames() -> None:
    straight = np.array(BODY.joint_offsets)
    straight[NAMES.index("Spine")] = [0.0, 0.0, 0.1]
    np.testing.assert_array_equal(shared_frames(NAMES, straight)[0], np.eye(3))
    other = SkeletonModel.human36m()
    np.testing.assert_array_equal(
        shared_frames(other.names, other.joint_offsets), np.tile(np.eye(3), (len(other.names), 1, 1))
    )
