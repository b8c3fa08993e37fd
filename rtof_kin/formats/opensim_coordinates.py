"""Coordinates of an .osim and a .mot: OpenSim's names for the skeleton's revolutes.

The skeleton table has the names. With a leading minus, as in ``-hip_flexion_r``, the coordinate turns about
the opposite of the revolute's axis, so that its values have OpenSim's sign; a revolute without a name in
OpenSim keeps the URDF's. Every angle is zero in the T-pose. The root has OpenSim's pelvis_tilt, _list,
_rotation, _tx, _ty and _tz: rotations about z, x, y and translations along x, y, z of its ground, y up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import checked_names
from rtof_kin.formats.joint_trajectory import BASE_TURN
from rtof_kin.formats.motion_views import check_known
from rtof_kin.formats.world_axes import R_WORLD_GROUND

Array = NDArray[np.float64]
ROOT_AXES: Final = "yxz"
"""Rotation axes of the root in world: z, x and y of OpenSim's ground, the first one reversed."""
_ROOT_ROTATIONS: Final = ("-pelvis_tilt", "pelvis_list", "pelvis_rotation")
_ROOT_TRANSLATIONS: Final = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
_ROOT_RANGE_M: Final = 10.0


@dataclass(frozen=True)
class Coordinate:
    """One degree of freedom of an .osim."""

    name: str
    joint: str
    """The joint of the skeleton that it moves."""
    axis: Array
    """(3,) axis of rotation or translation, in the joint's axes with all angles zero."""
    is_rotation: bool
    range: tuple[float, float]
    """Radians or metres."""
    urdf: str = ""
    """Its URDF name; `BASE_TURN` for the root's rotations, empty for its translations."""

    @property
    def sign(self) -> float:
        """-1 where the axis is the opposite of a link frame's, else 1."""
        return float(np.sign(self.axis.sum()))


def coordinates(table: SkeletonTable) -> tuple[Coordinate, ...]:
    """Return all coordinates: three rotations and three translations of the root, then three rotations of
    each joint in the order of its axes.

    Args:
        table: the skeleton.

    Raises:
        InvalidInputError: two would have one name.
    """
    root = table.names[0]
    out = [
        _rotation(root, axis, name, BASE_TURN, (-np.pi, np.pi))
        for axis, name in zip(ROOT_AXES, _ROOT_ROTATIONS, strict=True)
    ]
    for name, axis in zip(_ROOT_TRANSLATIONS, R_WORLD_GROUND.T, strict=True):
        out.append(Coordinate(name, root, axis, False, (-_ROOT_RANGE_M, _ROOT_RANGE_M)))
    for joint in table.joints[1:]:
        for axis, dof, (low, high) in zip(joint.axes, joint.dofs, joint.limits, strict=True):
            out.append(_rotation(joint.name, axis, dof.opensim, dof.urdf, (low, high)))
    checked_names("OpenSim coordinates", [c.name for c in out])
    return tuple(out)


def _rotation(joint: str, axis: str, opensim: str, urdf: str, limits: tuple[float, float]) -> Coordinate:
    low, high = map(float, limits)
    unit = np.eye(3)["xyz".index(axis)]
    if opensim.startswith("-"):
        return Coordinate(opensim[1:], joint, -unit, True, (-high, -low), urdf)
    return Coordinate(opensim or urdf, joint, unit, True, (low, high), urdf)


def coordinate_values(motion: MotionSequence) -> tuple[tuple[Coordinate, ...], Array]:
    """Return the coordinates of a motion and their values (T, C), rad and m, continuous over time.

    Args:
        motion: its configurations must be known, see `formats.motion_views.pieces`.

    Raises:
        InvalidInputError: a configuration is unknown.
    """
    check_known(motion)
    skeleton, R_world_root = motion.skeleton, motion.poses.R_world_bone[:, 0]
    every = coordinates(skeleton.table)
    index = [skeleton.dof_names.index(d.urdf) for j in skeleton.table.joints for d in j.dofs]
    unsigned = [
        so3.euler_continuous(so3.matrix_to_euler(ROOT_AXES, R_world_root)),
        motion.q[:, :3] @ np.abs(R_WORLD_GROUND),
        motion.q[:, 7:][:, index],
    ]
    return every, np.concatenate(unsigned, axis=1) * [c.sign for c in every]
