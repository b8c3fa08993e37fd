"""The page as a whole: what stands in it, and in which order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import date
from html import escape
from pathlib import Path
from typing import Final

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.clinical.analysis import MotionAnalysis, analyse_motion
from rtof_kin.recording.session import Session
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.reporting.audit_results import SECTIONS, Grade, section_verdict
from rtof_kin.reporting.clinical_findings import NO_BANDS, clinical_findings
from rtof_kin.reporting.headline import Headline, headline
from rtof_kin.reporting.html import badge, fill_template
from rtof_kin.reporting.isb import CITATION, isb_items
from rtof_kin.reporting.page import quality
from rtof_kin.reporting.page.clinical import gait_section, torques_section, way_line
from rtof_kin.reporting.page.ranges import ranges_section
from rtof_kin.reporting.plot_data import Data, angle_curves, cycle_curves_data, player_data, shown_frames
from rtof_kin.reporting.summary_file import SUMMARY, Summary, read_summary
from rtof_kin.reporting.summary_lines import SummaryLine, summary_lines

PAGE: Final = "report.html"
_BANDS: Final = "Bands are 95 % intervals of the motion's confidence."
_NO_AUDIT: Final = "an earlier version of rtof_kin wrote the folder, without an audit: reconstruct again"
_CONTENTS: Final = {
    "ranges": "Ranges",
    "angles": "Curves",
    "motion": "Motion in 3D",
    "gait": "Gait",
    "torques": "Torques",
    "verdicts": "Quality",
    "recording": "Recording",
    "calibration": "Calibration",
    "isb": "Checklist",
    "audit": "Audit",
}


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
    weight_kg = weight_kg or summary.subject.get("mass_kg")
    sex = sex or summary.subject.get("sex")
    labels = summary.session.updated(session or Session())
    subject = {**summary.subject, "mass_kg": weight_kg, "sex": sex}
    inputs = summary.inputs | {"subject": subject, "session": labels.plain()}
    summary = replace(summary, inputs=inputs)
    with MotionReader(folder) as reader:
        motion = reader
        analysis = analyse_motion(motion, weight_kg=weight_kg, sex=sex if weight_kg else None)
        return _page(motion, analysis, summary, labels, (made or date.today()).isoformat())


def _page(motion: MotionSource, analysis: MotionAnalysis, summary: Summary, session: Session, made: str) -> str:
    inputs = summary.inputs
    clinical = clinical_findings(analysis)
    results = (*(summary.results or ()), *clinical)
    overall = Headline(Grade.NOT_CHECKED, _NO_AUDIT, ())
    if summary.results is not None:
        overall = headline(summary.results)
    checked = [s for s in SECTIONS if s != "truth" or any(result.section == s for result in results)]
    bands = analysis.angles.sigma is not None
    shown = shown_frames(motion.times)
    curves = angle_curves(analysis, shown)
    plots = {
        "angles": curves,
        "cycles": cycle_curves_data(analysis),
        "player": player_data(motion, shown, inputs.get("floor_height_m")),
        "bands": bands,
    }
    checklist = isb_items(inputs, summary.mode, bands, quality.missing_data(motion))
    calibration = quality.calibration_table(inputs.get("calibration"))
    parts = {
        "title": escape(f"{session.subject or summary.recording}: motion report"),
        "origin": escape(_origin(summary, session, made)),
        "summary": _summary(summary_lines(analysis, summary, overall, session)),
        "contents": _contents(_CONTENTS),
        "ranges": way_line(analysis.travel) + ranges_section(analysis.ranges, analysis.angles.rows),
        "bands": _BANDS if bands else f"There are no bands: {NO_BANDS}.",
        "sampling": _sampling(curves, motion.rate_hz / (shown.step or 1)),
        "gait": gait_section(analysis.gait),
        "torques": torques_section(analysis.torques, motion.skeleton.table),
        "notes": quality.notes_section(plain_words(str(inputs.get("notes") or ""), analysis.table)),
        "recording": quality.recording_section(motion, summary, session, made),
        "calibration": quality.camera_table(inputs.get("camera_estimate")) + calibration,
        "headline": quality.headline_line(overall),
        "verdicts": quality.verdicts_table((section_verdict(section, results) for section in checked), analysis.table),
        "isb": quality.checklist(checklist),
        "citation": escape(CITATION),
        "audit": quality.audit_table(results),
        "acknowledgement": escape(summary.acknowledgement),
    }
    return fill_template(parts, plots, _foot(summary, session))


def _summary(lines: Iterable[SummaryLine]) -> str:
    def text(line: SummaryLine) -> str:
        return f"{badge(line.grade)} {escape(line.text)}" if line.grade else escape(line.text)

    return "\n".join(f"<dt>{escape(line.label)}</dt><dd>{text(line)}</dd>" for line in lines)


def _origin(summary: Summary, session: Session, made: str) -> str:
    """Who recorded what, where and when, in one line."""
    recorded = f"recorded {session.date}" if session.date else "date of the recording not stated"
    operator = f"by {session.operator}" if session.operator else ""
    place = f"at {session.place}" if session.place else ""
    first = " ".join(filter(None, (recorded, operator, place)))
    software = summary.inputs.get("software", "rtof_kin")
    return "; ".join(filter(None, (first, session.protocol, f"report made {made} by {software}")))


def _foot(summary: Summary, session: Session) -> str:
    """Foot of every printed page: whose motion, and when it was recorded."""
    return ", ".join(filter(None, (session.subject or summary.recording, session.date)))


def _contents(titles: dict[str, str]) -> str:
    """Return the entries of the table of contents."""
    return "\n".join(f'<li><a href="#{name}">{escape(title)}</a></li>' for name, title in titles.items())


def _sampling(curves: Data, rate_hz: float) -> str:
    if not curves["interval"]:
        return f"Plotted at {rate_hz:.3g} frames per second."
    return (
        f"The recording is long: each curve shows the lowest and the highest reliable value of every "
        f"{curves['interval']:.2g} s, with the widest band of that time; what is shorter is not visible."
    )
