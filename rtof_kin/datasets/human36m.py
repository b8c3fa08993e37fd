"""Human3.6M (Ionescu et al., TPAMI 2014) as `Recording`s: 17 joints, 50 Hz, four cameras, no IMUs.

The data are available from their owners for academic use; this package has none of them. The archives that
VideoPose3D (Pavllo et al., CVPR 2019) makes of them, converted to plain arrays by ``examples/convert_pickles.py``, are
read from one folder::

    data_3d_h36m.npz              positions_3d/SUBJECT/ACTION          (T, 32, 3) m, world z up
    data_2d_h36m_<keypoints>.npz  positions_2d/SUBJECT/ACTION/CAMERA   (T', 17, 2) px, cameras 0 to 3
                                  metadata/num_joints, keypoints_symmetry, layout_name

where ``<keypoints>`` is ``gt`` (projected), ``cpn_ft_h36m_dbb`` or ``detectron_ft_h36m`` (detected), and a
file of cameras, see `rtof_kin.datasets.human36m_files`. A recording ends with the shorter of the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import freeze
from rtof_kin.core.errors import CalibrationError, FileFormatError, RtofError, UnitError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.human36m_files import Archives, by_number
from rtof_kin.recording.recording import Recording

SUBJECTS_TRAIN = ("S1", "S5", "S6", "S7", "S8")
SUBJECTS_TEST = ("S9", "S11")
RATE_HZ = 50.0  #: Sampling rate of positions and video, Hz
_LIMIT_GT_PX, _LIMIT_DETECTED_PX = 3.0, 30.0
"""Largest median reprojection error of a recording with projected and with detected keypoints, px."""
ACKNOWLEDGEMENT = (
    "Human3.6M: C. Ionescu, D. Papava, V. Olaru, C. Sminchisescu, 'Human3.6M: Large Scale Datasets and Predictive "
    "Methods for 3D Human Sensing in Natural Environments', IEEE TPAMI 36(7), 2014. Academic use only."
)
_PLAUSIBLE_THIGH = (0.2, 0.7)
_CHECKED_FRAMES = 20
_FRAMES = 4000  #: Number of frames, evenly spread, from which the shape of a segment is estimated
_ROUNDS, _CONVERGED = 50, 1e-9
_shipped = cache(SkeletonModel.human36m)


@dataclass(frozen=True)
class ActionMotion:
    """Positions of one action of one subject."""

    subject: str  #: 'S1' to 'S11'
    action: str  #: Name in the archive, e.g. 'Directions 1'.
    p_world_joint: Array  #: (T, 17, 3) m, world z up; NaN where unknown
    joint_offsets: Array  #: (17, 3) m, the same in all of the subject's actions; see `measured_offsets`

    def __post_init__(self) -> None:
        freeze(self, "action", p_world_joint=("T", 17, 3), joint_offsets=(17, 3))


class Human36M(Archives):
    """The recordings of one folder."""

    def __init__(self, root: str | Path, cameras: str | Path | None = None, keypoints: str = "gt") -> None:
        """See `Archives`."""
        super().__init__(root, cameras, keypoints)
        self.skeleton = _shipped()  #: The 17-joint skeleton of the package
        self._offsets: dict[str, Array] = {}

    @property
    def sequences(self) -> tuple[tuple[str, str], ...]:
        """(subject, action) of every motion, subjects by number, actions by name."""
        return tuple((one, a) for one in by_number(self.all_positions) for a in sorted(self.all_positions[one]))

    def motion(self, subject: str, action: str) -> ActionMotion:
        """Return the positions of an action and the subject's body. `UnknownNameError`: no such subject or action;
        `FileFormatError`: this action is corrupt; `UnitError`: positions are not in metres.
        """
        p = self.positions(subject, action)
        offsets = self._offsets_of(subject)
        own = bone_lengths(self.skeleton, _whole(p))
        usual = np.linalg.norm(offsets, axis=-1)
        wrong = np.flatnonzero(np.abs(own - usual) > np.maximum(0.05 * usual, 0.01))
        if len(wrong):
            bone = int(wrong[0])
            raise FileFormatError(
                self.path_3d,
                f"{subject} {action!r}: the bone that ends at {self.skeleton.names[bone]} is {own[bone]:.3f} m long, "
                f"but {usual[bone]:.3f} m in all of the subject's actions together; get the archive again",
            )
        return ActionMotion(subject, action, p, offsets)

    def recording(self, subject: str, action: str, camera: int) -> Recording:
        """Return an action seen by one camera, with the truth.

        Orientations follow from the positions and the subject's offsets (`kinematics.rotations_from_positions`). Where
        detected keypoints do not fit this sequence but fit the subject's others with the same camera, `notes` says so:
        a known fault of a few sequences of S9. `UnknownNameError`: no such subject, action or camera;
        `FileFormatError`: a corrupt entry; `CalibrationError`: the cameras do not belong to the keypoints and
        positions.

        Args:
            camera: 0 to 3, see `human36m_files.CAMERA_IDS`.
        """
        cam, uv = self.camera(subject, camera), self.keypoints(subject, action, camera)
        motion = self.motion(subject, action)
        frames = min(len(uv), len(motion.p_world_joint))
        p, uv, skeleton = motion.p_world_joint[:frames], uv[:frames], self.skeleton
        R = kinematics.rotations_from_positions(skeleton.parents, motion.joint_offsets, p)
        times, observed = np.arange(frames) / RATE_HZ, skeleton.orientation_observed()
        truth = PoseSequence(times, p, R, skeleton.names, orientation_observed=observed)
        seen: Array = np.asarray(np.isfinite(uv).all(axis=-1), dtype=np.float64)
        return Recording(
            name=f"{subject} {action} cam{camera}",
            keypoints=KeypointSequence(cam, truth.times, uv, seen, self.skeleton.names),
            skeleton_table=self.skeleton.name,
            joint_offsets=motion.joint_offsets,
            truth=truth,
            acknowledgement=ACKNOWLEDGEMENT,
            notes=self._remark(subject, action, camera, _reprojection(cam, truth.p_world_joint, uv)),
        )

    def _remark(self, subject: str, action: str, camera: int, error_px: Array) -> str:
        """Return a note about large reprojection errors, or raise if the camera is wrong."""
        projected = self.kind == "gt"
        limit = _LIMIT_GT_PX if projected else _LIMIT_DETECTED_PX
        median = _median(error_px)
        if median < limit:
            return ""
        what = f"{subject} {action}, camera {camera}: the truth projects {median:.1f} px beside"
        others = np.inf if projected else _median(self._other_errors(subject, action, camera))
        if others < limit:
            return (
                f"{what} the keypoints (median), that of the subject's other actions {others:.1f} px: "
                "this truth stands in the wrong place; use only errors relative to the root"
            )
        raise CalibrationError(
            f"{what} the keypoints in the median, more than {limit:g}: the cameras of "
            f"{self.path_cameras} do not belong to these keypoints ({self.path_2d}), or a unit "
            "is wrong (positions are in m, cameras in mm, keypoints in px of the whole image)"
        )

    def _other_errors(self, subject: str, action: str, camera: int) -> Array:
        """Return reprojection errors, px, in a few frames of each of the subject's other actions."""
        cam, errors = self.camera(subject, camera), [np.zeros(0)]
        for other in self.all_positions[subject]:
            if other == action:
                continue
            try:
                p = self.positions(subject, other)
                uv = self.keypoints(subject, other, camera)
            except RtofError:
                continue
            frames = min(len(p), len(uv))
            every = slice(0, frames, max(frames // _CHECKED_FRAMES, 1))
            errors.append(_reprojection(cam, p[every], uv[every]))
        return np.concatenate(errors)

    def _offsets_of(self, subject: str) -> Array:
        """Return joint offsets from all of a subject's readable actions."""
        if subject not in self._offsets:
            parts = []
            for action in self.all_positions[subject]:
                try:
                    parts.append(_whole(self.positions(subject, action)))
                except FileFormatError:
                    continue
            p = np.concatenate(parts)
            thigh = float(bone_lengths(self.skeleton, p)[self.skeleton.index("RKnee")[0]])
            low, high = _PLAUSIBLE_THIGH
            if not low < thigh < high:
                raise UnitError(
                    f"{self.path_3d}: {subject}: the right thigh is {thigh:.3g} m long; positions must be in metres"
                )
            self._offsets[subject] = measured_offsets(self.skeleton, p)
        return self._offsets[subject]


def _whole(p: Array) -> Array:
    """Return the frames (T, J, 3) in which all joints are finite."""
    return np.asarray(p[np.isfinite(p).all(axis=(1, 2))])


def _reprojection(camera: Camera, p: Array, uv_px: Array) -> Array:
    """Return reprojection errors, px, where joints and keypoints are known."""
    error_px = np.linalg.norm(camera.project(p) - uv_px, axis=-1)
    return np.asarray(error_px[np.isfinite(error_px)])


def _median(values: Array) -> float:
    """Return the median; infinity for no values."""
    return float(np.median(values)) if len(values) else np.inf


# --- the body ------------------------------------------------------------------------------------


def bone_lengths(skeleton: SkeletonModel, p_world_joint: Array) -> Array:
    """Return the median distance (J,) of finite joints (T, J, 3) from their parents, m, 0 for the root."""
    parents = np.maximum(skeleton.parents, 0)
    distance = np.linalg.norm(p_world_joint - p_world_joint[:, parents], axis=-1)
    return np.asarray(np.median(distance, axis=0))


def measured_offsets(skeleton: SkeletonModel, p_world_joint: Array) -> Array:
    """Return the subject's joint offsets (J, 3) in the parents' link frames, m, from finite joints
    (T, J, 3); 0 for the root.

    Each bone has its median length. A segment with one child has the direction of the table. For one with several
    (pelvis, thorax) the directions are those of the mean shape of its children: a Procrustes analysis over the frames,
    without scale (Gower 1975), in axes nearest to the table's. `InvalidInputError`: a bone has no length.
    """
    lengths = bone_lengths(skeleton, p_world_joint)
    named = dict(zip(skeleton.names[1:], lengths[1:].tolist(), strict=True))
    offsets = np.array(skeleton.with_bone_lengths(named).joint_offsets)
    p = p_world_joint[:: -(-len(p_world_joint) // _FRAMES)]
    for joint in range(len(skeleton.names)):
        children = kinematics.children_of(skeleton.parents, joint)
        if len(children) > 1:
            bones = p[:, children] - p[:, [joint]]
            offsets[children] = _mean_shape(bones, offsets[children])
    return offsets


def _mean_shape(bones: Array, table: Array) -> Array:
    """Return directions of bones (T, C, 3) in common axes, near those of a table (C, 3), with its lengths."""
    lengths = np.linalg.norm(table, axis=-1, keepdims=True)
    shape = table
    for _ in range(_ROUNDS):
        R = so3.nearest_rotation(np.einsum("tci,cj->tij", bones, shape))
        turned = np.einsum("tji,tcj->tci", R, bones)
        before, shape = shape, lengths * so3.unit(np.median(turned, axis=0))
        if np.abs(shape - before).max() < _CONVERGED:
            break
    to_table = so3.nearest_rotation(np.einsum("ci,cj->ij", table, shape))
    return np.asarray(shape @ to_table.T)
