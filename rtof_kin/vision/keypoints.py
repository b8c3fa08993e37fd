"""Keypoints of one person from a detector's file, named as the skeleton's landmarks.

found = read_detector_keypoints("walk_json", camera, rate_hz=60.0)
found.keypoints            # input of a Recording
print(found.summary)       # detected layout, which person was tracked, ambiguous and lost frames
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, blocks_of
from rtof_kin.core.checks import shared
from rtof_kin.core.errors import InvalidInputError, reading
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence, blanked, detector_point
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
    """Keypoints of one person with their provenance."""

    keypoints: KeypointSequence  #: The skeleton's landmarks in the image, then the detector's own points
    recognition: Recognition  #: Layout of the detector
    track: PersonTrack  #: Index of the person in each frame

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
        return keypoints_from_detections(found, times, camera, layout, person, frame)


def keypoints_from_detections(
    found: Detections,
    times: Array,
    camera: Camera,
    layout: str | None = None,
    person: int | None = None,
    frame: int | None = None,
) -> DetectedKeypoints:
    """Compute keypoints of one person from detections in memory at times (T,), s; see `read_detector_keypoints`.
    `InvalidInputError`: unrecognised layout, no such person, or points outside the camera's image; `UnknownNameError`:
    unknown `layout`.
    """
    regression = LandmarkRegression.default()
    found = found.in_pixels(camera.width_px, camera.height_px)
    recognition = recognise(found.uv_px, found.confidence, found.names, layout, regression)
    if recognition.order != tuple(range(found.uv_px.shape[2])):
        found = found.of_points(recognition.order)
    track = track_person(found, times, person, frame, (camera.width_px, camera.height_px))
    form, names = recognition.layout, keypoint_names(recognition.layout, regression)
    uv, confidence = np.full((len(found), len(names), 2), np.nan), np.zeros((len(found), len(names)))
    seen, outside, reach, unseen = 0, 0, np.zeros(2), list[InvalidInputError]()
    for frames in blocks_of(len(found)):
        points = track.of(found, frames)
        shown = points[0][np.isfinite(points[0]).all(axis=-1)]
        seen, reach = seen + len(shown), np.fmax(reach, shown.max(axis=0, initial=0.0))
        outside += int(np.any((shown < 0) | (shown > [camera.width_px, camera.height_px]), axis=-1).sum())
        try:
            landmarks = regression.apply(form.name, *points)
        except InvalidInputError as error:
            unseen.append(error)
        else:
            uv[frames], confidence[frames] = blanked(*with_own_points(form, landmarks, *points))
    if outside > MOST_OUTSIDE * seen:  # the camera belongs to another video
        raise InvalidInputError(
            f"{100 * outside / seen:.0f} % of the points lie outside of the camera's image of "
            f"{camera.width_px} x {camera.height_px} px (they reach to {reach[0]:.0f}, {reach[1]:.0f}); give "
            "the camera that belongs to this video"
        )
    if unseen and not confidence.any():
        raise unseen[0]
    shared(uv, confidence)
    return DetectedKeypoints(KeypointSequence(camera, times, uv, confidence, names), recognition, track)


def keypoint_names(form: Layout, regression: LandmarkRegression) -> tuple[str, ...]:
    """Return the names of the skeleton's landmarks that a layout gives, then of its own points."""
    own = () if form.name in OWN_LAYOUTS else tuple(detector_point(form.name, p) for p in form.points)
    return regression.landmarks(form) + own


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
