"""Results of an audit: figures graded against limits, and the verdict on each section.

**Headline.** Headline of a report: verdicts on angles and pose, and apart from them on the position in the room, each
with its most serious result.

A declared input that the recording contradicts comes first, then frames without a measurement, then other
failures, then warnings. Without any of these, the headline lists what was checked and what was not. Agreement alone
is plausible; a reconstruction passes where left-out sensors were predicted, or where a reference was compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from enum import Enum
from typing import Any, Final, Self

from rtof_kin.core.checks import some
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu_stream import FaultKind

SECTIONS: Final = {
    "inputs": "Declared inputs",
    "streams": "Recorded data",
    "image": "Agreement with the image",
    "sensors": "Agreement with the sensors",
    "body": "Body model",
    "calibration": "Calibration from the recording",
    "solver": "Solver",
    "confidence": "Uncertainty of the motion",
    "room": "Position in the room",
    "certificate": "Left-out sensors",
    "truth": "Error against the reference",
    "angles": "Joint angles",
    "gait": "Gait",
    "torques": "Joint torques",
}
"""Sections of an audit, and their titles. All but the room are about the angles and the pose relative to the
root, which one can use without the position in the room."""
ROOM: Final = "room"
CERTIFICATE: Final = "certificate"
ROOM_BAND: Final = "half width of the 95 % band"
"""Name of the figure that states how far off the position in the room may be."""
FAILED_FRAGMENTS: Final = "share of fragments that failed"
UNOBSERVED_FRAGMENTS: Final = "share of fragments in which nothing was seen"
FAULT: Final = "fault, duration"
"""Names of the figures about frames without a measurement, as they are stored in summary.json."""
_NAMED: Final = 5  # largest number of similar results that are named beside the worst


class Grade(Enum):
    """Grade of a figure or a section."""

    PASS = "pass"
    PLAUSIBLE = "plausible"  #: Of a headline alone: nothing contradicts the reconstruction, and nothing proves it
    WARN = "warn"
    FAIL = "fail"
    WEAK = "weakly observed"  #: Within its limits, but hardly observable from the data: not a pass
    NOT_CHECKED = "not checked"
    INFORMATION = "for information"


WORST_FIRST: Final = (Grade.FAIL, Grade.WARN, Grade.WEAK, Grade.PASS, Grade.INFORMATION, Grade.NOT_CHECKED)
"""A section has the first of these grades that its figures have."""


@dataclass(frozen=True)
class AuditResult:
    """One figure graded against its limits, where larger is worse; or a remark in words."""

    section: str  #: One of `SECTIONS`
    name: str  #: Name of the figure; '' if the note is the whole result
    subject: str  #: A landmark, a sensor, an angle or the whole
    value: float  #: NaN if it could not be computed; then `note` gives the reason
    unit: str  #: Unit of the value and its limits; '' for none
    warn: float = math.inf  #: The figure warns above this limit; infinite for a figure without limits
    fail: float = math.inf  #: The figure fails above this limit
    source: str = ""
    note: str = ""  #: Possible cause of a value above its limits, or why there is no value
    at: float = math.nan  #: [s] time of the worst value; NaN if not applicable
    weak: bool = False  #: Whether the value is hardly observable from the data

    def __post_init__(self) -> None:
        if self.section not in SECTIONS:
            raise InvalidInputError(f"audit: no section {self.section!r}; there are {', '.join(SECTIONS)}")
        if not self.warn <= self.fail:
            raise InvalidInputError(f"{self.name}: fails above {self.fail:g}, but warns above {self.warn:g}")

    @property
    def grade(self) -> Grade:
        """Grade from value and limits."""
        if math.isnan(self.value):
            return Grade.NOT_CHECKED
        if self.value > self.warn:
            return Grade.FAIL if self.value > self.fail else Grade.WARN
        if self.weak:
            return Grade.WEAK
        return Grade.INFORMATION if math.isinf(self.warn) else Grade.PASS

    @property
    def text(self) -> str:
        """One line: subject, figure, exceeded limit, time and possible cause."""
        if not self.name:
            return f"{self.subject}: {self.note}"
        if self.grade is Grade.NOT_CHECKED:
            return f"{self.subject}: {self.name}: {self.note}"
        if self.name == FAULT and math.isfinite(self.at):
            return f"{self.subject}, {self.at:.1f} to {self.at + self.value:.1f} s: {self.note}"
        line = f"{self.subject}: {self.name} {self.value:.3g} {self.unit}".rstrip()
        if self.grade in (Grade.PASS, Grade.INFORMATION):
            return line
        if self.grade is not Grade.WEAK:
            limit = self.fail if self.grade is Grade.FAIL else self.warn
            line += f" (above {limit:.3g}{f' {self.unit}'.rstrip()})" if limit >= 0 else ""
            line += f" at {self.at:.1f} s" if math.isfinite(self.at) else ""
        return f"{line}: {self.note}" if self.note else line

    @classmethod
    def warning(cls, section: str, subject: str, note: str) -> Self:
        """Return a warning in words."""
        return cls(section, "", subject, 1.0, "", 0.0, source="any warns", note=note)

    @classmethod
    def remark(cls, section: str, subject: str, note: str, weak: bool = False) -> Self:
        """Return information in words."""
        return cls(section, "", subject, 0.0, "", note=note, weak=weak)

    @classmethod
    def not_checked(cls, section: str, subject: str, why: str, name: str = "") -> Self:
        """Return a result without a value."""
        return cls(section, name, subject, math.nan, "", note=why)

    def plain(self) -> dict[str, Any]:
        """Return the fields and the grade as JSON data, null for values that are not finite."""
        out = {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in asdict(self).items()}
        return out | {"grade": self.grade.value}

    @classmethod
    def from_plain(cls, data: Any) -> Self:
        """Return the result that `plain` wrote; raise `InvalidInputError` if it is none."""
        if not isinstance(data, dict):
            raise InvalidInputError(f"audit result: {str(data)[:40]!r} is no table of its fields")
        kinds = {"bool": (bool, "neither true nor false"), "float": (int | float, "no number")}
        empty = {"value": math.nan, "at": math.nan, "warn": math.inf, "fail": math.inf, "weak": False}
        out: dict[str, Any] = {}
        for field in fields(cls):
            given = data.get(field.name)
            given = empty.get(field.name) if given is None else given
            kind, wrong = kinds.get(str(field.type), (str, "no text"))
            if not isinstance(given, kind) or (isinstance(given, bool) and kind is not bool):
                raise InvalidInputError(f"audit result: {field.name} is {str(given)[:40]!r}, {wrong}")
            out[field.name] = float(given) if field.type == "float" else given
        return cls(**out)


@dataclass(frozen=True)
class SectionVerdict:
    """Verdict on one section."""

    section: str
    grade: Grade  #: Worst grade of its figures; NOT_CHECKED without any
    reasons: tuple[str, ...]  #: Why it is not a pass, and further remarks

    @property
    def title(self) -> str:
        """Title of the section."""
        return SECTIONS[self.section]


def section_verdict(section: str, results: Sequence[AuditResult], most: int = 6) -> SectionVerdict:
    """Return the verdict on one of `SECTIONS`, by results of any sections."""
    own = [result for result in results if result.section == section]
    grades = {result.grade for result in own}
    grade = next((worse for worse in WORST_FIRST if worse in grades), Grade.NOT_CHECKED)
    reasons = [line for g in WORST_FIRST if g is not Grade.PASS for line in result_lines(own, g)]
    if not own:
        reasons = ["nothing was checked"]
    if len(reasons) > most:
        reasons = [*reasons[:most], f"and {len(reasons) - most} more in the audit"]
    return SectionVerdict(section, grade, tuple(reasons))


def result_lines(results: Sequence[AuditResult], grade: Grade) -> Iterator[str]:
    """Yield the lines of one grade; results with the same name are merged into the line of the worst, and for WEAK
    remarks replace the single figures.
    """
    chosen = [result for result in results if result.grade is grade]
    if grade is Grade.WEAK:
        chosen = [result for result in chosen if not result.name] or chosen
    for name in dict.fromkeys(result.name for result in chosen):
        alike = [result for result in chosen if result.name == name]
        if not name or len(alike) == 1 or grade in (Grade.NOT_CHECKED, Grade.INFORMATION):
            yield from (result.text for result in alike)
            continue
        worst = max(alike, key=lambda result: result.value - result.warn)
        others = [result.subject for result in alike if result is not worst]
        yield f"{worst.text}; also {some(others, _NAMED)}"


_UNCHECKED: Final = 3  # largest number of unchecked things that are named
_ALONE: Final = "for the angles; "  #: Beginning of the text where the angles pass and the position in the room does not
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
    """Of angles and pose relative to the root: FAIL or WARN if any result does; else, if any passes, PASS where that
    is proven and PLAUSIBLE where it is not."""
    text: str  #: One line about both, without the grade
    sections: tuple[SectionVerdict, ...]
    room: Grade | None = None  #: Of the position in the room; None where nothing is said about it
    room_text: str = ""  #: The sentence about the position in the room, a part of `text`
    not_proven: str = ""  #: What would prove a reconstruction that is PLAUSIBLE, a part of `text`

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
    """Return the overall grades and the headline of an audit, or of some of its sections."""
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
        grade, text, not_proven = _without_warnings(of_angles, about)
        both = "; ".join(part for part in (room, text) if part)
        alone = _ALONE if grade in (Grade.PASS, Grade.PLAUSIBLE) and of_room not in (None, Grade.PASS) else ""
        return Headline(grade, alone + both, sections, of_room, room, not_proven)
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


def _without_warnings(sections: tuple[SectionVerdict, ...], results: Sequence[AuditResult]) -> tuple[Grade, str, str]:
    """Grade; words of what was checked, what is not proven, what is weakly observed, and what could not be checked;
    and what would prove it, if it is plausible.
    """
    checked = [verdict.section for verdict in sections if verdict.grade is Grade.PASS]
    not_proven = _not_proven(results) if checked else ""
    said = CERTIFICATE if not_proven else ""
    weak = [f"{v.section}: {v.reasons[0]}" for v in sections if v.grade is Grade.WEAK and v.section != said]
    unknown = list(result_lines([result for result in results if result.section != said], Grade.NOT_CHECKED))
    if checked and not not_proven and not any(result.section == "truth" for result in results):
        unknown.append("the error itself: there is no reference")
    parts = [f"checked, no problem found in {', '.join(checked)}"] if checked else []
    parts += [f"not proven: {not_proven}"] if not_proven else []
    parts += weak
    parts += [f"not checked: {some(unknown, _UNCHECKED, '; ')}"] if unknown else []
    good = Grade.PLAUSIBLE if not_proven else Grade.PASS
    return good if checked else Grade.WEAK if weak else Grade.NOT_CHECKED, "; ".join(parts), not_proven


def _not_proven(results: Sequence[AuditResult]) -> str:
    """What would prove a reconstruction; '' where it is proven, and for results about none (markers, calibration)."""
    present = {result.section for result in results}
    if not present & {"image", "sensors", CERTIFICATE}:  # those that the audit of every reconstruction has
        return ""
    compared = any(result.section == "truth" and math.isfinite(result.value) for result in results)
    if compared or section_verdict(CERTIFICATE, results).grade is Grade.PASS:
        return ""
    said = (Grade.NOT_CHECKED, Grade.WEAK)
    notes = (r.note for r in results if r.section == CERTIFICATE and r.grade in said)
    return next(notes, "nothing was compared with a left-out sensor or a reference: reconstruct again")
