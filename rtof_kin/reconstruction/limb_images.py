"""Bones with sensors as an image shows them, and how far the sensors are from that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence


def sensed_bones(bone_imus: BoneImuSequence, skeleton: SkeletonModel) -> list[tuple[int, int, int]]:
    """Return (sensor, joint, child) of every bone whose segment carries a sensor."""
    index = skeleton.names.index
    return [
        (s, index(joint), child)
        for s, joint in enumerate(bone_imus.joints)
        for child in kinematics.children_of(skeleton.parents, index(joint))
    ]


@dataclass(frozen=True)
class Limbs:
    """Bones from each sensor's joint to its children, in the image plane."""

    seen: Array
    """(T, n, 2) of the keypoints at unit depth; zero where missing."""
    middle: Array
    """(T, n, 2) their centres."""
    bones: Array
    """(T, n, 3) of the sensors in camera axes, m; zero where missing."""

    @classmethod
    def of(cls, keypoints: KeypointSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel) -> Limbs:
        """Collect the bones.

        Args:
            skeleton: the subject's.
        """
        sensor, joint, child = np.array(sensed_bones(bone_imus, skeleton)).T
        xy = keypoints.camera.normalise(keypoints.select(skeleton.names).uv_px)
        R_camera_bone = keypoints.camera.R_camera_world @ bone_imus.R_world_bone[:, sensor]
        seen, middle = xy[:, child] - xy[:, joint], (xy[:, child] + xy[:, joint]) / 2
        bones = np.einsum("tnij,nj->tni", R_camera_bone, skeleton.joint_offsets[child])
        known = np.isfinite(np.concatenate([seen, bones], axis=-1)).all(axis=-1, keepdims=True)
        kept = (np.where(known, values, 0.0) for values in (seen, middle, bones))
        return cls(*kept)

    def drawn(self, bones: Array, perspective: ArrayLike = 1.0) -> Array:
        """Return the images (..., T, n, 2) of bones, up to a scale.

        Args:
            bones: (..., T, n, 3) m, camera axes.
            perspective: (...) 1 for the focal length given, 0.5 for one twice as long.
        """
        share = np.asarray(perspective)[..., None, None, None]
        return np.asarray(bones[..., :2] - share * self.middle * bones[..., 2:])

    def misfit(self, headings: Array, camera: Camera) -> float:
        """Return the misfit of image and sensors: 0 for agreement, 1 for none.

        It is the mean over frames of the squared fraction that no single scale explains, minimised over a
        common heading of all sensors.

        Args:
            headings: (H,) rad.
        """
        R = camera.R_camera_world
        turns = R @ so3.about_axis("z", headings) @ R.T
        drawn = self.drawn(np.einsum("hij,tnj->htni", turns, self.bones))
        both = np.einsum("tni,htni->ht", self.seen, drawn)
        squares = np.sum(self.seen**2, axis=(1, 2)) * np.sum(drawn**2, axis=(2, 3))
        known = squares > 0
        explained = np.maximum(both, 0) ** 2 / np.where(known, squares, 1.0)
        frames = known.sum(axis=1)
        return float(np.min(1 - explained.sum(axis=1) / np.maximum(frames, 1)))
