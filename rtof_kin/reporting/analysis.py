"""A motion analysis as a document; each column and field has its unit in its name.

==============================  ==================================================================
angles.csv, angles.json         angles over time, degrees, and their standard deviations if the motion has
                                a confidence; the table of their names and signs
angles_provenance.csv           observation source of each value (`Provenance` by number)
angles_trusted.csv              1 where a value is reliable (`decomposition`), else 0
range_of_motion.csv             minimum, maximum and mean reliable value, peak velocity of each angle;
                                standard deviations of both ends and of the range; 1 for a heading; 95 %
                                intervals with the unreliable samples, their seconds and furthest value
                                beyond either end; 1 for a range that may be compared with others; half width
                                within which the whole curve lies (`curve_bands`)
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

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_file import motion_path
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait import PHASES, GaitAnalysis
from rtof_kin.clinical.ground_reaction import STATUS, Contact, GroundReaction
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.clinical.repetitions import RepetitionAnalysis
from rtof_kin.clinical.torques import JointTorques
from rtof_kin.clinical.travel import Travel
from rtof_kin.core.array_types import Array, blocks_of
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.files.folder import check_replaceable, new_folder
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance
from rtof_kin.reporting.angle_names import SIDE_COLORS, label
from rtof_kin.reporting.document import Cell, Document, Figure, Table, fixed, number, subplots, write_files
from rtof_kin.reporting.settings import AnalysisSettings
from rtof_kin.reporting.summary_file import SUMMARY, read_summary
from rtof_kin.solve.uncertainty import CovarianceInflation

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

MARKER: Final = "angles.csv"
_BLOCK: Final = 600  #: Rows of a table that are formatted at once
_STRIDE: Final = ("side", "start_s", "toe_off_s", "stop_s", "stride_length_m")  # names of the fields of a `Stride`
_DIGITS: Final = 9  # after the point, of what is written
_ALL: Final = 17  # significant digits: a number as it is
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


@dataclass(frozen=True)
class _Series:
    """Rows of a time and numbers, computed a block at a time, so that an hour is never text at once."""

    times: Array  #: (T,) s
    values: Callable[[slice], NDArray[Any]]  #: Frames -> numbers (N, ...)
    words: Callable[[int], str] | None = None  #: Frame -> a text behind the time

    def __iter__(self) -> Iterator[list[Cell]]:
        for frames in blocks_of(len(self.times), _BLOCK):
            values = np.asarray(self.values(frames), dtype=float).tolist()
            for t, (time, row) in enumerate(zip(self.times[frames].tolist(), values, strict=True), frames.start):
                yield [time, *([] if self.words is None else [self.words(t)]), *_rounded(row)]


def write_analysis(
    motion: str | Path,
    folder: str | Path,
    settings: AnalysisSettings,
    overwrite: bool = False,
    inputs: Mapping[str, str] | None = None,
    documents: Sequence[Document] = (),
) -> Document:
    """Analyse the motion of an output folder, and write the analysis into a folder. `OutputExistsError`: the folder may
    not be replaced. Errors of `analyse`.

    Args:
        overwrite: replace an earlier analysis there. inputs: fingerprints for the folder's manifest.
        documents: of the same motion, such as its gait scores, which get folders of their own in it.
    """
    check_replaceable(folder, MARKER, overwrite)
    path = motion_path(motion).parent / SUMMARY
    summary = read_summary(path) if path.exists() else None
    subject = {} if summary is None else summary.subject
    weight_kg = settings.weight_kg if settings.weight_kg is not None else subject.get("mass_kg")
    sex = settings.sex or (subject.get("sex") if weight_kg is not None else None)
    body: dict[str, Any] = {"weight_kg": weight_kg, "height": settings.height, "sex": sex}
    found = analyse(motion, **body, repetitions=settings.repetitions, from_standing=settings.from_standing)
    made = document(found, None if summary is None else summary.sensors)
    del found  # the document has what it needs
    return_free_memory()
    with new_folder(folder, MARKER, overwrite, inputs) as new:
        for one, inner in ((made, new), *((other, new / other.name) for other in documents)):
            inner.mkdir(exist_ok=True)
            write_files(one if settings.figures else replace(one, figures=()), inner)
    return made


def document(analysis: MotionAnalysis, sensors: int | None = None) -> Document:
    """Return an analysis as a document.

    Args:
        sensors: number of those that the bands rest on; without it there are no bands of whole curves.
    """
    curves = curve_bands(analysis.ranges, sensors)
    angles, gait = analysis.angles, analysis.gait
    series: list[NDArray[Any]] = [angles.values] if angles.sigma is None else [angles.values, angles.sigma]
    columns = [f"{name}{kind}_deg" for kind in ("", "_sigma")[: len(series)] for name in angles.names]

    def in_degrees(frames: slice) -> Array:
        return np.asarray(np.degrees(np.hstack([one[frames] for one in series])))

    tables = {
        MARKER: Table(("time", *columns), _Series(angles.times, in_degrees)),
        "angles_provenance.csv": Table(
            ("time", *angles.names), _Series(angles.times, lambda frames: angles.provenance[frames])
        ),
        "angles_trusted.csv": Table(("time", *angles.names), _Series(angles.times, angles.is_trusted)),
        "range_of_motion.csv": _ranges(analysis.ranges, curves),
    }
    data = {
        "angles.json": _ANGLES_JSON | {"whole_curves": _curve_facts(curves), "angles": analysis.table.sidecar()},
        "gait.json": _gait_facts(gait),
        "travel.json": _travel_facts(analysis.travel),
        "notes.json": {part: list(notes) for part, notes in analysis.notes.items()},
    }
    figures = list[Figure]()
    if analysis.curves:
        names, cells = ["cycle_percent"], [100 * PHASES]
        for curve in analysis.curves:
            name = curve.name if curve.name.startswith(curve.side) else f"{curve.name}_{curve.side}_cycle"
            names += [f"{name}_mean_deg", f"{name}_sd_deg"]
            cells += [np.degrees(curve.mean), np.degrees(curve.sd)]
        tables["gait_cycles.csv"] = Table(names, list(map(_rounded, np.stack(cells, axis=-1))))
    if analysis.repetitions is not None:
        data["repetitions.json"] = _repetition_facts(analysis.repetitions)
    if (torques := analysis.torques) is not None:
        tables["torques.csv"], data["torques.json"] = _torques(torques)
    if (reaction := analysis.ground_reaction) is not None:
        tables["ground_reaction.csv"], data["ground_reaction.json"] = _reaction(reaction)
        if np.isfinite(reaction.force).any():
            alt = "Vertical force, that of each foot, and centre of pressure over time"
            figures.append(Figure("figures/ground_reaction", alt, lambda: ground_reaction_over_time(reaction)))
    return Document(
        "analysis",
        "Analysis of a motion",
        f"pelvis: {analysis.travel.text}",
        printed=_printed(analysis),
        figures=figures,
        tables=tables,
        facts=None,
        data=data,
    )


@dataclass(frozen=True)
class CurveBand:
    """Band that contains the whole curve of an angle, for so many of 100 people (`CurveFactors`)."""

    factor: float  #: Half width in standard deviations
    half: float  #: [rad] at its widest, where the angle is reliable


def curve_bands(ranges: Iterable[RangeOfMotion], sensors: int | None) -> dict[str, CurveBand]:
    """Return the bands of the angles that have one, by name; sensors: as for `document`."""
    factors = CovarianceInflation.shipped().curves
    if sensors is None or factors is None:
        return {}
    found = {own.name: (factors.factor(own.name, sensors), own.largest_sigma) for own in ranges}
    return {name: CurveBand(k, k * sigma) for name, (k, sigma) in found.items() if k and math.isfinite(sigma)}


def curve_note() -> str:
    """Return what the bands of whole curves mean, as a sentence."""
    factors = CovarianceInflation.shipped().curves
    assert factors is not None
    return (
        f"the whole curve lies within these bands in {100 * factors.level:g} % of recordings of 2 to 10 s of people "
        f"like the {factors.people} measured"
    )


# --- what the terminal shows ---------------------------------------------------------------------


def _printed(analysis: MotionAnalysis) -> list[Table | str]:
    gait, shown = analysis.gait, [row for row in analysis.ranges if row.known_share > 0 and not row.about_vertical]
    out: list[Table | str] = [
        _printed_ranges(shown),
        *(f"{row.name}: {row.text}" for row in shown if row.is_uncertain),
        *([gait_table(gait), f"gait: from {gait.rests_on}"] if gait.is_gait else [f"gait: {gait.why_not}"]),
    ]
    if (found := analysis.repetitions) is not None:
        columns = ("down [s]", "below [s]", "up [s]", "depth [m]", "right knee [deg]", "left knee [deg]")
        rows = [
            (
                str(n),
                *(fixed(value, 2) for value in (r.descent_time, r.bottom_time, r.ascent_time, r.depth)),
                *(fixed(math.degrees(r.knee_flexion[side]), 0) for side in SIDES),
            )
            for n, r in enumerate(found.repetitions, start=1)
        ]
        out.append(Table((found.kind.replace("_", " "), *columns), rows))
    return [*out, *(f"{part}: {note}" for part, notes in analysis.notes.items() for note in notes)]


def _printed_ranges(shown: Sequence[RangeOfMotion]) -> Table:
    rows = []
    for row in shown:
        half = math.nan if row.is_uncertain else BAND_95 * row.range_sigma
        cells = [fixed(math.degrees(v), 0) for v in (row.low, row.high, row.range, half, row.peak_velocity)]
        cells[2] = f">= {cells[2]}" if row.is_uncertain else cells[2]
        rows.append((row.name, *cells, f"{100 * row.known_share * row.trusted_share:.0f} %"))
    return Table(("angle [deg]", "low", "high", "range", "\u00b1 95 %", "deg/s", "trusted"), rows)


_GAIT_UNITS: Final = {
    "stride_time": ("s", 2),
    "cadence": ("steps/min", 1),
    "stride_length": ("m", 2),
    "speed": ("m/s", 2),
    "stance_share": ("of the stride", 2),
}
"""Measure -> unit, decimals."""


def gait_table(gait: GaitAnalysis) -> Table:
    """Return the gait measures of both sides."""
    rows = []
    for name, (unit, digits) in _GAIT_UNITS.items():
        cells = []
        for side in SIDES:
            mean, sd, strides = gait.summary.get(side, {}).get(name, (math.nan, math.nan, 0))
            spread = f" \u00b1 {sd:.{digits}f}" if math.isfinite(sd) else ""
            cells.append(f"{mean:.{digits}f}{spread} ({strides})" if strides else "")
        symmetry = fixed(100 * gait.symmetry.get(name, math.nan), 1, True)
        rows.append((f"{label(name)} [{unit}]", *cells, f"{symmetry} %" if symmetry else ""))
    columns = ("mean, standard deviation (strides)", *SIDES, "(right - left) / mean")
    return Table(columns, rows, kind="gait", row_headers=True)


# --- what the files have -------------------------------------------------------------------------


def _gait_facts(gait: GaitAnalysis) -> dict[str, Any]:
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
        "strides": [dict(zip(_STRIDE, vars(stride).values(), strict=True)) for stride in gait.strides],
        "summary": {
            side: {
                name + units.get(name, ""): {"mean": _known(mean), "sd": _known(sd), "strides": n}
                for name, (mean, sd, n) in measures.items()
            }
            for side, measures in gait.summary.items()
        },
        "symmetry": {name: _known(value) for name, value in gait.symmetry.items()},
        "symmetry_is": "(right - left) / mean of both",
    }


def _travel_facts(travel: Travel) -> dict[str, Any]:
    """Way and turning as plain data."""
    return {
        "path_length_m": _known(travel.path_length),
        "displacement_m": _known(travel.displacement),
        "direction_deg": _degrees(travel.direction),
        "direction_is": "from world x, counterclockwise seen from above",
        "direction_from_facing_deg": _degrees(travel.relative_direction),
        "turned_left_deg": _degrees(travel.turned_left),
        "turned_right_deg": _degrees(travel.turned_right),
        "turned_left_sigma_deg": _degrees(travel.turned_left_sigma),
        "turned_right_sigma_deg": _degrees(travel.turned_right_sigma),
        "turns_within_their_error": travel.unsure_turns,
        "walking_share": travel.walking_share,
        "observed_share": travel.observed_share,
        "notes": list(travel.notes),
    }


def _repetition_facts(found: RepetitionAnalysis) -> dict[str, Any]:
    """Repetitions as plain data."""
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
                "knee_flexion_deg": {k: _degrees(v) for k, v in r.knee_flexion.items()},
            }
            for r in found.repetitions
        ],
    }


def _curve_facts(curves: Mapping[str, CurveBand]) -> dict[str, Any] | None:
    """Factors of the bands of whole curves as plain data; None without any."""
    if not curves:
        return None
    return {
        "half_width": "factor x ..._sigma_deg, in every frame",
        "meaning": curve_note(),
        "factor": {name: band.factor for name, band in curves.items()},
    }


def _ranges(ranges: Sequence[RangeOfMotion], curves: Mapping[str, CurveBand]) -> Table:
    rows: list[list[Cell]] = []
    for r in ranges:
        angles = {"low": r.low, "high": r.high, "range": r.range, "mean": r.mean}
        sigmas = {"low": r.low_sigma, "high": r.high_sigma, "range": r.range_sigma}
        intervals = {"low": r.low_interval, "high": r.high_interval, "range": r.range_interval}
        values = {f"{name}_deg": np.degrees(value) for name, value in angles.items()}
        values |= {"time_low_s": r.time_low, "time_high_s": r.time_high}
        values |= {"peak_velocity_deg_per_s": np.degrees(r.peak_velocity)}
        values |= {name: getattr(r, name) for name in ("known_share", "singular_share", "trusted_share")}
        values |= {f"{name}_sigma_deg": np.degrees(value) for name, value in sigmas.items()}
        values["about_vertical"] = r.about_vertical
        for name, ends in intervals.items():
            values |= {
                f"{name}_interval_{k}_deg": np.degrees(end) for k, end in zip(("low", "high"), ends, strict=True)
            }
        for name, end in (("low", r.uncertain_low), ("high", r.uncertain_high)):
            values[f"uncertain_{name}_s"] = 0.0 if end is None else end.seconds
            values[f"uncertain_{name}_deg"] = math.nan if end is None else np.degrees(end.value)
        values["comparable"] = r.is_comparable
        values["curve_half_width_deg"] = np.degrees(curves[r.name].half) if r.name in curves else math.nan
        rows.append([r.name, *_rounded(values.values())])
    return Table(("angle", *values), rows)


def _torques(torques: JointTorques) -> tuple[Table, dict[str, Any]]:
    wrenches = [f"{kind}_{c}" for kind in ("outer", "unexplained") for c in WRENCH_COLUMNS]
    sigmas = [f"{name}_sigma_{part}_Nm" for part in ("motion", "masses") for name in torques.dof_names]
    columns = [*(f"{name}_Nm" for name in torques.dof_names), *wrenches, *sigmas]

    def values(frames: slice) -> Array:
        whole = torques.torques, torques.root_wrench, torques.unexplained
        return np.hstack([*(one[frames] for one in whole), *np.moveaxis(torques.sigma_parts(frames), 1, 0)])

    return (
        Table(("time", *columns), _Series(torques.times, values)),
        {
            "file": "torques.csv",
            "weight_kg": torques.weight_kg,
            "torques": "about the URDF's revolutes of that name, positive along their axes",
            "outer": "external force and moment about the root that the motion requires, world axes",
            "unexplained": "the part of it that is assigned to no foot; not a measurement",
            "sigma": "columns ..._sigma_motion_Nm, ..._sigma_masses_Nm: standard deviations by the errors of "
            "the motion and of the masses of segments; the whole is the root of the sum of their squares",
            "notes": list(torques.notes),
        },
    )


def _reaction(reaction: GroundReaction) -> tuple[Table, dict[str, Any]]:
    axes = ("x", "y", "z")
    columns = [
        "status",
        *(f"force_{c}{kind}_N" for kind in ("", "_sigma") for c in axes),
        *(f"pressure_{c}{kind}_m" for kind in ("", "_sigma") for c in axes[:2]),
        "outside_soles_m",
        *(f"{side}_vertical_{end}_N" for side in SIDES for end in ("least", "most")),
    ]
    series = [reaction.force, reaction.force_sigma, reaction.pressure, reaction.pressure_sigma]
    series += [reaction.outside[:, None], reaction.vertical.reshape(-1, 4)]
    rows = _Series(
        reaction.times,
        lambda frames: np.hstack([one[frames] for one in series]),
        lambda t: STATUS[Contact(reaction.state[t])],
    )
    return (
        Table(("time", *columns), rows),
        {
            "file": "ground_reaction.csv",
            "weight_kg": reaction.weight_kg,
            "floor_m": _known(reaction.floor),
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


def _rounded(values: Iterable[Any]) -> list[float]:
    return [round(float(value), _DIGITS) for value in values]


def _known(value: Any) -> float | None:
    return number(value, _ALL)


def _degrees(radians: float) -> float | None:
    return _known(np.degrees(radians))


# --- figures -------------------------------------------------------------------------------------

MOST_DRAWN: Final = 10_000  #: Largest number of samples of a curve; an image has fewer columns of pixels


def ground_reaction_over_time(found: GroundReaction) -> Plot:
    """Plot the vertical force with its band and the interval of each foot, and the centre of pressure."""
    figure, ((force,), (each,), (sole,)) = subplots(3, 1, (10.0, 7.5), sharex=True)
    step = max(1, math.ceil(len(found.times) / MOST_DRAWN))
    times, weight = found.times[::step], found.body_weight
    total, band = found.force[::step, 2], BAND_95 * found.force_sigma[::step, 2]
    force.fill_between(times, total - band, total + band, color="0.8", lw=0, label="95 % band")
    force.plot(times, total, color="0.2", lw=1.0, label="both feet together")
    force.axhline(weight, color="0.5", lw=0.7, ls="--", label="body weight")
    force.set_ylabel("vertical force [N]")
    right = force.secondary_yaxis("right", functions=(lambda n: 100 * n / weight, lambda w: w * weight / 100))
    right.set_ylabel("% of body weight")
    for side, interval in zip(SIDES, np.moveaxis(found.vertical[::step], 1, 0), strict=True):
        colour = SIDE_COLORS[side]
        each.fill_between(times, *interval.T, color=colour, alpha=0.3, lw=0)
        alone = np.where(interval[:, 0] == interval[:, 1], interval[:, 0], np.nan)
        each.plot(times, alone, color=colour, lw=1.2, label=f"{side} foot; area: not identifiable")
    each.set_ylabel("vertical force\non each foot [N]")
    for axis, name, style in ((0, "x", "-"), (1, "y", ":")):
        at, spread = found.pressure[::step, axis], BAND_95 * found.pressure_sigma[::step, axis]
        sole.fill_between(times, at - spread, at + spread, color="0.85", lw=0)
        sole.plot(times, at, style, color="0.2", lw=1.0, label=f"{name}, world")
    sole.set_ylabel("centre of pressure [m]")
    sole.set_xlabel("time [s]")
    for ax in (force, each, sole):
        ax.legend(fontsize=8, loc="upper right")
        ax.grid(alpha=0.3)
    return figure
