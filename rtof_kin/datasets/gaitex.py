"""GAITEX (Spilz, Munz et al., Scientific Data 2025): nine IMUs and markers, gait and exercises, no camera.

Files of a trial; exercises are rd (resisted dorsiflexion), rgs (resisted gait simulation), ng (normal gait)
and gwo (gait with orthosis)::

    austra/ng/xsens_imu_data_austra_ng.csv        'time [s]', XSens_Pelvis_QW, _QX, ...: orientations, 100 Hz
    austra/ng/metadata_austra_ng.json             start_ts of the T-pose; segment -> imu_name, marker_names
    austra/ng/qualisys_marker_data_austra_ng.csv  'time_[s]', R_IAS_X_[mm], ...; 0 where missing

The files of IMU inverse kinematics that the set has are of the same sensors. The reference is therefore made
from the markers: flexion of the knees from joint centres, or, where the user has run OpenSim's inverse
kinematics of the markers, ``ik_markers/ik_austra_ng.mot``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import load_json, measurable, read_text
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.datasets.joint_centres import hinge_table, hip_centres
from rtof_kin.datasets.public_sets import Movement, Take, TakeInputs, Truth, checked_root, existing, some
from rtof_kin.formats.opensim import read_opensim_table
from rtof_kin.formats.sensors.readings import Readings, sensor_log

EXERCISES: Final[dict[str, Movement]] = {"rd": "other", "rgs": "other", "ng": "walk", "gwo": "walk"}
SEGMENTS: Final = {
    "pelvis": "pelvis",
    "torso": "sternum",
    "femur_r": "right thigh",
    "femur_l": "left thigh",
    "tibia_r": "right shank",
    "tibia_l": "left shank",
    "calcn_r": "right foot",
    "calcn_l": "left foot",
}
"""Body of OpenSim in the metadata -> segment; the right foot's second sensor, on the toes, is left out."""
POSE_SECONDS: Final = 1.0
"""[s] of the T-pose from `start_ts` on that are used."""
_QUATERNION: Final = re.compile(r"(.+)_Q([WXYZ])")
_MARKER: Final = re.compile(r"(.+)_([XYZ])_\[mm\]")
_MARKERS: Final[dict[str, tuple[str, ...]]] = {
    "right_asis": ("R_IAS",),
    "left_asis": ("L_IAS",),
    "right_psis": ("R_IPS",),
    "left_psis": ("L_IPS",),
    "right_knee": ("R_FLE", "R_FME"),
    "left_knee": ("L_FLE", "L_FME"),
    "right_ankle": ("R_FAL", "R_TAM"),
    "left_ankle": ("L_FAL", "L_TAM"),
}
"""Point -> the markers whose middle it is."""
_OF_LEGS: Final = tuple(
    f"{name}_{side}"
    for side in "rl"
    for name in ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle")
)
_LAYOUT: Final = "SUBJECT/ng/xsens_imu_data_SUBJECT_ng.csv with metadata and markers"


class Gaitex:
    """Adapter of GAITEX."""

    name = "gaitex"
    title = "GAITEX"
    mode: Mode = "imu"
    caution = (
        "sensors give orientations alone, so that the root has no path; joint centres define the flexion "
        "of the knees alone, with an offset of definition"
    )

    def __init__(self, root: Path):
        """Take the folder with a folder for each subject, or one above."""
        self.root = checked_root(root, "GAITEX")

    def takes(self) -> tuple[Take, ...]:
        """See `PublicSet.takes`."""
        return some(self._takes(), self.root, self.title, _LAYOUT)

    def _takes(self) -> Iterator[Take]:
        for path in sorted(self.root.rglob("xsens_imu_data_*.csv")):
            subject, exercise = path.parent.parent.name, path.parent.name
            if exercise in EXERCISES and path.name == f"xsens_imu_data_{subject}_{exercise}.csv":
                key = f"{subject}_{exercise}"
                yield Take(key, subject, exercise, EXERCISES[exercise], path.parent)

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        start, bodies = _metadata(take)
        log = read_orientations(take.folder / f"xsens_imu_data_{take.key}.csv")
        places = {imu: SEGMENTS[body] for body, imu in bodies.items() if body in SEGMENTS}
        missing = [imu for imu in places if imu not in log.names]
        if missing:
            raise FileFormatError(log.path, f"no columns of {', '.join(missing)}, which the metadata name")
        return TakeInputs(
            sensors=log.select(list(places)), places=places, pose="T", still=(start, start + POSE_SECONDS)
        )

    def truth(self, take: Take) -> Truth:
        """See `PublicSet.truth`."""
        own = take.folder / "ik_markers" / f"ik_{take.key}.mot"
        if own.is_file():
            source = "OpenSim inverse kinematics of optical markers, run by the user"
            return Truth(read_opensim_table(own), _OF_LEGS, source, reach=0.5)
        path = existing(
            take.folder / f"qualisys_marker_data_{take.key}.csv",
            "the positions of the markers",
            "unpack the raw data of GAITEX",
        )
        times, points = read_markers(path)
        centres = {name: _point(path, points, markers) for name, markers in _MARKERS.items()}
        table = hinge_table(times, hip_centres(centres) | centres)
        return Truth(table, table.names, "angles between joint centres of optical markers", reach=0.5)


def _metadata(take: Take) -> tuple[float, dict[str, str]]:
    """Return the time of the pose, s, and the sensor of each body."""
    path = take.folder / f"metadata_{take.key}.json"
    existing(path, "the metadata, which say where each sensor is,", "unpack the raw data of GAITEX")
    found: Any = load_json(path)
    start = found.get("start_ts") if isinstance(found, dict) else None
    bodies = found.get("inverse_kinematics") if isinstance(found, dict) else None
    if not isinstance(start, int | float) or not np.isfinite(start) or start < 0:
        raise FileFormatError(path, f"start_ts: expected the time of the T-pose, s, found {start!r}")
    if not isinstance(bodies, dict) or not all(
        isinstance(one, dict) and isinstance(one.get("imu_name"), str) for one in bodies.values()
    ):
        raise FileFormatError(path, "inverse_kinematics: expected an imu_name for each body")
    return float(start), {body: one["imu_name"] for body, one in bodies.items()}


def read_orientations(path: Path) -> SensorLog:
    """Read the orientation of every sensor; components by their names, as files order them differently.

    Args:
        path: ``xsens_imu_data_*.csv``.

    Raises:
        FileFormatError: no time, an incomplete sensor, no quaternions, or damaged.
    """
    names, table = _table(path, "time [s]")
    columns: dict[str, dict[str, int]] = {}
    for column, name in enumerate(names):
        if found := _QUATERNION.fullmatch(name):
            columns.setdefault(found[1], {})[found[2]] = column
    for sensor, own in columns.items():
        if set(own) != set("WXYZ"):
            missing = ", ".join(f"{sensor}_Q{c}" for c in "WXYZ" if c not in own)
            raise FileFormatError(path, f"no column {missing}")
    quaternions = {sensor: table[:, [own[c] for c in "WXYZ"]] for sensor, own in columns.items()}
    for sensor, quat in quaternions.items():
        norm = float(np.nanmedian(np.linalg.norm(quat, axis=1)))
        if not 0.9 < norm < 1.1:
            raise FileFormatError(path, f"{sensor}: quaternions have a norm of {norm:.3g}, not 1")
    readings = [Readings(name, table[:, 0], quaternions=quat) for name, quat in quaternions.items()]
    try:
        return sensor_log([path], "GAITEX orientations", readings, Declaration())
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def read_markers(path: Path) -> tuple[Array, dict[str, Array]]:
    """Read times (T,) s and each marker (T, 3) m; NaN where it is missing.

    Args:
        path: ``qualisys_marker_data_*.csv``.

    Raises:
        FileFormatError: no time, no marker in mm, or damaged.
    """
    names, table = _table(path, "time_[s]")
    columns: dict[str, dict[str, int]] = {}
    for column, name in enumerate(names):
        if found := _MARKER.fullmatch(name):
            columns.setdefault(found[1], {})[found[2]] = column
    whole = {marker: own for marker, own in columns.items() if set(own) == set("XYZ")}
    if not whole:
        raise FileFormatError(path, "no columns such as R_IAS_X_[mm]; is it of another unit or version?")
    points = {marker: table[:, [own[a] for a in "XYZ"]] / 1000 for marker, own in whole.items()}
    return table[:, 0], {
        marker: np.where((p == 0).all(axis=1, keepdims=True), np.nan, p) for marker, p in points.items()
    }


def _point(path: Path, points: dict[str, Array], markers: tuple[str, ...]) -> Array:
    missing = [marker for marker in markers if marker not in points]
    if missing:
        raise FileFormatError(path, f"no marker {', '.join(missing)}, which the flexion of the knees needs")
    return np.asarray(np.mean([points[marker] for marker in markers], axis=0))


def _table(path: Path, time: str) -> tuple[list[str], Array]:
    """Return the names of columns and the numbers of a CSV whose first column is the time."""
    lines = [line for line in read_text(path, "CSV").splitlines() if line.strip()]
    names = [name.strip().strip('"') for name in lines[0].split(",")] if lines else []
    if not names or names[0] != time:
        raise FileFormatError(path, f"expected {time!r} as first column, found {names[0] if names else ''!r}", 1)
    rows = []
    for number, line in enumerate(lines[1:], 2):
        cells = line.split(",")
        if len(cells) != len(names):
            raise FileFormatError(path, f"{len(cells)} cells under {len(names)} names: cut off?", number)
        try:
            rows.append([float(cell) if cell.strip() else np.nan for cell in cells])
        except ValueError as error:
            raise FileFormatError(path, f"holds something else than numbers ({error})", number) from error
    if len(rows) < 2:
        raise FileFormatError(path, "has fewer than two rows: cut off?")
    table = np.array(rows)
    if not measurable(table[np.isfinite(table)]):
        raise FileFormatError(path, "holds a number that is no measurement")
    return names, table
