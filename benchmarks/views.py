"""Simulated views of a body's points, for fitting and measuring landmark regressions.

The motion gives the orientations; the body is the shipped skeleton with varied bone lengths, because joints
are those of the skeleton's table and the skeletons of motion capture have others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.vision.layouts import DetectorTable, mirrored, own, point_names

MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class ViewSettings:
    """Distributions of what is drawn for each view; a pair is a uniform range."""

    distance: tuple[float, float] = (1.8, 7.5)  # [m] camera to root, along the floor
    height: tuple[float, float] = (0.5, 3.2)  # [m] of the camera over the floor
    roll: float = np.radians(2.0)  # [rad] of the camera about its axis, standard deviation
    tilt: float = 0.7  # [rad] of the whole body about a horizontal axis, largest
    tilt_share: float = 1 / 3  # [-] of the frames that are tilted
    bone_scale: float = 0.05  # [-] of each bone's length, the same on both sides, standard deviation
    place: float = 0.010  # [m] of each detector's point in its segment per axis, standard deviation
    mirror: bool = True  # whether half of the views are of the mirrored motion


class Views:
    """Generator of views; points are in the order of `point_names`.

    Args:
        table: of the layouts, on the shipped skeleton. settings: distributions.
    """

    def __init__(self, table: DetectorTable, settings: ViewSettings | None = None):
        self.settings = settings or ViewSettings()
        self.skeleton = SkeletonModel.default()
        self.names = point_names(table, self.skeleton)
        points = (*self.skeleton.table.landmarks, *table.points)
        self._table = replace(self.skeleton.table, landmarks=points)
        self._still = len(self.skeleton.table.landmarks)
        self._other_joint = [self.names.index(own(mirrored(n))) for n in self.skeleton.names]

    def see(self, p_root: Array, R_world_bone: Array, rng: Generator) -> tuple[Array, Array]:
        """Draw one view of a motion, with a camera position for each frame.

        Args:
            p_root: (T, 3) root in world, m. R_world_bone: (T, J, 3, 3). rng: source of randomness.

        Returns:
            (T, N, 2) points on the image plane, x/z right and y/z down, and (T,) depth of the root, m.
        """
        s, T = self.settings, len(p_root)
        if s.mirror and rng.random() < 0.5:
            p_root = p_root @ MIRROR
            R_world_bone = MIRROR @ R_world_bone[:, self._other_joint] @ MIRROR
        points = self._body(p_root, R_world_bone, rng)
        root = points[:, [0]]
        points = root + (points - root) @ np.swapaxes(self._tilts(T, rng), -1, -2)
        azimuth = rng.uniform(-np.pi, np.pi, T)
        away = rng.uniform(*s.distance, T)
        eye = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), 0 * away], axis=-1)
        eye += root[:, 0] * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0] * rng.uniform(*s.height, (T, 1))
        towards = root[:, 0] + rng.uniform(-0.3, 0.3, (T, 3)) - eye
        camera = np.einsum("tij,tnj->tni", self._axes(towards, rng), points - eye[:, None])
        return camera[..., :2] / camera[..., 2:], camera[:, 0, 2]

    def _body(self, p_root: Array, R: Array, rng: Generator) -> Array:
        """Return the points (T, N, 3) in world on a body with varied bone lengths."""
        names = self.skeleton.names
        factor = 1 + self.settings.bone_scale * rng.standard_normal(len(names))
        factor = np.where([n.startswith("Left") for n in names], factor[self._other_joint], factor)
        offsets = self.skeleton.joint_offsets * np.clip(factor, 0.8, 1.2)[:, None]
        body = self._table.scaled_to(offsets).landmarks
        p = kinematics.positions(self.skeleton.parents, offsets, p_root, R)
        joints = [names.index(point.joint) for point in body]
        place = np.array([point.offset for point in body])
        place[self._still :] += self.settings.place * rng.standard_normal((len(place) - self._still, 3))
        points = p[:, joints] + np.einsum("tnij,nj->tni", R[:, joints], place)
        return np.concatenate([p, points], axis=1)

    def _tilts(self, count: int, rng: Generator) -> Array:
        """Return rotations (T, 3, 3) of the body about horizontal axes; most are none."""
        heading = rng.uniform(-np.pi, np.pi, count)
        angle = rng.uniform(0, self.settings.tilt, count)
        angle *= rng.random(count) < self.settings.tilt_share
        axis = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=-1)
        return so3.exp(axis * angle[:, None])

    def _axes(self, forward: Array, rng: Generator) -> Array:
        """Return R_camera_world (T, 3, 3) of nearly upright cameras with viewing directions (T, 3)."""
        forward = so3.unit(forward)
        right = so3.unit(np.cross(forward, [0.0, 0.0, 1.0]))
        upright = np.stack([right, np.cross(forward, right), forward], axis=-2)
        roll = self.settings.roll * rng.standard_normal(len(forward))
        return np.asarray(so3.exp(roll[:, None] * [0.0, 0.0, 1.0]) @ upright)
