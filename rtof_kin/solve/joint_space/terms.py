"""The built-in terms of the joint-space energy; see `rtof_kin.solve.terms.Term`.

Each class has its symbols, residual, loss, unit and data. The fields are indices of the skeleton's segments and joints.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import LIMBS, bare, both_bones_sensed
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.packages import casadi as ca
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.inertial.root_path import FEET, ContactPoints, detect_contacts
from rtof_kin.solve import terms as residuals
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.terms import Matrix, Shapes, Term, cauchy_loss, cut_off_loss, pseudo_huber_loss
from rtof_kin.vision.image_points import ImagePoints

if TYPE_CHECKING:
    from rtof_kin.solve.joint_space.energy import Frame
    from rtof_kin.solve.joint_space.observations import Observations

TORSO: Final = ("Hips", "Spine3")  #: Pelvis and upper trunk
ANCHORED: Final = (*TORSO, "Neck", "LeftShoulder", "RightShoulder")
"""Segments whose orientation may be anchored to the initial guess: those that the head and the limbs begin at."""
BUILT_IN: Final = ("visual", "orientation", "torso", "bone", "root", "floor", "prior", "acceleration", "smooth")
"""Names of the built-in terms."""
_ROBUST_CONTACT: Final = 3.0
"""[sigma] Threshold of the pseudo-Huber loss of a contact point: contacts are inferred, not measured."""
_ROOT_BESIDE_SENSORS: Final = 2.0  #: Factor on sigma_root where there are both landmarks and sensors
_FIRM: Final = np.radians(1.0)  #: [rad] Standard deviation of the prior of a fixed joint


def built_in_terms(
    skeleton: SkeletonModel,
    space: StateSpace,
    settings: JointSpaceSettings,
    points: ImagePoints,
    further: Sequence[int],
    sensors: Sequence[str],
    contact_points: ContactPoints | None,
) -> tuple[Term, ...]:
    """Return the built-in terms of an energy without those that couple frames.

    Args:
        points: of all cameras. further: number of points of each further camera.
        sensors: segments with a place for one.
    """
    index = skeleton.names.index
    given = () if contact_points is None else contact_points.joints
    standing = tuple(index(name) for name in skeleton.names if given and (name in given or name in FEET))
    # Joint and child of the bones of the limbs.
    joints = skeleton.index(*({*skeleton.names} & {*sum(LIMBS, ())}))
    pairs = [(joint, kinematics.children_of(skeleton.parents, joint)) for joint in joints]
    return (
        Visual(points.on, tuple(further)),
        Orientation(tuple(map(index, sensors)), settings.robust_orientation),
        Torso(tuple(index(name) for name in ANCHORED if name in skeleton.names)),
        Bone(tuple(sorted((joint, children[0]) for joint, children in pairs if len(children) == 1))),
        Root(),
        Floor(tuple(index(name) for name in FEET if name in skeleton.names), settings.floor_cutoff, standing),
        Prior(len(space.joints) - 1),
    )


@dataclass(frozen=True)
class Visual(Term):
    """Reprojection of landmarks."""

    landmarks: tuple[tuple[int, bool], ...]
    """Segment of each landmark, and whether the landmark is the joint where the segment begins."""
    further: tuple[int, ...] = ()  #: Number of landmarks of each further camera; they are the last ones
    name: str = "visual"
    unit: ClassVar[str] = "px"

    @property
    def cameras(self) -> tuple[int, ...]:
        """Camera of each landmark; the first is 0."""
        counts = (len(self.landmarks) - sum(self.further), *self.further)
        return tuple(c for c, count in enumerate(counts) for _ in range(count))

    def symbols(self) -> Shapes:
        """Return undistorted pixels, weights, and each camera's threshold of the loss."""
        L = len(self.landmarks)
        return {"uv_px": (2, L), "w_visual": (L,), "knee_visual": (1 + len(self.further),)}

    def constants(self) -> Shapes:
        """Return cameras and locations of the points in their segments."""
        shapes = (3, 3), (3, 3), (3, 1)
        cameras = [zip(camera_names(c), shapes, strict=True) for c in range(1 + len(self.further))]
        return {**{name: shape for camera in cameras for name, shape in camera}, "places": (3, len(self.landmarks))}

    def add(self, frame: Frame) -> None:
        """Add each landmark with a pseudo-Huber loss."""
        O, C = frame.O, frame.C
        for i, ((j, is_joint), which) in enumerate(zip(self.landmarks, self.cameras, strict=True)):
            K, R, t = (C[name] for name in camera_names(which))
            point = frame.p[j] if is_joint else frame.p[j] + frame.R[j] @ C["places"][:, i]
            residual, loss = partial(_pixels, O["uv_px"][:, i], K, R, t), pseudo_huber_loss(O["knee_visual"][which])
            frame.reprojections.append(frame.point(self, j, point, residual, O["w_visual"][i], loss))

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return undistorted landmarks of all cameras, weighted 1 where seen (`Annealing` has their sigma)."""
        uv, seen = [np.zeros((len(data.times), 0, 2))], [np.zeros((len(data.times), 0))]
        for view in data.seen:
            camera = view.camera
            undistorted = camera.normalise(view.uv_px) @ camera.K[:2, :2].T + camera.K[:2, 2]
            uv.append(np.where(view.seen[..., None], undistorted, 0.0))
            seen.append(view.seen.astype(float))
        knees = np.full((len(data.times), max(len(data.seen), 1)), data.settings.robust_reprojection)
        return {"uv_px": np.concatenate(uv, 1), "w_visual": np.concatenate(seen, 1), "knee_visual": knees}

    def constant(self, data: Observations) -> dict[str, Array]:
        """Return the cameras, one that sees nothing where there is none, and the points' locations."""
        out = {"K": np.eye(3), "R_camera_world": np.eye(3), "t_camera_world": np.zeros(3)}
        for which, view in enumerate(data.seen):
            values = view.camera.K, view.camera.R_camera_world, view.camera.t_camera_world
            out |= dict(zip(camera_names(which), values, strict=True))
        return out | {"places": data.points.places.T}


@dataclass(frozen=True)
class Orientation(Term):
    """Orientation of segments by their sensors, swing and twist apart."""

    sensors: tuple[int, ...]  #: Segments that have a place for a sensor
    robust: float  #: [sigma] Threshold of the pseudo-Huber loss
    name: str = "orientation"
    unit: ClassVar[str] = "rad"
    constant_errors: ClassVar[tuple[str, ...]] = ("w_sensor",)

    def symbols(self) -> Shapes:
        """Return quaternions and weights."""
        return {"quat_sensor": (4, len(self.sensors)), "w_sensor": (len(self.sensors),)}

    def constants(self) -> Shapes:
        """Return the matrices from an error to swing and twist in sigmas."""
        return {"whitening": (9, len(self.sensors))}

    def add(self, frame: Frame) -> None:
        """Add each sensor."""
        for s, j in enumerate(self.sensors):
            W, measured = ca.reshape(frame.C["whitening"][:, s], 3, 3), frame.O["quat_sensor"][:, s]
            turn = partial(_orientation, frame, j, measured, W)
            frame.turn(self, j, turn, frame.O["w_sensor"][s], pseudo_huber_loss(self.robust))

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return the sensors' quaternions, weighted 1 where known."""
        quat, has, *_ = data.sensed
        return {"quat_sensor": quat, "w_sensor": has}

    def constant(self, data: Observations) -> dict[str, Array]:
        """Return (9, S) column-major matrices from an orientation's error, rad, to swing and twist in sigmas."""
        axes = np.reshape([data.skeleton.bone_axis(joint) for joint in data.sensors], (-1, 3))
        along = axes[:, :, None] * axes[:, None]
        W = (np.eye(3) - along) / data.settings.sigma_swing + along / data.settings.sigma_twist  # symmetric
        return {"whitening": np.asarray(W.reshape(-1, 9).T)}


@dataclass(frozen=True)
class Torso(Term):
    """Orientation of pelvis, upper trunk, neck and clavicles about the initial guess, where no sensor has data."""

    segments: tuple[int, ...]
    name: str = "torso"
    unit: ClassVar[str] = "rad"

    def symbols(self) -> Shapes:
        """Return quaternions and weights."""
        return {"quat_torso": (4, len(self.segments)), "w_torso": (len(self.segments),)}

    def add(self, frame: Frame) -> None:
        """Add each segment with a Cauchy loss."""
        for i, j in enumerate(self.segments):
            turn = partial(_orientation, frame, j, frame.O["quat_torso"][:, i], ca.DM.eye(3))
            frame.turn(self, j, turn, frame.O["w_torso"][i], cauchy_loss)

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return those of the initial guess, weighted by its own standard deviations where it has any."""
        torso, start, s = list(self.segments), data.guess.poses, data.settings
        quat = so3.to_quat_wxyz(start.R_world_bone[:, torso])
        if s.sigma_torso is None:
            return {"quat_torso": quat, "w_torso": np.zeros((len(start), len(torso)))}
        sigma = start.sigma_rad[:, torso] * s.torso_inflation
        weights = 1 / np.where(np.isfinite(sigma), sigma, s.sigma_torso) ** 2
        for i, j in enumerate(torso):
            if (name := data.skeleton.names[j]) in data.sensors:
                weights[data.sensed[1][:, data.sensors.index(name)] > 0, i] = 0.0
        return {"quat_torso": quat, "w_torso": weights}


@dataclass(frozen=True)
class Bone(Term):
    """Bone vectors of limbs without a sensor about the initial guess."""

    bones: tuple[tuple[int, int], ...]  #: Joint and child of each
    name: str = "bone"
    unit: ClassVar[str] = "m"

    def symbols(self) -> Shapes:
        """Return vectors and weights."""
        return {"b_world": (3, len(self.bones)), "w_bone": (len(self.bones),)}

    def add(self, frame: Frame) -> None:
        """Add each bone with a Cauchy loss."""
        for i, (j, child) in enumerate(self.bones):
            residual = partial(_bone, frame.R[j], frame.C["offsets"][:, child], frame.O["b_world"][:, i])
            frame.turn(self, j, residual, frame.O["w_bone"][i], cauchy_loss)

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return those of the initial guess."""
        p, sigma, bare_joints = data.guess.poses.p_world_joint, data.settings.sigma_bone, bare(data.active)
        alone = np.array([data.skeleton.names[joint] in bare_joints for joint, _ in self.bones], dtype=float)
        weights = np.zeros_like(alone) if sigma is None else alone / sigma**2
        joints, children = np.reshape(self.bones, (-1, 2)).astype(int).T
        return {"b_world": p[:, children] - p[:, joints], "w_bone": np.tile(weights, (len(p), 1))}


@dataclass(frozen=True)
class Root(Term):
    """Position of the root about the initial guess."""

    name: str = "root"
    unit: ClassVar[str] = "m"
    constant_errors: ClassVar[tuple[str, ...]] = ("w_root",)

    def symbols(self) -> Shapes:
        """Return position and weight."""
        return {"p_root": (3,), "w_root": (1,)}

    def add(self, frame: Frame) -> None:
        """Add the root with a Cauchy loss."""
        residual = partial(_position, frame.O["p_root"])
        frame.point(self, 0, frame.p[0], residual, frame.O["w_root"], cauchy_loss)

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return that of the initial guess; where that was bridged, the weight is that of the bridge.

        The error of a bridge is the same over a gap, so all frames of it in one fragment count as one.
        """
        s, active, sigma = data.settings, data.active, data.guess.sigma_root
        usual = 0.0
        if s.sigma_root is not None and not (data.seen and both_bones_sensed(active)):
            usual = 1 / (_ROOT_BESIDE_SENSORS * s.sigma_root if data.seen and active else s.sigma_root) ** 2
        weights = np.full(len(data.times), usual)
        for first, stop in signals.runs(sigma > 0):
            weights[first:stop] = 1 / (min(stop - first, data.frames) * sigma[first:stop] ** 2)
        return {"p_root": data.guess.poses.p_world_joint[:, 0], "w_root": weights}


@dataclass(frozen=True)
class Floor(Term):
    """Height of standing ankles over a flat floor, and joints of the feet about their contact points."""

    feet: tuple[int, ...]  #: Ankles that the floor acts on
    cutoff: float  #: [m] Scale of the Cauchy loss of heights
    contacts: tuple[int, ...] = ()  #: Joints that may have contact points
    name: str = "floor"
    unit: ClassVar[str] = "m"

    def symbols(self) -> Shapes:
        """Return weights of the heights, and contact points with their weights."""
        C = len(self.contacts)
        return {"w_floor": (len(self.feet),), **({"p_contact": (3, C), "w_contact": (C,)} if C else {})}

    def constants(self) -> Shapes:
        """Return the height of a standing ankle."""
        return {"floor": (1,)}

    def add(self, frame: Frame) -> None:
        """Add heights and contact points."""
        O, floor = frame.O, frame.C["floor"]
        for i, j in enumerate(self.feet):
            weight = O["w_floor"][i]
            loss = cut_off_loss(weight, self.cutoff)
            frame.point(self, j, frame.p[j], lambda p: residuals.height(p, floor), weight, loss)
        for i, j in enumerate(self.contacts):
            loss = pseudo_huber_loss(_ROBUST_CONTACT)
            frame.point(self, j, frame.p[j], partial(_position, O["p_contact"][:, i]), O["w_contact"][i], loss)

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return the weights of ankles that stand in the smoothed initial guess, and the contact points."""
        s, start, out = data.settings, data.guess.poses, {}
        out["w_floor"] = np.zeros((len(start), len(self.feet)))
        if data.contact_points is not None:
            p = np.full((len(start), len(self.contacts), 3), np.nan)
            at = data.skeleton.index(*data.contact_points.joints)
            p[:, [self.contacts.index(joint) for joint in at]] = data.contact_points.p_world
            out |= {"p_contact": np.nan_to_num(p), "w_contact": np.isfinite(p[..., 0]) / s.sigma_contact**2}
        if s.floor_height is not None:
            smooth = start.with_poses(slice(None), *data.space.poses(data.start))
            at_frames = None if data.bone_imus is None else data.bone_imus.resample(start.times)
            contacts = detect_contacts(smooth, at_frames, data.skeleton, from_poses=True)
            out["w_floor"] = contacts.standing / s.sigma_floor**2
        return out

    def constant(self, data: Observations) -> dict[str, Array]:
        """Return the height of a standing ankle."""
        return {"floor": np.array([(data.settings.floor_height or 0.0) + data.settings.ankle_height])}


@dataclass(frozen=True)
class Prior(Term):
    """Rotations of all joints but the root by the pose prior."""

    joints: int  #: Moving joints but the root
    name: str = "prior"
    unit: ClassVar[str] = "rad"
    constant_errors: ClassVar[tuple[str, ...]] = ("w_prior",)

    def symbols(self) -> Shapes:
        """Return the weight."""
        return {"w_prior": (1,)}

    def constants(self) -> Shapes:
        """Return mean rotations and precision."""
        return {"quat_mean": (4, self.joints), "precision": (3 * self.joints, 3 * self.joints)}

    def add(self, frame: Frame) -> None:
        """Add the quadratic form."""
        frame.rotations(self, frame.C["quat_mean"], frame.O["w_prior"] * frame.C["precision"])

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return 1 in every frame, also in the padding."""
        return {"w_prior": np.ones(len(data.times))}

    def constant(self, data: Observations) -> dict[str, Array]:
        """Return mean (4, A - 1) and precision; fixed joints have a firm one."""
        prior, moving, s = data.skeleton.table.prior, data.space.names[1:], data.settings
        turning = [name for name in moving if name not in data.fixed]
        of_turning = np.repeat([name not in data.fixed for name in moving], 3)
        mean = np.tile([1.0, 0.0, 0.0, 0.0], (len(moving), 1))
        mean[of_turning[::3]] = prior.mean_quat_wxyz[[prior.joints.index(name) - 1 for name in turning]]
        precision = np.eye(3 * len(moving)) / _FIRM**2
        own = prior.precision(turning, s.prior_inflation, s.sigma_prior_least)
        precision[np.ix_(of_turning, of_turning)] = own
        return {"quat_mean": mean.T, "precision": precision}


@dataclass(frozen=True)
class Acceleration(Term):
    """Acceleration of the sensors; it couples three frames, and is bound apart (`FragmentData.a_world`)."""

    sensors: tuple[int, ...]  #: Segments that have a place for a sensor
    robust: float  #: [sigma] Threshold of the pseudo-Huber loss
    name: str = "acceleration"
    unit: ClassVar[str] = "m/s^2"

    def constants(self) -> Shapes:
        """Return the sensors' lever arms."""
        return {"levers": (3, len(self.sensors))}

    def add(self, frame: Frame) -> None:
        """Add the path of each sensor."""
        for s, j in enumerate(self.sensors):
            frame.path(self, j, frame.p[j] + frame.R[j] @ frame.C["levers"][:, s], 2, self.robust)

    def measured(self, data: Observations) -> tuple[Array, Array]:
        """Return accelerations (T, S, 3) and their weights (T, S)."""
        return data.sensed[2], data.sensed[3]

    def constant(self, data: Observations) -> dict[str, Array]:
        """Return the lever arms."""
        return {"levers": data.sensed[4].T}


def camera_names(which: int) -> tuple[str, str, str]:
    """Return the names of a camera's constants, 0 for the first: intrinsic matrix, rotation and translation."""
    end = f"_{which}" if which else ""
    return f"K{end}", f"R_camera_world{end}", f"t_camera_world{end}"


def jerk_sigma(space: StateSpace, settings: JointSpaceSettings, active: Collection[str]) -> Array:
    """Return the standard deviations (D,) of the jerk of every tangent coordinate, m/s^3 and rad/s^3.

    The term "smooth", the jerk of root and joints by that of free motion, couples four frames: its residual acts on the
    steps of the whole state, so the evaluators have it (`stencils.motion`).

    Args:
        active: segments with sensor data.
    """
    prior, smooth = space.skeleton.table.prior, bare(active)
    others = settings.jerk if active else settings.jerk_without_sensors
    factors = [settings.jerk_without_sensors if name in smooth else others for name in space.names]
    sigma = prior.sigma_jerk[[prior.joints.index(joint) for joint in space.names]]
    tangent = np.repeat(sigma * factors, 3) @ (space.expand != 0)
    return np.concatenate([np.full(3, others * prior.sigma_root_jerk), tangent])


def _pixels(uv: Matrix, K: Matrix, R: Matrix, t: Matrix, point: Matrix) -> Matrix:
    return residuals.reprojection(R @ point + t, uv, K)


def _orientation(frame: Frame, j: int, measured: Matrix, W: Matrix, e: Matrix) -> Matrix:
    return W @ residuals.orientation(frame.turned(j, e), measured)


def _bone(R: Matrix, b: Matrix, start: Matrix, e: Matrix) -> Matrix:
    return residuals.bone_vector(ca.SX(3, 1), R @ (b + ca.cross(e, b)), start)


def _position(observed: Matrix, point: Matrix) -> Matrix:
    return residuals.position(point, observed)


def low_passed(bone_imus: BoneImuSequence | None, settings: JointSpaceSettings) -> BoneImuSequence | None:
    """Return the sensors with accelerations filtered as `acceleration_cutoff_hz` of the settings asks for."""
    cutoff_hz = settings.acceleration_cutoff_hz
    return bone_imus if bone_imus is None or cutoff_hz is None else bone_imus.low_passed(cutoff_hz)


def sensor_data(
    times: Array, bone_imus: BoneImuSequence | None, sensors: tuple[str, ...], settings: JointSpaceSettings
) -> tuple[Array, Array, Array, Array, Array]:
    """Return quaternions (T, S, 4) and weights (T, S), accelerations (T, S, 3) and weights, levers (S, 3)."""
    T, S = len(times), len(sensors)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (T, S, 1))
    has, a, w, levers = np.zeros((T, S)), np.zeros((T, S, 3)), np.zeros((T, S)), np.zeros((S, 3))
    if bone_imus is None:
        return quat, has, a, w, levers
    if not np.array_equal(bone_imus.times, times):
        bone_imus = bone_imus.resample(times)
    for k, joint in enumerate(sensors):
        if joint not in bone_imus.joints:
            continue
        s = bone_imus.joints.index(joint)
        R, known = bone_imus.R_world_bone[:, s], np.isfinite(bone_imus.R_world_bone[:, s, 0, 0])
        quat[known, k] = so3.to_quat_wxyz(R[known])
        has[:, k] = known
        measured = np.isfinite(bone_imus.a_world[:, s]).all(axis=-1)
        a[:, k] = np.nan_to_num(bone_imus.a_world[:, s])
        w[:, k] = measured / settings.sigma_acceleration**2
        levers[k] = bone_imus.p_bone_sensor[s]
    return quat, has, a, w, levers
