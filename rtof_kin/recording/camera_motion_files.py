"""Keypoints of a recording and their camera, which may turn: the table ``[camera.motion]``."""

from __future__ import annotations

import logging
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.camera_motion_npz import read_camera_motion
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.phone import phone_files, read_phone
from rtof_kin.inertial.camera_gyroscope import HELD, held_of_gravity, motion_of_gyroscope
from rtof_kin.recording.camera_table import read_camera
from rtof_kin.recording.files import data_path, naming, read_keypoints

_FOCAL: Final = 0.05  # relative difference of the focal length that is remarked on
_log = logging.getLogger(__name__)


def read_filmed(camera: Section, keypoints: Section, skeleton: SkeletonModel) -> tuple[KeypointSequence, str]:
    """Read a camera and its keypoints; those of a camera that turns are stabilised.

    Args:
        camera: table ``[camera]``. keypoints: table ``[keypoints]``. skeleton: that has the landmarks.

    Returns:
        The keypoints, and a note about the turning, empty without one.
    """
    found = read_keypoints(keypoints, read_camera(camera), skeleton)
    return _stabilised_as_declared(found, camera.table("motion")) if camera.has("motion") else (found, "")


def _stabilised_as_declared(keypoints: KeypointSequence, section: Section) -> tuple[KeypointSequence, str]:
    """Return the keypoints of a still camera, and a note about it.

    Args:
        keypoints: of the camera that turns. section: table ``[camera.motion]``.

    Raises:
        FileFormatError: no such file, damaged, or of another time. UnknownNameError: unknown sensor.
    """
    motion = _read(section).shifted(section.number("start_s", 0.0))
    section.close()
    with naming(section.path):
        still = stabilised(keypoints, motion)
    focal = float(np.trace(keypoints.camera.K[:2, :2])) / 2
    if motion.focal_px is not None and abs(motion.focal_px / focal - 1) > _FOCAL:
        _log.warning(
            "%s: the turning was estimated with a focal length of %.0f px, [camera] has %.0f px; its angles "
            "are wrong by their ratio: give both the same", section.path, motion.focal_px, focal,
        )  # fmt: skip
    lost = int(keypoints.seen.sum() - still.seen.sum())
    note = (
        f"The camera turned by up to {np.degrees(np.nanmax(motion.angles)):.0f} deg; the keypoints are those "
        "of a camera that stands still in the mean orientation. The translation of the hand is not modelled."
    )
    if motion.sigma:
        note += f" The turning is known to {np.degrees(motion.sigma):.2f} deg."
    if lost:
        note += f" {lost} points are left out where it is unknown or turned too far."
    return still, note


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
