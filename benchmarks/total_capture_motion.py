"""Bodies, cameras and motion for the stand-in, `benchmarks.total_capture_standin`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.harness import split
from benchmarks.total_capture_files import C_WORLD_TC, M_TC_BONE
from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap import ANKLE_HEIGHT, MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.mocap_families import NAMES, PARENTS
from rtof_kin.simulation.simulate import low_passed

RATE_HZ = 60.0
KINDS = ("acting", "freestyle", "rom", "walking")
TAKES = {
    **dict.fromkeys(("S1", "S2", "S3"), tuple(f"{kind}{n}" for kind in KINDS for n in (1, 2, 3))),
    **dict.fromkeys(("S4", "S5"), ("acting3", "freestyle1", "freestyle3", "rom3", "walking2")),
}
"""Takes of each subject."""
TEST_TAKES = ("walking2", "acting3", "freestyle3")
UNSEEN_SUBJECTS = ("S4", "S5")
OTHER_SIZE = {("S1", "freestyle2"): 1.02, ("S2", "rom1"): 0.985, ("S2", "rom3"): 0.985, ("S2", "walking1"): 1.015}
"""Takes in which the skeleton has another size than in the subject's others."""
CATEGORIES = {"rom": ("rom", "freestyle"), "acting": ("acting", "freestyle")}
"""Categories of the corpus for a kind of take, in the order of preference; else the one of its name."""
_OFFSETS_MM = {
    "Spine": "0 46.2 -69.3  0 39.3 -58.9  0 44.1 -66.2  0 44.2 -66.3  0 46.3 -69.4",
    "Spine1": "0 16.0 -90.9  0 13.6 -77.3  0 15.3 -86.9  0 15.3 -87.0  0 16.1 -91.2",
    "Spine2": "0 8.0 -92.0  0 6.8 -78.2  0 7.7 -87.9  0 7.7 -88.0  0 8.1 -92.2",
    "Spine3": "0 0 -92.3  0 0 -78.5  0 0 -88.3  0 0 -88.4  0 0 -92.6",
    "Neck": "0 -34.6 -242.4  0 -29.5 -206.2  0 -33.1 -231.7  0 -33.1 -232.0  0 -34.7 -243.1",
    "Head": "0 -22.0 -125.0  0 -18.8 -106.4  0 -21.1 -119.5  0 -21.1 -119.7  0 -22.1 -125.4",
    "RightShoulder": "29.2 -48.6 -157.6  26.4 -44.1 -142.8  29.7 -49.5 -160.4  30.3 -50.5 -163.5  30.7 -51.2 -165.9",
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
STILL_FRAMES, BLEND_FRAMES = 10, 40
SHORTEST_CLIP = 30
_T_POSE_ERROR_DEG = 1.5


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
    return np.asarray(offsets @ M_TC_BONE / 1000 * OTHER_SIZE.get((subject, take), 1.0))


def cameras() -> dict[int, Camera]:
    """The eight cameras by number, aimed at the middle of the room at 1 m, in the package's world."""
    found = {}
    for number, row in enumerate(np.array(_CAMERAS.split(), dtype=float).reshape(8, 5), 1):
        aimed = Camera.looking_at(C_WORLD_TC @ row[2:], [0.0, 0.0, 1.0], float(row[0]))
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
    if len(poses) < SHORTEST_CLIP:
        raise InvalidInputError(f"stand-in: {len(poses)} frames are too few; give {SHORTEST_CLIP} at least")
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
        InvalidInputError: there are too few clips of some category.
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
            raise InvalidInputError(
                f"the corpus has too few motions of category {' or '.join(categories)} for {subject} "
                f"{take}; give a larger one, or fewer --seconds"
            )
        piece = pool.pop(0)
        poses = piece.clip.poses[piece.frames]
        chosen[subject, take] = replace(piece.clip, poses=replace(poses, times=poses.times - poses.times[0]))
    return chosen


def _pieces(clip: MocapClip, length: int) -> Iterator[_Piece]:
    cuts = [*range(0, len(clip.poses), length), len(clip.poses)]
    for nth, (start, stop) in enumerate(pairwise(cuts)):
        if stop - start >= SHORTEST_CLIP:
            short = stop - start < length / 2
            yield _Piece(clip, slice(start, stop), (short, nth, start - stop, clip.name))


def choose_motions(corpus: Path, seconds: float) -> dict[tuple[str, str], MocapClip]:
    """The motion of every subject and take, from the right side of the split."""
    rows = split()
    left_out = {*rows["test"], *rows["validation"]}
    test: list[MocapClip] = []
    train: list[MocapClip] = []
    for clip in read_corpus(corpus, output_rate_hz=120.0):
        if clip.subject in left_out and clip.subject not in rows["test"]:
            continue
        tested = clip.subject in rows["test"]
        if len(clip.poses) < 2 * SHORTEST_CLIP or (tested and "GLITCH" in clip.quality):
            continue
        clip = resample_clip(low_passed(clip, 10.0), RATE_HZ)
        (test if tested else train).append(clip)
    pairs = [(subject, take) for subject, takes in TAKES.items() for take in takes]
    unseen = [(s, t) for s, t in pairs if s in UNSEEN_SUBJECTS or t in TEST_TAKES]
    unseen.sort(key=lambda pair: pair[1] not in TEST_TAKES)  # the test takes choose first
    seen = [pair for pair in pairs if pair not in unseen]
    return choose_clips(test, unseen, seconds) | choose_clips(train, seen, seconds)
