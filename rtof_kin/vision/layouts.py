"""Detectors' layouts (``models/detectors.toml``): their points and the place of each in the body.

A detector's point is no joint centre but a landmark of its own, fixed in a segment's link frame. Other packages add
layouts by the entry points of `ADDED`, scripts by `add_layout`, users by a file of the same form (`read_layout`), with
points of the table and points with places of their own. The guide is docs/layouts.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from pydantic import Strict

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Landmark
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, UnknownNameError, reading
from rtof_kin.core.files.input_table import ArrayOf, InputTable, Integer, Names, OneOf, Positive, Vector3
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.packages import Extensions
from rtof_kin.core.resources import model_path
from rtof_kin.data.keypoints import layout_and_point

OWN_LAYOUTS: Final = ("joints", "landmarks")  #: Layouts of the skeleton's own points, not of a detector
FEWEST_NAMED: Final = 12  #: Fewest points of a layout by which it is recognised where others are missing
MIRROR: Final = np.array([1.0, -1.0, 1.0])  #: Signs of a place on the other side of the body
_SIDES = {"l": "Left", "left": "Left", "r": "Right", "right": "Right"}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Place:
    """A point with a place of its own, on the shipped skeleton in its own size; people differ by the spread."""

    name: str  #: A name that begins with 'Right' or 'Left' stands for its mirror image too.
    joint: str  #: Segment in which it is fixed, by the joint where that begins
    offset: tuple[float, float, float]  #: [m] in the segment's link frame
    spread: tuple[float, float, float]  #: [m] standard deviation between persons by axis of that frame
    size: float = 0.02  #: [m] standard deviation of the detector's errors in the image plane

    @property
    def sides(self) -> tuple[Self, ...]:
        """The point and, if it has a side, its mirror image."""
        (x, y, z), other = self.offset, mirrored(self.name)
        image = replace(self, name=other, joint=mirrored(self.joint), offset=(x, -y, z))
        return (self,) if other == self.name else (self, image)


@dataclass(frozen=True)
class Layout:
    """Points of one kind of detector."""

    name: str  #: Identifier in settings and files, e.g. 'halpe26'.
    title: str  #: Name for people
    names: tuple[str, ...]  #: K names of the points in the detector's own words and order
    points: tuple[str, ...]  #: K points of `DetectorTable` or landmarks of the skeleton (`own`)
    places: tuple[Place, ...] = ()  #: Places of those of its points that no table has
    whole: tuple[tuple[int, tuple[int, ...]], ...] = ()
    """Numbers of points of whole bodies, and the K indices of its own among them."""

    @classmethod
    def of(
        cls,
        name: str,
        title: str,
        names: Iterable[str],
        points: Mapping[str, str] | None = None,
        places: Iterable[Place] = (),
    ) -> Self:
        """Return the layout of points in a detector's own words.

        Args:
            names: K names of the points (``left_big_toe``, ``LBigToe``).
            points: which point of the table or of `places` each is, where its name does not say it.
            places: of the points that the table lacks.
        """
        names, renamed = tuple(map(str, names)), points or {}
        return cls(name, title, names, tuple(str(renamed.get(n, _canonical(n))) for n in names), tuple(places))

    def __len__(self) -> int:
        return len(self.names)

    def found(self, names: Sequence[str]) -> tuple[int | None, ...]:
        """Return the index of each of the K points among names in any order and spelling (``LBigToe``,
        ``left_big_toe``); None for one that is missing.
        """
        exact, given = list(names), [_canonical(name).lower() for name in names]
        words = [_canonical(name).lower() for name in self.names]

        def index(name: str, word: str) -> int | None:
            if name in exact or words.count(word) > 1:  # r_knee and right_knee are two points of one layout
                return exact.index(name) if name in exact else None
            return given.index(word) if word in given else None

        return tuple(map(index, self.names, words))

    def order(self, names: Sequence[str]) -> list[int] | None:
        """Return the same, or None if one is missing."""
        found = [index for index in self.found(names) if index is not None]
        return found if len(found) == len(self) else None


@dataclass(frozen=True, eq=False)
class DetectorTable:
    """All layouts and the body's points that they consist of."""

    points: tuple[Landmark, ...]  #: U points in the link frames of the shipped skeleton
    places: Mapping[str, Place]  #: Of those of them that have a spread of their own
    layouts: Mapping[str, Layout]  #: By name; includes the skeleton's own, 'joints' and 'landmarks'
    seen_by: Mapping[str, tuple[str, ...]]
    """Landmark of the skeleton that is no joint -> points that show it, itself included."""

    @property
    def fitted(self) -> Self:
        """The table of the points without a spread, whose joint distribution was fitted."""
        return replace(self, points=tuple(point for point in self.points if point.name not in self.places))

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
        InvalidInputError: its name is that of a shipped layout, one of its names or points stands twice, or it places a
            point that the table, or another added layout, has elsewhere.
        UnknownNameError: neither the table nor the layout has such a point, or the skeleton no such joint.
    """
    _extended((*(one for one in ADDED.all() if one.name != layout.name), layout))
    ADDED.add(layout)


def detector_table() -> DetectorTable:
    """Return the shipped table with the layouts that were added; `ExtensionError`, `InvalidInputError` or
    `UnknownNameError` where that of an installed package cannot be used.
    """
    return _extended(ADDED.all())


@lru_cache(maxsize=4)
def _extended(added: tuple[Layout, ...]) -> DetectorTable:
    """The shipped table with further layouts and their points."""
    table, skeleton = _shipped_table(), SkeletonModel.default()
    for layout in added:
        if layout.name in table.layouts:
            raise InvalidInputError(f"layout {layout.name!r} is a shipped one; choose another name")
        for kind, names in (("name", layout.names), ("point", layout.points)):
            if double := [name for name in names if names.count(name) > 1]:
                raise InvalidInputError(f"layout {layout.name!r}: the {kind} {double[0]!r} stands there twice")
        for place in (side for one in layout.places for side in one.sides):
            if place.joint not in skeleton.names:
                raise UnknownNameError(f"joint of point {place.name!r}", [place.joint], skeleton.names)
            if table.places.get(place.name) != place:
                if place.name in (point.name for point in table.points):
                    elsewhere = "has another place already; choose another name"
                    raise InvalidInputError(f"layout {layout.name!r}: the point {place.name!r} {elsewhere}")
                point = Landmark(place.name, place.joint, np.array(place.offset))
                table = replace(table, points=(*table.points, point), places={**table.places, place.name: place})
        known = [*(point.name for point in table.points), *map(own, skeleton.landmarks)]
        if unknown := sorted(set(layout.points) - set(known)):
            raise UnknownNameError(f"point in layout {layout.name!r}", unknown, known)
        table = replace(table, layouts={**table.layouts, layout.name: layout})
    return table


# --- files ---------------------------------------------------------------------------------------


@cache
def _markers() -> dict[str, Any]:
    """Anatomical locations of optical laboratories."""
    points: dict[str, Any] = load_toml(model_path("marker_sets.toml"))["point"]
    return points


class PointTable(InputTable):
    """A point and its place; a point named Right... stands for its mirror image Left... too."""

    name: str
    """Name of the point, the side first."""
    joint: Annotated[str, OneOf(lambda: SkeletonModel.default().names)] | None = None
    """Segment in which the point is fixed, by the joint where it begins."""
    offset_mm: Vector3 | None = None
    """Place in the segment's link frame (T-pose: x forward, y left, z up) on a person of 1.72 m."""
    share: Vector3 | None = None
    """The same in lengths of the segment."""
    marker: Annotated[str, OneOf(lambda: _markers())] | None = None
    """Instead of joint and place: a location of models/marker_sets.toml, whose place and spread it has."""
    spread_mm: Annotated[Array, ArrayOf(3, also=((),))] | None = None
    """Standard deviation of the place between persons, of all axes or by axis."""
    size_mm: Positive | None = None
    """Standard deviation of the detector's errors in the image plane."""

    def landmark(self) -> Landmark:
        """Return the point in its segment."""
        if self.marker is not None:
            row = _markers()[self.marker]
            left = Landmark(self.name, row["segment"], np.array(row["place_mm"]) / 1e3)
            return _mirror_image(left, self.name) if self.name.startswith("Right") else left
        if self.joint is None or (self.offset_mm is None) == (self.share is None):
            raise self.error("joint", f"of {self.name!r}: give joint and one of offset_mm and share; or marker alone")
        if self.offset_mm is not None:
            return Landmark(self.name, self.joint, self.offset_mm / 1e3)
        assert self.share is not None
        end = next(one.end for one in SkeletonModel.default().table.joints if one.name == self.joint)
        return Landmark(self.name, self.joint, self.share * float(np.linalg.norm(end)))

    def place(self, usual_mm: float | None) -> Place | None:
        """Return the place with its spread, the usual one where it has none; None without any."""
        spread: Any = usual_mm if self.marker is None else _markers()[self.marker]["sd_mm"]
        if (spread := spread if self.spread_mm is None else self.spread_mm) is None:
            return None
        if np.any(np.less_equal(spread, 0)):
            raise self.error("spread_mm", "a standard deviation is not positive; give millimetres, e.g. 15")
        point, (a, b, c) = self.landmark(), (float(mm) / 1e3 for mm in np.broadcast_to(spread, 3))
        x, y, z = map(float, point.offset)
        size = Place.size if self.size_mm is None else self.size_mm / 1e3
        return Place(self.name, point.joint, (x, y, z), (a, b, c), size)


_Indices = Annotated[tuple[Integer, ...], Strict(False)]


class LayoutTable(InputTable):
    """A detector's points in its order."""

    name: str
    """Name of the layout, as in ``layout = "coco17"``."""
    names: Names
    """What the detector calls its points, in its order."""
    title: str = ""
    """Name for people."""
    points: dict[str, str] = {}
    """Name -> point, where its name does not say which one it is."""
    whole: dict[str, _Indices] = {}
    """Number of points of a whole body that it takes some of -> their indices; [] for the first ones."""

    def layout(self, places: Sequence[Place]) -> Layout:
        """Return the layout."""
        if strange := sorted(set(self.points) - set(self.names)):
            raise UnknownNameError("name", strange, self.names, self.path, self.where("points"))
        K, whole = len(self.names), list[tuple[int, tuple[int, ...]]]()
        for count, at in self.whole.items():
            if not (count.isdigit() and len(at) in (0, K) and all(0 <= i < int(count) for i in at)):
                raise self.error("whole", f"{count!r}: give {K} indices, one for each name, below the number of points")
            whole.append((int(count), at or tuple(range(K))))
        made = Layout.of(self.name, self.title or self.name, self.names, self.points, places)
        return replace(made, whole=tuple(whole))


class LayoutFile(InputTable):
    """The points and layouts of a file."""

    point: Annotated[tuple[PointTable, ...], Strict(False)] = ()
    """Points with places of their own."""
    layout: Annotated[tuple[LayoutTable, ...], Strict(False)]
    """The layout, [[layout]]."""


_SPREAD_MM: Final = 20.0  #: Of a point of a user's file that does not say it


def read_layout(path: str | Path) -> Layout:
    """Read the one layout of a user's file, whose form is that of ``models/detectors.toml``. `FileFormatError`,
    `UnknownNameError`: with file, field and remedy.
    """
    file = LayoutFile.read(path)
    if len(file.layout) != 1:
        raise file.error("layout", f"{len(file.layout)} layouts; a file has one, [[layout]]")
    places = tuple(place for point in file.point if (place := point.place(_SPREAD_MM)) is not None)
    return file.layout[0].layout(places)


def is_layout_file(name: str | Path | None) -> bool:
    """Return whether a layout is given by a file, not by its name."""
    return name is not None and Path(name).suffix.lower() == ".toml"


def layout_named(name: str | Path) -> str:
    """Return the name of a layout that is given by name or by a file, which is read and added; errors as of
    `read_layout`, `add_layout` and `DetectorTable.layout`.
    """
    if not is_layout_file(name):
        return detector_table().layout(str(name)).name
    layout = read_layout(name)
    with reading(name, "{}", InvalidInputError, UnknownNameError):
        add_layout(layout)
    return layout.name


@cache
def _shipped_table() -> DetectorTable:
    path = model_path("detectors.toml")
    data = load_toml(path)
    file = LayoutFile.of({key: data[key] for key in ("point", "layout")}, Path(path))
    points = tuple(side for entry in file.point for side in _sides(entry.landmark()))
    placed = (place for entry in file.point if (place := entry.place(None)) is not None)
    places = {side.name: side for place in placed for side in place.sides}
    layouts, skeleton = {one.name: one.layout(()) for one in file.layout}, SkeletonModel.default()
    for name, names in zip(OWN_LAYOUTS, (skeleton.names, tuple(skeleton.landmarks)), strict=True):
        layouts[name] = Layout(name, f"the skeleton's own {name}", names, tuple(map(own, names)))
    return DetectorTable(points, places, layouts, _seen_by(data["seen_by"]))


def _sides(point: Landmark) -> list[Landmark]:
    """Return a point and, if it has a side, its mirror image."""
    other = mirrored(point.name)
    return [point] if other == point.name else [point, _mirror_image(point, other)]


def _mirror_image(point: Landmark, name: str) -> Landmark:
    return Landmark(name, mirrored(point.joint), point.offset * MIRROR)


def _seen_by(of_right: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    both: dict[str, tuple[str, ...]] = {}
    for name, points in of_right.items():
        both[name] = (own(name), *points)
        both[mirrored(name)] = (own(mirrored(name)), *map(mirrored, points))
    return both
