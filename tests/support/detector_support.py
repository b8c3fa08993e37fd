"""What a perfect detector sees of a motion, and files of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.simulation.mocap import read_mocap
from rtof_kin.vision.layouts import detector_table, own

Array = NDArray[np.float64]
LAYOUTS = ("body25", "body25b", "coco17", "halpe26", "mediapipe33", "human36m17")


def points_px(layout: str, motion: Motion, camera: Camera) -> Array:
    """Exact image points (T, K, 2) of a layout."""
    skeleton, poses = motion.skeleton, motion.poses
    p, R = poses.p_world_joint, poses.R_world_bone
    bare = replace(SkeletonModel.default().table, landmarks=detector_table().points)
    scaled = bare.scaled_to(skeleton.joint_offsets).landmarks
    body = {point.name: (point.joint, point.offset) for point in scaled}
    body |= {own(name): place for name, place in skeleton.landmarks.items()}
    places = [body[name] for name in detector_table().layout(layout).points]
    joints = skeleton.index(*(joint for joint, _ in places))
    offsets = np.array([offset for _, offset in places])
    return camera.project(p[:, joints] + np.einsum("tkij,kj->tki", R[:, joints], offsets))


def landmarks_px(names: tuple[str, ...], motion: Motion, camera: Camera) -> Array:
    """(T, L, 2) landmarks of the skeleton in the image."""
    poses, skeleton = motion.poses, motion.skeleton
    every = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    order = list(skeleton.landmarks)
    return camera.project(every[:, [order.index(name) for name in names]])


@cache
def walking() -> Motion:
    """A test subject's walk (50 frames at 30 Hz), on the shipped skeleton."""
    clip = read_mocap(Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh", output_rate_hz=None)
    return SkeletonModel.default().motion(clip.poses[:50])


def watching(motion: Motion) -> Camera:
    """A camera 4 m from the middle of a motion, aslant in front of it."""
    middle = motion.poses.p_world_joint[:, 0].mean(axis=0)
    return Camera.looking_at(middle + np.array([3.2, 2.4, 0.4]), middle, 1250.0)


def flat(uv: Array, confidence: float = 0.8) -> list[float]:
    """x, y, c of one person, as most JSON has them."""
    rows: Any = np.column_stack([uv, np.full(len(uv), confidence)])
    return [round(float(value), 3) for value in rows.ravel()]
