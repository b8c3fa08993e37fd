"""A plan as a document: what to expect, what is not identifiable and why, and what to do about it.

``plan.csv`` has a row for each angle, ``plan.json`` everything, ``plan.png`` the figure, ``plan.html`` what to read of
these; ``instructions.html`` is the operator's page.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.checks import some
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.packages import can_draw
from rtof_kin.data.confidence import BAND_95
from rtof_kin.plan.identifiability import Weakness
from rtof_kin.plan.movements import MOVEMENTS, MovementInfo
from rtof_kin.plan.plan import SEEN, Option, Plan
from rtof_kin.plan.prediction import ENOUGH, UNITS
from rtof_kin.plan.setup import Setup
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.document import Badge, Document, Figure, Section, Table, write_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

MARKER: Final = "plan.json"
_ACCURACY: Final = "sd_deg half_band_deg simulated_error_deg inside_95 observed_share"
COLUMNS: Final = ("angle", "shown", *_ACCURACY.split(), "identifiable", "confused_with")
_CLEAR: Final = 0.1
"""Least gain in the mean standard deviation, relative to it, that is worth a change: others are within the
scatter of a few simulated recordings."""
_APART: Final = 1.5  #: Ratio of simulated to stated errors beyond which a caution is given
_OWN, _OTHER, _WEAK = "#1f77b4", "#9ecae1", "#d62728"
_CUT: Final = 45.0  #: [deg] Longest bar
_MOST: Final = 10  #: Options shown in a figure


def write_plan(plan: Plan, folder: str | Path, overwrite: bool = False) -> None:
    """Make a folder of a plan with its document and the operator's page; it appears complete or not at all.
    `OutputExistsError`: the folder exists and may not be replaced; `WritingError`: it cannot be written.
    """
    with new_folder(folder, MARKER, overwrite) as new:
        write_files(document(plan), new)
        if can_draw():
            from rtof_kin.plan.operator_page import write_instructions

            own = MOVEMENTS.get(plan.protocol.movement, _recorded(plan.protocol.movement))
            repetitions = plan.protocol.repetitions or own.repetitions
            further = [f"For the calibration: {plan.calibration.words}"] if plan.calibration is not None else []
            write_instructions(plan.setup, own, repetitions, further, cautions(plan), new)


def _recorded(movement: str) -> MovementInfo:
    """A movement that is not of the library."""
    name = Path(movement).name
    said = f"The movement of {name}.", "do the same movement as in the recording planned from"
    return MovementInfo(name, *said, (), (), "the whole movement", 1, "")


def document(plan: Plan) -> Document:
    """Return a plan as a document."""
    found, rows = plan.calibration, _angles(plan)
    calibration = None
    if found is not None:
        calibration = {
            "seconds": found.seconds.tolist(),
            "sigma": {kind: [_number(value, 5) for value in values] for kind, values in found.sigma.items()},
            "error": {kind: [_number(value, 5) for value in values] for kind, values in found.error.items()},
            "units": "delay in s, heading and mounting in rad",
        }
    facts = {
        "advice": list(advice(plan)),
        "protocol": asdict(plan.protocol),
        "subject": None if plan.setup.subject is None else plan.setup.subject.subject,
        "draws": plan.prediction.draws,
        "seen_share": round(plan.seen, 4),
        "angles": rows,
        "cameras": [_option(option) for option in plan.cameras],
        "sensors": [_option(option) for option in plan.sensors if option.name],
        "calibration": calibration,
    }
    figure = Figure("plan", "Expected errors by angle, camera places, further sensors", lambda: plan_figure(plan))
    return Document(
        "plan",
        f"Plan of {Path(plan.protocol.movement).name.replace('_', ' ')}",
        headline(plan),
        cautions=cautions(plan),
        printed=[_printed(plan), *advice(plan)],
        sections=[Section("angles", "What to expect", [advice(plan), _printed(plan), figure])],
        figures=[figure],
        tables={"plan.csv": Table(COLUMNS, [list(row.values()) for row in rows])},
        facts=facts,
    )


# --- sentences -----------------------------------------------------------------------------------


def headline(plan: Plan) -> str:
    """Return the first line: the expected accuracy, and how many angles are not to be had."""
    own = plan.prediction.select(plan.shown)
    known = np.isfinite(own.sigma)
    if not known.any():
        return "Expected: none of the angles is observed in this setup."
    mean = np.degrees(np.mean(own.sigma[known]))
    parts = [f"Expected standard deviation: {mean:.1f} deg, mean of {known.sum()} angles"]
    if plan.weaknesses:
        parts.append(f"{len(plan.weaknesses)} of {len(own.names)} are not identifiable by camera and sensors")
    if not known.all():
        parts.append(f"{np.count_nonzero(~known)} are not observed")
    if plan.protocol.wanted_sd_deg is not None:
        missed = ", ".join(name.replace("_", " ") for name in plan.unreached)
        what = f"{plan.protocol.wanted_sd_deg:g} deg wanted"
        parts.append(f"{what}: missed by {missed}" if missed else f"{what}: reached by all")
    return "; ".join(parts) + "."


def cautions(plan: Plan) -> tuple[str, ...]:
    """Return what makes one doubt the plan, in sentences."""
    found = []
    if plan.seen < SEEN:
        found.append(
            f"only {100 * plan.seen:.0f} % of the body is in the image over the movement: move the camera "
            "back, or use a wider lens"
        )
    own = plan.prediction.select(plan.shown)
    with np.errstate(invalid="ignore"):
        apart = own.error > _APART * own.sigma
    names = [name.replace("_", " ") for name, far in zip(own.names, apart, strict=True) if far]
    if names:
        found.append(
            f"simulated errors of {some(names)} are more than {_APART:g} times the standard "
            f"deviation stated, over {own.draws} simulated recording(s)"
        )
    return tuple(found)


def advice(plan: Plan) -> tuple[str, ...]:
    """Return what is not identifiable, the best camera place, the next sensor and how long to move."""
    found = list(_not_identifiable(plan.weaknesses))
    cameras = [option for option in plan.cameras if not option.problem]
    if cameras:
        best, worst, mean = cameras[0], cameras[-1], f"mean {np.degrees(cameras[0].loss):.1f} deg"
        if best.name == plan.protocol.camera.words:
            last = f"the worst ({worst.name.partition(', ')[0]}) {np.degrees(worst.loss):.1f} deg"
            found.append(f"Camera place: {best.name}, the best of {len(cameras)} compared; {mean}, {last}.")
        elif _is_clear(best):
            found.append(f"Better camera place: {best.name}; {mean}, {_gain(best)}.")
        else:
            found.append(f"No other camera place is clearly better; the best is {best.name}, {_gain(best)}.")
    if blind := [f"{option.name}: {option.problem}" for option in plan.cameras if option.problem]:
        found.append(f"{len(blind)} of {len(plan.cameras)} camera places are not possible; {blind[0]}.")
    if sensors := [option for option in plan.sensors if not option.problem and option.name]:
        best = sensors[0]
        name, mean = f"{best.name} ({where(plan.setup, best.name)})", f"mean {np.degrees(best.loss):.1f} deg"
        found.append(
            f"Best next sensor: {name}; {mean}, {_gain(best)}."
            if _is_clear(best)
            else f"No further sensor lowers the mean by {100 * _CLEAR:.0f} %; the best is {name}."
        )
    return tuple(found) if plan.calibration is None else (*found, plan.calibration.words)


def _is_clear(option: Option) -> bool:
    return option.gain > _CLEAR * (option.loss + option.gain)


def _gain(option: Option) -> str:
    return f"{np.degrees(option.gain):.1f} deg less, most at {option.most.replace('_', ' ')}"


def _not_identifiable(weaknesses: Sequence[Weakness]) -> Iterator[str]:
    """Pairs of angles that are confused with each other, and angles that nothing depends on."""
    pairs = {tuple(sorted((one.confused_with, one.angle))) for one in weaknesses if one.confused_with}
    alone = [one.angle for one in weaknesses if not one.confused_with]
    texts = (
        (
            " and ".join,
            sorted(pairs),
            "a change of both leaves image and sensors nearly as they are, so their split is",
        ),
        (str, alone, "image and sensors hardly depend on them, so they are"),
    )
    for joined, own, why in texts:
        if own:
            names = ", ".join(joined(one) for one in own).replace("_", " ")
            yield f"Not identifiable: {names}: {why} that of a usual person in this posture."


def where(setup: Setup, sensor: str) -> str:
    """Return the segment of a sensor of the skeleton's table in words."""
    joint, _ = setup.skeleton.sensors[sensor]
    terms = {own: term for term, own in angle_table(setup.skeleton.table).segments.items()}
    return terms.get(joint, joint).replace("_", " ")


# --- tables --------------------------------------------------------------------------------------


def _printed(plan: Plan) -> Table:
    """Angles that matter, with their bands."""
    weak = {weakness.angle for weakness in plan.weaknesses}
    own, rows = plan.prediction.select(plan.shown), []
    for name, sigma, error in zip(own.names, np.degrees(own.sigma), np.degrees(own.error), strict=True):
        known = np.isfinite(sigma)
        remark = "not observed" if not known else Badge("not identifiable", "warn") if name in weak else ""
        rows.append([name.replace("_", " "), *((sigma, BAND_95 * sigma, error) if known else [None] * 3), remark])
    columns = ("angle [deg]", "sd", "\u00b1 95 %", "simulated error", "")
    return Table(columns, rows, digits=(None, 1, 1, 1, None))


def _angles(plan: Plan) -> list[dict[str, Any]]:
    """A row for each angle."""
    weak = {weakness.angle: weakness for weakness in plan.weaknesses}
    own, rows = plan.prediction, []
    for a, name in enumerate(own.names):
        values = (
            name,
            name in plan.shown,
            _degrees(own.sigma[a]),
            _degrees(BAND_95 * own.sigma[a]),
            _degrees(own.error[a]),
            _number(own.inside[a], 3),
            round(float(own.observed[a]), 3),
            (name not in weak) if name in plan.shown else None,
            weak[name].confused_with or None if name in weak else None,
        )
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def _option(option: Option) -> dict[str, Any]:
    return {
        "name": option.name,
        "mean_sd_deg": _degrees(option.loss),
        "gain_deg": _degrees(option.gain),
        "gains_most": option.most or None,
        "problem": option.problem or None,
    }


def _degrees(value: float) -> float | None:
    return _number(np.degrees(value), 2)


def _number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


# --- figure --------------------------------------------------------------------------------------


def plan_figure(plan: Plan) -> Plot:
    """Plot a plan."""
    from matplotlib.figure import Figure as Plot

    compared = bool(plan.cameras or plan.sensors)
    height = 1.8 + 0.27 * len(plan.shown)
    figure = Plot(figsize=(12.0 if compared else 7.0, max(height, 6.0 if compared else 3.0)), layout="constrained")
    if not compared:
        _draw_angles(figure.subplots(), plan)
        return figure
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0))
    _draw_angles(figure.add_subplot(grid[:, 0]), plan)
    _draw_options(figure.add_subplot(grid[0, 1]), _shortened(plan.cameras), "camera place")
    named = [
        replace(o, name=" at ".join(dict.fromkeys((o.name, where(plan.setup, o.name)))) if o.name else "as planned")
        for o in plan.sensors
    ]
    _draw_options(figure.add_subplot(grid[1, 1]), named, "one more sensor")
    ax = figure.add_subplot(grid[2, 1])
    if plan.calibration is None:
        ax.axis("off")
    else:
        _draw_calibration(ax, plan)
    return figure


def _draw_angles(ax: Any, plan: Plan) -> None:
    own = plan.prediction.select(plan.shown)
    weak = {weakness.angle for weakness in plan.weaknesses}
    at = np.arange(len(own.names))[::-1]
    sigma, error = np.degrees(own.sigma), np.degrees(own.error)
    colours = [_WEAK if name in weak else _OWN for name in own.names]
    ax.barh(at, np.minimum(np.nan_to_num(sigma), _CUT), color=colours, height=0.7)
    ax.plot(np.minimum(error, _CUT), at, "k|", markersize=9, label="error in the simulations")
    for y, value, far in zip(at, sigma, np.fmax(sigma, error), strict=True):
        text = "not observed" if np.isnan(value) else f"{value:.1f}"
        right_of_both = (min(np.nan_to_num(far if np.isfinite(value) else 0.0), _CUT), y)
        ax.annotate(text, right_of_both, (5, 0), textcoords="offset points", va="center", fontsize=7)
    ax.set_yticks(at, [label(name) for name in own.names], fontsize=8)
    ax.set_ylim(-0.8, len(at) - 0.2)
    ax.bar(0, 0, color=_WEAK, label="not identifiable by the measurements alone")
    if plan.protocol.wanted_sd_deg is not None:
        ax.axvline(plan.protocol.wanted_sd_deg, color="0.4", linestyle="--", label="wanted")
    ax.set_xlim(0.0, None)
    ax.set_xlabel("expected standard deviation [deg]")
    ax.set_title(f"camera {plan.protocol.camera.words}", fontsize=9, loc="left")
    ax.margins(x=0.15)
    ax.figure.legend(*ax.get_legend_handles_labels(), fontsize=8, loc="outside lower left", ncols=3)


def _shortened(options: Sequence[Option]) -> list[Option]:
    """Options without what all their names end with."""
    rests = {option.name.partition(", ")[2] for option in options}
    if len(rests) > 1:
        return list(options)
    return [replace(option, name=option.name.partition(", ")[0]) for option in options]


def _draw_options(ax: Any, options: Sequence[Option], title: str) -> None:
    best = [option for option in options if not option.problem]
    possible = best[:_MOST] + [option for option in best[_MOST:] if not option.most]
    left_out = len(options) - len(possible)
    at = np.arange(len(possible))[::-1]
    losses = np.degrees([option.loss for option in possible])
    unchanged = [not option.most for option in possible]
    ax.barh(at, losses, color=[_OWN if same else _OTHER for same in unchanged], height=0.7)
    ax.margins(x=0.1)
    for y, value in zip(at, losses, strict=True):
        ax.annotate(f"{value:.1f}", (value, y), (3, 0), textcoords="offset points", va="center", fontsize=7)
    ax.set_yticks(at, [option.name for option in possible], fontsize=7)
    ax.set_xlabel("mean standard deviation [deg]", fontsize=8)
    more = f" ({left_out} not shown)" if left_out else ""
    ax.set_title(f"{title}; dark: as planned{more}", fontsize=9)


def _draw_calibration(ax: Any, plan: Plan) -> None:
    found = plan.calibration
    assert found is not None
    for kind, sigma in found.sigma.items():
        factor, unit = UNITS[kind]
        (line,) = ax.plot(found.seconds, factor * sigma, "o-", label=f"{kind} [{unit}]", markersize=4)
        ax.plot(found.seconds, factor * found.error[kind], "x:", color=line.get_color(), markersize=4)
        ax.axhline(factor * ENOUGH[kind], color=line.get_color(), linewidth=0.6, alpha=0.6)
    ax.set_ylim(0.0, None)
    ax.set_xlabel("movement for the calibration [s]", fontsize=8)
    ax.set_ylabel("standard deviation", fontsize=8)
    ax.set_title("calibration; crosses: errors in simulations; lines: enough", fontsize=9)
    ax.legend(fontsize=7)
