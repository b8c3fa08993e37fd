"""The command line ``rtof-kin``: the only place that prints.

Exit codes: 0 done, 1 a check does not hold (inspect), 2 wrong input (one line says what, where and what
to do), 130 interrupted.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code.

    Args:
        arguments: of the command line; default: sys.argv.
    """
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        exec("")  # else Python ends by the signal where it interrupted an exec, as imports have them
        return 130


def _run(arguments: list[str] | None) -> int:
    import logging

    from rtof_kin.cli.terminal import err
    from rtof_kin.core.errors import RtofError

    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        return int(options.run(options) or 0)
    except RtofError as error:
        err.print(f"error: {error}", style="bold red", soft_wrap=True)
        return 2


def _parser() -> argparse.ArgumentParser:
    import argparse

    from rtof_kin.cli import (
        clinical,
        compare,
        detection,
        inspection,
        lifters,
        live,
        overlay,
        protocols,
        recordings,
        reporting,
        start,
        training,
        view,
    )

    parser = argparse.ArgumentParser(
        prog="rtof-kin",
        description="Human motion from one camera and a handful of IMUs. Everything stays on this "
        "machine. Start with: rtof-kin demo",
        epilog="Each command explains itself: rtof-kin reconstruct --help",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (
        start,
        recordings,
        inspection,
        clinical,
        compare,
        reporting,
        overlay,
        detection,
        live,
        training,
        lifters,
        protocols,
        view,
    ):
        module.add_commands(commands)
    return parser
