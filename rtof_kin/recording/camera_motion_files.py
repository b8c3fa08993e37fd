"""Keypoints of a recording and their camera, which may turn: the table ``[camera.motion]``."""

from __future__ import annotations

import logging
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera import Camera
from rtof_kin.data.camera_motion import CameraMotion, still_camera_of, turned
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.camera_motion_npz import read_camera_motion
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.phone import phone_files, read_phone
from rtof_kin.inertial.orientation import HELD, held_of_gravity, motion_of_gyroscope
from rtof_kin.recording.camera_table import read_camera
from rtof_kin.recording.files import data_path, keypoint_stream, naming
from rtof_kin.recording.sources import Source
from rtof_kin.recording.streams import Stream

_FOCAL: Final = 0.05  # relative difference of the focal length that is remarked on
_log = logging.getLogger(__name__)


def filmed_stream(
    camera: Section, keypoints: Section, skeleton: SkeletonModel, source: Source
) -> tuple[Stream[KeypointSequence], str]:
    """Read a camera and open its keypoints; those of a camera that turns are stabilised.

    Args:
        camera: table ``[camera]``. keypoints: table ``[keypoints]``.

    Returns:
        The keypoints, and a note about the turning, empty without one.
    """
    seen = read_camera(camera)
    found = keypoint_stream(keypoints, seen, skeleton, source)
    if not camera.has("motion"):
        return found, ""
    return _stabilised_as_declared(found, seen, camera.table("motion"))


def _stabilised_as_declared(
    keypoints: Stream[KeypointSequence], camera: Camera, section: Section
) -> tuple[Stream[KeypointSequence], str]:
    """Return the keypoints of a still camera, and a note about it.

    Args:
        section: table ``[camera.motion]``.

    Raises:
        FileFormatError: no such file, damaged, or of another time. UnknownNameError: unknown sensor.
    """
    motion = _read(section).shifted(section.number("start_s", 0.0))
    section.close()
    with naming(section.path):
        times = checked_times("keypoint times", keypoints.times)
        R_still_camera, still_camera = still_camera_of(camera, times, motion)

    def part(rows: slice) -> KeypointSequence:
        return turned(keypoints.part(rows), R_still_camera[rows], still_camera)

    focal = float(np.trace(camera.K[:2, :2])) / 2
    if motion.focal_px is not None and abs(motion.focal_px / focal - 1) > _FOCAL:
        _log.warning(
            "%s: the turning was estimated with a focal length of %.0f px, [camera] has %.0f px; its angles "
            "are wrong by their ratio: give both the same",
            section.path,
            motion.focal_px,
            focal,
        )
    note = (
        f"The camera turned by up to {np.degrees(np.nanmax(motion.angles)):.0f} deg; the keypoints are those "
        "of a camera that stands still in the mean orientation. The translation of the hand is not modelled."
    )
    if motion.sigma:
        note += f" The turning is known to {np.degrees(motion.sigma):.2f} deg."
    if lost := _lost(keypoints, R_still_camera, still_camera):
        note += f" {lost} points are left out where it is unknown or turned too far."
    return Stream(times, part), note


def _lost(keypoints: Stream[KeypointSequence], R_still_camera: Array, still: Camera) -> int:
    """Return the number of points that a camera that stands still does not see."""
    lost, start = 0, 0
    for part in keypoints.blocks():
        R = R_still_camera[start : start + len(part)]
        lost += int(part.seen.sum() - turned(part, R, still).seen.sum())
        start += len(part)
    return lost


def _read(section: Section) -> CameraMotion:
    path = data_path(section, or_folder=True)
    if path.suffix.lower() == ".npz":
        return read_camera_motion(path)
    phone = phone_files(path)
    log = read_phone(phone) if phone else read_sensor_log(path)
    stream = log.select([section.text("sensor", log.names[0])]).streams[0]
    held = section.optional_text("held")
    if held is not None and held not in HELD:
        raise section.error("held", f"{held!r} is not known; write one of {', '.join(HELD)}")
    with naming(path):
        return motion_of_gyroscope(stream, HELD[held or held_of_gravity(stream)])
