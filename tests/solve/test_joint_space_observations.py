"""Weights and data of the joint-space problem from a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence, detector_point
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import FEET, ContactPoints
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.terms import ANCHORED, TORSO
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.vision.image_points import detector_points, image_points

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
N, T = 8, 20
SETTINGS = JointSpaceSettings(sigma_torso=0.3, torso_inflation=2.5, refit_root=False)
POSES = planted.human(BODY, T).poses
HIPS, CHEST = BODY.index(*TORSO)
ANCHORS = list(BODY.index(*ANCHORED))  # pelvis and upper trunk first


def start(sigma_rad: Array | None = None) -> PoseSequence:
    return replace(POSES, sigma_rad=sigma_rad)


def observed(
    poses: PoseSequence, imus: BoneImuSequence | None = None, settings: JointSpaceSettings = SETTINGS
) -> Observations:
    return Observations(BODY, N, settings, InitialGuess(poses, np.zeros(T)), planted.keypoints(POSES), imus)


def weights(
    sigma_rad: Array | None = None, imus: BoneImuSequence | None = None, settings: JointSpaceSettings = SETTINGS
) -> Array:
    """(T, 5) of the pelvis, the upper trunk, the neck and the clavicles."""
    return observed(start(sigma_rad), imus, settings).rows["w_torso"]


def sigmas() -> Array:
    return np.random.default_rng(0).uniform(0.05, 0.4, (T, 21))


def worn(*joints: str) -> BoneImuSequence:
    return planted.bone_imus(BODY, POSES, joints)


def test_torso_weights_follow_the_sigma_of_the_guess() -> None:
    sigma = sigmas()
    expected = 1 / (2.5 * sigma[:, ANCHORS]) ** 2
    np.testing.assert_allclose(weights(sigma), expected)
    assert np.ptp(expected[:, 0] / expected[:, 1]) > 1


def test_torso_weights_default_to_the_settings() -> None:
    sigma = sigmas()
    sigma[3:7] = np.nan
    sigma[12, CHEST] = np.nan
    found = weights(sigma)
    np.testing.assert_allclose(found[3:7], 1 / 0.3**2)
    np.testing.assert_allclose(found[12, :2], [1 / (2.5 * sigma[12, HIPS]) ** 2, 1 / 0.3**2])


@pytest.mark.parametrize("sigma", [None, sigmas()])
def test_sensor_replaces_the_anchor_of_its_segment(sigma: Array | None) -> None:
    without = weights(sigma)
    for joints, free in ((("Hips",), [0]), (("Spine3",), [1]), (("Hips", "Spine3"), [0, 1])):
        found = weights(sigma, worn("LeftArm", *joints))
        anchored = [i for i in range(len(ANCHORS)) if i not in free]
        assert np.all(found[:, free] == 0)
        np.testing.assert_allclose(found[:, anchored], without[:, anchored])
    np.testing.assert_allclose(weights(sigma, worn("LeftArm", "Head", "RightLeg")), without)


def test_segment_is_anchored_where_its_sensor_has_no_data() -> None:
    imus = worn("Hips", "LeftArm")
    R = np.array(imus.R_world_bone)
    R[5:9, 0], R[10:12, 1] = np.nan, np.nan
    found = weights(sigmas(), replace(imus, R_world_bone=R))
    silent = np.isin(np.arange(T), np.arange(5, 9))
    np.testing.assert_array_equal(found[:, 0] > 0, silent)
    np.testing.assert_allclose(found[silent, 0], weights(sigmas())[silent, 0])
    assert np.all(found[:, 1] > 0)


def test_weights_are_zero_in_the_padding() -> None:
    sigma = sigmas()
    problem = observed(start(sigma))
    _, inside, data = problem.fragment(-3)
    assert inside.tolist() == [False] * 3 + [True] * 5
    found = data.observation["w_torso"]
    assert found.shape == (N, len(ANCHORS))
    assert np.all(found[:3] == 0)
    np.testing.assert_allclose(found[3:], weights(sigma)[:5])


ARM = ("LeftArm", "LeftForeArm")
ALL_BONES = {side + bone for side in ("Left", "Right") for bone in ("Arm", "ForeArm", "UpLeg", "Leg")}


@pytest.mark.parametrize(
    ("sensors", "bare"),
    [
        ((), ALL_BONES),
        (("Hips", "Spine3"), ALL_BONES),
        (("LeftForeArm",), ALL_BONES - {*ARM}),
        (("LeftHand",), ALL_BONES - {*ARM}),
        (("LeftForeArm", "RightForeArm", "LeftLeg", "RightLeg"), set()),
    ],
)
def test_bones_of_limbs_without_a_sensor_are_anchored(sensors: tuple[str, ...], bare: set[str]) -> None:
    found = observed(start(), worn(*sensors) if sensors else None)
    bones, anchored = found.problem.energy["bone"].bones, found.rows["w_bone"] > 0
    assert {BODY.names[bones[i][0]] for i in np.flatnonzero(anchored.all(axis=0))} == bare
    assert np.array_equal(anchored.all(axis=0), anchored.any(axis=0))
    p = POSES.p_world_joint
    for i, (joint, child) in enumerate(bones):
        np.testing.assert_allclose(found.rows["b_world"][:, i], p[:, child] - p[:, joint])


def test_jerk_of_limbs_without_a_sensor_has_its_own_factor() -> None:
    def sigma_jerk(*sensors: str) -> dict[str, float]:
        found = observed(start(), worn(*sensors) if sensors else None)
        first = {BODY.names[j]: found.space.columns(j).stop - 1 for j in found.space.joints}
        return {name: float(found.problem.sigma_jerk[i]) for name, i in first.items()}

    alone, one_arm = sigma_jerk(), sigma_jerk("LeftForeArm")
    ratio = SETTINGS.jerk / SETTINGS.jerk_without_sensors
    for name in alone:
        limb = name.removeprefix("Left").removeprefix("Right")
        is_bare = limb in ("Arm", "ForeArm", "UpLeg", "Leg") and name not in ARM
        assert one_arm[name] / alone[name] == pytest.approx(1 if is_bare else ratio), name


@pytest.mark.parametrize(
    ("sensors", "times_wider"),
    [
        ((), 1),
        (("LeftForeArm",), 2),
        (("Hips", "LeftForeArm", "RightForeArm", "LeftLeg", "RightLeg"), 2),
        (ARM, np.inf),
        (("LeftUpLeg", "LeftLeg", "RightForeArm"), np.inf),
    ],
)
def test_root_anchor_depends_on_the_sensors(sensors: tuple[str, ...], times_wider: float) -> None:
    found = observed(start(), worn(*sensors) if sensors else None)
    expected = 1 / (times_wider * SETTINGS.sigma_root) ** 2
    np.testing.assert_allclose(found.rows["w_root"], expected)


def noisy(imus: BoneImuSequence) -> BoneImuSequence:
    return replace(imus, a_world=imus.a_world + np.random.default_rng(1).normal(size=imus.a_world.shape))


def test_accelerations_are_low_passed() -> None:
    imus, plain = noisy(worn("LeftLeg")), replace(SETTINGS, acceleration_cutoff_hz=None)
    slow = signals.low_pass(imus.a_world, 60.0, 12.0)
    np.testing.assert_allclose(observed(start(), imus).a_world, slow, atol=1e-9)
    np.testing.assert_allclose(observed(start(), imus, plain).a_world, imus.a_world)


PLACES = ("Hips", "Head", "LeftArm", "LeftForeArm", "LeftFoot", "RightLeg")


def with_places(places: tuple[str, ...], *sensors: str, **more: Any) -> Observations:
    imus = worn(*sensors) if sensors else None
    seen = planted.keypoints(POSES, 2.0)
    return Observations(BODY, N, SETTINGS, InitialGuess(start(), np.zeros(T)), seen, imus, places=places, **more)


SETS = [(), ("LeftForeArm",), ("LeftArm", "LeftForeArm", "Head"), PLACES]


@pytest.mark.parametrize("sensors", SETS)
def test_subsets_of_places_share_the_compiled_energy(sensors: tuple[str, ...]) -> None:
    full, some = with_places(PLACES, *PLACES), with_places(PLACES, *sensors)
    assert some.problem.energy is full.problem.energy
    assert some.problem is not full.problem


@pytest.mark.parametrize("sensors", SETS)
def test_places_without_a_sensor_have_no_effect(sensors: tuple[str, ...]) -> None:
    """Not the motion, not the energy, not which joints turn, not what is known of them."""
    found = []
    for places in ((), PLACES):
        solver = FragmentSolver(BODY, N, SETTINGS, sensor_joints=places or None)
        seen, imus = planted.keypoints(POSES, 2.0), worn(*sensors) if sensors else None
        found.append(solver.solve(start(), seen, imus, confidence=True))
    own, with_places = found
    np.testing.assert_allclose(with_places.poses.p_world_joint, own.poses.p_world_joint, atol=1e-8)
    np.testing.assert_allclose(with_places.poses.R_world_bone, own.poses.R_world_bone, atol=1e-8)
    for term, energy in own.energy.items():
        assert with_places.energy[term] == pytest.approx(energy, rel=1e-6, abs=1e-9), term
    for field in ("position_covariance", "turn_covariance"):
        a, b = (getattr(known, field) for known in (own.confidence, with_places.confidence))
        np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-10)


def test_contacts_of_one_foot_share_the_energy_of_both() -> None:
    def stands(*feet: str) -> ContactPoints:
        return ContactPoints(feet, POSES.p_world_joint[:, BODY.index(*feet)])

    one, both = (with_places((), contact_points=stands(*feet)) for feet in (("RightFoot",), FEET))
    assert one.problem.energy is both.problem.energy
    stood = [BODY.names[j] == "RightFoot" for j in one.problem.energy["floor"].contacts]
    assert (one.rows["w_contact"] > 0).all(axis=0).tolist() == stood
    own, other = (found.rows["p_contact"][:, stood] for found in (one, both))
    np.testing.assert_array_equal(own, other)


def test_no_hinge_of_the_start_passes_through_a_whole_turn() -> None:
    knee, foot = BODY.index("LeftLeg", "LeftFoot")
    R = np.array(POSES.R_world_bone)
    twist = np.linspace(0, 2 * np.pi, T)  # the shank turns about itself, as a lifter's may at a straight knee
    twisted = so3.exp(twist[:, None] * so3.unit(BODY.joint_offsets[foot]))
    R[:, knee] = R[:, knee] @ so3.about_axis("x", 0.2) @ twisted  # and abducted
    data = observed(replace(POSES, R_world_bone=R))
    assert data.limits is not None
    angles = data.limits.values(data.start)
    assert np.abs(data.limits.excess(angles)).max() < np.radians(2)
    assert np.abs(np.diff(angles, axis=0)).max() < np.radians(20)


MOTION = planted.human(BODY, 100)
CAMERA = planted.camera()
NAMES = tuple(detector_point("mediapipe33", name) for name in detector_points("mediapipe33"))


def seen(sigma_px: float) -> KeypointSequence:
    """What the detector sees of a person whose points lie at their usual places."""
    points, poses = image_points(BODY, NAMES), MOTION.poses
    p, R = poses.p_world_joint, poses.R_world_bone
    uv = CAMERA.project(points.positions(p, R)) + points.displaced(CAMERA, p, R)
    uv += sigma_px * np.random.default_rng(0).normal(size=uv.shape)
    return KeypointSequence(CAMERA, poses.times, uv, np.ones(uv.shape[:2]), NAMES)


def test_exact_points_of_a_detector_give_the_motion() -> None:
    imus = planted.bone_imus(BODY, MOTION.poses, planted.LIMBS)
    solver = FragmentSolver(BODY, 50, JointSpaceSettings(refit_root=False))
    solution = solver.solve(MOTION.poses, seen(sigma_px=0.5), imus)
    apart = solution.poses.p_world_joint - MOTION.poses.p_world_joint
    assert np.linalg.norm(apart, axis=-1).mean() < 0.015
