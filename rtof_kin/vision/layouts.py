"""Detectors' layouts (``models/detectors.toml``): their points and the place of each in the body.

A detector's point is no joint centre but a landmark of its own, fixed in a segment's link frame. Other packages add
layouts of these points by the entry points of `ADDED`, scripts by `add_layout`; the guide is CONTRIBUTING.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, Final, Self

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Landmark
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.packages import Extensions
from rtof_kin.core.resources import model_path
from rtof_kin.data.keypoints import layout_and_point

OWN_LAYOUTS: Final = ("joints", "landmarks")  #: Layouts of the skeleton's own points, not of a detector
FEWEST_NAMED: Final = 12  #: Fewest points of a layout by which it is recognised where others are missing
_SIDES = {"l": "Left", "left": "Left", "r": "Right", "right": "Right"}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Layout:
    """Points of one kind of detector."""

    name: str  #: Identifier in settings and files, e.g. 'halpe26'.
    title: str  #: Name for people
    names: tuple[str, ...]  #: K names of the points in the detector's own words and order
    points: tuple[str, ...]  #: K points of `DetectorTable` or landmarks of the skeleton (`own`)

    @classmethod
    def of(cls, name: str, title: str, names: Iterable[str], points: Mapping[str, str] | None = None) -> Self:
        """Return the layout of points in a detector's own words.

        Args:
            names: K names of the points (``left_big_toe``, ``LBigToe``).
            points: which point of the table each is, where its name does not say it.
        """
        names, renamed = tuple(map(str, names)), points or {}
        return cls(name, title, names, tuple(str(renamed.get(n, _canonical(n))) for n in names))

    def __len__(self) -> int:
        return len(self.names)

    def found(self, names: Sequence[str]) -> tuple[int | None, ...]:
        """Return the index of each of the K points among names in any order and spelling (``LBigToe``,
        ``left_big_toe``); None for one that is missing.
        """
        given = [_canonical(name).lower() for name in names]
        words = (_canonical(name).lower() for name in self.names)
        return tuple(given.index(word) if word in given else None for word in words)

    def order(self, names: Sequence[str]) -> list[int] | None:
        """Return the same, or None if one is missing."""
        found = [index for index in self.found(names) if index is not None]
        return found if len(found) == len(self) else None


@dataclass(frozen=True, eq=False)
class DetectorTable:
    """All layouts and the body's points that they consist of."""

    points: tuple[Landmark, ...]  #: U points in the link frames of the shipped skeleton
    layouts: Mapping[str, Layout]  #: By name; includes the skeleton's own, 'joints' and 'landmarks'
    seen_by: Mapping[str, tuple[str, ...]]
    """Landmark of the skeleton that is no joint -> points that show it, itself included."""

    def layout(self, name: str) -> Layout:
        """Return a layout; `UnknownNameError`, which lists those known, where there is none."""
        if name not in self.layouts:
            raise UnknownNameError("layout of keypoints", [name], list(self.layouts))
        return self.layouts[name]

    def nearest(self, names: Sequence[str]) -> tuple[Layout | None, tuple[int | None, ...]]:
        """Return the layout of which most points are named, and the index of each, None where it is not; names that it
        lacks are ignored. None and () where no layout has `FEWEST_NAMED` of its points among them.
        """
        found = [(form, form.found(names)) for name, form in self.layouts.items() if name not in OWN_LAYOUTS]
        best = max(found, key=lambda pair: (sum(i is not None for i in pair[1]), -len(pair[0])))
        return best if sum(i is not None for i in best[1]) >= FEWEST_NAMED else (None, ())


def _canonical(name: str) -> str:
    """Return a point's name in one spelling, side first: ``left_big_toe`` and ``LBigToe`` are LeftBigToe."""
    words = [word.lower() for word in _WORDS.findall(name)]
    sides = [_SIDES[word] for word in words if word in _SIDES]
    return "".join([*sides[:1], *(word.capitalize() for word in words if word not in _SIDES)])


def is_detector_point(name: str) -> bool:
    """Return whether a name in a `KeypointSequence` is that of a detector's own point; `UnknownNameError` where the
    layout has no such point, or there is no such layout.
    """
    layout, point = layout_and_point(name)
    if layout and point not in (known := detector_table().layout(layout).points):
        raise UnknownNameError(f"point of layout {layout}", [point], known)
    return bool(layout)


def mirrored(name: str) -> str:
    """Return the name of the same point on the other side, or the name if it has no side. name: with the side first."""
    for side, other in (("Right", "Left"), ("Left", "Right")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def own(landmark: str) -> str:
    """Return the name of a landmark of the skeleton in layouts, distinct from detectors' points."""
    return f"skeleton:{landmark}"


def point_names(table: DetectorTable, skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return the N points of a view: the skeleton's landmarks, then the detectors' points."""
    return (*map(own, skeleton.landmarks), *(point.name for point in table.points))


ADDED: Final = Extensions("rtof_kin.detector_layouts", Layout, lambda layout: layout.name)
"""Layouts of other packages and of this process."""


def add_layout(layout: Layout) -> None:
    """Add a layout for this process, in place of an added one of the same name.

    Raises:
        InvalidInputError: its name is that of a shipped layout, or one of its names or points stands twice.
        UnknownNameError: the table has no such point.
    """
    _extended((layout,))
    ADDED.add(layout)


def detector_table() -> DetectorTable:
    """Return the shipped table with the layouts that were added; `ExtensionError`, `InvalidInputError` or
    `UnknownNameError` where that of an installed package cannot be used.
    """
    return _extended(ADDED.all())


@lru_cache(maxsize=4)
def _extended(added: tuple[Layout, ...]) -> DetectorTable:
    """The shipped table with further layouts."""
    shipped = _shipped_table()
    known = [*(point.name for point in shipped.points), *map(own, SkeletonModel.default().landmarks)]
    for layout in added:
        if layout.name in shipped.layouts:
            raise InvalidInputError(f"layout {layout.name!r} is a shipped one; choose another name")
        for kind, names in (("name", layout.names), ("point", layout.points)):
            if double := [name for name in names if names.count(name) > 1]:
                raise InvalidInputError(f"layout {layout.name!r}: the {kind} {double[0]!r} stands there twice")
        if unknown := sorted(set(layout.points) - set(known)):
            raise UnknownNameError(f"point in layout {layout.name!r}", unknown, known)
    return replace(shipped, layouts={**shipped.layouts, **{layout.name: layout for layout in added}})


@cache
def _shipped_table() -> DetectorTable:
    data = load_toml(model_path("detectors.toml"))
    points = tuple(point for entry in data["point"] for point in _point(entry))
    layouts = {
        one["name"]: Layout.of(one["name"], one["title"], one["names"], one.get("points")) for one in data["layout"]
    }
    return DetectorTable(points, layouts | _own_layouts(), _seen_by(data["seen_by"]))


def _point(entry: Mapping[str, Any]) -> list[Landmark]:
    """Return a point and, if it has a side, its mirror image."""
    name, joint, offset = entry["name"], entry["joint"], np.array(entry["offset_mm"]) / 1000
    point, other = Landmark(name, joint, offset), mirrored(name)
    return [point] if other == name else [point, Landmark(other, mirrored(joint), offset * [1.0, -1.0, 1.0])]


def _own_layouts() -> dict[str, Layout]:
    """Return the shipped skeleton's joints, and all its landmarks, as layouts."""
    skeleton = SkeletonModel.default()
    named = dict(zip(OWN_LAYOUTS, (skeleton.names, tuple(skeleton.landmarks)), strict=True))
    return {k: Layout(k, f"the skeleton's own {k}", n, tuple(map(own, n))) for k, n in named.items()}


def _seen_by(of_right: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    both: dict[str, tuple[str, ...]] = {}
    for name, points in of_right.items():
        both[name] = (own(name), *points)
        both[mirrored(name)] = (own(mirrored(name)), *map(mirrored, points))
    return both
