"""Floor, world axes and first view of a scene, and how it follows a person."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.keypoints import Measurements
from rtof_kin.data.poses import PoseSequence

WORLD: Final = "/world"
"""Node that all others are in; it is moved to follow a person."""
_DISTANCE: Final = 3.4
"""[m] of the first view from the person."""
_ASIDE: Final = np.radians(52.0)
"""[rad] Direction of the first view from the person, away from that to the camera or from where the person faces."""
_HIGH: Final = 1.5
"""[m] of the first view above the floor."""
_MIDDLE: Final = 0.9
"""[m] of the point that is looked at above the floor."""
_VIEW: Final = np.radians(50.0)
"""[rad] Vertical angle of the first view."""


class Stage:
    """Floor and world of a scene.

    Attributes:
        floor: node of the floor. measured: whether its height was given with the measurements.
        following: whether the scene is moved so that the person stays in its middle.
        sideways: (3,) unit vector to the right in the first view.
    """

    def __init__(
        self,
        server: Any,
        poses: PoseSequence | None,
        skeleton: SkeletonModel | None = None,
        measurements: Measurements | None = None,
        floor: float | None = None,
    ):
        """Add floor and axes, and choose the first view.

        Args:
            poses: first frames of the motion.
            floor: height of the floor, m; default: that of the measurements, else the lowest point of the first
                frames.
        """
        self._server = server
        given = floor if measurements is None or floor is not None else measurements.floor_height
        self.measured = given is not None
        self.height = given if given is not None else _lowest(poses, skeleton)
        scene = server.scene
        self.world = scene.add_frame(WORLD, show_axes=False)
        self.floor = scene.add_grid(
            f"{WORLD}/floor",
            infinite_grid=True,
            cell_size=0.25,
            section_size=1.0,
            fade_distance=14.0,
            cell_color=(222, 222, 226),
            section_color=(186, 186, 194),
            shadow_opacity=0.0,
            position=(0.0, 0.0, self.height),
        )
        scene.add_frame(f"{WORLD}/origin", axes_length=0.25, axes_radius=0.006, position=(0.0, 0.0, self.height))
        scene.world_axes.visible = False
        _light(scene)
        self.following = True
        self._at = np.zeros(3)
        self.first_view(poses, measurements)

    def first_view(self, poses: PoseSequence | None, measurements: Measurements | None) -> None:
        """Look at the person from the side of the camera, or of the face."""
        direction, distance = -_ASIDE, _DISTANCE
        if poses is not None and np.isfinite(poses.p_world_joint[0, 0]).all():
            self.follow(poses.p_world_joint[0, 0])
            if np.isfinite(poses.R_world_bone[0, 0]).all():
                direction += float(so3.heading(poses.R_world_bone[0, 0]))
            if measurements is not None and measurements.views:
                away = measurements.views[0].camera.center_world - poses.p_world_joint[0, 0]
                direction = float(np.arctan2(away[1], away[0])) - _ASIDE
        camera = self._server.initial_camera
        middle = np.array([0.0, 0.0, self.height + _MIDDLE])
        camera.fov = _VIEW
        camera.position = distance * np.array([np.cos(direction), np.sin(direction), 0.0]) + np.array(
            [0.0, 0.0, self.height + _HIGH]
        )
        camera.look_at = middle
        self.sideways = np.array([-np.sin(direction), np.cos(direction), 0.0])

    def follow(self, p_root: Array) -> None:
        """Move the scene so that a person stands in its middle, or to where it belongs.

        Args:
            p_root: (3,) m; where it is missing the scene stays.
        """
        if not self.following:
            self._at = np.zeros(3)
        elif np.isfinite(p_root).all():
            self._at = np.array([-p_root[0], -p_root[1], 0.0])
        self.world.position = self._at


def _light(scene: Any) -> None:
    """Light the scene from above and the sides, without maps and shadows, which weak machines cannot draw."""
    scene.configure_environment_map(hdri=None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_hemisphere("/lights/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=1.5)
    for number, place in enumerate(((3.0, -2.0, 6.0), (-4.0, 3.0, 4.0))):
        scene.add_light_directional(
            f"/lights/lamp {number + 1}", intensity=(1.5, 0.5)[number], position=place, cast_shadow=False
        )


def _lowest(poses: PoseSequence | None, skeleton: SkeletonModel | None) -> float:
    """Return the lowest point of a motion, m; 0 if it has none."""
    if poses is None or skeleton is None:
        return 0.0
    points = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    return float(np.nanmin(points[..., 2])) if np.isfinite(points).any() else 0.0
