"""The files that phone and sensors would have written of a recording, to practise on and to test with."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.text import write_text
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.recording.recording import Recording

KEYPOINTS, SENSORS, PLACES, CAMERA = "keypoints.csv", "dots", "places.csv", "camera.toml"
"""What `write_raw_files` writes."""
_BEGUN: Final = 37.0
"""[s] What the sensors' clock shows when the video begins."""
_WORDS: Final = {"UpLeg": "thigh", "Leg": "shank", "ForeArm": "forearm", "Arm": "upper arm", "Foot": "foot"}
_DOT_COLUMNS: Final = (
    "PacketCounter",
    "SampleTimeFine",
    "Quat_W",
    "Quat_X",
    "Quat_Y",
    "Quat_Z",
    "FreeAcc_X",
    "FreeAcc_Y",
    "FreeAcc_Z",
)


def write_raw_files(recording: Recording, folder: str | Path, overwrite: bool = False) -> None:
    """Write keypoints, sensors on a clock of their own, their places and the camera, as a user has them.

    The sensors' files are those of Movella DOTs, one per sensor, named by a letter and a number. Mounting,
    headings and the time between the two clocks are in none of the files.

    Args:
        overwrite: replace what this wrote there earlier.

    Raises:
        InvalidInputError: there are no keypoints. OutputExistsError: `folder` may not be replaced.
    """
    keypoints = recording.video
    columns = {"time": keypoints.times}
    for i, name in enumerate(keypoints.names):
        columns |= {f"{name}_{axis}": keypoints.uv_px[:, i, k] for k, axis in enumerate("xy")}
        columns[f"{name}_c"] = keypoints.confidence[:, i]
    with new_folder(folder, KEYPOINTS, overwrite) as fresh:
        rows = np.stack(list(columns.values()), axis=1)
        np.savetxt(fresh / KEYPOINTS, rows, "%.6g", ",", header=",".join(columns), comments="")
        write_camera_toml(fresh / CAMERA, {"phone": keypoints.camera})
        if recording.imus is not None:
            _write_sensors(recording, fresh)


def _write_sensors(recording: Recording, folder: Path) -> None:
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None:
        raise InvalidInputError(f"recording {recording.name}: its sensors have no places")
    (folder / SENSORS).mkdir()
    places, rate = [], 1 / float(np.median(np.diff(imus.times)))
    R, f = imus.R_inertial_sensor, imus.f_sensor
    free = np.einsum("tsij,tsj->tsi", R, f) + GRAVITY_WORLD
    stamps = np.round(1e6 * (imus.times - recording.video.times[0] + _BEGUN))
    for s, name in enumerate(imus.names):
        rows = np.column_stack([np.arange(len(stamps)), stamps, so3.to_quat_wxyz(R[:, s]), free[:, s]])
        lines = [",".join(_DOT_COLUMNS), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        head = f"sep=,\nDeviceTag:,D{s + 1}\nOutputRate:,{rate:.0f}Hz\n\n"
        path = folder / SENSORS / f"D{s + 1}_20260131_101500.csv"
        write_text(path, head + "\n".join(lines) + "\n")
        places.append(f"D{s + 1}, {_place(calibration.joints[calibration.sensors.index(name)])}\n")
    write_text(folder / PLACES, "sensor, segment\n" + "".join(places))


def _place(joint: str) -> str:
    """Return the segment of a joint in words, such as 'left thigh'."""
    for side in ("Left", "Right"):
        if joint.startswith(side) and joint.removeprefix(side) in _WORDS:
            return f"{side.lower()} {_WORDS[joint.removeprefix(side)]}"
    return {"Hips": "pelvis", "Spine3": "chest"}.get(joint, joint)
