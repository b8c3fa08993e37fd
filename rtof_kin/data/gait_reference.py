"""`GaitReference`: curves of the nine variables of the gait scores in people without a gait disorder.

The variables are those of the Gait Deviation Index (Schwartz and Rozumalski, Gait & Posture 28, 2008) and of
the Gait Profile Score (Baker et al., Gait & Posture 30, 2009), at 51 instants of the gait cycle, from heel
strike to heel strike of the same foot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, readonly
from rtof_kin.core.errors import InvalidInputError

OWN_SYSTEM: Final = "rtof_kin"  #: Begins the name of the system of a reference that this package made
PERCENT: Final = np.linspace(0.0, 100.0, 51)  #: Instants of the gait cycle, per cent
MODEL_ZERO: Final = "model"
STANDING_ZERO: Final = "standing"
"""Zeros of the angles: the model's anatomical posture, or each person's own quiet standing."""


@dataclass(frozen=True)
class GaitVariable:
    """One of the nine variables."""

    name: str
    positive: str  #: The movement that is positive, on the side of the gait cycle
    zero: str  #: Posture in which it is 0
    largest: float = 180.0  #: [deg] largest magnitude of a plausible mean

    @property
    def label(self) -> str:
        """The name with spaces."""
        return self.name.replace("_", " ")


VARIABLES: Final = (
    GaitVariable("pelvic_tilt", "anterior: upper end forward", "upright pelvis of the model", 60),
    GaitVariable("pelvic_obliquity", "side of the cycle up", "level pelvis", 45),
    GaitVariable("pelvic_rotation", "side of the cycle forward", "pelvis square to the way", 60),
    GaitVariable("hip_flexion", "thigh forward", "thigh along the pelvis's long axis", 120),
    GaitVariable("hip_adduction", "thigh towards the midline", "thigh in the pelvis's sagittal plane", 60),
    GaitVariable("hip_rotation", "internal", "kneecap and pelvis face the same way", 90),
    GaitVariable("knee_flexion", "heel towards the buttock", "straight leg", 150),
    GaitVariable("ankle_dorsiflexion", "toes towards the shin", "foot at a right angle to the shank", 90),
    GaitVariable("foot_progression", "internal: toes towards the midline", "foot along the way", 90),
)
"""The nine variables, in the order of all arrays."""
NAMES: Final = tuple(variable.name for variable in VARIABLES)
SHAPE: Final = (len(VARIABLES), len(PERCENT))


@dataclass(frozen=True)
class GaitReference:
    """Mean curves of a group of people, and the curves of each of them where these are known."""

    mean: Array  #: (9, 51) rad, mean over people; NaN as a whole for a variable that the reference does not have
    sd: Array  #: (9, 51) rad, standard deviation between people; NaN where unknown
    people: int  #: Number of people
    licence: str  #: Terms under which the reference may be used
    source: str  #: Where it is from: a citation, or who recorded whom and how
    system: str  #: What measured it: `OWN_SYSTEM` and its version, or another system and model
    zero: str = MODEL_ZERO  #: `MODEL_ZERO`, `STANDING_ZERO`, or that of another system in words
    curves: Array | None = None
    """(N, 2, 9, 51) rad, of every person's right and left cycles; None if only means are known."""
    names: tuple[str, ...] = ()  #: N codes of the people with curves
    strides: tuple[tuple[int, int], ...] = ()  #: N numbers of right and left strides
    speeds: tuple[float, ...] = ()  #: [m/s] N walking speeds; NaN where unknown, as on a treadmill
    speed_range: tuple[float, float] | None = None  #: [m/s] slowest and fastest; None if unknown
    notes: tuple[str, ...] = ()  #: What to know about it, one sentence each

    def __post_init__(self) -> None:
        for name in ("mean", "sd"):
            object.__setattr__(self, name, readonly(f"gait reference {name}", getattr(self, name), SHAPE))
        for name in ("licence", "source", "system", "zero"):
            if not getattr(self, name).strip():
                raise InvalidInputError(
                    f"gait reference {name}: empty; a reference states its licence, source and system"
                )
        if self.people < 1:
            raise InvalidInputError(f"gait reference people: {self.people}; at least one is needed")
        if np.isnan(self.mean).all():
            raise InvalidInputError("gait reference mean: no variable has values")
        for variable, mean, sd in zip(VARIABLES, self.mean, self.sd, strict=True):
            unknown = np.isnan(mean)
            if unknown.any() and not unknown.all():
                raise InvalidInputError(f"gait reference {variable.name}: the mean has gaps")
            if np.isinf(mean).any() or np.abs(np.degrees(mean[~unknown])).max(initial=0) > variable.largest:
                raise InvalidInputError(
                    f"gait reference {variable.name}: a mean is beyond {variable.largest:g} deg; check units "
                    f"(degrees) and sign (positive: {variable.positive})"
                )
            if np.isinf(sd).any() or np.any(sd < 0):
                raise InvalidInputError(f"gait reference {variable.name}: a standard deviation is negative")
        self._check_people()

    def _check_people(self) -> None:
        set_: Any = object.__setattr__
        set_(self, "names", checked_names("gait reference people", self.names))
        if self.curves is not None:
            set_(self, "curves", readonly("gait reference curves", self.curves, ("N", 2, *SHAPE)))
            if not np.isfinite(self.curves).all():
                raise InvalidInputError("gait reference curves: not finite; leave incomplete people out")
            if not len(self.curves) == len(self.names) == self.people:
                raise InvalidInputError("gait reference: not one name and curve for each person")
        for name in ("strides", "speeds"):
            if (given := getattr(self, name)) and len(given) != len(self.names):
                raise InvalidInputError(f"gait reference {name}: not one for each person")
        if self.speed_range is not None and not 0 <= self.speed_range[0] <= self.speed_range[1] < 10:
            raise InvalidInputError("gait reference speed: slowest and fastest in m/s, below 10")

    @property
    def is_own(self) -> bool:
        """Whether this package made it, so that zeros and axes are the same."""
        return self.system.split()[0] == OWN_SYSTEM

    @property
    def missing(self) -> tuple[str, ...]:
        """Variables that it does not have."""
        unknown = np.asarray(np.isnan(self.mean).all(axis=1)).tolist()
        return tuple(name for name, no in zip(NAMES, unknown, strict=True) if no)
