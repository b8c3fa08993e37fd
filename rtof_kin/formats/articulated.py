"""A motion as joint-rotation files carry it: a tree of joints, rest offsets, local rotations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import ShapeError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArticulatedMotion:
    """A tree of joints in motion, in the axes and the length unit of its file.

    A joint's frame is that of the segment that begins at it. Before any rotation all frames of a
    BVH or ASF file are parallel to the file's world.
    """

    names: tuple[str, ...]
    """J joint names; a parent stands before its children."""
    parents: tuple[int, ...]
    """J indices of the parent joint; -1 for the root, which is first."""
    offsets: Array
    """(J, 3) position of each joint in its parent's frame, file units; root row as in the file."""
    R_parent_joint: Array
    """(T, J, 3, 3) rotation of each joint's frame in its parent's; of the root, in the world."""
    p_root: Array
    """(T, 3) position of the root joint in the file's world, file units."""
    rate_hz: float
    """Frames per second, as the file says."""
    unit_m: float | None = None
    """Metres per unit of length; None where the format does not say."""
    p_parent_joint: Array | None = None
    """(T, J, 3) file units: where a file moves joints in their parent's frame; None where `offsets`
    holds at all times."""
    end_parents: tuple[int, ...] = ()
    """E indices of the joints that end sites are fixed to."""
    end_offsets: Array = None  # type: ignore[assignment]
    """(E, 3) position of each end site in its joint's frame, file units."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        J, T = len(self.names), len(self.p_root)
        set_(self, "names", tuple(self.names))
        set_(self, "parents", tuple(int(p) for p in self.parents))
        self._check_tree()
        set_(self, "offsets", readonly("motion offsets", self.offsets, (J, 3)))
        set_(self, "p_root", readonly("motion p_root", self.p_root, (T, 3)))
        R = readonly("motion R_parent_joint", self.R_parent_joint, (T, J, 3, 3))
        set_(self, "R_parent_joint", R)
        if not so3.is_rotation(R, tolerance=1e-5):
            raise ShapeError("motion R_parent_joint: not rotation matrices; orthonormalise first")
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ShapeError(f"motion rate_hz: {self.rate_hz} is not a positive number of frames/s")
        if self.p_parent_joint is not None:
            moving = readonly("motion p_parent_joint", self.p_parent_joint, (T, J, 3))
            set_(self, "p_parent_joint", moving)
        ends = np.zeros((0, 3)) if self.end_offsets is None else self.end_offsets
        set_(self, "end_parents", tuple(int(p) for p in self.end_parents))
        E = len(self.end_parents)
        set_(self, "end_offsets", readonly("motion end_offsets", ends, (E, 3)))

    def _check_tree(self) -> None:
        if not self.names or len(self.parents) != len(self.names):
            raise ShapeError("motion: as many parents as names are needed, and at least one joint")
        if len(set(self.names)) < len(self.names):
            raise ShapeError("motion names: a joint stands there more than once")
        if self.parents[0] != -1 or any(not 0 <= p < j + 1 for j, p in enumerate(self.parents[1:])):
            raise ShapeError("motion parents: the root comes first, then parents before children")

    def __len__(self) -> int:
        return len(self.p_root)

    def __getitem__(self, frames: slice) -> Self:
        moving = self.p_parent_joint
        return replace(
            self,
            R_parent_joint=self.R_parent_joint[frames],
            p_root=self.p_root[frames],
            p_parent_joint=None if moving is None else moving[frames],
        )

    def index(self, name: str) -> int:
        """Index of a joint; `UnknownNameError` lists those that exist."""
        return indices_of("joint", [name], self.names)[0]

    def renamed(self, names: Mapping[str, str]) -> Self:
        """The same with other names for some joints.

        Raises:
            UnknownNameError: one is not there. ShapeError: two would have one name.
        """
        indices_of("joint", list(names), self.names)
        return replace(self, names=tuple(names.get(name, name) for name in self.names))

    def forward_kinematics(self) -> tuple[Array, Array]:
        """Positions and orientations of all joints in the file's world.

        Returns:
            p_world_joint (T, J, 3) in file units and R_world_joint (T, J, 3, 3).
        """
        R_world_joint = np.empty_like(self.R_parent_joint)
        p_world_joint = np.empty((len(self), len(self.names), 3))
        for j, parent in enumerate(self.parents):
            if parent < 0:
                R_world_joint[:, j], p_world_joint[:, j] = self.R_parent_joint[:, j], self.p_root
                continue
            moving = self.p_parent_joint
            offset = self.offsets[j] if moving is None else moving[:, j, :, None]
            arm = R_world_joint[:, parent] @ offset
            p_world_joint[:, j] = p_world_joint[:, parent] + (arm if moving is None else arm[..., 0])
            R_world_joint[:, j] = R_world_joint[:, parent] @ self.R_parent_joint[:, j]
        return p_world_joint, R_world_joint

    def end_positions(self) -> Array:
        """Positions (T, E, 3) of the end sites in the file's world, file units."""
        p_world_joint, R_world_joint = self.forward_kinematics()
        joints = list(self.end_parents)
        arms = np.einsum("teij,ej->tei", R_world_joint[:, joints], self.end_offsets)
        return np.asarray(p_world_joint[:, joints] + arms)
