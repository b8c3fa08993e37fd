"""The command line ``rtof-kin``: the only place that prints.

Exit codes: 0 done, 1 a check does not hold (inspect), 2 wrong input (one line says what, where and what
to do), 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging

from rtof_kin.cli import (
    clinical,
    detection,
    inspection,
    lifters,
    protocols,
    recordings,
    reporting,
    training,
)
from rtof_kin.cli.terminal import err
from rtof_kin.errors import RtofError


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        code = options.run(options)
    except RtofError as error:
        err.print(f"error: {error}", style="bold red", soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        err.print("interrupted")
        return 130
    return int(code or 0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rtof-kin",
        description="Human motion from one camera and a handful of IMUs. Everything stays on this "
        "machine. Start with: rtof-kin demo",
        epilog="Each command explains itself: rtof-kin reconstruct --help",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (recordings, inspection, clinical, reporting, detection, training, lifters, protocols):
        module.add_commands(commands)
    return parser
