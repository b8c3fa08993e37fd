"""Camera placements, none of which a lifter was trained with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence

FOCAL_PX = 1250.0


@dataclass(frozen=True)
class Placement:
    """A camera's place around a motion; it looks at the middle of the root's path."""

    name: str
    height: float
    """Over the floor, m."""
    distance: float
    """From the nearest point of the root's path, on the floor, m."""
    azimuth: float
    """Direction from the middle of the path to the camera, against x of the world, deg."""

    def camera(self, poses: PoseSequence) -> Camera:
        """1920 x 1080, f = 1250 px."""
        root = poses.p_world_joint[:, 0]
        middle = (root.min(axis=0) + root.max(axis=0)) / 2
        angle = np.radians(self.azimuth)
        away = np.array([np.cos(angle), np.sin(angle)])
        position = middle[:2] + _clearance(root[:, :2] - middle[:2], away, self.distance) * away
        return Camera.looking_at([*position, self.height], middle, FOCAL_PX)


def _clearance(path: Array, away: Array, distance: float) -> float:
    """Distance to move so that no point of a path (T, 2), beside or behind, is nearer than a distance."""
    ahead = path @ away
    beside = path[:, 0] * away[1] - path[:, 1] * away[0]
    near = np.abs(beside) < distance
    return float(np.max(ahead[near] + np.sqrt(distance**2 - beside[near] ** 2), initial=distance))


PLACEMENTS = (
    Placement("eye height, 4 m", 1.6, 4.0, 25.0),
    Placement("low, 4 m", 0.4, 4.0, 115.0),
    Placement("high, 4 m", 3.0, 4.0, 205.0),
    Placement("close, 2 m", 1.6, 2.0, 295.0),
)
