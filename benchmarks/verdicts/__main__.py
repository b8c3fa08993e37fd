"""Detection of bad frames by stated standard deviations and verdicts.

``python -m benchmarks verdicts --corpus DIR [--detector-errors FILE]``: the benchmark's people and
motions on other rigs, unchanged and with one planted fault, realistic 2D and 2D drawn from a model
fitted to a real detector, 0, 4, 8 and 10 sensors. Numbers are written as they come: an interrupted run
resumes where it stopped.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from rich.progress import Progress

from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.command_line import study_parser
from benchmarks.verdicts.measuring import Row, measured
from benchmarks.verdicts.recordings import SAMPLED, SIMULATED, Job, held_out_clips, jobs
from benchmarks.verdicts.tables import draw, tables
from rtof_kin.core.errors import RtofError
from rtof_kin.core.resources import model_path


def collected(work: Sequence[Job], kept: RowFile, workers: int) -> list[Row]:
    """Rows of all jobs in their order; those done earlier are taken from the file."""
    left = [job for job in work if job.key not in kept.rows]
    with Progress() as progress, ProcessPoolExecutor(workers) as pool:
        task = progress.add_task("recordings", total=len(work), completed=len(work) - len(left))
        futures = {pool.submit(measured, job): job for job in left}
        try:
            for future in as_completed(futures):
                kept.add(futures[future].key, [future.result()])
                progress.advance(task)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [row for job in work for row in kept.rows[job.key]]


def write(rows: Sequence[Row], out: Path, facts: dict[str, Any]) -> str:
    """Write the tables, their numbers and the figure; the tables as Markdown."""
    failed = [f"{row['motion']}, {row['fault']}: {row['failed']}" for row in rows if "failed" in row]
    shown, numbers = tables([row for row in rows if "failed" not in row])
    text = "\n".join(
        [
            "# Detection of bad frames by sigma and verdicts\n",
            facts["how"] + "\n",
            *(table.markdown() for table in shown),
        ]
    )
    if failed:
        text += "\n".join(["\nNot reconstructed:\n", *(f"- {line}" for line in failed)]) + "\n"
    content = json.loads(json.dumps(facts | numbers | {"failed": failed}), parse_float=_rounded)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    out.with_suffix(".md").write_text(text, encoding="utf-8")
    draw(numbers["curves"], out.with_suffix(".png"))
    return text


def _rounded(text: str) -> float:
    return float(f"{float(text):.4g}")


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("verdicts", __doc__)
    parser.add_argument("--detector-errors", type=Path, help="Python file, sampler of real 2D errors")
    parser.add_argument("--cameras", type=int, default=1, choices=range(1, 5))
    parser.add_argument("--motions", type=int, help="only so many, evenly chosen")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    options = parser.parse_args(arguments)
    clips = held_out_clips(options.corpus)
    if options.motions is not None:
        clips = [clips[i * len(clips) // options.motions] for i in range(options.motions)]
    kinds = (SIMULATED, SAMPLED) if options.detector_errors else (SIMULATED,)
    work = jobs(clips, kinds, options.seed, options.detector_errors, options.cameras)
    own = [path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py"))]
    keys = [job.key for job in work]
    own.append(model_path("confidence.toml").read_text(encoding="utf-8"))
    version = version_of(own, keys, options.seed)
    try:
        kept = RowFile(options.out.with_suffix(".jsonl"), version, options.restart)
    except RtofError as error:
        sys.exit(f"error: {error}")
    rows = collected(work, kept, options.workers)
    people = len({job.clip.subject for job in work})
    how = (
        f"`python -m benchmarks verdicts`: {len(clips)} motions of {people} people whom the confidence "
        f"was not fitted on, {len(work)} recordings, half of them with a planted fault; 2D "
        f"{' and '.join(kinds)}; 0, 4, 8 and 10 sensors, calibrated from themselves."
    )
    print(write(rows, options.out, {"how": how, "version": version, "seed": options.seed}))
    kept.path.unlink()


if __name__ == "__main__":
    main()
