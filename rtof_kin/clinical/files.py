"""Export of a motion analysis as CSV and JSON files; each column and field has its unit in its name.

==============================  ==================================================================
angles.csv, angles.json         angles over time, degrees, and their standard deviations if the motion has
                                a confidence; the table of their names and signs
angles_provenance.csv           observation source of each value (`Provenance` by number)
angles_trusted.csv              1 where a value is reliable (`decomposition`), else 0
range_of_motion.csv             minimum, maximum and mean reliable value, peak velocity of each angle;
                                standard deviations of both ends and of the range; 1 for a heading; 95 %
                                intervals with the unreliable samples, their seconds and furthest value
                                beyond either end; 1 for a range that may be compared with others
gait.json                       whether the motion is gait; events, strides, mean and standard deviation by
                                side, symmetry
travel.json                     way and turning of the pelvis
gait_cycles.csv                 mean and standard deviation of each angle over the gait cycle
repetitions.json                depth and tempo, on request
torques.csv, torques.json       joint torques and the external wrench, with a body mass only
ground_reaction.csv, .json      force of the floor and centre of pressure, with a body mass only
notes.json                      what could not be determined, and why
==============================  ==================================================================

An empty cell is an unobserved value.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait import PHASES, CycleCurves, GaitAnalysis
from rtof_kin.clinical.ground_reaction import STATUS, Contact, GroundReaction
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.clinical.repetitions import RepetitionAnalysis
from rtof_kin.clinical.torques import JointTorques
from rtof_kin.clinical.travel import Travel
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import Provenance

MARKER: Final = "angles.csv"
_BLOCK: Final = 3600
"""Rows of a table that are formatted at once."""
WRENCH_COLUMNS: Final = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
_ANGLES_JSON: Final = {
    "file": MARKER,
    "units": "time s; angles degrees, as in the column names",
    "frames": "segment frames x forward, y up, z right (ISB); sequences intrinsic, in these axes; "
    "'mirrored': the rotation is reflected in the sagittal plane before it is decomposed",
    "sign": "a leading '-' of an OpenSim name: its sign is the opposite of the column's",
    "gaps": "an empty cell: the angle was not observed",
    "continuity": "continuous between gaps; whole turns are chosen so that each stretch lies in range_deg",
    "sigma": "columns ..._sigma_deg: standard deviations; 95 % of errors lie within 1.96 of them",
    "provenance": {str(int(p)): p.name.lower() for p in Provenance},
}


def write_analysis(analysis: MotionAnalysis, folder: str | Path) -> None:
    """Write all files that apply into an existing folder."""
    folder = Path(folder)
    angles = analysis.angles
    series = [angles.values] if angles.sigma is None else [angles.values, angles.sigma]
    columns = [f"{name}{kind}_deg" for kind in ("", "_sigma")[: len(series)] for name in angles.names]
    _write_series(
        folder / MARKER, columns, angles.times, lambda frames: np.degrees(np.hstack([one[frames] for one in series]))
    )
    _write_json(folder / "angles.json", _ANGLES_JSON | {"angles": analysis.table.sidecar()})
    _write_series(
        folder / "angles_provenance.csv", angles.names, angles.times, lambda frames: angles.provenance[frames]
    )
    _write_series(folder / "angles_trusted.csv", angles.names, angles.times, angles.is_trusted)
    _write_ranges(folder / "range_of_motion.csv", analysis.ranges)
    _write_json(folder / "gait.json", _gait_data(analysis.gait))
    _write_json(folder / "travel.json", _travel_data(analysis.travel))
    if analysis.curves:
        _write_cycles(folder / "gait_cycles.csv", analysis.curves)
    if analysis.repetitions is not None:
        _write_json(folder / "repetitions.json", _repetition_data(analysis.repetitions))
    if analysis.torques is not None:
        _write_torques(folder / "torques.csv", analysis.torques)
    if analysis.ground_reaction is not None:
        _write_reaction(folder / "ground_reaction.csv", analysis.ground_reaction)
    _write_json(folder / "notes.json", {part: list(notes) for part, notes in analysis.notes.items()})


def _gait_data(gait: GaitAnalysis) -> dict[str, Any]:
    """Events, strides and gait parameters as plain data."""
    units = {"stride_time": "_s", "cadence": "_steps_per_min", "stride_length": "_m", "speed": "_m_per_s"}
    return {
        "is_gait": gait.is_gait,
        "why_not": gait.why_not,
        "rests_on": gait.rests_on,
        "walking_strides": len(gait.verdict.walking),
        "on_the_spot": gait.verdict.on_the_spot,
        "events_s": {
            side: {"heel_strikes": foot.strikes.tolist(), "toe_offs": foot.offs.tolist()}
            for side, foot in gait.events.feet.items()
        },
        "strides": [
            {
                "side": s.side,
                "start_s": s.start,
                "toe_off_s": s.toe_off,
                "stop_s": s.stop,
                "stride_length_m": s.stride_length,
            }
            for s in gait.strides
        ],
        "summary": {
            side: {
                name + units.get(name, ""): {"mean": _number(mean), "sd": _number(sd), "strides": n}
                for name, (mean, sd, n) in measures.items()
            }
            for side, measures in gait.summary.items()
        },
        "symmetry": {name: _number(value) for name, value in gait.symmetry.items()},
        "symmetry_is": "(right - left) / mean of both",
    }


def _travel_data(travel: Travel) -> dict[str, Any]:
    """Way and turning as plain data."""
    return {
        "path_length_m": _number(travel.path_length),
        "displacement_m": _number(travel.displacement),
        "direction_deg": _number(np.degrees(travel.direction)),
        "direction_is": "from world x, counterclockwise seen from above",
        "direction_from_facing_deg": _number(np.degrees(travel.relative_direction)),
        "turned_left_deg": _number(np.degrees(travel.turned_left)),
        "turned_right_deg": _number(np.degrees(travel.turned_right)),
        "turned_left_sigma_deg": _number(np.degrees(travel.turned_left_sigma)),
        "turned_right_sigma_deg": _number(np.degrees(travel.turned_right_sigma)),
        "turns_within_their_error": travel.unsure_turns,
        "walking_share": travel.walking_share,
        "observed_share": travel.observed_share,
        "notes": list(travel.notes),
    }


def _repetition_data(found: RepetitionAnalysis) -> dict[str, Any]:
    """Repetitions as plain data."""
    return {
        "kind": found.kind,
        "count": len(found.repetitions),
        "total_time_s": _number(found.total_time),
        "repetitions": [
            {
                "descent_s": r.descent,
                "ascent_s": r.ascent,
                "descent_time_s": _number(r.descent_time),
                "bottom_time_s": _number(r.bottom_time),
                "ascent_time_s": _number(r.ascent_time),
                "depth_m": r.depth,
                "depth_share_of_leg": r.depth_share,
                "knee_flexion_deg": {k: _number(np.degrees(v)) for k, v in r.knee_flexion.items()},
            }
            for r in found.repetitions
        ],
    }


def _write_ranges(path: Path, ranges: Sequence[RangeOfMotion]) -> None:
    header = (
        "angle",
        "low_deg",
        "high_deg",
        "range_deg",
        "mean_deg",
        "time_low_s",
        "time_high_s",
        "peak_velocity_deg_per_s",
        "known_share",
        "singular_share",
        "trusted_share",
        "low_sigma_deg",
        "high_sigma_deg",
        "range_sigma_deg",
        "about_vertical",
        *(f"{name}_interval_{end}_deg" for name in ("low", "high", "range") for end in ("low", "high")),
        *(f"uncertain_{end}_{unit}" for end in ("low", "high") for unit in ("s", "deg")),
        "comparable",
    )
    figures = (
        (
            *np.degrees([r.low, r.high, r.range, r.mean]),
            r.time_low,
            r.time_high,
            np.degrees(r.peak_velocity),
            r.known_share,
            r.singular_share,
            r.trusted_share,
            *np.degrees([r.low_sigma, r.high_sigma, r.range_sigma]),
            float(r.about_vertical),
            *np.degrees([*r.low_interval, *r.high_interval, *r.range_interval]),
            *(
                x
                for end in (r.uncertain_low, r.uncertain_high)
                for x in ((0.0, np.nan) if end is None else (end.seconds, np.degrees(end.value)))
            ),
            float(r.is_comparable),
        )
        for r in ranges
    )
    _write_csv(path, header, ([r.name, *map(_cell, row)] for r, row in zip(ranges, figures, strict=True)))


def _write_cycles(path: Path, curves: Sequence[CycleCurves]) -> None:
    """A row for each per cent of the cycle; a pair of columns for each angle and side."""
    header, columns = ["cycle_percent"], [100 * PHASES]
    for curve in curves:
        name = curve.name if curve.name.startswith(curve.side) else f"{curve.name}_{curve.side}_cycle"
        header += [f"{name}_mean_deg", f"{name}_sd_deg"]
        columns += [np.degrees(curve.mean), np.degrees(curve.sd)]
    _write_csv(path, header, (map(_cell, row) for row in np.stack(columns, axis=-1)))


def _write_torques(path: Path, torques: JointTorques) -> None:
    wrenches = [f"{kind}_{c}" for kind in ("outer", "unexplained") for c in WRENCH_COLUMNS]
    series = (torques.torques, torques.root_wrench, torques.unexplained, *torques.sigma_parts)
    sigmas = [f"{name}_sigma_{part}_Nm" for part in ("motion", "masses") for name in torques.dof_names]
    columns = [*(f"{name}_Nm" for name in torques.dof_names), *wrenches, *sigmas]
    _write_series(path, columns, torques.times, lambda frames: np.hstack([one[frames] for one in series]))
    _write_json(
        path.with_suffix(".json"),
        {
            "file": path.name,
            "weight_kg": torques.weight_kg,
            "torques": "about the URDF's revolutes of that name, positive along their axes",
            "outer": "external force and moment about the root that the motion requires, world axes",
            "unexplained": "the part of it that is assigned to no foot; not a measurement",
            "sigma": "columns ..._sigma_motion_Nm, ..._sigma_masses_Nm: standard deviations by the errors of "
            "the motion and of the masses of segments; the whole is the root of the sum of their squares",
            "notes": list(torques.notes),
        },
    )


def _write_reaction(path: Path, reaction: GroundReaction) -> None:
    axes = ("x", "y", "z")
    columns = [
        "status",
        *(f"force_{c}_N" for c in axes),
        *(f"force_{c}_sigma_N" for c in axes),
        "pressure_x_m",
        "pressure_y_m",
        "pressure_x_sigma_m",
        "pressure_y_sigma_m",
        "outside_soles_m",
        *(f"{side}_vertical_{end}_N" for side in SIDES for end in ("least", "most")),
    ]
    series = (
        reaction.force,
        reaction.force_sigma,
        reaction.pressure,
        reaction.pressure_sigma,
        reaction.outside[:, None],
        reaction.vertical.reshape(-1, 4),
    )

    def rows() -> Iterator[list[str]]:
        for start in range(0, len(reaction.times), _BLOCK):
            frames = slice(start, start + _BLOCK)
            values = np.hstack([one[frames] for one in series]).tolist()
            for time, state, row in zip(
                reaction.times[frames].tolist(), reaction.state[frames].tolist(), values, strict=True
            ):
                yield [repr(time), STATUS[Contact(state)], *map(_cell, row)]

    _write_csv(path, ("time", *columns), rows())
    _write_json(
        path.with_suffix(".json"),
        {
            "file": path.name,
            "weight_kg": reaction.weight_kg,
            "floor_m": _number(reaction.floor),
            "status": {contact.name.lower(): words for contact, words in STATUS.items()},
            "force": "of all external contacts together, world axes, with standard deviations",
            "pressure": "centre of pressure of both feet together on the floor, world; standard deviations "
            "relative to the feet",
            "outside_soles": "distance of the centre of pressure from the soles on the floor; 0 inside",
            "vertical": "least and most vertical force on each foot; equal where one foot bears all, an "
            "interval where two share it",
            "notes": list(reaction.notes),
        },
    )


def _write_series(path: Path, columns: Sequence[str], times: Array, values: Callable[[slice], NDArray[Any]]) -> None:
    """Write a row for each of the times (T,), a block at a time.

    Args:
        times: (T,) s.
    """

    def rows() -> Iterator[list[str]]:
        for start in range(0, len(times), _BLOCK):
            frames = slice(start, start + _BLOCK)
            for time, row in zip(times[frames].tolist(), values(frames).tolist(), strict=True):
                yield [repr(time), *map(_cell, row)]

    _write_csv(path, ("time", *columns), rows())


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Iterable[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def _cell(value: float) -> str:
    return repr(round(float(value), 9)) if math.isfinite(value) else ""


def _number(value: Any) -> float | None:
    """None, which is null in JSON, for NaN."""
    return float(value) if np.isfinite(value) else None
