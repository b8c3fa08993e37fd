"""Text tables of inertial sensors: plain CSV, Noraxon, Motion-BIDS, x-IMU3, phones, OpenSense.

Plain CSV is for any logger. The first line names the columns, the others hold numbers; commas, decimal points, UTF-8;
an empty cell or ``nan`` is a missing sample. ``time`` is in seconds and increases; without it the rate is declared,
and the first line is 0 s. NAME is a sensor's, of any characters but commas:

=====================================  =============================================================
NAME_fx, NAME_fy, NAME_fz              specific force, sensor axes: 9.81 m/s^2 upwards at rest
NAME_wx, NAME_wy, NAME_wz              angular velocity, sensor axes, rad/s
NAME_mx, NAME_my, NAME_mz              magnetic field, sensor axes, any unit
NAME_qw, NAME_qx, NAME_qy, NAME_qz     unit quaternion from the sensor to a reference with z up
=====================================  =============================================================

Each sensor has one or more complete groups. Other units, axes and order can be declared.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import load_json, numbers_of, write_text
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.channels import StreamChannels
from rtof_kin.formats.sensors.readings import Readings, in_order, lost, sensor_log
from rtof_kin.formats.sensors.sensor_text import (
    LONGEST_LINE,
    MOST_HEADER_LINES,
    SensorTable,
    cells,
    read_table,
    text_lines,
    unzoned_note,
)

CSV_TITLE: Final = "plain CSV"
_ENDINGS: Final = (*(f"_{kind}{axis}" for kind in "fwm" for axis in "xyz"), "_qw", "_qx", "_qy", "_qz")


def _is_header(names: Sequence[str]) -> bool:
    return any(name[-3:] in _ENDINGS for name in names)


def is_imu_csv(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return _is_header(cells(head.split("\n", 1)[0]))


def read_imu_csv(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the column of times."""
    table = read_table(path, _is_header, lambda name: True)
    labels = [name for name in table.names if name != "time"]
    for label in labels:
        if label[-3:] not in _ENDINGS or len(label) == 3:
            known = "time, or a sensor's name and one of " + ", ".join(_ENDINGS)
            raise FileFormatError(path, f"column {label!r}: expected {known}", 1)
    return _labelled(table, CSV_TITLE, labels, [""] * len(labels), declared)


def _labelled(
    table: SensorTable, title: str, labels: Sequence[str], units: Sequence[str], declared: Mapping[str, Any]
) -> SensorLog:
    """Return the log of a table whose columns but `time` have labels and units of `formats.channels`."""
    Declaration().changed(**declared)
    try:
        channels = StreamChannels.of(table.path.stem, labels, units, declared=declared)
    except InvalidInputError as error:
        raise FileFormatError(table.path, str(error), len(table.header) + 1) from error
    times = _times(table, channels.declaration.rate_hz)
    values = table.values[:, [i for i, name in enumerate(table.names) if name.lower() != "time"]]
    readings = (sensor.readings(times, values) for sensor in channels.sensors)
    notes = (*table.notes, *channels.notes, *lost(times))
    return sensor_log([table.path], title, readings, channels.declaration, notes)


def _times(table: SensorTable, rate_hz: float | None) -> Array:
    times = table.column("time")
    if rate_hz is not None:
        return np.arange(len(table.values)) / rate_hz
    if times is None:
        raise FileFormatError(table.path, "no column time (s); add it, or declare rate_hz", len(table.header) + 1)
    wrong = np.flatnonzero(~(np.diff(times, prepend=-np.inf) > 0))
    if len(wrong):
        i = int(wrong[0])
        problem = f"time {times[i]:g} s is not after the one above; sort, and drop what came twice"
        raise FileFormatError(table.path, problem, table.lines[i])
    return times


# CSV of Noraxon's myoRESEARCH: MyoMotion and Ultium Motion, all sensors of a trial in one file.
#
# Three lines about the recording (type, name, ...) may stand above the names of the columns. Cells are
# separated by commas, or by semicolons where numbers have decimal commas. A sensor is named by its segment,
# with the side on a limb: ``Thigh LT``. The software has had several spellings; read are ``time``, s, and
#
# =================  =======================================================================================
# accelerometer      ``Thigh Accel Sensor X LT (mG)``, ``LT Thigh Accel Sensor X (mG)``,
#                    ``Thigh Accel Sensor X LT,mG``: gravity included, sensor axes
# gyroscope          ``Noraxon MyoMotion-Segments-Thigh LT-Gyroscope-x (deg/s)``, ``Thigh Gyro X LT (deg/s)``
# =================  =======================================================================================
#
# Course, pitch and roll, ``Rot``, and ``Acceleration`` of segments are not read, as no document says which
# rotation or axes they mean: orientation comes from the two above (`rtof_kin.inertial.orientation`). Names in
# other languages than English are not known. Joint angles and muscles' signals are ignored.

NORAXON_TITLE: Final = "Noraxon CSV"
_SEGMENT: Final = r"(?P<segment>[^-,()]+?)"
_SIDE: Final = r"(?: (?P<side>[LR]T))?"
_FORMS: Final = tuple(
    re.compile(form + r"\s*(?:\((?P<unit>[^()]*)\)|,\s*(?P<unit2>.*))\s*", re.IGNORECASE)
    for form in (
        rf"(?:(?P<before>[LR]T) )?{_SEGMENT} (?P<kind>Accel Sensor|Gyro) (?P<axis>[XYZ]){_SIDE}",
        rf"(?:Noraxon )?MyoMotion-Segments-{_SEGMENT}{_SIDE}-(?P<kind>Gyroscope)-(?P<axis>[xyz])",
    )
)


def is_noraxon(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return any(_is_noraxon_header(cells(line)) for line in head.splitlines()[:8])


def _is_noraxon_header(names: Iterable[str]) -> bool:
    return any(_meaning(name) is not None for name in names)


def _meaning(name: str) -> tuple[str, str] | None:
    """Return the label of a column in words of `formats.channels`, and its unit; None for one that is not read."""
    found = next((match for form in _FORMS if (match := form.fullmatch(name.strip()))), None)
    if found is None:
        return None
    parts = found.groupdict()
    side = (parts.get("before") or parts["side"] or "").upper()
    unit = (found["unit"] if found["unit"] is not None else found["unit2"]).strip() or "none"
    return f"{found['segment']} {side}".strip() + f" {found['kind'].split()[0]} {found['axis']}", unit


def read_noraxon(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the column of times."""
    table = read_table(path, _is_noraxon_header, lambda name: name.lower() == "time" or bool(_meaning(name)), True)
    labels, units = zip(*(found for name in table.names if (found := _meaning(name)) is not None), strict=True)
    return _labelled(table, NORAXON_TITLE, labels, units, declared)


# Motion-BIDS: a ``*_motion.tsv`` without a line of names, which ``*_channels.tsv`` has (BIDS 1.9 and later, "Motion").
#
# Read are channels of type ACCEL, GYRO and MAGN, and of ORNT those of components quat_w, ..., in the units that are
# stated; a sensor is a tracked point. Times are the channel of type LATENCY, s, else those of SamplingFrequency.

BIDS_TITLE: Final = "Motion-BIDS"
BIDS_MOTION: Final = "_motion.tsv"
BIDS_COLUMNS: Final = ("name", "component", "type", "tracked_point", "units")  #: First columns of ``*_channels.tsv``
_BIDS_LABELS: Final = {"ACCEL": "acc_", "GYRO": "gyr_", "MAGN": "mag_", "ORNT": ""}
_BIDS_ROW: Final = re.compile(r"((n/a|nan|[-+]?[\d.]+(e[-+]?\d+)?)(\t(?!\n)|(?=\r?\n))){3,}\r?\n", re.IGNORECASE)


def is_bids_motion(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return bool(_BIDS_ROW.match(head))


def read_bids_motion(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces latencies and sampling frequency."""
    about = _describing(path, "_channels.tsv")
    header, *rows = [[cell.strip() for cell in line.split("\t")] for _, line in text_lines(about) if line] or [[""]]
    lacking = [name for name in BIDS_COLUMNS if name not in header]
    if lacking or any(len(row) != len(header) for row in rows):
        raise FileFormatError(
            about, f"has no column {lacking[0]}" if lacking else "rows of other lengths than the first"
        )
    names, units, left = list[str](), dict[str, str](), list[str]()
    for name, component, kind, point, unit in ([row[header.index(one)] for one in BIDS_COLUMNS] for row in rows):
        if kind in _BIDS_LABELS and (kind != "ORNT" or component.startswith("quat_")):
            name = f"{'' if point == 'n/a' else point}.{_BIDS_LABELS[kind]}{component}".lstrip(".")
            units[name] = "" if unit == "n/a" else unit
        elif kind != "LATENCY":
            left.append(name)
        names.append("time" if kind == "LATENCY" else name)
    if "time" not in names and declared.get("rate_hz") is None:
        file = _describing(path, "_motion.json")
        rate = load_json(file).get("SamplingFrequency")
        if not isinstance(rate, int | float):
            raise FileFormatError(file, "has no number SamplingFrequency")
        declared["rate_hz"] = float(rate)
    table = read_table(path, lambda _: True, lambda name: name in units or name == "time", names_above="\t".join(names))
    notes = (*table.notes, *([f"channels left out: {', '.join(left)}"] if left else ()))
    return _labelled(replace(table, notes=notes), BIDS_TITLE, [*units], [*units.values()], declared)


def _describing(path: Path, ending: str) -> Path:
    """Return the file that describes a motion file: beside it or in a folder above, with no label that it lacks."""
    own = {*path.name.removesuffix(BIDS_MOTION).split("_"), ""}
    for folder in path.absolute().parents[:4]:
        found = [one for one in folder.glob(f"*{ending}") if own >= {*one.name.removesuffix(ending).split("_")}]
        if found:
            return max(found, key=lambda one: len(one.name))
    raise FileFormatError(path, f"numbers without names: its {ending[1:]} is neither beside it nor above; put it there")


# Folders of x-io Technologies' x-IMU3: a folder per sensor, a CSV per kind of message.
#
# Read are ``Inertial.csv`` (gyroscope deg/s, accelerometer g, gravity included, sensor axes), ``Quaternion.csv`` (W, X,
# Y, Z from the sensor to the earth, z up in its usual NWU) and ``Magnetometer.csv``, each with its own time stamps in
# us. ``Command.json`` names the sensor, else the folder does. Orientation and magnetic field are interpolated to the
# inertial samples where their stamps differ. Clocks are those of the devices, which the maker's software synchronises.

XIMU3_TITLE: Final = "x-IMU3 folders"
_STAMP: Final = "Timestamp (us)"
_GYROSCOPE: Final = tuple(f"Gyroscope {axis} (deg/s)" for axis in "XYZ")
_ACCELEROMETER: Final = tuple(f"Accelerometer {axis} (g)" for axis in "XYZ")
_OTHERS: Final = {
    "Quaternion": (("W", "X", "Y", "Z"), 0.1),
    "Magnetometer": (("X (a.u.)", "Y (a.u.)", "Z (a.u.)"), 0.5),
}
"""Columns of other messages, and the longest gap, s, that is interpolated."""
_WHOLE: Final = 2**53
_LATEST_US: Final = 1_000_000
_LARGEST_JSON: Final = 2**20


def is_ximu3(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return cells(head.split("\n", 1)[0])[0] == _STAMP


def read_ximu3(paths: Sequence[Path], **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` gives equal steps after the first stamp."""
    declaration = Declaration(acceleration_unit="g", angular_unit="deg/s").changed(**declared)
    folders = list(dict.fromkeys(path.parent for path in paths))
    labels = [_label(folder) for folder in folders]
    names = [name for name, _ in labels]
    sensors = [
        _sensor(folder, f"{name} {serial}" if names.count(name) > 1 else name, declaration.rate_hz)
        for folder, (name, serial) in zip(folders, labels, strict=True)
    ]
    notes = unzoned_note(_command(folders[0], "time"))
    return sensor_log(paths if len(paths) == 1 else folders, XIMU3_TITLE, sensors, declaration, notes)


def _label(folder: Path) -> tuple[str, str]:
    """Return a sensor's name and serial number, from Command.json, else from the folder's name."""
    ping = _command(folder, "ping")
    name, serial = (ping.get("name"), ping.get("sn")) if isinstance(ping, dict) else (None, None)
    if isinstance(name, str) and isinstance(serial, str) and name.strip():
        return name.strip(), serial
    found = re.fullmatch(r"(.+?) ([0-9A-Fa-f]{8})( \(.*\))?", folder.name)
    return (found[1], found[2]) if found else (folder.name, "")


def _command(folder: Path, name: str) -> Any:
    """Return the value of a command in Command.json; None where absent, or not as devices write it."""
    try:
        with (folder / "Command.json").open("rb") as stream:
            commands = json.loads(stream.read(_LARGEST_JSON))
        return next(command[name] for command in commands if name in command)
    except (OSError, ValueError, TypeError, KeyError, StopIteration, RecursionError):
        return None


def _sensor(folder: Path, name: str, rate_hz: float | None) -> Readings:
    inertial = _messages(folder / "Inertial.csv", (*_GYROSCOPE, *_ACCELEROMETER))
    if inertial is None:
        raise FileFormatError(folder, "has no Inertial.csv; log inertial messages")
    stamps, values, notes = inertial
    others: dict[str, Array | None] = dict.fromkeys(_OTHERS)
    for kind, (columns, max_gap) in _OTHERS.items():
        found = _messages(folder / f"{kind}.csv", columns)
        if found is not None:
            own, others[kind], remarks = found
            if not np.array_equal(own, stamps):
                remarks.append(f"{len(own)} messages interpolated to the inertial samples")
                others[kind] = _interpolated(own, found[1], stamps, max_gap * 1e6)
            notes += [f"{kind}: {note}" for note in remarks]
    times = stamps / 1e6
    if rate_hz is not None:
        times = times[0] + np.arange(len(times)) / rate_hz
    else:
        notes += lost(times)
    f, w = values[:, 3:], values[:, :3]
    return Readings(name, times, f, w, others["Magnetometer"], others["Quaternion"], notes=tuple(notes))


def _messages(path: Path, columns: Sequence[str]) -> tuple[Array, Array, list[str]] | None:
    """Return stamps (T,) us, numbers (T, C) and notes of one file, in order; None without the file."""
    if not path.exists():
        return None
    wanted = {_STAMP, *columns}
    table = read_table(path, lambda names: _STAMP in names, lambda name: name in wanted)
    stamps, values = table.column(_STAMP), table.columns(*columns)
    if stamps is None or values is None:
        raise FileFormatError(path, f"has no columns {', '.join(columns)}", 1)
    packets = in_order(path, stamps, table.lines, _WHOLE, _LATEST_US, _STAMP)
    return packets.count.astype(float), values[packets.rows], [*table.notes, *packets.notes]


def _interpolated(stamps: Array, values: Array, at: Array, max_gap: float) -> Array:
    """Interpolate vectors (T, 3), or quaternions (T, 4) whose signs may jump."""
    if values.shape[1] == 4:  # a quaternion and its opposite are the same rotation
        turned = np.sum(values[1:] * values[:-1], axis=1) < 0
        values = values * np.cumprod(np.where([False, *turned], -1.0, 1.0))[:, None]
    return signals.interpolate(stamps, values, at, max_gap)


# OpenSense orientation tables (.sto) of OpenSim: orientation alone, all sensors at the same times.
#
# Header lines to ``endheader``, among them ``DataType=Quaternion``; then tab-separated columns ``time``
# and ``<body>_imu``, with cells ``w,x,y,z``: from the sensor to a reference with z up, or with y up where
# OpenSim's rotation was already applied; then declare ``inertial_axes="y up"``.

OPENSENSE_TITLE: Final = "OpenSense .sto"
_SUFFIX: Final = "_imu"
_END: Final = "endheader"


def is_opensense_sto(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    lines = [line.strip().lower().replace(" ", "") for line in head.splitlines()]
    return "datatype=quaternion" in lines and _END in lines


def read_opensense_sto(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the column of times."""
    declaration = Declaration().changed(**declared)
    rows = text_lines(path)
    for number, line in rows:
        if line.strip().lower() == _END:
            break
        if number >= MOST_HEADER_LINES:
            raise FileFormatError(path, f"no {_END} in the first {number} lines", number)
    number, line = next(rows, (1, ""))
    names = line.rstrip().split("\t")
    if names[0] != "time" or len(names) < 2:
        raise FileFormatError(path, f"expected time and sensors' names after {_END}", number)
    table = []
    for number, line in rows:
        cells_of = line.rstrip().split("\t")
        if len(cells_of) == len(names):
            widths = [1] + [4] * (len(names) - 1)
            table.append([numbers_of(path, number, c.split(","), w) for c, w in zip(cells_of, widths, strict=True)])
        elif line.strip():
            raise FileFormatError(path, f"{len(cells_of)} cells under {len(names)} column names", number)
    if not table:
        raise FileFormatError(path, "holds names and no row", number)
    times = np.array([row[0][0] for row in table])
    quaternions = np.array([row[1:] for row in table]).transpose(1, 0, 2)
    if declaration.rate_hz is not None:
        times = np.arange(len(times)) / declaration.rate_hz
    sensors = [
        Readings(name.removesuffix(_SUFFIX), times, quaternions=quat)
        for name, quat in zip(names[1:], quaternions, strict=True)
    ]
    return sensor_log([path], OPENSENSE_TITLE, sensors, declaration, lost(times))


def write_opensense_sto(path: str | Path, log: SensorLog) -> None:
    """Write orientations R_inertial_sensor, z up, for OpenSense, of sensors named as bodies (`SensorLog.renamed`).
    `InvalidInputError`: a sensor lacks orientation or was sampled at other times.
    """
    times = log.streams[0].times
    columns = []
    for stream in log.streams:
        R = stream.R_inertial_sensor
        if R is None or np.isnan(R).any():
            raise InvalidInputError(f"sensor {stream.name} has no orientation in every sample; cut or fill it")
        if not np.array_equal(stream.times, times):
            problem = f"sensors {log.names[0]} and {stream.name} were sampled at different times"
            raise InvalidInputError(f"{problem}; resample one of them")
        columns.append([",".join(map(repr, quat)) for quat in so3.to_quat_wxyz(R).tolist()])
    rate = log.streams[0].rate_hz if len(times) > 1 else 1.0
    header = [f"DataRate={rate:.6f}", "DataType=Quaternion", "version=3", _END]
    names = "\t".join(["time", *(name + _SUFFIX for name in log.names)])
    rows = ["\t".join(cells) for cells in zip(map(repr, times.tolist()), *columns, strict=True)]
    write_text(Path(path), "\n".join([*header, names, *rows, ""]), overwrite=True)


# CSV of a phone's gyroscope and accelerometer, by phyphox, Sensor Logger, or written by hand.
#
# =====================  ==================================  ============================================
# written by             times, s                            angular velocity rad/s; specific force m/s^2
# =====================  ==================================  ============================================
# hand                   ``time``                            ``wx``, ``wy``, ``wz``; ``fx``, ``fy``, ``fz``
# phyphox                ``Time (s)``                        ``Gyroscope x (rad/s)``, ...;
#                                                            ``Acceleration x (m/s^2)``, ...
# Sensor Logger          ``seconds_elapsed``                 ``x``, ``y``, ``z`` of ``Gyroscope.csv``;
#                                                            of ``TotalAcceleration.csv``
# =====================  ==================================  ============================================
#
# Axes are the phone's: x to the right of the screen, y up, z out of it. Files of one folder are one phone.

_PHONE_TITLE: Final = "CSV of a phone"
_TIMES_OF_PHONE: Final = ("time", "time (s)", "seconds_elapsed")
_RATE_OF_PHONE, _FORCE_OF_PHONE = "gyroscope", "accelerometer"
_COLUMNS_OF_PHONE: Final = {
    _RATE_OF_PHONE: (("wx", "wy", "wz"), tuple(f"gyroscope {axis} (rad/s)" for axis in "xyz")),
    _FORCE_OF_PHONE: (("fx", "fy", "fz"), tuple(f"acceleration {axis} (m/s^2)" for axis in "xyz")),
}
_BY_FILE: Final = {"gyroscope": _RATE_OF_PHONE, "totalacceleration": _FORCE_OF_PHONE}
"""What columns x, y, z of a file of this name are."""
_LONGEST_GAP: Final = 0.1  # [s] that the accelerometer is interpolated over


def _is_phone_header(names: Sequence[str]) -> bool:
    have = {name.strip('"').lower() for name in names}
    groups = [set(group) for kinds in _COLUMNS_OF_PHONE.values() for group in kinds]
    own = any(have >= group for group in groups) or have >= {"seconds_elapsed", "x", "y", "z"}
    return own and not have.isdisjoint(_TIMES_OF_PHONE)


def phone_files(path: Path) -> list[Path]:
    """Return the files of a phone at a path, which may be a folder; none where it is of something else."""
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    return [one for one in files if _is_phone_header(cells(_first_line(one)))]


def _first_line(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.readline(LONGEST_LINE).decode("utf-8-sig", errors="replace")


def read_phone(paths: Sequence[Path]) -> SensorLog:
    """Read gyroscope and, where there is one, accelerometer of a phone as the sensor *phone*; `FileFormatError` without
    gyroscope, or where damaged.
    """
    found: dict[str, tuple[Array, Array]] = {}
    left: list[str] = []
    for path in paths:
        table = read_table(path, _is_phone_header, lambda name: True)
        times = next(t for t in (table.column(name) for name in reversed(_TIMES_OF_PHONE)) if t is not None)
        own = {kind: values for kind in _COLUMNS_OF_PHONE if (values := _phone_group(table, kind)) is not None}
        found |= {kind: (times, values) for kind, values in own.items()}
        left += [] if own else [path.name]
    if _RATE_OF_PHONE not in found:
        raise FileFormatError(paths[0], f"has no gyroscope; log it too, {_COLUMNS_OF_PHONE[_RATE_OF_PHONE][1][0]!r}")
    times, w = found[_RATE_OF_PHONE]
    f = None
    if _FORCE_OF_PHONE in found:
        f = signals.interpolate(*found[_FORCE_OF_PHONE], times, _LONGEST_GAP)
    notes = (f"left aside: {', '.join(left)}",) if left else ()
    return sensor_log(paths, _PHONE_TITLE, [Readings("phone", times, f, w)], Declaration(), (*notes, *lost(times)))


def _phone_group(table: SensorTable, kind: str) -> Array | None:
    """Return the columns of a kind (T, 3); None where the file has none."""
    groups = [*_COLUMNS_OF_PHONE[kind]]
    if _BY_FILE.get(table.path.stem.lower()) == kind:
        groups.append(("x", "y", "z"))
    return next((values for group in groups if (values := table.columns(*group)) is not None), None)
