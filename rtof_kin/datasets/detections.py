"""A detector's 2D for the takes and cameras of a dataset, from a folder of files.

Files are found by name at any depth, case-insensitively: ``TC_S5_acting3_cam1.npz``,
``S5_acting3_cam1.npz``, or ``cam1.npz`` in folders ``S5/acting3``. An .npz has ``uv_px`` (T, L, 2) and
optionally ``confidence`` (T, L) and ``times`` (T,), s; its landmarks are listed, one a line, in a file
``landmarks.txt`` in the folder (by default all joints of the skeleton in its order). A .csv has the columns
of a recording's keypoints. Without times, frame k is frame k of the video.

With a layout they are a detector's own files, of any format in `rtof_kin.vision.keypoint_files` (a folder of
.json is named like a file), whose points are converted to landmarks.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.arrays import read_csv, read_npz
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.datasets.total_capture_files import only_one, walk
from rtof_kin.recording.cameras import arranged_keypoints, keypoint_arrays
from rtof_kin.recording.streams import naming, needed
from rtof_kin.recording.tables import RECOGNISE
from rtof_kin.vision.keypoint_files import FORMATS, read_detector_file
from rtof_kin.vision.keypoints import keypoints_from_detections

LANDMARKS = "landmarks.txt"
_ARRAYS = ("uv_px", "confidence", "times")
_OWN_FORMATS = (".npz", ".csv")
_log = logging.getLogger(__name__)


def read_detections(
    folder: str | Path,
    subject: str,
    take: str,
    number: int,
    camera: Camera,
    skeleton: SkeletonModel | None = None,
    rate_hz: float = 60.0,
    layout: str | None = None,
) -> KeypointSequence:
    """Read the detections in the video of one take and camera.

    Args:
        skeleton: that has the landmarks; the 21-joint one by default.
        rate_hz: frame rate of the video, Hz, for files without times.
        layout: of a detector's points, or `RECOGNISE`; by default the skeleton's own landmarks. Only for the
            21-joint skeleton.

    Raises:
        FileFormatError: no file, different files, or one that is damaged or of another format or layout.
        UnknownNameError: a landmark that the skeleton does not have, or no such layout.
    """
    skeleton = skeleton or SkeletonModel.default()
    path = _find(Path(folder), subject, take, number, _OWN_FORMATS if layout is None else FORMATS)
    if layout is not None:
        return _adapted(path, camera, rate_hz, layout)
    if path.suffix.lower() == ".csv":
        names, arrays = arranged_keypoints(path, read_csv(path))
    else:
        arrays = read_npz(path)
        indices_of(f"array in {path}", sorted(arrays), _ARRAYS)
        names = _landmarks(Path(folder), skeleton)
    shapes = {name: array.shape for name, array in arrays.items()}
    shape = needed(path, shapes, "uv_px", "(T, L, 2)")
    if shape[1:] != (len(names), 2):
        raise FileFormatError(
            path,
            f"uv_px has shape {shape}, and {len(names)} landmarks are named; list the names of its "
            f"points, one a line, in {Path(folder) / LANDMARKS}, or name a detector's layout",
        )
    unknown = [name for name in names if name not in skeleton.landmarks]
    if unknown:
        kind = f"landmark (a detector's own points need the name of their layout) in {path}"
        raise UnknownNameError(kind, unknown, list(skeleton.landmarks))
    with naming(path):
        uv, confidence = keypoint_arrays(arrays)
        return KeypointSequence(camera, arrays.get("times", np.arange(len(uv)) / rate_hz), uv, confidence, names)


def _adapted(path: Path, camera: Camera, rate_hz: float, layout: str) -> KeypointSequence:
    """Convert a detector's own file to landmarks; layout and tracked person are logged."""
    found = read_detector_file(path, camera.width_px, camera.height_px)
    times = np.arange(len(found)) / rate_hz if found.times is None else found.times
    with naming(path):
        adapted = keypoints_from_detections(found, times, camera, None if layout == RECOGNISE else layout)
    _log.info("%s: %s", path, adapted.summary)
    return adapted.keypoints


def _landmarks(folder: Path, skeleton: SkeletonModel) -> tuple[str, ...]:
    path = folder / LANDMARKS
    if not path.is_file():
        return skeleton.names
    try:
        return tuple(path.read_text(encoding="utf-8-sig").split())
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"not readable ({error})") from error


def _find(folder: Path, subject: str, take: str, number: int, formats: Sequence[str]) -> Path:
    """Find the file of a take and camera, or its folder of .json; equal copies are allowed."""
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder of detections")
    about = re.escape(subject), re.escape(take), f"cam{number}"
    names = (r"(.*/)?(tc_)?{}_{}_{}", r"(.*/)?{}/{}/{}")
    wanted = re.compile("|".join(name.format(*about) for name in names), re.IGNORECASE)

    def is_wanted(path: Path) -> bool:
        return wanted.fullmatch(path.relative_to(folder).as_posix()) is not None

    every = [p for p in walk(folder, []) if p.suffix.lower() in formats]
    found = [p for p in every if is_wanted(p.with_suffix(""))]
    found += {p.parent for p in every if p.suffix.lower() == ".json" and is_wanted(p.parent)}
    if len(found) > 1 and any(p.is_dir() for p in found):
        raise FileFormatError(found[0], f"{found[-1]} claims to be the same detections; remove the wrong one")
    path = only_one(sorted(found))
    if path is None:
        raise FileFormatError(
            folder,
            f"no detections of {subject} {take} camera {number}: expected a file such as "
            f"TC_{subject}_{take}_cam{number}.npz",
        )
    return path
