"""The first line that a user reads of a reconstruction, made from the findings of its audit alone.

The most serious thing comes first: something declared that the recording contradicts, then frames that no
measurement made, then what else fails, then what warns. Where there is none of these, the line says what
was checked, and what could not be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtof_kin.report.audit_results import (
    FAILED_FRAGMENTS,
    SECTIONS,
    UNOBSERVED_FRAGMENTS,
    Finding,
    Grade,
    SectionVerdict,
    finding_lines,
    section_verdict,
)

_NAMED = 3
"""So many things that could not be checked are named."""


@dataclass(frozen=True)
class Headline:
    """What an audit comes to as a whole."""

    grade: Grade
    """FAIL or WARN where anything does; else PASS where anything was checked and found right."""
    text: str
    """One line, without the grade."""
    sections: tuple[SectionVerdict, ...]
    """Verdicts on the sections that the audit has."""

    @property
    def line(self) -> str:
        """Grade and text."""
        return f"{self.grade.value}: {self.text}"

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "grade": self.grade.value,
            "headline": self.text,
            "sections": {verdict.section: verdict.grade.value for verdict in self.sections},
        }


def headline(findings: Sequence[Finding]) -> Headline:
    """Overall grade and first line of an audit.

    Args:
        findings: of `rtof_kin.report.audit`, or of some of its sections.
    """
    present = {finding.section for finding in findings}
    sections = tuple(section_verdict(section, findings) for section in SECTIONS if section in present)
    wrong = [finding for finding in findings if finding.grade in (Grade.FAIL, Grade.WARN)]
    if not wrong:
        return _nothing_found(sections, findings)
    worst = max(wrong, key=_severity)  # the first of several alike
    others = [finding for finding in wrong if finding is not worst]
    text = _declared_wrongly(worst) if _is_declared(worst) else worst.text
    grade = Grade.FAIL if any(finding.grade is Grade.FAIL for finding in wrong) else Grade.WARN
    return Headline(grade, text.rstrip(".") + _beside(others), sections)


def _severity(finding: Finding) -> tuple[bool, bool, bool, bool, float]:
    """What ranks findings that fail or warn. What is told in words tells more than a figure."""
    fails = finding.grade is Grade.FAIL
    limit = finding.fail if fails else finding.warn
    return (
        fails and _is_declared(finding),
        finding.name in (FAILED_FRAGMENTS, UNOBSERVED_FRAGMENTS),
        fails,
        not finding.name,
        finding.value / limit if limit > 0 else math.inf,
    )


def _is_declared(finding: Finding) -> bool:
    return finding.section == "inputs"


def _declared_wrongly(finding: Finding) -> str:
    """The likely cause, then the figure that shows it."""
    limit = f"{finding.fail:.3g} {finding.unit}".rstrip()
    figure = f"{finding.subject}: {finding.name} {finding.value:.3g} {finding.unit}".rstrip()
    return f"{finding.note.rstrip('.')} ({figure}, above {limit})" if finding.note else finding.text


def _beside(others: Sequence[Finding]) -> str:
    """Where else something fails or warns."""
    parts = []
    for grade, verb in ((Grade.FAIL, "fails"), (Grade.WARN, "warns")):
        where = dict.fromkeys(finding.section for finding in others if finding.grade is grade)
        if where:
            parts.append(f"more {verb} in {', '.join(where)}")
    return "".join(f"; {part}" for part in parts)


def _nothing_found(sections: tuple[SectionVerdict, ...], findings: Sequence[Finding]) -> Headline:
    """What was checked, what the data hardly tell, and what nobody could check."""
    checked = [verdict.section for verdict in sections if verdict.grade is Grade.PASS]
    weak = [f"{v.section}: {v.reasons[0]}" for v in sections if v.grade is Grade.WEAK]
    unknown = list(finding_lines(findings, Grade.UNTOLD))
    if checked and not any(finding.section == "truth" for finding in findings):
        unknown.append("the error itself: no truth is known")
    more = f" and {len(unknown) - _NAMED} more" if len(unknown) > _NAMED else ""
    parts = [f"checked, nothing found in {', '.join(checked)}"] if checked else []
    parts += weak
    parts += [f"not checked: {'; '.join(unknown[:_NAMED])}{more}"] if unknown else []
    grade = Grade.PASS if checked else Grade.WEAK if weak else Grade.UNTOLD
    return Headline(grade, "; ".join(parts), sections)
