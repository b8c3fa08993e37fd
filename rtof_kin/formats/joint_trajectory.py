"""Joint trajectories of the URDF as messages of ROS in JSON.

ROS's JointTrajectory has joints of one degree of freedom only, so the free base is a message of its own, a
``trajectory_msgs/MultiDOFJointTrajectory``. JSON is YAML, which ROS's tools read.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, pairwise, repeat
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.body.urdf import pin
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.signals import runs

BASE_COLUMNS: Final = ("base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw")
BASE_TURN: Final = "base_q"  #: Name of the base's orientation as a whole
WORLD_FRAME: Final = "world"  #: ``frame_id`` of poses in ROS messages


def joint_velocities(skeleton: SkeletonModel, q: Array, times: Array) -> Array:
    """Return velocities (T, nv) of configurations (T, nq) at times (T,), s, by central differences on the manifold,
    one-sided at the ends; in Pinocchio's convention: base linear and angular velocity in the root's frame, then rad/s.
    """
    if len(q) < 2:
        return np.zeros((len(q), skeleton.nv))
    steps = [pin.difference(skeleton.model, a, b) for a, b in pairwise(q)]
    rates = np.array(steps) / np.diff(times)[:, None]
    padded = np.concatenate([rates[:1], rates, rates[-1:]])
    return np.asarray((padded[:-1] + padded[1:]) / 2)


def write_ros_trajectory(folder: str | Path, motion: Motion | MotionSource) -> list[Path]:
    """Write ``ros_joint_trajectory.json`` (trajectory_msgs/JointTrajectory: angles and velocities) and
    ``ros_base_trajectory.json`` (trajectory_msgs/MultiDOFJointTrajectory: pose of the root link).

    Players interpolate between points, so a trajectory cannot have a gap: each run of known configurations
    is a pair of files, numbered ``..._1.json``, ``..._2.json`` where there are several. Times count from
    the motion's first frame in all of them. Revolutes that were never observed are left out.

    Args:
        folder: where files of these names are replaced. motion: configurations, NaN where unknown.

    Returns:
        The paths written.
    """
    folder, source, paths = Path(folder), MotionSource.of(motion), []
    skeleton, unseen = source.skeleton, never_observed(source.masks)
    kept = [i for i, name in enumerate(skeleton.dof_names) if name not in unseen]
    known = runs(source.masks.known)
    for number, (start, stop) in enumerate(known, 1):
        suffix = f"_{number}" if len(known) > 1 else ""
        joints, base = (folder / f"ros_{kind}_trajectory{suffix}.json" for kind in ("joint", "base"))
        names = [skeleton.dof_names[i] for i in kept]
        with new_message(base, [skeleton.root]) as add_base, new_message(joints, names) as add_joints:
            for block in source[start:stop].blocks(margin=1):
                q, times = block.motion.q, block.motion.times - source.times[0]
                velocities = joint_velocities(skeleton, q, times)[block.own, 6:][:, kept]
                add_joints(joint_points(times[block.own], q[block.own, 7:][:, kept], velocities))
                add_base(base_points(times[block.own], q[block.own]))
        paths += [joints, base]
    return paths


@contextmanager
def new_message(path: Path, joint_names: Sequence[str]) -> Iterator[Callable[[list[Any]], None]]:
    """Write a trajectory over an existing file: yield a function that appends points, one at least."""
    head = json.dumps({"header": ros_header(0.0), "joint_names": list(joint_names), "points": []})
    with new_file(path, overwrite=True) as whole, whole.open("w", encoding="utf-8", newline="") as stream:
        stream.write(head.removesuffix("]}"))
        between = chain([""], repeat(", "))
        yield lambda points: stream.writelines([next(between), json.dumps(points)[1:-1]])
        stream.write("]}\n")


def joint_points(times: Array, q: Array, velocities: Array) -> list[dict[str, Any]]:
    """Return JointTrajectoryPoints: times (T,), s, angles and velocities (T, D)."""
    return [
        {"positions": row, "velocities": rates, "time_from_start": ros_time(time)}
        for row, rates, time in zip(q.tolist(), velocities.tolist(), times, strict=True)
    ]


def base_points(times: Array, q: Array) -> list[dict[str, Any]]:
    """Return MultiDOFJointTrajectoryPoints: times (T,), s, and configurations, of which the first seven are used."""
    rows = zip(q.tolist(), times, strict=True)
    return [{"transforms": [ros_transform(row)], "time_from_start": ros_time(time)} for row, time in rows]


def ros_time(seconds: float) -> dict[str, int]:
    """Return a builtin_interfaces/Time or Duration of seconds."""
    nanoseconds = round(float(seconds) * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def ros_header(seconds: float) -> dict[str, Any]:
    """Return a std_msgs/Header of something in world at a time, s."""
    return {"stamp": ros_time(seconds), "frame_id": WORLD_FRAME}


def ros_transform(q: Sequence[float]) -> dict[str, dict[str, float]]:
    """Return the geometry_msgs/Transform of the root link in world: the configuration's first seven numbers."""
    translation = dict(zip("xyz", q[:3], strict=True))
    return {"translation": translation, "rotation": dict(zip("xyzw", q[3:7], strict=True))}
