"""Marker sets: which marker sits where on the skeleton; ``models/marker_sets.toml`` explains the fields."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import freeze
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import read_text
from rtof_kin.core.resources import model_path

TABLE = "marker_sets.toml"
_MIRROR = np.array([1.0, -1.0, 1.0])
Millimetres = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Point(_Strict):
    segment: str
    place_mm: Millimetres
    sd_mm: Millimetres
    skin_mm: float = Field(gt=0)


class _Set(_Strict):
    sides: Annotated[list[str], Field(min_length=2, max_length=2)]
    signature: Annotated[list[str], Field(min_length=1)]
    markers: dict[str, str]


class _Table(_Strict):
    point: dict[str, _Point] = {}
    set: dict[str, _Set]


@dataclass(frozen=True)
class MarkerPlaces:
    """Prior places of K markers on the skeleton of 1.72 m."""

    names: tuple[str, ...]  #: K, as in the trial
    points: tuple[str, ...]  #: Anatomical location of each, e.g. 'left asis'
    segments: tuple[str, ...]  #: Joint of the segment of each
    p_bone_marker: Array  #: (K, 3) place in the segment's frame, m
    sigma_place: Array  #: (K, 3) [m] standard deviation of the place
    sigma_skin: Array  #: (K,) [m] standard deviation of the motion on the segment
    set_name: str = ""

    def __post_init__(self) -> None:
        K = len(self.names)
        freeze(self, "marker places", p_bone_marker=(K, 3), sigma_place=(K, 3), sigma_skin=(K,))

    def scaled(self, scale: float) -> Self:
        """Return the places on a body of another size; `scale`: relative to 1.72 m."""
        return replace(self, p_bone_marker=scale * self.p_bone_marker, sigma_place=scale * self.sigma_place)

    def select(self, names: Sequence[str]) -> Self:
        """Return the places of some markers."""
        rows = [self.names.index(name) for name in names]
        return replace(
            self,
            names=tuple(names),
            points=tuple(self.points[i] for i in rows),
            segments=tuple(self.segments[i] for i in rows),
            p_bone_marker=self.p_bone_marker[rows],
            sigma_place=self.sigma_place[rows],
            sigma_skin=self.sigma_skin[rows],
        )


def read_marker_sets(path: str | Path | None = None) -> _Table:
    """Read a table of marker sets; sets of a user's file may use the points of the shipped one.
    `FileFormatError`: missing or damaged, with the key.
    """
    shipped = _parse(model_path(TABLE))
    if path is None:
        return shipped
    own = _parse(Path(path))
    table = _Table(point={**shipped.point, **own.point}, set=own.set)
    for name, markers in ((name, one.markers) for name, one in table.set.items()):
        if unknown := sorted({point.partition(".")[0] for point in markers.values()} - {*table.point}):
            raise FileFormatError(path, f"set.{name}: no point {unknown[0]!r}; known: {', '.join(sorted(table.point))}")
    return table


@cache
def _parse(path: Path) -> _Table:
    text = read_text(path, "a table of marker sets, TOML")
    try:
        return _Table.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(path, str(error)) from error
    except ValidationError as error:
        first = error.errors()[0]
        raise FileFormatError(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def places_of(
    names: Sequence[str], table: str | Path | None = None, set_name: str | None = None, person: str | None = None
) -> MarkerPlaces:
    """Return the prior places of a trial's markers; markers that are not of the set are left out.
    `InvalidInputError`: no set fits, or those of several people do; `FileFormatError`: a damaged table.

    Args:
        names: of a trial, perhaps with a person's name in front ("Anna:LASI").
        table: file with further sets; default: the shipped sets.
        set_name: one of the table's sets; default: the one with most markers in the trial.
        person: whose markers, where the trial has those of several.
    """
    sets = read_marker_sets(table)
    if set_name is not None and set_name not in sets.set:
        raise InvalidInputError(f"marker set {set_name!r}: not in the table; known: {', '.join(sets.set)}")
    chosen = sets.set if set_name is None else {set_name: sets.set[set_name]}
    people = {name.rpartition(":")[0]: dict[str, str]() for name in names}
    for name in reversed(names):
        people[name.rpartition(":")[0]][_plain(name)] = name
    complete = {
        (who, name): _matched(one, plain)
        for who, plain in people.items()
        for name, one in chosen.items()
        if {_plain(marker) for marker in one.signature} <= {*plain} and person in (None, who)
    }
    if not complete:
        known = "; ".join(f"{name} has {', '.join(one.signature)}" for name, one in chosen.items())
        of = "" if person is None else f" of {person}"
        raise InvalidInputError(
            f"markers {', '.join(names[:6])}, ...: of no known marker set{of} ({known}); write a table of your own, "
            "whose form is in docs/markers.md"
        )
    if len(found := list(dict.fromkeys(who for who, _ in complete))) > 1:
        raise InvalidInputError(f"markers of several people: choose one by --marker-person: {', '.join(found)}")
    who, best = max(complete, key=lambda key: len(complete[key]))
    plain = people[who]
    rows = [(plain[marker], *_placed(sets.point, point, side)) for marker, (point, side) in complete[who, best].items()]
    rows.sort(key=lambda row: names.index(row[0]))
    labels, points, segments, places, sd, skin = zip(*rows, strict=True)
    return MarkerPlaces(labels, points, segments, np.array(places), np.array(sd), np.array(skin), best)


def _plain(name: str) -> str:
    return re.sub(r"[\s_.\-]", "", name.rpartition(":")[2]).lower()


def _matched(one: _Set, plain: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return point and side of the markers of a set that are there, by their plain names."""
    found = {}
    for name, entry in one.markers.items():
        point, _, fixed = entry.partition(".")
        for sign, side in zip(one.sides, ("Left", "Right"), strict=True):
            if _plain(name.replace("{s}", sign)) in plain:
                found[_plain(name.replace("{s}", sign))] = point, side if "{s}" in name else fixed
    return found


Side = Literal["Left", "Right", ""]


def _placed(points: Mapping[str, _Point], name: str, side: str) -> tuple[str, str, Array, Array, float]:
    """Return label, segment, place, its deviation and the skin's, m."""
    point = points[name]
    place, right = np.array(point.place_mm) / 1000, side == "Right"
    segment = point.segment.replace("Left", "Right") if right else point.segment
    label = f"{side.lower()} {name}".strip()
    return label, segment, place * (_MIRROR if right else 1.0), np.array(point.sd_mm) / 1000, point.skin_mm / 1000
