"""Sensors worn in a training window, and the errors of their orientations.

Errors are constant over the half second of a window: misalignment of the calibration, roll by soft tissue
about the bone, heading of the sensor's reference frame, lag between camera and sensors. At amplitude 1 they
turn a limb's bone by 2.7 degrees and its segment about the bone by 4.7 degrees in the median, as measured on
real recordings; the camera's detections come 1-3 frames late.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lifting.body import Body
from lifting.draws import Draw, cross, rotation


@dataclass(frozen=True)
class SensorConfig:
    """Sets of sensors and sizes of errors; those of orientations are scaled by an amplitude per window."""

    none: float = 0.30
    """Share of windows without any sensor."""
    limbs: float = 0.30
    """Share of windows with sensors on upper arms, forearms, thighs and shanks."""
    limbs_and_trunk: float = 0.12
    """Share with these and sensors on pelvis and upper trunk."""
    ends: float = 0.08
    """Share with sensors on forearms and shanks."""
    every: float = 0.06
    """Share with all sensors; the rest have random subsets."""
    amplitude: tuple[float, float] = (0.2, 1.8)
    """Range of the factor on misalignment and roll."""
    misalignment: float = 0.037
    """Standard deviation about each axis of the segment, rad."""
    roll: float = 0.11
    """Standard deviation of the additional error about the bone, rad."""
    heading: float = 0.03
    """Standard deviation of a sensor's heading, rad."""
    lag: tuple[float, float] = (-1.0, 4.0)
    """Range of the lead of the sensors over the camera, frames."""
    missing: float = 0.03
    """Share of (frame, sensor) lost, in runs."""


TRUNK = ("Hips", "Spine3")
"""Segments of the pelvis and upper trunk sensors."""


def worn(body: Body, config: SensorConfig, draw: Draw) -> Tensor:
    """Draw the sensors of each window, (B, S) bool."""
    limbs = {j for limb in body.arms + body.legs for j in limb[:2]}
    ends = {limb[1] for limb in body.arms + body.legs}
    trunk = {body.names.index(name) for name in TRUNK if name in body.names}
    sets = [
        (config.none, set()),
        (config.limbs, limbs),
        (config.limbs_and_trunk, limbs | trunk),
        (config.ends, ends),
        (config.every, set(body.sensor_joints)),
    ]
    which = draw.uniform(draw.batch, 1)
    chance = draw.uniform(draw.batch, 1)
    mask = draw.uniform(draw.batch, len(body.sensors)) < chance
    below = 1.0
    for share, joints in sets:
        chosen = torch.tensor([j in joints for j in body.sensor_joints], device=draw.device)
        mask = torch.where((which < below) & (which >= below - share), chosen, mask)
        below -= share
    return mask


def with_errors(bones: Tensor, axes_world: Tensor, config: SensorConfig, draw: Draw) -> Tensor:
    """Return axes (B, 3, W, 2, S) as sensors measure them.

    Args:
        bones: (S, 3) unit vectors along the bones in their segments' frames, zero where there is none.
        axes_world: (B, 3, W, 2, S) true x and z axes of the segments.
    """
    B, S = draw.batch, len(bones)
    factor = draw.between(config.amplitude, B, 1, 1)
    turn = config.misalignment * draw.normal(B, S, 3)
    turn = factor * (turn + config.roll * draw.normal(B, S, 1) * bones)
    E = rotation(turn.reshape(-1, 3)).reshape(B, S, 3, 3)
    x, z = axes_world.unbind(dim=3)
    y = cross(z, x)

    def column(k: int) -> Tensor:
        a, b, c = (E[:, None, None, :, i, k] for i in range(3))
        return a * x + b * y + c * z

    reported = torch.stack([column(0), column(2)], dim=3)
    heading = (config.heading * draw.normal(B, S))[:, None, None]
    east, north, up = reported.unbind(dim=1)
    cos, sin = heading.cos(), heading.sin()
    return torch.stack([cos * east - sin * north, sin * east + cos * north, up], dim=1)
