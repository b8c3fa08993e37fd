"""The benchmark everything is measured by: test motions x cameras x kinds of 2D, as JSON and a table.

``python -m benchmarks.harness --corpus DIR`` with DIR the folder of free motion (see README.md here).
Split and motions come from split.toml, cameras and noise from `rtof_kin.simulation.simulate`, seeds fixed.
Every number is a mean over frames pooled over motions and cameras; the interval beside a root-relative
error is the 95 % bootstrap over motions, the unit that is independent.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tomllib
import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.progress import Progress

from rtof_kin.body.metrics import evaluate, motionless
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.protocols.measures import reconstructions
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import (
    LIMB_SENSORS,
    SimulationSettings,
    low_passed,
    simulate,
    standard_cameras,
)

HERE = Path(__file__).parent
KEYPOINTS = {
    "perfect": SimulationSettings.perfect,
    "white": SimulationSettings.white,
    "independent": SimulationSettings.independent,
    "realistic": SimulationSettings.realistic,
}
SENSOR_SETS = {
    "4": ("L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg"),
    "8": LIMB_SENSORS,
    "10": (*LIMB_SENSORS, "Pelvis", "Sternum"),
}
COLUMNS = {
    "mpjpe_rr_mm": "rr mm",
    "mpjpe_mm": "abs mm",
    "mpjpe_pa_mm": "PA mm",
    "mpjae": "MPJAE m/s2",
    "mpjje": "MPJJE m/s3",
    "angle_deg": "joint angle deg",
    "flexion_deg": "flexion deg",
}


@dataclass(frozen=True)
class Job:
    """One motion seen by one camera."""

    clip: MocapClip
    camera: int
    keypoints: tuple[str, ...]
    modes: tuple[str, ...]
    sensors: tuple[str, ...]
    seed: int
    lifter: str | None


def split() -> dict[str, Any]:
    """The contents of split.toml."""
    return tomllib.loads((HERE / "split.toml").read_text(encoding="utf-8"))


def test_clips(corpus: Path) -> list[MocapClip]:
    """The benchmark's motions, cut to their middle."""
    rows = split()
    clips = whole_clips(corpus, rows["test"], rows["benchmark"]["motions"])
    return [middle(clip, rows["benchmark"]["seconds"]) for clip in clips]


def whole_clips(corpus: Path, subjects: list[str], wanted: list[str]) -> list[MocapClip]:
    """Motions of some subjects by name, low-passed, at 60 Hz."""
    found = read_corpus(corpus, subjects, output_rate_hz=120.0)
    clips = {clip.name: resample_clip(low_passed(clip, 10.0), 60.0) for clip in found}
    missing = [name for name in wanted if name not in clips]
    if missing:
        sys.exit(f"error: {corpus} has no {', '.join(missing)}; see benchmarks/README.md")
    glitches = [name for name in wanted if "GLITCH" in clips[name].quality]
    if glitches:
        sys.exit(f"error: {', '.join(glitches)} are marked GLITCH; take them out of split.toml")
    return [clips[name] for name in wanted]


def middle(clip: MocapClip, seconds: float) -> MocapClip:
    """The middle of a motion, from time 0."""
    count = min(len(clip.poses), round(seconds * clip.poses.rate_hz))
    first = (len(clip.poses) - count) // 2
    poses = clip.poses[first : first + count]
    return replace(clip, poses=replace(poses, times=poses.times - poses.times[0]))


def recorded(clip: MocapClip, camera: int, kind: str, sensors: tuple[str, ...], seed: int) -> Recording:
    """Simulate one of a motion's four cameras and the sensors."""
    # A motion's cameras and noise depend on its name, not on its place in the list.
    own = seed * 1_000_003 + zlib.crc32(clip.name.encode())
    return simulate(
        clip.poses,
        clip.joint_offsets,
        camera=standard_cameras(clip.poses, own)[camera],
        settings=replace(KEYPOINTS[kind](), sensors=sensors),
        seed=own + camera,
        name=clip.name,
    )


def run(job: Job) -> list[dict[str, Any]]:
    """Simulate and reconstruct one motion and camera; one row for every kind of 2D and mode."""
    lifter = Path(job.lifter) if job.lifter else None
    rows = []
    for kind in job.keypoints:
        recording = recorded(job.clip, job.camera, kind, job.sensors, job.seed)
        skeleton = recording.skeleton
        results = reconstructions(recording, job.modes, lifter)
        scores = {mode: result.stage_metrics[mode] for mode, result in results.items()}
        truth = recording.truth
        assert truth is not None
        scores["zero motion"] = evaluate(motionless(truth), truth, skeleton)
        for mode, metrics in scores.items():
            rows.append(
                {
                    "motion": job.clip.name,
                    "category": job.clip.category,
                    "camera": job.camera,
                    "keypoints": kind,
                    "mode": mode,
                    "frames": len(recording.keypoints),
                    **dict(metrics),
                }
            )
    return rows


def pooled(
    rows: Iterable[dict[str, Any]], columns: Iterable[str] = COLUMNS, unit: str = "motion"
) -> dict[str, Any]:
    """Means over all frames, with the bootstrap interval of the root-relative error over motions.

    Args:
        columns: the figures wanted. unit: what the rows of one independent unit have in common.
    """
    rows = list(rows)
    frames = np.array([row["frames"] for row in rows], dtype=float)
    figures: dict[str, Any] = {
        name: float(np.average([row[name] for row in rows], weights=frames))
        for name in (*columns, "coverage")
    }
    units = [row[unit] for row in rows]
    figures["rr_interval"] = bootstrap(units, [row["mpjpe_rr_mm"] for row in rows], frames)
    return figures


def write_results(path: Path, data: Any, text: str) -> None:
    """Write what a benchmark found.

    Args:
        path: of the JSON; the Markdown is written beside it. data: as JSON. text: as Markdown.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    path.with_suffix(".md").write_text(text + "\n", encoding="utf-8")


def bootstrap(units: Sequence[Any], values: ArrayLike, weights: ArrayLike) -> list[float]:
    """95 % interval of a weighted mean of values (n,) when units, which share values, are drawn anew."""
    known = sorted(set(units))
    sums = np.zeros((len(known), 2))
    for unit, value, weight in zip(units, np.asarray(values), np.asarray(weights), strict=True):
        sums[known.index(unit)] += weight * np.array([value, 1.0])
    rng = np.random.default_rng(0)
    draws = sums[rng.integers(len(known), size=(2000, len(known)))].sum(axis=1)
    return [float(v) for v in np.percentile(draws[:, 0] / draws[:, 1], [2.5, 97.5])]


def table(rows: list[dict[str, Any]]) -> str:
    """The rows pooled by kind of 2D and mode, as Markdown."""
    lines = [
        "| 2D | mode | " + " | ".join(COLUMNS.values()) + " | rr 95 % | valid |",
        "|---|---|" + "---|" * (len(COLUMNS) + 2),
    ]
    for kind in dict.fromkeys(row["keypoints"] for row in rows):
        for mode in ("zero motion", *CAMERA_MODES):
            chosen = [r for r in rows if r["keypoints"] == kind and r["mode"] == mode]
            if not chosen:
                continue
            figures = pooled(chosen)
            cells = [_cell(name, figures[name]) for name in COLUMNS]
            low, high = figures["rr_interval"]
            cells += [f"{low:.1f}-{high:.1f}", f"{100 * figures['coverage']:.0f} %"]
            lines.append(f"| {kind} | {mode} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(name: str, value: float) -> str:
    return f"{value:.0f}" if name == "mpjje" else f"{value:.2f}" if name == "mpjae" else f"{value:.1f}"


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.harness", description=__doc__)
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--keypoints", default="perfect,white,realistic", help="kinds of 2D")
    parser.add_argument("--modes", default="lift,sf2,rto,rtof", help="stages to measure")
    parser.add_argument("--sensors", default="8", choices=[*SENSOR_SETS, "0"], help="how many IMUs")
    parser.add_argument("--cameras", type=int, default=4, help="of the four around each motion")
    parser.add_argument("--motions", help="only these, separated by commas")
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "harness.json")
    options = parser.parse_args(arguments)
    clips = test_clips(options.corpus)
    if options.motions:
        clips = [clip for clip in clips if clip.name in options.motions.split(",")]
    jobs = [
        Job(clip, camera, tuple(options.keypoints.split(",")), tuple(options.modes.split(",")),
            SENSOR_SETS.get(options.sensors, ()), options.seed, options.lifter)
        for clip in clips for camera in range(options.cameras)
    ]  # fmt: skip
    rows: list[dict[str, Any]] = []
    with Progress() as progress, ProcessPoolExecutor(options.workers) as pool:
        task = progress.add_task("motions x cameras", total=len(jobs))
        for future in as_completed([pool.submit(run, job) for job in jobs]):
            rows += future.result()
            progress.advance(task)
    rows.sort(key=lambda r: (r["keypoints"], r["motion"], r["camera"], r["mode"]))
    text = table(sorted(rows, key=lambda r: list(KEYPOINTS).index(r["keypoints"])))
    result = {
        "command": "python -m benchmarks.harness " + " ".join(sys.argv[1:]).replace(
            str(options.corpus), "DIR"),
        "split_sha256": hashlib.sha256((HERE / "split.toml").read_bytes()).hexdigest(),
        "seed": options.seed,
        "sensors": options.sensors,
        "rows": rows,
    }  # fmt: skip
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    options.out.with_suffix(".md").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
