"""People in the scene: the motion, and beside it the truth or a second motion."""

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
from rtof_kin.view.provenance_colours import Rgb
from rtof_kin.view.scene.block_content import BlockContent
from rtof_kin.view.scene.layers import BodyLayer, EllipsoidLayer, JointAxesLayer, SensorLayer
from rtof_kin.view.scene.solids import segment_solids

TRUTH: Final = (70, 70, 78)
"""RGB of the truth."""
SECOND: Final = (170, 60, 190)
"""RGB of a second motion."""
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
