"""What may be wrong about a declared camera: one list for the estimate, the self-calibration and errors of positions.

::

    focal length     f = (1 + y) declared                                1
    pitch, roll      R_camera_world = exp(y_1, 0, y_2) declared, about the centre: about the camera's x and z axes, rad
    height           z of the centre in world = declared + y             m
    distortion       k1 = declared + y                                   1
    size of the body, principal point to the right and down, heading     1, rad, rad, rad

The first five are estimated where a camera is not calibrated (`camera_estimate`). Heading about the world's vertical
and horizontal position are a choice of the world's axes then; with sensors a declared heading may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera, CameraUncertainty

FOCAL, PITCH, ROLL, HEIGHT, DISTORTION, SIZE, RIGHT, DOWN, HEADING = range(9)
_DEG: Final = float(np.radians(1.0))
STATED: Final = "state the accuracy of its calibration"
_MEASURED: Final = "measure the camera's height and give the floor's"


@dataclass(frozen=True)
class CameraUnknown:
    """One quantity that may be wrong."""

    name: str  # In sentences
    declared: float  # Standard deviation of what is declared without its accuracy
    remedy: str = STATED  # What makes it known; `STATED` is another one where the camera is not calibrated
    estimated: str = ""  # Name where it is estimated; empty for what is not


CAMERA_UNKNOWNS: Final = (
    # Between a calibration and an unknown phone (0.15), as videos are cropped, zoomed and stabilised.
    CameraUnknown(
        "the focal length",
        0.12,
        f"{STATED}, or walk two metres towards the camera with sensors on thighs and shanks",
        "focal length",
    ),
    CameraUnknown("the camera's tilt", 2 * _DEG, _MEASURED, "pitch"),
    CameraUnknown("the camera's roll", 2 * _DEG, _MEASURED, "roll"),
    CameraUnknown("the height of camera or floor", 0.05, _MEASURED, "height over the floor"),
    CameraUnknown("the distortion", 0.0, estimated="distortion k1"),
    CameraUnknown("the size of the body", 0.04, "give the person's height"),
    CameraUnknown("the principal point", 0.02),
    CameraUnknown("the principal point", 0.02),
    CameraUnknown("the camera's heading", 3 * _DEG, _MEASURED),
)
UNKNOWNS: Final = tuple(unknown.estimated for unknown in CAMERA_UNKNOWNS if unknown.estimated)
"""The five that are estimated."""


def sigma_of(own: CameraUncertainty | None) -> Array:
    """Return standard deviations (9,) by the order above; 0 for what they do not say, or is known."""
    own, sigma = own or CameraUncertainty(), np.zeros(len(CAMERA_UNKNOWNS))
    roll = own.tilt if own.roll is None else own.roll
    sigma[: len(UNKNOWNS)] = own.focal, own.tilt, roll, own.height, own.k1
    return sigma


def refocused(camera: Camera, y: float) -> Camera:
    """Return a camera whose focal length is 1 + y times as long."""
    K = camera.K.copy()
    K[:2, :2] *= 1 + y
    return replace(camera, K=K)


def turned(camera: Camera, y: Array, rise: float = 0.0) -> Camera:
    """Return a camera turned about its centre by y (3,), rad, in its own axes, and raised by `rise` along z, m."""
    R, centre = so3.exp(y) @ camera.R_camera_world, camera.center_world + np.array([0.0, 0.0, rise])
    return replace(camera, R_camera_world=R, t_camera_world=-R @ centre)


def corrected(camera: Camera, y: Array) -> Camera:
    """Return a camera corrected by y (5,), its `UNKNOWNS`."""
    distortion = camera.distortion.copy()
    distortion[0] += y[DISTORTION]
    camera = refocused(replace(camera, distortion=distortion), y[FOCAL])
    return turned(camera, np.array([y[PITCH], 0.0, y[ROLL]]), y[HEIGHT])


def pitch_and_roll(camera: Camera) -> tuple[float, float]:
    """Return how far a camera, in a world with z up, looks down, and how far its right side is down, rad."""
    right, _, forward = camera.R_camera_world
    return float(-np.arcsin(np.clip(forward[2], -1, 1))), float(-np.arcsin(np.clip(right[2], -1, 1)))


def displacements(camera: Camera, p_world: Array) -> Array:
    """Return by how much points (..., 3), m, are off per unit of each unknown (..., 3, 9), m; 0 for the distortion."""
    right, down, forward = camera.R_camera_world
    away = p_world - camera.center_world
    depth, up = (away @ forward)[..., None], np.array([0.0, 0.0, 1.0])
    out = np.zeros((*away.shape, len(CAMERA_UNKNOWNS)))
    out[..., FOCAL], out[..., SIZE] = -depth * forward, -away
    out[..., RIGHT], out[..., DOWN] = depth * right, depth * down
    for unknown, axis in ((PITCH, right), (HEADING, up), (ROLL, forward)):
        out[..., unknown] = np.cross(axis, away)
    out[..., HEIGHT] = -up
    return out
