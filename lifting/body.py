"""The body of a lifter: joints, tree, nominal bones, and segments that may carry sensors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from lifting.arrays import Tensor, like, namespace

_SIDED = re.compile(r"(Left|Right|L|R)(?=[A-Z])")


@dataclass(frozen=True)
class Body:
    """Joints of a lifter with their tree and nominal bones."""

    names: tuple[str, ...]  #: J joint names, root first, parents before children; sides by name, see `side_of`
    parents: tuple[int, ...]  #: (J,) index of each joint's parent, -1 for the root
    nominal_bones: tuple[float, ...]  #: (3 G,) mean `bones_of` the training skeletons, m
    sensors: tuple[str, ...] = ()
    """S joints whose segments may carry a sensor; if none, orientations are neither input nor output."""

    @cached_property
    def mirrored(self) -> list[int]:
        """(J,) index of each joint's counterpart on the other side, itself in the middle."""
        sided = [side_of(name) for name in self.names]
        index = {key: j for j, key in enumerate(sided)}
        other = {"": "", "left": "right", "right": "left"}
        return [index.get((other[side], rest), j) for j, (side, rest) in enumerate(sided)]

    @cached_property
    def hips(self) -> list[int]:
        """Indices of the root's sided children: their mean replaces an unseen root."""
        return [j for j, p in enumerate(self.parents) if p == 0 and side_of(self.names[j])[0]]

    @cached_property
    def legs(self) -> list[list[int]]:
        """Indices of hip, knee and ankle of each leg."""
        return [limb for limb in self._limbs if limb[0] in self.hips]

    @cached_property
    def arms(self) -> list[list[int]]:
        """Indices of shoulder, elbow and wrist of each arm."""
        return [limb for limb in self._limbs if limb[0] not in self.hips]

    @cached_property
    def feet(self) -> list[int]:
        """Indices of the ankles."""
        return [leg[-1] for leg in self.legs]

    @cached_property
    def _limbs(self) -> list[list[int]]:
        """Last three joints of every sided chain."""
        parents = self.parents
        ends = [j for j in range(len(parents)) if j not in parents and parents[j] > 0]
        return [[parents[parents[j]], parents[j], j] for j in ends if side_of(self.names[j])[0]]

    @cached_property
    def sensor_joints(self) -> list[int]:
        """Index of the joint of each sensor's segment."""
        return [self.names.index(name) for name in self.sensors]

    @cached_property
    def mirrored_sensors(self) -> list[int]:
        """(S,) index of each sensor's counterpart on the other side."""
        return [self.sensor_joints.index(self.mirrored[j]) for j in self.sensor_joints]

    def bones_of(self, offsets: Tensor) -> Tensor:
        """Return the bones (..., 3 G), m, of a person with joint offsets (..., J, 3), m.

        One offset per bone in its parent's link frame: the right side is mirrored and averaged with the left, bones in
        the middle lose their sideways part.
        """
        parts = []
        for joints in bone_groups(self.names).values():
            side = [[1.0, -1.0 if side_of(self.names[j])[0] == "right" else 1.0, 1.0] for j in joints]
            middle = [1.0, float(len(joints) > 1), 1.0]
            mean = (offsets[..., joints, :] * like(offsets, side)).mean(axis=-2)
            parts.append(mean * like(offsets, middle))
        return namespace(offsets).concat(parts, axis=-1)


def bone_groups(joint_names: tuple[str, ...]) -> dict[str, list[int]]:
    """Return the joint indices of each bone, left and right together, by its distal joint's name without side."""
    groups: dict[str, list[int]] = {}
    for j, name in enumerate(joint_names[1:], start=1):
        groups.setdefault(side_of(name)[1], []).append(j)
    return groups


def side_of(joint_name: str) -> tuple[str, str]:
    """Split a joint's name, such as ``LeftArm`` or ``LElbow``, into its side ('left', 'right' or '') and the rest."""
    found = _SIDED.match(joint_name)
    if not found:
        return "", joint_name
    return ("left" if found[0].startswith("L") else "right"), joint_name[found.end() :]
