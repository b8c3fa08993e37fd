"""Way and turning of the pelvis of planted motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clinical_support import squatting, stepping, walk, walking
from report_support import certain_to

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.travel import DRIFT, Travel
from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import Provenance

BODY = SkeletonModel.default()
STANDING = np.tile([0.0, -0.78], (480, 1))
TIMES = np.arange(480) / 60


def of(motion: Motion) -> Travel:
    return analyse(motion).travel


def turning(heading: np.ndarray) -> Travel:
    return of(stepping(TIMES, {"right": STANDING, "left": STANDING}, heading=heading))


@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_way_of_a_planted_walk(heading: float) -> None:
    way = of(walking(6.0, speed=1.1, heading=heading))
    assert way.path_length == pytest.approx(1.1 * 6, abs=0.05)
    assert way.displacement == pytest.approx(1.1 * 6, abs=0.05)
    assert way.direction == pytest.approx(heading, abs=1e-3)
    assert way.relative_direction == pytest.approx(0, abs=1e-3)
    assert way.way == "forward"
    assert (way.turned_left, way.turned_right) == (0, 0)
    assert way.walking_share > 0.85
    assert (way.observed_share, way.notes) == (1, ())


def test_direction_is_told_from_where_the_person_faces() -> None:
    motion = walking()
    p = np.array(motion.poses.p_world_joint)
    p[..., :2] = p[..., :2] - p[:, :1, :2]
    p[..., 1] += (0.5 * motion.times)[:, None]
    sideways = BODY.motion(motion.poses.with_poses(slice(None), p))
    ways = [of(one).way for one in (walking(heading=1.0), walking(speed=-1.0, heading=1.0), sideways)]
    assert ways == ["forward", "backward", "to the left"]


@pytest.mark.parametrize("sign", [1, -1])
def test_two_turns_in_place_are_720_degrees_without_a_way(sign: int) -> None:
    share = np.clip((TIMES - 1) / 6, 0, 1)
    way = turning(sign * 4 * np.pi * share**2 * (3 - 2 * share))
    left, right = np.degrees([way.turned_left, way.turned_right])
    assert (left, right)[::sign] == pytest.approx((720, 0), abs=3)
    assert way.path_length == 0
    assert np.isnan(way.direction)
    assert way.way == ""


def test_turns_to_both_sides_are_summed_apart_and_noise_is_none() -> None:
    swing = np.radians(40) * (1 - np.cos(np.pi * TIMES / 2))  # to 80 degrees and back, twice
    way = turning(swing + planted.smooth_noise(0, (480,), 5, np.radians(2)))
    assert np.degrees([way.turned_left, way.turned_right]) == pytest.approx((160, 160), abs=12)
    still = turning(planted.smooth_noise(1, (480,), 5, np.radians(3)))
    assert (still.turned_left, still.turned_right) == (0, 0)


def test_standing_squats_and_treadmills_have_no_way() -> None:
    for motion in (planted.standing(BODY, 240), squatting(), walking(treadmill=True)):
        way = of(motion)
        assert way.path_length == 0
        assert way.displacement < 0.1
    assert way.walking_share > 0.85


def test_noise_of_the_position_adds_no_way() -> None:
    motion = planted.standing(BODY, 600)
    noise = planted.smooth_noise(2, (600, 3), 4, 0.03)
    noisy = motion.poses.with_poses(slice(None), motion.poses.p_world_joint + noise[:, None])
    assert of(BODY.motion(noisy)).path_length == 0


def test_a_way_along_a_circle_is_longer_than_its_displacement() -> None:
    motion = walking(8.0, treadmill=True)
    angle = 2 * np.pi * motion.times / motion.times[-1]
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    poses = motion.poses.with_poses(slice(None), motion.poses.p_world_joint + circle[:, None])
    way = of(BODY.motion(poses))
    assert way.path_length == pytest.approx(2 * np.pi, rel=0.05)
    assert way.displacement < 0.05


def test_an_unobserved_pelvis_has_no_way() -> None:
    motion = walking()
    provenance = np.full(motion.poses.valid.shape, Provenance.PRIOR, dtype=np.uint8)
    provenance[:, 5:] = Provenance.CAMERA
    way = of(replace(motion, poses=replace(motion.poses, provenance=provenance)))
    assert np.isnan([way.path_length, way.displacement, way.direction]).all()
    assert way.observed_share == 0
    assert way.notes == ("the pelvis was never observed",)


def test_sensors_alone_drift_and_gaps_are_noted() -> None:
    motion = walking()
    provenance = np.full(motion.poses.valid.shape, Provenance.IMU, dtype=np.uint8)
    poses = replace(motion.poses, provenance=provenance)
    assert of(replace(motion, poses=poses)).notes == (DRIFT,)
    provenance[:90] = Provenance.BRIDGED
    way = of(replace(motion, poses=replace(poses, provenance=provenance)))
    assert "not observed for 25 % of the time" in way.notes[1]
    assert way.path_length == pytest.approx(1.1 * 4.5, abs=0.1)


def test_no_path_is_shorter_than_the_way_from_its_start_to_its_end() -> None:
    motion = walking(6.0, speed=1.1)
    provenance, half = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8), 180
    provenance[half : half + 60] = Provenance.PRIOR  # a gap of a second
    p = np.array(motion.poses.p_world_joint)
    p[-1] += [0.2, 0, 0]  # a last frame that jumps
    way = of(replace(motion, poses=replace(motion.poses, p_world_joint=p, provenance=provenance)))
    assert way.path_length >= way.displacement
    assert way.path_length == pytest.approx(6.6, abs=0.25)
    assert "crossed straight" in way.notes[0]


def drifting(motion: Motion, degrees: float) -> Motion:
    """A motion whose body is turned about the pelvis by an angle that grows to so many degrees."""
    poses = motion.poses
    turn = so3.about_axis("z", np.radians(degrees) * np.linspace(0, 1, len(poses)))
    root = poses.p_world_joint[:, :1]
    p = root + np.einsum("tij,tkj->tki", turn, poses.p_world_joint - root)
    return BODY.motion(poses.with_poses(slice(None), p, turn[:, None] @ poses.R_world_bone))


@pytest.mark.parametrize("degrees", [None, 5.0])
def test_a_straight_walk_whose_heading_drifts_is_not_said_to_turn(degrees: float | None) -> None:
    motion = drifting(walking(6.0), 41)
    if degrees is not None:
        motion = replace(motion, confidence=certain_to(degrees, motion))
    way = of(motion)
    assert (way.turned_left, way.turned_right, way.unsure_turns) == (0, 0, True)
    assert "turn" not in way.text


def test_a_turn_has_the_deviation_of_the_heading_and_is_said_beyond_its_band_only() -> None:
    share = np.clip((TIMES - 2) / 4, 0, 1)
    quarter = stepping(TIMES, {"right": STANDING, "left": STANDING}, heading=np.pi / 2 * share**2 * (3 - 2 * share))
    certain, doubtful = (of(replace(quarter, confidence=certain_to(s, quarter))) for s in (10.0, 40.0))
    assert np.degrees(certain.turned_left_sigma) == pytest.approx(10 * np.sqrt(2), rel=0.01)
    assert certain.text.endswith("turning 90 ± 28° left")
    assert (doubtful.turned_left, doubtful.unsure_turns) == (0, True)
    assert of(quarter).text.endswith("turning about 90° left")


def test_real_walking_has_its_way() -> None:
    way = of(walk())
    assert 3.5 < way.path_length < 6.0
    assert way.way == "forward"
    assert way.turned_left == way.turned_right == 0
    assert way.walking_share > 0.5
