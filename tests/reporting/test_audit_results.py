"""Grades of audit results, their lines, and the verdicts on sections."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu_stream import FaultKind
from rtof_kin.reporting.audit_results import (
    CERTIFICATE,
    FAILED_FRAGMENTS,
    ROOM_BAND,
    SECTIONS,
    UNOBSERVED_FRAGMENTS,
    AuditResult,
    Grade,
    headline,
    section_verdict,
)

NUMBERS = st.one_of(st.floats(0, 100), st.just(math.nan))
LIMITS = st.one_of(st.floats(0, 100), st.just(math.inf))


def figure(value: float, at: float = math.nan, weak: bool = False) -> AuditResult:
    return AuditResult("image", "error", "Head", value, "px", 2.0, 5.0, "a source", "check it", at, weak)


@pytest.mark.parametrize(
    ("result", "grade"),
    [
        (figure(2.0), Grade.PASS),
        (figure(2.1), Grade.WARN),
        (figure(5.0), Grade.WARN),
        (figure(5.1), Grade.FAIL),
        (figure(math.nan), Grade.NOT_CHECKED),
        (figure(1.0, weak=True), Grade.WEAK),
        (figure(3.0, weak=True), Grade.WARN),
        (AuditResult("truth", "error", "motion", 1e9, "mm"), Grade.INFORMATION),
    ],
)
def test_figures_are_graded_by_their_limits(result: AuditResult, grade: Grade) -> None:
    assert result.grade is grade


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (figure(5.5, at=3.25), "Head: error 5.5 px (above 5 px) at 3.2 s: check it"),
        (figure(1.0, at=3.25), "Head: error 1 px"),
        (AuditResult.not_checked("gait", "strides", "nobody walks"), "strides: nobody walks"),
        (AuditResult.warning("gait", "gait", "not steady"), "gait: not steady"),
    ],
)
def test_a_line_has_subject_figure_limit_time_and_note(result: AuditResult, text: str) -> None:
    assert result.text == text


def test_unknown_sections_and_reversed_limits_are_rejected() -> None:
    with pytest.raises(InvalidInputError, match="'weather'"):
        AuditResult("weather", "error", "Head", 1.0, "px")
    with pytest.raises(InvalidInputError, match="fails above 2"):
        AuditResult("image", "error", "Head", 1.0, "px", 3.0, 2.0)


@given(NUMBERS, LIMITS, LIMITS, NUMBERS, st.booleans())
def test_results_survive_a_round_trip_through_json(value: float, a: float, b: float, at: float, weak: bool) -> None:
    limits = min(a, b), max(a, b)
    made = AuditResult("image", "error", "<Head>", value, "px", *limits, "source", "note", at, weak)
    plain = json.loads(json.dumps(made.plain(), allow_nan=False))
    assert repr(AuditResult.from_plain(plain)) == repr(made)  # NaN is not equal to itself


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"value": "much"}, "value is 'much', no number"),
        ({"value": True}, "value is 'True', no number"),
        ({"subject": 7}, "subject is '7', no text"),
        ({"note": None}, "note is 'None', no text"),
        ({"weak": "very"}, "weak is 'very'"),
    ],
)
def test_invalid_fields_are_rejected(change: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        AuditResult.from_plain(figure(1.0).plain() | change)
    with pytest.raises(InvalidInputError, match="no table"):
        AuditResult.from_plain(["a list"])


def test_a_section_has_the_worst_grade_and_lists_the_worst_first() -> None:
    verdict = section_verdict("image", [figure(1), figure(3), figure(9), figure(math.nan)])
    assert (verdict.grade, verdict.title) == (Grade.FAIL, SECTIONS["image"])
    assert "9 px (above 5 px)" in verdict.reasons[0]
    assert "3 px (above 2 px)" in verdict.reasons[1]
    assert len(verdict.reasons) == 3
    assert section_verdict("image", [figure(1)]).reasons == ()
    assert section_verdict("image", [figure(1), figure(1, weak=True)]).grade is Grade.WEAK


def test_a_section_without_figures_is_not_checked() -> None:
    assert section_verdict("gait", [figure(1)]).reasons == ("nothing was checked",)
    verdict = section_verdict("gait", [AuditResult.not_checked("gait", "strides", "two seconds")])
    assert (verdict.grade, verdict.reasons) == (Grade.NOT_CHECKED, ("strides: two seconds",))


def test_many_reasons_are_counted_and_similar_ones_merged() -> None:
    warnings = [AuditResult.warning("image", "camera", f"reason {i}") for i in range(9)]
    verdict = section_verdict("image", warnings, most=4)
    assert (len(verdict.reasons), verdict.reasons[-1]) == (5, "and 5 more in the audit")
    hand = AuditResult("image", "error", "Hand", 4.0, "px", 2.0, 5.0)
    (line,) = section_verdict("image", [figure(3), hand, figure(1)]).reasons
    assert line == "Hand: error 4 px (above 2 px); also Head"


GOOD = AuditResult("image", "error", "Head", 1.0, "px", 2.0, 5.0)
OFF = AuditResult("image", "error", "Foot", 50.0, "px", 2.0, 5.0, note="the camera is off")
LOOSE = AuditResult("sensors", "residual", "LeftLeg", 3.0, "deg", 2.0, 5.0, note="mounting")
LOST = AuditResult("solver", UNOBSERVED_FRAGMENTS, "all", 10.0, "%", 0.0, 50.0, note="the prior alone.")
GONE = AuditResult("solver", FAILED_FRAGMENTS, "all", 20.0, "%", 0.0, 10.0, note="gave up.")
FOCAL = AuditResult(
    "inputs",
    "height in the picture",
    "camera",
    0.2,
    "1",
    0.1,
    0.1,
    "limit of the check",
    "the focal length is too short: compare it with the camera's file",
)
WARNING = AuditResult.warning("streams", "motion", "two sensors are exchanged")
FAULT = AuditResult("streams", "fault, duration", "LeftLeg", 2.0, "s", -1.0, note="it stuck", at=1.0)
UNKNOWN = AuditResult.not_checked("inputs", "camera", "the person does not move", "distance")
TRUTH = AuditResult("truth", "error", "motion", 20.0, "mm")
PREDICTED = AuditResult(CERTIFICATE, "error of a left-out sensor", "LeftLeg", 4.0, "deg", 6.0, 12.0)
LONE = AuditResult.not_checked(CERTIFICATE, "motion", "a camera alone proves no angle: add a sensor")
WEAK = AuditResult.remark("calibration", "30 quantities", "1 observed, 29 weakly observed", weak=True)


def test_contradicted_inputs_come_first_with_their_likely_cause() -> None:
    found = headline([OFF, LOST, GONE, LOOSE, FOCAL, GOOD])
    assert found.grade is Grade.FAIL
    assert found.line.startswith("fail: the focal length is too short")
    assert "camera: height in the picture 0.2 1, above 0.1 1" in found.text
    assert "more fails in image, solver; more warns in solver, sensors" in found.text
    assert "\n" not in found.line


def test_of_several_contradicted_inputs_the_first_leads_as_they_are_in_the_order_of_cause() -> None:
    tilted = replace(FOCAL, value=0.11, note="the references are tilted: calibrate")
    assert headline([tilted, FOCAL]).line.startswith("fail: the references are tilted")


@pytest.mark.parametrize(
    ("results", "grade", "text"),
    [
        ([OFF, LOOSE, LOST, GONE], Grade.FAIL, "gave up"),
        ([OFF, LOOSE, LOST], Grade.FAIL, "the prior alone"),
        ([LOOSE, WARNING, OFF], Grade.FAIL, "the camera is off"),
        ([LOOSE, FAULT, WARNING], Grade.WARN, "LeftLeg, 1.0 to 3.0 s: it stuck"),
        ([LOOSE, WARNING], Grade.WARN, "motion: two sensors are exchanged"),
        ([GOOD, LOOSE], Grade.WARN, "LeftLeg: residual 3 deg (above 2 deg): mounting"),
    ],
)
def test_lost_frames_come_before_failures_and_these_before_warnings(
    results: list[AuditResult], grade: Grade, text: str
) -> None:
    found = headline(results)
    assert found.grade is grade
    assert text in found.text.split(";")[0]


def test_without_warnings_it_lists_what_was_checked_and_what_was_not() -> None:
    found = headline([UNKNOWN, GOOD, WEAK, PREDICTED])
    assert found.grade is Grade.PASS
    for part in (
        "found in image, certificate;",
        "calibration: 30 quantities: 1 observed, 29 weakly observed",
        "not checked: camera: distance: the person does not move",
        "no reference",
    ):
        assert part in found.text
    assert "no reference" not in headline([UNKNOWN, GOOD, WEAK, TRUTH]).text


@pytest.mark.parametrize(
    ("proof", "grade"),
    [
        ((), Grade.PLAUSIBLE),
        ((LONE,), Grade.PLAUSIBLE),
        ((PREDICTED,), Grade.PASS),
        ((LONE, PREDICTED), Grade.PASS),
        ((replace(PREDICTED, value=7.0), TRUTH), Grade.WARN),
        ((LONE, TRUTH), Grade.PASS),
        ((LONE, replace(TRUTH, value=math.nan)), Grade.PLAUSIBLE),
    ],
)
def test_a_reconstruction_passes_only_with_left_out_sensors_or_a_reference(
    proof: tuple[AuditResult, ...], grade: Grade
) -> None:
    found = headline([GOOD, *proof])
    assert found.grade is grade
    assert ("not proven: " in found.text) == bool(found.not_proven) == (grade is Grade.PLAUSIBLE)


def test_a_plausible_headline_says_what_would_prove_it_and_nothing_of_that_twice() -> None:
    found = headline([UNKNOWN, GOOD, LONE, replace(LONE, note="another")])
    assert found.line == (
        "plausible: checked, no problem found in image; not proven: a camera alone proves no angle: add a sensor; "
        "not checked: camera: distance: the person does not move"
    )
    assert found.not_proven == LONE.note
    assert found.plain()["sections"] == {"inputs": "not checked", "image": "pass", "certificate": "not checked"}
    assert headline([LONE, OFF]).line.startswith("fail: Foot")
    assert headline([UNKNOWN, LONE]).grade is Grade.NOT_CHECKED
    assert f"motion: {LONE.note}" in headline([UNKNOWN, LONE]).text


def test_markers_and_a_calibration_need_no_proof() -> None:
    fit = AuditResult("body", "residual of the markers, RMS", "body", 8.0, "mm", 15.0, 30.0)
    assert headline([fit]).grade is Grade.PASS
    assert headline([replace(GOOD, section="calibration")]).grade is Grade.PASS


def test_without_a_check_there_is_no_pass() -> None:
    assert headline([]).grade is Grade.NOT_CHECKED
    assert headline([UNKNOWN]).grade is Grade.NOT_CHECKED
    assert headline([WEAK]).grade is Grade.WEAK


def test_the_summary_has_grade_headline_and_sections() -> None:
    plain = json.loads(json.dumps(headline([GOOD, LOOSE]).plain()))
    assert plain["grade"] == "warn"
    assert plain["headline"].startswith("LeftLeg")
    assert plain["sections"] == {"image": "pass", "sensors": "warn"}


BAND = AuditResult("room", ROOM_BAND, "position", 1.1, "m", note="the focal length is not checked", weak=True)
LENS = AuditResult(
    "room", "height of the ankle", "the person", 0.4, "m", 0.2, 0.2, note="the lens is higher: measure it"
)


def test_angles_pass_apart_from_a_position_in_the_room_that_nobody_verified() -> None:
    assert headline([GOOD, BAND]).line.startswith("plausible for the angles; position in the room not verified: ± 1.1")
    found = headline([GOOD, BAND, PREDICTED])
    assert found.line.startswith(
        "pass for the angles; position in the room not verified: ± 1.1 m, the focal length is not checked; "
    )
    assert (found.grade, found.room) == (Grade.PASS, Grade.WEAK)
    assert found.plain()["room"] == {"grade": "weakly observed", "text": found.room_text}


def test_a_contradicted_position_in_the_room_does_not_fail_the_angles_but_leads() -> None:
    found = headline([GOOD, LENS, BAND, PREDICTED])
    assert found.line.startswith("pass for the angles; position in the room fails: the lens is higher")
    assert (found.grade, found.room) == (Grade.PASS, Grade.FAIL)
    assert headline([LOOSE, LENS]).line.startswith("warn: position in the room fails: the lens is higher")
    declared = headline([FOCAL, LENS]).line
    assert declared.startswith("fail: the focal length is too short")
    assert "position in the room fails: the lens is higher" in declared


def test_sides_that_may_be_exchanged_for_a_moment_lead_before_nothing() -> None:
    note = FaultKind.SIDES_IN_DOUBT.value
    sides = AuditResult("streams", FAULT.name, "keypoints of legs", 0.5, "s", 0.15, note=note, at=6.6)
    other = AuditResult.warning("streams", "motion", "the sensors are 52 ± 6 ms late; corrected")
    unseen = AuditResult("streams", "share of frames unseen", "LeftForeArm", 12.0, "%", 10.0, 90.0)
    assert "52 ± 6 ms late" in headline((sides, other)).text
    assert headline((sides, unseen)).text.startswith("LeftForeArm")
    assert "may be exchanged" in headline((sides,)).text
