"""Summary of a report in five lines: who, what, how good, what to be careful about, findings.

The lines are plain sentences for a reader who has twenty seconds. They name what was observed and how well,
and interpret nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.repetitions import find_repetitions
from rtof_kin.clinical.travel import DRIFT, Travel
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.session import Session
from rtof_kin.report.audit_results import Grade
from rtof_kin.report.clinical_findings import NO_BANDS, SECOND_PELVIS
from rtof_kin.report.headline import Headline
from rtof_kin.report.summary_file import Summary
from rtof_kin.report.summary_findings import compared_pairs, findings, shown_name

MOST_FINDINGS: Final = 3
DEEP_KNEE: Final = np.radians(60.0)  # [rad] least flexion of both knees in a squat
FEWEST_SQUATS: Final = 2
_CODES: Final = re.compile(r" \(\w+_[xyz]\)|; more (fails|warns) in .*")
"""Names of revolutes and the list of further sections, which the first line omits."""


@dataclass(frozen=True)
class SummaryLine:
    """One line of the summary."""

    label: str
    """'Who', 'What', 'How good', 'Careful' or 'Findings'."""
    text: str
    """One to three sentences."""
    grade: Grade | None
    """Grade that the line states; None for a line without one."""


def summary_lines(
    motion: MotionSequence, analysis: MotionAnalysis, summary: Summary, overall: Headline, session: Session
) -> tuple[SummaryLine, ...]:
    """Return the five lines of a report's summary.

    Args:
        motion: reconstructed. analysis: of the motion. summary: of its folder.
        overall: headline of its audit. session: labels of the session.
    """
    return (
        SummaryLine("Who", _who(motion, summary, session), None),
        SummaryLine("What", _what(motion, analysis, summary), None),
        SummaryLine("How good", _how_good(motion, analysis), overall.grade),
        _careful(motion, analysis, overall),
        SummaryLine("Findings", _findings(motion, analysis), None),
    )


def _who(motion: MotionSequence, summary: Summary, session: Session) -> str:
    subject = summary.subject
    height = f"{subject['height_m']:.2f} m" if subject.get("height_m") else None
    weight = f"{subject['mass_kg']:.3g} kg" if subject.get("mass_kg") else None
    height = height or f"height not given (model {motion.skeleton.height:.2f} m)"
    parts = (height, weight or "weight not given", subject.get("sex") or "sex not given")
    return f"{session.subject or 'Subject not named'}: {', '.join(parts)}."


def _what(motion: MotionSequence, analysis: MotionAnalysis, summary: Summary) -> str:
    seconds = float(motion.times[-1] - motion.times[0])
    return f"{_movement(motion, analysis)} {seconds:.1f} s, from {_sources(analysis, summary)}."


def _movement(motion: MotionSequence, analysis: MotionAnalysis) -> str:
    """Sentence on the movement, as far as it was recognised."""
    gait, way = analysis.gait, analysis.travel
    if gait.is_gait:
        strides = len(gait.verdict.walking)
        partly = f" in {100 * way.walking_share:.0f} % of the time" if way.walking_share < 0.5 else ""
        if gait.verdict.on_the_spot:
            return f"Walking on the spot or on a treadmill{partly}, {strides} strides."
        return f"Walking{partly}: {strides} strides, {_way(way)}."
    repeated = find_repetitions(motion.poses, motion.skeleton, analysis.angles, "squat").repetitions
    squats = [r for r in repeated if all(knee >= DEEP_KNEE for knee in r.knee_flexion.values())]
    if len(squats) >= FEWEST_SQUATS:
        return f"{len(squats)} deep knee bends (squats); no walking, {_way(way)}."
    return f"Neither walking nor squats were recognised; {_way(way)}."


def _way(way: Travel) -> str:
    """Path and turns of the pelvis in words."""
    if not math.isfinite(way.path_length):
        return "the way of the pelvis was not observed"
    about = "about " if DRIFT in way.notes else ""
    path = f"{about}{way.path_length:.1f} m {way.way}".rstrip() if way.path_length else "staying in place"
    turns = [
        f"{np.degrees(turn):.0f}° to the {side}"
        for side, turn in (("left", way.turned_left), ("right", way.turned_right))
        if turn > 0
    ]
    return f"{path}, turning {' and '.join(turns)}" if turns else f"{path}, without turning"


def _sources(analysis: MotionAnalysis, summary: Summary) -> str:
    """Camera and sensors that were used, in words."""
    camera = "one camera" if summary.inputs.get("camera") else "no camera"
    words = {joint: term.replace("_", " ") for term, joint in analysis.table.segments.items()}
    carriers = [str(s["segment"]) for s in summary.inputs.get("sensors") or [] if s.get("segment")]
    if not carriers:
        return f"{camera} and no sensors"
    terms = [words.get(name, name) for name in carriers]
    singles = [term.split(" ", 1)[1] if term.startswith(("left ", "right ")) else term for term in terms]
    grouped = [
        f"both {term}s" if singles.count(term) == 2 else terms[singles.index(term)]
        for term in dict.fromkeys(singles)
    ]
    many = "1 sensor" if len(carriers) == 1 else f"{len(carriers)} sensors"
    return f"{camera} and {many} ({', '.join(grouped)})"


def _half_widths(analysis: MotionAnalysis) -> dict[str, float]:
    """Median half width of the 95 % band of each observed clinical angle, degrees."""
    angles = analysis.angles
    if angles.sigma is None:
        return {}
    sigma = np.where(angles.known, angles.sigma, np.nan)
    return {
        row.name: float(np.degrees(BAND_95 * np.nanmedian(sigma[:, a])))
        for a, row in enumerate(angles.rows)
        if np.isfinite(sigma[:, a]).any() and not row.name.startswith(SECOND_PELVIS)
    }


def _how_good(motion: MotionSequence, analysis: MotionAnalysis) -> str:
    seen = (
        f"Joints were observed in {100 * float(motion.poses.position_observed.mean()):.0f} % of the frames."
    )
    widths = {name: half for name, half in _half_widths(analysis).items() if name.endswith("flexion")}
    if not widths:
        return f"The accuracy of the angles is not known: {NO_BANDS}. {seen}"
    best, worst = min(widths, key=widths.__getitem__), max(widths, key=widths.__getitem__)
    median = float(np.median(list(widths.values())))
    return (
        f"Flexion angles are expected to be within ± {median:.0f}° (95 % of the time); best "
        f"{shown_name(best)} ± {widths[best]:.0f}°, worst {shown_name(worst)} ± {widths[worst]:.0f}°. {seen}"
    )


def _careful(motion: MotionSequence, analysis: MotionAnalysis, overall: Headline) -> SummaryLine:
    """Headline of the audit if it warns or fails, and what is unobserved, bridged or drifting."""
    warned = overall.grade in (Grade.WARN, Grade.FAIL)
    parts = [_CODES.sub("", overall.text)] if warned else []
    unseen = [
        joint.name.replace("_", " ")
        for joint in analysis.table.joints
        if not any(analysis.angles[angle.name][np.isfinite(analysis.angles[angle.name])].size
                   for angle in joint.angles)
    ]  # fmt: skip
    if unseen:
        parts.append(f"no angles of {_both_sides(unseen)}: not observed")
    bridged = float((motion.poses.provenance == Provenance.BRIDGED).any(axis=1).mean())
    if bridged > 0:
        parts.append(f"gaps were bridged in {100 * bridged:.0f} % of the frames")
    parts += [note for note in analysis.travel.notes if note == DRIFT]
    widths = _half_widths(analysis)
    if widths and not warned:
        worst = max(widths, key=widths.__getitem__)
        parts.append(f"most uncertain is {shown_name(worst)}, ± {widths[worst]:.0f}°")
    text = ". ".join(part[:1].upper() + part[1:] for part in parts) or "Nothing in particular"
    return SummaryLine("Careful", f"{text}.", overall.grade if warned else None)


def _both_sides(names: list[str]) -> str:
    """Names in a row; those of both sides once."""
    singles = [re.sub(r"^(left|right) ", "", name) for name in names]
    return ", ".join(
        f"both {single}s" if singles.count(single) == 2 else names[singles.index(single)]
        for single in dict.fromkeys(singles)
    )


def _findings(motion: MotionSequence, analysis: MotionAnalysis) -> str:
    if analysis.angles.sigma is None:
        return f"None can be stated: {NO_BANDS}, so that a difference cannot be told from an error."
    found = findings(analysis, motion.skeleton.table)[:MOST_FINDINGS]
    if not found:
        pairs = compared_pairs(analysis)
        return (
            f"No difference exceeds its 95 % band: {pairs} angles were compared between left and right, and "
            "all with their usual limits."
        )
    return " ".join(f"{one.text[:1].upper()}{one.text[1:]}." for one in found)
