"""The command line ``rtof-kin``: the only place that prints.

Exit codes: 0 done, 1 a check does not hold (inspect), or a recording or take failed (batch, evaluate), 2 wrong
input (one line says what, where and what to do), 130 interrupted.
"""

from __future__ import annotations

import gc
import sys
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cyclopts import App, CycloptsError

COMMANDS: Final = {
    "begin": {"app": "application"},
    "record": {"run": "record", "detect": "record", "simulate": "record"},
    "reconstruct": {"reconstruct": "reconstruction", "batch": "batch"},
    "look": {"inspect": "files", "report": "reporting", "view": "view", "overlay": "view"},
    "compare": {"compare": "compare", "study": "compare", "gait-reference": "compare"},
    "plan": {"plan": "compare"},
    "connect": {"export": "files", "retarget": "files", "live": "live"},
    "develop": {"train": "training", "evaluate": "evaluation"},
}
"""What a person wants -> command -> module that has it."""
LIMITED: Final = ("app", "run", "reconstruct", "study", "plan", "live")
"""Commands that limit the threads of the numerical libraries, before these are loaded."""
OLD_COMMANDS: Final = {
    "init": "run FILE... --only recording -o FOLDER",
    "join": "run FILE... --second FILE... -o OUT",
    "demo": "run --demo",
    "calibrate": "reconstruct RECORDING --calibrate-only -o FILE",
    "analyse": "report OUT --analysis FOLDER",
    "gait-scores": "report OUT --gait-reference FILE",
    "follow": "compare VISITS",
    "export-lifter": "export MODEL FILE.onnx --to onnx",
    "total-capture": "evaluate total-capture",
    "human36m": "evaluate human36m",
    "validate": "evaluate SET, such as evaluate opencap",
    "bundle": "export OUT FILE --to archive",
    "reproduce": "reconstruct, on the recording that export --to archive has put into the file",
}
"""Command of an earlier version -> what does it now."""
OLD_OPTIONS: Final = {
    ("report", "--subject"): "--code; --subject is the person's file, of other commands",
    **{(name, "--workers"): "--threads" for name in ("batch", "study", "plan", "evaluate")},
}
"""Command and option of an earlier version -> what does it now."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code. `arguments`: of the command line; default: sys.argv."""
    gc.set_threshold(50_000, 20, 20)  # imports make many objects and no garbage: a twentieth of a short command
    try:
        from rtof_kin.cli.terminal import remark
        from rtof_kin.core.errors import RtofError

        try:
            return dispatch(sys.argv[1:] if arguments is None else arguments)
        except RtofError as error:
            remark(f"error: {error}", "bold red")
            return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        exec("")  # else Python ends by the signal where it interrupted an exec, as imports have them
        return 130


def dispatch(arguments: list[str]) -> int:
    """Run one command and return its exit code; errors are raised. `RtofError`: the arguments are wrong, or an error of
    the command.
    """
    import errno
    import logging

    from cyclopts import CycloptsError

    from rtof_kin.cli.terminal import log_handler
    from rtof_kin.core.errors import InvalidInputError, RtofError, too_long

    _check_name(arguments)
    if arguments and arguments[0] in LIMITED:
        from rtof_kin.core.environment import keep_freed_memory, limit_threads

        limit_threads()
        keep_freed_memory()
    logging.basicConfig(level=logging.WARNING, handlers=[log_handler()])
    try:
        return int(app(arguments)(arguments) or 0)
    except CycloptsError as error:
        raise InvalidInputError(_sentence(error, arguments)) from error
    except ImportError as error:  # cyclopts wraps that of a command's module
        raise error.__cause__ if isinstance(error.__cause__, RtofError) else error  # noqa: B904
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        raise RtofError(too_long(error.filename)) from error
    except MemoryError as error:
        problem = f"not enough memory ({error})" if str(error) else "not enough memory"
        raise RtofError(f"{problem}; end other programs, or take a shorter recording") from error


def check(arguments: list[str]) -> None:
    """Check the arguments of a command without running it. `InvalidInputError`: they are wrong, or ask for help."""
    from cyclopts import CycloptsError

    from rtof_kin.core.errors import InvalidInputError

    _check_name(arguments)
    if {"--help", "-h", "--version"} & {*arguments}:
        raise InvalidInputError("asks for help only")
    try:
        app(arguments).parse_args(arguments)
    except CycloptsError as error:
        raise InvalidInputError(_sentence(error, arguments)) from error


def command_names() -> set[str]:
    """Return the names of all commands."""
    return {name for commands in COMMANDS.values() for name in commands}


def app(arguments: Sequence[str] = ()) -> App:
    """Return the application; a command's module is imported when the command is used.

    `arguments`: that it is for; without the name of a command the summary of each is at hand.
    """
    from cyclopts import App, Group

    import rtof_kin
    from rtof_kin.cli.terminal import err, out

    whole = App(
        name="rtof-kin",
        help="Human motion from one camera and a handful of IMUs. Everything stays on this machine. Start with: "
        "rtof-kin run --demo. Each command explains itself: rtof-kin reconstruct --help",
        help_format="plaintext",
        version=lambda: f"rtof-kin {rtof_kin.__version__}",
        version_flags="--version",
        group_commands=Group("options", sort_key=len(COMMANDS)),
        console=out,
        error_console=err,
        result_action="return_value",
        exit_on_error=False,
        print_error=False,
        suppress_keyboard_interrupt=False,
    )
    named = bool(arguments) and arguments[0] in command_names()
    for number, (purpose, commands) in enumerate(COMMANDS.items()):
        group = Group(purpose, sort_key=number)
        for order, (name, module) in enumerate(commands.items()):
            function = name.replace("-", "_")
            summary = None if named else _summary(module, function)
            path = f"rtof_kin.cli.{module}:{function}"
            whole.command(path, name=name, group=group, help=summary, sort_key=order)
    return whole


def _summary(module: str, function: str) -> str:
    """Return the first line of a command's docstring without importing its module."""
    import re
    from pathlib import Path

    text = Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")
    found = re.search(rf'^def {function}(?:_motion)?\(.*?"""(.+?)\.?["\n]', text, re.M | re.S)
    assert found, f"{module}: no command {function}"
    return found[1]


def _check_name(arguments: list[str]) -> None:
    """Raise an error with the present name of a command or option that an earlier version called otherwise."""
    from rtof_kin.core.errors import InvalidInputError

    if arguments and arguments[0] in OLD_COMMANDS:
        raise InvalidInputError(f"{arguments[0]}: is now rtof-kin {OLD_COMMANDS[arguments[0]]}")
    for option in (word.partition("=")[0] for word in arguments[1:]):
        if (now := OLD_OPTIONS.get((arguments[0], option))) is not None:
            raise InvalidInputError(f"{arguments[0]} {option}: is now {now}")


def _sentence(error: CycloptsError, arguments: list[str]) -> str:
    """Return what is wrong with the arguments in one sentence."""
    from cyclopts import MissingArgumentError, UnknownCommandError, UnusedCliTokensError

    text = " ".join(str(error).split())
    name = f"rtof-kin {arguments[0]}" if arguments and arguments[0] in command_names() else "rtof-kin"
    if isinstance(error, UnknownCommandError):
        text = text.partition(" Available commands")[0]
    elif isinstance(error, UnusedCliTokensError):
        text = f"unknown arguments: {' '.join(error.unused_tokens or ())}"
    elif isinstance(error, MissingArgumentError) and error.argument is not None:
        option = error.argument.name if error.argument.name.startswith("-") else error.argument.name.upper()
        given = any(word.partition("=")[0] in error.argument.names for word in arguments)
        text = f"{option} needs a value" if given else f"required: {option}"
    return f"{text} ({name} --help has all options)"
