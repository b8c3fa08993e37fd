"""The turning of the camera of a video, by its background and by the log of the phone that filmed.

found = turning_of_video("walk.mp4", detections, camera, 0.15, phone="gyroscope.csv")
if found.turning().failed:                                         # held by hand
    write_camera_motion(Path("camera_motion.npz"), found.motion)   # [camera.motion] file
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.data.camera import Camera
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.phone import phone_files, read_phone
from rtof_kin.inertial.camera_gyroscope import match_to_image, with_gravity
from rtof_kin.setup.camera_prior import SetupCamera
from rtof_kin.setup.recording_text import Field, Origin
from rtof_kin.vision.background_motion import BackgroundMotion, estimate_camera_motion
from rtof_kin.vision.detections import Detections

MOTION: Final = "camera_motion.npz"
"""File of a recording's folder."""
Progress = Callable[[str, int, int], None]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FilmingCamera:
    """The camera of a take, and how it turned."""

    camera: SetupCamera
    motion: CameraMotion | None = None
    """None where it stood still, or nothing tells."""
    doubts: tuple[str, ...] = ()


def filming_camera(
    video: Path | None, people: Detections, camera: SetupCamera, phone: Path | None, progress: Progress
) -> FilmingCamera:
    """Find out whether a camera stood still; of one that turned, its focal length follows too.

    Args:
        video: None where there is none. progress: called with ("camera", frames done, in total).

    Raises:
        InvalidInputError: a log without a video. FileFormatError: the log cannot be read.
    """
    if video is None:
        if phone is not None:
            raise InvalidInputError(f"{phone}: give the video too, which tells the time between both")
        return FilmingCamera(camera)
    unsure = camera.camera.uncertainty
    try:
        found = turning_of_video(
            video, people, camera.camera, unsure.focal if unsure else 0.0, phone=phone, progress=progress
        )
    except FileFormatError:
        raise
    except RtofError as error:  # nothing to follow, or OpenCV is not installed
        return FilmingCamera(camera, None, (f"whether the camera stood still is not known: {error}",))
    if found.turning().passed:
        return FilmingCamera(camera)
    fields = dict(camera.fields)
    if unsure is not None and found.sigma_focal < unsure.focal:
        focal, sigma = round(float(found.camera.K[0, 0]), 1), round(found.sigma_focal, 4)
        why = f"focal length {focal:.0f} px ± {100 * sigma:.0f} %, by how the background moves as it turns"
        fields["focal_px"] = Field(focal, Origin.FOUND, why, why)
        uncertainty = fields["uncertainty"]
        assert not isinstance(uncertainty, Field)
        fields["uncertainty"] = {**uncertainty, "focal": Field(sigma, note="standard deviations: relative,")}
        camera = SetupCamera(replace(camera.camera, K=found.camera.K, uncertainty=replace(unsure, focal=sigma)), fields)
    fields["motion"] = {"file": Field(MOTION, Origin.FOUND, "keypoints are stabilised by it", found.summary)}
    return FilmingCamera(SetupCamera(camera.camera, fields), found.motion)


def turning_of_video(
    video: str | Path,
    people: Detections | KeypointSequence | None,
    camera: Camera,
    sigma_focal: float,
    *,
    phone: str | Path | None = None,
    progress: Progress | None = None,
) -> BackgroundMotion:
    """Estimate the turning of a camera, and its focal length where it turned.

    Args:
        video, people, camera, sigma_focal: as for `estimate_camera_motion`.
        phone: log of the gyroscope of the phone that filmed, and of its accelerometer, which gives the tilt.
        progress: called with ("camera", frames done, in total).

    Raises:
        FileFormatError: a file cannot be read. InvalidInputError: the background has nothing to follow, or
            the log no gyroscope. RtofError: the extra ``video`` is not installed.
    """
    found = estimate_camera_motion(video, people, camera, sigma_focal=sigma_focal, progress=progress)
    if phone is None:
        return found
    files = phone_files(Path(phone))
    stream = (read_phone(files) if files else read_sensor_log(phone)).streams[0]
    match = match_to_image(stream, found.motion)
    if match.doubt:
        _log.warning("%s: %s; it is not used", phone, match.doubt)
        return found
    _log.info("%s: held %s, %+.3f s to the clock of the video", phone, match.held, match.offset)
    return replace(found, motion=with_gravity(found.motion, stream, match))
