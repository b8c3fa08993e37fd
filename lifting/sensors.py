"""Which sensors a window's person wears, and what is wrong with their orientations.

What is wrong hardly changes in the half second that a window lasts, so each error is drawn once a window:
the calibration's misalignment and the soft tissue's roll, most of it about the bone, the heading of the
sensor's own reference, a lag between camera and sensors. What drifts over tens of seconds is in there
too, as every window is another moment of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lifting.body import Body
from lifting.draws import Draw, cross, rotation


@dataclass(frozen=True)
class SensorConfig:
    """Which sensors there are, and sizes of errors; orientations' are multiplied by a factor drawn for
    each window.
    """

    none: float = 0.30
    """Share of windows without any sensor."""
    limbs: float = 0.30
    """Share with one on each upper arm, forearm, thigh and shank."""
    limbs_and_trunk: float = 0.12
    """Share with these and one on pelvis and upper trunk each."""
    ends: float = 0.08
    """Share with forearms and shanks alone."""
    every: float = 0.06
    """Share with all there may be; the rest wear any subset."""
    amplitude: tuple[float, float] = (0.2, 1.8)
    """Range of the factor on misalignment and roll."""
    misalignment: float = 0.06
    """Standard deviation about each axis of the segment, rad."""
    roll: float = 0.12
    """Standard deviation of what comes to it about the bone, rad."""
    heading: float = 0.05
    """Standard deviation of a sensor's heading, rad."""
    lag: tuple[float, float] = (-3.0, 6.0)
    """Range of the time by which sensors are ahead of the camera, frames."""
    missing: float = 0.03
    """Share of (frame, sensor) that is lost, in runs."""


TRUNK = ("Hips", "Spine3")
"""Segments of the pelvis' and the upper trunk's sensor."""


def worn(body: Body, config: SensorConfig, draw: Draw) -> Tensor:
    """(B, S) bool: the sensors of each window, by the shares of `SensorConfig` in random order."""
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
    """Axes (B, 3, W, 2, S) as sensors report them.

    Args:
        bones: (S, 3) unit vectors along the segments in their own frames, zero where there is no bone.
        axes_world: (B, 3, W, 2, S) true x and z axes of the segments.
        config: sizes of the errors.
        draw: of everything random.
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
