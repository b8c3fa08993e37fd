"""A detector's 2D for the takes and cameras of a dataset, from a folder of files.

A file is found by its name at any depth, case-insensitively: ``TC_S5_acting3_cam1.npz``,
``S5_acting3_cam1.npz``, or ``cam1.npz`` in folders ``S5/acting3``. An .npz has ``uv_px`` (T, L, 2) and
- ``confidence`` (T, L), its landmarks named in a file ``landmarks.txt`` in the folder (all joints of the
skeleton in its order where there is none); a .csv has the columns of a recording's keypoints. Frame k is
frame k of the video.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin import recording_files as files
from rtof_kin.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import Camera, KeypointSequence

Array = NDArray[np.float64]
LANDMARKS = "landmarks.txt"


def read_detections(
    folder: str | Path,
    subject: str,
    take: str,
    number: int,
    camera: Camera,
    skeleton: SkeletonModel | None = None,
    rate_hz: float = 60.0,
) -> KeypointSequence:
    """The detections in one take's video from one camera.

    Args:
        folder: where the files lie. number: of the camera; camera: its calibration.
        skeleton: whose landmarks the names are; the 21-joint one where not given.
        rate_hz: frames per second of the video.

    Raises:
        FileFormatError: no such file or several, or one that is damaged or of another format.
        UnknownNameError: a landmark that the skeleton does not have.
    """
    skeleton = skeleton or SkeletonModel.default()
    path = _find(Path(folder), subject, take, number)
    if path.suffix.lower() == ".csv":
        names, arrays = files.read_keypoint_csv(path)
    else:
        arrays = files.read_arrays(path, ("uv_px", "confidence"))
        names = _landmarks(Path(folder), skeleton)
    uv = files.needed(path, arrays, "uv_px", "(T, L, 2)")
    if uv.shape[1:] != (len(names), 2):
        raise FileFormatError(
            path, f"uv_px has shape {uv.shape}, and {len(names)} landmarks are named; list the names "
            f"of its points, one a line, in {Path(folder) / LANDMARKS}",
        )  # fmt: skip
    unknown = [name for name in names if name not in skeleton.landmarks]
    if unknown:
        raise UnknownNameError(f"landmark in {path}", unknown, list(skeleton.landmarks))
    seen: Array = np.isfinite(uv).all(axis=-1).astype(float)
    confidence = arrays.get("confidence", seen)
    with files.naming(path):
        if confidence.shape != uv.shape[:2]:
            raise ShapeError(f"confidence has shape {confidence.shape}, uv_px {uv.shape}")
        return KeypointSequence(camera, np.arange(len(uv)) / rate_hz, uv, confidence, names)


def _landmarks(folder: Path, skeleton: SkeletonModel) -> tuple[str, ...]:
    path = folder / LANDMARKS
    if not path.is_file():
        return skeleton.names
    try:
        return tuple(path.read_text(encoding="utf-8").split())
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"not readable ({error})") from error


def _find(folder: Path, subject: str, take: str, number: int) -> Path:
    """The one file of a take and camera."""
    wanted = re.compile(rf"(tc_)?{subject}_{take}_cam{number}\.(npz|csv)", re.IGNORECASE)
    in_folders = re.compile(rf"(.*/)?{subject}/{take}/cam{number}\.(npz|csv)", re.IGNORECASE)
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder of detections")
    found = [
        path
        for path in sorted(folder.rglob(f"*[cC][aA][mM]{number}.*"))
        if wanted.fullmatch(path.name) or in_folders.fullmatch(path.relative_to(folder).as_posix())
    ]
    if not found:
        raise FileFormatError(
            folder, f"no detections of {subject} {take} camera {number}: expected a file such as "
            f"TC_{subject}_{take}_cam{number}.npz",
        )  # fmt: skip
    if len(found) > 1:
        raise FileFormatError(found[0], f"{found[1]} is of the same take and camera; remove one")
    return found[0]
