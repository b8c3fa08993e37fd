"""Command line and processes of a study."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from rich.progress import track

from rtof_kin.core.jobs import memory

RESULTS = Path(__file__).parent / "results"
Job, Found = TypeVar("Job"), TypeVar("Found")


def study_parser(study: str, about: str | None, motion: bool = True, page: str = "{}.json") -> argparse.ArgumentParser:
    """Parser with what every study is told, the options ``--corpus`` and ``--out``.

    Args:
        study: its name for ``python -m benchmarks``. about: the docstring of its module.
        motion: whether it needs the folder of free motion. page: what it writes into results/, {}: its name.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {study}", description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if motion:
        parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    if page:
        parser.add_argument("--out", type=Path, default=RESULTS / page.format(study.replace(".", "_")))
    return parser


def rounded(value: Any, digits: int = 6) -> Any:
    """The same as JSON has it, with so many significant digits: plenty in a file."""
    return json.loads(json.dumps(value), parse_float=lambda text: float(f"{float(text):.{digits}g}"))


def table_head(headings: str) -> list[str]:
    """The first two lines of a Markdown table, of headings with `` | `` between."""
    return [f"| {headings} |", "|---" * (headings.count(" | ") + 1) + "|"]


def in_parallel(function: Callable[[Job], Found], jobs: Iterable[Job], workers: int = 2) -> list[Found]:
    """What a function returns for each job, in their order, of several processes with a bar of progress."""
    jobs = list(jobs)
    with ProcessPoolExecutor(workers) as pool:
        return list(track(pool.map(function, jobs), "recordings", len(jobs)))


def resident_memory(process: int) -> int:
    """The memory that a process has now, bytes; 0 where it is not known."""
    return memory._field(Path(f"/proc/{process}/status"), "VmRSS") or 0
