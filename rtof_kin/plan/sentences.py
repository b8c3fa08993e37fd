"""A plan in sentences: what to expect, what is not identifiable and why, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.plan.identifiability import Weakness
from rtof_kin.plan.plan import SEEN, Option, Plan
from rtof_kin.plan.setup import Setup

_CLEAR: Final = 0.1
"""Least gain in the mean standard deviation, relative to it, that is worth a change: others are within the
scatter of a few simulated recordings."""
_APART: Final = 1.5
"""Ratio of simulated to stated errors beyond which a caution is given."""


def headline(plan: Plan) -> str:
    """Return the first line: the expected accuracy, and how many angles are not to be had."""
    own = plan.prediction.select(plan.shown)
    known = np.isfinite(own.sigma)
    if not known.any():
        return "Expected: none of the angles is observed in this setup."
    mean = np.degrees(np.mean(own.sigma[known]))
    parts = [f"Expected standard deviation: {mean:.1f} deg, mean of {known.sum()} angles"]
    if plan.weaknesses:
        parts.append(f"{len(plan.weaknesses)} of {len(own.names)} are not identifiable by camera and sensors")
    if not known.all():
        parts.append(f"{np.count_nonzero(~known)} are not observed")
    if plan.protocol.wanted_sd_deg is not None:
        missed = ", ".join(name.replace("_", " ") for name in plan.unreached)
        what = f"{plan.protocol.wanted_sd_deg:g} deg wanted"
        parts.append(f"{what}: missed by {missed}" if missed else f"{what}: reached by all")
    return "; ".join(parts) + "."


def cautions(plan: Plan) -> tuple[str, ...]:
    """Return what makes one doubt the plan, in sentences."""
    found = []
    if plan.seen < SEEN:
        found.append(
            f"only {100 * plan.seen:.0f} % of the body is in the image over the movement: move the camera "
            "back, or use a wider lens"
        )
    own = plan.prediction.select(plan.shown)
    with np.errstate(invalid="ignore"):
        apart = own.error > _APART * own.sigma
    names = [name.replace("_", " ") for name, far in zip(own.names, apart, strict=True) if far]
    if names:
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        found.append(
            f"simulated errors of {', '.join(names[:3])}{more} are more than {_APART:g} times the standard "
            f"deviation stated, over {own.draws} simulated recording(s)"
        )
    return tuple(found)


def advice(plan: Plan) -> tuple[str, ...]:
    """Return what is not identifiable, the best camera place, the next sensor and how long to move."""
    found = list(_not_identifiable(plan.weaknesses))
    cameras = [option for option in plan.cameras if not option.problem]
    if cameras and cameras[0].name == plan.protocol.camera.words:
        best, worst = cameras[0], cameras[-1]
        found.append(
            f"Camera place: {best.name}, the best of {len(cameras)} compared; mean "
            f"{np.degrees(best.loss):.1f} deg, the worst ({worst.name.partition(', ')[0]}) "
            f"{np.degrees(worst.loss):.1f} deg."
        )
    elif cameras and _is_clear(cameras[0]):
        best = cameras[0]
        found.append(
            f"Better camera place: {best.name}; mean {np.degrees(best.loss):.1f} deg, "
            f"{np.degrees(best.gain):.1f} deg less, most at {best.most.replace('_', ' ')}."
        )
    elif cameras:
        best = cameras[0]
        found.append(
            f"No other camera place is clearly better; the best is {best.name}, by {np.degrees(best.gain):.1f} deg."
        )
    blind = [option for option in plan.cameras if option.problem]
    if blind:
        found.append(
            f"{len(blind)} of {len(plan.cameras)} camera places are not possible; {blind[0].name}: {blind[0].problem}."
        )
    sensors = [option for option in plan.sensors if not option.problem and option.name]
    if sensors:
        best = sensors[0]
        name = f"{best.name} ({where(plan.setup, best.name)})"
        found.append(
            f"Best next sensor: {name}; mean {np.degrees(best.loss):.1f} deg, "
            f"{np.degrees(best.gain):.1f} deg less, most at {best.most.replace('_', ' ')}."
            if _is_clear(best)
            else f"No further sensor lowers the mean by {100 * _CLEAR:.0f} %; the best is {name}."
        )
    if plan.calibration is not None:
        found.append(plan.calibration.words)
    return tuple(found)


def _is_clear(option: Option) -> bool:
    return option.gain > _CLEAR * (option.loss + option.gain)


def _not_identifiable(weaknesses: Sequence[Weakness]) -> Iterator[str]:
    """Angles that are confused with each other in one sentence, and those that nothing depends on."""
    groups: list[list[str]] = []
    for weakness in weaknesses:
        if not weakness.confused_with:
            continue
        both = [weakness.confused_with, weakness.angle]
        joined = [group for group in groups if {*group} & {*both}]
        groups = [group for group in groups if group not in joined]
        groups.append(list(dict.fromkeys([name for group in joined for name in group] + both)))
    for group in groups:
        first, *others = (name.replace("_", " ") for name in group)
        yield (
            f"Not identifiable: {first} against {', '.join(others)}: changes of these together leave image "
            "and sensors nearly as they are, so their split is that of a usual person."
        )
    alone = [weakness.angle.replace("_", " ") for weakness in weaknesses if not weakness.confused_with]
    if alone:
        yield (
            f"Not identifiable: {', '.join(alone)}: image and sensors hardly depend on them, so they are "
            "those of a usual person in this posture."
        )


def where(setup: Setup, sensor: str) -> str:
    """Return the segment of a sensor in words.

    Args:
        sensor: name in the skeleton's table.
    """
    joint, _ = setup.skeleton.sensors[sensor]
    terms = {own: term for term, own in angle_table(setup.skeleton.table).segments.items()}
    return terms.get(joint, joint).replace("_", " ")
