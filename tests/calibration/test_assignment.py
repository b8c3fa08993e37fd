"""Unnamed sensors are found on their segments."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from assignment_support import SOME, exchanged, places, some, turned, walk, walking_log, walking_poses
from scipy.special import softmax

from rtof_kin.calibration.assignment import assign_sensors, check_assignment, match
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.reconstruction.checks.sensors import check_recording

LEGS = ("R_LowLeg", "Pelvis", "L_UpLeg", "R_UpLeg", "L_LowLeg")


def test_all_sensors_of_a_walk_are_found_from_motion_alone() -> None:
    found = assign_sensors(walking_log(), walk().skeleton)
    assert found.joints == places()
    assert min(found.probabilities.values()) > 0.5
    assert "too short" in found.doubt


def test_few_sensors_are_found_with_an_image() -> None:
    log = walking_log(("R_LowArm", "L_LowLeg", "L_LowArm", "R_LowLeg", "Pelvis"))
    found = assign_sensors(log, walk().skeleton, walking_poses())
    assert found.joints == {name: places()[name] for name in log.names}
    assert min(found.probabilities.values()) > 0.8


def test_the_answer_does_not_depend_on_mountings_headings_or_order() -> None:
    skeleton, poses, log = walk().skeleton, walking_poses(), walking_log(LEGS)
    first = assign_sensors(log, skeleton, poses)
    again = assign_sensors(turned(log.select(LEGS[::-1]), 3), skeleton, poses)
    assert again.joints == first.joints
    for name in LEGS:
        assert again.probabilities[name] == pytest.approx(first.probabilities[name], abs=0.05)


def test_candidates_restrict_the_segments_of_all_and_of_single_sensors() -> None:
    skeleton, log = walk().skeleton, walking_log(("L_UpLeg", "R_UpLeg"))
    arms = assign_sensors(log, skeleton, candidates=("LeftForeArm", "RightForeArm"))
    assert set(arms.joints.values()) == {"LeftForeArm", "RightForeArm"}
    known = assign_sensors(log, skeleton, candidates={"L_UpLeg": ("LeftUpLeg",), "R_UpLeg": ("RightUpLeg",)})
    assert known.joints == {"L_UpLeg": "LeftUpLeg", "R_UpLeg": "RightUpLeg"}
    assert min(known.probabilities.values()) > 0.99
    assert known.doubt.startswith("4 s are too short to be sure from motion alone")


def test_unlearned_segments_and_sensors_without_acceleration_need_an_image() -> None:
    skeleton, poses, log = walk().skeleton, walking_poses(), walking_log(("L_Foot", "R_Foot"))
    hands = ("LeftHand", "LeftFoot", "RightFoot")
    assert assign_sensors(log, skeleton, poses, candidates=hands).joints == {
        "L_Foot": "LeftFoot",
        "R_Foot": "RightFoot",
    }
    with pytest.raises(InvalidInputError, match="cannot be told from motion alone for LeftHand; give poses"):
        assign_sensors(log, skeleton, candidates=hands)
    log = walking_log(LEGS)
    log = replace(log, streams=tuple(replace(stream, f_sensor=None) for stream in log.streams))
    segments = [places()[name] for name in LEGS]
    assert assign_sensors(log, skeleton, poses, candidates=segments).joints == dict(zip(LEGS, segments, strict=True))
    with pytest.raises(InvalidInputError, match="without accelerations"):
        assign_sensors(log, skeleton)


def test_sensors_at_rest_are_named_and_not_guessed_silently() -> None:
    first, *others = walking_log(LEGS).streams
    rest = {name: np.repeat(getattr(first, name)[:1], len(first), axis=0) for name in ("R_inertial_sensor", "f_sensor")}
    log = replace(walking_log(LEGS), streams=(replace(first, **rest), *others))
    found = assign_sensors(log, walk().skeleton)
    assert found.doubt.startswith("R_LowLeg does not move: record a few steps")


def test_unsure_sensors_have_alternatives_and_a_sentence() -> None:
    found = assign_sensors(walking_log(("R_LowArm",)), walk().skeleton)
    assert "R_LowArm" in found.doubt
    others = [p for _, p in found.alternatives["R_LowArm"]]
    assert others == sorted(others, reverse=True)
    assert others
    assert sum(others) + found.probabilities["R_LowArm"] <= 1 + 1e-9


@pytest.mark.parametrize(
    "candidates, message",
    [
        (("Hips",), "5 sensors for 1 segments"),
        (dict.fromkeys(LEGS[:2], ("Hips",)), "no segment of its own"),
        (("Nose",), "Nose"),
        ({"thigh": ("LeftUpLeg",)}, "thigh"),
    ],
)
def test_too_many_sensors_and_unknown_names_are_errors(candidates: Any, message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        assign_sensors(walking_log(LEGS), walk().skeleton, candidates=candidates)


def test_a_video_of_another_time_is_an_error() -> None:
    poses = walking_poses()
    late = replace(poses, times=poses.times + 100)
    with pytest.raises(InvalidInputError, match=r"0\.0 s of a visible person in common"):
        assign_sensors(walking_log(LEGS), walk().skeleton, late)


def test_a_right_map_is_left_alone() -> None:
    own = {name: places()[name] for name in SOME}
    for poses in (None, walking_poses()):
        check = check_assignment(walking_log(), own, walk().skeleton, poses)
        assert check.joints == own
        assert not check.wrong
        assert check.check().passed


def test_exchanged_legs_are_named_with_the_correction() -> None:
    own = {name: places()[name] for name in SOME}
    wrong = own | {"L_LowLeg": "RightLeg", "R_LowLeg": "LeftLeg"}
    check = check_assignment(walking_log(), wrong, walk().skeleton, walking_poses())
    assert check.joints == own
    assert {sensor.sensor for sensor in check.wrong} == {"L_LowLeg", "R_LowLeg"}
    assert check.check().failed
    assert "L_LowLeg, declared on RightLeg, is on LeftLeg" in check.check().advice


def test_two_sensors_on_one_segment_are_an_error() -> None:
    twice = {"L_LowLeg": "LeftLeg", "R_LowLeg": "LeftLeg"}
    with pytest.raises(InvalidInputError, match="two sensors on LeftLeg"):
        check_assignment(walking_log(), twice, walk().skeleton)


def test_exchanged_samples_of_a_recording_get_each_other_s_calibration() -> None:
    right = some()
    check, corrected = check_recording(exchanged(right, "L_UpLeg", "R_UpLeg"))
    assert {sensor.sensor for sensor in check.wrong} == {"L_UpLeg", "R_UpLeg"}
    a, b = SOME.index("L_UpLeg"), SOME.index("R_UpLeg")
    np.testing.assert_allclose(corrected.calibration.R_sensor_bone[[a, b]], right.calibration.R_sensor_bone[[b, a]])
    assert corrected.calibration.joints[a] == "RightUpLeg"


def test_a_right_recording_comes_back_as_it_is() -> None:
    right = some()
    check, same = check_recording(right)
    assert not check.wrong
    assert same is right
    with pytest.raises(InvalidInputError, match="no calibrated sensors"):
        check_recording(replace(walk(), imus=None, calibration=None))


def planted(S: int, K: int) -> tuple[np.ndarray, np.ndarray]:
    """Random scores of single sensors and symmetric ones of pairs."""
    rng = np.random.default_rng(5)
    single, pair = 2 * rng.standard_normal((S, K)), rng.standard_normal((S, S, K, K))
    pair = (pair + pair.transpose(1, 0, 3, 2)) / 2
    pair[np.arange(S), np.arange(S)] = 0
    return single, pair


def test_probabilities_are_those_of_enumeration() -> None:
    single, pair = planted(3, 5)
    every = np.array(list(permutations(range(5), 3)))
    rows = np.arange(3)
    single_score, pair_score = (
        single[rows, every].sum(axis=1),
        pair[rows[:, None], rows, every[:, :, None], every[:, None]],
    )
    score = single_score + pair_score.sum(axis=(1, 2)) / 2  # each pair stands there twice
    exact = np.array([[softmax(score)[every[:, s] == k].sum() for k in range(5)] for s in range(3)])
    found = match(single, pair)
    np.testing.assert_allclose(found.probability, exact, atol=0.02)
    assert tuple(found.best) == tuple(every[score.argmax()])


def test_every_sensor_has_a_segment_of_its_own_that_it_is_allowed() -> None:
    single, pair = planted(4, 4)
    allowed = ~np.eye(4, dtype=bool)
    found = match(single, pair, allowed=allowed)
    assert sorted(found.best) == [0, 1, 2, 3]
    assert np.all(np.diag(found.probability) < 1e-6)


def test_sides_that_are_equally_likely_are_both_visited() -> None:
    pair = np.zeros((2, 2, 2, 2))
    pair[0, 1] = pair[1, 0] = 50 * (1 - np.eye(2))
    mirror = np.array([1, 0])
    found = match(np.zeros((2, 2)), pair, mirrors=[mirror])
    np.testing.assert_allclose(found.probability, 0.5, atol=0.1)


def test_a_prior_moves_the_answer() -> None:
    found = match(np.zeros((2, 3)), prior=lambda labels: np.where((labels == [2, 0]).all(axis=1), 20.0, 0.0))
    assert tuple(found.best) == (2, 0)
