"""Report of a reconstruction as one HTML page; its plots are from `rtof_kin.report.plot_data`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import date
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.clinical.analysis import MotionAnalysis, analyse_motion
from rtof_kin.clinical.angle_table import clinical_name
from rtof_kin.clinical.gait import MEASURES, GaitAnalysis
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.clinical.torques import NO_WEIGHT, JointTorques
from rtof_kin.core.signals import runs
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.recording.session import Session
from rtof_kin.report.audit_results import SECTIONS, AuditResult, Grade, SectionVerdict, section_verdict
from rtof_kin.report.clinical_findings import NO_BANDS, SECOND_PELVIS, clinical_findings
from rtof_kin.report.headline import Headline, headline
from rtof_kin.report.html import badge, bullets, definitions, fill_template, table
from rtof_kin.report.isb import CITATION, Items, isb_items
from rtof_kin.report.plot_data import (
    angle_curves,
    cycle_curves_data,
    player_data,
    shown_frames,
    side_and_name,
)
from rtof_kin.report.summary_file import SUMMARY, Summary, read_summary

PAGE: Final = "report.html"
_GAIT_UNITS: Final = {"stride_time": "s", "cadence": "steps/min", "stride_length": "m", "speed": "m/s"}
_BANDS: Final = "Bands are 95 % intervals of the motion's confidence."
_NO_AUDIT: Final = "an earlier version of rtof_kin wrote the folder, without an audit: reconstruct again"


def report(
    folder: str | Path,
    session: Session | None = None,
    weight_kg: float | None = None,
    sex: str | None = None,
    made: date | None = None,
) -> str:
    """Return the self-contained HTML page of a reconstruction.

    Args:
        folder: written by `export`. session: labels that replace those of the recording.
        weight_kg, sex: of the subject, if not in the recording; there are no torques without a weight.
        made: date of the report; today by default.

    Raises:
        FileFormatError: the folder's files are missing or damaged.
        InvalidInputError: an implausible weight.
    """
    folder = Path(folder)
    summary = read_summary(folder / SUMMARY)
    motion = read_motion_npz(folder / "motion.npz").motion()
    weight_kg = weight_kg or summary.subject.get("mass_kg")
    sex = sex or summary.subject.get("sex")
    analysis = analyse_motion(motion, weight_kg=weight_kg, sex=sex if weight_kg else None)
    labels = summary.session.updated(session or Session())
    subject = {**summary.subject, "mass_kg": weight_kg, "sex": sex}
    summary = replace(summary, inputs=summary.inputs | {"subject": subject})
    return _page(motion, analysis, summary, labels, (made or date.today()).isoformat())


def _page(
    motion: MotionSequence, analysis: MotionAnalysis, summary: Summary, session: Session, made: str
) -> str:
    clinical = clinical_findings(analysis)
    results = (*(summary.results or ()), *clinical)
    overall = Headline(Grade.NOT_CHECKED, _NO_AUDIT, ())
    if summary.results is not None:
        overall = headline(summary.results)
    checked = [s for s in SECTIONS if s != "truth" or any(result.section == s for result in results)]
    own = [section_verdict(section, clinical) for section in ("angles", "gait", "torques")]
    bands = analysis.angles.sigma is not None
    inputs = summary.inputs | {"session": session.plain()}
    shown = shown_frames(motion.times)
    parts = {
        "title": escape(f"{session.subject or summary.recording}: motion report"),
        "headline": f"{badge(overall.grade)} {escape(overall.text)}",
        "clinical_verdicts": ", ".join(f"{v.title.lower()}: {v.grade.value}" for v in own),
        "header": definitions(_header(motion, summary, session, made)),
        "notes": _notes(str(inputs.get("notes") or "")),
        "verdicts": _verdicts(section_verdict(section, results) for section in checked),
        "ranges": _ranges(analysis.ranges),
        "bands": _BANDS if bands else f"There are no bands: {NO_BANDS}.",
        "plotted_hz": f"{motion.poses[shown].rate_hz:.3g}",
        "gait": _gait(analysis.gait),
        "torques": _torques(analysis.torques, motion.skeleton.table),
        "calibration": _camera(inputs.get("camera_estimate")) + _calibration(inputs.get("calibration")),
        "audit": _audit(results),
        "isb": _isb(isb_items(inputs, summary.mode, bands, _gaps_text(motion))),
        "citation": escape(CITATION),
        "acknowledgement": escape(summary.acknowledgement),
    }
    plots = {
        "angles": angle_curves(analysis, shown),
        "cycles": cycle_curves_data(analysis),
        "player": player_data(motion, shown, inputs.get("floor_height_m")),
        "bands": bands,
    }
    return fill_template(parts, plots)


def _notes(text: str) -> str:
    """Section with the notes of the recording, e.g. what `init` assumed and found; nothing without notes."""
    if not text.strip():
        return ""
    return f'<section id="notes"><h2>How the recording was made</h2>{bullets(text.splitlines())}</section>'


def _header(motion: MotionSequence, summary: Summary, session: Session, made: str) -> list[list[str]]:
    times, inputs, subject = motion.times, summary.inputs, summary.subject
    height = f"{subject['height_m']:g} m" if subject.get("height_m") else "height not given"
    weight = f"{subject['mass_kg']:g} kg" if subject.get("mass_kg") else "weight not given"
    sensors, camera = inputs.get("sensors") or [], inputs.get("camera")
    image = f"{camera.get('width_px')} x {camera.get('height_px')} px" if camera else "none"
    if camera and camera.get("rate_hz"):
        image += f", {camera['rate_hz']:.4g} Hz"
    labels = ("subject", "operator", "date", "place", "protocol")
    rows = [
        *([label.title(), getattr(session, label) or "not stated"] for label in labels),
        ["Recording", summary.recording],
        ["Body", f"{height}, {weight}"],
        ["Length", f"{len(times)} frames, {times[-1] - times[0]:.1f} s, {motion.poses.rate_hz:.4g} Hz"],
        ["Camera", image],
        ["Sensors", ", ".join(str(s.get("segment") or s.get("name")) for s in sensors) or "none"],
        ["Mode", summary.mode],
        *_settings(summary.settings or {}),
        ["Report made", f"{made}, {inputs.get('software', 'rtof_kin')}"],
    ]
    return [*rows, ["Notes", str(inputs["notes"])]] if inputs.get("notes") else rows


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


def _gaps_text(motion: MotionSequence) -> str:
    """Intervals in which the person was not observed."""
    times = motion.times
    gaps = runs(~motion.poses.valid.any(axis=1))
    if not gaps:
        return f"no frame without an observation; missing samples: see {SECTIONS['streams']}"
    spans = ", ".join(f"{times[start]:.2f} to {times[stop - 1]:.2f} s" for start, stop in gaps[:8])
    more = f" and {len(gaps) - 8} more" if len(gaps) > 8 else ""
    return f"the person was not observed at {spans}{more}; interpolated, and marked as such"


def _verdicts(verdicts: Iterable[SectionVerdict]) -> str:
    within = "all figures are within their limits"
    rows = ((escape(v.title), badge(v.grade), bullets(v.reasons) or within) for v in verdicts)
    return table(("section", "verdict", "why"), rows, "verdicts")


def _audit(results: Iterable[AuditResult]) -> str:
    def figure(value: float, unit: str) -> str:
        return escape(f"{value:.3g} {unit}".rstrip()) if math.isfinite(value) else ""

    def limit(value: float, unit: str) -> str:
        return "any" if value < 0 else figure(value, unit) or "no limit"

    rows = (
        (escape(r.section), escape(r.subject), escape(r.name), figure(r.value, r.unit),
         limit(r.warn, r.unit), limit(r.fail, r.unit), badge(r.grade),
         escape(r.note if r.grade is not Grade.PASS else ""), escape(r.source))
        for r in results
    )  # fmt: skip
    columns = ("section", "subject", "figure", "value", "warns above", "fails above", "", "note", "limits")
    return table(columns, rows, "audit")


def _camera(found: Any) -> str:
    """Table of a camera that is not calibrated; empty for a calibrated one."""
    if not isinstance(found, dict):
        return ""
    text = "The camera is not calibrated. What remains uncertain is part of all bands."
    return f"<p>{text}</p>" + _rows(found)


def _calibration(found: Any) -> str:
    if not isinstance(found, dict):
        return "<p>Nothing else was estimated from the recording: all other parameters are used as given.</p>"
    return _rows(found)


def _rows(found: dict[str, Any]) -> str:
    rows = ((escape(str(cell)) for cell in row) for row in found.get("rows", []))
    return table(map(str, found.get("columns", [])), rows)


def _ranges(ranges: Iterable[RangeOfMotion]) -> str:
    def whole(radians: float) -> str:
        return f"{np.degrees(radians):.0f}" if math.isfinite(radians) else ""

    def cells(found: RangeOfMotion | None) -> tuple[str, ...]:
        if found is None:
            return ("", "", "")
        span = f"{whole(found.low)} to {whole(found.high)}" if math.isfinite(found.low) else ""
        share = f" <small>observed {100 * found.known_share:.0f} %</small>"
        share = share if found.known_share < 0.995 else ""
        return span, f"<b>{whole(found.range)}</b>{share}", whole(found.peak_velocity)

    rows: dict[str, dict[str, RangeOfMotion]] = {}
    for found in ranges:
        side, name = side_and_name(found.name)
        if found.known_share > 0 and not name.startswith(SECOND_PELVIS):
            rows.setdefault(name, {})[side] = found
    out = []
    for name, own in rows.items():
        right, left = own.get("right", own.get("")), own.get("left")
        difference = math.degrees(right.range - left.range) if right and left else math.nan
        last = f"{round(difference):+d}" if math.isfinite(difference) else ""
        out.append((escape(name.replace("_", " ")), *cells(right), *cells(left), last))
    columns = ("angle [deg]", "right: from, to", "range", "peak deg/s", "left: from, to", "range",
               "peak deg/s", "range right - left")  # fmt: skip
    return table(columns, out, "ranges") if out else "<p>No angle was observed.</p>"


def _gait(gait: GaitAnalysis) -> str:
    if not gait.summary:
        return "<p>No gait cycle was found.</p>" + bullets(gait.notes)

    def cell(side: str, name: str) -> str:
        if side not in gait.summary:
            return ""
        mean, sd, strides = gait.summary[side][name]
        return f"{mean:.3g}" + (f" &plusmn; {sd:.2g}" if math.isfinite(sd) else "") + f" ({strides})"

    rows = []
    for name in MEASURES:
        symmetry = 100 * gait.symmetry.get(name, math.nan)
        text = f"{symmetry:+.1f} %" if math.isfinite(symmetry) else ""
        label = f"{name.replace('_', ' ')} {_GAIT_UNITS.get(name, '')}"
        rows.append((label, cell("right", name), cell("left", name), text))
    header = ("mean, standard deviation (strides)", "right", "left", "(right - left) / mean")
    return table(header, rows) + bullets(gait.notes)


def _torques(torques: JointTorques | None, skeleton: SkeletonTable) -> str:
    if torques is None:
        return f"<p>{NO_WEIGHT.capitalize()}.</p>"
    rows = []
    for name, column in zip(torques.dof_names, torques.torques.T, strict=True):
        known = np.isfinite(column)
        if known.any():
            peak = np.abs(column[known]).max()
            figures = (f"{peak:.3g}", f"{peak / torques.weight_kg:.2g}", f"{100 * known.mean():.0f} %")
            rows.append((escape(clinical_name(skeleton, name)), *figures))
    return table(("degree of freedom", "peak N m", "peak N m/kg", "known"), rows)


def _isb(topics: Mapping[str, Items]) -> str:
    blank = '<span class="blank">to be filled in:</span>'
    rows = []
    for topic, items in topics.items():
        for number, (name, known) in enumerate(items.items()):
            text = blank if known is None else escape(known) + (f" {blank}" if known.endswith(":") else "")
            rows.append((escape(topic) if number == 0 else "", escape(name), text))
    return table(("", "item", "in this recording"), rows, "isb")
