"""Report of a reconstruction as one HTML page: summary, ranges, curves, gait, torques, quality, audit.

A second page, `review`, has the motion beside its video, on one time line with the curves, to choose ranges in.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import SIDES, AngleRow, AngleTable, clinical_name
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.clinical.torques import NO_WEIGHT, JointTorques
from rtof_kin.clinical.travel import Travel
from rtof_kin.core.checks import some
from rtof_kin.core.signals import runs
from rtof_kin.formats.measurements_file import MeasurementsReader, measurements_path
from rtof_kin.recording.labels import Session
from rtof_kin.reporting import certificate
from rtof_kin.reporting.analysis import CurveBand, curve_bands, curve_note, gait_table
from rtof_kin.reporting.angle_names import ISB, MAIN, OPENSIM, XZY, AngleName, angle_name, plain_words, side_and_name
from rtof_kin.reporting.audit_results import (
    CERTIFICATE,
    SECTIONS,
    AuditResult,
    Grade,
    Headline,
    SectionVerdict,
    headline,
    section_verdict,
)
from rtof_kin.reporting.clinical_findings import NO_BANDS, clinical_findings
from rtof_kin.reporting.document import Cell, Table, badge, sentence
from rtof_kin.reporting.html import css_string, render
from rtof_kin.reporting.plot_data import angle_curves, cycle_curves_data, packed, player_data, shown_frames
from rtof_kin.reporting.provenance import checklist
from rtof_kin.reporting.summary_file import SUMMARY, Summary, read_summary
from rtof_kin.reporting.summary_lines import summary_lines

PAGE: Final = "report.html"
_SCRIPTS: Final = ("unpack.js", "charts.js", "scene.js", "player.js")  # of pages with curves and a skeleton that plays
_NO_AUDIT: Final = "an earlier version of rtof_kin wrote the folder, without an audit: reconstruct again"
OBSERVED: Final = 0.995  #: Share of the frames from which on something counts as always observed
_RELIABLE: Final = 0.75  # share of reliable among observed frames below which a range says it
_FEWEST: Final = 0.25  # share of observed and reliable frames below which there is no range
_URDF: Final = re.compile(r" \(\w+\)$")  # the name of a degree of freedom in the URDF, behind the clinical one
_PROBLEMS: Final = {Grade.FAIL: "problem", Grade.WARN: "with care", Grade.WEAK: "not verified"}
"""Grades of sections with a row of their own, worst first, and their labels."""
_FOOT: Final = (
    '@page { @bottom-left { content: FOOT; font: 8pt system-ui, "DejaVu Sans", sans-serif; color: #5d6873; } }'
)
"""Foot of every printed page: whose motion, and when it was recorded."""


def report(
    folder: str | Path,
    session: Session | None = None,
    weight_kg: float | None = None,
    sex: str | None = None,
    made: date | None = None,
) -> str:
    """Return the self-contained HTML page of a reconstruction.

    >>> from pathlib import Path
    >>> from rtof_kin import report
    >>> page = report("out/motion")
    >>> written = Path("report.html").write_text(page, encoding="utf-8")
    >>> "report" in page[:2000].lower()
    True

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
    with MotionReader(folder) as motion:
        analysis = analyse(motion, weight_kg=weight_kg, sex=sex if weight_kg else None)
        return _page(motion, analysis, summary, labels, (made or date.today()).isoformat())


def _page(motion: MotionSource, analysis: MotionAnalysis, summary: Summary, session: Session, made: str) -> str:
    inputs, words, named = summary.inputs, analysis.table, session.subject or summary.recording
    results = (*(summary.results or ()), *clinical_findings(analysis))
    overall = Headline(Grade.NOT_CHECKED, _NO_AUDIT, ()) if summary.results is None else headline(summary.results)
    checked = [s for s in SECTIONS if s not in (CERTIFICATE, "truth") or any(result.section == s for result in results)]
    bands = analysis.angles.sigma is not None
    shown = shown_frames(motion.times)
    curves, whole = angle_curves(analysis, shown), curve_bands(analysis.ranges, summary.sensors)
    sampling = f"Plotted at {motion.rate_hz / (shown.step or 1):.3g} frames per second."
    if curves["interval"]:
        sampling = (
            f"The recording is long: each curve shows the lowest and the highest reliable value of every "
            f"{curves['interval']:.2g} s, with the widest band of that time; what is shorter is not visible."
        )
    grades = {"Angles": overall.grade} | ({"Position in the room": overall.room} if overall.room else {})
    return render(
        "report.html",
        styles=("page.css", "report.css"),
        scripts=(*_SCRIPTS, "start.js"),
        data={
            "angles": curves,
            "cycles": cycle_curves_data(analysis),
            "player": player_data(motion, shown, inputs.get("floor_height_m")),
            "bands": bands,
        },
        rules=_FOOT.replace("FOOT", css_string(", ".join(filter(None, (named, session.date))))),
        title=f"{named}: motion report",
        origin=_origin(summary, session, made),
        summary=_summary(analysis, summary, overall, session),
        way=way_line(analysis.travel),
        ranges=range_tables(analysis.ranges, analysis.angles.rows, whole),
        whole_curves=f"Curve, in parentheses: {curve_note()}." if whole else "",
        bands=_bands_note(analysis),
        sampling=sampling,
        gait=gait_table(analysis.gait) if analysis.gait.is_gait else None,
        gait_notes=analysis.gait.notes if analysis.gait.is_gait else (),
        why_no_gait=analysis.gait.why_not,
        torques=torque_tables(analysis.torques, motion.skeleton.table),
        why_no_torques=f"{NO_WEIGHT.capitalize()}.",
        notes=plain_words(str(inputs.get("notes") or ""), words).strip().splitlines(),
        recording=recording_facts(motion, summary, session, made),
        camera=_estimates(inputs.get("camera_estimate")),
        calibration=_estimates(inputs.get("calibration")),
        grades={what: badge(grade) for what, grade in grades.items()},
        careful=bool({Grade.WARN, Grade.FAIL} & {*grades.values()}),
        verdicts=_verdicts([section_verdict(section, results) for section in checked], words),
        certificate=None if summary.certificate is None else certificate.section(summary.certificate, words),
        checklist=checklist(inputs, summary.mode, bands, _missing_data(motion)),
        audit=_audit(results),
        acknowledgement=summary.acknowledgement,
    )


def _bands_note(analysis: MotionAnalysis) -> str:
    without = f"There are no bands: {NO_BANDS}."
    return without if analysis.angles.sigma is None else "Bands are 95 % intervals of the motion's confidence."


def _summary(
    analysis: MotionAnalysis, summary: Summary, overall: Headline, session: Session
) -> list[tuple[str, str, str]]:
    """Label, badge and text of each line of the summary."""
    lines = summary_lines(analysis, summary, overall, session)
    return [(line.label, badge(line.grade) if line.grade else "", line.text) for line in lines]


def _origin(summary: Summary, session: Session, made: str) -> str:
    """Who recorded what, where and when, in one line."""
    recorded = f"recorded {session.date}" if session.date else "date of the recording not stated"
    operator = f"by {session.operator}" if session.operator else ""
    place = f"at {session.place}" if session.place else ""
    first = " ".join(filter(None, (recorded, operator, place)))
    software = summary.inputs.get("software", "rtof_kin")
    return "; ".join(filter(None, (first, session.protocol, f"report made {made} by {software}")))


# --- ranges of motion ----------------------------------------------------------------------------


def range_tables(
    ranges: Iterable[RangeOfMotion], rows: Iterable[AngleRow], whole: Mapping[str, CurveBand] | None = None
) -> list[Table]:
    """Return the ranges of motion of pelvis and trunk, then right against left; no tables without an angle. Headings
    among the rows have no range of motion; whole: bands of whole curves, by angle.
    """

    def ends(own: RangeOfMotion | None, name: AngleName) -> str:
        shown, band = _ends(own, name), (whole or {}).get(own.name) if own else None
        return (
            Markup("{} <small class='curve'>(\u00b1 {})</small>").format(shown, _whole(band.half))
            if band and shown
            else shown
        )

    named = {row.name: row for row in rows}
    found: dict[str, dict[str, RangeOfMotion]] = {}
    for own in ranges:
        side, angle = side_and_name(own.name)
        if own.known_share > 0 and not named[own.name].about_vertical:
            found.setdefault(angle, {})[side] = own
    single: dict[AngleName, tuple[Cell, ...]] = {}
    both: dict[AngleName, tuple[Cell, ...]] = {}
    for by_side in found.values():
        name = angle_name(named[next(iter(by_side.values())).name])
        if "" in by_side:
            middle = by_side[""]
            single[name] = (_title(name), _range(middle), ends(middle, name), _peak(middle))
            continue
        right, left = sides = [by_side.get(side) for side in SIDES]
        difference = math.nan
        if right and left and right.is_comparable and left.is_comparable:
            difference = math.degrees(right.range - left.range)
        both[name] = (
            _title(name),
            *(cell for own in sides for cell in (_range(own), ends(own, name))),
            f"{round(difference):+d}".replace("+0", "0") if math.isfinite(difference) else "",
            *map(_peak, sides),
        )
    curve = " (curve)" if whole else ""
    columns = ("angle", "range [deg]", f"from, to [deg]{curve}", "peak [deg/s]")
    of_sides = [f"{side}: {what}" for side in SIDES for what in ("range [deg]", f"from, to{curve}")]
    of_both = ("angle", *of_sides, "right - left", *(f"{side}: peak [deg/s]" for side in SIDES))
    out = []
    for names, cells, title, kind in (
        (columns, single, "Pelvis and trunk", "ranges single"),
        (of_both, both, "Right and left", "ranges"),
    ):
        further = [{"data-in": name.shown} | ({} if name.clinical in MAIN else {"class": "further"}) for name in cells]
        if cells:
            rows_of = list(cells.values())
            out.append(Table(names, rows_of, title, kind=kind, row_headers=True, attributes=further))
    return out


def _title(name: AngleName) -> Markup:
    """Name of the angle under the conventions in which it is shown, and the movement that is positive."""
    clinical = Markup("{} <small>+ {}</small>").format(name.clinical, name.positive)
    return _by_convention(clinical, name.opensim_title)


def _by_convention(clinical: str, opensim: str) -> Markup:
    texts = Markup('<span data-in="{} {}">{}</span><span data-in="{}">{}</span>')
    return texts.format(ISB, XZY, clinical, OPENSIM, opensim)


def _range(found: RangeOfMotion | None) -> Markup:
    if found is None:
        return Markup()
    small = Markup(" <small>{}</small>")
    if not _has_range(found):
        few = 100 * found.known_share * found.trusted_share
        return small.format(f"reliable only {few:.0f} %" if few else "no reliable value").lstrip()
    value, _, uncertain = found.text.partition(", ")
    value, _, half = value.partition(" \u00b1 ")
    out = Markup("<b>{}</b>").format(value)
    out += f" \u00b1 {half}" if half else small.format(uncertain) if uncertain else ""
    if found.known_share < OBSERVED:
        out += small.format(f"observed {100 * found.known_share:.0f} %")
    if found.trusted_share < _RELIABLE:
        out += small.format(f"{100 * found.trusted_share:.0f} % of it reliable")
    return out


def _ends(found: RangeOfMotion | None, name: AngleName) -> str:
    if found is None or not _has_range(found):
        return ""
    usual = f"{_whole(found.low)} to {_whole(found.high)}"
    opposite = f"{_whole(-found.high)} to {_whole(-found.low)}"
    return _by_convention(usual, opposite) if name.opposite else usual


def _peak(found: RangeOfMotion | None) -> str:
    return "" if found is None or not _has_range(found) else _whole(found.peak_velocity)


def _has_range(found: RangeOfMotion) -> bool:
    return math.isfinite(found.low) and found.known_share * found.trusted_share >= _FEWEST


def _whole(radians: float) -> str:
    return f"{round(float(np.degrees(radians)))}" if math.isfinite(radians) else ""


# --- way, gait and torques -----------------------------------------------------------------------


def way_line(travel: Travel) -> str:
    """Return how far the person went and turned, what was observed of it, and what could not be determined."""
    parts = [travel.text, "turns within their error" if travel.unsure_turns else ""]
    if travel.observed_share < OBSERVED:
        parts.append(f"position observed in {100 * travel.observed_share:.0f} % of the frames")
    return f"{'; '.join(filter(None, (*parts, *travel.notes)))}."


def torque_tables(torques: JointTorques | None, skeleton: SkeletonTable) -> list[Table]:
    """Return the peak torques on the skeleton's degrees of freedom, right against left; none without a body mass."""
    if torques is None:
        return []
    found: dict[str, dict[str, tuple[str, str, str]]] = {}
    for dof, column in zip(torques.dof_names, torques.torques.T, strict=True):
        known = np.isfinite(column)
        if known.any():
            peak = float(np.abs(column[known]).max())
            cells = (f"{peak:.3g}", f"{peak / torques.weight_kg:.2g}", f"{100 * known.mean():.0f} %")
            name = _URDF.sub("", clinical_name(skeleton, dof))
            side = next((side for side in SIDES if name.startswith(f"{side} ")), "")
            found.setdefault(name.removeprefix(f"{side} "), {})[side] = cells
    sided = {name: own for name, own in found.items() if "" not in own}
    both = [(name, *(cell for side in SIDES for cell in own.get(side, ("", "", "")))) for name, own in sided.items()]
    single = [(name, *own[""]) for name, own in found.items() if "" in own]
    parts = ("N m", "N m/kg", "known")
    columns = ("movement", *(f"{side}: {part}" for side in SIDES for part in parts))
    middle = "Peak torques of spine, neck and head"
    return [
        Table(columns, both, "Peak torques, right and left", kind="torques", row_headers=True),
        Table(("movement", *parts), single, middle, kind="torques single", row_headers=True),
    ]


# --- recording and quality -----------------------------------------------------------------------


def recording_facts(motion: MotionSource, summary: Summary, session: Session, made: str) -> dict[str, str]:
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
    labels, by_hand = ("subject", "operator", "date", "place", "protocol"), inputs.get("corrections")
    return {
        **{label.title(): getattr(session, label) or "not stated" for label in labels},
        "Recording": summary.recording,
        "Body": f"{height}, {weight}",
        "Length": f"{len(times)} frames, {times[-1] - times[0]:.1f} s, {motion.rate_hz:.4g} Hz",
        "Camera": image,
        **({"Other 3D models": ". ".join(found)} if (found := inputs.get("found_of_lifts")) else {}),
        **({"Corrected by hand": ". ".join(by_hand)} if by_hand else {}),
        "Sensors": ", ".join(str(s.get("segment") or s.get("name")) for s in sensors) or "none",
        "Mode": summary.mode,
        **_settings(summary.settings or {}),
        "Report made": f"{made}, {inputs.get('software', 'rtof_kin')}",
    }


def _settings(settings: dict[str, Any]) -> dict[str, str]:
    """Settings of the reconstruction; none if the summary has none."""
    if not settings:
        return {}
    rows = {}
    if settings.get("space"):
        solver = f"{settings['space']} space, energy: {settings.get('energy')}"
        rows["Solver"] = f"{solver}; {settings.get('frames')} frames a fragment"
    if settings.get("lifter"):
        source = "" if settings.get("lift_with_sensors") else ", from the image alone"
        rows["Lifter"] = f"{settings['lifter']}{source}"
    prior = ", starting from another recording" if settings.get("known_of_another_recording") else ""
    return rows | {
        "Self-calibration": f"{settings.get('calibrate')}{prior}",
        "Outlier rejection": settings.get("guards") or "off",
        "Threads": str(settings.get("threads") or "not limited"),
    }


def _missing_data(motion: MotionSource) -> str:
    """Intervals in which the person was not observed, in words."""
    times = motion.times
    gaps = runs(~motion.masks.valid.any(axis=1))
    if not gaps:
        return f"no frame without an observation; missing samples: see {SECTIONS['streams']}"
    spans = some([f"{times[start]:.2f} to {times[stop - 1]:.2f} s" for start, stop in gaps], 8)
    return f"the person was not observed at {spans}; interpolated, and marked as such"


def _verdicts(verdicts: Iterable[SectionVerdict], names: AngleTable) -> tuple[Table, list[str]]:
    """A row for each section with a problem, with its first reason and the others folded, and one row for the
    sections of each other grade; and remarks on them.
    """
    found = [(v, [sentence(plain_words(reason, names)) for reason in v.reasons]) for v in verdicts]
    rows: list[tuple[Cell, ...]] = []
    for grade, word in _PROBLEMS.items():
        for v, reasons in found:
            if v.grade is grade:
                why = Markup.escape(reasons[0])
                if more := reasons[1:]:
                    folded = Markup(" <details><summary>{} more</summary><ul>{}</ul></details>")
                    why += folded.format(len(more), Markup().join(map(Markup("<li>{}</li>").format, more)))
                rows.append((v.title, badge(grade, word), why))
    others = [g for g in Grade if g not in _PROBLEMS]
    for grade in others:
        if alike := [v.title for v, _ in found if v.grade is grade]:
            rows.append((", ".join(alike), badge(grade), ""))
    remarks = [f"{v.title}: {reason}" for v, reasons in found if v.grade in others for reason in reasons]
    return Table(("section", "verdict", "why"), rows, kind="verdicts", row_headers=True), remarks


def _audit(results: Iterable[AuditResult]) -> Table:
    """All figures of the audit with their limits and sources."""

    def figure(value: float, unit: str) -> str:
        return f"{value:.3g} {unit}".rstrip() if math.isfinite(value) else ""

    def limit(value: float, unit: str) -> str:
        return "any" if value < 0 else figure(value, unit) or "no limit"

    rows = [
        (
            f"{r.subject}: {r.name}" if r.name else r.subject,
            figure(r.value, r.unit),
            badge(r.grade, r.grade.value),
            limit(r.warn, r.unit),
            limit(r.fail, r.unit),
            r.note if r.grade is not Grade.PASS else "",
            r.source,
            r.section,
        )
        for r in results
    ]
    columns = ("figure", "value", "grade", "warns above", "fails above", "note", "limits from", "section")
    return Table(columns, rows, kind="audit", row_headers=True)


def _estimates(found: Any) -> Table | None:
    """Table of what was estimated from the recording; None where nothing was."""
    if not isinstance(found, dict):
        return None
    columns = [str(column) for column in found.get("columns", [])]
    rows = [[str(cell) for cell in row][: len(columns)] for row in found.get("rows", [])]
    filled = [[*row, *[""] * (len(columns) - len(row))] for row in rows]
    return Table(columns, filled, kind="estimates", row_headers=bool(columns))


# --- the motion beside its video -----------------------------------------------------------------


def review(folder: str | Path, video: str = "") -> str:
    """Return the page of a reconstruction; it posts the chosen range, ``{range: [start or null, stop or null]}`` in s,
    to the page around it. `FileFormatError`: the folder's files are missing or damaged.

    Args:
        folder: written by `export`. video: address of the video on the same server; '' where there is none.
    """
    folder = Path(folder)
    summary = read_summary(folder / SUMMARY)
    with MotionReader(folder) as motion:
        analysis, shown = analyse(motion), shown_frames(motion.times)
        player = player_data(motion, shown, summary.inputs.get("floor_height_m"))
        image, offset = _image(folder, motion, shown)
        start, stop = motion.times[[0, -1]]
        mended = [(max(one.start_s, start), min(one.stop_s, stop)) for one in motion.corrections]
        seen = motion.masks.valid[shown].any(axis=1)
    feet = analysis.gait.events.feet.items()
    return render(
        "review.html",
        styles=("page.css", "report.css", "review.css"),
        scripts=(*_SCRIPTS, "review.js"),
        data={
            "angles": angle_curves(analysis, shown),
            "player": player,
            "image": image,
            "offset": offset,
            "strikes": [{"at": float(at), "side": side} for side, foot in feet for at in foot.strikes],
            "mended": mended,
            "gone": runs(~seen),
            "unplayable": "This browser cannot play the video; the motion is shown without it.",
        },
        title=f"{summary.session.subject or summary.recording}: review",
        summary=_summary(analysis, summary, headline(summary.results or ()), summary.session),
        picture="Yellow: detected points." if image else "There was no camera.",
        bands=_bands_note(analysis),
        video=video,
    )


def _image(folder: Path, motion: MotionSource, shown: slice) -> tuple[dict[str, Any] | None, float]:
    """Return joints and detected points of the frames that are shown, px of the first camera, and how much later a
    frame is on the video's clock, s; None without a camera.
    """
    path, step = measurements_path(folder), shown.step or 1
    if not path.is_file():
        return None, 0.0
    joints, found, view = [], [], None
    with MeasurementsReader(path) as measured:
        for block in motion.blocks():
            views = measured.read(block.start, block.stop).views
            if not views:
                return None, 0.0
            own = slice(-block.start % step, None, step)
            frames = np.arange(block.stop - block.start)[own]
            poses = block.motion.poses[block.own][own]
            p = np.where(poses.valid[..., None], poses.p_world_joint, np.nan)
            joints.append(views[0].project(p, frames))
            found.append(np.where(views[0].seen[own, :, None], views[0].in_video(frames), np.nan))
            view = view or views[0]
    assert view is not None  # a motion has a frame
    return {
        "width": view.camera.width_px,
        "height": view.camera.height_px,
        "uv": packed(np.concatenate(joints), 1),
        "detected": packed(np.concatenate(found), 1),
        "landmarks": len(view.names),
    }, float(view.video_times[0] - view.times[0])
