"""Observations of a recording, looked up at any time: rays to landmarks, axes of segments with sensors.

This is the boundary between the package's float64 arrays and the lifter's, of float32.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lifting.body import Body
from lifting.windows import Windows
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

MAX_STEP = 0.15  #: Longest time between two frames that is interpolated across, s
VELOCITY_S, KEPT_VELOCITY = 4 / 60, 0.8
"""After the last frame, the mean velocity over this time goes on, s, of which this share is left after each
frame; chosen on the validation subjects."""


@dataclass(frozen=True)
class Source:
    """Rays and axes at the times of the keypoints."""

    times: Array  #: (T,) s
    rays: NDArray[np.float32]  #: (T, J, 3) directions in world; zeros where unseen
    seen: Mask  #: (T, J)
    axes: NDArray[np.float32]
    """(T, 2, S, 3) x and z axes in world of the segments that may carry sensors; zeros where unknown."""
    sensed: Mask  #: (T, S)

    @classmethod
    def of(
        cls,
        body: Body,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | None = None,
        R_bone_shared: Array | None = None,
    ) -> Self:
        """Collect the observations of a recording.

        Args:
            body: joints and sensors to take; others are ignored.
            bone_imus: calibrated sensors, resampled to the keypoints' times where they differ.
            R_bone_shared: (J, 3, 3) frame of each segment whose axes are taken; None for the segments' own.
        """
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
                    if R_bone_shared is not None:
                        R = R @ R_bone_shared[body.names.index(joint)]
                    sensed[:, s] = known
                    axes[known, :, s] = R[known][..., [0, 2]].swapaxes(1, 2)
        return cls(keypoints.times, rays.astype(np.float32), seen, axes, sensed)

    def extended(self, count: int, rate_hz: float) -> Self:
        """Return the same with further frames, in which the last one moves on more and more slowly.

        What was unknown shortly before the last frame stays where it is.
        """
        times, frames = self.times, 1 + np.arange(count)
        earlier = int(np.searchsorted(times, times[-1] - VELOCITY_S - 0.5 / rate_hz))
        step = float(times[-1] - times[earlier])
        moves = self.seen[-1] & self.seen[earlier], self.sensed[-1] & self.sensed[earlier]
        share = 1 / (step * rate_hz) if 0 < step < MAX_STEP else 0.0
        reach = np.cumsum(share * KEPT_VELOCITY**frames).astype(np.float32)

        def moved(values: NDArray[np.float32], known: Mask) -> NDArray[np.float32]:
            move = (values[-1] - values[earlier]) * known[:, None]
            new = values[-1] + reach.reshape(-1, *[1] * move.ndim) * move
            new /= np.sqrt((new * new).sum(axis=-1, keepdims=True)).clip(1e-9)
            return np.concatenate([values, new])

        def still(values: NDArray[Any]) -> NDArray[Any]:
            return np.concatenate([values, np.broadcast_to(values[-1], (count, *values.shape[1:]))])

        return replace(
            self,
            times=np.concatenate([times, times[-1] + frames / rate_hz]),
            rays=moved(self.rays, moves[0]),
            axes=moved(self.axes, moves[1]),
            seen=still(self.seen),
            sensed=still(self.sensed),
        )

    def windows(self, times: Array, size: int, estimated: int, rate_hz: float, bones: Array, height: float) -> Windows:
        """Return the windows around B times, s, of the estimated frames.

        A landmark is interpolated between two frames where both saw it; before the first and after the last frame, that
        frame is repeated. Bones (3 G,), see `Body.bones_of`, and the camera's height over the floor, m, may be NaN.
        """
        at = times[:, None] + (np.arange(size) - estimated) / rate_hz
        instants = _Instants(self.times, at, near=0.1 / rate_hz)
        B, W, S = *at.shape, self.sensed.shape[1]
        axes = instants.interpolated(self.axes.reshape(len(self.axes), 2 * S, 3)).reshape(B, 3, W, 2, S)
        rays, seen, sensed = instants.interpolated(self.rays), instants.known(self.seen), instants.known(self.sensed)
        bones_m, height_m = np.tile(bones.astype(np.float32), (B, 1)), np.full(B, height, np.float32)
        return Windows(rays, seen, bones_m, height_m, axes, sensed, estimated)


class _Instants:
    """Frames before and after instants (B, W), and the weight of the one after."""

    def __init__(self, times: Array, at: Array, near: float):
        """Locate instants `at` (B, W), s; an instant less than `near` from a frame is that frame."""
        at = at.clip(times[0], times[-1])
        right = np.searchsorted(times, at)
        left = np.maximum(right - 1, 0)
        before, after = times[left], times[right]
        step, since, until = after - before, at - before, after - at
        share = since / np.where(step > 0, step, 1.0)
        share[until < near] = 1.0
        share[(since < near) & (until >= near)] = 0.0
        between = (share > 0) & (share < 1)
        if not between.any():
            left = right = np.where(share == 1, right, left)
        first = int(left.min())
        self.frames = slice(first, int(right.max()) + 1)
        self.right = right - first
        self.left = left - first if between.any() else self.right
        self.share = share.astype(np.float32)
        self.far = between & (step > MAX_STEP)

    def known(self, mask: Mask) -> Mask:
        """(B, W, n) whether all frames that an instant is interpolated from are known in (T, n)."""
        values, share = mask[self.frames], self.share[..., None]
        return np.asarray(
            (values[self.left] | (share == 1)) & (values[self.right] | (share == 0)) & ~self.far[..., None]
        )

    def interpolated(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, C, W, n) at the instants, from n vectors of C components in each frame (T, n, C)."""
        planes = np.ascontiguousarray(values[self.frames].transpose(2, 0, 1))
        C, frames, n = planes.shape
        flat, offsets = planes.reshape(C * frames, n), frames * np.arange(C)[:, None]
        right: NDArray[np.float32] = flat.take(self.right[:, None] + offsets, axis=0)
        if self.left is self.right:
            return right
        left, share = flat.take(self.left[:, None] + offsets, axis=0), self.share[:, None, :, None]
        return np.asarray((1 - share) * left + share * right)
