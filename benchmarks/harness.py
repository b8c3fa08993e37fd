"""The benchmark everything is measured by: test motions x cameras x kinds of 2D, as JSON and tables.

``python -m benchmarks harness --corpus DIR --exercises CORPUS.npz`` with DIR the folder of free motion (see README.md
here), and CORPUS.npz of models/build_corpus.py for repetitions of rehabilitation exercises by two held-out people.
Split and motions come from split.toml, which holds out rigs as well as people; cameras and noise from
`rtof_kin.simulation.simulate`; seeds are fixed. Every number is pooled over frames of all motions and
cameras; the interval beside a root-relative error is the 95 % bootstrap over motions, the unit that is
independent. One number of sensors takes six minutes on two cores with every kind of 2D, as given.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tomllib
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from benchmarks import scoring
from benchmarks.command_line import in_parallel, rounded, study_parser
from benchmarks.keypoint_noise import independent, white
from benchmarks.rerigged import rerigged, t_pose
from lifting.training.corpus import Corpus
from lifting.training.corpus import read_corpus as read_built
from rtof_kin.body.metrics import evaluate, motionless
from rtof_kin.body.pose_prior import JOINTS, NeutralPosture
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.data.poses import PoseSequence
from rtof_kin.protocols.measures import reconstructions
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import LIMB_SENSORS, SimulationSettings, low_passed, simulate, standard_cameras

HERE = Path(__file__).parent
KEYPOINTS = {
    "perfect": SimulationSettings.perfect,
    "white": white,
    "independent": independent,
    "realistic": SimulationSettings.realistic,
    "unexchanged": lambda: SimulationSettings(keypoints=DetectorErrors(exchanges=0.0)),
}
SENSOR_SETS = {
    "4": ("L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg"),
    "8": LIMB_SENSORS,
    "10": (*LIMB_SENSORS, "Pelvis", "Sternum"),
}
STILL, STARTED = "zero motion", "lift with sensors"
MODES = (STILL, *CAMERA_MODES[:1], STARTED, *CAMERA_MODES[1:])
"""*lift with sensors* is what sf2 and rtof begin with, *lift* the image's alone."""
COLUMNS = {
    "mpjpe_rr_mm": ("rr mm", 1),
    "mpjpe_mm": ("abs mm", 1),
    "mpjpe_pa_mm": ("PA mm", 1),
    "hips_deg": ("hips deg", 1),
    "trunk_deg": ("upper trunk deg", 1),
    "flexion_deg": ("flexion deg", 1),
    "angle_deg": ("joint angle deg", 1),
    "mpjae": ("MPJAE m/s2", 2),
    "mpjje": ("MPJJE m/s3", 0),
    "coverage": ("valid", 2),
}
"""Heading and digits of each figure."""
BANDS = {
    f"{figure}_{kind}{unit}": (f"{kind}: {heading}", 2 if not unit else 1)
    for kind in ("relative", "world")
    for figure, unit, heading in (
        ("inside", "", "inside 95 % bands"),
        ("sigma", "_mm", "stated mm"),
        ("rms", "_mm", "actual mm"),
        ("rho", "", "rank correlation"),
    )
}


@cache
def lifter(path: str | None) -> Any:
    """A lifter, or the shipped one, read once."""
    from lifting.predict import Lifter

    return Lifter.load(path)


@dataclass(frozen=True)
class Job:
    """One motion seen by one camera, with so many sensors."""

    clip: MocapClip
    camera: int
    keypoints: tuple[str, ...]
    modes: tuple[str, ...]
    sensors: str
    calibrate: bool
    seed: int
    lifter: str | None
    posture: NeutralPosture | None = None
    """The person's T-pose, where it is told."""


def split() -> dict[str, Any]:
    """The contents of split.toml."""
    return tomllib.loads((HERE / "split.toml").read_text(encoding="utf-8"))


def mocap_people(side: str) -> list[str]:
    """Subjects of one side of the split that the folder of free motion has."""
    rows = split()
    return [person for person in rows[side] if person not in rows["benchmark"]["exercises"]]


def test_clips(corpus: Path) -> list[MocapClip]:
    """The benchmark's motions, cut to their middle."""
    rows = split()
    chosen = rows["benchmark"]
    wanted = sorted({*chosen["motions"], *chosen["rerigged"]})
    clips = {clip.name: clip for clip in whole_clips(corpus, rows["test"], wanted)}
    own = [part for name in chosen["motions"] for part in parts_of(clips[name], chosen["parts"].get(name, 1))]
    return own + [rerigged(middle(clips[name], chosen["seconds"])) for name in chosen["rerigged"]]


def exercise_clips(path: Path, people: Sequence[str] | None = None, repetitions: int | None = None) -> list[MocapClip]:
    """Repetitions of exercises, the longest of each group of neighbours in the corpus.

    Args:
        path: of the corpus. people, repetitions: of each; the held-out people and as many as split.toml says
            where not given.
    """
    corpus, rows, out = read_built(path), split()["benchmark"], []
    for person in people or rows["exercises"]:
        own = [clip for clip, subject in enumerate(corpus.subjects) if subject == person]
        for group in np.array_split(own, repetitions or rows["repetitions"]):
            out.append(built_clip(corpus, max(group, key=lambda c: corpus.start[c + 1] - corpus.start[c])))
    return out


def built_clip(corpus: Corpus, clip: int) -> MocapClip:
    """A clip of a corpus; the rig is that of the exercises."""
    person, frames, offsets = corpus.subjects[clip], corpus.frames(clip), corpus.joint_offsets[clip].astype(float)
    R = so3.nearest_rotation(corpus.R_world_bone[frames].astype(float))
    times = np.arange(len(R)) / corpus.rate_hz
    poses = PoseSequence(times, corpus.positions(clip).astype(float), R, corpus.names)
    return MocapClip(f"{person}_{clip}", poses, offsets, person, "exercise", rig="ui_prmd")


def t_poses(corpus: Path) -> dict[str, NeutralPosture]:
    """The neutral postures of the people on the re-posed rig, by motion."""
    rows = split()
    out = {}
    for clip in whole_clips(corpus, rows["test"], sorted(rows["benchmark"]["rerigged"])):
        local = {joint: R for joint, R in t_pose(clip).items() if joint in JOINTS}
        quat_wxyz = so3.to_quat_wxyz(np.stack(list(local.values())))
        out[rerigged(middle(clip, 1.0)).name] = NeutralPosture(tuple(local), quat_wxyz)
    return out


def parts_of(clip: MocapClip, count: int) -> Iterator[MocapClip]:
    """The middle of each of so many parts of a motion, as long as the benchmark's motions."""
    for i, index in enumerate(np.array_split(np.arange(len(clip.poses)), count), start=1):
        name = clip.name if count == 1 else f"{clip.name}-{i}"
        part = replace(clip, name=name, poses=clip.poses[index[0] : index[-1] + 1])
        yield middle(part, split()["benchmark"]["seconds"])


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
    return filmed(clip, own, camera, replace(KEYPOINTS[kind](), sensors=sensors))


def filmed(clip: MocapClip, own: int, number: int, settings: SimulationSettings) -> Recording:
    """Simulate a motion by one of the four cameras, and with the noise, that a number of its own draws."""
    camera = standard_cameras(clip.poses, own)[number]
    return simulate(clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=own + number, name=clip.name)


def run(job: Job) -> list[dict[str, Any]]:
    """Simulate and reconstruct one motion and camera; one row for every kind of 2D and mode."""
    lifter = Path(job.lifter) if job.lifter else None
    rows = []
    for kind in job.keypoints:
        recording = recorded(job.clip, job.camera, kind, SENSOR_SETS.get(job.sensors, ()), job.seed)
        recording = replace(recording, posture=job.posture)
        results = reconstructions(recording, job.modes, lifter, calibrate=job.calibrate)
        scores = {mode: scoring.figures(result, mode) for mode, result in results.items()}
        inertial = results.get("rtof", results.get("sf2"))
        if inertial is not None:
            scores[STARTED] = scoring.figures(inertial, "lift")
        truth = recording.truth
        assert truth is not None
        still = motionless(truth)
        scores[STILL] = dict(evaluate(still, truth, recording.skeleton)) | scoring.torso(still, truth)
        about = {
            "motion": job.clip.name,
            "rig": job.clip.rig,
            "subject": job.clip.subject,
            "held out": "rigs" if job.clip.rig in split()["benchmark"]["rigs"] else "people",
            "category": job.clip.category,
            "camera": job.camera,
            "keypoints": kind,
            "sensors": job.sensors,
            "calibrate": job.calibrate,
            "frames": len(recording.video),
        }
        rows += [about | {"mode": mode} | figures for mode, figures in scores.items()]
    return rows


def pooled(
    rows: Iterable[dict[str, Any]], columns: Iterable[str] = (*COLUMNS, *BANDS), unit: str = "motion"
) -> dict[str, Any]:
    """Means over all frames, with the bootstrap interval of the root-relative error over motions.

    Args:
        rows: those without a figure do not count for it.
        columns: the figures wanted; of those that are root mean squares, the root mean square.
        unit: what the rows of one independent unit have in common.
    """
    rows = list(rows)
    frames = np.array([row["frames"] for row in rows], dtype=float)
    figures: dict[str, Any] = {}
    for name in columns:
        power = 2 if name.startswith(("sigma_", "rms_")) else 1
        values = np.array([row.get(name, np.nan) for row in rows]) ** power
        known = np.isfinite(values)
        mean = np.average(values[known], weights=frames[known]) if known.any() else np.nan
        figures[name] = float(mean ** (1 / power))
    units = [row[unit] for row in rows]
    figures["rr_interval"] = bootstrap(units, [row["mpjpe_rr_mm"] for row in rows], frames)
    return figures


def write_results(path: Path, data: Any, text: str) -> str:
    """Write what a benchmark found; return the text.

    Args:
        path: of the JSON; the Markdown is written beside it. data: as JSON. text: as Markdown.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    path.with_suffix(".md").write_text(text + "\n", encoding="utf-8")
    return text


def bootstrap(units: Sequence[Any], values: ArrayLike, weights: ArrayLike) -> list[float]:
    """95 % interval of a weighted mean of values (n,) when units, which share values, are drawn anew."""
    known = sorted(set(units))
    sums = np.zeros((len(known), 2))
    for unit, value, weight in zip(units, np.asarray(values), np.asarray(weights), strict=True):
        sums[known.index(unit)] += weight * np.array([value, 1.0])
    rng = np.random.default_rng(0)
    draws = sums[rng.integers(len(known), size=(2000, len(known)))].sum(axis=1)
    return [float(v) for v in np.percentile(draws[:, 0] / draws[:, 1], [2.5, 97.5])]


def tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """The rows pooled by kind of 2D and mode: all, of held-out people and rigs, by rig; and the bands."""
    ours = [row for row in rows if row["mode"] in (STARTED, "sf2", "rto", "rtof")]
    stating = [row for row in rows if "rho_world" in row]
    return [
        _table("all", "All motions", rows, ("keypoints", "mode"), COLUMNS),
        _table("held_out", "Held-out people and rigs", ours, ("keypoints", "held out", "mode"), COLUMNS),
        _table("rigs", "By rig", ours, ("keypoints", "rig", "mode"), COLUMNS),
        _table("bands", "Stated errors of positions", stating, ("keypoints", "mode"), BANDS),
        _table("bands_rigs", "The same by rig", stating, ("keypoints", "held out", "rig", "mode"), BANDS),
    ]


def _table(
    name: str, title: str, rows: Sequence[dict[str, Any]], by: tuple[str, ...], columns: dict[str, tuple[str, int]]
) -> Table:
    """Rows pooled by what they have in common in some fields."""
    found: list[tuple[Cell, ...]] = []
    for key in dict.fromkeys(tuple(row[field] for field in by) for row in in_order(rows, by)):
        figures = pooled(row for row in rows if tuple(row[field] for field in by) == key)
        low, high = figures["rr_interval"]
        found.append((*key, *(figures[column] for column in columns), f"{low:.1f}-{high:.1f}"))
    headings, digits = zip(*columns.values(), strict=True)
    labels = tuple("2D" if field == "keypoints" else field for field in by)
    notes = ("Sizes of errors are root mean squares, stated and actual.",) if columns is BANDS else ()
    return Table(name, title, (*labels, *headings, "rr 95 %"), (0,) * len(by) + digits + (0,), tuple(found), notes)


def in_order(rows: Iterable[dict[str, Any]], by: Sequence[str]) -> list[dict[str, Any]]:
    """Rows sorted by fields; kinds of 2D and modes in their own order."""
    order = {"keypoints": list(KEYPOINTS).index, "mode": MODES.index}
    return sorted(rows, key=lambda row: [order.get(field, lambda own: own)(row[field]) for field in by])


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    options = _parser().parse_args(arguments)
    clips = test_clips(options.corpus) + (exercise_clips(options.exercises) if options.exercises else [])
    postures = t_poses(options.corpus) if options.posture == "known" else {}
    if options.motions:
        clips = [clip for clip in clips if clip.name in options.motions.split(",")]
    jobs = [
        Job(
            clip,
            camera,
            tuple(options.keypoints.split(",")),
            tuple(options.modes.split(",")),
            options.sensors,
            options.calibrate == "yes",
            options.seed,
            options.lifter,
            postures.get(clip.name),
        )
        for clip in clips
        for camera in range(options.cameras)
    ]
    rows = [row for own in in_parallel(run, jobs, options.workers) for row in own]
    rows = in_order(rows, ("keypoints", "motion", "camera", "mode"))
    words = " ".join(sys.argv[1:]).replace(str(options.corpus), "DIR").replace(str(options.exercises), "CORPUS.npz")
    result = {
        "command": f"python -m benchmarks harness {words}",
        "split_sha256": hashlib.sha256((HERE / "split.toml").read_bytes()).hexdigest(),
        "rows": rows,
    }
    text = "\n".join(table.markdown() for table in tables(rows))
    print(write_results(options.out, rounded(result), text))


def _parser() -> argparse.ArgumentParser:
    parser = study_parser("harness", __doc__)
    parser.add_argument("--exercises", type=Path, metavar="CORPUS.npz", help="also exercises of held-out people")
    parser.add_argument("--keypoints", default=",".join(KEYPOINTS), help="kinds of 2D")
    parser.add_argument("--modes", default="lift,sf2,rto,rtof", help="stages to measure")
    parser.add_argument("--sensors", default="8", choices=["0", *SENSOR_SETS], help="how many IMUs")
    parser.add_argument(
        "--posture",
        choices=("known", "unknown"),
        default="unknown",
        help="whether the T-pose of people on the re-posed rig is told",
    )
    parser.add_argument("--calibrate", default="no", choices=("yes", "no"), help="from the recording itself")
    parser.add_argument("--cameras", type=int, default=4, help="of the four around each motion")
    parser.add_argument("--motions", help="only these, separated by commas")
    parser.add_argument("--lifter", help="checkpoint; the shipped one where not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    return parser


if __name__ == "__main__":
    main()
