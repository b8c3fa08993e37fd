"""Streams through the estimator, tick by tick, and its poses at one or many lags."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.online.streams import NO_FAULTS, portions, setup_of
from rtof_kin.core.array_types import Array
from rtof_kin.data import confidence as confidences
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.live.replay import Faults
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.recording.recording import Recording

MakeEstimator = Callable[..., Any]
"""`OnlineEstimator` or what has its interface: (setup, landmarks, settings)."""

_FIELDS = (
    "times",
    "p_world_joint",
    "R_world_bone",
    "provenance",
    "valid",
    "sigma_rad",
    "orientation_observed",
    "direction_observed",
)
"""Arrays of `PoseSequence` over time."""
WIDER = 5 / 60
"""[s] by which a window is longer than its lag."""


@dataclass(frozen=True)
class Track:
    """Poses of one lag, one after the other."""

    poses: PoseSequence
    """At the instants that were estimated."""
    lag_s: Array
    """(T,) age of each pose when it was estimated, s."""
    seconds: Array
    """(T,) what each took, s."""
    confidence: Confidence | None = None

    def between(self, first: float, last: float) -> Track:
        """The frames of an interval, ends included."""
        times = self.poses.times
        kept = slice(*np.searchsorted(times, [first - 1e-6, last + 1e-6]))
        known = None if self.confidence is None else self.confidence[kept]
        return Track(self.poses[kept], self.lag_s[kept], self.seconds[kept], known)


def run(
    estimator: Any, recording: Recording, faults: Faults = NO_FAULTS, at: Array | None = None
) -> Iterator[OnlineEstimate]:
    """Estimates of a recording as they come; those left in the lag at the end are not among them.

    Args:
        estimator: fresh. recording, faults: what it gets.
        at: when an estimate is asked for, s; by default at each frame of the video.
    """
    for now, samples in portions(recording, recording.video.times if at is None else at, faults):
        for sample in samples:
            estimator.push(sample)
        yield from estimator.advance(now)


def tracks(
    recording: Recording, make: MakeEstimator, settings: Any, lags: Sequence[float], faults: Faults = NO_FAULTS
) -> dict[float, Track]:
    """The poses of a recording at every lag, s, each from an estimator of its own.

    The last poses are as old as the recording's end makes them.
    """
    found: dict[float, Track] = {}
    for lag in lags:
        estimator = make(setup_of(recording), recording.video.names, replace(settings, lag_s=lag))
        found[lag] = joined([*run(estimator, recording, faults), *estimator.finish()])
    return found


def tracks_of_one_window(
    recording: Recording, make: MakeEstimator, settings: Any, lags: Sequence[float]
) -> dict[float, Track]:
    """The same from one estimator whose window is longer than every lag, shown anew at each tick."""
    settings = replace(settings, window_s=max(lags) + WIDER)
    estimator = make(setup_of(recording), recording.video.names, settings)
    newest, rate_hz = estimator.settings.frames - 1, estimator.settings.rate_hz
    back = {lag: round(lag * rate_hz) for lag in lags}
    found: dict[float, list[OnlineEstimate]] = {lag: [] for lag in lags}
    for estimate in run(estimator, recording):
        for lag, frames in back.items():
            one = estimate if frames == 0 else estimator._estimate(newest - frames, perf_counter())
            found[lag] += [one] if one is not None else []
    for lag, frames in back.items():
        rest = (estimator._estimate(newest - i, perf_counter()) for i in reversed(range(frames)))
        found[lag] += [one for one in rest if one is not None]
    return {lag: joined(own) for lag, own in found.items()}


def joined(estimates: Iterable[OnlineEstimate]) -> Track:
    """Estimates of rising times as one track."""
    every = list(estimates)
    first = every[0].poses
    whole: dict[str, Any] = {name: np.concatenate([getattr(one.poses, name) for one in every]) for name in _FIELDS}
    stated = [one.confidence for one in every if one.confidence is not None]
    known = confidences.joined(stated) if len(stated) == len(every) else None
    lag_s, seconds = (np.array([getattr(one, name) for one in every]) for name in ("lag_s", "seconds"))
    return Track(replace(first, **whole), lag_s, seconds, known)
