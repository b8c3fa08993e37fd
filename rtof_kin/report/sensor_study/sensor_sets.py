"""What the reconstruction with some of the sensors gave, measured against another one, angle by angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.core.checks import readonly
from rtof_kin.data.confidence import BAND_95

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorSet:
    """What the reconstruction with some of the sensors gave, angle by angle; A angles."""

    sensors: tuple[str, ...]
    """Names of those that were used."""
    difference: Array
    """(A,) rad, RMS from the full set over the frames in which both see the angle; NaN without any."""
    seen: Array
    """(A,) share of the frames in which the full set sees the angle that this one sees too; NaN where the
    full set never does."""
    error: Array
    """(A,) rad, RMS against the truth; NaN without one."""
    half_band: Array
    """(A,) rad, half the median 95 % band; NaN where the motion does not say how certain it is."""
    loss: float
    """rad, what is lost against the reference (the truth, else the full set): the mean over angles of the
    RMS, a frame in which an angle is not seen counting as the angle's own spread, which is what guessing
    its mean would err."""

    def __post_init__(self) -> None:
        for field in ("difference", "seen", "error", "half_band"):
            own = readonly(f"sensor set {field}", getattr(self, field), (len(self.difference),))
            object.__setattr__(self, field, own)


def measured(
    sensors: tuple[str, ...], angles: ClinicalAngles, full: ClinicalAngles, truth: ClinicalAngles | None
) -> SensorSet:
    """One set of sensors against the full one, and the truth.

    Frames in a singular posture of either do not count: the angle is not defined there.

    Args:
        angles, full, truth: of the same rows at the same times.
    """
    reference = full if truth is None else truth
    counted = full.known & ~full.singular
    off, error = _off(angles, full), np.full(angles.values.shape, np.nan)
    if truth is not None:
        error = np.where(full.known, _off(angles, truth), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        seen = (angles.known & counted).sum(axis=0) / counted.sum(axis=0)
    spread = np.array([_spread(column) for column in reference.values.T])
    lost = np.where(np.isnan(off if truth is None else error), spread, off if truth is None else error)
    losses = [_rms(np.where(counted, lost, np.nan)[:, a]) for a in range(lost.shape[1])]
    known = np.array(losses)[np.isfinite(losses)]
    half = np.full(len(angles.names), np.nan)
    if angles.sigma is not None:
        half = BAND_95 * np.array([_median(column) for column in angles.sigma.T])
    return SensorSet(
        sensors, np.array([_rms(column) for column in off.T]), seen,
        np.array([_rms(column) for column in error.T]), half, float(known.mean()) if known.size else 0.0,
    )  # fmt: skip


def _off(angles: ClinicalAngles, reference: ClinicalAngles) -> Array:
    """(T, A) rad between two, the short way round; NaN where either is not known or not defined."""
    off = angles.values - reference.values
    off = (off + np.pi) % (2 * np.pi) - np.pi
    return np.where(angles.singular | reference.singular, np.nan, off)


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _spread(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.std()) if known.size else 0.0
