"""A sensor study as a document: what its numbers mean in sentences, tables and figures.

A sensor is called needed only where its removal alone clearly takes an angle beyond the tolerance. That it
was removed late proves nothing, because not all sets of the same size were tried. ``study.csv`` has a row for each
set of sensors and angle; ``study.json`` the verdict and settings of the full set, the sets in order and the sentences.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.core.errors import RtofError
from rtof_kin.reporting.angle_names import label, side_and_name
from rtof_kin.reporting.document import Cell, Document, Figure, Table, number, write_files
from rtof_kin.reporting.sensor_study.accuracy import SensorSet
from rtof_kin.reporting.sensor_study.study import CLEARLY, LEAST_SEEN, TOLERANCE, SensorStudy, omitted

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

TABLE: Final = "study.csv"
LEAST_CHANGE: Final = np.radians(1.0)  #: [rad] by which the RMS of an angle grows where a sensor is called needed
NO_ERROR: Final = (
    "A difference from the full set is not an error: an error that both motions share does not appear in it, "
    "and where they differ, either may be wrong."
)
_COLUMNS: Final = "set sensors number angle difference_deg seen_share error_deg half_band_deg kept"
COLUMNS: Final = tuple(_COLUMNS.split())
_FIGURES: Final = ("figures/sensors.png", "figures/number.png")
_SETTINGS: Final = "settings.json"  # written by `rtof_kin.core.jobs.open_runs`
_LARGEST: Final = 20.0  # [deg] end of the colour scale


def write_study(study: SensorStudy, folder: str | Path, figures: bool = True) -> list[Path]:
    """Write the files of a study, ``study.json`` last, and return their paths; earlier ones are replaced."""
    return write_files(document(study, figures), Path(folder))


def remove_results(folder: str | Path) -> None:
    """Remove the results of an earlier study of a folder, so that none remain of a study that is not done."""
    for name in (TABLE, "study.json", *_FIGURES):
        (Path(folder) / name).unlink(missing_ok=True)


@contextmanager
def unused_removed(folder: Path) -> Iterator[None]:
    """Remove the new folder of a study that fails before its first run is done."""
    try:
        yield
    except RtofError:
        runs = folder / "runs"
        if not any(runs.iterdir()):
            runs.rmdir()
            (folder / _SETTINGS).unlink()
            with suppress(OSError):  # results of an earlier study
                folder.rmdir()
        raise


def document(study: SensorStudy, figures: bool = True) -> Document:
    """Return a study as a document."""
    part = study.part
    facts = {
        "recording": study.recording,
        "part_s": [part.start, part.stop],
        "whole_s": part.whole,
        "verdict": study.verdict.plain(),
        "settings": study.choices,
        "runs": study.runs,
        "compared_with": "the truth" if study.has_truth else "the full set of sensors",
        "note": "errors are against the truth; differences against the full set" if study.has_truth else NO_ERROR,
        "tolerance_deg": float(np.degrees(TOLERANCE)),
        "least_seen_share": LEAST_SEEN,
        "segments": study.segments,
        "without": [
            _set_data(study, found) | {"left_out": omitted(found, study.full.sensors)} for found in study.without
        ],
        "path": [_set_data(study, found) for found in study.path],
        "tried": [[_set_data(study, found) for found in step] for step in study.steps],
        "removed_as_well": [list(study.as_good(step)) for step in range(len(study.steps))],
        "standard_deviation_deg": {
            name: number(np.degrees(value), 17) for name, value in zip(study.angles, study.moved, strict=True)
        },
    }
    headline, *others = sentences(study)
    drawn = [
        Figure("figures/sensors", "Change of each angle without each sensor", lambda: worth_of_sensors(study)),
        Figure("figures/number", "RMS of the angles by number of sensors", lambda: error_by_number(study)),
    ]
    return Document(
        "study",
        f"Sensors of {study.recording}",
        headline,
        others,
        printed=[_way_down(study)],
        figures=drawn if figures else [],
        tables={TABLE: Table(COLUMNS, list(_rows(study)))},
        facts=facts,
    )


def _way_down(study: SensorStudy) -> Table:
    """One row for each number of sensors."""
    rows: list[list[Cell]] = []
    for before, found in zip((study.path[0], *study.path), study.path, strict=False):
        gone = [study.segments[name] for name in before.sensors if name not in found.sensors]
        kept = f"{int(study.kept(found).sum())} of {len(study.angles)}"
        rows.append([len(found.sensors), *(gone or [""]), np.degrees(found.loss), kept])
    columns = ("sensors", "without", f"mean {'error' if study.has_truth else 'difference'} [deg]", "angles kept")
    return Table(columns, rows, digits=(0, None, 1, None))


def _set_data(study: SensorStudy, found: SensorSet) -> dict[str, Any]:
    scatter = CLEARLY * np.degrees(found.scatter(study.full))
    return {
        "sensors": list(found.sensors),
        "loss_deg": float(np.degrees(found.loss)),
        "loss_change_scatter_deg": number(scatter, 17),
        "angles_kept": int(study.kept(found).sum()),
    }


def _rows(study: SensorStudy) -> Iterator[list[str]]:
    """Rows of the full set, of each sensor omitted alone, and of the path below the full set."""
    sets = [("full", study.full)]
    sets += [(f"without {omitted(found, study.full.sensors)}", found) for found in study.without]
    sets += [(f"path {len(found.sensors)}", found) for found in study.path[1:]]
    for name, found in sets:
        kept = study.kept(found)
        for a, angle in enumerate(study.angles):
            difference, error, half_band = np.degrees([found.difference[a], found.error[a], found.half_band[a]])
            figures = (difference, found.seen[a], error, half_band)
            cells = [f"{value:.4f}" if np.isfinite(value) else "" for value in figures]
            sensors = " ".join(found.sensors)
            yield [name, sensors, str(len(found.sensors)), angle, *cells, "yes" if kept[a] else "no"]


# --- sentences -----------------------------------------------------------------------------------


def sentences(study: SensorStudy, tolerance: float = TOLERANCE) -> list[str]:
    """Return what was studied, the contribution of each sensor, the order of removal, and what each angle
    needs and does not need, to a tolerance of the RMS in rad.
    """
    shown = [study.angles[a] for a in study.shown]
    first = _scope(study), _meaning(study), _alone(study), _order(study, tolerance)
    return [*first, *_chance(study), *_by_need(study, shown, tolerance)]


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
        f"Removed one after the other, the smallest loss first: {', '.join(gone)}. Angles of {len(study.angles)} "
        f"within {_deg(tolerance, 0)} by number of sensors: {counts}. These are the sets of this order{rest}"
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
    """Sets without one sensor alone that an angle clearly needs: it is lost or clearly worse."""
    full = study.measure(study.full)[a]
    lost = [found for found in study.without if not study.kept(found, tolerance)[a]]
    return [
        found
        for found in lost
        if not found.seen[a] >= LEAST_SEEN or not float(study.measure(found)[a] - full) < LEAST_CHANGE
    ]


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


# --- figures -------------------------------------------------------------------------------------


def worth_of_sensors(study: SensorStudy) -> Plot:
    """Plot the RMS difference from the full set, deg, of each angle without each sensor alone.

    Differences beyond the tolerance are bold.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure as Plot

    rows = list(study.shown)
    size = (4.0 + 0.85 * len(study.without), 2.3 + 0.28 * len(rows))
    figure = Plot(figsize=size, layout="constrained")
    ax = figure.subplots()
    difference = np.degrees(np.stack([found.difference for found in study.without], axis=1)[rows])
    lost = np.stack([found.seen for found in study.without], axis=1)[rows] < LEAST_SEEN
    seen = np.where(lost, np.nan, difference)
    image = ax.imshow(seen, cmap="YlOrRd", vmin=0, vmax=_LARGEST, aspect="auto")
    ax.imshow(np.where(lost, 0.0, np.nan), cmap=ListedColormap(["0.35"]), aspect="auto")
    for (i, j), value in np.ndenumerate(difference):
        text = "unobserved" if lost[i, j] else "" if np.isnan(value) else f"{value:.1f}"
        beyond = value > np.degrees(TOLERANCE)
        colour = "white" if lost[i, j] or value > 0.6 * _LARGEST else "black" if beyond else "0.45"
        weight = "bold" if beyond else "normal"
        ax.text(j, i, text, ha="center", va="center", fontsize=7, color=colour, weight=weight)
    names = [f"{label(study.angles[a])} ({np.degrees(study.moved[a]):.0f})" for a in rows]
    ax.set_yticks(range(len(rows)), names, fontsize=8)
    ax.set_ylabel("angle (its standard deviation in this recording [deg])")
    ax.set_xticks(range(len(study.places)), list(study.places.values()), rotation=30, ha="right", fontsize=8)
    ax.set_xlabel("the one sensor that is omitted")
    scale = "RMS difference from all sensors [deg]"
    figure.colorbar(image, ax=ax, label=scale, extend="max", shrink=0.6)
    limit = f"{np.degrees(TOLERANCE):.0f} deg"
    figure.suptitle(
        f"{study.recording}: how far each angle changes if one sensor is omitted\n"
        f"(a change, not an error; bold: beyond {limit})",
        fontsize=11,
    )
    return figure


def error_by_number(study: SensorStudy) -> Plot:
    """Plot the RMS of the angles against the number of sensors, one panel for each joint, and name the
    sensor that is removed at each step.
    """
    from matplotlib.figure import Figure as Plot

    joints: dict[str, list[int]] = {}
    for a in study.shown:
        joint = side_and_name(study.angles[a])[1].partition("_")[0]
        joints.setdefault(joint, []).append(a)
    columns = min(3, len(joints))
    lines = -(-len(joints) // columns)
    figure = Plot(figsize=(4.6 * columns, 3.4 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, sharex=True, squeeze=False).ravel()
    number = [len(found.sensors) for found in study.path]
    gone = [study.places[omitted(found, larger.sensors)] for larger, found in pairwise(study.path)]
    steps = [f"{n}\n{name.replace(' ', chr(10))}" for n, name in zip(number, ["", *gone], strict=True)]
    values = np.degrees(np.stack([study.measure(found) for found in study.path]))
    values[np.stack([found.seen for found in study.path]) < LEAST_SEEN] = np.nan
    for ax, (joint, own) in zip(panels, joints.items(), strict=False):
        for a in own:
            name, line = label(study.angles[a].replace(f"{joint}_", "")), "-"
            if study.angles[a].startswith("left_"):
                line = "--"
            ax.plot(number, values[:, a], marker="o", ms=3, lw=1.2, label=name, ls=line)
        ax.axhline(np.degrees(TOLERANCE), color="0.5", lw=0.8, ls=":")
        ax.set_title(joint, fontsize=9)
        ax.set_ylabel("RMS [deg]", fontsize=8)
        ax.set_ylim(bottom=0)
        ax.set_xlim(max(number) + 0.3, min(number) - 0.3)
        ax.set_xticks(number, steps, fontsize=7)
        ax.tick_params("x", labelbottom=True)
        ax.legend(fontsize=6, ncols=2 if len(own) > 6 else 1, framealpha=0.6)
        ax.grid(alpha=0.3)
    for ax in panels[len(joints) :]:
        ax.set_visible(False)
    for ax in panels[max(0, len(joints) - columns) : len(joints)]:
        ax.set_xlabel("number of sensors, and the one removed last", fontsize=8)
    what = "error against the truth" if study.has_truth else "difference from the full set (not an error)"
    figure.suptitle(
        f"{study.recording}: {what}; a line ends where the angle is unobserved\n"
        "(one order of removal: not all sets of the same size were tried, and others may be better)",
        fontsize=11,
    )
    return figure
