"""The turning of the camera of a video about which nothing is known, by its background and the phone's log.

found = turning_of_video("walk.mp4", detections, phone="gyroscope.csv")
if found.turning().failed:                                     # held by hand
    write_camera_motion(Path("camera_motion.npz"), found.motion)   # [camera.motion] file
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.phone import phone_files, read_phone
from rtof_kin.inertial.camera_gyroscope import match_to_image, with_gravity
from rtof_kin.vision.background_motion import BackgroundMotion, estimate_camera_motion
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.lens_prior import lens_prior
from rtof_kin.vision.video_metadata import read_video_metadata

_log = logging.getLogger(__name__)


def turning_of_video(
    video: str | Path,
    people: Detections | KeypointSequence | None,
    *,
    phone: str | Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> BackgroundMotion:
    """Estimate the turning of a camera, and its focal length where it turned.

    Args:
        video: file. people: detected in it. phone: log of the gyroscope of the phone that filmed, and of its
            accelerometer, which gives the tilt. progress: called with ("camera", frames done, in total).

    Raises:
        FileFormatError: a file cannot be read. InvalidInputError: the background has nothing to follow, or
            the log no gyroscope. RtofError: the extra ``video`` is not installed.
    """
    metadata = read_video_metadata(video)
    width, height = metadata.width_px, metadata.height_px
    prior = lens_prior(width, height, metadata)
    camera = Camera.looking_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], prior.focal_px, width, height)
    camera = replace(camera, distortion=np.array([prior.k1, 0.0, 0.0, 0.0, 0.0]))
    found = estimate_camera_motion(video, people, camera, sigma_focal=prior.sigma_focal, progress=progress)
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
