"""Stamps on this machine's clock, and jumps of a sender's clock."""

from __future__ import annotations

import re

import numpy as np
import pytest

from rtof_kin.live.lsl import LslClock

RATE_HZ = 50.0


def replay(clock: LslClock, stamps: np.ndarray, arrivals: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times of stamps that arrive in chunks of two, and the sentences."""
    times, sentences = [], []
    for i in range(0, len(stamps), 2):
        some, sentence = clock.times(stamps[i : i + 2], float(arrivals[i : i + 2].max()))
        times.append(some)
        sentences += [sentence] if sentence else []
    return np.concatenate(times), sentences


def test_measured_offset_is_added_and_small_changes_are_no_jump() -> None:
    clock = LslClock()
    assert clock.offset_s == 0.0
    assert clock.corrected_by(None) is None
    assert clock.corrected_by(-120.0) is None
    assert clock.corrected_by(-120.0004) is None
    times, sentence = clock.times(np.array([1120.0, 1120.02]), 1000.03)
    np.testing.assert_allclose(times, [999.9996, 1000.0196])
    assert (sentence, clock.offset_s) == (None, -120.0004)


def test_loss_gaps_jitter_and_late_samples_are_no_jumps() -> None:
    rng = np.random.default_rng(0)
    true = 1000 + np.arange(500) / RATE_HZ
    true = true[(rng.uniform(size=500) > 0.1) & ~((true > 1003) & (true < 1006))]
    arrivals = np.maximum.accumulate(true + rng.uniform(0, 0.05, len(true)))
    stamps = true.copy()
    stamps[[100, 101]] = stamps[[101, 100]]
    times, sentences = replay(LslClock(), stamps, arrivals)
    np.testing.assert_array_equal(times, stamps)
    assert sentences == []


@pytest.mark.parametrize("jump", [3600.0, -3600.0, 1.7e9, 2.0])
def test_jump_of_stamps_is_said_once_and_times_go_on(jump: float) -> None:
    rng = np.random.default_rng(1)
    true = 1000 + np.arange(400) / RATE_HZ
    arrivals = np.maximum.accumulate(true + rng.uniform(0.005, 0.05, len(true)))
    stamps = true + np.where(np.arange(400) >= 201, jump, 0.0)
    times, sentences = replay(LslClock(), stamps, arrivals)
    np.testing.assert_allclose(times, true, atol=0.06)
    np.testing.assert_allclose(np.diff(times[202:]), 1 / RATE_HZ, atol=1e-6)
    (sentence,) = sentences
    said = re.search(r"[+-][\d.]+", sentence)
    assert said is not None
    assert float(said[0]) == pytest.approx(jump, abs=0.06)


def test_stamps_of_another_clock_from_the_start_are_mapped_by_arrival() -> None:
    clock = LslClock()
    true = 1000 + np.arange(100) / RATE_HZ
    times, sentences = replay(clock, true + 1.7e9, true + 0.01)
    np.testing.assert_allclose(times, true, atol=0.05)
    assert len(sentences) == 1
    assert clock.offset_s == pytest.approx(-1.7e9, abs=0.1)
    assert clock.corrected_by(-1.7e9) is None  # the first measurement came late
    assert clock.offset_s == -1.7e9


def test_jump_of_the_offset_is_said_and_replaces_that_of_the_stamps() -> None:
    clock = LslClock()
    clock.corrected_by(5.0)
    clock.times(np.array([995.0]), 1000.0)
    _, said = clock.times(np.array([1995.02]), 1000.02)  # the sender's clock is 1000 s ahead from here on
    assert said is not None
    sentence = clock.corrected_by(-995.0)
    assert sentence is not None
    assert "+1000.000 s" in sentence
    times, again = clock.times(np.array([1995.04]), 1000.04)
    np.testing.assert_allclose(times, 1000.04)
    assert again is None
    assert clock.corrected_by(-994.0) is not None


def test_jumps_without_end_are_said_five_times_and_missing_stamps_stay_missing() -> None:
    clock = LslClock()
    said = [clock.times(np.array([1000.0 + i + 100 * (i % 2)]), 1000.0 + i)[1] for i in range(40)]
    assert sum(sentence is not None for sentence in said) == 5
    times, sentence = clock.times(np.array([np.nan, np.inf]), 1040.0)
    assert not np.isfinite(times).any()
    assert sentence is None
    assert clock.times(np.zeros(0), 1041.0) == (pytest.approx([]), None)
