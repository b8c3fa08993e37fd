"""The estimator of live streams, measured: ``python -m benchmarks online STUDY --corpus DIR``.

* accuracy: error at lags from 0 to 1 s on the harness's motions, beside batch and a frame-by-frame baseline.
* speed: milliseconds a frame and memory over ten minutes on one core.
* soak: an hour with faults.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path
from tempfile import gettempdir
from types import ModuleType
from typing import Any

from benchmarks import harness
from benchmarks.command_line import rounded, study_parser
from benchmarks.online import accuracy, figure, soak, speed

STUDIES: dict[str, ModuleType] = {"accuracy": accuracy, "soak": soak, "speed": speed}


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    words = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(words)
    logging.disable(logging.WARNING)  # of the recordings, which are meant to be bad
    study = STUDIES[options.study]
    rows = study.rows_of(options)
    tables = study.tables(rows)
    out = options.out or harness.HERE / "results" / f"online_{options.study}.json"
    text = "\n".join(table.markdown() for table in tables)
    content = {"command": _command(words, options), "rows": rounded(rows)}
    harness.write_results(out, content, text.rstrip())
    _draw(options.study, rows, out.with_suffix(".png"))
    print(text)


def _draw(study: str, rows: list[dict[str, Any]], path: Path) -> None:
    if study == "accuracy":
        figure.error_against_lag(rows, path)
    elif study == "speed":
        figure.histogram(rows, path)


def _command(words: list[str], options: argparse.Namespace) -> str:
    return "python -m benchmarks online " + " ".join(words).replace(str(options.corpus), "DIR")


def _parser() -> argparse.ArgumentParser:
    parser = study_parser("online", __doc__, page="")
    parser.add_argument("study", choices=tuple(STUDIES))
    parser.add_argument("--subset", choices=("test", "validation"), default="test", help="of accuracy")
    parser.add_argument("--sensors", nargs="+", default=["8", "10"], choices=list(harness.SENSOR_SETS))
    parser.add_argument("--cameras", type=int, default=4, choices=range(1, 5), help="of each motion, in turn")
    parser.add_argument("--motions", help="names with commas between, or how many")
    parser.add_argument("--seconds", type=float, help="at most, of a motion; of the stream of speed")
    parser.add_argument("--hours", type=float, default=1.0, help="of the stream of soak")
    parser.add_argument("--person", default="02", help="of speed and soak")
    parser.add_argument("--rates", nargs="+", type=float, default=[60.0, 100.0], help="of the sensors, Hz, of speed")
    parser.add_argument("--lags", nargs="+", type=float, default=[0.0], help="s, of speed")
    parser.add_argument("--confidence", action="store_true", help="covariances too")
    parser.add_argument("--goals", action="store_true", help="of accuracy, only the lags with a goal")
    parser.add_argument("--keep", type=Path, help="folder for the poses of accuracy")
    parser.add_argument(
        "--work",
        type=Path,
        default=Path(gettempdir()) / "rtof_kin_online",
        help="folder of batch reconstructions, which are made once",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, help="JSON to write; tables and figure beside it")
    return parser


if __name__ == "__main__":
    main()
