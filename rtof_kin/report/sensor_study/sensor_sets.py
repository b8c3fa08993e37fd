"""Accuracy of each angle with a subset of the sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.core.checks import readonly
from rtof_kin.data.confidence import BAND_95

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorSet:
    """Accuracy of the reconstruction with some of the sensors; A angles."""

    sensors: tuple[str, ...]
    difference: Array
    """(A,) rad, RMS difference from the full set over frames in which both observe the angle; NaN without."""
    seen: Array
    """(A,) share of the frames observed by the full set that are observed here; NaN if there are none."""
    error: Array
    """(A,) rad, RMS error against the reference; NaN without one."""
    half_band: Array
    """(A,) rad, half the median 95 % band; NaN if the motion has no confidence."""
    loss: float
    """[rad] mean over angles of the RMS against the reference, else the full set. In unobserved frames the
    standard deviation of the angle counts, which is the error of its mean."""

    def __post_init__(self) -> None:
        for field in ("difference", "seen", "error", "half_band"):
            own = readonly(f"sensor set {field}", getattr(self, field), (len(self.difference),))
            object.__setattr__(self, field, own)


def measure_set(
    sensors: tuple[str, ...], angles: ClinicalAngles, full: ClinicalAngles, truth: ClinicalAngles | None
) -> SensorSet:
    """Compare a set of sensors with the full set and the reference; singular postures are excluded.

    Args:
        sensors: names. angles, full, truth: with the same rows and times.
    """
    reference = full if truth is None else truth
    counted = full.known & ~full.singular
    off, error = _difference(angles, full), np.full(angles.values.shape, np.nan)
    if truth is not None:
        error = np.where(full.known, _difference(angles, truth), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        seen = (angles.known & counted).sum(axis=0) / counted.sum(axis=0)
    spread = np.nan_to_num(_by_column(np.std, reference.values))
    lost = off if truth is None else error
    losses = _by_column(_rms, np.where(counted, np.where(np.isnan(lost), spread, lost), np.nan))
    known = losses[np.isfinite(losses)]
    half = np.full(len(angles.names), np.nan)
    if angles.sigma is not None:
        half = BAND_95 * _by_column(np.median, angles.sigma)
    loss = float(known.mean()) if known.size else 0.0
    return SensorSet(sensors, _by_column(_rms, off), seen, _by_column(_rms, error), half, loss)


def _difference(angles: ClinicalAngles, reference: ClinicalAngles) -> Array:
    """(T, A) rad in [-pi, pi); NaN where either is unknown or singular."""
    off = (angles.values - reference.values + np.pi) % (2 * np.pi) - np.pi
    return np.where(angles.singular | reference.singular, np.nan, off)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _by_column(statistic: Callable[[Array], Any], values: Array) -> Array:
    """(A,) statistic of the finite values of each column of (T, A); NaN without any."""
    finite = (column[np.isfinite(column)] for column in values.T)
    return np.array([statistic(own) if own.size else np.nan for own in finite])
