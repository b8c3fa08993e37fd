"""Visits of one person: trials of one movement, and how they were recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from typing import Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import MotionAnalysis, analyse_motion
from rtof_kin.clinical.comparison import repetition_spans
from rtof_kin.clinical.comparison_samples import Spans
from rtof_kin.clinical.strides import Stride
from rtof_kin.core.array_types import Array

OTHER_BONES: Final = 0.01
"""Relative difference from which on a bone has another length."""
OTHER_VIEW: Final = np.radians(20.0)
"""[rad] Difference of the directions from which the person was filmed that is another view."""
OTHER_PLACE: Final = 0.25
"""Relative difference of the camera's distance that is another view."""
OTHER_HEIGHT: Final = 0.3
"""[m] Difference of the camera's height that is another view."""


@dataclass(frozen=True)
class Setup:
    """How a trial was recorded and reconstructed; '' or NaN where unknown."""

    subject: str = ""
    date: str = ""
    """Day, as 2026-01-31."""
    protocol: str = ""
    mode: str = ""
    """Of the reconstruction."""
    software: str = ""
    """Package and version."""
    model: str = ""
    """Lifter and pose prior, and settings of the solver that differ from the default."""
    sensors: tuple[str, ...] = ()
    """Segments that carry one."""
    points: tuple[str, ...] = ()
    """Landmarks that the detector found."""
    cameras: int = 0
    camera_height: float = float("nan")
    """[m] above the origin of the world."""
    camera_distance: float = float("nan")
    """[m] median distance of the person."""
    view: float = float("nan")
    """[rad] mean heading of the person, from the direction in which the camera looks; NaN if it varies."""
    failed: str = ""
    """Headline of the audit where its verdict is 'fail'."""


@dataclass(frozen=True)
class Trial:
    """One motion of a visit."""

    name: str
    analysis: MotionAnalysis
    repetitions: Spans
    """Kind ('squat', 'sit_to_stand') -> start and stop of each, s."""
    stride_sigma: Mapping[Stride, float]
    """[m] standard deviation of the length of each stride by the motion's covariances; empty without any."""
    setup: Setup = field(default_factory=Setup)


@dataclass(frozen=True)
class Visit:
    """Trials of one day."""

    name: str
    trials: tuple[Trial, ...]
    """At least one."""
    day: date | None = None


def trial(name: str, motion: Motion | MotionSource, setup: Setup | None = None) -> Trial:
    """Return a motion with its analysis, repetitions and stated errors of its strides."""
    source = MotionSource.of(motion)
    analysis = analyse_motion(source)
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
    whole = {side: np.concatenate(parts) for side, parts in covariances.items()}
    return {stride: _stride_sigma(stride, whole[stride.side], analysis) for stride in strides}


def _stride_sigma(stride: Stride, covariance: Array, analysis: MotionAnalysis) -> float:
    times, heel = analysis.paths.times, analysis.gait.events.feet[stride.side].heel
    first, last = (int(np.abs(times - at).argmin()) for at in (stride.start, stride.stop))
    way = (heel[last] - heel[first])[:2]
    along = way / max(float(np.linalg.norm(way)), 1e-9)
    both = (covariance[first] + covariance[last])[:2, :2]
    return float(np.sqrt(max(along @ both @ along, 0.0)))


def incomparable(visits: Sequence[Visit], baseline: int) -> tuple[str, ...]:
    """Return sentences on what makes visits not comparable with the baseline, the gravest first.

    Args:
        baseline: index of the visit that the others are compared with.
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
            out.append(f"{text} ({_few(changes) or 'not in all trials'})")
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


def _few(texts: Sequence[str], most: int = 4) -> str:
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more
