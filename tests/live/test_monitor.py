"""States of streams, their figures, and what it costs to follow them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from live_support import FakeEstimator, frame_samples

from rtof_kin.live.clock_map import VIDEO, Arrived
from rtof_kin.live.monitor import Change, Monitor, State
from rtof_kin.live.samples import FrameSample, ImuSample, Sample

STEP = 1 / 60


def follow(monitor: Monitor, arrivals: list[tuple[float, Sample]], stop: float) -> list[Change]:
    """Changes of a monitor that is checked 60 times a second."""
    waiting = sorted(arrivals, key=lambda pair: pair[0])
    changes: list[Change] = []
    for now in np.arange(0.0, stop, STEP):
        while waiting and waiting[0][0] <= now:
            sample = waiting.pop(0)[1]
            monitor.update(Arrived("source", sample, float(now), sample.time))
        changes += monitor.check(float(now))
    return changes


def ticks(rate_hz: float, stop: float, sensor: str = "a") -> list[tuple[float, Sample]]:
    rng = np.random.default_rng(0)
    times = np.arange(0, stop, 1 / rate_hz)
    return [(float(t), ImuSample(sensor, float(t), np.eye(3), rng.normal(size=3))) for t in times]


def test_loss_is_measured_from_the_stamps() -> None:
    monitor = Monitor(["a"])
    follow(monitor, [pair for i, pair in enumerate(ticks(100.0, 4.0)) if i % 5], 4.0)
    (shown,) = monitor.status()["sensors"]
    assert shown["state"] == "lossy"
    assert shown["loss_percent"] == pytest.approx(20, abs=2)
    assert monitor.counts()["a"].lost == pytest.approx(80, abs=25)


def test_all_that_die_together_are_one_change() -> None:
    monitor = Monitor(["a", "b"])
    arrivals = [pair for name in "ab" for pair in ticks(60.0, 2.0, name)]
    (change,) = follow(monitor, [*arrivals, *ticks(60.0, 4.0, "c")], 4.0)
    assert change.streams == ("a", "b")
    assert change.state is State.LOST
    assert change.begins
    assert 2.4 < change.time < 2.8


def test_time_goes_on_where_nothing_comes_at_all() -> None:
    monitor = Monitor(["a"])
    (change,) = follow(monitor, ticks(60.0, 1.0), 3.0)
    assert change.state is State.LOST
    assert 1.4 < change.time < 1.9


def test_losses_are_told_as_over_only_after_a_while() -> None:
    monitor = Monitor(["a"])
    arrivals = [(t, s) for i, (t, s) in enumerate(ticks(60.0, 8.0)) if t > 2.0 or i % 6]
    begin, end = follow(monitor, arrivals, 8.0)
    assert begin.begins
    assert not end.begins
    assert begin.state is end.state is State.LOSSY
    assert 5.0 < end.time < 7.0


def test_camera_that_sees_nobody() -> None:
    monitor = Monitor([])
    frames = [
        (s.time, replace(s, uv_px=s.uv_px * np.nan, confidence=s.confidence * 0) if 1 < s.time < 3 else s)
        for s in frame_samples(4.0)
        if isinstance(s, FrameSample)
    ]
    begin, end = follow(monitor, frames, 4.0)
    assert begin.state is end.state is State.EMPTY
    assert 1.0 < begin.time + 0.07 < 2.1
    assert not end.begins
    assert not monitor.frozen(VIDEO)


def test_orientation_alone_may_repeat_for_longer() -> None:
    alone = ImuSample("a", 0.0, np.eye(3), np.full(3, np.nan))
    arrivals: list[tuple[float, Sample]] = [(t, replace(alone, time=t)) for t in np.arange(0, 1.5, 0.02)]
    assert follow(Monitor(["a"]), arrivals, 1.5) == []


def test_waiting_is_told_and_ends() -> None:
    monitor = Monitor(["a"], patience_s=0.5)
    assert monitor.status()["sensors"][0]["state"] == "waiting"
    late = [(t + 1, replace(s, time=t + 1)) for t, s in ticks(60.0, 1.0) if isinstance(s, ImuSample)]
    begin, end = follow(monitor, late, 2.0)
    assert begin.state is end.state is State.WAITING
    assert begin.time < 0.7
    assert not end.begins


def test_stamps_of_arrival_are_no_losses() -> None:
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.choice([0.002, 0.031], 400))
    arrivals: list[tuple[float, Sample]] = [
        (float(t), ImuSample("a", float(t), np.eye(3), rng.normal(size=3))) for t in times
    ]
    assert [c for c in follow(Monitor(["a"]), arrivals, 5.0) if c.state is State.LOSSY] == []


def test_status_is_plain_and_has_the_figures_of_the_estimate() -> None:
    monitor = Monitor(["a"])
    monitor.expect(VIDEO)
    assert monitor.status()["rate_hz"] is None
    estimator = FakeEstimator()
    for estimate in [*estimator.advance(0.0), *estimator.advance(1.0)]:
        monitor.estimated(replace(estimate, lag_s=0.25), 0.004)
    status = json.loads(json.dumps(monitor.status()))
    assert status["rate_hz"] == pytest.approx(60, abs=0.2)
    assert (status["lag_ms"], status["frame_ms"]) == (250, 4)
    assert status["camera"]["state"] == "waiting"


def test_rate_of_a_fast_stream_is_that_of_the_samples_that_are_kept() -> None:
    monitor = Monitor(["a"])
    follow(monitor, ticks(1000.0, 4.0), 4.0)
    assert monitor.status()["sensors"][0]["rate_hz"] == pytest.approx(1000, rel=0.02)
