"""A camera that is held by hand and turns, beside the same recording from a tripod.

``python -m benchmarks handheld --corpus DIR`` films motions of held-out people and rigs with a camera that
pans and shakes by up to 20 degrees about its optical centre: detections are simulated as that camera sees the
person, who leaves its image at times, with the errors of a real detector (realistic 2D), 8 sensors and none,
as given. Its turning is known exactly, with the errors of an estimate, or estimated from a rendered
background; the hand moves by some centimetres too in some; and it is ignored. All cases of a recording share
their random numbers. Rows are written as they come: an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks import harness
from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.calibration.planted_rows import SESSIONS, session
from benchmarks.command_line import study_parser
from benchmarks.turning_video import pan_and_shake, write_turning_video
from lifting.predict import Lifter
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.protocols.tables import Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.simulation.detector_errors import DELAY_RATE_HZ, DetectorErrors
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras
from rtof_kin.vision.background_motion import estimate_camera_motion, with_focal

FIGURES = {"mpjpe_rr_mm": "rr mm", "mpjpe_mm": "abs mm", "flexion_deg": "flexion deg"}
DELAY = 2
"""Frames at 60 Hz by which detections are late; drawn elsewhere."""
DRIFT, NOISE = np.radians(1.0) / 20.0, np.radians(0.15)
"""Of an estimated turning: rad/s about the vertical, and rad per axis and frame."""
GYROSCOPE = np.radians(0.15)
"""[rad/s] Drift of a bad gyroscope, alone."""
HAND_HZ = 0.4
RENDERED = 0.25
"""Size of the rendered video, of the camera's image."""


@dataclass(frozen=True)
class Case:
    """What the camera does, and what is known of it."""

    turns: bool = True
    known: str = "exactly"
    """exactly, not, as estimated, or from a video."""
    hand: float = 0.0
    """[m] standard deviation per axis of the optical centre."""
    drift: float = DRIFT
    """[rad/s] of the heading, *as estimated*."""
    removed: bool = False
    """Whether the drift is estimated against the sensors."""


CASES = {
    "tripod": Case(turns=False),
    "turning known exactly": Case(),
    "turning with errors of an estimate": Case(known="as estimated"),
    "turning from a rendered background": Case(known="from a video"),
    "known exactly while the hand moves by 3 cm": Case(hand=0.03),
    "tripod that moves by 3 cm": Case(turns=False, hand=0.03),
    "turning ignored": Case(known="not"),
}
LONG_CASES = {
    "tripod": CASES["tripod"],
    "turning known exactly": CASES["turning known exactly"],
    "heading drifts by 3 deg": Case(known="as estimated", drift=GYROSCOPE),
    "heading drifts by 3 deg, found against the sensors": Case(known="as estimated", drift=GYROSCOPE, removed=True),
}
"""On sessions of 20 s with sensors."""
HEAD = f"""# Handheld camera

`python -m benchmarks handheld`: pan of 18 deg and shake of up to 4 deg at 1 to 3 Hz, realistic 2D, held-out
people and rigs, as given. *errors of an estimate*: heading drifts by 1 deg in 20 s, white noise of
{np.degrees(NOISE):.2f} deg per axis. *hand moves*: standard deviation per axis, at {HAND_HZ} Hz.
*in view*: points that were detected. *rr change*: mean over recordings of the change against the tripod, and
its 95 % bootstrap interval over motions.

"""


def seen_by_hand(poses: PoseSequence, camera: Camera, R_middle_camera: Array, p_hand: Array) -> PoseSequence:
    """The motion in the world in which the camera that turns and moves stands still."""
    R = camera.R_camera_world
    R_moved = R.T @ np.swapaxes(R_middle_camera, -1, -2) @ R
    c = camera.center_world
    p = np.einsum("tij,tnj->tni", R_moved, poses.p_world_joint - c - p_hand[:, None]) + c
    return replace(poses, p_world_joint=p, R_world_bone=R_moved[:, None] @ poses.R_world_bone)


def solved(clip: MocapClip, number: int, sensors: str, case: Case, lifter: Lifter) -> dict[str, float]:
    """Figures of one recording."""
    own = zlib.crc32(clip.name.encode())
    rng, of_hand, of_errors = np.random.default_rng(own).spawn(3)
    camera = standard_cameras(clip.poses, own)[number]
    settings = SimulationSettings(
        keypoints=DetectorErrors(delay_frames=(DELAY,)), sensors=harness.SENSOR_SETS.get(sensors, ())
    )
    films = {"joint_offsets": clip.joint_offsets, "camera": camera, "seed": own + number}
    recording = simulate(clip.poses, settings=settings, name=clip.name, **films)
    times = clip.poses.times
    turn = pan_and_shake(rng, times) if case.turns else np.tile(np.eye(3), (len(times), 1, 1))
    hand = case.hand * np.sqrt(2) * np.sin(2 * np.pi * (HAND_HZ * times[:, None] + of_hand.random(3)))
    poses = seen_by_hand(clip.poses, camera, turn, hand)
    filmed = simulate(poses, settings=replace(settings, sensors=()), **films).video
    shown = np.maximum(filmed.times - DELAY / DELAY_RATE_HZ, times[0])
    R = signals.interpolate_rotations(times, turn[:, None], shown)[:, 0]
    keypoints = filmed if case.known == "not" else still(filmed, R, case, of_errors)
    result = reconstruct(
        replace(recording, keypoints=keypoints),
        mode="rtof" if recording.imus is not None else "rto",
        lifter=lifter,
        settings=ReconstructionSettings(confidence=False),
        calibrate=False,
    )
    assert result.metrics is not None
    found = {figure: float(result.metrics[figure]) for figure in FIGURES}
    return found | {"in view": 100 * float(filmed.seen.mean())}


def still(filmed: KeypointSequence, R_middle_camera: Array, case: Case, rng: np.random.Generator) -> KeypointSequence:
    """Keypoints of the camera that stands still, whose pose is known."""
    camera, times = filmed.camera, filmed.times
    motion = CameraMotion(times, R_middle_camera)
    declared = replace(
        camera,
        R_camera_world=motion.R_first_still.T @ camera.R_camera_world,
        t_camera_world=motion.R_first_still.T @ camera.t_camera_world,
    )
    if case.known == "as estimated":
        drift = so3.exp(case.drift * (times - times.mean())[:, None] * camera.R_camera_world[:, 2])
        noise = so3.exp(NOISE * rng.normal(size=(len(times), 3)))
        sigma_drift = np.radians(0.1) if case.removed else 0.0
        motion = CameraMotion(times, drift @ R_middle_camera @ noise, drift=sigma_drift)
    elif case.known == "from a video":
        motion = from_video(filmed, R_middle_camera)
    return stabilised(replace(filmed, camera=declared), motion)


def from_video(filmed: KeypointSequence, R_middle_camera: Array) -> CameraMotion:
    """Turning of the camera by a rendered background, with a focal length that is 5 % wrong."""
    size = {
        "width_px": round(RENDERED * filmed.camera.width_px),
        "height_px": round(RENDERED * filmed.camera.height_px),
    }
    camera = replace(filmed.camera, K=np.diag([RENDERED, RENDERED, 1.0]) @ filmed.camera.K, **size)
    small = replace(filmed, camera=camera, times=filmed.times - filmed.times[0], uv_px=RENDERED * filmed.uv_px)
    boxes = np.full((len(small), 4), np.nan)
    some = small.seen.any(axis=1)
    boxes[some] = np.concatenate([np.nanmin(small.uv_px[some], axis=1), np.nanmax(small.uv_px[some], axis=1)], axis=-1)
    guess = with_focal(camera, 1.05)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_turning_video(path, R_middle_camera, camera, 60.0, boxes)
        found = estimate_camera_motion(path, replace(small, camera=guess), guess, sigma_focal=0.1)
    return found.motion.shifted(float(filmed.times[0]))


def measured(clips: Sequence[MocapClip], cases: Mapping[str, Case], sensors: Sequence[str], file: RowFile) -> None:
    """Make the rows that are missing; motions take turns with the cameras."""
    lifter = Lifter.load()
    jobs = [
        (f"{name}/{clip.name}/{i % 4}/{count}/{cases is LONG_CASES}", clip, i % 4, count, name)
        for i, clip in enumerate(clips)
        for count in sensors
        for name in cases
    ]
    for key, clip, camera, count, name in track([job for job in jobs if job[0] not in file.rows], "recordings"):
        held = "rigs" if clip.rig in harness.split()["benchmark"]["rigs"] else "people"
        about = {
            "case": name,
            "motion": clip.name,
            "sensors": count,
            "camera": camera,
            "held out": held,
            "long": cases is LONG_CASES,
        }
        file.add(key, [about | solved(clip, camera, count, cases[name], lifter)])


def tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """Figures of each case, and the change of the root-relative error against the tripod."""
    found = []
    for long, count in dict.fromkeys((row["long"], row["sensors"]) for row in rows):
        own = [row for row in rows if (row["long"], row["sensors"]) == (long, count)]
        tripod = {(row["motion"], row["camera"]): row["mpjpe_rr_mm"] for row in own if row["case"] == "tripod"}
        lines = []
        for name in LONG_CASES if long else CASES:
            case = [row for row in own if row["case"] == name]
            if not case:
                continue
            change = [100 * (row["mpjpe_rr_mm"] / tripod[row["motion"], row["camera"]] - 1) for row in case]
            low, high = harness.bootstrap([row["motion"] for row in case], change, np.ones(len(case)))
            means = [float(np.mean([row[figure] for row in case])) for figure in (*FIGURES, "in view")]
            lines.append((name, len(case), *means, float(np.mean(change)), f"{low:+.0f} to {high:+.0f}"))
        columns = ("camera", "recordings", *FIGURES.values(), "in view %", "rr change %", "95 %")
        title = ("Sessions of 20 s, " if long else "") + (f"{count} sensors" if count != "0" else "No sensors")
        found.append(Table(f"sensors_{count}_{long}", title, columns, (0, 0, 1, 1, 1, 0, 0, 0), tuple(lines)))
    return found


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("handheld", __doc__)
    parser.add_argument("--motions", help="names, with commas; default: all of the benchmark")
    parser.add_argument("--sensors", default="8,0", help="numbers of sensors, with commas")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each motion's middle")
    parser.add_argument("--restart", action="store_true", help="throw rows of other code away")
    options = parser.parse_args(arguments)
    clips = [harness.middle(clip, options.seconds) for clip in harness.test_clips(options.corpus)]
    if options.motions:
        clips = [clip for clip in clips if clip.name in options.motions.split(",")]
    file = RowFile(options.out.with_suffix(".rows"), version_of(options.seconds), options.restart)
    measured(clips, CASES, options.sensors.split(","), file)
    sessions = [session(options.corpus, "test", name, 20.0) for name in SESSIONS["test"]]
    measured(2 * sessions, LONG_CASES, ("8",), file)  # two cameras each
    rows = [row for own in file.rows.values() for row in own]
    text = HEAD + "\n".join(table.markdown() for table in tables(rows))
    print(harness.write_results(options.out, {"seconds": options.seconds, "rows": rows}, text))


if __name__ == "__main__":
    main()
