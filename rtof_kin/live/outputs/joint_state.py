"""Estimates as plain data in the shape of ROS messages, for JSON.

A message is a ``sensor_msgs/JointState`` with more keys, so that a reader of joint states needs no other:

========== ==========================================================================================
header     time of the pose on the clock of the sensors, and the frame, ``world``
name       revolutes of the URDF
position   their angles, rad, each on the turn nearest to the middle of its limits
velocity   rad/s, from the message before; empty for the first one and after an interruption
effort     empty
root       ``geometry_msgs/TransformStamped`` of the root link in world; its transform is null if unknown
joints     ``position`` in world, m (null if missing), ``valid`` and ``provenance``, of each joint
lag_s      age of the pose when it was estimated
frame_s    time that the estimate took
========== ==========================================================================================

As ROS asks, `position` is empty where the configuration is unknown.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.joint_trajectory import ros_header, ros_transform
from rtof_kin.live.samples import OnlineEstimate

Data = dict[str, Any]
_LONGEST_STEP_S: Final = 0.25
"""Time between two poses above which their difference says nothing about the velocity."""
_DIGITS: Final = 5
"""Digits after the point of joint positions, m."""


class JointStates:
    """Messages of successive estimates of one skeleton."""

    def __init__(self, skeleton: SkeletonModel):
        """Take the skeleton whose poses come."""
        self._skeleton = skeleton
        joints = skeleton.table.joints[1:]
        index = [[skeleton.dof_names.index(dof.urdf) for dof in joint.dofs] for joint in joints]
        self._index = np.array(index).reshape(-1, 3)
        self._middle = skeleton.limits.mean(axis=1)
        self._last: tuple[float, Array] | None = None

    def description(self) -> Data:
        """Return what the messages refer to: joints and their parents; revolutes with the joint they are of,
        clinical name and its sign relative to the revolute; the meaning of the numbers of `provenance`.
        """
        skeleton = self._skeleton
        dofs = {dof.urdf: (joint.name, dof) for joint in skeleton.table.joints for dof in joint.dofs}
        return {
            "name": skeleton.name,
            "height_m": skeleton.height,
            "joints": list(skeleton.names),
            "parents": [int(parent) for parent in skeleton.parents],
            "angles": [
                {
                    "name": name,
                    "joint": joint,
                    "clinical": dof.clinical.lstrip("-"),
                    "sign": -1 if dof.clinical.startswith("-") else 1,
                }
                for name, (joint, dof) in ((name, dofs[name]) for name in skeleton.dof_names)
            ],
            "provenance": [member.name.lower().replace("_", " ") for member in Provenance],
        }

    def message(self, estimate: OnlineEstimate) -> Data:
        """Return the message of an estimate, see the module.

        Raises:
            UnknownNameError, InvalidInputError: its joints are not those of the skeleton.
        """
        poses, skeleton = estimate.poses, self._skeleton
        skeleton.check_joints(poses.names)
        time = float(poses.times[-1])
        p = poses.p_world_joint[-1]
        q = skeleton.inverse_kinematics(p[None], poses.R_world_bone[-1:])[0]
        known = bool(np.isfinite(q).all())
        header = ros_header(time)
        return {
            "header": header,
            "name": list(skeleton.dof_names),
            "position": self._near(q[7:], self._middle).tolist() if known else [],
            "velocity": self._velocity(time, q[7:]) if known else [],
            "effort": [],
            "root": {
                "header": header,
                "child_frame_id": skeleton.root,
                "transform": ros_transform(q.tolist()) if known else None,
            },
            "joints": {
                "position": [
                    row if finite else None
                    for row, finite in zip(p.round(_DIGITS).tolist(), np.isfinite(p).all(axis=1).tolist(), strict=True)
                ],
                "valid": poses.valid[-1].tolist(),
                "provenance": poses.provenance[-1].tolist(),
            },
            "lag_s": float(estimate.lag_s),
            "frame_s": float(estimate.seconds),
        }

    def _near(self, angles: Array, reference: Array) -> Array:
        """Return the equivalent angles (D,) nearest to others, rad."""
        out = np.empty_like(angles)
        out[self._index] = so3.euler_near(angles[self._index], reference[self._index])
        return out

    def _velocity(self, time: float, angles: Array) -> list[float]:
        last, self._last = self._last, (time, angles)
        if last is None or not 0 < time - last[0] <= _LONGEST_STEP_S:
            return []
        rates: list[float] = ((self._near(angles, last[1]) - last[1]) / (time - last[0])).tolist()
        return rates
