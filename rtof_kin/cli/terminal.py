"""What every command shares: consoles, progress bars, tables, and how a command is declared."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from rtof_kin.core.files.manifest import MANIFEST

if TYPE_CHECKING:
    from rtof_kin.report.headline import Headline

# Units stand in square brackets, and paths may: nothing printed is markup.
out, err = Console(markup=False), Console(stderr=True, markup=False)
_STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
SCORE_COLUMNS = {
    "mpjpe_rr_mm": "relative\nto root\n[mm]",
    "mpjpe_mm": "absolute\n\n[mm]",
    "mpjae": "MPJAE\n\n[m/s2]",
    "mpjje": "MPJJE\n\n[m/s3]",
    "angle_deg": "joint\nangle\n[deg]",
    "flexion_deg": "flexion\n\n[deg]",
    "coverage": "valid",
}


def command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], int | None], summary: str, more: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}. {more}",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def add_output(parser: argparse.ArgumentParser, default: str | None, what: str, **how: Any) -> None:
    parser.add_argument(
        "-o", "--output", default=default, required=default is None, metavar="OUT", help=what, **how
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what an earlier run wrote there")


@contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """A bar for each stage, on the error stream."""
    columns = (
        TextColumn("{task.description:>5}", markup=False), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=err) as progress:
        tasks: dict[str, Any] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield tell


def with_zero_motion(recording: Any) -> dict[str, Any]:
    """The row of a predictor that never moves, by the same code as every other."""
    from rtof_kin.body.metrics import evaluate, motionless

    if recording.truth is None:
        return {}
    still = motionless(recording.truth)
    return {"zero motion": evaluate(still, recording.truth, recording.skeleton)}


def print_scores(scores: Mapping[str, Mapping[str, float]]) -> None:
    from rtof_kin.body.metrics import BEGUN_TOGETHER

    title = "error against the truth, mean over frames"
    first = Column("stage", no_wrap=True)
    table = Table(first, *SCORE_COLUMNS.values(), title=title, show_edge=False)  # fits in 80 columns
    for stage, metrics in scores.items():
        table.add_row(stage, *(figure_text(key, metrics[key]) for key in SCORE_COLUMNS))
    out.print(table)
    if "imu" in scores:
        out.print(BEGUN_TOGETHER)


def print_calibration(calibration: Any) -> None:
    """What was estimated, in one table."""
    table = Table("quantity", "of", "value", "+-", "before +-", "verdict", title="calibrated from itself")
    for row in calibration.table():
        table.add_row(*row)
    out.print(table)


def print_headline(headline: Headline, what: str = "") -> None:
    """The overall verdict in one line, and that of every section with its reasons."""
    out.print(f"{what}{headline.line}", style=_STYLES.get(headline.grade.value, ""), soft_wrap=True)
    table = Table("section", Column("verdict", no_wrap=True), "why", box=SIMPLE_HEAD, pad_edge=False)
    for verdict in headline.sections:
        grade = verdict.grade.value
        if verdict.section == "truth":
            continue  # see `print_scores`
        table.add_row(verdict.section, Text(grade, _STYLES.get(grade, "")), "\n".join(verdict.reasons))
    out.print(table)


@contextmanager
def doubts_in_headline() -> Iterator[None]:
    """Without the log's warnings of what `print_headline` says."""
    from rtof_kin.reconstruction.pipeline import WARNINGS_LOGGER

    logger = logging.getLogger(WARNINGS_LOGGER)
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = False


def figure_text(key: str, value: float | None) -> str:
    if value is None:
        return ""
    if key == "coverage":
        return f"{100 * value:.0f} %"
    return f"{value:.2f}" if key == "mpjae" else f"{value:.1f}"


def print_files(folder: str | Path) -> None:
    folder = Path(folder)
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    files.remove(MANIFEST)
    out.print(f"wrote {folder}: {', '.join(files)}", soft_wrap=True)
