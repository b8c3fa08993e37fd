"""Files of inertial sensors, recognised by their content and read as one log.

A trial is one file, several files, or a folder: in most formats a file is a sensor. Other packages add
formats by the entry points of `ADDED`, scripts by `add_format`; the guide is CONTRIBUTING.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import beginning, load_toml
from rtof_kin.core.packages import Extensions
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats import total_capture, xdf
from rtof_kin.formats.sensors import imu_mat, mvnx, tables, xsens

_MOST_FILES: Final = 1000


@dataclass(frozen=True)
class Format:
    """One format of sensor files."""

    title: str  #: Name for people, different from those of the other formats
    looks: str  #: Description of such a file
    recognise: Callable[[str], bool]  #: Return True for the text that a file of the format begins with
    read: Callable[..., SensorLog]
    """Read a trial from paths, or from one path where `file_is_trial`; keyword arguments are fields of
    `Declaration` that replace the format's own. Raises FileFormatError for anything unreadable,
    incomplete, damaged or inconsistent, and UnknownNameError for an unknown field or value."""
    file_is_trial: bool = False  #: True where one file holds all sensors of a trial


_LOOKS: Final = load_toml(Path(__file__).with_suffix(".toml"))  #: Title -> `Format.looks` of the built-in formats


def _built_in(
    title: str, recognise: Callable[[str], bool], read: Callable[..., SensorLog], file_is_trial: bool = False
) -> Format:
    return Format(title, _LOOKS[title], recognise, read, file_is_trial)


FORMATS: Final = (
    _built_in(xdf.TITLE, xdf.is_xdf, xdf.read_xdf, True),
    _built_in(mvnx.TITLE, mvnx.is_mvnx, mvnx.read_mvnx, True),
    _built_in(imu_mat.TITLE, imu_mat.is_imu_mat, imu_mat.read_imu_mat, True),
    _built_in(tables.OPENSENSE_TITLE, tables.is_opensense_sto, tables.read_opensense_sto, True),
    _built_in(total_capture.TITLE, total_capture.is_sensors, total_capture.read_sensor_log, True),
    _built_in(tables.XIMU3_TITLE, tables.is_ximu3, tables.read_ximu3),
    _built_in(xsens.DOT_TITLE, xsens.is_xsens_dot, xsens.read_xsens_dot),
    _built_in(xsens.MT_TITLE, xsens.is_xsens_mt, xsens.read_xsens_mt),
    _built_in(tables.NORAXON_TITLE, tables.is_noraxon, tables.read_noraxon, True),
    _built_in(tables.CSV_TITLE, tables.is_imu_csv, tables.read_imu_csv, True),
    _built_in(tables.BIDS_TITLE, tables.is_bids_motion, tables.read_bids_motion, True),
)
"""Built-in formats."""
ADDED: Final = Extensions("rtof_kin.sensor_formats", Format, lambda form: form.title)
"""Formats of other packages and of this process."""


def formats() -> tuple[Format, ...]:
    """Return all formats, those added before the built-in ones; a file is of the first that recognises it.
    `ExtensionError` where that of an installed package cannot be loaded.
    """
    return (*ADDED.all(), *FORMATS)


def add_format(form: Format) -> None:
    """Add a format for this process, in place of an added one of the same title. `InvalidInputError`: its title is that
    of a built-in format.
    """
    ADDED.add(form, [one.title for one in FORMATS])


def read_sensor_log(path: str | Path | Sequence[str | Path], **declared: Any) -> SensorLog:
    """Read the sensors of one trial, in SI units. `FileFormatError`: no known file, files of two formats or two trials,
    or damaged; `UnknownNameError`: unknown field or value.

    Args:
        path: a file, several files, or a folder of files, all of one trial.
        declared: fields of `Declaration` that replace the format's own, e.g. ``acceleration_unit="g"``
            or ``rate_hz=60``.
    """
    given = [path] if isinstance(path, str | Path) else list(path)
    if not given:
        raise FileFormatError(Path(), "no file was named")
    found: dict[Path, Format] = {}
    left: list[Path] = []
    for part in given:
        known, others = _recognised(Path(part))
        found |= known
        left += others
    log = _read(found, declared)
    aside = (f"left aside, as no files of sensors: {_names(left)}",) if left else ()
    return replace(log, file_notes=(*log.file_notes, *aside))


def _read(found: Mapping[Path, Format], declared: Mapping[str, Any]) -> SensorLog:
    titles = list(dict.fromkeys(kind.title for kind in found.values()))
    first, kind = next(iter(found.items()))
    if len(titles) > 1:
        raise FileFormatError(first.parent, f"there are files of {' and of '.join(titles)}; name those of one trial")
    if not kind.file_is_trial:
        return kind.read(list(found), **declared)
    if len(found) > 1:
        raise FileFormatError(first.parent, f"there are {len(found)} trials ({_names(list(found))}); name one")
    return kind.read(first, **declared)


def holds_sensors(folder: Path) -> bool:
    """Return whether a folder, or its folders, have a file of sensors."""
    try:
        return bool(_recognised(folder))
    except FileFormatError:
        return False


def _recognised(path: Path) -> tuple[dict[Path, Format], list[Path]]:
    """Return the known files at a path, in its folder or in its folders, and others of their suffixes."""
    if not path.is_dir():
        kind = format_of(path)
        if kind is None:
            raise FileFormatError(path, f"no file of sensors that is known. {_known()}")
        return {path: kind}, []
    for pattern in ("*", "*/*"):
        files = sorted(one for one in path.glob(pattern) if one.is_file())
        if len(files) > _MOST_FILES:
            raise FileFormatError(path, f"holds {len(files)} files; name the folder of one trial")
        found = {one: kind for one in files if (kind := format_of(one)) is not None}
        if found:
            endings = {one.suffix for one in found}
            return found, [one for one in files if one not in found and one.suffix in endings]
    raise FileFormatError(path, f"no file of sensors that is known in this folder. {_known()}")


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(path.name for path in paths[:5]) + (", ..." if len(paths) > 5 else "")


def format_of(path: Path) -> Format | None:
    """Return the format of a file by the text that it begins with; None where it is none of them, `FileFormatError`
    where it cannot be read.
    """
    head = beginning(path, "file or folder").decode("utf-8-sig", errors="replace")
    return next((kind for kind in formats() if kind.recognise(head)), None)


def _known() -> str:
    return "Known: " + "; ".join(f"{kind.title} ({kind.looks})" for kind in formats())
