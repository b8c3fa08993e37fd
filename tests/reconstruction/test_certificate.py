"""The certificate: planted errors come back, the sensor's own are taken out, and what it cannot say is said."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from reconstruction_support import BODY, Case

from rtof_kin.core import rotations as so3
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.reconstruction import certificate as module
from rtof_kin.reconstruction.camera_evidence import heading_turned
from rtof_kin.reconstruction.certificate import SENSOR_SD, SWING, TWIST, Certificate, LeftOut, LeftOutPoints, factor
from rtof_kin.reconstruction.part_results import cut, joined
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Job
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import AuditResult, Grade, headline
from rtof_kin.reporting.certificate import CertificateSummary, bars, facts, results, sentences, table
from rtof_kin.reporting.html import _environment

Array = NDArray[np.float64]
T = 600
TIMES = np.arange(T) / 60
SETTINGS = ReconstructionSettings(frames=16, certificate=True, sensor_joints=planted.LIMBS)  # compiled once for all
JOINTS = ("LeftArm", "LeftForeArm", "LeftUpLeg", "LeftLeg")

PARTS: Any = _environment().get_template("parts.html").module


def left_out(swing: float, stated: float, joint: str = "LeftLeg", seed: int = 0, **changes: Any) -> LeftOut:
    """A sensor with a swing error of so many degrees, RMS, and a stated one."""
    rng = np.random.default_rng(seed)
    size = np.abs(rng.normal(size=T))
    error = np.zeros((T, 2))
    error[:, SWING] = np.radians(swing) * size / np.sqrt(np.mean(size**2))
    error[:, TWIST] = np.radians(2.0)
    told = np.tile(np.radians([stated, 2.0]), (T, 1))
    eye, bone = np.tile(np.eye(3), (T, 1, 1)), np.array([0.0, 0.0, 1.0])
    rates = np.array([0.1, 1.0])
    one = LeftOut("imu", joint, TIMES, error, error, told, SENSOR_SD, False, np.zeros(2), eye, bone, rates, rates)
    return replace(one, **changes)


def certificate(*sensors: LeftOut) -> Certificate:
    return Certificate(0.0, 10.0, sensors)


@pytest.fixture(scope="module")
def case() -> Case:
    truth = planted.human(BODY, 250)
    return Case(truth, planted.recording(truth, sigma_px=3.0, joints=JOINTS, degrees=2.0))


@pytest.fixture(scope="module")
def certified(case: Case) -> Reconstruction:
    return case.run(settings=SETTINGS)


def test_a_swing_error_is_certified_whatever_was_stated() -> None:
    for true, stated in ((20.0, 8.0), (20.0, 20.0), (10.0, 20.0)):
        one = left_out(np.hypot(true, np.degrees(SENSOR_SD[SWING])), stated)
        assert np.degrees(one.certified[SWING]) == pytest.approx(true, rel=0.15)


def test_twist_stays_near_what_was_stated_as_the_sensor_shows_it_badly() -> None:
    one = left_out(8.0, 8.0)
    for measured in (1.0, 9.0, 12.0):
        error = one.error.copy()
        error[:, TWIST] = np.radians(measured)
        twist = np.degrees(replace(one, error=error).certified[TWIST])
        assert 1.0 < twist < measured + 1.0
    assert twist < 10.0


def test_all_sensors_together_are_surer_than_one() -> None:
    many = [left_out(16.0, 8.0, seed=seed) for seed in range(8)]
    assert factor(many[:1], SWING) < factor(many, SWING) == pytest.approx(4.0, rel=0.15)
    assert np.isnan(factor([left_out(5.0, np.nan)], SWING))


def test_a_mounting_that_was_found_from_the_motion_may_only_widen() -> None:
    assert factor([left_out(2.0, 10.0)], SWING) < 1.0
    assert factor([left_out(2.0, 10.0, found=True)], SWING) == 1.0
    assert factor([left_out(30.0, 10.0, found=True)], SWING) > 4.0


def test_the_interval_of_blocks_holds_the_rms_and_is_wider_where_errors_last() -> None:
    rng = np.random.default_rng(0)
    white = np.column_stack([rng.normal(size=T), np.zeros(T)])
    lasting = np.column_stack([np.repeat(rng.normal(size=5), T // 5), np.zeros(T)])
    one, widths = left_out(1.0, 1.0), []
    for error in (white, lasting):
        low, high = one.interval(error)
        assert low < np.sqrt(np.mean(np.sum(error**2, axis=1))) < high
        widths.append(high - low)
    assert widths[1] > 3 * widths[0]


def test_planted_sensors_are_predicted_and_compared_with_what_they_measured(
    case: Case, certified: Reconstruction
) -> None:
    found = certified.certificate
    assert found is not None
    assert [one.joint for one in found.left_out] == list(JOINTS)
    for one in found.left_out:
        true = one.against(case.truth.poses.R_world_bone[:, BODY.index(one.joint)[0]])
        size = np.sqrt(np.mean(np.sum(true**2, axis=1)))
        assert np.linalg.norm(one.measured) == pytest.approx(size, abs=np.radians(3.0))  # its sensor is 2 deg off
        assert np.isfinite(one.movement).all()
        assert 0.0 < one.below(0.5) < one.below(0.9)
        assert one.rate_rms[0] < one.rate_rms[1]
    whats = {one.what for one in found.points}
    assert whats == {"LeftHand", "RightHand", "LeftFoot", "RightFoot", "Head"}
    assert all(0 < one.rms < 0.5 for one in found.points)


def test_the_motion_is_the_same_with_and_without_a_certificate(case: Case, certified: Reconstruction) -> None:
    without = case.run(settings=replace(SETTINGS, certificate=False))
    assert without.certificate is None
    np.testing.assert_array_equal(without.motion.q, certified.motion.q)


def test_a_second_camera_is_left_out_and_its_points_are_predicted(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LEAST_SECONDS", 0.5)
    case = replace(case, recording=case.recording.between(0.0, 0.7))
    video, half_turn = case.recording.video, so3.about_axis("z", np.pi)
    camera = replace(video.camera, R_camera_world=video.camera.R_camera_world @ half_turn)  # from the other side
    uv = camera.project(case.truth.poses.p_world_joint[: len(video)])
    with_two = case.changed(views=(replace(video, camera=camera, uv_px=uv),)).run(settings=SETTINGS).certificate
    assert with_two is not None
    (view,) = [one for one in with_two.points if one.what == "view 2"]
    assert 0.0 < view.rms < 0.2
    assert np.isfinite(view.error).all()


def test_a_turned_sensor_is_seen_by_its_own_prediction_only(
    case: Case, certified: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_ENDS", ())
    calibration = case.recording.calibration
    assert calibration is not None
    R = calibration.R_sensor_bone.copy()
    R[3] = R[3] @ so3.exp(np.radians([25.0, 0.0, 0.0]))
    turned = case.changed(calibration=replace(calibration, R_sensor_bone=R)).run(settings=SETTINGS).certificate
    assert turned is not None
    assert certified.certificate is not None
    before, after = ([np.linalg.norm(one.measured) for one in c.left_out] for c in (certified.certificate, turned))
    rise = np.degrees(np.subtract(after, before))
    assert np.argmax(rise) == 3
    assert rise[3] > 10.0
    moved = [np.sqrt(np.nanmean(one.movement**2)) for one in (certified.certificate.left_out[3], turned.left_out[3])]
    assert moved[1] == pytest.approx(moved[0], rel=0.2)  # constant errors are no errors of movement


def test_of_a_long_recording_the_part_with_most_movement_is_certified(
    case: Case, certified: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_SECONDS", 2.0)
    monkeypatch.setattr(module, "LEAST_SECONDS", 1.0)
    monkeypatch.setattr(module, "_ENDS", ())
    found = case.run(settings=SETTINGS).certificate
    assert found is not None
    assert found.stop - found.start == pytest.approx(2.0, abs=0.05)
    R = certified.bone_imus.R_world_bone
    turns = so3.angle_between(R[:-1], R[1:]).sum(axis=1)
    at = np.searchsorted(certified.motion.times, found.start)
    most = max(turns[i : i + 120].sum() for i in range(len(turns) - 119))
    assert turns[at : at + 120].sum() == pytest.approx(most, rel=0.02)
    for one in found.left_out:
        assert len(one.times) == 120
        assert np.isfinite(one.error).all()


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"imus": 1}, "one sensor leaves no other"),
        ({"mode": "sf2"}, "mode sf2 is not tested by sensors"),
        ({"imus": 0}, "a camera alone proves no angle"),
        ({"seconds": 3.0}, "3.0 s are too short"),
    ],
)
def test_what_cannot_be_certified_says_why(case: Case, changes: dict[str, Any], why: str) -> None:
    recording, mode = case.recording, changes.get("mode", "rtof")
    assert recording.imus is not None
    if "seconds" in changes:
        recording = recording.between(0.0, changes["seconds"])
    elif changes.get("imus"):
        recording = replace(recording, imus=recording.imus.select(recording.imus.names[:1]))
    elif "imus" in changes:
        recording, mode = replace(recording, imus=None, calibration=None), "rto"
    found = reconstruct(recording, BODY, mode, lifter=case.lifter(), settings=SETTINGS)
    assert found.certificate is not None
    assert why in found.certificate.reason
    (result,) = [one for one in audit(found) if one.section == "certificate"]
    assert result.grade is Grade.NOT_CHECKED
    assert why in result.text


def test_a_recording_that_is_worse_than_its_bands_warns_and_says_how_much() -> None:
    good, bad = certificate(left_out(8.0, 8.0)), certificate(*[left_out(30.0, 8.0, seed=s) for s in range(4)])
    assert next(results(good, BODY)).grade is Grade.PASS
    worst = next(results(bad, BODY))
    assert worst.grade is Grade.FAIL
    assert any("times what is stated" in sentence for sentence in sentences(bad, BODY))
    assert not any("times what is stated" in sentence for sentence in sentences(good, BODY))


def test_sentences_name_what_has_no_witness() -> None:
    still = left_out(5.0, 5.0, "LeftArm", rate_rms=np.array([0.01, 0.05]))
    said = list(sentences(certificate(still, left_out(5.0, 5.0, "LeftUpLeg", found=True)), BODY))
    assert said[0].startswith("in this recording a segment without a sensor is predicted to 4.9 deg (90 %")
    (hips,) = [one for one in said if "no sensor measured" in one and "Hips" in one]
    assert hips.endswith("the nearest (LeftUpLeg) can be predicted to 5.4 deg")
    assert len([one for one in said if "no sensor measured" in one]) <= 4  # those with the same neighbours are one
    assert any("LeftArm hardly moved" in one for one in said)
    assert any("found from this motion" in one and "LeftUpLeg" in one for one in said)


def test_facts_are_plain_and_the_page_shows_them() -> None:
    data = facts(certificate(left_out(9.0, 6.0), left_out(5.0, np.nan, "LeftArm")), BODY)
    summary = CertificateSummary(**data)
    words = planted_words()
    assert [row[0] for row in table(summary, words).text()] == ["left shank", "left upper arm"]
    drawn = str(PARTS.bars(bars(summary, words)))
    assert drawn.count("<rect") == 2
    assert drawn.count("<path") == 1  # nothing was stated of the other


def test_segments_of_other_limbs_have_no_witness_and_stillness_shows_no_movement() -> None:
    still = {"rate_rms": np.array([0.01, 0.05])}
    both = left_out(5.0, 5.0, "LeftUpLeg"), left_out(5.0, 5.0, "LeftLeg")
    for found, why in (
        (certificate(*both), "on one limb"),
        (
            certificate(left_out(5.0, 5.0, "LeftArm", **still), left_out(5.0, 5.0, "RightLeg", **still)),
            "no sensor moved",
        ),
    ):
        own = tuple(results(found, BODY))
        passed = AuditResult("image", "error", "Head", 1.0, "px", 2.0, 5.0)
        about = headline([passed, *own])
        assert about.grade is Grade.PLAUSIBLE
        assert why in about.not_proven
    said = " ".join(sentences(certificate(*both), BODY))
    assert "LeftFoot" in said
    assert "RightLeg" not in said  # a leg says nothing of the other
    assert headline([passed, *results(certificate(both[0], left_out(5.0, 5.0, "LeftArm")), BODY)]).grade is Grade.PASS


def test_nine_in_ten_frames_are_below_with_every_sensor_counting_the_same() -> None:
    good, bad = left_out(5.0, 5.0), left_out(30.0, 30.0, "LeftArm", seed=1)
    few = replace(bad, error=np.where(np.arange(T)[:, None] < 200, bad.error, np.nan))
    found = certificate(good, few)
    assert found.below_90 == pytest.approx(few.below(0.8), rel=0.02)
    assert certificate(good).below_90 == pytest.approx(good.below(0.9), rel=0.01)
    assert np.isnan(certificate().below_90)


def test_sensors_that_ended_or_are_silent_are_told_from_segments_without_one(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("LEAST_SECONDS", 1.5), ("LEAST_KNOWN_S", 0.5), ("_ENDS", ())):
        monkeypatch.setattr(module, name, value)
    recording = case.recording.between(0.0, 2.0)
    imus, calibration = recording.imus, recording.calibration
    assert imus is not None
    assert calibration is not None
    imus = imus.select([imus.names[s] for s in (0, 2, 3)])
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    for s, end in ((0, 0.2), (2, 1.3)):
        R[imus.times > end, s], f[imus.times > end, s] = np.nan, np.nan
    mounted = calibration.R_sensor_bone.copy()
    mounted[3] = mounted[3] @ so3.exp(np.radians([25.0, 0.0, 0.0]))
    imus, calibration = replace(imus, R_inertial_sensor=R, f_sensor=f), replace(calibration, R_sensor_bone=mounted)
    changed = replace(case, recording=replace(recording, imus=imus, calibration=calibration))
    found = changed.run(settings=SETTINGS).certificate
    assert found is not None
    assert [one.joint for one in found.left_out] == [JOINTS[2], JOINTS[3]]
    assert found.untested == (("LeftArm", "its sensor has less than 0.5 s of samples there"),)
    said = list(sentences(found, BODY))
    assert any("LeftArm was not tested" in one for one in said)
    assert not any("no sensor measured LeftArm" in one for one in said)
    ended = found.left_out[-1]
    assert 70 < np.isfinite(ended.error[:, 0]).sum() < 85
    np.testing.assert_array_equal(np.isnan(ended.stated), np.isnan(ended.error))  # like with like
    assert np.degrees(np.linalg.norm(ended.measured)) > 15.0
    assert np.linalg.norm(ended.moved) < np.linalg.norm(ended.measured) / 2  # both halves of what was measured
    json.dumps(facts(found, BODY), allow_nan=False)


def test_sensors_of_another_recording_testify_nothing(case: Case, certified: Reconstruction) -> None:
    foreign = tuple(StreamFault(FaultKind.FOREIGN, joint, 0.0, 4.0) for joint in JOINTS)
    job = Job.of(case.recording, BODY, case.lifter(), SETTINGS)
    assert "do not belong" in module.certify(job, "rtof", certified.motion, foreign).reason


def test_where_no_reconstruction_succeeds_the_certificate_says_so(
    case: Case, certified: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module._Without, "predicted", lambda self: None)
    job = Job.of(case.recording, BODY, case.lifter(), SETTINGS)
    found = module.certify(job, "rtof", certified.motion)
    assert "LeftArm, without its sensor nothing could be reconstructed" in found.reason
    assert not found.left_out
    assert {joint for joint, _ in found.untested} == set(JOINTS)
    assert list(facts(found, BODY)["sentences"])
    json.dumps(facts(found, BODY), allow_nan=False)


def test_nothing_of_a_left_out_sensor_reaches_its_prediction(case: Case) -> None:
    recording, found = case.recording.between(0.0, 0.8), []
    imus = recording.imus
    assert imus is not None
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    R[:, 3], f[:, 3] = R[::-1, 3] @ so3.exp([1.0, -2.0, 0.5]), 30.0
    for own in (imus, replace(imus, R_inertial_sensor=R, f_sensor=f)):
        job = Job.of(replace(recording, imus=own), BODY, case.lifter(), SETTINGS).with_solver(None)
        for sensor in (3, 2):
            without = module._Without(job, "rtof", (), None, sensor=imus.names[sensor], joint=JOINTS[sensor])
            found.append(without.predicted())
    same, other, changed, moved = found
    assert same is not None and changed is not None and other is not None and moved is not None  # noqa: PT018
    np.testing.assert_array_equal(same.q, changed.q)
    assert same.confidence is not None
    assert changed.confidence is not None
    np.testing.assert_array_equal(same.confidence.turn_covariance, changed.confidence.turn_covariance)
    assert np.abs(other.q - moved.q).max() > 0.01  # the same sensor is used where another is left out


def test_points_of_a_camera_in_the_hand_are_compared_without_its_drift(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = case.recording.video
    angle = np.radians(np.linspace(-4.0, 4.0, len(video)))
    drifting = replace(video, camera=replace(video.camera, heading_drift=0.01))
    job = Job.of(replace(case.recording, keypoints=heading_turned(drifting, angle)), BODY, case.lifter(), SETTINGS)
    one, errors = module._Without(job, "rtof", (), None, joints=("Head",)), []
    for sign in (0, -1):
        monkeypatch.setattr(module, "without_heading_drift", lambda seen, *_, s=sign: heading_turned(seen, s * angle))
        errors.append(next(one.compared_points(case.truth)).rms)
    assert errors[0] > 5 * errors[1]


def test_the_certificate_of_a_later_part_is_that_of_the_whole(certified: Reconstruction) -> None:
    first, second = cut(replace(certified, certificate=None), slice(0, 100)), cut(certified, slice(100, 250))
    assert joined((first, second)).certificate is certified.certificate


def test_points_without_stated_deviations_have_none() -> None:
    nothing = np.full(T, np.nan)
    assert np.isnan(LeftOutPoints("Head", TIMES, nothing + 1, nothing).expected)


@pytest.mark.parametrize(
    "damage", [{"error_deg": -1.0}, {"error_deg": float("nan")}, {"sentences": []}, {"sensors": 3}]
)
def test_a_damaged_summary_is_refused(damage: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(damage))):
        CertificateSummary(**(facts(certificate(left_out(9.0, 6.0)), BODY) | damage))


def test_the_picture_shows_large_errors_to_scale() -> None:
    data = facts(certificate(left_out(75.0, 50.0), left_out(20.0, 10.0, "LeftArm")), BODY)
    drawn = str(PARTS.bars(bars(CertificateSummary(**data), planted_words())))
    long, short = (float(width) for width in re.findall(r'<rect[^>]* width="([\d.]+)"', drawn))
    assert long / short == pytest.approx(data["sensors"][0]["error_deg"] / data["sensors"][1]["error_deg"], rel=0.01)
    assert "90°" in drawn


def planted_words() -> Any:
    from rtof_kin.clinical.angle_table import angle_table

    return angle_table(BODY.table)
