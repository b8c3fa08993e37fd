"""`ArticulatedMotion`: a tree of joints with rest offsets and local rotations, as in BVH and ASF files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, indices_of, readonly
from rtof_kin.core.errors import InvalidInputError


@dataclass(frozen=True)
class ArticulatedMotion:
    """A moving tree of joints in the axes and the length unit of its file.

    A joint's frame is that of the segment that begins at it. Without any rotation all frames are parallel
    to the file's world.
    """

    names: tuple[str, ...]  #: J joint names; parents before children
    parents: tuple[int, ...]  #: J indices of the parent joint; -1 for the root, which is first
    offsets: Array  #: (J, 3) position of each joint in its parent's frame, file units; root row as in the file
    R_parent_joint: Array  #: (T, J, 3, 3) rotation of each joint's frame in its parent's; of the root, in the world
    p_root: Array  #: (T, 3) position of the root joint in the file's world, file units
    rate_hz: float  #: Frames per second
    unit_m: float | None = None  #: Metres per unit of length; None where the format does not state it
    p_parent_joint: Array | None = None
    """(T, J, 3) file units: positions of joints that move in their parent's frame; None where `offsets`
    holds at all times."""
    end_parents: tuple[int, ...] = ()  #: E indices of the joints that end sites are fixed to
    end_offsets: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(E, 3) position of each end site in its joint's frame, file units."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        J, T, E = len(self.names), len(self.p_root), len(self.end_parents)
        set_(self, "names", checked_names("motion names", self.names))
        set_(self, "parents", tuple(int(p) for p in self.parents))
        if J == 0 or len(self.parents) != J:
            raise InvalidInputError("motion: needs at least one joint and as many parents as names")
        if self.parents[0] != -1 or any(not 0 <= p < j + 1 for j, p in enumerate(self.parents[1:])):
            raise InvalidInputError("motion parents: the root comes first, then parents before children")
        set_(self, "end_parents", tuple(int(p) for p in self.end_parents))
        shapes: dict[str, tuple[int, ...]] = {
            "offsets": (J, 3),
            "p_root": (T, 3),
            "R_parent_joint": (T, J, 3, 3),
            "end_offsets": (E, 3),
        }
        if self.p_parent_joint is not None:
            shapes["p_parent_joint"] = (T, J, 3)
        for name, shape in shapes.items():
            set_(self, name, readonly(f"motion {name}", getattr(self, name), shape))
        if not so3.is_rotation(self.R_parent_joint, tolerance=1e-5):
            raise InvalidInputError("motion R_parent_joint: not rotation matrices; orthonormalise first")
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise InvalidInputError(f"motion rate_hz: {self.rate_hz} is not a positive number of frames/s")

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
        """Return the index of a joint; `UnknownNameError` lists the existing ones."""
        return indices_of("joint", [name], self.names)[0]

    def renamed(self, names: Mapping[str, str]) -> Self:
        """Return the motion with other names for some joints; `UnknownNameError` for no such joint, `InvalidInputError`
        where two would have one name.
        """
        indices_of("joint", list(names), self.names)
        return replace(self, names=tuple(names.get(name, name) for name in self.names))

    def forward_kinematics(self) -> tuple[Array, Array]:
        """Return p_world_joint (T, J, 3) in file units and R_world_joint (T, J, 3, 3) in the file's world."""
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
