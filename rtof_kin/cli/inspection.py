"""The command inspect: identify files and check their contents by physics."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.table import Column, Table
from rich.text import Text

from rtof_kin.cli.terminal import command, out

_FAILED = 1


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "inspect",
        _inspect,
        "identify files and check their contents by physics",
        "FILE is a sensor log or a folder of one, a recording, a motion, motion capture, markers, "
        "cameras or a detector's keypoints. Every check is printed with its figure and limit; where a "
        "declaration is wrong, the likely right one is named as the option to add. Of a recording with "
        "calibrated sensors, those that are on another segment than declared are named, and --fix writes "
        "the corrected recording. Exit code 1: a check does not hold.",
    )
    parser.add_argument("files", metavar="FILE", nargs="+", help="files or folders")
    parser.add_argument(
        "--declare",
        metavar="FIELD=VALUE",
        nargs="+",
        default=[],
        type=_declaration,
        help="units and conventions of a sensor log, e.g. acceleration_unit=g gravity=removed",
    )
    parser.add_argument("--all", action="store_true", help="figures of every sensor and bone")
    parser.add_argument(
        "--fix",
        action="store_true",
        help="correct the segments of sensors that are elsewhere; of one recording, with -o",
    )
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, help="new folder for --fix")
    parser.add_argument("--plot", metavar="PNG", type=Path, help="draw what looks wrong; of one FILE")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier PNG")
    parser.add_argument(
        "--schema", action=_PrintSchema, nargs=0, help="print the path of the JSON Schema of recording.toml and exit"
    )


class _PrintSchema(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from rtof_kin.recording.tables import SCHEMA

        out.print(SCHEMA, soft_wrap=True)
        parser.exit()


def _declaration(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"{text!r} is not FIELD=VALUE, such as acceleration_unit=g")
    return name, value


def _inspect(options: argparse.Namespace) -> int:
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.reporting.inspection import inspect

    if options.plot is not None:
        if len(options.files) > 1:
            raise InvalidInputError(f"--plot draws one FILE, {len(options.files)} are named")
        if options.plot.suffix.lower() != ".png":
            raise InvalidInputError(f"--plot {options.plot}: give the picture a name that ends in .png")
        check_new_file(options.plot, options.overwrite)
    if options.fix != (options.out is not None) or (options.fix and len(options.files) > 1):
        raise InvalidInputError("--fix corrects one recording and needs a new folder for it: --fix -o OUT")
    declared: dict[str, Any] = dict(options.declare)
    if "rate_hz" in declared:
        declared["rate_hz"] = _number(declared["rate_hz"])
    failed = False
    for file in options.files:
        found, corrected = _with_places(inspect(file, **declared))
        _print(found, options.all)
        if options.fix:
            _fix(found, corrected, options.out)
        if options.plot is not None:
            _draw(found, options.plot, options.overwrite)
        failed |= bool(found.failed)
    return _FAILED if failed else 0


def _with_places(found: Any) -> tuple[Any, Any]:
    """Add the check of where a recording's sensors are; with the corrected recording, if any is wrong."""
    from dataclasses import replace

    from rtof_kin.calibration.assignment import NAME
    from rtof_kin.core.checks import Check
    from rtof_kin.core.errors import RtofError
    from rtof_kin.reconstruction.checks.sensors import check_recording
    from rtof_kin.recording.recording import Recording

    if found.title != "recording" or found.log is None:
        return found, None
    recording = Recording.load(found.path)
    if recording.calibration is None:
        return found, None
    try:
        places, corrected = check_recording(recording)
    except RtofError as error:
        check = Check.unknown(NAME, "sensors", "", str(error))
        return replace(found, checks=(*found.checks, check)), None
    notes = (f"sensors: {places.doubt}",) if places.doubt else ()
    found = replace(found, checks=(*found.checks, places.check()), notes=(*found.notes, *notes))
    return found, corrected if places.wrong else None


def _fix(found: Any, corrected: Any, target: Path) -> None:
    from rtof_kin.core.errors import InvalidInputError

    if found.title != "recording":
        raise InvalidInputError(f"--fix: {found.path} is a {found.title}; only recordings are corrected")
    if corrected is None:
        text = "no sensor is found elsewhere: there is nothing to correct, and nothing was written"
        out.print(text, soft_wrap=True)
        return
    corrected.save(target)
    places = zip(corrected.calibration.sensors, corrected.calibration.joints, strict=True)
    out.print(f"wrote {target}: {', '.join(f'{sensor} on {joint}' for sensor, joint in places)}", soft_wrap=True)


def _number(text: str) -> float:
    from rtof_kin.core.errors import InvalidInputError

    try:
        return float(text)
    except ValueError as error:
        raise InvalidInputError(f"rate_hz: {text!r} is not a number of samples per second") from error


def _print(found: Any, every: bool) -> None:
    out.print(f"\n{found.path}: {found.title}", style="bold", soft_wrap=True)
    contents = Table(Column(overflow="fold"), Column(overflow="fold"), show_header=False)
    for name, value in found.contents:
        contents.add_row(name, value)
    out.print(contents)
    for note in found.notes:
        out.print(f"note: {note}", soft_wrap=True)
    shown = list(found.checks) if every else _worst(found.checks)
    if shown:
        out.print(_checks_table(shown, found.checks), crop=False)
    for check in shown:
        if check.failed:
            text = f"{check.subject}: {check.name}. {check.advice}"
            out.print(text, soft_wrap=True)
    likely = {tuple(check.likely.items()) for check in found.failed if check.likely}
    if likely:
        pairs = sorted({f"{name}={value}" for one in likely for name, value in one})
        options = " ".join(map(shlex.quote, pairs))
        out.print(f"likely: --declare {options}", style="bold", soft_wrap=True)


def _worst(checks: Any) -> list[Any]:
    """Of checks of the same name, the one that failed most or comes nearest to it."""
    worst: dict[str, Any] = {}
    for check in checks:
        if check.name not in worst or _nearness(check) > _nearness(worst[check.name]):
            worst[check.name] = check
    return list(worst.values())


def _nearness(check: Any) -> float:
    return -1.0 if math.isnan(check.value) else float(check.value / check.limit)


def _checks_table(shown: list[Any], checks: Any) -> Table:
    """A row for each check shown; its texts are wrapped where there is little room, and never cut."""
    names = (Column(name, overflow="fold") for name in ("check", "figure"))
    table = Table(Column("verdict", no_wrap=True), *names, box=SIMPLE)
    for check in shown:
        verdict = Text(check.verdict.value, style="bold red" if check.failed else "")
        table.add_row(verdict, check.name, _figure(check, shown, checks))
    return table


def _figure(check: Any, shown: list[Any], checks: Any) -> str:
    """Value and limit, or why there are none; of the worst of several, for how many the check holds."""
    if math.isnan(check.value):
        return f"{check.subject}: {check.advice}"
    text = f"{check.value:.3g} {check.unit}".rstrip() + f", limit {check.limit:.3g}"
    alike = [other for other in checks if other.name == check.name]
    if len(alike) == 1 or len(shown) == len(checks):
        return f"{text}; {check.subject}"
    holding = sum(other.passed for other in alike)
    return f"{text}; worst is {check.subject}, {holding} of {len(alike)} hold"


def _draw(found: Any, target: Path, overwrite: bool) -> None:
    from rtof_kin.core.files.folder import new_file
    from rtof_kin.core.packages import optional

    canvas = optional("matplotlib.backends.backend_agg", "figures", "a picture")
    from rtof_kin.reporting.inspection import picture

    figure = picture(found)
    if figure is None:
        out.print("nothing of this file can be drawn")
        return
    canvas.FigureCanvasAgg(figure)
    with new_file(target, overwrite) as whole:
        figure.savefig(whole)
    out.print(f"wrote {target}", soft_wrap=True)
