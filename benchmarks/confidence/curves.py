"""Factors of bands that contain whole curves: made by split-conformal prediction over people, and measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.confidence.cases import Case, angle_errors
from benchmarks.harness import bootstrap
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.solve.uncertainty import CURVES, CovarianceInflation, CurveFactors

LEVEL = 0.9
"""Share of the curves that are meant to be inside throughout."""
FEWEST_SECONDS = 0.5
"""For which an angle must be known to count as a curve."""


class Curve(NamedTuple):
    """One angle in one recording."""

    person: str
    sensors: int
    angle: str
    """Without its side."""
    score: float
    """The largest |error| / sigma."""
    sigma_deg: float
    """Mean along the recording."""


def curves(case: Case, person: str, inflation: CovarianceInflation) -> Iterator[Curve]:
    """All known angles of a recording, both sides; frames near a singular posture do not count."""
    for name, error, sigma in angle_errors(case, case.stated(inflation), regular=True):
        if len(error) >= FEWEST_SECONDS * case.motion.poses.rate_hz:
            angle, score = name.removeprefix("right_").removeprefix("left_"), float(np.max(np.abs(error) / sigma))
            yield Curve(person, int(case.sensors), angle, score, float(np.degrees(sigma.mean())))


def conformal_quantile(scores: Sequence[Array], level: float = LEVEL) -> float:
    """The smallest score q for which the people's shares of scores up to q, each over n + 1, add up to `level`.

    Infinite where n people are too few: the person to come may have any score.

    Args:
        scores: (m,) of each of n people.
    """
    values = np.concatenate(scores)
    weights = np.concatenate([np.full(len(own), 1 / len(own)) for own in scores]) / (len(scores) + 1)
    order = np.argsort(values)
    enough = np.flatnonzero(np.cumsum(weights[order]) >= level - 1e-9)
    return float(values[order[enough[0]]]) if len(enough) else np.inf


def curve_factors(found: Iterable[Curve], made_of: str) -> CurveFactors:
    """The factors of all angles that enough people showed."""
    by_person: dict[int, dict[str, dict[str, list[float]]]] = defaultdict(
        lambda: defaultdict(lambda: defaultdict(list))
    )
    people = set()
    for one in found:
        by_person[one.sensors][one.angle][one.person].append(one.score)
        people.add(one.person)
    quantiles = {
        sensors: {angle: conformal_quantile([np.array(own) for own in of.values()]) for angle, of in angles.items()}
        for sensors, angles in by_person.items()
    }
    finite = {count: {name: q for name, q in own.items() if np.isfinite(q)} for count, own in quantiles.items()}
    return CurveFactors(finite, len(people), LEVEL, made_of)


def as_toml(factors: CurveFactors) -> str:
    """The text of the table in the inflation's file; factors are rounded up, so that they keep their level."""
    lines = [
        f"[{CURVES}]  # standard deviations that contain a whole curve, by number of sensors and angle",
        f"people = {factors.people}",
        f"level = {factors.level:g}",
        f'made_of = "{factors.made_of}"',
    ]
    for sensors, own in sorted(factors.factors.items()):
        lines += [
            "",
            f"[{CURVES}.{sensors}]",
            *(f"{angle} = {np.ceil(100 * factor - 1e-6) / 100:g}" for angle, factor in own.items()),
        ]
    return "\n".join(lines) + "\n"


def split_file(text: str) -> tuple[str, bool]:
    """The text of the inflation alone, and whether there were factors of curves behind it."""
    inflation, table, _ = text.partition(f"[{CURVES}]")
    return inflation.rstrip() + "\n", bool(table)


def coverage(found: Sequence[Curve], factors: CurveFactors) -> list[dict[str, Any]]:
    """A row for every number of sensors, all angles together and each: shares of curves that are inside throughout."""
    out = []
    for sensors in sorted({one.sensors for one in found}):
        own = [(one, f) for one in found if one.sensors == sensors and (f := factors.factor(one.angle, sensors))]
        for angle in ("all", *dict.fromkeys(one.angle for one, _ in own)):
            of = [(one, f) for one, f in own if angle in ("all", one.angle)]
            inside = [float(one.score <= f) for one, f in of]
            sigma = np.array([one.sigma_deg for one, _ in of])
            out.append(
                {
                    "sensors": sensors,
                    "angle": angle,
                    "curves": len(of),
                    "people": len({one.person for one, _ in of}),
                    "inside": float(np.mean(inside)),
                    "interval": bootstrap([one.person for one, _ in of], inside, np.ones(len(of))),
                    "inside_95": float(np.mean([one.score <= BAND_95 for one, _ in of])),
                    "half_deg": float(np.mean([f for _, f in of] * sigma)),
                    "half_95_deg": float(BAND_95 * sigma.mean()),
                    "factor": float(np.mean([f for _, f in of])),
                }
            )
    return out


def section(rows: Sequence[dict[str, Any]], factors: CurveFactors) -> str:
    """The rows as Markdown."""
    whole, counts = [row for row in rows if row["angle"] == "all"], sorted({row["sensors"] for row in rows})
    level, n = f"{100 * factors.level:g} %", factors.people
    lines = [
        "## Whole curves\n",
        f"Share of the curves (an angle of a recording, 2 to 10 s, all frames at 60 Hz) that lie inside throughout: of "
        f"bands for {level} of the curves, made by split-conformal prediction over {n} people, and of those of "
        f"± {BAND_95:.2f} sigma. The benchmark's motions without the exercises, whose people the factors are made of. "
        f"1 / (n + 1) is {100 / (n + 1):.1f} %; over draws of {n} people the coverage of one angle has a standard "
        f"deviation of {100 * np.sqrt(factors.level * (1 - factors.level) / (n + 2)):.1f} %. The interval is the 95 % "
        f"bootstrap over the {whole[0]['people']} people. Half widths are means over curves, of both bands.\n",
        f"| sensors | curves | inside, {level} meant | interval | inside ± 1.96 sigma | half widths (deg) |",
        "|---|---|---|---|---|---|",
    ]
    for row in whole:
        low, high = (f"{100 * end:.0f}" for end in row["interval"])
        lines.append(
            f"| {row['sensors']} | {row['curves']} | {100 * row['inside']:.0f} % | {low}-{high} % "
            f"| {100 * row['inside_95']:.0f} % | {row['half_deg']:.1f}, {row['half_95_deg']:.1f} |"
        )
    lines += [
        "\nEach angle: factor, share inside, half width in degrees.\n",
        "| | " + " | ".join(f"{count} sensors" for count in counts) + " |",
        "|---|" + "---|" * len(counts),
    ]
    cells = {
        (row["angle"], row["sensors"]): f"{row['factor']:.1f}, {100 * row['inside']:.0f} %, {row['half_deg']:.0f}"
        for row in rows
    }
    for angle in dict.fromkeys(row["angle"] for row in rows if row["angle"] != "all"):
        shown = " | ".join(cells.get((angle, count), "-") for count in counts)
        lines.append(f"| {angle.replace('_', ' ')} | {shown} |")
    return "\n".join(lines) + "\n"
