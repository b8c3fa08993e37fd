"""Random numbers and rotations for batches of windows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Draw:
    """Random tensors of one batch, all from one generator on one device."""

    batch: int
    generator: torch.Generator
    device: torch.device

    def uniform(self, *shape: int) -> Tensor:
        """Return uniform numbers in [0, 1)."""
        return torch.rand(shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        """Return standard normal numbers."""
        return torch.randn(shape, generator=self.generator, device=self.device)

    def between(self, bounds: tuple[float, float], *shape: int) -> Tensor:
        """Return uniform numbers between two bounds."""
        return bounds[0] + (bounds[1] - bounds[0]) * self.uniform(*shape)

    def integers(self, below: int) -> Tensor:
        """Return integers (batch,) from 0 to below - 1."""
        return torch.randint(below, (self.batch,), generator=self.generator, device=self.device)


def about_axis(axis: int, angle: Tensor) -> Tensor:
    """Return rotations (B, 3, 3) about a coordinate axis.

    Args:
        axis: 0, 1 or 2 for x, y or z. angle: (B,) rad.
    """
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = ([[i, o, o], [o, c, -s], [o, s, c]], [[c, o, s], [o, i, o], [-s, o, c]], [[c, -s, o], [s, c, o], [o, o, i]])[
        axis
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def rotation(rotvec: Tensor) -> Tensor:
    """Return rotations (B, 3, 3) of rotation vectors (B, 3), rad."""
    angle = rotvec.norm(dim=1).clamp_min(1e-9)[:, None, None]
    x, y, z = rotvec.unbind(dim=1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).reshape(-1, 3, 3)
    square = torch.bmm(cross, cross)
    one = torch.eye(3, device=rotvec.device)
    R: Tensor = one + (angle.sin() / angle) * cross + ((1 - angle.cos()) / angle**2) * square
    return R


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross product of (B, 3, ...); faster than torch's for planar components."""
    (a1, a2, a3), (b1, b2, b3) = a.unbind(dim=1), b.unbind(dim=1)
    return torch.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], dim=1)
