"""The frames of the online estimator's window: observations of streams, arranged for the smoother.

The rows are those of `Observations` for a whole recording, made frame by frame as samples arrive. A sample of
the video is put into the frame nearest in time, moved to its time at the speed of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.observability import WHOLE, levels_by_points
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import LONGEST_BRIDGE, PoseSequence, Provenance
from rtof_kin.inertial.root_path import FEET, ContactPoints, detect_contacts
from rtof_kin.live.samples import FrameSample
from rtof_kin.live.sensor_buffer import SensorBuffer
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.covariance import confidence_of
from rtof_kin.solve.joint_space.fixed_lag import FixedLagSmoother
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.uncertainty import CovarianceInflation, ResidualStatistics
from rtof_kin.vision.image_points import measurements

if TYPE_CHECKING:
    from lifting.streaming import StreamedPose


_AWAY_M: Final = 4.0  # [m] from the camera of the poses that the problem is built with
_MOVES: Final = 0.02  # [frames] distance in time below which points are not moved
_DISPLACED_EVERY: Final = 4  # frames; what moves points beside their segments changes slowly
_CONTACTS_EVERY: Final = 4  # frames
_SELDOM: Final = 12  # frames between searches for standing feet that only tell the ground's height
_GROUND_SHARE: Final = 0.1
_LOST_S: Final = 0.1  # [s] without an image after which feet hold the root
_LEGS: Final = ("LeftLeg", "RightLeg", *FEET)
_TORSO_SHARE: Final = 0.05  # Share of a new lift in the mean of the torso's standard deviations


class Window:
    """Window of N frames and its smoother.

    Attributes:
        data: the problem. smoother: of N frames. first: number of the window's first frame.
        torso: segments that may be anchored to the lift.
        order: places of the sensors' rows in `SensorBuffer.joints`.
        seen: (N, J) joints whose landmark the camera saw. latency_s: usual age of an image that arrives, s.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        camera: Camera | None,
        landmarks: Sequence[str],
        sensors: SensorBuffer | None,
        settings: JointSpaceSettings,
        rate_hz: float,
        frames: int,
        solved: int | None = None,
    ) -> None:
        """Build the problem.

        `skeleton`: the subject's. `camera`: None without one. `landmarks`: names of the video's points. `sensors`:
        calibrated; None without any. `rate_hz`: frames per second.
        """
        self.skeleton, self.camera, self.sensors, self.rate_hz = skeleton, camera, sensors, rate_hz
        self._settings, self.frames, self.first = settings, frames, 1 - frames
        self.data = self._problem(landmarks)
        self.smoother = FixedLagSmoother(self.data, frames, solved)
        names = skeleton.names
        self.seen = np.zeros((frames, len(names)), dtype=bool)
        energy = self.data.problem.energy
        self.torso, self._bones = list(energy["torso"].segments), energy["bone"].bones
        self._torso_weights = np.zeros((frames, len(self.torso)))
        self._bone_weights, self._root_weight = self.data.rows["w_bone"][0], self.data.rows["w_root"][0]
        worn = () if sensors is None else sensors.joints
        self._of_torso = [worn.index(names[j]) if names[j] in worn else -1 for j in self.torso]
        self.order = [worn.index(joint) for joint in self.data.sensors]
        points = self.data.points
        self._sizes = points.independent / points.sizes**2
        if camera is not None:
            self._measured = [list(landmarks).index(name) for name in self.data.names]
            self._joints = [(list(landmarks).index(n), j) for j, n in enumerate(names) if n in landmarks]
        self._displaced: Array | None = None
        self._ground: float | None = None  # [m] height of standing ankles
        if settings.floor_height is not None:
            self._ground = settings.floor_height + settings.ankle_height
        self._standing = np.zeros((frames, len(FEET)), dtype=bool)
        self._holds: list[Array | None] = [None] * len(FEET)
        self._since_image, self.latency_s = 0, 0.0
        self._whole_of: dict[bytes, Mask] = {}

    def _problem(self, landmarks: Sequence[str]) -> Observations:
        """Observations of a person who stands in front of the camera, without any: the problem's constants."""
        camera, sensors, skeleton, N = self.camera, self.sensors, self.skeleton, self.frames
        times, at = np.arange(N) / self.rate_hz, np.zeros(3)
        if camera is not None:
            at = camera.center_world + _AWAY_M * camera.R_camera_world[2]
        p, R = skeleton.forward_kinematics(skeleton.t_pose()[None])
        p = np.repeat(p - p[:, :1] + at, N, axis=0)
        guess = InitialGuess(PoseSequence(times, p, np.repeat(R, N, axis=0), skeleton.names), np.zeros(N))
        keypoints = None
        if camera is not None:
            empty = np.full((N, len(landmarks), 2), np.nan)
            keypoints = KeypointSequence(camera, times, empty, np.zeros(empty.shape[:2]), tuple(landmarks))
            keypoints = keypoints.select(measurements(keypoints, skeleton).names)
        bone_imus = None
        if sensors is not None:
            S = len(sensors.joints)
            R_world_bone = np.tile(np.eye(3), (N, S, 1, 1))
            bone_imus = BoneImuSequence(times, R_world_bone, np.zeros((N, S, 3)), sensors.levers, sensors.joints)
        nowhere = ContactPoints(FEET, np.full((N, len(FEET), 3), np.nan))
        return Observations(skeleton, N, self._settings, guess, keypoints, bone_imus, nowhere)

    @property
    def lost_s(self) -> float:
        """Time without an image beyond its usual age, s; infinite without a camera."""
        if self.camera is None:
            return np.inf
        return max(self._since_image / self.rate_hz - self.latency_s, 0.0)

    @property
    def head(self) -> int:
        """Number of the newest frame."""
        return self.first + self.frames - 1

    @property
    def oldest(self) -> int:
        """Number of the oldest frame whose observations still count."""
        return self.first + self.smoother.first

    def append(self, x: Array) -> None:
        """Append a frame without observations; the oldest one leaves. `x`: (3 + 4A,) its initial state."""
        S = len(self.data.sensors)
        self.smoother.append(x, {"w_prior": np.ones(())}, np.zeros((S, 3)), np.zeros(S))
        for array in (self.seen, self._torso_weights, self._standing):
            array[:-1] = array[1:]
            array[-1] = 0
        self.first += 1
        self._since_image += 1

    def translate(self, shift: Array) -> None:
        """Move the person by (3,) m, as an image shows after a time without."""
        self.smoother.translate(shift)
        self.smoother.rows["w_contact"][:] = 0.0
        self._holds = [None] * len(FEET)

    # --- sensors ---------------------------------------------------------------------------------

    def sense(self, first: int, times: Array) -> None:
        """Evaluate the sensors again.

        `first`: index in the window of the first frame. times: (N - first,) of the frames, s.
        """
        if self.sensors is None or not len(times):
            return
        smoother, order = self.smoother, self.order
        q, known, a, moved = self.sensors.at(times)
        smoother.rows["quat_sensor"][first:] = q[:, order]
        smoother.rows["w_sensor"][first:] = known[:, order]
        smoother.a_world[first:] = a[:, order]
        smoother.w_acceleration[first:] = moved[:, order] / self._settings.sigma_acceleration**2
        self._weigh_torso()

    def _weigh_torso(self) -> None:
        """Anchor the torso to the lift where no sensor is on it."""
        out = self.smoother.rows["w_torso"]
        out[:] = self._torso_weights
        has = self.smoother.rows["w_sensor"]
        for i, s in enumerate(self._of_torso):
            if s >= 0:
                out[has[:, self.order.index(s)] > 0, i] = 0.0

    # --- image -----------------------------------------------------------------------------------

    def see(self, i: int, sample: FrameSample, offset: float, speed: Array | None) -> None:
        """Put the points of a video frame into frame i of the window.

        `offset`: time of the frame after the sample, s. speed: (L, 2) of the points, px/s; None where unknown.
        """
        assert self.camera is not None
        uv, camera, rows = sample.uv_px, self.camera, self.smoother.rows
        seen = (sample.confidence > 0) & np.isfinite(uv).all(axis=1)
        if speed is not None and abs(offset) * self.rate_hz > _MOVES:
            uv = uv + offset * np.where(np.isfinite(speed), speed, 0.0)
        own = self._measured
        px = camera.normalise(uv[own]) @ camera.K[:2, :2].T + camera.K[:2, 2]
        points = self.data.points
        if points.moving:
            if self.head % _DISPLACED_EVERY == 0 or self._displaced is None:
                p, R = self.data.space.poses(self.smoother.state(i))
                self._displaced = np.nan_to_num(points.displaced(camera, p, R)[0])
            px = px - self._displaced
        rows["uv_px"][i] = np.where(seen[own, None], px, 0.0)
        rows["w_visual"][i] = np.where(seen[own], sample.confidence[own] * self._sizes, 0.0)
        for k, j in self._joints:
            self.seen[i, j] = seen[k]
        if seen[own].any():
            self._since_image = min(self._since_image, self.frames - 1 - i)
            rows["w_contact"][i] = 0.0

    @property
    def needs_lift(self) -> bool:
        """Whether a part of the body is observed by the lift, not by sensors."""
        if self._root_weight or self._bone_weights.any():
            return True
        unsensed = self.smoother.rows["w_sensor"][-1] == 0
        return any(s < 0 or bool(unsensed[self.order.index(s)]) for s in self._of_torso)

    def sensed(self, i: int) -> dict[str, Array]:
        """Return the measured orientations (3, 3) of segments in frame i of the window, by joint."""
        rows = self.smoother.rows
        known = np.flatnonzero(rows["w_sensor"][i])
        if not len(known):
            return {}
        R = so3.from_quat_wxyz(rows["quat_sensor"][i, known])
        return {self.data.sensors[s]: turn for s, turn in zip(known.tolist(), R, strict=True)}

    def lift(self, frames: Sequence[int], poses: Sequence[StreamedPose], images: int) -> None:
        """Anchor frames of the window to lifts, where nothing better observes the body.

        `images`: that each of them stands for.
        """
        own, rows, s = list(frames), self.smoother.rows, self._settings
        p = np.stack([pose.p_world_joint for pose in poses])
        R = np.stack([pose.R_world_bone for pose in poses])
        if s.sigma_torso is not None:
            j = self.torso
            known = np.isfinite(R[:, j, 0, 0])
            sigma = np.stack([pose.sigma_rad[j] for pose in poses]) * s.torso_inflation
            weights = images * known / np.where(np.isfinite(sigma), sigma, s.sigma_torso) ** 2
            oriented = np.stack([self._oriented(k, p, R) for k in j], axis=1)
            oriented = np.where(known[..., None, None], oriented, np.eye(3))
            rows["quat_torso"][own], self._torso_weights[own] = so3.to_quat_wxyz(oriented), weights
            self._weigh_torso()
        if self._bone_weights.any():
            joints, children = np.array(self._bones).T
            lengths = np.linalg.norm(self.skeleton.joint_offsets[children], axis=1, keepdims=True)
            rows["b_world"][own] = so3.unit(p[:, children] - p[:, joints]) * lengths
            rows["w_bone"][own] = images * self._bone_weights
        if self._root_weight:
            rows["p_root"][own], rows["w_root"][own] = p[:, 0], images * self._root_weight

    def _oriented(self, j: int, p: Array, R: Array) -> Array:
        """Orientations (n, 3, 3) of a segment of the torso as SF2 has them; see `InertialGuidedIK`."""
        parents = self.skeleton.parents
        if parents[j] < 0 or len(kinematics.children_of(parents, j)) < 2:
            return R[:, j]
        offsets = self.skeleton.joint_offsets
        by_positions = kinematics.segment_rotation(parents, offsets, j, p, R[:, parents[j]])
        known = np.isfinite(R[:, j]).all(axis=(1, 2))
        out = R[:, j].copy()
        out[known] = so3.nearest_rotation(R[known, j] + by_positions[known])
        return out

    # --- floor -----------------------------------------------------------------------------------

    def stand(self, times: Array) -> None:
        """Find standing feet: they are on the floor and, without an image, hold their place.

        `times`: (N,) of the frames, s.
        """
        s, smoother = self._settings, self.smoother
        lost = self.lost_s > _LOST_S
        if self.head % (_CONTACTS_EVERY if lost or s.floor_height is not None else _SELDOM) == 0:
            self._find_contacts(times, lost)
        if s.floor_height is not None:
            smoother.rows["w_floor"][:] = self._standing / s.sigma_floor**2
        if lost:
            self._hold()

    def _find_contacts(self, times: Array, lost: bool) -> None:
        inside, s = self.smoother.inside.copy(), self._settings
        inside[: self.smoother.first] = False
        if inside.sum() < 3:
            return
        p, R = self.data.space.poses(self.smoother.solved[inside[self.smoother.first :]])
        poses = PoseSequence(times[inside], p, R, self.skeleton.names)
        sensors = None
        if self.sensors is not None:
            joints = [joint for joint in self.data.sensors if joint in _LEGS]
            own = [self.data.sensors.index(joint) for joint in joints]
            known = self.smoother.rows["w_sensor"][inside][:, own, None, None] > 0
            R_bone = so3.from_quat_wxyz(self.smoother.rows["quat_sensor"][inside][:, own])
            a_known = self.smoother.w_acceleration[inside][:, own, None] > 0
            a = np.where(a_known, self.smoother.a_world[inside][:, own], np.nan)
            levers = self.data.constant["levers"].T[own]
            sensors = (
                BoneImuSequence(times[inside], np.where(known, R_bone, np.nan), a, levers, tuple(joints))
                if joints
                else None
            )
        found = detect_contacts(poses, sensors, self.skeleton, from_poses=True)
        self._standing[inside] |= found.standing
        if not lost and s.floor_height is None and found.standing.any():
            height = float(p[:, self.skeleton.index(*FEET), 2][found.standing].mean())
            before = height if self._ground is None else self._ground
            self._ground = before + _GROUND_SHARE * (height - before)

    def _hold(self) -> None:
        """Hold standing feet of the newest frame where they stood, and the lower foot near the ground."""
        rows, s = self.smoother.rows, self._settings
        p = self.data.space.poses(self.smoother.state(-2))[0][0]
        ankles = p[list(self.skeleton.index(*FEET))]
        if self._ground is None:
            self._ground = float(ankles[:, 2].min())
        self.smoother.constant["floor"] = np.array([self._ground])
        rows["w_floor"][-1, int(np.argmin(ankles[:, 2]))] = 1 / s.sigma_floor**2
        standing = self._standing[-1 - (self.head % _CONTACTS_EVERY)]
        for foot, ankle in enumerate(ankles):
            if not standing[foot]:
                self._holds[foot] = None
                continue
            if self._holds[foot] is None:
                self._holds[foot] = np.array([ankle[0], ankle[1], self._ground])
            rows["p_contact"][-1, foot] = self._holds[foot]
            rows["w_contact"][-1, foot] = 1 / s.sigma_contact**2

    # --- results ---------------------------------------------------------------------------------

    def poses(self, i: int, time: float) -> PoseSequence:
        """Return the pose of frame i of the window: provenance, validity and observed orientations as after SF2.

        `time`: of the frame, s.
        """
        p, R = self.data.space.poses(self.smoother.state(i))
        parents, names = self.skeleton.parents, self.skeleton.names
        seen, sensed = self.seen[i], np.zeros(len(names), dtype=bool)  # by the camera; by its own sensor
        sensed[list(self.data.problem.energy["orientation"].sensors)] = self.smoother.rows["w_sensor"][i] > 0
        by_imu = np.zeros(len(seen), dtype=bool)
        by_imu[1:] = sensed[list(parents[1:])]  # the segments that end in the joints
        unseen = Provenance.PRIOR if self.camera is None or seen.any() else Provenance.BRIDGED
        provenance = np.where(
            by_imu, np.where(seen, Provenance.CAMERA_AND_IMU, Provenance.IMU), np.where(seen, Provenance.CAMERA, unseen)
        )
        first = max(i - round(LONGEST_BRIDGE * self.smoother.rate_hz), 0)
        valid: Mask = np.asarray(self.seen[first : i + 1].any(axis=0))
        if self.camera is None:
            valid = np.concatenate([[sensed.any()], by_imu[1:]])
        for j, parent in enumerate(parents):
            valid[j] |= parent >= 0 and by_imu[j] and valid[parent]
        oriented = sensed | (self._whole(seen) & valid)
        kinds = provenance[None].astype(np.uint8)
        return PoseSequence(np.array([time]), p, R, names, kinds, valid[None], oriented[None])

    def _whole(self, seen: Mask) -> Mask:
        """(J,) segments whose orientation the joints seen determine."""
        key = seen.tobytes()
        if key not in self._whole_of:
            levels = np.zeros(len(seen), dtype=int)
            if self.camera is not None and seen.any():
                uv = np.where(seen[None, :, None], 0.0, np.nan) * np.ones(2)
                sure = seen[None].astype(float)
                points = KeypointSequence(self.camera, np.zeros(1), uv, sure, self.skeleton.names)
                levels = levels_by_points(self.skeleton, points)[0]
            self._whole_of[key] = levels == WHOLE
        return self._whole_of[key]


class StatedErrors:
    """Covariances of frames of a window, inflated as those of a recording are.

    On motions of validation with realistic 2D and 8 or 10 sensors the 95 % bands have 99 % of the errors about
    the root and 97 % of those in world at lag 0, and 90 and 92 % at 0.25 s.
    """

    def __init__(self, window: Window) -> None:
        self._window, self._inflation = window, CovarianceInflation.shipped()
        self._torso_sigma: float | None = None

    def lifted(self, sigma_rad: Array) -> None:
        """Take the standard deviations (n,) of pelvis and upper trunk of a lift, rad; NaN where unknown."""
        known = sigma_rad[np.isfinite(sigma_rad)]
        if len(known):
            new = float(np.median(known))
            before = new if self._torso_sigma is None else self._torso_sigma
            self._torso_sigma = before + _TORSO_SHARE * (new - before)

    def of(self, i: int, time: float) -> Confidence:
        """Return the covariances of frame i of the window. `time`: of the frame, s."""
        window, data = self._window, self._window.data
        x = window.smoother.state(i)
        C = window.smoother.covariance(i)[:1]
        raw = confidence_of(data.space, np.array([time]), x, C, data.fixed)
        statistics = ResidualStatistics(data.sensors)
        if self._torso_sigma is not None:
            statistics = ResidualStatistics(data.sensors, torso_sigma=self._torso_sigma)
        if window.camera is None:
            return self._inflation.apply(raw, statistics)
        from_camera = data.space.poses(x)[0] - window.camera.center_world
        return self._inflation.apply(raw, statistics, None, from_camera)
