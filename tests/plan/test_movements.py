"""Every movement of the library on two bodies: on the floor, with planted feet, and what it is said to be."""

import itertools
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from clinical_support import body_paths

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.clinical.gait import analyse_gait
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.repetitions import find_repetitions
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.movements import MOVEMENTS, movement

SOLES = ("LeftHeel", "LeftToeBase", "RightHeel", "RightToeBase")


@cache
def body(name: str) -> SkeletonModel:
    default = SkeletonModel.default()
    if name == "adult":
        return default
    small = default.with_offsets(0.85 * default.joint_offsets)
    return small.with_bone_lengths({"LeftLeg": 0.30, "RightLeg": 0.30, "LeftFoot": 0.37, "RightFoot": 0.37})


@cache
def poses_of(name: str, who: str) -> PoseSequence:
    return movement(name, body(who))


def points(poses: PoseSequence, skeleton: SkeletonModel) -> Callable[[str], np.ndarray]:
    p = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    return lambda name: p[:, list(skeleton.landmarks).index(name)]


EACH = pytest.mark.parametrize("name, who", list(itertools.product(MOVEMENTS, ["adult", "small"])))


@EACH
def test_poses_are_those_of_the_body_within_its_limits(name: str, who: str) -> None:
    skeleton, poses = body(who), poses_of(name, who)
    motion = skeleton.motion(poses)
    assert np.abs(motion.poses.p_world_joint - poses.p_world_joint).max() < 1e-9
    assert np.degrees(motion.report.limit_excess.max()) < 1.0
    assert not motion.report.singular.any()
    v = np.gradient(poses.p_world_joint, poses.times, axis=0)
    a = np.gradient(v, poses.times, axis=0)
    assert np.linalg.norm(v, axis=-1).max() < 4.5  # of people
    assert np.linalg.norm(a, axis=-1).max() < 60
    assert np.linalg.norm(v[0], axis=-1).max() < 0.1


@EACH
def test_feet_are_on_the_floor(name: str, who: str) -> None:
    at = points(poses_of(name, who), body(who))
    lowest = np.min([at(point)[:, 2] - at(point)[0, 2] for point in SOLES], axis=0)  # flat at the start
    assert np.abs([at(f"{side}Heel")[0, 2] for side in ("Left", "Right")]).max() < 0.002
    assert np.abs(lowest).max() < 0.02


@EACH
def test_a_standing_foot_does_not_slide(name: str, who: str) -> None:
    poses, skeleton = poses_of(name, who), body(who)
    at = points(poses, skeleton)
    flat = 0.0
    for side in ("Left", "Right"):
        ball, heel = at(f"{side}ToeBase"), at(f"{side}Heel")
        flat = ball[0, 2]  # everybody begins with both feet flat
        down = (heel[:, 2] < 0.004) & (ball[:, 2] < flat + 0.002)
        edges = np.flatnonzero(np.diff(np.r_[False, down, False].astype(int)))
        for start, stop in edges.reshape(-1, 2):
            assert np.ptp(ball[start:stop, :2], axis=0).max() < 0.02
    if name in ("squat", "sit_to_stand", "shoulder_raises"):
        assert np.ptp(at("LeftToeBase"), axis=0).max() < 1e-3


@pytest.mark.parametrize("who", ["adult", "small"])
@pytest.mark.parametrize("name", ["squat", "sit_to_stand"])
@pytest.mark.parametrize("count", [1, 4])
def test_repetitions_are_found_again(name: str, who: str, count: int) -> None:
    skeleton = body(who)
    poses = movement(name, skeleton, count)
    found = find_repetitions(body_paths(poses, skeleton), clinical_angles(poses, skeleton), name)
    assert len(found.repetitions) == count
    knees = np.degrees([one.knee_flexion[side] for one in found.repetitions for side in ("right", "left")])
    assert np.all((knees > 85) & (knees < 120))


@pytest.mark.parametrize("who", ["adult", "small"])
@pytest.mark.parametrize("name", ["gait", "timed_up_and_go"])
def test_walking_is_recognised(name: str, who: str) -> None:
    skeleton, poses = body(who), poses_of(name, who)
    angles = clinical_angles(poses, skeleton)
    gait = analyse_gait(gait_events(body_paths(poses, skeleton)), angles)
    assert gait.verdict.why_not == ""
    swing = np.degrees(angles.select(["right_knee_flexion"]).values[:, 0])
    assert 50 < swing.max() < 120
    path = poses.p_world_joint[:, 0, :2]  # from the origin along x and back
    assert np.linalg.norm(path[0]) < 0.4
    assert path[:, 0].max() > 2.0


def test_an_impossible_request_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="squat"):
        movement("squats", body("adult"))
    with pytest.raises(InvalidInputError, match="repetitions"):
        movement("squat", body("adult"), 0)
    with pytest.raises(InvalidInputError, match="rate"):
        movement("squat", body("adult"), rate_hz=1.0)
    with pytest.raises(UnknownNameError, match="Hips"):
        movement("squat", SkeletonModel.human36m())
