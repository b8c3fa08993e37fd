"""An hour of raw files set up by ``run``: seconds of the processor, and the most memory resident.

``python -m benchmarks long_raw --corpus DIR --files FOLDER``: every motion of the corpus on one body, in random order,
each turned, drawn into the picture and joined to the one before within a second, until the hour is full; a detector's
points at 60 Hz, eight sensors at 60 Hz without names on a clock of their own (`from_raw.write_raw`), the person's
height. Memory is that of ``rtof-kin run --only recording`` alone, in a process of its own; FOLDER keeps the files.
Fails above 700 MB.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from benchmarks.command_line import in_parallel, study_parser
from benchmarks.from_raw import write_raw
from benchmarks.harness import SENSOR_SETS
from benchmarks.long_outputs import MOST_MB, OUTPUT, measured
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.environment import processor
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.detector_errors import DetectorErrors, simulate_detections
from rtof_kin.simulation.mocap import MocapClip, read_corpus
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

RATE_HZ: Final = 60.0
REACH, JOINED = 1.2, 1.0  #: [m] from the middle that a motion hardly leaves, and [s] between two motions


def every_motion(clips: list[MocapClip], skeleton: SkeletonModel, seconds: float, rng: Generator) -> PoseSequence:
    """The motions in random order on one body, each at least once, then again, until the time is full."""
    times, R, root, end = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), 0.0
    while end < seconds:
        for i in rng.permutation(len(clips)):
            poses, yaw = clips[i].poses, so3.about_axis("z", float(rng.uniform(-np.pi, np.pi)))
            p = poses.p_world_joint[:, 0] * skeleton.height / _height(clips[i])
            middle = p[:, :2] - p[:, :2].mean(axis=0)
            p[:, :2] = REACH * np.tanh(middle / REACH)
            times.append(end + poses.times - poses.times[0])
            R.append(yaw @ poses.R_world_bone)
            root.append(p @ yaw.T)
            end = float(times[-1][-1]) + JOINED
    t, at = np.concatenate(times), np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    turned = signals.interpolate_rotations(t, np.concatenate(R), at)
    p_root = signals.interpolate(t, np.concatenate(root), at)
    p_joint = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p_root, turned)
    return PoseSequence(at, p_joint, turned, skeleton.names)


def _height(clip: MocapClip) -> float:
    return SkeletonModel.default().with_offsets(clip.joint_offsets).height


def write_hour(folder: Path, corpus: Path, minutes: float, seed: int = 0) -> None:
    """Write the files of a user, of a person of 1.75 m before a camera of 1920 x 1080 pixels."""
    rng, skeleton = np.random.default_rng(seed), SkeletonModel.default().with_height(1.75)
    clips = [low_passed(clip, 10.0) for clip in read_corpus(corpus, output_rate_hz=RATE_HZ)]
    poses = every_motion(clips, skeleton, 60 * minutes, rng)
    camera = standard_cameras(poses[:: round(RATE_HZ)], seed)[0]
    found = simulate_detections(rng, poses, skeleton, camera, DetectorErrors())
    settings = replace(SimulationSettings.realistic(), sensors=SENSOR_SETS["8"])
    recording = simulate(poses, skeleton.joint_offsets, camera=camera, settings=settings, seed=seed, name="hour")
    folder.mkdir(parents=True)
    write_raw(folder, recording, replace(found, times=poses.times), rng)


def main() -> None:
    """Run the command."""
    parser = study_parser("long_raw", __doc__, page="")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--files", type=Path, help="folder of the raw files, which are made where it is missing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.files or Path(temporary) / "files"
        if not folder.exists():
            # In another process: the memory of this one counts in that of those it starts.
            in_parallel(partial(write_hour, corpus=options.corpus, minutes=options.minutes), [folder])
        files = [str(folder / name) for name in ("keypoints.npz", "sensors.csv")]
        told = ("--height", "1.75", "--size", "1920x1080", "--person", "1")
        (output := Path(temporary) / "out").mkdir()
        found = measured(("run", *files, *told, "--only", "recording", "-o", OUTPUT), output / "recording")
    print(f"{options.minutes:g} minutes, {processor()}: " + ", ".join(f"{v:.0f} {k}" for k, v in found.items()))
    if found["peak_mb"] > MOST_MB:
        sys.exit(f"{found['peak_mb']:.0f} MB are more than {MOST_MB:g}")


if __name__ == "__main__":
    main()
