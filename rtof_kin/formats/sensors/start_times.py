"""Dates and times at which sensor files say that they began.

Only what states its zone becomes a time in UTC. A time of an unknown zone is a note for the reader.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta, timezone
from typing import Final

import numpy as np

from rtof_kin.formats.sensors.sensor_text import SensorTable

_DOT_START: Final = re.compile(
    r"StartTime:\W*(\d{4}-\d\d-\d\d)_(\d\d:\d\d:\d\d)_(\d{1,3}) (?:GMT|UTC)([+-]\d{1,2})?(?::?(\d\d))?"
)
_MT_START: Final = re.compile(r"//\s*Start Time:\s*(?!Unknown)(\S.*)", re.IGNORECASE)
_UTC_COLUMNS: Final = tuple(
    f"UTC_{part}" for part in ("Year", "Month", "Day", "Hour", "Minute", "Second", "Nano", "Valid")
)
UTC_COLUMNS: Final = frozenset(name.lower() for name in _UTC_COLUMNS)
"""Columns of MT Manager with the time of each packet, in small letters."""
_VALID: Final = 4
"""Bit of UTC_Valid that says that date and time are known."""


def utc_of_milliseconds(since_epoch: str) -> datetime | None:
    """Return a time given in milliseconds since 1970; None where it is none."""
    if not re.fullmatch(r"\d{1,14}", since_epoch) or int(since_epoch) == 0:
        return None
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=int(since_epoch))


def start_of_dot(header: Sequence[str]) -> datetime | None:
    """Return the time of a DOT file's header, which states the zone; None where absent or impossible."""
    found = next((match for line in header if (match := _DOT_START.match(line.strip()))), None)
    if found is None:
        return None
    date, time, thousandths, hours, minutes = found.groups()
    sign = -1 if (hours or "").startswith("-") else 1
    zone = sign * timedelta(hours=abs(int(hours or 0)), minutes=int(minutes or 0))
    try:
        local = datetime.fromisoformat(f"{date}T{time}").replace(tzinfo=timezone(zone))
    except ValueError:
        return None
    return local.astimezone(UTC) + timedelta(milliseconds=int(thousandths))


def start_of_mt(table: SensorTable, row: int) -> datetime | None:
    """Return the time of a packet of MT Manager by its UTC columns; None where they do not state it."""
    columns = table.columns(*_UTC_COLUMNS)
    if columns is None or not np.isfinite(columns[row]).all() or not int(columns[row, -1]) & _VALID:
        return None
    *whole, nano, _ = columns[row].tolist()
    try:
        return datetime(*map(int, whole), tzinfo=UTC) + timedelta(microseconds=nano / 1000)  # type: ignore[misc, arg-type]
    except (ValueError, OverflowError):
        return None


def start_in_mt_header(header: Sequence[str]) -> str | None:
    """Return MT Manager's time of start as it is in the header; None where unknown."""
    return next((match[1] for line in header if (match := _MT_START.match(line.strip()))), None)


def unzoned_note(start: object) -> tuple[str, ...]:
    """Return a sentence about a time of start without its zone; none where it is no text."""
    if not isinstance(start, str) or not start.strip():
        return ()
    return (f"began at {start.strip()[:40]}, in a time zone that is not stated",)
