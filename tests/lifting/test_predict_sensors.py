"""`Lifter.predict` with sensors: orientations, uncertainties, any subset of sensors, causal lifters."""

from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from lifting import predict as module
from lifting.predict import LiftedPoses, Lifter
from lifting.windows import SIGMA_ACROSS, SIGMA_ALONG, SIGMA_TURN, EncodedWindows
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

Array = NDArray[np.float64]
T = 40
OFFSETS = support.TABLE.offsets
BODY = support.tiny_corpus().body()
EVERY = BODY.sensors
FLIP = np.diag([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return support.untrained_lifter()


@pytest.fixture(scope="module")
def camera() -> Camera:
    return support.side_camera()


@pytest.fixture(scope="module")
def keypoints(camera: Camera) -> KeypointSequence:
    return support.seen_by(camera, support.positions(0, T))


@pytest.fixture(scope="module")
def imus() -> BoneImuSequence:
    return support.worn_by(0, T, EVERY)


@pytest.fixture(scope="module")
def lifted(lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence) -> LiftedPoses:
    return lifter.predict(keypoints, OFFSETS, bone_imus=imus)


def arrays(poses: LiftedPoses) -> list[Array]:
    return [poses.p_world_joint, poses.sigma_m, poses.R_world_bone, poses.sigma_rad]


def assert_same(one: LiftedPoses, two: LiftedPoses, atol: float = 1e-4) -> None:
    for a, b in zip(arrays(one), arrays(two), strict=True):
        np.testing.assert_allclose(a, b, atol=atol)


def differ(one: LiftedPoses, two: LiftedPoses) -> float:
    return float(np.abs(one.p_world_joint - two.p_world_joint).max())


def spoilt(imus: BoneImuSequence, where: object) -> BoneImuSequence:
    R = np.array(imus.R_world_bone)
    R[where] = np.nan  # type: ignore[index]
    return replace(imus, R_world_bone=R)


# --- a perfect network ---------------------------------------------------------------------------


def test_a_perfect_answer_is_the_scene(
    lifter: Lifter, keypoints: KeypointSequence, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses, orientations and their uncertainties come back in world, each with its own meaning."""
    _, R = support.moving(0, T)
    p = support.positions(0, T) - camera.center_world
    axes, points = (torch.from_numpy(x).float() for x in (R[..., [0, 2]], p))
    across, along, turn = 0.01, 0.03, 0.05

    def perfect(self: Lifter, encoded: EncodedWindows, flip: bool) -> Tensor:
        now, R_ray = points.permute(0, 2, 1), encoded.R_ray_world
        pose = torch.bmm(R_ray, now - now[:, :, :1])[:, :, 1:]
        root = torch.einsum("bij,bj->bi", encoded.R_view_world, now[:, :, 0])
        shift = root[:, :2] / root[:, 2:] / encoded.scale[:, None]
        distance = (root.norm(dim=1) * encoded.scale).log()[:, None]
        spread = torch.tensor([across, along]).log()[:, None].expand(T, 2, 21)
        in_ray = torch.einsum("bij,bsja->bais", R_ray, axes)
        turns = torch.full((T, 21), turn).log()
        parts = [pose, shift, distance, spread, in_ray, turns]
        return torch.cat([x.flatten(1) for x in parts], dim=1)

    monkeypatch.setattr(Lifter, "_answer", perfect)
    poses = lifter.predict(keypoints, OFFSETS)
    np.testing.assert_allclose(poses.p_world_joint, p + camera.center_world, atol=1e-5)
    np.testing.assert_allclose(poses.R_world_bone, R, atol=1e-5)
    assert so3.is_rotation(poses.R_world_bone)
    np.testing.assert_allclose(poses.sigma_rad, SIGMA_TURN * turn, rtol=1e-5)
    np.testing.assert_allclose(poses.sigma_m[:, 1:, 0], SIGMA_ACROSS * across, rtol=1e-5)
    np.testing.assert_allclose(poses.sigma_m[:, 1:, 1], SIGMA_ALONG * along, rtol=1e-5)
    away = np.linalg.norm(p[:, 0], axis=-1)
    np.testing.assert_allclose(poses.sigma_m[:, 0, 0], SIGMA_ACROSS * across * away, rtol=1e-4)
    np.testing.assert_allclose(poses.sigma_m[:, 0, 1], SIGMA_ALONG * along * away, rtol=1e-4)


def test_orientations_are_rotations_and_everything_has_an_uncertainty(lifted: LiftedPoses) -> None:
    assert lifted.R_world_bone.shape == (T, 21, 3, 3)
    assert so3.is_rotation(lifted.R_world_bone)
    assert lifted.sigma_m.shape == (T, 21, 2)
    assert lifted.sigma_rad.shape == (T, 21)
    assert (lifted.sigma_m > 0).all()
    assert (lifted.sigma_rad > 0).all()
    for values in arrays(lifted):
        assert values.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            values[0, 0] = 1.0


# --- what must not matter ------------------------------------------------------------------------


def test_sensors_are_read(
    lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence, lifted: LiftedPoses
) -> None:
    assert differ(lifter.predict(keypoints, OFFSETS), lifted) > 1e-3
    wrong = replace(imus, R_world_bone=imus.R_world_bone @ so3.about_axis("x", 0.3))
    assert differ(lifter.predict(keypoints, OFFSETS, bone_imus=wrong), lifted) > 1e-3


def test_the_answer_turns_with_the_world(
    lifter: Lifter, camera: Camera, keypoints: KeypointSequence, imus: BoneImuSequence,
    lifted: LiftedPoses,
) -> None:  # fmt: skip
    R, t = so3.about_axis("z", 1.9), np.array([3.0, -2.0, 0.5])
    R_camera = camera.R_camera_world @ R.T
    elsewhere = Camera(
        camera.K, R_camera, camera.t_camera_world - R_camera @ t, camera.width_px, camera.height_px
    )
    turned = lifter.predict(
        replace(keypoints, camera=elsewhere), OFFSETS,
        bone_imus=replace(imus, R_world_bone=R @ imus.R_world_bone),
    )  # fmt: skip
    np.testing.assert_allclose(turned.p_world_joint, lifted.p_world_joint @ R.T + t, atol=1e-4)
    np.testing.assert_allclose(turned.R_world_bone, R @ lifted.R_world_bone, atol=1e-4)
    np.testing.assert_allclose(turned.sigma_m, lifted.sigma_m, atol=1e-4)
    np.testing.assert_allclose(turned.sigma_rad, lifted.sigma_rad, atol=1e-4)


def mirrored(imus: BoneImuSequence) -> BoneImuSequence:
    """The sensors of the mirrored scene."""
    swap = {"Left": "Right", "Right": "Left"}
    sides = [next((s for s in swap if name.startswith(s)), "") for name in imus.joints]
    joints = [swap.get(s, "") + n.removeprefix(s) for s, n in zip(sides, imus.joints, strict=True)]
    return replace(imus, R_world_bone=FLIP @ imus.R_world_bone @ FLIP, joints=tuple(joints))


@pytest.mark.parametrize("joints", [EVERY, ("LeftForeArm", "Hips", "RightLeg", "RightFoot")])
def test_mirrored_scenes_have_mirrored_answers(lifter: Lifter, joints: tuple[str, ...]) -> None:
    p, imus = support.positions(0, T), support.worn_by(0, T, joints)
    left = Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 0.9], 1250.0)
    right = Camera.looking_at([4.0, -1.0, 1.5], [0.0, 0.0, 0.9], 1250.0)
    order = BODY.mirrored
    here = lifter.predict(support.seen_by(left, p), OFFSETS, bone_imus=imus)
    there = lifter.predict(support.seen_by(right, (p @ FLIP)[:, order]), OFFSETS, bone_imus=mirrored(imus))
    np.testing.assert_allclose(there.p_world_joint, (here.p_world_joint @ FLIP)[:, order], atol=1e-4)
    R = FLIP @ here.R_world_bone[:, order] @ FLIP
    np.testing.assert_allclose(there.R_world_bone, R, atol=1e-4)
    np.testing.assert_allclose(there.sigma_m, here.sigma_m[:, order], atol=1e-4)
    np.testing.assert_allclose(there.sigma_rad, here.sigma_rad[:, order], atol=1e-4)


def test_chunks_the_order_of_sensors_and_their_accelerations_do_not_matter(
    lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence, lifted: LiftedPoses,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(module, "CHUNK", 7)
    shuffled = imus.select(tuple(reversed(EVERY)))
    shuffled = replace(shuffled, a_world=np.full_like(shuffled.a_world, np.nan))
    assert_same(lifter.predict(keypoints, OFFSETS, bone_imus=shuffled), lifted, 1e-5)


def test_the_arguments_are_left_as_they_were_and_equal_calls_are_equal(
    lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence, lifted: LiftedPoses
) -> None:
    R = imus.R_world_bone.copy()
    again = lifter.predict(keypoints, OFFSETS, bone_imus=imus)
    np.testing.assert_array_equal(imus.R_world_bone, R)
    for a, b in zip(arrays(again), arrays(lifted), strict=True):
        np.testing.assert_array_equal(a, b)


# --- which sensors there are ---------------------------------------------------------------------


@settings(max_examples=12, deadline=None)
@given(joints=st.sets(st.sampled_from((*EVERY, "Neck", "LeftHand", "Spine1", "Tail"))))
def test_any_subset_is_taken_and_those_it_does_not_know_are_ignored(joints: set[str]) -> None:
    lifter = support.untrained_lifter()
    keypoints = support.seen_by(support.side_camera(), support.positions(0, 6))
    names = tuple(sorted(joints))
    R = so3.exp(np.random.default_rng(len(names)).normal(size=(6, len(names), 3)))
    none = np.zeros((6, len(names), 3))
    imus = BoneImuSequence(keypoints.times, R, none, none[0], names)
    out = lifter.predict(keypoints, OFFSETS, bone_imus=imus)
    known = tuple(name for name in names if name in EVERY)
    assert_same(out, lifter.predict(keypoints, OFFSETS, bone_imus=imus.select(known)), 1e-9)
    if not known:
        assert_same(out, lifter.predict(keypoints, OFFSETS), 1e-9)
    assert np.isfinite(out.p_world_joint).all()
    assert so3.is_rotation(out.R_world_bone)


def test_sensors_at_other_times_are_brought_to_the_frames(
    lifter: Lifter, keypoints: KeypointSequence
) -> None:
    _, R = support.moving(0, 200, rate_hz=240.0)
    index = list(BODY.sensor_joints)
    none = np.zeros((200, len(index), 3))
    fast = BoneImuSequence(np.arange(200) / 240, R[:, index], none, none[0], EVERY)
    exact = replace(fast, times=fast.times[::4], R_world_bone=fast.R_world_bone[::4],
                    a_world=fast.a_world[::4])[:T]  # fmt: skip
    slower = replace(fast, times=fast.times[1::3], R_world_bone=fast.R_world_bone[1::3],
                     a_world=fast.a_world[1::3])  # fmt: skip
    expected = lifter.predict(keypoints, OFFSETS, bone_imus=exact)
    assert_same(lifter.predict(keypoints, OFFSETS, bone_imus=fast), expected, 1e-5)
    inside = slice(14, T)  # the first sample comes after the first frame
    again = lifter.predict(keypoints, OFFSETS, bone_imus=slower)
    np.testing.assert_allclose(again.p_world_joint[inside], expected.p_world_joint[inside], atol=2e-4)


def test_samples_that_are_missing_leave_those_windows_alone_that_do_not_see_them(
    lifter: Lifter, imus: BoneImuSequence
) -> None:
    long = support.seen_by(support.side_camera(), support.positions(0, 80))
    worn = support.worn_by(0, 80, EVERY)
    whole = lifter.predict(long, OFFSETS, bone_imus=worn)
    gap = lifter.predict(long, OFFSETS, bone_imus=spoilt(worn, (slice(40, 45), slice(None))))
    change = np.abs(gap.p_world_joint - whole.p_world_joint).max(axis=(1, 2))
    assert np.flatnonzero(change > 1e-6).tolist() == list(range(40 - 13, 45 + 13))
    assert np.isfinite(gap.p_world_joint).all()


def test_a_sensor_that_says_nothing_is_as_if_it_were_not_there(
    lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    silent = spoilt(imus, (slice(None), [2, 5]))
    there = [name for s, name in enumerate(EVERY) if s not in (2, 5)]
    assert_same(
        lifter.predict(keypoints, OFFSETS, bone_imus=silent),
        lifter.predict(keypoints, OFFSETS, bone_imus=imus.select(there)), 1e-9,
    )  # fmt: skip
    nothing = lifter.predict(keypoints, OFFSETS, bone_imus=spoilt(imus, slice(None)))
    assert_same(nothing, lifter.predict(keypoints, OFFSETS), 1e-9)


def test_sensors_of_another_time_are_as_if_they_were_not_there(
    lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    yesterday = replace(imus, times=imus.times - 86_400.0)
    assert_same(
        lifter.predict(keypoints, OFFSETS, bone_imus=yesterday), lifter.predict(keypoints, OFFSETS), 1e-9
    )


def test_a_lifter_of_17_joints_has_no_orientations_and_ignores_sensors(imus: BoneImuSequence) -> None:
    lifter = support.untrained_lifter(table=support.TABLE_17)
    p_root, _ = support.moving(0, T)
    uv = support.side_camera().project(p_root[:, None] + support.TABLE_17.offsets)
    keypoints = KeypointSequence(
        support.side_camera(), np.arange(T) / 60, uv, np.ones((T, 17)), support.TABLE_17.names
    )
    one, two = lifter.predict(keypoints), lifter.predict(keypoints, bone_imus=imus)
    np.testing.assert_array_equal(one.p_world_joint, two.p_world_joint)
    for poses in (one, two):
        assert np.isnan(poses.R_world_bone).all()
        assert np.isnan(poses.sigma_rad).all()
        assert (poses.sigma_m > 0).all()


# --- what is not seen ----------------------------------------------------------------------------


def unseen(keypoints: KeypointSequence, frames: slice) -> KeypointSequence:
    confidence = keypoints.confidence.copy()
    confidence[frames] = 0.0
    return replace(keypoints, confidence=confidence)


def test_bridged_frames_have_neither_orientations_nor_uncertainties(lifter: Lifter) -> None:
    keypoints = support.seen_by(support.side_camera(), support.positions(0, 120))
    gap = unseen(keypoints, slice(40, 90))
    out = lifter.predict(gap, OFFSETS, bone_imus=support.worn_by(0, 120, EVERY))
    assert not out.seen[60:70].any()
    assert out.seen[:40].all()
    for values in arrays(out)[1:]:
        assert np.isnan(values[~out.seen]).all()
        assert np.isfinite(values[out.seen]).all()
    assert np.isfinite(out.p_world_joint).all()


def test_smoothing_moves_positions_alone(
    lifter: Lifter, keypoints: KeypointSequence, imus: BoneImuSequence, lifted: LiftedPoses
) -> None:
    smooth = lifter.predict(keypoints, OFFSETS, bone_imus=imus, smooth=True)
    assert np.abs(smooth.p_world_joint - lifted.p_world_joint).max() > 1e-6
    for a, b in zip(arrays(smooth)[1:], arrays(lifted)[1:], strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_not_said_is_not_known() -> None:
    poses = LiftedPoses(np.arange(2.0), np.zeros((2, 3, 3)), np.ones(2, dtype=bool), ("a", "b", "c"))
    assert poses.sigma_m.shape == (2, 3, 2)
    for values in arrays(poses)[1:]:
        assert np.isnan(values).all()
    with pytest.raises(ShapeError, match=r"lifted sigma_rad: expected shape \(2, 3\), got \(2, 2\)"):
        replace(poses, sigma_rad=np.ones((2, 2)))


# --- causal --------------------------------------------------------------------------------------


@pytest.mark.parametrize("causal", [True, False])
def test_a_causal_lifter_does_not_wait_for_later_frames(
    keypoints: KeypointSequence, imus: BoneImuSequence, causal: bool
) -> None:
    """What comes after frame 20 changes, or never comes: what was said of frame 20 stays."""
    lifter = support.untrained_lifter(causal=causal)
    whole = lifter.predict(keypoints, OFFSETS, bone_imus=imus)
    uv, R = np.array(keypoints.uv_px), np.array(imus.R_world_bone)
    uv[21:] += 40.0
    R[21:] = R[21:] @ so3.about_axis("y", 1.0)
    other = lifter.predict(replace(keypoints, uv_px=uv), OFFSETS, bone_imus=replace(imus, R_world_bone=R))
    cut = lifter.predict(keypoints[:21], OFFSETS, bone_imus=imus[:21])
    for changed in (other, cut):
        for a, b in zip(arrays(changed), arrays(whole), strict=True):
            change = np.abs(a[:21] - b[:21]).reshape(21, -1).max(axis=1)
            if causal:
                assert change.max() < 1e-6
            else:
                assert change[8:].min() > 1e-7
                assert change[:7].max() < 1e-6


def test_a_causal_lifter_reads_the_frame_itself_and_those_before(keypoints: KeypointSequence) -> None:
    lifter = support.untrained_lifter(causal=True)
    whole = lifter.predict(keypoints, OFFSETS)
    uv = np.array(keypoints.uv_px)
    uv[5] += np.random.default_rng(0).normal(scale=30.0, size=(21, 2))
    other = lifter.predict(replace(keypoints, uv_px=uv), OFFSETS)
    change = np.abs(other.p_world_joint - whole.p_world_joint).max(axis=(1, 2))
    assert np.flatnonzero(change > 1e-7).tolist() == list(range(5, 5 + 27))


def test_a_causal_lifter_at_another_rate_does_not_wait_either(camera: Camera) -> None:
    """A video at 50 Hz, whose frames lie between those of the lifter."""
    keypoints = support.seen_by(camera, support.positions(0, T), 50.0)
    lifter = support.untrained_lifter(causal=True)
    whole = lifter.predict(keypoints, OFFSETS).p_world_joint
    for length in (1, 2, 17, 30):
        part = lifter.predict(keypoints[:length], OFFSETS).p_world_joint
        np.testing.assert_allclose(part, whole[:length], atol=1e-5)
