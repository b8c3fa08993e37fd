"""What a recording shows, to be looked up at any time: rays to landmarks, axes of sensed segments.

This is the boundary between the package's float64 arrays and float32 tensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lifting.body import Body
from lifting.windows import Picture, Windows
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

Array = NDArray[np.float64]
MAX_STEP = 0.15
"""Longest time between two frames that is interpolated across, s."""


@dataclass(frozen=True)
class Source:
    """Everything seen and sensed, at the times of the keypoints."""

    times: Array
    """(T,) s."""
    rays: NDArray[np.float32]
    """(T, J, 3) directions in world; zeros where unseen."""
    seen: NDArray[np.bool_]
    """(T, J)."""
    axes: NDArray[np.float32]
    """(T, 2, S, 3) x and z axes in world of the segments that may carry sensors; zeros where unknown."""
    sensed: NDArray[np.bool_]
    """(T, S)."""
    picture: NDArray[np.float32]
    """(T, J, 2) as in `Picture`; zeros where unseen."""
    R_camera_world: NDArray[np.float32]
    """(3, 3)."""

    @classmethod
    def of(cls, body: Body, keypoints: KeypointSequence, bone_imus: BoneImuSequence | None) -> Source:
        """Of a recording; sensors at other times than the keypoints' are resampled to them."""
        keypoints = keypoints.select(body.names)
        rays = keypoints.camera.rays_world(keypoints.uv_px)
        seen = keypoints.seen & np.isfinite(rays).all(axis=-1)
        rays = np.where(seen[..., None], rays, 0.0)
        sensed = np.zeros((len(keypoints), len(body.sensors)), bool)
        axes = np.zeros((len(keypoints), 2, len(body.sensors), 3), np.float32)
        if bone_imus is not None and body.sensors:
            if not np.array_equal(bone_imus.times, keypoints.times):
                bone_imus = bone_imus.resample(keypoints.times)
            for joint, R in zip(bone_imus.joints, bone_imus.R_world_bone.swapaxes(0, 1), strict=True):
                if joint in body.sensors:
                    s = body.sensors.index(joint)
                    known = np.isfinite(R).all(axis=(1, 2))
                    sensed[:, s] = known
                    axes[known, :, s] = R[known][..., [0, 2]].swapaxes(1, 2)
        camera = keypoints.camera
        middle = np.array([camera.width_px, camera.height_px]) / 2
        xy = np.where(seen[..., None], (keypoints.uv_px - middle) / middle[0], 0.0)
        return cls(
            keypoints.times, rays.astype(np.float32), seen, axes, sensed,
            xy.astype(np.float32), camera.R_camera_world.astype(np.float32),
        )  # fmt: skip

    def windows(
        self,
        times: Array,
        size: int,
        estimated: int,
        rate_hz: float,
        bones: Array,
        height: float,
        picture: bool = True,
    ) -> Windows:
        """Windows of `size` instants around each of B times, which is that of the estimated frame.

        Between two frames a landmark is interpolated where both saw it; before the first and after the
        last frame the nearest one stands. `bones` (3 G) and the camera's `height` hold for all. Without
        `picture` the windows have none.
        """
        instants = self._instants(times, size, estimated, rate_hz)
        B = len(times)
        R_camera = torch.from_numpy(self.R_camera_world).expand(B, 3, 3)
        rays, seen, axes, sensed = map(torch.from_numpy, self._observed(instants))
        return Windows(
            rays,
            seen,
            torch.from_numpy(bones).float().expand(B, -1),
            torch.full((B,), height),
            axes,
            sensed,
            estimated,
            Picture(torch.from_numpy(instants.mixed(self.picture)), R_camera) if picture else None,
        )

    def window(self, time: float, size: int, estimated: int, rate_hz: float) -> tuple[NDArray[Any], ...]:
        """What `windows` observes in the one around `time`: rays (3, W, J), seen (W, J), axes
        (3, W, 2, S), sensed (W, S).
        """
        instants = self._instants(np.array([time]), size, estimated, rate_hz)
        return tuple(values[0] for values in self._observed(instants))

    def _instants(self, times: Array, size: int, estimated: int, rate_hz: float) -> _Instants:
        at = times[:, None] + (np.arange(size) - estimated) / rate_hz
        return _Instants.at(self.times, at, near=0.1 / rate_hz)

    def _observed(self, instants: _Instants) -> tuple[NDArray[Any], ...]:
        """Rays (B, 3, W, J), seen (B, W, J), axes (B, 3, W, 2, S), sensed (B, W, S)."""
        B, W = instants.left.shape
        S = self.sensed.shape[1]
        axes = instants.mixed(self.axes.reshape(len(self.axes), 2 * S, 3)).reshape(B, 3, W, 2, S)
        return (
            instants.mixed(self.rays), instants.known(self.seen), axes, instants.known(self.sensed),
        )  # fmt: skip


@dataclass(frozen=True)
class _Instants:
    """Where instants (B, W) lie between frames."""

    frames: slice
    """All frames that are concerned; the numbers below count within."""
    left: NDArray[np.int64]
    """(B, W) number of the frame before."""
    right: NDArray[np.int64]
    """(B, W) number of the frame after."""
    share: NDArray[np.float32]
    """(B, W) of the one after."""
    mixes: bool
    """Whether any is truly between two; if none is, `left` and `right` are one."""
    far: NDArray[np.bool_]
    """(B, W) whether the two are too far apart."""

    @classmethod
    def at(cls, times: Array, at: Array, near: float) -> _Instants:
        """Instants `at` (B, W), s; an image less than `near` away stands alone."""
        at = at.clip(times[0], times[-1])
        right = np.searchsorted(times, at)
        left = np.maximum(right - 1, 0)
        before, after = times[left], times[right]
        step, since, until = after - before, at - before, after - at
        share = since / np.where(step > 0, step, 1.0)
        share[until < near] = 1.0
        share[(since < near) & (until >= near)] = 0.0
        between = (share > 0) & (share < 1)
        mixes = bool(between.any())
        if not mixes:
            left = right = np.where(share == 1, right, left)
        first, last = int(left.min()), int(right.max()) + 1
        return cls(
            slice(first, last),
            left - first,
            right - first,
            share.astype(np.float32),
            mixes,
            between & (step > MAX_STEP),
        )

    def known(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(B, W, n) bool of (T, n): whether all frames that an instant is made of are."""
        values = mask[self.frames]
        right = values.take(self.right, axis=0)
        if not self.mixes:
            return right
        right |= (self.share == 0)[..., None]
        left = values.take(self.left, axis=0) | (self.share == 1)[..., None]
        return np.asarray(left & right & ~self.far[..., None])

    def mixed(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, C, W, n) of n vectors of C components in each frame (T, n, C)."""
        planes = np.ascontiguousarray(values[self.frames].transpose(2, 0, 1))
        C, frames, n = planes.shape
        flat, offsets = planes.reshape(C * frames, n), frames * np.arange(C)[:, None]
        right: NDArray[np.float32] = flat.take(self.right[:, None] + offsets, axis=0)
        if not self.mixes:
            return right
        left, share = flat.take(self.left[:, None] + offsets, axis=0), self.share[:, None, :, None]
        return np.asarray((1 - share) * left + share * right)
