"""Checks of live streams: every sample's numbers, names, and the physics of the first seconds.

The laws are those of `rtof_kin.inertial.physics`. Nothing is changed: a sentence says what does not hold, and
under which declaration it would. Only numbers that are of no use are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check, some
from rtof_kin.core.errors import RtofError, nearest
from rtof_kin.data.imu_stream import Declaration, SensorLog, SensorStream
from rtof_kin.inertial.physics import LAWS, check_log
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.samples import FrameSample, ImuSample, Sample
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.layouts import is_detector_point

FIRST_SECONDS: Final = 4.5
"""[s] of a sensor after which it is checked: so long the direction of gravity takes where it moves."""
_NEARLY: Final = 0.8  # of it, with which a sensor is checked beside others
_ORTHONORMAL = 1e-2  # [-] largest deviation of a dot product of a rotation's rows
_FASTEST_HZ: Final = 2000.0
_NAMED: Final = 6
_FOLLOWED: Final = ("rate", "jitter", "samples lost", "stuck")
"""Beginnings of the names of checks whose subjects `Monitor` follows all the time."""


# --- numbers of a sample -------------------------------------------------------------------------


def number_faults(samples: Sequence[Sample]) -> list[str]:
    """Return for each sample why its numbers are of no use; '' where they are."""
    out = [_frame_fault(s) if isinstance(s, FrameSample) else "" for s in samples]
    imus = [(i, s) for i, s in enumerate(samples) if isinstance(s, ImuSample)]
    if imus:
        R = np.array([s.R_inertial_sensor for _, s in imus], dtype=float)
        f = np.array([s.f_sensor for _, s in imus], dtype=float)
        for (i, _), fault in zip(imus, _imu_faults(R, f), strict=True):
            out[i] = fault
    return out


def _frame_fault(sample: FrameSample) -> str:
    if np.isinf(sample.uv_px).any():
        return "has pixels that are infinite"
    wrong = ~((sample.confidence >= 0) & (sample.confidence <= 1))
    return "has a confidence outside 0 to 1" if wrong.any() else ""


def _imu_faults(R: Array, f: Array) -> list[str]:
    """Return the faults of orientations (n, 3, 3) and specific forces (n, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        products = R @ np.swapaxes(R, -1, -2) - np.eye(3)
        off = np.abs(products).max(axis=(-2, -1))
        mirrored = np.linalg.det(R) < 0
    missing = np.isnan(R).all(axis=(-2, -1))
    infinite = np.isinf(f).any(axis=-1) | ~(missing | np.isfinite(R).all(axis=(-2, -1)))
    out = np.full(len(R), "", dtype=object)
    out[mirrored] = "has an orientation that is mirrored"
    out[~missing & ~(off < _ORTHONORMAL)] = "has an orientation that is no rotation; quaternions have norm 1"
    out[infinite] = "has numbers that are not finite"
    return [str(fault) for fault in out]


# --- names ---------------------------------------------------------------------------------------


def unknown_sensors(seen: Iterable[str], setup: Recording) -> list[str]:
    """Return the sensors that the calibration of a setup does not have; none without a calibration."""
    if setup.calibration is None:
        return []
    return [name for name in seen if name not in setup.calibration.sensors]


def sensor_sentence(unknown: Sequence[str], seen: Sequence[str], setup: Recording) -> str:
    """Return what to say about sensors without a calibration."""
    known = setup.calibration.sensors if setup.calibration is not None else ()
    free = [name for name in known if name not in seen]
    text = f"{some(unknown, _NAMED)}: not in the calibration, so recorded but not used"
    return f"{text}{_closest(unknown, free)}. It has {', '.join(known)}"


def unknown_landmarks(names: Sequence[str], setup: Recording) -> list[str]:
    """Return the names that are neither landmarks of the skeleton nor points of a detector."""
    known = setup.skeleton.landmarks
    return [name for name in names if name not in known and not _of_detector(name)]


def landmark_sentences(landmarks: Sequence[str], setup: Recording) -> list[str]:
    """Return what to say about the points of a camera's stream: unknown names, and missing ones.

    `setup`: with the skeleton, and the keypoints of the setup if any.
    """
    known = list(setup.skeleton.landmarks)
    unknown = unknown_landmarks(landmarks, setup)
    out = []
    if unknown:
        out.append(f"{some(unknown, _NAMED)}: no landmarks of the skeleton, so not used{_closest(unknown, known)}")
    usual = [name for name in setup.keypoints.names if name in known] if setup.keypoints is not None else []
    missing = [name for name in usual if name not in landmarks]
    if missing:
        out.append(f"{some(missing, _NAMED)}: in the setup's keypoints, but not in the camera's stream")
    return out


def _of_detector(name: str) -> bool:
    try:
        return is_detector_point(name)
    except RtofError:
        return False


def _closest(names: Sequence[str], known: Sequence[str]) -> str:
    near = nearest(names, known)
    return f"; did you mean {', '.join(dict.fromkeys(near))}?" if near else ""


# --- physics -------------------------------------------------------------------------------------


@dataclass
class _First:
    """First samples of one sensor."""

    source: str
    times: list[float] = field(default_factory=list)
    R: list[Array] = field(default_factory=list)
    f: list[Array] = field(default_factory=list)
    start: float = math.inf
    stop: float = -math.inf

    def add(self, time: float, R: Array, f: Array) -> None:
        self.times.append(time)
        self.R.append(R)
        self.f.append(f)
        self.start, self.stop = min(self.start, time), max(self.stop, time)

    @property
    def seconds(self) -> float:
        return self.stop - self.start

    def stream(self, name: str) -> SensorStream | None:
        """Return the samples in the order of time; None where there are too few."""
        times, first = np.unique(self.times, return_index=True)
        if len(times) < 10:
            return None
        R, f = np.array(self.R)[first], np.array(self.f)[first]
        R[~np.isfinite(R).all(axis=(-2, -1))] = np.nan
        known = np.isfinite(R).all(axis=(-2, -1))
        R[known] = so3.nearest_rotation(R[known])
        return SensorStream(
            name,
            times,
            f if np.isfinite(f).any() else None,
            R if known.any() else None,
            quaternion_norm=np.where(known, 1.0, np.nan),  # so that the order of components is in question
        )


class FirstSeconds:
    """Collects the first seconds of every sensor and checks them by physics."""

    def __init__(self) -> None:
        self._first: dict[str, _First] = {}
        self._done: set[str] = set()

    def add(self, arrived: Arrived) -> None:
        """Take a sample of a sensor; one that has been checked is ignored."""
        sample = arrived.sample
        if isinstance(sample, FrameSample) or sample.sensor in self._done or math.isnan(arrived.time):
            return
        first = self._first.setdefault(sample.sensor, _First(arrived.source))
        first.add(arrived.time, sample.R_inertial_sensor, sample.f_sensor)
        if len(first.times) > FIRST_SECONDS * _FASTEST_HZ:
            self._finished(sample.sensor)

    def due(self) -> Callable[[], list[str]] | None:
        """Return a check that is due, as a function that returns sentences; None where none is.

        The sensors of a source that have their first seconds are checked together, because they share
        one declaration. A function must have returned before the next one is asked for.
        """
        source = next((first.source for first in self._first.values() if first.seconds >= FIRST_SECONDS), None)
        if source is None:
            return None
        ready = [n for n, one in self._first.items() if one.source == source and one.seconds >= _NEARLY * FIRST_SECONDS]
        streams = [self._finished(name).stream(name) for name in ready]
        return lambda: _physics(source, [stream for stream in streams if stream is not None])

    def _finished(self, name: str) -> _First:
        self._done.add(name)
        return self._first.pop(name)


def _physics(source: str, streams: Sequence[SensorStream]) -> list[str]:
    """Return sentences about laws that do not hold; of several that a sensor breaks the first one is told."""
    log = SensorLog(Path(source), "live stream", tuple(streams), Declaration())
    told: set[tuple[str, str]] = set()
    failed: dict[str, list[Check]] = {}
    for check in check_log(log):
        kind = check.subject, "law" if check.name in LAWS else check.name
        if check.failed and not check.name.startswith(_FOLLOWED) and kind not in told:
            told.add(kind)
            failed.setdefault(check.name, []).append(check)
    return [_law_sentence(source, checks) for checks in failed.values()]


def _law_sentence(source: str, checks: Sequence[Check]) -> str:
    """Say which sensors break a law, with the figures of the worst and the likely declaration."""
    worst = max(checks, key=lambda check: check.value)
    if len(checks) == 1:
        return f"{source}: {worst.message}"
    names = ", ".join(check.subject for check in checks)
    return f"{source}: {names} do not obey {worst.name}; the worst is {worst.message}"
