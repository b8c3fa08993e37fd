"""The command follow: did the person change over visits?"""

from __future__ import annotations

import argparse
from typing import Any

from rtof_kin.cli.terminal import command, job_progress, out, print_files


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
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.reporting.document import show, write
    from rtof_kin.reporting.visits import follow

    if options.output:
        check_replaceable(options.output, "follow.json", options.overwrite)
    given = (name.strip() for name in (options.measures or "").split(","))
    with job_progress("reading") as update:
        document = follow(
            options.folder,
            baseline=options.baseline or "",
            by=options.by,
            kind=options.repetitions or "",
            measures=list(dict.fromkeys(filter(None, given))),
            progress=lambda done, total: update(done, total, ""),
        )
    show(document, out)
    if options.output:
        write(document, options.output, options.overwrite)
        print_files(options.output)
