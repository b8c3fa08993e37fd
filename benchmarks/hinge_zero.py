"""The zero of knees and elbows where a detector's points lie beside the joints and no mounting is known.

``python -m benchmarks hinge_zero --corpus DIR``: walks of held-out people on the floor, with and without a still
second before them, 30 images a second, a camera beside the person and one behind. The detector's knees lie 25 mm
behind the joints, its hips, ankles, shoulders, elbows and wrists 15 mm off (per axis, another draw for each recording),
and everything else is wrong as in `DetectorErrors`. *run*: eight sensors with any heading and mounting, aligned by the
video and reconstructed as ``rtof-kin run`` does; *camera alone*: no sensors. *right, as given* and *right, calibrated*:
points where they are told to be, mountings known but for 0.9 degrees.

The rigs of the corpus have knees of their own: their people walk and stand with 10 to 25 degrees. Each leg is
straightened by a constant, so that the knee in the straightest tenth of the walk and in the still second is as in
people: 4 and 2 degrees, each with a spread of 4, correlation 0.6, and 1.5 more between the sides.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from benchmarks import harness
from benchmarks.calibration.sessions import joined
from benchmarks.command_line import study_parser
from rtof_kin.body import kinematics
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.alignment import align_sensors
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import calibrate_recording
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors, detector_error_table, simulate_detections
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.mocap_families import PARENTS
from rtof_kin.simulation.simulate import SimulationSettings, simulate
from rtof_kin.vision.keypoints import keypoints_from_detections

Row = dict[str, Any]
WALKS: Final = {
    "CMU016": [f"16_{n}" for n in ("15", "16", "21", "22", "31", "32", "47", "58")],
    "CMU002": ["02_01", "02_02"],
    "CMU008": [f"08_{n:02d}" for n in (1, 2, 3, 4, 5, 6, 8, 9, 10, 11)],
    "CMU012": ["12_01"],
}
"""Person -> walks, one after the other, from the beginning again where they are too short."""
KNEES: Final = (("LeftUpLeg", "LeftLeg"), ("RightUpLeg", "RightLeg"))
ANGLES: Final = {
    "knee": ("left_knee_flexion", "right_knee_flexion"),
    "elbow": ("left_elbow_flexion", "right_elbow_flexion"),
}
BEHIND_M, BESIDE_M = 0.025, 0.015
STILL_S, BLEND_S = 2.0, 1.0
CASES: Final = ("camera alone", "run", "right, as given", "right, calibrated")


def habit(rng: Generator, bent_deg: float = 0.0) -> tuple[Array, Array]:
    """Knee flexion (2,), rad, of left and right in the straightest tenth of a walk and in standing."""
    stands = 2.0 + 4.0 * rng.standard_normal()
    walks = 4.0 + 0.6 * (stands - 2.0) + 3.2 * rng.standard_normal()
    sides = 1.5 * rng.standard_normal((2, 2))
    return np.radians(walks + bent_deg + sides[0]), np.radians(stands + bent_deg + sides[1])


def straightened(clip: MocapClip, straightest: Array) -> MocapClip:
    """The walk with other zeros of the knees, feet on the floor; thigh and shank share each turn."""
    poses, R = clip.poses, np.array(clip.poses.R_world_bone)
    feet = [poses.names.index(f"{side}Foot") for side in ("Left", "Right")]
    lowest = poses.p_world_joint[:, feet, 2].min(axis=1)
    for (thigh, shank), wanted in zip(KNEES, straightest, strict=True):
        t, s = poses.names.index(thigh), poses.names.index(shank)
        knee = _tilt(R[:, s]) - _tilt(R[:, t])
        less = np.sort(knee)[: max(1, len(knee) // 10)].mean() - wanted
        R[:, t] = R[:, t] @ so3.about_axis("y", less / 2)
        R[:, s] = R[:, s] @ so3.about_axis("y", -less / 2)
    p = kinematics.positions(PARENTS, clip.joint_offsets, poses.p_world_joint[:, 0], R)
    p[..., 2] += float(np.median(lowest - p[:, feet, 2].min(axis=1)))
    return replace(clip, poses=replace(poses, p_world_joint=p, R_world_bone=R))


def _tilt(R: Array) -> Array:
    return np.asarray(np.arctan2(-R[..., 2, 0], R[..., 2, 2]))


def with_still_second(clip: MocapClip, knees: Array, rng: Generator) -> MocapClip:
    """The person stands still, arms hanging, where the walk begins, and goes over into it."""
    poses, skeleton = clip.poses, SkeletonModel.default().with_offsets(clip.joint_offsets)
    R0 = skeleton.forward_kinematics(skeleton.n_pose()[None])[1][0]
    lean = np.radians(4.0 + 3.0 * rng.standard_normal())  # of the shanks, forward
    for (thigh, shank), knee in zip(KNEES, knees, strict=True):
        R0[skeleton.names.index(thigh)] = so3.about_axis("y", lean - knee)
        R0[skeleton.names.index(shank)] = so3.about_axis("y", lean)
    forward = poses.R_world_bone[0, 0, :, 0]
    R0 = so3.about_axis("z", float(np.arctan2(forward[1], forward[0]))) @ R0
    rate = poses.rate_hz
    n, b = round(STILL_S * rate), round(BLEND_S * rate)
    share = np.concatenate([np.zeros(n), (1 - np.cos(np.pi * np.arange(b) / b)) / 2])
    sway = np.radians(0.4) * np.sin(2 * np.pi * 0.4 * np.arange(n + b) / rate + 6 * rng.random())
    way = so3.log(np.swapaxes(R0, -1, -2) @ poses.R_world_bone[0])
    R = R0 @ so3.exp(share[:, None, None] * way) @ so3.about_axis("y", sway)[:, None]
    R = np.concatenate([R, poses.R_world_bone])
    root = poses.p_world_joint[:, 0]
    before = root[0] + (share - 1)[:, None] * (root[min(b, len(root) - 1)] - root[0]) * [0.3, 0.3, 0.0]
    p = kinematics.positions(PARENTS, clip.joint_offsets, np.concatenate([before, root]), R)
    feet = [poses.names.index(f"{side}Foot") for side in ("Left", "Right")]
    sunk = np.median(p[n + b :, feet, 2].min(axis=1)) - p[: n + b, feet, 2].min(axis=1)
    p[: n + b, :, 2] += np.where(share < 1, sunk * (1 - share), 0.0)[:, None]
    return replace(clip, poses=PoseSequence(np.arange(len(R)) / rate, p, R, poses.names))


def camera_at(poses: PoseSequence, place: str) -> Camera:
    """A camera beside the person or behind, from where it sees the whole walk."""
    p = poses.p_world_joint
    centre = (p.min(axis=(0, 1)) + p.max(axis=(0, 1))) / 2
    facing = poses.R_world_bone[:, 0, :2, 0].mean(axis=0)
    facing = facing / np.linalg.norm(facing)
    direction = np.array([-facing[1], facing[0]]) if place == "side" else -facing
    for distance in np.arange(3.5, 14.0, 0.5):
        camera = Camera.looking_at(np.array([*(centre[:2] + distance * direction), 1.2]), centre, 1250.0)
        uv, depth = camera.project(p), camera.to_camera(p)[..., 2]
        if ((uv > 0) & (uv < [camera.width_px, camera.height_px])).all(axis=-1).mean() > 0.97 and depth.min() > 1.0:
            break
    return camera


def seen(clip: MocapClip, camera: Camera, rng: Generator, displaced: bool) -> Any:
    """What the detector finds, its points beside the joints or where they are told to be."""
    skeleton, shown = SkeletonModel.default().with_offsets(clip.joint_offsets), clip.poses[::2]
    errors = DetectorErrors(person=0.0, camera=0.0, delay_frames=(0,))
    found = simulate_detections(rng, shown, skeleton, camera, errors)
    if displaced:
        uv, places = np.array(found.uv_px), detector_error_table().places
        drawn: Mapping[str, Array] = {joint: BESIDE_M * rng.standard_normal(3) for joint in skeleton.names}
        for k, (joint, frame) in enumerate(zip(places.anchor, places.frame, strict=True)):
            j, f = skeleton.index(joint, frame)
            knee = joint in ("LeftLeg", "RightLeg")
            place = np.array([-BEHIND_M, 0.0, 0.0]) if knee else drawn[joint]
            at = shown.p_world_joint[:, j]
            uv[:, 0, k] += camera.project(at + shown.R_world_bone[:, f] @ place) - camera.project(at)
        found = replace(found, uv_px=uv)
    return keypoints_from_detections(found, shown.times, camera).keypoints


def unmounted(imus: ImuSequence, rng: Generator) -> ImuSequence:
    """Sensors with any heading, turned in their cases."""
    S = len(imus.names)
    case = so3.exp(rng.uniform(-np.pi, np.pi, (S, 3)) / np.sqrt(3))
    R = so3.about_axis("z", rng.uniform(-np.pi, np.pi, S)) @ imus.R_inertial_sensor @ case
    return replace(imus, R_inertial_sensor=R, f_sensor=np.einsum("sji,tsj->tsi", case, imus.f_sensor))


def reconstructed(case: str, clip: MocapClip, place: str, seed: int) -> Reconstruction:
    """Simulate and reconstruct a walk."""
    rng, camera = np.random.default_rng(seed), camera_at(clip.poses, place)
    sensors = () if case == "camera alone" else harness.SENSOR_SETS["8"]
    settings = replace(SimulationSettings.perfect(), sensors=sensors)
    made = simulate(clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=seed, name=clip.name)
    right = case.startswith("right")
    keypoints = seen(clip, camera, rng, displaced=not right)
    height = made.skeleton.height
    own = Recording(clip.name, keypoints=keypoints, height=height, floor_height=0.0, truth=made.truth)
    if case == "camera alone":
        return reconstruct(own)
    imus, given = made.imus, made.calibration
    assert imus is not None
    assert given is not None
    if right:
        own = replace(own, imus=imus, calibration=given, height=None, joint_offsets=clip.joint_offsets)
        return reconstruct(own, calibrate=case == "right, calibrated")
    imus = unmounted(imus, rng)
    joints, skeleton = dict(zip(given.sensors, given.joints, strict=True)), own.skeleton
    poses = lift(keypoints, skeleton, None, None, 0.0).poses
    log = SensorLog.of_imus(imus, "imus")
    found = align_sensors(poses, keypoints, log, joints, skeleton, calibrate_recording)
    return reconstruct(replace(own, imus=imus, calibration=found.calibration), calibrate=True)


def rows_of(case: str, clip: MocapClip, place: str, seed: int) -> Iterator[Row]:
    """Errors of knees and elbows of both sides."""
    result = reconstructed(case, clip, place, seed)
    truth = result.recording.truth
    assert truth is not None
    found, skeleton = clinical_angles(result.motion), SkeletonModel.default().with_offsets(clip.joint_offsets)
    true = clinical_angles(all_observed(at_times(truth, found.times)), skeleton)
    assert found.sigma is not None
    for hinge, names in ANGLES.items():
        for name in names:
            off = np.degrees(found[name] - true[name])
            sigma = np.degrees(found.sigma[:, found.names.index(name)])
            known = np.isfinite(off + sigma)
            off, sigma = off[known], sigma[known]
            yield {
                "case": case,
                "hinge": hinge,
                "side": name.partition("_")[0],
                "constant_deg": round(float(np.median(off)), 3),
                "curve_deg": round(float(np.mean(np.abs(off - np.median(off)))), 3),
                "all_deg": round(float(np.mean(np.abs(off))), 3),
                "inside": round(float(np.mean(np.abs(off) <= BAND_95 * sigma)), 3),
                "stated_deg": round(float(np.sqrt(np.mean(sigma**2))), 3),
            }


def walks(
    corpus: Path, people: Sequence[str], seconds: Sequence[float], bent_deg: float = 0.0
) -> Iterator[tuple[str, float, bool, MocapClip]]:
    """Person, seconds, whether with a still second, and the motion."""
    names = {n for person in people for n in WALKS[person]}
    clips = {c.name: c for c in harness.whole_clips(corpus, list(people), sorted(names))}
    for person in people:
        own = [clips[name] for name in WALKS[person]]
        for length in seconds:
            rng = np.random.default_rng(zlib.crc32(f"{person} {length:g}".encode()))
            walking, standing = habit(rng, bent_deg)
            enough = own * (1 + int(length))
            walk = straightened(joined(enough, length, f"{person} {length:g} s"), walking)
            for still in (False, True):
                yield person, length, still, with_still_second(walk, standing, rng) if still else walk


def report(rows: Sequence[Row]) -> str:
    """Tables as Markdown."""
    lines = [f"# The zero of knees and elbows\n\n{(__doc__ or '').partition(chr(10))[2].strip()}\n"]
    heads = ["hinge", "case", "still second", "constant: median", "90 %", "most", "curve", "inside 95 %", "stated"]
    lines += [f"| {' | '.join([*heads, 'sides'])} |", "|---" * (len(heads) + 1) + "|"]
    for hinge, case, still in product(ANGLES, CASES, (False, True)):
        own = [r for r in rows if (r["hinge"], r["case"], r["still"]) == (hinge, case, still)]
        if own:
            size = np.abs([r["constant_deg"] for r in own])
            curve, inside, stated = (np.mean([r[k] for r in own]) for k in ("curve_deg", "inside", "stated_deg"))
            figures = [f"{f:.1f}" for f in (np.median(size), np.percentile(size, 90), size.max(), curve)]
            about = [hinge, case, "yes" if still else "no", *figures, f"{inside:.2f}", f"{stated:.1f}", str(len(own))]
            lines.append(f"| {' | '.join(about)} |")
    lines += ["\nKnees, constant error in degrees, left and right:\n"]
    heads = ["person", "seconds", "still second", "camera", *CASES]
    lines += [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for key in dict.fromkeys((r["person"], r["seconds"], r["still"], r["camera"]) for r in rows):
        cells = []
        for case in CASES:
            own = [r for r in rows if (r["person"], r["seconds"], r["still"], r["camera"]) == key]
            own = [r for r in own if r["case"] == case and r["hinge"] == "knee"]
            cells.append(", ".join(f"{r['constant_deg']:.1f}" for r in own))
        about = [key[0], f"{key[1]:g}", "yes" if key[2] else "no", key[3]]
        lines.append(f"| {' | '.join([*about, *cells])} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("hinge_zero", __doc__)
    parser.add_argument("--people", default=",".join(WALKS))
    parser.add_argument("--seconds", default="6,20,60")
    parser.add_argument("--cases", default="camera alone;run", help="of " + "; ".join(CASES))
    parser.add_argument("--cameras", default="side,behind")
    parser.add_argument("--bent", type=float, default=0.0, help="deg more than usual of all knees, as of patients")
    options = parser.parse_args(arguments)
    rows: list[Row] = json.loads(options.out.read_text()) if options.out.exists() else []
    done = {(r["person"], r["seconds"], r["still"], r["camera"], r["case"]) for r in rows}
    cases = [case for case in CASES if case in options.cases.split(";")]
    lengths = [float(s) for s in options.seconds.split(",")]
    for person, seconds, still, clip in walks(options.corpus, options.people.split(","), lengths, options.bent):
        for place in options.cameras.split(","):
            for case in cases:
                if (person, seconds, still, place, case) in done:
                    continue
                about = {"person": person, "seconds": seconds, "still": still, "camera": place}
                seed = zlib.crc32(f"{person} {seconds} {place}".encode())
                own = [about | row for row in rows_of(case, clip, place, seed)]
                rows += own
                options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
                print(*about.values(), case, [row["constant_deg"] for row in own], own[0]["inside"], flush=True)
    options.out.with_suffix(".md").write_text(report(rows) + "\n", encoding="utf-8")
    print(report(rows))


if __name__ == "__main__":
    main()
