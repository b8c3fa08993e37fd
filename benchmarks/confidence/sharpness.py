"""Coverage beside sharpness, by rig and number of sensors.

A band that is wide enough for everything covers everything. So its mean half width stands beside that of the
band which is equally wide for all joints, axes and frames of the same recordings and covers as much: what a
stated standard deviation is worth is the difference.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.confidence.cases import Case, errors
from benchmarks.verdicts.scores import rank_correlation
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.solve.uncertainty import CovarianceInflation

Row = dict[str, Any]
KINDS = {"relative": ("mm", 1e3), "position": ("mm", 1e3), "turn": ("deg", np.degrees(1.0))}
"""Unit of the figures of each kind, and its size."""


def sharpness(cases: Sequence[Case], inflation: CovarianceInflation) -> list[Row]:
    """A row for every rig, number of sensors and kind, and for all rigs together."""
    found: dict[tuple[str, str, str], list[tuple[Array, Array]]] = defaultdict(list)
    for case in cases:
        for kind, both in _by_kind(case, inflation).items():
            for rig in (case.rig, "all"):
                found[rig, case.sensors, kind].append(both)
    order = sorted(found, key=lambda key: (int(key[1]), list(KINDS).index(key[2]), key[0]))
    return [
        {"rig": rig, "sensors": sensors, "kind": kind, **_figures(kind, found[rig, sensors, kind])}
        for rig, sensors, kind in order
    ]


def _by_kind(case: Case, inflation: CovarianceInflation) -> dict[str, tuple[Array, Array]]:
    """Errors and standard deviations (n, 3) of a recording."""
    parts: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for kind, _, both in errors(case, case.stated(inflation)):
        sigma = np.sqrt(np.diagonal(both.covariance, axis1=1, axis2=2))
        parts[kind].append((both.error, sigma))
    return {
        kind: (np.concatenate([e for e, _ in own]), np.concatenate([s for _, s in own])) for kind, own in parts.items()
    }


def _figures(kind: str, recordings: Sequence[tuple[Array, Array]]) -> Row:
    error, sigma = (np.concatenate(values) for values in zip(*recordings, strict=True))
    scale = KINDS[kind][1]
    inside = float(np.mean(np.abs(error) <= BAND_95 * sigma))
    sizes = [[np.linalg.norm(value, axis=1) for value in both] for both in recordings]
    return {
        "recordings": len(recordings),
        "inside": inside,
        "stated": float(scale * np.sqrt(np.mean(np.sum(sigma**2, axis=1)))),
        "actual": float(scale * np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "half_width": float(scale * BAND_95 * np.mean(sigma)),
        "constant": float(scale * np.quantile(np.abs(error), inside)),
        "rho": _mean([rank_correlation(*both) for both in sizes]),
        "rho_between": rank_correlation(*np.sqrt([[np.mean(v**2) for v in both] for both in sizes]).T),
    }


def _mean(values: Sequence[float]) -> float:
    """Of those that are known; NaN for none."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def by_rig(found: Sequence[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "## By rig\n",
        "Axis by axis; sizes of errors are root mean squares. *Constant* is the half width of the band that "
        "is equally wide everywhere and covers as much. Rank correlations of stated and actual size: within "
        "recordings (over joints and frames), and of the recordings' root mean squares.\n",
        "| sensors | | rig | recordings | inside 95 % bands | stated | actual | half width | constant "
        "| rank correlation | between recordings |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found:
        sizes = " | ".join(f"{row[name]:.1f}" for name in ("stated", "actual", "half_width", "constant"))
        ranks = " | ".join(f"{row[name]:.2f}".replace("nan", "-") for name in ("rho", "rho_between"))
        what = f"{row['sensors']} | {row['kind']}, {KINDS[row['kind']][0]} | {row['rig']}"
        lines.append(f"| {what} | {row['recordings']} | {100 * row['inside']:.0f} % | {sizes} | {ranks} |")
    return "\n".join(lines) + "\n"
