"""`ProjectedMotion`: a motion in the pixels of a picture, at the times of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import ObservationMasks, observed_landmarks
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.measurements_file import MeasurementsReader
from rtof_kin.view.blocks import Nearby

_SIZE: Final = (1280, 720)  # [px] of a virtual camera's picture
_FOCAL_PX: Final = 1400.0
_CLOSER: Final = 0.78125
"""Distance of the camera, over that at which a sphere around all points just fits into the picture: people
are narrower than the sphere."""
_STANDS: Final = 2.5  # [m] largest radius of a motion that is seen whole; a larger one is followed
_LONGEST_GAP: Final = 2.5  # [frames] between poses that are interpolated
_AT_ENDS: Final = 0.75  # [frames] before the first and after the last pose in which that is shown
_NEAR: Final = 1e-3  # [frames] from a pose within which it is not interpolated
_STEP: Final = 1e-3  # [m] of the differences that give the derivative of the projection
_WEAKEST: Final = int(Provenance.PRIOR)


@dataclass(frozen=True)
class VirtualView:
    """A camera that looks at the person from the front, for motions without a camera."""

    camera: Camera  #: The virtual camera
    moved: Array  #: (T, 3) m, subtracted from all points of a frame: the way of a person that is followed

    def project(self, p_world: Array, frames: Any) -> Array:
        """Project points to pixels (n, ..., 2). `p_world`: (n, ..., 3) m. `frames`: (n,) of the motion."""
        moved = self.moved[np.asarray(frames)]
        return self.camera.project(p_world - moved.reshape(len(moved), *[1] * (p_world.ndim - 2), 3))

    def in_video(self, frames: Any) -> Array:
        """Return no points (n, 0, 2). `frames`: (n,) of the motion."""
        return np.zeros((len(np.asarray(frames)), 0, 2))


@dataclass(frozen=True)
class PictureView:
    """A camera with the frames of a motion, in a picture of any size."""

    camera: Camera  #: With the size of the picture; the rest is of the recorded one
    names: tuple[str, ...]  #: L names of the detected points
    video_times: Array  #: (T,) s of the motion's frames, on the clock of the pictures
    parts: Nearby[KeypointSequence | VirtualView]  #: The frames, in pixels as recorded
    scale: float = 1.0  #: Pixels of the picture per recorded pixel

    @classmethod
    def of(cls, measurements: MeasurementsReader, number: int) -> Self:
        """Return a camera of a motion. `number`: of it, from 0."""
        first, times = measurements.read(0, 1).views[number], measurements.video_times(number)
        parts = Nearby(len(times), lambda start, stop: measurements.read(start, stop).views[number])
        return cls(first.camera, first.names, times, parts)

    def scaled(self, scale: float, size: tuple[int, int], video_times: Array) -> Self:
        """Return the view in a picture of another size, px. `video_times`: (T,) s."""
        camera = replace(self.camera, width_px=size[0], height_px=size[1])
        return replace(self, camera=camera, scale=scale, video_times=video_times)

    def project(self, p_world: Array, frames: Index) -> Array:
        """Project points (n, ..., 3) m of frames (n,), next to each other, to pixels (n, ..., 2) of the picture."""
        part, own = self.parts.at(frames)
        return self._scaled(part.project(p_world, own))

    def in_video(self, frames: Index) -> Array:
        """Return detected points (n, L, 2) in the picture. `frames`: (n,) of the motion, next to each other."""
        part, own = self.parts.at(frames)
        return self._scaled(part.in_video(own))

    def _scaled(self, uv: Array) -> Array:
        """The first pixel's centre is (0, 0) in both pictures."""
        return (uv + 0.5) * self.scale - 0.5


def virtual_view(motion: Motion | MotionSource) -> PictureView:
    """Return a camera in front of the person that sees all of the motion, or follows it where it is long.
    `InvalidInputError`: no frame of the motion has a pose.
    """
    parts = [_whole_poses(block.motion.poses) for block in MotionSource.of(motion).blocks()]
    known: Mask = np.concatenate([seen for seen, *_ in parts])
    if not known.any():
        raise InvalidInputError("overlay: no frame of the motion has a pose, so there is nothing to show")
    points = [p for _, p, _ in parts if len(p)]
    moved = np.zeros((len(known), 3))
    middle, radius = _sphere(points)
    if radius > _STANDS:
        level = (1.0, 1.0, 0.0)
        moved[known] = np.concatenate([p[:, 0] for p in points]) * level
        middle, radius = _sphere([p - p[:, :1] * level for p in points])
    ahead = np.concatenate([axis for *_, axis in parts]).sum(axis=0) * (1.0, 1.0, 0.0)
    norm = float(np.linalg.norm(ahead))
    ahead = ahead / norm if norm > 1e-3 else np.array([1.0, 0.0, 0.0])
    distance = radius + _CLOSER * radius * 2 * _FOCAL_PX / min(_SIZE)  # from which all points are seen
    position = middle + distance * ahead + np.array([0.0, 0.0, 0.1 * distance])
    camera = Camera.looking_at(position, middle, _FOCAL_PX, *_SIZE)
    views = Nearby(len(moved), lambda start, stop: VirtualView(camera, moved[start:stop]))
    return PictureView(camera, (), motion.times, views)


def _whole_poses(poses: PoseSequence) -> tuple[Mask, Array, Array]:
    """Return a mask (T,) of frames without a gap, and of these the positions (n, J, 3) and the root's x axis (n, 3)."""
    p, R = poses.p_world_joint, poses.R_world_bone[:, 0]
    known: Mask = np.asarray(np.isfinite(p).all(axis=(1, 2)) & np.isfinite(R).all(axis=(1, 2)))
    return known, p[known], R[known, :, 0]


def _sphere(parts: Sequence[Array]) -> tuple[Array, float]:
    """Return the middle (3,) of points, parts (n, J, 3), and their largest distance from it, m."""
    ends = np.array([(p.min(axis=(0, 1)), p.max(axis=(0, 1))) for p in parts])
    middle = (ends[:, 0].min(axis=0) + ends[:, 1].max(axis=0)) / 2
    return middle, max(float(np.linalg.norm(p - middle, axis=-1).max()) for p in parts)


@dataclass(frozen=True)
class Moment:
    """An instant between two frames of a motion."""

    before: int  #: Frame of the motion
    after: int  #: The same frame or the next one
    weight: float  #: Of the second one, 0 to 1

    @property
    def frames(self) -> NDArray[np.int_]:
        """(2,) both frames."""
        return np.array([self.before, self.after])

    def mix(self, values: Array) -> Array:
        """Interpolate values (2, ...) of both frames. `values`: of `frames`."""
        if self.weight == 0:
            return np.asarray(values[0])
        return np.asarray((1 - self.weight) * values[0] + self.weight * values[1])


@dataclass(frozen=True)
class ProjectedPose:
    """A person in a picture."""

    time: float  #: s, of the motion
    uv_px: Array
    """(P, 2) pixels of the joints and the ends of the limbs; NaN where unobserved or behind the camera, and
    all where no joint is observed."""
    provenance: NDArray[np.uint8]  #: (P,) `Provenance`; of the weaker frame where two are interpolated


class ProjectedMotion:
    """A motion with the ends of its limbs (head, hands, toes) in the pixels of a view."""

    def __init__(self, given: Motion | MotionSource, view: PictureView):
        motion = MotionSource.of(given)
        self.motion, self.view = motion, view
        self.nearby = Nearby(len(motion), motion.read)
        """The motion around a frame."""
        skeleton = motion.skeleton
        ends = limb_ends(skeleton)
        J = len(skeleton.names)
        self.bones = (
            *((parent, j) for j, parent in enumerate(skeleton.parents) if parent >= 0),
            *((skeleton.names.index(skeleton.landmarks[end][0]), J + i) for i, end in enumerate(ends)),
        )
        """Pairs of points: parent, child."""
        self.names = (*skeleton.names, *ends)
        """P names of the points."""
        self._ends = [list(skeleton.landmarks).index(end) for end in ends]
        self._known: Mask = np.concatenate(
            [np.any(np.isfinite(block.motion.poses.p_world_joint).all(axis=2), axis=1) for block in motion.blocks()]
        )
        joints = shown_provenance(motion.masks)
        own = joints[:, [skeleton.names.index(skeleton.landmarks[end][0]) for end in ends]]
        seen = observed_landmarks(motion.masks)[:, self._ends]
        self.provenance = np.concatenate([joints, np.where(seen, own, np.minimum(own, _WEAKEST))], axis=1)
        """(T, P) `Provenance` of the points."""
        times = view.video_times
        self._step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / 60

    @property
    def provenances(self) -> tuple[Provenance, ...]:
        """Those that are drawn."""
        drawn = self.provenance[self.provenance > _WEAKEST]
        return tuple(Provenance(int(value)) for value in np.unique(drawn))

    def moment(self, video_time: float) -> Moment | None:
        """Return the frames of the motion at an instant of the video; None where there is no motion.

        `video_time`: s, in the time of the video.
        """
        times, margin = self.view.video_times, _AT_ENDS * self._step
        if not times[0] - margin <= video_time <= times[-1] + margin:
            return None
        after = int(np.clip(np.searchsorted(times, video_time), 0, len(times) - 1))
        before = max(after - 1, 0)
        gap = times[after] - times[before]
        weight = float(np.clip((video_time - times[before]) / gap, 0, 1)) if gap > 0 else 1.0
        if weight * gap < _NEAR * self._step:
            after, weight = before, 0.0
        elif (1 - weight) * gap < _NEAR * self._step:
            before, weight = after, 0.0
        elif gap > _LONGEST_GAP * self._step:
            return None
        return Moment(before, after, weight) if self._known[[before, after]].all() else None

    def pose(self, moment: Moment) -> ProjectedPose:
        """Return the person at an instant."""
        frames = moment.frames
        motion, own = self.nearby.at(frames)
        p, R = motion.poses.p_world_joint[own], motion.poses.R_world_bone[own]
        points = np.concatenate([p, self.motion.skeleton.landmark_positions(p, R)[:, self._ends]], axis=1)
        uv = moment.mix(self.view.project(points, frames))
        provenance = self.provenance[frames].min(axis=0)
        drawn = (provenance > _WEAKEST) & (provenance >= Provenance.IMU).any()
        uv = np.where(drawn[:, None], uv, np.nan)
        return ProjectedPose(float(moment.mix(self.motion.times[frames])), uv, provenance)

    def detected(self, moment: Moment) -> Array:
        """Return detected points (L, 2) px at an instant, NaN where there are none."""
        return moment.mix(self.view.in_video(moment.frames))

    def covariance_px(self, frame: int) -> Array | None:
        """Return covariances (J, 2, 2) px^2 of the joints in the picture; None without a confidence."""
        motion, own = self.nearby.at(np.array([frame]))
        if motion.confidence is None:
            return None
        moved = motion.poses.p_world_joint[own, :, None] + _STEP * np.vstack([np.zeros(3), np.eye(3)])
        uv = self.view.project(moved, np.array([frame]))[0]
        J = np.swapaxes(uv[:, 1:] - uv[:, :1], -1, -2) / _STEP
        return np.asarray(J @ motion.confidence.position_covariance[own[0]] @ np.swapaxes(J, -1, -2))


def shown_provenance(motion: Motion | ObservationMasks) -> NDArray[np.uint8]:
    """Return `Provenance` (T, J) as it is drawn: unreliable positions count as unobserved.

    A motion without provenance, e.g. of motion capture, counts as seen by a camera where it is valid.
    """
    masks = ObservationMasks.of(motion)
    given = masks.provenance if masks.has_provenance else np.full(masks.provenance.shape, Provenance.CAMERA)
    shown = np.where(masks.valid, given, np.minimum(given, _WEAKEST))
    return np.asarray(shown, dtype=np.uint8)


def limb_ends(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return the farthest landmark of each joint without children: top of the head, hand ends, toes."""
    leaves = [name for j, name in enumerate(skeleton.names) if j not in skeleton.parents]
    out = []
    for leaf in leaves:
        own = {
            name: float(np.linalg.norm(offset))
            for name, (joint, offset) in skeleton.landmarks.items()
            if joint == leaf and name != leaf
        }
        out += [max(own, key=own.__getitem__)] if own else []
    return tuple(out)
