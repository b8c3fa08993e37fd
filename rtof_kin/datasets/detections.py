"""A detector's 2D for the takes and cameras of a dataset, from a folder of files.

A file is found by its name at any depth, case-insensitively: ``TC_S5_acting3_cam1.npz``,
``S5_acting3_cam1.npz``, or ``cam1.npz`` in folders ``S5/acting3``. An .npz has ``uv_px`` (T, L, 2),
- ``confidence`` (T, L) and - ``times`` (T,), s; its landmarks are named, one a line, in a file
``landmarks.txt`` in the folder (all joints of the skeleton in its order where there is none). A .csv has
the columns of a recording's keypoints. Frame k is frame k of the video where there are no times.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin import recording_files as files
from rtof_kin.datasets.total_capture_files import only_one, walk
from rtof_kin.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import Camera, KeypointSequence

Array = NDArray[np.float64]
LANDMARKS = "landmarks.txt"
_ARRAYS = ("uv_px", "confidence", "times")


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
        rate_hz: frames per second of the video, where the file has no times.

    Raises:
        FileFormatError: no such file or different ones, or one that is damaged or of another format.
        UnknownNameError: a landmark that the skeleton does not have.
    """
    skeleton = skeleton or SkeletonModel.default()
    path = _find(Path(folder), subject, take, number)
    if path.suffix.lower() == ".csv":
        names, arrays = files.read_keypoint_csv(path)
    else:
        arrays = files.read_arrays(path, _ARRAYS)
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
    times = arrays.get("times", np.arange(len(uv)) / rate_hz)
    with files.naming(path):
        if confidence.shape != uv.shape[:2] or len(times) != len(uv):
            raise ShapeError(
                f"confidence has shape {confidence.shape}, times {times.shape}, uv_px {uv.shape}"
            )
        return KeypointSequence(camera, times, uv, confidence, names)


def _landmarks(folder: Path, skeleton: SkeletonModel) -> tuple[str, ...]:
    path = folder / LANDMARKS
    if not path.is_file():
        return skeleton.names
    try:
        return tuple(path.read_text(encoding="utf-8-sig").split())
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"not readable ({error})") from error


def _find(folder: Path, subject: str, take: str, number: int) -> Path:
    """The file of a take and camera; copies of it do not matter."""
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder of detections")
    about = re.escape(subject), re.escape(take), f"cam{number}\\.(npz|csv)"
    names = (r"(.*/)?(tc_)?{}_{}_{}", r"(.*/)?{}/{}/{}")
    wanted = re.compile("|".join(name.format(*about) for name in names), re.IGNORECASE)
    found = [p for p in walk(folder, []) if wanted.fullmatch(p.relative_to(folder).as_posix())]
    path = only_one(sorted(found))
    if path is None:
        raise FileFormatError(
            folder, f"no detections of {subject} {take} camera {number}: expected a file such as "
            f"TC_{subject}_{take}_cam{number}.npz",
        )  # fmt: skip
    return path
