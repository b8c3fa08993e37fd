"""A stand-in for Total Capture: folders in its formats, quirks included, made from free motion.

It is NOT Total Capture. That is handed out by its authors for research only; here CMU's motion moves
bodies of its five subjects' proportions, and the IMUs, cameras and detections are simulated. What is
measured on it shows that files are read rightly and a protocol runs, and says nothing about the dataset.

``python -m benchmarks.total_capture_standin --corpus DIR --out FOLDER`` with DIR as in README.md here.
Subjects S1, S2 and S3 move as training subjects of split.toml do, but for the three test takes, which are
of its test subjects, as everything of S4 and S5 is.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from benchmarks import total_capture_files as files
from benchmarks.harness import split
from rtof_kin import kinematics, signals
from rtof_kin import rotations as so3
from rtof_kin.calibration import ImuCalibration
from rtof_kin.errors import OutputExistsError, RtofError, ShapeError
from rtof_kin.mocap import ANKLE_HEIGHT, NAMES, PARENTS, MocapClip, read_corpus, resample_clip
from rtof_kin.simulation import SimulationSettings, low_passed, simulate
from rtof_kin.simulation_noise import ImuNoise
from rtof_kin.simulation_sensors import simulate_imus
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import Camera, ImuSequence, PoseSequence

Array = NDArray[np.float64]
RATE_HZ = 60.0
KINDS = ("acting", "freestyle", "rom", "walking")
TAKES = {
    **dict.fromkeys(("S1", "S2", "S3"), tuple(f"{kind}{n}" for kind in KINDS for n in (1, 2, 3))),
    **dict.fromkeys(("S4", "S5"), ("acting3", "freestyle1", "freestyle3", "rom3", "walking2")),
}
"""Takes of each subject."""
TEST_TAKES = ("walking2", "acting3", "freestyle3")
UNSEEN_SUBJECTS = ("S4", "S5")
OTHER_SIZE = {
    ("S1", "freestyle2"): 1.02,
    ("S2", "rom1"): 0.985,
    ("S2", "rom3"): 0.985,
    ("S2", "walking1"): 1.015,
}
"""Takes in which the skeleton has another size than in the subject's others."""
WITHOUT_ORIENTATIONS = (("S2", "rom2"), ("S3", "rom1"), ("S3", "rom2"), ("S3", "rom3"))
WITHOUT_BVH = (("S3", "rom3"),)
CATEGORIES = {"rom": ("rom", "freestyle"), "acting": ("acting", "freestyle")}
"""Categories of the corpus for a kind of take, in the order of preference; else the one of its name."""
_OFFSETS_MM = {
    "Spine": "0 46.2 -69.3  0 39.3 -58.9  0 44.1 -66.2  0 44.2 -66.3  0 46.3 -69.4",
    "Spine1": "0 16.0 -90.9  0 13.6 -77.3  0 15.3 -86.9  0 15.3 -87.0  0 16.1 -91.2",
    "Spine2": "0 8.0 -92.0  0 6.8 -78.2  0 7.7 -87.9  0 7.7 -88.0  0 8.1 -92.2",
    "Spine3": "0 0 -92.3  0 0 -78.5  0 0 -88.3  0 0 -88.4  0 0 -92.6",
    "Neck": "0 -34.6 -242.4  0 -29.5 -206.2  0 -33.1 -231.7  0 -33.1 -232.0  0 -34.7 -243.1",
    "Head": "0 -22.0 -125.0  0 -18.8 -106.4  0 -21.1 -119.5  0 -21.1 -119.7  0 -22.1 -125.4",
    "RightShoulder": "29.2 -48.6 -157.6  26.4 -44.1 -142.8  29.7 -49.5 -160.4  30.3 -50.5 -163.5"
    "  30.7 -51.2 -165.9",
    "RightArm": "144.9 0 0  131.3 0 0  147.6 0 0  150.4 0 0  152.6 0 0",
    "RightForeArm": "288.9 0 0  236.0 0 0  266.3 0 0  265.7 0 0  320.7 0 0",
    "RightHand": "219.6 0 0  198.1 0 0  227.7 0 0  236.5 0 0  234.3 0 0",
    "RightUpLeg": "86.6 0 25.3  78.5 0 22.9  88.1 0 25.7  89.8 0 26.2  91.2 0 26.6",
    "RightLeg": "0 0 378.9  0 0 381.1  0 0 401.9  0 0 408.5  0 0 411.6",
    "RightFoot": "0 0 375.4  0 0 365.4  0 0 424.2  0 0 402.3  0 0 412.7",
}
"""Rest offsets of S1 to S5 in the parent's segment frame (x right, y back, z down); left mirrors x."""
_CAMERAS = """
1284.3 1286.4  1.19 2.45 -4.70    1395.1 1400.2  3.27 2.48 -2.18    1323.3 1324.6  3.00 2.39  2.30
1184.1 1186.4  0.72 2.37  4.35    1258.6 1262.7 -2.96 2.30  4.15    1222.0 1223.9 -4.36 2.28  2.25
1423.7 1424.7 -4.19 2.34 -2.38    1239.2 1242.5 -2.45 2.37 -4.85
"""
"""fx, fy in px and the centre in the files' world, m, of cameras 1 to 8."""
CAMERA_2_BIAS_PX = (20.0, -8.0)
"""By how much the real camera 2 misses: it is miscalibrated."""
STILL_FRAMES, BLEND_FRAMES = 10, 40
_SHORTEST_CLIP = 30
_T_POSE_ERROR_DEG = 1.5
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
    """What the sensors say, one sample a frame."""
    calibration: ImuCalibration
    """How they are mounted, as far as it is known."""


# --- bodies and cameras --------------------------------------------------------------------------


def body(subject: str, take: str = "") -> Array:
    """Joint offsets (21, 3), m in link axes, of a subject in a take."""
    s = int(subject.removeprefix("S")) - 1
    offsets = np.zeros((len(NAMES), 3))
    for j, name in enumerate(NAMES):
        text = _OFFSETS_MM.get(name.replace("Left", "Right"))
        if text is not None:
            offsets[j] = np.array(text.split(), dtype=float).reshape(5, 3)[s]
        if name.startswith("Left"):
            offsets[j, 0] *= -1
    return np.asarray(offsets @ files.M_TC_BONE / 1000 * OTHER_SIZE.get((subject, take), 1.0))


def cameras() -> dict[int, Camera]:
    """The eight cameras by number, aimed at the middle of the room at 1 m, in the package's world."""
    found = {}
    for number, row in enumerate(np.array(_CAMERAS.split(), dtype=float).reshape(8, 5), 1):
        aimed = Camera.looking_at(files.C_WORLD_TC @ row[2:], [0.0, 0.0, 1.0], float(row[0]))
        K = np.array([[row[0], 0, 959.5], [0, row[1], 539.5], [0, 0, 1]])
        found[number] = replace(aimed, K=K, distortion=np.array([number * 1e-6, 0, 0, 0, 0]))
    return found


# --- motion --------------------------------------------------------------------------------------


def carried_over(poses: PoseSequence, joint_offsets: Array) -> PoseSequence:
    """A motion's rotations on another body, in the middle of the room, its feet on the floor.

    The way of the root is scaled with the length of the legs; the lower ankle's 5th percentile is as high
    as in the corpus.
    """
    legs = [NAMES.index("RightLeg"), NAMES.index("RightFoot")]
    new = np.linalg.norm(joint_offsets[legs], axis=-1).sum()
    old = np.linalg.norm(np.diff(poses.p_world_joint[0, [15, 16, 17]], axis=0), axis=-1).sum()
    p_root = poses.p_world_joint[:, 0] * (new / old)
    p_root[:, :2] -= (p_root[:, :2].max(axis=0) + p_root[:, :2].min(axis=0)) / 2
    p = kinematics.positions(PARENTS, joint_offsets, p_root, poses.R_world_bone)
    p[..., 2] += ANKLE_HEIGHT - np.percentile(_lower_ankle(p), 5)
    return replace(poses, p_world_joint=p)


def _lower_ankle(p: Array) -> Array:
    return np.asarray(p[:, [NAMES.index("RightFoot"), NAMES.index("LeftFoot")], 2].min(axis=1))


def from_t_pose(poses: PoseSequence, joint_offsets: Array, seed: int = 0) -> PoseSequence:
    """The motion turned to begin facing the files' -Z, growing out of a T-pose in two thirds of a second.

    The subject stands still for ten frames; then the motion's own time sets in smoothly while the
    rotations go over to it. The T-pose is off by a few degrees, as people are.

    Args:
        poses: the motion. joint_offsets: (21, 3) m, its own. seed: of what is wrong with the T-pose.
    """
    if len(poses) < _SHORTEST_CLIP:
        raise ShapeError(
            f"stand-in: {len(poses)} frames are too few; give {_SHORTEST_CLIP} at least"
        )
    turn = so3.about_axis("z", np.pi / 2 - so3.heading(poses.R_world_bone[0, 0]))
    p_root, R = poses.p_world_joint[:, 0] @ turn.T, turn @ poses.R_world_bone
    count = STILL_FRAMES + BLEND_FRAMES // 2 + len(poses)
    share = np.clip((np.arange(count) - STILL_FRAMES) / BLEND_FRAMES, 0, 1)
    late = np.maximum(np.arange(count) - STILL_FRAMES - BLEND_FRAMES, 0)
    clock = BLEND_FRAMES * (share**3 - share**4 / 2) + late
    clock = clock[clock <= len(poses) - 1]
    share = share[: len(clock)]
    weight = share**3 * (10 - 15 * share + 6 * share**2)

    frames = np.arange(len(poses), dtype=float)
    rng = np.random.default_rng(seed)
    error = so3.exp(np.radians(_T_POSE_ERROR_DEG) * rng.standard_normal((len(NAMES), 3)))
    error[0] = so3.about_axis("z", np.pi / 2) @ error[0]
    moving = signals.interpolate_rotations(frames, kinematics.local_rotations(PARENTS, R), clock)
    step = so3.log(np.swapaxes(error, -1, -2) @ moving)
    local = error @ so3.exp(weight[:, None, None] * step)
    R = kinematics.world_rotations(PARENTS, local)

    root = np.asarray(CubicSpline(frames, p_root)(clock))
    standing = kinematics.positions(PARENTS, joint_offsets, p_root[:1], R[:1])
    start = p_root[0] + [0, 0, ANKLE_HEIGHT - _lower_ankle(standing)[0]]
    root = start + weight[:, None] * (root - start)
    p = kinematics.positions(PARENTS, joint_offsets, root, R)
    return PoseSequence(np.arange(len(p)) / RATE_HZ, p, R, NAMES)


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
        rng,
        poses,
        _skeleton(),
        tuple(_skeleton().sensors),
        poses.times,
        noise or ImuNoise.realistic(),
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
    root: Path,
    take: StandInTake,
    layout: str = "one",
    *,
    orientations: bool = True,
    bvh: bool = True,
    aux: bool = True,
) -> dict[str, Path]:
    """Write the files of a take below the dataset's folder.

    Args:
        layout: one of `total_capture_files.LAYOUTS`. orientations, bvh, aux: whether those are written.

    Returns:
        The paths that `total_capture_files.take_paths` names, of what was written.
    """
    paths = files.take_paths(layout, take.subject, take.name)
    paths = {kind: root / path for kind, path in paths.items()}
    for kind, wanted in (("orientations", orientations), ("bvh", bvh), ("aux", aux)):
        if not wanted:
            del paths[kind]
    poses = take.poses
    files.write_joints(paths["positions"], files.tc_positions(poses.p_world_joint))
    if orientations:
        quat = files.quat_xyzw(files.tc_rotations(poses.R_world_bone))
        files.write_joints(paths["orientations"], quat)
    if bvh:
        files.write_bvh(paths["bvh"], poses, take.joint_offsets)
    files.write_sensors(paths["sensors"], take.imus)
    if aux:
        files.write_sensors(paths["aux"], take.imus, aux=True)
    files.write_imu_calibration(paths["ref"], paths["bone"], take.calibration)
    return paths


def write_detections(
    folder: Path, take: StandInTake, number: int, camera: Camera, seed: int
) -> Path:
    """A detector's 2D of a take: `rtof_kin.simulation_noise`, a few frames late, camera 2 off.

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
    settings = replace(
        SimulationSettings.realistic(), sensors=(), video_lag_frames=(float(lag), float(lag))
    )
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


# --- which motion for which take -----------------------------------------------------------------


@dataclass(frozen=True)
class _Piece:
    """Some seconds of a clip."""

    clip: MocapClip
    frames: slice
    rank: tuple[bool, int, int, str]
    """Whole pieces before short ones, first pieces of all clips before second ones, long ones first."""


def choose_clips(
    clips: Iterable[MocapClip], pairs: Sequence[tuple[str, str]], seconds: float
) -> dict[tuple[str, str], MocapClip]:
    """A piece of motion for every subject and take, each used once.

    Args:
        clips: at 60 Hz, with the category of the corpus' index. pairs: subject and take.
        seconds: length of a piece; short clips are used where there are too few long ones.

    Raises:
        ShapeError: there are too few clips of some category.
    """
    pools: dict[str, list[_Piece]] = {}
    for clip in clips:
        pools.setdefault(clip.category, []).extend(_pieces(clip, round(seconds * RATE_HZ)))
    for pool in pools.values():
        pool.sort(key=lambda piece: piece.rank)
    chosen = {}
    for subject, take in pairs:
        kind = take[:-1]
        categories = CATEGORIES.get(kind, (kind,))
        pool = next((pools[c] for c in categories if pools.get(c)), [])
        if not pool:
            raise ShapeError(
                f"the corpus has too few motions of category {' or '.join(categories)} for {subject} "
                f"{take}; give a larger one, or fewer --seconds"
            )
        piece = pool.pop(0)
        poses = piece.clip.poses[piece.frames]
        chosen[subject, take] = replace(
            piece.clip, poses=replace(poses, times=poses.times - poses.times[0])
        )
    return chosen


def _pieces(clip: MocapClip, length: int) -> Iterator[_Piece]:
    cuts = [*range(0, len(clip.poses), length), len(clip.poses)]
    for nth, (start, stop) in enumerate(pairwise(cuts)):
        if stop - start >= _SHORTEST_CLIP:
            short = stop - start < length / 2
            yield _Piece(clip, slice(start, stop), (short, nth, start - stop, clip.name))


def _motions(corpus: Path, seconds: float) -> dict[tuple[str, str], MocapClip]:
    """The motion of every subject and take, from the right side of the split."""
    rows = split()
    left_out = {*rows["test"], *rows["validation"], *rows["excluded"]}
    test: list[MocapClip] = []
    train: list[MocapClip] = []
    for clip in read_corpus(corpus, output_rate_hz=120.0):
        if clip.subject in left_out and clip.subject not in rows["test"]:
            continue
        tested = clip.subject in rows["test"]
        if len(clip.poses) < 2 * _SHORTEST_CLIP or (tested and "GLITCH" in clip.quality):
            continue
        clip = resample_clip(low_passed(clip, 10.0), RATE_HZ)
        (test if tested else train).append(clip)
    pairs = [(subject, take) for subject, takes in TAKES.items() for take in takes]
    unseen = [(s, t) for s, t in pairs if s in UNSEEN_SUBJECTS or t in TEST_TAKES]
    unseen.sort(key=lambda pair: pair[1] not in TEST_TAKES)  # the test takes choose first
    seen = [pair for pair in pairs if pair not in unseen]
    return choose_clips(test, unseen, seconds) | choose_clips(train, seen, seconds)


def write_dataset(
    corpus: Path,
    out: Path,
    layout: str = "one",
    seconds: float = 8.0,
    seed: int = 0,
    detections: Path | None = None,
) -> Iterator[str]:
    """Write all 46 takes; yields a line about each.

    Raises:
        OutputExistsError: `out` is not empty. RtofError, OSError: the corpus cannot be used.
    """
    if not seconds * RATE_HZ >= _SHORTEST_CLIP:
        raise ShapeError(f"--seconds {seconds:g}: give {_SHORTEST_CLIP / RATE_HZ:g} at least")
    for folder in (out, detections):
        if folder is not None and folder.exists() and (folder.is_file() or any(folder.iterdir())):
            raise OutputExistsError(f"{folder}: not an empty folder; name another one")
    motions = _motions(corpus, seconds)
    out.mkdir(parents=True, exist_ok=True)
    (out / "README.txt").write_text(README, encoding="utf-8")
    eyes = cameras()
    files.write_cameras(out / "calibration.cal", eyes)
    for subject, name in sorted(motions):
        clip, offsets = motions[subject, name], body(subject, name)
        about = zlib.crc32(f"{subject} {name}".encode())
        poses = from_t_pose(carried_over(clip.poses, offsets), offsets, about + seed)
        take = make_take(subject, name, poses, offsets, seed=seed)
        write_take(
            out,
            take,
            layout,
            orientations=(subject, name) not in WITHOUT_ORIENTATIONS,
            bvh=(subject, name) not in WITHOUT_BVH,
        )
        if detections is not None:
            for number, camera in eyes.items():
                write_detections(detections, take, number, camera, seed)
        yield f"{subject} {name:10} {len(poses):5d} frames from {clip.name} ({clip.category})"


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.total_capture_standin", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--out", type=Path, required=True, help="new folder for the stand-in")
    parser.add_argument("--layout", choices=files.LAYOUTS, default="one")
    parser.add_argument("--seconds", type=float, default=8.0, help="longest motion of a take")
    parser.add_argument("--seed", type=int, default=0)
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
