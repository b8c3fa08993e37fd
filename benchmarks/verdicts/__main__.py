"""Detection of bad frames by stated standard deviations and verdicts.

``python -m benchmarks verdicts --corpus DIR [--detector-errors FILE]``: the benchmark's people and
motions on other rigs, unchanged and with one planted fault, realistic 2D and 2D drawn from a model
fitted to a real detector, 0, 4, 8 and 10 sensors. Numbers are written as they come: an interrupted run
resumes where it stopped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.command_line import rounded, study_parser
from benchmarks.harness import write_results
from benchmarks.verdicts.measuring import Row, measured
from benchmarks.verdicts.recordings import SAMPLED, SIMULATED, Job, held_out_clips, jobs
from benchmarks.verdicts.tables import draw, tables
from rtof_kin.core.resources import model_path


def _measured(job: Job) -> list[Row]:
    return [measured(job)]


def write(rows: Sequence[Row], out: Path, facts: dict[str, Any]) -> str:
    """Write the tables, their numbers and the figure; the tables as Markdown."""
    failed = [f"{row['motion']}, {row['fault']}: {row['failed']}" for row in rows if "failed" in row]
    shown, numbers = tables([row for row in rows if "failed" not in row])
    title = "# Detection of bad frames by sigma and verdicts\n"
    text = "\n".join([title, facts["how"] + "\n", *(table.markdown() for table in shown)])
    if failed:
        text += "\n".join(["\nNot reconstructed:\n", *(f"- {line}" for line in failed)]) + "\n"
    content = rounded(facts | numbers | {"failed": failed}, 4)
    write_results(out, content, text.removesuffix("\n"))
    draw(numbers["curves"], out.with_suffix(".png"))
    return text


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
    kept = RowFile(options.out.with_suffix(".jsonl"), version, options.restart)
    rows = kept.collect({job.key: partial(_measured, job) for job in work}, options.workers)
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
