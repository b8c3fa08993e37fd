"""Everything that a report shows, as one structure of plain data: `page_data`.

``rtof_kin.report.html`` turns it into a page. What a reader reads is text and tables, made here; what is
drawn is ``rtof_kin.report.plot_data``'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.gait import MEASURES
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.core.signals import runs
from rtof_kin.recording.session import Session
from rtof_kin.report.audit_results import SECTIONS, Finding, Grade, section_verdict
from rtof_kin.report.clinical_findings import SECOND_PELVIS, outcomes
from rtof_kin.report.headline import Headline, headline
from rtof_kin.report.isb import CITATION, isb_items
from rtof_kin.report.plot_data import (
    Data,
    angle_curves,
    cycle_drawings,
    player_data,
    shown_frames,
    side_and_name,
)
from rtof_kin.report.summary_file import Summary

_GAIT_UNITS = {"stride_time": "s", "cadence": "steps/min", "stride_length": "m", "speed": "m/s"}
NO_AUDIT = "an earlier version of rtof_kin wrote the folder, without an audit: reconstruct again"


def page_data(
    motion: MotionSequence, analysis: MotionAnalysis, summary: Summary, session: Session, made: str
) -> Data:
    """Everything on the page.

    Args:
        motion: as reconstructed. analysis: of it. summary: what was written beside it.
        session: who, by whom, when. made: the day the report is made.

    Returns:
        Plain data: JSON knows all of it.
    """
    of_motion = outcomes(analysis)
    findings = (*(summary.findings or ()), *of_motion)
    first = Headline(Grade.UNTOLD, NO_AUDIT, ())
    if summary.findings is not None:
        first = headline(summary.findings)
    shown = shown_frames(motion.times)
    verdicts = [section_verdict(section, findings) for section in SECTIONS]
    if not any(finding.section == "truth" for finding in findings):
        verdicts = [verdict for verdict in verdicts if verdict.section != "truth"]
    bands = analysis.angles.sigma is not None
    inputs = summary.inputs | {"session": session.plain()}
    return {
        "title": f"{session.subject or summary.recording}: motion report",
        "headline": {"grade": first.grade.value, "text": first.text},
        "read_from_it": _read_from_it(of_motion),
        "header": _header(motion, summary, session, made),
        "verdicts": [
            {"section": v.section, "title": v.title, "grade": v.grade.value, "reasons": list(v.reasons)}
            for v in verdicts
        ],
        "findings": [finding.plain() for finding in findings],
        "calibration": inputs.get("calibration"),
        "ranges": _ranges(analysis),
        "gait": _gait(analysis),
        "torques": _torques(analysis, motion.skeleton.table),
        "angles": angle_curves(analysis, shown),
        "cycles": cycle_drawings(analysis),
        "bands": bands,
        "player": player_data(motion, shown, inputs.get("floor_height_m")),
        "isb": [{"topic": i.topic, "name": i.name, "known": i.known}
                for i in isb_items(inputs, summary.mode, bands, _gaps_text(motion))],
        "citation": CITATION,
        "acknowledgement": summary.acknowledgement,
        "drawn_hz": motion.poses[shown].rate_hz,
    }  # fmt: skip


# --- text and tables -----------------------------------------------------------------------------


def _header(motion: MotionSequence, summary: Summary, session: Session, made: str) -> list[list[str]]:
    times, inputs = motion.times, summary.inputs
    subject = inputs.get("subject") or {}
    body = [f"{subject['height_m']:g} m" if subject.get("height_m") else "height not given",
            f"{subject['mass_kg']:g} kg" if subject.get("mass_kg") else "weight not given"]  # fmt: skip
    sensors = inputs.get("sensors") or []
    camera = inputs.get("camera")
    seen = "none"
    if camera:
        size, rate = f"{camera.get('width_px')} x {camera.get('height_px')} px", camera.get("rate_hz")
        seen = f"{size}, {rate:.4g} Hz" if rate else size
    rows = [
        ["Subject", session.subject or "not stated"],
        ["Operator", session.operator or "not stated"],
        ["Date", session.date or "not stated"],
        ["Place", session.place or "not stated"],
        ["Protocol", session.protocol or "not stated"],
        ["Recording", summary.recording],
        ["Body", ", ".join(body)],
        ["Length", f"{len(times)} frames, {times[-1] - times[0]:.1f} s, {motion.poses.rate_hz:.4g} Hz"],
        ["Camera", seen],
        ["Sensors", ", ".join(str(s.get("segment") or s.get("name")) for s in sensors) or "none"],
        ["Mode", summary.mode],
        *_choices(summary.settings or {}),
        ["Report made", f"{made}, {inputs.get('software', 'rtof_kin')}"],
    ]
    return [*rows, ["Notes", str(inputs["notes"])]] if inputs.get("notes") else rows


def _choices(settings: Data) -> list[list[str]]:
    """How it was made; nothing where the summary does not say."""
    if not settings:
        return []
    rows = [["Calibrated from itself", str(settings.get("calibrate"))]]
    if settings.get("known_of_another_recording"):
        rows[0][1] += ", with what another recording said of the person"
    if settings.get("lifter"):
        told = "" if settings.get("lift_with_sensors") else ", from the image alone"
        rows.insert(0, ["Lifter", f"{settings['lifter']}{told}"])
    if settings.get("space"):
        solver = f"{settings['space']} space, {settings.get('backend')}, energy: {settings.get('energy')}"
        rows.insert(0, ["Solver", f"{solver}; {settings.get('frames')} frames a fragment"])
    guards = "looked through" if settings.get("guard_streams") else "taken as they are"
    return [*rows, ["Streams", guards], ["Threads", str(settings.get("threads") or "not limited")]]


def _read_from_it(of_motion: Sequence[Finding]) -> str:
    """What the angles, the gait and the torques come to, which the headline does not tell."""
    verdicts = [section_verdict(section, of_motion) for section in ("angles", "gait", "torques")]
    return ", ".join(f"{verdict.title.lower()}: {verdict.grade.value}" for verdict in verdicts)


def _gaps_text(motion: MotionSequence) -> str:
    """When nobody saw where the person was."""
    times = motion.times
    gaps = runs(~motion.poses.valid.any(axis=1))
    if not gaps:
        return "no frame in which nobody saw the person; missing samples: see What was recorded"
    spans = ", ".join(f"{times[start]:.2f} to {times[stop - 1]:.2f} s" for start, stop in gaps[:8])
    more = f" and {len(gaps) - 8} more" if len(gaps) > 8 else ""
    return f"nobody saw the person at {spans}{more}; bridged there, and marked as such"


def _ranges(analysis: MotionAnalysis) -> list[Data]:
    """A row for each angle without its side: low, high, range, peak velocity of right and left."""
    rows: dict[str, Data] = {}
    for found in analysis.ranges:
        if not found.known_share > 0 or found.name.startswith(SECOND_PELVIS):
            continue
        side, name = side_and_name(found.name)
        rows.setdefault(name, {"name": name.replace("_", " ")})[side or "both"] = _range(found)
    return list(rows.values())


def _range(found: RangeOfMotion) -> Data:
    figures = (found.low, found.high, found.range, found.peak_velocity)
    low, high, extent, speed = (_rounded(np.degrees(v)) for v in figures)
    return {"low": low, "high": high, "range": extent, "speed": speed, "known": float(found.known_share)}


def _gait(analysis: MotionAnalysis) -> Data:
    gait = analysis.gait
    rows = []
    for name in MEASURES:
        own = {side: measures[name] for side, measures in gait.summary.items()}
        if own:
            row: Data = {"name": name.replace("_", " "), "unit": _GAIT_UNITS.get(name, ""),
                         "symmetry": _rounded(100 * gait.symmetry.get(name, np.nan))}  # fmt: skip
            for side, (mean, sd, n) in own.items():
                row[side] = {"mean": _rounded(mean, 3), "sd": _rounded(sd, 3), "n": n}
            rows.append(row)
    return {"rows": rows, "notes": list(gait.notes)}


def _torques(analysis: MotionAnalysis, table: SkeletonTable) -> list[Data]:
    torques = analysis.torques
    if torques is None:
        return []
    clinical = {dof.urdf: dof.clinical.lstrip("-") for joint in table.joints for dof in joint.dofs}
    out = []
    for name, column in zip(torques.dof_names, torques.torques.T, strict=True):
        if np.isfinite(column).any():
            peak = float(np.nanmax(np.abs(column)))
            per_kg = _rounded(peak / torques.weight_kg, 2)
            known = float(np.isfinite(column).mean())
            out.append({"name": name, "clinical": clinical[name], "peak": _rounded(peak),
                        "per_kg": per_kg, "known": known})  # fmt: skip
    return out


def _rounded(value: Any, digits: int = 1) -> float | None:
    """JSON knows no NaN: a figure that there is no data for is null."""
    return round(float(value), digits) if np.isfinite(value) else None
