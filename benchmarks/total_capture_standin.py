"""A stand-in for Total Capture: folders in its formats, quirks included, made from free motion.

It is NOT Total Capture. That is handed out by its authors for research only; here CMU's motion moves
bodies of its five subjects' proportions, and the IMUs, cameras and detections are simulated. What is
measured on it shows that files are read correctly and a protocol runs, not the accuracy on the dataset.

``python -m benchmarks total_capture_standin --corpus DIR --out FOLDER`` with DIR as in README.md here.
Subjects S1, S2 and S3 move as training subjects of split.toml do, but for the three test takes, which are
of its test subjects, as everything of S4 and S5 is.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks import total_capture_files as files
from benchmarks.keypoint_noise import independent
from benchmarks.total_capture_motion import (
    BLEND_FRAMES,
    RATE_HZ,
    SHORTEST_CLIP,
    STILL_FRAMES,
    body,
    cameras,
    carried_over,
    choose_motions,
    from_t_pose,
)
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.simulation.simulate import another_person, simulate

WITHOUT_ORIENTATIONS = (("S2", "rom2"), ("S3", "rom1"), ("S3", "rom2"), ("S3", "rom3"))
CAMERA_2_BIAS_PX = (20.0, -8.0)
"""Error of the miscalibrated real camera 2, px."""
_STAMP = 107.0
_SHORTER_VIDEO = {("S1", "acting3"): 90}
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with\n"
    "funding from NSF EIA-0196217."
)
README = f"""A stand-in for Total Capture, written by benchmarks/total_capture_standin.py.
It is not Total Capture.

The motion is CMU's, carried over to other bodies; the IMUs and all calibrations are simulated. Only names
and formats of the files are those of Total Capture (Trumble et al., BMVC 2017), whose authors hand the
real one out for research. No figure measured here may be reported as one of Total Capture.

{ACKNOWLEDGEMENT}
"""


@dataclass(frozen=True)
class StandInTake:
    """Everything about one take, in the package's units and frames."""

    subject: str
    """'S1' to 'S5'."""
    name: str
    """'acting3' and so on."""
    poses: PoseSequence
    """The motion, 60 Hz from time 0."""
    joint_offsets: Array
    """(21, 3) m, link axes of the parent."""
    imus: ImuSequence
    """Simulated sensors, one sample per frame."""
    calibration: ImuCalibration
    """Their calibration, as far as it is known."""


# --- takes ---------------------------------------------------------------------------------------


def make_take(
    subject: str,
    name: str,
    poses: PoseSequence,
    joint_offsets: Array,
    *,
    noise: ImuNoise | None = None,
    stamp: bool = True,
    seed: int = 0,
) -> StandInTake:
    """A take of a motion, with thirteen simulated sensors.

    All sensors share an inertial frame, which is off the world's by a small heading and about a degree
    of tilt, as the real calibrations have it.

    Args:
        poses: 60 Hz from time 0, joints in the order of `NAMES`. joint_offsets: (21, 3) m, theirs.
        noise: of the sensors; realistic where not given.
        stamp: whether the accelerometers at the feet show a stamp in the first ten frames.
        seed: of everything random, with subject and name.
    """
    rng = np.random.default_rng([seed, zlib.crc32(f"{subject} {name}".encode())])
    imus, calibration = simulate_imus(
        rng, poses, _skeleton(), tuple(_skeleton().sensors), poses.times, noise or ImuNoise()
    )
    tilt = so3.exp(np.radians(0.7) * np.array([*rng.standard_normal(2), 0.0]))
    R_world_inertial = tilt @ so3.about_axis("z", np.radians(rng.uniform(-6, 6)))
    R_new_old = R_world_inertial.T @ calibration.R_world_inertial
    f_sensor = np.array(imus.f_sensor)
    if stamp:
        shape = np.array([0.2, 1.0, -0.5, 0.2])[: max(len(f_sensor) - 2, 0)]
        for s, sensor in enumerate(imus.names):
            if sensor.endswith("Foot"):
                f_sensor[2 : 2 + len(shape), s, 2] += _STAMP * shape
    S = len(imus.names)
    return StandInTake(
        subject,
        name,
        poses,
        joint_offsets,
        replace(imus, R_inertial_sensor=R_new_old @ imus.R_inertial_sensor, f_sensor=f_sensor),
        replace(calibration, R_world_inertial=np.tile(R_world_inertial, (S, 1, 1))),
    )


@cache
def _skeleton() -> SkeletonModel:
    return SkeletonModel.default()


def write_take(
    root: Path, take: StandInTake, layout: str = "one", *, orientations: bool = True, aux: bool = True
) -> dict[str, Path]:
    """Write the files of a take below the dataset's folder.

    Args:
        layout: one of `total_capture_files.LAYOUTS`. orientations, aux: whether those are written.

    Returns:
        The paths that `total_capture_files.take_paths` names, of what was written.
    """
    paths = files.take_paths(layout, take.subject, take.name)
    paths = {kind: root / path for kind, path in paths.items()}
    for kind, wanted in (("orientations", orientations), ("aux", aux)):
        if not wanted:
            del paths[kind]
    poses = take.poses
    files.write_joints(paths["positions"], files.tc_positions(poses.p_world_joint))
    if orientations:
        quat = files.quat_xyzw(files.tc_rotations(poses.R_world_bone))
        files.write_joints(paths["orientations"], quat)
    files.write_sensors(paths["sensors"], take.imus)
    if aux:
        files.write_sensors(paths["aux"], take.imus, aux=True)
    files.write_imu_calibration(paths["ref"], paths["bone"], take.calibration)
    return paths


def write_detections(folder: Path, take: StandInTake, number: int, camera: Camera, seed: int) -> Path:
    """A detector's 2D of a take: `rtof_kin.simulation.noise`, a few frames late, camera 2 off.

    Video of some takes ends before the motion does, as the real one.

    Returns:
        The file, ``TC_S5_acting3_cam1.npz``: uv_px (T, 21, 2), confidence (T, 21). ``landmarks.txt``
        beside it names the 21.
    """
    about_take = zlib.crc32(f"{take.subject} {take.name}".encode())
    lag = int(np.random.default_rng([seed, about_take]).integers(1, 4))
    poses = take.poses
    before = [poses[:1]] * lag  # what was before the start: the subject stood still
    padded = PoseSequence(
        np.arange(lag + len(poses)) / RATE_HZ,
        np.concatenate([*(one.p_world_joint for one in before), poses.p_world_joint]),
        np.concatenate([*(one.R_world_bone for one in before), poses.R_world_bone]),
        poses.names,
    )
    late = (float(lag), float(lag))
    settings = replace(independent(), sensors=(), video_lag_frames=late)
    random = int(np.random.default_rng([seed, about_take, number]).integers(2**31))
    recording = simulate(padded, take.joint_offsets, camera=camera, settings=settings, seed=random)
    shorter = _SHORTER_VIDEO.get((take.subject, take.name), 0)
    seen = recording.keypoints[: max(len(poses) - shorter, 1)]
    uv_px = seen.uv_px + CAMERA_2_BIAS_PX if number == 2 else seen.uv_px
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"TC_{take.subject}_{take.name}_cam{number}.npz"
    np.savez(path, uv_px=uv_px, confidence=seen.confidence)
    (folder / "landmarks.txt").write_text("".join(f"{name}\n" for name in seen.names))
    return path


def write_dataset(
    corpus: Path,
    out: Path,
    layout: str = "one",
    seconds: float = 8.0,
    seed: int = 0,
    detections: Path | None = None,
    postures: bool = False,
) -> Iterator[str]:
    """Write all 46 takes; yields a line about each.

    Args:
        postures: whether each subject has a neutral posture of their own, and the takes acting3 begin without a T-pose.

    Raises:
        OutputExistsError: `out` is not empty. RtofError, OSError: the corpus cannot be used.
    """
    if not seconds * RATE_HZ >= SHORTEST_CLIP:
        raise InvalidInputError(f"--seconds {seconds:g}: give {SHORTEST_CLIP / RATE_HZ:g} at least")
    for folder in (out, detections):
        if folder is not None and folder.exists() and (folder.is_file() or any(folder.iterdir())):
            raise OutputExistsError(f"{folder}: not an empty folder; name another one")
    motions = choose_motions(corpus, seconds)
    out.mkdir(parents=True, exist_ok=True)
    (out / "README.txt").write_text(README, encoding="utf-8")
    eyes = cameras()
    files.write_cameras(out / "calibration.cal", eyes)
    for subject, name in sorted(motions):
        clip, offsets = motions[subject, name], body(subject, name)
        about = zlib.crc32(f"{subject} {name}".encode())
        poses = from_t_pose(carried_over(clip.poses, offsets), offsets, about + seed)
        if postures:
            own = np.random.default_rng([zlib.crc32(subject.encode()), seed])
            poses = another_person(own, poses, _skeleton().with_offsets(offsets))
            poses = poses[STILL_FRAMES + BLEND_FRAMES :] if name == "acting3" else poses
            poses = replace(poses, times=poses.times - poses.times[0])
        take = make_take(subject, name, poses, offsets, seed=seed)
        write_take(out, take, layout, orientations=(subject, name) not in WITHOUT_ORIENTATIONS)
        if detections is not None:
            for number, camera in eyes.items():
                write_detections(detections, take, number, camera, seed)
        yield f"{subject} {name:10} {len(poses):5d} frames from {clip.name} ({clip.category})"


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks total_capture_standin",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--out", type=Path, required=True, help="new folder for the stand-in")
    parser.add_argument("--layout", choices=files.LAYOUTS, default="one")
    parser.add_argument("--seconds", type=float, default=8.0, help="longest motion of a take")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--postures", action="store_true", help="subjects of different neutral posture")
    parser.add_argument("--detections", type=Path, help="new folder for a detector's 2D")
    options = parser.parse_args(arguments)
    try:
        for line in write_dataset(**vars(options)):
            print(line, flush=True)
    except (RtofError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
