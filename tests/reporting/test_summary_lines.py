"""The five lines of a report's summary, against sentences written by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from clinical_support import limb, posture, squatting, stepping, walk, walking
from numpy.typing import NDArray
from report_support import certain_to

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.comparison import compare_sides, compared
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.index import Session
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.reporting.audit_results import AuditResult, Grade, Headline
from rtof_kin.reporting.summary_file import Summary
from rtof_kin.reporting.summary_lines import (
    EVENT_SIGMA,
    Finding,
    SummaryLine,
    anatomical_limits,
    compared_sides,
    findings,
    summary_lines,
)

BODY = SkeletonModel.default()
LABELS = ("Who", "What", "How good", "Careful", "Findings")
FINE = Headline(Grade.PASS, "checked, no problem found in image", ())
TIMES = np.arange(240) / 60
SENSORS = ("RightUpLeg", "LeftUpLeg", "RightLeg")


def summary(
    mode: str = "rtof", camera: bool = True, results: Any = None, cameras: int | None = None, **subject: Any
) -> Summary:
    inputs = {
        "subject": subject,
        "camera": {"width_px": 1920} if camera else None,
        "sensors": [{"name": name, "segment": name} for name in SENSORS],
    } | ({} if cameras is None else {"cameras": cameras})
    return Summary("walk", mode, "", Session(), inputs, results)


def lines(
    motion: Motion, overall: Headline = FINE, session: Session | None = None, **fields: Any
) -> dict[str, SummaryLine]:
    found = summary_lines(analyse(motion), summary(**fields), overall, session or Session())
    assert tuple(line.label for line in found) == LABELS
    assert all(line.text.endswith(".") for line in found)
    return {line.label: line for line in found}


def knees(right_deg: float, left_deg: float) -> Motion:
    """Both knees bend from zero by so many degrees, under a person who stands."""
    wave = 0.5 * (1 - np.cos(np.pi * TIMES))
    turns: dict[str, NDArray[np.float64]] = {}
    for side, most in (("right", right_deg), ("left", left_deg)):
        turns |= limb(side, ("shank", "foot"), so3.about_axis("y", np.radians(most) * wave))
    return BODY.motion(posture(BODY, len(TIMES), **turns))


def certain(motion: Motion, degrees: float) -> Motion:
    return replace(motion, confidence=certain_to(degrees, motion))


def found_in(analysis: MotionAnalysis) -> tuple[Finding, ...]:
    return findings(analysis, BODY.table, compared_sides(analysis))


def test_who_names_what_is_known_and_what_is_not() -> None:
    session = Session(subject="P07")
    known = lines(squatting(), session=session, height_m=1.8, mass_kg=72.5, sex="female")["Who"]
    assert known == SummaryLine("Who", "P07, 1.80 m, 72.5 kg, female.", None)
    partly = lines(squatting(), session=session, mass_kg=70.0)["Who"].text
    height = BODY.height
    assert partly == f"P07, 70 kg. Not given: height and sex (the model is {height:.2f} m tall)."
    assert lines(squatting())["Who"].text.startswith("Subject not named. Not given: height, weight and sex")


@pytest.mark.parametrize(
    ("motion", "text"),
    [
        (walking(6.0, speed=1.1), "Walking: 8 strides, 6.6 m forward, without turns."),
        (walking(6.0, treadmill=True), "Walking on the spot or on a treadmill: 8 strides."),
        (squatting(4), "4 bends of both knees (squats); no walking; staying in place, without turns."),
        (walking(2.4), "Walking: 2 strides, 2.6 m forward, without turns."),
        (walking(6.0, speed=-1.0), "Neither walking nor squats were recognised; 6.0 m backward, without turns."),
        (knees(40, 40), "Neither walking nor squats were recognised; staying in place, without turns."),
    ],
)
def test_what_is_done_is_named_as_far_as_it_is_recognised(motion: Motion, text: str) -> None:
    what = lines(motion)["What"].text
    seconds = motion.times[-1]
    sources = "from one camera and 3 sensors (both thighs, right shank)"
    assert what == f"{text} {seconds:.1f} s, {sources}."


def test_turning_in_place_is_told_in_degrees() -> None:
    still = np.tile([0.0, -0.78], (240, 1))
    motion = stepping(TIMES, {"right": still, "left": still}, heading=np.pi * (1 - np.cos(np.pi * TIMES / 4)))
    assert "staying in place, turning about 360° left." in lines(motion)["What"].text


@pytest.mark.parametrize(
    ("mode", "camera", "text"),
    [
        ("rto", True, "from one camera alone; 3 sensors recorded, but not used."),
        ("imu", True, "from 3 sensors (both thighs, right shank); the camera was not used."),
        ("imu", False, "from 3 sensors (both thighs, right shank), without a camera."),
    ],
)
def test_only_what_a_mode_uses_is_named_as_its_source(mode: str, camera: bool, text: str) -> None:
    assert lines(squatting(), mode=mode, camera=camera)["What"].text.endswith(text)


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        ("rtof", "from 2 cameras and 3 sensors (both thighs, right shank)."),
        ("rto", "from 2 cameras alone; 3 sensors recorded, but not used."),
        ("imu", "from 3 sensors (both thighs, right shank); the cameras were not used."),
    ],
)
def test_all_cameras_are_counted(mode: str, text: str) -> None:
    assert lines(squatting(), mode=mode, cameras=2)["What"].text.endswith(text)


def test_segments_with_sensors_are_named_in_words() -> None:
    own = summary()
    names = ("Hips", "Head", "LeftShoulder", "LeftFoot", "RightFoot")
    own = replace(own, inputs=own.inputs | {"sensors": [{"segment": name} for name in names]})
    motion = squatting()
    what = summary_lines(analyse(motion), own, FINE, Session())[1].text
    assert what.endswith("and 5 sensors (pelvis, head, left shoulder, both feet).")


def test_angles_that_turned_on_beyond_their_interval_have_no_finding() -> None:
    analysis = analyse(certain(knees(60, 60), 2.0))
    values = np.array(analysis.angles.values)
    values[120:, analysis.angles.names.index("left_knee_flexion")] -= 2 * np.pi
    turned = replace(analysis.angles, values=values)
    turned_on = replace(analysis, angles=turned, ranges=ranges_of_motion(turned))
    assert found_in(turned_on) == ()
    assert "whole turns" in next(r.why_not_comparable for r in turned_on.ranges if r.name == "left_knee_flexion")


def test_expected_accuracy_is_the_half_width_of_bands() -> None:
    good = lines(certain(knees(60, 60), 2.0))["How good"]
    half = round(2.0 * BAND_95)
    assert good.grade is Grade.PASS
    assert f"within ± {half}° (median 95 % band), from ± {half}° (" in good.text
    assert good.text.endswith("100 % of the positions of joints were observed.")
    error = AuditResult("truth", "mean error of knee and elbow flexion", "motion", 2.44, "deg")
    with_truth = lines(certain(knees(60, 60), 2.0), results=(error,))["How good"].text
    assert with_truth.endswith("Against the reference, knees and elbows are 2.4° off on average.")


def test_without_bands_neither_accuracy_nor_findings_are_stated() -> None:
    found = lines(knees(90, 30))
    assert found["How good"].text.startswith("The accuracy of the angles is not known")
    assert found["Findings"].text.startswith("None can be stated")


def test_findings_are_differences_that_exceed_their_bands() -> None:
    """Difference of a planted asymmetry: each of the four ends has 2 degrees."""
    found = lines(certain(knees(90, 60), 2.0))["Findings"].text
    assert found.startswith(
        f"Knee flexion: range 90° right, 60° left, that is 30 ± {BAND_95 * 4:.0f}° less on the left."
    )
    assert "No other difference is shown: 16 angles of the left and right were compared by their range" in found


def test_the_report_has_the_differences_of_the_sides_that_the_command_prints() -> None:
    motion = certain(knees(90, 60), 2.0)
    printed, _ = compare_sides(compared("a motion", motion))
    (changed,) = printed.changed
    assert (changed.name, changed.largest.measure) == ("knee_flexion", "range")
    found = compared_sides(analyse(motion))
    assert found is not None
    assert found.by == printed.by
    assert [
        [(one.name, one.verdict, one.changes[0].difference) for one in which.angles] for which in (found, printed)
    ] == [[(one.name, one.verdict, one.changes[0].difference) for one in printed.angles]] * 2


def test_no_difference_is_claimed_where_nothing_could_be_compared() -> None:
    text = lines(certain(knees(90, 60), 20.0))["Findings"].text
    assert text == (
        "Left and right were not compared: no angle is observed and reliable almost throughout on both sides."
    )


@pytest.mark.parametrize(("right", "left", "sigma"), [(60.0, 60.0, 2.0), (66.0, 60.0, 2.0), (64.0, 60.0, 0.2)])
def test_small_or_uncertain_differences_are_no_findings(right: float, left: float, sigma: float) -> None:
    found = lines(certain(knees(right, left), sigma))["Findings"].text
    assert found.startswith("No difference is shown: 16 angles of the left and right were compared")


def test_an_end_beyond_an_anatomical_limit_is_a_finding() -> None:
    limit = np.degrees(anatomical_limits(BODY.table)["right_knee_flexion"][1])
    motion = certain(knees(limit + 12, limit + 12), 2.0)
    (knee,) = found_in(analyse(motion))
    assert knee.subject == "right_knee"[6:]
    assert f"highest angle {limit + 12:.0f} ± 4°, beyond the anatomical limit of {limit:.0f}°" in knee.text
    assert knee.size == pytest.approx(6, rel=0.02)
    assert found_in(analyse(certain(knees(limit + 3, limit + 3), 2.0))) == ()


def test_limits_have_the_signs_of_the_clinical_angles() -> None:
    limits = anatomical_limits(BODY.table)
    for side in ("right", "left"):
        low, high = np.degrees(limits[f"{side}_knee_flexion"])
        assert -20 < low < 0 < 120 < high
        low, high = np.degrees(limits[f"{side}_hip_flexion"])
        assert -70 < low < 0 < 110 < high
    assert limits["right_hip_adduction"] == pytest.approx(limits["left_hip_adduction"])


def test_unobserved_and_unreliable_angles_have_no_finding() -> None:
    motion = certain(knees(90, 60), 2.0)
    assert found_in(analyse(motion))
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    observed = np.array(motion.poses.orientation_observed)
    for part in ("LeftLeg", "LeftFoot"):
        provenance[:40, BODY.index(part)[0]] = Provenance.PRIOR
        observed[:40, BODY.index(part)[0]] = False
    unseen = replace(motion.poses, provenance=provenance, orientation_observed=observed)
    assert found_in(analyse(replace(motion, poses=unseen))) == ()
    assert found_in(analyse(certain(knees(90, 60), 20.0))) == ()


def test_asymmetric_stance_of_gait_is_a_finding_only_if_it_is_gait() -> None:
    analysis = analyse(certain(walking(10.0), 2.0))
    assert found_in(analysis) == ()

    def limping(analysis: MotionAnalysis) -> MotionAnalysis:
        gait = analysis.gait
        sides = {side: dict(measures) for side, measures in gait.summary.items()}
        sides["right"]["stance_share"] = (0.60, 0.01, 4)
        sides["left"]["stance_share"] = (0.70, 0.02, 4)
        return replace(analysis, gait=replace(gait, summary=sides))

    (stance,) = found_in(limping(analysis))
    right, left = (np.hypot(sd / 2, EVENT_SIGMA) for sd in (0.01, 0.02))
    bands = [f"{100 * BAND_95 * sigma:.0f}" for sigma in (right, left)]
    assert stance.text == f"stance: 60 ± {bands[0]} % of the stride right, 70 ± {bands[1]} % left"
    assert stance.size == pytest.approx(0.10 / np.hypot(right, left))
    feet = dict(analysis.gait.events.feet)
    feet["left"] = replace(feet["left"], by_ankle=True)  # events of another kind are not compared
    unlike = replace(limping(analysis).gait, events=replace(analysis.gait.events, feet=feet))
    assert found_in(replace(analysis, gait=unlike)) == ()
    gait = limping(analysis).gait
    other = replace(gait, verdict=replace(gait.verdict, why_not="It is a dance."))
    assert found_in(replace(analysis, gait=other)) == ()


def test_careful_has_the_headline_in_words_and_what_is_unseen() -> None:
    text = (
        "left hip internal/external rotation (LeftUpLeg_z): beyond its anatomical limit, largest 37 deg; "
        "more warns in body"
    )
    warned = lines(knees(60, 60), overall=Headline(Grade.WARN, text, ()))["Careful"]
    assert warned.grade is None  # it is beside how good
    assert warned.text.startswith("Left hip internal/external rotation: beyond its anatomical limit, largest 37°.")
    assert lines(knees(60, 60))["Careful"] == SummaryLine("Careful", "No warning.", None)
    assert lines(certain(knees(60, 60), 2.0))["Careful"].text == (
        "Bands of shoulder plane of elevation and shoulder axial rotation are wider than ± 30°."
    )  # the arms hang, where neither is defined alone
    forearm = Headline(Grade.FAIL, "LeftForeArm: share of frames unseen 30 %", ())
    assert lines(knees(60, 60), overall=forearm)["Careful"].text.startswith("Left forearm: share")
    unaudited = Headline(Grade.NOT_CHECKED, "written without an audit: reconstruct again", ())
    assert lines(knees(60, 60), overall=unaudited)["Careful"] == SummaryLine(
        "Careful", "Written without an audit: reconstruct again.", None
    )
    ear = Headline(Grade.FAIL, "LeftEar: share of frames unseen 30 %", ())
    assert lines(knees(60, 60), overall=ear)["Careful"].text.startswith("Left ear: share")


def test_the_position_in_the_room_has_a_verdict_of_its_own() -> None:
    room = "position in the room not verified: ± 0.4 m, nothing in the recording verifies it"
    both = Headline(Grade.WARN, f"Hips: share of frames unseen 30 %; {room}", (), Grade.WEAK, room)
    found = summary_lines(analyse(knees(60, 60)), summary(), both, Session())
    assert [(line.label, line.grade) for line in found if line.grade] == [
        ("How good", Grade.WARN),
        ("Position in the room", Grade.WEAK),
    ]
    text = {line.label: line.text for line in found}
    assert text["Position in the room"] == "± 0.4 m, nothing in the recording verifies it."
    assert text["Careful"] == "Pelvis: share of frames unseen 30 %."


@pytest.mark.parametrize(
    ("technical", "plain"),
    [
        (
            "LeftFoot: share of frames unseen 30 % (above 10 %) at 2.1 s: occluded",
            "left foot: share of frames unseen 30 % at 2.1 s: occluded",
        ),
        ("It is at z = -0.41 m, by the body's size", "It is 0.41 m below height 0, by the body's size"),
        ("joints 30 %: interpolated, or from the prior", "joints 30 %: assumed, not measured"),
        (
            "joints relative to the root: error expected by the stated standard deviations, RMS 70 mm",
            "posture: expected error 70 mm",
        ),
        ("knee 12 deg/s and 3 deg; more fails in body, image", "knee 12°/s and 3°"),
        (
            "all landmarks: reprojection error, median 7 px",
            "all points of the body: distance of the body model from the image, median 7 px",
        ),
    ],
)
def test_sentences_of_the_audit_are_said_in_plain_words(technical: str, plain: str) -> None:
    assert plain_words(technical, angle_table(BODY.table)) == plain


def test_careful_names_unobserved_joints_and_bridged_gaps() -> None:
    motion = walk()
    observed = np.ones(len(motion.skeleton.names), dtype=bool)
    observed[motion.skeleton.index("RightFoot", "LeftFoot", "RightHand", "LeftHand")] = False
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[: len(motion.times) // 4] = Provenance.BRIDGED
    poses = replace(motion.poses, orientation_observed=observed, provenance=provenance)
    text = lines(replace(motion, poses=poses))["Careful"].text
    assert "Angles of both ankles and both wrists were not observed and are not shown." in text
    share = 100 * (len(motion.times) // 4) / len(motion.times)
    assert f"Gaps were bridged in {share:.0f} % of the frames." in text
