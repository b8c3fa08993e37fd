"""Headline of a report: verdicts on angles and pose, and apart from them on the position in the room, each
with its most serious result.

A declared input that the recording contradicts comes first, then frames without a measurement, then other
failures, then warnings. Without any of these, the headline lists what was checked and what was not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from rtof_kin.data.imu_stream import FaultKind
from rtof_kin.reporting.audit_results import (
    FAILED_FRAGMENTS,
    FAULT,
    ROOM,
    ROOM_BAND,
    SECTIONS,
    UNOBSERVED_FRAGMENTS,
    AuditResult,
    Grade,
    SectionVerdict,
    result_lines,
    section_verdict,
)

_NAMED: Final = 3  # largest number of unchecked things that are named
_ALONE: Final = "for the angles; "
"""Beginning of the text where the angles pass and the position in the room does not."""
_ROOM: Final = {
    Grade.FAIL: "fails",
    Grade.WARN: "uncertain",
    Grade.WEAK: "not verified",
    Grade.NOT_CHECKED: "not checked",
}


@dataclass(frozen=True)
class Headline:
    """Overall verdicts of an audit."""

    grade: Grade
    """Of angles and pose relative to the root: FAIL or WARN if any result does; else PASS if any passes."""
    text: str
    """One line about both, without the grade."""
    sections: tuple[SectionVerdict, ...]
    room: Grade | None = None
    """Of the position in the room; None where nothing is said about it."""
    room_text: str = ""
    """The sentence about the position in the room, a part of `text`."""

    @property
    def line(self) -> str:
        """Grade and text."""
        return f"{self.grade.value}{' ' if self.text.startswith(_ALONE) else ': '}{self.text}"

    def plain(self) -> dict[str, Any]:
        """Return the headline as JSON data."""
        room = None if self.room is None else {"grade": self.room.value, "text": self.room_text}
        return {
            "grade": self.grade.value,
            "headline": self.text,
            "sections": {verdict.section: verdict.grade.value for verdict in self.sections},
            "room": room,
        }


def headline(results: Sequence[AuditResult]) -> Headline:
    """Return the overall grades and the headline of an audit.

    Args:
        results: of `rtof_kin.reporting.audit`, or of some of its sections.
    """
    present = {result.section for result in results}
    sections = tuple(section_verdict(section, results) for section in SECTIONS if section in present)
    of_room = next((verdict.grade for verdict in sections if verdict.section == ROOM), None)
    if of_room is Grade.INFORMATION:
        of_room = None
    room = "" if of_room is None else _room_text(of_room, [r for r in results if r.section == ROOM])
    about = [result for result in results if result.section != ROOM]
    wrong = [result for result in about if result.grade in (Grade.FAIL, Grade.WARN)]
    if not wrong:
        of_angles = tuple(verdict for verdict in sections if verdict.section != ROOM)
        grade, text = _without_warnings(of_angles, about)
        both = "; ".join(part for part in (room, text) if part)
        alone = _ALONE if grade is Grade.PASS and of_room not in (None, Grade.PASS) else ""
        return Headline(grade, alone + both, sections, of_room, room)
    grade = Grade.FAIL if any(result.grade is Grade.FAIL for result in wrong) else Grade.WARN
    worst = max(wrong, key=_severity)  # the first of equal ones
    text = _words(worst).rstrip(".")
    for of, verb in ((Grade.FAIL, "fails"), (Grade.WARN, "warns")):
        others = (result for result in wrong if result is not worst and result.grade is of)
        if where := dict.fromkeys(result.section for result in others):
            text += f"; more {verb} in {', '.join(where)}"
    declared = worst.section == "inputs" and worst.grade is Grade.FAIL
    parts = (room, text) if of_room is Grade.FAIL and not declared else (text, room)  # causes lead
    return Headline(grade, "; ".join(part for part in parts if part), sections, of_room, room)


def _room_text(grade: Grade, results: Sequence[AuditResult]) -> str:
    """Sentence about the position in the room: a contradiction, or how far off it may be and why."""
    words = [f"position in the room {_ROOM.get(grade, '')}".rstrip()]
    band = next((r for r in results if r.name == ROOM_BAND), None)
    wrong = [result for result in results if result.grade in (Grade.FAIL, Grade.WARN) and result is not band]
    if wrong:
        words.append(f": {_words(max(wrong, key=_severity)).rstrip('.')}")
    elif band is not None:
        size = f"± {band.value:.2g} {band.unit}" if math.isfinite(band.value) else ""
        words.append((" " if grade is Grade.PASS else ": ") + ", ".join(p for p in (size, band.note) if p))
    return "".join(words)


def _words(result: AuditResult) -> str:
    """The likely cause, then the figure, of a declared input; else the result's line."""
    if result.section not in ("inputs", ROOM) or not result.note:
        return result.text
    limit = f"{result.fail:.3g} {result.unit}".rstrip()
    figure = f"{result.subject}: {result.name} {result.value:.3g} {result.unit}".rstrip()
    return f"{result.note.rstrip('.')} ({figure}, above {limit})"


def _severity(result: AuditResult) -> tuple[bool, bool, bool, bool, float]:
    """Sort key of failures and warnings; faults and what is said in words come before figures. That sides may
    be exchanged for a moment, as in most recordings with a real detector, comes last.
    """
    fails = result.grade is Grade.FAIL
    limit = result.fail if fails else result.warn
    named = fails and result.section in ("inputs", ROOM)  # they are in the order of cause
    usual = result.note == FaultKind.SIDES_IN_DOUBT.value
    return (
        named,
        result.name in (FAILED_FRAGMENTS, UNOBSERVED_FRAGMENTS),
        fails,
        result.name in ("", FAULT) and not usual,
        0.0 if named or usual else result.value / limit if limit > 0 and result.name != FAULT else math.inf,
    )


def _without_warnings(sections: tuple[SectionVerdict, ...], results: Sequence[AuditResult]) -> tuple[Grade, str]:
    """Grade and words of what was checked, what is weakly observed, and what could not be checked."""
    checked = [verdict.section for verdict in sections if verdict.grade is Grade.PASS]
    weak = [f"{v.section}: {v.reasons[0]}" for v in sections if v.grade is Grade.WEAK]
    unknown = list(result_lines(results, Grade.NOT_CHECKED))
    if checked and not any(result.section == "truth" for result in results):
        unknown.append("the error itself: there is no reference")
    more = f" and {len(unknown) - _NAMED} more" if len(unknown) > _NAMED else ""
    parts = [f"checked, no problem found in {', '.join(checked)}"] if checked else []
    parts += weak
    parts += [f"not checked: {'; '.join(unknown[:_NAMED])}{more}"] if unknown else []
    return Grade.PASS if checked else Grade.WEAK if weak else Grade.NOT_CHECKED, "; ".join(parts)
