"""Planted faults: how many are named in the first line, and whether bands cover those that are not.

``python -m benchmarks planted --corpus DIR [DIR]`` with the folder of free motion and the second collection
(see README.md): right recordings of people whom nothing was fitted on, then the first ``--motions`` of them
with every fault of `FAULTS` in every size. Judged is the line that a user reads first. Rows are written as
they come: an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.command_line import rounded, study_parser
from benchmarks.harness import write_results
from benchmarks.planted.faults import FAULTS, RIGHT
from benchmarks.planted.gross import GROSS
from benchmarks.planted.measuring import measured
from benchmarks.planted.recordings import Scene, scenes
from benchmarks.planted.tables import markdown, totals


def others(scene: Scene, known: Sequence[Scene]) -> dict[str, Scene]:
    """Other takes of the same person and of another one, with the sensors of a scene."""
    found: dict[str, Scene] = {}
    for one in known:
        if one.clip.name != scene.clip.name:
            same = one.clip.subject == scene.clip.subject
            other = Scene(one.clip, scene.sensors, scene.floor, scene.seed)
            found.setdefault("same person" if same else "another person", other)
    return found


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("planted", __doc__, motion=False)
    parser.add_argument("--corpus", type=Path, required=True, nargs="+", help="folders of motion")
    parser.add_argument("--faults", nargs="+", choices=[*RIGHT, *FAULTS, *GROSS], help="only these", metavar="NAME")
    parser.add_argument("--motions", type=int, default=8, help="recordings that faults are planted in")
    parser.add_argument("--right", type=int, help="recordings without one; all by default")
    parser.add_argument("--sensors", default="8,0,8,10", help="numbers of sensors, in turn")
    parser.add_argument("--calibrate", action="store_true", help="each recording from itself first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    options = parser.parse_args(arguments)
    known = scenes(options.corpus, options.sensors.split(","), options.seed)
    count = max(options.motions, len(known) if options.right is None else options.right)
    chosen, names = known[:count], options.faults or [*RIGHT, *FAULTS, *GROSS]
    own = [path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py"))]
    version = version_of(own, names, options.motions, options.calibrate, options.seed)
    kept = RowFile(options.out.with_suffix(".jsonl"), version, options.restart)
    right, work = [name for name in names if name in RIGHT], {}
    for i, scene in enumerate(chosen):
        given = names if i < options.motions else right
        work[scene.key] = partial(measured, scene, given, others(scene, known), options.calibrate)
    rows = kept.collect(work, options.workers)
    people = len({scene.clip.subject for scene in chosen})
    how = (
        f"`python -m benchmarks planted`: {len(chosen)} recordings of {people} people whom nothing was "
        f"fitted on, {min(options.motions, len(chosen))} of them with faults; {options.sensors} "
        "sensors in turn."
    )
    print(write_results(options.out, {"how": how, "totals": rounded(totals(rows), 4)}, markdown(rows, how)))


if __name__ == "__main__":
    main()
