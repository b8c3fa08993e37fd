"""From rays to network input and back: the gravity-aligned, root-centred, scaled representation.

A window is W frames of rays from one camera to J landmarks. The *view* frame of a window looks along
the ray to the root in its middle frame (x right, y down, z forward, no roll); the *ray* frame has the
same azimuth but is level (x away from the camera, y left, z up). Both are upright in world, so the
network sees gravity, and neither knows the camera's intrinsics, tilt, or heading.

Per frame the network sees x/z and y/z of each landmark in the view frame, divided by `scale`, and
whether it was seen; on every frame it also sees what holds for the window: the elevation of the
root's ray, log scale, the camera's height over the floor, and bone lengths, the last two optional.
It answers with root-relative joints in the ray frame (m), the root's shift from the window's centre in
the scaled image, and log(distance x scale).

Arrays are (B, component, W, J): one plane per component, so turning and chaining bones are large
matrix products.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from lifting.model import TemporalNetwork

MIN_FORWARD = 0.1
"""Cosine to the view axis below which a ray counts as unseen."""
MIN_SCALE = 1e-4
BONE_GAIN = 15.0
"""Bones enter as their difference from the nominal ones, m, times this."""
ANKLE_HEIGHT = 0.08
"""Height of an ankle over the floor when standing, m."""
_SIDED = re.compile(r"(Left|Right|L|R)(?=[A-Z])")


@dataclass(frozen=True)
class Body:
    """The joints a lifter knows: names, tree, and the usual bone lengths."""

    names: tuple[str, ...]
    """J joint names, root first, parents before children; for sided ones see `side_of`."""
    parents: tuple[int, ...]
    """(J,) index of each joint's parent, -1 for the root."""
    nominal_bones: tuple[float, ...]
    """(3 G,) usual `bones_of` a person, m."""

    @cached_property
    def mirrored(self) -> list[int]:
        """(J,) index of each joint's counterpart on the other side, itself in the middle."""
        sided = [side_of(name) for name in self.names]
        index = {key: j for j, key in enumerate(sided)}
        other = {"": "", "left": "right", "right": "left"}
        return [index.get((other[side], rest), j) for j, (side, rest) in enumerate(sided)]

    @cached_property
    def hips(self) -> list[int]:
        """Indices of the root's sided children: their mean stands in for an unseen root."""
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
        """Indices of the joints that stand near the floor: the ankles."""
        return [leg[-1] for leg in self.legs]

    @cached_property
    def _limbs(self) -> list[list[int]]:
        """The last three joints on the way to every sided joint that nothing hangs on."""
        parents = self.parents
        ends = [j for j in range(len(parents)) if j not in parents and parents[j] > 0]
        return [[parents[parents[j]], parents[j], j] for j in ends if side_of(self.names[j])[0]]

    @property
    def inputs(self) -> int:
        """Features per frame of the network."""
        bones = 3 * len(bone_groups(self.names))
        return 3 * len(self.names) + 2 * len(self.feet) + 2 + (1 + 1) + (bones + 1)

    @property
    def outputs(self) -> int:
        """Values per estimated frame of the network."""
        return 3 * len(self.names)

    def bones_of(self, offsets: Tensor) -> Tensor:
        """What the network is told of a person: (..., 3 G) m, of joint offsets (..., J, 3).

        One offset per bone in its parent's link frame, the two sides as one (the right one mirrored
        and averaged with the left), those in the middle without their sideways part.
        """
        parts = []
        for joints in bone_groups(self.names).values():
            side = offsets.new_tensor(
                [[1.0, -1.0 if side_of(self.names[j])[0] == "right" else 1.0, 1.0] for j in joints]
            )
            middle = offsets.new_tensor([1.0, float(len(joints) > 1), 1.0])
            parts.append((offsets[..., joints, :] * side).mean(dim=-2) * middle)
        return torch.cat(parts, dim=-1)


def bone_groups(joint_names: tuple[str, ...]) -> dict[str, list[int]]:
    """Bones by the unsided name of the joint at their far end, each with the indices of its joints."""
    groups: dict[str, list[int]] = {}
    for j, name in enumerate(joint_names[1:], start=1):
        groups.setdefault(side_of(name)[1], []).append(j)
    return groups


def side_of(joint_name: str) -> tuple[str, str]:
    """A joint's side ('left', 'right', or '' in the middle) and its name without it.

    Both ``LeftArm`` and ``LElbow`` are on the left.
    """
    found = _SIDED.match(joint_name)
    if not found:
        return "", joint_name
    return ("left" if found[0].startswith("L") else "right"), joint_name[found.end() :]


@dataclass(frozen=True)
class EncodedWindows:
    """Network input, and the frame in which its answer is to be read."""

    features: Tensor
    """(B, W, inputs)."""
    R_view_world: Tensor
    """(B, 3, 3)."""
    R_ray_world: Tensor
    """(B, 3, 3)."""
    scale: Tensor
    """(B,) RMS distance of the landmarks from each frame's mean, in units of focal length."""


def encode(
    body: Body, rays_world: Tensor, seen: Tensor, bones: Tensor, camera_height: Tensor
) -> EncodedWindows:
    """Network input of windows.

    Args:
        body: the joints.
        rays_world: (B, 3, W, J) directions in world from the optical centre, of any finite length.
        seen: (B, W, J) bool; unseen rays are not read.
        bones: (B, 3 G) m, see `Body.bones_of`; NaN in a row where they are unknown.
        camera_height: (B,) height of the optical centre over the floor, m; NaN where unknown.
    """
    centre = _centre_ray(body, rays_world, seen)
    elevation = torch.atan2(centre[:, 2], centre[:, :2].norm(dim=1))
    azimuth = torch.atan2(centre[:, 1], centre[:, 0])
    R_view, R_ray = _frames(azimuth, elevation)
    view = torch.bmm(R_view, rays_world.flatten(2)).reshape(rays_world.shape)
    x, y, z = view.unbind(dim=1)
    seen = seen & (z > MIN_FORWARD)
    weight = seen.to(view.dtype)
    inverse = weight / torch.where(seen, z, 1.0)
    x, y = x * inverse, y * inverse
    scale = _scale(x, y, weight)
    image = (torch.cat([x, y], dim=2) / scale[:, None, None]).clamp(-20, 20)
    feet = _standing(rays_world[..., body.feet], seen[..., body.feet], camera_height, scale)
    fixed = [
        elevation[:, None],
        scale.log()[:, None],
        _optional((camera_height * scale).clamp_min(1e-3).log()[:, None]),
        _optional((bones - bones.new_tensor(body.nominal_bones)) * BONE_GAIN),
    ]
    frames = torch.cat(fixed, dim=1)[:, None].expand(-1, x.shape[1], -1)
    features = torch.cat([image, weight, feet, frames], dim=2)
    return EncodedWindows(features, R_view, R_ray, scale)


def decode(body: Body, output: Tensor, encoded: EncodedWindows) -> tuple[Tensor, Tensor]:
    """The network's answer in world axes.

    Args:
        body: the joints.
        output: (B, outputs) of the network.
        encoded: what it was computed from.

    Returns:
        Root-relative joints (B, 3, J) and the root's position from the optical centre (B, 3), m.
    """
    output = output.to(encoded.scale.dtype)  # bfloat16 in training
    pose_ray = output[:, :-3].reshape(len(output), 3, -1)
    pose = torch.bmm(encoded.R_ray_world.transpose(1, 2), pose_ray)
    pose = torch.nn.functional.pad(pose, (1, 0))
    shift = output[:, -3:-1] * encoded.scale[:, None]
    direction = torch.nn.functional.normalize(torch.nn.functional.pad(shift, (0, 1), value=1.0))
    distance = output[:, -1].clamp(-4, 3).exp() / encoded.scale
    root_view = direction * distance[:, None]
    return pose, torch.einsum("bji,bj->bi", encoded.R_view_world, root_view)


@torch.no_grad()
def answer(body: Body, network: TemporalNetwork, encoded: EncodedWindows, flip: bool) -> Tensor:
    """The network's output (B, outputs), averaged with that of the mirrored windows."""
    output: Tensor = network.forward_windows(encoded.features)
    if flip:
        mirrored = network.forward_windows(mirror_features(body, encoded.features))
        output = (output + mirror_output(body, mirrored)) / 2
    return output


def mirror_features(body: Body, features: Tensor) -> Tensor:
    """Features (B, W, inputs) of the mirrored scene: left and right swapped, x negated."""
    J, F = len(body.names), len(body.feet)
    sizes = [J, J, J, F, F, features.shape[-1] - 3 * J - 2 * F]
    x, y, seen, away, stands, fixed = torch.split(features, sizes, dim=-1)
    order = body.mirrored
    feet = [body.feet.index(order[j]) for j in body.feet]
    parts = [-x[..., order], y[..., order], seen[..., order], away[..., feet], stands[..., feet]]
    return torch.cat([*parts, fixed], dim=-1)


def mirror_output(body: Body, output: Tensor) -> Tensor:
    """Answer (B, outputs) of the mirrored scene, or back."""
    order = [j - 1 for j in body.mirrored[1:]]
    pose = output[:, :-3].reshape(len(output), 3, -1)[:, :, order]
    pose = pose * pose.new_tensor([1.0, -1.0, 1.0])[:, None]
    root = output[:, -3:] * output.new_tensor([-1.0, 1.0, 1.0])
    return torch.cat([pose.flatten(1), root], dim=1)


def _centre_ray(body: Body, rays: Tensor, seen: Tensor) -> Tensor:
    """Direction (B, 3) that a window is centred on.

    In the middle frame, or the nearest one with anything seen: the root, else the mean of the hips
    seen, else the mean of everything seen; straight ahead (x) where nothing is.
    """
    B, W, _ = seen.shape
    away = (torch.arange(W, device=seen.device) - W // 2).abs()
    frame = (away + W * ~seen.any(dim=2)).argmin(dim=1)
    rows = torch.arange(B, device=seen.device)
    now, ray = seen[rows, frame].to(rays.dtype), rays[rows, :, frame]
    hips = torch.zeros_like(now)
    hips[:, body.hips] = now[:, body.hips]
    weight = torch.where(hips.any(dim=1, keepdim=True), hips, now)
    root = torch.zeros_like(now)
    root[:, 0] = 1.0
    weight = torch.where(now[:, :1] > 0, root, weight)
    unit = torch.nn.functional.normalize(torch.where(now[:, None] > 0, ray, 0.0), dim=1)
    centre = torch.einsum("bcj,bj->bc", unit, weight)
    ahead = centre.new_tensor([1.0, 0.0, 0.0])
    return torch.where(centre.norm(dim=1, keepdim=True) > 1e-6, centre, ahead)


def _frames(azimuth: Tensor, elevation: Tensor) -> tuple[Tensor, Tensor]:
    """R_view_world and R_ray_world (B, 3, 3)."""
    cos_a, sin_a, cos_e, sin_e = azimuth.cos(), azimuth.sin(), elevation.cos(), elevation.sin()
    zero, one = torch.zeros_like(azimuth), torch.ones_like(azimuth)
    right = torch.stack([sin_a, -cos_a, zero], dim=1)
    forward = torch.stack([cos_e * cos_a, cos_e * sin_a, sin_e], dim=1)
    R_view = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    level = torch.stack([cos_a, sin_a, zero], dim=1)
    R_ray = torch.stack([level, -right, torch.stack([zero, zero, one], dim=1)], dim=1)
    return R_view, R_ray


def _scale(x: Tensor, y: Tensor, weight: Tensor) -> Tensor:
    """RMS distance (B,) of the points seen (B, W, J) from the mean of their frame."""
    count = weight.sum(dim=2, keepdim=True).clamp_min(1.0)
    square = weight * (
        (x - x.sum(dim=2, keepdim=True) / count) ** 2
        + (y - y.sum(dim=2, keepdim=True) / count) ** 2
    )
    mean = square.sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp_min(1.0)
    return mean.sqrt().clamp_min(MIN_SCALE)


def _standing(rays: Tensor, seen: Tensor, camera_height: Tensor, scale: Tensor) -> Tensor:
    """Log(horizontal distance x scale) of each foot if it stands on the floor, and whether known.

    (B, W, 2 F) of rays (B, 3, W, F): unknown where the height is, or the ray is near the horizon.
    """
    slope = -rays[:, 2] / rays[:, :2].norm(dim=1).clamp_min(1e-6)
    height = (camera_height - ANKLE_HEIGHT)[:, None, None]
    known = seen & (slope > 0.02) & (height > 0.05)
    away = height * scale[:, None, None] / torch.where(known, slope, 1.0)
    return torch.cat([torch.where(known, away.log(), 0.0), known.to(rays.dtype)], dim=2)


def _optional(values: Tensor) -> Tensor:
    """Values (B, n) and a flag (B, 1) that they are known; zeros where any in a row is NaN."""
    known = values.isfinite().all(dim=1, keepdim=True)
    return torch.cat([torch.where(known, values, 0.0), known.to(values.dtype)], dim=1)
