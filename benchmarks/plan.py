"""Errors that a plan expects, against those that held-out people get.

``python -m benchmarks plan --corpus DIR [--split test]`` with DIR the folder of free motion (README.md).
*The same movement*: each motion of the people and rigs that nothing was learned from is planned on the
package's own body, and recorded of the person with the person's own body, by one of the benchmark's four
cameras, with 0, 4, 8 and 10 sensors. *Gait from the library*: the library's gait, of other people, is planned
with the place of the camera alone, and the walking of the held-out people is recorded. Plan and recordings
have different seeds. By angle, over all motions: root mean squares of the standard deviations expected and
of the errors achieved, Spearman's correlation over angles, and the mean of their ratios.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from benchmarks import harness
from benchmarks.command_line import in_parallel, study_parser, table_head
from benchmarks.rerigged import rerigged
from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import shared_frames
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.movements import movement
from rtof_kin.plan.prediction import SETTINGS, Run, angles_and_errors, measure
from rtof_kin.plan.protocol import place_of
from rtof_kin.plan.setup import Setup
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import low_passed, standard_cameras

SENSORS = ("0", "4", "8", "10")
SECONDS = 6.0
PLANNED_SEED, RECORDED_SEED = 7000, 3
FEWEST = 3
"""Motions in which an angle must be observed."""


@dataclass(frozen=True)
class Case:
    """A motion, a camera and a set of sensors."""

    clip: MocapClip
    camera: int
    sensors: str
    library: bool
    """Whether the library's gait is planned, else the same movement."""


def on_our_body(clip: MocapClip) -> tuple[PoseSequence, SkeletonModel]:
    """The movement of a clip on the package's body of the same size."""
    default = SkeletonModel.default()
    size = np.linalg.norm(clip.joint_offsets, axis=1).sum() / np.linalg.norm(default.joint_offsets, axis=1).sum()
    skeleton = default.with_offsets(size * default.joint_offsets)
    source, ours = (shared_frames(skeleton.names, o) for o in (clip.joint_offsets, skeleton.joint_offsets))
    R = clip.poses.R_world_bone @ source @ np.swapaxes(ours, -1, -2)
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, clip.poses.p_world_joint[:, 0], R)
    return replace(clip.poses, p_world_joint=p, R_world_bone=R), skeleton


def run(case: Case) -> list[dict[str, Any]]:
    """Mean squares by angle: expected and achieved, where the recording observes the angle."""
    logging.disable(logging.WARNING)
    clip, sensors = case.clip, harness.SENSOR_SETS.get(case.sensors, ())
    recording = harness.recorded(clip, case.camera, "realistic", sensors, RECORDED_SEED)
    result = reconstruct(recording, mode="rtof" if sensors else "rto", settings=SETTINGS, calibrate=False)
    found, off = angles_and_errors(result)
    setup = _planned(case, recording.video.camera, sensors)
    arrays = measure(Run(setup, PLANNED_SEED)).arrays
    rows = []
    for a, name in enumerate(found.names):
        known = found.known[:, a] & np.isfinite(off[:, a])
        if known.mean() >= 0.5 and arrays["known"][a] >= 0.5 * arrays["frames"][a]:
            rows.append(
                {
                    "plan": "library" if case.library else "same",
                    "sensors": case.sensors,
                    "angle": name,
                    "motion": clip.name,
                    "subject": clip.subject,
                    "rig": clip.rig,
                    "expected": float(arrays["variance"][a] / arrays["known"][a]),
                    "simulated": float(arrays["square"][a] / arrays["known"][a]),
                    "achieved": float(np.mean(off[known, a] ** 2)),
                }
            )
    return rows


def _planned(case: Case, camera: Any, sensors: tuple[str, ...]) -> Setup:
    """The setup that is planned for a case."""
    if not case.library:
        return Setup(*on_our_body(case.clip), camera, sensors)
    place, skeleton = place_of(camera, case.clip.poses, 60.0), SkeletonModel.default()
    poses = movement("gait", skeleton)[: round(SECONDS * 60)]
    return Setup(poses, skeleton, place.camera(poses), sensors)


def cases(corpus: Path, split: str) -> Iterator[Case]:
    """What is planned and recorded."""
    if split == "test":
        clips = [harness.middle(clip, SECONDS) for clip in harness.test_clips(corpus)]
    else:
        found = read_corpus(corpus, harness.mocap_people(split), output_rate_hz=120.0)
        whole = [clip for clip in found if "GLITCH" not in clip.quality]
        clips = [harness.middle(resample_clip(low_passed(c, 10.0), 60.0), SECONDS) for c in whole][:12]
        clips += [rerigged(clip) for clip in clips[::2]]
    for i, clip in enumerate(clips):
        for sensors in SENSORS:
            yield Case(clip, i % 4, sensors, False)
    walking = [clip for clip in clips if clip.category == "walking" and _straight(clip)]
    for i, clip in enumerate(walking):
        for sensors in SENSORS:
            yield Case(clip, (i + 1) % 4, sensors, True)


def _straight(clip: MocapClip) -> bool:
    """Whether a person walks on, and a camera of the benchmark sees it as a plan's would."""
    p = clip.poses.p_world_joint[:, 0, :2]
    return float(np.linalg.norm(p[-1] - p[0])) > 1.0 and len(standard_cameras(clip.poses, 0)) == 4


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Rank correlation and ratio by plan and sensors, and the angles of the same movement."""
    heads = "plan | sensors | motions | people | angles | rank correlation | mean ratio"
    lines = table_head(f"{heads} | ratio of medians | within 0.5-2")
    angles = ["", *table_head(" | ".join(["angle", *(f"{s}: expected, achieved" for s in SENSORS)]))]
    cells: dict[str, dict[str, str]] = {}
    for plan in dict.fromkeys(row["plan"] for row in rows):
        for sensors in SENSORS:
            own = [row for row in rows if row["plan"] == plan and row["sensors"] == sensors]
            pooled = dict(_pooled(own))
            if len(pooled) < FEWEST:
                continue
            expected, achieved = np.array(list(pooled.values())).T
            ratio = expected / achieved
            rho = float(spearmanr(expected, achieved).statistic)
            cells_of_row = (
                plan,
                sensors,
                _distinct(own, "motion"),
                _distinct(own, "subject"),
                len(pooled),
                f"{rho:.2f}",
                f"{ratio.mean():.2f}",
                f"{np.median(expected) / np.median(achieved):.2f}",
                f"{np.mean((ratio > 0.5) & (ratio < 2)):.2f}",
            )
            lines.append(f"| {' | '.join(map(str, cells_of_row))} |")
            if plan == "same":
                for name, (e, a) in pooled.items():
                    cells.setdefault(name, {})[sensors] = f"{e:.1f}, {a:.1f}"
    for name, own_cells in cells.items():
        angles.append(f"| {name.replace('_', ' ')} | " + " | ".join(own_cells.get(s, "") for s in SENSORS) + " |")
    return "\n".join(lines + angles)


def _distinct(rows: Sequence[dict[str, Any]], field: str) -> int:
    return len({row[field] for row in rows})


def _pooled(rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, tuple[float, float]]]:
    """Angle -> root mean squares expected and achieved, deg, over motions."""
    for name in dict.fromkeys(row["angle"] for row in rows):
        own = [row for row in rows if row["angle"] == name]
        if len(own) >= FEWEST:
            yield (
                name,
                tuple(
                    float(np.degrees(np.sqrt(np.mean([row[key] for row in own])))) for key in ("expected", "achieved")
                ),
            )  # type: ignore[misc]


def pooled(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each plan, set of sensors and angle."""
    return [
        {"plan": plan, "sensors": sensors, "angle": name, "expected_deg": round(e, 2), "achieved_deg": round(a, 2)}
        for plan in dict.fromkeys(row["plan"] for row in rows)
        for sensors in SENSORS
        for name, (e, a) in _pooled([r for r in rows if (r["plan"], r["sensors"]) == (plan, sensors)])
    ]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("plan", __doc__)
    parser.add_argument("--split", choices=("test", "validation"), default="test")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--no-library", action="store_true", help="only the same movement")
    options = parser.parse_args(arguments)
    chosen = [case for case in cases(options.corpus, options.split) if not (options.no_library and case.library)]
    rows = [row for own in in_parallel(run, chosen, options.workers) for row in own]
    words = " ".join(sys.argv[1:]).replace(str(options.corpus), "DIR")
    text = f"`python -m benchmarks plan {words}`\n\n{table(rows)}"
    print(harness.write_results(options.out, {"command": words, "rows": pooled(rows)}, text))


if __name__ == "__main__":
    main()
