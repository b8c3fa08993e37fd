"""What the numbers of a sensor study mean, in sentences.

A sensor is called needed only where its removal alone clearly takes an angle beyond the tolerance. That it
was removed late proves nothing, because not all sets of the same size were tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from rtof_kin.reporting.angle_names import label, side_and_name
from rtof_kin.reporting.sensor_study.accuracy import SensorSet
from rtof_kin.reporting.sensor_study.study import CLEARLY, LEAST_SEEN, TOLERANCE, SensorStudy, omitted

LEAST_CHANGE: Final = np.radians(1.0)
"""[rad] by which the RMS of an angle grows where a sensor is called needed."""
NO_ERROR: Final = (
    "A difference from the full set is not an error: an error that both motions share does not appear in it, "
    "and where they differ, either may be wrong."
)


def sentences(study: SensorStudy, tolerance: float = TOLERANCE) -> list[str]:
    """Return what was studied, the contribution of each sensor, the order of removal, and what each angle
    needs and does not need.

    Args:
        tolerance: RMS, rad.
    """
    shown = [study.angles[a] for a in study.shown]
    return [
        _scope(study),
        _meaning(study),
        _alone(study),
        _order(study, tolerance),
        *_chance(study),
        *_by_need(study, shown, tolerance),
    ]


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
    text = f"Numbers are RMS differences from the motion with all {len(study.full.sensors)} sensors. {NO_ERROR}"
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
        study.places[omitted(found, larger.sensors)] for larger, found in zip(study.path, study.path[1:], strict=False)
    ]
    n, tried = len(study.full.sensors), study.runs
    kept = [int(study.kept(found, tolerance).sum()) for found in study.path]
    counts = ", ".join(f"{len(found.sensors)}: {k}" for found, k in zip(study.path, kept, strict=True))
    every = 2**n - (0 if study.camera else 1)
    rest = (
        "."
        if tried == every
        else (
            f": {tried} of {every} possible sets were tried, and others of the same size may be as good or "
            "better. That a sensor is removed late does not prove that it is needed."
        )
    )
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
        for k, names in others.items()
        if names
    ]
    if undecided:
        yield (
            "The order is partly chance: within the scatter, these at least could have been removed instead: "
            f"{'; '.join(undecided)}."
        )


def _by_need(study: SensorStudy, shown: list[str], tolerance: float) -> Iterator[str]:
    """One sentence for each group of angles."""
    groups: dict[str, list[str]] = {}
    for name in shown:
        groups.setdefault(_need(study, name, tolerance), []).append(name)
    limit, least = _deg(tolerance, 0), study.path[-1].sensors
    last = f"the {study.places[least[0]]}" if least else "the camera"
    enough = f"{last[0].upper()}{last[1:]} is enough" if least else "No sensor is needed"
    says = {
        "none": f"{enough}, within {limit} in every set of the order down to {last} alone",
        "several": f"No single sensor is needed, and these stay within {limit} in this order of removal",
        "single": f"Beyond {limit} where one sensor alone is omitted, so that it is needed for this angle",
        "slight": f"Within {limit} with all sensors and slightly beyond it without some single one (by a "
        f"change of less than {_deg(LEAST_CHANGE, 0)})",
        "still": f"These hardly move here (standard deviation under {limit}), so that being within {limit} says little",
        "beyond": f"Beyond {limit} even with all {len(study.full.sensors)} sensors, so that this study "
        "cannot say what they need",
    }
    for group, beginning in says.items():
        if names := groups.get(group):
            yield f"{beginning}: {_listed(study, group, names, tolerance)}."


def _need(study: SensorStudy, name: str, tolerance: float) -> str:
    """What an angle needs: 'none', 'several' sensors, a 'single' one, a single one for a 'slight' change; or
    that it is 'beyond' the tolerance anyway or nearly 'still'.
    """
    a = study.angles.index(name)
    kept = [bool(study.kept(found, tolerance)[a]) for found in study.path]
    if not kept[0]:
        return "beyond"
    if _needed(study, a, tolerance):
        return "single"
    if not study.moved[a] > tolerance:
        return "still"
    if not all(study.kept(found, tolerance)[a] for found in study.without):
        return "slight"
    return "none" if all(kept) else "several"


def _listed(study: SensorStudy, group: str, names: list[str], tolerance: float) -> str:
    """The angles of a group with what belongs to it."""
    index = [study.angles.index(name) for name in names]
    if group in ("none", "still"):
        return _both_sides(names)
    if group == "single":
        return "; ".join(f"{_named(study, a)} {_without(study, a, tolerance)}" for a in index)
    if group in ("slight", "beyond"):
        return ", ".join(_named(study, a) for a in index)
    down: dict[int, list[str]] = {}
    for name in names:
        if (fewest := study.fewest(name, tolerance)) is not None:
            down.setdefault(len(fewest.sensors), []).append(name)
    sets = (f"{_both_sides(own)} down to {number}" for number, own in sorted(down.items()))
    return f"{'; '.join(sets)} sensors"


def _needed(study: SensorStudy, a: int, tolerance: float) -> list[SensorSet]:
    """Sets without one sensor alone that an angle clearly needs."""
    return [found for found in study.without if not study.kept(found, tolerance)[a] and _changed(study, a, found)]


def _changed(study: SensorStudy, a: int, found: SensorSet) -> bool:
    """Whether an angle is lost without a sensor, or clearly worse."""
    change = float(study.measure(found)[a] - study.measure(study.full)[a])
    return not found.seen[a] >= LEAST_SEEN or not change < LEAST_CHANGE


def _named(study: SensorStudy, a: int) -> str:
    """An angle in words, with its error with all sensors if there is a truth."""
    error = f" ({_deg(float(study.full.error[a]))})" if study.has_truth else ""
    return f"{label(study.angles[a])}{error}"


def _without(study: SensorStudy, a: int, tolerance: float) -> str:
    """Sensors whose removal alone takes an angle beyond the tolerance, with its RMS."""
    texts = []
    for found in _needed(study, a, tolerance):
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
        label(rest) if len(own) > 1 or not own[0] else f"{own[0]} {label(rest)}" for rest, own in sides.items()
    )


def _deg(radians: float, digits: int = 1) -> str:
    return f"{np.degrees(radians):.{digits}f} deg"
