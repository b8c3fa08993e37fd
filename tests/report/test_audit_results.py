"""Figures against limits, and what a section's figures come to."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtof_kin.core.errors import ShapeError
from rtof_kin.report.audit_results import SECTIONS, Finding, Grade, section_verdict

NUMBERS = st.one_of(st.floats(0, 100), st.just(math.nan))
LIMITS = st.one_of(st.floats(0, 100), st.just(math.inf))


def finding(value: float, section: str = "image", **more: object) -> Finding:
    given = (section, "error", "Head", value, "px", 2.0, 5.0, "a source", "check it")
    return Finding(*given, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("value", "grade"),
    [(2.0, Grade.PASS), (2.1, Grade.WARN), (5.0, Grade.WARN), (5.1, Grade.FAIL), (math.nan, Grade.UNTOLD)],
)
def test_a_figure_is_graded_by_its_limits(value: float, grade: Grade) -> None:
    assert finding(value).grade is grade


def test_without_a_limit_a_figure_is_for_information() -> None:
    assert Finding("truth", "error", "motion", 1e9, "mm").grade is Grade.INFORMATION


def test_a_line_says_what_where_when_and_what_it_may_mean() -> None:
    text = finding(5.5, at=3.25).text
    assert text == "Head: error 5.5 px (above 5 px) at 3.2 s: check it"
    assert finding(1.0, at=3.25).text == "Head: error 1 px"
    assert Finding.untold("gait", "strides", "nobody walks").text == "strides: nobody walks"
    assert Finding.doubt("gait", "gait", "no steady walking").text == "gait: no steady walking"


def test_a_value_that_the_data_hardly_tell_does_not_pass() -> None:
    weak = finding(1.0, weak=True)
    assert weak.grade is Grade.WEAK
    assert finding(3.0, weak=True).grade is Grade.WARN
    assert section_verdict("image", [finding(1.0), weak]).grade is Grade.WEAK


def test_unknown_sections_and_limits_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(ShapeError, match="no section 'weather'; there are inputs"):
        Finding("weather", "error", "Head", 1.0, "px")
    with pytest.raises(ShapeError, match="error: it fails above 2, but warns above 3"):
        Finding("image", "error", "Head", 1.0, "px", 3.0, 2.0)


@given(NUMBERS, LIMITS, LIMITS, NUMBERS, st.booleans())
def test_plain_data_come_back_through_json(value: float, a: float, b: float, at: float, weak: bool) -> None:
    limits = min(a, b), max(a, b)
    made = Finding("image", "error", "<Head>", value, "px", *limits, "source", "note", at, weak)
    plain = json.loads(json.dumps(made.plain(), allow_nan=False))
    assert repr(Finding.from_plain(plain)) == repr(made)  # NaN equals itself by its name


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
def test_what_is_no_finding_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        Finding.from_plain(finding(1.0).plain() | change)
    with pytest.raises(ShapeError, match="no table"):
        Finding.from_plain(["a list"])


def test_a_section_is_as_good_as_its_worst_figure_and_says_the_worst_first() -> None:
    verdict = section_verdict("image", [finding(1), finding(3), finding(9), finding(math.nan)])
    assert (verdict.grade, verdict.title) == (Grade.FAIL, SECTIONS["image"])
    assert "9 px (above 5 px)" in verdict.reasons[0]
    assert "3 px (above 2 px)" in verdict.reasons[1]
    assert len(verdict.reasons) == 3
    assert section_verdict("image", [finding(1)]).reasons == ()


def test_a_section_of_which_nothing_could_be_told_is_not_told() -> None:
    assert section_verdict("gait", [finding(1)]).reasons == ("nothing was checked",)
    verdict = section_verdict("gait", [Finding.untold("gait", "strides", "two seconds")])
    assert (verdict.grade, verdict.reasons) == (Grade.UNTOLD, ("strides: two seconds",))


def test_more_reasons_than_anyone_reads_are_counted() -> None:
    doubts = [Finding.doubt("image", "camera", f"reason {i}") for i in range(9)]
    verdict = section_verdict("image", doubts, most=4)
    assert len(verdict.reasons) == 5
    assert verdict.reasons[-1] == "and 5 more in the audit"


def test_of_many_alike_the_worst_stands_for_all() -> None:
    hand = Finding("image", "error", "Hand", 4.0, "px", 2.0, 5.0)
    (line,) = section_verdict("image", [finding(3), hand, finding(1)]).reasons
    assert line == "Hand: error 4 px (above 2 px); also Head"
