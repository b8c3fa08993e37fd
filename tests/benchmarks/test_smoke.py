"""The bounds of the short benchmarks."""

from __future__ import annotations

import math

from benchmarks.smoke import BOUNDS, wrong


def test_figures_within_their_bounds_pass_and_others_are_named() -> None:
    usual = {name: math.sqrt(low * high) for name, (low, high) in BOUNDS.items()}
    assert wrong(usual) == []
    for name, (low, high) in BOUNDS.items():
        for value in (math.nan, math.inf, low / 2, high * 2):
            assert [fault.split()[0] for fault in wrong({**usual, name: value})] == [name]
