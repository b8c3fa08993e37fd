"""Checks of bodies and cameras without a reconstruction: bone lengths, size, focal length, reprojection."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence

RIGID_MM: Final = 1.0  #: Largest spread of a bone of a skeleton that was solved for, mm
TRIANGULATED_MM: Final = 50.0
"""Largest spread of the distance of two joints that were measured one by one, mm; 10-37 with four cameras."""
SIZE, SIZE_FACTOR = 1.9, 2.4
"""Diagonal of the box around a person's points, m, and the largest ratio to it: 0.8 to 4.6 m."""
FOCAL, FOCAL_FACTOR = 1.2, 5.0
"""Focal length in image widths, and the largest ratio to it: fields of view of 10-130 deg."""
CENTRE, ASPECT = 7.0, 3.0
"""Largest offset of the principal point from the centre, % of the width; largest difference of the focal
lengths, %."""
REPROJECTION_PX: Final = 20.0  #: Largest median reprojection error, px; detectors are off by up to 13 px
UNITS_M: Final = {"mm": 0.001, "cm": 0.01, "inches": 0.0254, "CMU units": 0.0254 / 0.45, "m": 1.0}
"""Units of length, m."""
_BONES: Final = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))


def limb_bones(names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return bones, by name, as indices of two points named by side and joint (``RHip``, ``left_knee``)."""
    found: dict[str, int] = {}
    for i, name in enumerate(names):
        words = re.sub(r"[^a-z]", "", name.lower()).replace("right", "r").replace("left", "l")
        found.setdefault(words, i)
    return {
        f"{names[found[side + a]]} to {names[found[side + b]]}": (found[side + a], found[side + b])
        for side in "rl"
        for a, b in _BONES
        if side + a in found and side + b in found
    }


def skeleton_bones(names: Sequence[str], parents: Sequence[int]) -> dict[str, tuple[int, int]]:
    """Return the bones of a tree of joints, as `limb_bones` does, from the index of each joint's parent, -1 for the
    root.
    """
    return {f"{names[p]} to {names[j]}": (p, j) for j, p in enumerate(parents) if p >= 0}


def bone_lengths(p: Array, bones: Mapping[str, tuple[int, int]]) -> dict[str, Array]:
    """Return the length (T,), m, of each bone of `limb_bones` between points (T, J, 3), m; NaN where an end is
    missing.
    """
    return {name: np.linalg.norm(p[:, a] - p[:, b], axis=-1) for name, (a, b) in bones.items()}


def check_bone_lengths(lengths: Mapping[str, Array], limit_mm: float) -> list[Check]:
    """Check the standard deviation of every bone's length (T,), m, against a limit in mm."""
    name, checks = "spread of length", []
    for bone, length in lengths.items():
        known = length[np.isfinite(length)]
        if len(known) < 2:
            checks.append(Check.unknown(name, bone, "mm", f"it is seen in {len(known)} frames"))
            continue
        advice = f"It is {np.median(known):.3f} m long in the median, and from {known.min():.3f} to "
        advice += f"{known.max():.3f} m; are points swapped, or another person's?"
        checks.append(Check(name, bone, 1000 * float(np.std(known)), limit_mm, "mm", advice))
    return checks


def box_sizes(p: Array) -> Array:
    """Return the diagonals (n,), m, of the boxes around points (T, J, 3), m, in the frames with five seen points."""
    p = p[np.isfinite(p).all(axis=-1).sum(axis=1) >= 5]
    return np.asarray(np.linalg.norm(np.nanmax(p, axis=1) - np.nanmin(p, axis=1), axis=-1))


def check_size(sizes: Array) -> Check:
    """Check that the points of a frame are as far apart as those of a person; sizes: of `box_sizes`."""
    name = "size of the person"
    if not len(sizes):
        return Check.unknown(name, "all points", "times", "in no frame are five points seen")
    size = float(np.median(sizes))
    others = [u for u, length in UNITS_M.items() if u != "m" and _factor(size * length / SIZE) < 1.3]
    advice = f"The points of a frame are {size:.3g} m apart, read in m"
    if others:
        advice += f"; are they in {' or '.join(others)}?"
    return Check(name, "all points", _factor(size / SIZE), SIZE_FACTOR, "times", advice)


def check_camera(name: str, camera: Camera) -> list[Check]:
    """Check focal length, aspect ratio and principal point against those of ordinary cameras."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    size = np.array([camera.width_px, camera.height_px])
    view = np.degrees(2 * np.arctan(camera.width_px / 2 / fx))
    off = 100 * float(np.max(np.abs(camera.K[:2, 2] - size / 2))) / camera.width_px
    where = f"camera {name}"
    lens = f"{fx:.5g} px see {view:.0f} deg; is it in px, and of images of this size?"
    pixels = f"The focal lengths are {fx:.5g} and {fy:.5g} px"
    centre = "Is the matrix of images of another size, or was the image cropped?"
    return [
        Check("focal length", where, _factor(fx / camera.width_px / FOCAL), FOCAL_FACTOR, "times", lens),
        Check("pixels not square", where, 100 * abs(fx / fy - 1), ASPECT, "%", pixels),
        Check("principal point off the centre", where, off, CENTRE, "% of width", centre),
    ]


def check_reprojection(parts: Iterable[tuple[KeypointSequence, Array]], names: Sequence[str]) -> Check:
    """Check the median reprojection error of known positions; parts: keypoints, and (n, J, 3) m at their times."""
    name, where, errors = "median reprojection error", "truth in the camera", list[Array]()
    for keypoints, p_world in parts:
        common = [joint for joint in keypoints.names if joint in names]
        seen = keypoints.camera.project(p_world[:, [list(names).index(joint) for joint in common]])
        error = np.linalg.norm(keypoints.select(common).uv_px - seen, axis=-1)
        errors.append(error[np.isfinite(error)])
    error = np.concatenate(errors)
    if len(error) == 0:
        return Check.unknown(name, where, "px", "no joint is both known and seen")
    advice = f"{len(common)} joints, {len(error)} points: is it another camera, or another clock?"
    return Check(name, where, float(np.median(error)), REPROJECTION_PX, "px", advice)


def _factor(ratio: float) -> float:
    """Return a ratio or its inverse, whichever is larger."""
    return max(ratio, 1 / ratio) if ratio > 0 else float("inf")
