"""Consoles, progress bars and tables of all commands."""

from __future__ import annotations

import logging
import math
import os
import signal
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from rtof_kin.core.errors import plain

if TYPE_CHECKING:
    from rtof_kin.calibration.result import SelfCalibration
    from rtof_kin.reporting.audit_results import Headline
    from rtof_kin.reporting.statistics import ReconstructionStatistics

# Units stand in square brackets, and paths may: nothing printed is markup.
out, err = Console(markup=False), Console(stderr=True, markup=False)
STYLES = {"pass": "green", "plausible": "cyan", "warn": "yellow", "fail": "bold red"}
"""Style of the terminal by verdict."""
SCORE_COLUMNS = {
    "mpjpe_rr_mm": "relative\nto root\n[mm]",
    "mpjpe_mm": "absolute\n\n[mm]",
    "mpjae": "MPJAE\n\n[m/s2]",
    "mpjje": "MPJJE\n\n[m/s3]",
    "angle_deg": "joint\nangle\n[deg]",
    "flexion_deg": "flexion\n\n[deg]",
    "coverage": "valid",
}
_LONG = 600.0  # [s] of jobs that the remaining time is estimated from
_MEAN_NORM = 1.596  # Mean norm of a normal error in three dimensions, in standard deviations of an axis


class _PlainFormatter(logging.Formatter):
    """One line without what a terminal would obey: messages are of other packages too."""

    def format(self, record: logging.LogRecord) -> str:
        return plain(super().format(record))


def log_handler() -> logging.Handler:
    """Return what prints log messages on the error stream."""
    handler = logging.StreamHandler()
    handler.setFormatter(_PlainFormatter("%(levelname)s: %(message)s"))
    return handler


@contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar for each stage on the error stream; yields a function of (stage, done, in all)."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description:>5}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err) as bars:
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield update


@contextmanager
def job_progress(what: str = "measuring") -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar over jobs with the time that remains, and a line for each that fails or is skipped; yields a function
    of (done, in all, last event).
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[last]}", markup=False),
    )
    bar = Progress(*columns, console=err, speed_estimate_period=_LONG)
    task = bar.add_task("jobs", total=None, last="")

    def update(done: int, total: int, last: str) -> None:
        bar.start()  # not before there are jobs: an error stands alone
        if " failed: " in last or " skipped: " in last:
            bar.console.print(last, soft_wrap=True)
            last = ""
        bar.update(task, completed=done, total=total, last=last)

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM (of a job scheduler, or the end of the system) and SIGHUP (a closed terminal) act as Ctrl-C
    once; signals that are ignored, as under nohup, stay so.
    """
    kinds = [kind for name in ("SIGTERM", "SIGHUP") if (kind := getattr(signal, name, None)) is not None]
    before = {kind: found for kind in kinds if (found := signal.getsignal(kind)) is not signal.SIG_IGN}

    def end(number: int, _: object) -> None:
        for kind in before:
            signal.signal(kind, signal.SIG_IGN)  # a terminal sends it twice
        if number != signal.SIGTERM:
            _leave_terminal()
        raise KeyboardInterrupt

    try:
        for kind in before:
            signal.signal(kind, end)
        yield
    finally:
        for kind, found in before.items():
            signal.signal(kind, found)


def _leave_terminal() -> None:
    """Print nowhere, where output went to a terminal: it is no more, and printing would fail."""
    for stream in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)


# --- what is printed -----------------------------------------------------------------------------


def say(text: object, style: str | None = None) -> None:
    """Print a sentence in one line, however wide the terminal is."""
    out.print(text, style=style, soft_wrap=True)


def remark(text: object, style: str | None = None) -> None:
    """Print a sentence on the error stream in one line."""
    err.print(text, style=style, soft_wrap=True)


def line(name: str, text: str, style: str = "") -> None:
    """Print a sentence behind its kind."""
    out.print(Text(f"{name:9} ", "bold"), Text(text, style), soft_wrap=True, sep="")


def print_summary(found: ReconstructionStatistics, headline: Headline, folder: str | Path) -> None:
    """Print a result in five lines: recording, accuracy, cautions, files, next command.

    `found`: statistics of what was exported to `folder`.
    """
    first = found.first
    long = f"{found.seconds:.1f} s" if found.seconds < 600 else f"{found.seconds / 60:.1f} min"
    source = f"{long} at {first.motion.poses.rate_hz:.0f} Hz"
    parts = ["one camera"] if first.keypoints is not None else []
    parts += [f"{len(first.bone_imus.joints)} IMUs"] if first.bone_imus is not None else []
    lines = {
        "recording": f"{first.recording.name}: {source}, {' and '.join(parts)}, mode {first.mode}; "
        f"subject {first.motion.skeleton.height:.2f} m tall",
        "accuracy": accuracy(found.metrics, found.mean_sigmas, first.mode),
        "caution": headline.line,
        "files": f"{folder}: {_files(folder)}",
        "next": f"rtof-kin report {folder} (one page for the browser); rtof-kin view {folder} (in 3D)",
    }
    for name, text in lines.items():
        style = STYLES.get(headline.grade.value, "") if name == "caution" else ""
        line(name, text, style)
        if name == "recording":
            for other in first.lifts:
                line("lift", str(other))


def accuracy(metrics: Mapping[str, float] | None, sigmas: tuple[float, float] | None, mode: str) -> str:
    """Return errors against the truth, else those expected by the covariances.

    `sigmas`: mean standard deviations per axis of the joints relative to the root and in world, m; NaN where unknown.
    None of a motion without covariances.
    """
    if (m := metrics) is not None:
        return (
            f"{m['mpjpe_rr_mm']:.1f} mm relative to the root, {m['mpjpe_mm']:.0f} mm absolute, flexion of "
            f"knees and elbows {m['flexion_deg']:.1f} deg (mean errors against the truth)"
        )
    if sigmas is None:
        return f"not estimated in mode {mode}; the recording has no truth to compare with"
    relative, world = (1000 * _MEAN_NORM * sigma for sigma in sigmas)
    if math.isnan(world):
        return "unknown: no fragment determines the pose, and the recording has no truth to compare with"
    return (
        f"expected {relative:.0f} mm relative to the root, {world:.0f} mm absolute (mean joint error by the "
        "estimated covariances; there is no truth to compare with)"
    )


def print_sections(headline: Headline) -> None:
    """Print the verdict of every section of the audit with its reasons."""
    from rtof_kin.reporting.document import Badge, Table, show_table

    rows = [
        (one.section, Badge(one.grade.value, one.grade.value), "\n".join(one.reasons))
        for one in headline.sections
        if one.section != "truth"  # see `print_scores`
    ]
    show_table(Table(("section", "verdict", "why"), rows), out)


def print_headline(headline: Headline, what: str = "") -> None:
    """Print the overall verdict in one line, and that of every section."""
    say(f"{what}{headline.line}", STYLES.get(headline.grade.value, ""))
    print_sections(headline)


def print_calibration(calibration: SelfCalibration) -> None:
    """Print every estimated quantity with its standard deviations."""
    from rtof_kin.reporting.document import Table, show_table

    columns = ("quantity", "of", "value", "+-", "prior +-", "verdict")
    show_table(Table(columns, calibration.table(), title="self-calibration"), out)


def with_zero_motion(recording: Any) -> dict[str, Any]:
    """Score a predictor that never moves by the same code; empty without truth. `recording`: with or without truth."""
    from rtof_kin.body.metrics import evaluate, zero_motion

    truth, skeleton = recording.streams.truth, recording.facts.skeleton
    return {} if truth is None else {"zero motion": evaluate(zero_motion(truth), truth, skeleton)}


def print_scores(scores: Mapping[str, Mapping[str, float]], of: str = "stage") -> None:
    """Print one row of errors for each stage, or joint.

    `scores`: stage -> figures of `SCORE_COLUMNS`, those that there are.
    """
    from rtof_kin.body.metrics import BEGUN_TOGETHER
    from rtof_kin.reporting.document import Table, show_table

    rows = [[name, *(_figure(key, scores[name].get(key)) for key in SCORE_COLUMNS)] for name in scores]
    title = "error against the truth, mean over frames" if of == "stage" else ""
    notes = (BEGUN_TOGETHER,) if "imu" in scores else ()
    show_table(Table((of, *SCORE_COLUMNS.values()), rows, title, notes), out)  # fits in 80 columns


def _figure(key: str, value: float | None) -> str:
    if value is None:
        return ""
    if key == "coverage":
        return f"{100 * value:.0f} %"
    return f"{value:.2f}" if key == "mpjae" else f"{value:.1f}"


def _files(folder: str | Path) -> str:
    """Files of a folder, and its subfolders with their number of files."""
    from rtof_kin.core.files.manifest import MANIFEST

    entries = sorted(path for path in Path(folder).iterdir() if path.name != MANIFEST)
    inner = {path: sum(one.is_file() for one in path.rglob("*")) for path in entries if path.is_dir()}
    files = [path.name for path in entries if path not in inner]
    return ", ".join([*files, *(f"{path.name}/ ({count})" for path, count in inner.items())])


def print_files(folder: str | Path) -> None:
    """Print the files of a folder."""
    say(f"wrote {folder}: {_files(folder)}")
