"""Priors of a self-calibration: which quantities are estimated, and their standard deviations before."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final, Self

import numpy as np

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.recording.recording import Recording

EFFECTIVE_SECONDS: Final = 6.0  #: [s] Effective length of a longer recording: autocorrelated errors do not average out
WEIGHT_POSES: Final = 0.1
"""[1] Weight of the pose prior and of the torso of the initial guess relative to a reconstruction: postures are
autocorrelated."""
OVERCOUNT: Final = 3.0
"""[1] Factor by which autocorrelated errors overstate the information, in claimed standard deviations."""


@dataclass(frozen=True)
class CalibrationPriors:
    """Standard deviation of each quantity; None for those that are known and not estimated."""

    sigma_delay: float | None = 0.05  #: [s] Delay of the video relative to the sensors
    sigma_swing: float | None = np.radians(2.0)  #: [rad] Mounting of a sensor, about axes across its bone
    sigma_twist: float = np.radians(4.0)  #: [rad] about the bone
    sigma_heading: float | None = None  #: [rad] Heading of each sensor's reference
    sigma_size: float | None = None  #: [1] of the skeleton as a whole
    sigma_proportion: float | None = None  #: [1] of each group of bones relative to that
    sigma_image_bias: float | None = 6.0
    """[px] per axis, of each landmark, constant in the image; for a person 500 px tall."""
    sigma_place: float | None = 0.025
    """[m] per axis, of where a detector sees a joint in its segments, beside mountings: at knees 20 to 30 mm were
    measured; half of it at elbows and wrists."""
    sigma_ankle_height: float | None = 0.02  #: [m] of ankles over the floor that they stand on; only where there is one
    most_seconds: float = 20.0  #: [s] of the recording that are used, in fragments distributed over it
    rounds: int = 5  #: Largest number of Gauss-Newton steps

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if value is None and entry.name.startswith("sigma_"):
                continue
            if not isinstance(value, int | float | np.number) or not 0 < value < np.inf:
                raise InvalidInputError(
                    f"{entry.name} is {value}: give a positive, finite number"
                    + ("; None where it is known" if entry.name.startswith("sigma_") else "")
                )

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """Return the usual priors of a recording; bones are estimated only where not measured, and
        those of the person's file within its standard deviations; mountings not where it states how well they are
        known: another estimate from the same video is no better.
        """
        usual, known = cls(), recording.calibration
        if known is not None and known.mounting_sd_deg is not None and np.isfinite(known.mounting_sd_deg).all():
            usual = replace(usual, sigma_swing=None)
        if (sigma := recording.sigma_bones) is not None:  # of size and proportion together
            return replace(usual, sigma_size=sigma / 2**0.5, sigma_proportion=sigma / 2**0.5)
        if recording.bones_given:
            return usual
        return replace(usual, sigma_size=0.05 if recording.height is None else 0.02, sigma_proportion=0.03)
