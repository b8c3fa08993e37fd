"""The commands gait-reference and gait-scores: a person's gait against that of healthy people."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtof_kin.cli.terminal import add_output, command, out, print_files

if TYPE_CHECKING:
    from rtof_kin.data.gait_reference import GaitReference


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_reference(commands)
    _add_scores(commands)


# --- what they do --------------------------------------------------------------------------------


def _reference(options: argparse.Namespace) -> None:
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.formats.gait_reference import write_gait_reference

    check_new_file(Path(options.output), options.overwrite)
    build = _from_table if Path(options.source_files).is_file() else _from_recordings
    reference = build(options)
    _print_reference(reference)
    write_gait_reference(options.output, reference, options.overwrite)
    out.print(f"wrote {options.output}", soft_wrap=True)


def _from_recordings(options: argparse.Namespace) -> GaitReference:
    """Reference from a folder of recordings; says who is left out, and why."""
    import rtof_kin
    from rtof_kin.clinical.gait_scores import build_reference
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.data.gait_reference import MODEL_ZERO, OWN_SYSTEM, STANDING_ZERO
    from rtof_kin.reporting.gait import find_people

    for_tables = {
        "--people": options.people,
        "--system": options.system,
        "--zero": options.zero,
        "--speed": options.speed,
        "--negate": options.negate,
    }
    if given := [name for name, value in for_tables.items() if value]:
        raise InvalidInputError(f"gait-reference: {', '.join(given)} is for a table, not for recordings")
    found = find_people(options.source_files, options.from_standing)
    for place, reason in found.left_out.items():
        out.print(f"left out: {place}: {reason}", style="yellow", soft_wrap=True)
    reference, without = build_reference(
        found.people,
        least_strides=options.strides,
        licence=options.licence,
        source=options.origin,
        system=f"{OWN_SYSTEM} {rtof_kin.__version__}, skeleton {', '.join(found.skeletons)}",
        zero=STANDING_ZERO if options.from_standing else MODEL_ZERO,
        notes=_notes(found.recordings, found.people),
    )
    for code, reason in without.items():
        out.print(f"left out: {code}: {reason}", style="yellow", soft_wrap=True)
    return reference


def _notes(recordings: dict[str, list[str]], people: dict[str, Any]) -> tuple[str, ...]:
    """What the builder found about the recordings."""
    notes = []
    if alone := [code for code, places in recordings.items() if places == [code]]:
        notes.append(
            f"{len(alone)} of {len(recordings)} people are single recordings without a subject in their "
            "session; recordings of one person count as several people then"
        )
    if any(cycles.sigma is None for cycles in people.values()):
        notes.append("some motions have no covariances, so that errors of the reference are unknown")
    return tuple(notes)


def _from_table(options: argparse.Namespace) -> GaitReference:
    """Reference from a table of means."""
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.formats.gait_reference import read_gait_reference_table

    needed = {"--people": options.people, "--system": options.system, "--zero": options.zero}
    if absent := [name for name, value in needed.items() if not value]:
        raise InvalidInputError(f"gait-reference: a table needs {', '.join(absent)} too")
    negated = [name.strip() for name in (options.negate or "").split(",") if name.strip()]
    return read_gait_reference_table(
        options.source_files,
        negated=negated,
        people=options.people,
        licence=options.licence,
        source=options.origin,
        system=options.system,
        zero=options.zero,
        speed_range=tuple(options.speed) if options.speed else None,
    )


def _print_reference(reference: GaitReference) -> None:
    """Print what the reference is of, and what it cannot be used for."""
    from rtof_kin.clinical.gait_scores import FEW, gait_features
    from rtof_kin.core.errors import InvalidInputError

    speeds = ""
    if reference.speed_range is not None:
        speeds = " at {:.2f} to {:.2f} m/s".format(*reference.speed_range)
    out.print(f"reference of {reference.people} people{speeds}: {reference.system}", style="bold", soft_wrap=True)
    if reference.people < FEW:
        text = f"caution: fewer than {FEW} people: scores are relative to few"
        out.print(text, style="yellow", soft_wrap=True)
    if reference.missing:
        text = f"caution: without {', '.join(reference.missing)}: no GPS and GDI, only single scores"
        out.print(text, style="yellow", soft_wrap=True)
    try:
        features = gait_features(reference)
        out.print(f"GDI: {features.basis.shape[1]} features have 98 % of the variance", soft_wrap=True)
    except InvalidInputError as error:
        out.print(f"GDI will not be computed: {error}", soft_wrap=True)
    for note in reference.notes:
        out.print(f"note: {note}", soft_wrap=True)


def _scores(options: argparse.Namespace) -> None:
    from dataclasses import replace

    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.reporting.document import show, write
    from rtof_kin.reporting.gait import score_motion

    check_replaceable(options.output, "gait_scores.json", options.overwrite)
    document = score_motion(options.motion, options.reference, options.from_standing)
    show(document, out)
    write(replace(document, figures=()) if options.no_figures else document, options.output, options.overwrite)
    print_files(options.output)


# --- their arguments -----------------------------------------------------------------------------


def _add_reference(commands: Any) -> None:
    parser = command(
        commands,
        "gait-reference",
        _reference,
        "a reference of healthy gait, for gait-scores",
        "FROM is a folder of recordings of healthy people, outputs of reconstruct, run or batch: each person "
        "counts once, by the subject of the session. Or it is a CSV table of a published normal set, with "
        "the columns variable, percent, mean and sd in degrees. FILE is JSON. Who is left out is said, with "
        "the reason.",
    )
    parser.add_argument("source_files", metavar="FROM", help="folder of recordings, or CSV table")
    add_output(parser, None, "file to write")
    parser.add_argument("--licence", required=True, metavar="TEXT", help="terms of use of the reference")
    parser.add_argument(
        "--origin", required=True, metavar="TEXT", help="who was recorded, where and how; or a citation"
    )
    parser.add_argument("--strides", type=int, default=3, metavar="N", help="of each side that a person needs")
    parser.add_argument(
        "--from-standing", action="store_true", help="angles of trunk and legs relative to each person's quiet standing"
    )
    parser.add_argument("--people", type=int, metavar="N", help="of a table: number of people")
    parser.add_argument("--system", metavar="TEXT", help="of a table: what measured it, with its model")
    parser.add_argument("--zero", metavar="TEXT", help="of a table: posture in which its angles are 0")
    parser.add_argument(
        "--speed", type=float, nargs=2, metavar="M/S", help="of a table: slowest and fastest walking speed"
    )
    parser.add_argument(
        "--negate", metavar="NAMES", help="of a table: variables with the opposite sign, separated by commas"
    )


def _add_scores(commands: Any) -> None:
    parser = command(
        commands,
        "gait-scores",
        _scores,
        "a person's gait in one number: GPS, its profile (MAP), GDI",
        "MOTION is the output of reconstruct or run. Prints the scores with 95 % bands and what is missing; "
        "OUT gets JSON, tables and a figure. A motion that is no gait has no score, and a sentence says why.",
    )
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.npz")
    parser.add_argument("--reference", required=True, metavar="FILE", help="written by rtof-kin gait-reference")
    add_output(parser, None, "folder to write")
    parser.add_argument(
        "--from-standing",
        action="store_true",
        help="angles of trunk and legs relative to quiet standing; the default for a reference made so",
    )
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")
