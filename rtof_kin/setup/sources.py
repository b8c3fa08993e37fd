"""Files that are given for one take, recognised by their contents and sorted by what they are."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import npz_names
from rtof_kin.core.files.text import beginning
from rtof_kin.formats.cameras import MATRIX_NAMES
from rtof_kin.formats.sensors.files import format_of, holds_sensors
from rtof_kin.formats.sensors.sensor_map import read_sensor_map
from rtof_kin.formats.sensors.tables import phone_files
from rtof_kin.inertial.segment_names import segment_of
from rtof_kin.recording.index import INDEX
from rtof_kin.vision.detections import is_keypoint_header
from rtof_kin.vision.keypoint_files import ARRAY_NAMES

_LARGEST_MAP: Final = 2**18
VIDEO_SUFFIXES: Final = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp"}
)
"""Suffixes of videos, for containers that do not show themselves by their first bytes."""
_BOXES: Final = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")  # First boxes of MP4, MOV and 3GP
_CONTAINERS: Final = (
    b"\x1a\x45\xdf\xa3",
    b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",
    b"\x00\x00\x01\xba",
    b"\x00\x00\x01\xb3",
    b"FLV\x01",
    b"OggS",
)
"""First bytes of MKV and WebM, WMV, MPEG, FLV, Ogg."""
_PEOPLE: Final = re.compile(
    r'"(people|bodies|instances|instance_info|annotations|keypoints|pose_keypoints(_2d)?|(pose_)?landmarks'
    r'|image_id|joints)"\s*:'
)
_MATRIX: Final = "|".join(map(re.escape, MATRIX_NAMES))
_CAMERA_JSON: Final = re.compile(rf'"({_MATRIX})\d?"\s*:')
_CAMERA_YAML: Final = re.compile(rf"^\s*({_MATRIX})\d?\s*:", re.MULTILINE)
_CAMERA_TOML: Final = re.compile(r"^\s*matrix\s*=", re.MULTILINE)
_RECORDING: Final = re.compile(r"^schema_version\s*=", re.MULTILINE)


class SourceKind(Enum):
    """What a file or folder is, in words."""

    VIDEO = "a video"
    KEYPOINTS = "a detector's keypoints"
    SENSORS = "files of sensors"
    CAMERA = "a camera calibration"
    SENSOR_MAP = "a map of sensors"
    PHONE = "a log of the phone that filmed"
    RECORDING = "a recording folder"
    UNKNOWN = "unknown"


_KNOWN: Final = (
    "a video (MP4, MOV, AVI, MKV, ...), a detector's keypoints (a folder of OpenPose's .json; .json, .csv, "
    ".npz, .npy), files of inertial sensors (docs/sensors.md), a camera calibration (.toml, .yml, .json; "
    "OpenCap's .pickle converted, docs/recording.md), a map of sensors (two columns: serial number, segment), a log "
    "of the phone that filmed (phyphox, Sensor Logger)"
)


def recognise_source(path: str | Path) -> SourceKind:
    """Return what a file or folder is, from its first bytes; it may be damaged further on. `FileFormatError`: there is
    no such file or folder, or it cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        return _of_folder(path)
    head = beginning(path, "file or folder")
    film = head[4:8] in _BOXES or head.startswith(_CONTAINERS) or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
    if film or path.suffix.lower() in VIDEO_SUFFIXES:
        return SourceKind.VIDEO
    if head[:6] == b"\x93NUMPY":
        return SourceKind.KEYPOINTS
    if head[:4] == b"PK\x03\x04":
        with suppress(FileFormatError):
            if set(ARRAY_NAMES) & set(npz_names(path)):
                return SourceKind.KEYPOINTS
        return SourceKind.UNKNOWN
    if format_of(path) is not None:
        return SourceKind.SENSORS
    if b"\0" in head:
        return SourceKind.UNKNOWN
    if phone_files(path):
        return SourceKind.PHONE
    return _of_text(path, head.decode("utf-8-sig", errors="replace"))


def _of_folder(folder: Path) -> SourceKind:
    if (folder / INDEX).is_file():
        return SourceKind.RECORDING
    found = min(folder.glob("*.json"), default=None)
    if found is not None and recognise_source(found) is SourceKind.KEYPOINTS:
        return SourceKind.KEYPOINTS
    if holds_sensors(folder):
        return SourceKind.SENSORS
    return SourceKind.PHONE if phone_files(folder) else SourceKind.UNKNOWN


def _of_text(path: Path, head: str) -> SourceKind:
    start = head.lstrip()
    if start[:1] in ("{", "["):
        if _PEOPLE.search(head):
            return SourceKind.KEYPOINTS
        if start[:1] == "{":
            return SourceKind.CAMERA if _CAMERA_JSON.search(head) else SourceKind.UNKNOWN
    if path.name == INDEX or _RECORDING.search(head):
        return SourceKind.RECORDING
    if _CAMERA_TOML.search(head) or _CAMERA_YAML.search(head):
        return SourceKind.CAMERA
    if start.startswith("PathFileType") and "_px" in path.stem:
        return SourceKind.KEYPOINTS
    if is_keypoint_header(start.split("\n", 1)[0]):
        return SourceKind.KEYPOINTS
    return SourceKind.SENSOR_MAP if _is_map(path) else SourceKind.UNKNOWN


def _is_map(path: Path) -> bool:
    """Return whether a text has two columns, of which the second names segments."""
    if path.stat().st_size > _LARGEST_MAP:
        return False
    try:
        places = read_sensor_map(path).values()
    except FileFormatError:
        return False
    skeleton = SkeletonModel.default()
    return 2 * sum(segment_of(place, skeleton) is not None for place in places) >= len(places)


@dataclass(frozen=True)
class Sources:
    """Files of one take."""

    video: Path | None = None
    keypoints: Path | None = None  #: A detector's file or folder, see `rtof_kin.vision.keypoint_files`
    sensors: tuple[Path, ...] = ()  #: Files or folders of inertial sensors, see `rtof_kin.formats.sensors.files`
    camera: Path | None = None  #: A calibration, see `rtof_kin.formats.cameras`
    sensor_map: Path | None = None  #: Which sensor is where, see `rtof_kin.formats.sensors.sensor_map`
    phone: Path | None = None
    """Gyroscope and accelerometer of the phone that filmed, see `rtof_kin.formats.sensors.tables`."""

    @classmethod
    def of(cls, paths: Iterable[str | Path]) -> Sources:
        """Sort files and folders by what they are. `paths`: in any order. `FileFormatError`: one does not exist, or is
        nothing of these; `InvalidInputError`: two videos, keypoints, calibrations or maps, or a recording folder.
        """
        found: dict[SourceKind, list[Path]] = {kind: [] for kind in SourceKind}
        for path in map(Path, paths):
            found[recognise_source(path)].append(path)
        for path in found[SourceKind.UNKNOWN]:
            raise FileFormatError(path, f"nothing that is known. Known: {_KNOWN}")
        for path in found[SourceKind.RECORDING]:
            folder = path if path.is_dir() else path.parent
            raise InvalidInputError(f"{path}: is a recording already; go on with: rtof-kin reconstruct {folder}")
        one = {kind: _only(kind, files) for kind, files in found.items() if kind is not SourceKind.SENSORS}
        return cls(
            one[SourceKind.VIDEO],
            one[SourceKind.KEYPOINTS],
            tuple(found[SourceKind.SENSORS]),
            one[SourceKind.CAMERA],
            one[SourceKind.SENSOR_MAP],
            one[SourceKind.PHONE],
        )

    @property
    def seen(self) -> bool:
        """Whether there is a video or keypoints."""
        return self.video is not None or self.keypoints is not None

    @property
    def sizeless(self) -> bool:
        """Whether no file says how large the image is."""
        return self.keypoints is not None and self.video is None and self.camera is None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files and folders."""
        single = (self.video, self.keypoints, self.camera, self.sensor_map, self.phone)
        return (*(path for path in single if path is not None), *self.sensors)

    @property
    def name(self) -> str:
        """Name of the take, from its video, else its keypoints, else its sensors."""
        return next(path for path in (self.video, self.keypoints, *self.sensors) if path is not None).stem


def _only(kind: SourceKind, files: Sequence[Path]) -> Path | None:
    if len(files) > 1:
        names = " and ".join(str(path) for path in files)
        raise InvalidInputError(f"{names}: each is {kind.value}; give one of them")
    return files[0] if files else None
