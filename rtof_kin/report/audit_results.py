"""One figure of an audit against its limits, and what a section's figures come to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from enum import Enum
from typing import Any, Self

from rtof_kin.core.errors import ShapeError

SECTIONS = {
    "inputs": "What was declared",
    "streams": "What was recorded",
    "image": "Agreement with the image",
    "sensors": "Agreement with the sensors",
    "body": "The body",
    "calibration": "Calibration from the recording",
    "solver": "The solver",
    "confidence": "How well the motion is known",
    "truth": "Against the known truth",
    "angles": "Joint angles",
    "gait": "Gait",
    "torques": "Joint torques",
}
"""Parts of an audit, and their titles."""
FAILED_FRAGMENTS = "share of fragments that failed"
UNOBSERVED_FRAGMENTS = "share of fragments in which nothing was seen"
"""Names of the figures about frames that no measurement made."""
_NAMED = 5
"""Of many findings alike, so many are named beside the worst."""


class Grade(Enum):
    """What a figure, or a section, comes to."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"
    WEAK = "weakly observed"
    """Within its limits, but the data hardly tell: no pass."""
    UNTOLD = "not checked"
    INFORMATION = "for information"


WORST_FIRST = (Grade.FAIL, Grade.WARN, Grade.WEAK, Grade.PASS, Grade.INFORMATION, Grade.UNTOLD)
"""A section has the first of its figures' grades."""


@dataclass(frozen=True)
class Finding:
    """One figure against its limits, where larger is worse; or something to know, in words."""

    section: str
    """One of `SECTIONS`."""
    name: str
    """What the figure is; '' where the note says everything."""
    subject: str
    """Whose: a landmark, a sensor, an angle, the whole."""
    value: float
    """NaN where it could not be told; then `note` says why."""
    unit: str
    """Of the value and its limits; '' for none."""
    warn: float = math.inf
    """Above this the figure warns; without a limit it is for information."""
    fail: float = math.inf
    """Above this it fails."""
    source: str = ""
    """Where the limits come from."""
    note: str = ""
    """What a figure above its limits may mean, or why it could not be told."""
    at: float = math.nan
    """[s] when it was worst; NaN where that says nothing."""
    weak: bool = False
    """Whether the data hardly tell the value."""

    def __post_init__(self) -> None:
        if self.section not in SECTIONS:
            raise ShapeError(f"finding: no section {self.section!r}; there are {', '.join(SECTIONS)}")
        if not self.warn <= self.fail:
            raise ShapeError(f"{self.name}: it fails above {self.fail:g}, but warns above {self.warn:g}")

    @property
    def grade(self) -> Grade:
        """By value and limits."""
        if math.isnan(self.value):
            return Grade.UNTOLD
        if self.value > self.fail:
            return Grade.FAIL
        if self.value > self.warn:
            return Grade.WARN
        if self.weak:
            return Grade.WEAK
        return Grade.INFORMATION if math.isinf(self.warn) else Grade.PASS

    @property
    def text(self) -> str:
        """One line: whose, what, the figure, the limit it is above, when, and what that may mean."""
        if not self.name:
            return f"{self.subject}: {self.note}"
        if self.grade is Grade.UNTOLD:
            return f"{self.subject}: {self.name}: {self.note}"
        line = f"{self.subject}: {self.name} {self.value:.3g} {self.unit}".rstrip()
        if self.grade in (Grade.PASS, Grade.INFORMATION):
            return line
        if self.grade is Grade.WEAK:
            return f"{line}: {self.note}"
        limit = self.fail if self.grade is Grade.FAIL else self.warn
        line += f" (above {limit:.3g}{f' {self.unit}'.rstrip()})" if limit >= 0 else ""
        line += f" at {self.at:.1f} s" if math.isfinite(self.at) else ""
        return f"{line}: {self.note}" if self.note else line

    @classmethod
    def doubt(cls, section: str, subject: str, note: str, at: float = math.nan) -> Self:
        """Something that warns, in words."""
        return cls(section, "", subject, 1.0, "", 0.0, source="any warns", note=note, at=at)

    @classmethod
    def remark(cls, section: str, subject: str, note: str, weak: bool = False) -> Self:
        """Something to know, in words."""
        return cls(section, "", subject, 0.0, "", note=note, weak=weak)

    @classmethod
    def untold(cls, section: str, subject: str, why: str, name: str = "") -> Self:
        """Something that could not be told, and why."""
        return cls(section, name, subject, math.nan, "", note=why)

    def plain(self) -> dict[str, Any]:
        """The fields as JSON knows them: null for what is not finite; and the grade."""
        out = {
            name: None if isinstance(v, float) and not math.isfinite(v) else v
            for name, v in asdict(self).items()
        }
        return out | {"grade": self.grade.value}

    @classmethod
    def from_plain(cls, data: Any) -> Self:
        """The finding that `plain` wrote.

        Raises:
            ShapeError: it is none.
        """
        missing = {"value": math.nan, "at": math.nan, "warn": math.inf, "fail": math.inf}
        out: dict[str, Any] = {"weak": False}
        if not isinstance(data, dict):
            raise ShapeError(f"finding: {str(data)[:40]!r} is no table of its fields")
        for field in fields(cls):
            given = data.get(field.name, out.get(field.name))
            if field.name == "weak":
                if not isinstance(given, bool):
                    raise ShapeError(f"finding: weak is {str(given)[:40]!r}, neither true nor false")
            elif field.name in missing:
                given = missing[field.name] if given is None else given
                if isinstance(given, bool) or not isinstance(given, int | float):
                    raise ShapeError(f"finding: {field.name} is {str(given)[:40]!r}, no number")
                given = float(given)
            elif not isinstance(given, str):
                raise ShapeError(f"finding: {field.name} is {str(given)[:40]!r}, no text")
            out[field.name] = given
        return cls(**out)


@dataclass(frozen=True)
class SectionVerdict:
    """What the figures of one section come to."""

    section: str
    grade: Grade
    """The worst of its figures; UNTOLD where none could be told."""
    reasons: tuple[str, ...]
    """Why it is no pass, and what there is to know besides."""

    @property
    def title(self) -> str:
        """For people."""
        return SECTIONS[self.section]


def section_verdict(section: str, findings: Sequence[Finding], most: int = 6) -> SectionVerdict:
    """The verdict on a section from its findings; those of other sections are passed over.

    Args:
        most: reasons that are spelt out; the others are counted.
    """
    own = [finding for finding in findings if finding.section == section]
    grades = {finding.grade for finding in own}
    grade = next((worse for worse in WORST_FIRST if worse in grades), Grade.UNTOLD)
    reasons = [line for g in WORST_FIRST if g is not Grade.PASS for line in finding_lines(own, g)]
    if not own:
        reasons = ["nothing was checked"]
    if len(reasons) > most:
        reasons = [*reasons[:most], f"and {len(reasons) - most} more in the audit"]
    return SectionVerdict(section, grade, tuple(reasons))


def finding_lines(findings: Sequence[Finding], grade: Grade) -> Iterator[str]:
    """Findings of one grade; of several of one figure the worst stands for all, and of figures that are
    weakly observed what is said of them in words.
    """
    chosen = [finding for finding in findings if finding.grade is grade]
    if grade is Grade.WEAK:
        chosen = [finding for finding in chosen if not finding.name] or chosen
    for name in dict.fromkeys(finding.name for finding in chosen):
        alike = [finding for finding in chosen if finding.name == name]
        if not name or len(alike) == 1 or grade in (Grade.UNTOLD, Grade.INFORMATION):
            yield from (finding.text for finding in alike)
            continue
        worst = max(alike, key=lambda finding: finding.value - finding.warn)
        others = [finding.subject for finding in alike if finding is not worst]
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        yield f"{worst.text}; also {', '.join(others[:_NAMED])}{more}"
