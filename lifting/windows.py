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
from itertools import accumulate
from math import sqrt

from lifting.arrays import Tensor, like, namespace
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
        xp, root = namespace(self.root), self.root
        sigma = xp.exp(self.log_spread).swapaxes(1, 2) * like(root, [SIGMA_ACROSS, SIGMA_ALONG])
        return xp.concat([sigma[:, :1] * _length(root)[..., None], sigma[:, 1:]], axis=1)


def sizes(body: Body) -> tuple[int, int, int]:
    """Return the numbers of inputs, constants and outputs of the network."""
    J, S = len(body.names), len(body.sensors)
    constants = 2 + (1 + 1) + (3 * len(bone_groups(body.names)) + 1)
    return 3 * J + 2 * len(body.feet) + 7 * S, constants, 5 * J + (7 * J if S else 0)


def encode(body: Body, windows: Windows) -> EncodedWindows:
    """Return the network input of windows."""
    rays, seen, height = windows.rays_world, windows.seen, windows.camera_height
    xp = namespace(rays)
    R_view, R_ray, elevation = _frames(_centre_ray(body, rays, seen, windows.estimated))
    view = _turned(R_view, rays)
    forward = view[:, 2]
    weight = like(rays, seen & (forward > MIN_FORWARD))
    image = view[:, :2] * (weight / forward.clip(MIN_FORWARD))[:, None]
    scale = _scale(image, weight)
    image = (image / scale[:, None, None, None]).clip(-MAX_IMAGE, MAX_IMAGE)
    constants = [
        elevation,
        xp.log(scale)[:, None],
        _optional(xp.log((height * scale).clip(MIN_HEIGHT_IN_IMAGE))[:, None]),
        _optional((windows.bones - like(rays, body.nominal_bones)) * BONE_GAIN),
    ]
    feet = _standing(rays[..., body.feet], seen[..., body.feet], height, scale)
    parts = [image[:, 0], image[:, 1], weight, feet]
    if body.sensors:
        parts += _sensed_axes(windows, R_ray)
    return EncodedWindows(xp.concat(parts, axis=2), xp.concat(constants, axis=1), R_view, R_ray, scale)


def decode(body: Body, output: Tensor, encoded: EncodedWindows) -> Estimate:
    """Return the estimate in world axes.

    Args:
        output: (B, outputs): root-relative joints but the root (3, J-1) in the ray frame, m; the root's shift from
            the window's centre in the scaled image (2); log(distance x scale) (1); logarithms of spreads (2, J); for
            a body with sensors, x and z axes of all segments (2, 3, J) in the ray frame, not yet orthonormal, and the
            logarithm of their spread (J).
    """
    xp, J = namespace(output), len(body.names)
    pose_ray, root, spread, *turns = _parts(body, output)
    R_world_ray = encoded.R_ray_world.swapaxes(1, 2)
    pose = R_world_ray @ pose_ray.reshape(-1, 3, J - 1)
    pose = xp.concat([xp.zeros_like(pose[..., :1]), pose], axis=2)
    direction = _unit(xp.concat([root[:, :2] * encoded.scale[:, None], xp.ones_like(root[:, :1])], axis=1))
    distance = xp.exp(root[:, 2].clip(*LOG_DISTANCE)) / encoded.scale
    root_view = direction * distance[:, None]
    root_world = (encoded.R_view_world.swapaxes(1, 2) @ root_view[..., None])[..., 0]
    log_spread = spread.reshape(-1, 2, J).clip(*LOG_SPREAD)
    if not turns:
        return Estimate(pose, root_world, log_spread, None, None)
    axes = orthonormal(turns[0].reshape(-1, 2, 3, J).swapaxes(1, 2))
    return Estimate(pose, root_world, log_spread, _turned(R_world_ray, axes), turns[1].clip(*LOG_SPREAD))


def orthonormal(axes: Tensor) -> Tensor:
    """Return orthonormal x and z axes (B, 3, 2, J) with the given direction of z."""
    x, z = axes[:, :, 0], _unit(axes[:, :, 1])
    x = _unit(x - (x * z).sum(axis=1, keepdims=True) * z)
    return namespace(axes).stack([x, z], axis=2)


def rotations(axes: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3, n) with x and z axes (..., 3, 2, n)."""
    xp, x, z = namespace(axes), axes[..., 0, :], axes[..., 1, :]
    return xp.stack([x, xp.linalg.cross(z, x, axis=-2), z], axis=-2)


def mirror_features(body: Body, features: Tensor) -> Tensor:
    """Mirror features (B, W, inputs): swap left and right, negate x."""
    J, F, S = len(body.names), len(body.feet), len(body.sensors)
    x, y, seen, away, stands, axes, sensed = _split(features, [J, J, J, F, F, 6 * S, S])
    order, other = body.mirrored, body.mirrored_sensors
    feet = [body.feet.index(order[j]) for j in body.feet]
    turned = axes.reshape(*axes.shape[:-1], 3, 2, S)[..., other] * _across(axes)
    parts = [-x[..., order], y[..., order], seen[..., order], away[..., feet], stands[..., feet]]
    return namespace(x).concat([*parts, turned.reshape(axes.shape), sensed[..., other]], axis=-1)


def mirror_output(body: Body, output: Tensor) -> Tensor:
    """Mirror an output (B, outputs): swap left and right, negate the lateral component."""
    J, order = len(body.names), body.mirrored
    pose, root, spread, *turns = _parts(body, output)
    across = _across(pose)[..., 0]
    parts = [
        (pose.reshape(-1, 3, J - 1)[..., [j - 1 for j in order[1:]]] * across).reshape(pose.shape),
        root * like(root, [-1.0, 1.0, 1.0]),
        spread.reshape(-1, 2, J)[..., order].reshape(spread.shape),
    ]
    if turns:
        axes = turns[0].reshape(-1, 2, 3, J)[..., order] * across
        parts += [axes.reshape(turns[0].shape), turns[1][:, order]]
    return namespace(output).concat(parts, axis=1)


def _parts(body: Body, output: Tensor) -> list[Tensor]:
    """Split an output (B, outputs) in the order of `decode`."""
    J = len(body.names)
    return _split(output, [3 * (J - 1), 3, 2 * J] + ([6 * J, J] if body.sensors else []))


def _split(x: Tensor, sizes: list[int]) -> list[Tensor]:
    """Parts of these sizes of the last axis."""
    stops = list(accumulate(sizes))
    return [x[..., stop - size : stop] for size, stop in zip(sizes, stops, strict=True)]


def _turned(R: Tensor, v: Tensor) -> Tensor:
    """Vectors (B, 3, ...) turned by rotations (B, 3, 3)."""
    return (R @ v.reshape(*v.shape[:2], -1)).reshape(v.shape)


def _length(v: Tensor) -> Tensor:
    """Lengths (B, 1, ...) of vectors (B, 2 or 3, ...), at least 1e-12; faster than `Tensor.norm` here."""
    return namespace(v).sqrt((v * v).sum(axis=1, keepdims=True).clip(1e-24))


def _unit(v: Tensor) -> Tensor:
    """Vectors (B, 2 or 3, ...) of length 1; zero stays zero."""
    return v / _length(v)


def _across(x: Tensor) -> Tensor:
    """(3, 1, 1) signs of a mirrored vector's components: y, to the left, is negated."""
    return like(x, [1.0, -1.0, 1.0])[:, None, None]


def _sensed_axes(windows: Windows, R_ray_world: Tensor) -> list[Tensor]:
    """Three components (B, W, 2 S) of axes in the ray frame, zero if not sensed, and the mask (B, W, S)."""
    weight = like(R_ray_world, windows.sensed)
    turned = _turned(R_ray_world, windows.axes_world) * weight[:, None, :, None]  # many times faster than `where`
    parts = turned.reshape(*turned.shape[:3], -1)
    return [parts[:, 0], parts[:, 1], parts[:, 2], weight]


def _centre_ray(body: Body, rays: Tensor, seen: Tensor, estimated: int) -> Tensor:
    """Direction (B, 3) to the centre of a window, in the nearest frame to the estimated one with anything seen:
    the root, else the mean of the hips, else the mean of all landmarks seen; x if nothing is seen.
    """
    xp, (B, W, J) = namespace(rays), seen.shape
    away = abs(xp.arange(W, device=seen.device) - estimated)
    frame = (away + W * ~seen.any(axis=2)).argmin(axis=1)
    rows = xp.arange(B, device=seen.device)
    now, ray = seen[rows, frame], rays[rows, :, frame]
    rank = like(rays, now) * like(rays, [3.0 if j == 0 else 2.0 if j in body.hips else 1.0 for j in range(J)])
    chosen = now & (rank == xp.amax(rank, axis=1, keepdims=True))
    ahead = like(rays, [1e-12, 0.0, 0.0])  # negligible where anything is seen
    return _unit(xp.where(chosen[:, None], ray, 0.0)).sum(axis=2) + ahead


def _frames(centre: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R_view_world and R_ray_world (B, 3, 3) of windows centred on (B, 3), and the elevation (B, 1), rad."""
    xp, across = namespace(centre), _length(centre[:, :2])
    elevation = xp.atan2(centre[:, 2:], across)
    x, y = centre[:, :1] / across, centre[:, 1:2] / across
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    level, left = xp.concat([x, y, zero], axis=1), xp.concat([-y, x, zero], axis=1)
    vertical = xp.concat([zero, zero, one], axis=1)
    cos_e, sin_e = xp.cos(elevation), xp.sin(elevation)
    view = [-left, sin_e * level - cos_e * vertical, cos_e * level + sin_e * vertical]
    return xp.stack(view, axis=1), xp.stack([level, left, vertical], axis=1), elevation


def _scale(image: Tensor, weight: Tensor) -> Tensor:
    """RMS distance (B,) of the points seen (B, 2, W, J) from the mean of their frame."""
    count = weight.sum(axis=2)
    mean = image.sum(axis=3) / count.clip(1.0)[:, None]
    away = (image - mean[..., None]) * weight[:, None]
    square = (away * away).sum(axis=(1, 2, 3)) / count.sum(axis=1).clip(1.0)
    return namespace(image).sqrt(square).clip(MIN_SCALE)


def _standing(rays: Tensor, seen: Tensor, camera_height: Tensor, scale: Tensor) -> Tensor:
    """Log(horizontal distance x scale) of each foot if it is on the floor, and whether known, (B, W, 2 F);
    unknown if the height is, or if the ray (B, 3, W, F) is near the horizon.
    """
    xp = namespace(rays)
    slope = -rays[:, 2] / _length(rays[:, :2])[:, 0].clip(1e-6)
    height = (camera_height - ANKLE_HEIGHT)[:, None, None]
    known = seen & (slope > MIN_SLOPE) & (height > MIN_HEIGHT)
    away = height * scale[:, None, None] / slope.clip(MIN_SLOPE)
    return xp.concat([xp.where(known, xp.log(away), 0.0), like(rays, known)], axis=2)


def _optional(values: Tensor) -> Tensor:
    """Values (B, n) and whether they are known (B, 1); zeros where any in a row is NaN."""
    xp = namespace(values)
    known = xp.isfinite(values).all(axis=1, keepdims=True)
    return xp.concat([xp.where(known, values, 0.0), like(values, known)], axis=1)
