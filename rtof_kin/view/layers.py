"""Layers of the scene: what one motion consists of, each drawn by one batched mesh of viser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.keypoints import Measurements
from rtof_kin.data.poses import PoseSequence
from rtof_kin.view.block_content import (
    AXES_LENGTH,
    BlockContent,
    Ellipsoids,
    SegmentSolids,
    barrel,
    box,
    segment_solids,
    sphere,
)
from rtof_kin.view.legend import Rgb

_AXES_RADIUS: Final = 0.0035
_UNKNOWN: Final = (150, 150, 150)
_FADING: Final = 1.7
"""Exponent by which the browser's tone mapping makes colours paler."""
_ELLIPSOID: Final = (120, 94, 240)
_ELLIPSOID_OPACITY: Final = 0.25
_SENSOR: Final = (40, 40, 48)
_SENSOR_SIZE: Final = np.array([0.024, 0.017, 0.007])
"""[m] Half edges of a drawn sensor."""
_SENSOR_AXES: Final = 0.09
"""[m]"""


def solid_colours(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return colours (..., 3) that look on a lit solid as the given ones do in the legend.

    Args:
        colours: (..., 3) RGB.
    """
    return np.round(255 * (colours / 255) ** _FADING).astype(np.uint8)


def _upright(count: int) -> NDArray[np.float32]:
    """Return identity quaternions (count, 4)."""
    return np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (count, 1))


def _put(handle: Any, positions: Array, quat_wxyz: Array, scales: Array) -> None:
    """Move the n copies of a batched node: positions (n, 3) m, orientations (n, 4), scales (n,) or (n, 3)."""
    handle.batched_positions = positions
    handle.batched_wxyzs = quat_wxyz
    handle.batched_scales = scales


class BodyLayer:
    """Solids of the segments of one person."""

    def __init__(self, server: Any, name: str, solids: SegmentSolids, colour: Rgb | None = None, opacity: float = 1.0):
        """Add the solids to the scene, not yet shown.

        Args:
            colour: of all segments; None: that of their provenance.
        """
        count = len(solids.sizes)
        mesh = barrel()
        self._sizes, self._colour = np.asarray(solids.sizes, dtype=np.float32), colour
        self.handle = server.scene.add_batched_meshes_simple(
            name,
            mesh.vertices.astype(np.float32),
            mesh.faces,
            _upright(count),
            np.zeros((count, 3)),
            batched_scales=np.zeros((count, 3)),
            batched_colors=solid_colours(np.tile(np.array(colour or _UNKNOWN, dtype=np.uint8), (count, 1))),
            opacity=None if opacity == 1 else opacity,
            lod="off",
            cast_shadow=opacity == 1,
            receive_shadow=False,
        )

    def show(self, content: BlockContent, i: int) -> None:
        """Show one frame."""
        sizes = self._sizes * content.shown[i][:, None]
        _put(self.handle, content.centers[i], content.solids_wxyz[i], sizes)
        if self._colour is None:
            self.handle.batched_colors = solid_colours(content.colours[i])
        opacities = content.opacities[i]
        self.handle.batched_opacities = None if np.all(opacities == 1) else opacities


class JointAxesLayer:
    """Axes of the segments' frames, at the joints."""

    def __init__(self, server: Any, name: str, count: int):
        """Add the axes to the scene."""
        self.handle = server.scene.add_batched_axes(
            name,
            _upright(count),
            np.zeros((count, 3)),
            np.zeros(count),
            axes_length=AXES_LENGTH,
            axes_radius=_AXES_RADIUS,
        )

    def show(self, content: BlockContent, i: int) -> None:
        """Show one frame."""
        _put(self.handle, content.p_joint[i], content.joints_wxyz[i], content.axes[i])


class EllipsoidLayer:
    """95 % ellipsoids of the joint positions."""

    def __init__(self, server: Any, name: str, count: int):
        """Add the ellipsoids to the scene."""
        mesh = sphere()
        self.handle = server.scene.add_batched_meshes_simple(
            name,
            mesh.vertices.astype(np.float32),
            mesh.faces,
            _upright(count),
            np.zeros((count, 3)),
            batched_scales=np.zeros((count, 3)),
            batched_colors=_ELLIPSOID,
            opacity=_ELLIPSOID_OPACITY,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def show(self, content: BlockContent, i: int, found: Ellipsoids) -> None:
        """Show one frame."""
        _put(self.handle, content.p_joint[i], found.quat_wxyz[i], found.sizes[i])


class SensorLayer:
    """Sensors on their segments, with the axes that they measured."""

    def __init__(self, server: Any, name: str, count: int):
        """Add the sensors to the scene."""
        mesh = box()
        self.boxes = server.scene.add_batched_meshes_simple(
            f"{name}/boxes",
            mesh.vertices.astype(np.float32),
            mesh.faces,
            _upright(count),
            np.zeros((count, 3)),
            batched_scales=np.zeros((count, 3)),
            batched_colors=_SENSOR,
            lod="off",
            flat_shading=True,
            receive_shadow=False,
        )
        self.axes = server.scene.add_batched_axes(
            f"{name}/axes",
            _upright(count),
            np.zeros((count, 3)),
            np.zeros(count),
            axes_length=_SENSOR_AXES,
            axes_radius=_AXES_RADIUS,
        )

    def show(self, p_world: Array, quat_wxyz: Array, measured: NDArray[np.bool_]) -> None:
        """Show one frame.

        Args:
            p_world: (S, 3) m, 0 where there is no pose. quat_wxyz: (S, 4) measured orientations.
            measured: (S,) whether there is a place and a measurement.
        """
        _put(self.boxes, p_world, quat_wxyz, (_SENSOR_SIZE * measured[:, None]).astype(np.float32))
        _put(self.axes, p_world, quat_wxyz, measured.astype(np.float32))


class PathLayer:
    """Path of the root, as a line at its height."""

    def __init__(self, server: Any, name: str):
        """Add the path to the scene, empty."""
        self.handle = server.scene.add_line_segments(
            name,
            np.zeros((1, 2, 3), dtype=np.float32),
            np.zeros((1, 2, 3), dtype=np.uint8),
            thickness=2.0,
            thickness_units="screen",
        )

    def show(self, p_root: Array, colours: NDArray[np.uint8]) -> None:
        """Show a path; it has gaps where a position is missing.

        Args:
            p_root: (n, 3) m; NaN where missing. colours: (n, 3) RGB of the points.
        """
        pairs = np.stack([p_root[:-1], p_root[1:]], axis=1)
        whole = np.isfinite(pairs).all(axis=(1, 2))
        if not whole.any():
            pairs, whole = np.zeros((1, 2, 3)), np.ones(1, dtype=np.bool_)
            colours = np.zeros((2, 3), dtype=np.uint8)
        ends = np.stack([colours[:-1], colours[1:]], axis=1)
        self.handle.points = pairs[whole].astype(np.float32)
        self.handle.colors = ends[whole]


_TRANSPARENT: Final = 0.45
"""Opacity of a person beside the motion."""


class Person:
    """The motion: segments by provenance, axes of its joints, ellipsoids of its positions."""

    def __init__(self, server: Any, name: str, skeleton: SkeletonModel, confidence: bool):
        """Add the person to the scene."""
        self.skeleton, self.solids = skeleton, segment_solids(skeleton)
        count = len(skeleton.names)
        self.body = BodyLayer(server, f"{name}/segments", self.solids)
        self.axes = JointAxesLayer(server, f"{name}/joint axes", count)
        self.ellipsoids = EllipsoidLayer(server, f"{name}/confidence", count) if confidence else None
        self.relative = True
        """Whether ellipsoids are those relative to the root."""

    def show(self, content: BlockContent, i: int) -> None:
        """Show one frame."""
        self.body.show(content, i)
        self.axes.show(content, i)
        found = content.to_root if self.relative else content.in_world
        if self.ellipsoids is not None and found is not None:
            self.ellipsoids.show(content, i, found)

    def unknown_positions(self, content: BlockContent, i: int) -> int:
        """Return the number of joints whose ellipsoid is too large to be drawn; arguments as for `show`."""
        found = content.to_root if self.relative else content.in_world
        return 0 if found is None else int(found.left_out[i])


class Companion:
    """Another person at the same times, transparent and of one colour."""

    def __init__(self, server: Any, name: str, skeleton: SkeletonModel, colour: Rgb):
        """Add the person to the scene."""
        self.skeleton, self.solids = skeleton, segment_solids(skeleton)
        self.frame = server.scene.add_frame(name, show_axes=False)
        self.body = BodyLayer(server, f"{name}/segments", self.solids, colour, _TRANSPARENT)

    def stand(self, offset: Array) -> None:
        """Put the person beside the motion.

        Args:
            offset: (3,) m.
        """
        self.frame.position = offset


class Sensors:
    """Sensors at their place on the motion, with their measured axes."""

    def __init__(self, server: Any, name: str, skeleton: SkeletonModel, measurements: Measurements):
        """Add the sensors to the scene.

        Args:
            measurements: any frames.
        """
        self._joints = skeleton.index(*measurements.segments)
        self._p_bone_sensor = measurements.p_bone_sensor
        self.layer = SensorLayer(server, name, len(self._joints))

    def place(self, poses: PoseSequence, measurements: Measurements) -> SensorBlock:
        """Return the sensors in the frames of a block."""
        p = poses.p_world_joint[:, self._joints]
        R = poses.R_world_bone[:, self._joints]
        at = p + np.einsum("nsij,sj->nsi", R, self._p_bone_sensor)
        R_sensor = measurements.R_world_sensor
        known = np.isfinite(at).all(axis=-1) & np.isfinite(R_sensor).all(axis=(-2, -1))
        turned = np.where(known[..., None, None], R_sensor, np.eye(3))
        placed = np.where(known[..., None], at, 0.0).astype(np.float32)
        return SensorBlock(placed, so3.to_quat_wxyz(turned).astype(np.float32), known)

    def show(self, block: SensorBlock, i: int) -> None:
        """Show one frame.

        Args:
            block: of `place`.
        """
        self.layer.show(block.p_world[i], block.quat_wxyz[i], block.measured[i])


@dataclass(frozen=True)
class SensorBlock:
    """Sensors in the frames of a block."""

    p_world: NDArray[np.float32]
    """(n, S, 3) m; 0 where unknown."""
    quat_wxyz: NDArray[np.float32]
    """(n, S, 4) measured orientations."""
    measured: Mask
    """(n, S) whether place and orientation are known."""
