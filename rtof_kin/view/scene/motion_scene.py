"""`MotionScene`: a motion of the disk with its measurements, truth and a second motion, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.keypoints import Measurements
from rtof_kin.view.provenance_colours import PALETTE
from rtof_kin.view.scene.block_cache import BlockCache
from rtof_kin.view.scene.block_content import BlockContent, block_content
from rtof_kin.view.scene.camera_layer import DEPTH, CameraBlock, CameraLayer, camera_block
from rtof_kin.view.scene.layers import PathLayer
from rtof_kin.view.scene.measurement_blocks import MeasurementBlocks
from rtof_kin.view.scene.motion_blocks import MotionBlocks
from rtof_kin.view.scene.people import SECOND, TRUTH, Companion, Person, SensorBlock, Sensors
from rtof_kin.view.scene.stage import Stage

_PATH_S: Final = 60.0
"""[s] of the root's path before and after the frame."""
_PATH_BLOCK_S: Final = 30.0
_PATH_POINTS: Final = 1500
_SAME_TIME: Final = 0.05
"""[s] By which times of two motions may differ for one frame."""
_BEHIND: Final = 1.25, 0.8
"""Depth of the image behind the person: relative to the person's distance, and added, m."""


class Layer(Enum):
    """Part of the scene that can be hidden, by its label."""

    SEGMENTS = "segments"
    AXES = "joint axes"
    CONFIDENCE = "95 % ellipsoids"
    SENSORS = "sensors"
    CAMERAS = "cameras"
    IMAGE = "video frame"
    DETECTED = "detected points"
    REPROJECTED = "reprojected joints"
    PATH = "root path"
    FLOOR = "floor"
    TRUTH = "truth"
    SECOND = "second motion"


@dataclass(frozen=True)
class SceneBlock:
    """Everything that is drawn in a block of frames."""

    motion: BlockContent
    truth: BlockContent | None
    second: BlockContent | None
    sensors: SensorBlock | None
    cameras: tuple[CameraBlock, ...]
    video_times: tuple[Array, ...]
    """(n,) s of each camera's video."""


class MotionScene:
    """Scene of a motion; `show` is called by one thread.

    Attributes:
        layers: parts that this scene has. cameras: in it. person: the motion.
    """

    def __init__(
        self,
        server: Any,
        motion: MotionBlocks,
        measurements: MeasurementBlocks | None = None,
        second: MotionBlocks | None = None,
    ):
        """Add everything to the scene; nothing is shown before `show`.

        Raises:
            InvalidInputError: the measurements are of another motion. FileFormatError: a damaged file.
        """
        if measurements is not None and len(measurements) != len(motion):
            raise InvalidInputError(
                f"{measurements.path}: has {len(measurements)} frames, the motion {len(motion)}; reconstruct again"
            )
        self._server, self._motion, self._measurements, self._second = server, motion, measurements, second
        given = None if measurements is None else measurements.first
        start = motion.frames(0, min(len(motion), motion.available, 60))
        self.stage = Stage(server, start.poses, motion.skeleton, given)
        self.person = Person(server, "/world/motion", motion.skeleton, start.confidence is not None)
        self._path = PathLayer(server, "/world/motion/root path")
        self.sensors: Sensors | None = None
        self.truth: Companion | None = None
        self.second: Companion | None = None
        self.cameras: list[CameraLayer] = []
        if given is not None:
            self._add_measurements(given)
        if second is not None:
            self.second = Companion(server, "/world/second motion", second.skeleton, SECOND)
        self.layers = self._handles(start.confidence is not None)
        self.behind: int | None = None
        """Camera through which one looks: its image is behind the person."""
        self._blocks = BlockCache(len(motion), self._available, self._compute)
        self._paths = BlockCache(
            len(motion), self._path_available, self._compute_path, int(_PATH_BLOCK_S * motion.rate_hz) + 1
        )
        self._path_shown: Any = None

    def show(self, frame: int, seconds: float = 0.0) -> SceneBlock | None:
        """Show a frame; return its block, or None while it is being read.

        Raises:
            RtofError: it cannot be read.
        """
        found = self._blocks.at(frame, seconds)
        if found is None:
            return None
        block, i = found
        with self._server.atomic():
            self.person.show(block.motion, i)
            if self.sensors is not None and block.sensors is not None:
                self.sensors.show(block.sensors, i)
            for companion, content in ((self.truth, block.truth), (self.second, block.second)):
                if companion is not None and content is not None:
                    companion.body.show(content, i)
            for number, (layer, camera) in enumerate(zip(self.cameras, block.cameras, strict=True)):
                layer.show(camera, i, self._depth(number, block.motion.p_root[i]))
            self._show_path(frame)
            self.stage.follow(block.motion.p_root[i])
        self._server.flush()  # else two frames may wait for each other
        return block

    def set_visible(self, layer: Layer, visible: bool) -> None:
        """Show or hide a layer.

        Args:
            layer: of `layers`.
        """
        part = {
            Layer.CAMERAS: "frustum",
            Layer.IMAGE: "image",
            Layer.DETECTED: "detected",
            Layer.REPROJECTED: "reprojected",
        }.get(layer)
        with self._server.atomic():
            for handle in self.layers[layer]:
                if part is None:
                    handle.visible = visible
                else:
                    handle.set_visible(part, visible)

    def put_beside(self, distance: float) -> None:
        """Put the truth and the second motion beside the motion, at its left and right as the viewer sees.

        Args:
            distance: m; 0: in the same place.
        """
        for companion, sign in ((self.truth, 1.0), (self.second, -1.0)):
            if companion is not None:
                companion.stand(sign * distance * self.stage.sideways)

    def close(self) -> None:
        """Stop computing blocks."""
        self._blocks.close()
        self._paths.close()

    # --- parts of the scene ----------------------------------------------------------------------

    def _add_measurements(self, given: Measurements) -> None:
        if given.sensors:
            self.sensors = Sensors(self._server, "/world/motion/sensors", self._motion.skeleton, given)
        for number, view in enumerate(given.views, start=1):
            label = f"camera {number}" if len(given.views) > 1 else "camera"
            if view.camera.stabilised and view.turning is None:
                label += " (handheld: its mean orientation)"
            elif view.turning is not None:
                label += " (handheld)"
            if view.camera.assumed:
                label += f" (assumed: {', '.join(view.camera.assumed)})"
            self.cameras.append(CameraLayer(self._server, f"/world/camera {number}", view, label))
        if given.truth is not None:
            self.truth = Companion(self._server, "/world/truth", self._motion.skeleton, TRUTH)

    def _handles(self, confidence: bool) -> dict[Layer, list[Any]]:
        person = self.person
        out: dict[Layer, list[Any]] = {
            Layer.SEGMENTS: [person.body.handle],
            Layer.AXES: [person.axes.handle],
            Layer.PATH: [self._path.handle],
            Layer.FLOOR: [self.stage.floor],
        }
        if confidence and person.ellipsoids is not None:
            out[Layer.CONFIDENCE] = [person.ellipsoids.handle]
        if self.sensors is not None:
            out[Layer.SENSORS] = [self.sensors.layer.boxes, self.sensors.layer.axes]
        if self.cameras:
            parts = (Layer.CAMERAS, Layer.IMAGE, Layer.DETECTED, Layer.REPROJECTED)
            out |= {layer: list(self.cameras) for layer in parts}
        for layer, companion in ((Layer.TRUTH, self.truth), (Layer.SECOND, self.second)):
            if companion is not None:
                out[layer] = [companion.body.handle]
        return out

    def _depth(self, camera: int, p_root: Array) -> float:
        if camera != self.behind or not np.isfinite(p_root).all():
            return DEPTH
        distance = float(np.linalg.norm(p_root - self.cameras[camera].center))
        return _BEHIND[0] * distance + _BEHIND[1]

    # --- blocks ----------------------------------------------------------------------------------

    def _available(self) -> int:
        frames = self._motion.available
        if self._measurements is not None:
            frames = min(frames, self._measurements.available)
        if self._second is not None and (known := self._second.available) < len(self._second):
            last = self._second.times[known - 1] if known else -np.inf
            frames = min(frames, int(np.searchsorted(self._motion.times, last)))
        return frames

    def _compute(self, start: int, stop: int) -> SceneBlock:
        motion = self._motion.frames(start, stop)
        skeleton, poses = motion.skeleton, motion.poses
        content = block_content(poses, skeleton, self.person.solids, start, motion.confidence)
        truth = sensors = None
        cameras: list[CameraBlock] = []
        video_times: list[Array] = []
        if self._measurements is not None:
            given = self._measurements.frames(start, stop)
            if self.truth is not None and given.truth is not None:
                truth = block_content(given.truth, skeleton, self.truth.solids, start)
            if self.sensors is not None:
                sensors = self.sensors.place(poses, given)
            cameras = [camera_block(view, poses.p_world_joint) for view in given.views]
            video_times = [view.video_times for view in given.views]
        second = self._of_second(poses.times, start)
        return SceneBlock(content, truth, second, sensors, tuple(cameras), tuple(video_times))

    def _of_second(self, times: Array, start: int) -> BlockContent | None:
        """Return the second motion at the times of a block, not shown where it has no frame then."""
        if self._second is None or self.second is None:
            return None
        at = np.array([self._second.frame_at(time) for time in times])
        first, last = int(at.min()), int(at.max())
        found = self._second.frames(first, last + 1)
        content = block_content(found.poses, found.skeleton, self.second.solids, start)
        index = at - first
        arrays: dict[str, Any] = {
            field.name: value[index]
            for field in fields(content)
            if isinstance(value := getattr(content, field.name), np.ndarray)
        }
        far = np.abs(self._second.times[at] - times) > _SAME_TIME
        arrays["shown"] = arrays["shown"] * ~far[:, None]
        return replace(content, **arrays)

    # --- path ------------------------------------------------------------------------------------

    def _path_available(self) -> int:
        margin = 0 if self._motion.available == len(self._motion) else int(_PATH_S * self._motion.rate_hz)
        return max(self._motion.available - margin, 0)

    def _compute_path(self, start: int, stop: int) -> tuple[Array, NDArray[np.uint8]]:
        margin = int(_PATH_S * self._motion.rate_hz)
        start, stop = max(start - margin, 0), min(stop + margin, len(self._motion))
        p, provenance = self._motion.thinned_root(start, stop, max((stop - start) // _PATH_POINTS, 1))
        return p, PALETTE[provenance]

    def _show_path(self, frame: int) -> None:
        found = self._paths.at(frame)
        if found is not None and found[0] is not self._path_shown:
            self._path_shown = found[0]
            self._path.show(*found[0])
