"""Gravity-aligned, root-centred, scaled network input and output of windows.

A window has W frames of rays from one camera to J landmarks, and of orientations of the segments that
carry sensors. Its estimated frame is the middle one, or the last one of a causal lifter. The *view* frame
of a window looks along the ray to the root in that frame (x right, y down, z forward, no roll); the *ray*
frame has the same azimuth but is level (x away from the camera, y left, z up). Both are upright in world
and independent of the camera's intrinsics, tilt and heading.

Features per frame: x/z and y/z of each landmark in the view frame divided by `scale`, whether it was seen, the x and z
axes in the ray frame of each sensor's segment, and whether they are known. Features per window: elevation of the
root's ray, log scale, and optionally the camera's height over the floor and bone lengths. For the output see `decode`.

Arrays are (B, component, W, J): with one plane per component, turning is one large matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import torch
from torch import Tensor
from torch.nn.functional import pad

from lifting.body import Body, bone_groups

MIN_FORWARD = 0.1  #: Cosine to the view axis below which a ray counts as unseen
MIN_SCALE = 1e-4
MAX_IMAGE = 20.0  #: Largest coordinate in the scaled image
BONE_GAIN = 15.0  #: Bones enter as their difference from the nominal ones, m, times this
ANKLE_HEIGHT = 0.08  #: Height of an ankle over the floor when standing, m
MIN_SLOPE, MIN_HEIGHT = 0.02, 0.05
"""Least slope of a ray to a standing foot, and least height of the camera over it, m."""
MIN_HEIGHT_IN_IMAGE = 1e-3  #: Least height of the camera times scale
LOG_DISTANCE = (-4.0, 3.0)  #: Smallest and largest logarithm of the distance times scale
LOG_SPREAD = (-7.0, 2.0)  #: Smallest and largest logarithm of a spread
SIGMA_ALONG, SIGMA_ACROSS, SIGMA_TURN = sqrt(2), sqrt(3), sqrt(4)
"""Standard deviation per axis of errors in 1, 2 and 3 dimensions with spread 1. An error e in n dimensions
with spread b has a density proportional to ``b^-n exp(-|e| / b)``, for n = 1 Laplace's."""


@dataclass(frozen=True)
class Windows:
    """Observations in B windows of W frames."""

    rays_world: Tensor  #: (B, 3, W, J) directions in world from the optical centre, of any finite length
    seen: Tensor  #: (B, W, J) bool; unseen rays are not read, but are finite
    bones: Tensor  #: (B, 3 G) m, see `Body.bones_of`; NaN in a row where they are unknown
    camera_height: Tensor  #: (B,) height of the optical centre over the floor, m; NaN where unknown
    axes_world: Tensor  #: (B, 3, W, 2, S) x and z axes in world of the segments that may carry sensors
    sensed: Tensor  #: (B, W, S) bool; axes that are not sensed are not read, but are finite
    estimated: int  #: Index of the frame that is estimated


@dataclass(frozen=True)
class EncodedWindows:
    """Network input, and the frames of its output."""

    features: Tensor  #: (B, W, inputs)
    constants: Tensor  #: (B, constants)
    R_view_world: Tensor  #: (B, 3, 3)
    R_ray_world: Tensor  #: (B, 3, 3)
    scale: Tensor  #: (B,) RMS distance of the landmarks from each frame's mean, in units of focal length


@dataclass(frozen=True)
class Estimate:
    """Estimates of the estimated frames of B windows, in world axes."""

    pose: Tensor  #: (B, 3, J) root-relative joints, m
    root: Tensor  #: (B, 3) root from the optical centre, m
    log_spread: Tensor
    """(B, 2, J) logarithm of the spread of the error across the ray and along it, m, of root-relative
    joints and, in the root's column, of the root relative to its distance. NaN where unknown."""
    axes: Tensor | None  #: (B, 3, 2, J) x and z axes of every segment, orthonormal; None for a body without sensors
    log_turn: Tensor | None  #: (B, J) logarithm of the spread of their error, rad

    def sigma_m(self) -> Tensor:
        """Return (B, J, 2) standard deviations per axis across and along the ray, m."""
        sigma = self.log_spread.exp().transpose(1, 2)
        sigma = sigma * sigma.new_tensor([SIGMA_ACROSS, SIGMA_ALONG])
        return torch.cat([sigma[:, :1] * _length(self.root)[..., None], sigma[:, 1:]], dim=1)


def sizes(body: Body) -> tuple[int, int, int]:
    """Return the numbers of inputs, constants and outputs of the network."""
    J, S = len(body.names), len(body.sensors)
    constants = 2 + (1 + 1) + (3 * len(bone_groups(body.names)) + 1)
    return 3 * J + 2 * len(body.feet) + 7 * S, constants, 5 * J + (7 * J if S else 0)


def encode(body: Body, windows: Windows) -> EncodedWindows:
    """Return the network input of windows."""
    rays = windows.rays_world
    centre = _centre_ray(body, rays, windows.seen, windows.estimated)
    R_view, R_ray, elevation = _frames(centre)
    view = torch.bmm(R_view, rays.flatten(2)).reshape(rays.shape)
    forward = view[:, 2]
    weight = (windows.seen & (forward > MIN_FORWARD)).to(view.dtype)
    image = view[:, :2] * (weight / forward.clamp_min(MIN_FORWARD))[:, None]
    scale = _scale(image, weight)
    image = (image / scale[:, None, None, None]).clamp(-MAX_IMAGE, MAX_IMAGE)
    height = windows.camera_height
    feet = _standing(
        torch.stack([rays[..., j] for j in body.feet], dim=3),
        torch.stack([windows.seen[..., j] for j in body.feet], dim=2),
        height,
        scale,
    )
    constants = [
        elevation,
        scale.log()[:, None],
        _optional((height * scale).clamp_min(MIN_HEIGHT_IN_IMAGE).log()[:, None]),
        _optional((windows.bones - windows.bones.new_tensor(body.nominal_bones)) * BONE_GAIN),
    ]
    parts = [image[:, 0], image[:, 1], weight, feet]
    if body.sensors:
        parts += _sensed_axes(windows, R_ray)
    return EncodedWindows(torch.cat(parts, dim=2), torch.cat(constants, dim=1), R_view, R_ray, scale)


def decode(body: Body, output: Tensor, encoded: EncodedWindows) -> Estimate:
    """Return the estimate in world axes.

    Args:
        output: (B, outputs): root-relative joints but the root (3, J-1) in the ray frame, m; the root's shift from
            the window's centre in the scaled image (2); log(distance x scale) (1); logarithms of spreads (2, J); for
            a body with sensors, x and z axes of all segments (2, 3, J) in the ray frame, not yet orthonormal, and the
            logarithm of their spread (J).
    """
    output = output.to(encoded.scale.dtype)  # bfloat16 in training
    B, J = output.shape[0], len(body.names)
    pose_ray, root, spread, *turns = _parts(body, output)
    R_world_ray = encoded.R_ray_world.transpose(1, 2)
    pose = pad(torch.bmm(R_world_ray, pose_ray.reshape(B, 3, J - 1)), (1, 0))
    direction = _unit(pad(root[:, :2] * encoded.scale[:, None], (0, 1), value=1.0))
    distance = root[:, 2].clamp(*LOG_DISTANCE).exp() / encoded.scale
    root_view = direction * distance[:, None]
    root_world = torch.bmm(encoded.R_view_world.transpose(1, 2), root_view[..., None])[..., 0]
    log_spread = spread.reshape(B, 2, J).clamp(*LOG_SPREAD)
    if not turns:
        return Estimate(pose, root_world, log_spread, None, None)
    axes = orthonormal(turns[0].reshape(B, 2, 3, J).transpose(1, 2))
    axes = torch.bmm(R_world_ray, axes.flatten(2)).reshape(B, 3, 2, J)
    return Estimate(pose, root_world, log_spread, axes, turns[1].clamp(*LOG_SPREAD))


def orthonormal(axes: Tensor) -> Tensor:
    """Return orthonormal x and z axes (B, 3, 2, J) with the given direction of z."""
    x, z = axes.unbind(dim=2)
    z = _unit(z)
    x = _unit(x - (x * z).sum(dim=1, keepdim=True) * z)
    return torch.stack([x, z], dim=2)


def rotations(axes: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3, n) with x and z axes (..., 3, 2, n)."""
    x, z = axes.unbind(dim=-2)
    return torch.stack([x, torch.linalg.cross(z, x, dim=-2), z], dim=-2)


def mirror_features(body: Body, features: Tensor) -> Tensor:
    """Mirror features (B, W, inputs): swap left and right, negate x."""
    J, F, S = len(body.names), len(body.feet), len(body.sensors)
    x, y, seen, away, stands, axes, sensed = torch.split(features, [J, J, J, F, F, 6 * S, S], dim=-1)
    order, other = body.mirrored, body.mirrored_sensors
    feet = [body.feet.index(order[j]) for j in body.feet]
    axes = axes.reshape(*axes.shape[:-1], 3, 2, S)[..., other] * _across(axes)
    parts = [-x[..., order], y[..., order], seen[..., order], away[..., feet], stands[..., feet]]
    return torch.cat([*parts, axes.flatten(-3), sensed[..., other]], dim=-1)


def mirror_output(body: Body, output: Tensor) -> Tensor:
    """Mirror an output (B, outputs): swap left and right, negate the lateral component."""
    J, order = len(body.names), body.mirrored
    pose, root, spread, *turns = _parts(body, output)
    pose = pose.reshape(-1, 3, J - 1)[..., [j - 1 for j in order[1:]]] * _across(pose)[..., 0]
    parts = [pose.flatten(1), root * root.new_tensor([-1.0, 1.0, 1.0]), spread.reshape(-1, 2, J)[..., order].flatten(1)]
    if turns:
        axes = turns[0].reshape(-1, 2, 3, J)[..., order] * _across(pose)[..., 0]
        parts += [axes.flatten(1), turns[1][:, order]]
    return torch.cat(parts, dim=1)


def _parts(body: Body, output: Tensor) -> tuple[Tensor, ...]:
    """Split an output (B, outputs) in the order of `decode`."""
    J = len(body.names)
    sizes = [3 * (J - 1), 3, 2 * J] + ([6 * J, J] if body.sensors else [])
    return torch.split(output, sizes, dim=1)


def _length(v: Tensor) -> Tensor:
    """Lengths (B, 1, ...) of vectors (B, 2 or 3, ...), at least 1e-12; faster than `Tensor.norm` here."""
    return (v * v).sum(dim=1, keepdim=True).clamp_min(1e-24).sqrt()


def _unit(v: Tensor) -> Tensor:
    """Vectors (B, 2 or 3, ...) of length 1; zero stays zero."""
    return v / _length(v)


def _across(like: Tensor) -> Tensor:
    """(3, 1, 1) signs of a mirrored vector's components: y, to the left, is negated."""
    return like.new_tensor([1.0, -1.0, 1.0])[:, None, None]


def _sensed_axes(windows: Windows, R_ray_world: Tensor) -> list[Tensor]:
    """Three components (B, W, 2 S) of axes in the ray frame, zero if not sensed, and the mask (B, W, S)."""
    axes, weight = windows.axes_world, windows.sensed.to(R_ray_world.dtype)
    turned = torch.bmm(R_ray_world, axes.flatten(2)).reshape(*axes.shape[:3], -1)
    turned = turned * torch.cat([weight, weight], dim=2)[:, None]  # many times faster than `where`
    return [*turned.unbind(dim=1), weight]


def _centre_ray(body: Body, rays: Tensor, seen: Tensor, estimated: int) -> Tensor:
    """Direction (B, 3) to the centre of a window, in the nearest frame to the estimated one with anything seen:
    the root, else the mean of the hips, else the mean of all landmarks seen; x if nothing is seen.
    """
    B, W, J = seen.shape
    away = (torch.arange(W, device=seen.device) - estimated).abs()
    frame = (away + W * ~seen.any(dim=2)).argmin(dim=1)
    rows = torch.arange(B, device=seen.device)
    now, ray = seen[rows, frame], rays[rows, :, frame]
    first = [3 if j == 0 else 2 if j in body.hips else 1 for j in range(J)]
    rank = now * torch.tensor(first, device=seen.device)
    chosen = now & (rank == rank.amax(dim=1, keepdim=True))
    ahead = rays.new_tensor([1e-12, 0.0, 0.0])  # negligible where anything is seen
    return _unit(torch.where(chosen[:, None], ray, 0.0)).sum(dim=2) + ahead


def _frames(centre: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R_view_world and R_ray_world (B, 3, 3) of windows centred on (B, 3), and the elevation (B, 1), rad."""
    across, up = _length(centre[:, :2]), centre[:, 2:]
    elevation = torch.atan2(up, across)
    level = pad(centre[:, :2] / across, (0, 1))
    x, y, zero = level.unbind(dim=1)
    left = torch.stack([-y, x, zero], dim=1)
    vertical = centre.new_tensor([0.0, 0.0, 1.0])
    cos_e, sin_e = elevation.cos(), elevation.sin()
    view = [-left, sin_e * level - cos_e * vertical, cos_e * level + sin_e * vertical]
    ray = [level, left, vertical.expand_as(level)]
    return torch.stack(view, dim=1), torch.stack(ray, dim=1), elevation


def _scale(image: Tensor, weight: Tensor) -> Tensor:
    """RMS distance (B,) of the points seen (B, 2, W, J) from the mean of their frame."""
    count = weight.sum(dim=2)
    mean = image.sum(dim=3) / count.clamp_min(1.0)[:, None]
    away = (image - mean[..., None]) * weight[:, None]
    square = (away * away).sum(dim=(1, 2, 3)) / count.sum(dim=1).clamp_min(1.0)
    return square.sqrt().clamp_min(MIN_SCALE)


def _standing(rays: Tensor, seen: Tensor, camera_height: Tensor, scale: Tensor) -> Tensor:
    """Log(horizontal distance x scale) of each foot if it is on the floor, and whether known, (B, W, 2 F);
    unknown if the height is, or if the ray (B, 3, W, F) is near the horizon.
    """
    slope = -rays[:, 2] / _length(rays[:, :2])[:, 0].clamp_min(1e-6)
    height = (camera_height - ANKLE_HEIGHT)[:, None, None]
    known = seen & (slope > MIN_SLOPE) & (height > MIN_HEIGHT)
    away = height * scale[:, None, None] / slope.clamp_min(MIN_SLOPE)
    return torch.cat([torch.where(known, away.log(), 0.0), known.to(rays.dtype)], dim=2)


def _optional(values: Tensor) -> Tensor:
    """Values (B, n) and whether they are known (B, 1); zeros where any in a row is NaN."""
    known = values.isfinite().all(dim=1, keepdim=True)
    return torch.cat([torch.where(known, values, 0.0), known.to(values.dtype)], dim=1)
