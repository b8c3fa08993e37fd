"""Visits of one person: trials of one movement, and how they were recorded.

**Measures.** Measures that are followed over visits: of each angle, and of gait.

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
from dataclasses import dataclass, field
from datetime import date
from typing import Final, Literal, get_args

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.comparison import HEADINGS, LEAST_SHARE, repetition_spans, with_strides
from rtof_kin.clinical.comparison_change import Made, Measured
from rtof_kin.clinical.comparison_samples import Spans, extremes, own_side, repeats_of
from rtof_kin.clinical.gait_events import Stride
from rtof_kin.clinical.repetitions import KINDS
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, some
from rtof_kin.core.errors import InvalidInputError

OTHER_BONES: Final = 0.01  #: Relative difference from which on a bone has another length
OTHER_VIEW: Final = np.radians(20.0)
"""[rad] Difference of the directions from which the person was filmed that is another view."""
OTHER_PLACE: Final = 0.25  #: Relative difference of the camera's distance that is another view
OTHER_HEIGHT: Final = 0.3  #: [m] Difference of the camera's height that is another view


@dataclass(frozen=True)
class Setup:
    """How a trial was recorded and reconstructed; '' or NaN where unknown."""

    subject: str = ""
    date: str = ""  #: Day, as 2026-01-31
    protocol: str = ""
    mode: str = ""  #: Of the reconstruction
    software: str = ""  #: Package and version
    model: str = ""  #: Lifter and pose prior, and settings of the solver that differ from the default
    sensors: tuple[str, ...] = ()  #: Segments that carry one
    points: tuple[str, ...] = ()  #: Landmarks that the detector found
    cameras: int = 0
    camera_height: float = float("nan")  #: [m] above the origin of the world
    camera_distance: float = float("nan")  #: [m] median distance of the person
    view: float = float("nan")
    """[rad] mean heading of the person, from the direction in which the camera looks; NaN if it varies."""
    certified: float = float("nan")  #: [deg] error of a segment without its sensor, by its certificate
    failed: str = ""  #: Headline of the audit where its verdict is 'fail'
    person: tuple[str, ...] = ()  #: Identifier of the person's file and digest of bones and posture; empty without one

    calibrated: bool = False  #: Whether mountings were found from the recording itself

    @property
    def made(self) -> Made | None:
        """How it was made, where the person is known."""
        how = (self.person, self.mode, self.software, self.model, self.points, self.cameras)
        return Made(how, self.sensors, self.calibrated) if self.person else None


@dataclass(frozen=True)
class Trial:
    """One motion of a visit."""

    name: str
    analysis: MotionAnalysis
    repetitions: Spans  #: Kind ('squat', 'sit_to_stand') -> start and stop of each, s
    stride_sigma: Mapping[Stride, float]
    """[m] standard deviation of the length of each stride by the motion's covariances; empty without any."""
    setup: Setup = field(default_factory=Setup)


@dataclass(frozen=True)
class Visit:
    """Trials of one day."""

    name: str
    trials: tuple[Trial, ...]  #: At least one
    day: date | None = None


def trial(name: str, motion: Motion | MotionSource, setup: Setup | None = None) -> Trial:
    """Return a motion with its analysis, repetitions and stated errors of its strides."""
    source = MotionSource.of(motion)
    analysis = analyse(source)
    spans = repetition_spans(analysis.paths, analysis.angles)
    return Trial(name, analysis, spans, _stride_sigmas(source, analysis), setup or Setup())


def _stride_sigmas(source: MotionSource, analysis: MotionAnalysis) -> dict[Stride, float]:
    """[m] of the length of each stride, along its way, as if the errors at its two ends were independent."""
    strides, paths = analysis.gait.strides, analysis.paths
    if not strides:
        return {}
    feet = {stride.side: paths.joint(f"{stride.side} foot") for stride in strides}
    covariances: dict[str, list[Array]] = {side: [] for side in feet}
    for block in source.blocks(confidence=True):
        if block.motion.confidence is None:
            return {}
        for side, joint in feet.items():
            covariances[side].append(block.motion.confidence.position_covariance[block.own, joint])
    whole, out = {side: np.concatenate(parts) for side, parts in covariances.items()}, {}
    for stride in strides:
        heel, covariance = analysis.gait.events.feet[stride.side].heel, whole[stride.side]
        first, last = (int(np.abs(paths.times - at).argmin()) for at in (stride.start, stride.stop))
        way = (heel[last] - heel[first])[:2]
        along = way / max(float(np.linalg.norm(way)), 1e-9)
        both = (covariance[first] + covariance[last])[:2, :2]
        out[stride] = float(np.sqrt(max(along @ both @ along, 0.0)))
    return out


def incomparable(visits: Sequence[Visit], baseline: int) -> tuple[str, ...]:
    """Return sentences on what makes visits not comparable with the baseline, the gravest first; baseline: index of the
    visit that the others are compared with.
    """
    first, lines = visits[baseline], list[str]()
    for visit in visits:
        if failed := [one for one in visit.trials if one.setup.failed]:
            names = ", ".join(one.name for one in failed)
            lines.append(f"{visit.name}: the audit of {names} failed ({failed[0].setup.failed})")
    for visit in visits:
        lines += [f"{visit.name}: {cause}" for cause in _within(visit)]
        if visit is not first:
            lines += [f"{visit.name}: {cause} than {first.name}" for cause in _differences(first, visit)]
    return tuple(lines)


def _within(visit: Visit) -> list[str]:
    """Differences between the trials of one visit, in the setup that its errors depend on."""
    out, one = [], visit.trials[0]
    for other in visit.trials[1:]:
        causes = _differences(Visit(visit.name, (one,)), Visit(visit.name, (other,)), view=False)
        out += [f"{other.name} has {cause} than {one.name}" for cause in causes]
    return out


_TEXTS: Final = {
    "subject": "another person",
    "mode": "another mode of reconstruction",
    "software": "another version",
    "model": "another lifter or other settings",
    "protocol": "another task",
}


def _differences(a: Visit, b: Visit, view: bool = True) -> list[str]:
    """Causes in words, which end before 'than'; a person may walk to and fro in one visit."""
    out = []
    for name, text in _TEXTS.items():
        known = [{getattr(one.setup, name) for one in visit.trials} - {""} for visit in (a, b)]
        if all(known) and known[0] != known[1]:
            out.append(f"{text} ({', '.join(sorted(known[1]))})")
    out += _other_sensors(a, b)
    if (bones := _other_bones(a, b)) is not None:
        out.append(f"other body lengths ({bones})")
    if view and (what := _other_view(a, b)) is not None:
        out.append(f"another camera view ({what})")
    return out


def _other_sensors(a: Visit, b: Visit) -> list[str]:
    out = []
    for name, text in (("sensors", "other sensors"), ("points", "another detector's points")):
        sets = [{getattr(one.setup, name) for one in visit.trials} for visit in (a, b)]
        if sets[0] != sets[1]:
            before, after = (set().union(*found) for found in sets)
            changes = [f"without {joint}" for joint in sorted(before - after)]
            changes += [f"with {joint}" for joint in sorted(after - before)]
            out.append(f"{text} ({some(changes, 4) or 'not in all trials'})")
    return out


def _other_bones(a: Visit, b: Visit) -> str | None:
    """Bone whose length differs most, where one does."""
    first, second = (visit.trials[0].analysis.paths.skeleton.bone_lengths for visit in (a, b))
    off = {bone: abs(second[bone] / length - 1) for bone, length in first.items() if bone in second and length > 0}
    worst = max(off, key=lambda bone: off[bone])
    if off[worst] < OTHER_BONES:
        return None
    return f"{worst} {100 * second[worst]:.1f} cm rather than {100 * first[worst]:.1f} cm"


def _other_view(a: Visit, b: Visit) -> str | None:
    """What differs about the camera, where anything does."""
    own = [[one.setup for one in visit.trials] for visit in (a, b)]
    if (n := [max(one.cameras for one in found) for found in own])[0] != n[1]:
        return f"{n[1]} cameras rather than {n[0]}"
    for setup in own[1]:
        gaps = [abs(np.angle(np.exp(1j * (setup.view - one.view)))) for one in own[0]]
        if all(gap > OTHER_VIEW for gap in gaps):  # not for NaN
            return f"filmed {np.degrees(min(gaps)):.0f} deg further around the person"
    for name, limit, relative in (("camera_distance", OTHER_PLACE, True), ("camera_height", OTHER_HEIGHT, False)):
        x, y = (float(np.mean([getattr(one, name) for one in found])) for found in own)
        if abs(y - x) > limit * (x if relative else 1.0):
            return f"{name.replace('_', ' ')} {y:.1f} m rather than {x:.1f} m"
    return None


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
_UNITS: Final = {"stride_time": "s", "stride_length": "m", "stance_share": "%"}


@dataclass(frozen=True)
class Measure:
    """What is followed."""

    name: str  #: E.g. 'right_knee_flexion_range', 'gait_speed', 'right_stride_length', 'stance_share_symmetry'.
    unit: str  #: Unit of output, of `SCALES`
    positive: str = ""  #: The movement that is positive, of an angle

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
    return dict(_angles(trial, by, kind)) | (_gait(trial) if by == "cycle" else {})


def _angles(trial: Trial, by: Movement, kind: str) -> Iterator[tuple[Measure, Measured]]:
    angles = trial.analysis.angles
    strides = with_strides(trial.name, angles, trial.analysis.gait).strides
    spans = strides if by == "cycle" else {"": trial.repetitions.get(kind, ())}
    ranges = {row.name: row for row in trial.analysis.ranges}
    for row in angles.rows:
        if row.name in HEADINGS or row.about_vertical:
            continue
        if by == "range":
            samples, _ = extremes(angles.select([row.name]))
            enough = ranges[row.name].is_comparable
        else:
            side = own_side(row.name, spans, spans)
            if side is None:
                continue
            every = repeats_of(angles.select([row.name]), spans[side])
            samples = every.only(every.complete)
            enough = len(samples.values) >= max(1, LEAST_SHARE * len(every.values))
        if enough:
            for end, method in STATISTICS.items():
                if by != "range" or end != "mean":
                    yield Measure(f"{row.name}_{end}", "deg", row.positive), getattr(samples, method)()


def _gait(trial: Trial) -> dict[Measure, Measured]:
    gait, sigma = trial.analysis.gait, trial.stride_sigma
    out = {}
    if gait.counted:
        out[Measure("gait_cadence", "steps/min")] = _over(gait.counted, "cadence")
        speeds = [sigma[s] / s.stride_time for s in gait.counted if s in sigma]
        out[Measure("gait_speed", "m/s")] = _over(gait.counted, "speed", speeds)
    for side in SIDES:
        own = [stride for stride in gait.counted if stride.side == side]
        for name, unit in _UNITS.items() if own else ():
            stated = [sigma[s] for s in own if s in sigma] if name == "stride_length" else []
            out[Measure(f"{side}_{name}", unit)] = _over(own, name, stated)
    for name in _UNITS:
        if np.isfinite(value := gait.symmetry.get(name, float("nan"))):
            sides = [own for measure, own in out.items() if measure.name in [f"{side}_{name}" for side in SIDES]]
            band = 0.0  # of (right - left) / mean, as of independent errors of the sides
            if all(own.band_sigma > 0 for own in sides):
                band = float(np.sqrt(sum(own.band_sigma**2 for own in sides)) / np.mean([own.mean for own in sides]))
            out[Measure(f"{name}_symmetry", "%")] = Measured(np.array([value]), band)
    if gait.verdict.on_the_spot:
        return {one: value for one, value in out.items() if "stride_length" not in one.name and one.unit != "m/s"}
    return out


def _over(strides: Sequence[Stride], name: str, sigmas: Sequence[float] = ()) -> Measured:
    """One measure of strides, with the mean of their bands: they share their errors."""
    values: Array = np.array([getattr(stride, name) for stride in strides])
    known = [sigma for sigma in sigmas if np.isfinite(sigma)]
    return Measured(values, float(np.mean(known)) if known else 0.0)


LEAST_REPEATS: Final = 2  #: Fewest repetitions in each trial by which trials are measured by default


def movement(visits: Sequence[Visit], by: Movement | None, kind: str) -> tuple[Movement, str, str, dict[str, str]]:
    """Return what is measured over, the kind of the repetitions, why, and trials left out -> why.
    `InvalidInputError`: a visit does not have what is requested; `UnknownNameError`: no such kind.

    Args:
        by: None to choose. kind: of the repetitions; '' to choose.
    """
    every = [one for visit in visits for one in visit.trials]
    walking = [[one for one in visit.trials if not _not_gait(one)] for visit in visits]
    if by == "cycle" or (by is None and all(walking)):
        if absent := [v.name for v, own in zip(visits, walking, strict=True) if not own]:
            raise InvalidInputError(f"follow: no gait in {', '.join(absent)}; measure by repetition or range (--by)")
        left = [(visit.name, one) for visit in visits for one in visit.trials if _not_gait(one)]
        out = {f"{name}, {one.name}": f"left out, not gait: {_not_gait(one)}" for name, one in left}
        return "cycle", "", "" if by else "all visits are walking", out
    if kind:
        indices_of("kind of repetitions", [kind], KINDS)
    least = {k: min(len(one.repetitions.get(k, ())) for one in every) for k in ([kind] if kind else KINDS)}
    best = max(least, key=lambda k: least[k])
    if by == "repetition" and not least[best]:
        raise InvalidInputError(f"follow: not all trials have a {best}; measure by another (--by)")
    if by == "repetition" or (by is None and least[best] >= LEAST_REPEATS):
        why = "" if by else f"all trials have {LEAST_REPEATS} repetitions or more"
        return "repetition", best, why, {}
    why = "" if by else "neither gait nor repetitions are in all trials"
    others = zip(visits, walking, strict=True) if any(walking) else ()
    return (
        "range",
        "",
        why,
        {
            visit.name: f"another movement: not gait, as others are ({_not_gait(visit.trials[0])})"
            for visit, own in others
            if not own
        },
    )


def _not_gait(trial: Trial) -> str:
    """Sentence on why a trial is not measured by its gait; '' if it is."""
    gait = trial.analysis.gait
    return gait.why_not or gait.verdict.too_few
