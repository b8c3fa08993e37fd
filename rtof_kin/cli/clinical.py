"""The command analyse: joint angles, gait, repetitions and torques of a motion."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.table import Column, Table

from rtof_kin.cli.terminal import add_output, command, decimal, out, print_files


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "analyse",
        _analyse,
        "clinical joint angles, gait and torques of a motion",
        "MOTION is the output of reconstruct. OUT gets the angles as CSV with a table of their names, "
        "signs and zeros, ranges of motion, gait cycles, torques where a body mass is known, figures, and "
        "notes on what could not be computed and why. An unobserved angle is an empty cell.",
    )
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.h5")
    add_output(parser, None, "folder to write")
    parser.add_argument("--height", type=decimal, metavar="M", help="to check the skeleton's size")
    add_analysis(parser)
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")


def add_analysis(parser: argparse.ArgumentParser) -> None:
    """Declare the options that `analyse_and_write` reads, but for height, figures and output."""
    parser.add_argument("--weight", type=decimal, metavar="KG", help="body mass, for torques; overrides the recording")
    parser.add_argument("--sex", choices=["male", "female"], help="of the tables of body mass")
    parser.add_argument("--repetitions", choices=["squat", "sit_to_stand"], help="what to count")
    parser.add_argument(
        "--from-standing",
        action="store_true",
        help="angles of trunk and legs relative to half a second or more of the person's quiet standing",
    )


def _analyse(options: argparse.Namespace) -> None:
    analysis = analyse_and_write(options)
    _print_ranges(analysis)
    out.print(f"pelvis: {analysis.travel.text}", soft_wrap=True)
    if analysis.gait.is_gait:
        _print_gait(analysis.gait)
        out.print(f"gait: from {analysis.gait.rests_on}", soft_wrap=True)
    else:
        out.print(f"gait: {analysis.gait.why_not}", soft_wrap=True)
    if analysis.repetitions is not None:
        _print_repetitions(analysis.repetitions)
    for part, notes in analysis.notes.items():
        for note in notes:
            out.print(f"{part}: {note}", soft_wrap=True)
    print_files(options.output)


def analyse_and_write(options: argparse.Namespace, inputs: Mapping[str, str] | None = None) -> Any:
    """Analyse a motion, write the folder, and return the `MotionAnalysis`.

    Args:
        inputs: fingerprints for the folder's manifest.
    """
    from rtof_kin.body.motion_file import MotionReader, motion_path
    from rtof_kin.clinical.analysis import analyse_motion
    from rtof_kin.clinical.files import MARKER, write_analysis
    from rtof_kin.core.files.folder import check_replaceable, new_folder
    from rtof_kin.core.packages import can_draw

    check_replaceable(options.output, MARKER, options.overwrite)
    path = motion_path(options.motion)
    weight_kg, sex = _weight_and_sex(options, path.parent)
    with MotionReader(path) as reader:
        analysis = analyse_motion(
            reader,
            weight_kg=weight_kg,
            height=options.height,
            sex=sex,
            repetitions=options.repetitions,
            from_standing=options.from_standing,
        )
    with new_folder(options.output, MARKER, options.overwrite, inputs) as folder:
        write_analysis(analysis, folder)
        if not options.no_figures and can_draw():
            from rtof_kin.reporting.clinical_figures import write_clinical_figures

            write_clinical_figures(analysis, folder / "figures")
    return analysis


def _weight_and_sex(options: argparse.Namespace, folder: Path) -> tuple[float | None, str | None]:
    """Body mass and sex of the options, else of the recording."""
    from rtof_kin.reporting.summary_file import SUMMARY, read_summary

    summary = folder / SUMMARY
    subject = read_summary(summary).subject if summary.exists() else {}
    weight_kg = options.weight if options.weight is not None else subject.get("mass_kg")
    return weight_kg, options.sex or (subject.get("sex") if weight_kg is not None else None)


def _print_ranges(analysis: Any) -> None:
    from rtof_kin.data.confidence import BAND_95

    columns = ("low", "high", "range", "\u00b1 95 %", "deg/s", "trusted")
    table = Table(Column("angle [deg]", no_wrap=True), *columns)
    shown = [row for row in analysis.ranges if row.known_share > 0 and not row.about_vertical]
    for row in shown:
        half = math.nan if row.is_uncertain else BAND_95 * row.range_sigma
        figures = map(math.degrees, (row.low, row.high, row.range, half, row.peak_velocity))
        cells = ["" if math.isnan(v) else f"{v:.0f}" for v in figures]
        cells[2] = f">= {cells[2]}" if row.is_uncertain else cells[2]
        table.add_row(row.name, *cells, f"{100 * row.known_share * row.trusted_share:.0f} %")
    out.print(table)
    for row in shown:
        if row.is_uncertain:
            out.print(f"{row.name}: {row.text}", soft_wrap=True)


def _print_gait(gait: Any) -> None:
    digits = {"stride_time": "s", "cadence": "steps/min", "stride_length": "m", "speed": "m/s"}
    table = Table(Column("gait", no_wrap=True), *gait.summary, "symmetry")
    for name in next(iter(gait.summary.values())):
        cells = [_spread(*measures[name]) for measures in gait.summary.values()]
        symmetry = f"{100 * gait.symmetry[name]:+.1f} %" if name in gait.symmetry else ""
        label = f"{name.replace('_', ' ')} {digits.get(name, '')}"
        table.add_row(label, *cells, symmetry)
    out.print(table)


def _spread(mean: float, spread: float, strides: int) -> str:
    return f"{mean:.3g}" + (f" \u00b1 {spread:.2g}" if strides > 1 else "") + f" ({strides})"


def _print_repetitions(found: Any) -> None:
    columns = ("down [s]", "below [s]", "up [s]", "depth [m]", "right knee [deg]", "left knee [deg]")
    table = Table(Column(found.kind.replace("_", " "), no_wrap=True), *columns)
    for number, r in enumerate(found.repetitions, start=1):
        knees = [math.degrees(r.knee_flexion[side]) for side in ("right", "left")]
        figures = (r.descent_time, r.bottom_time, r.ascent_time, r.depth)
        cells = [f"{v:.2f}" for v in figures] + [f"{v:.0f}" for v in knees]
        table.add_row(str(number), *("" if cell == "nan" else cell for cell in cells))
    out.print(table)
