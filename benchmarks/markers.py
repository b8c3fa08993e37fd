"""Marker trials on the skeleton: planted truth, left-out markers of real people, OpenSim's own inverse kinematics.

``python -m benchmarks markers --motion DIR --opensim DIR``: DIR of `--motion` holds UI-PRMD and biomechzoo as
benchmarks/README.md describes; that of `--opensim` the files `subject01_static.trc` (Applications/Scale/tests),
`subject01_synthetic_marker_data.trc` and `std_subject01_walk1_ik.mot` (Applications/IK/tests) of opensim-core.

* planted: a known body and marker places that deviate by half of their prior, every joint turning, 5 mm of noise;
* left out: the marker's place from half of the trials of a person, its prediction in the other half, by the body and
  motion of all other markers;
* children: joint centres of Plug-in-Gait (hips by regression of 1991) in 12 children;
* OpenSim: markers of a walk on OpenSim's own model, scaled by OpenSim, and the angles of its inverse kinematics.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.command_line import in_parallel, study_parser
from benchmarks.harness import HERE
from rtof_kin.body import metrics
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.formats.markers import MarkerSequence, read_trc
from rtof_kin.markers.fit import fit_body, track
from rtof_kin.markers.marker_sets import places_of

sys.path.insert(0, str(HERE.parent / "tests" / "support"))
from marker_support import planted

LEFT_OUT = ("LTIB", "RTHI", "LFRM", "RASI", "LKNE", "RHEE")
LIMBS = [side + part for side in ("Left", "Right") for part in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand")]
SAGITTAL = {
    "right_hip_flexion": ("hip_flexion_r", 1),
    "left_hip_flexion": ("hip_flexion_l", 1),
    "right_knee_flexion": ("knee_angle_r", -1),
    "left_knee_flexion": ("knee_angle_l", -1),
    "right_ankle_dorsiflexion": ("ankle_angle_r", 1),
    "left_ankle_dorsiflexion": ("ankle_angle_l", 1),
}


def table(title: str, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table as Markdown."""
    lines = [f"## {title}", "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows), ""])


def planted_table() -> str:
    """Errors of joint centres and flexion by seed."""
    rows = []
    for seed in range(5):
        truth = planted(seed)
        body = fit_body([truth.markers])
        motion = track(truth.markers, body)
        apart = 1000 * np.linalg.norm(motion.poses.p_world_joint - truth.p, axis=-1)
        limbs = np.sqrt(np.mean(apart[:, motion.skeleton.index(*LIMBS)] ** 2))
        found, true = (metrics.flexion(p, truth.skeleton) for p in (motion.poses.p_world_joint, truth.p))
        error = np.degrees(found - true)[:, metrics.hinges(truth.skeleton)]
        cells = (limbs, np.sqrt(np.mean(apart**2)), np.sqrt(np.mean(error**2)), np.std(error - error.mean(axis=0)))
        rows.append([seed, *(f"{cell:.1f}" for cell in cells)])
    heads = ("seed", "limb joints mm", "all joints mm", "flexion deg", "without its mean")
    return table("Planted, 5 mm of noise", heads, rows)


def trials_of(path: Path) -> dict[str, MarkerSequence]:
    """The trials of one person of UI-PRMD."""
    file = np.load(path)
    names, out = tuple(map(str, file["names"])), {}
    for key in (name for name in file.files if name != "names"):
        p = np.where(file[key] == -32768, np.nan, file[key] * 1e-4)
        out[key] = MarkerSequence(np.arange(len(p)) / 50.0, names, p)
    return out


def left_out(path: Path) -> list[float]:
    """Root mean square prediction error, mm, of each marker of `LEFT_OUT` in one person."""
    trials = list(trials_of(path).values())[::16]
    errors = []
    for name in LEFT_OUT:
        kept = [n for n in trials[0].names if n != name]
        columns = [trials[0].names.index(n) for n in kept]
        fewer = [MarkerSequence(t.times, tuple(kept), t.p_world[:, columns]) for t in trials]
        body = fit_body(fewer, places=places_of(trials[0].names).select(kept))
        segment = places_of(trials[0].names).select([name]).segments[0]
        own = []
        for whole, trial in zip(trials, fewer, strict=True):
            poses = track(trial, body).poses
            j = poses.names.index(segment)
            seen = whole.p_world[:, whole.names.index(name)] - poses.p_world_joint[:, j]
            own.append(np.einsum("tji,tj->ti", poses.R_world_bone[:, j], seen))
        place = np.nanmean(np.concatenate(own[::2]), axis=0)
        squared = np.nansum((np.concatenate(own[1::2]) - place) ** 2, axis=-1)
        errors.append(1000 * float(np.sqrt(np.mean(squared))))
    return errors


def left_out_table(folder: Path, workers: int) -> str:
    """Prediction errors by marker and person."""
    people = sorted((folder / "ui_prmd").glob("s*.npz"))
    found = in_parallel(left_out, people, workers)
    rows = [[path.stem, *(f"{e:.0f}" for e in errors)] for path, errors in zip(people, found, strict=True)]
    rows.append(["all, rms", *(f"{e:.0f}" for e in np.sqrt(np.mean(np.square(found), axis=0)))])
    return table("Left-out markers of eight adults, mm", ("person", *LEFT_OUT), rows)


def children(folder: Path) -> Iterator[tuple[str, list[MarkerSequence]]]:
    """The trials of each child of biomechzoo."""
    file = np.load(folder / "biomechzoo" / "markers.npz")
    found: dict[str, list[MarkerSequence]] = {}
    for key in (name.removesuffix("/xyz") for name in file.files if name.endswith("/xyz")):
        p, rate = file[key + "/xyz"].astype(float), float(file[key + "/rate"])
        trial = MarkerSequence(np.arange(len(p)) / rate, tuple(map(str, file[key + "/names"])), p)
        found.setdefault(key[:6], []).append(trial)
    yield from found.items()


def children_table(folder: Path) -> str:
    """Joint centres against those of Plug-in-Gait."""
    rows = []
    for name, trials in children(folder):
        body, apart = fit_body(trials), dict[str, list[np.ndarray]]()
        for trial in trials:
            poses = track(trial, body).poses
            for side, sign in (("Left", "L"), ("Right", "R")):
                for label, joint in (("HJC", "UpLeg"), ("AJC", "Foot")):
                    given = [i for i, n in enumerate(trial.names) if n.endswith(sign + label)]
                    own = poses.p_world_joint[:, poses.names.index(side + joint)]
                    apart.setdefault(label, []).extend(own - trial.p_world[:, i] for i in given)
        errors = [1000 * np.nanmean(np.linalg.norm(np.concatenate(apart[n]), axis=-1)) for n in ("HJC", "AJC")]
        named = ", ".join([*body.left_out, *body.doubtful]) or "-"
        rows.append([name, f"{body.skeleton.height:.2f}", *(f"{e:.0f}" for e in errors), named])
    heads = ("child", "height m", "hips mm", "ankles mm", "markers left out or doubtful")
    return table("Joint centres of 12 children against Plug-in-Gait's", heads, rows)


def opensim_table(folder: Path) -> str:
    """Sagittal angles against OpenSim's inverse kinematics."""
    static, walk = (read_trc(folder / f"subject01_{n}.trc") for n in ("static", "synthetic_marker_data"))
    angles = clinical_angles(track(walk, fit_body([static, walk])))
    lines = (folder / "std_subject01_walk1_ik.mot").read_text().splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("time\t"))
    names = lines[head].split("\t")
    numbers = np.array([list(map(float, line.split("\t")[: len(names)])) for line in lines[head + 1 :] if line.strip()])
    theirs = dict(zip(names, numbers.T, strict=True))
    rows = []
    for own, (other, sign) in SAGITTAL.items():
        found = np.degrees(np.interp(theirs["time"], angles.times, angles[own]))
        error = found - sign * theirs[other]
        rows.append(
            [own.replace("_", " "), f"{np.ptp(theirs[other]):.0f}", f"{error.mean():.1f}", f"{error.std():.2f}"]
        )
    return table("OpenSim's inverse kinematics, degrees", ("angle", "range", "offset", "rms after it"), rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("markers", __doc__, motion=False, page="{}.md")
    parser.add_argument("--motion", type=Path, help="folder of the collections of motion")
    parser.add_argument("--opensim", type=Path, help="folder of the three files of opensim-core")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    parts = ["# Markers on the skeleton", "", planted_table()]
    parts += [opensim_table(options.opensim)] if options.opensim else []
    if options.motion:
        parts += [children_table(options.motion), left_out_table(options.motion, options.workers)]
    text = "\n".join(parts)
    options.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
