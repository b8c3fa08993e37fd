"""The command compare: two motions, or both sides of one, angle by angle."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.table import Column, Table

from rtof_kin.cli.terminal import command, out, print_files

if TYPE_CHECKING:
    from rtof_kin.clinical.comparison import AngleComparison, Comparison
    from rtof_kin.clinical.comparison_alignment import Alignment

_SHOWN = 12
"""Angles in the printed table, unless they are chosen."""


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "compare",
        _compare,
        "two motions, or the left and right side of one, angle by angle",
        "A and B are outputs of reconstruct or run, a motion.h5, or a .mot or .sto of another system. "
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
    from rtof_kin.clinical.comparison_spm import compare_spm
    from rtof_kin.core.files.folder import check_replaceable, new_folder
    from rtof_kin.reporting.comparison.files import MARKER, write_comparison
    from rtof_kin.reporting.comparison.sentences import cautions, opening
    from rtof_kin.reporting.comparison.spm import spm_lines, write_spm

    if options.output:
        check_replaceable(options.output, MARKER, options.overwrite)
    found, why = _compared(options)
    mapped = compare_spm(found) if options.spm else None
    for line in opening(found, why):
        out.print(line, style="bold", soft_wrap=True)
    for line in cautions(found):
        out.print(f"caution: {line}", style="yellow", soft_wrap=True)
    _print_angles(found, all_of_them=bool(options.angles))
    for line in spm_lines(mapped) if mapped is not None else ():
        out.print(line, soft_wrap=True)
    if options.output:
        with new_folder(options.output, MARKER, options.overwrite) as folder:
            write_comparison(found, folder, why)
            if mapped is not None:
                write_spm(mapped, found, folder)
        print_files(options.output)


def _compared(options: argparse.Namespace) -> tuple[Comparison, str]:
    """Comparison as the options ask for it, and why its axis was chosen."""
    from rtof_kin.clinical.comparison import compare
    from rtof_kin.clinical.comparison_axis import agreement, choose_axis, compare_sides
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.reporting.comparison.inputs import distinct, read_compared

    given = (name.strip() for name in (options.angles or "").split(","))
    names = list(dict.fromkeys(filter(None, given)))
    if options.sides == (options.b is not None):
        raise InvalidInputError("compare: give two motions, or one with --sides")
    shifted = options.align or options.shift is not None
    if shifted and (options.sides or options.by not in (None, "time")):
        raise InvalidInputError("compare: --shift and --align are for two motions compared --by time")
    if options.sides:
        kind = options.repetitions or ""
        return compare_sides(read_compared(options.a), options.by, names=names, kind=kind)
    a, b = read_compared(options.a), read_compared(options.b)
    first, second = distinct(a, b, (options.a, options.b))
    a, b = replace(a, name=first), replace(b, name=second)
    clocks = agreement(a, b)
    choice = choose_axis(a, b, clocks, "time" if shifted else options.by)
    shift = _found_shift(clocks) if options.align else options.shift or 0.0
    if choice.by != "time":
        clocks = None
    elif shift:
        clocks = agreement(a, b, shift)
    kind = options.repetitions or choice.kind
    return compare(a, b, choice.by, names=names, shift=shift, alignment=clocks, kind=kind), choice.why


def _found_shift(clocks: Alignment | None) -> float:
    from rtof_kin.core.errors import InvalidInputError

    if clocks is None:
        raise InvalidInputError("compare: no common angle moves, so that --align finds no shift; give --shift")
    return clocks.shift


def _print_angles(found: Comparison, all_of_them: bool) -> None:
    """Table of the largest differences; errors only where there are curves."""
    from rtof_kin.reporting.angle_names import label
    from rtof_kin.reporting.comparison.sentences import degrees, difference_text

    shown = found.angles if all_of_them else found.angles[:_SHOWN]
    curves = found.axis is not None
    columns = ("B - A,\nmean", "B - A,\nrange") if curves else ("A,\nrange", "B,\nrange", "B - A,\nrange")
    errors = ("RMSE", "MAE", "me-\ndian", "no\noffset") if curves else ()
    headers = (*columns, *errors, "changed")
    figures = [Column(header, justify="right", no_wrap=True) for header in headers]
    table = Table(Column("angle [deg]"), *figures, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for one in shown:
        changes = [difference_text(change) for change in one.changes]
        if one.errors is None:
            cells = [degrees(one.changes[0].a), degrees(one.changes[0].b), *changes]
        else:
            e = one.errors
            cells = [*changes, *map(degrees, (e.rmse, e.mae, e.median, e.offset_removed))]
        table.add_row(label(one.name), *cells, _verdict(one))
    out.print(table)
    if len(shown) < len(found.angles):
        out.print(f"and {len(found.angles) - len(shown)} smaller ones: -o DIR, or --angles", soft_wrap=True)


def _verdict(one: AngleComparison) -> str:
    from rtof_kin.clinical.comparison_change import Verdict

    changed = [change.measure for change in one.changes if change.verdict is Verdict.CHANGED]
    if len(changed) > 1:
        return "both"
    return changed[0] if changed else {Verdict.NOT_TESTED: "not tested"}.get(one.verdict, "not shown")
