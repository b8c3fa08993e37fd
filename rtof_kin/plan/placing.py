"""Where camera and sensors are placed, in numbers and in words for the operator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence

_PLACES: Final = {
    "Head": "forehead, on a headband",
    "Spine3": "breastbone",
    "Hips": "back of the pelvis, on the sacrum",
    "ForeArm": "back of the {side} forearm just above the wrist, as a watch",
    "Arm": "outside of the {side} upper arm, lower third, away from the biceps",
    "UpLeg": "outside of the {side} thigh, upper third",
    "Leg": "flat inner face of the {side} shin, upper half",
    "Foot": "back of the {side} foot, on the laces",
}
"""End of a joint's name -> where its segment's sensor goes, as in docs/sensor_placement.md."""


@dataclass(frozen=True)
class Framing:
    """Place of a camera relative to a movement."""

    distance: float
    """[m] horizontal, from the middle of the pelvis' path."""
    height: float
    """[m] over the floor."""
    angle_deg: float
    """Direction of the camera from that middle, from the person's facing at the start: 0 in front, 90 to the
    person's left, -90 to the right."""
    tilt_deg: float
    """Of the optical axis, downwards."""
    field_deg: tuple[float, float]
    """Horizontal and vertical field of view."""
    middle: Array
    """(2,) m, of the pelvis' path."""
    inside: float
    """Share of frames with all landmarks in the picture."""
    margin: float
    """Least distance of a landmark from the border over all frames, share of the picture's height; negative
    outside, NaN where a landmark is behind the camera."""

    @property
    def side(self) -> str:
        """Direction in words."""
        size = abs(self.angle_deg)
        if size < 5:
            return "straight in front of the person"
        if size > 175:
            return "straight behind the person"
        side = "left" if self.angle_deg > 0 else "right"
        return f"{size:.0f}° to the person's {side} of straight ahead"

    @property
    def view(self) -> str:
        """What the picture shows, in words."""
        if self.inside < 1:
            return (
                f"the whole body is in the picture only {100 * self.inside:.0f} % of the time: move the "
                "camera back or aim it better"
            )
        return f"the whole body stays in the picture, with {100 * self.margin:.0f} % of its height to spare"


def framing(poses: PoseSequence, skeleton: SkeletonModel, camera: Camera) -> Framing:
    """Return where a camera stands relative to a movement, and whether it sees all of it.

    Args:
        poses: of the movement, finite, on the floor z = 0.
    """
    distance, height, angle_deg = stand_of(camera, poses)
    axis = camera.R_camera_world[2]
    uv = camera.project(skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone))
    size = np.array([camera.width_px, camera.height_px])
    least = np.minimum(uv, size - uv).min(axis=(1, 2)) / camera.height_px
    fields = 2 * np.arctan(size / 2 / np.diag(camera.K)[:2])
    return Framing(
        distance=distance,
        height=height,
        angle_deg=angle_deg,
        tilt_deg=float(np.degrees(np.arcsin(np.clip(-axis[2], -1, 1)))),
        field_deg=(float(np.degrees(fields[0])), float(np.degrees(fields[1]))),
        middle=centre_of(poses)[:2],
        inside=float(np.mean(least >= 0)),
        margin=float(least.min()),
    )


def stand_of(camera: Camera, poses: PoseSequence) -> tuple[float, float, float]:
    """Return a camera's horizontal distance from the middle of a movement, m, its height, m, and its
    direction from there, deg from the person's facing at the start, positive to the left.

    Args:
        poses: of the movement, pelvis first.
    """
    way = camera.center_world[:2] - centre_of(poses)[:2]
    angle = np.degrees(np.arctan2(way[1], way[0]) - facing_of(poses))
    return float(np.hypot(*way)), float(camera.center_world[2]), float((angle + 180) % 360 - 180)


def centre_of(poses: PoseSequence) -> Array:
    """Return the middle (3,) m of a movement: of the pelvis' path on the floor, and of the body's height.

    Args:
        poses: of the movement, pelvis first.
    """
    path, heights = poses.p_world_joint[:, 0, :2], poses.p_world_joint[..., 2]
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    return np.array([*middle, (heights.min() + heights.max()) / 2])


def facing_of(poses: PoseSequence) -> float:
    """Return the heading of the pelvis in the first frame, rad from world's x.

    Args:
        poses: of the movement, pelvis first.
    """
    return float(so3.heading(poses.R_world_bone[:1, 0])[0])


def sensor_places(skeleton: SkeletonModel, sensors: Sequence[str]) -> dict[str, str]:
    """Return where to strap each sensor, in words: name -> "outside of the left thigh, upper third".

    Raises:
        UnknownNameError: a sensor that it does not have.
    """
    indices_of("sensor", sensors, list(skeleton.sensors))
    return {name: _place(skeleton.sensors[name][0]) for name in sensors}


def _place(joint: str) -> str:
    side = "left" if joint.startswith("Left") else "right"
    return next(words for end, words in _PLACES.items() if joint.endswith(end)).format(side=side)
