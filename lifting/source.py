"""What a recording shows, to be looked up at any time: rays to landmarks, axes of sensed segments.

This is the boundary between the package's float64 arrays and float32 tensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lifting.body import Body
from lifting.windows import Picture, Windows
from rtof_kin.types import BoneImuSequence, KeypointSequence

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
    """(T, S, 2, 3) x and z axes in world of the segments that may carry sensors; zeros where unknown."""
    sensed: NDArray[np.bool_]
    """(T, S)."""
    picture: NDArray[np.float32]
    """(T, J, 2) as in `Picture`; zeros where unseen."""
    R_camera_world: NDArray[np.float32]
    """(3, 3)."""

    @classmethod
    def of(
        cls, body: Body, keypoints: KeypointSequence, bone_imus: BoneImuSequence | None
    ) -> Source:
        """Of a recording; sensors at other times than the keypoints' are resampled to them."""
        keypoints = keypoints.select(body.names)
        rays = keypoints.camera.rays_world(keypoints.uv_px)
        seen = keypoints.seen & np.isfinite(rays).all(axis=-1)
        rays = np.where(seen[..., None], rays, 0.0)
        R = np.full((len(keypoints), len(body.sensors), 3, 3), np.nan)
        if bone_imus is not None and body.sensors:
            if not np.array_equal(bone_imus.times, keypoints.times):
                bone_imus = bone_imus.resample(keypoints.times)
            for s, joint in enumerate(bone_imus.joints):
                if joint in body.sensors:
                    R[:, body.sensors.index(joint)] = bone_imus.R_world_bone[:, s]
        sensed = np.isfinite(R).all(axis=(2, 3))
        axes = np.where(sensed[..., None, None], R, 0.0)[..., [0, 2]].swapaxes(2, 3)
        camera = keypoints.camera
        middle = np.array([camera.width_px, camera.height_px]) / 2
        xy = np.where(seen[..., None], (keypoints.uv_px - middle) / middle[0], 0.0)
        return cls(
            keypoints.times, rays.astype(np.float32), seen, axes.astype(np.float32), sensed,
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
        at = times[:, None] + (np.arange(size) - estimated) / rate_hz
        instants = _Instants.at(self.times, at, near=0.1 / rate_hz)
        B = len(times)
        R_camera = torch.from_numpy(self.R_camera_world).expand(B, 3, 3)
        axes = self.axes[instants.frames].transpose(3, 0, 2, 1)
        n, S = axes.shape[1], axes.shape[3]
        return Windows(
            instants.mixed(self.rays[instants.frames].transpose(2, 0, 1)),
            instants.known(self.seen),
            torch.from_numpy(bones).float().expand(B, -1),
            torch.full((B,), height),
            instants.mixed(axes.reshape(3, n, 2 * S)).reshape(B, 3, size, 2, S),
            instants.known(self.sensed),
            estimated,
            Picture(instants.mixed(self.picture[instants.frames].transpose(2, 0, 1)), R_camera)
            if picture
            else None,
        )


@dataclass(frozen=True)
class _Instants:
    """Where instants (B, W) lie between frames."""

    frames: slice
    """All frames that are concerned; the numbers below count within."""
    left: torch.Tensor
    """(B, W) number of the frame before."""
    right: torch.Tensor
    """(B, W) number of the frame after."""
    share: torch.Tensor
    """(B, W) of the one after."""
    mixes: bool
    """Whether any is truly between two; if none is, `left` and `right` are one."""
    far: torch.Tensor
    """(B, W) whether the two are too far apart."""

    @classmethod
    def at(cls, times: Array, at: Array, near: float) -> _Instants:
        """Instants `at` (B, W), s; an image less than `near` away stands alone."""
        at = np.clip(at, times[0], times[-1])
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
            torch.from_numpy(left - first),
            torch.from_numpy(right - first),
            torch.from_numpy(share.astype(np.float32)),
            mixes,
            torch.from_numpy(between & (step > MAX_STEP)),
        )

    def known(self, mask: NDArray[np.bool_]) -> torch.Tensor:
        """(B, W, n) bool of (T, n): whether all frames that an instant is made of are."""
        values = torch.from_numpy(mask[self.frames])
        right = _rows(values, self.right)
        if not self.mixes:
            return right
        right |= (self.share == 0)[..., None]
        left = _rows(values, self.left) | (self.share == 1)[..., None]
        return left & right & ~self.far[..., None]

    def mixed(self, values: NDArray[np.float32]) -> torch.Tensor:
        """(B, C, W, n) of C planes of the frames concerned (C, frames, n)."""
        planes, frames = values.shape[:2]
        flat = torch.from_numpy(np.ascontiguousarray(values)).reshape(planes * frames, -1)
        offsets = (frames * torch.arange(planes))[:, None]
        right = _rows(flat, self.right[:, None] + offsets)
        if not self.mixes:
            return right
        left, share = _rows(flat, self.left[:, None] + offsets), self.share[:, None, :, None]
        return (1 - share) * left + share * right


def _rows(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Rows (*index, n) of values (frames, n)."""
    return values.index_select(0, index.reshape(-1)).reshape(*index.shape, values.shape[1])
