"""Texts of the labels that show joint angles beside their joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_table import SIDES, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import BAND_95
from rtof_kin.view.overlay.projected_motion import Moment

USUAL: Final = tuple(f"{side}_{joint}_flexion" for joint in ("knee", "hip", "elbow") for side in SIDES)
"""Angles that are shown unless others are chosen."""
UNKNOWN: Final = "-"
"""Value of an angle that is not observed, or unreliable."""


@dataclass(frozen=True)
class AngleLabels:
    """Chosen angles of a motion, their joints and their texts."""

    names: tuple[str, ...]
    """A names, e.g. 'right_knee_flexion'."""
    titles: tuple[str, ...]
    """A short names, e.g. 'R knee'."""
    joints: tuple[int, ...]
    """A joints of the skeleton beside which they stand."""
    values_deg: Array
    """(T, A) deg; NaN where not observed or unreliable."""
    half_deg: Array
    """(T, A) deg, half width of the 95 % band; NaN where unknown."""

    def widest(self, index: int) -> str:
        """Return a text as wide as any of an angle."""
        values, half = self.values_deg[:, index], self.half_deg[:, index]
        if not np.isfinite(values).any():
            return f"{self.titles[index]} {UNKNOWN}"
        digits = [len(str(round(float(np.nanmax(np.abs(x)))))) if np.isfinite(x).any() else 0 for x in (values, half)]
        sign = "−" if np.nanmin(values) < 0 else ""
        band = f"  ± {'8' * digits[1]}°" if digits[1] else ""
        return f"{self.titles[index]} {sign}{'8' * digits[0]}°{band}"

    def text(self, index: int, moment: Moment) -> str:
        """Return the title and the value of an angle at an instant."""
        frames = moment.frames
        value = float(moment.mix(self.values_deg[frames, index]))
        half = float(moment.mix(self.half_deg[frames, index]))
        return f"{self.titles[index]} {value_text(value, half)}"


def value_text(value_deg: float, half_deg: float) -> str:
    """Return an angle in words, e.g. '45°  ± 4°'.

    Args:
        value_deg: deg; NaN where unknown. half_deg: half width of its 95 % band, deg; NaN where unknown.
    """
    if not np.isfinite(value_deg):
        return UNKNOWN
    band = f"  ± {max(half_deg, 1):.0f}°" if np.isfinite(half_deg) else ""
    return f"{round(value_deg)}°{band}".replace("-", "−")


def angle_labels(motion: Motion, chosen: Sequence[str] | None = None) -> AngleLabels:
    """Return the labels of chosen angles.

    Args:
        chosen: names of angles; by default `USUAL`, those with a value at any time.

    Raises:
        UnknownNameError: there is no such angle.
    """
    angles = clinical_angles(motion)
    names = tuple(dict.fromkeys(_observed(angles) if chosen is None else chosen))
    angles = angles.select(names)
    table = angle_table(motion.skeleton.table)
    child = {row.name: joint.child for joint in table.joints for row in joint.angles}
    half = np.full(angles.values.shape, np.nan) if angles.sigma is None else BAND_95 * angles.sigma
    return AngleLabels(
        names,
        tuple(map(short_name, names)),
        tuple(motion.skeleton.index(*(child[name] for name in names))),
        np.degrees(angles.trusted_values),
        np.degrees(half),
    )


def _observed(angles: ClinicalAngles) -> list[str]:
    """Return those of the usual angles that have a reliable value at any time."""
    known: Mask = np.asarray(np.isfinite(angles.trusted_values).any(axis=0))
    return [name for name in USUAL if name in angles.names and known[angles.names.index(name)]]


def short_name(name: str) -> str:
    """Return a short title of an angle: 'R knee', 'L hip adduction'."""
    side, _, rest = name.partition("_")
    title = f"{side[0].upper()} {rest}" if side in SIDES else name
    return title.replace("_", " ").removesuffix(" flexion")
