"""Simple solids: one mesh for all segments, placed, stretched and coloured for each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import freeze

_TRUNK: Final = (0.8, 1.25)
"""Depth and width of a segment in the middle of the body, relative to the radius in the table."""
_LONGER: Final = 1.12
"""Length of a solid relative to its bone: neighbours overlap."""
_AROUND, _ALONG = 16, 11
"""Vertices of a mesh around its axis and along it."""


@dataclass(frozen=True)
class Mesh:
    """Triangles."""

    vertices: Array
    """(V, 3) m."""
    faces: NDArray[np.uint32]
    """(F, 3) vertices, counterclockwise from outside."""


@dataclass(frozen=True)
class SegmentSolids:
    """Place and size of the solid of each segment, in its link frame."""

    centers: Array
    """(J, 3) m from the joint."""
    R_bone_solid: Array
    """(J, 3, 3); the solid's z axis is along the bone."""
    sizes: Array
    """(J, 3) m, half thickness in x and y, half length in z."""

    def __post_init__(self) -> None:
        freeze(self, "solids", centers=("J", 3), R_bone_solid=("J", 3, 3), sizes=("J", 3))


def barrel(power: float = 3.0) -> Mesh:
    """Return a solid of revolution about z with radius 1 and half length 1, round at its ends.

    Args:
        power: 2 for a sphere; the larger, the more like a cylinder.
    """
    angles = np.linspace(0, np.pi, _ALONG)
    z = -np.cos(angles)
    radius = np.maximum(1 - np.abs(z) ** power, 0.0) ** (1 / power)
    turn = np.arange(_AROUND) * 2 * np.pi / _AROUND
    rings = np.stack(
        np.broadcast_arrays(radius[1:-1, None] * np.cos(turn), radius[1:-1, None] * np.sin(turn), z[1:-1, None]),
        axis=-1,
    )
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, -1.0], [0, 0, 1.0]]])
    return Mesh(vertices, _faces(len(rings)))


def sphere() -> Mesh:
    """Return a sphere of radius 1."""
    return barrel(2.0)


def box() -> Mesh:
    """Return a cube from -1 to 1."""
    corners = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = np.concatenate([corners[list(quad)] for quad in quads])  # not shared: edges stay sharp
    faces = [(4 * i + a, 4 * i + b, 4 * i + c) for i in range(6) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return Mesh(vertices, np.array(faces, dtype=np.uint32))


def segment_solids(skeleton: SkeletonModel) -> SegmentSolids:
    """Return the solids of a person's segments, of the thickness in the skeleton's table."""
    centers, turns, sizes = [], [], []
    for joint in skeleton.table.joints:
        along = so3.unit(joint.end)
        length = float(np.linalg.norm(joint.end))
        middle = abs(joint.end[1]) < 1e-3 and not joint.name.startswith(("Left", "Right"))
        depth, width = _TRUNK if middle else (1.0, 1.0)
        centers.append(joint.end / 2)
        turns.append(so3.minimal_rotation(np.array([0.0, 0.0, 1.0]), along))
        sizes.append([depth * joint.radius, width * joint.radius, _LONGER * length / 2])
    return SegmentSolids(np.array(centers), np.array(turns), np.array(sizes))


def _faces(rings: int) -> NDArray[np.uint32]:
    """Return the triangles of rings of `_AROUND` vertices, and of the poles after them."""
    here = np.arange(_AROUND)
    after = (here + 1) % _AROUND
    faces = []
    for ring in range(rings - 1):
        low, high = ring * _AROUND, (ring + 1) * _AROUND
        faces.append(np.stack([low + here, low + after, high + after], axis=1))
        faces.append(np.stack([low + here, high + after, high + here], axis=1))
    bottom, top = rings * _AROUND, rings * _AROUND + 1
    last = (rings - 1) * _AROUND
    faces.append(np.stack([np.full(_AROUND, bottom), after, here], axis=1))
    faces.append(np.stack([np.full(_AROUND, top), last + here, last + after], axis=1))
    return np.concatenate(faces).astype(np.uint32)
