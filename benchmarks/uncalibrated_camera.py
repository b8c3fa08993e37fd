"""A camera that is not calibrated: what is found of it, and what it costs.

``python -m benchmarks uncalibrated_camera --corpus DIR``: recordings of 20 s of held-out people and rigs,
30 images a second, realistic 2D, eight sensors and none. Focal length (10 %), pitch and roll (5 degrees
each) are wrong by that much, with drawn signs; the camera's height by 1.5 cm, k1 by 0.02 and the person's
height by 1 % (standard deviations). Each recording is reconstructed with the true camera, with the wrong
one believed, and with the wrong one declared uncertain. An interrupted run resumes where it stopped.

``--fit`` prints the evidence of `rtof_kin.reconstruction.camera_evidence` with the true camera in recordings
of other subjects, in its standard deviations, which were chosen by it.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scoring
from benchmarks.calibration.planted_rows import SESSIONS
from benchmarks.calibration.sessions import joined
from benchmarks.command_line import study_parser
from rtof_kin.body.metrics import at_times
from rtof_kin.calibration.camera_estimate import UNKNOWNS, corrected
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reconstruction.camera_evidence import Scene, evidence, standing_feet
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

Row = dict[str, Any]
MOTIONS = SESSIONS["test"] | {
    "SNU (rig)": ["snu_balance", "snu_kick", "snu_dance", "snu_pirouette"],
    "rokoko (rig)": ["ad_rokoko_jesse_dance"],
}
"""Name of a recording -> motions of one person or rig, one after the other."""
SECONDS = 20.0
FITTED = ("CMU008", "CMU035", "CMU007", "CMU006", "CMU039", "CMU005")
"""Subjects of training and validation."""
UNCERTAIN = CameraUncertainty(focal=0.1, tilt=float(np.radians(5.0)), height=0.015, k1=0.02)
SIZE = 0.01
"""Standard deviation of the person's height."""
CASES = ("true camera", "wrong, believed", "wrong, uncertain")
FIGURES = {
    "mpjpe_rr_mm": "rr mm",
    "mpjpe_mm": "abs mm",
    "flexion_deg": "flexion deg",
    "angle_deg": "joints deg",
    "hips_deg": "hips deg",
    "distance_percent": "distance off %",
    "distance_inside": "distance inside 95 %",
    "inside_relative": "relative inside 95 %",
    "inside_world": "world inside 95 %",
}


def clips(corpus: Path) -> Iterator[tuple[str, MocapClip]]:
    """Recordings' names and motions."""
    names = [name for motions in MOTIONS.values() for name in motions]
    found = {c.name: c for c in harness.whole_clips(corpus, harness.split()["test"], names)}
    for name, motions in MOTIONS.items():
        clip = joined([found[m] for m in motions], SECONDS, name)
        yield name, clip


def recorded(clip: MocapClip, camera: int, sensors: str) -> tuple[Recording, Recording, Array]:
    """Return the recording with the true and with a wrong camera, and the corrections (5,) of the latter."""
    own = zlib.crc32(clip.name.encode()) + camera
    rng = np.random.default_rng(own)
    sigma = np.array([UNCERTAIN.focal, UNCERTAIN.tilt, UNCERTAIN.tilt, UNCERTAIN.height, UNCERTAIN.k1])
    y = sigma * np.concatenate([rng.choice([-1.0, 1.0], 3), rng.standard_normal(2)])
    settings = replace(SimulationSettings.realistic(), sensors=harness.SENSOR_SETS.get(sensors, ()))
    right = standard_cameras(clip.poses, own)[camera]
    made = simulate(clip.poses, clip.joint_offsets, camera=right, settings=settings, seed=own, name=clip.name)
    seen = made.video[::2]
    true = replace(right, distortion=np.array([y[4], 0, 0, 0, 0]))
    uv = _distorted(true, right.normalise(seen.uv_px))
    offsets = made.joint_offsets * (1 + SIZE * rng.standard_normal())
    recording = replace(made, keypoints=replace(seen, uv_px=uv, camera=true), joint_offsets=offsets, floor_height=0.0)
    wrong = replace(recording, keypoints=replace(recording.video, camera=_uncorrected(true, y)))
    return recording, wrong, y


def _distorted(camera: Camera, xy: Array) -> Array:
    """Pixels of normalised coordinates (..., 2)."""
    points = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    return replace(camera, R_camera_world=np.eye(3), t_camera_world=np.zeros(3)).project(points)


def _uncorrected(true: Camera, y: Array) -> Camera:
    """The camera that `corrected` by y is the true one."""
    K, inverse = true.K.copy(), -y
    K[:2, :2] /= 1 + y[0]
    return corrected(replace(true, K=K), inverse * [0, 1, 1, 1, 1])


def figures(result: Reconstruction, true: Camera) -> Row:
    """Errors of a reconstruction, and of its distance from the camera."""
    truth = result.recording.truth
    assert truth is not None
    out = scoring.figures(result, result.mode)
    motion, confidence = result.motion, result.motion.confidence
    assert confidence is not None
    camera = result.recording.video.camera
    ray = motion.poses.p_world_joint[:, 0] - camera.center_world
    distance = np.linalg.norm(ray, axis=-1)
    p_true = at_times(truth, motion.times).p_world_joint[:, 0]
    off = distance - np.linalg.norm(p_true - true.center_world, axis=-1)
    ray = ray / distance[:, None]
    sigma = np.sqrt(np.einsum("ti,tij,tj->t", ray, confidence.position_covariance[:, 0], ray))
    known = np.isfinite(sigma + off)
    out["distance_percent"] = float(100 * np.mean(np.abs(off / distance)[known]))
    out["distance_inside"] = float(np.mean(np.abs(off) <= BAND_95 * sigma, where=known))
    return {name: round(float(out[name]), 4) for name in FIGURES}


def rows_of(name: str, clip: MocapClip, camera: int, sensors: str) -> Iterator[Row]:
    """One row for every case."""
    recording, wrong, y = recorded(clip, camera, sensors)
    true, truth = recording.video.camera, recording.truth
    assert truth is not None
    believed = wrong.video
    uncertain = replace(believed, camera=replace(believed.camera, uncertainty=UNCERTAIN))
    given = (recording, wrong, replace(wrong, keypoints=uncertain))
    depth = true.to_camera(truth.p_world_joint[:, 0])[:, 2]
    about = {"motion": name, "camera": camera, "sensors": sensors, "frames": len(recording.video)}
    about["to_and_fro_m"] = round(float(np.abs(np.diff(depth[::6])).sum()), 2)
    for case, one in zip(CASES, given, strict=True):
        result = reconstruct(one, mode="rtof" if one.imus is not None else "rto")
        row = about | {"case": case} | figures(result, true)
        if result.camera is not None:
            row |= {"planted": y.tolist(), "found": result.camera.value.tolist(), "sigma": result.camera.sigma.tolist()}
        yield row


def fitted(corpus: Path) -> None:
    """Print the evidence with the true camera, by sensors, and its root mean square over the recordings."""
    found: dict[str, list[Array]] = {"8": [], "none": []}
    for subject in FITTED:
        motions = [m for m in read_corpus(corpus, [subject], output_rate_hz=120.0) if "GLITCH" not in m.quality]
        whole = [resample_clip(low_passed(m, 10.0), 60.0) for m in motions]
        for camera, parts in enumerate(np.array_split(np.arange(len(whole)), 2)):
            clip = joined([whole[i] for i in parts], SECONDS, f"{subject} {camera}")
            for sensors, rows in found.items():
                recording = recorded(clip, camera, sensors)[0]
                result = reconstruct(recording, mode="rtof" if recording.imus is not None else "rto")
                assert result.keypoints is not None
                skeleton, poses = result.motion.skeleton, result.motion.poses
                contacts = standing_feet(result.keypoints, poses, skeleton)
                scene = Scene(skeleton, recording.floor_height, contacts, result.bone_imus)
                lifted = lift(result.keypoints, skeleton, None, None, recording.floor_height).poses
                own = evidence(scene, result.keypoints, lifted, poses)
                rows.append(np.where(own.known, own.value / own.sigma, np.nan))
                print(clip.name, sensors, np.round(rows[-1], 2), flush=True)
    for sensors, rows in found.items():
        print(sensors, "root mean square", np.round(np.sqrt(np.nanmean(np.square(rows), axis=0)), 2))


def report(rows: Sequence[Row]) -> str:
    """Tables as Markdown."""
    lines = [f"# A camera that is not calibrated\n\n{(__doc__ or '').partition(chr(10))[2].strip()}\n"]
    heads = ["sensors", "case", *FIGURES.values(), "recordings"]
    body = []
    for sensors in dict.fromkeys(row["sensors"] for row in rows):
        for case in CASES:
            own = [row for row in rows if (row["sensors"], row["case"]) == (sensors, case)]
            means = [f"{np.mean([row[name] for row in own]):.3g}" for name in FIGURES]
            body.append([sensors, case, *means, str(len(own))])
    lines += ["## Errors\n", *_table(heads, body), "\n## Unknowns\n"]
    lines += [
        "Root mean squares of what was planted, what remains of it and what is stated; share of the "
        "true values inside two standard deviations.\n"
    ]
    heads = ["sensors", "motions", "unknown", "planted", "remaining", "stated", "inside 2 sd", "recordings"]
    found = [row for row in rows if "found" in row]
    lines += _table(heads, list(_unknowns(found)))
    lines += ["\n## Recordings\n"]
    heads = ["motion", "camera", "sensors", "path in depth m"]
    for unknown in ("focal %", "pitch deg", "roll deg"):
        heads += [f"{unknown} planted", "found", "sd"]
    body = []
    for row in found:
        columns = np.array([row["planted"], row["found"], row["sigma"]])[:, :3] * [100, *np.degrees([1, 1])]
        numbers = [f"{value:.1f}" for value in columns.T.ravel()]
        body.append([row["motion"], str(row["camera"]), row["sensors"], str(row["to_and_fro_m"]), *numbers])
    return "\n".join([*lines, *_table(heads, body)])


def _unknowns(found: Sequence[Row]) -> Iterator[list[str]]:
    units = (100.0, np.degrees(1.0), np.degrees(1.0), 100.0, 1.0)
    words = ("%", "deg", "deg", "cm", "")
    for sensors in dict.fromkeys(row["sensors"] for row in found):
        for walks, label in ((True, "towards the camera"), (False, "others")):
            own = [r for r in found if r["sensors"] == sensors and (r["to_and_fro_m"] > _FAR) == walks]
            if not own:
                continue
            y, e, s = (np.array([row[n] for row in own]) for n in ("planted", "found", "sigma"))
            inside = np.mean(np.abs(e - y) <= 2 * s, axis=0)
            for i, name in enumerate(UNKNOWNS):
                sizes = (units[i] * np.sqrt(np.mean(np.square(v[:, i]))) for v in (y, e - y, s))
                yield [
                    sensors,
                    label,
                    name,
                    *(f"{size:.2g} {words[i]}".strip() for size in sizes),
                    f"{inside[i]:.2f}",
                    str(len(own)),
                ]


_FAR = 8.0
"""[m] of path to and from the camera in 20 s from which a motion counts as one towards the camera."""


def _table(heads: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    rows = [heads, ["---"] * len(heads), *body]
    return [f"| {' | '.join(row)} |" for row in rows]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("uncalibrated_camera", __doc__)
    parser.add_argument("--fit", action="store_true", help="print the evidence in recordings of training subjects")
    parser.add_argument("--cameras", type=int, default=2, choices=range(1, 5))
    options = parser.parse_args(arguments)
    if options.fit:
        fitted(options.corpus)
        return
    partial = options.out.with_suffix(".jsonl")
    rows = [json.loads(line) for line in partial.read_text().splitlines()] if partial.exists() else []
    done = {(row["motion"], row["camera"], row["sensors"]) for row in rows}
    for camera in range(options.cameras):
        for name, clip in clips(options.corpus):
            for sensors in ("8", "none"):
                if (name, camera, sensors) in done:
                    continue
                rows += (new := list(rows_of(name, clip, camera, sensors)))
                with partial.open("a", encoding="utf-8") as file:
                    file.writelines(json.dumps(row) + "\n" for row in new)
                print(len(rows), name, camera, sensors, file=sys.stderr, flush=True)
    harness.write_results(options.out, {"rows": rows}, report(rows))
    partial.unlink(missing_ok=True)
    print(report(rows))


if __name__ == "__main__":
    main()
