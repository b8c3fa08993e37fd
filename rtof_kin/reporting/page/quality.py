"""Sections of a report on its quality: recording and settings, verdicts, calibration, audit, checklist."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any, Final

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.core.signals import runs
from rtof_kin.recording.session import Session
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.reporting.audit_results import SECTIONS, AuditResult, Grade, SectionVerdict
from rtof_kin.reporting.headline import Headline
from rtof_kin.reporting.html import badge, bullets, definitions, folded, table
from rtof_kin.reporting.isb import Items
from rtof_kin.reporting.summary_file import Summary

_PROBLEMS: Final = {Grade.FAIL: "problem", Grade.WARN: "with care", Grade.WEAK: "not verified"}
"""Grades of sections with a row of their own, worst first, and their labels."""
_LONGEST: Final = 180  # characters of a reason that stands in the table of verdicts unfolded


def recording_section(motion: MotionSource, summary: Summary, session: Session, made: str) -> str:
    """Return what was recorded, with what, and how the motion was computed."""
    times, inputs, subject = motion.times, summary.inputs, summary.subject
    height = f"{subject['height_m']:g} m" if subject.get("height_m") else "height not given"
    weight = f"{subject['mass_kg']:g} kg" if subject.get("mass_kg") else "weight not given"
    sensors, camera = inputs.get("sensors") or [], inputs.get("camera")
    image = f"{camera.get('width_px')} x {camera.get('height_px')} px" if camera else "none"
    if camera and camera.get("rate_hz"):
        image += f", {camera['rate_hz']:.4g} Hz"
    if (cameras := inputs.get("cameras", 1)) > 1:
        image += f"; the first of {cameras} cameras"
    labels = ("subject", "operator", "date", "place", "protocol")
    rows = [
        *([label.title(), getattr(session, label) or "not stated"] for label in labels),
        ["Recording", summary.recording],
        ["Body", f"{height}, {weight}"],
        ["Length", f"{len(times)} frames, {times[-1] - times[0]:.1f} s, {motion.rate_hz:.4g} Hz"],
        ["Camera", image],
        ["Sensors", ", ".join(str(s.get("segment") or s.get("name")) for s in sensors) or "none"],
        ["Mode", summary.mode],
        *_settings(summary.settings or {}),
        ["Report made", f"{made}, {inputs.get('software', 'rtof_kin')}"],
    ]
    return f'<dl class="details">\n{definitions(rows)}\n</dl>'


def _settings(settings: dict[str, Any]) -> list[list[str]]:
    """Settings of the reconstruction; none if the summary has none."""
    if not settings:
        return []
    rows = []
    if settings.get("space"):
        solver = f"{settings['space']} space, {settings.get('backend')}, energy: {settings.get('energy')}"
        rows.append(["Solver", f"{solver}; {settings.get('frames')} frames a fragment"])
    if settings.get("lifter"):
        source = "" if settings.get("lift_with_sensors") else ", from the image alone"
        rows.append(["Lifter", f"{settings['lifter']}{source}"])
    prior = ", starting from another recording" if settings.get("known_of_another_recording") else ""
    return [
        *rows,
        ["Self-calibration", f"{settings.get('calibrate')}{prior}"],
        ["Outlier rejection", settings.get("guards") or "off"],
        ["Threads", str(settings.get("threads") or "not limited")],
    ]


def notes_section(text: str) -> str:
    """Return a section with the notes of the recording, e.g. what `init` assumed; nothing without notes."""
    if not text.strip():
        return ""
    inside = f'<h2 id="notes-title">How the recording was made</h2>{bullets(text.splitlines())}'
    return f'<section id="notes" aria-labelledby="notes-title">{inside}</section>'


def missing_data(motion: MotionSource) -> str:
    """Return the intervals in which the person was not observed, in words."""
    times = motion.times
    gaps = runs(~motion.masks.valid.any(axis=1))
    if not gaps:
        return f"no frame without an observation; missing samples: see {SECTIONS['streams']}"
    spans = ", ".join(f"{times[start]:.2f} to {times[stop - 1]:.2f} s" for start, stop in gaps[:8])
    more = f" and {len(gaps) - 8} more" if len(gaps) > 8 else ""
    return f"the person was not observed at {spans}{more}; interpolated, and marked as such"


def headline_line(overall: Headline) -> str:
    """Return the verdicts on the angles and on the position in the room, and what they mean."""
    grades = {"Angles": overall.grade} | ({"Position in the room": overall.room} if overall.room else {})
    both = "; ".join(f"{what} {badge(grade)}" for what, grade in grades.items())
    note = ""
    if {Grade.WARN, Grade.FAIL} & {*grades.values()}:
        note = "Use with care: some figures are less reliable. Do not use: an input is wrong, or they are."
    return f"<p>{both}</p>" + (f'<p class="note wide">{note}</p>' if note else "")


def verdicts_table(verdicts: Iterable[SectionVerdict], names: AngleTable) -> str:
    """Return a row for each section with a problem, with its first reason and the others folded, one row for
    the sections of each other grade, and remarks on them.
    """
    found = [(v, [_sentence(reason, names) for reason in v.reasons]) for v in verdicts]
    rows = []
    for grade, word in _PROBLEMS.items():
        for v, reasons in found:
            if v.grade is grade:
                short = textwrap.shorten(reasons[0], _LONGEST, placeholder=" ...")
                more = reasons if short.endswith(" ...") else reasons[1:]
                title = "in full" if more is reasons else f"{len(more)} more"
                why = escape(short) + (f" {folded(title, bullets(more))}" if more else "")
                rows.append((escape(v.title), badge(grade, word), why))
    others = [g for g in Grade if g not in _PROBLEMS]
    for grade in others:
        if alike := [v.title for v, _ in found if v.grade is grade]:
            rows.append((escape(", ".join(alike)), badge(grade), ""))
    remarks = [f"{v.title}: {reason}" for v, reasons in found if v.grade in others for reason in reasons]
    rest = folded("remarks on sections without a problem", bullets(remarks)) if remarks else ""
    sections = table(("section", "verdict", "why"), rows, "verdicts", row_headers=True)
    return f'{sections}<div class="remarks">{rest}</div>'


def _sentence(text: str, names: AngleTable) -> str:
    text = plain_words(text, names)
    return text[:1].upper() + text[1:]


def audit_table(results: Iterable[AuditResult]) -> str:
    """Return all figures of the audit with their limits and sources."""

    def figure(value: float, unit: str) -> str:
        return escape(f"{value:.3g} {unit}".rstrip()) if math.isfinite(value) else ""

    def limit(value: float, unit: str) -> str:
        return "any" if value < 0 else figure(value, unit) or "no limit"

    rows = (
        (
            escape(f"{r.subject}: {r.name}" if r.name else r.subject),
            figure(r.value, r.unit),
            badge(r.grade, r.grade.value),
            limit(r.warn, r.unit),
            limit(r.fail, r.unit),
            escape(r.note if r.grade is not Grade.PASS else ""),
            escape(r.source),
            escape(r.section),
        )
        for r in results
    )
    columns = ("figure", "value", "grade", "warns above", "fails above", "note", "limits from", "section")
    return table(columns, rows, "audit", row_headers=True)


def camera_table(found: Any) -> str:
    """Return the table of a camera that is not calibrated; nothing for a calibrated one."""
    if not isinstance(found, dict):
        return ""
    text = "The camera is not calibrated. What remains uncertain is part of all bands."
    return f"<p>{text}</p>" + _rows(found)


def calibration_table(found: Any) -> str:
    """Return what was estimated from the recording."""
    if not isinstance(found, dict):
        return "<p>Nothing else was estimated from the recording: all other parameters are used as given.</p>"
    return _rows(found)


def _rows(found: dict[str, Any]) -> str:
    columns = [str(column) for column in found.get("columns", [])]
    rows = [[escape(str(cell)) for cell in row][: len(columns)] for row in found.get("rows", [])]
    filled = ([*row, *[""] * (len(columns) - len(row))] for row in rows)
    return table(columns, filled, "estimates", row_headers=bool(columns))


def checklist(topics: Mapping[str, Items]) -> str:
    """Return the items that a study reports, one table a topic, blank where they are unknown.

    Args:
        topics: of `isb_items`.
    """
    blank = '<span class="blank">to be filled in:</span>'

    def value(known: str | None) -> str:
        return blank if known is None else escape(known) + (f" {blank}" if known.endswith(":") else "")

    return "".join(
        table(
            ("item", "in this recording"),
            ((escape(name), value(known)) for name, known in items.items()),
            "isb",
            topic,
            row_headers=True,
        )
        for topic, items in topics.items()
    )
