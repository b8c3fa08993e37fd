"""Reference of the gait scores from recordings of healthy people.

Every person counts once: the mean over the strides of a side in all recordings of that person. Mean and
standard deviation of the reference are those over people, right and left pooled.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait_scores import side_curves
from rtof_kin.clinical.gait_variables import GaitCycles
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.gait_reference import NAMES, GaitReference

FEW: Final = 10
"""People below whose number scores are said to be relative to few."""
LEAST_STRIDES: Final = 3
"""Strides of each side that a person needs."""


def build_reference(
    people: Mapping[str, GaitCycles], *, least_strides: int = LEAST_STRIDES, **about: Any
) -> tuple[GaitReference, dict[str, str]]:
    """Return a reference, and the people that are left out with the reasons.

    Args:
        least_strides: see `LEAST_STRIDES`. about: fields of `GaitReference`: licence, source, system, zero, notes.

    Raises:
        InvalidInputError: fewer than two people are left, or a licence or source is missing.
    """
    kept, left_out = {}, {}
    for code, cycles in people.items():
        if reason := unsuitable(cycles, least_strides):
            left_out[code] = reason
        else:
            kept[code] = cycles
    if len(kept) < 2:
        why = "; ".join(f"{code}: {reason}" for code, reason in list(left_out.items())[:3])
        raise InvalidInputError(
            f"gait reference: {len(kept)} of {len(people)} people can be used, and two are needed ({why})"
        )
    curves = np.array([[side_curves(own, side).mean for side in SIDES] for own in kept.values()])
    pooled = curves.mean(axis=1)
    speeds = tuple(own.speed for own in kept.values())
    known = [speed for speed in speeds if np.isfinite(speed)]
    return GaitReference(
        pooled.mean(axis=0),
        curves.std(axis=(0, 1), ddof=1),
        len(kept),
        curves=curves,
        names=tuple(kept),
        strides=tuple((own.sides.count("right"), own.sides.count("left")) for own in kept.values()),
        speeds=speeds,
        speed_range=(min(known), max(known)) if known else None,
        **about,
    ), left_out


def unsuitable(cycles: GaitCycles, least_strides: int) -> str:
    """Return why a person cannot be part of a reference; '' if that is possible.

    Args:
        least_strides: of each side, with all variables.
    """
    if cycles.why_not:
        return cycles.why_not
    for side in SIDES:
        if missing := cycles.missing(side):
            needs = "; ".join(f"{name} needs {what}" for name, what in missing.items())
            return f"{side} cycle: {needs}"
        few = cycles.complete(side).sum(axis=0)
        if few.min() < least_strides:
            return f"{few.min()} {side} strides with {NAMES[int(few.argmin())]}; {least_strides} are needed"
    return ""
