"""Planted curves of the nine gait variables, and references of planted people."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.gait_scores import build_reference
from rtof_kin.clinical.gait_variables import GaitCycles
from rtof_kin.data.gait_reference import NAMES, PERCENT, SHAPE, GaitReference

Array = NDArray[np.float64]
ABOUT: dict[str, Any] = {"licence": "CC0-1.0", "source": "planted", "system": "rtof_kin 0"}
PHASE = 2 * np.pi * PERCENT / 100
MEAN = np.radians([a + b * np.sin(PHASE + c) for a, b, c in zip(range(9), range(4, 31, 3), range(9), strict=True)])
"""(9, 51) rad, mean curves of planted healthy people."""


def people_curves(count: int, seed: int, size_deg: float = 4.0) -> Array:
    """(count, 2, 9, 51) rad of healthy people: offsets and two harmonics with random amplitudes."""
    rng = np.random.default_rng(seed)
    shapes = np.stack([np.ones(51), np.sin(PHASE), np.cos(PHASE), np.sin(2 * PHASE)])
    own = rng.normal(size=(count, 1, 9, 4)) + 0.4 * rng.normal(size=(count, 2, 9, 4))
    return np.asarray(MEAN + np.radians(size_deg) * (own * [1, 0.5, 0.5, 0.25]) @ shapes)


def cycles_of(curves: Array, sigma_deg: float | None = None, strides: int = 3, speed: float = 1.2) -> GaitCycles:
    """Equal strides of one person with curves (2, 9, 51), right and left."""
    sides = ("right", "left") * strides
    each = np.array([curves[int(side == "left")] for side in sides])
    sigma = None if sigma_deg is None else np.full(each.shape, np.radians(sigma_deg))
    return GaitCycles(sides, each, sigma, np.full(len(sides), speed), "")


def reference_of(curves: Array, **about: Any) -> GaitReference:
    """Reference of people with curves (N, 2, 9, 51)."""
    people = {f"P{k:03d}": cycles_of(one, speed=1.0 + 0.01 * k) for k, one in enumerate(curves)}
    return build_reference(people, **(ABOUT | about))[0]


def means_only(mean: Array = MEAN, **about: Any) -> GaitReference:
    """Reference with means and standard deviations of 3 degrees alone."""
    return GaitReference(mean, np.full(SHAPE, np.radians(3.0)), 20, **(ABOUT | about))


def without(cycles: GaitCycles, name: str) -> GaitCycles:
    """Cycles in which a variable is unobserved."""
    curves = np.array(cycles.curves)
    curves[:, NAMES.index(name)] = np.nan
    return GaitCycles(cycles.sides, curves, cycles.sigma, cycles.speeds, "")
