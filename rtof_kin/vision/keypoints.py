"""Keypoints of one person from a detector's file, named as the skeleton's landmarks.

found = read_detector_keypoints("walk_json", camera, rate_hz=60.0)
found.keypoints            # input of a Recording
print(found.summary)       # detected layout, which person was tracked, ambiguous and lost frames
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, blocks_of
from rtof_kin.core.checks import shared
from rtof_kin.core.errors import InvalidInputError, reading
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence, detector_point
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.landmark_regression import (
    LEAST_CONFIDENCE,
    LandmarkRegression,
    Recognition,
    RegressedLandmarks,
    recognise,
)
from rtof_kin.vision.layouts import OWN_LAYOUTS, Layout
from rtof_kin.vision.tracking import PersonTrack, track_person

MOST_OUTSIDE: Final = 0.5  # [-] largest fraction of the detected points that may lie outside the image


@dataclass(frozen=True)
class DetectedKeypoints:
    """Keypoints of one person with their provenance; they are computed at their first use, or block by block."""

    detections: Detections  #: Points in px, in the layout's order
    times: Array  #: (T,) s
    camera: Camera
    recognition: Recognition  #: Layout of the detector
    track: PersonTrack  #: Index of the person in each frame
    path: Path | None = None  #: The detector's file, if it is one, which errors name

    @cached_property
    def keypoints(self) -> KeypointSequence:
        """The skeleton's landmarks in the image, then the detector's own points; errors of `blocks`."""
        parts, names = self.blocks(), keypoint_names(self.recognition.layout)
        uv, confidence = np.empty((len(self.times), len(names), 2)), np.empty((len(self.times), len(names)))
        for frames, part in zip(blocks_of(len(self.times)), parts, strict=True):
            uv[frames], confidence[frames] = part.uv_px, part.confidence
        shared(uv, confidence)
        return KeypointSequence(self.camera, self.times, uv, confidence, names)

    def blocks(self) -> Iterator[KeypointSequence]:
        """Yield the `keypoints` of frames that follow one another. `InvalidInputError`, after the last ones: the points
        lie outside of the camera's image, or no landmark can be estimated from them.
        """
        regression, form, camera = LandmarkRegression.default(), self.recognition.layout, self.camera
        names, seen, outside, reach = keypoint_names(form), 0, 0, np.zeros(2)
        known, unseen = False, list[InvalidInputError]()
        with nullcontext() if self.path is None else reading(self.path):
            for frames in blocks_of(len(self.times)):
                points = self.track.of(self.detections, frames)
                shown = points[0][np.isfinite(points[0]).all(axis=-1)]
                seen, reach = seen + len(shown), np.fmax(reach, shown.max(axis=0, initial=0.0))
                outside += int(np.any((shown < 0) | (shown > [camera.width_px, camera.height_px]), axis=-1).sum())
                try:
                    uv, confidence = with_own_points(form, regression.apply(form.name, *points), *points)
                except InvalidInputError as error:
                    unseen.append(error)
                    confidence = np.zeros((len(points[0]), len(names)))
                    uv = np.full((*confidence.shape, 2), np.nan)
                known |= bool(confidence.any())
                yield KeypointSequence(camera, self.times[frames], uv, confidence, names)
            if outside > MOST_OUTSIDE * seen:  # the camera belongs to another video
                raise InvalidInputError(
                    f"{100 * outside / seen:.0f} % of the points lie outside of the camera's image of "
                    f"{camera.width_px} x {camera.height_px} px (they reach to {reach[0]:.0f}, {reach[1]:.0f}); give "
                    "the camera that belongs to this video"
                )
            if unseen and not known:
                raise unseen[0]

    @property
    def summary(self) -> str:
        """Layout, tracked person, ambiguous and lost frames as text."""
        track, T = self.track, len(self.track.person)
        parts = [f"layout {self.recognition.layout.name}, {self.recognition.reason}"]
        if track.people > 1:
            numbers = ", ".join(str(p + 1) for p in np.unique(track.person[~track.lost]))
            parts.append(f"{track.people} people; followed person {numbers}, {track.reason}")
        for what, frames in (("ambiguous", track.ambiguous), ("lost", track.lost)):
            if runs := signals.runs(frames):
                first = [f"{start}-{stop - 1}" if stop - start > 1 else str(start) for start, stop in runs]
                parts.append(
                    f"{what} in {frames.sum()} of {T} frames ({', '.join(first[:3])}{', ...' * (len(runs) > 3)})"
                )
        return "; ".join(parts)


def read_detector_keypoints(
    path: str | Path,
    camera: Camera,
    *,
    layout: str | None = None,
    rate_hz: float | None = None,
    start: float = 0.0,
    person: int | None = None,
    frame: int | None = None,
) -> DetectedKeypoints:
    """Read keypoints of one person from a detector's file or folder. `FileFormatError`: damaged, unknown format or
    layout, no people, or neither times nor a rate; `UnknownNameError`: unknown `layout`.

    Args:
        path: see `rtof_kin.vision.keypoint_files`.
        camera: camera of the video; its image size scales fractions of the image to pixels.
        layout: name of the points' layout; recognised if None, else verified.
        rate_hz: frame rate, for files without times. start: s, added to all times.
        person: index of the person among those of `frame`; chosen automatically if None.
        frame: frame of `person`; the first with people if None.
    """
    path = Path(path)
    found = read_detector_file(path, camera.width_px, camera.height_px, layout)
    with reading(path):
        times = _times(found, rate_hz) + start
        return keypoints_from_detections(found, times, camera, layout, person, frame, path)


def keypoints_from_detections(
    found: Detections,
    times: Array,
    camera: Camera,
    layout: str | None = None,
    person: int | None = None,
    frame: int | None = None,
    path: Path | None = None,
) -> DetectedKeypoints:
    """Return keypoints of one person of detections in memory at times (T,), s; see `read_detector_keypoints`.
    `InvalidInputError`: unrecognised layout, or no such person; `UnknownNameError`: unknown `layout`.
    """
    found = found.in_pixels(camera.width_px, camera.height_px)
    recognition = recognise(found.uv_px, found.confidence, found.names, layout)
    if recognition.order != tuple(range(found.uv_px.shape[2])):
        found = found.of_points(recognition.order)
    track = track_person(found, times, person, frame, (camera.width_px, camera.height_px))
    return DetectedKeypoints(found, times, camera, recognition, track, path)


def keypoint_names(form: Layout) -> tuple[str, ...]:
    """Return the names of the skeleton's landmarks that a layout gives, then of its own points."""
    own = () if form.name in OWN_LAYOUTS else tuple(detector_point(form.name, p) for p in form.points)
    return LandmarkRegression.default().landmarks(form) + own


def with_own_points(form: Layout, landmarks: RegressedLandmarks, uv: Array, confidence: Array) -> tuple[Array, Array]:
    """Return points (T, L, 2), px, and confidence (T, L) of `keypoint_names`. uv: (T, K, 2) px. confidence: (T, K)."""
    K = 0 if form.name in OWN_LAYOUTS else len(form)
    sure = np.where(confidence >= LEAST_CONFIDENCE, confidence, 0.0)[:, :K]
    return (np.concatenate([landmarks.uv_px, uv[:, :K]], axis=1), np.concatenate([landmarks.confidence, sure], axis=1))


def _times(found: Detections, rate_hz: float | None) -> Array:
    if found.times is not None:
        if rate_hz is not None:
            raise InvalidInputError("has times of its own; leave rate_hz out, or the times")
        return found.times
    if rate_hz is None or not (np.isfinite(rate_hz) and rate_hz > 0):
        raise InvalidInputError("has no times; give rate_hz, the video's frames per second")
    return np.arange(len(found)) / rate_hz
