"""`StreamingLifter`: a lifter frame by frame, with the same answers as `Lifter.predict` of all frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lifting.models import RAYS
from lifting.predict import MIN_JOINTS, Lifter, camera_height
from lifting.source import Source
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, indices_of
from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence


@dataclass(frozen=True)
class StreamedPose:
    """Pose of one person at one instant; arrays are read-only."""

    time: float
    """Time of the frame, s."""
    p_world_joint: Array
    """(J, 3) m."""
    seen: bool
    """Whether the camera saw enough around the frame; if not, positions are the last ones seen."""
    sigma_m: Array
    """(J, 2) see `LiftedPoses.sigma_m`; NaN where not seen."""
    R_world_bone: Array
    """(J, 3, 3) see `LiftedPoses.R_world_bone`; NaN where not seen."""
    sigma_rad: Array
    """(J,) see `LiftedPoses.sigma_rad`; NaN where not seen."""


class StreamingLifter:
    """Lifter of one person in front of one camera: frames in, poses out."""

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
            camera: its orientation gives the vertical.
            joint_offsets: (J, 3) m, as in `Lifter.predict`; None where unknown.
            floor_height: z of a flat floor in world, m; None where unknown.
            names: L landmark names, by default the lifter's joints; unknown ones are ignored.
            flip: average with the mirrored scene: a third slower, and more accurate.

        Raises:
            InvalidInputError: the lifter's model does not stream; too few landmarks are joints of the
                lifter; `joint_offsets` or `floor_height` are wrong.
        """
        description = lifter.description
        if description.network.model != RAYS:
            raise InvalidInputError(
                f"a lifter of kind {description.network.model} does not stream; use predict"
            )
        self._names = checked_names("landmark names", lifter.names if names is None else names)
        common = set(self._names) & set(lifter.names)
        if len(common) < MIN_JOINTS:
            raise InvalidInputError(
                f"names: {len(common)} of the landmarks are joints of the lifter, and it needs "
                f"{MIN_JOINTS}; its joints are {', '.join(lifter.names)}"
            )
        self._lifter, self._camera, self._body = lifter, camera, description.body
        self._bones, self._flip = lifter.bones_of(joint_offsets), flip
        self._R_bone_shared = lifter.shared_frames(joint_offsets)
        self._height = camera_height(camera, floor_height)
        self._frames: deque[Source] = deque()
        self._last: StreamedPose | None = None
        self._newest = self._answered = -np.inf

    @property
    def delay_s(self) -> float:
        """Age of the newest pose when its frame's window is complete, s; 0 for a causal lifter."""
        after = self._lifter.receptive_field() - 1 - self._lifter.estimated()
        return after / self._lifter.description.rate_hz

    def push(
        self,
        time: float,
        uv_px: ArrayLike,
        confidence: ArrayLike,
        R_world_bone: Mapping[str, ArrayLike] | None = None,
    ) -> StreamedPose | None:
        """Take one frame, and return the newest complete pose.

        Args:
            time: s, later than the frame before; any rate, gaps allowed.
            uv_px: (L, 2) landmarks, px; NaN where unseen.
            confidence: (L,) in [0, 1]; 0 where unseen.
            R_world_bone: orientations (3, 3) of segments by joint name; NaN or left out where missing.
                Segments without a sensor in the lifter's training are ignored.

        Returns:
            The pose; None while `delay_s` has not passed, no new frame is complete, or too little was
            ever seen.

        Raises:
            ShapeError, InvalidInputError: time goes back, or an array is wrong; the frame is not taken.
            UnknownNameError: an orientation is not of a joint of the lifter.
        """
        time = float(time)
        if not time > self._newest or not np.isfinite(time):
            raise InvalidInputError(
                f"time: {time:g} s after a frame at {self._newest:g} s; give frames in order, "
                "each once, and make a new StreamingLifter for a new recording"
            )
        times, uv, sure = (np.asarray([value], float) for value in (time, uv_px, confidence))
        keypoints = KeypointSequence(self._camera, times, uv, sure, self._names)
        axes, sensed = self._axes(R_world_bone or {})
        frame = replace(Source.of(self._body, keypoints), axes=axes[None], sensed=sensed[None])
        self._frames.append(frame)
        self._newest = time
        limit = time - self.delay_s + 0.1 / self._lifter.description.rate_hz
        complete = next((t for t in reversed(self._times()) if t <= limit), -np.inf)
        if complete <= self._answered:
            return None
        pose = self._lifted(complete)
        self._answer_until(complete)
        return pose

    def flush(self) -> list[StreamedPose]:
        """Return the remaining poses at the end of a stream, one per frame; none of a causal lifter.

        The last frame is repeated, as in `Lifter.predict`. Further frames may follow; those answered
        here are not answered again.
        """
        remaining = [self._lifted(time) for time in self._times() if time > self._answered]
        self._answer_until(self._newest)
        return [pose for pose in remaining if pose is not None]

    def _times(self) -> list[float]:
        return [float(frame.times[0]) for frame in self._frames]

    def _answer_until(self, time: float) -> None:
        """Drop the frames before every window to come; two earlier ones remain to interpolate from."""
        self._answered = time
        first = time - self._lifter.receptive_field() / self._lifter.description.rate_hz
        while len(self._frames) > 2 and self._frames[2].times[0] < first:
            self._frames.popleft()

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

    def _lifted(self, time: float) -> StreamedPose | None:
        """Return the pose of the frame at this time, with the last positions seen if it is not."""
        source, J = Source.joined(self._frames), len(self._body.names)
        p, sigma_m, R, sigma_rad, enough = self._lifter.lift_windows(
            source, np.array([time]), self._bones, self._height, self._flip
        )
        R = R @ self._R_bone_shared.swapaxes(-1, -2)
        seen = bool(enough[0] and np.isfinite(p).all())
        if seen:
            arrays = [self._camera.center_world + p[0], sigma_m[0], R[0], sigma_rad[0]]
        elif self._last is not None:
            unknown = [np.full(shape, np.nan) for shape in ((J, 2), (J, 3, 3), (J,))]
            arrays = [self._last.p_world_joint, *unknown]
        else:
            return None
        for array in arrays:
            array.setflags(write=False)
        self._last = StreamedPose(time, arrays[0], seen, *arrays[1:])
        return self._last
