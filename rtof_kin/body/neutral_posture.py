"""A person's neutral posture: how the joints stand when the person stands in the T-pose.

Pelvis tilt, bends of the spine and the height of the clavicles differ between persons, and from the zero pose of the
rig, by 5 to 20 degrees. One camera and sensors at the ends of the spine do not show them; a reference pose does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, freeze
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence

SPINE: Final = ("Spine", "Spine1", "Spine2", "Spine3")
CLAVICLES: Final = ("LeftShoulder", "RightShoulder")
HIPS: Final = ("LeftUpLeg", "RightUpLeg")
JOINTS: Final = (*SPINE, *CLAVICLES, *HIPS)
"""Joints of a posture."""
_LEVEL, _UPRIGHT, _STILL = np.radians(25.0), np.radians(20.0), 0.5
"""Largest angles: arms to the horizontal, thighs and trunk to the vertical, rad; angular speed, rad/s."""
_SHORTEST: Final = 0.2
"""Shortest T-pose, s."""


@dataclass(frozen=True)
class NeutralPosture:
    """Rotations of some joints in the T-pose."""

    joints: tuple[str, ...]
    """K joints."""
    quat_wxyz: Array
    """(K, 4) rotation of each relative to its parent."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", checked_names("joints of the posture", self.joints))
        freeze(self, "posture", quat_wxyz=(len(self.joints), 4))
        if not np.allclose(np.linalg.norm(self.quat_wxyz, axis=-1), 1.0, atol=1e-3):
            raise InvalidInputError("posture quat_wxyz: not unit quaternions; give w, x, y, z of each joint")

    @property
    def R_parent_bone(self) -> Array:
        """(K, 3, 3) rotation of each joint relative to its parent."""
        return so3.from_quat_wxyz(self.quat_wxyz)

    @classmethod
    def of(cls, poses: PoseSequence, parents: Sequence[int], joints: Sequence[str] = JOINTS) -> Self:
        """Return the mean posture of poses.

        Args:
            poses: (T) in the T-pose. parents: (J,) of their joints.
        """
        known = poses.R_world_bone[np.isfinite(poses.R_world_bone).all(axis=(1, 2, 3))]
        if len(known) == 0:
            raise InvalidInputError("posture: no frame of the T-pose is complete")
        local = kinematics.local_rotations(parents, known).mean(axis=0)
        index = [poses.names.index(joint) for joint in joints]
        return cls(tuple(joints), so3.to_quat_wxyz(so3.nearest_rotation(local[index])))


def standing_frames(poses: PoseSequence, rate_hz: float | None = None) -> Mask:
    """Return in which frames (T,) the person stands still: thighs and upper trunk upright, nothing turns.

    Args:
        poses: of the 21-joint skeleton, evenly spaced. rate_hz: of the frames; default: that of the poses.
    """
    R = poses.R_world_bone
    turns = so3.angle_between(R[:-1], R[1:]) * (rate_hz or poses.rate_hz)
    fast = np.nan_to_num(turns, nan=np.inf).max(axis=1) > _STILL
    still = ~np.append(fast, fast[-1:]) & ~np.append(fast[:1], fast)
    upright = R[:, [poses.names.index(n) for n in ("LeftUpLeg", "RightUpLeg", "Spine3")], 2, 2] > np.cos(_UPRIGHT)
    return np.asarray(still & upright.all(axis=1))


def t_pose_frames(poses: PoseSequence) -> Mask:
    """Return in which frames (T,) the person stands still with level arms.

    Args:
        poses: of the 21-joint skeleton, evenly spaced.
    """
    arms = [poses.names.index(name) for name in ("LeftArm", "RightArm")]
    level = np.abs(poses.R_world_bone[:, arms, 2, 1]) < np.sin(_LEVEL)
    return np.asarray(standing_frames(poses) & level.all(axis=1))


def posture_from_t_pose(poses: PoseSequence, parents: Sequence[int]) -> NeutralPosture | None:
    """Return the posture of the first T-pose; None where there is none.

    Args:
        poses: of the 21-joint skeleton, evenly spaced. parents: (J,) of its joints.
    """
    least = _SHORTEST * poses.rate_hz
    runs = [(start, stop) for start, stop in signals.runs(t_pose_frames(poses)) if stop - start >= least]
    return NeutralPosture.of(poses[slice(*runs[0])], parents) if runs else None
