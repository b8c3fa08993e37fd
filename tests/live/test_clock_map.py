"""Clocks are mapped by the earliest arrivals; jumps are found, late bursts and replays are none."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from rtof_kin.live.clock_map import VIDEO, ClockMap, SessionClock
from rtof_kin.live.samples import Clock, FrameSample, ImuSample, Sample

OFFSET = 1234.5


def sample(time: float, sensor: str = "a") -> Sample:
    if sensor == VIDEO:
        return FrameSample(time, np.zeros((1, 2)), np.ones(1))
    return ImuSample(sensor, time, np.eye(3), np.zeros(3))


def mapped(clock_map: ClockMap, pairs: Iterable[tuple[float, float]], stream: str = "a") -> np.ndarray:
    """Times of samples by their stamps and arrivals, in the order of arrival."""
    return np.array([clock_map.time(stream, stamp, arrival) for stamp, arrival in pairs])


def arrivals(times: np.ndarray, jitter: float, seed: int = 0) -> list[tuple[float, float]]:
    late = np.random.default_rng(seed).uniform(0.005, 0.005 + jitter, len(times))
    return sorted(zip(times, times + late, strict=True), key=lambda pair: pair[1])


def test_common_clock_stays_as_it_is() -> None:
    pairs = arrivals(np.arange(0, 3, 0.01), 0.05)
    np.testing.assert_array_equal(mapped(ClockMap("s", Clock.COMMON), pairs), [t for t, _ in pairs])


@pytest.mark.parametrize("ppm", [0.0, 50.0, -50.0])
def test_own_clock_is_mapped_despite_jitter_and_drift(ppm: float) -> None:
    pairs = arrivals(np.arange(0, 120, 0.01), 0.05)
    stamped = [(t * (1 + ppm * 1e-6) - OFFSET, arrival) for t, arrival in pairs]
    errors = mapped(ClockMap("s"), stamped) - [t for t, _ in pairs]
    assert np.all(np.abs(errors[200:] - 0.005) < 0.003)
    order = np.argsort([t for t, _ in pairs])
    steps = np.diff((errors + [t for t, _ in pairs])[order][200:])
    assert np.all(np.abs(steps - 0.01) < 0.001)


def test_sensors_of_one_source_share_a_clock_or_have_their_own() -> None:
    clock_map = ClockMap("s")
    times = np.arange(0, 3, 0.02)
    a, b, c = [], [], []
    for t in times:
        a.append(clock_map.time("a", t - OFFSET, t + 0.002))
        b.append(clock_map.time("b", t - OFFSET, t + 0.012))
        c.append(clock_map.time("c", t + OFFSET, t + 0.002))
    np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(a, c, atol=1e-9)


@pytest.mark.parametrize("clock", list(Clock))
@pytest.mark.parametrize("leap", [-3000.0, -2.0, 2.0, 3000.0])
def test_jump_begins_the_map_anew(clock: Clock, leap: float) -> None:
    clock_map = ClockMap("s", clock)
    pairs = arrivals(np.arange(0, 4, 0.01), 0.02)
    times = mapped(clock_map, [(t + (leap if t > 2 else 0), a) for t, a in pairs])
    assert 2 <= np.isnan(times).sum() <= 10
    assert np.nanmax(np.abs(times - [t for t, _ in pairs])) < 0.04
    (sentence,) = clock_map.notices(4.0)
    assert "s: " in sentence
    assert f"{leap:+.1f}" in sentence
    assert clock_map.notices(5.0) == []


def test_single_stamp_off_the_line_is_left_out() -> None:
    clock_map = ClockMap("s")
    pairs = [(t + (50 if i == 100 else 0), t + 0.01) for i, t in enumerate(np.arange(0, 3, 0.01))]
    times = mapped(clock_map, pairs)
    assert list(np.flatnonzero(np.isnan(times))) == [100]
    assert clock_map.notices(3.0) == []


def test_stamp_that_is_not_finite_is_left_out() -> None:
    times = mapped(ClockMap("s"), [(0.0, 0.0), (np.nan, 0.1), (np.inf, 0.2), (0.3, 0.3)])
    assert list(np.isnan(times)) == [False, True, True, False]


@pytest.mark.parametrize("clock", list(Clock))
def test_burst_after_a_stall_is_no_jump(clock: Clock) -> None:
    clock_map = ClockMap("s", clock)
    pairs = [(t, 4.0 if 2 < t < 4 else t) for t in np.arange(0, 6, 0.01)]
    assert not np.isnan(mapped(clock_map, pairs)).any()
    assert clock_map.notices(6.0) == []


def test_gap_of_a_stream_is_no_jump() -> None:
    clock_map = ClockMap("s")
    assert not np.isnan(mapped(clock_map, [(t, t) for t in np.arange(0, 20, 0.01) if not 5 < t < 15])).any()
    assert clock_map.notices(20.0) == []


def test_old_samples_of_a_buffer_are_no_jump() -> None:
    clock_map = ClockMap("s")
    pairs = [(t, max(t, 3.0)) for t in np.arange(0, 6, 0.01)]
    times = mapped(clock_map, pairs)
    assert clock_map.notices(6.0) == []
    np.testing.assert_allclose(times[-100:], [t for t, _ in pairs[-100:]], atol=1e-6)


@pytest.mark.parametrize("speed", [4.0, 20.0, np.inf])
def test_gap_of_an_accelerated_replay_is_no_jump(speed: float) -> None:
    clock_map = ClockMap("s", Clock.COMMON)
    stamps = np.array([t for t in np.arange(0, 60, 0.01) if not 20 < t < 25])
    times = mapped(clock_map, [(t, 100 + t / speed) for t in stamps])
    np.testing.assert_array_equal(times, stamps)
    assert clock_map.notices(200.0) == []


def test_own_clock_is_put_on_the_common_one() -> None:
    clock = SessionClock({"replay": Clock.COMMON, "webcam": Clock.OWN})
    errors = []
    for t in np.arange(0, 5, 0.01):
        arrival = 900 + t
        common = clock.arrived("replay", sample(t), arrival)
        own = clock.arrived("webcam", sample(t + OFFSET, VIDEO), arrival + 0.001)
        assert common.time == t
        errors.append(own.time - t)
    assert np.abs(errors).max() < 0.002


def test_without_the_common_clock_this_machines_clock_is_taken() -> None:
    clock = SessionClock({"lsl": Clock.COMMON, "phone": Clock.OWN})
    times = [clock.arrived("phone", sample(t - OFFSET), 900 + t).time for t in np.arange(0, 5, 0.1)]
    assert np.isnan(times[0])
    assert times[-1] == pytest.approx(904.9)
    late = clock.arrived("lsl", sample(7.0, "b"), 905.0)
    assert late.time == pytest.approx(905.0)
