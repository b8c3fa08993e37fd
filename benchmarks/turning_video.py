"""Turning of a hand, and videos of a background that a turning camera films."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera

_HEIGHT = 1400
_HALF_VIEW = np.radians(57.0)


def pan_and_shake(rng: np.random.Generator, times: Array, pan_deg: float = 18.0, shake_deg: float = 4.0) -> Array:
    """Rotations (T, 3, 3) from the camera to a middle orientation: a slow pan, and a shake of 1 to 3 Hz.

    Args:
        times: (T,) s. pan_deg, shake_deg: largest angles; the shake is shared out among three axes.
    """
    phase, period = rng.uniform(0, 2 * np.pi), rng.uniform(6.0, 9.0)
    rotvec = np.zeros((len(times), 3))
    rotvec[:, 1] = np.radians(pan_deg) * np.sin(2 * np.pi * times / period + phase)
    sizes = rng.normal(size=(4, 3)) * [0.7, 1.0, 0.5]
    sizes *= np.radians(shake_deg) / (0.7 * np.linalg.norm(sizes, axis=1).sum())  # all at once is rare
    waves = np.sin(2 * np.pi * times[:, None] * rng.uniform(1.0, 3.0, 4) + rng.uniform(0, 2 * np.pi, 4))
    return so3.exp(rotvec) @ so3.exp(waves @ sizes)


@lru_cache(maxsize=1)
def _wall(seed: int) -> NDArray[np.uint8]:
    """Random texture with coarse and fine patches."""
    rng, shape = np.random.default_rng(seed), (2 * _HEIGHT, _HEIGHT)
    coarse, fine = (cv2.resize(rng.random((_HEIGHT // n, 2 * _HEIGHT // n, 3)), shape) for n in (8, 2))
    return np.asarray(255 * (0.6 * coarse + 0.4 * fine)).astype(np.uint8)


def write_turning_video(
    path: Path, R_middle_camera: Array, camera: Camera, rate_hz: float, boxes: ArrayLike | None = None, seed: int = 0
) -> None:
    """Write a video of a distant wall of random texture, with a flickering box for the person.

    Args:
        path: .mp4. R_middle_camera: (T, 3, 3). camera: that films, without distortion. rate_hz: of frames.
        boxes: (T, 4) left, top, right, bottom of the person, px. seed: of the texture.
    """
    rng, wall = np.random.default_rng(seed), _wall(seed)
    size = camera.width_px, camera.height_px
    focal = _HEIGHT / np.tan(_HALF_VIEW)
    K_wall = np.array([[focal, 0, _HEIGHT], [0, focal, _HEIGHT / 2], [0, 0, 1]])
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate_hz, size)
    for t, R in enumerate(R_middle_camera):
        image = cv2.warpPerspective(wall, camera.K @ R.T @ np.linalg.inv(K_wall), size)
        if boxes is not None and np.isfinite(np.asarray(boxes)[t]).all():
            left, top, right, bottom = np.clip(np.asarray(boxes)[t], 0, max(size)).astype(int)
            person = image[top:bottom, left:right]
            person[:] = rng.integers(0, 255, (*person.shape[:1], 1, 3))
        film.write(image)
    film.release()
