"""A recording as the joint-space problem wants it: what was observed, in every fragment."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.limbs import LIMBS, bare, both_bones_sensed
from rtof_kin.body.pose_prior import shipped_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.contacts import FEET, Footholds, detect_contacts
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy, built_energy
from rtof_kin.solve.energy.frame_energy import TORSO, Shape
from rtof_kin.solve.energy.problem import FragmentData
from rtof_kin.solve.energy.state import StateSpace
from rtof_kin.solve.joint_space.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.limits import Limits
from rtof_kin.solve.joint_space.settings import JointSpaceSettings

Array = NDArray[np.float64]
_ROOT_BESIDE_SENSORS = 2.0
"""By how much wider the root's anchor is where there are landmarks and sensors."""
_FIRM = np.radians(1.0)
"""Standard deviation of a joint that nothing turns."""
_WEIGHTS = {"w_visual", "w_sensor", "w_torso", "w_bone", "w_root", "w_floor", "w_contact"}
"""What is observed in frames that exist alone; the prior holds in the padding too."""


@dataclass(frozen=True)
class Attached:
    """On which segments things sit."""

    landmarks: tuple[int, ...]
    free: Array
    """(L, 1) 1 where a landmark has a place of its own in its segment, 0 where it is its joint."""
    sensors: tuple[int, ...]
    feet: tuple[int, ...]

    @classmethod
    def of(cls, shape: Shape) -> Self:
        """Those that a problem is built for."""
        free = np.array([[0.0 if is_joint else 1.0] for _, is_joint in shape.landmarks])
        return cls(tuple(j for j, _ in shape.landmarks), free, shape.sensors, shape.feet)


class Observations:
    """A recording as the problem wants it, and the problem that fits what it has.

    Attributes:
        names: L landmarks. sensors: S segments with a place for a sensor. attached: where both sit.
        held: joints that turn in the problem for a sensor that says nothing, and stay as they are.
        rows, a_world, w_acceleration: what every one of T frames shows; constant: what is known.
        start: (T, 3 + 4A) states to begin with.
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
    ) -> None:
        """Collect what every frame shows, for fragments of so many frames.

        Args:
            places: segments that have a place for a sensor in the problem whether theirs says anything
                or not: recordings with any of them take the same compiled code.
        """
        self.skeleton, self.frames, self.settings, s = skeleton, frames, settings, settings
        start = guess.poses
        self.rate_hz = start.rate_hz
        known, extra, names = skeleton.landmarks, tuple[str, ...](), tuple[str, ...]()
        if keypoints is not None:
            extra = tuple(n for n in keypoints.names if n in known and n not in skeleton.names)
            names = (*skeleton.names, *extra)
            keypoints = keypoints.select(names)
        speaking = _speaking(bone_imus)
        sensors = tuple(n for n in skeleton.names if n in speaking or n in places)
        turning = {
            name for j, name in enumerate(skeleton.names)
            if kinematics.children_of(skeleton.parents, j) or name in speaking
            or any(known[n][0] == name for n in extra)
        }  # fmt: skip
        moving = tuple(name for name in skeleton.names if name in turning or name in sensors)
        self.space, self.held = StateSpace(skeleton, moving, s.hinges), {*moving} - turning
        standing = () if footholds is None else footholds.joints
        standing = tuple(n for n in skeleton.names if standing and (n in standing or n in FEET))
        self.problem = self._built(moving, names, sensors, standing, self._jerk(speaking))
        self.names, self.sensors = names, sensors
        self.attached = Attached.of(self.problem.energy.shape)
        self.limits = Limits(self.space) if s.limits else None
        self._observe(start, keypoints, bone_imus, speaking)
        self._hold_in_gaps(guess.sigma_root)
        if footholds is not None:
            p = np.full((len(start), len(standing), 3), np.nan)
            p[:, [standing.index(joint) for joint in footholds.joints]] = footholds.p_world
            self.rows["p_contact"] = np.nan_to_num(p)
            self.rows["w_contact"] = np.isfinite(p[..., 0]) / s.sigma_contact**2
        x = self._states(start.p_world_joint[:, 0], start.R_world_bone)
        self.start = self.space.low_passed(x, start.rate_hz, s.smooth_start_hz)
        if s.floor_height is not None:
            smooth = start.with_poses(slice(None), *self.space.poses(self.start))
            at_frames = None if bone_imus is None else bone_imus.resample(start.times)
            contacts = detect_contacts(smooth, at_frames, skeleton, from_poses=True)
            self.rows["w_floor"] = contacts.standing / s.sigma_floor**2

    def _states(self, p_root: Array, R_world_bone: Array) -> Array:
        """`StateSpace.from_poses`, where joints that are held lose their turn too."""
        x = self.space.from_poses(p_root, R_world_bone)
        self.space.rotations(x)[:, [name in self.held for name in self.space.names]] = [1.0, 0, 0, 0]
        return x

    def _built(
        self, moving: tuple[str, ...], names: tuple[str, ...], sensors: tuple[str, ...],
        standing: tuple[str, ...], jerk: tuple[float, ...],
    ) -> FragmentEnergy:  # fmt: skip
        """The problem for some moving joints, landmarks, sensors, joints that have footholds, and factors
        on the jerk.
        """
        skeleton, s = self.skeleton, self.settings
        index = skeleton.names.index
        shape = Shape(
            landmarks=tuple((index(skeleton.landmarks[n][0]), n in skeleton.names) for n in names),
            sensors=tuple(map(index, sensors)),
            torso=tuple(index(name) for name in TORSO if name in skeleton.names),
            bones=_limb_bones(skeleton),
            feet=tuple(index(name) for name in FEET if name in skeleton.names),
            robust_orientation=s.robust_orientation,
            floor_cutoff=s.floor_cutoff,
            contacts=tuple(map(index, standing)),
        )
        return built_energy(
            skeleton.name, shape, moving, self.frames, s.hinges, s.compile, jerk, s.robust_acceleration
        )  # fmt: skip

    def _jerk(self, sensors: Collection[str]) -> tuple[float, ...]:
        """Factors on the jerk of the root's position and of every joint that moves."""
        unseen, smooth = self.settings.jerk_without_sensors, bare(sensors)
        others = self.settings.jerk if sensors else unseen
        return others, *(unseen if name in smooth else others for name in self.space.names)

    def _observe(
        self, start: PoseSequence, seen: KeypointSequence | None, bone_imus: BoneImuSequence | None,
        speaking: Collection[str],
    ) -> None:  # fmt: skip
        skeleton, s, T, sensors = self.skeleton, self.settings, len(start), self.sensors
        bones, bare_joints = self.problem.energy.shape.bones, bare(speaking)
        alone = np.array([skeleton.names[joint] in bare_joints for joint, _ in bones], dtype=float)
        bone_weights = np.zeros_like(alone) if s.sigma_bone is None else alone / s.sigma_bone**2
        rows, constant = _camera_data(seen, T)
        self.confidence = rows["w_visual"] if seen is None else np.where(seen.seen, seen.confidence, 0.0)
        slow = low_passed(bone_imus, s)
        quat, has, a, w, levers = sensor_data(start.times, slow, sensors, s)
        torso = skeleton.index(*[name for name in TORSO if name in skeleton.names])
        self.rows = rows | {
            "knee_visual": np.full(T, s.robust_reprojection),
            "quat_sensor": quat,
            "w_sensor": has,
            "quat_torso": so3.to_quat_wxyz(start.R_world_bone[:, torso]),
            "w_torso": self._torso_weights(start, torso, sensors, has),
            "b_world": _bone_vectors(start, bones),
            "w_bone": np.tile(bone_weights, (T, 1)),
            "p_root": start.p_world_joint[:, 0],
            "w_root": np.full(T, self._root_weight(speaking, seen is not None)),
            "w_floor": np.zeros((T, len(self.attached.feet))),
            "w_prior": np.ones(T),
        }
        self.a_world, self.w_acceleration = a, w
        mean, precision = self._prior()
        places = [skeleton.landmarks[name][1] for name in (() if seen is None else seen.names)]
        self.constant = constant | {
            "offsets": skeleton.joint_offsets.T,
            "whitening": _whitening(skeleton, sensors, s),
            "levers": levers.T,
            "places": np.reshape(places, (-1, 3)).T,
            "quat_mean": mean.T,
            "precision": precision,
            "floor": np.array([(s.floor_height or 0.0) + s.ankle_height]),
        }

    def _prior(self) -> tuple[Array, Array]:
        """Mean rotations (A - 1, 4) of the joints that move and their precision; of those that are held,
        none and a firm one of their own, so that nothing turns them.
        """
        prior, moving, s = shipped_prior(self.skeleton.names), self.space.names[1:], self.settings
        turning = [name for name in moving if name not in self.held]
        of_turning = np.repeat([name not in self.held for name in moving], 3)
        mean = np.tile([1.0, 0.0, 0.0, 0.0], (len(moving), 1))
        mean[of_turning[::3]] = prior.mean_quat_wxyz[[prior.joints.index(name) - 1 for name in turning]]
        precision = np.eye(3 * len(moving)) / _FIRM**2
        own = prior.precision(turning, s.prior_inflation, s.sigma_prior_least)
        precision[np.ix_(of_turning, of_turning)] = own
        return mean, precision

    def _hold_in_gaps(self, sigma: Array) -> None:
        """Anchor the root to the start where nobody saw it: a fragment all of whose frames are such knows
        nothing else of its place. What it is off by stays for the whole gap, so all frames that a
        fragment has of it count as one.

        Args:
            sigma: (T,) m; 0 where it was seen or nothing is known.
        """
        for first, stop in signals.runs(sigma > 0):
            count = min(stop - first, self.frames)
            self.rows["w_root"][first:stop] = 1 / (count * sigma[first:stop] ** 2)

    def _root_weight(self, sensors: Collection[str], seen: bool) -> float:
        """Of the anchor to the start's root, 1/m^2."""
        s = self.settings
        known = seen and both_bones_sensed(sensors)
        if s.sigma_root is None or known:
            return 0.0
        return 1 / (_ROOT_BESIDE_SENSORS * s.sigma_root if seen and sensors else s.sigma_root) ** 2

    def _torso_weights(
        self, start: PoseSequence, torso: Sequence[int], sensors: tuple[str, ...], has: Array
    ) -> Array:
        """(T, n) of the anchor to the start's orientations; none where a sensor knows better."""
        s = self.settings
        if s.sigma_torso is None:
            return np.zeros((len(start), len(torso)))
        sigma = start.sigma_rad[:, torso] * s.torso_inflation
        weights = 1 / np.where(np.isfinite(sigma), sigma, s.sigma_torso) ** 2
        for i, j in enumerate(torso):
            if (name := self.skeleton.names[j]) in sensors:
                weights[has[:, sensors.index(name)] > 0, i] = 0.0
        return weights

    def fragment(self, first: int) -> tuple[NDArray[np.intp], NDArray[np.bool_], FragmentData]:
        """Indices of a fragment's frames, which of them exist, and their data."""
        return fragment_of(
            self.rows, self.constant, self.a_world, self.w_acceleration, self.rate_hz, first, self.frames
        )

    def anything_seen(self, first: int, inside: NDArray[np.bool_]) -> bool:
        """Whether a landmark or a sensor says anything in a fragment."""
        index = np.arange(first, first + self.frames)[inside]
        rows = self.rows["w_visual"], self.rows["w_sensor"], self.w_acceleration
        return any(row[index].any() for row in rows)


def fragment_of(
    rows: Mapping[str, Array], constant: Mapping[str, Array], a_world: Array, w_acceleration: Array,
    rate_hz: float, first: int, frames: int,
) -> tuple[NDArray[np.intp], NDArray[np.bool_], FragmentData]:  # fmt: skip
    """Indices of a fragment's frames, which of them exist, and their data, from those of T frames."""
    frame = np.arange(first, first + frames)
    inside = (frame >= 0) & (frame < len(a_world))
    index = np.clip(frame, 0, len(a_world) - 1)
    observation = {name: values[index] for name, values in rows.items()}
    for name in observation.keys() & _WEIGHTS:
        observation[name] = (observation[name].T * inside).T
    whole = inside[2:] & inside[1:-1] & inside[:-2]
    return index, inside, FragmentData(
        observation, dict(constant), a_world[index][1:-1], w_acceleration[index][1:-1] * whole[:, None],
        (np.convolve(inside, np.ones(4), mode="valid") == 4).astype(float), rate_hz,
    )  # fmt: skip


def _camera_data(seen: KeypointSequence | None, frames: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """Landmarks without distortion, by frame, and the camera; nothing of either where there is none."""
    if seen is None:
        none = {"uv_px": np.zeros((frames, 0, 2)), "w_visual": np.zeros((frames, 0))}
        return none, {"K": np.eye(3), "R_camera_world": np.eye(3), "t_camera_world": np.zeros(3)}
    camera = seen.camera
    uv = camera.normalise(seen.uv_px) @ camera.K[:2, :2].T + camera.K[:2, 2]
    rows = {"uv_px": np.where(seen.seen[..., None], uv, 0.0), "w_visual": seen.seen.astype(float)}
    matrices = {name: getattr(camera, name) for name in ("K", "R_camera_world", "t_camera_world")}
    return rows, matrices


def _speaking(bone_imus: BoneImuSequence | None) -> set[str]:
    """Segments whose sensor says anything at all."""
    if bone_imus is None:
        return set()
    turns = np.isfinite(bone_imus.R_world_bone).all(axis=(2, 3)).any(axis=0)
    moves = np.isfinite(bone_imus.a_world).all(axis=2).any(axis=0)
    return {bone_imus.joints[s] for s in np.flatnonzero(turns | moves)}


def low_passed(bone_imus: BoneImuSequence | None, settings: JointSpaceSettings) -> BoneImuSequence | None:
    """The sensors as the settings want their accelerations."""
    cutoff_hz = settings.acceleration_cutoff_hz
    if bone_imus is None or cutoff_hz is None:
        return bone_imus
    return bone_imus.low_passed(cutoff_hz)


def sensor_data(
    times: Array, bone_imus: BoneImuSequence | None, sensors: tuple[str, ...],
    settings: JointSpaceSettings,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Quaternions (T, S, 4), their weights (T, S), accelerations (T, S, 3), weights, levers (S, 3)."""
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


def _limb_bones(skeleton: SkeletonModel) -> tuple[tuple[int, int], ...]:
    """Joint and child of the bones of the limbs."""
    joints = skeleton.index(*({*skeleton.names} & {*sum(LIMBS, ())}))
    pairs = [(joint, kinematics.children_of(skeleton.parents, joint)) for joint in joints]
    return tuple(sorted((joint, children[0]) for joint, children in pairs if len(children) == 1))


def _bone_vectors(start: PoseSequence, bones: tuple[tuple[int, int], ...]) -> Array:
    """(T, B, 3) of the start, m."""
    p = start.p_world_joint
    return (
        np.stack([p[:, child] - p[:, joint] for joint, child in bones], axis=1)
        if bones
        else (np.zeros((len(p), 0, 3)))
    )


def _whitening(skeleton: SkeletonModel, sensors: tuple[str, ...], s: JointSpaceSettings) -> Array:
    """(9, S) column-major matrices from an orientation's error, rad, to swing and twist in sigmas.

    Of a segment with several children or none, all three axes have the swing's sigma.
    """
    columns = []
    for joint in skeleton.index(*sensors):
        children = kinematics.children_of(skeleton.parents, joint)
        W = np.eye(3) / s.sigma_swing
        if len(children) == 1:
            bone = so3.unit(skeleton.joint_offsets[children[0]])
            along = np.outer(bone, bone)
            W = (np.eye(3) - along) / s.sigma_swing + along / s.sigma_twist
        columns.append(W.ravel(order="F"))
    return np.array(columns).reshape(-1, 9).T
