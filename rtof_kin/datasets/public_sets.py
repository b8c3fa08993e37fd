"""What the adapters of public data sets have in common: takes, their inputs and their reference.

An adapter reads a folder that the user has downloaded and unpacked. It lists takes without reading them
(`PublicSet.takes`), names the files that a recording is made from (`inputs`) and reads what it is compared with
(`truth`). Nothing is guessed of a file that is missing: the take is listed and fails with the file's name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, Protocol, get_args

from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.opensim import OpenSimTable

Movement = Literal["walk", "squat", "sit-to-stand", "arms", "floor", "other"]
MOVEMENTS: Final[tuple[Movement, ...]] = get_args(Movement)
"""Classes of movement, in the order of tables."""


@dataclass(frozen=True)
class Take:
    """One trial of one person, seen by one camera or by none."""

    key: str
    """Name in the set and of files, without separators of folders."""
    subject: str
    movement: str
    """The set's own name of it."""
    kind: Movement
    folder: Path
    """Where most of its files are."""
    camera: str = ""
    """The set's name of the camera; '' without one."""


@dataclass(frozen=True)
class TakeInputs:
    """Files and measurements that a recording is made from."""

    video: Path | None = None
    span: tuple[float, float] | None = None
    """[s] part of the video that is the take; None for all of it."""
    size_px: tuple[int, int] | None = None
    """Width and height of the image, where the set states it; else the video does."""
    rate_hz: float | None = None
    """Frames per second of detections without times; else the video states it."""
    camera: Path | Camera | None = None
    """Calibration: a file of `rtof_kin.formats.cameras`, or the camera; None where the set has none."""
    sensors: SensorLog | None = None
    """Sensors in a reference with z up, on a clock of their own."""
    places: Mapping[str, str] = field(default_factory=dict)
    """Sensor -> segment, in names of `rtof_kin.inertial.segment_names`."""
    pose: str = ""
    """Pose of the person at `still`: 'T', 'N'; '' if none is documented."""
    still: tuple[float, float] | None = None
    """[s] when the pose was held, on the sensors' clock."""
    height: float | None = None
    """Standing height, m."""


@dataclass(frozen=True)
class Truth:
    """Reference of a take: coordinates over time, as of OpenSim's Rajagopal model."""

    table: OpenSimTable
    coordinates: tuple[str, ...]
    """Coordinates that were measured in this take; others of the table are the model's default."""
    source: str
    """How it was made, in words."""
    of_sensors: bool = False
    """Whether it was computed from the sensors of the take, so that it is no reference for them."""
    reach: float = 1.0
    """[s] largest difference of the clocks of take and reference that is searched."""


class PublicSet(Protocol):
    """Adapter of one data set."""

    name: str
    """On the command line."""
    title: str
    mode: Mode
    """Mode of reconstruction whose inputs the set has, see `rtof_kin.core.choices`."""
    caution: str
    """What its reference cannot show; '' if nothing."""

    def takes(self) -> tuple[Take, ...]:
        """Return all takes, in a fixed order; raises FileFormatError where there is none."""
        ...

    def inputs(self, take: Take) -> TakeInputs:
        """Return what a recording is made from; raises FileFormatError for missing or damaged files."""
        ...

    def truth(self, take: Take) -> Truth:
        """Return the reference; raises FileFormatError for a missing or damaged file."""
        ...


def checked_root(root: Path, title: str) -> Path:
    """Return the folder of a set.

    Raises:
        FileFormatError: there is no such folder.
    """
    if not root.is_dir():
        raise FileFormatError(root, f"there is no such folder; give the one into which {title} was unpacked")
    return root


def existing(path: Path, what: str, remedy: str) -> Path:
    """Return a file that exists.

    Args:
        remedy: what to do without it.

    Raises:
        FileFormatError: there is no such file.
    """
    if not path.is_file():
        raise FileFormatError(path, f"{what} is missing; {remedy}")
    return path


def some(takes: Iterable[Take], root: Path, title: str, layout: str) -> tuple[Take, ...]:
    """Return the takes of a set.

    Raises:
        FileFormatError: there is none.
    """
    found = tuple(takes)
    if not found:
        raise FileFormatError(root, f"no take of {title} in it; expected {layout} (docs/validate.md)")
    return found


def kind_of(name: str, kinds: Mapping[str, Movement]) -> Movement:
    """Return the class of a movement by the beginning of its name in small letters; 'other' if unknown.

    Args:
        kinds: beginning -> class; the longest that fits counts.
    """
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    fitting = [start for start in kinds if plain.startswith(start)]
    return kinds[max(fitting, key=len)] if fitting else "other"


def natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text) if part]
