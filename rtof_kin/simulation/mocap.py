"""Motion capture files as motion of the package's skeleton: single files, and a corpus of them.

A file's skeleton is recognised by its joint names (`simulation.mocap_families`) and mapped joint by joint.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask, blocks_of
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError, UnknownNameError, reading
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.text import read_text
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.asf_amc import read_asf_amc
from rtof_kin.formats.bvh import read_bvh
from rtof_kin.simulation.mocap_families import (
    NAMES,
    PARENTS,
    Between,
    Family,
    lead_in,
    recognise_family,
    recognise_unit,
    restored_offsets,
    without_character,
)

_R_WORLD_FILE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Files are y up and face z in their rest pose; world is z up, and the T-pose faces x."""
_DOWN, _LEFT = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
_CANONICAL = {
    "RightUpLeg": _DOWN,
    "RightLeg": _DOWN,
    "LeftUpLeg": _DOWN,
    "LeftLeg": _DOWN,
    "RightArm": -_LEFT,
    "RightForeArm": -_LEFT,
    "LeftArm": _LEFT,
    "LeftForeArm": _LEFT,
}
"""Direction of a segment's child in its link frame."""


@dataclass(frozen=True)
class MocapClip:
    """Motion of the package's skeleton, with rigid bones."""

    name: str  #: File name without its ending, with the range of source frames if it is a piece
    poses: PoseSequence  #: Positions and orientations in world (z up, m), joints named `NAMES`; from time 0
    joint_offsets: Array  #: (J, 3) position of each joint in its parent's link frame, m; zero for the root
    subject: str = ""  #: Name of the subject in an index
    category: str = ""  #: walking, running, acting, freestyle, rom or other, from an index
    quality: str = ""  #: Remark of an index; contains GLITCH where the original has spikes
    rig: str = ""  #: Family of the source's skeleton, see `mocap_families`

    def __post_init__(self) -> None:
        offsets = readonly("clip joint_offsets", self.joint_offsets, (len(self.poses.names), 3))
        object.__setattr__(self, "joint_offsets", offsets)


def map_motion(motion: ArticulatedMotion, family: Family, unit_m: float, rate_hz: float, name: str) -> MocapClip:
    """Map a motion without artificial frames to the package's joints, at its rate; `unit_m` is the source's unit, m.

    A segment's orientation is its source's rotation from the T-pose, in axes x forward, y left, z up:
    ``R_world_bone(t) = R_world_source(t) R_world_source(T-pose)^T``. Where the T-pose spreads legs or lowers arms, a
    constant minimal rotation first brings thighs and shanks to -z, arms to +-y. Joint offsets are those of the T-pose
    and constant: positions are forward kinematics.
    """
    offsets = restored_offsets(motion, family)
    p_t_pose, R_t_pose = _t_pose(motion, family, offsets @ _R_WORLD_FILE.T * unit_m)
    p_rest, R_rest = _points(motion, family.at, p_t_pose), _turns(motion, family.turns, R_t_pose)
    R_canonical = _canonical_rotations(family, p_rest[0])
    joint_offsets = np.zeros((len(NAMES), 3))
    for m, parent in enumerate(PARENTS):
        if parent >= 0:
            joint_offsets[m] = R_canonical[parent] @ (p_rest[0, m] - p_rest[0, parent])
    p, R = np.empty((len(motion), len(NAMES), 3)), np.empty((len(motion), len(NAMES), 3, 3))
    for frames in blocks_of(len(motion), 4096):
        rigid = replace(motion[frames], offsets=offsets, p_parent_joint=None)
        p_source, R_source = rigid.forward_kinematics()
        p_wanted = _points(motion, family.at, p_source @ _R_WORLD_FILE.T * unit_m)
        R_turned = _turns(motion, family.turns, _R_WORLD_FILE @ R_source @ _R_WORLD_FILE.T)
        R_world_bone = R_turned @ np.swapaxes(R_canonical @ R_rest, -1, -2)
        p[frames], R[frames] = _aimed(R_world_bone, joint_offsets, p_wanted, family.aim)
    times = np.arange(len(motion)) / rate_hz
    return MocapClip(name, PoseSequence(times, p, R, NAMES), joint_offsets, rig=family.name)


def _t_pose(motion: ArticulatedMotion, family: Family, offsets: Array) -> tuple[Array, Array]:
    """Return source joints (1, J, 3) and frames (1, J, 3, 3) in the T-pose, in world axes."""
    p = np.zeros((1, len(motion.names), 3))
    R = np.tile(np.eye(3), (1, len(motion.names), 1, 1))
    for j, (name, parent) in enumerate(zip(motion.names, motion.parents, strict=True)):
        if parent >= 0:
            p[0, j] = p[0, parent] + R[0, parent] @ offsets[j]
            R[0, j] = R[0, parent]
        if name in family.t_pose_deg:
            # x left, y up, z forward of the file are y, z, x of the world.
            about_y, about_z, about_x = np.deg2rad(family.t_pose_deg[name])
            R[0, j] = so3.euler_to_matrix("xzy", [about_x, about_z, about_y])
    return p, R


def _points(motion: ArticulatedMotion, at: tuple[Between, ...], p: Array) -> Array:
    """Return the package's joints (T, J, 3) from the source's positions."""
    starts = p[:, [motion.index(start) for start, _, _ in at]]
    stops = p[:, [motion.index(stop) for _, stop, _ in at]]
    share = np.array([share for _, _, share in at])[:, None]
    return np.asarray(starts + share * (stops - starts))


def _turns(motion: ArticulatedMotion, turns: tuple[Between, ...], R: Array) -> Array:
    """Return rotations (T, J, 3, 3) of the package's segments from the source's frames."""
    R_segment = R[:, [motion.index(start) for start, _, _ in turns]]
    for m, (_, stop, share) in enumerate(turns):
        if share:
            step = np.swapaxes(R_segment[:, m], -1, -2) @ R[:, motion.index(stop)]
            R_segment[:, m] = R_segment[:, m] @ so3.exp(share * so3.log(step))
    return R_segment


def _canonical_rotations(family: Family, p_rest: Array) -> Array:
    """Return constant rotations (J, 3, 3) that bring the limbs of the T-pose (J, 3) to their axes.

    A hand is turned like its forearm, and a foot like its shank in some families.
    """
    R = np.tile(np.eye(3), (len(NAMES), 1, 1))
    for joint, direction in _CANONICAL.items():
        m = NAMES.index(joint)
        (child,) = kinematics.children_of(PARENTS, m)
        R[m] = so3.minimal_rotation(p_rest[child] - p_rest[m], direction)
        if NAMES[child].endswith("Hand") or (NAMES[child].endswith("Foot") and family.feet_go_with_shanks):
            R[child] = R[m]
    return R


def _aimed(R_world_bone: Array, joint_offsets: Array, p_wanted: Array, aim: tuple[float, ...]) -> tuple[Array, Array]:
    """Return positions and orientations in which segments with one child turn towards its wanted position.

    `aim` has, by joint, the share of the smallest rotation that would point the segment at its child.
    """
    R, p = R_world_bone.copy(), p_wanted.copy()
    for m, parent in enumerate(PARENTS):
        if parent >= 0:
            p[:, m] = p[:, parent] + R[:, parent] @ joint_offsets[m]
        children = kinematics.children_of(PARENTS, m)
        if len(children) == 1:
            bone = R[:, m] @ joint_offsets[children[0]]
            turn = so3.minimal_rotation(bone, p_wanted[:, children[0]] - p[:, m])
            R[:, m] = (turn if aim[m] == 1 else so3.exp(aim[m] * so3.log(turn))) @ R[:, m]
    return p, R


def resample_clip(clip: MocapClip, rate_hz: float) -> MocapClip:
    """Resample a clip; an integer ratio of rates takes every n-th frame. Otherwise the rotation of each segment in its
    parent's frame is interpolated on the geodesic, the root's position linearly, and joints follow by kinematics.
    """
    poses = clip.poses
    ratio = poses.rate_hz / rate_hz
    if round(ratio) and abs(ratio - round(ratio)) < 1e-6:
        return replace(clip, poses=poses[:: round(ratio)])
    times = np.arange(int(poses.times[-1] * rate_hz * (1 + 1e-12)) + 1) / rate_hz
    local = kinematics.local_rotations(PARENTS, poses.R_world_bone)
    R = kinematics.world_rotations(PARENTS, signals.interpolate_rotations(poses.times, local, times))
    p_root = signals.interpolate(poses.times, poses.p_world_joint[:, 0], times)
    p = kinematics.positions(PARENTS, clip.joint_offsets, p_root, R)
    return replace(clip, poses=PoseSequence(times, p, R, NAMES))


def read_mocap(
    path: str | Path,
    *,
    rate_hz: float | None = None,
    unit_m: float | None = None,
    output_rate_hz: float | None = 60.0,
    asf: str | Path | None = None,
    names: Mapping[str, str] | None = None,
) -> MocapClip:
    """Read a motion capture file as motion of the package's skeleton, in world axes z up.

    Frames that a converter put before the motion are left out. `FileFormatError`: a missing or damaged file, an unknown
    skeleton or one that is not of human size; `UnknownNameError`: a joint in `names` is not in the file.

    Args:
        asf: skeleton of an .amc file, by default `find_asf` of it.
        rate_hz: sampling rate that replaces the file's, Hz; an .amc has none (120 Hz by default).
        unit_m: length unit of the file, m; by default the one that gives a human leg.
        output_rate_hz: sampling rate of the result, Hz; None keeps that of the file.
        names: name of a joint in a known family by its name in the file. A common prefix of all names ("mixamorig:")
            is removed where that makes the family known.
    """
    path = Path(path)
    if path.suffix.lower() == ".bvh":
        motion = read_bvh(path, rate_hz)
    elif path.suffix.lower() == ".amc":
        motion = read_asf_amc(find_asf(path) if asf is None else asf, path)
    else:
        raise FileFormatError(path, "motion capture is read from .bvh and .amc files")
    motion = without_character(motion.renamed(names or {}))
    family = recognise_family(path, motion)
    rate, whole = motion.rate_hz, float(round(motion.rate_hz))
    if rate_hz is not None:
        rate = rate_hz
    elif abs(rate - whole) < 2e-4 * rate:  # of a rounded frame time: 0.0083333 s is 120 Hz
        rate = whole
    unit_m = recognise_unit(path, motion, family) if unit_m is None else unit_m
    clip = map_motion(motion[lead_in(motion, family) :], family, unit_m, rate, path.stem)
    return clip if output_rate_hz is None else resample_clip(clip, output_rate_hz)


def find_asf(path_amc: str | Path) -> Path:
    """Return the skeleton beside an .amc, else `FileFormatError`: ``16.asf`` of ``16_21.amc``, ``gs_charleston.asf`` of
    ``gs_charleston2.amc``.
    """
    path_amc = Path(path_amc)
    stem = path_amc.stem
    tried = (stem, stem.rstrip("0123456789"), stem.rsplit("_", 1)[0], stem.split("_")[0])
    for name in filter(None, tried):
        candidate = path_amc.with_name(f"{name}.asf")
        if candidate.is_file():
            return candidate
    raise FileFormatError(path_amc, "no .asf skeleton beside it; name one with asf=...")


# --- the corpus: a folder of such files with index.csv -------------------------------------------

_SPIKE_SPEED: Final = 15.0  #: Largest speed of a joint, m/s
_SPIKE_JUMP: Final = 10.0  #: Largest difference of a joint's velocity from the median of the 7 steps around, m/s
_SPIKE_TURN: Final = 60.0  #: Largest turning rate of a segment other than a hand, rad/s
_ANKLE_TURN: Final = float(np.radians(110.0))  #: Largest angle of a foot from its neutral position on the shank, rad
ANKLE_HEIGHT: Final = 0.07  #: Height of the lower ankle over the floor, 5th percentile over a recording, m
_CORRECTIONS: Final = {
    "cmu_amc/gs_backflip.amc": {"fps": "60"},
    "cmu_amc/gs_lambada.amc": {"subject": "CMU055"},
    "cmu_amc/gs_pirouette.amc": {"subject": "CMU005"},
    "other_bvh/ad_cmu1_jumping_jacks.bvh": {"subject": "CMU014"},
}
"""Errors in ``index.csv``: the backflip falls with 9.81 m/s^2 at 60 Hz, not at 120; the other skeletons equal
those of these subjects."""


def read_corpus(
    root: str | Path, subjects: Collection[str] | None = None, *, output_rate_hz: float = 60.0, min_seconds: float = 0.5
) -> Iterator[MocapClip]:
    """Read the clips of a folder whose ``index.csv`` has subject, category and true rate of each file.

    The rate of the index replaces that of the file. Heights are shifted so that the floor (`ANKLE_HEIGHT`) lies at z =
    0. Clips are cut at glitches, see `without_spikes`. `UnknownNameError`: a subject is not in the index;
    `FileFormatError`: a damaged index or file, or a file outside the folder.

    Args:
        subjects: names in the corrected index; None for all. output_rate_hz: sampling rate of the clips, Hz.
        min_seconds: shortest piece of a cut clip that is kept, s.

    Yields:
        Clips; pieces of a cut file are named ``name[first:stop]``, in frames of the file without its artificial start.
    """
    root = Path(root)
    rows = _index_rows(root / "index.csv")
    known = sorted({row["subject"] for row in rows})
    missing = [] if subjects is None else sorted(set(subjects) - set(known))
    if missing:
        raise UnknownNameError("subject", missing, known)
    feet = [m for m, name in enumerate(NAMES) if name.endswith("Foot")]
    for row in rows:
        if subjects is not None and row["subject"] not in subjects:
            continue
        whole = read_mocap(root / row["file"], rate_hz=float(row["fps"]), output_rate_hz=None)
        p = whole.poses.p_world_joint.copy()
        p[..., 2] -= np.percentile(p[:, feet, 2].min(axis=1), 5) - ANKLE_HEIGHT
        poses, quality = replace(whole.poses, p_world_joint=p), row["quality"]
        whole = replace(whole, poses=poses, subject=row["subject"], category=row["tc_like"], quality=quality)
        pieces = without_spikes(whole)
        for piece in pieces:
            if len(pieces) == 1 or len(piece.poses) >= min_seconds * piece.poses.rate_hz:
                yield resample_clip(piece, output_rate_hz)


def _index_rows(path: Path) -> list[dict[str, str]]:
    """Read the corrected rows of motions (not of skeletons)."""
    columns = ("file", "subject", "tc_like", "fps", "quality")
    reader = csv.DictReader(io.StringIO(read_text(path, "a CSV file"), newline=""), restval="")
    with reading(path, "not a readable CSV file: {}", csv.Error):
        if lacking := set(columns) - set(reader.fieldnames or ()):
            raise FileFormatError(path, f"no column {', '.join(sorted(lacking))}", 1)
        rows = [{column: row[column] for column in columns} for row in reader if row["tc_like"] != "skeleton"]
    for row in rows:
        row |= _CORRECTIONS.get(row["file"], {})
        if path_inside(path.parent, row["file"]) is None:
            raise FileFormatError(path, f"{row['file'][:100]!r} is not a file inside this folder")
        if not re.fullmatch(r"\d{1,6}(\.\d*)?", row["fps"].strip()) or float(row["fps"]) < 1e-3:
            problem = f"{row['file']}: fps is {row['fps'][:40]!r}, not a number of frames per second"
            raise FileFormatError(path, problem)
    return rows


def without_spikes(clip: MocapClip) -> list[MocapClip]:
    """Return a clip without glitches, or the pieces between them, each starting at time 0. Where a step between frames
    exceeds the limit of speed, velocity jump or turning rate, both frames and a neighbour on either side are cut out;
    so are frames beyond the limit of the ankle.
    """
    poses = clip.poses
    good = ~_flipped(poses.R_world_bone)
    fault = np.flatnonzero(_spikes(poses))
    for shift in (-1, 0, 1, 2):
        good[np.clip(fault + shift, 0, len(poses) - 1)] = False
    if good.all():
        return [clip]
    return [
        replace(
            clip,
            name=f"{clip.name}[{start}:{stop}]",
            poses=replace(poses[start:stop], times=poses.times[: stop - start]),
        )
        for start, stop in signals.runs(good)
    ]


def _spikes(poses: PoseSequence) -> Mask:
    """Return (T - 1,) whether the step to the next frame is a glitch."""
    v = np.diff(poses.p_world_joint, axis=0) * poses.rate_hz
    around = np.pad(v, ((3, 3), (0, 0), (0, 0)), mode="edge")
    jump = v - np.median(sliding_window_view(around, 7, axis=0), axis=-1)
    carrying = [m for m, name in enumerate(NAMES) if not name.endswith("Hand")]
    R = poses.R_world_bone[:, carrying]
    turn = so3.angle_between(R[1:], R[:-1]) * poses.rate_hz
    fault = np.any(np.linalg.norm(v, axis=-1) > _SPIKE_SPEED, axis=1)
    fault |= np.any(np.linalg.norm(jump, axis=-1) > _SPIKE_JUMP, axis=1)
    return np.asarray(fault | np.any(turn > _SPIKE_TURN, axis=1))


def _flipped(R_world_bone: Array) -> Mask:
    """Return (T,) whether a foot is turned beyond the limit of the ankle."""
    feet = [m for m, name in enumerate(NAMES) if name.endswith("Foot")]
    shanks = [PARENTS[m] for m in feet]
    angle = so3.angle_between(R_world_bone[:, feet], R_world_bone[:, shanks])
    return np.asarray(np.any(angle > _ANKLE_TURN, axis=1))
