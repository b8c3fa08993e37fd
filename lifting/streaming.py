"""`StreamingLifter`: a lifter frame by frame, as they come from a camera.

It gives what `Lifter.predict` gives of the same frames: both look windows up in a `Source`, and
`SingleWindowLifter` computes of one what `predict` computes of many.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lifting.models import RAYS
from lifting.predict import MIN_JOINTS, Lifter, camera_height
from lifting.single_window import SingleWindowLifter
from lifting.source import Source
from rtof_kin.core.checks import checked_names
from rtof_kin.core.errors import ShapeError, UnknownNameError
from rtof_kin.data.camera import Camera

Array = NDArray[np.float64]
FIRST_CAPACITY = 512
"""Frames kept at least; more only where so many come within one window."""


@dataclass(frozen=True)
class StreamedPose:
    """The pose of one person at one instant; arrays are read-only."""

    time: float
    """Of the frame it belongs to, s."""
    p_world_joint: Array
    """(J, 3) m."""
    seen: bool
    """Whether the camera saw enough around the frame; if not, positions are the last that were seen."""
    sigma_m: Array
    """(J, 2) see `LiftedPoses.sigma_m`; NaN where not seen."""
    R_world_bone: Array
    """(J, 3, 3) see `LiftedPoses.R_world_bone`; likewise."""
    sigma_rad: Array
    """(J,) their standard deviation per axis, rad; likewise."""


class StreamingLifter:
    """One person in front of one camera: frames in, poses out."""

    def __init__(
        self,
        lifter: Lifter,
        camera: Camera,
        joint_offsets: ArrayLike | None = None,
        floor_height: float | None = None,
        *,
        names: Sequence[str] | None = None,
        flip: bool = True,
    ):
        """Prepare for a camera and a person.

        Args:
            lifter: a causal one answers at once, a centred one after `delay_s`.
            camera: that sees the landmarks; its orientation gives the vertical.
            joint_offsets: (J, 3) m, as in `Lifter.predict`; None where unknown.
            floor_height: z of a flat floor in world, m, where it is known.
            names: L names of the landmarks; the lifter's own joints if not given. Those that it does not
                know are ignored.
            flip: average with the mirrored scene: a third slower, and better.

        Raises:
            ShapeError: the lifter is of a kind that does not stream; too few landmarks are joints that it
                knows; `joint_offsets` or `floor_height` are wrong.
        """
        description = lifter.description
        if description.network.model != RAYS:
            raise ShapeError(f"a lifter of kind {description.network.model} does not stream; use predict")
        self._names = checked_names("landmark names", lifter.names if names is None else names)
        self._joints = [j for j, name in enumerate(lifter.names) if name in self._names]
        self._landmarks = [self._names.index(lifter.names[j]) for j in self._joints]
        if len(self._joints) < MIN_JOINTS:
            raise ShapeError(
                f"names: {len(self._joints)} of the landmarks are joints that the lifter knows, and it "
                f"needs {MIN_JOINTS}; it knows {', '.join(lifter.names)}"
            )
        self._camera, self._body, self._rate_hz = camera, description.body, description.rate_hz
        self._size = lifter.receptive_field()
        self._estimated = lifter.estimated()
        self._lift = SingleWindowLifter(
            self._body, lifter.network, lifter.bones_of(joint_offsets),
            camera_height(camera, floor_height), flip,
        )  # fmt: skip
        bent = bool(camera.distortion.any())
        self._from_pixels = None if bent else camera.R_camera_world.T @ np.linalg.inv(camera.K)
        span = (self._size - 1) / self._rate_hz
        self._history = _History(len(lifter.names), len(description.body.sensors), span)
        self._last: StreamedPose | None = None
        self._answered = -np.inf

    @property
    def delay_s(self) -> float:
        """Age of the newest pose when its frame's window is complete, s; 0 for a causal lifter."""
        return (self._size - 1 - self._estimated) / self._rate_hz

    def push(
        self,
        time: float,
        uv_px: ArrayLike,
        confidence: ArrayLike,
        R_world_bone: Mapping[str, ArrayLike] | None = None,
    ) -> StreamedPose | None:
        """Take one frame, and give the newest pose there is since the last one.

        Args:
            time: s, later than the frame before; at any rate, with gaps.
            uv_px: (L, 2) landmarks, px; NaN where unseen.
            confidence: (L,) in [0, 1]; 0 where unseen.
            R_world_bone: orientations (3, 3) of the segments whose sensors reported, by joint name; NaN
                or left out where they did not. Segments that the lifter knows no sensor of are ignored.

        Returns:
            The pose; None as long as `delay_s` has not passed, no new frame is complete, or too little
            was ever seen.

        Raises:
            ShapeError: time goes back, or an array is wrong; the frame is not taken.
            UnknownNameError: an orientation is of no joint of the lifter.
        """
        time = float(time)
        if not time > self._history.newest or not np.isfinite(time):
            raise ShapeError(
                f"time: {time:g} s after a frame at {self._history.newest:g} s; give frames in order, "
                "each once, and make a new StreamingLifter for a new recording"
            )
        rays, seen = self._rays(uv_px, confidence)
        axes, sensed = self._axes(R_world_bone or {})
        self._history.append(time, rays, seen, axes, sensed)
        return self._answer()

    def flush(self) -> list[StreamedPose]:
        """The poses still owed at the end of a stream, one per frame; none of a causal lifter.

        After the last frame it stands still, as in `Lifter.predict`. Frames may follow all the same;
        those answered here are not answered again.
        """
        owed = [self._lifted(time) for time in self._history.times_after(self._answered)]
        self._answered = self._history.newest
        return [pose for pose in owed if pose is not None]

    def _rays(self, uv_px: ArrayLike, confidence: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Directions (J, 3), zero where unseen, and whether seen (J,)."""
        uv, sure, L = np.asarray(uv_px, float), np.asarray(confidence, float), len(self._names)
        if uv.shape != (L, 2) or sure.shape != (L,):
            raise ShapeError(
                f"uv_px, confidence: expected shapes ({L}, 2) and ({L},), got {uv.shape} and {sure.shape}"
            )
        if np.isinf(uv).any() or ((sure < 0) | (sure > 1)).any():
            raise ShapeError("uv_px, confidence: give finite pixels or NaN, and confidence in [0, 1]")
        J = len(self._body.names)
        rays, seen = np.zeros((J, 3), np.float32), np.zeros(J, bool)
        directions = self._directions(uv[self._landmarks])
        known = (sure[self._landmarks] > 0) & np.isfinite(directions).all(axis=1)
        rays[self._joints] = np.where(known[:, None], directions, 0.0)
        seen[self._joints] = known
        return rays, seen

    def _directions(self, uv: Array) -> Array:
        """Directions in world (n, 3) of pixels; of a camera without distortion by one product."""
        if self._from_pixels is None:
            return self._camera.rays_world(uv)
        rays = uv @ self._from_pixels[:, :2].T + self._from_pixels[:, 2]
        return np.asarray(rays / np.sqrt((rays * rays).sum(axis=1, keepdims=True)))

    def _axes(self, given: Mapping[str, ArrayLike]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """X and z axes (2, S, 3), zero where not sensed, and whether sensed (S,)."""
        sensors = self._body.sensors
        axes, sensed = np.zeros((2, len(sensors), 3), np.float32), np.zeros(len(sensors), bool)
        unknown = given.keys() - set(self._body.names)
        if unknown:
            raise UnknownNameError("joint", sorted(unknown), self._body.names)
        worn = [name for name in given if name in sensors]
        if not worn:
            return axes, sensed
        shapes = {np.shape(given[name]) for name in worn}
        if shapes != {(3, 3)}:
            raise ShapeError(f"R_world_bone: expected (3, 3) each, got {sorted(shapes)}")
        R = np.array([given[name] for name in worn], float)
        known = np.isfinite(R).all(axis=(1, 2))
        off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
        if (off[known] > 1e-3).any():
            first = worn[int(np.flatnonzero(known & (off > 1e-3))[0])]
            raise ShapeError(f"R_world_bone of {first}: not a rotation matrix; NaN where missing")
        index = [sensors.index(name) for name in worn]
        axes[:, index] = np.where(known[:, None, None], R, 0.0)[..., [0, 2]].transpose(2, 0, 1)
        sensed[index] = known
        return axes, sensed

    def _answer(self) -> StreamedPose | None:
        """The pose of the newest frame whose window is complete."""
        time = self._history.newest_before(self.delay_s - 0.1 / self._rate_hz)
        if time is None or time <= self._answered:
            return None
        self._answered = time
        return self._lifted(time)

    def _lifted(self, time: float) -> StreamedPose | None:
        """The pose of the frame of this time; the last one that was seen if it is not."""
        window = self._history.source().window(time, self._size, self._estimated, self._rate_hz)
        p, *others = self._lift(*window)
        if np.count_nonzero(window[1].any(axis=0)) >= MIN_JOINTS and np.isfinite(p).all():
            self._last = _pose(time, self._camera.center_world + p, True, *others)
        elif self._last is not None:
            self._last = _pose(time, self._last.p_world_joint, False)
        return self._last


def _pose(
    time: float,
    p: Array,
    seen: bool,
    sigma_m: ArrayLike | None = None,
    R: ArrayLike | None = None,
    sigma_rad: ArrayLike | None = None,
) -> StreamedPose:
    """A pose of read-only arrays; what is unknown is NaN."""

    def full(values: ArrayLike | None, *shape: int) -> Array:
        array = np.empty(shape)
        array[:] = np.nan if values is None else values
        array.setflags(write=False)
        return array

    J = len(p)
    return StreamedPose(time, full(p, J, 3), seen, full(sigma_m, J, 2), full(R, J, 3, 3), full(sigma_rad, J))


class _History:
    """The last frames, in arrays that are filled from the front and moved back when they are full."""

    def __init__(self, joints: int, sensors: int, span: float):
        """Of so many joints and sensors; windows are `span` s long."""
        self._span, self._count = span, 0
        self._times = np.zeros(FIRST_CAPACITY)
        self._arrays = self._empty(FIRST_CAPACITY, joints, sensors)

    @property
    def newest(self) -> float:
        """Time of the last frame; before all times if there is none."""
        return float(self._times[self._count - 1]) if self._count else -np.inf

    def newest_before(self, age: float) -> float | None:
        """Time of the last frame that is at least so old, s."""
        times = self._times[: self._count]
        found = int(np.searchsorted(times, times[-1] - age, side="right"))
        return float(times[min(found, len(times)) - 1]) if found else None

    def times_after(self, time: float) -> list[float]:
        """Times of all frames after this one."""
        times = self._times[: self._count]
        after: list[float] = times[times > time].tolist()
        return after

    def append(self, time: float, *values: NDArray[Any]) -> None:
        """Add a frame."""
        if self._count == len(self._times):
            self._make_room()
        self._times[self._count] = time
        for array, value in zip(self._arrays, values, strict=True):
            array[self._count] = value
        self._count += 1

    def source(self) -> Source:
        """All frames kept; one that nobody saw where there are none."""
        n = max(self._count, 1)
        rays, seen, axes, sensed = (array[:n] for array in self._arrays)
        none = np.zeros((0, 0, 2), np.float32)
        return Source(self._times[:n], rays, seen, axes, sensed, none, np.eye(3, dtype=np.float32))

    def _make_room(self) -> None:
        """Drop what no window to come reaches back to; more room if that is less than half."""
        # A window begins at most two spans before the newest frame, and may lie between two frames.
        first = np.searchsorted(self._times, self._times[-1] - 2 * self._span) - 2
        first = max(int(first), 0)
        kept = self._count - first
        capacity = len(self._times) * (2 if kept > len(self._times) // 2 else 1)
        moved = np.zeros(capacity)
        moved[:kept] = self._times[first:]
        self._times = moved
        for i, array in enumerate(self._arrays):
            room = np.zeros((capacity, *array.shape[1:]), array.dtype)
            room[:kept] = array[first:]
            self._arrays[i] = room
        self._count = kept

    @staticmethod
    def _empty(capacity: int, joints: int, sensors: int) -> list[NDArray[Any]]:
        return [
            np.zeros((capacity, joints, 3), np.float32),
            np.zeros((capacity, joints), bool),
            np.zeros((capacity, 2, sensors, 3), np.float32),
            np.zeros((capacity, sensors), bool),
        ]
