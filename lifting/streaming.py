"""`StreamingLifter`: lifts of the newest frames of a live video, again as later frames come.

A few windows at a time: the answer of `Lifter.lift_windows` up to rounding, in less time. For one to ten windows, the
calls of torch take longer than their arithmetic. Here torch evaluates the network alone; `windows.encode` and
`windows.decode` are done by NumPy on arrays of the same layout, what depends on the person alone only once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from lifting.body import Body
from lifting.model import TemporalNetwork, torch_threads
from lifting.models import RAYS, FoldedNetwork
from lifting.predict import MIN_JOINTS, Lifter, camera_height
from lifting.source import Source
from lifting.windows import (
    ANKLE_HEIGHT,
    BONE_GAIN,
    LOG_DISTANCE,
    LOG_SPREAD,
    MAX_IMAGE,
    MIN_FORWARD,
    MIN_HEIGHT,
    MIN_HEIGHT_IN_IMAGE,
    MIN_SCALE,
    MIN_SLOPE,
    SIGMA_ACROSS,
    SIGMA_ALONG,
    SIGMA_TURN,
    Windows,
    sizes,
)
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, indices_of, readonly
from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.data.camera import Camera

_Array = NDArray[np.float32]


class FewWindows:
    """Lifts of one person from one height of the camera."""

    def __init__(self, body: Body, network: TemporalNetwork, bones: Array, camera_height: float, flip: bool = True):
        """Fuse the weights of a network in evaluation mode, of the package's own model, for bones (3 G,), m,
        see `Body.bones_of`, and a camera's height over the floor, m; both may be NaN.
        """
        self._body, self._network = body, FoldedNetwork(body, network, flip)
        self._inputs, constants, _ = sizes(body)
        J = len(body.names)
        self._rank = np.array([3 if j == 0 else 2 if j in body.hips else 1 for j in range(J)])
        self._away = np.abs(np.arange(network.receptive_field()) - network.estimated())
        self._height = camera_height if np.isfinite(camera_height) else None
        self._constants = np.zeros((1, constants), np.float32)
        if np.isfinite(bones).all():
            self._constants[0, 4:-1] = (bones - np.array(body.nominal_bones)) * BONE_GAIN
            self._constants[0, -1] = 1.0

    def __call__(self, windows: Windows) -> tuple[Array, Array, Array, Array]:
        """Return positions (B, J, 3) from the optical centre, m; their sigma (B, J, 2), m; orientations
        (B, J, 3, 3) of the segments' shared frames; their sigma (B, J), rad.

        Bones and height of the windows are not read.
        """
        rays, seen = windows.rays_world.numpy(), windows.seen.numpy()
        R_view, R_ray, elevation = _frames(self._centre(rays, seen))
        features, scale = self._features(windows, R_view, R_ray)
        constants = np.repeat(self._constants, len(rays), axis=0)
        constants[:, 0], constants[:, 1] = elevation, np.log(scale)
        if self._height is not None:
            constants[:, 2] = np.log((self._height * scale).clip(MIN_HEIGHT_IN_IMAGE))
            constants[:, 3] = 1.0
        with torch_threads(1), torch.inference_mode():
            output = self._network(torch.from_numpy(features), torch.from_numpy(constants)).numpy()
        return self._decoded(output, R_view, R_ray, scale)

    def _centre(self, rays: _Array, seen: NDArray[np.bool_]) -> _Array:
        """Direction (B, 3) to the centre of each window, as in `windows.encode`."""
        B, W, _ = seen.shape
        frame = np.where(seen.any(axis=2), self._away, self._away + W).argmin(axis=1)
        rows = np.arange(B)
        now, ray = seen[rows, frame], rays[rows, :, frame]
        rank = now * self._rank
        chosen = now & (rank == rank.max(axis=1, keepdims=True))
        length = np.sqrt((ray * ray).sum(axis=1)).clip(1e-12)
        centre = (ray * (chosen / length)[:, None]).sum(axis=2)
        centre[:, 0] += 1e-12  # negligible where anything is seen
        return np.asarray(centre, np.float32)

    def _features(self, windows: Windows, R_view: _Array, R_ray: _Array) -> tuple[_Array, _Array]:
        """Features (B, W, inputs), and the scale (B,)."""
        rays, seen = windows.rays_world.numpy(), windows.seen.numpy()
        (B, W, J), F = seen.shape, len(self._body.feet)
        features = np.empty((B, W, self._inputs), np.float32)
        view = (R_view @ rays.reshape(B, 3, -1)).reshape(rays.shape)
        forward = view[:, 2]
        weight = (seen & (forward > MIN_FORWARD)).astype(np.float32)
        image = view[:, :2] * (weight / np.maximum(forward, MIN_FORWARD))[:, None]
        scale = _scale(image, weight)
        image /= scale[:, None, None, None]
        limited = np.minimum(np.maximum(image, -MAX_IMAGE), MAX_IMAGE)
        features[..., :J], features[..., J : 2 * J] = limited[:, 0], limited[:, 1]
        features[..., 2 * J : 3 * J] = weight
        feet, sensors = features[..., 3 * J : 3 * J + 2 * F], features[..., 3 * J + 2 * F :]
        self._standing(feet, rays, seen, scale)
        sensed, S2 = windows.sensed.numpy().astype(np.float32), 2 * len(self._body.sensors)
        axes = (R_ray @ windows.axes_world.numpy().reshape(B, 3, -1)).reshape(B, 3, W, S2)
        axes *= np.concatenate([sensed, sensed], axis=2)[:, None]
        sensors[..., : 3 * S2].reshape(B, W, 3, S2)[:] = axes.transpose(0, 2, 1, 3)
        sensors[..., 3 * S2 :] = sensed
        return features, scale

    def _standing(self, out: _Array, rays: _Array, seen: NDArray[np.bool_], scale: _Array) -> None:
        """Write log(horizontal distance x scale) of each foot on the floor, whether known, (B, W, 2 F)."""
        F = len(self._body.feet)
        height = -1.0 if self._height is None else self._height - ANKLE_HEIGHT
        if not height > MIN_HEIGHT:
            out[:] = 0.0
            return
        for f, j in enumerate(self._body.feet):
            x, y, z = rays[:, 0, :, j], rays[:, 1, :, j], rays[:, 2, :, j]
            slope = -z / np.maximum(np.sqrt(x * x + y * y), 1e-6)
            known = seen[..., j] & (slope > MIN_SLOPE)
            out[..., f] = known * np.log(height * scale[:, None] / np.maximum(slope, MIN_SLOPE))
            out[..., F + f] = known

    def _decoded(
        self, output: _Array, R_view: _Array, R_ray: _Array, scale: _Array
    ) -> tuple[Array, Array, Array, Array]:
        """What `__call__` returns, from the network's output (B, outputs), see `windows.decode`."""
        B, J = len(output), len(self._body.names)
        ends = np.cumsum([3 * (J - 1), 3, 2 * J, 6 * J])
        pose, root, spread, turns, turn = np.split(output, ends, axis=1)
        direction = np.concatenate([root[:, :2] * scale[:, None], np.ones((B, 1))], axis=1)
        away = np.exp(root[:, 2].clip(*LOG_DISTANCE)) / scale / np.sqrt((direction * direction).sum(axis=1))
        p = np.empty((B, J, 3))
        p[:, 0] = ((direction * away[:, None])[:, None] @ R_view)[:, 0]
        distance = np.sqrt((p[:, 0] * p[:, 0]).sum(axis=1))
        p[:, 1:] = p[:, :1] + pose.reshape(B, 3, J - 1).swapaxes(1, 2) @ R_ray
        sigma_m = np.exp(spread.reshape(B, 2, J).clip(*LOG_SPREAD)).swapaxes(1, 2).astype(float)
        sigma_m *= (SIGMA_ACROSS, SIGMA_ALONG)
        sigma_m[:, 0] *= distance[:, None]
        sigma_rad = SIGMA_TURN * np.exp(turn.clip(*LOG_SPREAD).astype(float))
        axes = turns.reshape(B, 2, 3, J).transpose(0, 1, 3, 2) @ R_ray[:, None]
        return p, sigma_m, _rotations(*axes.swapaxes(0, 1).astype(float)), sigma_rad


def _frames(centre: _Array) -> tuple[_Array, _Array, _Array]:
    """R_view_world and R_ray_world (B, 3, 3) of windows centred on (B, 3), and the elevation (B,), rad."""
    x, y, up = centre.T
    across = np.sqrt(x * x + y * y).clip(1e-12)
    elevation = np.arctan2(up, across)
    x, y, cos_e, sin_e = x / across, y / across, np.cos(elevation), np.sin(elevation)
    R = np.zeros((2, len(centre), 3, 3), np.float32)
    view, ray = R
    view[:, 0, 0], view[:, 0, 1] = y, -x
    view[:, 1, 0], view[:, 1, 1], view[:, 1, 2] = sin_e * x, sin_e * y, -cos_e
    view[:, 2, 0], view[:, 2, 1], view[:, 2, 2] = cos_e * x, cos_e * y, sin_e
    ray[:, 0, 0], ray[:, 0, 1], ray[:, 1, 0], ray[:, 1, 1], ray[:, 2, 2] = x, y, -y, x, 1.0
    return view, ray, elevation


def _scale(image: _Array, weight: _Array) -> _Array:
    """RMS distance (B,) of the points seen (B, 2, W, J) from the mean of their frame."""
    count = weight.sum(axis=2)
    mean = image.sum(axis=3) / np.maximum(count, 1.0)[:, None]
    away = (image - mean[..., None]) * weight[:, None]
    square = (away * away).reshape(len(image), -1).sum(axis=1) / np.maximum(count.sum(axis=1), 1.0)
    return np.asarray(np.maximum(np.sqrt(square), MIN_SCALE), np.float32)


def _rotations(x: Array, z: Array) -> Array:
    """Rotations (B, J, 3, 3) with z axes in the direction of (B, J, 3) and x axes near those given."""
    R = np.empty((*x.shape, 3))
    R[..., 2] = z = z / np.sqrt((z * z).sum(axis=-1, keepdims=True)).clip(1e-12)
    x = x - (x * z).sum(axis=-1, keepdims=True) * z
    R[..., 0] = x = x / np.sqrt((x * x).sum(axis=-1, keepdims=True)).clip(1e-12)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        R[..., i, 1] = z[..., j] * x[..., k] - z[..., k] * x[..., j]
    return R


_SAME_S = 1e-6  #: Largest difference between times of the same frame, s


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
        """Prepare for a camera and a person.

        Args:
            lifter: see `Lifter.load`. joint_offsets: (J, 3) m, as in `Lifter.predict`; None where unknown.
            floor_height: z of a flat floor in world, m; None where unknown.
            names: L landmark names, by default the lifter's joints; unknown ones are ignored.
            lookaheads: of the poses that `push` returns: frames that are newer than theirs.
            history_s: age of the oldest frame that may still come and of the oldest pose that may be estimated,
                relative to the newest frame, s.
            flip: average with the mirrored scene: a tenth slower, and more accurate.

        Raises:
            InvalidInputError: the lifter's model does not stream; too few landmarks are joints of the
                lifter; `joint_offsets`, `floor_height`, `lookaheads` or `history_s` are wrong.
        """
        description = lifter.description
        if description.network.model != RAYS:
            raise InvalidInputError(f"a lifter of kind {description.network.model} does not stream; use predict")
        if not history_s >= 0 or not all(0 <= k == int(k) for k in lookaheads):
            raise InvalidInputError(
                f"history_s {history_s:g}, lookaheads {tuple(lookaheads)}: give seconds and frames, not negative"
            )
        self._lifter, self._camera, self._body = lifter, camera, description.body
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
        self._lifted = FewWindows(self._body, lifter.network, self._bones, self._height, flip)
        self._lookaheads, self._history = tuple(map(int, lookaheads)), history_s
        self._frames = _Frames(len(lifter.names), len(self._body.sensors), camera)

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
        """Take one frame; it may come late, and replaces one of the same time.

        Args:
            time: s, at most `history_s` before the newest frame; any rate, gaps allowed.
            uv_px: (L, 2) landmarks, px; NaN where unseen. confidence: (L,) in [0, 1]; 0 where unseen.
            R_world_bone: orientations (3, 3) of segments by joint name; NaN or left out where missing. Segments
                without a sensor in the lifter's training are ignored.

        Raises:
            ShapeError, InvalidInputError: the frame is too late, or an array is wrong; it is not taken.
            UnknownNameError: an orientation is not of a joint of the lifter.
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
        frames so far; None where too little is seen around one.

        Raises:
            InvalidInputError: a time is earlier, or later than the newest frame.
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
        size, estimated = self._lifter.receptive_field(), self._lifter.estimated()
        windows = source.windows(at, size, estimated, rate_hz, self._bones, self._height, picture=False)
        p, sigma_m, R, sigma_rad = self._lifted(windows)
        enough = windows.seen.numpy().any(axis=1).sum(axis=1) >= MIN_JOINTS
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
    """Frames in the order of their times, in arrays with room at their end."""

    def __init__(self, joints: int, sensors: int, camera: Camera) -> None:
        shapes = ((), (joints, 3), (joints,), (2, sensors, 3), (sensors,))
        types = (float, np.float32, bool, np.float32, bool)
        self._arrays = [np.zeros((128, *shape), dtype) for shape, dtype in zip(shapes, types, strict=True)]
        self._first = self._end = 0
        self._R_camera_world = camera.R_camera_world.astype(np.float32)

    @property
    def times(self) -> Array:
        """(T,) a view."""
        return self._arrays[0][self._first : self._end]

    @property
    def newest(self) -> float:
        """Time of the last frame; -inf where there is none."""
        return float(self._arrays[0][self._end - 1]) if self._end > self._first else -np.inf

    def put(self, *frame: ArrayLike) -> None:
        """Insert time, rays, seen, axes and sensed at their place, or in place of the same frame."""
        if self._end == len(self._arrays[0]):
            self._make_room()
        time = float(np.asarray(frame[0]))
        row = self._first + int(np.searchsorted(self.times, time - _SAME_S))
        same = row < self._end and self._arrays[0][row] <= time + _SAME_S
        for array, value in zip(self._arrays, frame, strict=True):
            if not same:
                array[row + 1 : self._end + 1] = array[row : self._end]
            array[row] = value
        self._end += not same

    def forget(self, before: float) -> None:
        """Drop the frames before a time; two earlier ones remain to interpolate from."""
        self._first = max(self._first, self._first + int(np.searchsorted(self.times, before)) - 2)

    def source(self) -> Source:
        """The frames, as views."""
        times, rays, seen, axes, sensed = (array[self._first : self._end] for array in self._arrays)
        picture = np.zeros((len(times), seen.shape[1], 2), np.float32)
        return Source(times, rays, seen, axes, sensed, picture, self._R_camera_world)

    def _make_room(self) -> None:
        """Move the frames to the beginning of arrays at least twice as long as they are."""
        count = self._end - self._first
        for i, old in enumerate(self._arrays):
            new = np.zeros((max(len(old), 2 * count), *old.shape[1:]), old.dtype)
            new[:count] = old[self._first : self._end]
            self._arrays[i] = new
        self._first, self._end = 0, count
