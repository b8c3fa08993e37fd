"""The command line ``rtof-kin``: the only place that prints.

Exit codes: 0 done, 1 a check does not hold (inspect) or a recording failed (batch), 2 wrong input
(one line says what, where and what to do), 130 interrupted.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import argparse

    from rtof_kin.cli.terminal import Parser


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
    from rtof_kin.cli.terminal import err
    from rtof_kin.core.errors import RtofError

    try:
        return dispatch(arguments)
    except RtofError as error:
        err.print(f"error: {error}", style="bold red", soft_wrap=True)
        return 2


def dispatch(arguments: list[str] | None) -> int:
    """Run one command and return its exit code; errors are raised.

    Args:
        arguments: of the command line; None: sys.argv.

    Raises:
        RtofError: of the command. SystemExit: the arguments are wrong, or ask for help.
    """
    import errno
    import logging

    from rtof_kin.cli.terminal import log_handler
    from rtof_kin.core.errors import RtofError, too_long

    options = parse(arguments)
    logging.basicConfig(level=logging.WARNING, handlers=[log_handler()])
    try:
        return int(options.run(options) or 0)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        raise RtofError(too_long(error.filename)) from error
    except MemoryError as error:
        problem = f"not enough memory ({error})" if str(error) else "not enough memory"
        raise RtofError(f"{problem}; end other programs, or take a shorter recording") from error


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the options of a command line.

    Args:
        arguments: see `dispatch`.

    Raises:
        SystemExit: they are wrong, or ask for help.
    """
    return _parser()[0].parse_args(arguments)


def command_names() -> set[str]:
    """Return the names of all commands."""
    return set(_parser()[1].choices)


def _parser() -> tuple[Parser, argparse._SubParsersAction[Parser]]:
    """Return the parser and its commands."""
    from rtof_kin.cli import (
        batch,
        clinical,
        compare,
        conversion,
        detection,
        follow,
        gait,
        inspection,
        lifters,
        live,
        overlay,
        plan,
        protocols,
        recordings,
        reporting,
        start,
        training,
        validation,
        view,
    )
    from rtof_kin.cli.terminal import Parser

    parser = Parser(
        prog="rtof-kin",
        description="Human motion from one camera and a handful of IMUs. Everything stays on this "
        "machine. Start with: rtof-kin demo",
        epilog="Each command explains itself: rtof-kin reconstruct --help",
    )
    parser.add_argument("--version", action=_version_action(), help="show the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (
        start,
        plan,
        recordings,
        conversion,
        inspection,
        clinical,
        compare,
        follow,
        gait,
        reporting,
        overlay,
        detection,
        live,
        training,
        lifters,
        batch,
        protocols,
        validation,
        view,
    ):
        module.add_commands(commands)
    return parser, commands


def _version_action() -> type[argparse.Action]:
    """Return an action that finds the version only where it is asked for."""
    import argparse

    class Version(argparse._VersionAction):
        def __call__(self, parser: argparse.ArgumentParser, *rest: Any) -> None:
            import rtof_kin

            self.version = f"rtof-kin {rtof_kin.__version__}"
            super().__call__(parser, *rest)

    return Version
