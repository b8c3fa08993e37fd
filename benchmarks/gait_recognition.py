"""Recognition of walking: ``python -m benchmarks gait_recognition --corpus DIR``.

DIR is the folder of free motion (see README.md here). Every motion of the people of split.toml is judged by
`rtof_kin.clinical.gait`, once with its feet and once by its ankles alone, as in recordings
without sensors on the feet. What it is follows from its description in index.csv; walking is judged again
with its mean velocity subtracted, as on a treadmill. Limits were chosen on the people who train and on
validation. After a look at held-out people (test), one more condition, of walking in place, was added: the
reconstruction of a dance (`range_bands`) had passed. Two minutes of one core.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.command_line import study_parser
from benchmarks.harness import split, write_results
from rtof_kin.body.observability import ObservationMasks
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.gait import analyse_gait
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.paths import PathCollector
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap import MocapClip, read_corpus

PARTLY: Final = re.compile("navigate|start walk stop|forward dribble|zombie", re.IGNORECASE)
"""Descriptions of motions that are walking for a part of their time, or of a kind of their own."""
TREADMILL: Final = "walking on a treadmill"
KINDS: Final = ("walking", TREADMILL, "partly walking", "anything else")
FEET: Final = ("feet", "ankles")
PARTS: Final = {
    "test": "held-out people and rigs",
    "training": "people on whom limits were chosen",
    "validation": "limits were chosen on them too",
}
LEAST_SECONDS: Final = 1.0
"""[s] a shorter piece has no complete stride of walking."""


def kind_of(clip: MocapClip, action: str) -> str:
    """What a motion is by its description, one of `KINDS`."""
    if PARTLY.search(action) or PARTLY.search(clip.name):
        return "partly walking"
    return "walking" if re.search("walk", action, re.IGNORECASE) else "anything else"


def observed(clip: MocapClip, skeleton: SkeletonModel, feet: str) -> PoseSequence:
    """The poses of a motion, all observed but for the orientation of the feet if only ankles are wanted."""
    seen = np.ones(len(clip.poses.names), dtype=np.bool_)
    if feet == "ankles":
        seen[skeleton.index("RightFoot", "LeftFoot")] = False
    return replace(all_observed(clip.poses), orientation_observed=seen)


def on_treadmill(poses: PoseSequence) -> PoseSequence:
    """The poses without the mean velocity of the root."""
    path = poses.p_world_joint[:, 0, :2]
    way = np.zeros((len(poses), 1, 3))
    for axis in range(2):
        line = np.polynomial.Polynomial.fit(poses.times, path[:, axis], 1)
        way[:, 0, axis] = line(poses.times) - line(0.0)
    return poses.with_poses(slice(None), poses.p_world_joint - way)


def judged(corpus: Path) -> Iterator[dict[str, Any]]:
    """One row for every motion, with feet and by ankles."""
    with (corpus / "index.csv").open(encoding="utf-8") as stream:
        actions = {Path(row["file"]).stem: row["action"] for row in csv.DictReader(stream)}
    rows = split()
    parts = {subject: part for part in ("test", "validation") for subject in rows[part]}
    for clip in read_corpus(corpus, output_rate_hz=60.0):
        seconds = float(clip.poses.times[-1])
        action = actions.get(clip.name.split("[")[0], "")
        if seconds < LEAST_SECONDS or "GLITCH" in clip.quality:
            continue
        skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
        about = {
            "motion": clip.name,
            "subject": clip.subject,
            "part": parts.get(clip.subject, "training"),
            "action": action,
            "seconds": seconds,
        }
        kind = kind_of(clip, action)
        for feet in FEET:
            poses = observed(clip, skeleton, feet)
            yield about | {"kind": kind, "feet": feet} | verdict_on(poses, skeleton)
            if kind == KINDS[0]:
                yield about | {"kind": TREADMILL, "feet": feet} | verdict_on(on_treadmill(poses), skeleton)


def verdict_on(poses: PoseSequence, skeleton: SkeletonModel) -> dict[str, Any]:
    """Strides and verdict of one motion."""
    paths = PathCollector(skeleton, poses.times)
    paths.add(slice(None), poses, slice(None))
    gait = analyse_gait(gait_events(paths.paths(ObservationMasks.of_poses(poses, skeleton))))
    return {
        "strides": len(gait.strides),
        "walking": len(gait.verdict.walking),
        "gait": gait.is_gait,
        "on_the_spot": gait.verdict.on_the_spot,
        "why_not": gait.why_not,
    }


def outcome(row: dict[str, Any]) -> str:
    """Verdict in one of three columns."""
    if row["gait"]:
        return "gait"
    short = row["why_not"].startswith("Only ")
    return "too few strides" if short else "no gait"


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Confusion tables by part and feet, and the motions that are judged against their description."""
    columns = ("gait", "too few strides", "no gait")
    lines = ["# Recognition of walking", "", "Made by `python -m benchmarks gait_recognition --corpus DIR`."]
    for part, about in PARTS.items():
        lines += ["", f"## {part.title()}: {about}", ""]
        lines += [f"| | motions | {' | '.join(columns)} | strides found | of walking |", "|---" * 7 + "|"]
        for feet in FEET:
            for kind in KINDS:
                own = [r for r in rows if (r["part"], r["feet"], r["kind"]) == (part, feet, kind)]
                counts = [sum(outcome(row) == column for row in own) for column in columns]
                strides = [sum(row[name] for row in own) for name in ("strides", "walking")]
                figures = " | ".join(map(str, (len(own), *counts, *strides)))
                lines.append(f"| {kind}, by {feet} | {figures} |")
    lines += ["", "## Against their description", ""]
    lines += [
        f"- {row['part']}: {row['motion']} ({row['action']}), {row['kind']}, by {row['feet']}: "
        f"{row['why_not'] or 'gait'}"
        for row in rows
        if (row["kind"] in (KINDS[0], TREADMILL) and outcome(row) == "no gait")
        or (row["kind"] == "anything else" and row["gait"])
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge the corpus and write the tables."""
    parser = study_parser("gait_recognition", __doc__)
    options = parser.parse_args(arguments)
    rows = list(judged(options.corpus))
    print(write_results(options.out, rows, tables(rows)))


if __name__ == "__main__":
    main()
