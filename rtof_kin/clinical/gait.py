"""Gait cycles: cadence, stride length, stance share, symmetry, and angles over the cycle.

**Recognition.** Recognition of walking among the strides of a motion.

Every alternation of the feet relative to the pelvis has strikes, offs and strides: dances, exercises and
kicks too. A stride is one of walking if its shape is (`StrideShape`, `departures`); a motion is gait if most
of its strides are, and if these are three or more and steady, or take most of the recording. The limits were
chosen on free motion and are measured on other people by ``python -m benchmarks gait_recognition``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.gait_events import LONGEST_STRIDE, GaitEvents, Stride, find_strides
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

STANCE: Final = (0.55, 0.82)  #: Stance shares of walking, of the stride time; slow walking has up to four fifths
PHASE: Final = (0.32, 0.68)  #: Strike of the other foot, share of the stride time
LEAST_SWING: Final = 0.20  # [m] excursion of a heel relative to the pelvis within a stride
LEAST_PROGRESS: Final = 0.30  # [m] way of the pelvis in one stride over ground
ON_THE_SPOT: Final = 0.20  # [m] largest way of the pelvis in one stride on a treadmill
SPOT_SWING: Final = 0.35  # [m] least excursion of a heel on a treadmill: a knee lifted in place has less
SPOT_PHASE: Final = (0.42, 0.58)
"""Strike of the other foot on a treadmill, where no way over ground confirms the stride."""
BELT: Final = (0.35, 0.75)
"""Way of the heel in mid stance on a treadmill, share of its swing: half of the stance is half of the way."""
FORWARD: Final = np.cos(np.radians(35.0))
"""Least cosine between the way of the pelvis and the direction in which it faces."""
LARGEST_TURN: Final = np.radians(70.0)  # [rad] change of heading within a stride
LARGEST_SLIP: Final = 0.20  # [m] way of the heel in mid stance over ground; noise has a decimetre
MID_STANCE: Final = np.array([0.2, 0.7])  #: Share of stance in which a heel stands, or moves with a treadmill's belt
FEWEST: Final = 3  #: Strides of both feet together from which on a motion is walking whatever else the recording shows
MOST_OF_TIME: Final = 0.5
"""Share of the recording that fewer strides must take; those within other movements take less."""
LEAST_SHARE: Final = 0.6  # of the strides found that are those of walking
UNSTEADY: Final = 0.15  # coefficient of variation of stride times


@dataclass(frozen=True)
class StrideShape:
    """Shape of one stride, by which walking is recognised; NaN where unknown."""

    stance_share: float  #: Stance time divided by stride time
    phase: float  #: Strike of the other foot, share of the stride time
    swing: float  #: [m] excursion of the heel relative to the pelvis, along its heading
    progress: float  #: [m] horizontal way of the pelvis from start to stop
    forward: float  #: Cosine between that way and the mean heading
    turn: float  #: [rad] change of the heading from start to stop
    slip: float  #: [m] horizontal way of the heel in world from 20 to 70 % of stance


@dataclass(frozen=True)
class GaitVerdict:
    """Whether a motion is gait, and which of its strides are those of walking."""

    walking: tuple[Stride, ...]  #: Strides of walking, by their start
    on_the_spot: bool  #: Whether the pelvis stays where it is: a treadmill, or walking on the spot
    why_not: str  #: One sentence on why the motion is no gait; '' if it is

    @property
    def is_gait(self) -> bool:
        """Whether the motion is gait."""
        return not self.why_not

    @property
    def too_few(self) -> str:
        """Sentence where strides of walking are fewer than `FEWEST`, for what needs their mean; else ''."""
        count = len(self.walking)
        strides = "stride" if count == 1 else "strides"
        enough = count >= FEWEST
        return "" if enough else f"Only {count} complete {strides} of walking: at least {FEWEST} are needed."


def stride_shape(stride: Stride, events: GaitEvents) -> StrideShape:
    """Return the shape of a stride."""
    own = stride.frames(events.times)
    times, pelvis, heel = events.times[own], events.pelvis[own], events.feet[stride.side].heel[own]
    inside = (times >= stride.start) & (times <= stride.stop)
    forward = events.forward[own][inside]
    ahead = np.sum((heel - pelvis)[inside] * forward, axis=-1)
    stance = stride.start + (stride.toe_off - stride.start) * MID_STANCE
    way = _way(times, pelvis, np.array([stride.start, stride.stop]))
    facing = np.nanmean(forward, axis=0)
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    progress = float(np.linalg.norm(way))
    others = [t for side, foot in events.feet.items() if side != stride.side for t in foot.strikes]
    between = [t for t in others if stride.start < t < stride.stop]
    return StrideShape(
        stance_share=stride.stance_share,
        phase=(between[0] - stride.start) / stride.stride_time if between else float("nan"),
        swing=float(np.ptp(ahead)) if np.isfinite(ahead).all() else float("nan"),
        progress=progress,
        forward=float(way @ facing[:2] / max(progress * np.linalg.norm(facing[:2]), 1e-9)),
        turn=float(heading[-1] - heading[0]),
        slip=float(np.linalg.norm(_way(times, heel, stance))),
    )


def progression(stride: Stride, events: GaitEvents) -> float:
    """Return the direction of progression of a stride from world x, rad.

    It is that of the way of the pelvis from strike to strike, or, on a treadmill, against the way of the heel
    in mid stance.
    """
    own = stride.frames(events.times)
    way = _way(events.times[own], events.pelvis[own], np.array([stride.start, stride.stop]))
    if np.linalg.norm(way) < LEAST_PROGRESS:
        at = stride.start + (stride.toe_off - stride.start) * MID_STANCE
        way = -_way(events.times[own], events.feet[stride.side].heel[own], at)
    return float(np.arctan2(way[1], way[0]))


def _way(times: Array, path: Array, at: Array) -> Array:
    """(2,) horizontal displacement of a path between two instants, m."""
    ends = signals.interpolate(times, path, at)
    return np.asarray((ends[1] - ends[0])[:2])


def recognise_gait(strides: Sequence[Stride], events: GaitEvents) -> GaitVerdict:
    """Decide whether strides are those of walking."""
    shapes = [stride_shape(stride, events) for stride in strides]
    against = [departures(shape) for shape in shapes]
    walking = tuple(stride for stride, reasons in zip(strides, against, strict=True) if not reasons)
    progress = [shape.progress for shape, reasons in zip(shapes, against, strict=True) if not reasons]
    on_the_spot = bool(progress) and float(np.median(progress)) < ON_THE_SPOT
    verdict = GaitVerdict(walking, on_the_spot, _why_not(strides, walking, against))
    if not events.feet:
        text = f"Walking cannot be recognised: {'; '.join(events.notes) or 'no foot was observed'}."
        return replace(verdict, why_not=text)
    if verdict.is_gait and (on_the_spot or share_of_time(walking, events.times) < MOST_OF_TIME):
        return replace(verdict, why_not=verdict.too_few)
    return verdict


def share_of_time(strides: Sequence[Stride], times: Array) -> float:
    """Return the share of a recording at times (T,), s, within strides."""
    inside = np.zeros(len(times), dtype=np.bool_)
    for stride in strides:
        inside[signals.within(times, stride.start, stride.stop)] = True
    return float(inside.mean())


def departures(shape: StrideShape) -> tuple[str, ...]:
    """Return phrases on what a stride has that walking has not; empty for a stride of walking."""
    spot = shape.progress < ON_THE_SPOT
    low, high = SPOT_PHASE if spot else PHASE
    swing = SPOT_SWING if spot else LEAST_SWING
    one_foot = np.isnan(shape.phase)  # the other foot was not observed
    stance, belt = shape.stance_share, shape.slip / max(shape.swing, 1e-9)
    least, most = (f"{100 * share:.0f} % of the stride" for share in STANCE)
    way, turn = f"{ON_THE_SPOT:.1f} to {LEAST_PROGRESS:.1f} m", f"{np.degrees(LARGEST_TURN):.0f} deg"
    wrong = (
        (stance < STANCE[0], f"stance takes less than {least}, as in running and jumping"),
        (stance > STANCE[1], f"stance takes more than {most}"),
        (not (one_foot or low <= shape.phase <= high), "the feet do not alternate evenly"),
        (not shape.swing >= swing, f"the foot swings less than {swing:.2f} m past the pelvis"),
        (not (spot or shape.progress >= LEAST_PROGRESS), f"the pelvis advances by {way} in a stride"),
        (not (spot or shape.forward >= FORWARD), "the person moves backward or sideways"),
        (not abs(shape.turn) <= LARGEST_TURN, f"the person turns by more than {turn} within a stride"),
        (not (spot or shape.slip <= LARGEST_SLIP), "the foot slides or hops during stance"),
        (spot and not BELT[0] <= belt <= BELT[1], "in place, the feet do not glide back as on a treadmill"),
    )
    return tuple(text for flag, text in wrong if flag)


def _why_not(strides: Sequence[Stride], walking: Sequence[Stride], against: Sequence[tuple[str, ...]]) -> str:
    """Sentence on why strides are no gait; '' if they are."""
    count = len(strides)
    if not count:
        return "No complete stride was found: no foot strikes twice with a strike of the other foot between."
    if len(walking) < LEAST_SHARE * count:
        reasons = [text for own in against for text in own]
        most = max(dict.fromkeys(reasons), key=reasons.count)
        have = "has" if len(walking) == 1 else "have"
        share = f"only {len(walking)} of {count} stride-like movements {have} the shape of walking"
        if not walking:
            share = f"none of {count} stride-like movements has the shape of walking"
        return f"This is not steady walking: {share}; most often, {most}."
    times = np.array([stride.stride_time for stride in walking])
    if count >= FEWEST and (spread := float(times.std(ddof=1) / times.mean())) > UNSTEADY:
        return (
            f"The strides are not steady: their times vary by {100 * spread:.0f} %, more than {100 * UNSTEADY:.0f} %."
        )
    return ""


PHASES: Final = np.linspace(0.0, 1.0, 101)  #: Samples of a cycle, share of the time from heel strike to heel strike
MEASURES: Final = ("stride_time", "cadence", "stride_length", "speed", "stance_share")
"""Fields of `Stride` that are averaged and compared between the sides."""
Summary = dict[str, dict[str, tuple[float, float, int]]]


@dataclass(frozen=True)
class GaitAnalysis:
    """Strides of a recording and their spatiotemporal parameters."""

    events: GaitEvents
    strides: tuple[Stride, ...]  #: Of both feet, by their start
    summary: Summary  #: Side -> measure of `MEASURES` -> (mean, standard deviation, n); the deviation is NaN for n = 1
    symmetry: dict[str, float]
    """Measure -> (right - left) / mean of both; 0 is symmetric. Empty if a side has no stride."""
    notes: tuple[str, ...]
    verdict: GaitVerdict

    @property
    def counted(self) -> tuple[Stride, ...]:
        """Strides of which measures and curves are: those of walking if it is gait, else all."""
        return self.verdict.walking if self.is_gait else self.strides

    @property
    def rests_on(self) -> str:
        """What the measures rest on: '1 stride, of the right side alone', '5 strides, 3 right and 2 left'."""
        counts = {side: int(own["stride_time"][2]) for side, own in self.summary.items()}
        total = sum(counts.values())
        text = f"{total} stride" + ("s" if total != 1 else "")
        if len(counts) == 1:
            return f"{text}, of the {next(iter(counts))} side alone"
        return f"{text}, {' and '.join(f'{n} {side}' for side, n in counts.items())}" if counts else text

    @property
    def is_gait(self) -> bool:
        """Whether the strides are those of walking (`recognise_gait`); measures of others mean little."""
        return self.verdict.is_gait

    @property
    def why_not(self) -> str:
        """One sentence on why the motion is no gait; '' if it is."""
        return self.verdict.why_not


@dataclass(frozen=True)
class CycleCurves:
    """One angle over the gait cycles of one side."""

    name: str
    side: str
    curves: Array  #: (n, 101) radians at `PHASES`, one row for each stride with a complete curve

    @property
    def mean(self) -> Array:
        """(101,) radians."""
        return np.asarray(self.curves.mean(axis=0))

    @property
    def sd(self) -> Array:
        """(101,) radians, between strides; NaN for a single one."""
        if len(self.curves) < 2:
            return np.full(len(PHASES), np.nan)
        return np.asarray(self.curves.std(axis=0, ddof=1))


def analyse_gait(events: GaitEvents, angles: ClinicalAngles | None = None) -> GaitAnalysis:
    """Find strides and compute their parameters by side, and the symmetry of the sides; angles: of the same motion;
    strides with unreliable knee flexion are excluded, with a note.
    """
    found = [stride for side in events.feet for stride in find_strides(side, events)]
    strides = sorted((s for s in found if _trusted(s, angles)), key=lambda stride: stride.start)
    summary: Summary = {}
    notes = list(events.notes)
    if len(strides) < len(found):
        notes.append(f"{len(found) - len(strides)} of {len(found)} strides are excluded: unreliable knee flexion")
    verdict = recognise_gait(strides, events)
    if found and not strides:
        verdict = replace(verdict, why_not="No stride has a reliable knee flexion throughout.")
    counted = verdict.walking if verdict.is_gait else strides
    for side in SIDES:
        own = [stride for stride in counted if stride.side == side]
        if own:
            summary[side] = {name: _statistics(own, name) for name in MEASURES}
        strikes = events.feet[side].strikes.size if side in events.feet else 0
        if len(own) == 1:
            notes.append(f"{side}: a single complete stride, so no standard deviation")
        elif not own and strikes:
            notes.append(
                f"{side}: {strikes} heel strike(s), but no two with a toe off and a strike of the other foot "
                f"between them within {LONGEST_STRIDE:g} s: no stride"
            )
    symmetry = {}
    if len(summary) < 2:
        notes.append("symmetry needs a complete stride of each side")
    else:
        for name in MEASURES:
            right, left = (summary[side][name][0] for side in SIDES)
            symmetry[name] = 2 * (right - left) / (right + left) if right + left > 0 else float("nan")
    found_gait = GaitAnalysis(events, tuple(strides), summary, symmetry, tuple(notes), verdict)
    if verdict.is_gait and verdict.too_few:
        first = f"all measures rest on {found_gait.rests_on}: they may not represent usual walking"
        return replace(found_gait, notes=(first, *notes))
    return found_gait


def _trusted(stride: Stride, angles: ClinicalAngles | None) -> bool:
    """Whether all values of the knee's flexion during a stride are reliable."""
    if angles is None:
        return True
    knee, own = angles.names.index(f"{stride.side}_knee_flexion"), stride.frames(angles.times)
    inside = (angles.times[own] >= stride.start) & (angles.times[own] <= stride.stop)
    return bool((angles.is_trusted(own)[:, knee] | ~np.isfinite(angles.values[own, knee]))[inside].all())


def _statistics(strides: list[Stride], name: str) -> tuple[float, float, int]:
    values = np.array([getattr(stride, name) for stride in strides])
    spread = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    return float(values.mean()), spread, len(values)


def cycle_curves(angles: ClinicalAngles, gait: GaitAnalysis) -> tuple[CycleCurves, ...]:
    """Sample each angle over the cycles of its own side; those of the trunk over the cycles of both.

    Headings are from the direction of progression, which turns evenly in a stride with a turn. Angles without
    a stride in which they are known and reliable throughout are omitted.
    """
    times, max_gap = angles.times, 1.5 / angles.rate_hz
    sampled: dict[str, list[Array]] = {side: [] for side in SIDES}
    headings = [row.about_vertical for row in angles.rows]
    for s in gait.counted:
        own, at = s.frames(times), s.start + PHASES * s.stride_time
        values = np.where(angles.is_trusted(own), angles.values[own], np.nan)
        turned = np.nan_to_num(stride_shape(s, gait.events).turn) * ((times[own] - s.start) / s.stride_time - 0.5)
        ahead = progression(s, gait.events) + turned
        values[:, headings] = (values[:, headings] - ahead[:, None] + np.pi) % (2 * np.pi) - np.pi
        sampled[s.side].append(signals.interpolate(times[own], values, at, max_gap))
    out = []
    for a, row in enumerate(angles.rows):
        for side in [side for side in SIDES if row.name.startswith(f"{side}_")] or SIDES:
            curves = [curves[:, a] for curves in sampled[side]]
            if known := [curve for curve in curves if np.isfinite(curve).all()]:
                out.append(CycleCurves(row.name, side, np.array(known)))
    return tuple(out)
