"""Sensor study: accuracy of each angle when sensors are removed from a reconstruction.

First each sensor is omitted alone, then sensors are removed one after the other, the least important first,
down to none (without a camera, to one). Each set is compared with the full set, and with the reference if
the recording has one. A difference from the full set is not an error: errors that both share cancel. Other
sets of the same size than those of this order of removal may be equally good or better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, Final

import numpy as np

from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

Progress = Callable[[str, int, int], None]
TOLERANCE: Final = np.radians(5.0)
"""[rad] largest RMS of an angle that is kept: differences beyond 5 degrees may mislead a clinical decision
(McGinley, Baker, Wolfe, Morris: Gait & Posture 29, 2009)."""
LEAST_SEEN: Final = 0.9  # smallest share of frames in which an angle that is kept is observed
MOST_GREEDY: Final = 8  # largest number of sensors for which the greedy search is the default


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


@dataclass(frozen=True)
class SensorStudy:
    """Importance of each sensor of a recording."""

    recording: str
    segments: dict[str, str]
    """Sensor -> segment that carries it."""
    angles: tuple[str, ...]
    """A names of the angles that the full set observes."""
    full: SensorSet
    without: tuple[SensorSet, ...]
    """Each sensor omitted alone, in the order of the sensors."""
    path: tuple[SensorSet, ...]
    """From the full set down, with one sensor fewer each."""
    has_truth: bool
    """Whether the recording has a reference, so that there are errors."""
    reconstruction: Reconstruction
    """With the full set."""

    def measure(self, found: SensorSet) -> Array:
        """Return (A,) rad: errors if there is a reference, else differences from the full set."""
        return found.error if self.has_truth else found.difference

    def kept(self, found: SensorSet, tolerance: float = TOLERANCE) -> Mask:
        """Return (A,) whether angles are observed and within the tolerance, rad."""
        return np.asarray((found.seen >= LEAST_SEEN) & (self.measure(found) <= tolerance))

    def fewest(self, angle: str, tolerance: float = TOLERANCE) -> SensorSet | None:
        """Return the smallest set of the path up to which an angle is kept throughout; None for none."""
        a, last = self.angles.index(angle), None
        for found in self.path:
            if not self.kept(found, tolerance)[a]:
                break
            last = found
        return last


def number_of_runs(sensors: int, camera: bool = True, greedy: bool | None = None) -> int:
    """Return the number of reconstructions of a study.

    Args:
        sensors: number of sensors. camera: whether there are keypoints. greedy: as in `study_sensors`.
    """
    steps = sensors if camera else sensors - 1
    if _is_greedy(sensors, greedy):
        return 1 + sum(sensors - step for step in range(steps))
    return 1 + sensors + max(steps - 1, 0)


def study_sensors(
    recording: Recording,
    *,
    greedy: bool | None = None,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    progress: Progress | None = None,
) -> SensorStudy:
    """Reconstruct a recording with all sensors, without each of them, and with fewer and fewer.

    The recording is not calibrated; apply `SelfCalibration.apply` with all sensors before, if wanted.

    Args:
        recording: with calibrated IMUs, with or without keypoints.
        greedy: whether each removal tries all remaining sensors, n (n + 1) / 2 runs in all; else sensors
            are removed in the order of their loss when omitted alone. Default: up to `MOST_GREEDY` sensors.
        lifter, settings: as for `reconstruct`. progress: called with ("study", runs done, runs in all).

    Raises:
        InvalidInputError: there are no sensors, or only one and no camera.
    """
    imus, bone_imus = recording.imus, recording.bone_imus()
    if imus is None or bone_imus is None:
        raise InvalidInputError(f"recording {recording.name}: has no IMUs, so there is nothing to omit")
    camera, names = recording.keypoints is not None, imus.names
    if not camera and len(names) < 2:
        raise InvalidInputError(
            f"recording {recording.name}: has one sensor and no camera, so there is nothing to omit"
        )
    settings = settings or ReconstructionSettings()
    settings = replace(settings, sensor_joints=(*settings.sensor_joints, *bone_imus.joints))
    done, total = count(), number_of_runs(len(names), camera, greedy)

    def run(sensors: tuple[str, ...]) -> Reconstruction:
        if progress is not None:
            progress("study", next(done), total)
        return _reconstruct(recording, sensors, lifter, settings)

    def measure(sensors: tuple[str, ...]) -> SensorSet:
        return measure_set(sensors, clinical_angles(run(sensors).motion).select(observed), angles, truth)

    reconstruction = run(names)
    angles = clinical_angles(reconstruction.motion)
    observed = tuple(np.array(angles.names)[angles.known.any(axis=0)].tolist())
    angles = angles.select(observed)
    truth = _true_angles(recording, angles)
    full = measure_set(names, angles, angles, truth)
    without = tuple(measure(_less(names, name)) for name in names)
    path = [full, min(without, key=lambda found: found.loss)]
    loss = dict(zip(names, (found.loss for found in without), strict=True))
    while len(path[-1].sensors) > (0 if camera else 1):
        left = path[-1].sensors
        tried = left if _is_greedy(len(names), greedy) else (min(left, key=lambda name: loss[name]),)
        path.append(min((measure(_less(left, name)) for name in tried), key=lambda found: found.loss))
    if progress is not None:
        progress("study", total, total)
    return SensorStudy(
        recording.name, dict(zip(names, bone_imus.joints, strict=True)), observed, full, without,
        tuple(path), recording.truth is not None, reconstruction,
    )  # fmt: skip


def _is_greedy(sensors: int, greedy: bool | None) -> bool:
    return sensors <= MOST_GREEDY if greedy is None else greedy


def _less(names: Sequence[str], omitted: str) -> tuple[str, ...]:
    return tuple(name for name in names if name != omitted)


def _reconstruct(
    recording: Recording,
    sensors: tuple[str, ...],
    lifter: LifterLike | None,
    settings: ReconstructionSettings,
) -> Reconstruction:
    """Reconstruction with some of the sensors."""
    mode: Mode = "rto"
    if sensors and recording.imus is not None:
        recording = replace(recording, imus=recording.imus.select(sensors))
        mode = "rtof" if recording.keypoints is not None else "imu"
    else:
        recording = replace(recording, imus=None, calibration=None)
    return reconstruct(recording, mode=mode, lifter=lifter, settings=settings, calibrate=False)


def _true_angles(recording: Recording, like: ClinicalAngles) -> ClinicalAngles | None:
    """Angles of the reference at the times of others."""
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
