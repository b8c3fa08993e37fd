"""`SkeletonModel`: the URDF in Pinocchio, with vectorised forward and inverse kinematics.

A configuration q is Pinocchio's: root position (3), root quaternion x y z w (4), then one angle per
revolute in the order of `SkeletonModel.dof_names`. Positions are in world, m; angles in radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton_table import SkeletonTable, read_skeleton_table
from rtof_kin.body.urdf import to_urdf
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.core.files.text import read_text
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
_LARGEST_URDF = 16 * 2**20
SINGULAR_MARGIN = np.radians(5.0)
"""A posture this near to a middle angle of +-90 degrees is flagged as singular."""


@dataclass(frozen=True)
class ConfigurationReport:
    """What there is to say about configurations: nothing is clipped, all of it is reported."""

    singular: NDArray[np.bool_]
    """(T, J) whether a ball joint is within 5 degrees of a singular posture of its three angles."""
    limit_excess: Array
    """(T, D) radians by which each revolute exceeds its limits; 0 inside."""
    dof_names: tuple[str, ...]
    """D names of the revolutes."""

    @property
    def violations(self) -> dict[str, float]:
        """Largest excess in radians of each revolute that leaves its limits anywhere."""
        worst = np.nanmax(self.limit_excess, axis=0, initial=0)
        return {n: float(w) for n, w in zip(self.dof_names, worst, strict=True) if w > 0}


@dataclass(frozen=True)
class MotionSequence:
    """A motion of a skeleton: configurations, and the poses they are the kinematics of."""

    skeleton: SkeletonModel
    q: Array
    """(T, nq) configurations, continuous over time."""
    poses: PoseSequence
    """Forward kinematics of q, with validity and provenance."""
    report: ConfigurationReport
    """Singular postures and limit violations."""
    confidence: Confidence | None = None
    """How well it is known, where that is known at all."""

    def __post_init__(self) -> None:
        confidence, poses = self.confidence, self.poses
        if confidence is None:
            return
        if confidence.names != poses.names or not np.array_equal(confidence.times, poses.times):
            raise ShapeError("motion: its confidence is of other joints or other times")

    def __getitem__(self, frames: slice) -> MotionSequence:
        report = replace(
            self.report, singular=self.report.singular[frames], limit_excess=self.report.limit_excess[frames]
        )
        confidence = None if self.confidence is None else self.confidence[frames]
        return replace(self, q=self.q[frames], poses=self.poses[frames], report=report, confidence=confidence)

    @property
    def times(self) -> Array:
        """(T,) seconds."""
        return self.poses.times


class SkeletonModel:
    """A human skeleton as a free-floating tree of ball joints, immutable.

    Attributes:
        table: the facts it is made from. model: the Pinocchio model (free-flyer root).
        names, parents: J joints, parents before children. joint_offsets: (J, 3) m.
    """

    def __init__(self, table: SkeletonTable, urdf: str | None = None):
        """Build from a table; `urdf` is the text to load instead of the one the table makes."""
        self.table = table
        self.names, self.parents = table.names, table.parents
        self.joint_offsets: Array = readonly("joint_offsets", table.offsets, ("J", 3))
        self.model: Any = pin.buildModelFromXML(urdf or to_urdf(table), pin.JointModelFreeFlyer())
        self.model.gravity.linear = GRAVITY_WORLD
        revolutes = [name for name in self.model.names if name not in ("universe", "root_joint")]
        self.dof_names: tuple[str, ...] = tuple(revolutes)
        expected = [dof.urdf for joint in table.joints for dof in joint.dofs]
        if sorted(expected) != sorted(revolutes):
            odd = sorted(set(expected) ^ set(revolutes))
            raise ShapeError(f"URDF and skeleton table differ in the joints {', '.join(odd)}")
        self._q_index = np.array([[7 + revolutes.index(d.urdf) for d in j.dofs]
                                  for j in table.joints[1:]]).reshape(-1, 3)  # fmt: skip

    @classmethod
    def default(cls) -> SkeletonModel:
        """The 21-joint Total Capture skeleton of ``models/skeleton.urdf``."""
        return cls.from_urdf(model_path("skeleton.urdf"))

    @classmethod
    def human36m(cls) -> SkeletonModel:
        """Human3.6M's 17 joints, from ``models/human36m.urdf``."""
        return cls.from_urdf(model_path("human36m.urdf"), model_path("human36m.toml"))

    @classmethod
    def named(cls, name: str) -> SkeletonModel:
        """A shipped skeleton by its table's name: 'total_capture' or 'human36m'."""
        shipped = {"total_capture": cls.default, "human36m": cls.human36m}
        if name not in shipped:
            raise UnknownNameError("skeleton", [name], list(shipped))
        return shipped[name]()

    @classmethod
    def from_urdf(cls, path: str | Path, table: str | Path | None = None) -> SkeletonModel:
        """Load a URDF that this package wrote (shipped or personalised).

        Bone offsets, limits and inertias are the file's, everything else the table's.

        Args:
            path: the URDF. table: its skeleton table; the 21-joint one where not given.

        Raises:
            FileFormatError: not a URDF, or not one of this skeleton.
        """
        facts = read_skeleton_table(table or model_path("skeleton.toml"))
        text = read_text(path, "a URDF", _LARGEST_URDF)
        try:
            loaded = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        except (ValueError, RuntimeError) as error:
            raise FileFormatError(path, f"not a readable URDF: {error}") from error
        offsets = np.zeros_like(facts.offsets)
        for i, joint in enumerate(facts.joints[1:], start=1):
            if not loaded.existJointName(joint.dofs[0].urdf):
                raise FileFormatError(path, f"there is no joint {joint.dofs[0].urdf} in it")
            index = loaded.getJointId(joint.dofs[0].urdf)
            offsets[i] = loaded.jointPlacements[index].translation
        if not np.allclose(offsets, facts.offsets, atol=1e-12):
            facts = facts.scaled_to(offsets)
        own = cls(facts).model
        for name in loaded.names[1:]:
            if not _same_joint(name, loaded, own):
                raise FileFormatError(
                    path,
                    f"the joint {name} has another parent, place or axis than in the skeleton table; "
                    "give the table that this URDF was made from",
                )
        return cls(facts, text)

    # --- names and sizes -------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the skeleton, e.g. 'total_capture'."""
        return self.table.name

    @property
    def nq(self) -> int:
        """Length of a configuration."""
        return int(self.model.nq)

    @property
    def nv(self) -> int:
        """Degrees of freedom."""
        return int(self.model.nv)

    @property
    def root(self) -> str:
        """Name of the root joint."""
        return self.names[0]

    @cached_property
    def limits(self) -> Array:
        """(D, 2) radians, lower and upper limit of each revolute in the order of `dof_names`."""
        return np.stack([self.model.lowerPositionLimit[7:], self.model.upperPositionLimit[7:]], -1)

    @cached_property
    def bone_lengths(self) -> dict[str, float]:
        """Distance of each joint from its parent, m, by the name of the child joint."""
        lengths = np.linalg.norm(self.joint_offsets, axis=1)
        return dict(zip(self.names[1:], lengths[1:].tolist(), strict=True))

    @cached_property
    def landmarks(self) -> dict[str, tuple[str, Array]]:
        """Landmark name -> (joint, offset in its link frame (3,), m); every joint is one too."""
        own = {name: (name, np.zeros(3)) for name in self.names}
        return own | {point.name: (point.joint, point.offset) for point in self.table.landmarks}

    @cached_property
    def sensors(self) -> dict[str, tuple[str, Array]]:
        """Usual sensor name -> (joint whose segment carries it, lever arm in its frame (3,), m)."""
        return {point.name: (point.joint, point.offset) for point in self.table.sensors}

    @cached_property
    def height(self) -> float:
        """Standing height in the T-pose, m, between the lowest and the highest landmark."""
        p, R = self.forward_kinematics(self.t_pose()[None])
        z = self.landmark_positions(p, R)[0, :, 2]
        return float(z.max() - z.min())

    def index(self, *names: str) -> list[int]:
        """Indices of joints by name; raises `UnknownNameError`."""
        return indices_of("joint", names, self.names)

    def check_joints(self, names: tuple[str, ...], what: str = "poses") -> None:
        """Check that names are all joints of this skeleton, in its order.

        Raises:
            UnknownNameError: it has no such joint. ShapeError: some are missing, or the order differs.
        """
        if names != self.names:
            self.index(*names)
            raise ShapeError(f"{what}: need all joints, in this order: {', '.join(self.names)}")

    # --- other bodies ----------------------------------------------------------------------------

    def with_offsets(self, offsets: ArrayLike | Mapping[str, ArrayLike]) -> SkeletonModel:
        """The same skeleton with other joint offsets.

        Args:
            offsets: (J, 3) m in the parents' link frames (the root's row is ignored), or a mapping from
                joint name to (3,) for some of them.

        Raises:
            ShapeError, UnknownNameError: wrong shape, not finite, a bone of no length, an unknown joint.
        """
        new = np.array(self.joint_offsets)
        if isinstance(offsets, Mapping):
            for index, value in zip(self.index(*offsets), offsets.values(), strict=True):
                new[index] = readonly("joint offset", value, (3,))
        else:
            new = np.array(readonly("joint_offsets", offsets, (len(self.names), 3)))
        new[0] = 0.0
        if not np.all(np.isfinite(new)):
            bad = self.names[int(np.flatnonzero(~np.isfinite(new).all(axis=1))[0])]
            raise ShapeError(f"joint_offsets: the offset of {bad} is not finite")
        short = np.linalg.norm(new[1:], axis=1) < 1e-4
        if np.any(short):
            bad = self.names[1 + int(np.flatnonzero(short)[0])]
            raise ShapeError(f"joint_offsets: the bone that ends at {bad} has no length")
        return SkeletonModel(self.table.scaled_to(new))

    def with_bone_lengths(self, lengths: Mapping[str, float]) -> SkeletonModel:
        """The same skeleton with some bones longer or shorter, directions kept.

        Args:
            lengths: child joint -> distance from its parent, m (``{"LeftLeg": 0.41}`` is the thigh).
        """
        for name, length in lengths.items():
            if name not in self.bone_lengths:
                raise UnknownNameError("bone", [name], list(self.bone_lengths))
            if not (np.isfinite(length) and length > 0):
                raise ShapeError(f"bone length of {name}: {length} m is not a positive length")
        return self.with_offsets(
            {n: self.joint_offsets[self.names.index(n)] * (length / self.bone_lengths[n])
             for n, length in lengths.items()}
        )  # fmt: skip

    def with_height(self, height: float) -> SkeletonModel:
        """The same proportions at another standing height, m."""
        if not 0.4 < height < 2.6:
            raise ShapeError(f"height: {height} m is no human height; give metres")
        return self.with_offsets(self.joint_offsets * (height / self.height))

    def with_mass(self, mass_kg: float, sex: str | None = None) -> SkeletonModel:
        """The same skeleton with another body mass, kg; de Leva's column ('male', 'female') as it was
        where not given.
        """
        if not 2 < mass_kg < 500:
            raise ShapeError(f"mass: {mass_kg:g} kg is no person's; give kilograms")
        if sex not in (None, "male", "female"):
            raise ShapeError(f"sex: {sex!r} is not male, female or None")
        return SkeletonModel(replace(self.table, mass_kg=float(mass_kg), sex=sex or self.table.sex))

    def to_urdf(self) -> str:
        """The URDF of this body as XML text."""
        return to_urdf(self.table)

    # --- named poses -----------------------------------------------------------------------------

    def t_pose(self) -> Array:
        """(nq,) arms sideways, facing world x, root at the origin; every angle is zero."""
        return np.array(pin.neutral(self.model))

    def n_pose(self) -> Array:
        """(nq,) arms hanging, facing world x, root at the origin."""
        q = self.t_pose()
        for dof, angle in self.table.n_pose.items():
            q[7 + self.dof_names.index(dof)] = angle
        return q

    # --- kinematics ------------------------------------------------------------------------------

    def forward_kinematics(self, q: ArrayLike) -> tuple[Array, Array]:
        """Joint positions and segment orientations of configurations.

        Args:
            q: (T, nq); NaN rows give NaN poses.

        Returns:
            p_world_joint (T, J, 3) m and R_world_bone (T, J, 3, 3).
        """
        rows: Array = readonly("q", q, ("T", self.nq))
        quat = rows[:, 3:7]
        norm = np.linalg.norm(quat, axis=1)
        if np.any(np.abs(norm - 1) > 1e-3):
            bad = int(np.flatnonzero(np.abs(norm - 1) > 1e-3)[0])
            raise ShapeError(f"q: the root quaternion (x y z w) of frame {bad} has norm {norm[bad]:g}")
        R_local = np.full((len(rows), len(self.names), 3, 3), np.nan)
        known = np.isfinite(rows).all(axis=1)
        R_local[known, 0] = Rotation.from_quat(quat[known]).as_matrix()
        angles = rows[:, self._q_index]
        for order, joints in self._joints_by_axes.items():
            R_local[:, joints] = so3.euler_to_matrix(order, angles[:, np.array(joints) - 1])
        R = kinematics.world_rotations(self.parents, R_local)
        return kinematics.positions(self.parents, self.joint_offsets, rows[:, :3], R), R

    def inverse_kinematics(self, p: ArrayLike, R: ArrayLike | None = None) -> Array:
        """Configurations of poses, on the branch of the angles nearest to the frame before.

        The root position and the segment orientations determine q; bone lengths are the model's, so
        the forward kinematics of q equals p where p has this skeleton's offsets. Without R,
        orientations come from the positions (`kinematics.rotations_from_positions`): twist of
        one-child segments and leaves follows the parent, see `orientation_observed`. Near a singular
        posture the outer angles may turn fast; `check` flags it, and limits, and nothing is clipped.

        Args:
            p: (T, J, 3) m; of use is the root's alone where R is given.
            R: (T, J, 3, 3) R_world_bone. Frames with a NaN in what is used give NaN rows.

        Returns:
            (T, nq), angles and root quaternion continuous over time.
        """
        J = len(self.names)
        points: Array = readonly("p", p, ("T", J, 3))
        if R is None:
            R = kinematics.rotations_from_positions(self.parents, self.joint_offsets, points)
        R_world_bone: Array = readonly("R", R, (len(points), J, 3, 3))
        q = np.full((len(points), self.nq), np.nan)
        known = np.isfinite(points[:, 0]).all(axis=1) & np.isfinite(R_world_bone).all(axis=(1, 2, 3))
        if not known.any():
            return q
        if not so3.is_rotation(R_world_bone[known], tolerance=1e-5):
            raise ShapeError("R: holds a matrix that is not a rotation")
        R_local = kinematics.local_rotations(self.parents, R_world_bone[known])
        rows = np.empty((int(known.sum()), self.nq))
        rows[:, :3] = points[known, 0]
        rows[:, 3:7] = np.roll(so3.to_quat_wxyz(R_local[:, 0]), -1, axis=-1)
        for order, joints in self._joints_by_axes.items():
            angles = so3.euler_continuous(so3.matrix_to_euler(order, R_local[:, joints]))
            rows[:, self._q_index[np.array(joints) - 1]] = angles
        q[known] = rows
        return q

    def check(self, q: ArrayLike) -> ConfigurationReport:
        """Singular postures and limit violations of configurations (T, nq).

        A joint that came round by a whole turn, or to the other branch of its angles, is judged by the
        posture it is in.
        """
        rows: Array = readonly("q", q, ("T", self.nq))
        singular: NDArray[np.bool_] = np.zeros((len(rows), len(self.names)), dtype=np.bool_)
        middle = rows[:, self._q_index[:, 1]]
        singular[:, 1:] = np.abs(np.cos(middle)) < np.sin(SINGULAR_MARGIN)
        # Limits are about postures: of the names a rotation has, the one nearest to their middle.
        index = self._q_index - 7
        angles = np.empty((len(rows), len(self.dof_names)))
        middle_of_limits = self.limits.mean(axis=1)
        angles[:, index] = so3.euler_near(rows[:, self._q_index], middle_of_limits[index])
        excess = np.maximum(np.maximum(self.limits[:, 0] - angles, angles - self.limits[:, 1]), 0.0)
        return ConfigurationReport(singular, excess, self.dof_names)

    def motion(self, poses: PoseSequence, confidence: Confidence | None = None) -> MotionSequence:
        """The motion of this skeleton that poses describe; their positions become its own.

        The root follows the poses' root; every other joint stands where this skeleton's bones put it.
        """
        self.check_joints(poses.names)
        q = self.inverse_kinematics(poses.p_world_joint, poses.R_world_bone)
        p, R = self.forward_kinematics(q)
        return MotionSequence(
            self, q, replace(poses, p_world_joint=p, R_world_bone=R), self.check(q), confidence
        )

    def landmark_positions(self, p: Array, R: Array) -> Array:
        """Landmarks (T, L, 3) in world, in the order of `landmarks`, of joints p and orientations R."""
        joints = self.index(*(joint for joint, _ in self.landmarks.values()))
        offsets = np.array([offset for _, offset in self.landmarks.values()])
        return np.asarray(p[:, joints] + np.einsum("tlij,lj->tli", R[:, joints], offsets))

    def orientation_observed(self, sensor_joints: tuple[str, ...] = ()) -> NDArray[np.bool_]:
        """(J,) whether positions (and sensors on the segments named) fix a segment's three angles."""
        count = np.bincount([p for p in self.parents if p >= 0], minlength=len(self.names))
        observed = count > 1
        observed[self.index(*sensor_joints)] = True
        return np.asarray(observed)

    @cached_property
    def _joints_by_axes(self) -> dict[str, list[int]]:
        groups: dict[str, list[int]] = {}
        for i, joint in enumerate(self.table.joints[1:], start=1):
            groups.setdefault(joint.axes, []).append(i)
        return groups


def _same_joint(name: str, a: Any, b: Any) -> bool:
    """Whether two Pinocchio models have the same joint of that name."""
    if not b.existJointName(name):
        return False
    i, j = a.getJointId(name), b.getJointId(name)
    return bool(
        a.names[a.parents[i]] == b.names[b.parents[j]]
        and a.joints[i].shortname() == b.joints[j].shortname()
        and a.jointPlacements[i].isApprox(b.jointPlacements[j], 1e-9)
    )
