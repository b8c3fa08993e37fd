"""Tables of the rows: in all, by placement, action and joint; the torso; calibration; by seed.

Lifters named like ``NAME_seed0``, ``NAME_seed1`` differ in the seed of their training alone: the first
of them stands in all tables, the others in the last one.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from statistics import mean, stdev

from benchmarks import harness
from benchmarks.accuracy.tables import chosen
from benchmarks.lifter.measures import DIRECTIONS, PARTS, SIGMAS, TORSO, expected_share, gaussian_share
from benchmarks.lifter.rows import STILL, Row
from rtof_kin.protocols.tables import Cell, Table, pooled

ERRORS = {"rr": "mpjpe_rr_mm", "abs": "mpjpe_mm"}
WORN = {"0": "image only", "8": "+ 8 sensors", "10": "+ 10 sensors"}
_SEEDED = re.compile(r"(.+)_seed(\d+)(.*)")
_POOLED = "Means over the frames in which the camera saw enough, pooled over motions and placements."


def values(rows: Sequence[Row], field: str) -> list[str]:
    """The different values of a field, in their order."""
    return list(dict.fromkeys(row[field] for row in rows))


def measured(rows: Sequence[Row]) -> list[Row]:
    """Those that did not fail."""
    return [row for row in rows if "error" not in row]


def first_seeds(rows: Sequence[Row]) -> list[Row]:
    """Those of no further seed of a training."""
    return [row for row in rows if not (seeded := _SEEDED.fullmatch(row["lifter"])) or seeded[2] == "0"]


def unseeded(name: str) -> str:
    """A lifter's name without the seed of its training."""
    seeded = _SEEDED.fullmatch(name)
    return seeded[1] + seeded[3] if seeded else name


def seeds(rows: Sequence[Row]) -> Table:
    """Spread over the seeds of a training."""
    ways: dict[tuple[str, str, str], list[tuple[str, str, str]]] = defaultdict(list)
    for way in _ways(rows):
        if (name := unseeded(way[1])) != way[1]:
            ways[way[0], name, way[2]].append(way)
    lines: list[tuple[Cell, ...]] = []
    for label, same in ways.items():
        cells: list[Cell] = [*_label(label), str(len(same))]
        for figure in ERRORS.values():
            found = [pooled(_of(rows, way), figure) or 0.0 for way in same]
            cells += [mean(found), stdev(found) if len(found) > 1 else None]
        lines.append(tuple(cells))
    columns = "2D", "training", "given", "seeds", "rr mm", "sd", "abs mm", "sd"
    return Table("seeds", "By seed", columns, (0, 0, 0, 0, 1, 1, 1, 1), tuple(lines))


def _ways(rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """Kind of 2D, lifter and sensors, where there is anything, kinds of 2D first."""
    found = dict.fromkeys((r["keypoints"], r["lifter"], r["sensors"]) for r in rows)
    return [way for kind in values(rows, "keypoints") for way in found if way[0] == kind]


def _of(rows: Sequence[Row], way: tuple[str, str, str]) -> list[Row]:
    return chosen(rows, keypoints=way[0], lifter=way[1], sensors=way[2])


def _label(way: tuple[str, str, str]) -> list[Cell]:
    return [way[0], way[1], "-" if way[1] == STILL else WORN[way[2]]]


def overall(rows: Sequence[Row]) -> Table:
    """Errors of each lifter, with the bootstrap interval over motions."""
    figures = ("mpjpe_rr_mm", "mpjpe_mm", "mpjae", "mpjje")
    lines: list[tuple[Cell, ...]] = []
    for way in _ways(rows):
        same = _of(rows, way)
        frames, errors = ([row[n] for row in same] for n in ("frames", "mpjpe_rr_mm"))
        low, high = harness.bootstrap([row["source"] for row in same], errors, frames)
        seen = 100 * (pooled(same, "coverage", "all_frames") or 0.0)
        means = (pooled(same, name) for name in figures)
        lines.append((*_label(way), *means, f"{low:.1f}-{high:.1f}", seen))
    return Table(
        "overall",
        "In all",
        ("2D", "lifter", "given", "rr mm", "abs mm", "MPJAE m/s2", "MPJJE m/s3", "rr 95 %", "seen %"),
        (0, 0, 0, 1, 1, 2, 0, 0, 0),
        tuple(lines),
        (_POOLED, "Raw output of the lifter, not filtered; intervals are 95 % bootstraps over motions."),
    )


def torso(rows: Sequence[Row]) -> Table:
    """Orientation of pelvis and upper trunk."""
    figures = [f"{name} {part} deg" for name in TORSO for part in PARTS]
    ways = [way for way in _ways(rows) if way[1] != STILL]
    lines = [(*_label(way), *(pooled(_of(rows, way), name) for name in figures)) for way in ways]
    notes = (
        "Yaw: about the vertical. Lean: about a horizontal axis. Of a lifter that gives no orientations: "
        "from its positions.",
    )
    columns = ("2D", "lifter", "given", *figures)
    return Table("torso", "Torso", columns, (0, 0, 0, *[1] * len(figures)), tuple(lines), notes)


def by(field: str, title: str) -> Callable[[Sequence[Row]], Table]:
    """Errors by the value of a field."""

    def table(rows: Sequence[Row]) -> Table:
        found = values(rows, field)
        lines = [
            (
                *_label(way),
                *(
                    pooled(chosen(_of(rows, way), **{field: value}), figure)
                    for value in found
                    for figure in ERRORS.values()
                ),
            )
            for way in _ways(rows)
        ]
        columns = ("2D", "lifter", "given", *(f"{v}: {e} mm" for v in found for e in ERRORS))
        digits = (0, 0, 0, *[1] * (len(columns) - 3))
        return Table(field, title, columns, digits, tuple(lines))

    return table


def joints(rows: Sequence[Row]) -> Table:
    """Root-relative error of every joint."""
    ways = [way for way in _ways(rows) if way[1] != STILL]
    names = [key.removesuffix(" mm") for key in rows[0] if key.endswith(" mm")]
    lines = [(name, *(pooled(_of(rows, way), f"{name} mm") for way in ways)) for name in names]
    columns = ("joint", *(f"{kind}, {name}, {WORN[count]}" for kind, name, count in ways))
    return Table("joints", "By joint, rr mm", columns, (0, *[1] * len(ways)), tuple(lines))


def calibration(rows: Sequence[Row]) -> Table:
    """Shares of errors within the spreads that the lifter states."""
    lines: list[tuple[Cell, ...]] = []
    for way in _ways(rows):
        same = _of(rows, way)
        for name, dimensions in DIRECTIONS.items():
            shares = [pooled(same, f"{name} within {k}") for k in SIGMAS]
            if shares[0] is None:
                continue
            cells: list[Cell] = [*_label(way), name]
            for k, share in zip(SIGMAS, shares, strict=True):
                expected = expected_share(dimensions, k), gaussian_share(k)
                cells += [100 * value for value in (share or 0.0, *expected)]
            lines.append(tuple(cells))
    columns = ["2D", "lifter", "given", "of"]
    columns += [f"within {k} sigma: {what} %" for k in SIGMAS for what in ("share", "Laplace", "Gauss")]
    notes = (
        "Per axis: across the ray to the root, along it, and about each axis of a segment. More within "
        "than expected: the lifter is better than stated. Laplace: the density it is trained with.",
    )
    return Table("calibration", "Calibration", tuple(columns), (0, 0, 0, 0, *[1] * 6), tuple(lines), notes)


TABLES: tuple[Callable[[Sequence[Row]], Table], ...] = (
    overall,
    by("placement", "By placement"),
    by("category", "By action"),
    torso,
    calibration,
    joints,
)


def failures(rows: Sequence[Row]) -> list[str]:
    """A line for every way that ended with an error."""
    about = "motion", "placement", "keypoints", "lifter", "sensors"
    return [f"FAILED: {', '.join(row[name] for name in about)}: {row['error']}" for row in rows if "error" in row]
