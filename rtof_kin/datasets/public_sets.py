"""What the adapters of public data sets have in common: takes, their inputs and their reference.

An adapter reads a folder that the user has downloaded and unpacked. It lists takes without reading them
(`PublicSet.takes`), names the files that a recording is made from (`inputs`) and reads what it is compared with
(`truth`). Nothing is guessed of a file that is missing: the take is listed and fails with the file's name.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final, Literal, get_args

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.text import load_toml
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.opensim import OpenSimTable
from rtof_kin.formats.sensors.readings import Readings, sensor_log

Movement = Literal["walk", "squat", "sit-to-stand", "arms", "floor", "other"]
MOVEMENTS: Final[tuple[Movement, ...]] = get_args(Movement)  #: Classes of movement, in the order of tables
_DESCRIPTIONS: Final = load_toml(Path(__file__).with_suffix(".toml"))


@dataclass(frozen=True)
class Take:
    """One trial of one person, seen by one camera or by none."""

    key: str  #: Name in the set and of files, without separators of folders
    subject: str
    movement: str  #: The set's own name of it
    kind: Movement
    folder: Path  #: Where most of its files are
    camera: str = ""  #: The set's name of the camera; '' without one


@dataclass(frozen=True)
class TakeInputs:
    """Files and measurements that a recording is made from."""

    video: Path | None = None
    span: tuple[float, float] | None = None  #: [s] part of the video that is the take; None for all of it
    size_px: tuple[int, int] | None = None
    """Width and height of the image, where the set states it; else the video does."""
    rate_hz: float | None = None  #: Frames per second of detections without times; else the video states it
    camera: Path | Camera | None = None
    """Calibration: a file of `rtof_kin.formats.cameras`, or the camera; None where the set has none."""
    sensors: SensorLog | None = None  #: Sensors in a reference with z up, on a clock of their own
    places: Mapping[str, str] = field(default_factory=dict)
    """Sensor -> segment, in names of `rtof_kin.inertial.segment_names`."""
    pose: str = ""  #: Pose of the person at `still`: 'T', 'N'; '' if none is documented
    still: tuple[float, float] | None = None  #: [s] when the pose was held, on the sensors' clock
    height: float | None = None  #: Standing height, m


@dataclass(frozen=True)
class Truth:
    """Reference of a take: coordinates over time, as of OpenSim's Rajagopal model."""

    table: OpenSimTable
    coordinates: tuple[str, ...]
    """Coordinates that were measured in this take; others of the table are the model's default."""
    source: str  #: How it was made, in words
    of_sensors: bool = False
    """Whether it was computed from the sensors of the take, so that it is no reference for them."""
    reach: float = 1.0  #: [s] largest difference of the clocks of take and reference that is searched


class PublicSet(ABC):
    """Adapter of one data set, which ``public_sets.toml`` describes under its name."""

    name: ClassVar[str]  #: On the command line
    title: ClassVar[str]
    mode: ClassVar[Mode]  #: Mode of reconstruction whose inputs the set has, see `rtof_kin.core.choices`
    caution: ClassVar[str] = ""  #: What its reference cannot show; '' if nothing
    layout: ClassVar[str]  #: Where its files are
    archive: ClassVar[str]  #: What is unpacked into the folder
    kinds: ClassVar[Mapping[str, Movement]]  #: Beginning of a movement's name, or its code -> class

    def __init_subclass__(cls) -> None:
        """Take the description from the file."""
        for key, value in _DESCRIPTIONS[cls.name].items():
            setattr(cls, key, value)

    def __init__(self, root: Path):
        """Take the folder of the set, or one above; raises FileFormatError where there is none."""
        if not root.is_dir():
            raise FileFormatError(root, f"there is no such folder; give the one into which {self.archive} was unpacked")
        self.root = root

    def takes(self) -> tuple[Take, ...]:
        """Return all takes, in a fixed order; raises FileFormatError where there is none."""
        found = tuple(self._takes())
        if not found:
            expected = f"expected {self.layout} (docs/validate.md)"
            raise FileFormatError(self.root, f"no take of {self.title} in it; {expected}")
        return found

    @abstractmethod
    def _takes(self) -> Iterator[Take]: ...

    @abstractmethod
    def inputs(self, take: Take) -> TakeInputs:
        """Return what a recording is made from; raises FileFormatError for missing or damaged files."""

    @abstractmethod
    def truth(self, take: Take) -> Truth:
        """Return the reference; raises FileFormatError for a missing or damaged file."""


def existing(path: Path, what: str, remedy: str) -> Path:
    """Return a file that exists; `FileFormatError` with a remedy if there is none."""
    if not path.is_file():
        raise FileFormatError(path, f"{what} is missing; {remedy}")
    return path


def orientation_log(path: Path, what: str, sensors: Mapping[str, tuple[Array, Array]]) -> SensorLog:
    """Return the sensors of a file that has orientations alone: times (T,), s, and quaternions w, x, y, z (T, 4) by
    name. `FileFormatError`: no quaternions, or no sensors.
    """
    for sensor, (_, quaternions) in sensors.items():
        norm = float(np.nanmedian(np.linalg.norm(quaternions, axis=1)))
        if not 0.9 < norm < 1.1:
            raise FileFormatError(path, f"{sensor}: quaternions have a norm of {norm:.3g}, not 1: another unit?")
    readings = [Readings(name, times, quaternions=quat) for name, (times, quat) in sensors.items()]
    with reading(path):
        return sensor_log([path], what, readings, Declaration())


def kind_of(name: str, kinds: Mapping[str, Movement]) -> Movement:
    """Return the class of a movement by the longest beginning of its name, in small letters; 'other' if unknown."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    fitting = [start for start in kinds if plain.startswith(start)]
    return kinds[max(fitting, key=len)] if fitting else "other"


def natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text) if part]


HINGES: Final = {
    "knee_angle_r": ("right_hip", "right_knee", "right_ankle"),
    "knee_angle_l": ("left_hip", "left_knee", "left_ankle"),
    "elbow_flex_r": ("right_shoulder", "right_elbow", "right_wrist"),
    "elbow_flex_l": ("left_shoulder", "left_elbow", "left_wrist"),
}
"""Coordinate of OpenSim -> joint centres before, at and after the hinge."""


def hinge_table(times: Array, centres: Mapping[str, Array]) -> OpenSimTable:
    """Return the flexion, rad, of the hinges whose three centres are known.

    Centres are joint -> (T, 3) in any one unit, at times (T,) s; NaN where unknown. The flexion is the angle between
    the long axes of both segments, unsigned, 0 where they are in line: markers define it without any convention of
    segment axes. Against another definition of zero it is off by a few degrees, which the error without offset leaves
    out.
    """
    found = {
        name: so3.angle_of(centres[at] - centres[before], centres[after] - centres[at])
        for name, (before, at, after) in HINGES.items()
        if centres.keys() >= {before, at, after}
    }
    values = np.stack(list(found.values()), axis=1) if found else np.empty((len(times), 0))
    return OpenSimTable(times, tuple(found), values, in_degrees=False)
