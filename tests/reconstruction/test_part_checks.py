"""Checks of the parts of a recording become one, which neither cries wolf nor hides a lasting fault."""

from __future__ import annotations

import pytest

from rtof_kin.core.checks import Check
from rtof_kin.reconstruction.part_results import PartFindings, joined_checks, joined_warnings


def parts(*values: float, warnings: dict[int, str] | None = None) -> list[PartFindings]:
    """One check with limit 1 in each part of a minute."""
    return [
        PartFindings(
            60.0 * i,
            (Check("tilt", "camera", value, 1.0, "deg", "Level it", cause="it fell"),),
            (warnings[i],) if warnings and i in warnings else (),
        )
        for i, value in enumerate(values)
    ]


def test_a_single_part_keeps_its_findings() -> None:
    (own,) = parts(2.0, warnings={0: "dark"})
    assert joined_checks([own]) == own.checks
    assert joined_warnings([own]) == own.warnings


def test_a_check_fails_where_half_of_the_parts_do() -> None:
    (check,) = joined_checks(parts(0.2, 3.0, 2.0, 0.1))
    assert check.failed
    assert "2 of 4 parts" in check.advice
    assert joined_warnings(parts(0.2, 3.0, 2.0, 0.1)) == ()  # the check says so itself


def test_one_failure_of_many_is_chance_but_two_neighbours_are_named() -> None:
    alone = parts(*[0.1] * 10, 5.0, *[0.2] * 10)
    (check,) = joined_checks(alone)
    assert check.passed
    assert joined_warnings(alone) == ()
    (text,) = joined_warnings(parts(*[0.1] * 10, 5.0, 4.0, *[0.2] * 10))
    assert "2 of 22 parts" in text
    assert "from 600 s" in text
    assert "it fell" in text


def test_failures_beyond_chance_are_named_though_apart() -> None:
    assert len(joined_warnings(parts(*[5.0, 0.1, 0.1, 0.1, 0.1] * 4))) == 1


def test_unknown_parts_do_not_vote_and_a_single_one_does_not_decide() -> None:
    nan = float("nan")
    (check,) = joined_checks(parts(nan, 3.0, 2.0))
    assert check.failed
    alone = parts(nan, nan, 2.0)
    (check,) = joined_checks(alone)
    assert not check.failed
    assert "1 of 3 parts only" in check.advice
    assert "it fell" in joined_warnings(alone)[0]
    (check,) = joined_checks(parts(nan, nan))
    assert not check.failed
    assert not check.passed


@pytest.mark.parametrize("count", [1, 3])
def test_equal_warnings_are_given_once(count: int) -> None:
    found = joined_warnings(parts(0.1, 0.1, 0.1, 0.1, warnings=dict.fromkeys(range(count), "dark")))
    assert len(found) == 1
    assert found[0].startswith("dark")
    assert ("3 of 4 parts, first from 0 s" in found[0]) == (count == 3)
