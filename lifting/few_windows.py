"""A few windows at a time: the answer of `Lifter.lift_windows` up to rounding, in less time.

For one to ten windows, the calls of torch take longer than their arithmetic. Here torch evaluates the network
alone; `windows.encode` and `windows.decode` are done by NumPy on arrays of the same layout, what depends on
the person alone only once.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lifting.body import Body
from lifting.folded import FoldedNetwork
from lifting.model import TemporalNetwork, torch_threads
from lifting.windows import (
    ANKLE_HEIGHT,
    BONE_GAIN,
    LOG_DISTANCE,
    LOG_SPREAD,
    MAX_IMAGE,
    MIN_FORWARD,
    MIN_HEIGHT,
    MIN_HEIGHT_IN_IMAGE,
    MIN_SCALE,
    MIN_SLOPE,
    SIGMA_ACROSS,
    SIGMA_ALONG,
    SIGMA_TURN,
    Windows,
    sizes,
)
from rtof_kin.core.array_types import Array

_Array = NDArray[np.float32]


class FewWindows:
    """Lifts of one person from one height of the camera."""

    def __init__(self, body: Body, network: TemporalNetwork, bones: Array, camera_height: float, flip: bool = True):
        """Fuse the weights.

        Args:
            network: in evaluation mode, of the package's own model. bones: (3 G,) see `Body.bones_of`, m.
            camera_height: over the floor, m. Both may be NaN.
        """
        self._body, self._network = body, FoldedNetwork(body, network, flip)
        self._inputs, constants, _ = sizes(body)
        J = len(body.names)
        self._rank = np.array([3 if j == 0 else 2 if j in body.hips else 1 for j in range(J)])
        self._away = np.abs(np.arange(network.receptive_field()) - network.estimated())
        self._height = camera_height if np.isfinite(camera_height) else None
        self._constants = np.zeros((1, constants), np.float32)
        if np.isfinite(bones).all():
            self._constants[0, 4:-1] = (bones - np.array(body.nominal_bones)) * BONE_GAIN
            self._constants[0, -1] = 1.0

    def __call__(self, windows: Windows) -> tuple[Array, Array, Array, Array]:
        """Return positions (B, J, 3) from the optical centre, m; their sigma (B, J, 2), m; orientations
        (B, J, 3, 3) of the segments' shared frames; their sigma (B, J), rad.

        Args:
            windows: B windows; their bones and height of the camera are not read.
        """
        rays, seen = windows.rays_world.numpy(), windows.seen.numpy()
        R_view, R_ray, elevation = _frames(self._centre(rays, seen))
        features, scale = self._features(windows, R_view, R_ray)
        constants = np.repeat(self._constants, len(rays), axis=0)
        constants[:, 0], constants[:, 1] = elevation, np.log(scale)
        if self._height is not None:
            constants[:, 2] = np.log((self._height * scale).clip(MIN_HEIGHT_IN_IMAGE))
            constants[:, 3] = 1.0
        with torch_threads(1), torch.inference_mode():
            output = self._network(torch.from_numpy(features), torch.from_numpy(constants)).numpy()
        return self._decoded(output, R_view, R_ray, scale)

    def _centre(self, rays: _Array, seen: NDArray[np.bool_]) -> _Array:
        """Direction (B, 3) to the centre of each window, as in `windows.encode`."""
        B, W, _ = seen.shape
        frame = np.where(seen.any(axis=2), self._away, self._away + W).argmin(axis=1)
        rows = np.arange(B)
        now, ray = seen[rows, frame], rays[rows, :, frame]
        rank = now * self._rank
        chosen = now & (rank == rank.max(axis=1, keepdims=True))
        centre = (ray * (chosen / _length(ray))[:, None]).sum(axis=2)
        centre[:, 0] += 1e-12  # negligible where anything is seen
        return np.asarray(centre, np.float32)

    def _features(self, windows: Windows, R_view: _Array, R_ray: _Array) -> tuple[_Array, _Array]:
        """Features (B, W, inputs), and the scale (B,)."""
        rays, seen = windows.rays_world.numpy(), windows.seen.numpy()
        (B, W, J), F = seen.shape, len(self._body.feet)
        features = np.empty((B, W, self._inputs), np.float32)
        view = (R_view @ rays.reshape(B, 3, -1)).reshape(rays.shape)
        forward = view[:, 2]
        weight = (seen & (forward > MIN_FORWARD)).astype(np.float32)
        image = view[:, :2] * (weight / np.maximum(forward, MIN_FORWARD))[:, None]
        scale = _scale(image, weight)
        image /= scale[:, None, None, None]
        limited = np.minimum(np.maximum(image, -MAX_IMAGE), MAX_IMAGE)
        features[..., :J], features[..., J : 2 * J] = limited[:, 0], limited[:, 1]
        features[..., 2 * J : 3 * J] = weight
        feet, sensors = features[..., 3 * J : 3 * J + 2 * F], features[..., 3 * J + 2 * F :]
        self._standing(feet, rays, seen, scale)
        sensed, S2 = windows.sensed.numpy().astype(np.float32), 2 * len(self._body.sensors)
        axes = (R_ray @ windows.axes_world.numpy().reshape(B, 3, -1)).reshape(B, 3, W, S2)
        axes *= np.concatenate([sensed, sensed], axis=2)[:, None]
        sensors[..., : 3 * S2].reshape(B, W, 3, S2)[:] = axes.transpose(0, 2, 1, 3)
        sensors[..., 3 * S2 :] = sensed
        return features, scale

    def _standing(self, out: _Array, rays: _Array, seen: NDArray[np.bool_], scale: _Array) -> None:
        """Write log(horizontal distance x scale) of each foot on the floor, whether known, (B, W, 2 F)."""
        F = len(self._body.feet)
        height = -1.0 if self._height is None else self._height - ANKLE_HEIGHT
        if not height > MIN_HEIGHT:
            out[:] = 0.0
            return
        for f, j in enumerate(self._body.feet):
            x, y, z = rays[:, 0, :, j], rays[:, 1, :, j], rays[:, 2, :, j]
            slope = -z / np.maximum(np.sqrt(x * x + y * y), 1e-6)
            known = seen[..., j] & (slope > MIN_SLOPE)
            out[..., f] = known * np.log(height * scale[:, None] / np.maximum(slope, MIN_SLOPE))
            out[..., F + f] = known

    def _decoded(
        self, output: _Array, R_view: _Array, R_ray: _Array, scale: _Array
    ) -> tuple[Array, Array, Array, Array]:
        """What `__call__` returns, from the network's output (B, outputs), see `windows.decode`."""
        B, J = len(output), len(self._body.names)
        ends = np.cumsum([3 * (J - 1), 3, 2 * J, 6 * J])
        pose, root, spread, turns, turn = np.split(output, ends, axis=1)
        direction = np.concatenate([root[:, :2] * scale[:, None], np.ones((B, 1))], axis=1)
        away = np.exp(root[:, 2].clip(*LOG_DISTANCE)) / scale / np.sqrt((direction * direction).sum(axis=1))
        p = np.empty((B, J, 3))
        p[:, 0] = ((direction * away[:, None])[:, None] @ R_view)[:, 0]
        distance = np.sqrt((p[:, 0] * p[:, 0]).sum(axis=1))
        p[:, 1:] = p[:, :1] + pose.reshape(B, 3, J - 1).swapaxes(1, 2) @ R_ray
        sigma_m = np.exp(spread.reshape(B, 2, J).clip(*LOG_SPREAD)).swapaxes(1, 2).astype(float)
        sigma_m *= (SIGMA_ACROSS, SIGMA_ALONG)
        sigma_m[:, 0] *= distance[:, None]
        sigma_rad = SIGMA_TURN * np.exp(turn.clip(*LOG_SPREAD).astype(float))
        axes = turns.reshape(B, 2, 3, J).transpose(0, 1, 3, 2) @ R_ray[:, None]
        return p, sigma_m, _rotations(*axes.swapaxes(0, 1).astype(float)), sigma_rad


def _frames(centre: _Array) -> tuple[_Array, _Array, _Array]:
    """R_view_world and R_ray_world (B, 3, 3) of windows centred on (B, 3), and the elevation (B,), rad."""
    x, y, up = centre.T
    across = np.sqrt(x * x + y * y).clip(1e-12)
    elevation = np.arctan2(up, across)
    x, y, cos_e, sin_e = x / across, y / across, np.cos(elevation), np.sin(elevation)
    R = np.zeros((2, len(centre), 3, 3), np.float32)
    view, ray = R
    view[:, 0, 0], view[:, 0, 1] = y, -x
    view[:, 1, 0], view[:, 1, 1], view[:, 1, 2] = sin_e * x, sin_e * y, -cos_e
    view[:, 2, 0], view[:, 2, 1], view[:, 2, 2] = cos_e * x, cos_e * y, sin_e
    ray[:, 0, 0], ray[:, 0, 1], ray[:, 1, 0], ray[:, 1, 1], ray[:, 2, 2] = x, y, -y, x, 1.0
    return view, ray, elevation


def _scale(image: _Array, weight: _Array) -> _Array:
    """RMS distance (B,) of the points seen (B, 2, W, J) from the mean of their frame."""
    count = weight.sum(axis=2)
    mean = image.sum(axis=3) / np.maximum(count, 1.0)[:, None]
    away = (image - mean[..., None]) * weight[:, None]
    square = (away * away).reshape(len(image), -1).sum(axis=1) / np.maximum(count.sum(axis=1), 1.0)
    return np.asarray(np.maximum(np.sqrt(square), MIN_SCALE), np.float32)


def _rotations(x: Array, z: Array) -> Array:
    """Rotations (B, J, 3, 3) with z axes in the direction of (B, J, 3) and x axes near those given."""
    R = np.empty((*x.shape, 3))
    R[..., 2] = z = z / np.sqrt((z * z).sum(axis=-1, keepdims=True)).clip(1e-12)
    x = x - (x * z).sum(axis=-1, keepdims=True) * z
    R[..., 0] = x = x / np.sqrt((x * x).sum(axis=-1, keepdims=True)).clip(1e-12)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        R[..., i, 1] = z[..., j] * x[..., k] - z[..., k] * x[..., j]
    return R


def _length(v: _Array) -> _Array:
    """Lengths (B, n) of vectors (B, 3, n), at least 1e-12."""
    return np.asarray(np.sqrt((v * v).sum(axis=1)).clip(1e-12))
