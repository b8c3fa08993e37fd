"""Detected landmarks of one person in a video.

Axes are time, element, component. Missing is NaN in the value and 0 in the confidence. Beside the skeleton's landmarks
there may be the points of the detector that these were estimated from, named ``mediapipe33:LeftEar`` after its layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask, blocks_of
from rtof_kin.core.checks import checked_names, checked_rotations, checked_times, freeze, readonly, shared
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.over_time import OverTime
from rtof_kin.data.camera import Camera, CameraTurning
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import PoseSequence

_OF: Final = ":"  #: Between a layout and its point
_LONGEST_GAP: Final = 1.5  #: [frames] between detections that are interpolated


def detector_point(layout: str, point: str) -> str:
    """Return the name of a detector's own point in a `KeypointSequence`; point: of the layout, e.g. ``LeftEar``."""
    return f"{layout}{_OF}{point}"


def layout_and_point(name: str) -> tuple[str, str]:
    """Return layout and point of a name in a `KeypointSequence`; a landmark of the skeleton has the layout ``""``."""
    layout, _, point = name.rpartition(_OF)
    return layout, point


def blanked(uv_px: Array, confidence: Array) -> tuple[Array, Array]:
    """Return points (..., 2) and confidences (...), read-only, with NaN and 0 where either is missing; those that have
    it already as they are.
    """
    given = uv_px
    for rows in blocks_of(len(given)):
        missing = ~(np.isfinite(given[rows]).all(axis=-1) & (confidence[rows] > 0))
        if confidence[rows][missing].any() or not np.isnan(given[rows][missing]).all():
            if uv_px is given:
                uv_px, confidence = given.copy(), confidence.copy()
            uv_px[rows][missing], confidence[rows][missing] = np.nan, 0.0
    shared(uv_px, confidence)
    return uv_px, confidence


@dataclass(frozen=True)
class KeypointSequence(OverTime):
    """2D landmarks of one person seen by one camera."""

    camera: Camera  #: Camera of the video
    times: Array  #: (T,) seconds, strictly increasing
    uv_px: Array  #: (T, L, 2) pixels; NaN where not detected
    confidence: Array  #: (T, L) in [0, 1]; 0 where not detected
    names: tuple[str, ...]  #: L names of landmarks and of the detector's own points
    own_times: Array | None = None
    """(T,) seconds since the first frame of the video, where `times` are those of another clock."""
    turning: CameraTurning | None = None
    """Of the handheld camera that `camera` stands for; None if `camera` itself made the video, or unknown."""
    rows = ("uv_px", "confidence", "own_times", "turning")

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", checked_names("keypoint names", self.names))
        set_(self, "times", checked_times("keypoint times", self.times))
        T, L = len(self.times), len(self.names)
        freeze(self, "keypoints", uv_px=(T, L, 2), confidence=(T, L))
        if self.own_times is not None:
            freeze(self, "keypoints", own_times=(T,))
        if self.turning is not None:
            readonly("keypoints turning", self.turning.R_still_camera, (T, 3, 3))
        if np.any((self.confidence < 0) | (self.confidence > 1)):
            raise InvalidInputError("keypoints confidence: outside [0, 1]; divide by the detector's maximum")
        if np.any(np.isinf(self.uv_px)):
            raise InvalidInputError("keypoints uv_px: infinite; write NaN where a landmark was not seen")
        uv, confidence = blanked(self.uv_px, self.confidence)
        set_(self, "uv_px", uv)
        set_(self, "confidence", confidence)

    def columns(self) -> dict[str, Array]:
        """Return columns (T,) of a detector's table: times, and its own points, else landmarks."""
        named = list(map(layout_and_point, self.names))
        found = {"time": self.times}
        for i, (layout, name) in enumerate(named):
            if layout or not any(layout for layout, _ in named):
                found |= {f"{name}_{axis}": self.uv_px[:, i, k] for k, axis in enumerate("xy")}
                found[f"{name}_c"] = self.confidence[:, i]
        return found

    def at(self, frames: Any, uv_px: Array, confidence: Array) -> Self:
        """Return some of the frames with other points; uv_px: (T', L, 2). confidence: (T', L)."""
        return replace(self, **(self.cut(frames) | {"uv_px": uv_px, "confidence": confidence}))

    def on_clock(self, times: Array) -> Self:
        """Return the frames at their times on another clock; `video_times` stay. times: (T,) s."""
        same = np.array_equal(times, self.times)
        return self if same else replace(self, times=times, own_times=self.video_times)

    @property
    def video_times(self) -> Array:
        """(T,) seconds since the first frame of the video."""
        return self.times if self.own_times is None else self.own_times

    def resample(self, times: Array) -> Self:
        """Return the landmarks interpolated linearly to other times; missing frames stay missing. times: (T',) s."""
        if np.array_equal(times, self.times):
            return self
        max_gap = _LONGEST_GAP * float(np.median(np.diff(self.times))) if len(self) > 1 else 0.0
        return self.interpolated(times, times, max_gap)

    def interpolated(self, times: Array, at: Array, max_gap: float) -> Self:
        """Return the landmarks interpolated linearly. times: (T',) s, of the result. at: (T',) s, where to interpolate;
        may differ by rounding. max_gap: longest gap that is interpolated, s.
        """
        uv = signals.interpolate(self.times, self.uv_px, at, max_gap)
        confidence = signals.interpolate(self.times, self.confidence, at, max_gap)
        turning = None if self.turning is None else self.turning.resample(self.times, at)
        own = self.own_times
        if own is not None:
            own = at + np.interp(at, self.times, own - self.times)
        return replace(
            self,
            times=times,
            uv_px=uv,
            confidence=np.clip(np.nan_to_num(confidence), 0, 1),
            turning=turning,
            own_times=own,
        )

    def project(self, p_world: Array, frames: Any) -> Array:
        """Project points to pixels (n, ..., 2) of the upright video; NaN outside the camera's sight. p_world: (n, ...,
        3) m. frames: n of the T frames, as an index of arrays.
        """
        uv = self.camera.project(p_world)
        return uv if self.turning is None else self.turning.in_video(uv, frames)

    def in_video(self, frames: Any) -> Array:
        """Return the detected points (n, L, 2) in pixels of the upright video; frames: n of the T frames, as an index
        of arrays.
        """
        uv = self.uv_px[frames]
        return uv if self.turning is None else self.turning.in_video(uv, frames)

    @property
    def seen(self) -> Mask:
        """Mask (T, L) of detected landmarks."""
        return np.asarray(self.confidence > 0)

    @property
    def landmarks(self) -> Self:
        """The skeleton's landmarks alone, without the detector's own points."""
        kept = [i for i, name in enumerate(self.names) if not layout_and_point(name)[0]]
        if len(kept) == len(self.names):
            return self
        names = tuple(self.names[i] for i in kept)
        return replace(self, uv_px=self.uv_px[:, kept], confidence=self.confidence[:, kept], names=names)

    def select(self, names: Sequence[str]) -> Self:
        """Return landmarks in the order of `names`; missing ones are NaN with confidence 0."""
        uv = np.full((len(self), len(names), 2), np.nan)
        confidence = np.zeros((len(self), len(names)))
        for i, name in enumerate(names):
            if name in self.names:
                j = self.names.index(name)
                uv[:, i], confidence[:, i] = self.uv_px[:, j], self.confidence[:, j]
        return replace(self, uv_px=uv, confidence=confidence, names=tuple(names))


@dataclass(frozen=True)
class Measurements:
    """Detected points, measured orientations and reference of a motion; what is absent is empty or None."""

    times: Array  #: (T,) s, those of the motion
    views: tuple[KeypointSequence, ...] = ()
    """Landmarks of the skeleton seen by each camera at these times, and the cameras as calibrated."""
    sensors: tuple[str, ...] = ()  #: S names of the sensors
    segments: tuple[str, ...] = ()  #: S segments that carry them, by their proximal joint
    R_world_sensor: Array = field(default_factory=lambda: np.empty((0, 0, 3, 3)))
    """(T, S, 3, 3) measured orientation of the sensors in world, as calibrated; NaN as a whole where missing
    or rejected."""
    R_bone_sensor: Array = field(default_factory=lambda: np.empty((0, 3, 3)))
    """(S, 3, 3) mounting: sensor axes to those of the segment's link frame."""
    p_bone_sensor: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(S, 3) position of the sensors in the segment's link frame, m."""
    truth: PoseSequence | None = None  #: Known poses at these times
    faults: tuple[StreamFault, ...] = ()  #: Faults of keypoints and sensors, and how they were handled
    floor_height: float | None = None  #: z of a flat floor in world, m

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", checked_times("measurements times", self.times))
        set_(self, "sensors", checked_names("measurements: sensor", self.sensors))
        set_(self, "segments", checked_names("measurements: segment", self.segments))
        T, S = len(self.times), len(self.sensors)
        if len(self.segments) != S:
            raise InvalidInputError(f"measurements: {S} sensors, but {len(self.segments)} segments")
        if S == 0:
            set_(self, "R_world_sensor", np.empty((T, 0, 3, 3)))
        shapes = {"R_world_sensor": (T, S, 3, 3), "R_bone_sensor": (S, 3, 3), "p_bone_sensor": (S, 3)}
        freeze(self, "measurements", **shapes)
        for name in ("R_world_sensor", "R_bone_sensor"):
            checked_rotations(f"measurements {name}", getattr(self, name))
        for what, part in (*(("view", view) for view in self.views), ("truth", self.truth)):
            if part is not None and not np.array_equal(part.times, self.times):
                raise InvalidInputError(f"measurements: the {what} has other times")
