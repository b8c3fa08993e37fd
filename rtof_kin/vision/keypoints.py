"""From a detector's file to keypoints of one person, named as the skeleton's landmarks.

found = read_detector_keypoints("walk_json", camera, rate_hz=60.0)
found.keypoints            # what a Recording is made of
print(found.summary)       # which layout and why, whom of how many, where in doubt and where lost
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import signals
from rtof_kin.core.errors import FileFormatError, ShapeError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.landmark_regression import LandmarkRegression, RegressedLandmarks
from rtof_kin.vision.recognise import Recognition, recognise
from rtof_kin.vision.tracking import PersonTrack, track_person

Array = NDArray[np.float64]

MOST_OUTSIDE = 0.5
"""Share of the points seen that may lie outside of the image."""


@dataclass(frozen=True)
class DetectedKeypoints:
    """Keypoints of one person, and how they came about."""

    keypoints: KeypointSequence
    """The skeleton's landmarks in the image."""
    landmarks: RegressedLandmarks
    """The same with the expected error of each."""
    recognition: Recognition
    """The layout, and why."""
    track: PersonTrack
    """Which of the people in each frame, where in doubt and where lost."""

    @property
    def summary(self) -> str:
        """What was done, in a few sentences."""
        track, T = self.track, len(self.track.person)
        said = [f"layout {self.recognition.layout.name}, {self.recognition.reason}"]
        if track.people > 1:
            numbers = sorted({int(p) for p in track.person if p >= 0})
            said.append(
                f"{track.people} people; followed the one who is number "
                f"{', '.join(map(str, numbers))} in the frames, {track.reason}"
            )
        for what, frames in (("in doubt", track.ambiguous), ("lost", track.lost)):
            if frames.any():
                said.append(f"{what} in {frames.sum()} of {T} frames ({_runs(frames)})")
        return "; ".join(said)


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
    """Keypoints of one person from a detector's file or folder.

    Args:
        path: see `rtof_kin.vision.keypoint_files`.
        camera: the camera; its image's size is needed where coordinates are shares of it.
        layout: name of the points' layout; recognised where not given, confirmed where given.
        rate_hz: frames per second, where the file has no times. start: s, added to all times.
        person: number of the person to follow among the people of `frame`; picked where not given.
        frame: the frame in which `person` is that number; the first with anybody where not given.

    Raises:
        FileFormatError: the file is damaged or of no known format, its points are not in that layout or
            in none, nobody is in it, or it says nothing about time and no rate is given.
        UnknownNameError: there is no such layout.
    """
    path = Path(path)
    found = read_detector_file(path, camera.width_px, camera.height_px)
    try:
        times = _times(found, rate_hz) + start
        return keypoints_from_detections(found, times, camera, layout, person, frame)
    except ShapeError as error:
        raise FileFormatError(path, str(error)) from error


def keypoints_from_detections(
    found: Detections,
    times: Array,
    camera: Camera,
    layout: str | None = None,
    person: int | None = None,
    frame: int | None = None,
) -> DetectedKeypoints:
    """Keypoints of one person from detections in memory; arguments as of `read_detector_keypoints`.

    Raises:
        ShapeError, UnknownNameError: as there.
    """
    adapter = LandmarkRegression.default()
    found = found.in_pixels(camera.width_px, camera.height_px)
    recognition = recognise(found.uv_px, found.confidence, found.names, layout, adapter)
    found = found.ordered(recognition.order)
    track = track_person(found, times, person, frame, (camera.width_px, camera.height_px))
    uv, confidence = track.of(found)
    _check_inside(uv, camera)
    adapted = adapter.apply(recognition.layout.name, uv, confidence)
    keypoints = KeypointSequence(camera, times, adapted.uv_px, adapted.confidence, adapted.names)
    return DetectedKeypoints(keypoints, adapted, recognition, track)


def _check_inside(uv: Array, camera: Camera) -> None:
    """Refuse points that are mostly outside of the camera's image: it is another image's camera."""
    seen = np.isfinite(uv).all(axis=-1)
    outside = np.any((uv < 0) | (uv > [camera.width_px, camera.height_px]), axis=-1)[seen]
    if len(outside) and outside.mean() > MOST_OUTSIDE:
        right, down = np.nanmax(uv, axis=(0, 1))
        raise ShapeError(
            f"{100 * outside.mean():.0f} % of the points lie outside of the camera's image of "
            f"{camera.width_px} x {camera.height_px} px (they reach to {right:.0f}, {down:.0f}); give "
            "the camera that belongs to this video, for its size"
        )


def _times(found: Detections, rate_hz: float | None) -> Array:
    if found.times is not None:
        if rate_hz is not None:
            raise ShapeError("has times of its own; leave rate_hz out, or the times")
        return found.times
    if rate_hz is None or not (np.isfinite(rate_hz) and rate_hz > 0):
        raise ShapeError("has no times; give rate_hz, the video's frames per second")
    return np.arange(len(found)) / rate_hz


def _runs(frames: NDArray[np.bool_]) -> str:
    """Frames in words: the first three runs."""
    runs = list(signals.runs(frames))
    text = [f"{start}-{stop - 1}" if stop - start > 1 else str(start) for start, stop in runs[:3]]
    return ", ".join(text) + (", ..." if len(runs) > 3 else "")
