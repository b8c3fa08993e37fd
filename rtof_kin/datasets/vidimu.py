"""VIDIMU (Martínez-Zarzuela et al., Scientific Data 10, 648, 2023): one camera, five IMUs, 13 activities.

Files of a trial, subjects S40 to S57 with sensors::

    dataset/videoandimus/S40/S40_A01_T01.mp4     video, 30 Hz, maybe without sound and in another folder
    dataset/videoandimus/S40/S40_A01_T01.raw     CSV: QUAT,w,x,y,z,timestamp; five lines an instant, 50 Hz
    dataset/videoandimus/S40/ik_S40_A01_T01.mot  OpenSim's inverse kinematics of those sensors

The first instant of a ``.raw`` is the N-pose before the trial, with a time stamp of its own. A01 to A04 have sensors
on pelvis, thighs and shanks, A05 to A13 on back, upper arms and forearms. There are no accelerations. The reference is
computed from the same sensors: it tests what is found from the video alone (mode rto).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import measurable, read_text
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.datasets.public_sets import Movement, Take, TakeInputs, Truth, checked_root, existing, some
from rtof_kin.formats.opensim import read_opensim_table
from rtof_kin.formats.sensors.readings import Readings, sensor_log

LOWER: Final = {
    "qsHIPS": "pelvis",
    "qsRUL": "right thigh",
    "qsRLL": "right shank",
    "qsLUL": "left thigh",
    "qsLLL": "left shank",
}
UPPER: Final = {
    "qsBACK": "sternum",
    "qsRUA": "right upper arm",
    "qsRLA": "right forearm",
    "qsLUA": "left upper arm",
    "qsLLA": "left forearm",
}
"""Sensors of A01 to A04 and of A05 to A13 -> segment."""
ACTIVITIES: Final[dict[str, tuple[str, Movement]]] = {
    "A01": ("walk forward", "walk"),
    "A02": ("walk backward", "walk"),
    "A03": ("walk along a line", "walk"),
    "A04": ("sit to stand", "sit-to-stand"),
    "A05": ("move a bottle, right arm", "arms"),
    "A06": ("move a bottle, left arm", "arms"),
    "A07": ("drink, right arm", "arms"),
    "A08": ("drink, left arm", "arms"),
    "A09": ("assemble a tower", "arms"),
    "A10": ("throw and catch", "arms"),
    "A11": ("reach up, right arm", "arms"),
    "A12": ("reach up, left arm", "arms"),
    "A13": ("tear paper and throw", "arms"),
}
_LEGS: Final = tuple(
    f"{name}_{side}" for side in "rl" for name in ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle")
)
_ARMS: Final = ("elbow_flex_r", "elbow_flex_l", "pro_sup_r", "pro_sup_l")
_COLUMNS: Final = ("QUAT", "w", "x", "y", "z", "timestamp")
_TRIAL: Final = re.compile(r"(S\d{2})_(A\d{2})_(T\d{2})")
_RATE_HZ: Final = 50.0
_OF_POSE: Final = 2
"""Rows of the reference that belong to the N-pose, as the set's own scripts leave them out."""
_LAYOUT: Final = "dataset/videoandimus/S40/S40_A01_T01.raw with .mp4 and ik_S40_A01_T01.mot"


class Vidimu:
    """Adapter of VIDIMU's subjects with video and sensors."""

    name = "vidimu"
    title = "VIDIMU"
    mode: Mode = "rto"
    caution = (
        "the reference is OpenSim's inverse kinematics of the same five sensors, not of markers: with "
        "sensors in the mode the table shows agreement of two computations, not accuracy"
    )

    def __init__(self, root: Path):
        """Take the folder that has ``dataset``, or any folder above or below it."""
        self.root = checked_root(root, "VIDIMU")

    def takes(self) -> tuple[Take, ...]:
        """See `PublicSet.takes`: every trial with sensors or a reference, from one folder each."""
        return some(self._takes(), self.root, self.title, _LAYOUT)

    def _takes(self) -> Iterator[Take]:
        found: dict[str, Path] = {}
        for path in sorted([*self.root.rglob("*.raw"), *self.root.rglob("ik_S*.mot")]):
            name = _TRIAL.fullmatch(path.stem.removeprefix("ik_"))
            if name is None or path.parent.name != name[1] or name[2] not in ACTIVITIES:
                continue
            if not path.parent.parent.name.startswith("videoandimusync"):  # cut copies without videos of their own
                found.setdefault(name[0], path.parent)
        for key, folder in sorted(found.items()):
            subject, activity, _ = key.split("_")
            yield Take(key, subject, activity, ACTIVITIES[activity][1], folder, "camera")

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        path = existing(take.folder / f"{take.key}.raw", "the sensors' quaternions", "unpack dataset.zip of VIDIMU")
        places = LOWER if take.movement in ("A01", "A02", "A03", "A04") else UPPER
        log = read_raw(path, tuple(places))
        return TakeInputs(video=self._video(take), rate_hz=30.0, sensors=log, places=places)

    def _video(self, take: Take) -> Path | None:
        if (beside := take.folder / f"{take.key}.mp4").is_file():
            return beside
        found = sorted(self.root.rglob(f"{take.subject}/{take.key}.mp4"))
        return found[0] if found else None

    def truth(self, take: Take) -> Truth:
        """See `PublicSet.truth`."""
        path = existing(
            take.folder / f"ik_{take.key}.mot",
            "OpenSim's inverse kinematics",
            "unpack dataset.zip of VIDIMU; trials that failed have none: leave them out by --takes",
        )
        lower = take.movement in ("A01", "A02", "A03", "A04")
        table = read_opensim_table(path)
        if len(table.times) <= _OF_POSE + 1:
            raise FileFormatError(path, f"has {len(table.times)} rows: cut off?")
        table = replace(table, times=table.times[_OF_POSE:], values=table.values[_OF_POSE:])
        source = "OpenSim inverse kinematics of the take's own sensors"
        return Truth(table, _LEGS if lower else _ARMS, source, of_sensors=True, reach=2.0)


def read_raw(path: Path, sensors: tuple[str, ...]) -> SensorLog:
    """Read the quaternions of one trial, without the N-pose in the first instant.

    Args:
        path: ``.raw`` file. sensors: names that it must have.

    Raises:
        FileFormatError: another header, an unknown or missing sensor, no numbers, or damaged.
    """
    lines = read_text(path, "VIDIMU's quaternions").splitlines()
    header = tuple(name.strip() for name in lines[0].split(",")) if lines else ()
    if header[:5] != _COLUMNS[:5]:
        raise FileFormatError(
            path,
            f"expected the columns {','.join(_COLUMNS)}, found {','.join(header) or 'nothing'}; is it "
            "of another version of the set?",
            1,
        )
    rows: dict[str, list[list[float]]] = {name: [] for name in sensors}
    for number, line in enumerate(lines[1:], 2):
        cells = line.split(",")
        if not line.strip():
            continue
        if cells[0] not in rows or len(cells) != len(header):
            expected = f"one of {', '.join(sensors)} and {len(header) - 1} numbers"
            raise FileFormatError(path, f"expected {expected}, found {line[:60]!r}", number)
        try:
            rows[cells[0]].append([float(cell) for cell in cells[1:]])
        except ValueError as error:
            raise FileFormatError(path, f"holds something else than numbers ({error})", number) from error
    return _log(path, {name: np.array(own, dtype=float) for name, own in rows.items()})


def _log(path: Path, rows: dict[str, Array]) -> SensorLog:
    short = [name for name, own in rows.items() if len(own) < 3]
    if short:
        raise FileFormatError(path, f"fewer than two samples of {', '.join(short)} after the N-pose: cut off?")
    if not all(measurable(own) for own in rows.values()):
        raise FileFormatError(path, "holds a number that cannot be a quaternion or a time")
    norms = np.concatenate([np.linalg.norm(own[:, :4], axis=1) for own in rows.values()])
    if not 0.9 < np.median(norms) < 1.1:
        raise FileFormatError(path, f"quaternions have a norm of {np.median(norms):.3g}, not 1: another unit?")
    first = min(float(own[1, 4]) for own in rows.values()) if len(next(iter(rows.values()))[0]) == 5 else 0.0
    readings = [Readings(name, _times(own[1:], first), quaternions=own[1:, :4]) for name, own in rows.items()]
    try:
        return sensor_log([path], "VIDIMU .raw", readings, Declaration())
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _times(rows: Array, first: float) -> Array:
    """Time stamps from the first one, s, if they increase; else the nominal rate."""
    if rows.shape[1] == 5 and (np.diff(rows[:, 4]) > 0).all():
        return np.asarray(rows[:, 4] - first)
    return np.arange(len(rows)) / _RATE_HZ
