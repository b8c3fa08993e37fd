"""A camera in the scene: its frustum, the image of the video in it, detected points and reprojected joints.

All of it lies in one plane at some depth before the camera, so that a line from the camera's centre through
a point meets the joint. Pixels are placed as if the lens had no distortion, like those of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.packages import optional
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.view.canvas import Image, resized
from rtof_kin.view.legend import DETECTED, REPROJECTED
from rtof_kin.vision.video_metadata import open_video, slow_motion, upright_image

HEIGHT: Final = 360  #: [px] Largest height of the images
_AHEAD: Final = 2.0  # [s] Up to which images are decoded one after the other instead of sought
_ROUNDING: Final = 0.004  # [s] By which a stamp may be before that of its image
DEPTH: Final = 0.6  #: [m] of the image before the camera
_EDGES: Final = (40, 40, 48)
_POINT: Final = 0.009  # Size of a point relative to the depth
_BEHIND: Final = 1.003  # Depth of the image relative to that of the points


class VideoFrames(AbstractContextManager["VideoFrames"]):
    """Decodes the image that was asked for last: the last one at or before a time, in a thread."""

    def __init__(self, path: str | Path, receive: Callable[[Image], None]):
        """Open the video; end it with `close`. `receive`: called in the thread with (height, width, 3) RGB images.
        `FileFormatError`: not a readable video, or one without times; `RtofError`: the extra is missing.
        """
        self.path, self._receive = Path(path), receive
        self.problem: RtofError | None = None
        with ExitStack() as failed:
            self._container, self._stream = failed.enter_context(open_video(self.path))
            self._stream.thread_type = "AUTO"
            self._frames: Iterator[Any] = self._container.decode(self._stream)
            self._held = next(self._frames, None)
            if self._held is None or self._held.time is None:
                raise FileFormatError(self.path, "has no times of its images; convert it first")
            self._first = float(self._held.time)
            self._slowed = slow_motion(self._container, self._stream)
            self.size = upright_image(self._held, self._stream).shape[1::-1]
            self._closing = failed.pop_all()
        self._next: Any = None
        self._shown: Any = None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=f"images of {self.path.name}")
        self._requested: Future[None] | None = None

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self._worker.shutdown(cancel_futures=True)
        self._closing.close()

    def request(self, time: float) -> None:
        """Ask for the image at a time; an earlier request that waits is dropped.

        `time`: s since the first frame, real time, as `KeypointSequence.video_times`.
        """
        if self._requested is not None:
            self._requested.cancel()
        self._requested = self._worker.submit(self._show, self._first + time * self._slowed + _ROUNDING)

    def _show(self, stamp: float) -> None:
        """Give the image that is shown at a stamp, unless it is the one given last."""
        av, held = optional("av", "video"), self._held
        try:
            if held is None or not held.time <= stamp <= held.time + _AHEAD:
                self._container.seek(int(stamp / self._stream.time_base), stream=self._stream, backward=True)
                self._frames, self._held, self._next = self._container.decode(self._stream), None, None
            try:
                self._advance(stamp)
            except (av.InvalidDataError, av.EOFError):
                self._frames = iter(())
            if self._held is not None and self._held is not self._shown:
                self._shown = self._held
                self._receive(_small(upright_image(self._held, self._stream)))
        except av.FFmpegError as error:
            self.problem = FileFormatError(self.path, f"cannot be read any more ({error})")

    def _advance(self, stamp: float) -> None:
        while True:
            if self._next is None:
                self._next = next((f for f in self._frames if f.time is not None), None)
            if self._next is None or (self._held is not None and self._next.time > stamp + 1e-6):
                return
            self._held, self._next = self._next, None


def _small(image_bgr: Image) -> Image:
    """Return an image of at most `HEIGHT`, RGB."""
    height, width = image_bgr.shape[:2]
    part = min(1.0, HEIGHT / height)
    return np.ascontiguousarray(resized(image_bgr, (round(part * width), round(part * height)))[..., ::-1])


@dataclass(frozen=True)
class CameraBlock:
    """Points and pose of one camera in the frames of a block."""

    R_world_camera: Array  #: (n, 3, 3) of the video's camera; NaN where a handheld one's is unknown
    detected: Array  #: (n, L, 3) points at depth 1 in camera axes; NaN where missing
    reprojected: Array  #: (n, J, 3) joints of the motion at depth 1 in camera axes; NaN where missing
    video_times: Array  #: (n,) s of the video


def video_camera(view: KeypointSequence) -> Camera:
    """Return the camera whose images the video has, with the pose of the mean orientation."""
    return view.camera if view.turning is None else view.turning.camera


def camera_block(view: KeypointSequence, p_world: Array) -> CameraBlock:
    """Return what is drawn of a camera. `p_world`: (n, J, 3) m, joints of the motion in them."""
    camera, frames = video_camera(view), np.arange(len(view))
    R_world_still = view.camera.R_camera_world.T
    R = np.broadcast_to(R_world_still, (len(view), 3, 3))
    if view.turning is not None:
        R = R_world_still @ view.turning.R_still_camera
    detected, joints = (_at_depth_one(camera, uv) for uv in (view.in_video(frames), view.project(p_world, frames)))
    return CameraBlock(R, detected, joints, view.video_times)


def _at_depth_one(camera: Camera, uv_px: Array) -> Array:
    """Return points (..., 3) of the image plane at depth 1; NaN outside the image."""
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        inside = ((uv_px >= 0) & (uv_px <= size)).all(axis=-1, keepdims=True)
    uv = np.where(inside, uv_px, np.nan)
    xy = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


class CameraLayer:
    """Frustum of one camera with its image and points."""

    def __init__(self, server: Any, name: str, view: KeypointSequence, label: str):
        """Add the camera to the scene. `view`: any frames of the camera."""
        self.camera = video_camera(view)
        self.center = view.camera.center_world
        self._depth = DEPTH
        corners = self._corners()
        edges = [(np.zeros(3), corner) for corner in corners]
        edges += [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
        scene = server.scene
        self.edges = scene.add_line_segments(
            f"{name}/frustum", np.array(edges, dtype=np.float32), _EDGES, thickness=1.5, thickness_units="screen"
        )
        points = {"detected": (DETECTED, "circle", 1.0), "reprojected": (REPROJECTED, "diamond", 0.8)}
        self.points = {
            what: scene.add_point_cloud(
                f"{name}/{what}",
                np.zeros((0, 3), dtype=np.float32),
                colour,
                point_size=size * _POINT,
                point_shape=shape,
                precision="float32",
                point_shading="flat",
            )
            for what, (colour, shape, size) in points.items()
        }
        self.label = scene.add_label(f"{name}/label", label, anchor="bottom-center")
        self.image: Any = None
        self._server, self._name, self._image_visible = server, name, True
        self.R_world_camera: Array = view.camera.R_camera_world.T
        """(3, 3) orientation that is shown."""
        self._show_pose(self.R_world_camera)

    @property
    def vertical_view(self) -> float:
        """Vertical angle of view, rad."""
        return 2 * float(np.arctan(self.camera.height_px / 2 / self.camera.K[1, 1]))

    def show(self, block: CameraBlock, i: int, depth: float = DEPTH) -> None:
        """Show one frame. `depth`: of the image before the camera, m."""
        self._depth = depth
        self._show_pose(block.R_world_camera[i])
        for what, points in (("detected", block.detected[i]), ("reprojected", block.reprojected[i])):
            seen = points[np.isfinite(points).all(axis=-1)]
            self.points[what].points = seen.astype(np.float32)

    def show_image(self, image: NDArray[np.uint8]) -> None:
        """Show an image in the frustum.

        `image`: (height, width, 3) RGB, of the whole upright video image at any size.
        """
        if self.image is None:
            camera = self.camera
            quat, position, depth = self._image_pose()
            self.image = self._server.scene.add_image(
                f"{self._name}/image",
                image,
                camera.width_px / camera.K[0, 0],
                camera.height_px / camera.K[1, 1],
                format="jpeg",
                cast_shadow=False,
                receive_shadow=False,
                visible=self._image_visible,
                wxyz=quat,
                position=position,
                scale=depth,
            )
        else:
            self.image.image = image

    def set_visible(self, what: str, visible: bool) -> None:
        """Show or hide a part."""
        if what == "image":
            self._image_visible = visible
            if self.image is not None:
                self.image.visible = visible
        elif what == "frustum":
            self.edges.visible = self.label.visible = visible
        else:
            self.points[what].visible = visible

    def _corners(self) -> list[Array]:
        """Return the four corners of the image at depth 1, in order around it."""
        w, h = self.camera.width_px, self.camera.height_px
        return [_at_depth_one(self.camera, np.array(uv, float)) for uv in ((0, 0), (w, 0), (w, h), (0, h))]

    def _show_pose(self, R_world_camera: Array) -> None:
        """Turn all parts; with an unknown orientation the camera keeps its last one."""
        if np.isfinite(R_world_camera).all():
            self.R_world_camera = R_world_camera
        quat, depth = so3.to_quat_wxyz(self.R_world_camera), self._depth
        for handle in (self.edges, *self.points.values()):
            handle.wxyz, handle.position = quat, self.center
            handle.scale = depth
        self.label.position = self.center + 0.06 * np.array([0, 0, 1.0])
        if self.image is not None:
            self.image.wxyz, self.image.position, self.image.scale = self._image_pose()

    def _image_pose(self) -> tuple[Array, Array, float]:
        """Return orientation, position and scale of the image, just behind the points."""
        middle = np.mean(self._corners(), axis=0)
        position = self.center + _BEHIND * self._depth * self.R_world_camera @ middle
        return so3.to_quat_wxyz(self.R_world_camera), position, self._depth
