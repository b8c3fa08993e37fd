"""Observations of a recording, arranged for the joint-space energy of its fragments."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.limbs import LIMBS, bare, both_bones_sensed
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import FEET, Footholds, detect_contacts
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy, built_energy
from rtof_kin.solve.energy.frame_energy import TORSO, Shape
from rtof_kin.solve.energy.problem import FragmentData
from rtof_kin.solve.energy.state import StateSpace
from rtof_kin.solve.joint_space.cameras import camera_data
from rtof_kin.solve.joint_space.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.limits import Limits
from rtof_kin.solve.joint_space.places import estimated_places
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.point_terms import PointData, PointTerm, point_rows
from rtof_kin.vision.image_points import image_points, joined_points, measurements

_ROOT_BESIDE_SENSORS: Final = 2.0
"""Factor on sigma_root where there are both landmarks and sensors."""
_FIRM: Final = np.radians(1.0)
"""[rad] Standard deviation of the prior of a fixed joint."""


@dataclass(frozen=True)
class Attached:
    """Segments (indices) of landmarks, sensors and ankles."""

    landmarks: tuple[int, ...]
    free: Array
    """(L, 1) 1 for a landmark with its own place in the segment, 0 for the segment's joint."""
    sensors: tuple[int, ...]
    feet: tuple[int, ...]

    @classmethod
    def of(cls, shape: Shape) -> Self:
        """Return those of a problem's shape."""
        free = np.array([[0.0 if is_joint else 1.0] for _, is_joint in shape.landmarks])
        return cls(tuple(j for j, _ in shape.landmarks), free, shape.sensors, shape.feet)


class Observations:
    """Observations of T frames, and the energy of fragments built for them.

    Attributes:
        names: L landmarks, or the detector's own points, those of further cameras behind those of the first.
        points: their places.
        sensors: S segments with a place for a sensor. attached: segments of landmarks, sensors, ankles.
        fixed: joints of the state space that keep their orientation because their sensor has no data.
        rows, a_world, w_acceleration: observations of every frame. constant: body, cameras, prior, floor.
        start: (T, 3 + 4A) initial states. confidence: (T, L) relative weights of the landmarks, 0 where
            unobserved.
        problem: energy of a fragment. limits: of the hinges, or None.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int,
        settings: JointSpaceSettings,
        guess: InitialGuess,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | None,
        footholds: Footholds | None = None,
        places: Collection[str] = (),
        views: Sequence[KeypointSequence] = (),
        terms: tuple[PointTerm, ...] = (),
        observed: Mapping[str, PointData] | None = None,
    ) -> None:
        """Collect the observations.

        Args:
            guess: initial guess (T). bone_imus: at any times. footholds: of standing feet (T).
            places: further segments with a place for a sensor; recordings with any of them share the compiled code.
            views: keypoints of further cameras, at the times of the guess. observed: their observations (T) by name.
        """
        self.skeleton, self.frames, self.settings, self._terms = skeleton, frames, settings, terms
        start = guess.poses
        self.rate_hz = start.rate_hz
        seen = [measurements(k, skeleton) for k in (keypoints, *views) if k is not None]
        self.names: tuple[str, ...] = sum((k.names for k in seen), ())
        named = [k.names for k in seen] or [()]
        self.points = joined_points([image_points(skeleton, names) for names in named])
        stops = np.cumsum([len(k.names) for k in seen]).tolist()
        parts = map(slice, [0, *stops], stops)
        self._cameras = [(k.camera, part) for k, part in zip(seen, parts, strict=False)]
        active = _active(bone_imus)
        self.sensors = tuple(n for n in skeleton.names if n in active or n in places)
        turning = {skeleton.names[p] for p in skeleton.parents if p >= 0} | active
        turning |= {skeleton.names[j] for j, own in self.points.on if not own}
        self.fixed = {*self.sensors} - turning
        self.space = StateSpace(skeleton, [*turning, *self.sensors], settings.hinges)
        given = () if footholds is None else footholds.joints
        standing = tuple(n for n in skeleton.names if given and (n in given or n in FEET))
        self._energy_of = self._energies(active, standing)
        self.problem = self._energy_of(frames)
        self.attached = Attached.of(self.problem.energy.shape)
        self.limits = Limits(self.space) if settings.limits else None
        self._observe(start, seen, bone_imus, active)
        self.rows |= point_rows(terms, observed or {}, len(start))
        self._displace(start.p_world_joint, start.R_world_bone)
        self._anchor_bridged_root(guess.sigma_root)
        if footholds is not None:
            p = np.full((len(start), len(standing), 3), np.nan)
            p[:, [standing.index(joint) for joint in footholds.joints]] = footholds.p_world
            self.rows["p_contact"] = np.nan_to_num(p)
            self.rows["w_contact"] = np.isfinite(p[..., 0]) / settings.sigma_contact**2
        self.start = self._initial_states(start)
        if settings.floor_height is not None:
            smooth = start.with_poses(slice(None), *self.space.poses(self.start))
            at_frames = None if bone_imus is None else bone_imus.resample(start.times)
            contacts = detect_contacts(smooth, at_frames, skeleton, from_poses=True)
            self.rows["w_floor"] = contacts.standing / settings.sigma_floor**2

    def fragment(self, first: int) -> tuple[Index, Mask, FragmentData]:
        """Return the indices of a fragment's frames, which of them exist, and their data.

        Args:
            first: its first frame, negative in the padding.
        """
        return fragment_of(
            self.rows, self.constant, self.a_world, self.w_acceleration, self.rate_hz, first, self.frames
        )

    def continue_from(self, x: Array) -> None:
        """Take solved states as the start, and the places of the detector's points from their residuals.

        Args:
            x: (T, 3 + 4A).
        """
        self.start = x
        p, R = self.space.poses(x)
        self._displace(p, R)
        if self.points.place_covariance.any():
            slopes = self._by_camera(lambda camera: self.points.slopes(camera, p, R))
            at = self.points.positions(p, R)
            residuals = self.rows["uv_px"] - self._by_camera(lambda camera: camera.undistorted().project(at))
            found = estimated_places(residuals, slopes, self.confidence, self.points.place_covariance)
            self.points = replace(self.points, places=self.points.places + found)
            self.constant["places"] = self.points.places.T

    def _displace(self, p: Array, R: Array) -> None:
        """Remove from the pixels what moves the points beside their segments at poses (T, J)."""
        if self.points.place_covariance.any():
            off = self._by_camera(lambda camera: self.points.displaced(camera, p, R))
            self.rows["uv_px"] = self._uv_px - np.where(self.confidence[..., None] > 0, np.nan_to_num(off), 0.0)

    def _by_camera(self, of: Callable[[Camera], Array]) -> Array:
        """Values (T, L, ...) of the points, each by the camera that sees it."""
        return np.concatenate([of(camera)[:, part] for camera, part in self._cameras], axis=1)

    def anything_seen(self, first: int, inside: Mask) -> bool:
        """Return whether a landmark or a sensor has data in a fragment.

        Args:
            first: its first frame. inside: (N,) which of its frames exist.
        """
        index = np.arange(first, first + self.frames)[inside]
        rows = self.rows["w_visual"], self.rows["w_sensor"], self.w_acceleration
        return any(row[index].any() for row in rows)

    def _initial_states(self, start: PoseSequence) -> Array:
        """Low-pass filtered states of the initial guess, fixed joints at zero."""
        x = self.space.from_poses(start.p_world_joint[:, 0], start.R_world_bone)
        x = x if self.limits is None else self.limits.within(x)
        self.space.rotations(x)[:, [name in self.fixed for name in self.space.names]] = [1.0, 0, 0, 0]
        return self.space.low_passed(x, start.rate_hz, self.settings.smooth_start_hz)

    def energy(self, frames: int) -> FragmentEnergy:
        """Return an energy like `problem` of another number of frames, with arrays of its own."""
        return self._energy_of(frames)

    def _energies(self, active: Collection[str], standing: tuple[str, ...]) -> Callable[[int], FragmentEnergy]:
        """The energy of a number of frames, for joints with sensors and those that may have footholds."""
        skeleton, s = self.skeleton, self.settings
        index = skeleton.names.index
        shape = Shape(
            landmarks=self.points.on,
            sensors=tuple(map(index, self.sensors)),
            torso=tuple(index(name) for name in TORSO if name in skeleton.names),
            bones=_limb_bones(skeleton),
            feet=tuple(index(name) for name in FEET if name in skeleton.names),
            robust_orientation=s.robust_orientation,
            floor_cutoff=s.floor_cutoff,
            contacts=tuple(map(index, standing)),
            further=tuple(part.stop - part.start for _, part in self._cameras[1:]),
            points=self._terms,
        )
        unsensed, smooth = s.jerk_without_sensors, bare(active)
        others = s.jerk if active else unsensed
        jerk = others, *(unsensed if name in smooth else others for name in self.space.names)
        return lambda frames: built_energy(
            skeleton.name,
            shape,
            self.space.names,
            frames,
            s.hinges,
            s.compile,
            jerk,
            s.robust_acceleration,
            skeleton.table.prior,
        )

    def _observe(
        self,
        start: PoseSequence,
        seen: Sequence[KeypointSequence],
        bone_imus: BoneImuSequence | None,
        active: Collection[str],
    ) -> None:
        """Set rows, constant, a_world and w_acceleration."""
        skeleton, s, T = self.skeleton, self.settings, len(start)
        bones, bare_joints, p = self.problem.energy.shape.bones, bare(active), start.p_world_joint
        alone = np.array([skeleton.names[joint] in bare_joints for joint, _ in bones], dtype=float)
        bone_weights = np.zeros_like(alone) if s.sigma_bone is None else alone / s.sigma_bone**2
        joints, children = np.reshape(bones, (-1, 2)).astype(int).T
        rows, constant = camera_data(seen, T)
        self.confidence = rows["w_visual"]
        if seen:
            shares = self.points.independent / self.points.sizes**2
            self.confidence = np.concatenate([k.confidence for k in seen], axis=1) * shares
            self._uv_px = rows["uv_px"]
        slow = low_passed(bone_imus, s)
        quat, has, self.a_world, self.w_acceleration, levers = sensor_data(start.times, slow, self.sensors, s)
        torso = list(self.problem.energy.shape.torso)
        self.rows = rows | {
            "knee_visual": np.full((T, max(len(seen), 1)), s.robust_reprojection),
            "quat_sensor": quat,
            "w_sensor": has,
            "quat_torso": so3.to_quat_wxyz(start.R_world_bone[:, torso]),
            "w_torso": self._torso_weights(start, torso, has),
            "b_world": p[:, children] - p[:, joints],
            "w_bone": np.tile(bone_weights, (T, 1)),
            "p_root": p[:, 0],
            "w_root": np.full(T, self._root_weight(active, bool(seen))),
            "w_floor": np.zeros((T, len(self.attached.feet))),
            "w_prior": np.ones(T),
        }
        mean, precision = self._prior()
        self.constant = constant | {
            "offsets": skeleton.joint_offsets.T,
            "whitening": _whitening(skeleton, self.sensors, s),
            "levers": levers.T,
            "places": self.points.places.T,
            "quat_mean": mean.T,
            "precision": precision,
            "floor": np.array([(s.floor_height or 0.0) + s.ankle_height]),
        }

    def _prior(self) -> tuple[Array, Array]:
        """Mean rotations (A - 1, 4) and precision of the joints; fixed joints have a firm one."""
        prior, moving, s = self.skeleton.table.prior, self.space.names[1:], self.settings
        turning = [name for name in moving if name not in self.fixed]
        of_turning = np.repeat([name not in self.fixed for name in moving], 3)
        mean = np.tile([1.0, 0.0, 0.0, 0.0], (len(moving), 1))
        mean[of_turning[::3]] = prior.mean_quat_wxyz[[prior.joints.index(name) - 1 for name in turning]]
        precision = np.eye(3 * len(moving)) / _FIRM**2
        own = prior.precision(turning, s.prior_inflation, s.sigma_prior_least)
        precision[np.ix_(of_turning, of_turning)] = own
        return mean, precision

    def _anchor_bridged_root(self, sigma: Array) -> None:
        """Anchor the root to the initial guess where that was bridged with a sigma (T,), m.

        The error is the same over a gap, so all frames of it in one fragment count as one.
        """
        for first, stop in signals.runs(sigma > 0):
            count = min(stop - first, self.frames)
            self.rows["w_root"][first:stop] = 1 / (count * sigma[first:stop] ** 2)

    def _root_weight(self, active: Collection[str], seen: bool) -> float:
        """Weight of the anchor to the initial guess's root, 1/m^2."""
        s = self.settings
        if s.sigma_root is None or (seen and both_bones_sensed(active)):
            return 0.0
        return 1 / (_ROOT_BESIDE_SENSORS * s.sigma_root if seen and active else s.sigma_root) ** 2

    def _torso_weights(self, start: PoseSequence, torso: list[int], has: Array) -> Array:
        """(T, n) of the anchor to the initial guess's orientations; 0 where a sensor has data."""
        s = self.settings
        if s.sigma_torso is None:
            return np.zeros((len(start), len(torso)))
        sigma = start.sigma_rad[:, torso] * s.torso_inflation
        weights = 1 / np.where(np.isfinite(sigma), sigma, s.sigma_torso) ** 2
        for i, j in enumerate(torso):
            if (name := self.skeleton.names[j]) in self.sensors:
                weights[has[:, self.sensors.index(name)] > 0, i] = 0.0
        return weights


def fragment_of(
    rows: Mapping[str, Array],
    constant: Mapping[str, Array],
    a_world: Array,
    w_acceleration: Array,
    rate_hz: float,
    first: int,
    frames: int,
) -> tuple[Index, Mask, FragmentData]:
    """Return the indices of a fragment's frames, which of them exist, and their data.

    Args:
        rows: name -> (T, ...). a_world: (T, S, 3) m/s^2. w_acceleration: (T, S).
    """
    frame = np.arange(first, first + frames)
    inside = (frame >= 0) & (frame < len(a_world))
    index = np.clip(frame, 0, len(a_world) - 1)
    observation = {name: values[index] for name, values in rows.items()}
    for name in (n for n in observation if n.startswith("w_") and n != "w_prior"):  # 0 in the padding
        observation[name] = (observation[name].T * inside).T
    whole = inside[2:] & inside[1:-1] & inside[:-2]
    return (
        index,
        inside,
        FragmentData(
            observation,
            dict(constant),
            a_world[index][1:-1],
            w_acceleration[index][1:-1] * whole[:, None],
            (np.convolve(inside, np.ones(4), mode="valid") == 4).astype(float),
            rate_hz,
        ),
    )


def low_passed(bone_imus: BoneImuSequence | None, settings: JointSpaceSettings) -> BoneImuSequence | None:
    """Return the sensors with accelerations filtered as the settings ask for.

    Args:
        settings: `acceleration_cutoff_hz`.
    """
    cutoff_hz = settings.acceleration_cutoff_hz
    if bone_imus is None or cutoff_hz is None:
        return bone_imus
    return bone_imus.low_passed(cutoff_hz)


def sensor_data(
    times: Array, bone_imus: BoneImuSequence | None, sensors: tuple[str, ...], settings: JointSpaceSettings
) -> tuple[Array, Array, Array, Array, Array]:
    """Return quaternions (T, S, 4) and weights (T, S), accelerations (T, S, 3) and weights, levers (S, 3).

    Args:
        times: (T,) s.
    """
    T, S = len(times), len(sensors)
    quat = np.zeros((T, S, 4))
    quat[..., 0] = 1.0
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


def _active(bone_imus: BoneImuSequence | None) -> set[str]:
    """Segments whose sensor has any data."""
    if bone_imus is None:
        return set()
    turns = np.isfinite(bone_imus.R_world_bone).all(axis=(2, 3)).any(axis=0)
    moves = np.isfinite(bone_imus.a_world).all(axis=2).any(axis=0)
    return {bone_imus.joints[s] for s in np.flatnonzero(turns | moves)}


def _limb_bones(skeleton: SkeletonModel) -> tuple[tuple[int, int], ...]:
    """Joint and child of the bones of the limbs."""
    joints = skeleton.index(*({*skeleton.names} & {*sum(LIMBS, ())}))
    pairs = [(joint, kinematics.children_of(skeleton.parents, joint)) for joint in joints]
    return tuple(sorted((joint, children[0]) for joint, children in pairs if len(children) == 1))


def bone_axis(skeleton: SkeletonModel, joint: str) -> Array:
    """Return the unit direction (3,) of a segment's bone in its frame; 0 for several bones or none."""
    children = kinematics.children_of(skeleton.parents, skeleton.names.index(joint))
    return np.asarray(so3.unit(skeleton.joint_offsets[children[0]]) if len(children) == 1 else np.zeros(3))


def _whitening(skeleton: SkeletonModel, sensors: tuple[str, ...], s: JointSpaceSettings) -> Array:
    """(9, S) column-major matrices from an orientation's error, rad, to swing and twist in sigmas."""
    axes = np.reshape([bone_axis(skeleton, joint) for joint in sensors], (-1, 3))
    along = axes[:, :, None] * axes[:, None]
    W = (np.eye(3) - along) / s.sigma_swing + along / s.sigma_twist  # symmetric
    return np.asarray(W.reshape(-1, 9).T)
