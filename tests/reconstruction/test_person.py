"""A person's file in reconstructions: better with it, named where it is another's, and what a recording adds to it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.kinematics import world_rotations
from rtof_kin.body.pose_prior import HIPS, SPINE, NeutralPosture
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import CameraUncertainty
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.keypoints import detector_point
from rtof_kin.reconstruction.person import Person, news_of_markers, update_subject
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import Estimate, Subject, merged, read_subject
from rtof_kin.vision.image_points import detector_points

USUAL = SkeletonModel.default()
POSTURE = {
    "Spine": (0.0, 10.0, 0.0),
    "Spine2": (0.0, -8.0, 0.0),
    "LeftShoulder": (6.0, 0.0, 0.0),
    "RightShoulder": (-6.0, 0.0, 0.0),
    "LeftUpLeg": (0.0, -12.0, 0.0),
    "RightUpLeg": (0.0, -12.0, 0.0),
}


def person(seed: int) -> SkeletonModel:
    """Bones of usual length with a standard deviation of 5 %, and a neutral posture."""
    sizes = 1 + 0.05 * np.random.default_rng(seed).normal(size=len(USUAL.names))
    body = USUAL.with_offsets(USUAL.joint_offsets * sizes[:, None])
    turns = so3.exp(np.radians([*POSTURE.values()]))
    return body.with_posture(NeutralPosture(tuple(POSTURE), so3.to_quat_wxyz(turns)))


def file_of(body: SkeletonModel, seed: int = 0) -> Subject:
    """A file with the bones and the posture of a body, with errors of the stated standard deviations."""
    rng, news = np.random.default_rng(seed), dict[str, Estimate[Any]]()
    for joint, offset in zip(body.names[1:], body.joint_offsets[1:], strict=True):
        news[f"joint_offsets_m.{joint}"] = Estimate[Any](value=offset + rng.normal(0, 0.003, 3), sd=0.003)
    for joint, turn in POSTURE.items():
        news[f"posture_deg.{joint}"] = Estimate[Any](value=turn + rng.normal(0, 2.0, 3), sd=2.0)
    return merged(Subject.of({"subject": "P07"}, Path("P07.toml")), news)[0]


def solved(subject: Subject | None, recording: Recording, truth: Motion, mode: Any) -> tuple[float, Person, Any]:
    """Error relative to the root, mm, what was learned, and the result."""
    who = Person.of(subject, recording)
    informed = who.informed(recording).whole()
    found = reconstruct(informed, mode=mode, lifter=planted.PlantedLifter(truth))
    (found,) = who.learning([found], recording, informed.skeleton, "recording 1")
    return planted.root_relative_mm(found.motion.poses.p_world_joint, truth.poses.p_world_joint), who, found


@pytest.mark.parametrize("mode", ["rto", "rtof"])
def test_a_silent_recording_is_better_with_the_file_of_its_person(mode: str) -> None:
    without, with_file = [], []
    for seed in (0, 1):
        body = person(seed)
        truth = planted.human(body, 40, seed=seed)
        recording = replace(planted.recording(truth, sigma_px=2.0), joint_offsets=None)
        without.append(solved(None, recording, truth, mode)[0])
        with_file.append(solved(file_of(body), recording, truth, mode)[0])
    assert np.mean(with_file) < 0.65 * np.mean(without)


def test_the_file_of_another_person_is_named_and_changes_nothing() -> None:
    truth = planted.human(USUAL, 24)
    recording = replace(planted.recording(truth, sigma_px=2.0), joint_offsets=None, height=USUAL.height)
    other, _ = merged(file_of(person(3)), {"height_m": Estimate[Any](value=USUAL.height + 0.1, sd=0.01)})
    error, who, found = solved(other, recording, truth, "lift")
    assert found.warnings[0].startswith("P07.toml is likely of another person and is not used: height_m ")
    assert error == solved(None, recording, truth, "lift")[0]
    assert [*who.news] == ["height_m"]


def test_another_mass_alone_is_said_and_the_rest_of_the_file_is_used() -> None:
    body = person(0)
    truth = planted.human(body, 24)
    subject, _ = merged(file_of(body), {"mass_kg": Estimate[Any](value=60.0, sd=1.0)})
    recording = replace(planted.recording(truth, sigma_px=2.0), joint_offsets=None, mass_kg=90.0)
    _, who, found = solved(subject, recording, truth, "lift")
    assert found.warnings[0].startswith("P07.toml has another mass_kg, which is not used: 90 is ")
    assert found.recording.mass_kg == 90.0
    assert found.recording.posture is not None
    assert who.doubt == ""


def test_updates_of_one_file_wait_for_each_other(tmp_path: Path) -> None:
    path, body = tmp_path / "P07.toml", person(1)
    with ThreadPoolExecutor(4) as pool:
        sigma, many = np.full((21, 3), 0.02), range(6)
        list(pool.map(lambda n: update_subject(path, news_of_markers(body, sigma, f"markers {n}"), body.name), many))
    assert len(read_subject(path).history["joint_offsets_m.LeftLeg"]) == 6


@pytest.fixture(scope="module")
def silent() -> tuple[Motion, Recording]:
    """A person with feet on the floor, and a recording that gives nothing of the body."""
    truth = planted.human(person(0), 40, seed=0)
    return truth, replace(planted.recording(truth, sigma_px=2.0), joint_offsets=None, floor_height=0.0)


def compared(silent: tuple[Motion, Recording], subject: Subject, mode: Any = "rtof", **facts: Any) -> Person:
    truth, recording = silent
    recording, lifter = replace(recording, **{"joint_offsets": None} | facts), planted.PlantedLifter(truth)
    return Person.of(subject, recording).seen(recording, mode, lifter, ReconstructionSettings())


NAMED = "P07.toml is likely of another person and is not used: with its bones, "


def test_the_motion_shows_bones_of_another_person_and_those_of_the_right_one(silent: tuple[Motion, Recording]) -> None:
    for facts in ({}, {"height": person(0).height}):
        who = compared(silent, file_of(person(7)), **facts)
        assert who.doubt.startswith(f"{NAMED}50 frames fit worse by ")
        assert who.subject is None
        assert who.informed(silent[1]) is silent[1]
        right = file_of(person(0))
        assert compared(silent, right, **facts) == Person(right)


def test_sensors_and_floor_show_a_body_of_another_size_where_the_height_is_not_given(
    silent: tuple[Motion, Recording],
) -> None:
    large = file_of(person(0).with_height(1.15 * person(0).height))
    assert "accelerations are those of a body 0.9" in compared(silent, large).doubt
    right, words = file_of(person(0)), r"the feet stand 0\.3\d m over the floor, unless that is wrong"
    assert re.fullmatch(NAMED + words, compared(silent, right, "rto", floor_height=-0.3).doubt)
    assert compared(silent, right, "rto", floor_height=-0.3, height=person(0).height).doubt == ""
    assert compared(silent, right, "rto", floor_height=-1.0).doubt == ""  # rather the floor than the body


def test_bones_that_fit_no_better_are_not_used_and_the_rest_of_the_file_is(silent: tuple[Motion, Recording]) -> None:
    subject, _ = merged(file_of(person(7)), {"mass_kg": Estimate[Any](value=60.0)})
    who = compared(silent, subject, "rto", height=person(0).height)  # without sensors that show it
    why = "the motion fits no better with its bones than without"
    words = f"bones, posture and image points of P07.toml are not used: {why}"
    assert (who.doubt, who.remarks) == ("", (words,))
    assert who.subject is not None
    assert set(who.subject.known) == {"mass_kg"}
    thin, _ = merged(Subject.of({"subject": "P07"}, Path("P07.toml")), {"height_m": Estimate[Any](value=1.8)})
    assert compared(silent, thin, "rto", floor_height=None).subject is thin  # has neither


def test_what_shows_no_bones_is_not_compared(silent: tuple[Motion, Recording]) -> None:
    other, truth = file_of(person(7)), silent[0]
    for mode in ("lift", "sf2", "imu"):
        assert compared(silent, other, mode).subject is other
    assert compared(silent, other, joint_offsets=truth.skeleton.joint_offsets).doubt != ""  # what is given is
    video = silent[1].video
    loose = replace(video, camera=replace(video.camera, uncertainty=CameraUncertainty(0.03, 0.03, 0.2)))
    assert compared(silent, other, keypoints=loose).subject is other
    unseen = replace(video, uv_px=np.full_like(video.uv_px, np.nan), confidence=0 * video.confidence)
    assert compared(silent, other, "rto", keypoints=unseen).subject is other


def quantity(kind: str, item: str, value: float, sigma: float, prior: float) -> Quantity:
    known = 1 - (sigma / prior) ** 2
    return Quantity(kind, item, np.array([value]), np.array([sigma]), np.array([prior]), known)


def news(recording: Recording, found: Any) -> Mapping[str, Estimate[Any]]:
    who = Person()
    assert [*who.learning([found], recording, recording.skeleton, "recording 1")] == [found]
    return who.news


def test_bones_and_ankles_of_a_calibration_count_without_their_prior() -> None:
    truth = planted.human(USUAL, 12)
    recording = planted.recording(truth)
    result = reconstruct(recording, mode="lift", lifter=planted.PlantedLifter(truth))
    calibration = SelfCalibration(
        (
            quantity("bones", "thighs", 0.04, 0.01, 0.03),
            quantity("bones", "head", 0.01, 0.0299, 0.03),  # taken from the prior
            quantity("ankle height", "feet", 0.015, 0.005, 0.02),
        )
    )
    found = news(recording, replace(result, calibration=calibration))
    assert set(found) == {"joint_offsets_m.LeftLeg", "joint_offsets_m.RightLeg", "ankle_height_m"}
    thigh, length = found["joint_offsets_m.LeftLeg"], USUAL.bone_lengths["LeftLeg"]
    assert thigh.sd is not None
    w_prior, w_own = 0.03**-2, (thigh.sd / length) ** -2  # prior and recording make what the calibration found
    scale = np.linalg.norm(thigh.value) / length - 1
    assert w_own * scale / (w_prior + w_own) == pytest.approx(0.04)
    assert (w_prior + w_own) ** -0.5 == pytest.approx(0.01)
    assert found["ankle_height_m"].value == pytest.approx(0.08 + 0.015 / (1 - 1 / 16))
    measured = replace(recording, joint_offsets=person(1).joint_offsets)
    assert np.array_equal(
        news(measured, replace(result, calibration=calibration))["joint_offsets_m.LeftLeg"].value,
        measured.joint_offsets[USUAL.index("LeftLeg")[0]],
    )  # what was measured stands


def test_places_of_the_detector_count_without_their_prior_about_what_was_known() -> None:
    truth = planted.human(USUAL, 12)
    recording = planted.recording(truth)
    video = recording.video.select(USUAL.names[:9])
    names = tuple(detector_point("halpe26", name) for name in [*detector_points("halpe26")][:9])
    result = reconstruct(recording, mode="lift", lifter=planted.PlantedLifter(truth))
    prior, known = 0.025, np.array([0.01, 0.0, 0.0])
    sigma, value = np.array([0.01, 0.02, 0.005]), np.array([0.012, -0.006, 0.003])
    places = tuple(
        Quantity("place", item, value, own, np.full(3, prior), 0.5)
        for item, own in (("LeftLeg", sigma), ("LeftForeArm", sigma), ("Head", np.full(3, prior)))
    )
    found = news(
        recording,
        replace(
            result,
            recording=replace(recording, image_points={"halpe26": {"LeftLeg": known}}),
            keypoints=replace(video, names=names),
            calibration=SelfCalibration((), places=places),
        ),
    )
    (field,) = found  # the elbow is not told apart, and the recording shows nothing of the head
    assert field == "image_points_m.halpe26.LeftLeg"
    variance = np.mean(sigma**2)
    own, sd = found[field].value - known, found[field].sd / 2.5**0.5
    np.testing.assert_allclose(own / sd**2 / (sd**-2 + prior**-2), value, rtol=1e-9)
    assert 1 / (sd**-2 + prior**-2) == pytest.approx(variance)


def test_the_ankle_height_of_the_file_is_used() -> None:
    subject, _ = merged(file_of(USUAL), {"ankle_height_m": Estimate[Any](value=0.095, sd=0.004)})
    calibration = Person(subject).calibration
    assert calibration is not None
    assert calibration.ankle_height == pytest.approx(0.015)
    assert Person(file_of(USUAL)).calibration is Person().calibration is None


def standing(frames: int, arms_deg: float, sigma_deg: Mapping[str, float]) -> Motion:
    """A person with `POSTURE` who stands still, the arms lowered, with standard deviations of turns by joint, and of
    the trunk relative to the pelvis as that of Spine3.
    """
    R = np.tile(np.eye(3), (21, 1, 1))
    R[USUAL.index(*POSTURE)] = so3.exp(np.radians([*POSTURE.values()]))
    R[USUAL.index("LeftArm", "RightArm")] = so3.exp(np.radians([[-arms_deg, 0, 0], [arms_deg, 0, 0]]))
    q = USUAL.inverse_kinematics(np.full((1, 21, 3), (0.0, 0.0, 0.95)), world_rotations(USUAL.parents, R[None]))
    still = planted._motion(USUAL, np.repeat(q, frames, axis=0), seen=True)
    pairs = (*((USUAL.names[USUAL.parents[j]], USUAL.names[j]) for j in range(1, 21)), ("Hips", "Spine3"))
    sigmas = np.radians([sigma_deg.get(child, 30.0) for _, child in pairs])
    turns = np.broadcast_to(sigmas[:, None, None] ** 2 * np.eye(3), (frames, len(pairs), 3, 3))
    zeros = np.zeros((frames, 21, 3, 3))
    return replace(still, confidence=Confidence(still.times, USUAL.names, zeros, zeros, pairs, turns))


def news_of(motion: Motion) -> Mapping[str, Estimate[Any]]:
    short = planted.human(USUAL, 12)
    result = reconstruct(planted.recording(short), mode="lift", lifter=planted.PlantedLifter(short))
    return news(planted.recording(short), replace(result, motion=motion))


SHOWN = {"LeftUpLeg": 4.0, "RightUpLeg": 4.0, "LeftShoulder": 4.0}


def test_a_t_pose_shows_the_joints_that_are_known_better_than_by_the_prior() -> None:
    still = standing(40, 0.0, SHOWN)
    found = news_of(still)
    assert set(found) == {f"posture_deg.{joint}" for joint in SHOWN}
    np.testing.assert_allclose(found["posture_deg.LeftUpLeg"].value, POSTURE["LeftUpLeg"], atol=0.1)
    assert found["posture_deg.LeftUpLeg"].sd == pytest.approx(np.hypot(4.0, 3.0), rel=1e-3)
    assert news_of(replace(still, confidence=None)) == {}


def test_hanging_arms_show_hips_and_spine_but_no_clavicles() -> None:
    found = news_of(standing(40, 80.0, {**SHOWN, "Spine3": 4.0}))
    assert set(found) == {f"posture_deg.{joint}" for joint in (*SPINE, *HIPS)}
    np.testing.assert_allclose(found["posture_deg.Spine2"].value, POSTURE["Spine2"], atol=0.1)
    assert found["posture_deg.Spine2"].sd == pytest.approx(np.hypot(1.0, 3.0), rel=1e-3)  # its share of the bend


def test_a_long_motion_shows_the_posture_without_such_a_pose() -> None:
    assert news_of(standing(600, 45.0, SHOWN)) == {}  # of ten seconds
    found = news_of(standing(3600, 45.0, SHOWN))
    assert set(found) == {f"posture_deg.{joint}" for joint in SHOWN}
    prior, sd = USUAL.table.prior.covariance, found["posture_deg.LeftUpLeg"].sd
    assert sd is not None
    j = USUAL.names.index("LeftUpLeg") - 1
    assert 4.0 < sd < np.degrees(np.sqrt(np.trace(prior[3 * j : 3 * j + 3, 3 * j : 3 * j + 3]) / 3))


def test_a_file_is_made_and_gets_better(tmp_path: Path) -> None:
    path, body = tmp_path / "P07.toml", person(1)
    sigma = np.full((21, 3), 0.004)
    said = update_subject(path, news_of_markers(body, sigma, "markers 1"), body.name)
    assert len(said) == 20
    assert [each.name for each in tmp_path.iterdir()] == ["P07.toml"]  # no lock stays behind
    assert said[0].startswith("P07: joint_offsets_m.Spine: ")
    assert update_subject(path, news_of_markers(body, sigma, "markers 1"), body.name) == (
        "P07: nothing new in this recording",
    )
    update_subject(path, news_of_markers(body, sigma, "markers 2"), body.name)
    leg = read_subject(path).joint_offsets_m["LeftLeg"]
    assert leg.sd == 0.004  # not less: what is shared, 1.5 % of the length, is more
    other = {"height_m": Estimate[Any](value=1.7), "joint_offsets_m.LKnee": Estimate[Any](value=np.ones(3))}
    assert update_subject(path, other, "human36m") == ("P07: height_m: 1.7 ± 0.01",)
