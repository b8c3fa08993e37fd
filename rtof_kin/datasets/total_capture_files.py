"""Which takes Total Capture has, and where their files lie in somebody's folder.

People unpack the archives in many ways, so files are found by name, case-insensitively, at any depth.
Subject and take come from the file's own name, else from the nearest folder above that names them.
"""

from __future__ import annotations

import filecmp
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rtof_kin.errors import FileFormatError

SUBJECTS = ("S1", "S2", "S3", "S4", "S5")
TRAIN = tuple(
    (subject, take)
    for subject in ("S1", "S2", "S3")
    for take in ("rom1", "rom2", "rom3", "walking1", "walking3", "freestyle1", "freestyle2",
                 "acting1", "acting2")
)  # fmt: skip
"""Takes of the paper's training set. (It lists a running take too; none was ever handed out.)"""
TEST = tuple(
    (subject, take) for subject in SUBJECTS for take in ("walking2", "acting3", "freestyle3")
)
"""Takes of the paper's test set."""
KINDS = {
    "positions": "gt_skel_gbl_pos.txt",
    "orientations": "gt_skel_gbl_ori.txt",
    "sensors": "_xsens.sensors",
    "aux_sensors": "_xsens_auxfields.sensors",
    "calib_bone": "calib_imu_bone.txt",
    "calib_ref": "calib_imu_ref.txt",
    "bvh": "_blenderzxy_ymz.bvh",
}
"""How the names of a take's files end, by what they hold."""
CAMERAS = "calibration.cal"
_TAKE = re.compile(r"(acting|freestyle|rom|walking)_?(\d)(?!\d)")
_SUBJECT_IN_FILE = re.compile(r"(?:^|_)s(\d)_")
_SUBJECT_FOLDER = re.compile(r"s(\d)(?![a-z0-9])")

Take = tuple[str, str]
"""Subject and take, e.g. ('S5', 'acting3')."""


@dataclass(frozen=True)
class FileIndex:
    """Every file of the dataset that was found."""

    root: Path
    files: dict[Take, dict[str, list[Path]]] = field(default_factory=dict)
    """Candidates by take and kind."""
    cameras: list[Path] = field(default_factory=list)
    """Candidates for the camera calibration."""
    unassigned: list[Path] = field(default_factory=list)
    """Files of the dataset's formats whose name and folders do not tell subject and take."""

    def one(self, take: Take, kind: str) -> Path | None:
        """The file of a kind, or None.

        Raises:
            FileFormatError: there are several, and they differ.
        """
        return only_one(self.files.get(take, {}).get(kind, []))


def only_one(candidates: list[Path]) -> Path | None:
    """The first of several equal files, or None without any; `FileFormatError` if they differ."""
    if not candidates:
        return None
    first, *others = candidates
    for other in others:
        if not filecmp.cmp(first, other, shallow=False):
            raise FileFormatError(
                first, f"{other} has the same name and other content; remove the wrong one"
            )
    return first


def find_files(root: str | Path) -> FileIndex:
    """Look for the dataset's files below a folder.

    Raises:
        FileFormatError: there is no such folder, or none of the dataset's files in it.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileFormatError(root, "there is no such folder; name the one the dataset lies in")
    index = FileIndex(root)
    for path in sorted(_walk(root)):
        name = path.name.lower()
        if name == CAMERAS:
            index.cameras.append(path)
            continue
        kind = next((kind for kind, end in KINDS.items() if name.endswith(end)), None)
        if kind is None:
            continue
        take = _take_of(path, root)
        if take is None:
            index.unassigned.append(path)
        else:
            index.files.setdefault(take, {}).setdefault(kind, []).append(path)
    if not index.files:
        raise FileFormatError(
            root, "holds no file of Total Capture (such as S1/acting1/gt_skel_gbl_pos.txt); name the "
            "folder in which its archives were unpacked",
        )  # fmt: skip
    return index


def _walk(root: Path) -> Iterator[Path]:
    """Files below a folder; links to folders are followed once."""
    been = set()
    for folder, folders, files in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        if real in been:
            folders.clear()
            continue
        been.add(real)
        folders[:] = [name for name in folders if name != "__MACOSX" and not name.startswith(".")]
        yield from (Path(folder, name) for name in files if not name.startswith("."))


def _take_of(path: Path, root: Path) -> Take | None:
    """Subject and take of a file, from its name or the nearest folder that says so."""
    folders = [part.lower() for part in (root.resolve().name, *path.relative_to(root).parts[:-1])]
    name = path.name.lower()
    take = _TAKE.search(name) or _nearest(_TAKE, folders)
    subject = _SUBJECT_IN_FILE.search(name) or _nearest(_SUBJECT_FOLDER, folders)
    if take is None or subject is None:
        return None
    return f"S{subject[1]}", f"{take[1]}{take[2]}"


def _nearest(pattern: re.Pattern[str], folders: list[str]) -> re.Match[str] | None:
    return next((match for name in reversed(folders) if (match := pattern.match(name))), None)
