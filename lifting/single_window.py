"""One window at a time: what `windows.encode` and `windows.decode` do, in NumPy.

Of one window torch spends longer on handing out these operations than on computing them. Here are the
formulas of `windows` without the batch, and with its constants; the network is that of `predict`. Tests
compare the two frame by frame.
"""

from __future__ import annotations

from math import atan2, exp, hypot, isfinite, log, sqrt
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lifting import windows
from lifting.body import Body
from lifting.folded import FoldedNetwork
from lifting.model import TemporalNetwork
from lifting.threads import torch_threads

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
_TINY = 1e-12
_AHEAD = np.array([_TINY, 0.0, 0.0], np.float32)
"""Where nothing is seen; of no weight where anything is."""


class SinglePose(NamedTuple):
    """The pose in the estimated frame of a window, in world axes."""

    p_camera_joint: Array
    """(J, 3) from the optical centre, m."""
    sigma_m: Array
    """(J, 2) see `Estimate.sigma_m`."""
    R_world_bone: Array | None
    """(J, 3, 3); None for a body without sensors."""
    sigma_rad: Array | None
    """(J,) standard deviation per axis; likewise."""


class _View(NamedTuple):
    """Where the answer is to be read, see `EncodedWindows`."""

    R_view_world: Array
    R_ray_world: Array
    scale: float


class SingleWindowLifter:
    """A lifter of the package's own kind for one person before one camera, a window at a time."""

    def __init__(
        self,
        body: Body,
        network: TemporalNetwork,
        bones: NDArray[np.float64],
        camera_height: float,
        flip: bool = True,
    ):
        """Take a network in evaluation mode, and what holds for all windows, see `Windows`."""
        self._body, self._height = body, camera_height
        self._network = FoldedNetwork(body, network, flip)
        self._estimated = network.estimated()
        self._rank = np.array([3] + [2 if j in body.hips else 1 for j in range(1, len(body.names))])
        self._told = np.zeros(len(bones) + 1, np.float32)
        if np.isfinite(bones).all():
            nominal = np.asarray(body.nominal_bones)
            self._told[:] = [*(bones - nominal) * windows.BONE_GAIN, 1.0]

    def __call__(self, rays: Array, seen: Mask, axes: Array, sensed: Mask) -> SinglePose:
        """The pose of a window of what `Source.window` gives."""
        features, constants, view = self._encode(rays, seen, axes, sensed)
        with torch_threads(1), torch.inference_mode():
            output = self._network(torch.from_numpy(features[None]), torch.from_numpy(constants[None]))
        return self._decode(output[0].numpy(), view)

    def _encode(self, rays: Array, seen: Mask, axes: Array, sensed: Mask) -> tuple[Array, Array, _View]:
        """Network input (W, inputs) and (constants,)."""
        R_view, R_ray, elevation = _frames(self._centre_ray(rays, seen))
        view = (R_view @ rays.reshape(3, -1)).reshape(rays.shape)
        weight = (seen & (view[2] > windows.MIN_FORWARD)).astype(np.float32)
        image = view[:2] * (weight / np.maximum(view[2], windows.MIN_FORWARD))
        scale = _scale(image, weight)
        x, y = (image / np.float32(scale)).clip(-windows.MAX_IMAGE, windows.MAX_IMAGE)
        parts = [x, y, weight, *self._standing(rays, seen, scale)]
        if axes.shape[-1]:
            turned = (R_ray @ axes.reshape(3, -1)).reshape(axes.shape) * sensed[:, None]
            parts += [*turned.reshape(*axes.shape[:2], -1), sensed]
        height = [0.0, 0.0]
        if isfinite(self._height):
            height = [log(max(self._height * scale, windows.MIN_HEIGHT_IN_IMAGE)), 1.0]
        told = np.array([elevation, log(scale), *height], np.float32)
        features = np.concatenate(parts, axis=1, dtype=np.float32)
        return features, np.concatenate([told, self._told]), _View(R_view, R_ray, scale)

    def _centre_ray(self, rays: Array, seen: Mask) -> Array:
        """(3,) see `windows.encode`."""
        frames = np.flatnonzero(seen.any(axis=1))
        if not len(frames):
            return _AHEAD
        frame = frames[np.abs(frames - self._estimated).argmin()]
        rank = self._rank * seen[frame]
        ray = rays[:, frame, rank == rank.max()]
        return np.asarray(_unit(ray).sum(axis=1) + _AHEAD)

    def _standing(self, rays: Array, seen: Mask, scale: float) -> tuple[Array, Mask]:
        """Log(horizontal distance x scale) of each foot if it stands, and whether known; (W, F) each."""
        feet = self._body.feet
        x, y, z = rays[..., feet]
        height = self._height - windows.ANKLE_HEIGHT
        if not height > windows.MIN_HEIGHT:
            return np.zeros_like(z), np.zeros(z.shape, bool)
        slope = -z / np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
        known = seen[:, feet] & (slope > windows.MIN_SLOPE)
        return np.log(height * scale / np.maximum(slope, windows.MIN_SLOPE)) * known, known

    def _decode(self, output: Array, view: _View) -> SinglePose:
        """The network's answer (outputs,) in world axes."""
        J = len(self._body.names)
        pose, (right, down, away) = output[: 3 * J - 3], output[3 * J - 3 : 3 * J].tolist()
        low, high = windows.LOG_DISTANCE
        distance = exp(min(max(away, low), high)) / view.scale
        direction = np.array([right * view.scale, down * view.scale, 1.0], np.float32)
        root = _unit(direction) * np.float32(distance) @ view.R_view_world
        p = np.empty((J, 3), np.float32)
        p[0], p[1:] = root, pose.reshape(3, J - 1).T @ view.R_ray_world + root
        spread = output[3 * J : 5 * J].reshape(2, J).T.clip(*windows.LOG_SPREAD)
        sigma = np.exp(spread) * np.array([windows.SIGMA_ACROSS, windows.SIGMA_ALONG], np.float32)
        sigma[0] *= np.float32(distance)
        if len(output) == 5 * J:
            return SinglePose(p, sigma, None, None)
        x, z = output[5 * J : 11 * J].reshape(2, 3, J)
        z = _unit(z)
        x = _unit(x - (x * z).sum(axis=0) * z)
        y = z[[1, 2, 0]] * x[[2, 0, 1]] - z[[2, 0, 1]] * x[[1, 2, 0]]
        R = view.R_ray_world.T @ np.stack([x, y, z]).transpose(2, 1, 0)
        turn = np.exp(output[11 * J :].clip(*windows.LOG_SPREAD))
        return SinglePose(p, sigma, R, turn * np.float32(windows.SIGMA_TURN))


def _frames(centre: Array) -> tuple[Array, Array, float]:
    """R_view_world and R_ray_world (3, 3) of a window centred on (3,), and its elevation."""
    x, y, up = centre.tolist()
    across = max(hypot(x, y), _TINY)
    length = hypot(across, up)
    cos_a, sin_a = x / across, y / across
    cos_e, sin_e = across / length, up / length
    view = [
        [sin_a, -cos_a, 0.0],
        [sin_e * cos_a, sin_e * sin_a, -cos_e],
        [cos_e * cos_a, cos_e * sin_a, sin_e],
    ]
    ray = [[cos_a, sin_a, 0.0], [-sin_a, cos_a, 0.0], [0.0, 0.0, 1.0]]
    return np.array(view, np.float32), np.array(ray, np.float32), atan2(up, across)


def _scale(image: Array, weight: Array) -> float:
    """RMS distance of the points seen (2, W, J) from the mean of their frame."""
    count = weight.sum(axis=1)
    mean = image.sum(axis=2) / np.maximum(count, 1)
    away = (image - mean[..., None]) * weight
    square = float(np.vdot(away, away)) / max(float(count.sum()), 1.0)
    return max(sqrt(square), windows.MIN_SCALE)


def _unit(v: Array) -> Array:
    """Vectors (3, ...) of length 1; zero stays zero."""
    unit: Array = v / np.maximum(np.sqrt((v * v).sum(axis=0)), np.float32(_TINY))
    return unit
