"""Motion-BIDS: sensors and a motion as a data set of BIDS 1.11 (bids-specification.readthedocs.io, "Motion").

Each system is a table of numbers without a line of names, ``*_motion.tsv``, whose channels ``*_channels.tsv`` names.
Times are channels of type LATENCY, s on the clock of the recording, whose zero is ``acq_time`` of ``*_scans.tsv``, the
same of all systems, in 1900 as of data without a date. A value that was not observed is n/a.
`formats.sensors.tables.read_bids_motion` reads sensors back.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from rtof_kin.body.motion_source import BLOCK, MotionSource
from rtof_kin.body.observability import NOTHING, observed_dofs
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.sensors.tables import BIDS_COLUMNS, BIDS_MOTION

DESCRIPTION: Final = "dataset_description.json"
_COLUMNS: Final = (*BIDS_COLUMNS, "placement", "reference_frame", "description")
_FRAMES: Final = {
    "world": ("FLU", "room: quaternions turn vectors of the segment into it; its turn about a bone may be the model's"),
    "inertial": ("n/a", "own reference of each sensor: z up, heading unknown; quaternions turn vectors of the sensor"),
    "sensor": ("n/a", "axes of the sensor; specific force, which is 9.81 m/s^2 upwards at rest"),
    "joint": ("n/a", "revolute of the URDF about x (forward), y (left) or z (up) of the link, 0 in the T-pose"),
}
"""Reference frame of channels -> its axes, and what it is."""
_QUANTITIES: Final = {
    **{"f_sensor": ("ACCEL", "m/s^2", "sensor"), "w_sensor": ("GYRO", "rad/s", "sensor")},
    **{"m_sensor": ("MAGN", "n/a", "sensor"), "R_inertial_sensor": ("ORNT", "n/a", "inertial")},
}
_PARTICIPANTS: Final = {
    "sex": {"Levels": {"M": "male", "F": "female"}},
    **{"height": {"Description": "standing height", "Units": "m"}, "weight": {"Units": "kg"}},
}
_README: Final = """# Human motion

Tracking systems: imu, inertial sensors as they were recorded; rtofkin, the motion that was computed from them and from
video, where it was observed. There are no names, dates or places; a body and its gait identify a person all the same.
"""


class System(NamedTuple):
    """What one system tracked."""

    label: str  #: Of letters and digits
    times: Array  #: (T,) s
    channels: Sequence[tuple[str, ...]]  #: Cells of ``*_channels.tsv``, of C channels beside the latency
    blocks: Iterator[Array]  #: (n, C) values of consecutive samples; NaN where missing


def sensor_systems(log: SensorLog) -> Iterator[System]:
    """Yield the sensors of a recording: a system for all that were sampled at the same times."""
    for number, times in enumerate({one.times.tobytes(): one.times for one in log.streams}.values(), 1):
        channels, columns = list[tuple[str, ...]](), list[Array]()
        for stream in (one for one in log.streams if np.array_equal(one.times, times)):
            for kind in stream.holds:
                values: Array = getattr(stream, kind)
                columns.append(so3.known_to_quat_wxyz(values) if kind == "R_inertial_sensor" else values)
                channels += _channels(stream.name, *_QUANTITIES[kind])
        blocks = map(partial(_rows, columns), range(0, len(times), BLOCK))
        yield System("imu" if number == 1 else f"imu{number}", times, channels, blocks)


def _rows(columns: Sequence[Array], start: int) -> Array:
    return np.hstack([own[start : start + BLOCK] for own in columns])


def motion_system(motion: MotionSource) -> System:
    """Return positions and orientations of the joints' segments in world, and the angles of the URDF's revolutes."""
    channels = list[tuple[str, ...]]()
    for name in motion.skeleton.names:
        channels += [*_channels(name, "POS", "m", "world"), *_channels(name, "ORNT", "n/a", "world")]
    dofs = {dof.urdf: (joint.name, dof.clinical) for joint in motion.skeleton.table.joints for dof in joint.dofs}
    for name in motion.skeleton.dof_names:  # in the order of the configuration
        joint, words = dofs[name]
        words = f"{words}; a leading - says that its sign is the opposite" if words else "n/a"
        channels.append((f"{name}_JNTANG", "n/a", "JNTANG", joint, "deg", joint, "joint", words))

    def blocks() -> Iterator[Array]:
        for block, masks in motion.observed_blocks():
            p = np.where(masks.position_observed[..., None], block.poses.p_world_joint, np.nan)
            turned = (masks.levels > NOTHING) | (masks.posed & (not masks.has_sources))
            quat = so3.known_to_quat_wxyz(np.where(turned[..., None, None], block.poses.R_world_bone, np.nan))
            angles = np.where(observed_dofs(masks), np.degrees(block.q[:, 7:]), np.nan)
            yield np.hstack([np.concatenate([p, quat], axis=2).reshape(len(p), -1), angles])

    return System("rtofkin", motion.times, channels, blocks())


def _channels(point: str, kind: str, unit: str, frame: str) -> list[tuple[str, ...]]:
    axes = [f"quat_{axis}" for axis in "wxyz"] if kind == "ORNT" else "xyz"
    return [(f"{point}_{kind}_{axis}", axis, kind, point, unit, point, frame, "n/a") for axis in axes]


def write_bids(folder: Path, systems: Iterable[System], code: str, subject: Mapping[str, Any]) -> None:
    """Write a data set of one person into an existing folder, in blocks. code: of the person, letters and digits;
    subject: 'height_m', 'mass_kg' and 'sex', where known.
    """
    person, made = f"sub-{code}", [{"Name": "rtof_kin", "Version": version("rtof_kin")}]
    about = {"Name": "Human motion", "BIDSVersion": "1.11.0", "DatasetType": "raw", "GeneratedBy": made}
    (folder / person / "motion").mkdir(parents=True)
    (folder / "README.md").write_text(_README, encoding="utf-8")
    sex = {"male": "M", "female": "F"}.get(subject.get("sex") or "", "n/a")
    sizes = [subject.get(name) or "n/a" for name in ("height_m", "mass_kg")]
    _table(folder / "participants.tsv", [("participant_id", *_PARTICIPANTS), (person, sex, *sizes)])
    scans: list[tuple[str, str]] = [("filename", "acq_time")]
    for system in systems:
        stem = f"motion/{person}_task-motion_tracksys-{system.label}"
        _write_system(folder / person / stem, system)
        scans.append((f"{stem}{BIDS_MOTION}", "1900-01-01T00:00:00"))
    _table(folder / person / f"{person}_scans.tsv", scans)
    for name, contents in ((DESCRIPTION, about), ("participants.json", _PARTICIPANTS)):
        (folder / name).write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")


def _write_system(stem: Path, system: System) -> None:
    clock = (f"{system.label}_latency", "n/a", "LATENCY", "n/a", "s", "n/a", "n/a", "on the clock of the recording")
    channels, rotation = (clock, *system.channels), {"RotationOrder": "n/a", "RotationRule": "right-hand"}
    frames = {row[6]: _FRAMES[row[6]] for row in system.channels}
    levels = {name: {"Description": what, "SpatialAxes": axes, **rotation} for name, (axes, what) in frames.items()}
    frame = {"LongName": "reference frame", "Description": "frame of the values", "Levels": levels}
    T, kinds, seconds = len(system.times), [row[2] for row in channels], float(np.ptp(system.times))
    facts = {
        "TaskName": "motion",
        "TrackingSystemName": system.label,
        "SamplingFrequency": round(float(1 / np.median(np.diff(system.times))), 6),
        "SamplingFrequencyEffective": (T - 1) / seconds,
        "RecordingDuration": seconds,
        "MissingValues": "n/a",
        "TrackedPointsCount": len({row[3] for row in system.channels}),
        "MotionChannelCount": len(kinds),
        **{f"{kind}ChannelCount": kinds.count(kind) for kind in sorted({*kinds})},
    }
    _table(Path(f"{stem}_channels.tsv"), [_COLUMNS, *channels])
    for ending, contents in (("channels", {"reference_frame": frame}), ("motion", facts)):
        Path(f"{stem}_{ending}.json").write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")
    with Path(f"{stem}{BIDS_MOTION}").open("w", encoding="utf-8", newline="") as stream:
        times = iter(system.times.tolist())
        for block in system.blocks:
            for row in block.tolist():
                cells = ("n/a" if value != value else f"{value:.9g}" for value in row)
                stream.write("\t".join([f"{next(times):.6f}", *cells]) + "\n")


def _table(path: Path, rows: Sequence[Sequence[Any]]) -> None:
    path.write_text("".join("\t".join(map(str, row)) + "\n" for row in rows), encoding="utf-8", newline="")
