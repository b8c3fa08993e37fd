"""A detector's 2D for the takes and cameras of a dataset, from a folder of files.

A file is found by its name at any depth, case-insensitively: ``TC_S5_acting3_cam1.npz``,
``S5_acting3_cam1.npz``, or ``cam1.npz`` in folders ``S5/acting3``. An .npz has ``uv_px`` (T, L, 2),
- ``confidence`` (T, L) and - ``times`` (T,), s; its landmarks are named, one a line, in a file
``landmarks.txt`` in the folder (all joints of the skeleton in its order where there is none). A .csv has
the columns of a recording's keypoints. Frame k is frame k of the video where there are no times.

With a layout they are a detector's own files, of any format in `rtof_kin.vision.keypoint_files`; a folder of
.json is named like a file, ``S5_acting3_cam1``. The shipped adapter makes landmarks of their points.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.datasets.total_capture_files import only_one, walk
from rtof_kin.recording import files
from rtof_kin.vision.keypoint_files import FORMATS, read_detector_file
from rtof_kin.vision.keypoints import keypoints_from_detections

Array = NDArray[np.float64]
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
    """The detections in one take's video from one camera.

    Args:
        folder: where the files lie. number: of the camera; camera: its calibration.
        skeleton: whose landmarks the names are; the 21-joint one where not given.
        rate_hz: frames per second of the video, where the file has no times.
        layout: of a detector's points, or `recording_files.RECOGNISE`; the skeleton's own landmarks where
            not given. Only for the 21-joint skeleton.

    Raises:
        FileFormatError: no such file or different ones, or one that is damaged or of another format or
            layout. UnknownNameError: a landmark that the skeleton does not have, or no such layout.
    """
    skeleton = skeleton or SkeletonModel.default()
    path = _find(Path(folder), subject, take, number, _OWN_FORMATS if layout is None else FORMATS)
    if layout is not None:
        return _adapted(path, camera, rate_hz, layout)
    if path.suffix.lower() == ".csv":
        names, arrays = files.read_keypoint_csv(path)
    else:
        arrays = files.read_arrays(path, _ARRAYS)
        names = _landmarks(Path(folder), skeleton)
    uv = files.needed(path, arrays, "uv_px", "(T, L, 2)")
    if uv.shape[1:] != (len(names), 2):
        raise FileFormatError(
            path, f"uv_px has shape {uv.shape}, and {len(names)} landmarks are named; list the names "
            f"of its points, one a line, in {Path(folder) / LANDMARKS}, or name a detector's layout",
        )  # fmt: skip
    unknown = [name for name in names if name not in skeleton.landmarks]
    if unknown:
        kind = f"landmark (a detector's own points need the name of their layout) in {path}"
        raise UnknownNameError(kind, unknown, list(skeleton.landmarks))
    seen: Array = np.isfinite(uv).all(axis=-1).astype(float)
    confidence = arrays.get("confidence", seen)
    times = arrays.get("times", np.arange(len(uv)) / rate_hz)
    with files.naming(path):
        if confidence.shape != uv.shape[:2] or len(times) != len(uv):
            raise ShapeError(
                f"confidence has shape {confidence.shape}, times {times.shape}, uv_px {uv.shape}"
            )
        return KeypointSequence(camera, times, uv, confidence, names)


def _adapted(path: Path, camera: Camera, rate_hz: float, layout: str) -> KeypointSequence:
    """Landmarks from a detector's own file; says in the log which layout and whom it followed."""
    found = read_detector_file(path, camera.width_px, camera.height_px)
    times = np.arange(len(found)) / rate_hz if found.times is None else found.times
    with files.naming(path):
        adapted = keypoints_from_detections(
            found, times, camera, None if layout == files.RECOGNISE else layout
        )
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
    """The file of a take and camera, or its folder of .json; copies of a file do not matter."""
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
            folder, f"no detections of {subject} {take} camera {number}: expected a file such as "
            f"TC_{subject}_{take}_cam{number}.npz",
        )  # fmt: skip
    return path
