"""Two public sets with inertial sensors: GAITEX and VIDIMU.

GAITEX (Spilz, Munz et al., Scientific Data 2025): nine IMUs and markers, gait and exercises, no camera.

Files of a trial; exercises are rd (resisted dorsiflexion), rgs (resisted gait simulation), ng (normal gait)
and gwo (gait with orthosis)::

    austra/ng/xsens_imu_data_austra_ng.csv        'time [s]', XSens_Pelvis_QW, _QX, ...: orientations, 100 Hz
    austra/ng/metadata_austra_ng.json             start_ts of the T-pose; segment -> imu_name, marker_names
    austra/ng/qualisys_marker_data_austra_ng.csv  'time_[s]', R_IAS_X_[mm], ...; 0 where missing

The files of IMU inverse kinematics that the set has are of the same sensors. The reference is therefore made
from the markers: flexion of the knees from joint centres, or, where the user has run OpenSim's inverse
kinematics of the markers, ``ik_markers/ik_austra_ng.mot``.

VIDIMU (Martínez-Zarzuela et al., Scientific Data 10, 648, 2023): one camera, five IMUs, 13 activities.

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
from typing import ClassVar, Final

import numpy as np
from pydantic import ConfigDict

from rtof_kin.body.kinematics import hip_centres
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.core.files.input_table import InputTable, Number
from rtof_kin.core.files.text import load_json, measurable, numbers_of, read_text
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.datasets.public_sets import PublicSet, Take, TakeInputs, Truth, existing, hinge_table, orientation_log
from rtof_kin.formats.opensim import read_opensim_table

BODIES: Final = ("pelvis", "torso", "femur_r", "femur_l", "tibia_r", "tibia_l", "calcn_r", "calcn_l")
"""Bodies of OpenSim in the metadata that are used; the right foot's second sensor, on the toes, is left out."""
POSE_SECONDS: Final = 1.0  #: [s] of the T-pose from `start_ts` on that are used
_QUATERNION: Final = re.compile(r"(.+)_Q([WXYZ])")
_MARKER: Final = re.compile(r"(.+)_([XYZ])_\[mm\]")
_MARKERS: Final = {
    f"{side}_{point}": tuple(f"{side[0].upper()}_{marker}" for marker in markers)
    for point, markers in {"asis": ["IAS"], "psis": ["IPS"], "knee": ["FLE", "FME"], "ankle": ["FAL", "TAM"]}.items()
    for side in ("right", "left")
}
"""Point -> the markers whose middle it is."""
_OF_LEGS: Final = tuple(
    f"{name}_{side}"
    for side in "rl"
    for name in ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle")
)


class Gaitex(PublicSet):
    """Adapter of GAITEX."""

    name = "gaitex"

    def _takes(self) -> Iterator[Take]:
        for path in sorted(self.root.rglob("xsens_imu_data_*.csv")):
            subject, exercise = path.parent.parent.name, path.parent.name
            if exercise in self.kinds and path.name == f"xsens_imu_data_{subject}_{exercise}.csv":
                key = f"{subject}_{exercise}"
                yield Take(key, subject, exercise, self.kinds[exercise], path.parent)

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        start, bodies = _metadata(take)
        log = read_orientations(take.folder / f"xsens_imu_data_{take.key}.csv")
        places = {imu: body for body, imu in bodies.items() if body in BODIES}
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
        back = (centres["right_psis"] + centres["left_psis"]) / 2
        hips = hip_centres(centres["left_asis"], centres["right_asis"], back)
        table = hinge_table(times, dict(zip(("left_hip", "right_hip"), hips, strict=True)) | centres)
        return Truth(table, table.names, "angles between joint centres of optical markers", reach=0.5)


def _metadata(take: Take) -> tuple[float, dict[str, str]]:
    """Return the time of the pose, s, and the sensor of each body."""
    path = take.folder / f"metadata_{take.key}.json"
    existing(path, "the metadata, which say where each sensor is,", "unpack the raw data of GAITEX")
    found = _MetadataTable.of(load_json(path), path)
    if found.start_ts < 0:
        raise found.error("start_ts", f"expected the time of the T-pose, s, found {found.start_ts:g}")
    return found.start_ts, {body: own.imu_name for body, own in found.inverse_kinematics.items()}


class _BodyTable(InputTable):
    model_config = ConfigDict(extra="ignore")
    imu_name: str


class _MetadataTable(InputTable):
    model_config = ConfigDict(extra="ignore")
    start_ts: Number  # [s] of the T-pose
    inverse_kinematics: dict[str, _BodyTable]


def read_orientations(path: Path) -> SensorLog:
    """Read the orientation of every sensor of an ``xsens_imu_data_*.csv``.

    Components are found by their names, as files order them differently. `FileFormatError`: no time, an incomplete
    sensor, no quaternions, or damaged.
    """
    times, sensors = _columns(path, "time [s]", _QUATERNION)
    for sensor, own in sensors.items():
        if missing := [f"{sensor}_Q{c}" for c in "WXYZ" if c not in own]:
            raise FileFormatError(path, f"no column {', '.join(missing)}")
    quaternions = {name: (times, np.stack([own[c] for c in "WXYZ"], axis=1)) for name, own in sensors.items()}
    return orientation_log(path, "GAITEX orientations", quaternions)


def read_markers(path: Path) -> tuple[Array, dict[str, Array]]:
    """Read times (T,) s and markers (T, 3) m of a ``qualisys_marker_data_*.csv``; NaN where one is missing.
    `FileFormatError`: no time, no marker in mm, or damaged.
    """
    times, markers = _columns(path, "time_[s]", _MARKER)
    points = {
        name: np.stack([own[a] for a in "XYZ"], axis=1) / 1000
        for name, own in markers.items()
        if set(own) == set("XYZ")
    }
    if not points:
        raise FileFormatError(path, "no columns such as R_IAS_X_[mm]; is it of another unit or version?")
    return times, {name: np.where((p == 0).all(axis=1, keepdims=True), np.nan, p) for name, p in points.items()}


def _columns(path: Path, time: str, pattern: re.Pattern[str]) -> tuple[Array, dict[str, dict[str, Array]]]:
    """Return the times of a CSV, and its columns by the two groups of their names' pattern."""
    columns = {name.strip(): values for name, values in read_csv(path).items()}
    if next(iter(columns)) != time:
        raise FileFormatError(path, f"expected {time!r} as first column, found {next(iter(columns))!r}", 1)
    if len(columns[time]) < 2:
        raise FileFormatError(path, "has fewer than two rows: cut off?")
    found: dict[str, dict[str, Array]] = {}
    for name, values in columns.items():
        if match := pattern.fullmatch(name):
            found.setdefault(match[1], {})[match[2]] = values
    return columns[time], found


def _point(path: Path, points: dict[str, Array], markers: tuple[str, ...]) -> Array:
    missing = [marker for marker in markers if marker not in points]
    if missing:
        raise FileFormatError(path, f"no marker {', '.join(missing)}, which the flexion of the knees needs")
    return np.asarray(np.mean([points[marker] for marker in markers], axis=0))


_LEGS: Final = tuple(
    f"{name}_{side}" for side in "rl" for name in ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle")
)
_ARMS: Final = ("elbow_flex_r", "elbow_flex_l", "pro_sup_r", "pro_sup_l")
_COLUMNS: Final = ("QUAT", "w", "x", "y", "z", "timestamp")
_TRIAL: Final = re.compile(r"(S\d{2})_(A\d{2})_(T\d{2})")
_RATE_HZ: Final = 50.0
_OF_POSE: Final = 2  #: Rows of the reference that belong to the N-pose, as the set's own scripts leave them out


class Vidimu(PublicSet):
    """Adapter of VIDIMU's subjects with video and sensors."""

    name = "vidimu"
    places: ClassVar[dict[str, dict[str, str]]]  #: Of the sensors on legs and on arms

    def _takes(self) -> Iterator[Take]:
        found: dict[str, Path] = {}
        for path in sorted([*self.root.rglob("*.raw"), *self.root.rglob("ik_S*.mot")]):
            name = _TRIAL.fullmatch(path.stem.removeprefix("ik_"))
            if name is None or path.parent.name != name[1] or name[2] not in self.kinds:
                continue
            if not path.parent.parent.name.startswith("videoandimusync"):  # cut copies without videos of their own
                found.setdefault(name[0], path.parent)
        for key, folder in sorted(found.items()):
            subject, activity, _ = key.split("_")
            yield Take(key, subject, activity, self.kinds[activity], folder, "camera")

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        path = existing(take.folder / f"{take.key}.raw", "the sensors' quaternions", "unpack dataset.zip of VIDIMU")
        places = self.places["arms" if take.kind == "arms" else "legs"]
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
        table = read_opensim_table(path)
        if len(table.times) <= _OF_POSE + 1:
            raise FileFormatError(path, f"has {len(table.times)} rows: cut off?")
        table = replace(table, times=table.times[_OF_POSE:], values=table.values[_OF_POSE:])
        source = "OpenSim inverse kinematics of the take's own sensors"
        return Truth(table, _ARMS if take.kind == "arms" else _LEGS, source, of_sensors=True, reach=2.0)


def read_raw(path: Path, sensors: tuple[str, ...]) -> SensorLog:
    """Read the quaternions of one trial's ``.raw`` file, without the N-pose in the first instant.
    `FileFormatError`: another header, an unknown or missing sensor, no numbers, or damaged.
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
        name, *cells = line.split(",")
        if line.strip():
            numbers = numbers_of(path, number, cells, len(header) - 1, gaps=True)
            if name not in rows:
                raise FileFormatError(path, f"expected one of {', '.join(sensors)}, found {name[:60]!r}", number)
            rows[name].append(numbers)
    found = {name: np.array(own, dtype=float) for name, own in rows.items()}
    if short := [name for name, own in found.items() if len(own) < 3]:
        raise FileFormatError(path, f"fewer than two samples of {', '.join(short)} after the N-pose: cut off?")
    if not all(measurable(own) for own in found.values()):
        raise FileFormatError(path, "holds a number that cannot be a quaternion or a time")
    first = min(float(own[1, 4]) for own in found.values()) if len(header) == 6 else 0.0
    return orientation_log(path, "VIDIMU .raw", {n: (_times(own[1:], first), own[1:, :4]) for n, own in found.items()})


def _times(rows: Array, first: float) -> Array:
    """Time stamps from the first one, s, if they increase; else the nominal rate."""
    if rows.shape[1] == 5 and (np.diff(rows[:, 4]) > 0).all():
        return np.asarray(rows[:, 4] - first)
    return np.arange(len(rows)) / _RATE_HZ
