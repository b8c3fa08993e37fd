"""Measures that are followed over visits: of each angle, and of gait.

==============  =========================================================================================
by              measures of each angle, of each trial
==============  =========================================================================================
cycle           mean, range, largest and smallest angle of a gait cycle; means over the strides
repetition      the same of a repetition; means over repetitions
range           range, largest and smallest angle of the whole recording, not its mean, which depends on
                what else was done
==============  =========================================================================================

By cycle there are also stride time, length and stance share of each side, cadence and speed of both, and the
symmetries of the sides, (right - left) / mean. The length of a stride, its symmetry and the speed have a band by the
covariances of the foot at both ends; nothing states the error of the instant of an event, so times have none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.comparison import HEADINGS, LEAST_SHARE
from rtof_kin.clinical.comparison_change import Measured
from rtof_kin.clinical.comparison_samples import own_side, repeats_of, whole
from rtof_kin.clinical.strides import Stride
from rtof_kin.clinical.visits import Trial
from rtof_kin.core.array_types import Array

Movement = Literal["cycle", "repetition", "range"]
MOVEMENTS: Final[tuple[Movement, ...]] = get_args(Movement)
Better = Literal["up", "down", "zero"]
BETTERS: Final[tuple[Better, ...]] = get_args(Better)
BETTER: Final[dict[str, Better]] = {
    "gait_speed": "up",
    "stride_time_symmetry": "zero",
    "stride_length_symmetry": "zero",
    "stance_share_symmetry": "zero",
}
"""Measures of which a direction is better whatever the patient has; the user declares others."""
SCALES: Final = {"deg": float(np.degrees(1.0)), "%": 100.0, "s": 1.0, "m": 1.0, "m/s": 1.0, "steps/min": 1.0}
"""Unit of output -> its number in the unit of computation (rad, share, s, m, m/s, steps/min)."""
STATISTICS: Final = {"mean": "mean", "range": "range", "max": "high", "min": "low"}
"""End of a measure's name -> method of `Samples`."""
_SYMMETRIC: Final = ("stride_time", "stride_length", "stance_share")
_UNITS: Final = {"stride_time": "s", "stride_length": "m", "stance_share": "%"}


@dataclass(frozen=True)
class Measure:
    """What is followed."""

    name: str
    """E.g. 'right_knee_flexion_range', 'gait_speed', 'right_stride_length', 'stance_share_symmetry'."""
    unit: str
    """Unit of output, of `SCALES`."""
    positive: str = ""
    """The movement that is positive, of an angle."""

    @property
    def is_gait(self) -> bool:
        """Whether it is a parameter of gait rather than of an angle."""
        return self.unit != "deg"

    @property
    def scale(self) -> float:
        """Unit of output per unit of computation."""
        return SCALES[self.unit]


def measures_of(trial: Trial, by: Movement, kind: str = "") -> dict[Measure, Measured]:
    """Return the measures of one trial that it has, from all its strides or repetitions."""
    out = dict(_angles(trial, by, kind))
    if by == "cycle":
        out |= _gait(trial)
    return out


def _angles(trial: Trial, by: Movement, kind: str) -> Iterator[tuple[Measure, Measured]]:
    angles = trial.analysis.angles
    strides = {side: [(s.start, s.stop) for s in trial.analysis.gait.counted if s.side == side] for side in SIDES}
    spans = strides if by == "cycle" else {"": trial.repetitions.get(kind, ())}
    ranges = {row.name: row for row in trial.analysis.ranges}
    for row in angles.rows:
        if row.name in HEADINGS or row.about_vertical:
            continue
        if by == "range":
            samples, _ = whole(angles, row.name)
            enough = ranges[row.name].is_comparable
        else:
            side = own_side(row.name, spans, spans)
            if side is None:
                continue
            every = repeats_of(angles, row.name, spans[side])
            samples = every.only(every.complete)
            enough = len(samples.values) >= max(1, LEAST_SHARE * len(every.values))
        if enough:
            for end, method in STATISTICS.items():
                if by != "range" or end != "mean":
                    yield Measure(f"{row.name}_{end}", "deg", row.positive), getattr(samples, method)()


def _gait(trial: Trial) -> dict[Measure, Measured]:
    gait, sigma = trial.analysis.gait, trial.stride_sigma
    moving = not gait.verdict.on_the_spot
    out = {}
    if gait.counted:
        out[Measure("gait_cadence", "steps/min")] = _over(gait.counted, "cadence")
        if moving:
            speeds = [sigma[s] / s.stride_time for s in gait.counted if s in sigma]
            out[Measure("gait_speed", "m/s")] = _over(gait.counted, "speed", speeds)
    for side in SIDES:
        own = [stride for stride in gait.counted if stride.side == side]
        for name, unit in _UNITS.items() if own else ():
            if name != "stride_length" or moving:
                stated = [sigma[s] for s in own if s in sigma] if name == "stride_length" else []
                out[Measure(f"{side}_{name}", unit)] = _over(own, name, stated)
    for name in _SYMMETRIC:
        value = gait.symmetry.get(name, float("nan"))
        if np.isfinite(value) and (name != "stride_length" or moving):
            out[Measure(f"{name}_symmetry", "%")] = Measured(np.array([value]), _symmetry_band(out, name))
    return out


def _symmetry_band(gait: Mapping[Measure, Measured], name: str) -> float:
    """Of (right - left) / mean, as of independent errors of the sides; 0 where they have no bands."""
    sides = [own for measure, own in gait.items() if measure.name in [f"{side}_{name}" for side in SIDES]]
    if not all(own.band_sigma > 0 for own in sides):
        return 0.0
    size = np.sqrt(sum(own.band_sigma**2 for own in sides))
    return float(size / np.mean([own.mean for own in sides]))


def _over(strides: Sequence[Stride], name: str, sigmas: Sequence[float] = ()) -> Measured:
    """One measure of strides, with the mean of their bands: they share their errors."""
    values: Array = np.array([getattr(stride, name) for stride in strides])
    known = [sigma for sigma in sigmas if np.isfinite(sigma)]
    return Measured(values, float(np.mean(known)) if known else 0.0)
