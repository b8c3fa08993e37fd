"""Rigs and people differ in how a trunk moves: variations of a motion that are constant over a window.

The bend between pelvis and upper trunk is spread differently over the spine's joints, the pelvis is pitched
differently against the rest of the body, and clavicles rest and move differently; orientations of the upper
trunk, arms and legs stay. The joints of the trunk lie at other places between hips, shoulders and head. All
joints follow by forward kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import tan
from typing import Final

import torch
from torch import Tensor

from lifting.body import Body, side_of
from lifting.draws import Draw, cross, rotation
from rtof_kin.body.neutral_posture import CLAVICLES, SPINE
from rtof_kin.body.shared_frames import LUMBAR_PITCH

TRUNK: Final = ("Hips", *SPINE)
"""Segments from the pelvis to the upper trunk."""
PLACES: Final = {
    "Hips": (0.02, 0.0, 0.045),
    "Spine": (0.0, 0.0, 0.025),
    "Spine1": (0.015, 0.0, 0.025),
    "Spine2": (0.015, 0.0, 0.025),
    "Spine3": (0.015, 0.0, 0.025),
    "Neck": (0.015, 0.0, 0.015),
    "Head": (0.02, 0.0, 0.02),
    "Shoulder": (0.015, 0.02, 0.025),
    "Arm": (0.012, 0.012, 0.015),
    "UpLeg": (0.008, 0.008, 0.008),
}
"""Standard deviation of where rigs have the joints of the trunk, m, sideways for the right side; the lumbar
joint lies in the direction that defines the pelvis."""


@dataclass(frozen=True)
class RigConfig:
    """Sizes of the differences."""

    share: float = 0.6
    """Share of windows that are varied."""
    spread: float = 0.7
    """Standard deviation of the logarithm of the share of the bend that a joint of the spine takes."""
    spine: tuple[float, float, float] = (0.03, 0.07, 0.02)
    """Standard deviation of the constant turn of each segment of the spine about x, y and z, rad."""
    pelvis: tuple[float, float, float] = (0.02, 0.1, 0.02)
    """The same of the pelvis."""
    clavicle: tuple[float, float, float] = (0.12, 0.04, 0.10)
    """The same of the clavicles, left and right mirrored."""
    mobility: tuple[float, float] = (0.3, 1.2)
    """Range of the factor on the rotation of the clavicles."""
    places: float = 1.0
    """Factor on `PLACES`."""


def trunk_segments(body: Body) -> list[int]:
    """Return the indices of `TRUNK`, the clavicles and the neck; none if the body lacks any."""
    names = (*TRUNK, *CLAVICLES, "Neck")
    return [body.names.index(name) for name in names] if set(names) <= set(body.names) else []


def places(body: Body, config: RigConfig, draw: Draw) -> Tensor:
    """Draw displacements of the joints (B, J, 3) in their parents' frames, of the root in its own, m."""
    sizes = torch.tensor([PLACES.get(side_of(name)[1], (0.0, 0.0, 0.0)) for name in body.names])
    shift = config.places * sizes.to(draw.device) * draw.normal(draw.batch, len(body.names), 3)
    left = [j for j, name in enumerate(body.names) if side_of(name)[0] == "left"]
    shift[:, left] = shift[:, [body.mirrored[j] for j in left]] * shift.new_tensor([1.0, -1.0, 1.0])
    spine = body.names.index("Spine")
    shift[:, spine, 0] = tan(LUMBAR_PITCH) * shift[:, spine, 2]
    return shift


def turns(axes: Tensor, config: RigConfig, draw: Draw) -> Tensor:
    """Draw the turns (B, W, 8, 3, 3) in world from a motion's trunk to another rig's.

    Args:
        axes: (B, 3, W, 2, 8) x and z axes of `trunk_segments`.
    """
    B = len(axes)
    x, z = axes.unbind(dim=3)
    R = torch.stack([x, cross(z, x), z], dim=-1).permute(0, 2, 3, 1, 4)  # (B, W, 8, 3, 3)

    def constant(sizes: tuple[float, float, float], n: int) -> Tensor:
        return draw.normal(B, 1, n, 3) * axes.new_tensor(sizes)

    pelvis = R[:, :, 0] @ exp(constant(config.pelvis, 1))[:, :, 0]
    bend = log(pelvis.transpose(-1, -2) @ R[:, :, 4])
    share = (config.spread * draw.normal(B, 4)).softmax(dim=1).cumsum(dim=1)[:, None, :3, None]
    spine = pelvis[:, :, None] @ exp(share * bend[:, :, None] + constant(config.spine, 3))
    upper = R[:, :, 4:5]
    side = constant(config.clavicle, 1)
    rest = torch.cat([side, side * side.new_tensor([-1.0, 1.0, -1.0])], dim=2)
    mobility = draw.between(config.mobility, B, 1, 1, 1)
    clavicles = upper @ exp(mobility * log(upper.transpose(-1, -2) @ R[:, :, 5:7]) + rest)
    varied = torch.cat([pelvis[:, :, None], spine, upper, clavicles, R[:, :, 7:]], dim=2)
    return varied @ R.transpose(-1, -2)


def exp(rotvec: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    return rotation(rotvec.reshape(-1, 3)).reshape(*rotvec.shape, 3)


def log(R: Tensor) -> Tensor:
    """Return rotation vectors (..., 3), rad, of rotations (..., 3, 3) below half a turn."""
    S = R - R.transpose(-1, -2)
    twice = torch.stack([S[..., 2, 1], S[..., 0, 2], S[..., 1, 0]], dim=-1)
    sin = (twice.norm(dim=-1) / 2).clamp_min(1e-7)
    angle = torch.atan2(sin, (R.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2)
    rotvec: Tensor = twice / 2 * (angle / sin)[..., None]
    return rotvec
