"""Files of Total Capture in a folder.

Files are found by name, case-insensitively, at any depth. Subject and take are read from the file's name, or
else from the nearest folder above that names them; a file without them is not used.
"""

from __future__ import annotations

import filecmp
import logging
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.arrays import read_csv, read_npz
from rtof_kin.core.files.text import read_text
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording.cameras import arranged_keypoints, keypoint_arrays
from rtof_kin.recording.streams import naming, needed
from rtof_kin.recording.tables import RECOGNISE
from rtof_kin.vision.keypoint_files import FORMATS, read_detector_file
from rtof_kin.vision.keypoints import keypoints_from_detections

SUBJECTS = ("S1", "S2", "S3", "S4", "S5")
CAMERAS = (1, 2, 3, 4, 5, 6, 7, 8)
MISCALIBRATED = {2: "camera 2 is miscalibrated: detections on its video lie (+20, -8) px off"}
"""Cameras whose calibration does not fit their video, with the reason."""
TRAIN = tuple(
    (subject, take)
    for subject in ("S1", "S2", "S3")
    for take in ("rom1", "rom2", "rom3", "walking1", "walking3", "freestyle1", "freestyle2", "acting1", "acting2")
)
"""Takes of the paper's training set, without a running take that is not in the dataset."""
TEST = tuple((subject, take) for subject in SUBJECTS for take in ("walking2", "acting3", "freestyle3"))
"""Takes of the paper's test set."""
KINDS = {
    "positions": "gt_skel_gbl_pos.txt",
    "orientations": "gt_skel_gbl_ori.txt",
    "sensors": "_xsens.sensors",
    "aux_sensors": "_xsens_auxfields.sensors",
    "calib_bone": "calib_imu_bone.txt",
    "calib_ref": "calib_imu_ref.txt",
}
"""Endings of file names, by kind."""
CAMERA_FILE = "calibration.cal"
_log = logging.getLogger(__name__)
_TAKE = re.compile(r"(?<![a-z])(acting|freestyle|rom|walking)_?([1-3])(?!\d)")
_SUBJECT = re.compile(r"(?<![a-z0-9])s([1-5])(?![a-z0-9])")

Take = tuple[str, str]  #: Subject and take, e.g. ('S5', 'acting3').


@dataclass(frozen=True)
class FileIndex:
    """All files of the dataset that were found."""

    root: Path
    files: dict[Take, dict[str, list[Path]]] = field(default_factory=dict)  #: Candidates by take and kind
    cameras: list[Path] = field(default_factory=list)  #: Candidates for the camera calibration
    unassigned: list[Path] = field(default_factory=list)  #: Files whose name and folders do not give subject and take

    def one(self, take: Take, kind: str) -> Path | None:
        """Return the file of one of `KINDS`, or None; raises FileFormatError: there are several, and they differ."""
        return only_one(self.files.get(take, {}).get(kind, []))


def only_one(candidates: list[Path]) -> Path | None:
    """Return the first of several equal files, or None without any; raises FileFormatError: they differ."""
    if not candidates:
        return None
    first, *others = candidates
    for other in others:
        if not filecmp.cmp(first, other, shallow=False):
            raise FileFormatError(first, f"{other} claims to be the same file and differs; remove the wrong one")
    return first


def find_files(root: str | Path) -> FileIndex:
    """Search a folder for the dataset's files. `FileFormatError`: there is no such folder, or none of the dataset's
    files in it.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileFormatError(root, "there is no such folder; name the one the dataset lies in")
    index, known = FileIndex(root), set[str]()
    for path in sorted(walk(root)):
        name = path.name.lower()
        if name == CAMERA_FILE:
            index.cameras.append(path)
        kind = next((kind for kind, end in KINDS.items() if name.endswith(end)), None)
        if kind is None:
            continue
        if (take := _take_of(path, root)) is None:
            index.unassigned.append(path)
        else:
            index.files.setdefault(take, {}).setdefault(kind, []).append(path)
            known.add(os.path.realpath(path))
    index.unassigned[:] = [p for p in index.unassigned if os.path.realpath(p) not in known]  # second names, of links
    if not index.files:
        problem = "holds no file of Total Capture (such as S1/acting1/gt_skel_gbl_pos.txt)"
        if index.unassigned:
            problem = f"subject and take of {index.unassigned[0]} are not in its path"
        raise FileFormatError(root, f"{problem}; name the folder in which the dataset's archives were unpacked")
    for path in index.unassigned:
        _log.warning("%s: subject and take are not in the path; not used", path)
    return index


def walk(root: Path) -> Iterator[Path]:
    """Yield the files below a folder, without hidden ones; links are followed, but not to a folder above them."""
    for place, folders, names in os.walk(root, followlinks=True):
        above = os.path.join(os.path.realpath(place), "")
        through = {os.path.realpath(folder) for folder in (Path(place), *Path(place).parents)}  # links to each other
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".")
            and name != "__MACOSX"
            and (real := os.path.realpath(os.path.join(place, name))) not in through
            and not above.startswith(os.path.join(real, ""))
        ]
        yield from (path for name in names if not name.startswith(".") and (path := Path(place, name)).is_file())


def _take_of(path: Path, root: Path) -> Take | None:
    """Read subject and take from a file's name or the nearest folder that has them; None where it has several."""
    parts = [path.name, *path.relative_to(root).parts[-2::-1], root.absolute().name, root.resolve().name]
    subjects, takes = (
        next((found for part in parts if (found := set(pattern.findall(part.lower())))), set())
        for pattern in (_SUBJECT, _TAKE)
    )
    return (f"S{subjects.pop()}", "".join(takes.pop())) if len(subjects) == len(takes) == 1 else None


LANDMARKS = "landmarks.txt"
_ARRAYS = ("uv_px", "confidence", "times")
_OWN_FORMATS = (".npz", ".csv")
_VIDEO_HZ = 60.0


def read_detections(
    folder: str | Path, subject: str, take: str, number: int, camera: Camera, layout: str | None = None
) -> KeypointSequence:
    """Read the detections in the video of one take and camera.

    Files are found by name at any depth, case-insensitively: ``TC_S5_acting3_cam1.npz``, ``S5_acting3_cam1.npz``, or
    ``cam1.npz`` in folders ``S5/acting3``. An .npz has ``uv_px`` (T, L, 2) and optionally ``confidence`` (T, L) and
    ``times`` (T,), s; its landmarks are listed in a file ``landmarks.txt`` in the folder (by default all joints of the
    skeleton in its order). A .csv has the columns of a recording's keypoints. Without times, frame k is frame k of the
    video. With a layout of a detector's points, or `RECOGNISE`, they are its own files, of any format in
    `rtof_kin.vision.keypoint_files` (a folder of .json is named like a file), whose points are converted to landmarks.
    `FileFormatError`: no file, different files, or one that is damaged or of another format or layout;
    `UnknownNameError`: a landmark that the skeleton does not have, or no such layout.
    """
    skeleton = SkeletonModel.default()
    path = _find(Path(folder), subject, take, number, _OWN_FORMATS if layout is None else FORMATS)
    if layout is not None:
        return _adapted(path, camera, layout)
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
        return KeypointSequence(camera, arrays.get("times", np.arange(len(uv)) / _VIDEO_HZ), uv, confidence, names)


def _adapted(path: Path, camera: Camera, layout: str) -> KeypointSequence:
    """Convert a detector's own file to landmarks; layout and tracked person are logged."""
    found = read_detector_file(path, camera.width_px, camera.height_px)
    times = np.arange(len(found)) / _VIDEO_HZ if found.times is None else found.times
    with naming(path):
        adapted = keypoints_from_detections(found, times, camera, None if layout == RECOGNISE else layout)
        _log.info("%s: %s", path, adapted.summary)
        return adapted.keypoints


def _landmarks(folder: Path, skeleton: SkeletonModel) -> tuple[str, ...]:
    path = folder / LANDMARKS
    return tuple(read_text(path, "names of landmarks").split()) if path.is_file() else skeleton.names


def _find(folder: Path, subject: str, take: str, number: int, formats: Sequence[str]) -> Path:
    """Find the file of a take and camera, or its folder of .json; equal copies are allowed."""
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder of detections")
    about = re.escape(subject), re.escape(take), f"cam{number}"
    names = (r"(.*/)?(tc_)?{}_{}_{}", r"(.*/)?{}/{}/{}")
    wanted = re.compile("|".join(name.format(*about) for name in names), re.IGNORECASE)

    def is_wanted(path: Path) -> bool:
        return wanted.fullmatch(path.relative_to(folder).as_posix()) is not None

    every = [p for p in walk(folder) if p.suffix.lower() in formats]
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
