"""The analysis of a motion as files, every number with its name and unit.

==============================  ==================================================================
angles.csv, angles.json         angles over time, degrees, and their standard deviations where the motion
                                has a confidence; the table of their names and signs
angles_provenance.csv           who saw each angle when (`Provenance` by number)
angles_trusted.csv              1 where ranges, peaks and gait go by the angle (`clinical.trust`), else 0
range_of_motion.csv             lowest, highest and mean trusted value, peak velocity of every angle
gait.json                       events, strides, mean and spread by side, symmetry
gait_cycles.csv                 mean and spread of every angle over the gait cycle
repetitions.json                depth and tempo, where they were asked for
torques.csv, torques.json       joint torques and the wrench from outside, where a weight was given
notes.json                      what could not be told, and why
==============================  ==================================================================

An empty cell is a value that nobody saw.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.gait import PHASES, CycleCurves, GaitAnalysis
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.clinical.repetitions import RepetitionAnalysis
from rtof_kin.clinical.torques import JointTorques
from rtof_kin.data.poses import Provenance

Array = NDArray[np.float64]
MARKER = "angles.csv"
WRENCH_COLUMNS = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")


def write_analysis(analysis: MotionAnalysis, folder: str | Path) -> None:
    """Write every file there is something for into an existing folder."""
    folder = Path(folder)
    angles = analysis.angles
    columns, values = [f"{name}_deg" for name in angles.names], angles.values_deg
    if angles.sigma is not None:
        columns += [f"{name}_sigma_deg" for name in angles.names]
        values = np.hstack([values, np.degrees(angles.sigma)])
    _write_csv(folder / MARKER, ("time", *columns), _timed(angles.times, values))
    _write_json(folder / "angles.json", _angles_sidecar(analysis))
    _write_csv(
        folder / "angles_provenance.csv", ("time", *angles.names), _timed(angles.times, angles.provenance)
    )
    trusted = np.isfinite(angles.trusted_values).astype(int)
    _write_csv(folder / "angles_trusted.csv", ("time", *angles.names), _timed(angles.times, trusted))
    _write_ranges(folder / "range_of_motion.csv", analysis.ranges)
    _write_json(folder / "gait.json", gait_facts(analysis.gait))
    if analysis.curves:
        _write_cycles(folder / "gait_cycles.csv", analysis.curves)
    if analysis.repetitions is not None:
        _write_json(folder / "repetitions.json", repetition_facts(analysis.repetitions))
    if analysis.torques is not None:
        _write_torques(folder / "torques.csv", analysis.torques)
    _write_json(folder / "notes.json", {part: list(notes) for part, notes in analysis.notes.items()})


def gait_facts(gait: GaitAnalysis) -> dict[str, Any]:
    """Events, strides and measures as plain data, units in the names."""
    units = {"stride_time": "s", "cadence": "steps_per_min", "stride_length": "m", "speed": "m_per_s"}
    return {
        "events_s": {
            side: {"heel_strikes": foot.strikes.tolist(), "toe_offs": foot.offs.tolist()}
            for side, foot in gait.events.feet.items()
        },
        "strides": [
            {"side": s.side, "start_s": s.start, "toe_off_s": s.toe_off, "stop_s": s.stop,
             "stride_length_m": s.stride_length}
            for s in gait.strides
        ],
        "summary": {
            side: {
                f"{name}_{units[name]}" if name in units else name: {
                    "mean": _known(mean), "sd": _known(spread), "strides": n
                }
                for name, (mean, spread, n) in measures.items()
            }
            for side, measures in gait.summary.items()
        },
        "symmetry": {name: _known(value) for name, value in gait.symmetry.items()},
        "symmetry_is": "(right - left) / mean of both",
    }  # fmt: skip


def repetition_facts(found: RepetitionAnalysis) -> dict[str, Any]:
    """Repetitions as plain data, units in the names."""
    return {
        "kind": found.kind,
        "count": len(found.repetitions),
        "total_time_s": _known(found.total_time),
        "repetitions": [
            {
                "descent_s": r.descent,
                "ascent_s": r.ascent,
                "descent_time_s": _known(r.descent_time),
                "bottom_time_s": _known(r.bottom_time),
                "ascent_time_s": _known(r.ascent_time),
                "depth_m": r.depth,
                "depth_share_of_leg": r.depth_share,
                "knee_flexion_deg": {k: _known(np.degrees(v)) for k, v in r.knee_flexion.items()},
            }
            for r in found.repetitions
        ],
    }


def _angles_sidecar(analysis: MotionAnalysis) -> dict[str, Any]:
    return {
        "file": MARKER,
        "units": "time s; angles degrees, as the names say",
        "frames": "segment frames x forward, y up, z right (ISB); sequences intrinsic, in these axes; "
        "'mirrored': the rotation is reflected in the sagittal plane before it is decomposed",
        "sign": "a leading '-' of an OpenSim name: its sign is the opposite of the column's",
        "gaps": "an empty cell: nobody saw this angle",
        "continuity": "continuous between gaps; whole turns are chosen so that each stretch lies in "
        "range_deg",
        "sigma": "columns ..._sigma_deg: standard deviations; 95 % of errors lie within 1.96 of them",
        "provenance": {str(int(p)): p.name.lower() for p in Provenance},
        "angles": analysis.table.sidecar(),
    }


def _write_ranges(path: Path, ranges: Sequence[RangeOfMotion]) -> None:
    header = ("angle", "low_deg", "high_deg", "range_deg", "mean_deg", "time_low_s", "time_high_s",
              "peak_velocity_deg_per_s", "known_share", "singular_share", "trusted_share")  # fmt: skip
    rows = [
        [r.name, *(_cell(np.degrees(v)) for v in (r.low, r.high, r.range, r.mean)),
         _cell(r.time_low), _cell(r.time_high), _cell(np.degrees(r.peak_velocity)),
         _cell(r.known_share), _cell(r.singular_share), _cell(r.trusted_share)]
        for r in ranges
    ]  # fmt: skip
    _write_csv(path, header, rows)


def _write_cycles(path: Path, curves: Sequence[CycleCurves]) -> None:
    """A row for each per cent of the cycle; a pair of columns for each angle and side."""
    header, columns = ["cycle_percent"], [100 * PHASES]
    for curve in curves:
        name = curve.name if curve.name.startswith(curve.side) else f"{curve.name}_{curve.side}_cycle"
        header += [f"{name}_mean_deg", f"{name}_sd_deg"]
        columns += [np.degrees(curve.mean), np.degrees(curve.sd)]
    _write_csv(path, header, ([_cell(v) for v in row] for row in np.stack(columns, axis=-1)))


def _write_torques(path: Path, torques: JointTorques) -> None:
    wrenches = [f"{kind}_{c}" for kind in ("outer", "unexplained") for c in WRENCH_COLUMNS]
    table = np.hstack([torques.torques, torques.root_wrench, torques.unexplained])
    header = ("time", *(f"{name}_Nm" for name in torques.dof_names), *wrenches)
    _write_csv(path, header, _timed(torques.times, table))
    _write_json(
        path.with_suffix(".json"),
        {
            "file": path.name,
            "weight_kg": torques.weight_kg,
            "torques": "about the URDF's revolutes of that name, positive along their axes",
            "outer": "force and moment about the root, world axes, that the motion needs from outside",
            "unexplained": "the part of it that was attributed to no foot; it is no measurement",
            "notes": list(torques.notes),
        },
    )


def _timed(times: Array, values: NDArray[Any]) -> Iterable[list[str]]:
    return ([repr(float(t)), *map(_cell, row)] for t, row in zip(times, values, strict=True))


def _cell(value: Any) -> str:
    return repr(round(float(value), 9)) if np.isfinite(value) else ""


def _known(value: Any) -> float | None:
    """JSON knows no NaN: a figure that there is no data for is null."""
    return float(value) if np.isfinite(value) else None


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
