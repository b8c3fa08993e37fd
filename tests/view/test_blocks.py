"""Time of the motion against the clock, and blocks computed ahead."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.view.blocks import BlockCache
from rtof_kin.view.controls import Playback
from rtof_kin.view.static_page import frames_of_page


def test_speed_pause_and_scrubbing() -> None:
    playback = Playback(2.0, 10.0)
    assert playback.at(100.0) == 2.0
    playback.play(100.0)
    assert playback.at(103.0) == 5.0
    playback.set_speed(0.125, 103.0)
    assert playback.at(111.0) == 6.0
    playback.play(111.0, False)
    assert playback.at(200.0) == 6.0
    playback.seek(99.0, 200.0)
    assert playback.at(201.0) == 10.0
    playback.play(201.0)
    assert playback.at(201.0) == 2.0  # again from the start


def test_end_repeats_or_pauses() -> None:
    playback = Playback(0.0, 1.0)
    playback.play(0.0)
    assert playback.at(1.5) == 0.0
    assert playback.playing
    assert playback.at(1.75) == pytest.approx(0.25)
    playback.repeat = False
    assert playback.at(9.0) == 1.0
    assert not playback.playing


def test_waiting_for_a_frame_does_not_lose_it() -> None:
    playback = Playback(0.0, 10.0)
    playback.play(0.0)
    for now in np.arange(1.0, 3.0, 0.1):
        playback.seek(1.0, float(now))
    assert playback.playing
    assert playback.at(3.0) == pytest.approx(1.1)


def test_blocks_are_computed_once_and_ahead() -> None:
    made: list[tuple[int, int]] = []

    def compute(start: int, stop: int) -> tuple[int, int]:
        made.append((start, stop))
        return start, stop

    cache = BlockCache(250, compute, block=100)
    try:
        assert cache.at(201, 5.0) == ((200, 250), 1)
        assert cache.at(10, 5.0) == ((0, 100), 10)
        assert cache.at(60, 5.0) == ((0, 100), 60)
        assert cache.at(150, 5.0) == ((100, 200), 50)
        assert sorted(made) == [(0, 100), (100, 200), (200, 250)]  # the second one while the first was shown
    finally:
        cache.close()


def test_failure_of_a_block_is_raised_where_it_is_asked_for() -> None:
    def fail(start: int, stop: int) -> None:
        raise RtofError(f"damaged at {start} to {stop}")

    cache = BlockCache(10, fail)
    with pytest.raises(RtofError, match="damaged at 0 to 10"):
        cache.at(3, 5.0)
    cache.close()


def test_frames_of_a_page_are_evenly_spaced_within_its_part() -> None:
    times = 5.0 + np.arange(600) / 60
    assert frames_of_page(times, None, None, 30.0) == list(range(0, 600, 2))
    assert frames_of_page(times, 6.0, 7.0, 10.0) == list(range(60, 121, 6))
    assert frames_of_page(times, None, None, 1000.0) == list(range(600))
    with pytest.raises(InvalidInputError, match="the motion is from 5 to"):
        frames_of_page(times, 50.0, None, 30.0)
    with pytest.raises(InvalidInputError, match="not positive"):
        frames_of_page(times, None, None, 0.0)
