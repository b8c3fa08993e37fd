"""The table of a detector's errors (``models/detector_errors.toml``), for all points of both sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.vision.image_points import MIRROR_HARMONICS
from rtof_kin.vision.layouts import Layout, detector_table

VIEWS = ("front", "back", "left", "right")  #: Where a camera stands that sees a covariance of coloured errors
_NUMBERS = ("amplitude", "visibility", "exchanges", "jumps", "lost", "camera")
_ARM, _LEG = ("shoulder", "elbow", "wrist", "hand"), ("knee", "ankle", "foot")
_MIRROR_BODY, _MIRROR_IMAGE = np.array([1, -1, 1]), np.array([-1, 1])


@dataclass(frozen=True)
class Places:
    """Where the K points stand, of a person whose thigh and shank together have the length `leg`."""

    leg: float  #: m
    anchor: tuple[str, ...]  #: K joints
    frame: tuple[str, ...]  #: K joints, of whose links the mean is fixed in
    second_frame: tuple[str, ...]  #: K joints, of whose links `pose` is fixed in
    mean: Array  #: (K, 3) from the anchor, m
    pose: Array  #: (K, 3) m
    view: Array  #: (K, 8, 3) displacement in the pelvis frame, m, by `harmonics` of the direction to the camera
    view_spread: float  #: Log-normal, of all `view` together
    person_sd: Array  #: (G, 3) of each kind of points between persons, m


@dataclass(frozen=True)
class Covariance:
    """Covariance ``factor factor^T + diag(rest^2)`` of errors in the image at the points' depth."""

    factor: Array  #: (..., K, 2, r) m
    rest: Array  #: (..., K, 2) m


@dataclass(frozen=True)
class DetectorErrorTable:
    """Errors of a detector of K points; lengths in m, times in s, angles in rad."""

    layout: Layout  #: Names of the points
    group: tuple[str, ...]  #: Kinds of points, e.g. face, shoulder; G of them.
    kind: Index  #: (K,) index of each point's kind
    left: Mask  #: (K,) points of the left side
    mirror: Index  #: (K,) the same point of the other side
    limb: Index  #: (K,) 0 for head and hips, then right arm, left arm, right leg, left leg
    places: Places  #: Of the points in the body
    shares: Array  #: (K, C) of the variance of coloured errors by time constant
    amplitude: Mapping[str, Array]  #: (K,) by kind of point: gain, hidden, far, speed, mood_sd
    visibility: Mapping[str, Array]  #: (K,) by kind of point: base, hidden, far, log_error, outside, residual_sd
    constant: Covariance  #: For a whole recording
    coloured: Covariance  #: Of coloured errors; the first axis is that of `VIEWS`
    time_constants: Array  #: (C,) of coloured errors, s
    smoothing: float  #: Standard deviation of the normal window over coloured errors, s
    numbers: Mapping[str, Any]
    """The sections amplitude, visibility, exchanges, jumps, lost and camera as they stand in the file."""

    def points_of(self, groups: Sequence[str]) -> Index:
        """Return the points of some kinds."""
        return np.flatnonzero(np.isin(self.kind, [self.group.index(name) for name in groups]))


@cache
def detector_error_table() -> DetectorErrorTable:
    """Return the shipped table."""
    data = load_toml(model_path("detector_errors.toml"))
    layout = detector_table().layout(data["layout"])
    group = tuple(data["group"])
    points = [data["point"][_stem(name)] for name in layout.names]
    kind = np.array([group.index(point["group"]) for point in points])
    left = np.array(["left" in name.split("_") for name in layout.names])
    sides = list(zip(map(_stem, layout.names), left.tolist(), strict=True))
    mirror = np.array(
        [sides.index((stem, not side)) if (stem, not side) in sides else k for k, (stem, side) in enumerate(sides)]
    )
    limb = [_limb(group[g], bool(side)) for g, side in zip(kind, left, strict=True)]
    coloured, rows = data["coloured"], [data["group"][group[g]] for g in kind]

    def columns(section: str) -> dict[str, Array]:
        return {name: np.array([float(row[section][name]) for row in rows]) for name in rows[0][section]}

    return DetectorErrorTable(
        layout=layout,
        group=group,
        kind=kind,
        left=left,
        mirror=mirror,
        limb=np.array(limb),
        places=_places(data, points, left, group),
        shares=np.array([row["shares"] for row in rows], dtype=float),
        amplitude=columns("amplitude"),
        visibility=columns("visibility"),
        constant=_covariance(data["constant"], len(points)),
        coloured=_by_view(coloured, mirror),
        time_constants=np.array(coloured["time_constants"], dtype=float),
        smoothing=float(coloured["smoothing"]),
        numbers={name: data[name] for name in _NUMBERS},
    )


def _stem(name: str) -> str:
    return "_".join(word for word in name.split("_") if word not in ("left", "right"))


def _limb(group: str, left: bool) -> int:
    return left + (1 if group in _ARM else 3) if group in (*_ARM, *_LEG) else 0


def _places(data: Mapping[str, Any], points: Sequence[Mapping[str, Any]], left: Mask, group: Sequence[str]) -> Places:
    sign = np.where(left[:, None], _MIRROR_BODY, 1)
    view = np.array([point["view_mm"] for point in points]) / 1e3
    mirrored = view * MIRROR_HARMONICS[:, None] * _MIRROR_BODY

    def joints(field: str) -> tuple[str, ...]:
        names = zip((point[field] for point in points), left, strict=True)
        return tuple(name.replace("Right", "Left") if side else name for name, side in names)

    return Places(
        leg=float(data["leg_mm"]) / 1e3,
        anchor=joints("anchor"),
        frame=joints("frame"),
        second_frame=joints("second_frame"),
        mean=np.array([point["mean_mm"] for point in points]) / 1e3 * sign,
        pose=np.array([point["pose_mm"] for point in points]) / 1e3 * sign,
        view=np.where(left[:, None, None], mirrored, view),
        view_spread=float(data["view"]["spread"]),
        person_sd=np.array([data["group"][name]["person_sd_mm"] for name in group]) / 1e3,
    )


def _covariance(section: Mapping[str, Any], K: int) -> Covariance:
    factor = np.array(section["factor_mm"], dtype=float).reshape(K, 2, -1) / 1e3
    return Covariance(factor, np.array(section["rest_mm"], dtype=float).reshape(K, 2) / 1e3)


def _by_view(section: Mapping[str, Any], mirror: Index) -> Covariance:
    """Return the covariances of all `VIEWS`; the right is the mirror image of the left."""
    seen = [_covariance(section[view], len(mirror)) for view in VIEWS[:3]]
    seen.append(Covariance(seen[-1].factor[mirror] * _MIRROR_IMAGE[:, None], seen[-1].rest[mirror]))
    return Covariance(np.stack([c.factor for c in seen]), np.stack([c.rest for c in seen]))
