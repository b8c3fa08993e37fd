"""Joint trajectories of the URDF: CSV with a JSON sidecar of units, and ROS messages as JSON.

ROS's JointTrajectory has joints of one degree of freedom only, so the free base is a message of its own, a
``trajectory_msgs/MultiDOFJointTrajectory``. JSON is YAML, which ROS's tools read.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pinocchio as pin

from rtof_kin.body.observability import never_observed, observed_dofs, root_turn_observed
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import write_text
from rtof_kin.core.signals import runs

BASE_COLUMNS: Final = ("base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw")
BASE_TURN: Final = "base_q"
"""Name of the base's orientation as a whole."""
WORLD_FRAME: Final = "world"
"""``frame_id`` of poses in ROS messages."""


def joint_velocities(skeleton: SkeletonModel, q: Array, times: Array) -> Array:
    """Central differences on the configuration manifold, one-sided at the ends.

    Args:
        skeleton: the model. q: (T, nq) configurations. times: (T,) s.

    Returns:
        (T, nv) in Pinocchio's convention: base linear and angular velocity in the root's frame, then rad/s.
    """
    if len(q) < 2:
        return np.zeros((len(q), skeleton.nv))
    steps = [pin.difference(skeleton.model, a, b) for a, b in pairwise(q)]
    rates = np.array(steps) / np.diff(times)[:, None]
    padded = np.concatenate([rates[:1], rates, rates[-1:]])
    return np.asarray((padded[:-1] + padded[1:]) / 2)


def write_joint_trajectory_csv(path: str | Path, motion: MotionSequence) -> None:
    """Write named columns: time, base pose, an angle per revolute, and ``NAME_valid`` of the base's
    orientation and of each revolute, 0 where unobserved. Units are in ``<name>.json`` beside the table.

    Args:
        path: the table; an existing file is replaced. motion: configurations and their observability.
    """
    path, skeleton = Path(path), motion.skeleton
    columns = ("time", *BASE_COLUMNS, *skeleton.dof_names, *_valid_columns(skeleton))
    valid = np.column_stack([root_turn_observed(motion), observed_dofs(motion)]).astype(int)
    sidecar = json.dumps(_sidecar(path, skeleton), indent=2) + "\n"
    with new_file(path, overwrite=True) as file:
        with file.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            for time, row, flags in zip(motion.times, motion.q, valid.tolist(), strict=True):
                writer.writerow([*(repr(float(value)) for value in (time, *row)), *flags])
        write_text(path.with_suffix(".json"), sidecar, overwrite=True)


def _valid_columns(skeleton: SkeletonModel) -> list[str]:
    return [f"{name}_valid" for name in (BASE_TURN, *skeleton.dof_names)]


def _sidecar(path: Path, skeleton: SkeletonModel) -> dict[str, Any]:
    units = {"time": "s"} | dict.fromkeys(BASE_COLUMNS[:3], "m") | dict.fromkeys(BASE_COLUMNS[3:], "1")
    units |= dict.fromkeys(skeleton.dof_names, "rad") | dict.fromkeys(_valid_columns(skeleton), "1")
    dofs = {dof.urdf: dof for joint in skeleton.table.joints for dof in joint.dofs}
    return {
        "file": path.name,
        "urdf": "skeleton.urdf",
        "frame": "world: z up, metres; base: pose of the root link in world, quaternion x y z w",
        "units": units,
        "valid": "NAME_valid: 1 where NAME was observed, 0 where it comes from a prior or the model",
        "names": {
            name: {"clinical": dofs[name].clinical, "opensim": dofs[name].opensim}
            for name in skeleton.dof_names
        },
        "sign": "a leading '-' of a clinical or OpenSim name: its sign is the opposite of the column's",
        "limits": dict(zip(skeleton.dof_names, skeleton.limits.tolist(), strict=True)),
    }


def read_joint_trajectory_csv(path: str | Path) -> tuple[tuple[str, ...], Array]:
    """Read column names and numbers (T, columns) of a trajectory written here.

    Args:
        path: the table.

    Raises:
        FileFormatError: missing, or not a table of numbers whose first column is `time`.
    """
    columns = read_csv(Path(path))
    table = np.stack(list(columns.values()), axis=-1)
    if next(iter(columns)) != "time" or len(table) == 0:
        raise FileFormatError(path, "the first column is not 'time', or there are no rows")
    return tuple(columns), table


def write_ros_trajectory(folder: str | Path, motion: MotionSequence) -> list[Path]:
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
    folder, times, paths = Path(folder), motion.times - motion.times[0], []
    unseen = never_observed(motion)
    known = runs(np.isfinite(motion.q).all(axis=1))
    for number, (start, stop) in enumerate(known, 1):
        q, t = motion.q[start:stop], times[start:stop]
        messages = {
            "joint": _joint_message(motion.skeleton, q, t, unseen),
            "base": _base_message(motion.skeleton, q, t),
        }
        for kind, message in messages.items():
            suffix = f"_{number}" if len(known) > 1 else ""
            paths.append(folder / f"ros_{kind}_trajectory{suffix}.json")
            write_text(paths[-1], json.dumps(message) + "\n", overwrite=True)
    return paths


def _joint_message(
    skeleton: SkeletonModel, q: Array, times: Array, without: tuple[str, ...]
) -> dict[str, Any]:
    kept = [i for i, name in enumerate(skeleton.dof_names) if name not in without]
    angles = q[:, 7:][:, kept]
    velocities = joint_velocities(skeleton, q, times)[:, 6:][:, kept]
    return {
        "header": ros_header(0.0),
        "joint_names": [skeleton.dof_names[i] for i in kept],
        "points": [
            {"positions": row, "velocities": rates, "time_from_start": ros_time(time)}
            for row, rates, time in zip(angles.tolist(), velocities.tolist(), times, strict=True)
        ],
    }


def _base_message(skeleton: SkeletonModel, q: Array, times: Array) -> dict[str, Any]:
    points = []
    for row, time in zip(q.tolist(), times, strict=True):
        points.append({"transforms": [ros_transform(row)], "time_from_start": ros_time(time)})
    return {"header": ros_header(0.0), "joint_names": [skeleton.root], "points": points}


def ros_time(seconds: float) -> dict[str, int]:
    """Return a builtin_interfaces/Time or Duration.

    Args:
        seconds: s.
    """
    nanoseconds = round(float(seconds) * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def ros_header(seconds: float) -> dict[str, Any]:
    """Return a std_msgs/Header of something in world.

    Args:
        seconds: its time, s.
    """
    return {"stamp": ros_time(seconds), "frame_id": WORLD_FRAME}


def ros_transform(q: Sequence[float]) -> dict[str, dict[str, float]]:
    """Return the geometry_msgs/Transform of the root link in world.

    Args:
        q: configuration; its first seven numbers.
    """
    translation = dict(zip("xyz", q[:3], strict=True))
    return {"translation": translation, "rotation": dict(zip("xyzw", q[3:7], strict=True))}
