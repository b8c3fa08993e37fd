"""Detectors' layouts (``models/detectors.toml``): their points, and where in the body each lies.

A detector's point is no joint centre: it is a landmark of its own in a segment's link frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Landmark
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path

_SIDES = {"l": "Left", "left": "Left", "r": "Right", "right": "Right"}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
Share = tuple[str, str, float]


@dataclass(frozen=True)
class Layout:
    """The points of one kind of detector."""

    name: str
    """How settings and files call it, e.g. 'halpe26'."""
    title: str
    """What people call it."""
    names: tuple[str, ...]
    """K names of its points in its own words, in its order."""
    points: tuple[str, ...]
    """K names of what these are: points of `DetectorTable` or landmarks of the skeleton."""

    def __len__(self) -> int:
        return len(self.names)

    def order(self, names: Sequence[str]) -> list[int] | None:
        """Where this layout's K points stand among names in any order and spelling (``LBigToe``,
        ``left_big_toe``); None where one of them is not among those.
        """
        given = [canonical(name).lower() for name in names]
        wanted = [canonical(name).lower() for name in self.names]
        return [given.index(name) for name in wanted] if set(wanted) <= set(given) else None


@dataclass(frozen=True)
class DetectorTable:
    """All layouts, and the body's points that they are made of."""

    path: Path
    """The file it was read from."""
    points: tuple[Landmark, ...]
    """U points, each in the link frame of its segment, in the size of the shipped skeleton."""
    layouts: Mapping[str, Layout]
    """By name; the skeleton's own, 'joints' and 'landmarks', are among them."""
    seen_by: Mapping[str, tuple[str, ...]]
    """Landmark of the skeleton that is no joint -> points that show it; itself is one."""
    naive: Mapping[str, tuple[tuple[str, ...], ...]]
    """Joint -> lists of points, of which the mean of the first that a layout has is nearest to it."""
    naive_between: Mapping[str, Share]
    """Joint -> (from, to, share): where the plain mapping puts joints that no point is near."""

    def layout(self, name: str) -> Layout:
        """One layout by name; `UnknownNameError` lists those there are."""
        if name not in self.layouts:
            raise UnknownNameError("layout of keypoints", [name], list(self.layouts))
        return self.layouts[name]

    def points_on(self, skeleton: SkeletonModel) -> tuple[Landmark, ...]:
        """The U points on a body of the shipped skeleton's joints; they scale as its landmarks do."""
        bare = replace(SkeletonModel.default().table, landmarks=self.points)
        return bare.scaled_to(skeleton.joint_offsets).landmarks


def canonical(name: str) -> str:
    """A point's name in one spelling, side first: ``LBigToe`` and ``left_big_toe`` are LeftBigToe."""
    words = [word.lower() for word in _WORDS.findall(name)]
    sides = [_SIDES[word] for word in words if word in _SIDES]
    return "".join([*sides[:1], *(word.capitalize() for word in words if word not in _SIDES)])


def mirrored(name: str) -> str:
    """The name of the same point on the other side; a point in the middle is its own."""
    for side, other in (("Right", "Left"), ("Left", "Right")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


@cache
def detector_table() -> DetectorTable:
    """The table that ships."""
    return read_detector_table(model_path("detectors.toml"))


def read_detector_table(path: str | Path) -> DetectorTable:
    """Read and check a table of detectors' layouts.

    Raises:
        FileFormatError: not TOML, a field missing or of the wrong kind, a name that stands twice.
        UnknownNameError: a point, or a joint or landmark of the shipped skeleton, that there is not.
    """
    path = Path(path)
    data = load_toml(path)
    try:
        points = tuple(point for entry in data["point"] for point in _point(entry))
        table = DetectorTable(
            path=path,
            points=points,
            layouts={e["name"]: _layout(e) for e in data["layout"]} | _own_layouts(),
            seen_by=_seen_by(data["seen_by"]),
            naive=_naive(data["naive"]),
            naive_between=_between(data["naive_between"]),
        )
    except KeyError as error:
        raise FileFormatError(path, f"the field {error} is missing") from error
    except (AttributeError, TypeError, ValueError) as error:
        raise FileFormatError(path, f"a field is not of the right kind: {error}") from error
    _check(table)
    return table


def _point(entry: Mapping[str, Any]) -> list[Landmark]:
    """A point and, where it has a side, its mirror image."""
    name, joint = str(entry["name"]), str(entry["joint"])
    offset = np.array(entry["offset_mm"], dtype=float) / 1000
    if offset.shape != (3,) or not np.all(np.isfinite(offset)):
        raise ValueError(f"{entry['offset_mm']} is no point x, y, z")
    if mirrored(name) == name:
        return [Landmark(name, joint, offset)]
    image = Landmark(mirrored(name), mirrored(joint), offset * [1.0, -1.0, 1.0])
    return [Landmark(name, joint, offset), image]


def _layout(entry: Mapping[str, Any]) -> Layout:
    names, renamed = tuple(map(str, entry["names"])), entry.get("points", {})
    points = tuple(str(renamed.get(name, canonical(name))) for name in names)
    return Layout(str(entry["name"]), str(entry["title"]), names, points)


def _own_layouts() -> dict[str, Layout]:
    """The shipped skeleton's joints, and all its landmarks, as layouts: nothing to adapt."""
    skeleton = SkeletonModel.default()
    named = {"joints": skeleton.names, "landmarks": tuple(skeleton.landmarks)}
    title = "the skeleton's own {}"
    return {k: Layout(k, title.format(k), n, tuple(map(own, n))) for k, n in named.items()}


def own(landmark: str) -> str:
    """How layouts call a landmark of the skeleton, which a detector's point may be a namesake of."""
    return f"skeleton:{landmark}"


def _seen_by(of_right: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    both: dict[str, tuple[str, ...]] = {}
    for name, points in of_right.items():
        both[name] = (own(name), *map(str, points))
        both[mirrored(name)] = (own(mirrored(name)), *(mirrored(str(p)) for p in points))
    return both


def _naive(of_right: Mapping[str, Sequence[Sequence[str]]]) -> dict[str, tuple[tuple[str, ...], ...]]:
    both: dict[str, tuple[tuple[str, ...], ...]] = {}
    for joint, lists in of_right.items():
        both[joint] = tuple(tuple(map(str, points)) for points in lists)
        both[mirrored(joint)] = tuple(tuple(mirrored(str(p)) for p in points) for points in lists)
    return both


def _between(of_right: Mapping[str, Mapping[str, Any]]) -> dict[str, Share]:
    both: dict[str, Share] = {}
    for joint, entry in of_right.items():
        start, stop, share = str(entry["from"]), str(entry["to"]), float(entry["share"])
        both[joint] = (start, stop, share)
        both[mirrored(joint)] = (mirrored(start), mirrored(stop), share)
    return both


def _check(table: DetectorTable) -> None:
    """Every name that the table uses is there, and none twice."""
    skeleton = SkeletonModel.default()
    points = [point.name for point in table.points]
    known = [*points, *map(own, skeleton.landmarks)]
    for where, names in {"points": points, **{n: la.points for n, la in table.layouts.items()}}.items():
        double = [name for name in names if list(names).count(name) > 1]
        if double:
            raise FileFormatError(table.path, f"{where}: {double[0]} stands there twice")
    joints = [*table.naive, *table.naive_between]
    joints += [n for start, stop, _ in table.naive_between.values() for n in (start, stop)]
    _check_known(table, "joint", (p.joint for p in table.points), skeleton.names)
    _check_known(table, "joint", joints, skeleton.names)
    _check_known(table, "landmark", table.seen_by, tuple(skeleton.landmarks))
    used = [n for layout in table.layouts.values() for n in layout.points]
    used += [n for names in table.seen_by.values() for n in names]
    used += [n for lists in table.naive.values() for names in lists for n in names]
    _check_known(table, "point", used, known)


def _check_known(table: DetectorTable, kind: str, used: Iterable[str], known: Sequence[str]) -> None:
    unknown = sorted(set(used) - set(known))
    if unknown:
        raise UnknownNameError(f"{kind} in {table.path}", unknown, known)
