"""Packet counters that wrap; packets lost, late and sent again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.sensors.readings import WRAP_16, Packets, in_order

PATH = Path("walk.txt")


def ordered(counters: list[float], wrap: int = WRAP_16, late: int = 10) -> Packets:
    lines = [i + 5 for i in range(len(counters))]
    return in_order(PATH, np.array(counters, dtype=float), lines, wrap, late, "PacketCounter")


@pytest.mark.parametrize(
    "counters, rows, count, note",
    [
        ([7, 8, 9, 12], [0, 1, 2, 3], [7, 8, 9, 12], None),
        ([65534, 65535, 0, 1], [0, 1, 2, 3], [65534, 65535, 65536, 65537], "passed 65535"),
        ([65534, 0, 65535, 1], [0, 2, 1, 3], [65534, 65535, 65536, 65537], "1 packet late"),
        ([3, 4, 4, 5, 3, 6, 7, 8, 9], [0, 1, 3, 5, 6, 7, 8], [3, 4, 5, 6, 7, 8, 9], "2 packets sent again"),
    ],
    ids=["in order", "wrap", "late across a wrap", "repeated"],
)
def test_sorted_packets(counters: list[float], rows: list[int], count: list[int], note: str | None) -> None:
    got = ordered(counters)
    assert (got.rows.tolist(), got.count.tolist()) == (rows, count)
    assert got.notes == () if note is None else any(note in one for one in got.notes)


@given(
    first=st.integers(0, WRAP_16 - 1),
    steps=st.lists(st.sampled_from([1, 1, 1, 2, 5]), min_size=1, max_size=60),
    seed=st.integers(0, 2**16),
)
def test_sent_packets_are_recovered(first: int, steps: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    sent = first + np.cumsum([0, *steps])
    again = rng.choice(sent, size=len(sent) // 5)
    arrival = np.concatenate([sent, again + 1]) + rng.integers(0, 3, len(sent) + len(again))
    arrival[0] = -1  # the first of a file is the one that others are counted from
    received = np.concatenate([sent, again])[np.argsort(arrival, kind="stable")]
    got = ordered((received % WRAP_16).tolist())
    assert got.count.tolist() == sent.tolist()
    assert (received[got.rows] == sent).all()


@pytest.mark.parametrize(
    ("counters", "line", "message"),
    [
        ([29848, 29849, 1, 2], 7, "goes from 29849 back to 1: it started anew; make a file of each"),
        ([1, np.nan], 6, "is nan, not a whole number"),
        ([1, 65536], 6, "is 65536, not a whole number"),
        ([1, 2, 3, 4, 1, 2, 3, 4], 9, "4 of 8 lines repeat a PacketCounter: it started anew"),
    ],
)
def test_invalid_counter_is_an_error_with_its_line(counters: list[float], line: int, message: str) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        ordered(counters)
    assert caught.value.line == line
    assert "walk.txt" in str(caught.value)
