"""The command plan: what to expect of a recording before it is made."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.table import Table

from rtof_kin.cli.solver_options import use_threads
from rtof_kin.cli.terminal import add_model, add_output, command, out, print_files, progress


def add_commands(commands: Any) -> None:
    """Declare the command."""
    parser = command(
        commands,
        "plan",
        _plan,
        "expected errors of a recording before it is made, and how to lower them",
        "PLAN is a protocol's TOML file, the name of a movement (--movements lists them), the folder of a "
        "recording, or the output of reconstruct. The recording is simulated with the errors of a real "
        "detector and real sensors and solved as a real one. Prints the standard deviation to expect of "
        "every clinical angle, what camera and sensors do not identify and why, the best place of the "
        "camera and of one more sensor, and how long to move for the calibration; -o writes tables, a "
        "figure and a page of instructions for the operator.",
    )
    parser.add_argument("plan", metavar="PLAN", nargs="?", help="what is to be recorded")
    parser.add_argument("--movements", action="store_true", help="list the movements of the library and exit")
    add_output(parser, "", "folder to write; nothing is written without")
    parser.add_argument(
        "--draws",
        type=int,
        default=3,
        metavar="N",
        help="simulated recordings of the plan, each with other errors of person, detector and sensors",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the first one")
    parser.add_argument(
        "--no-search",
        dest="search",
        action="store_false",
        help="predict only: compare no cameras, sensors and lengths for the calibration",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="processes; one per core if not given")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of numerical libraries")
    add_model(parser)


def _plan(options: argparse.Namespace) -> None:
    use_threads(options)
    from lifting.predict import Lifter
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.plan.document import MARKER, document, write_plan
    from rtof_kin.plan.movements import MOVEMENTS
    from rtof_kin.plan.plan import plan
    from rtof_kin.plan.setup import planned
    from rtof_kin.reporting.document import show

    if options.movements:
        table = Table("movement", "what it is")
        for name, movement in MOVEMENTS.items():
            table.add_row(name, movement.description)
        out.print(table)
        return
    if options.plan is None:
        raise InvalidInputError("plan: name a protocol's file, a movement, a recording or a motion")
    folder = Path(options.output) if options.output else None
    if folder is not None:
        check_replaceable(folder, MARKER, options.overwrite)
    lifter = Lifter.load(options.model)
    with progress() as update:
        protocol, setup = planned(options.plan, lifter, update)
        found = plan(
            protocol,
            setup,
            draws=options.draws,
            seed=options.seed,
            lifter=lifter,
            search=options.search,
            workers=options.workers,
            progress=update,
        )
    show(document(found), out)
    if folder is not None:
        write_plan(found, folder, options.overwrite)
        print_files(folder)
