"""Coverage of the confidence bands, and their width relative to the errors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.confidence.cases import Case, angle_errors, errors
from benchmarks.harness import bootstrap
from rtof_kin.core.array_types import Array
from rtof_kin.solve.uncertainty import CovarianceInflation, unsided

Row = dict[str, Any]
NOMINAL = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)
"""Shares of the errors that bands are meant to cover."""
COVERED = 0.90, 0.98
"""Least and largest coverage accepted for a 95 % band."""
WIDEST = 4.0
"""Root mean square errors that a 95 % band may be wide, from edge to edge, in the mean."""
UNITS = {"position": ("mm", 1000.0), "relative": ("mm", 1000.0), "angle": ("deg", np.degrees(1.0))}


@dataclass
class _Collected:
    """Errors and standard deviations of one quantity, a pair of arrays for every recording."""

    groups: list[str] = field(default_factory=list)
    errors: list[Array] = field(default_factory=list)
    sigmas: list[Array] = field(default_factory=list)

    def add(self, group: str, error: Array, sigma: Array) -> None:
        """Those of one recording, all axes together."""
        self.groups.append(group)
        self.errors.append(error.ravel())
        self.sigmas.append(sigma.ravel())


def rows(cases: Sequence[Case], inflation: CovarianceInflation) -> list[Row]:
    """A row for every kind of 2D, number of sensors, joint and clinical angle; both sides together."""
    found: dict[tuple[str, str, str, str], _Collected] = defaultdict(_Collected)
    for case in cases:
        for kind, name, error, sigma in _told(case, inflation):
            found[case.keypoints, case.sensors, kind, name].add(case.motion_name, error, sigma)
    return [
        {"keypoints": keypoints, "sensors": sensors, "kind": kind, "name": name, **_measured(kind, own)}
        for (keypoints, sensors, kind, name), own in found.items()
    ]


def honest(row: Row) -> bool:
    """Return whether a row's 95 % bands have an accepted coverage and width."""
    return bool(COVERED[0] <= row["coverage"]["0.95"] <= COVERED[1] and row["ratio"] <= WIDEST)


def _told(case: Case, inflation: CovarianceInflation) -> Iterator[tuple[str, str, Array, Array]]:
    """Kind, name, errors and standard deviations of everything there is a row of."""
    confidence = case.stated(inflation)
    for kind, name, both in errors(case, confidence):
        if kind in UNITS and len(both.error):
            yield kind, unsided(name), both.error, np.sqrt(np.diagonal(both.covariance, axis1=1, axis2=2))
    for name, error, sigma in angle_errors(case, confidence):
        yield "angle", name.removeprefix("right_").removeprefix("left_"), error, sigma


def _measured(kind: str, own: _Collected) -> Row:
    error, sigma = np.concatenate(own.errors), np.concatenate(own.sigmas)
    unit, scale = UNITS[kind]
    rms, width = np.sqrt(np.mean(error**2)), 2 * norm.ppf(0.975) * np.mean(sigma)
    inside = [np.abs(e) <= norm.ppf(0.975) * s for e, s in zip(own.errors, own.sigmas, strict=True)]
    interval = bootstrap(own.groups, [float(i.mean()) for i in inside], [len(i) for i in inside])
    return {
        "unit": unit,
        "recordings": len(own.errors),
        "rms": float(scale * rms),
        "width": float(scale * width),
        "ratio": float(width / rms),
        "coverage": {
            f"{share:g}": float(np.mean(np.abs(error) <= norm.ppf((1 + share) / 2) * sigma)) for share in NOMINAL
        },
        "interval": interval,
    }
