"""The commands bundle and reproduce: a study in one file without names, and its results computed again."""

from __future__ import annotations

import argparse
import hashlib
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtof_kin.cli.terminal import STYLES, add_output, command, out

if TYPE_CHECKING:
    from rtof_kin.batch.bundle_file import Bundle, Run
    from rtof_kin.batch.reproduction import Comparison

_CODES = {"EXACT": 0, "CLOSE": 3, "DIFFERENT": 1}
"""Exit codes of reproduce by agreement, the worst last."""
_STYLES = {"EXACT": "pass", "CLOSE": "warn", "DIFFERENT": "fail"}


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_bundle(commands)
    _add_reproduce(commands)


def _add_bundle(commands: Any) -> None:
    from rtof_kin.batch.bundle_file import LABELS

    parser = command(
        commands,
        "bundle",
        _bundle,
        "one file with recordings, settings and results, without names",
        "OUT is the output of reconstruct or run. FILE gets the numbers of its recording (keypoints, "
        "sensors, cameras, body), all that repeats the run, and the results, each with its SHA-256; rtof-kin "
        "reproduce computes them again. No video, names, notes, places, dates or paths are put in, and "
        "nothing is written if a search finds any. What is kept and left out is printed.",
    )
    parser.add_argument("outputs", nargs="+", type=Path, metavar="OUT", help="output folder")
    add_output(parser, None, "file to write, as study.rtof")
    parser.add_argument(
        "--recording",
        action="append",
        type=Path,
        default=[],
        metavar="FOLDER",
        help="recording of an OUT, or a folder of several, recognised by their contents; repeatable. "
        "Default: that of the output of run, or of the demo",
    )
    parser.add_argument(
        "--with",
        dest="files",
        action="append",
        type=Path,
        default=[],
        metavar="FILE",
        help="weights or calibration that a run was given, recognised by its contents; repeatable",
    )
    parser.add_argument(
        "--id",
        dest="ids",
        action="append",
        default=[],
        metavar="ID",
        help="pseudonym of the subject; once for each person, in the order of OUT; default: S01, S02, ...",
    )
    parser.add_argument("--keep", action="append", choices=LABELS, default=[], help="label that is kept; repeatable")
    parser.add_argument(
        "--forbid",
        action="append",
        default=[],
        metavar="WORD",
        help="further name that must not be in the file; repeatable",
    )
    parser.add_argument(
        "--allow", action="append", default=[], metavar="WORD", help="word that is harmless; repeatable"
    )
    parser.add_argument(
        "--redact", action="store_true", help="replace sentences that tell a name or path, in place of an error"
    )
    parser.add_argument("--verify", action="store_true", help="reproduce the file after it was written")


def _add_reproduce(commands: Any) -> None:
    parser = command(
        commands,
        "reproduce",
        _reproduce,
        "verify a bundle and compute its results again",
        "Compares the SHA-256 of every member first, then reconstructs each recording with the settings of "
        "the bundle and compares the motion bit by bit. Exit code 0: bit by bit; 3: within 1 mm and 0.1 "
        "deg; 1: not reproduced; 2: damaged or no bundle. Nothing in the file is executed.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="of rtof-kin bundle")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT",
        help="folder for the contents and, in reproduced/, the new results; default: nothing is kept",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what an earlier run wrote there")
    parser.add_argument("--check-only", action="store_true", help="compare the SHA-256 only")
    parser.add_argument("--threads", type=int, metavar="N", help="of numerical libraries; default: as in the bundle")


# --- bundle --------------------------------------------------------------------------------------


def _bundle(options: argparse.Namespace) -> int:
    from rtof_kin.batch.bundle import Choice, write_bundle
    from rtof_kin.batch.recordings import find_recordings

    path = Path(options.output)
    folders = [entry.folder for source in options.recording for entry in find_recordings(source, path)]
    choice = Choice(
        tuple(options.ids), tuple(options.keep), tuple(options.forbid), tuple(options.allow), options.redact
    )
    bundle = write_bundle(path, options.outputs, folders, options.files, choice, options.overwrite)
    _print_contents(path, bundle)
    if options.verify:
        options.file, options.output, options.threads, options.check_only = path, None, None, False
        return _reproduce(options)
    out.print(f"next      rtof-kin reproduce {path}", soft_wrap=True)
    return 0


def _print_contents(path: Path, bundle: Bundle) -> None:
    what = f"{_count(bundle)}, {path.stat().st_size / 1e6:.1f} MB"
    out.print(
        f"wrote {path}: {what}, without names, dates or paths as far as they are known",
        soft_wrap=True,
        style=STYLES["pass"],
    )
    out.print(f"SHA-256   {_sha256(path)}")
    for title, lines in (("kept", bundle.kept), ("left out", bundle.left_out)):
        for number, line in enumerate(lines):
            out.print(f"{'' if number else title:9} {line}", soft_wrap=True)
    out.print(
        "caution   body proportions and the way of moving may identify a person without a name: it is still "
        "data of a person",
        style=STYLES["warn"],
        soft_wrap=True,
    )


def _count(bundle: Bundle) -> str:
    recordings, runs = len({run.recording for run in bundle.runs}), len(bundle.runs)
    return f"{recordings} recording{'s' * (recordings != 1)} and {runs} result{'s' * (runs != 1)}"


# --- reproduce -----------------------------------------------------------------------------------


def _reproduce(options: argparse.Namespace) -> int:
    from rtof_kin.batch.bundle_file import MANIFEST, read_bundle
    from rtof_kin.core.environment import limit_threads
    from rtof_kin.core.files.folder import new_folder

    path = options.file
    with ExitStack() as stack:
        if options.output is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtof_kin_")))
        else:
            folder = stack.enter_context(new_folder(options.output, MANIFEST, options.overwrite))
        bundle = read_bundle(path, folder)
        (folder / MANIFEST).write_text(bundle.text(), encoding="utf-8")
        intact = f"{path}: intact, {len(bundle.sha256)} members as bundled ({_count(bundle)})"
        if options.check_only:
            out.print(intact, style=STYLES["pass"], soft_wrap=True)
            out.print(f"SHA-256   {_sha256(path)}")
            return 0
        limit_threads(_threads(bundle) if options.threads is None else options.threads)
        found = [_again(run, folder, folder / "reproduced" / str(i)) for i, run in enumerate(bundle.runs, 1)]
        _print_comparisons(intact, bundle.runs, found)
    out.print(f"SHA-256   {_sha256(path)}")
    if options.output is not None:
        out.print(f"wrote {options.output}: recordings/, results/ and reproduced/", soft_wrap=True)
    return _CODES[_worst(found)[0].agreement.name]


def _threads(bundle: Bundle) -> int | None:
    """Return the number of threads of the first run; None where it is unknown, or NumPy is there already."""
    import sys

    text = bundle.runs[0].record["environment"].get("threads", "") if bundle.runs else ""
    return int(text) if text.isdecimal() and 0 < int(text) <= 256 and "numpy" not in sys.modules else None


def _again(run: Run, folder: Path, output: Path) -> tuple[Comparison, list[str]]:
    """Reconstruct a recording of a bundle as it was, and compare; also what differs from then."""
    from rtof_kin.batch.reproduction import compare_results
    from rtof_kin.cli.recordings import opened, reconstruct_and_export
    from rtof_kin.core.environment import differences
    from rtof_kin.core.files.text import load_json

    options = _options_of(run, folder, output)
    then = run.record["environment"]
    with _evaluated_as(then), opened(folder / run.recording) as recording:
        reconstruct_and_export(recording, options.mode, options)
    record = load_json(output / "summary.json")["run"]
    causes = differences(then, record["environment"])
    for name, what in (("model_sha256", "weights"), ("recording_sha256", "recording")):
        if record[name] != run.record.get(name):
            causes.append(f"{what} {str(run.record.get(name))[:8]} -> {record[name][:8]}")
    return compare_results(folder / run.result, output), causes


def _options_of(run: Run, folder: Path, output: Path) -> argparse.Namespace:
    """Return the options of `reconstruct` that repeat a run.

    Raises:
        InvalidInputError: one of them is unknown to this version.
    """
    from rtof_kin.cli import parse
    from rtof_kin.cli.recordings import REPEATED
    from rtof_kin.core.errors import InvalidInputError

    options = parse(["reconstruct", str(folder / run.recording), "-o", str(output), "--no-figures"])
    given = dict(run.record["options"])
    if unknown := sorted({*given} - {"mode", *REPEATED}):
        raise InvalidInputError(f"the bundle has the option {unknown[0]!r}, unknown here; use a newer version")
    checks: dict[str, Any] = {
        "frames": lambda v: isinstance(v, int) and not isinstance(v, bool) and 2 <= v <= 10_000,
        "guards": lambda v: isinstance(v, list) and all(isinstance(one, str) for one in v),
        **dict.fromkeys(("paper", "lift_with_sensors", "calibrate"), lambda v: isinstance(v, bool)),
        **dict.fromkeys(("space", "backend", "mode"), lambda v: v is None or isinstance(v, str)),
    }
    for name, value in given.items():
        if not checks[name](value):
            raise InvalidInputError(f"the bundle has the option {name} = {str(value)[:40]!r}, which cannot be")
        setattr(options, name, tuple(value) if name == "guards" else value)
    if "model" in run.files:
        options.model = folder / run.files["model"]
    else:
        options.model = _shipped(run.record.get("model_sha256"))
    if "calibration" in run.files:
        options.calibration = str(folder / run.files["calibration"])
    return options


def _shipped(sha256: object) -> str | None:
    """Return the name of the shipped weights with this SHA-256; None for the default ones."""
    from rtof_kin.core.files.manifest import file_digest
    from rtof_kin.core.resources import LIFTERS, model_path

    return next((name for name, file in LIFTERS.items() if file_digest(model_path(file)) == sha256), None)


@contextmanager
def _evaluated_as(environment: Mapping[str, str]) -> Iterator[None]:
    """Interpret the energy if it was interpreted in the bundle's run."""
    from rtof_kin.core.numerics.c_compiler import SWITCH

    before = os.environ.get(SWITCH)
    if environment.get("energy") == "interpreted":
        os.environ[SWITCH] = "never"
    try:
        yield
    finally:
        os.environ.pop(SWITCH, None)
        if before is not None:
            os.environ[SWITCH] = before


def _worst(found: Sequence[tuple[Comparison, list[str]]]) -> tuple[Comparison, list[str]]:
    return max(found, key=lambda pair: [*_CODES].index(pair[0].agreement.name))


def _print_comparisons(intact: str, runs: Sequence[Run], found: Sequence[tuple[Comparison, list[str]]]) -> None:
    """Print the worst verdict first, then that of every run."""
    worst, causes = _worst(found)
    out.print(worst.sentence(causes), style=STYLES[_STYLES[worst.agreement.name]], soft_wrap=True)
    out.print(intact, soft_wrap=True)
    for run, (one, causes) in zip(runs, found, strict=True):
        mode = run.record["options"].get("mode")
        out.print(
            f"{run.result} of {run.recording}, mode {mode}, {one.frames} frames: {one.agreement.value}", soft_wrap=True
        )
        for name in one.arrays:
            out.print(f"  differs: {name}")
        for cause in causes:
            out.print(f"  other than in the bundle: {cause}", soft_wrap=True)


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
