"""Joint angles relative to a person's own standing posture."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.core import signals
from rtof_kin.core.errors import InvalidInputError

_SHORTEST: Final = 0.5
"""Shortest time of standing still that counts, s."""
_OWN_ZERO: Final = ("rotation", "shoulder", "elbow", "wrist")
"""Parts of names of angles that standing does not define."""


def relative_to_standing(angles: ClinicalAngles, paths: BodyPaths) -> ClinicalAngles:
    """Return angles from which those of the person's quiet standing are subtracted.

    Pelvis tilt and list, spine, hips, knees and ankles are changed; headings, rotations about long axes and
    the arms, which hang in one way or another, are not. Standing is the longest time with upright legs and
    trunk in which no segment turns faster than 0.5 rad/s, and its angles are the medians there.

    Args:
        paths: of the same motion, with `BodyPaths.standing`.

    Raises:
        InvalidInputError: nobody stands still for half a second, or it was not looked for.
    """
    if paths.standing is None:
        raise InvalidInputError("angles relative to standing: the paths are without the frames of standing")
    runs = signals.runs(paths.standing)
    start, stop = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
    if (stop - start) / paths.rate_hz < _SHORTEST:
        raise InvalidInputError(
            f"angles relative to standing: nobody stands upright and still for {_SHORTEST:g} s in this "
            "motion; record a second of quiet standing, or leave the angles as they are"
        )
    values = np.array(angles.values)
    for column, name in enumerate(angles.names):
        own = values[start:stop, column]
        if not any(part in name for part in _OWN_ZERO) and np.isfinite(own).any():
            values[:, column] -= np.nanmedian(own)
    first, last = paths.times[[start, stop - 1]]
    note = f"angles of trunk and legs are relative to quiet standing from {first:.2f} to {last:.2f} s"
    return replace(angles, values=values, notes=(*angles.notes, note))
