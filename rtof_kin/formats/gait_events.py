"""Gait events of other programs: those of a C3D file, and Visual3D's table of events.

A C3D file has a context (Left, Right), a label and a time for each (`formats.trial_results`). Visual3D exports a text
with a column for each event, separated by tabs: a line of names such as LHS and RTO among its first ones, and below
numbers of the rows and times in s.
"""

from __future__ import annotations

import math
from itertools import chain
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import read_text
from rtof_kin.data.corrections import EVENTS, Correction, CorrectionKind
from rtof_kin.formats.markers import read_c3d_events

_NAMES: Final[dict[CorrectionKind, tuple[str, ...]]] = {
    "foot_strike": ("foot strike", "heel strike", "initial contact", "fs", "hs", "ic", "on"),
    "foot_off": ("foot off", "toe off", "fo", "to", "off"),
}
_KINDS: Final = {name: kind for kind, names in _NAMES.items() for name in names}
_SIDES: Final = {"left": "left", "l": "left", "right": "right", "r": "right"}


def read_event_corrections(path: str | Path) -> tuple[Correction, ...]:
    """Read foot strikes and foot offs as corrections that replace all events of the feet that have any there.

    Args:
        path: a .c3d, or a text as Visual3D exports it. Its times are those of the recording.

    Raises:
        FileFormatError: no such file, damaged, or without an event of a foot.
    """
    path = Path(path)
    read = read_c3d_events(path) if path.suffix.lower() == ".c3d" else _table_events(path)
    named = ((_kind_and_side(f"{context} {label}"), time) for context, label, time in read)
    events = sorted((time, *known) for known, time in named if known is not None)
    if not events:
        raise FileFormatError(path, "has no foot strike and no foot off of the left or the right, such as LHS or RTO")
    if not all(math.isfinite(time) for time, _, _ in events):
        raise FileFormatError(path, "has an event without a time")
    who = path.name
    gone = [Correction("no_event", side, who=who) for side in sorted({side for _, _, side in events})]
    return (*gone, *(Correction(kind, side, time, who=who) for time, kind, side in events))


def check_events(corrections: tuple[Correction, ...], start: float, stop: float) -> None:
    """Raise `InvalidInputError` where no event lies between two times, s."""
    times = [one.start_s for one in corrections if one.kind in EVENTS]
    if times and not any(start <= time <= stop for time in times):
        raise InvalidInputError(
            f"{corrections[0].who}: its events are at {min(times):.2f} to {max(times):.2f} s, the recording from "
            f"{start:.2f} to {stop:.2f} s; give times on the recording's clock"
        )


def _kind_and_side(name: str) -> tuple[CorrectionKind, str] | None:
    """Kind and side of 'Left Foot Strike', 'LHS', 'L_TO' or ' RON'; None for another event."""
    words = name.lower().replace("_", " ").split()
    if len(words) > 1 and words[0] == "general":
        words = words[1:]
    first, rest = (words[0], words[1:]) if words else ("", [])
    if rest and first in _SIDES and rest[0][:1] == _SIDES[first][0] and rest[0][1:] in _KINDS:
        rest = [rest[0][1:]]  # context Left and label LHS
    if not rest and first[:1] in _SIDES:
        first, rest = first[:1], [first[1:]]
    kind = _KINDS.get(" ".join(rest))
    return (kind, _SIDES[first]) if kind is not None and first in _SIDES else None


def _table_events(path: Path) -> list[tuple[str, str, float]]:
    """Read (context '', name, s) of each cell below a name of an event."""
    lines = [line.split("\t") for line in read_text(path, "a table of events, separated by tabs").splitlines()]
    head = next((n for n, cells in enumerate(lines) if any(map(_kind_and_side, cells))), len(lines))
    found = (zip(lines[head], cells, strict=False) for cells in lines[head + 1 :])
    out = []
    for name, cell in chain.from_iterable(found):
        try:
            time = float(cell)
        except ValueError:
            continue  # EVENT_LABEL, ORIGINAL, X, or empty
        if _kind_and_side(name) is not None:
            out.append(("", name, time))
    return out
