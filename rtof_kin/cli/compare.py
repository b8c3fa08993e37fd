"""The command compare: two motions, or both sides of one, angle by angle."""

from __future__ import annotations

import argparse
from typing import Any

from rtof_kin.cli.terminal import command, out, print_files


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "compare",
        _compare,
        "two motions, or the left and right side of one, angle by angle",
        "A and B are outputs of reconstruct or run, a motion.npz, or a .mot or .sto of another system. "
        "Prints what is compared and how, which angles have changed, and differences B - A with 95 % "
        "intervals and errors; -o writes a page with the curves, a table and JSON.",
    )
    parser.add_argument("a", metavar="OUT_A", help="the first motion; its clock is used")
    parser.add_argument("b", metavar="OUT_B", nargs="?", help="the second motion")
    parser.add_argument("--sides", action="store_true", help="compare left (A) and right (B) of OUT_A")
    parser.add_argument(
        "--by",
        choices=["time", "cycle", "repetition", "range"],
        help="the same instants, phases of the gait cycle, phases of repetitions, or ranges of motion alone; "
        "default: chosen from the data, and said",
    )
    clocks = parser.add_mutually_exclusive_group()
    clocks.add_argument("--shift", type=float, metavar="S", help="seconds to add to the times of B")
    clocks.add_argument("--align", action="store_true", help="estimate that shift from the angular velocities of both")
    parser.add_argument("--repetitions", choices=["squat", "sit_to_stand"], help="what is repeated")
    parser.add_argument(
        "--angles", metavar="NAMES", help="angles to compare, separated by commas; fewer are tested more sharply"
    )
    parser.add_argument(
        "--spm",
        action="store_true",
        help="by cycle or repetition: Student's t along the cycle with clusters, by spm1d (extra clinical)",
    )
    parser.add_argument("-o", "--output", metavar="DIR", help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace what an earlier run wrote there")


def _compare(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.reporting.comparison import compare
    from rtof_kin.reporting.document import show, write

    if options.sides == (options.b is not None):
        raise InvalidInputError("compare: give two motions, or one with --sides")
    if options.output:
        check_replaceable(options.output, "comparison.json", options.overwrite)
    given = (name.strip() for name in (options.angles or "").split(","))
    document = compare(
        options.a,
        options.b,
        by=options.by,
        shift=options.shift,
        align=options.align,
        repetitions=options.repetitions or "",
        angles=list(dict.fromkeys(filter(None, given))),
        spm=options.spm,
    )
    show(document, out)
    if options.output:
        write(document, options.output, options.overwrite)
        print_files(options.output)
