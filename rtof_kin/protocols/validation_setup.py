"""From the inputs of a public take to its recording, by the same steps as ``rtof-kin init``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.datasets.public_sets import Take, TakeInputs
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.sensors.tables import write_opensense_sto
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.sensor_files import imus_of_log
from rtof_kin.setup.init import SetupSettings, find_people, make_recording
from rtof_kin.setup.sources import Sources
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import FORMATS, read_detector_file
from rtof_kin.vision.video import write_detections
from rtof_kin.vision.video_metadata import read_video_metadata

_WITH_SENSORS: Final = ("sf2", "rtof", "imu")


@dataclass(frozen=True)
class SetUp:
    """What a recording is made with."""

    folder: Path
    """For the recording and the files that it is made from."""
    mode: str
    keypoints: Path | None
    """Folder of the user's detections."""
    detections: Path | None
    """Detections in the whole video."""
    lifter: LifterLike


def recording_of(take: Take, inputs: TakeInputs, setup: SetUp) -> tuple[Recording, list[str]]:
    """Return the recording of a take, and what was found, assumed or in doubt.

    Raises:
        InvalidInputError: the take lacks what the mode needs. Errors of `make_recording`,
            `calibrate_by_pose`.
    """
    if setup.mode in _WITH_SENSORS and inputs.sensors is None:
        raise InvalidInputError(f"it has no sensors, which mode {setup.mode} needs; use --mode rto")
    return _of_sensors(take, inputs) if setup.mode == "imu" else _of_images(take, inputs, setup)


def _of_sensors(take: Take, inputs: TakeInputs) -> tuple[Recording, list[str]]:
    assert inputs.sensors is not None
    if not inputs.pose:
        raise CalibrationError(
            "no pose is documented by which its sensors could be calibrated; use a mode with the camera"
        )
    skeleton = SkeletonModel.default()
    skeleton = skeleton if inputs.height is None else skeleton.with_height(inputs.height)
    log = inputs.sensors.select(list(inputs.places))
    joints = {sensor: known_segment(place, skeleton) for sensor, place in inputs.places.items()}
    found = calibrate_by_pose(log, joints, inputs.pose, skeleton, still=inputs.still)
    recording = Recording(take.key, imus=imus_of_log(log), calibration=found.calibration, height=inputs.height)
    return recording, list(found.warnings)


def _of_images(take: Take, inputs: TakeInputs, setup: SetUp) -> tuple[Recording, list[str]]:
    folder = setup.folder
    make_folders(folder)
    settings = _settings(inputs, setup)
    sources = Sources(
        keypoints=_keypoints(take, inputs, setup, settings),
        camera=_calibration(inputs, folder),
        sensors=(_sensors(inputs, folder),) if setup.mode in _WITH_SENSORS else (),
    )
    find_people(sources, settings, folder / "recording", _no_detector)
    said = make_recording(sources, settings, folder / "recording", name=take.key)
    notes = [*said.assumed, *said.doubtful]
    if inputs.height is None:  # init's remedy is an option of its own
        notes = [note for note in notes if "--height" not in note]
        notes.append(f"the height of {take.subject} is not known; give it by --heights")
    return Recording.load(folder / "recording"), notes


def _settings(inputs: TakeInputs, setup: SetUp) -> SetupSettings:
    """Size and rate of the image as the set states them, else as the video does."""
    size, rate = inputs.size_px, inputs.rate_hz
    if inputs.video is not None:
        video = read_video_metadata(inputs.video)
        size, rate = size or (video.width_px, video.height_px), video.rate_hz or rate
    if size is None and inputs.camera is None:
        raise InvalidInputError(
            "detections alone do not say how large the image is: put the video where the set has it, or give "
            "--size 1920x1080"
        )
    return SetupSettings(height=inputs.height, rate_hz=rate, size_px=size, lifter=setup.lifter)


def _no_detector(video: Path) -> Detections:
    raise InvalidInputError(f"{video}: was not detected")


def keypoints_of(folder: Path | None, take: Take, inputs: TakeInputs) -> Path | None:
    """Return the user's detections of a take; None where there are none.

    Args:
        take, inputs: the take; a file has its name, or that of its video.
    """
    if folder is None:
        return None
    stems = [take.key, *([inputs.video.stem] if inputs.video else [])]
    files = (folder / f"{stem}{suffix}" for stem in stems for suffix in (*FORMATS, ""))
    return next((file for file in files if file.exists()), None)


def _keypoints(take: Take, inputs: TakeInputs, setup: SetUp, settings: SetupSettings) -> Path:
    """Return the detections of the take alone: those of a whole video are cut."""
    given = keypoints_of(setup.keypoints, take, inputs)
    found = given or setup.detections
    if found is None:
        where = f"put {take.key}.npz into the folder of --keypoints, or the video into {take.folder}"
        raise InvalidInputError(f"there is no video and no detection of it; {where}")
    if inputs.span is None or (given is not None and given.stem == take.key):
        return found
    every = read_detector_file(found, *(settings.size_px or ()))
    times = np.arange(len(every)) / (settings.rate_hz or 30.0) if every.times is None else every.times
    start, stop = inputs.span
    own = (times >= start - 1e-6) & (times <= stop + 1e-6)
    if own.sum() < 2:
        raise InvalidInputError(f"{found}: ends before {take.key}, which is from {start:.1f} to {stop:.1f} s")
    cut = replace(every, uv_px=every.uv_px[own], confidence=every.confidence[own], times=times[own] - start)
    write_detections(setup.folder / "keypoints.npz", cut, overwrite=True)
    return setup.folder / "keypoints.npz"


def _calibration(inputs: TakeInputs, folder: Path) -> Path | None:
    if not isinstance(inputs.camera, Camera):
        return inputs.camera
    write_camera_toml(folder / "camera.toml", {"camera": inputs.camera}, overwrite=True)
    return folder / "camera.toml"


def _sensors(inputs: TakeInputs, folder: Path) -> Path:
    """Write the orientations under the names of their segments, which say the places."""
    assert inputs.sensors is not None
    log = inputs.sensors.select(list(inputs.places)).renamed(inputs.places)
    path = folder / "sensors.sto"
    write_opensense_sto(path, SensorLog.of_imus(imus_of_log(log), path))
    return path
