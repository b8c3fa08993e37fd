"""Paths of pelvis and feet, from which gait, repetitions and travel are found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtof_kin.body.observability import ObservationMasks
from rtof_kin.body.pose_prior import standing_frames
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, AngleTable, angle_table
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.over_time import Sampled
from rtof_kin.data.corrections import Correction
from rtof_kin.data.poses import PoseSequence


@dataclass(frozen=True)
class BodyPaths(Sampled):
    """Positions of a few points of a whole motion of any length, and what was observed of it."""

    times: Array  #: (T,) seconds
    points: dict[str, Array]
    """Anatomical term ('pelvis', 'right foot', 'right heel', 'right toe', ...) -> (T, 3) m, in world."""
    heading: Array  #: (T,) rad, of the pelvis; NaN where its pose is unknown
    standing: Mask | None  #: (T,) whether the person stands still (`standing_frames`); None without a request
    table: AngleTable  #: Joint of each term, see `AngleTable.segments`
    masks: ObservationMasks  #: Of all joints
    corrections: tuple[Correction, ...] = ()  #: By hand, of the recording

    @property
    def skeleton(self) -> SkeletonModel:
        """Of the subject."""
        return self.masks.skeleton

    def joint(self, term: str) -> int:
        """Return the index of the joint of a term."""
        return self.skeleton.index(self.table.segments[term])[0]


class PathCollector:
    """Paths of a whole motion, added block by block."""

    def __init__(self, skeleton: SkeletonModel, times: Array, standing: bool = False):
        """Allocate the paths; times: (T,) s."""
        self._skeleton, self._times = skeleton, times
        self._table = angle_table(skeleton.table)
        words = ("foot", "heel", "toe")
        terms = ["pelvis", *(f"{side} {word}" for side in SIDES for word in words)]
        self._landmarks = {term: skeleton.landmarks[self._table.segments[term]] for term in terms}
        self._points = {term: np.full((len(times), 3), np.nan) for term in terms}
        self._heading = np.full(len(times), np.nan)
        self._standing = np.zeros(len(times), dtype=np.bool_) if standing else None
        self._rate_hz = float(1 / np.median(np.diff(times))) if len(times) > 1 else 60.0

    def add(self, frames: slice, poses: PoseSequence, own: slice) -> None:
        """Add a block; poses: these, and the frames beside them if there are any; own: `frames` in poses."""
        self._skeleton.check_joints(poses.names)
        for term, (joint, offset) in self._landmarks.items():
            (j,) = self._skeleton.index(joint)
            turned = np.einsum("tij,j->ti", poses.R_world_bone[own, j], offset) if offset.any() else 0.0
            self._points[term][frames] = poses.p_world_joint[own, j] + turned
        (pelvis,) = self._skeleton.index(self._table.segments["pelvis"])
        self._heading[frames] = so3.heading(poses.R_world_bone[own, pelvis])
        if self._standing is not None:
            self._standing[frames] = standing_frames(poses, self._rate_hz)[own]

    def paths(self, masks: ObservationMasks, corrections: tuple[Correction, ...] = ()) -> BodyPaths:
        """Return the paths; `corrections`: by hand, of the recording."""
        return BodyPaths(self._times, self._points, self._heading, self._standing, self._table, masks, corrections)
