"""Visits of planted walking, as motions and as folders, for the tests of follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from clinical_support import walking
from report_support import certain_to, folder_of

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.visits import Setup, Trial, Visit, trial

JITTER = (0.0, 0.011, -0.009, 0.006, -0.013, 0.004)
"""Planted differences between the trials of a visit, share of the speed."""


def walk_at(speed: float, number: int, certain: bool = True, **how: Any) -> Motion:
    """Planted walking of 4.5 s; the number changes it a little, as trials differ."""
    motion = walking(
        4.5, speed=speed * (1 + JITTER[number % 6]), stride_time=1.2 * (1 - JITTER[(number + 2) % 6] / 2), **how
    )
    return replace(motion, confidence=certain_to(2.0, motion)) if certain else motion


def visit(name: str, speed: float, first: int = 0, trials: int = 2, **setup: Any) -> Visit:
    """A visit with trials at a speed."""
    own: list[Trial] = []
    for number in range(first, first + trials):
        own.append(trial(f"walk{number}", walk_at(speed, number), Setup(**setup)))
    return Visit(name, tuple(own))


def visit_folders(folder: Path, speeds: Mapping[str, float], trials: Sequence[int] = (0, 1), **inputs: Any) -> Path:
    """Folder of visits by name of the visit -> speed, with outputs as of reconstruct."""
    for number, (name, speed) in enumerate(speeds.items()):
        for own in trials:
            motion = walk_at(speed, own + number)
            fields = {"recording": f"{name} {own}", "inputs": {"software": "rtof_kin 1.0", **inputs}}
            folder_of(motion, folder / name / f"walk{own}", **fields)
    return folder


def noise(seed: int, shape: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Standard normal numbers."""
    return np.random.default_rng(seed).normal(size=shape)
