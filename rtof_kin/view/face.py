"""Blurring of the tracked person's face; where its place is uncertain, of the whole picture.

Other people's faces are not known and not blurred.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import Provenance
from rtof_kin.view.canvas import Box, Image
from rtof_kin.view.projected_motion import Moment, ProjectedMotion, shown_provenance

_HEAD: Final = "Head"
_RADIUS: Final = 0.24 / 1.75
"""Radius around the middle of the head that contains it with hair and chin, over the body height."""
_SIGMAS: Final = 3.0  # Standard deviations of the head's position by which the region is larger
_UNKNOWN: Final = 0.5  # Radii by which it is larger without a confidence
_MOST: Final = 1.5
"""Largest such margin, radii; a detected point of the head that lies elsewhere than expected counts too."""
_BLOCKS: Final = 6  # Blocks across a region: about two across a face
_BLOCKS_OF_ALL: Final = 12  # Blocks across the shorter side where the whole picture is blurred
_SLACK: Final = 1  # Frames of the motion before and after, whose regions are added
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) / np.sqrt(3)
_DIRECTIONS: Final = np.vstack([np.eye(3), -np.eye(3), _CORNERS])  # (14, 3) unit vectors in all directions


@dataclass(frozen=True)
class FaceRegion:
    """Where the face of the tracked person may be."""

    box: Box | None  #: Pixels to be blurred; None: all of the picture
    block: int  #: Size of the blocks, px


class FaceFinder:
    """Regions of the face of the tracked person in a picture."""

    def __init__(self, projected: ProjectedMotion):
        skeleton = projected.motion.skeleton
        camera = projected.view.camera
        self._projected, self._picture = projected, Box(0, 0, camera.width_px, camera.height_px)
        self._joint = skeleton.names.index(_HEAD) if _HEAD in skeleton.names else None
        self._offset = 0.5 * skeleton.landmarks.get("HeadTop", (_HEAD, np.zeros(3)))[1]
        self._radius = _RADIUS * skeleton.height
        self._provenance = shown_provenance(projected.motion)
        names = projected.view.names
        own = {name: offset for name, (joint, offset) in skeleton.landmarks.items() if joint == _HEAD}
        self._detected = [i for i, name in enumerate(names) if name in own]
        self._offsets = np.array([own[names[i]] for i in self._detected]).reshape(-1, 3)
        self._largest = -(-min(self._picture.width, self._picture.height) // _BLOCKS_OF_ALL)

    def region(self, moment: Moment | None) -> FaceRegion:
        """Return what to blur at an instant. `moment`: of the motion; None where there is none."""
        whole = FaceRegion(None, self._largest)
        if moment is None or self._joint is None:
            return whole
        last = len(self._projected.motion.times) - 1
        frames = range(max(moment.before - _SLACK, 0), min(moment.after + _SLACK, last) + 1)
        circles = [self._circle(frame) for frame in frames]
        if any(circle is None for circle in circles):
            return whole
        boxes = np.array([(*(c - r), *(c + r)) for c, r in filter(None, circles)])
        left, top = np.floor(boxes[:, :2].min(axis=0)).astype(int)
        right, bottom = np.ceil(boxes[:, 2:].max(axis=0)).astype(int) + 1
        box = Box(int(left), int(top), int(right - left), int(bottom - top))
        block = -(-max(box.width, box.height) // _BLOCKS)
        self._largest = max(self._largest, block)
        return FaceRegion(box, block)

    def _circle(self, frame: int) -> tuple[Array, float] | None:
        """Return middle and radius, px, of a region with the head in a frame; None where that is unknown."""
        j, projected = self._joint, self._projected
        poses = projected.motion.poses
        if j is None or self._provenance[frame, j] < Provenance.IMU:
            return None
        p, R = poses.p_world_joint[frame, j], poses.R_world_bone[frame, j]
        around = p + R @ self._offset + self._radius * np.vstack([np.zeros(3), _DIRECTIONS])
        points = np.vstack([around, p + self._offsets @ R.T])
        uv = projected.view.project(points[None], np.array([frame]))[0]
        if not np.isfinite(uv).all():
            return None
        uv, expected = uv[: len(around)], uv[len(around) :]
        radius = float(np.linalg.norm(uv[1:] - uv[0], axis=1).max())
        margin = _UNKNOWN * radius
        covariance = projected.covariance_px(frame)
        if covariance is not None and np.isfinite(covariance[j]).all():
            margin = _SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance[j])[-1]))
        detected = projected.view.in_video(np.array([frame]))[0, self._detected]
        apart = np.linalg.norm(detected - expected, axis=1)
        margin = max(margin, float(apart[np.isfinite(apart)].max(initial=0.0)))
        return (uv[0], radius + margin) if margin <= _MOST * radius else None


def pixelate(image: Image, region: FaceRegion) -> None:
    """Replace a region of an image, in place, by the mean colours of its blocks. `image`: (height, width, 3)."""
    height, width = image.shape[:2]
    box = region.box or Box(0, 0, width, height)
    left, top = max(box.left, 0), max(box.top, 0)
    right, bottom = min(box.right, width), min(box.bottom, height)
    if right <= left or bottom <= top:
        return
    patch = image[top:bottom, left:right]
    counts = [max(size // region.block, 1) for size in patch.shape[:2]]  # blocks that are none smaller than that
    rows, columns = (np.arange(n) * size // n for n, size in zip(counts, patch.shape[:2], strict=True))
    heights, widths = np.diff([*rows, patch.shape[0]]), np.diff([*columns, patch.shape[1]])
    sums = np.add.reduceat(np.add.reduceat(patch, rows, axis=0, dtype=np.int64), columns, axis=1)
    means = (sums // np.outer(heights, widths)[..., None]).astype(np.uint8)
    patch[:] = means.repeat(heights, axis=0).repeat(widths, axis=1)
