"""Directions of bones with sensors, in the image and by the sensors.

A calibrated orientation gives the direction of a bone at every instant; the image shows its projection.
The two are compared without solving for poses, at any offset of the clocks.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array, Index
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

STEP: Final = 0.1
"""[s] between samples of the sensors' directions."""
_MOST_FRAMES: Final = 240
_SIGMA: Final = 0.12
_SIGMA_M: Final = 0.04
"""Standard deviation of the difference: per length of the bone, and [m]."""


@dataclass(frozen=True)
class BoneImages:
    """B bones with sensors, in the image and by the sensors."""

    frames: Index
    """(F,) index of each frame in the grid of `directions`."""
    vectors: Array
    """(F, B, 2) the bone in the image, in lengths of the bone."""
    rays: Array
    """(F, B, 2) normalised image coordinates of the bone's middle."""
    directions: Array
    """(G, B, 3) unit vectors in camera axes by the sensors, every `STEP`; NaN where missing."""
    sigma: Array
    """(B,) standard deviations of the differences."""
    weight: Array
    """(B,) 1 / number of bones of the same sensor."""
    sensors: Index
    """(B,) index of the sensor on each bone."""
    sensor_count: int
    """S."""

    def cost(self, steps: int, constant: bool = True) -> Array:
        """Return the robust differences (F, B), nats.

        Args:
            steps: offset of the video's stamps relative to the sensors', in `STEP`.
            constant: whether each bone may have a constant difference.
        """
        index = self.frames - steps
        inside = (index >= 0) & (index < len(self.directions))
        d = self.directions[np.where(inside, index, 0)]
        off = self.vectors - d[..., :2] + self.rays * d[..., 2:]
        known = inside[:, None] & np.isfinite(off[..., 0])
        off = np.where(known[..., None], off, 0.0)
        if constant:
            off = off - off.sum(axis=0) / np.maximum(known.sum(axis=0), 1)[:, None]
        square = np.einsum("fbi,fbi->fb", off, off) / self.sigma**2
        return np.where(known, 1.5 * np.log1p(square / 3), np.nan)

    def by_sensor(self, steps: int = 0) -> Array:
        """Return the mean difference (S,) of each sensor, nats per frame; NaN without a bone.

        Args:
            steps: offset of the clocks, in `STEP`.
        """
        cost = self.cost(steps, constant=False)
        known = np.isfinite(cost)
        some = known.any(axis=0)
        mean = np.where(known, cost, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        total, bones = (np.bincount(self.sensors, v, self.sensor_count) for v in (mean, some))
        return np.where(bones > 0, total / np.maximum(bones, 1), np.nan)


def bone_images(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, poses: PoseSequence, skeleton: SkeletonModel
) -> BoneImages | None:
    """Return the bones with sensors between joints of the detector; None where there are none.

    Args:
        poses: at the keypoints' times, for the depth of the root.
    """
    times = keypoints.times
    every = max(1, -(-int(np.ptp(times) / STEP) // _MOST_FRAMES))
    frames = np.arange(0, int(np.ptp(times) / STEP) + 1, every)
    chosen = _nearest(times, times[0] + STEP * frames)
    before = int(np.ceil((times[0] - bone_imus.times[0]) / STEP))  # so that frames lie on the grid
    grid = times[0] + STEP * np.arange(-before, (bone_imus.times[-1] - times[0]) / STEP)
    seen, camera = keypoints.select(skeleton.names), keypoints.camera
    xy = camera.normalise(seen.uv_px[chosen])
    depth = camera.to_camera(poses.p_world_joint[chosen, 0])[:, 2]
    ends = [
        (s, j, child)
        for s, j in enumerate(skeleton.index(*bone_imus.joints))
        for child in kinematics.children_of(skeleton.parents, j)
        if {skeleton.names[j], skeleton.names[child]} <= set(keypoints.names)
    ]
    if not ends:
        return None
    s, j, c = (np.array(column) for column in zip(*ends, strict=True))
    rest = skeleton.joint_offsets[c]
    length = np.linalg.norm(rest, axis=-1)
    R_world_bone = bone_imus.R_world_bone[_nearest(bone_imus.times, grid)][:, s]
    R = np.einsum("ij,gbjk->gbik", camera.R_camera_world, R_world_bone)
    return BoneImages(
        frames=frames + before,
        vectors=(xy[:, c] - xy[:, j]) * depth[:, None, None] / length[:, None],
        rays=(xy[:, c] + xy[:, j]) / 2,
        directions=np.einsum("gbik,bk->gbi", R, rest / length[:, None]),
        sigma=np.hypot(_SIGMA, _SIGMA_M / length),
        weight=1 / np.bincount(s)[s],
        sensors=s,
        sensor_count=len(bone_imus.joints),
    )


def _nearest(times: Array, at: Array) -> Index:
    """Indices of the samples nearest to instants."""
    middles = (times[1:] + times[:-1]) / 2
    return np.searchsorted(middles, at)


def exchanged_sides(bone_imus: BoneImuSequence) -> BoneImuSequence:
    """Return the sensors with left and right exchanged, where both sides have one."""
    sides = {"Left": "Right", "Right": "Left"}

    def other(joint: str) -> str:
        side = next((side for side in sides if joint.startswith(side)), "")
        mirrored = sides.get(side, "") + joint.removeprefix(side)
        return mirrored if mirrored in bone_imus.joints else joint

    return replace(bone_imus, joints=tuple(map(other, bone_imus.joints)))


def best_exchange(
    keypoints: KeypointSequence, readings: Iterable[BoneImuSequence], poses: PoseSequence, skeleton: SkeletonModel
) -> float:
    """Return the largest decrease of the difference by exchanging two sensors, nats per frame.

    Args:
        keypoints, poses, skeleton: as for `bone_images`.
        readings: the S sensors as declared, then with their segments rotated by 1 to S - 1 places.
    """
    rows = []
    for shift, moved in enumerate(readings):
        images = bone_images(keypoints, moved, poses, skeleton)
        off = np.full(len(moved.joints), np.nan) if images is None else images.by_sensor()
        rows.append(np.roll(off, shift))  # in the order of the segments
    S = len(rows)
    off = np.array([[rows[(b - a) % S][b] for b in range(S)] for a in range(S)])
    own = np.diag(off)
    return float(np.nanmax(own[:, None] + own - off - off.T, initial=0.0))
