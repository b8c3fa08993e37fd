"""Make one corpus of free motion for `rtof-kin train` and `build_pose_prior.py` from the collections of motion.

``python models/build_corpus.py MOTION MOCAP -o corpus.npz``: MOTION has ``ui_prmd`` (markers), ``cmu`` and ``cmu_daz``
(joint rotations, see its README); MOCAP is the first collection (``index.csv``, BVH and AMC files). What is in both is
taken once. People stay on one side of the split (`benchmarks/split.toml`): CMU's subjects whose skeletons have the same
bones to 1 mm are one person.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from lifting.training.corpus import BENCHMARK_SPLIT, Corpus, join_clips, read_split
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.markers.fit import fit_body, track
from rtof_kin.simulation import mocap
from rtof_kin.simulation.mocap import ANKLE_HEIGHT, MocapClip, without_spikes
from rtof_kin.simulation.mocap_families import NAMES, PARENTS, recognise_family

DAZ_START = 40  # frames of a T-pose and a ramp out of it at the start of a DAZ clip
FASTEST = 30.0  # [m/s] a clip with a faster joint has a glitch
SHORTEST = 0.5  # [s]
SAME_PERSON = 1e-3  # [m]
DAZ_PEOPLE = {"indian": "CMU094", "martial": "CMU135", "salsa": "CMU060/061"}  # the clips of martial are those of 135
ACKNOWLEDGEMENT = (
    "Motion: CMU Graphics Lab Motion Capture Database (mocap.cs.cmu.edu; funded by NSF EIA-0196217), and UI-PRMD "
    "(Vakanski et al. 2018, Data 3(1):2; University of Idaho; public domain)."
)


def hierarchies(path: Path) -> Iterator[tuple[str, ArticulatedMotion]]:
    """Read the clips of a file of joint rotations."""
    file = np.load(path)
    tree = json.loads(bytes(file["hierarchy"]))
    for key in (name for name in file.files if name.endswith("/root")):
        quat = file[key.removesuffix("root") + "quat"].astype(float)
        R = so3.from_quat_wxyz(quat / np.linalg.norm(quat, axis=-1, keepdims=True))
        root = file[key].astype(float)
        yield (
            key.removesuffix("/root"),
            ArticulatedMotion(
                tuple(tree["names"]), tuple(tree["parents"]), np.array(tree["offsets"], dtype=float), R, root, 60.0
            ),
        )


def on_floor(clip: MocapClip) -> list[MocapClip]:
    """Cut a clip at glitches and move its floor to z = 0."""
    p = clip.poses.p_world_joint.copy()
    feet = [NAMES.index("LeftFoot"), NAMES.index("RightFoot")]
    p[..., 2] -= np.percentile(p[:, feet, 2].min(axis=1), 5) - ANKLE_HEIGHT
    pieces = without_spikes(replace(clip, poses=replace(clip.poses, p_world_joint=p)))
    return [piece for piece in pieces if len(piece.poses) >= SHORTEST * clip.poses.rate_hz]


def cmu(motion: Path) -> Iterator[MocapClip]:
    """Map the clips of joint rotations to the package's skeleton."""
    for folder in ("cmu", "cmu_daz"):
        rows = {row["clip"]: row for row in csv.DictReader((motion / folder / "index.csv").open(encoding="utf-8"))}
        for path in sorted((motion / folder).glob("*.npz")):
            for name, whole in hierarchies(path):
                row = rows[name]
                if float(row["max_joint_speed"]) > FASTEST and folder == "cmu":
                    continue
                skipped = whole[DAZ_START:] if folder == "cmu_daz" else whole
                clip = mocap.map_motion(skipped, recognise_family(path, whole), 1.0, 60.0, name)
                person = DAZ_PEOPLE[row["category"]] if folder == "cmu_daz" else f"CMU{int(row['subject']):03d}"
                yield from on_floor(replace(clip, subject=person, category=row.get("category", "")))


def first_collection(root: Path, known: set[str]) -> Iterator[MocapClip]:
    """Read the clips of the first collection that are not in the second."""
    for clip in mocap.read_corpus(root):
        if clip.name.partition("[")[0] not in known and "GLITCH" not in clip.quality:
            yield clip


def ui_prmd(path: Path) -> list[MocapClip]:
    """Fit the body of one person and solve all trials on it."""
    file, person = np.load(path), f"UIPRMD{path.stem[1:]}"
    names = tuple(map(str, file["names"]))
    trials = {}
    for key in (name for name in file.files if name != "names"):
        p = np.where(file[key] == -32768, np.nan, file[key] * 1e-4)
        if len(p) >= SHORTEST * 50:
            trials[key] = MarkerSequence(np.arange(len(p)) / 50.0, names, p)
    body = fit_body(list(trials.values()), SkeletonModel.default())
    print(
        f"{person}: {len(trials)} trials, {body.skeleton.height:.2f} m, residual {1e3 * np.median(body.rms):.1f} mm",
        flush=True,
    )
    clips = []
    for name, trial in trials.items():
        poses = track(trial, body).poses
        if poses.valid.all():
            clip = MocapClip(name, poses, body.skeleton.joint_offsets, person, name[:3], rig="ui_prmd")
            clips += on_floor(clip)
    return clips


def one_side(clips: list[MocapClip], split_of: dict[str, str]) -> dict[str, str]:
    """Return the split of every subject: that of any subject with the same bones, held out before trained on."""
    order = ["excluded", "test", "validation", "train"]
    subjects = sorted({clip.subject for clip in clips})
    bodies = {s: [c.joint_offsets for c in clips if c.subject == s and c.rig != "daz"] for s in subjects}
    out = {s: split_of.get(s, "train") for s in subjects}
    for a in subjects:
        for b in subjects:
            if any(np.abs(x - y).max() < SAME_PERSON for x in bodies[a][:1] for y in bodies[b]) and a != b:
                side = min(out[a], out[b], key=order.index)
                if out[a] != side or out[b] != side:
                    print(f"{a} and {b} have the same bones: {side}")
                out[a] = out[b] = side
    return out


def build(motion: Path, first: Path, workers: int) -> Corpus:
    """Read everything, split it, join it."""
    clips = list(cmu(motion))
    print(f"second collection: {len(clips)} clips", flush=True)
    clips += first_collection(first, {clip.name.partition("[")[0] for clip in clips})
    print(f"both: {len(clips)} clips", flush=True)
    with ProcessPoolExecutor(workers) as pool:
        clips += [clip for person in pool.map(ui_prmd, sorted((motion / "ui_prmd").glob("*.npz"))) for clip in person]
    split_of = one_side(clips, read_split(BENCHMARK_SPLIT))
    for subject in sorted(split_of):
        own = [clip for clip in clips if clip.subject == subject]
        minutes = sum(len(clip.poses) / clip.poses.rate_hz for clip in own) / 60
        print(f"{subject:12s} {split_of[subject]:11s} {minutes:6.1f} min  {', '.join(sorted({c.rig for c in own}))}")
    return join_clips(((clip, split_of[clip.subject]) for clip in clips), PARENTS, acknowledgement=ACKNOWLEDGEMENT)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("motion", type=Path)
    parser.add_argument("mocap", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("corpus.npz"))
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    build(given.motion, given.mocap, given.workers).save(given.output)
