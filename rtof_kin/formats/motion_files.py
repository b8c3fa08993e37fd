"""A motion in the files of every tool, which agree with one another, and what each of them says.

What nobody saw is nowhere filled in silently. A frame belongs to a *gap* where no joint is valid (nobody
saw where the person was; what stands there was bridged) or the configuration is not known at all. Joints,
landmarks and degrees of freedom that nobody saw in other frames are *from the prior*
(`rtof_kin.body.observability`), and ``files.json`` lists them. Degrees of freedom that were never observed are
left out of .mot and ros, which cannot hold a NaN:

==========  ===========================================  =============================================
format      files                                        in a gap
==========  ===========================================  =============================================
csv         joint_trajectory.csv and .json, motion.csv   numbers with validity; empty where not known
parquet     motion.parquet                               the same; null where not known
ros         ros_joint_..., ros_base_trajectory.json      goes on; a file each side of what is not known
osim        skeleton.osim                                (a body has none)
mot, sto    motion.mot, motion.sto                       a file each side: motion_1.mot, motion_2.mot
bvh         motion.bvh                                   the same
trc, c3d    motion.trc, motion.c3d                       empty cells, residual -1; also of single
                                                         landmarks that nobody saw
==========  ===========================================  =============================================

``skeleton.urdf`` and ``files.json``, which says all this of the files beside it, are always written.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.errors import ShapeError, UnknownNameError
from rtof_kin.core.signals import runs
from rtof_kin.formats.bvh import write_bvh
from rtof_kin.formats.c3d import write_c3d
from rtof_kin.formats.joint_trajectory import write_joint_trajectory_csv, write_ros_trajectory
from rtof_kin.formats.motion_table import CONVENTION, write_motion_csv, write_motion_parquet
from rtof_kin.formats.motion_views import (
    dofs_from_prior,
    even_times,
    from_prior,
    joint_tree,
    landmark_markers,
    landmarks_from_prior,
    pieces,
)
from rtof_kin.formats.opensim_model import write_osim
from rtof_kin.formats.opensim_mot import write_mot, write_sto
from rtof_kin.formats.trc import write_trc

INDEX = "files.json"
URDF = "skeleton.urdf"
DEFAULT = ("csv", "ros")
Facts = dict[str, Any]
Files = dict[str, Facts]
"""What `files.json` says of each file, by its name."""
_GROUND = "OpenSim's ground: x forward (world x), y up (world z), z right (world -y)"


@dataclass(frozen=True)
class Format:
    """A kind of file that a motion is written to."""

    convention: str
    """Axes, units, order and names of what is in it."""
    write: Callable[[Path, MotionSequence], Files]
    """Writes into a folder."""
    even: bool = False
    """Whether it has a rate in place of times, or programs that read it count on even ones."""


def write_motion_files(folder: str | Path, motion: MotionSequence, formats: Sequence[str] = DEFAULT) -> Path:
    """Write a motion, its URDF and an index of the files into a folder that exists.

    Args:
        folder: where files of these names are replaced: give a new one, see `core.files.folder.new_folder`.
        formats: names in `FORMATS`.

    Returns:
        The folder.

    Raises:
        UnknownNameError: no such format. ShapeError: a format needs even times and these are not, or
            needs a frame in which somebody saw the person. RtofError: Parquet without pyarrow.
    """
    check_formats(formats)
    folder, skeleton = Path(folder), motion.skeleton
    (folder / URDF).write_text(skeleton.to_urdf(), encoding="utf-8")
    files: Files = {URDF: {"format": "urdf", "convention": _LINKS}}
    even = _with_even_times(motion) if any(FORMATS[name].even for name in formats) else motion
    for name in (name for name in FORMATS if name in formats):
        kind = FORMATS[name]
        for file, facts in kind.write(folder, even if kind.even else motion).items():
            files[file] = {"format": name, "convention": kind.convention, **facts}
    text = json.dumps(_index(motion, files), indent=2)
    (folder / INDEX).write_text(text + "\n", encoding="utf-8")
    return folder


def check_formats(formats: Sequence[str]) -> None:
    """Raise `UnknownNameError` for a format that is none; long work asks before it begins."""
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise UnknownNameError("format", unknown, list(FORMATS))


def _with_even_times(motion: MotionSequence) -> MotionSequence:
    """At even times; without a confidence, which none of these files has a place for."""
    poses = replace(motion.poses, times=even_times(motion.times))
    return replace(motion, poses=poses, confidence=None)


def _index(motion: MotionSequence, files: Files) -> Facts:
    """What `files.json` says."""
    poses, skeleton = motion.poses, motion.skeleton
    seen = np.zeros(len(poses), dtype=bool)
    for start, stop in pieces(motion):
        seen[start:stop] = True
    return {
        "skeleton": skeleton.name,
        "height_m": skeleton.height,
        "frames": len(poses),
        "rate_hz": poses.rate_hz,
        "times_s": [float(poses.times[0]), float(poses.times[-1])],
        "gaps": [list(gap) for gap in runs(~seen)],
        **_unseen(motion),
        "meaning": "frames and gaps: [first, stop) in frames of the motion, from 0; from_prior: joints "
        "that nobody saw, and in what share of the frames outside gaps; a prior or their neighbours say "
        "where they are, but .trc and .c3d leave them out; landmarks_from_prior: the same of other "
        "landmarks; dofs_from_prior: the same of degrees of freedom and base_q, the root's orientation: "
        "their numbers are a prior's or the model's; left_out: those that were never observed and that a "
        "file lacks: take the model's zero; time_zero_s: the motion's time at which the clock of a file "
        "shows 0; names with '-': sign opposite to the URDF's",
        "landmarks": {name: joint for name, (joint, _) in skeleton.landmarks.items()},
        "dofs": {
            dof.urdf: {"clinical": dof.clinical, "opensim": dof.opensim}
            for joint in skeleton.table.joints
            for dof in joint.dofs
        },
        "files": files,
    }


# --- one function for each format ----------------------------------------------------------------


def _csv(folder: Path, motion: MotionSequence) -> Files:
    write_joint_trajectory_csv(folder / "joint_trajectory.csv", motion)
    write_motion_csv(folder / "motion.csv", motion)
    return {"joint_trajectory.csv": _whole(motion), "motion.csv": _whole(motion)}


def _parquet(folder: Path, motion: MotionSequence) -> Files:
    write_motion_parquet(folder / "motion.parquet", motion)
    return {"motion.parquet": _whole(motion)}


def _ros(folder: Path, motion: MotionSequence) -> Files:
    paths = write_ros_trajectory(folder, motion)
    facts = {"time_zero_s": float(motion.times[0]), "left_out": list(never_observed(motion))}
    return {path.name: dict(facts) for path in paths}


def _osim(folder: Path, motion: MotionSequence) -> Files:
    write_osim(folder / "skeleton.osim", motion.skeleton)
    return {"skeleton.osim": {}}


def _trc(folder: Path, motion: MotionSequence) -> Files:
    write_trc(folder / "motion.trc", landmark_markers(motion), up="opensim")
    return {"motion.trc": _whole(motion)}


def _c3d(folder: Path, motion: MotionSequence) -> Files:
    """Times become numbers of frames, the first one's as near as can be."""
    markers = landmark_markers(motion)
    start, rate = float(markers.times[0]), markers.rate_hz
    first = round(start * rate)
    if not 0 <= first <= _MOST_FRAMES_C3D - len(markers):
        first = 0
    markers = replace(markers, times=(first + np.arange(len(markers))) / rate)
    write_c3d(folder / "motion.c3d", markers)
    return {"motion.c3d": _whole(motion) | {"time_zero_s": start - first / rate}}


def _bvh(path: Path, motion: MotionSequence) -> None:
    write_bvh(path, joint_tree(motion))


def _in_pieces(
    ending: str,
    write: Callable[[Path, MotionSequence], None],
    has_times: bool,
    folder: Path,
    motion: MotionSequence,
) -> Files:
    """A file for each stretch without gaps; one without times begins at 0."""
    parts = pieces(motion)
    if not parts:
        raise ShapeError(
            f"motion: nobody saw where the person was in any frame, so there is nothing for {ending}"
        )
    files = {}
    for number, (start, stop) in enumerate(parts, 1):
        part = motion[start:stop]
        name = f"motion{ending}" if len(parts) == 1 else f"motion_{number}{ending}"
        write(folder / name, part)
        zero = 0.0 if has_times else float(part.times[0])
        files[name] = {"frames": [start, stop], "time_zero_s": zero, **_unseen(part)}
        if ending == ".mot":
            files[name]["left_out"] = list(never_observed(part))
    return files


def _unseen(motion: MotionSequence) -> Facts:
    """What nobody saw of a motion, as `files.json` says it."""
    return {
        "from_prior": from_prior(motion),
        "landmarks_from_prior": landmarks_from_prior(motion),
        "dofs_from_prior": dofs_from_prior(motion),
    }


def _whole(motion: MotionSequence) -> Facts:
    return {"frames": [0, len(motion.q)], "time_zero_s": 0.0}


_MOST_FRAMES_C3D = 0xFFFF
"""Numbers of frames have 16 bits in the header."""
_LINKS = (
    "link frames x forward, y left, z up, parallel in the T-pose, where every angle is zero; m, rad, kg; "
    "the base floats: whoever loads it adds a floating joint"
)
_COORDINATES = (
    "coordinates of skeleton.osim by name, zero in the T-pose; pelvis_* are of the root in "
    f"{_GROUND}; even times"
)
FORMATS: dict[str, Format] = {
    "csv": Format(f"{CONVENTION}; units in the names of columns or in the .json beside it", _csv),
    "parquet": Format(f"{CONVENTION}; units and other names in the metadata of columns", _parquet),
    "ros": Format(
        "trajectory_msgs/JointTrajectory of the URDF's revolutes by name, rad and rad/s, and "
        "MultiDOFJointTrajectory of the root link in world, z up, m, quaternion x y z w",
        _ros,
    ),
    "osim": Format(
        f"OpenSim 4: bodies are the URDF's links in their frames, markers its landmarks; {_GROUND}", _osim
    ),
    "mot": Format(
        f"{_COORDINATES}; degrees and m", partial(_in_pieces, ".mot", write_mot, True), even=True
    ),
    "sto": Format(
        f"values and speeds of {_COORDINATES}; rad, m, rad/s, m/s",
        partial(_in_pieces, ".sto", write_sto, True), even=True,
    ),
    "trc": Format(f"landmarks by name in {_GROUND}; m; even times", _trc, even=True),
    "c3d": Format("landmarks by name, x forward, y left, z up; mm, 32 bits", _c3d, even=True),
    "bvh": Format(
        "joints by name; x left, y up, z forward, which is world x; cm; degrees, intrinsic in the order "
        "of CHANNELS, z x y; zero in the T-pose",
        partial(_in_pieces, ".bvh", _bvh, False), even=True,
    ),
}  # fmt: skip
"""All formats by name."""
