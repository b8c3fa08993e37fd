"""Accuracy of the angles with some of the sensors: differences from the full set and errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np

from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core import rotations, signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording

PARTS: Final = 8  #: Equal parts of a recording, over which the scatter of a loss is estimated
_ARRAYS: Final = ("difference", "seen", "error", "half_band", "part_losses")


@dataclass(frozen=True)
class SensorSet:
    """Accuracy of the reconstruction with some of the sensors; A angles."""

    sensors: tuple[str, ...]
    difference: Array
    """(A,) rad, RMS difference from the full set over frames in which both observe the angle; NaN without."""
    seen: Array  #: (A,) share of the frames observed by the full set that are observed here; NaN if there are none
    error: Array  #: (A,) rad, RMS error against the reference; NaN without one
    half_band: Array  #: (A,) rad, half the median 95 % band; NaN if the motion has no confidence
    loss: float
    """[rad] mean over angles of the RMS against the reference, else the full set. In unobserved frames the
    standard deviation of the angle counts, which is the error of its mean."""
    part_losses: Array
    """(`PARTS`,) rad, the same of consecutive equal parts of the recording; NaN for parts without frames."""

    @classmethod
    def read(cls, facts: Mapping[str, Any], arrays: Mapping[str, Array]) -> Self:
        """Return what `facts` and `arrays` hold."""
        values = {name: arrays[name] for name in _ARRAYS}
        return cls(sensors=tuple(facts["sensors"]), loss=facts["loss"], **values)

    @property
    def facts(self) -> dict[str, Any]:
        """Sensors and loss as plain data."""
        return {"sensors": list(self.sensors), "loss": self.loss}

    @property
    def arrays(self) -> dict[str, Array]:
        """All arrays by name."""
        return {name: getattr(self, name) for name in _ARRAYS}

    def scatter(self, other: SensorSet) -> float:
        """Return the standard error, rad, of the difference of the losses of two sets, by its scatter over
        the parts of the recording; NaN with fewer than two parts.
        """
        off = self.part_losses - other.part_losses
        off = off[np.isfinite(off)]
        return float(off.std(ddof=1) / np.sqrt(len(off))) if len(off) > 1 else float("nan")


def measure_set(
    sensors: tuple[str, ...], angles: ClinicalAngles, full: ClinicalAngles, truth: ClinicalAngles | None
) -> SensorSet:
    """Compare a set of sensors with the full set and the reference; singular postures are excluded."""
    reference = full if truth is None else truth
    counted = full.known & ~full.singular
    off, error = _difference(angles, full), np.full(angles.values.shape, np.nan)
    if truth is not None:
        error = np.where(full.known, _difference(angles, truth), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        seen = (angles.known & counted).sum(axis=0) / counted.sum(axis=0)
    lost = off if truth is None else error
    lost = np.where(counted, np.where(np.isnan(lost), np.nan_to_num(spread(reference)), lost), np.nan)
    parts = np.array([_loss(part) for part in np.array_split(lost, PARTS)])
    half = np.full(len(angles.names), np.nan)
    if angles.sigma is not None:
        half = BAND_95 * _by_column(np.median, angles.sigma.astype(float))
    return SensorSet(
        sensors, _by_column(_rms, off), seen, _by_column(_rms, error), half, float(np.nan_to_num(_loss(lost))), parts
    )


def spread(angles: ClinicalAngles) -> Array:
    """Return the standard deviation over time of each angle, (A,) rad; NaN for one without values."""
    return _by_column(np.std, angles.values)


def true_angles(recording: Recording, like: ClinicalAngles) -> ClinicalAngles | None:
    """Return the angles of the reference at the times of others; None without a reference."""
    truth = recording.truth
    if truth is None:
        return None
    poses = PoseSequence(
        times=like.times,
        p_world_joint=signals.interpolate(truth.times, truth.p_world_joint, like.times),
        R_world_bone=signals.interpolate_rotations(truth.times, truth.R_world_bone, like.times),
        names=truth.names,
    )
    return clinical_angles(all_observed(poses), recording.skeleton).select(like.names)


def _difference(angles: ClinicalAngles, reference: ClinicalAngles) -> Array:
    """(T, A) rad in [-pi, pi); NaN where either is unknown or singular."""
    off = (angles.values - reference.values + np.pi) % (2 * np.pi) - np.pi
    return np.where(angles.singular | reference.singular, np.nan, off)


def _loss(lost: Array) -> float:
    """Mean over angles of the RMS over frames of (T, A) rad; NaN without any."""
    losses = _by_column(_rms, lost)
    known = losses[np.isfinite(losses)]
    return float(known.mean()) if known.size else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _by_column(statistic: Callable[[Array], Any], values: Array) -> Array:
    """(A,) statistic of the finite values of each column of (T, A); NaN without any."""
    finite = (column[np.isfinite(column)] for column in values.T)
    return np.array([statistic(own) if own.size else np.nan for own in finite])


LONGEST: Final = 120.0  # [s] of a recording that a study takes if nothing else is wanted
_BIN: Final = 1.0  # [s] over which movement is averaged
_MARGIN: Final = 1.0  # [s] of samples of the sensors on both sides of the video, in which its clock is searched


@dataclass(frozen=True)
class Part:
    """An interval of a recording."""

    start: float  #: s, on the recording's clock
    stop: float
    whole: float  #: s, length of the recording

    @property
    def seconds(self) -> float:
        """Length, s."""
        return self.stop - self.start

    @property
    def is_whole(self) -> bool:
        """Whether it is the recording itself."""
        return self.seconds >= self.whole

    def of(self, recording: Recording) -> Recording:
        """Return this part of a recording; the reference is left as it is."""
        if self.is_whole:
            return recording
        seen = recording.between(self.start, self.stop)
        if seen.keypoints is None:
            return replace(recording, imus=seen.imus)
        around = recording.between(self.start - _MARGIN, self.stop + _MARGIN)
        return replace(recording, keypoints=seen.keypoints, imus=around.imus)


def liveliest_part(recording: Recording, longest: float) -> Part:
    """Return the part of a recording with IMUs in which the sensors turn most while the camera sees the person, at most
    `longest` s. `InvalidInputError`: `longest` is not positive.
    """
    if not longest > 0:
        raise InvalidInputError(f"seconds: {longest}; study more than 0 of a recording")
    imus, keypoints = recording.imus, recording.keypoints
    assert imus is not None
    times = imus.times if keypoints is None else keypoints.times
    start, stop = float(times[0]), float(times[-1])
    if stop - start <= longest:
        return Part(start, stop, stop - start)
    edges = np.arange(start, stop + _BIN, _BIN)
    R = imus.R_inertial_sensor
    rates = rotations.angle_between(R[:-1], R[1:]) / np.diff(imus.times)[:, None]  # rad/s
    known = np.isfinite(rates)
    turns = np.where(known, rates, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    movement = _mean(imus.times[:-1], turns, edges)
    if keypoints is not None:
        movement = movement * _mean(keypoints.times, keypoints.seen.mean(axis=1), edges)
    so_far = np.concatenate([[0.0], np.cumsum(movement)])
    count = min(len(movement), max(1, int(longest / _BIN)))
    best = int(np.argmax(so_far[count:] - so_far[:-count]))
    first = min(float(edges[best]), stop - longest)
    return Part(first, first + longest, stop - start)


def _mean(times: Array, values: Array, edges: Array) -> Array:
    """Mean of values in each interval; zero without any."""
    total = np.histogram(times, edges, weights=values)[0]
    number = np.histogram(times, edges)[0]
    return np.asarray(total / np.maximum(number, 1))
