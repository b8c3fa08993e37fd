"""Headline of a report: overall grade and most serious result of its audit.

A declared input that the recording contradicts comes first, then frames without a measurement, then other
failures, then warnings. Without any of these, the headline lists what was checked and what was not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from rtof_kin.report.audit_results import (
    FAILED_FRAGMENTS,
    FAULT,
    SECTIONS,
    UNOBSERVED_FRAGMENTS,
    AuditResult,
    Grade,
    SectionVerdict,
    result_lines,
    section_verdict,
)

_LONG: Final = 0.45
"""[s] Faults of a stream from which they lead the warnings; shorter ones are repaired."""
_NAMED: Final = 3  # largest number of unchecked things that are named


@dataclass(frozen=True)
class Headline:
    """Overall verdict of an audit."""

    grade: Grade
    """FAIL or WARN if any result does; else PASS if any passes."""
    text: str
    """One line, without the grade."""
    sections: tuple[SectionVerdict, ...]

    @property
    def line(self) -> str:
        """Grade and text."""
        return f"{self.grade.value}: {self.text}"

    def plain(self) -> dict[str, Any]:
        """Return the headline as JSON data."""
        return {
            "grade": self.grade.value,
            "headline": self.text,
            "sections": {verdict.section: verdict.grade.value for verdict in self.sections},
        }


def headline(results: Sequence[AuditResult]) -> Headline:
    """Return the overall grade and the headline of an audit.

    Args:
        results: of `rtof_kin.report.audit`, or of some of its sections.
    """
    present = {result.section for result in results}
    sections = tuple(section_verdict(section, results) for section in SECTIONS if section in present)
    wrong = [result for result in results if result.grade in (Grade.FAIL, Grade.WARN)]
    if not wrong:
        return _without_warnings(sections, results)
    worst = max(wrong, key=_severity)  # the first of equal ones
    text = worst.text
    if worst.section == "inputs" and worst.note:  # the likely cause, then the figure
        limit = f"{worst.fail:.3g} {worst.unit}".rstrip()
        figure = f"{worst.subject}: {worst.name} {worst.value:.3g} {worst.unit}".rstrip()
        text = f"{worst.note.rstrip('.')} ({figure}, above {limit})"
    text = text.rstrip(".")
    for grade, verb in ((Grade.FAIL, "fails"), (Grade.WARN, "warns")):
        others = (result for result in wrong if result is not worst and result.grade is grade)
        if where := dict.fromkeys(result.section for result in others):
            text += f"; more {verb} in {', '.join(where)}"
    grade = Grade.FAIL if any(result.grade is Grade.FAIL for result in wrong) else Grade.WARN
    return Headline(grade, text, sections)


def _severity(result: AuditResult) -> tuple[bool, bool, bool, bool, float]:
    """Sort key of failures and warnings; faults and what is said in words come before figures."""
    fails = result.grade is Grade.FAIL
    limit = result.fail if fails else result.warn
    named = fails and result.section == "inputs"  # they are in the order of cause
    return (
        named,
        result.name in (FAILED_FRAGMENTS, UNOBSERVED_FRAGMENTS),
        fails,
        not result.name or (result.name == FAULT and result.value > _LONG),
        0.0 if named else result.value / limit if limit > 0 else math.inf,
    )


def _without_warnings(sections: tuple[SectionVerdict, ...], results: Sequence[AuditResult]) -> Headline:
    """Headline of what was checked, what is weakly observed, and what could not be checked."""
    checked = [verdict.section for verdict in sections if verdict.grade is Grade.PASS]
    weak = [f"{v.section}: {v.reasons[0]}" for v in sections if v.grade is Grade.WEAK]
    unknown = list(result_lines(results, Grade.NOT_CHECKED))
    if checked and not any(result.section == "truth" for result in results):
        unknown.append("the error itself: there is no reference")
    more = f" and {len(unknown) - _NAMED} more" if len(unknown) > _NAMED else ""
    parts = [f"checked, no problem found in {', '.join(checked)}"] if checked else []
    parts += weak
    parts += [f"not checked: {'; '.join(unknown[:_NAMED])}{more}"] if unknown else []
    grade = Grade.PASS if checked else Grade.WEAK if weak else Grade.NOT_CHECKED
    return Headline(grade, "; ".join(parts), sections)
