"""Detectors' files: a folder or a file of JSON, arrays in .npz or .npy, columns in .csv.

==========================  ====================================================================
OpenPose                    folder of ``*_keypoints.json``, one a frame, or one JSON with many
AlphaPose, COCO results     one JSON: a list of ``image_id`` ("12.jpg" or 12: frame 12) and ``keypoints``
COCO annotations            one JSON with ``images``, ``annotations``, ``categories``
MMPose                      one JSON with ``instance_info``, or a list of frames with ``instances``
MediaPipe                   one JSON: frames of ``x``, ``y``, ``visibility``; or CSV
CSV                         a header of ``<point>_x``, ``<point>_y``, - ``<point>_confidence`` (or
                            ``_visibility``, ``_score``; ``_u_px`` and ``_v_px`` too), or ``x0``, ``y0``,
                            ``v0``, ...; - ``time`` (s) or ``timestamp_ms``
NPZ                         ``uv_px`` or ``keypoints`` (T, K, 2 or 3) or (T, P, K, 2 or 3),
                            - ``confidence`` or ``scores``, - ``times``
NPY                         one array like that
==========================  ====================================================================

Coordinates that are shares of the image need its size. Confidences above 1, which some detectors give,
count as 1; where a file has none, every point with finite coordinates counts as seen.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import read_csv, read_npy, read_npz
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.json_files import read_json, read_json_folder

Array = NDArray[np.float64]
FORMATS = (".json", ".npz", ".npy", ".csv")
_ENDINGS = {
    "_u_px": "x", "_v_px": "y", "_x": "x", "_y": "y", "_z": "", "_presence": "",
    "_confidence": "c", "_visibility": "c", "_score": "c", "_likelihood": "c", "_c": "c", "_v": "c",
}  # fmt: skip
_NUMBERED = re.compile(r"(x|y|z|v|c|visibility|confidence|score|presence)_?(\d{1,4})")
_TIMES = {"time": 1.0, "time_s": 1.0, "timestamp": 1.0, "timestamp_ms": 1e-3}
_NO_POINTS = {"frame", "frame_id", "index", ""}


def read_detector_file(
    path: str | Path, width_px: int | None = None, height_px: int | None = None
) -> Detections:
    """Everybody that a detector found in a video.

    Args:
        path: a file or folder of one of the formats above.
        width_px, height_px: size of the image, for coordinates that are shares of it.

    Raises:
        FileFormatError: none of the formats, damaged, or without anybody in it; the message says where.
    """
    path = Path(path)
    try:
        return _read(path).in_pixels(width_px, height_px)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _read(path: Path) -> Detections:
    if path.is_dir():
        return read_json_folder(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise FileFormatError(
            path, f"not one of {', '.join(FORMATS)}, nor a folder of OpenPose's .json files"
        )
    if not path.is_file():
        raise FileFormatError(path, "there is no such file or folder")
    if suffix == ".json":
        return read_json(path)
    if suffix == ".csv":
        return _of_columns(path)
    return _of_arrays(path, {"keypoints": read_npy(path)} if suffix == ".npy" else read_npz(path))


# --- arrays --------------------------------------------------------------------------------------


def _of_arrays(path: Path, arrays: dict[str, Array]) -> Detections:
    points = _one_of(path, arrays, ("uv_px", "keypoints", "keypoints_2d"))
    if points is None:
        have = ", ".join(arrays) or "nothing"
        raise FileFormatError(path, f"no array uv_px or keypoints of shape (T, K, 3); there is {have}")
    if points.ndim not in (3, 4) or points.shape[-1] not in (2, 3):
        raise FileFormatError(
            path, f"keypoints: shape {points.shape} is neither (T, K, 2 or 3) nor (T, P, K, 2 or 3)"
        )
    uv = points[..., :2]
    seen: Array = np.asarray(np.isfinite(uv).all(axis=-1), dtype=np.float64)
    given = _one_of(path, arrays, ("confidence", "scores", "keypoint_scores"))
    confidence = given if given is not None else points[..., 2] if points.shape[-1] == 3 else seen
    if confidence.shape != uv.shape[:-1]:
        raise FileFormatError(path, f"confidence: expected shape {uv.shape[:-1]}, got {confidence.shape}")
    if points.ndim == 3:
        uv, confidence = uv[:, None], confidence[:, None]
    return Detections(uv, confidence, _one_of(path, arrays, ("times", "timestamps")))


def _one_of(path: Path, arrays: dict[str, Array], names: tuple[str, ...]) -> Array | None:
    found = [name for name in names if name in arrays]
    if len(found) > 1:
        raise FileFormatError(path, f"has {' and '.join(found)}; leave only one of them")
    return arrays[found[0]] if found else None


# --- columns -------------------------------------------------------------------------------------


def _of_columns(path: Path) -> Detections:
    columns = read_csv(path)
    times = None
    parts: dict[str, dict[str, Array]] = {}
    for header, values in columns.items():
        name = header.strip().lower()
        if name in _TIMES and times is None:
            times = values * _TIMES[name]
        elif name not in _NO_POINTS:
            point, part = _meaning(path, header)
            if part in parts.setdefault(point, {}):
                raise FileFormatError(path, f"column {header!r}: a second {part} of {point}", 1)
            parts[point][part] = values
    points = {name: part for name, part in parts.items() if "x" in part or "y" in part}
    if not points:
        raise FileFormatError(path, "no column ends in _x or _y", 1)
    for name, has in points.items():
        if not {"x", "y"} <= set(has):
            other = "y" if "x" in has else "x"
            raise FileFormatError(path, f"point {name}: has no column of {other}", 1)
    names = list(points)
    if all(name.isdigit() for name in names):
        names.sort(key=int)
    uv = np.stack([[points[n]["x"], points[n]["y"]] for n in names]).transpose(2, 0, 1)
    seen: Array = np.asarray(np.isfinite(uv).all(axis=-1), dtype=np.float64)
    confidence = np.stack([points[n].get("c", seen[:, i]) for i, n in enumerate(names)], axis=1)
    named = None if all(name.isdigit() for name in names) else tuple(names)
    return Detections(uv[:, None], confidence[:, None], times, named)


def _meaning(path: Path, header: str) -> tuple[str, str]:
    """Which point a column is of, and which part of it: x, y, c, or '' for what is not used."""
    numbered = _NUMBERED.fullmatch(header.strip().lower())
    if numbered:
        part = numbered[1]
        return str(int(numbered[2])), part if part in "xy" else "" if part in ("z", "presence") else "c"
    for ending, part in _ENDINGS.items():
        if header.strip().lower().endswith(ending):
            return header.strip()[: -len(ending)], part
    raise FileFormatError(
        path, f"column {header!r}: expected time, or a point's name and one of {', '.join(_ENDINGS)}", 1
    )
