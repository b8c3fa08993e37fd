"""`Lifter.predict`: invariances, missing observations, other rates and skeletons, causal lifters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

from lifting import predict as module
from lifting.model import FoldedNetwork
from lifting.predict import LiftedPoses, Lifter
from lifting.streaming import StreamingLifter
from lifting.windows import SIGMA_ACROSS, SIGMA_ALONG, SIGMA_TURN
from lifting.windows import encode as encoded_by
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, ShapeError, ViewError
from rtof_kin.core.resources import LIFTERS, model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import read_mocap
from rtof_kin.simulation.simulate import SimulationSettings, simulate

Array = NDArray[np.float64]
EXCERPT = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"
T = 40
OFFSETS = support.TABLE.offsets
BODY = support.tiny_corpus().body()
EVERY = BODY.sensors
FLIP = np.diag([1.0, -1.0, 1.0])
CAMERA = support.side_camera()
P = support.positions(0, T)
KEYPOINTS = support.seen_by(CAMERA, P)
IMUS = support.worn_by(0, T, EVERY)


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return support.untrained_lifter()


@pytest.fixture(scope="module")
def lifted(lifter: Lifter) -> LiftedPoses:
    return lifter.predict(KEYPOINTS, OFFSETS, bone_imus=IMUS)


def arrays(poses: LiftedPoses) -> tuple[Array, ...]:
    return poses.p_world_joint, poses.sigma_m, poses.R_world_bone, poses.sigma_rad


def assert_same(one: LiftedPoses, two: LiftedPoses, atol: float = 1e-4) -> None:
    for a, b in zip(arrays(one), arrays(two), strict=True):
        np.testing.assert_allclose(a, b, atol=atol)


def differ(one: LiftedPoses, two: LiftedPoses) -> float:
    return float(np.abs(one.p_world_joint - two.p_world_joint).max())


def hidden(keypoints: KeypointSequence, frames: slice, joints: object = slice(None)) -> KeypointSequence:
    confidence = keypoints.confidence.copy()
    confidence[frames, joints] = 0.0
    return replace(keypoints, confidence=confidence)


def spoilt(imus: BoneImuSequence, where: Any) -> BoneImuSequence:
    R = np.array(imus.R_world_bone)
    R[where] = np.nan
    return replace(imus, R_world_bone=R)


def test_exact_network_output_gives_the_scene(lifter: Lifter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses, orientations and their standard deviations are returned in world."""
    _, R = support.moving(0, T)
    R_shared = R @ lifter.shared_frames(OFFSETS)
    p = P - CAMERA.center_world
    axes, points = (x.astype(np.float32) for x in (R_shared[..., [0, 2]], p))
    across, along, turn = 0.01, 0.03, 0.05
    seen: list[Any] = []

    def encode(*given: Any) -> Any:
        seen.append(encoded_by(*given))
        return seen[-1]

    def exact(*_: object) -> Any:
        encoded = seen[-1]
        pose = encoded.R_ray_world @ (points - points[:, :1]).swapaxes(1, 2)[:, :, 1:]
        root = np.einsum("bij,bj->bi", encoded.R_view_world, points[:, 0])
        shift = root[:, :2] / root[:, 2:] / encoded.scale[:, None]
        distance = np.log(np.linalg.norm(root, axis=1) * encoded.scale)
        spread = np.broadcast_to(np.log([across, along])[:, None], (T, 2, 21))
        in_ray = np.einsum("bij,bsja->bais", encoded.R_ray_world, axes)
        parts = [pose, shift, distance, spread, in_ray, np.full((T, 21), np.log(turn))]
        return np.concatenate([x.reshape(T, -1) for x in parts], axis=1, dtype=np.float32)

    monkeypatch.setattr(module, "CHUNK", T)
    monkeypatch.setattr(module, "encode", encode)
    monkeypatch.setattr(FoldedNetwork, "__call__", exact)
    poses = lifter.predict(KEYPOINTS, OFFSETS)
    np.testing.assert_allclose(poses.p_world_joint, P, atol=1e-5)
    np.testing.assert_allclose(poses.R_world_bone, R, atol=1e-5)
    np.testing.assert_allclose(poses.sigma_rad, SIGMA_TURN * turn, rtol=1e-5)
    sigma = np.tile([SIGMA_ACROSS * across, SIGMA_ALONG * along], (T, 21, 1))
    sigma[:, 0] *= np.linalg.norm(p[:, 0], axis=-1)[:, None]
    np.testing.assert_allclose(poses.sigma_m, sigma, rtol=1e-4)


# --- invariances ---------------------------------------------------------------------------------


def test_prediction_turns_with_the_world(lifter: Lifter, lifted: LiftedPoses) -> None:
    R, t = so3.about_axis("z", 1.9), np.array([3.0, -2.0, 0.5])
    R_camera = CAMERA.R_camera_world @ R.T
    elsewhere = replace(CAMERA, R_camera_world=R_camera, t_camera_world=CAMERA.t_camera_world - R_camera @ t)
    turned = lifter.predict(
        replace(KEYPOINTS, camera=elsewhere), OFFSETS, bone_imus=replace(IMUS, R_world_bone=R @ IMUS.R_world_bone)
    )
    expected = lifted.p_world_joint @ R.T + t, lifted.sigma_m, R @ lifted.R_world_bone, lifted.sigma_rad
    for a, b in zip(arrays(turned), expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def looking(R: Array) -> Camera:
    """The camera turned on the spot."""
    R = R @ CAMERA.R_camera_world
    return replace(CAMERA, R_camera_world=R, t_camera_world=-R @ CAMERA.center_world)


@pytest.mark.parametrize(
    "camera, atol",
    [
        (replace(CAMERA, K=CAMERA.K * np.array([[0.5], [0.5], [1.0]])), 1e-4),
        (looking(so3.exp([0.1, -0.25, 0.6])), 1e-4),
        (replace(CAMERA, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.0])), 1e-3),
    ],
    ids=["focal length", "direction", "distortion"],
)
def test_prediction_does_not_depend_on_the_view(
    lifter: Lifter, lifted: LiftedPoses, camera: Camera, atol: float
) -> None:
    found = lifter.predict(support.seen_by(camera, P), OFFSETS, bone_imus=IMUS)
    np.testing.assert_allclose(found.p_world_joint, lifted.p_world_joint, atol=atol)


def test_prediction_depends_on_tilt_sensors_bones_and_floor(lifter: Lifter, lifted: LiftedPoses) -> None:
    tilted = replace(KEYPOINTS, camera=looking(so3.about_axis("x", 0.3)))
    wrong = replace(IMUS, R_world_bone=IMUS.R_world_bone @ so3.about_axis("x", 0.3))
    for other in (
        lifter.predict(tilted, OFFSETS, bone_imus=IMUS),
        lifter.predict(KEYPOINTS, OFFSETS),
        lifter.predict(KEYPOINTS, OFFSETS, bone_imus=wrong),
        lifter.predict(KEYPOINTS, bone_imus=IMUS),
        lifter.predict(KEYPOINTS, OFFSETS * 1.2, bone_imus=IMUS),
        lifter.predict(KEYPOINTS, OFFSETS, bone_imus=IMUS, floor_height=0.0),
    ):
        assert differ(other, lifted) > 1e-3


def mirrored(imus: BoneImuSequence) -> BoneImuSequence:
    joints = [BODY.names[BODY.mirrored[BODY.names.index(name)]] for name in imus.joints]
    return replace(imus, R_world_bone=FLIP @ imus.R_world_bone @ FLIP, joints=tuple(joints))


@pytest.mark.parametrize("joints", [EVERY, ("LeftForeArm", "Hips", "RightLeg", "RightFoot")])
def test_mirrored_scenes_have_mirrored_poses(lifter: Lifter, joints: tuple[str, ...]) -> None:
    imus, order = support.worn_by(0, T, joints), BODY.mirrored
    left = support.seen_by(Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 0.9], 1250.0), P)
    camera = Camera.looking_at([4.0, -1.0, 1.5], [0.0, 0.0, 0.9], 1250.0)
    right = support.seen_by(camera, (P @ FLIP)[:, order])

    def both(flip: bool) -> tuple[LiftedPoses, LiftedPoses]:
        here = lifter.predict(left, OFFSETS, bone_imus=imus, flip=flip)
        p, R = (here.p_world_joint @ FLIP)[:, order], FLIP @ here.R_world_bone[:, order] @ FLIP
        sigmas = here.sigma_m[:, order], here.sigma_rad[:, order]
        expected = replace(here, p_world_joint=p, R_world_bone=R, sigma_m=sigmas[0], sigma_rad=sigmas[1])
        return lifter.predict(right, OFFSETS, bone_imus=mirrored(imus), flip=flip), expected

    assert_same(*both(flip=True))
    assert differ(*both(flip=False)) > 1e-3


def test_chunks_threads_and_the_order_of_observations_do_not_matter(
    lifter: Lifter, lifted: LiftedPoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = lifter.predict(KEYPOINTS, OFFSETS, bone_imus=IMUS)
    for a, b in zip(arrays(again), arrays(lifted), strict=True):
        np.testing.assert_array_equal(a, b)
    monkeypatch.setattr(module, "CHUNK", 7)
    shuffled = IMUS.select(tuple(reversed(EVERY)))
    shuffled = replace(shuffled, a_world=np.full_like(shuffled.a_world, np.nan))
    keypoints = KEYPOINTS.select([*reversed(KEYPOINTS.names), "LeftEar", "Tail"])
    with threadpool_limits(2):
        again = lifter.predict(keypoints, OFFSETS, bone_imus=shuffled)
        assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == {2}
    assert_same(again, lifted, 1e-5)


# --- time ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [25.0, 50.0, 120.0])
def test_other_rates_give_the_same_motion(lifter: Lifter, rate_hz: float) -> None:
    """A landmark that crosses the image evenly is the same at every rate."""

    def at(times: Array) -> KeypointSequence:
        uv = CAMERA.project(P[0]) + times[:, None, None] * np.array([60.0, -20.0])
        return KeypointSequence(CAMERA, times, uv, np.ones(uv.shape[:2]), support.TABLE.names)

    fine = lifter.predict(at(np.arange(241) / 60)).p_world_joint
    other = lifter.predict(at(np.arange(int(4 * rate_hz) + 1) / rate_hz)).p_world_joint
    assert len(other) == int(4 * rate_hz) + 1
    for second in (1, 2, 3):
        np.testing.assert_allclose(other[round(second * rate_hz)], fine[60 * second], atol=2e-3)


@pytest.mark.parametrize("causal", [True, False])
def test_a_causal_lifter_ignores_later_frames(causal: bool) -> None:
    lifter = support.untrained_lifter(causal=causal)
    whole = lifter.predict(KEYPOINTS, OFFSETS, bone_imus=IMUS)
    uv, R = np.array(KEYPOINTS.uv_px), np.array(IMUS.R_world_bone)
    uv[21:] += 40.0
    R[21:] = R[21:] @ so3.about_axis("y", 1.0)
    other = lifter.predict(replace(KEYPOINTS, uv_px=uv), OFFSETS, bone_imus=replace(IMUS, R_world_bone=R))
    cut = lifter.predict(KEYPOINTS[:21], OFFSETS, bone_imus=IMUS[:21])
    for changed in (other, cut):
        for a, b in zip(arrays(changed), arrays(whole), strict=True):
            change = np.abs(a[:21] - b[:21]).reshape(21, -1).max(axis=1)
            assert change[: 21 if causal else 7].max() < 1e-6
            assert causal or change[8:].min() > 1e-7


# --- missing observations ------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [160, 105])
def test_gaps_are_interpolated_ends_repeated_and_both_marked(lifter: Lifter, frames: int) -> None:
    gap = hidden(support.seen_by(CAMERA, support.positions(0, frames)), slice(50, 110))
    out = lifter.predict(gap, OFFSETS, bone_imus=support.worn_by(0, frames, EVERY))
    first, last = np.flatnonzero(~out.seen)[[0, -1]]
    assert 50 < first <= 64
    assert last == frames - 1 or 96 <= last < 110
    for values in arrays(out)[1:]:
        assert np.isnan(values[~out.seen]).all()
        assert np.isfinite(values[out.seen]).all()
    p = out.p_world_joint
    after = p[min(last + 1, frames - 1)]
    share = np.linspace(0, 1, last - first + 3)[:, None, None]
    expected = (1 - share) * p[first - 1] + share * after
    np.testing.assert_allclose(p[first : last + 1], expected[1:-1], atol=1e-9)


def test_joints_without_a_landmark_are_unseen(lifter: Lifter) -> None:
    coco = [n for n in KEYPOINTS.names if n.endswith(("Arm", "Hand", "Leg", "Foot", "Head"))]
    result = lifter.predict(KEYPOINTS.select(coco), OFFSETS)
    assert result.seen.all()
    masked = hidden(KEYPOINTS, slice(None), [n not in coco for n in KEYPOINTS.names])
    assert_same(result, lifter.predict(masked, OFFSETS), 1e-9)


@settings(max_examples=12, deadline=None)
@given(joints=st.sets(st.sampled_from((*EVERY, "Neck", "LeftHand", "Spine1", "Tail"))))
def test_any_subset_of_sensors_is_accepted_and_unknown_ones_ignored(joints: set[str]) -> None:
    lifter, keypoints, names = support.untrained_lifter(), KEYPOINTS[:6], tuple(sorted(joints))
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


def test_silent_sensors_are_as_absent(lifter: Lifter) -> None:
    there = [name for s, name in enumerate(EVERY) if s not in (2, 5)]
    some, none = (lifter.predict(KEYPOINTS, OFFSETS, bone_imus=IMUS.select(there)), lifter.predict(KEYPOINTS, OFFSETS))
    for imus, expected in (
        (spoilt(IMUS, (slice(None), [2, 5])), some),
        (spoilt(IMUS, slice(None)), none),
        (replace(IMUS, times=IMUS.times - 86_400.0), none),
    ):
        assert_same(lifter.predict(KEYPOINTS, OFFSETS, bone_imus=imus), expected, 1e-9)


def test_sensors_are_resampled_to_the_frames(lifter: Lifter) -> None:
    R = support.moving(0, 200, rate_hz=240.0)[1][:, BODY.sensor_joints]
    none = np.zeros((200, len(EVERY), 3))
    fast = BoneImuSequence(np.arange(200) / 240, R, none, none[0], EVERY)

    def every(first: int, step: int) -> BoneImuSequence:
        keep = slice(first, None, step)
        return replace(fast, times=fast.times[keep], R_world_bone=R[keep], a_world=none[keep])

    expected = lifter.predict(KEYPOINTS, OFFSETS, bone_imus=every(0, 4)[:T])
    assert_same(lifter.predict(KEYPOINTS, OFFSETS, bone_imus=fast), expected, 1e-5)
    again = lifter.predict(KEYPOINTS, OFFSETS, bone_imus=every(1, 3))
    inside = slice(14, T)  # the first sample comes after the first frame
    np.testing.assert_allclose(again.p_world_joint[inside], expected.p_world_joint[inside], atol=2e-4)


@pytest.mark.parametrize("seed", range(2))
def test_extreme_landmarks_give_finite_positions(lifter: Lifter, seed: int) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.normal(scale=10.0 ** rng.uniform(0, 6), size=(30, 21, 2))
    if seed == 0:
        uv[:] = 500.0  # everything in one point
    confidence = (rng.uniform(size=(30, 21)) > 0.7).astype(float)
    confidence[0] = 1.0
    keypoints = KeypointSequence(CAMERA, np.arange(30) / 60, uv, confidence, support.TABLE.names)
    assert np.isfinite(lifter.predict(keypoints).p_world_joint).all()
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    above = Camera(CAMERA.K, R, -R @ np.array([0.0, 0.0, 6.0]), 1920, 1080)
    assert np.isfinite(lifter.predict(support.seen_by(above, P)).p_world_joint).all()


# --- wrong input ---------------------------------------------------------------------------------


def scattered() -> KeypointSequence:
    """Seven joints, each seen in another window."""
    confidence = np.zeros((300, 21))
    confidence[40 * np.arange(7), np.arange(7)] = 1.0
    uv = np.resize(KEYPOINTS.uv_px, (300, 21, 2))
    return KeypointSequence(CAMERA, np.arange(300) / 60, uv, confidence, KEYPOINTS.names)


@pytest.mark.parametrize(
    "keypoints, message",
    [
        (KEYPOINTS.select([*KEYPOINTS.names[:5], "Nose"]), r"at least 6 joints .* sees 5 \(Hips, .*adapter"),
        (hidden(KEYPOINTS, slice(None)), "no person was seen"),
        (scattered(), "6 joints are not seen in any window"),
    ],
)
def test_too_few_joints_are_refused(lifter: Lifter, keypoints: KeypointSequence, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        lifter.predict(keypoints)


@pytest.mark.parametrize(
    "given, error, message",
    [
        ({"joint_offsets": OFFSETS[:20]}, ShapeError, r"joint_offsets: .*\(21, 3\)"),
        ({"joint_offsets": OFFSETS * 1000}, InvalidInputError, "joint_offsets: .*give metres"),
        ({"joint_offsets": OFFSETS * 0}, InvalidInputError, "not a human's"),
        ({"joint_offsets": OFFSETS * np.nan}, InvalidInputError, "not a human's"),
        ({"joint_offsets": "wide"}, ShapeError, "joint_offsets: not an array"),
        ({"floor_height": 2.0}, ViewError, "floor_height: .*0.50 m below"),
    ],
)
def test_wrong_bones_and_floors_are_refused(
    lifter: Lifter, given: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        lifter.predict(KEYPOINTS, **given)


# --- files and skeletons -------------------------------------------------------------------------


def test_the_shipped_lifter_lifts_an_unknown_scene() -> None:
    clip = read_mocap(EXCERPT)
    p = clip.poses.p_world_joint - clip.poses.p_world_joint[:1, :1] * np.array([1.0, 1.0, 0.0])
    error = Lifter.load().predict(support.seen_by(CAMERA, p), clip.joint_offsets).p_world_joint - p
    assert np.linalg.norm(error - error[:, :1], axis=-1).mean() < 0.08
    assert np.linalg.norm(error, axis=-1).mean() < 0.25


@pytest.mark.parametrize("name", list(LIFTERS))
def test_shipped_lifters_are_loaded_by_name(name: str) -> None:
    lifter = Lifter.load(name)
    assert not lifter.description.network.causal
    assert lifter.receptive_field() == (27 if name == "live" else 81)
    assert lifter.sha256 == Lifter.load(model_path(LIFTERS[name])).sha256


def recording_of_17(frames: int = 60) -> Recording:
    """A person with Human3.6M's joints at 50 Hz, seen without error."""
    skeleton = SkeletonModel.named("human36m")
    poses = planted.moving(skeleton, frames).poses
    poses = replace(poses, times=np.arange(frames) / 50)
    perfect = replace(SimulationSettings.perfect(), sensors=())
    return simulate(poses, skeleton.joint_offsets, camera=CAMERA, settings=perfect, seed=0, skeleton=skeleton)


def test_a_lifter_of_17_joints_ignores_sensors_and_gives_no_orientations() -> None:
    lifter, keypoints = support.untrained_lifter(table=support.TABLE_17), recording_of_17(T).keypoints
    one, two = lifter.predict(keypoints), lifter.predict(keypoints, bone_imus=IMUS)
    np.testing.assert_array_equal(one.p_world_joint, two.p_world_joint)
    assert np.isnan(two.R_world_bone).all()
    assert np.isnan(two.sigma_rad).all()
    assert (two.sigma_m > 0).all()
    at_50 = support.untrained_lifter(table=support.TABLE_17, rate_hz=50.0)
    assert differ(one, at_50.predict(keypoints)) > 1e-6


def test_a_lifter_of_17_joints_reconstructs_through_the_pipeline() -> None:
    recording = recording_of_17(frames=24)
    lifter = support.untrained_lifter(table=support.TABLE_17, rate_hz=50.0)
    result = reconstruct(recording, mode="rto", lifter=lifter, settings=ReconstructionSettings(frames=12))
    assert result.motion.poses.names == support.TABLE_17.names
    assert np.isfinite(result.motion.poses.p_world_joint).all()
    with pytest.raises(InvalidInputError, match=r"sees 3 \(Spine, Neck, Head\).*trained for these joints"):
        reconstruct(recording, mode="lift", lifter=support.untrained_lifter())


# --- rigs ----------------------------------------------------------------------------------------


def turned_rig() -> tuple[Array, Array]:
    """Joint offsets of the same person in a rig with other link frames, and those frames in the ones of
    `OFFSETS`: a pelvis pitched by 20 degrees, limbs along their bones."""
    R_bone_rig = shared_frames(support.TABLE.names, OFFSETS)
    R_bone_rig[0] = so3.about_axis("y", np.radians(20.0))
    return to_shared(R_bone_rig, support.TABLE.parents, OFFSETS), R_bone_rig


def test_a_rigs_link_frames_do_not_matter(lifter: Lifter, lifted: LiftedPoses) -> None:
    offsets, R_bone_rig = turned_rig()
    index = [support.TABLE.names.index(joint) for joint in IMUS.joints]
    imus = replace(IMUS, R_world_bone=IMUS.R_world_bone @ R_bone_rig[index])
    other = lifter.predict(KEYPOINTS, offsets, bone_imus=imus)
    np.testing.assert_allclose(other.p_world_joint, lifted.p_world_joint, atol=1e-5)
    np.testing.assert_allclose(other.R_world_bone, lifted.R_world_bone @ R_bone_rig, atol=1e-5)
    stream = StreamingLifter(lifter, CAMERA, offsets)
    for t in range(T):
        worn = dict(zip(imus.joints, imus.R_world_bone[t], strict=True))
        stream.put(IMUS.times[t], KEYPOINTS.uv_px[t], KEYPOINTS.confidence[t], worn)
    (pose,) = stream.lift(IMUS.times[[-14]])
    assert pose is not None
    np.testing.assert_allclose(pose.R_world_bone, other.R_world_bone[-14], atol=1e-5)
