"""A sensor study as a document: what its numbers mean in sentences, tables and figures.

A sensor is called needed only where its removal alone clearly takes an angle beyond the tolerance. That it
was removed late proves nothing, because not all sets of the same size were tried. ``study.csv`` has a row for each
set of sensors and angle; ``study.json`` the verdict and settings of the full set, the sets in order and the sentences.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.reporting.angle_names import label, side_and_name
from rtof_kin.reporting.document import Cell, Document, Figure, Table, number, subplots, write_files
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
_LARGEST: Final = 20.0  # [deg] end of the colour scale


def write_study(study: SensorStudy, folder: str | Path, figures: bool = True) -> list[Path]:
    """Write the files of a study, ``study.json`` last, and return their paths; earlier ones are replaced."""
    return write_files(document(study, figures), Path(folder))


def remove_results(folder: str | Path) -> None:
    """Remove the results of an earlier study of a folder, so that none remain of a study that is not done."""
    for name in (TABLE, "study.json", *_FIGURES):
        (Path(folder) / name).unlink(missing_ok=True)


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
    part, n = study.part, len(study.full.sensors)
    what = f"{part.seconds:.3g} s"
    if not part.is_whole:
        what = f"the {what} with the most movement (from {part.start:.0f} s) of {part.whole:.0f} s"
    meaning = "Numbers are RMS errors against the truth of this recording."
    if not study.has_truth:
        meaning = f"Numbers are RMS differences from the motion with all {n} sensors. {NO_ERROR}"
        half = study.full.half_band[np.isfinite(study.full.half_band)]
        if half.size:
            meaning += (
                f" With all sensors the 95 % bands of the angles are +-{_deg(float(np.median(half)))} in the median."
            )
    ranked = sorted(study.without, key=lambda found: found.loss)
    chosen = {"most": ranked[-1]} | ({"least": ranked[0]} if len(ranked) > 1 else {})
    before = f"{_deg(study.full.loss)} to " if study.has_truth else ""
    alone = [
        f"the {_place(study, found)} matters {which} ({before}{_deg(found.loss)} "
        f"+-{CLEARLY * np.degrees(study.full.scatter(found)):.1f})"
        for which, found in chosen.items()
    ]
    return [
        f"Studied: {what} of {study.recording}. It is one recording of one person: other people and "
        "movements may give other numbers, so repeat the study on several before a sensor is left out.",
        meaning,
        f"Of sensors omitted alone, {' and '.join(alone)}: mean {'error' if study.has_truth else 'difference'} of "
        f"{len(study.angles)} angles, +- {CLEARLY:.0f} standard errors by the scatter within this recording.",
        _order(study, tolerance),
        *_by_need(study, tolerance),
    ]


def _order(study: SensorStudy, tolerance: float) -> str:
    """Order of removal, what was not tried, and removals that could as well have been others."""
    gone = [study.places[omitted(found, larger.sensors)] for larger, found in pairwise(study.path)]
    counts = ", ".join(f"{len(found.sensors)}: {int(study.kept(found, tolerance).sum())}" for found in study.path)
    text = (
        f"Removed one after the other, the smallest loss first: {', '.join(gone)}. Angles of {len(study.angles)} "
        f"within {_deg(tolerance, 0)} by number of sensors: {counts}."
    )
    every = 2 ** len(study.full.sensors) - (0 if study.camera else 1)
    if study.runs < every:
        text += (
            f" {study.runs} of {every} possible sets were tried, and others of the same size may be as good or better. "
            "That a sensor is removed late does not prove that it is needed."
        )
    undecided = [
        f"{len(found.sensors)} left: {', '.join(study.places[name] for name in names)}"
        for step, found in enumerate(study.path[1:])
        if (names := study.as_good(step))
    ]
    if undecided:
        text += (
            " The order is partly chance: within the scatter, these at least could have been removed instead: "
            f"{'; '.join(undecided)}."
        )
    return text


def _by_need(study: SensorStudy, tolerance: float) -> Iterator[str]:
    """One sentence for each group of angles: those that need one sensor, none, that hardly move, or are beyond."""
    limit, groups = _deg(tolerance, 0), dict[str, list[int]]()
    for a in study.shown:
        still = not study.moved[a] > tolerance
        kept = study.kept(study.full, tolerance)[a]
        group = "beyond" if not kept else "single" if _needed(study, a, tolerance) else "still" if still else "several"
        groups.setdefault(group, []).append(a)
    if own := groups.get("several"):
        down: dict[int, list[str]] = {}
        for a in own:
            fewest = study.fewest(study.angles[a], tolerance) or study.full
            down.setdefault(len(fewest.sensors), []).append(study.angles[a])
        sets = "; ".join(f"{_both_sides(names)} down to {number}" for number, names in sorted(down.items()))
        yield f"No single sensor is needed, and these stay within {limit} in this order of removal: {sets} sensors."
    if own := groups.get("single"):
        texts = []
        for a in own:
            without = []
            for found in _needed(study, a, tolerance):
                value = "unobserved" if found.seen[a] < LEAST_SEEN else _deg(float(study.measure(found)[a]))
                without.append(f"{_place(study, found)} ({value})")
            texts.append(f"{_named(study, a)} without {' or '.join(without)}")
        what = f"Beyond {limit} where one sensor alone is omitted, so that it is needed for this angle"
        yield f"{what}: {'; '.join(texts)}."
    if own := groups.get("still"):
        names = _both_sides([study.angles[a] for a in own])
        yield f"These hardly move here (standard deviation under {limit}), so that it says little: {names}."
    if own := groups.get("beyond"):
        names = ", ".join(_named(study, a) for a in own)
        yield (
            f"Beyond {limit} even with all {len(study.full.sensors)} sensors, so that this study cannot say what they "
            f"need: {names}."
        )


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


def _place(study: SensorStudy, found: SensorSet) -> str:
    return study.places[omitted(found, study.full.sensors)]


def _both_sides(names: list[str]) -> str:
    """Names of angles in words, one for both sides."""
    sides: dict[str, list[str]] = {}
    for side, rest in map(side_and_name, names):
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
    rows = list(study.shown)
    figure, axes = subplots(1, 1, (4.0 + 0.85 * len(study.without), 2.3 + 0.28 * len(rows)))
    ax, limit = axes[0, 0], np.degrees(TOLERANCE)
    difference = np.degrees(np.stack([found.difference for found in study.without], axis=1)[rows])
    lost = np.stack([found.seen for found in study.without], axis=1)[rows] < LEAST_SEEN
    image = ax.imshow(np.where(lost, np.nan, difference), cmap="YlOrRd", vmin=0, vmax=_LARGEST, aspect="auto")
    ax.imshow(np.where(lost, 0.35, np.nan), cmap="gray", vmin=0, vmax=1, aspect="auto")
    for (i, j), value in np.ndenumerate(difference):
        text = "unobserved" if lost[i, j] else "" if np.isnan(value) else f"{value:.1f}"
        colour = "white" if lost[i, j] or value > 0.6 * _LARGEST else "black" if value > limit else "0.45"
        weight = "bold" if value > limit else "normal"
        ax.text(j, i, text, ha="center", va="center", fontsize=7, color=colour, weight=weight)
    names = [f"{label(study.angles[a])} ({np.degrees(study.moved[a]):.0f})" for a in rows]
    ax.set_yticks(range(len(rows)), names, fontsize=8)
    ax.set_xticks(range(len(study.places)), list(study.places.values()), rotation=30, ha="right", fontsize=8)
    ax.set(ylabel="angle (its standard deviation in this recording [deg])", xlabel="the one sensor that is omitted")
    figure.colorbar(image, ax=ax, label="RMS difference from all sensors [deg]", extend="max", shrink=0.6)
    figure.suptitle(
        f"{study.recording}: how far each angle changes if one sensor is omitted\n"
        f"(a change, not an error; bold: beyond {limit:.0f} deg)",
        fontsize=11,
    )
    return figure


def error_by_number(study: SensorStudy) -> Plot:
    """Plot the RMS of the angles against the number of sensors, one panel for each joint, and name the
    sensor that is removed at each step.
    """
    joints: dict[str, list[int]] = {}
    for a in study.shown:
        joints.setdefault(side_and_name(study.angles[a])[1].partition("_")[0], []).append(a)
    columns = min(3, len(joints))
    lines = -(-len(joints) // columns)
    figure, axes = subplots(lines, columns, (4.6 * columns, 3.4 * lines), sharex=True)
    number = [len(found.sensors) for found in study.path]
    gone = [study.places[omitted(found, larger.sensors)] for larger, found in pairwise(study.path)]
    steps = [f"{n}\n{name.replace(' ', chr(10))}" for n, name in zip(number, ["", *gone], strict=True)]
    values = np.degrees(np.stack([study.measure(found) for found in study.path]))
    values[np.stack([found.seen for found in study.path]) < LEAST_SEEN] = np.nan
    for ax, (joint, own) in zip(axes.flat, joints.items(), strict=False):
        for a in own:
            name = label(study.angles[a].replace(f"{joint}_", ""))
            line = "--" if study.angles[a].startswith("left_") else "-"
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
    for ax in axes.flat[len(joints) :]:
        ax.set_visible(False)
    what = "error against the truth" if study.has_truth else "difference from the full set (not an error)"
    figure.supxlabel("number of sensors, and the one removed last", fontsize=8)
    figure.suptitle(
        f"{study.recording}: {what}; a line ends where the angle is unobserved\n"
        "(one order of removal: not all sets of the same size were tried, and others may be better)",
        fontsize=11,
    )
    return figure
