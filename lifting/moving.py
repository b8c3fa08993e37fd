"""Moving bodies of training windows, before a camera is placed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lifting.body import Body
from lifting.draws import cross
from rtof_kin.body import kinematics


@dataclass
class Moving:
    """B moving bodies."""

    bones: Tensor
    """(B, 3, W, J-1) bone vectors in world, m."""
    root: Tensor
    """(B, 3, W) path of the root from the estimated frame, m."""
    offsets: Tensor
    """(B, J, 3) joint offsets, m."""
    axes: Tensor
    """(B, 3, 2, J) x and z axes of all segments in the estimated frame."""
    carried: Tensor
    """(B, 3, W, 2, S) those of the segments that may carry sensors, at the sensors' times."""

    def turned(self, R: Tensor) -> Moving:
        """Return the bodies turned by rotations (B, 3, 3)."""

        def turn(x: Tensor) -> Tensor:
            return torch.bmm(R, x.flatten(2)).reshape(x.shape)

        bones, root, axes, carried = map(turn, (self.bones, self.root, self.axes, self.carried))
        return Moving(bones, root, self.offsets, axes, carried)

    def put_on(self, count: int, upper: Moving, joints: Tensor, segments: Tensor, sensors: Tensor) -> None:
        """Replace the upper bodies of the first rows; masks (J,), (J,), (S,) select what is upper."""

        def exchange(mine: Tensor, other: Tensor, mask: Tensor) -> None:
            mine[:count] = torch.where(mask, other, mine[:count])

        exchange(self.bones, upper.bones, joints[1:])
        exchange(self.offsets, upper.offsets, joints[:, None])
        exchange(self.axes, upper.axes, segments)
        exchange(self.carried, upper.carried, sensors)

    def displace(
        self, body: Body, rows: Tensor, axes: Tensor, segments: list[int], shift: Tensor, estimated: int
    ) -> None:
        """Displace joints that segments start and end with in some rows (B',).

        Args:
            axes: (B', 3, W, 2, n) x and z axes of the segments. segments: (n,) their indices, root first.
            shift: (B', J, 3) in the parents' frames, of the root in its own, m.
        """
        x, z = axes.unbind(dim=3)
        columns = torch.stack([x, cross(z, x), z])  # (3, B', 3, W, n)
        for i, j in enumerate(segments):
            for child in kinematics.children_of(body.parents, j):
                change = shift[:, child] - shift[:, j]
                self.offsets[rows, child] += change
                self.bones[rows, ..., child - 1] += _turned(columns[..., i], change[..., None])
        path = _turned(columns[..., 0], shift[:, 0, :, None])
        self.root[rows] += path - path[..., estimated : estimated + 1]

    def vary(self, body: Body, rows: Tensor, R: Tensor, segments: list[int], estimated: int) -> None:
        """Turn segments by rotations R (B', W, n, 3, 3) in world in some rows (B',), with their bones."""
        for i, j in enumerate(segments):
            columns = R[:, :, i].permute(3, 0, 2, 1)  # (3, B', 3, W)
            for child in kinematics.children_of(body.parents, j):
                self.bones[rows, ..., child - 1] = _turned(columns, self.bones[rows, ..., child - 1])
            self.axes[rows, ..., j] = R[:, estimated, i] @ self.axes[rows, ..., j]
            if j in body.sensor_joints:
                s = body.sensor_joints.index(j)
                for axis in range(2):
                    self.carried[rows, :, :, axis, s] = _turned(columns, self.carried[rows, :, :, axis, s])


def _turned(columns: Tensor, v: Tensor) -> Tensor:
    """Vectors (B, 3, W or 1) turned by rotations with columns (3, B, 3, W), as (B, 3, W)."""
    x, y, z = columns
    turned: Tensor = x * v[:, :1] + y * v[:, 1:2] + z * v[:, 2:]
    return turned
