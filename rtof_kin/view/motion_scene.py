"""`MotionScene`: a motion of the disk with its measurements, truth and a second motion, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.keypoints import Measurements
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.measurements_file import MeasurementsReader
from rtof_kin.view.block_content import BlockContent, block_content
from rtof_kin.view.blocks import BlockCache, frame_at
from rtof_kin.view.camera_layer import DEPTH, CameraBlock, CameraLayer, camera_block
from rtof_kin.view.layers import Companion, Person, RootPath, SensorBlock, Sensors
from rtof_kin.view.legend import PALETTE, SECOND, TRUTH

WORLD: Final = "/world"  #: Node that all others are in; it is moved to follow a person
_DISTANCE: Final = 3.4  # [m] of the first view from the person
_ASIDE: Final = np.radians(52.0)
"""[rad] Direction of the first view from the person, away from that to the camera or from where the person faces."""
_HIGH: Final = 1.5  # [m] of the first view above the floor
_MIDDLE: Final = 0.9  # [m] of the point that is looked at above the floor
_VIEW: Final = np.radians(50.0)  # [rad] Vertical angle of the first view
_PATH_S: Final = 60.0  # [s] of the root's path before and after the frame
_PATH_BLOCK_S: Final = 30.0
_PATH_POINTS: Final = 1500
_SAME_TIME: Final = 0.05  # [s] By which times of two motions may differ for one frame
ELLIPSOIDS, IMAGE = "95 % ellipsoids", "video frame"  #: Labels of layers
_CAMERA_PARTS: Final = {
    "cameras": "frustum",
    IMAGE: "image",
    "detected points": "detected",
    "reprojected joints": "reprojected",
}
"""Label of a layer -> part of `CameraLayer`."""
_BEHIND: Final = 1.25, 0.8  # Depth of the image behind the person: relative to the person's distance, and added, m


class Stage:
    """Floor and world of a scene.

    Attributes:
        floor: node of the floor. measured: whether its height was given with the measurements.
        following: whether the scene is moved so that the person stays in its middle.
        sideways: (3,) unit vector to the right in the first view.
    """

    def __init__(self, server: Any, poses: PoseSequence, skeleton: SkeletonModel, measurements: Measurements | None):
        """Add floor and axes, and choose the first view. `poses`: first frames of the motion.

        The floor is that of the measurements, else at the lowest point of the first frames.
        """
        self._server = server
        given = None if measurements is None else measurements.floor_height
        self.measured = given is not None
        points = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)[..., 2]
        self.height = given if given is not None else float(np.nanmin(points)) if np.isfinite(points).any() else 0.0
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
        # Light from above and the sides, without maps and shadows, which weak machines cannot draw
        scene.configure_environment_map(hdri=None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere(
            "/lights/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=1.5
        )
        for number, intensity, place in ((1, 1.5, (3.0, -2.0, 6.0)), (2, 0.5, (-4.0, 3.0, 4.0))):
            scene.add_light_directional(
                f"/lights/lamp {number}", intensity=intensity, position=place, cast_shadow=False
            )
        self.following = True
        self._at = np.zeros(3)
        self._first_view(poses, measurements)

    def _first_view(self, poses: PoseSequence, measurements: Measurements | None) -> None:
        """Look at the person from the side of the camera, or of the face."""
        direction = -_ASIDE
        if np.isfinite(poses.p_world_joint[0, 0]).all():
            self.follow(poses.p_world_joint[0, 0])
            if np.isfinite(poses.R_world_bone[0, 0]).all():
                direction += float(so3.heading(poses.R_world_bone[0, 0]))
            if measurements is not None and measurements.views:
                away = measurements.views[0].camera.center_world - poses.p_world_joint[0, 0]
                direction = float(np.arctan2(away[1], away[0])) - _ASIDE
        camera = self._server.initial_camera
        camera.fov = _VIEW
        camera.position = np.array([_DISTANCE * np.cos(direction), _DISTANCE * np.sin(direction), self.height + _HIGH])
        camera.look_at = np.array([0.0, 0.0, self.height + _MIDDLE])
        self.sideways = np.array([-np.sin(direction), np.cos(direction), 0.0])

    def follow(self, p_root: Array) -> None:
        """Move the scene so that a person stands in its middle, or to where it belongs.

        `p_root`: (3,) m; where it is missing the scene stays.
        """
        if not self.following:
            self._at = np.zeros(3)
        elif np.isfinite(p_root).all():
            self._at = np.array([-p_root[0], -p_root[1], 0.0])
        self.world.position = self._at


@dataclass(frozen=True)
class SceneBlock:
    """Everything that is drawn in a block of frames."""

    motion: BlockContent
    truth: BlockContent | None
    second: BlockContent | None
    sensors: SensorBlock | None
    cameras: tuple[CameraBlock, ...]


class MotionScene:
    """Scene of a motion; `show` is called by one thread.

    Attributes:
        layers: parts that can be hidden: label -> function that shows (True) or hides them.
        cameras: in it. person: the motion.
    """

    def __init__(
        self,
        server: Any,
        motion: MotionReader,
        measurements: MeasurementsReader | None = None,
        second: MotionReader | None = None,
    ):
        """Add everything to the scene; nothing is shown before `show`. `FileFormatError`: a damaged file."""
        self._server, self._motion, self._measurements, self._second = server, motion, measurements, second
        given = None if measurements is None else measurements.read(0, 1)
        start = motion.read(0, min(len(motion), 60))
        self.stage = Stage(server, start.poses, motion.skeleton, given)
        self.person = Person(server, "/world/motion", motion.skeleton, start.confidence is not None)
        self._path = RootPath(server, "/world/motion/root path")
        self.sensors: Sensors | None = None
        self.truth: Companion | None = None
        self.second: Companion | None = None
        self.cameras: list[CameraLayer] = []
        if given is not None:
            self._add_measurements(given)
        if second is not None:
            self.second = Companion(server, "/world/second motion", second.skeleton, SECOND)
        self.layers = self._layers()
        self.behind: int | None = None
        """Camera through which one looks: its image is behind the person."""
        self._blocks = BlockCache(len(motion), self._compute)
        self._paths = BlockCache(len(motion), self._compute_path, int(_PATH_BLOCK_S * motion.rate_hz) + 1)
        self._path_shown: Any = None

    def show(self, frame: int, seconds: float = 0.0) -> SceneBlock | None:
        """Show a frame; return its block, or None while it is being read. `RtofError`: it cannot be read."""
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

    def put_beside(self, distance: float) -> None:
        """Put the truth and the second motion beside the motion, at its left and right as the viewer sees.

        `distance`: m; 0: in the same place.
        """
        for companion, sign in ((self.truth, 1.0), (self.second, -1.0)):
            if companion is not None:
                companion.frame.position = sign * distance * self.stage.sideways

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

    def _layers(self) -> dict[str, Callable[[bool], None]]:
        handles: dict[str, list[Any]] = {
            "segments": [self.person.body.handle],
            "joint axes": [self.person.axes],
            ELLIPSOIDS: [self.person.ellipsoids],
            "sensors": [] if self.sensors is None else [self.sensors.boxes, self.sensors.axes],
            "root path": [self._path.handle],
            "floor": [self.stage.floor],
            "truth": [] if self.truth is None else [self.truth.body.handle],
            "second motion": [] if self.second is None else [self.second.body.handle],
        }
        out: dict[str, Callable[[bool], None]]
        out = {label: partial(self._show_handles, own) for label, own in handles.items() if own and own[0] is not None}
        if self.cameras:
            out |= {label: partial(self._show_part, part) for label, part in _CAMERA_PARTS.items()}
        return out

    def _show_handles(self, handles: Sequence[Any], visible: bool) -> None:
        with self._server.atomic():
            for handle in handles:
                handle.visible = visible

    def _show_part(self, part: str, visible: bool) -> None:
        with self._server.atomic():
            for camera in self.cameras:
                camera.set_visible(part, visible)

    def _depth(self, camera: int, p_root: Array) -> float:
        if camera != self.behind or not np.isfinite(p_root).all():
            return DEPTH
        distance = float(np.linalg.norm(p_root - self.cameras[camera].center))
        return _BEHIND[0] * distance + _BEHIND[1]

    # --- blocks ----------------------------------------------------------------------------------

    def _compute(self, start: int, stop: int) -> SceneBlock:
        motion = self._motion.read(start, stop)
        skeleton, poses = motion.skeleton, motion.poses
        content = block_content(poses, skeleton, start, motion.confidence)
        truth = sensors = None
        cameras: list[CameraBlock] = []
        if self._measurements is not None:
            given = self._measurements.read(start, stop)
            if self.truth is not None and given.truth is not None:
                truth = block_content(given.truth, skeleton, start)
            if self.sensors is not None:
                sensors = self.sensors.place(poses, given)
            cameras = [camera_block(view, poses.p_world_joint) for view in given.views]
        second = self._of_second(poses.times, start)
        return SceneBlock(content, truth, second, sensors, tuple(cameras))

    def _of_second(self, times: Array, start: int) -> BlockContent | None:
        """Return the second motion at the times of a block, not shown where it has no frame then."""
        if self._second is None or self.second is None:
            return None
        at = np.array([frame_at(self._second.times, time) for time in times])
        first, last = int(at.min()), int(at.max())
        found = self._second.read(first, last + 1)
        content = block_content(found.poses, found.skeleton, start)
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

    def _compute_path(self, start: int, stop: int) -> tuple[Array, NDArray[np.uint8]]:
        margin = int(_PATH_S * self._motion.rate_hz)
        start, stop = max(start - margin, 0), min(stop + margin, len(self._motion))
        p, provenance = self._motion.root(start, stop)
        step = max((stop - start) // _PATH_POINTS, 1)
        return p[::step], PALETTE[provenance[::step]]

    def _show_path(self, frame: int) -> None:
        found = self._paths.at(frame)
        if found is not None and found[0] is not self._path_shown:
            self._path_shown = found[0]
            self._path.show(*found[0])
