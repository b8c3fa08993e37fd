"""The command follow: did the person change over visits?"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.table import Column, Table
from rich.text import Text

from rtof_kin.cli.terminal import command, job_progress, out, print_files

if TYPE_CHECKING:
    from rtof_kin.clinical.follow_up import Followed, FollowUp

_SHOWN = 14
"""Measures in the printed table, unless they are chosen."""
_STYLES = {"improved": "green", "worse": "bold red", "changed": "yellow"}


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "follow",
        _follow,
        "did the person change over visits",
        "DIR has a folder for each visit, with the outputs of reconstruct of its trials: repeated recordings "
        "of the same movement. Prints which measures improved, got worse or changed since the first visit, "
        "with standard errors of measurement and the smallest change that could be shown; -o writes a page "
        "with trajectories, figures, a table and JSON. DIR/follow.toml may name visits, baseline, measures "
        "and which direction is better.",
    )
    parser.add_argument("folder", metavar="DIR", help="a folder for each visit in it")
    parser.add_argument("--baseline", metavar="VISIT", help="visit to compare with; default: the first")
    parser.add_argument(
        "--by",
        choices=["cycle", "repetition", "range"],
        help="gait cycles, repetitions, or whole recordings; default: chosen from the data, and said",
    )
    parser.add_argument("--repetitions", choices=["squat", "sit_to_stand"], help="what is repeated")
    parser.add_argument(
        "--measures",
        metavar="NAMES",
        help="measures to follow, or angles with all of theirs, separated by commas; fewer are tested more sharply",
    )
    parser.add_argument("-o", "--output", metavar="OUT", help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace what an earlier run wrote there")


def _follow(options: argparse.Namespace) -> None:
    from rtof_kin.core.files.folder import check_replaceable, new_folder
    from rtof_kin.reporting.follow.files import MARKER, write_follow_up
    from rtof_kin.reporting.follow.sentences import cautions, opening

    if options.output:
        check_replaceable(options.output, MARKER, options.overwrite)
    found, notes = _found(options)
    first, *others = opening(found)
    out.print(first, style="bold red" if found.incomparable else "bold", soft_wrap=True)
    for line in others:
        out.print(line, style="bold", soft_wrap=True)
    for line in [*notes, *cautions(found)]:
        out.print(f"caution: {line}", style="yellow", soft_wrap=True)
    _print_measures(found, bool(options.measures))
    if options.output:
        with new_folder(options.output, MARKER, options.overwrite) as folder:
            write_follow_up(found, folder, notes)
        print_files(options.output)


def _found(options: argparse.Namespace) -> tuple[FollowUp, tuple[str, ...]]:
    """Answer as the options and ``follow.toml`` ask for it, and notes on the input."""
    from rtof_kin.clinical.follow_up import follow_up
    from rtof_kin.core.checks import indices_of
    from rtof_kin.reporting.follow.inputs import read_visits

    with job_progress("reading") as update:
        read = read_visits(options.folder, lambda done, total: update(done, total, ""))
    plan, baseline = read.plan, read.baseline
    if options.baseline:
        names = [visit.name for visit in read.visits]
        baseline = indices_of("visit", [plan.names.get(options.baseline, options.baseline)], names)[0]
    given = (name.strip() for name in (options.measures or "").split(","))
    names = list(dict.fromkeys(filter(None, given))) or list(plan.measures)
    found = follow_up(
        read.visits,
        baseline=baseline,
        by=options.by or plan.by,
        kind=options.repetitions or plan.kind,
        better=plan.better,
        names=names,
        shares=plan.shares,
    )
    return found, read.notes


def _print_measures(found: FollowUp, all_of_them: bool) -> None:
    """Table of the last visit against the baseline; those that changed first, then the smallest p-values."""
    from rtof_kin.reporting.follow.sentences import name_of, number, reasoning

    visit = found.last

    def key(one: Followed) -> tuple[float, float]:
        change = one.changes[visit]
        return (2.0, 1.0) if change is None else (float(change.p != change.p), change.p)

    ordered = sorted(found.measures, key=key)
    shown = ordered if all_of_them else ordered[:_SHOWN]
    first, last = found.visits[found.baseline].name, found.visits[visit].name
    headers = ("from", "to", "change", "detect-\nable", "SEM", "MDC95")
    figures = [Column(header, justify="right", no_wrap=True) for header in headers]
    table = Table("measure", *figures, "outcome", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for one in shown:
        change, measure, both = one.changes[visit], one.measure, one.errors.both
        outcome = one.outcome(visit).value
        table.add_row(
            f"{name_of(measure)} [{measure.unit}]",
            *(number(measure, one.estimates[v]) for v in (found.baseline, visit)),
            "" if change is None else number(measure, change.difference, True),
            "" if change is None else number(measure, change.detectable),
            number(measure, both.sem),
            number(measure, both.mdc95),
            Text(outcome, _STYLES.get(outcome, "")),
        )
    out.print(f"From {first} to {last}:", soft_wrap=True)
    out.print(table)
    for one in shown[:3]:
        out.print(f"{name_of(one.measure)}: {reasoning(one, visit)}", soft_wrap=True)
    if len(shown) < len(found.measures):
        out.print(f"and {len(found.measures) - len(shown)} more: -o OUT, or --measures", soft_wrap=True)
