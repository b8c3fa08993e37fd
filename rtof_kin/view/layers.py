"""People, sensors and paths in the scene, each drawn by batched meshes of viser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.packages import optional
from rtof_kin.data.keypoints import Measurements
from rtof_kin.data.poses import PoseSequence, Rgb
from rtof_kin.view.block_content import AXES_LENGTH, BlockContent, segment_solids

_TRANSPARENT: Final = 0.45  # Opacity of a person beside the motion
_AXES_RADIUS: Final = 0.0035
_UNKNOWN: Final = (150, 150, 150)
_FADING: Final = 1.7  # Exponent by which the browser's tone mapping makes colours paler
_ELLIPSOID: Final = (120, 94, 240)
_ELLIPSOID_OPACITY: Final = 0.25
_SENSOR: Final = (40, 40, 48)
_SENSOR_SIZE: Final = np.array([0.024, 0.017, 0.007])  # [m] Half edges of a drawn sensor
_SENSOR_AXES: Final = 0.09  # [m]
_AROUND, _ALONG = 16, 11  # Vertices of a mesh around its axis and along it


def solid_colours(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return colours (..., 3) RGB that look on a lit solid as the given ones do in the legend."""
    return np.round(255 * (colours / 255) ** _FADING).astype(np.uint8)


def barrel(power: float = 3.0) -> Any:
    """Return a `trimesh.Trimesh` of revolution about z with radius 1 and half length 1, round at its ends.

    `power`: 2 for a sphere; the larger, the more like a cylinder.
    """
    z = -np.cos(np.linspace(0, np.pi, _ALONG))
    radius = np.maximum(1 - np.abs(z) ** power, 0.0) ** (1 / power)
    return optional("trimesh.creation", "view").revolve(np.column_stack([radius, z]), sections=_AROUND)


def _meshes(server: Any, name: str, mesh: Any, count: int, colours: Any, **options: Any) -> Any:
    """Add copies of a mesh to the scene, not yet shown."""
    return server.scene.add_batched_meshes_simple(
        name,
        np.asarray(mesh.vertices, dtype=np.float32),
        np.asarray(mesh.faces, dtype=np.uint32),
        _upright(count),
        np.zeros((count, 3)),
        batched_scales=np.zeros((count, 3)),
        batched_colors=colours,
        lod="off",
        receive_shadow=False,
        **options,
    )


def _axes(server: Any, name: str, count: int, length: float) -> Any:
    return server.scene.add_batched_axes(
        name, _upright(count), np.zeros((count, 3)), np.zeros(count), axes_length=length, axes_radius=_AXES_RADIUS
    )


def _upright(count: int) -> NDArray[np.float32]:
    """Return identity quaternions (count, 4)."""
    return np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (count, 1))


def _put(handle: Any, positions: Array, quat_wxyz: Array, scales: Array) -> None:
    """Move the n copies of a batched node: positions (n, 3) m, orientations (n, 4), scales (n,) or (n, 3)."""
    handle.batched_positions = positions
    handle.batched_wxyzs = quat_wxyz
    handle.batched_scales = scales


class Body:
    """Solids of the segments of one person. `colour`: of all segments; None: that of their provenance."""

    def __init__(
        self, server: Any, name: str, skeleton: SkeletonModel, colour: Rgb | None = None, opacity: float = 1.0
    ):
        self._sizes, self._colour = np.asarray(segment_solids(skeleton).sizes, dtype=np.float32), colour
        colours = solid_colours(np.tile(np.array(colour or _UNKNOWN, dtype=np.uint8), (len(self._sizes), 1)))
        shading = {"opacity": None if opacity == 1 else opacity, "cast_shadow": opacity == 1}
        self.handle = _meshes(server, name, barrel(), len(self._sizes), colours, **shading)

    def show(self, content: BlockContent, i: int) -> None:
        """Show one frame."""
        sizes = self._sizes * content.shown[i][:, None]
        _put(self.handle, content.centers[i], content.solids_wxyz[i], sizes)
        if self._colour is None:
            self.handle.batched_colors = solid_colours(content.colours[i])
        opacities = content.opacities[i]
        self.handle.batched_opacities = None if np.all(opacities == 1) else opacities


class Person:
    """The motion: segments by provenance, axes of its joints, 95 % ellipsoids of its positions."""

    def __init__(self, server: Any, name: str, skeleton: SkeletonModel, confidence: bool):
        count = len(skeleton.names)
        self.body = Body(server, f"{name}/segments", skeleton)
        self.axes = _axes(server, f"{name}/joint axes", count, AXES_LENGTH)
        self.ellipsoids: Any = None
        if confidence:
            look = {"opacity": _ELLIPSOID_OPACITY, "cast_shadow": False}
            self.ellipsoids = _meshes(server, f"{name}/confidence", barrel(2.0), count, _ELLIPSOID, **look)
        self.relative = True
        """Whether ellipsoids are those relative to the root."""

    def show(self, content: BlockContent, i: int) -> None:
        """Show one frame."""
        self.body.show(content, i)
        _put(self.axes, content.p_joint[i], content.joints_wxyz[i], content.axes[i])
        found = content.to_root if self.relative else content.in_world
        if self.ellipsoids is not None and found is not None:
            _put(self.ellipsoids, content.p_joint[i], found.quat_wxyz[i], found.sizes[i])

    def unknown_positions(self, content: BlockContent, i: int) -> int:
        """Return the number of joints whose ellipsoid is too large to be drawn; arguments as for `show`."""
        found = content.to_root if self.relative else content.in_world
        return 0 if found is None else int(found.left_out[i])


class Companion:
    """Another person at the same times, transparent and of one colour, who may stand beside the motion."""

    def __init__(self, server: Any, name: str, skeleton: SkeletonModel, colour: Rgb):
        self.frame = server.scene.add_frame(name, show_axes=False)
        self.body = Body(server, f"{name}/segments", skeleton, colour, _TRANSPARENT)


@dataclass(frozen=True)
class SensorBlock:
    """Sensors in the frames of a block."""

    p_world: NDArray[np.float32]  #: (n, S, 3) m; 0 where unknown
    quat_wxyz: NDArray[np.float32]  #: (n, S, 4) measured orientations
    measured: Mask  #: (n, S) whether place and orientation are known


class Sensors:
    """Sensors on their segments, with the axes that they measured. `measurements`: any frames."""

    def __init__(self, server: Any, name: str, skeleton: SkeletonModel, measurements: Measurements):
        self._joints = skeleton.index(*measurements.segments)
        self._p_bone_sensor = measurements.p_bone_sensor
        count = len(self._joints)
        box = optional("trimesh.creation", "view").box(extents=(2.0, 2.0, 2.0))
        self.boxes = _meshes(server, f"{name}/boxes", box, count, _SENSOR, flat_shading=True)
        self.axes = _axes(server, f"{name}/axes", count, _SENSOR_AXES)

    def place(self, poses: PoseSequence, measurements: Measurements) -> SensorBlock:
        """Return the sensors in the frames of a block."""
        p, R = poses.p_world_joint[:, self._joints], poses.R_world_bone[:, self._joints]
        at = p + np.einsum("nsij,sj->nsi", R, self._p_bone_sensor)
        R_sensor = measurements.R_world_sensor
        known = np.isfinite(at).all(axis=-1) & np.isfinite(R_sensor).all(axis=(-2, -1))
        turned = np.where(known[..., None, None], R_sensor, np.eye(3))
        placed = np.where(known[..., None], at, 0.0).astype(np.float32)
        return SensorBlock(placed, so3.to_quat_wxyz(turned).astype(np.float32), known)

    def show(self, block: SensorBlock, i: int) -> None:
        """Show one frame of a block of `place`."""
        p, quat, measured = block.p_world[i], block.quat_wxyz[i], block.measured[i]
        _put(self.boxes, p, quat, (_SENSOR_SIZE * measured[:, None]).astype(np.float32))
        _put(self.axes, p, quat, measured.astype(np.float32))


class RootPath:
    """Path of the root, as a line at its height."""

    def __init__(self, server: Any, name: str):
        nothing = np.zeros((1, 2, 3))
        self.handle = server.scene.add_line_segments(
            name, nothing.astype(np.float32), nothing.astype(np.uint8), thickness=2.0, thickness_units="screen"
        )

    def show(self, p_root: Array, colours: NDArray[np.uint8]) -> None:
        """Show a path; it has gaps where a position is missing.

        `p_root`: (n, 3) m; NaN where missing. colours: (n, 3) RGB of the points.
        """
        pairs = np.stack([p_root[:-1], p_root[1:]], axis=1)
        whole = np.isfinite(pairs).all(axis=(1, 2))
        if not whole.any():
            pairs, whole = np.zeros((1, 2, 3)), np.ones(1, dtype=np.bool_)
            colours = np.zeros((2, 3), dtype=np.uint8)
        ends = np.stack([colours[:-1], colours[1:]], axis=1)
        self.handle.points = pairs[whole].astype(np.float32)
        self.handle.colors = ends[whole]
