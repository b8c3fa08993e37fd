"""Recognition of walking: ``python -m benchmarks.gait_recognition --corpus DIR``.

DIR is the folder of free motion (see README.md here). Every motion of the people of split.toml is judged by
`rtof_kin.clinical.gait_recognition`, once with its feet and once by its ankles alone, as in recordings
without sensors on the feet. What it is follows from its description in index.csv. Limits were chosen on the
people who train and on validation; the tables of held-out people (test) were made once, after that.
Two minutes of one core.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.harness import HERE, split, write_results
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.gait import analyse_gait
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap import MocapClip, read_corpus

PARTLY: Final = re.compile("navigate|start walk stop|forward dribble|zombie", re.IGNORECASE)
"""Descriptions of motions that are walking for a part of their time, or of a kind of their own."""
KINDS: Final = ("walking", "partly walking", "anything else")
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


def judged(corpus: Path) -> Iterator[dict[str, Any]]:
    """One row for every motion, with feet and by ankles."""
    with (corpus / "index.csv").open(encoding="utf-8") as stream:
        actions = {Path(row["file"]).stem: row["action"] for row in csv.DictReader(stream)}
    rows = split()
    parts = {subject: part for part in ("test", "validation") for subject in rows[part]}
    for clip in read_corpus(corpus, output_rate_hz=60.0):
        seconds = float(clip.poses.times[-1])
        action = actions.get(clip.name.split("[")[0], "")
        skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
        for feet in FEET if seconds >= LEAST_SECONDS and "GLITCH" not in clip.quality else ():
            gait = analyse_gait(gait_events(observed(clip, skeleton, feet), skeleton))
            yield {
                "motion": clip.name, "subject": clip.subject, "part": parts.get(clip.subject, "training"),
                "action": action, "kind": kind_of(clip, action), "feet": feet, "seconds": seconds,
                "strides": len(gait.strides), "walking": len(gait.verdict.walking), "gait": gait.is_gait,
                "on_the_spot": gait.verdict.on_the_spot, "why_not": gait.why_not,
            }  # fmt: skip


def outcome(row: dict[str, Any]) -> str:
    """Verdict in one of three columns."""
    if row["gait"]:
        return "gait"
    short = row["why_not"].startswith("Only ")
    return "too few strides" if short else "no gait"


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Confusion tables by part and feet, and the motions that are judged against their description."""
    columns = ("gait", "too few strides", "no gait")
    lines = ["# Recognition of walking", "", "Made by `python -m benchmarks.gait_recognition --corpus DIR`."]
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
        f"- {row['part']}: {row['motion']} ({row['action']}), by {row['feet']}: {row['why_not'] or 'gait'}"
        for row in rows
        if (row["kind"] == "walking" and outcome(row) == "no gait")
        or (row["kind"] == "anything else" and row["gait"])
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge the corpus and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--corpus", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "gait_recognition.json")
    options = parser.parse_args(arguments)
    rows = list(judged(options.corpus))
    text = tables(rows)
    write_results(options.out, rows, text)
    print(text)


if __name__ == "__main__":
    main()
