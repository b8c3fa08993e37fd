"""Files that say where each sensor of a trial is: two columns, or OpenSense's XML of settings.

    # sensor    place
    00B42279    pelvis
    00B4227D    right shank

Columns are separated by commas, semicolons, tabs or spaces; a first line of titles and comments behind # are
left out. A sensor is named by its serial number, or by the last characters of it, or as in its file; the
place is a segment or any other name for the sensor. OpenSense's XML has ``<ExperimentalSensor
name="_00B42279">`` with ``<name_in_model>pelvis_imu</name_in_model>``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from rtof_kin.core.errors import FileFormatError, InvalidInputError, did_you_mean, line_of
from rtof_kin.core.files.text import read_text

LARGEST_BYTES: Final = 2**20
_SEPARATED: Final = re.compile(r"\s*[,;\t]\s*")
_TITLE: Final = re.compile(
    "serial( number)?|sensors?|imu|id|device|tag|name|segment|joint|place|position|location|body( part)?|bone"
)
_Row = tuple[int | None, tuple[str, str]]  # a line's number; a sensor and its place
_SHORTEST_END: Final = 3  #: Fewest characters of a serial number that name a sensor


def read_sensor_map(path: str | Path) -> dict[str, str]:
    """Read the place of each sensor; `FileFormatError`, which names the line: unreadable, a line without two columns,
    or a sensor or place twice.
    """
    path = Path(path)
    text = read_text(path, "a map of sensors", LARGEST_BYTES)
    rows = _of_xml(path, text) if text.lstrip().startswith("<") else _of_lines(path, text)
    places: dict[str, str] = {}
    for number, (sensor, place) in rows:
        if sensor in places or place in places.values():
            twice = sensor if sensor in places else place
            raise FileFormatError(path, f"{twice!r} stands there twice; give each its own line", number)
        places[sensor] = place
    if not places:
        raise FileFormatError(path, "names no sensor; write lines such as '00B42279, pelvis'")
    return places


def _of_lines(path: Path, text: str) -> list[_Row]:
    rows: list[_Row] = []
    first = True
    for number, line in enumerate(text.splitlines(), 1):
        content = line.partition("#")[0].replace('"', "").strip()
        if not content:
            continue
        cells = [cell for cell in _SEPARATED.split(content) if cell]
        if len(cells) == 1:
            cells = content.split(maxsplit=1)
        is_title = first and all(_TITLE.fullmatch(cell.lower()) for cell in cells)
        first = False
        if is_title:
            continue
        if len(cells) != 2:
            problem = f"{len(cells)} columns; write a sensor and its place, e.g. '00B42279, pelvis'"
            raise FileFormatError(path, problem, number)
        rows.append((number, (cells[0], cells[1])))
    return rows


def _of_xml(path: Path, text: str) -> list[_Row]:
    try:
        root = fromstring(text, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise FileFormatError(path, f"broken XML: {str(error)[:200]}") from error
    found: list[_Row] = []
    for one in root.iter("ExperimentalSensor"):
        sensor, place = one.get("name", "").strip(" _"), (one.findtext("name_in_model") or "").strip()
        if not sensor or not place:
            raise FileFormatError(path, "an <ExperimentalSensor> has no name or no <name_in_model>")
        found.append((None, (sensor, place)))
    return found


def matched(places: Mapping[str, str], sensors: Sequence[str], path: str | Path | None = None) -> dict[str, str]:
    """Return the place of each sensor of a trial that a map names by serial number, by its last characters, or by name.
    `InvalidInputError`: no sensor is named, one is named twice, or there are both sensors and lines of the map left, so
    that one of them is probably misspelt.
    """
    found: dict[str, str] = {}
    unused = []
    for key, place in places.items():
        same = [name for name in sensors if _plain(name) == _plain(key)]
        fits = same or [name for name in sensors if same_sensor(key, name)]
        if not fits:
            unused.append(key)
            continue
        if len(fits) > 1 or fits[0] in found:
            several = " and ".join(dict.fromkeys(fits))
            raise InvalidInputError(f"{key!r} in the map means {several}; name each sensor once, in full")
        found[fits[0]] = place
    left = [name for name in sensors if name not in found]
    if not found or (unused and left):
        raise InvalidInputError(
            f"{_named(path, unused)} has {', '.join(unused)}, which the trial has not, and the trial has "
            f"{', '.join(left)}, which the map has not; correct one of them, or take the lines of absent "
            f"sensors out.{did_you_mean(unused, left)}"
        )
    return found


def _named(path: str | Path | None, keys: Sequence[str]) -> str:
    """Return the map in words, with the line of the first of some of its sensors."""
    line = line_of(path, keys[0]) if path is not None and keys else None
    return ", ".join(filter(None, (str(path or ""), f"line {line}" if line else "", "the map")))


def same_sensor(key: str, sensor: str) -> bool:
    """Return whether a map's word means a sensor: its name, or the last characters of it."""
    key, sensor = _plain(key), _plain(sensor)
    return key == sensor or (len(key) >= _SHORTEST_END and sensor.endswith(key))


def _plain(name: str) -> str:
    return re.sub(r"[^0-9a-z]", "", name.lower())
