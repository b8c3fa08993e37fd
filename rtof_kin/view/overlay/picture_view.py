"""Views that a motion is drawn in: a camera of its recording, or a virtual one in front of the person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera

Frames = NDArray[np.int_]
_SIZE: Final = (1280, 720)  # [px] of a virtual camera's picture
_FOCAL_PX: Final = 1400.0
_CLOSER: Final = 0.78125
"""Distance of the camera, over that at which a sphere around all points just fits into the picture: people
are narrower than the sphere."""
_STANDS: Final = 2.5  # [m] largest radius of a motion that is seen whole; a larger one is followed


class PictureView(Protocol):
    """A view with the frames of a motion, e.g. `KeypointSequence` of `Measurements`."""

    @property
    def camera(self) -> Camera:
        """With the size of the upright image."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """L names of the detected landmarks."""
        ...

    @property
    def video_times(self) -> Array:
        """(T,) s of the motion's frames in the video's own time."""
        ...

    def project(self, p_world: Array, frames: Any) -> Array:
        """Project points (n, ..., 3) of frames (n,) to pixels of the upright video (n, ..., 2)."""
        ...

    def in_video(self, frames: Any) -> Array:
        """Return detected points (n, L, 2) in pixels of the upright video; NaN where not detected."""
        ...


@dataclass(frozen=True)
class VirtualView:
    """A camera that looks at the person from the front, for motions without a camera."""

    camera: Camera
    """The virtual camera."""
    video_times: Array
    """(T,) s, the motion's times."""
    moved: Array
    """(T, 3) m, subtracted from all points of a frame: the way of a person that is followed."""
    names: tuple[str, ...] = ()
    """Nothing is detected."""

    def project(self, p_world: Array, frames: Any) -> Array:
        """Project points to pixels (n, ..., 2).

        Args:
            p_world: (n, ..., 3) m. frames: (n,) of the motion.
        """
        moved = self.moved[np.asarray(frames)]
        return self.camera.project(p_world - moved.reshape(len(moved), *[1] * (p_world.ndim - 2), 3))

    def in_video(self, frames: Any) -> Array:
        """Return no points (n, 0, 2).

        Args:
            frames: (n,) of the motion.
        """
        return np.zeros((len(np.asarray(frames)), 0, 2))


def virtual_view(motion: Motion) -> VirtualView:
    """Return a camera in front of the person that sees all of the motion, or follows it where it is long.

    Raises:
        InvalidInputError: no frame of the motion has a pose.
    """
    p, R = motion.poses.p_world_joint, motion.poses.R_world_bone[:, 0]
    known: Mask = np.asarray(np.isfinite(p).all(axis=(1, 2)) & np.isfinite(R).all(axis=(1, 2)))
    if not known.any():
        raise InvalidInputError("overlay: no frame of the motion has a pose, so there is nothing to show")
    points = p[known]
    middle = (points.min(axis=(0, 1)) + points.max(axis=(0, 1))) / 2
    moved = np.zeros((len(p), 3))
    if float(np.linalg.norm(points - middle, axis=-1).max()) > _STANDS:
        root = p[:, 0] * (1.0, 1.0, 0.0)
        moved = np.where(known[:, None], root, 0.0)
        points = points - moved[known, None]
        middle = (points.min(axis=(0, 1)) + points.max(axis=(0, 1))) / 2
    ahead = R[known, :, 0].sum(axis=0) * (1.0, 1.0, 0.0)
    norm = float(np.linalg.norm(ahead))
    ahead = ahead / norm if norm > 1e-3 else np.array([1.0, 0.0, 0.0])
    camera = _distant_enough(points, middle, ahead)
    return VirtualView(camera, motion.times, moved)


def _distant_enough(points: Array, middle: Array, ahead: Array) -> Camera:
    """Return the camera in the direction `ahead` at a distance from which all points are seen."""
    radius = float(np.linalg.norm(points - middle, axis=-1).max())
    distance = radius + _CLOSER * radius * 2 * _FOCAL_PX / min(_SIZE)
    position = middle + distance * ahead + np.array([0.0, 0.0, 0.1 * distance])
    return Camera.looking_at(position, middle, _FOCAL_PX, *_SIZE)


@dataclass(frozen=True)
class ScaledView:
    """A view in a picture of another size."""

    view: PictureView
    """Of the recorded size."""
    scale: float
    """Pixels of the picture per pixel of the view's image."""
    width_px: int
    """Width of the picture, px."""
    height_px: int
    """Height of the picture, px."""
    video_times: Array
    """(T,) s of the motion's frames, on the clock of the pictures."""

    @property
    def camera(self) -> Camera:
        """The camera with the size of the picture; its other fields are unchanged."""
        return replace(self.view.camera, width_px=self.width_px, height_px=self.height_px)

    @property
    def names(self) -> tuple[str, ...]:
        """See `PictureView`."""
        return self.view.names

    def project(self, p_world: Array, frames: Any) -> Array:
        """Project points to pixels (n, ..., 2) of the picture.

        Args:
            p_world: (n, ..., 3) m. frames: (n,) of the motion.
        """
        return self._scaled(self.view.project(p_world, frames))

    def in_video(self, frames: Any) -> Array:
        """Return detected points (n, L, 2) in the picture.

        Args:
            frames: (n,) of the motion.
        """
        return self._scaled(self.view.in_video(frames))

    def _scaled(self, uv: Array) -> Array:
        """The first pixel's centre is (0, 0) in both pictures."""
        return (uv + 0.5) * self.scale - 0.5
