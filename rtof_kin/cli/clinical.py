"""The command analyse: joint angles, gait, repetitions and torques of a motion."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtof_kin.cli.terminal import add_output, command, decimal, out, print_files

if TYPE_CHECKING:
    from rtof_kin.reporting.document import Document


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
    from rtof_kin.reporting.document import show

    show(analyse_and_write(options), out)
    print_files(options.output)


def analyse_and_write(options: argparse.Namespace, inputs: Mapping[str, str] | None = None) -> Document:
    """Analyse a motion, write the folder, and return the document.

    Args:
        inputs: fingerprints for the folder's manifest.
    """
    from rtof_kin.body.motion_file import motion_path
    from rtof_kin.clinical.analysis import analyse
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.reporting.analysis import MARKER, document
    from rtof_kin.reporting.document import write

    check_replaceable(options.output, MARKER, options.overwrite)
    weight_kg, sex = _weight_and_sex(options, motion_path(options.motion).parent)
    found = analyse(
        options.motion,
        weight_kg=weight_kg,
        height=options.height,
        sex=sex,
        repetitions=options.repetitions,
        from_standing=options.from_standing,
    )
    made = document(found)
    write(replace(made, figures=()) if options.no_figures else made, options.output, options.overwrite, inputs)
    return made


def _weight_and_sex(options: argparse.Namespace, folder: Path) -> tuple[float | None, str | None]:
    """Body mass and sex of the options, else of the recording."""
    from rtof_kin.reporting.summary_file import SUMMARY, read_summary

    summary = folder / SUMMARY
    subject = read_summary(summary).subject if summary.exists() else {}
    weight_kg = options.weight if options.weight is not None else subject.get("mass_kg")
    return weight_kg, options.sex or (subject.get("sex") if weight_kg is not None else None)
