"""Points of a body that keypoints show, with their places in its segments.

The skeleton's landmarks are fixed in their segments. A detector's own points lie where they were measured
(``models/detector_points.toml``), or else where their layout says, turned from the shipped skeleton's link frames to
those of this rig and scaled by the length of the leg, and moved by what is known of the person
(`SkeletonModel.with_image_points`). What moves them beside their segment, a second segment and the direction of view,
is evaluated at known poses (`ImagePoints.displaced`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from rtof_kin.body.kinematics import shared_frames
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Landmark
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence, layout_and_point
from rtof_kin.vision.layouts import MIRROR, Layout, Place, detector_table, mirrored

HARMONICS: Final = 8  #: Functions of the direction to the camera (`harmonics`)
MIRROR_HARMONICS: Final = np.array([1.0, -1.0, 1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
"""Signs of the `harmonics` where y changes its sign."""
_LEG: Final = 0.75  #: [m] Thigh and shank of the measured places
_CORRELATION: Final = 0.42  #: Of the errors of points next to one joint, as of an ankle's and a foot's
_SPREAD: Final = 0.02  #: [m] By how much the place of a point errs that was not measured with its detector


def harmonics(direction: Array) -> Array:
    """Return the functions (..., 8) that views are linear in, of unit vectors (..., 3) to the camera in the pelvis
    frame.
    """
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=-1)


@dataclass(frozen=True)
class DetectorPoint:
    """A detector's point on a body with a leg (thigh and shank) of 1 m; vectors are in link frames of the
    shipped skeleton.
    """

    anchor: str  #: Joint next to it
    frame: str  #: Segment in which it is fixed; it begins or ends at the anchor
    place: Array  #: (3,) from the anchor, m
    size: float  #: [m] Standard deviation of its errors per axis, up to a scale that is common to all points
    independent: float  #: [1] Weight beside correlated neighbours
    second: str  #: Segment that moves the place too
    second_place: Array = field(default_factory=lambda: np.zeros(3))  #: (3,) in the second segment's frame, m
    view: Array = field(default_factory=lambda: np.zeros((HARMONICS, 3)))
    """(8, 3) displacement by the direction of view in the pelvis frame, m."""

    def mirrored(self) -> DetectorPoint:
        """Return the point of the other side."""
        return replace(
            self,
            anchor=mirrored(self.anchor),
            frame=mirrored(self.frame),
            second=mirrored(self.second),
            place=self.place * MIRROR,
            second_place=self.second_place * MIRROR,
            view=self.view * MIRROR_HARMONICS[:, None] * MIRROR,
        )


def detector_points(layout: str) -> Mapping[str, DetectorPoint]:
    """Return the points of a layout that are used as measurements, by name; `UnknownNameError` for others."""
    return _known_points(detector_table().layout(layout))


@lru_cache(maxsize=32)
def _known_points(layout: Layout) -> Mapping[str, DetectorPoint]:
    return read_detector_points(model_path("detector_points.toml"), layout.name)


def read_detector_points(path: str | Path, layout: str) -> dict[str, DetectorPoint]:
    """Read the points of a layout: those of the shipped table of sizes, and those with a spread of their own;
    `UnknownNameError` for an unknown layout.
    """
    data, names = load_toml(path), detector_table().layout(layout).points
    places = {point.name: point for point in detector_table().points}
    measured, views = (data.get(key, {}).get(layout, {}) for key in ("measured", "view"))
    parts = {name: part for part in data["part"] for name in part["points"]}
    placed, found = detector_table().places, dict[str, DetectorPoint]()
    for name in names:
        right = name.replace("Left", "Right", 1) if name.startswith("Left") else name
        if name in placed:
            part = {"size_mm": 1000 * placed[name].size, "independent": 1.0}
            found[name] = _point(part, places[name], None, None)
        elif right in parts:
            point = _point(parts[right], places[right], measured.get(right), views.get(right))
            found[name] = point if name == right else point.mirrored()
    return _beside_placed(found, placed) if placed.keys() & found.keys() else found


def _beside_placed(found: Mapping[str, DetectorPoint], placed: Mapping[str, Place]) -> dict[str, DetectorPoint]:
    """Return points of which some have a spread: the spread is an error too, as is the usual one of the others, whose
    places were not measured with this detector; and there are further ones next to some joints.
    """
    crowd = Counter(found[name].anchor for name in found if name in placed)
    beside, out = Counter(point.anchor for point in found.values()), dict[str, DetectorPoint]()
    for name, point in found.items():
        others = beside[point.anchor] - 1 if name in placed else crowd[point.anchor]
        spread = np.sqrt(np.mean(np.square(placed[name].spread))) if name in placed else _SPREAD
        size = float(np.hypot(point.size, spread))
        out[name] = replace(point, size=size, independent=point.independent / (1 + others * _CORRELATION))
    return out


def _point(part: Mapping[str, Any], usual: Landmark, measured: Mapping[str, Any] | None, view: Any) -> DetectorPoint:
    """A point at its measured place, or else at that of the table of detectors."""
    skeleton = SkeletonModel.default()
    if measured is None:
        children = {j.name: j.offset for j in skeleton.table.joints if j.parent == usual.joint}
        beginnings = {usual.joint: np.zeros(3), **children}
        anchor = min(beginnings, key=lambda name: float(np.linalg.norm(beginnings[name] - usual.offset)))
        leg = skeleton.bone_lengths["RightLeg"] + skeleton.bone_lengths["RightFoot"]
        moving = usual.joint, (usual.offset - beginnings[anchor]) / leg, usual.joint, np.zeros(3)
    else:
        anchor = measured["anchor"]
        place, second = (_metres(measured[key]) for key in ("place_mm", "second_mm"))
        moving = measured["frame"], place, measured["second"], second
    frame, place, second_frame, second_place = moving
    return DetectorPoint(
        anchor,
        frame,
        place,
        part["size_mm"] / 1000,
        part["independent"],
        second_frame,
        second_place,
        np.zeros((HARMONICS, 3)) if view is None else _metres(view),
    )


def _metres(values_mm: Any) -> Array:
    """Millimetres on the measured body as metres on one with a leg of 1 m."""
    return np.array(values_mm) / 1000 / _LEG


@dataclass(frozen=True)
class ImagePoints:
    """L points of a skeleton; indices are those of its joints."""

    names: tuple[str, ...]
    on: tuple[tuple[int, bool], ...]  #: Segment of each, and whether it is the joint where the segment begins
    places: Array  #: (L, 3) in the link frames, m
    sizes: Array  #: (L,) expected errors relative to those of the others
    independent: Array  #: (L,) weights beside correlated neighbours, relative to those of the others
    anchors: tuple[int, ...]  #: Joint next to each
    seconds: tuple[int, ...]  #: Segment that moves the point too
    second_places: Array  #: (L, 3) in the second segments' link frames, m
    views: Array  #: (L, 8, 3) displacement by the direction of view in the pelvis frame, m
    R_bone_pelvis: Array  #: (3, 3) frame of the views in the root's link frame

    def positions(self, p_world_joint: Array, R_world_bone: Array) -> Array:
        """Return the points (T, L, 3) in world, m. p_world_joint: (T, J, 3) m. R_world_bone: (T, J, 3, 3)."""
        own = [j for j, _ in self.on]
        return np.asarray(p_world_joint[:, own] + np.einsum("tlij,lj->tli", R_world_bone[:, own], self.places))

    @property
    def moving(self) -> bool:
        """Whether anything moves the points beside their segments, see `displaced`."""
        return bool(self.second_places.any() or self.views.any())

    def displaced(self, camera: Camera, p_world_joint: Array, R_world_bone: Array) -> Array:
        """Return by how much the points (T, L, 2) lie off their places in the undistorted image, px, at joints (T, J,
        3), m, and orientations (T, J, 3, 3).
        """
        toward = so3.unit(camera.center_world - p_world_joint[:, list(self.anchors)])
        R_pelvis = R_world_bone[:, 0] @ self.R_bone_pelvis
        by_view = np.einsum("tlh,lhi->tli", harmonics(np.einsum("tji,tlj->tli", R_pelvis, toward)), self.views)
        second = np.einsum("tlij,lj->tli", R_world_bone[:, list(self.seconds)], self.second_places)
        at = self.positions(p_world_joint, R_world_bone)
        camera = camera.undistorted()
        off = second + np.einsum("tij,tlj->tli", R_pelvis, by_view)
        return np.asarray(camera.project(at + off) - camera.project(at))


def joined_points(parts: Sequence[ImagePoints]) -> ImagePoints:
    """Return the points of several cameras, one after the other."""
    joined: dict[str, Any] = {
        name: tuple(item for part in parts for item in getattr(part, name))
        for name in ("names", "on", "anchors", "seconds")
    }
    for name in ("places", "sizes", "independent", "second_places", "views"):
        joined[name] = np.concatenate([getattr(part, name) for part in parts])
    return replace(parts[0], **joined)


class _Point(NamedTuple):
    """One of the points: joints by index, places in link frames and m, as in `ImagePoints`."""

    segment: int
    anchor: int
    second: int
    place: Array
    second_place: Array = np.zeros(3)
    view: Array = np.zeros((HARMONICS, 3))
    size: float = 1.0
    independent: float = 1.0


def image_points(skeleton: SkeletonModel, names: Sequence[str]) -> ImagePoints:
    """Return the points of the subject's skeleton for L names: landmarks of it, or detector's points
    (`measurements`).
    """
    known = {name: point for name in names if (point := _measurement(name)) is not None}
    leg, turns = 1.0, np.eye(3)[None]
    if known:
        length, turns = skeleton.bone_lengths, link_turns(skeleton)
        leg = sum(length[f"{side}{joint}"] for side in ("Left", "Right") for joint in ("Leg", "Foot")) / 2
    points = []
    for name in names:
        if name not in known:
            joint, place = skeleton.landmarks[name]
            j = skeleton.names.index(joint)
            points.append(_Point(j, j, j, place))
            continue
        point = known[name]
        segment, anchor, second = map(skeleton.names.index, (point.frame, point.anchor, point.second))
        at = np.zeros(3) if anchor == segment else skeleton.joint_offsets[anchor]
        shift = skeleton.table.image_points.get(layout_and_point(name)[0], {}).get(point.anchor, 0.0)
        place = at + leg * turns[segment] @ point.place + shift
        moving = leg * turns[second] @ point.second_place, leg * point.view
        points.append(_Point(segment, anchor, second, place, *moving, point.size, point.independent))
    L = len(points)

    def each(field: str, *shape: int) -> Array:
        return np.reshape([getattr(point, field) for point in points], (L, *shape)).astype(float)

    sizes, independent = each("size"), each("independent")
    return ImagePoints(
        names=tuple(names),
        on=tuple((point.segment, name in skeleton.names) for point, name in zip(points, names, strict=True)),
        places=each("place", 3),
        sizes=sizes / np.exp(np.log(sizes).sum() / max(L, 1)),
        independent=independent / (independent.sum() / max(L, 1)),
        anchors=tuple(point.anchor for point in points),
        seconds=tuple(point.second for point in points),
        second_places=each("second_place", 3),
        views=each("view", HARMONICS, 3),
        R_bone_pelvis=turns[0],
    )


def measurements(keypoints: KeypointSequence, skeleton: SkeletonModel) -> KeypointSequence:
    """Return what a solver compares with the body: the detector's own points, whose places are known for the 21-joint
    skeleton, or else the landmarks.
    """
    own = [name for name in keypoints.names if _measurement(name) is not None]
    if own and skeleton.names == _shipped().names:
        return keypoints.select(own)
    extra = [n for n in keypoints.names if n in skeleton.landmarks and n not in skeleton.names]
    return keypoints.select((*skeleton.names, *extra))


@cache
def _shipped() -> SkeletonModel:
    return SkeletonModel.default()


def link_turns(skeleton: SkeletonModel) -> Array:
    """Return rotations (J, 3, 3) from the link frames of the shipped skeleton to those of this rig."""
    own, shipped = (shared_frames(s.names, s.joint_offsets) for s in (skeleton, _shipped()))
    return np.asarray(own @ np.swapaxes(shipped, -1, -2))


def _measurement(name: str) -> DetectorPoint | None:
    """A detector's point that is used; None for another one and for landmarks."""
    layout, point = layout_and_point(name)
    return detector_points(layout).get(point) if layout else None
