"""A detector's points as measurements (``models/detector_points.toml``): sizes of errors, places, views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Landmark
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.vision.layouts import Layout, detector_table, mirrored

HARMONICS: Final = 8
"""Functions of the direction to the camera (`harmonics`)."""
_MIRROR: Final = np.array([1.0, -1.0, 1.0])
MIRROR_HARMONICS: Final = np.array([1.0, -1.0, 1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
"""Signs of the `harmonics` where y changes its sign."""
_LEG: Final = 0.75
"""[m] Thigh and shank of the measured places."""


def harmonics(direction: Array) -> Array:
    """Return the functions (..., 8) of unit vectors that views are linear in.

    Args:
        direction: (..., 3) to the camera in the pelvis frame.
    """
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=-1)


@dataclass(frozen=True)
class DetectorPoint:
    """A detector's point on a body with a leg (thigh and shank) of 1 m; vectors are in link frames of the
    shipped skeleton.
    """

    anchor: str
    """Joint next to it."""
    frame: str
    """Segment in which it is fixed; it begins or ends at the anchor."""
    place: Array
    """(3,) from the anchor, m."""
    size: float
    """[m] Standard deviation of its errors per axis, up to a scale that is common to all points."""
    independent: float
    """[1] Weight beside correlated neighbours."""
    place_sd: Array
    """(3,) of its place between persons, m."""
    second: str
    """Segment that moves the place too."""
    second_place: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) in the second segment's frame, m."""
    view: Array = field(default_factory=lambda: np.zeros((HARMONICS, 3)))
    """(8, 3) displacement by the direction of view in the pelvis frame, m."""

    def mirrored(self) -> DetectorPoint:
        """Return the point of the other side."""
        return replace(
            self,
            anchor=mirrored(self.anchor),
            frame=mirrored(self.frame),
            second=mirrored(self.second),
            place=self.place * _MIRROR,
            second_place=self.second_place * _MIRROR,
            view=self.view * MIRROR_HARMONICS[:, None] * _MIRROR,
        )


def detector_points(layout: str) -> Mapping[str, DetectorPoint]:
    """Return the points of a layout that are used as measurements, by name.

    Args:
        layout: name of a detector's layout.

    Raises:
        UnknownNameError: unknown layout.
    """
    return _shipped_points(detector_table().layout(layout))


@lru_cache(maxsize=32)
def _shipped_points(layout: Layout) -> Mapping[str, DetectorPoint]:
    return read_detector_points(model_path("detector_points.toml"), layout.name)


def read_detector_points(path: str | Path, layout: str) -> dict[str, DetectorPoint]:
    """Read the points of a layout.

    Args:
        layout: name of a layout of the shipped table of detectors.

    Raises:
        FileFormatError: not TOML, a field missing or of the wrong kind. UnknownNameError: unknown layout.
    """
    path = Path(path)
    data, names = load_toml(path), detector_table().layout(layout).points
    places = {point.name: point for point in detector_table().points}
    try:
        measured, views = (data.get(key, {}).get(layout, {}) for key in ("measured", "view"))
        parts = {name: part for part in data["part"] for name in part["points"]}
        found = dict[str, DetectorPoint]()
        for name in names:
            right = name.replace("Left", "Right", 1) if name.startswith("Left") else name
            if right in parts:
                point = _point(parts[right], places[right], measured.get(right), views.get(right))
                found[name] = point if name == right else point.mirrored()
    except KeyError as error:
        raise FileFormatError(path, f"the field {error} is missing") from error
    except (AttributeError, TypeError, ValueError) as error:
        raise FileFormatError(path, f"a field is not of the right kind: {error}") from error
    return found


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
        place, second = (_metres(measured[key], (3,)) for key in ("place_mm", "second_mm"))
        moving = measured["frame"], place, measured["second"], second
    frame, place, second_frame, second_place = moving
    return DetectorPoint(
        anchor,
        frame,
        place,
        float(part["size_mm"]) / 1000,
        float(part["independent"]),
        _metres(part["place_sd_mm"], (3,)),
        second_frame,
        second_place,
        np.zeros((HARMONICS, 3)) if view is None else _metres(view, (HARMONICS, 3)),
    )


def _metres(values_mm: Any, shape: tuple[int, ...]) -> Array:
    """Millimetres on the measured body as metres on one with a leg of 1 m."""
    values = np.array(values_mm, dtype=float)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{values_mm} is not an array of shape {shape}")
    return values / 1000 / _LEG
