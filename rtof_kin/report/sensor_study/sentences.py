"""What the numbers of a sensor study mean, in sentences.

A sensor is called needed only where its removal alone takes an angle beyond the tolerance. That it was
removed late proves nothing, because other sets of the same size were not tried.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from rtof_kin.report.angle_names import label, side_and_name
from rtof_kin.report.sensor_study.accuracy import SensorSet
from rtof_kin.report.sensor_study.study import CLEARLY, LEAST_SEEN, TOLERANCE, SensorStudy, omitted

NO_ERROR: Final = (
    "A difference from the full set is not an error: an error that both motions share does not appear in it, "
    "and where they differ, either may be wrong."
)


def sentences(study: SensorStudy, tolerance: float = TOLERANCE) -> list[str]:
    """Return what was studied, the contribution of each sensor, the order of removal, and what each angle
    needs and does not need.

    Args:
        study: of a recording. tolerance: RMS, rad.
    """
    shown = [study.angles[a] for a in study.shown]
    return [
        _scope(study), _meaning(study), _alone(study), _order(study, tolerance), *_chance(study),
        *_by_need(study, shown, tolerance),
    ]  # fmt: skip


def _scope(study: SensorStudy) -> str:
    part = study.part
    what = f"{part.seconds:.3g} s"
    if not part.is_whole:
        what = f"the {what} with the most movement (from {part.start:.0f} s) of {part.whole:.0f} s"
    return (
        f"Studied: {what} of {study.recording}. It is one recording of one person: other people and "
        "movements may give other numbers, so repeat the study on several before a sensor is left out."
    )


def _meaning(study: SensorStudy) -> str:
    if study.has_truth:
        return "Numbers are RMS errors against the truth of this recording."
    text = (
        f"Numbers are RMS differences from the motion with all {len(study.full.sensors)} sensors. {NO_ERROR}"
    )
    half = study.full.half_band[np.isfinite(study.full.half_band)]
    if not half.size:
        return text
    band = _deg(float(np.median(half)))
    return f"{text} With all sensors the 95 % bands of the angles are +-{band} in the median."


def _alone(study: SensorStudy) -> str:
    """Which sensors matter when one alone is omitted."""
    ranked = sorted(study.without, key=lambda found: found.loss)
    chosen = {"most": ranked[-1], "least": ranked[0]} if len(ranked) > 1 else {"most": ranked[0]}
    what = f"mean {'error' if study.has_truth else 'difference'} of {len(study.angles)} angles"
    texts = []
    for which, found in chosen.items():
        value = f"{_deg(study.full.loss)} to {_deg(found.loss)}" if study.has_truth else _deg(found.loss)
        texts.append(f"the {_place(study, found)} matters {which} ({value} +-{_scatter(study.full, found)})")
    return (
        f"Of sensors omitted alone, {' and '.join(texts)}: {what}, +- {CLEARLY:.0f} standard errors by the "
        "scatter within this recording."
    )


def _order(study: SensorStudy, tolerance: float) -> str:
    """Order of removal, and what was not tried."""
    gone = [
        study.places[omitted(found, larger.sensors)]
        for larger, found in zip(study.path, study.path[1:], strict=False)
    ]
    n, tried = len(study.full.sensors), study.runs
    kept = [int(study.kept(found, tolerance).sum()) for found in study.path]
    counts = ", ".join(f"{len(found.sensors)}: {k}" for found, k in zip(study.path, kept, strict=True))
    every = 2**n - (0 if study.camera else 1)
    rest = "." if tried == every else (
        f": {tried} of {every} possible sets were tried, and others of the same size may be as good or "
        "better. That a sensor is removed late does not prove that it is needed."
    )  # fmt: skip
    return (
        f"Removed one after the other, the smallest loss first: {', '.join(gone)}. Angles of "
        f"{len(study.angles)} within {_deg(tolerance, 0)} by number of sensors: {counts}. These are the sets "
        f"of this order{rest}"
    )


def _chance(study: SensorStudy) -> Iterator[str]:
    """Removals that could as well have been others."""
    others = {k: study.as_good(k) for k in range(len(study.steps))}
    undecided = [
        f"{len(study.path[k + 1].sensors)} left: {', '.join(study.places[name] for name in names)}"
        for k, names in others.items() if names
    ]  # fmt: skip
    if undecided:
        yield (
            "The order is partly chance: within the scatter, these at least could have been removed instead: "
            f"{'; '.join(undecided)}."
        )


def _by_need(study: SensorStudy, shown: list[str], tolerance: float) -> Iterator[str]:
    """One sentence for each of four groups of angles."""
    limit = _deg(tolerance, 0)
    never: list[str] = []
    still: list[str] = []
    beyond: list[str] = []
    sensitive: list[str] = []
    down: dict[int, list[str]] = {}
    for name in shown:
        a = study.angles.index(name)
        kept = [bool(study.kept(found, tolerance)[a]) for found in study.path]
        alone = [found for found in study.without if not study.kept(found, tolerance)[a]]
        if not kept[0]:
            beyond.append(f"{label(name)} ({_deg(float(study.measure(study.full)[a]))})")
        elif alone:
            sensitive.append(f"{label(name)} {_without(study, a, alone)}")
        elif all(kept):
            (never if study.moved[a] > tolerance else still).append(name)
        else:
            fewest = study.fewest(name, tolerance)
            assert fewest is not None
            down.setdefault(len(fewest.sensors), []).append(name)
    least = study.path[-1]
    last = "the camera alone" if not least.sensors else f"the {study.places[least.sensors[0]]} alone"
    no_need = (
        "No sensor is needed" if not least.sensors else f"The {study.places[least.sensors[0]]} is enough"
    )
    if never:
        yield f"{no_need}, within {limit} in every set of the order down to {last}: {_both_sides(never)}."
    if still:
        yield (
            f"Within {limit} in every set too, but this says little, because they hardly move here (standard "
            f"deviation under {limit}): {_both_sides(still)}."
        )
    if down:
        sets = (f"{_both_sides(names)} down to {number}" for number, names in sorted(down.items()))
        yield (
            f"No single sensor is needed, and these stay within {limit} in this order of removal: "
            f"{'; '.join(sets)} sensors."
        )
    if sensitive:
        yield f"Beyond {limit} where one sensor alone is omitted, so it is needed: {'; '.join(sensitive)}."
    if beyond:
        yield (
            f"Beyond {limit} even with all {len(study.full.sensors)} sensors, so that this study cannot say "
            f"what they need: {', '.join(beyond)}."
        )


def _without(study: SensorStudy, a: int, alone: Iterable[SensorSet]) -> str:
    """Sensors whose removal alone takes an angle beyond the tolerance, with its RMS."""
    texts = []
    for found in alone:
        value = float(study.measure(found)[a])
        seen = not found.seen[a] < LEAST_SEEN
        texts.append(f"{_place(study, found)} ({_deg(value) if seen else 'unobserved'})")
    return f"without {' or '.join(texts)}"


def _place(study: SensorStudy, found: SensorSet) -> str:
    return study.places[omitted(found, study.full.sensors)]


def _scatter(a: SensorSet, b: SensorSet) -> str:
    return f"{CLEARLY * np.degrees(a.scatter(b)):.1f}"


def _both_sides(names: list[str]) -> str:
    """Names of angles in words, one for both sides."""
    sides: dict[str, list[str]] = {}
    for name in names:
        side, rest = side_and_name(name)
        sides.setdefault(rest, []).append(side)
    return ", ".join(
        label(rest) if len(own) > 1 or not own[0] else f"{own[0]} {label(rest)}"
        for rest, own in sides.items()
    )


def _deg(radians: float, digits: int = 1) -> str:
    return f"{np.degrees(radians):.{digits}f} deg"
