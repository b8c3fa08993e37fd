"""`SkeletonModel`: skeleton in Pinocchio with vectorised forward and inverse kinematics.

A configuration q is Pinocchio's: root position (3), root quaternion x y z w (4), then one angle per revolute
in the order of `SkeletonModel.dof_names`. Positions are in world, m; angles in radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import NeutralPosture, PosePrior
from rtof_kin.body.skeleton_table import ImageShifts, SkeletonTable
from rtof_kin.body.urdf import pin, read_urdf, to_urdf
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.packages import optional
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.corrections import Correction
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.poses import PoseSequence, Provenance


@dataclass(frozen=True)
class ConfigurationReport:
    """Singular postures and limit violations of configurations, which are never clipped."""

    singular: Mask  #: (T, J) True if a ball joint is within 5 degrees of a singular posture
    limit_excess: Array  #: (T, D) excess of each revolute beyond its limits, rad; 0 inside
    dof_names: tuple[str, ...]  #: Names of the D revolutes


SINGULAR_MARGIN = np.radians(5.0)  # of a middle angle from +-90 degrees; closer postures are singular


@dataclass(frozen=True)
class Motion:
    """Motion of a skeleton: configurations and their forward kinematics."""

    skeleton: SkeletonModel
    q: Array  #: (T, nq), continuous over time
    poses: PoseSequence  #: Forward kinematics of q, with validity and provenance
    report: ConfigurationReport  #: Singular postures and limit violations
    confidence: Confidence | None = None  #: Covariances, if estimated
    corrections: tuple[Correction, ...] = ()  #: By hand, of the recording: gait events and repetitions among them

    def __post_init__(self) -> None:
        known, poses = self.confidence, self.poses
        if known and not (known.names == poses.names and np.array_equal(known.times, poses.times)):
            raise InvalidInputError("motion: its confidence is of other joints or other times")

    def __getitem__(self, frames: slice) -> Motion:
        singular, excess = self.report.singular[frames], self.report.limit_excess[frames]
        report = replace(self.report, singular=singular, limit_excess=excess)
        confidence = None if self.confidence is None else self.confidence[frames]
        return replace(self, q=self.q[frames], poses=self.poses[frames], report=report, confidence=confidence)

    @classmethod
    def load(cls, folder: str | Path, start: int | None = None, stop: int | None = None) -> Motion:
        """Read a motion, or frames [start, stop) of it. `FileFormatError`: missing, damaged, of a newer schema, or not
        a motion; `InvalidInputError`: no such frames.

        Args:
            folder: output of `reconstruct` or `run`, or the file in it.
        """
        from rtof_kin.body.motion_file import MotionReader

        with MotionReader(folder) as file:
            return file.read(start, stop)

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` (extra ``connect``) of positions and rotations in world and angles of revolutes,
        standard deviations where there is a confidence, and what was observed; units and frames are attributes.
        """
        from rtof_kin.body.observability import observed_dofs  # which imports this module

        poses, known, joint = self.poses, self.confidence, ("time", "joint")
        flags = {"flag_values": list(map(int, Provenance)), "flag_meanings": " ".join(one.name for one in Provenance)}
        arrays = {
            "position": ((*joint, "xyz"), poses.p_world_joint, {"units": "m", "frame": "world"}),
            "rotation": ((*joint, "xyz", "bone_xyz"), poses.R_world_bone, {"units": "1", "frame": "world"}),
            "angle": (("time", "dof"), self.q[:, 7:], {"units": "rad", "frame": "joint, zero in the T-pose"}),
            "position_valid": (joint, poses.valid),
            "provenance": (joint, poses.provenance, flags),
            "angle_observed": (("time", "dof"), observed_dofs(self)),
            "rotation_observed": (joint, np.broadcast_to(poses.orientation_observed, poses.valid.shape)),
        }
        if known is not None:
            variance = np.diagonal(known.position_covariance, axis1=2, axis2=3)
            arrays["position_sigma"] = ((*joint, "xyz"), np.sqrt(variance), {"units": "m", "frame": "world"})
            arrays["rotation_sigma"] = (joint, known.orientation_sigma, {"units": "rad", "frame": "world, per axis"})
        names = {"joint": list(poses.names), "dof": list(self.skeleton.dof_names), "xyz": [*"xyz"]}
        coordinates = {"time": ("time", self.times, {"units": "s"}), **names, "bone_xyz": [*"xyz"]}
        about = {"skeleton": self.skeleton.name, "world": "z up, m"}
        return optional("xarray", "connect", "to_xarray").Dataset(arrays, coordinates, about)

    def show(self) -> Any:
        """Return the value of a notebook's cell that plays the motion (extra ``view``), thinned out if it is long."""
        return import_module("rtof_kin.view.static_page").notebook_page(self)  # this folder imports none above it

    @property
    def times(self) -> Array:
        """(T,) seconds."""
        return self.poses.times


class SkeletonModel:
    """A human skeleton as an immutable free-floating tree of ball joints.

    Attributes:
        table: skeleton table. name: e.g. 'total_capture'. model: Pinocchio model (free-flyer root).
        nq, nv: length of a configuration, degrees of freedom. root: name of the root joint.
        names, parents: J joints, parents before children. joint_offsets: (J, 3) in parents' link frames, m.
        dof_names: D revolutes in the order of the configuration.
    """

    def __init__(self, table: SkeletonTable, urdf: str | None = None):
        """Build from a table; `urdf` is text to load instead of the one made from the table."""
        self.table = table
        self.name, self.names, self.parents = table.name, table.names, table.parents
        self.root = self.names[0]
        self.joint_offsets: Array = readonly("joint_offsets", table.offsets, ("J", 3))
        self.model: Any = pin.buildModelFromXML(urdf or to_urdf(table), pin.JointModelFreeFlyer())
        self.model.gravity.linear = GRAVITY_WORLD
        self.nq, self.nv = int(self.model.nq), int(self.model.nv)
        self.dof_names = tuple(str(n) for n in self.model.names if n not in ("universe", "root_joint"))
        expected = {dof.urdf for joint in table.joints for dof in joint.dofs}
        if odd := sorted(expected ^ set(self.dof_names)):
            raise InvalidInputError(f"URDF and skeleton table differ in the joints {', '.join(odd)}")
        index = [[7 + self.dof_names.index(d.urdf) for d in j.dofs] for j in table.joints[1:]]
        self._q_index = np.array(index).reshape(-1, 3)

    @classmethod
    @cache
    def default(cls) -> SkeletonModel:
        """Load the 21-joint Total Capture skeleton, ``models/skeleton.urdf``."""
        return cls.from_urdf(model_path("skeleton.urdf"))

    @classmethod
    @cache
    def human36m(cls) -> SkeletonModel:
        """Load the 17-joint Human3.6M skeleton, ``models/human36m.urdf``."""
        return cls.from_urdf(model_path("human36m.urdf"), model_path("human36m.toml"))

    @classmethod
    def named(cls, name: str) -> SkeletonModel:
        """Load a shipped skeleton, 'total_capture' or 'human36m'; `UnknownNameError` for another name."""
        shipped = {"total_capture": cls.default, "human36m": cls.human36m}
        if name not in shipped:
            raise UnknownNameError("skeleton", [name], list(shipped))
        return shipped[name]()

    @classmethod
    def from_urdf(cls, path: str | Path, table: str | Path | None = None) -> SkeletonModel:
        """Load a URDF written by this package (shipped or personalised).

        Bone offsets, limits and inertias are those of the file, everything else is that of the table.
        `FileFormatError`: not a URDF of this skeleton.

        Args:
            table: its skeleton table; default: the 21-joint table.
        """
        return cls(*read_urdf(path, table or model_path("skeleton.toml")))

    @cached_property
    def limits(self) -> Array:
        """Lower and upper limits (D, 2) of the revolutes, rad."""
        return np.stack([self.model.lowerPositionLimit[7:], self.model.upperPositionLimit[7:]], -1)

    def bone_axis(self, joint: str) -> Array:
        """Return the unit direction (3,) of a segment's bone in its frame; 0 for several bones or none."""
        children = kinematics.children_of(self.parents, self.names.index(joint))
        return np.asarray(so3.unit(self.joint_offsets[children[0]]) if len(children) == 1 else np.zeros(3))

    @cached_property
    def bone_lengths(self) -> dict[str, float]:
        """Distance of each joint from its parent, m, by child joint."""
        lengths = np.linalg.norm(self.joint_offsets, axis=1)
        return dict(zip(self.names[1:], lengths[1:].tolist(), strict=True))

    @cached_property
    def landmarks(self) -> dict[str, tuple[str, Array]]:
        """Joint and offset (3,) in its link frame, m, of each landmark; joints are landmarks."""
        own = {name: (name, np.zeros(3)) for name in self.names}
        return own | {point.name: (point.joint, point.offset) for point in self.table.landmarks}

    @cached_property
    def sensors(self) -> dict[str, tuple[str, Array]]:
        """Joint of the segment and lever arm (3,) in its link frame, m, of each usual sensor."""
        return {point.name: (point.joint, point.offset) for point in self.table.sensors}

    @cached_property
    def height(self) -> float:
        """Standing height, m, from the lowest to the highest landmark in the T-pose."""
        p, R = self.forward_kinematics(self.t_pose()[None])
        z = self.landmark_positions(p, R)[0, :, 2]
        return float(z.max() - z.min())

    def index(self, *names: str) -> list[int]:
        """Return indices of joints; raise `UnknownNameError` for unknown names."""
        return indices_of("joint", names, self.names)

    def check_joints(self, names: tuple[str, ...], what: str = "poses") -> None:
        """Check that names are all joints of this skeleton in its order; `UnknownNameError` for an unknown joint,
        `InvalidInputError` for missing joints or another order.
        """
        if names != self.names:
            self.index(*names)
            raise InvalidInputError(f"{what}: need all joints, in this order: {', '.join(self.names)}")

    # --- other bodies ----------------------------------------------------------------------------

    def with_offsets(self, offsets: ArrayLike | Mapping[str, ArrayLike]) -> SkeletonModel:
        """Return the skeleton with other joint offsets. `InvalidInputError`, `UnknownNameError`: wrong shape, not
        finite, zero length, an unknown joint.

        Args:
            offsets: (J, 3) in the parents' link frames, m (the root's row is ignored), or (3,) by joint name.
        """
        new = np.array(self.joint_offsets)
        if isinstance(offsets, Mapping):
            for index, value in zip(self.index(*offsets), offsets.values(), strict=True):
                new[index] = readonly("joint offset", value, (3,))
        else:
            new = np.array(readonly("joint_offsets", offsets, (len(self.names), 3)))
        new[0] = 0.0
        missing = np.flatnonzero(~np.isfinite(new).all(axis=1))
        if len(missing):
            bad = self.names[missing[0]]
            raise InvalidInputError(f"joint_offsets: the offset of {bad} is not finite")
        short = np.flatnonzero(np.linalg.norm(new[1:], axis=1) < 1e-4)
        if len(short):
            bad = self.names[1 + short[0]]
            raise InvalidInputError(f"joint_offsets: the bone that ends at {bad} has no length")
        return SkeletonModel(self.table.scaled_to(new))

    def with_bone_lengths(self, lengths: Mapping[str, float]) -> SkeletonModel:
        """Return the skeleton with other bone lengths. `InvalidInputError`, `UnknownNameError`: a length is not
        positive, or an unknown joint.

        Args:
            lengths: distance from the parent by child joint, m (``{"LeftLeg": 0.41}`` is the thigh).
        """
        for name, length in lengths.items():
            if name not in self.bone_lengths:
                raise UnknownNameError("bone", [name], list(self.bone_lengths))
            if not (np.isfinite(length) and length > 0):
                raise InvalidInputError(f"bone length of {name}: {length} m is not a positive length")
        return self.with_offsets(
            {
                n: self.joint_offsets[self.names.index(n)] * (length / self.bone_lengths[n])
                for n, length in lengths.items()
            }
        )

    def with_height(self, height: float) -> SkeletonModel:
        """Return the skeleton scaled to another standing height, m; `InvalidInputError` for no human height."""
        if not 0.4 < height < 2.6:
            raise InvalidInputError(f"height: {height} m is no human height; give metres")
        return self.with_offsets(self.joint_offsets * (height / self.height))

    def with_mass(self, mass_kg: float | None, sex: str | None = None) -> SkeletonModel:
        """Return the skeleton with another body mass, kg, and another sex, 'male' or 'female', de Leva's column, each
        unchanged if None; `InvalidInputError` for no human mass, or another sex.
        """
        if mass_kg is None and sex is None:
            return self
        mass_kg = self.table.mass_kg if mass_kg is None else mass_kg
        if not 2 < mass_kg < 500:
            raise InvalidInputError(f"mass: {mass_kg:g} kg is no person's; give kilograms")
        if sex not in (None, "male", "female"):
            raise InvalidInputError(f"sex: {sex!r} is not male, female or None")
        return SkeletonModel(replace(self.table, mass_kg=float(mass_kg), sex=sex or self.table.sex))

    def with_posture(self, posture: NeutralPosture | None) -> SkeletonModel:
        """Return the skeleton with a neutral posture. posture: of joints of this skeleton; None where it is unknown."""
        self.index(*(posture.joints if posture else ()))
        return SkeletonModel(replace(self.table, posture=posture))

    def with_image_points(self, shifts: ImageShifts) -> SkeletonModel:
        """Return the skeleton of a person whose points a detector sees elsewhere, see `ImageShifts`."""
        return SkeletonModel(replace(self.table, image_points=shifts))

    def with_prior(self, prior: PosePrior) -> SkeletonModel:
        """Return the skeleton with another pose prior of all its joints than the shipped one."""
        self.check_joints(prior.joints, "pose prior")
        return SkeletonModel(replace(self.table, model_prior=prior))

    def to_urdf(self) -> str:
        """Return the URDF of this body."""
        return to_urdf(self.table)

    def t_pose(self) -> Array:
        """Return the T-pose (nq,): arms sideways, facing world x, root at the origin, all angles zero."""
        return np.array(pin.neutral(self.model))

    def n_pose(self) -> Array:
        """Return the N-pose (nq,): arms hanging, facing world x, root at the origin."""
        q = self.t_pose()
        for dof, angle in self.table.n_pose.items():
            q[7 + self.dof_names.index(dof)] = angle
        return q

    # --- kinematics ------------------------------------------------------------------------------

    def forward_kinematics(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return p_world_joint (T, J, 3), m, and R_world_bone (T, J, 3, 3) of configurations.

        Args:
            q: (T, nq); NaN rows give NaN poses.
        """
        rows: Array = readonly("q", q, ("T", self.nq))
        quat = rows[:, 3:7]
        norm = np.linalg.norm(quat, axis=1)
        wrong = np.flatnonzero(np.abs(norm - 1) > 1e-3)
        if len(wrong):
            bad = wrong[0]
            raise InvalidInputError(f"q: the root quaternion (x y z w) of frame {bad} has norm {norm[bad]:g}")
        R_local = np.full((len(rows), len(self.names), 3, 3), np.nan)
        known = np.isfinite(rows).all(axis=1)
        R_local[known, 0] = Rotation.from_quat(quat[known]).as_matrix()
        angles = rows[:, self._q_index]
        for order, joints in self._joints_by_axes.items():
            R_local[:, joints] = so3.euler_to_matrix(order, angles[:, np.array(joints) - 1])
        R = kinematics.world_rotations(self.parents, R_local)
        return kinematics.positions(self.parents, self.joint_offsets, rows[:, :3], R), R

    def inverse_kinematics(self, p: ArrayLike, R: ArrayLike | None = None) -> Array:
        """Return configurations (T, nq) of poses; angles and root quaternion are continuous over time.

        Root position and segment orientations determine q, so forward kinematics returns p only if p has the
        bone lengths of this skeleton. Near a singular posture the outer angles may change fast; `check` flags
        this and limit violations; nothing is clipped.

        Args:
            p: (T, J, 3) m; only the root's is used if R is given.
            R: (T, J, 3, 3) R_world_bone; default: `kinematics.rotations_from_positions`. Frames with NaN in
                what is used give NaN rows.
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
            raise InvalidInputError("R: contains a matrix that is not a rotation")
        R_local = kinematics.local_rotations(self.parents, R_world_bone[known])
        rows = np.empty((int(known.sum()), self.nq))
        rows[:, :3] = points[known, 0]
        rows[:, 3:7] = np.roll(so3.to_quat_wxyz(R_local[:, 0]), -1, axis=-1)
        for order, joints in self._joints_by_axes.items():
            angles = so3.euler_continuous(so3.matrix_to_euler(order, R_local[:, joints]))
            rows[:, self._q_index[np.array(joints) - 1]] = angles
        q[known] = rows
        return q

    def angles(self, q: Array) -> Array:
        """Return the angles (T, D) of configurations (T, nq), rad, nearest to the middle of the limits."""
        angles, index = np.empty((len(q), len(self.dof_names))), self._q_index - 7
        angles[:, index] = so3.euler_near(q[:, self._q_index], self.limits.mean(axis=1)[index])
        return angles

    def check(self, q: ArrayLike) -> ConfigurationReport:
        """Check configurations for singular postures and limit violations of `angles`. q: (T, nq)."""
        rows: Array = readonly("q", q, ("T", self.nq))
        singular: Mask = np.zeros((len(rows), len(self.names)), dtype=np.bool_)
        middle = rows[:, self._q_index[:, 1]]
        singular[:, 1:] = np.abs(np.cos(middle)) < np.sin(SINGULAR_MARGIN)
        angles = self.angles(rows)
        excess = np.maximum(np.maximum(self.limits[:, 0] - angles, angles - self.limits[:, 1]), 0.0)
        return ConfigurationReport(singular, excess, self.dof_names)

    def motion(self, poses: PoseSequence, confidence: Confidence | None = None) -> Motion:
        """Return the motion of this skeleton with the root positions and the orientations of poses."""
        self.check_joints(poses.names)
        q = self.inverse_kinematics(poses.p_world_joint, poses.R_world_bone)
        p, R = self.forward_kinematics(q)
        return Motion(self, q, replace(poses, p_world_joint=p, R_world_bone=R), self.check(q), confidence)

    def landmark_positions(self, p: Array, R: Array) -> Array:
        """Return landmark positions (T, L, 3) in world, m, in the order of `landmarks`.

        Args:
            p: (T, J, 3) m. R: (T, J, 3, 3) R_world_bone.
        """
        joints = self.index(*(joint for joint, _ in self.landmarks.values()))
        offsets = np.array([offset for _, offset in self.landmarks.values()])
        return np.asarray(p[:, joints] + np.einsum("tlij,lj->tli", R[:, joints], offsets))

    def orientation_observed(self, sensor_joints: tuple[str, ...] = ()) -> Mask:
        """Return a mask (J,) of segments whose three angles follow from joint positions and sensors."""
        count = np.bincount([p for p in self.parents if p >= 0], minlength=len(self.names))
        count[self.index(*sensor_joints)] = 2
        return np.asarray(count > 1)

    @cached_property
    def _joints_by_axes(self) -> dict[str, list[int]]:
        groups: dict[str, list[int]] = {}
        for i, joint in enumerate(self.table.joints[1:], start=1):
            groups.setdefault(joint.axes, []).append(i)
        return groups


@lru_cache(maxsize=8)
def known_body(name: str, offsets: bytes, mass_kg: float | None = None, sex: str | None = None) -> SkeletonModel:
    """Return a shipped skeleton of a person; the last ones are kept, as one takes a tenth of a second.

    Args:
        name: see `SkeletonModel.named`. offsets: (J, 3) float64, m, as bytes. mass_kg, sex: as for
            `SkeletonModel.with_mass`.
    """
    body = SkeletonModel.named(name).with_offsets(np.frombuffer(offsets).reshape(-1, 3))
    return body.with_mass(mass_kg, sex)
