"""Section of a report with the ranges of motion: pelvis and trunk, then right against left."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from rtof_kin.clinical.angle_table import AngleRow
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.reporting.angle_names import ISB, MAIN, OPENSIM, XZY, AngleName, angle_name, side_and_name
from rtof_kin.reporting.html import table
from rtof_kin.reporting.page.clinical import OBSERVED

_SINGLE: Final = ("angle", "range [deg]", "from, to [deg]", "peak [deg/s]")
_BOTH: Final = (
    "angle",
    "right: range [deg]",
    "right: from, to",
    "left: range [deg]",
    "left: from, to",
    "right - left",
    "right: peak [deg/s]",
    "left: peak [deg/s]",
)
_RELIABLE: Final = 0.75
"""Share of reliable among observed frames below which a range says it."""
_FEWEST: Final = 0.25
"""Share of observed and reliable frames below which there is no range."""


def ranges_section(ranges: Iterable[RangeOfMotion], rows: Iterable[AngleRow]) -> str:
    """Return the tables of the ranges of motion.

    Args:
        rows: the angles; headings among them have no range of motion.
    """
    named = {row.name: row for row in rows}
    found: dict[str, dict[str, RangeOfMotion]] = {}
    for own in ranges:
        side, name = side_and_name(own.name)
        if own.known_share > 0 and not named[own.name].about_vertical:
            found.setdefault(name, {})[side] = own
    names = {name: angle_name(named[next(iter(own.values())).name]) for name, own in found.items()}
    single = [_Line(names[name], own[""], None) for name, own in found.items() if "" in own]
    both = [_Line(names[name], own.get("right"), own.get("left")) for name, own in found.items() if "" not in own]
    out = ""
    if single:
        out += _table(_SINGLE, single, "ranges single", "Pelvis and trunk")
    if both:
        out += _table(_BOTH, both, "ranges", "Right and left")
    return out or "<p>No angle was observed.</p>"


@dataclass(frozen=True)
class _Line:
    """One angle: of the right (or the middle) and of the left."""

    name: AngleName
    first: RangeOfMotion | None
    second: RangeOfMotion | None


def _table(columns: tuple[str, ...], lines: list[_Line], kind: str, caption: str) -> str:
    cells = [_single(line) if columns is _SINGLE else _both(line) for line in lines]
    return table(
        columns,
        cells,
        kind,
        caption,
        row_headers=True,
        shown=[line.name.shown for line in lines],
        further=[line.name.clinical not in MAIN for line in lines],
    )


def _single(line: _Line) -> tuple[str, ...]:
    found = line.first
    assert found is not None
    return _title(line.name), _range(found), _ends(found, line.name), _peak(found)


def _both(line: _Line) -> tuple[str, ...]:
    right, left = line.first, line.second
    difference = math.nan
    if right and left and right.is_comparable and left.is_comparable:
        difference = math.degrees(right.range - left.range)
    return (
        _title(line.name),
        *(cell for found in (right, left) for cell in (_range(found), _ends(found, line.name))),
        f"{round(difference):+d}".replace("+0", "0") if math.isfinite(difference) else "",
        *(_peak(found) for found in (right, left)),
    )


def _title(name: AngleName) -> str:
    """Name of the angle under the conventions in which it is shown, and the movement that is positive."""
    clinical = f'<span data-in="{ISB} {XZY}">{escape(name.clinical)} <small>+ {escape(name.positive)}</small></span>'
    return f'{clinical}<span data-in="{OPENSIM}">{escape(name.opensim_title)}</span>'


def _range(found: RangeOfMotion | None) -> str:
    if found is None:
        return ""
    if not _has_range(found):
        few = 100 * _reliable_share(found)
        return f"<small>{f'reliable only {few:.0f} %' if few else 'no reliable value'}</small>"
    share = ""
    if found.known_share < OBSERVED:
        share = f" <small>observed {100 * found.known_share:.0f} %</small>"
    if found.trusted_share < _RELIABLE:
        share += f" <small>{100 * found.trusted_share:.0f} % of it reliable</small>"
    value, _, uncertain = found.text.partition(", ")
    value, _, half = value.partition(" \u00b1 ")
    within = f" &plusmn; {half}" if half else f" <small>{escape(uncertain)}</small>" if uncertain else ""
    return f"<b>{escape(value)}</b>{within}{share}"


def _ends(found: RangeOfMotion | None, name: AngleName) -> str:
    if found is None or not _has_range(found):
        return ""
    usual = f"{_whole(found.low)} to {_whole(found.high)}"
    if not name.opposite:
        return usual
    turned = f"{_whole(-found.high)} to {_whole(-found.low)}"
    return f'<span data-in="{ISB} {XZY}">{usual}</span><span data-in="{OPENSIM}">{turned}</span>'


def _peak(found: RangeOfMotion | None) -> str:
    return "" if found is None or not _has_range(found) else _whole(found.peak_velocity)


def _reliable_share(found: RangeOfMotion) -> float:
    """Share of the frames in which the angle is observed and reliable."""
    return found.known_share * found.trusted_share


def _has_range(found: RangeOfMotion) -> bool:
    return math.isfinite(found.low) and _reliable_share(found) >= _FEWEST


def _whole(radians: float) -> str:
    return f"{round(float(np.degrees(radians)))}" if math.isfinite(radians) else ""
