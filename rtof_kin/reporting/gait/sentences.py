"""Gait scores in words: the scores, what is missing, and what to be careful about."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.clinical.gait_reference import FEW
from rtof_kin.clinical.gait_scores import Score
from rtof_kin.data.gait_reference import MODEL_ZERO, NAMES, STANDING_ZERO
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.gait.result import ScoredGait

LEAST_EXPLAINED: Final = 0.8
"""Share of a deviation outside of which the features do not describe it."""
_FEW_STRIDES: Final = 4
_ZEROS: Final = {MODEL_ZERO: "the model's anatomical posture", STANDING_ZERO: "each person's quiet standing"}


def opening(found: ScoredGait) -> list[str]:
    """Return the first lines: another system's reference, then the scores or why there are none."""
    lines = [another_system(found)] if not found.reference.is_own else []
    if found.scores is None:
        return [*lines, f"No gait scores: {found.cycles.why_not}"]
    lines.append(f"{_profile(found)}.")
    if found.missing:
        by_need: dict[str, list[str]] = {}
        for name, needs in found.missing.items():
            by_need.setdefault(needs, []).append(label(name))
        text = "; ".join(f"{', '.join(names)} (needs {needs})" for needs, names in by_need.items())
        lines.append(f"Not observed in a whole stride: {text}.")
    lines.append(_index(found))
    return lines


def another_system(found: ScoredGait) -> str:
    """Return what to think of a reference that another system made."""
    return (
        f"The reference is of another system ({found.reference.system}; zero: {found.reference.zero}): its "
        "model has other zeros, above all of pelvic tilt, hip rotation and ankle, and a constant offset "
        "between the two counts as a deviation of the person."
    )


def cautions(found: ScoredGait) -> list[str]:
    """Return what to be careful about, one sentence each."""
    reference, scores = found.reference, found.scores
    lines = []
    if scores is not None:
        lines += _about_bands(found)
        explained = [one.explained for one in found.index.values()]
        if explained and min(explained) < LEAST_EXPLAINED:
            lines.append(
                f"the features of the GDI have {100 * min(explained):.0f} % of the deviation; in the rest "
                "people of the reference do not differ, so the GDI is too good: use the GPS"
            )
        speed, speeds = found.cycles.speed, reference.speed_range
        if np.isfinite(speed) and speeds is not None and not speeds[0] <= speed <= speeds[1]:
            lines.append(
                f"the person walks at {speed:.2f} m/s, the people of the reference at {speeds[0]:.2f} to "
                f"{speeds[1]:.2f} m/s; curves depend on speed"
            )
    if reference.people < FEW:
        lines.append(
            f"scores are relative to {reference.people} people, fewer than {FEW}; their mean is itself known "
            f"to \u00b1{_of_mean(found):.1f} deg (standard error)"
        )
    zero = _ZEROS.get(reference.zero)
    if zero and reference.zero == STANDING_ZERO:
        lines.append(f"angles of trunk and legs are relative to {zero}, as in the reference")
    return [*lines, *found.cycles.notes, *(f"reference: {note}" for note in reference.notes)]


def score_text(score: Score) -> str:
    """Return a score with its band, deg."""
    if not np.isfinite(score.value):
        return "not computed"
    text = f"{np.degrees(score.value):.1f}"
    if score.noise == 0:
        return text
    return f"{text} ({np.degrees(score.low):.1f} to {np.degrees(score.high):.1f})"


def _profile(found: ScoredGait) -> str:
    """Gait Profile Score, and that of the reference's people."""
    scores = found.scores
    assert scores is not None
    parts = [f"{side} {score_text(score)}" for side, score in scores.sides.items()]
    text = f"{found.name}: GPS {score_text(scores.overall)} deg, {', '.join(parts)}"
    if found.people is not None:
        own = np.degrees(found.people[1])
        text += f"; people of the reference {own.min():.1f} to {own.max():.1f}, median {np.median(own):.1f}"
    return text


def _index(found: ScoredGait) -> str:
    """Gait Deviation Index, or why there is none."""
    if not found.index:
        return f"GDI not computed: {found.why_no_index}"
    parts = []
    for side, one in found.index.items():
        high = f"to {one.high:.0f}" if np.isfinite(one.high) else "or more"
        parts.append(f"{side} {one.value:.0f} ({one.low:.0f} {high})")
    return f"GDI {', '.join(parts)}; 100 is the mean of the reference, 10 its standard deviation."


def _about_bands(found: ScoredGait) -> list[str]:
    scores = found.scores
    assert scores is not None
    if not scores.has_bands:
        return ["the motion has no covariances: bands have the spread between strides alone"]
    known = [one for own in scores.profile.values() for one in own if np.isfinite(one.value)]
    unknown = [
        f"{side} {label(name)}"
        for side, own in scores.profile.items()
        for name, one in zip(NAMES, own, strict=True)
        if np.isfinite(one.value) and np.isnan(one.pose_sigma)
    ]
    lines = []
    if unknown:
        lines.append(f"bands are without the errors of the poses, as some are unknown: {', '.join(unknown)}")
    if known:
        noise = np.degrees(np.sqrt(np.mean([one.noise**2 for one in known])))
        size = np.degrees(np.sqrt(np.mean([one.value**2 for one in known])))
        left = np.sqrt(max(0.0, size**2 - noise**2))
        fewest = min(one.strides for one in known)
        if fewest < _FEW_STRIDES:
            lines.append(f"{fewest} strides of a side: their spread is hardly known, so bands are wide")
        lines.append(
            f"errors of the curves make scores too large: they alone would give {noise:.1f} deg, and without "
            f"them the root mean square of {size:.1f} deg would be about {left:.1f}"
        )
    return lines


def _of_mean(found: ScoredGait) -> float:
    """Root mean square standard error of the reference's mean, deg."""
    reference = found.reference
    return float(np.degrees(np.sqrt(np.nanmean(reference.sd**2) / reference.people)))
