"""`StreamingLifter`: lifts of the newest frames of a live video, again as later frames come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lifting.predict import MIN_JOINTS, Lifter, camera_height
from lifting.source import Source
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, indices_of, readonly
from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.data.camera import Camera

_SAME_S: Final = 1e-6  #: Largest difference between times of the same frame, s


@dataclass(frozen=True)
class StreamedPose:
    """Pose of one person at one instant; arrays are read-only."""

    time: float  #: Time of the pose, s
    p_world_joint: Array  #: (J, 3) m
    sigma_m: Array  #: (J, 2) see `LiftedPoses.sigma_m`
    R_world_bone: Array  #: (J, 3, 3) see `LiftedPoses.R_world_bone`
    sigma_rad: Array  #: (J,) see `LiftedPoses.sigma_rad`


class StreamingLifter:
    """Lifter of one person in front of one camera: frames in, poses out.

    A pose depends on the frames up to `delay_s` before and after it. Once these are there it is that of
    `Lifter.predict`. Until then, what the newest frame shows is taken to move on more and more slowly: the
    newest pose is 4 % worse (benchmarks/results/lifter_lookahead.md).
    """

    def __init__(
        self,
        lifter: Lifter,
        camera: Camera,
        joint_offsets: ArrayLike | None = None,
        floor_height: float | None = None,
        *,
        names: Sequence[str] | None = None,
        lookaheads: Sequence[int] = (0,),
        history_s: float = 1.0,
        flip: bool = True,
    ):
        """Prepare for a camera and a person. `InvalidInputError`: too few landmarks are joints of the lifter;
        `joint_offsets`, `floor_height`, `lookaheads` or `history_s` are wrong.

        Args:
            lifter: see `Lifter.load`. joint_offsets: (J, 3) m, as in `Lifter.predict`; None where unknown.
            floor_height: z of a flat floor in world, m; None where unknown.
            names: L landmark names, by default the lifter's joints; unknown ones are ignored.
            lookaheads: of the poses that `push` returns: frames that are newer than theirs.
            history_s: age of the oldest frame that may still come and of the oldest pose that may be estimated,
                relative to the newest frame, s.
            flip: average with the mirrored scene: slower, and more accurate.
        """
        if not history_s >= 0 or not all(0 <= k == int(k) for k in lookaheads):
            raise InvalidInputError(
                f"history_s {history_s:g}, lookaheads {tuple(lookaheads)}: give seconds and frames, not negative"
            )
        self._lifter, self._camera, self._body = lifter, camera, lifter.description.body
        self._centre = camera.center_world
        self._names = checked_names("landmark names", lifter.names if names is None else names)
        joints = [j for j, name in enumerate(lifter.names) if name in self._names]
        if len(joints) < MIN_JOINTS:
            raise InvalidInputError(
                f"names: {len(joints)} of the landmarks are joints of the lifter, and it needs "
                f"{MIN_JOINTS}; its joints are {', '.join(lifter.names)}"
            )
        self._joints, self._landmarks = joints, [self._names.index(lifter.names[j]) for j in joints]
        self._bones, self._height = lifter.bones_of(joint_offsets), camera_height(camera, floor_height)
        self._R_bone_shared = lifter.shared_frames(joint_offsets)
        self._lookaheads, self._history, self._flip = tuple(map(int, lookaheads)), history_s, flip
        self._frames = _Frames(len(lifter.names), len(self._body.sensors))

    @property
    def delay_s(self) -> float:
        """Age relative to the newest frame at which a pose is complete, s."""
        return self._after() / self._lifter.description.rate_hz

    @property
    def times(self) -> Array:
        """(T,) times of the frames that are kept, s: of `history_s`, and what their windows begin with."""
        return self._frames.times.copy()

    def push(
        self, time: float, uv_px: ArrayLike, confidence: ArrayLike, R_world_bone: Mapping[str, ArrayLike] | None = None
    ) -> tuple[StreamedPose | None, ...]:
        """Take one frame, as `put` does, and return a pose for each of the lookaheads k: of the frame that is k frames
        before the newest; None where there is none within `history_s`, or too little is seen around it.
        """
        self.put(time, uv_px, confidence, R_world_bone)
        times = self._frames.times
        oldest = times[-1] - self._history - _SAME_S
        frames = [len(times) - 1 - k for k in self._lookaheads]
        there = [i for i, frame in enumerate(frames) if frame >= 0 and times[frame] >= oldest]
        poses: list[StreamedPose | None] = [None] * len(frames)
        for i, pose in zip(there, self.lift([times[frames[i]] for i in there]), strict=True):
            poses[i] = pose
        return tuple(poses)

    def put(
        self, time: float, uv_px: ArrayLike, confidence: ArrayLike, R_world_bone: Mapping[str, ArrayLike] | None = None
    ) -> None:
        """Take one frame; it may come late, and replaces one of the same time. `ShapeError`, `InvalidInputError`: the
        frame is too late, or an array is wrong; it is not taken. `UnknownNameError`: an orientation is not of a joint
        of the lifter.

        Args:
            time: s, at most `history_s` before the newest frame; any rate, gaps allowed.
            uv_px: (L, 2) landmarks, px; NaN where unseen. confidence: (L,) in [0, 1]; 0 where unseen.
            R_world_bone: orientations (3, 3) of segments by joint name; NaN or left out where missing. Segments
                without a sensor in the lifter's training are ignored.
        """
        time, newest = float(time), self._frames.newest
        if not newest - self._history - _SAME_S <= time < np.inf:
            raise InvalidInputError(
                f"time: {time:g} s, with frames up to {newest:g} s; a frame may be "
                f"{self._history:g} s late, and a new recording needs a new StreamingLifter"
            )
        rays, seen = self._rays(uv_px, confidence)
        self._frames.put(time, rays, seen, *self._axes(R_world_bone or {}))
        before = self._lifter.estimated() / self._lifter.description.rate_hz
        self._frames.forget(self._frames.newest - self._history - before)

    def lift(self, times: ArrayLike) -> tuple[StreamedPose | None, ...]:
        """Return poses at n times, s, not necessarily of frames, within `history_s` before the newest frame, from all
        frames so far; None where too little is seen around one. `InvalidInputError`: a time is earlier, or later than
        the newest frame.
        """
        at, newest = readonly("times", times, ("n",)), self._frames.newest
        if not len(at):
            return ()
        latest = float(at.max())
        if not (at.min() >= newest - self._history - _SAME_S and latest <= newest + _SAME_S):
            raise InvalidInputError(
                f"times from {at.min():g} to {latest:g} s: give such within "
                f"{self._history:g} s before the newest frame at {newest:g} s"
            )
        source, rate_hz = self._frames.source(), self._lifter.description.rate_hz
        if self._after() and latest + self.delay_s > newest + 0.1 / rate_hz:
            source = source.extended(self._after(), rate_hz)
        p, sigma_m, R, sigma_rad, enough = self._lifter.lift_windows(source, at, self._bones, self._height, self._flip)
        p += self._centre
        R = R @ self._R_bone_shared.swapaxes(-1, -2)
        known = enough & np.isfinite(p).all(axis=(1, 2))
        for array in (p, sigma_m, R, sigma_rad):
            array.setflags(write=False)
        return tuple(
            StreamedPose(float(at[i]), p[i], sigma_m[i], R[i], sigma_rad[i]) if known[i] else None
            for i in range(len(at))
        )

    def _after(self) -> int:
        """Number of frames after the estimated one in a window."""
        return self._lifter.receptive_field() - 1 - self._lifter.estimated()

    def _rays(self, uv_px: ArrayLike, confidence: ArrayLike) -> tuple[Array, Mask]:
        """Directions in world (J, 3), zero where unseen, and whether seen (J,)."""
        L, J = len(self._names), len(self._body.names)
        uv, sure = readonly("uv_px", uv_px, (L, 2)), readonly("confidence", confidence, (L,))
        if ((sure < 0) | (sure > 1)).any():
            raise InvalidInputError("confidence: outside [0, 1]; divide by the detector's maximum")
        if np.isinf(uv).any():
            raise InvalidInputError("uv_px: infinite; write NaN where a landmark was not seen")
        rays, seen = np.zeros((J, 3)), np.zeros(J, bool)
        found = self._camera.rays_world(uv[self._landmarks])
        known = (sure[self._landmarks] > 0) & np.isfinite(found).all(axis=1)
        rays[self._joints] = np.where(known[:, None], found, 0.0)
        seen[self._joints] = known
        return rays, seen

    def _axes(self, given: Mapping[str, ArrayLike]) -> tuple[NDArray[np.float32], Mask]:
        """X and z axes (2, S, 3), zero where not sensed, and whether sensed (S,)."""
        sensors = self._body.sensors
        axes, sensed = np.zeros((2, len(sensors), 3), np.float32), np.zeros(len(sensors), bool)
        indices_of("joint", list(given), self._body.names)
        worn = [name for name in given if name in sensors]
        if not worn:
            return axes, sensed
        shapes = {np.shape(given[name]) for name in worn}
        if shapes != {(3, 3)}:
            raise ShapeError(f"R_world_bone: expected (3, 3) each, got {sorted(shapes)}")
        R = np.array([given[name] for name in worn], float)
        known = np.isfinite(R).all(axis=(1, 2))
        off = known & (np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) > 1e-3)
        if off.any():
            first = worn[int(off.argmax())]
            raise InvalidInputError(f"R_world_bone of {first}: not a rotation matrix; NaN where missing")
        index = [sensors.index(name) for name in worn]
        R = R @ self._R_bone_shared[[self._body.sensor_joints[s] for s in index]]
        axes[:, index] = np.where(known[:, None, None], R, 0.0)[..., [0, 2]].transpose(2, 0, 1)
        sensed[index] = known
        return axes, sensed


class _Frames:
    """Frames in the order of their times."""

    def __init__(self, joints: int, sensors: int) -> None:
        shapes = ((), (joints, 3), (joints,), (2, sensors, 3), (sensors,))
        types = (float, np.float32, bool, np.float32, bool)
        self._arrays = [np.zeros((0, *shape), dtype) for shape, dtype in zip(shapes, types, strict=True)]

    @property
    def times(self) -> Array:
        """(T,) s."""
        return self._arrays[0]

    @property
    def newest(self) -> float:
        """Time of the last frame; -inf where there is none."""
        return float(self.times[-1]) if len(self.times) else -np.inf

    def put(self, time: float, *frame: NDArray[Any]) -> None:
        """Insert rays, seen, axes and sensed by their time, or replace those of the same time."""
        row, stop = np.searchsorted(self.times, [time - _SAME_S, time + _SAME_S])
        news = (np.array(time), *frame)
        self._arrays = [
            np.concatenate([old[:row], new[None].astype(old.dtype), old[stop:]])
            for old, new in zip(self._arrays, news, strict=True)
        ]

    def forget(self, before: float) -> None:
        """Drop the frames before a time; two earlier ones remain to interpolate from."""
        first = max(int(np.searchsorted(self.times, before)) - 2, 0)
        self._arrays = [array[first:] for array in self._arrays]

    def source(self) -> Source:
        """Return all frames."""
        times, rays, seen, axes, sensed = self._arrays
        return Source(times, rays, seen, axes, sensed)
