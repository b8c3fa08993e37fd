"""Recognition of walking among the strides of a motion.

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

from rtof_kin.clinical.gait_events import GaitEvents
from rtof_kin.clinical.strides import Stride
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

STANCE: Final = (0.55, 0.82)
"""Stance shares of walking, of the stride time; slow walking has up to four fifths."""
PHASE: Final = (0.32, 0.68)
"""Strike of the other foot, share of the stride time."""
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
MID_STANCE: Final = np.array([0.2, 0.7])
"""Share of stance in which a heel stands, or moves with a treadmill's belt."""
FEWEST: Final = 3
"""Strides of both feet together from which on walking is told whatever else the recording shows."""
MOST_OF_TIME: Final = 0.5
"""Share of the recording that fewer strides must take; those within other movements take less."""
LEAST_SHARE: Final = 0.6  # of the strides found that are those of walking
UNSTEADY: Final = 0.15  # coefficient of variation of stride times


@dataclass(frozen=True)
class StrideShape:
    """Shape of one stride, from which walking is told; NaN where unknown."""

    stance_share: float
    """Stance time divided by stride time."""
    phase: float
    """Strike of the other foot, share of the stride time."""
    swing: float
    """[m] excursion of the heel relative to the pelvis, along its heading."""
    progress: float
    """[m] horizontal way of the pelvis from start to stop."""
    forward: float
    """Cosine between that way and the mean heading."""
    turn: float
    """[rad] change of the heading from start to stop."""
    slip: float
    """[m] horizontal way of the heel in world from 20 to 70 % of stance."""


@dataclass(frozen=True)
class GaitVerdict:
    """Whether a motion is gait, and which of its strides are those of walking."""

    walking: tuple[Stride, ...]
    """Strides of walking, by their start."""
    on_the_spot: bool
    """Whether the pelvis stays where it is: a treadmill, or walking on the spot."""
    why_not: str
    """One sentence on why the motion is no gait; '' if it is."""

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
    others = [foot.strikes for side, foot in events.feet.items() if side != stride.side]
    between = [
        t
        for strikes in others
        for t in strikes[signals.within(strikes, stride.start, stride.stop)]
        if stride.start < t < stride.stop
    ]
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
    """Return the share of a recording within strides.

    Args:
        times: (T,) s.
    """
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
    wrong = {
        f"stance takes less than {100 * STANCE[0]:.0f} % of the stride, as in running and jumping": shape.stance_share
        < STANCE[0],
        f"stance takes more than {100 * STANCE[1]:.0f} % of the stride": shape.stance_share > STANCE[1],
        "the feet do not alternate evenly": not (one_foot or low <= shape.phase <= high),
        f"the foot swings less than {swing:.2f} m past the pelvis": not shape.swing >= swing,
        f"the pelvis advances by {ON_THE_SPOT:.1f} to {LEAST_PROGRESS:.1f} m in a stride": not (
            spot or shape.progress >= LEAST_PROGRESS
        ),
        "the person moves backward or sideways": not (spot or shape.forward >= FORWARD),
        f"the person turns by more than {np.degrees(LARGEST_TURN):.0f} deg within a stride": not abs(shape.turn)
        <= LARGEST_TURN,
        "the foot slides or hops during stance": not (spot or shape.slip <= LARGEST_SLIP),
        "in place, the feet do not glide back as on a treadmill": spot
        and not BELT[0] <= shape.slip / max(shape.swing, 1e-9) <= BELT[1],
    }
    return tuple(text for text, flag in wrong.items() if flag)


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
