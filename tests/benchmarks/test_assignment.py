"""Tables of which sensor is where, from planted rows."""

from __future__ import annotations

from typing import Any

from benchmarks.assignment import tables


def row(sensor: int, found: str, probability: float, doubt: bool) -> dict[str, Any]:
    """A sensor of the left shank in a recording of four sensors."""
    return {
        "recording": f"walk {sensor // 4}",
        "rig": "rig",
        "walk": False,
        "seconds": 10,
        "sensors": 4,
        "image": True,
        "told": False,
        "truth": "LeftLeg",
        "found": found,
        "probability": probability,
        "doubt": doubt,
    }


def test_shares_and_reliability_are_those_planted() -> None:
    rows = [row(i, "LeftLeg", 0.995, False) for i in range(4)]
    rows += [row(i, "RightLeg", 0.6, True) for i in range(4, 8)]
    text = tables(rows)
    assert "| yes | 4 | 2 | 50.0 | 100.0 | 50.0 | 50 | 100.0 | 50 | 100.0 |" in text
    assert "| 50 to 80 % | 4 | 60.0 | 0.0 | 0 | - | - |" in text
    assert "| 99 to 100 % | 4 | 99.5 | 100.0 | 0 | - | - |" in text


def test_planted_errors_are_counted_by_fault() -> None:
    about = {"recording": "walk", "image": True, "doubt": False}
    rows = [row(0, "LeftLeg", 0.9, True)]
    rows += [{**about, "fault": "forearms exchanged", "named": True, "right": right} for right in (True, False)]
    assert "| forearms exchanged | yes | 2 | 100.0 | 50.0 | 0.0 |" in tables(rows)
