"""Observations of a recording, arranged for the joint-space energy of its fragments."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.inertial.root_path import ContactPoints
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.fragment import FragmentData, FragmentEnergy, built_energy
from rtof_kin.solve.joint_space.layout import FrameLayout
from rtof_kin.solve.joint_space.state import Limits, StateSpace
from rtof_kin.solve.joint_space.terms import Acceleration, built_in_terms, jerk_sigma, low_passed, sensor_data
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.terms import MotionTerm, PointData, Term, check_observed
from rtof_kin.vision.image_points import image_points, joined_points, measurements

__all__ = ["Attached", "Observations", "fragment_of", "low_passed", "sensor_data"]


@dataclass(frozen=True)
class Attached:
    """Segments (indices) of landmarks, sensors and ankles."""

    landmarks: tuple[int, ...]
    free: Array  #: (L, 1) 1 for a landmark with its own place in the segment, 0 for the segment's joint
    sensors: tuple[int, ...]
    feet: tuple[int, ...]

    @classmethod
    def of(cls, energy: FrameLayout) -> Self:
        """Return those of an energy."""
        landmarks = energy["visual"].landmarks
        free = np.array([[0.0 if is_joint else 1.0] for _, is_joint in landmarks])
        return cls(tuple(j for j, _ in landmarks), free, energy["orientation"].sensors, energy["floor"].feet)


class Observations:
    """Observations of T frames, and the energy of fragments built for them.

    Attributes:
        times: (T,) s. guess: initial guess. seen: measured points of each camera.
        bone_imus, contact_points, observed: as given. active: segments whose sensor has data.
        names: L landmarks, or the detector's own points, those of further cameras behind those of the first.
        points: their places.
        sensors: S segments with a place for a sensor. sensed: their `sensor_data`. attached: segments of landmarks,
            sensors, ankles.
        fixed: joints of the state space that keep their orientation because their sensor has no data.
        rows, a_world, w_acceleration: observations of every frame. constant: body, cameras, prior, floor.
        start: (T, 3 + 4A) initial states. confidence: (T, L) relative weights of the landmarks, 0 where unobserved.
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
        contact_points: ContactPoints | None = None,
        places: Collection[str] = (),
        views: Sequence[KeypointSequence] = (),
        terms: tuple[Term, ...] = (),
        observed: Mapping[str, PointData] | None = None,
    ) -> None:
        """Collect the observations.

        Args:
            guess: initial guess (T). bone_imus: at any times. contact_points: of standing feet (T).
            places: further segments with a place for a sensor; recordings with any of them share the compiled code.
            views: keypoints of further cameras, at the times of the guess. observed: their observations (T) by name.
        """
        self.skeleton, self.frames, self.settings, self.guess = skeleton, frames, settings, guess
        self.bone_imus, self.contact_points, self.observed = bone_imus, contact_points, observed or {}
        start = guess.poses
        self.times, self.rate_hz = start.times, start.rate_hz
        self.seen = [measurements(k, skeleton) for k in (keypoints, *views) if k is not None]
        self.names: tuple[str, ...] = sum((k.names for k in self.seen), ())
        named = [k.names for k in self.seen] or [()]
        self.points = joined_points([image_points(skeleton, names) for names in named])
        stops = np.cumsum([len(k.names) for k in self.seen]).tolist()
        cameras = [(k.camera, part) for k, part in zip(self.seen, map(slice, [0, *stops], stops), strict=False)]
        self.active = set[str]()
        if bone_imus is not None:
            turns = np.isfinite(bone_imus.R_world_bone).all(axis=(2, 3)).any(axis=0)
            moves = np.isfinite(bone_imus.a_world).all(axis=2).any(axis=0)
            self.active = {bone_imus.joints[s] for s in np.flatnonzero(turns | moves)}
        self.sensors = tuple(n for n in skeleton.names if n in self.active or n in places)
        self.sensed = sensor_data(self.times, low_passed(bone_imus, settings), self.sensors, settings)
        turning = {skeleton.names[p] for p in skeleton.parents if p >= 0} | self.active
        turning |= {skeleton.names[j] for j, own in self.points.on if not own}
        self.fixed = {*self.sensors} - turning
        self.space = StateSpace(skeleton, [*turning, *self.sensors], settings.hinges)
        self.limits = Limits(self.space) if settings.limits else None
        self.start = self._initial_states()
        check_observed(terms, self.observed)
        further = [part.stop - part.start for _, part in cameras[1:]]
        built_in = built_in_terms(skeleton, self.space, settings, self.points, further, self.sensors, contact_points)
        sensors = tuple(map(skeleton.names.index, self.sensors))
        self.terms = (*built_in, *terms, Acceleration(sensors, settings.robust_acceleration))
        self.problem = self.energy(frames)
        self.attached = Attached.of(self.problem.energy)
        self.rows: dict[str, Array] = {}
        self.constant: dict[str, Array] = {"offsets": skeleton.joint_offsets.T}
        for term in self.terms:
            self.rows |= {name: rows for name, rows in term.rows(self).items() if name in self.problem.energy.rows}
            self.constant |= term.constant(self)
        paths = [term.measured(self) for term in self.terms if isinstance(term, Acceleration | MotionTerm)]
        self.a_world, self.w_acceleration = (np.concatenate(parts, axis=1) for parts in zip(*paths, strict=True))
        self.confidence = self.rows["w_visual"]
        if self.seen:
            shares = self.points.independent / self.points.sizes**2
            self.confidence = np.concatenate([k.confidence for k in self.seen], axis=1) * shares
        if self.points.moving:  # remove from the pixels what moves points beside their segments
            p, R = start.p_world_joint, start.R_world_bone
            off = [self.points.displaced(camera, p, R)[:, part] for camera, part in cameras]
            shown = np.where(self.confidence[..., None] > 0, np.nan_to_num(np.concatenate(off, axis=1)), 0.0)
            self.rows["uv_px"] = self.rows["uv_px"] - shown

    def fragment(self, first: int) -> tuple[Index, Mask, FragmentData]:
        """Return the indices of a fragment's frames, which of them exist, and their data; `first`: its first frame,
        negative in the padding.
        """
        measured = self.a_world, self.w_acceleration
        return fragment_of(self.rows, self.constant, *measured, self.rate_hz, first, self.frames)

    def anything_seen(self, first: int, inside: Mask) -> bool:
        """Return whether a landmark or a sensor has data in a fragment from `first`, in its existing frames (N,)."""
        index = np.arange(first, first + self.frames)[inside]
        rows = self.rows["w_visual"], self.rows["w_sensor"], self.w_acceleration
        return any(row[index].any() for row in rows)

    def _initial_states(self) -> Array:
        """Low-pass filtered states of the initial guess, fixed joints at zero."""
        start = self.guess.poses
        x = self.space.from_poses(start.p_world_joint[:, 0], start.R_world_bone)
        x = x if self.limits is None else self.limits.within(x)
        self.space.rotations(x)[:, [name in self.fixed for name in self.space.names]] = [1.0, 0, 0, 0]
        return self.space.low_passed(x, start.rate_hz, self.settings.smooth_start_hz)

    def energy(self, frames: int) -> FragmentEnergy:
        """Return an energy like `problem` of any number of frames, with arrays of its own."""
        s, moving = self.settings, self.space.names
        sigma = jerk_sigma(self.space, s, self.active)
        return built_energy(self.skeleton.name, self.terms, moving, frames, s.hinges, s.compile, sigma)


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
        rows: name -> (T, ...). a_world: (T, P, 3) of the paths, m/s^2 of the sensors. w_acceleration: (T, P).
    """
    frame = np.arange(first, first + frames)
    inside = (frame >= 0) & (frame < len(a_world))
    index = np.clip(frame, 0, len(a_world) - 1)
    observation = {name: values[index] for name, values in rows.items()}
    for name in (n for n in observation if n.startswith("w_") and n != "w_prior"):  # 0 in the padding
        observation[name] = (observation[name].T * inside).T
    whole = inside[2:] & inside[1:-1] & inside[:-2]
    a, w = a_world[index][1:-1], w_acceleration[index][1:-1] * whole[:, None]
    w_jerk = (np.convolve(inside, np.ones(4), mode="valid") == 4).astype(float)
    return index, inside, FragmentData(observation, dict(constant), a, w, w_jerk, rate_hz)
