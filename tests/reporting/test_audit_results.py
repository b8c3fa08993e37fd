"""Grades of audit results, their lines, and the verdicts on sections."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.reporting.audit_results import SECTIONS, AuditResult, Grade, section_verdict

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
