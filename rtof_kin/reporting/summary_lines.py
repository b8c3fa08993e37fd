"""Summary of a report in a few lines: who, what, how good are angles and position, what to be careful about, findings.

The lines are plain sentences for a reader who has twenty seconds. They name what was observed and how well,
and interpret nothing.

**Findings.** Findings of a summary: differences that exceed their errors, by their size in standard deviations.

Compared are the two sides, by the same computation as ``compare --sides``, the ends of ranges with anatomical
limits, and the measures of gait of the two sides. Angles that were unobserved, unreliable or near a singular
posture for a part of the recording have no findings. A finding names a difference, never its cause.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import SIDES, AngleTable
from rtof_kin.clinical.comparison import Comparison, compare_sides, with_strides
from rtof_kin.clinical.comparison_change import LEVEL, Verdict
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.clinical.repetitions import find_repetitions
from rtof_kin.clinical.travel import DRIFT
from rtof_kin.core.choices import MARKERS
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.labels import Session
from rtof_kin.reporting.angle_names import SECOND_SHOULDER, label, plain_words
from rtof_kin.reporting.audit_results import Grade, Headline
from rtof_kin.reporting.clinical_findings import NO_BANDS, SECOND_PELVIS, WIDEST
from rtof_kin.reporting.document import sentence
from rtof_kin.reporting.summary_file import Summary

LEAST_DIFFERENCE: Final = np.radians(5.0)  # [rad] smaller differences are no findings, however certain
FEWEST_WITH_SD: Final = 3  # of each side, for their standard deviation
EVENT_SIGMA: Final = 0.015
"""Standard deviation of a side's mean stance, share of the stride, that more strides do not reduce."""


class Finding(NamedTuple):
    """A difference that exceeds its 95 % band."""

    subject: str  #: Joint or measure; of one subject only the largest finding is shown
    text: str  #: Sentence with the figures and their 95 % bands
    size: float  #: Difference divided by its standard deviation


def findings(analysis: MotionAnalysis, skeleton: SkeletonTable, sides: Comparison | None) -> tuple[Finding, ...]:
    """Return the findings of an analysis with its `compared_sides`, the largest first, one for each subject."""
    rows = {row.name: row for row in analysis.ranges if is_comparable(row)}
    found = [*_side_differences(sides), *_beyond_limits(rows, analysis.table, skeleton), *_asymmetries(analysis.gait)]
    out: dict[str, Finding] = {}
    for finding in sorted(found, key=lambda finding: -finding.size):
        out.setdefault(finding.subject, finding)
    return tuple(out.values())


def compared_sides(analysis: MotionAnalysis) -> Comparison | None:
    """Return left against right as `compare --sides` has it; None if nothing can be compared."""
    try:
        return compare_sides(with_strides("", analysis.angles, analysis.gait))[0]
    except InvalidInputError:
        return None


def is_comparable(row: RangeOfMotion) -> bool:
    """Return whether a range has a band, may be compared, and is not of a second sequence."""
    return row.is_comparable and bool(np.isfinite(row.range_sigma)) and not is_second_sequence(row.name)


def is_second_sequence(name: str) -> bool:
    """Return whether an angle is one of another sequence of the same rotation, which a summary omits."""
    return name.startswith(SECOND_PELVIS) or SECOND_SHOULDER in name


def with_band(value: float, sigma: float) -> str:
    """Return an angle and the half width of its 95 % band, given in rad, in degrees."""
    return f"{np.degrees(value):.0f} ± {np.degrees(BAND_95 * sigma):.0f}°"


def _side_differences(sides: Comparison | None) -> Iterator[Finding]:
    """Angles that differ between the sides, after Holm's correction for all that were compared."""
    for one in sides.changed if sides is not None else ():
        change = one.largest
        if abs(change.difference) > LEAST_DIFFERENCE:
            name, less = label(one.name), "left" if change.difference > 0 else "right"
            over = " over the gait cycle" if sides is not None and sides.by == "cycle" else ""
            right, left = (f"{np.degrees(value):.0f}°" for value in (change.b, change.a))
            by = with_band(abs(change.difference), change.error.half_width(LEVEL) / BAND_95)
            text = f"{name}: {change.measure}{over} {right} right, {left} left, that is {by} less on the {less}"
            yield Finding(name.split()[0], text, abs(change.difference) / change.sigma)


def _beyond_limits(rows: dict[str, RangeOfMotion], table: AngleTable, skeleton: SkeletonTable) -> Iterator[Finding]:
    """Ends of ranges beyond the anatomical limits of the skeleton by more than their band."""
    limits = anatomical_limits(skeleton)
    joints = {angle.name: joint for joint in table.joints for angle in joint.angles}
    for name, row in rows.items():
        if name not in limits:
            continue
        low, high = limits[name]
        for which, end, sigma, excess, limit in (
            ("lowest", row.low, row.low_sigma, low - row.low, low),
            ("highest", row.high, row.high_sigma, row.high - high, high),
        ):
            if excess > max(LEAST_DIFFERENCE, BAND_95 * sigma):
                beyond = f"beyond the anatomical limit of {np.degrees(limit):.0f}°"
                text = f"{label(name)}: {which} angle {with_band(end, sigma)}, {beyond}"
                yield Finding(joints[name].name.removeprefix(f"{joints[name].side}_"), text, excess / sigma)


def anatomical_limits(skeleton: SkeletonTable) -> dict[str, tuple[float, float]]:
    """Return the limits, rad, of those clinical angles that are single revolutes of the skeleton."""
    out = {}
    for joint in skeleton.joints:
        for dof, (low, high) in zip(joint.dofs, joint.limits, strict=True):
            name = dof.clinical.removeprefix("-")
            if name.startswith(SIDES):
                ends = (-high, -low) if dof.clinical.startswith("-") else (low, high)
                out[name.replace(" ", "_")] = (float(ends[0]), float(ends[1]))
    return out


def _asymmetries(gait: GaitAnalysis) -> Iterator[Finding]:
    """Stance of the two sides, if its means differ by more than their band."""
    by_ankle = {foot.by_ankle for foot in gait.events.feet.values()}
    if not gait.is_gait or len(gait.summary) < 2 or len(by_ankle) > 1:
        return
    (right, sd_right, n_right), (left, sd_left, n_left) = (gait.summary[s]["stance_share"] for s in SIDES)
    if min(n_right, n_left) < FEWEST_WITH_SD:
        return
    errors = [float(np.hypot(sd / np.sqrt(n), EVENT_SIGMA)) for sd, n in ((sd_right, n_right), (sd_left, n_left))]
    sigma = float(np.hypot(errors[0], errors[1]))
    if abs(right - left) > BAND_95 * sigma:
        first, second = (
            f"{100 * mean:.0f} ± {100 * BAND_95 * error:.0f} %"
            for mean, error in zip((right, left), errors, strict=True)
        )
        yield Finding("stance", f"stance: {first} of the stride right, {second} left", abs(right - left) / sigma)


MOST_FINDINGS: Final = 3
DEEP_KNEE: Final = np.radians(60.0)  # [rad] least flexion of a knee that bends deeply
FEWEST_BENDS: Final = 2
MOSTLY: Final = 0.5  # share of the time from which on a motion is walking without a qualification
IMAGE_FREE: Final = "imu"
IMAGE_ALONE: Final = ("lift", "rto")  #: Modes of reconstruction that use no image, or no sensors
FLEXION_ERROR: Final = "mean error of knee and elbow flexion"  #: Name of a figure of the audit, deg
_SIDE: Final = re.compile("^(left|right) ")
_PLURALS: Final = {"foot": "feet"}


class SummaryLine(NamedTuple):
    """One line of the summary."""

    label: str  #: 'Who', 'What', 'How good', 'Position in the room', 'Careful' or 'Findings'
    text: str  #: One to three sentences
    grade: Grade | None = None  #: Grade that the line states; None for a line without one


def summary_lines(
    analysis: MotionAnalysis, summary: Summary, overall: Headline, session: Session
) -> tuple[SummaryLine, ...]:
    """Return the lines of a report's summary; one on the position in the room where its audit has one."""
    seconds = float(analysis.paths.times[-1] - analysis.paths.times[0])
    room, mended = [], len(summary.inputs.get("corrections") or ())
    by_hand = f" Corrected by hand {'once' if mended == 1 else f'{mended} times'}: see Recording." if mended else ""
    if overall.room:
        verdict, _, why = plain_words(overall.room_text, analysis.table).partition(": ")
        room = [SummaryLine("Position in the room", f"{sentence(why or verdict)}.", overall.room)]
    return (
        SummaryLine("Who", _who(analysis, summary, session)),
        SummaryLine("What", f"{_movement(analysis)}. {seconds:.1f} s, from {_sources(analysis, summary)}.{by_hand}"),
        SummaryLine("How good", _how_good(analysis, summary), overall.grade),
        *room,
        SummaryLine("Careful", _careful(analysis, overall)),
        SummaryLine("Findings", _findings(analysis)),
    )


def _who(analysis: MotionAnalysis, summary: Summary, session: Session) -> str:
    subject = summary.subject
    given = {
        "height": f"{subject['height_m']:.2f} m" if subject.get("height_m") else "",
        "weight": f"{subject['mass_kg']:.3g} kg" if subject.get("mass_kg") else "",
        "sex": subject.get("sex") or "",
    }
    known = [text for text in given.values() if text]
    missing = [name for name, text in given.items() if not text]
    who = ", ".join([session.subject or "Subject not named", *known])
    model = f" (the model is {analysis.paths.skeleton.height:.2f} m tall)" if "height" in missing else ""
    return f"{who}. Not given: {_listed(missing)}{model}." if missing else f"{who}."


def _movement(analysis: MotionAnalysis) -> str:
    """Movement in words, as far as it was recognised."""
    gait, travel = analysis.gait, analysis.travel
    strides = len(gait.verdict.walking)
    counted = f"{strides} stride" + "s" * (strides != 1)
    if gait.is_gait:
        partly = f" in {100 * travel.walking_share:.0f} % of the time" if travel.walking_share < MOSTLY else ""
        where, way = ("", f", {travel.text}")
        if gait.verdict.on_the_spot:
            where, way = " on the spot or on a treadmill", ""
        return f"Walking{where}{partly}: {counted}{way}"
    own = analysis.repetitions
    if own is not None and (times := len(own.repetitions)):  # asked for, or set by hand
        name, rest = {"squat": ("squat", ""), "sit_to_stand": ("rise", " from a seat")}[own.kind]
        bends = [f"{times} {name}{'s' * (times > 1)}{rest}"]
    else:
        bends = _knee_bends(analysis)
    walking = f"{counted} of walking, but no steady walking" if strides else "no walking was recognised"
    return sentence("; ".join([*([_listed(bends)] if bends else []), walking, travel.text]))


def _knee_bends(analysis: MotionAnalysis) -> list[str]:
    """Repeated descents of the pelvis with deep flexion of both knees or of one, in words."""
    found = find_repetitions(analysis.paths, analysis.angles, "squat").repetitions
    deep = [sum(knee >= DEEP_KNEE for knee in one.knee_flexion.values()) for one in found]
    kinds = {2: "bends of both knees (squats)", 1: "bends of one knee (lunges)"}
    return [f"{deep.count(knees)} {name}" for knees, name in kinds.items() if deep.count(knees) >= FEWEST_BENDS]


def _sources(analysis: MotionAnalysis, summary: Summary) -> str:
    """Cameras and sensors in words, and which of them the mode of reconstruction does not use."""
    if summary.mode == MARKERS:
        return "optical markers"
    carriers = [str(s["segment"]) for s in summary.inputs.get("sensors") or [] if s.get("segment")]
    names = ", ".join(_both_sides([plain_words(name, analysis.table) for name in carriers]))
    count = f"{len(carriers)} sensor{'s' if len(carriers) > 1 else ''}"
    cameras = summary.inputs.get("cameras", 1)  # files of earlier versions do not say
    image, used = "one camera" if cameras <= 1 else f"{cameras} cameras", summary.inputs.get("lifts")
    points = f" with the 3D points of {_listed(used)}" if used else ""
    image += points
    if not summary.inputs.get("camera"):
        return f"{count} ({names}){points}, without a camera" if carriers else "no camera and no sensors"
    if summary.mode == IMAGE_FREE:
        return f"{count} ({names}); the camera{' was' if cameras <= 1 else 's were'} not used"
    if summary.mode in IMAGE_ALONE:
        return f"{image} alone" + (f"; {count} recorded, but not used" if carriers else "")
    return f"{image} and {count} ({names})" if carriers else f"{image} alone"


def _both_sides(names: list[str]) -> list[str]:
    """Names without duplicates; those of both sides once, in the plural."""
    names = list(dict.fromkeys(names))
    singles = [_SIDE.sub("", name) for name in names]
    return [
        f"both {_PLURALS.get(single, f'{single}s')}" if singles.count(single) == 2 else names[singles.index(single)]
        for single in dict.fromkeys(singles)
    ]


def _listed(words: list[str]) -> str:
    """'a', 'a and b', 'a, b and c'."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _half_widths(analysis: MotionAnalysis) -> dict[str, float]:
    """Median half width of the 95 % band of each observed clinical angle, degrees."""
    angles = analysis.angles
    if angles.sigma is None:
        return {}
    widths = {}
    for a, row in enumerate(angles.rows):
        sigma = angles.sigma[np.isfinite(angles.values[:, a]), a]
        if np.isfinite(sigma).any() and not is_second_sequence(row.name):
            widths[row.name] = float(np.degrees(BAND_95 * np.nanmedian(sigma)))
    return widths


def _how_good(analysis: MotionAnalysis, summary: Summary) -> str:
    share = 100 * float(analysis.paths.masks.position_observed.mean())
    seen = f"{share:.0f} % of the positions of joints were observed."
    reference = "".join(
        f" Against the reference, knees and elbows are {result.value:.1f}° off on average."
        for result in summary.results or ()
        if result.name == FLEXION_ERROR and math.isfinite(result.value)
    )
    if summary.certificate is not None and summary.certificate.sensors:
        seen += f" {sentence(plain_words(summary.certificate.sentences[0], analysis.table))}."
    widths = {name: half for name, half in _half_widths(analysis).items() if name.endswith("flexion")}
    if not widths:
        return f"The accuracy of the angles is not known: {NO_BANDS}. {seen}{reference}"
    best, worst = min(widths, key=widths.__getitem__), max(widths, key=widths.__getitem__)
    median = float(np.median(list(widths.values())))
    joints = (re.sub("_[a-z]*flexion$", "", name).replace("_", " ") for name in (best, worst))
    ends = [f"± {widths[name]:.0f}° ({joint})" for name, joint in zip((best, worst), joints, strict=True)]
    expected = f"Flexion angles are expected to be within ± {median:.0f}° (median 95 % band)"
    return f"{expected}, from {ends[0]} to {ends[1]}. {seen}{reference}"


def _careful(analysis: MotionAnalysis, overall: Headline) -> str:
    """Headline of the audit if it warns, fails or is missing, what would prove it if it is plausible, and what is
    unobserved, bridged or drifting.
    """
    warned = overall.grade in (Grade.WARN, Grade.FAIL, Grade.NOT_CHECKED)
    about_angles = [part for part in overall.text.replace(overall.room_text, "").split("; ") if part]
    parts = [plain_words("; ".join(about_angles), analysis.table)] if warned else []
    parts += [f"not proven: {overall.not_proven}"] if overall.not_proven else []
    known = {row.name: row.known_share > 0 for row in analysis.ranges}
    unseen = [
        joint.name.replace("_", " ")
        for joint in analysis.table.joints
        if not any(known[angle.name] or is_second_sequence(angle.name) for angle in joint.angles)
    ]
    if unseen:
        parts.append(f"angles of {_listed(_both_sides(unseen))} were not observed and are not shown")
    bridged = float((analysis.paths.masks.provenance == Provenance.BRIDGED).any(axis=1).mean())
    if bridged > 0:
        parts.append(f"gaps were bridged in {100 * bridged:.0f} % of the frames")
    parts += [note for note in analysis.travel.notes if note == DRIFT]
    wide = (_SIDE.sub("", label(name)) for name, half in _half_widths(analysis).items() if half > WIDEST[1])
    if doubtful := list(dict.fromkeys(wide)):
        parts.append(f"bands of {_listed(doubtful)} are wider than ± {WIDEST[1]:.0f}°")
    return f"{'. '.join(map(sentence, parts)) or 'No warning'}."


def _findings(analysis: MotionAnalysis) -> str:
    if analysis.angles.sigma is None:
        return f"None can be stated: {NO_BANDS}, so that a difference cannot be told from an error."
    sides = compared_sides(analysis)
    found = findings(analysis, analysis.paths.skeleton.table, sides)
    tested = [] if sides is None else [one for one in sides.angles if one.verdict is not Verdict.NOT_TESTED]
    pairs = len(tested)
    over = "over the gait cycle" if sides is not None and sides.by == "cycle" else "by their range"
    compared = f"{pairs} angle{'s' if pairs > 1 else ''} of the left and right were compared {over}"
    lines = [f"{sentence(one.text)}." for one in found[:MOST_FINDINGS]]
    if not pairs:
        none = "no angle is observed and reliable almost throughout on both sides"
        lines.append(f"Left and right were not compared: {none}.")
    elif len(found) < MOST_FINDINGS:
        other = "other " if found else ""
        lines.append(f"No {other}difference is shown: {compared}, and ranges with anatomical limits.")
    return " ".join(lines)
