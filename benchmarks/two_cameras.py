"""Two cameras against one: realistic 2D, held-out people and rigs, cameras 60 to 90 degrees apart.

``python -m benchmarks two_cameras --corpus DIR``. Of the second camera, heading, position and clock are
unknown, its tilt is 3 to 5 degrees off, and the focal lengths of both are 5 to 10 % off; the first camera's
orientation, which is that of the world, is known. `rtof_kin.calibration.second_camera` finds the rest from the
person. *Calibrated* cameras are as a calibration gives them, with the errors of real ones.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks import scoring
from benchmarks.command_line import study_parser
from benchmarks.harness import bootstrap, middle, test_clips, write_results
from rtof_kin.calibration.second_camera import SecondCamera
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.join import find_second_camera
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras

FOCAL, TILT_DEG, APART_DEG, CLOCK = (0.05, 0.10), (3.0, 5.0), (60.0, 90.0), (-60.0, 60.0)
"""Ranges: error of the focal lengths [1], of the second camera's tilt, angle between the cameras, clock s."""
SHORTEST = 3.0
"""[s] of a motion."""
FIGURES = {
    "mpjpe_rr_mm": ("rr mm", 1),
    "mpjpe_mm": ("abs mm", 1),
    "flexion_deg": ("flexion deg", 1),
    "inside_relative": ("rr in 95 % bands", 2),
    "sigma_relative_mm": ("stated rr mm", 1),
    "rms_relative_mm": ("actual rr mm", 1),
}


def second_view(poses_camera: Camera, centre: Array, rng: Generator) -> Camera:
    """A camera at the same distance, turned about the middle of the motion, at a height of its own."""
    off = poses_camera.center_world - centre
    angle = np.radians(rng.uniform(*APART_DEG)) * rng.choice([-1, 1])
    position = centre + so3.about_axis("z", float(angle)) @ off
    position[2] = rng.uniform(0.8, 2.6)
    return Camera.looking_at(position, centre, poses_camera.K[0, 0])


def recordings(clip: MocapClip, seed: int) -> tuple[Recording, KeypointSequence, Generator]:
    """One person, sensors and first camera; the second camera's keypoints; and what draws the unknowns."""
    own = seed * 1_000_003 + zlib.crc32(clip.name.encode())
    rng = np.random.default_rng(own)
    p = clip.poses.p_world_joint
    first = standard_cameras(clip.poses, own)[0]
    second = second_view(first, (p.min(axis=(0, 1)) + p.max(axis=(0, 1))) / 2, rng)
    seen = [
        simulate(
            clip.poses,
            clip.joint_offsets,
            camera=camera,
            settings=SimulationSettings.realistic(),
            seed=own + i,
            name=clip.name,
        )
        for i, camera in enumerate((first, second))
    ]
    return seen[0], seen[1].video, rng


def wrong_focal(camera: Camera, rng: Generator) -> Camera:
    """The camera with a focal length that is some per cent off."""
    K = camera.K.copy()
    K[:2, :2] *= 1 + rng.uniform(*FOCAL) * rng.choice([-1, 1])
    return replace(camera, K=K)


def unknown_pose(keypoints: KeypointSequence, rng: Generator) -> KeypointSequence:
    """A camera that stands at its height over the origin and looks along x, on a clock of its own."""
    camera = wrong_focal(keypoints.camera, rng)
    off = np.radians(rng.uniform(*TILT_DEG, 2)) * rng.choice([-1, 1], 2)
    camera = over_origin(camera, so3.exp(np.array([off[0], 0.0, off[1]])))
    return replace(keypoints, camera=camera, times=keypoints.times + rng.uniform(*CLOCK))


def over_origin(camera: Camera, R_wrong: Array) -> Camera:
    """The camera over the origin, looking along x, turned by a further rotation."""
    forward = camera.R_camera_world[2]
    R = R_wrong @ camera.R_camera_world @ so3.about_axis("z", float(np.arctan2(forward[1], forward[0])))
    return replace(camera, R_camera_world=R, t_camera_world=-R @ np.array([0.0, 0.0, camera.center_world[2]]))


def measure(clip: MocapClip, seed: int) -> list[dict[str, Any]]:
    """A row for every case, with sensors and without."""
    sensed, second, rng = recordings(clip, seed)
    first, unknown = wrong_focal(sensed.video.camera, rng), unknown_pose(second, rng)
    rows = []
    for sensors in (8, 0):
        exact = sensed if sensors else replace(sensed, imus=None, calibration=None)
        given = replace(exact, keypoints=replace(exact.video, camera=first))
        found = find_second_camera(given, unknown)
        cases = {
            "one, focal length off": given,
            "two, second found": found.apply(given),
            "one, calibrated": exact,
            "two, calibrated": replace(exact, views=(second,)),
        }
        for case, recording in cases.items():
            mode = "rtof" if sensors else "rto"
            figures = scoring.figures(reconstruct(recording, mode=mode), mode)
            row = {"motion": clip.name, "rig": clip.rig, "sensors": sensors, "case": case}
            row |= {name: figures[name] for name in FIGURES}
            if case.startswith("two, second"):
                row["camera"] = camera_errors(found, second, unknown)
            rows.append(row)
    return rows


def camera_errors(found: SecondCamera, true: KeypointSequence, given: KeypointSequence) -> dict[str, Any]:
    """Errors of the second camera, and what was stated."""
    camera = found.view.camera
    turn = so3.log(true.camera.R_camera_world.T @ camera.R_camera_world)
    moved = camera.center_world - true.camera.center_world
    return {
        "turn_deg": float(np.degrees(np.linalg.norm(turn))),
        "sigma_turn_deg": float(np.degrees(np.linalg.norm(found.sigma_turn))),
        "moved_m": float(np.linalg.norm(moved)),
        "sigma_moved_m": float(np.linalg.norm(found.sigma_position)),
        "focal": float(camera.K[0, 0] / true.camera.K[0, 0] - 1),
        "sigma_focal": float(found.sigma_focal[1]),
        "clock_ms": 1e3 * float(found.offset + given.times[0] - true.times[0]),
        "doubt": found.doubt,
    }


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """All tables as Markdown."""
    cells, cameras = [], []
    for sensors in (8, 0):
        own = [row for row in rows if row["sensors"] == sensors]
        by_case = {case: [r for r in own if r["case"] == case] for case in dict.fromkeys(r["case"] for r in own)}
        for case, chosen in by_case.items():
            base = by_case["one, calibrated" if "calibrated" in case else "one, focal length off"]
            one, two = (np.array([row["mpjpe_rr_mm"] for row in part]) for part in (base, chosen))
            values = [float(np.mean([row[name] for row in chosen])) for name in FIGURES]
            ratio = two.sum() / one.sum()
            low, high = bootstrap([row["motion"] for row in chosen], two / one, one)
            cells.append((sensors, case, *values, float(ratio), f"{low:.2f}-{high:.2f}"))
        found = [row["camera"] for row in own if "camera" in row]
        names = [name for name in found[0] if name != "doubt"]
        cameras.append(
            (
                sensors,
                *(float(np.median(np.abs([f[name] for f in found]))) for name in names),
                float(np.mean([not f["doubt"] for f in found])),
            )
        )
    motions = len({row["motion"] for row in rows})
    first = Table(
        "two_cameras",
        f"Two cameras and one, {motions} motions",
        ("sensors", "cameras", *(heading for heading, _ in FIGURES.values()), "rr of two / one", "95 %"),
        (0, 0, *(digits for _, digits in FIGURES.values()), 2, 0),
        tuple(cells),
        ("Ratios are of the mean errors, with a bootstrap interval over motions.",),
    )
    second = Table(
        "second_camera",
        "The second camera, medians of sizes of errors",
        ("sensors", "turn deg", "stated", "moved m", "stated", "focal 1", "stated", "clock ms", "sure"),
        (0, 1, 1, 2, 2, 3, 3, 0, 2),
        tuple(cameras),
        ("The clock is against the pictures' own stamps; simulated detectors are late by 17 to 50 ms.",),
    )
    return first.markdown() + "\n" + second.markdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("two_cameras", __doc__)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each motion")
    parser.add_argument("--motions", help="only these, separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    chosen = [middle(clip, options.seconds) for clip in test_clips(options.corpus)]
    wanted = options.motions.split(",") if options.motions else [clip.name for clip in chosen]
    rows: list[dict[str, Any]] = []
    command = f"python -m benchmarks two_cameras --corpus DIR --seconds {options.seconds:g}"
    command += f" --motions {options.motions}" if options.motions else ""
    for clip in chosen:
        if clip.name in wanted and clip.poses.times[-1] >= SHORTEST:
            rows += measure(clip, options.seed)
            print(clip.name, [round(row["mpjpe_rr_mm"], 1) for row in rows[-8:]], file=sys.stderr, flush=True)
            write_results(options.out, {"command": command, "rows": rows}, tables(rows))
    print(tables(rows))


if __name__ == "__main__":
    main()
