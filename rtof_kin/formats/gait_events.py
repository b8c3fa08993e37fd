"""Gait events of other programs: of a C3D file, or of the table that Visual3D exports.

The table has a column for each event, separated by tabs: a line of names such as LHS and RTO among its first ones, and
below numbers of the rows and times in s.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import read_text
from rtof_kin.data.corrections import Correction, CorrectionKind
from rtof_kin.formats.markers import read_c3d_events

_NAMES: Final[dict[CorrectionKind, tuple[str, ...]]] = {
    "foot_strike": ("foot strike", "heel strike", "initial contact", "fs", "hs", "ic", "on"),
    "foot_off": ("foot off", "toe off", "fo", "to", "off"),
}
_KINDS: Final = {f"{s[0]} {name}": (kind, s) for s in ("left", "right") for kind, own in _NAMES.items() for name in own}


def read_event_corrections(path: str | Path, times: Array) -> tuple[Correction, ...]:
    """Read foot strikes and foot offs as corrections that replace all events of the feet that have any there.
    `FileFormatError`: no such file, damaged, or without an event of a foot; `InvalidInputError`: none is at the times.

    Args:
        path: a .c3d, or a text as Visual3D exports it. times: (T,) s, of the recording, whose clock it has.
    """
    path, who = Path(path), Path(path).name
    read = read_c3d_events(path) if path.suffix.lower() == ".c3d" else _table_events(path)
    events = sorted((time, *known) for name, time in read if (known := _kind_and_side(name)) and math.isfinite(time))
    if not events:
        raise FileFormatError(path, "has no foot strike and no foot off of the left or the right, such as LHS or RTO")
    (first, *_), (last, *_), start, stop = events[0], events[-1], times[0], times[-1]
    if not any(start <= time <= stop for time, *_ in events):
        raise InvalidInputError(
            f"{path}: its events are at {first:.2f} to {last:.2f} s, the recording from {start:.2f} to {stop:.2f} s; "
            "give times on the recording's clock"
        )
    gone = [Correction("no_event", side, who=who) for side in sorted({side for _, _, side in events})]
    return (*gone, *(Correction(kind, side, time, who=who) for time, kind, side in events))


def _kind_and_side(name: str) -> tuple[CorrectionKind, str] | None:
    """Kind and side of 'Left Foot Strike', 'Left LHS', 'LHS' or 'L_TO'; None for another event."""
    words = " ".join(name.lower().replace("_", " ").split())
    last = words.rpartition(" ")[2]
    return _KINDS.get(words.replace("left ", "l ").replace("right ", "r ")) or _KINDS.get(f"{last[:1]} {last[1:]}")


def _table_events(path: Path) -> list[tuple[str, float]]:
    """Read name and s of each cell below a name of an event."""
    lines = [line.split("\t") for line in read_text(path, "a table of events, separated by tabs").splitlines()]
    head = next((n for n, cells in enumerate(lines) if any(map(_kind_and_side, cells))), len(lines))
    out = []
    for name, cell in (pair for cells in lines[head + 1 :] for pair in zip(lines[head], cells, strict=False)):
        try:
            out.append((name, float(cell)))
        except ValueError:  # EVENT_LABEL, ORIGINAL, X, or empty
            continue
    return out
