"""Files of a plan: ``plan.csv`` with a row for each angle, ``plan.json`` with everything, a figure and the
operator's page.
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.files.text import write_text
from rtof_kin.core.packages import can_draw
from rtof_kin.data.confidence import BAND_95
from rtof_kin.plan.movements import MOVEMENTS, MovementInfo
from rtof_kin.plan.operator_page import operator_page, operator_steps
from rtof_kin.plan.placing import sensor_places
from rtof_kin.plan.plan import Option, Plan
from rtof_kin.plan.sentences import advice, cautions, headline

TABLE: Final = "plan.csv"
MARKER: Final = "plan.json"
INSTRUCTIONS: Final = "instructions.html"
COLUMNS: Final = (
    "angle",
    "shown",
    "sd_deg",
    "half_band_deg",
    "simulated_error_deg",
    "inside_95",
    "observed_share",
    "identifiable",
    "confused_with",
)


def write_plan(plan: Plan, folder: str | Path) -> None:
    """Write the files of a plan."""
    folder = Path(folder)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([["" if cell is None else cell for cell in row.values()] for row in _angles(plan)])
    write_text(folder / TABLE, stream.getvalue())
    write_text(folder / MARKER, json.dumps(plan_data(plan), indent=2) + "\n")
    if can_draw():
        from rtof_kin.plan.figures import write_plan_figures

        write_plan_figures(plan, folder)
        _write_instructions(plan, folder)


def _write_instructions(plan: Plan, folder: Path) -> None:
    """Write the operator's page with the drawing of the set-up."""
    from rtof_kin.plan.drawing import draw_setup

    setup, drawing = plan.setup, folder / "setup.svg"
    framed = draw_setup(setup.poses, setup.skeleton, setup.camera, setup.sensors, drawing)
    own = MOVEMENTS.get(plan.protocol.movement, _recorded(plan.protocol.movement))
    repetitions = plan.protocol.repetitions or own.repetitions
    seconds = float(setup.poses.times[-1] - setup.poses.times[0])
    places = sensor_places(setup.skeleton, setup.sensors)
    steps = operator_steps(own, framed, places, repetitions, seconds)
    if plan.calibration is not None:
        steps.append(f"For the calibration: {plan.calibration.words}")
    title = f"Recording: {own.name.replace('_', ' ')}"
    page = operator_page(title, own, steps, drawing.read_text(encoding="utf-8"), cautions(plan))
    write_text(folder / INSTRUCTIONS, page)


def _recorded(movement: str) -> MovementInfo:
    """A movement that is not of the library."""
    name = Path(movement).name
    return MovementInfo(
        name,
        f"The movement of {name}.",
        "do the same movement as in the recording planned from",
        (),
        (),
        "the whole movement",
        1,
        "",
    )


def plan_data(plan: Plan) -> dict[str, Any]:
    """Return a plan as plain data."""
    protocol = asdict(plan.protocol)
    found = plan.calibration
    return {
        "headline": headline(plan),
        "cautions": list(cautions(plan)),
        "advice": list(advice(plan)),
        "protocol": protocol,
        "draws": plan.prediction.draws,
        "seen_share": round(plan.seen, 4),
        "angles": _angles(plan),
        "cameras": [_option(option) for option in plan.cameras],
        "sensors": [_option(option) for option in plan.sensors if option.name],
        "calibration": None
        if found is None
        else {
            "seconds": found.seconds.tolist(),
            "sigma": {kind: _rounded(values) for kind, values in found.sigma.items()},
            "error": {kind: _rounded(values) for kind, values in found.error.items()},
            "units": "delay in s, heading and mounting in rad",
        },
    }


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


def _rounded(values: Array) -> list[float | None]:
    return [_number(value, 5) for value in values]
