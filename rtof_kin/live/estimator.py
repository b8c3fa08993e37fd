"""Online estimator: samples of a camera and of inertial sensors in, poses at a fixed lag out.

Frames follow each other at an even rate, up to the newest time of any stream. A frame begins at the state
that the ones before it predict; samples that belong to a frame of the window change its observations whenever
they arrive, late ones too. So a video that lags the sensors is bridged by them, and without a camera the feet
that stand hold the root, as in mode imu. See `solve.joint_space.fixed_lag` for the mathematics.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import InvalidInputError, ShapeError, SolverError
from rtof_kin.core.resources import LIVE_LIFTER
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import poses_from_sensors, refit_root
from rtof_kin.inertial.root_path import FEET
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.live.refinement import Refinement
from rtof_kin.live.samples import FrameSample, ImuSample, OnlineEstimate, Sample
from rtof_kin.live.sensor_buffer import SensorBuffer
from rtof_kin.live.window import StatedErrors, Window
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.joint_space.terms import TORSO

if TYPE_CHECKING:
    from lifting.predict import Lifter
    from lifting.streaming import StreamedPose, StreamingLifter

_LOOKAHEADS_S: Final = (0.0, 0.22)  # ages at which a frame is lifted
_LIFT_EVERY_S: Final = 0.05  # [s] between lifts, which are autocorrelated for longer
_GRACE: Final = 1e-6  # [frames] of rounding
_ASTRAY_ROOT_M: Final = 1.0  # of the root from where the image shows it
_BACK_S, _BACK_M = 0.5, 0.2  # without an image for so long, a root that jumps by so much is moved
_LONGEST_STEP_S: Final = 5.0
_FEW: Final = 3  # frames that are due at once and solved even in a hurry
_CHECK_EVERY: Final = 10  # images, of which one is compared with its lift
_ASTRAY_M, _ASTRAY_TIMES = 0.3, 3  # mean distance of joints about the root from the lift, and how often
_LAST_ITERATIONS: Final = 5


class OnlineEstimator:
    """Fixed-lag smoother of live streams.

    Attributes:
        skeleton: the subject's. settings: as given. dropped: by sensor, and ``video``: samples too late.
        hurried: number of frames that were only predicted, to catch up.
    """

    def __init__(
        self,
        setup: Recording,
        landmarks: Sequence[str] = (),
        settings: OnlineSettings | None = None,
        lifter: Lifter | None = None,
        calibration: SelfCalibration | None = None,
    ) -> None:
        """Build the problem, which compiles code the first time. `InvalidInputError`: there is neither camera nor
        calibrated sensor.

        Args:
            setup: recording whose camera, body, floor and calibration of sensors are used; not its streams.
            landmarks: names of the L points of the video; none for sensors alone.
            lifter: keypoints to 3D; by default the shipped one.
            calibration: that the refinement begins with; for one to be kept as it is, apply it to the setup.
        """
        self.settings = s = settings or OnlineSettings()
        self.skeleton, self._landmarks, self._rate = setup.skeleton, tuple(landmarks), s.rate_hz
        self._camera = setup.video.camera if landmarks else None
        solver = s.solver
        if solver.floor_height is None:
            floor = setup.floor_height
            if floor is None and self._camera is None:
                floor = 0.0  # where sensors alone put the person
            solver = replace(solver, floor_height=floor)
        self._sensors: SensorBuffer | None = None
        if setup.calibration is not None:
            joints = tuple(dict.fromkeys(setup.calibration.joints))
            self._sensors = SensorBuffer(setup.calibration, joints, s.rate_hz, solver.acceleration_cutoff_hz)
        if self._camera is None and self._sensors is None:
            raise InvalidInputError("setup: neither camera with landmarks nor calibrated sensors")
        sizes = s.rate_hz, s.frames, s.solved
        self._window = Window(self.skeleton, self._camera, self._landmarks, self._sensors, solver, *sizes)
        self._errors = StatedErrors(self._window) if s.confidence else None
        self._solver, self._lifter = solver, self._streaming(lifter, setup.floor_height)
        self._pending: deque[FrameSample] = deque()
        self._last_seen: FrameSample | None = None
        self._placed: dict[int, float] = {}
        self._origin: float | None = None
        self._newest = -np.inf
        self.dropped: dict[str, int] = {}
        self.hurried, self._astray = 0, 0
        self._images, self._lifted = 0, -self._window.frames
        self._delay_s, self._refinement = s.video_delay_s, None
        if s.refined is not None and self._sensors is not None and self._camera is not None:
            self._refinement = Refinement(self._window, self._sensors, s.refined, calibration)

    def _streaming(self, lifter: Lifter | None, floor_height: float | None) -> StreamingLifter | None:
        if self._camera is None:
            return None
        from lifting.predict import Lifter
        from lifting.streaming import StreamingLifter

        return StreamingLifter(
            lifter or Lifter.load(LIVE_LIFTER),
            self._camera,
            self.skeleton.joint_offsets,
            floor_height,
            names=self._landmarks,
            history_s=self.settings.frames / self._rate + 0.5,
        )

    @property
    def calibration(self) -> SelfCalibration | None:
        """What was refined so far; None where nothing is."""
        return None if self._refinement is None else self._refinement.calibration.as_self_calibration()

    # --- samples ---------------------------------------------------------------------------------

    def push(self, sample: Sample) -> None:
        """Take a sample, in any order; it counts from the next `advance` on.

        `sample`: on the common clock; a frame has the landmarks of the estimator.

        Raises:
            UnknownNameError: the sensor has no calibration. ShapeError: other landmarks.
            InvalidInputError: the time is not finite.
        """
        if not np.isfinite(sample.time):
            name = getattr(sample, "sensor", "the video")
            raise InvalidInputError(f"sample of {name}: its time is not finite")
        if isinstance(sample, ImuSample):
            if self._sensors is None:
                return
            if self._origin is not None and sample.time < self._time(self._window.first):
                self._drop(sample.sensor)
                return
            self._sensors.add(sample.sensor, sample.time, sample.R_inertial_sensor, sample.f_sensor)
            self._newest = max(self._newest, sample.time)
            return
        L = len(self._landmarks)
        if np.shape(sample.uv_px) != (L, 2) or np.shape(sample.confidence) != (L,):
            raise ShapeError(f"frame at {sample.time:g} s: {np.shape(sample.uv_px)} points for {L} landmarks")
        sample = replace(sample, time=sample.time - self._delay_s)
        if self._origin is not None and sample.time < self._time(self._window.oldest) - 0.5 / self._rate:
            self._drop("video")
            return
        self._newest = max(self._newest, sample.time)
        self._pending.append(sample)

    def _drop(self, what: str) -> None:
        self.dropped[what] = self.dropped.get(what, 0) + 1

    # --- frames ----------------------------------------------------------------------------------

    def _time(self, frame: int | Index) -> Array:
        """Time of frames by their numbers, s."""
        assert self._origin is not None
        return np.asarray(self._origin + np.asarray(frame) / self._rate)

    def advance(self, time: float | None = None, *, hurry: bool = False) -> list[OnlineEstimate]:
        """Estimate the frames up to a time and return those whose lag has passed, oldest first.

        `time`: s; by default that of the newest sample. A step of more than 5 s is not bridged. `hurry`: of many frames
        that are due, solve every third only, to catch up.
        """
        now = self._newest if time is None else float(time)
        if self._origin is None and not self._begin():
            return []
        found = []
        last = int(np.floor((now - float(self._time(0))) * self._rate + _GRACE))
        if last - self._window.head > _LONGEST_STEP_S * self._rate:
            self._leap(last)
        while self._window.head < last:
            began, due = perf_counter(), last - self._window.head
            solve = not hurry or due <= _FEW or self._window.head % _FEW == 0
            self.hurried += not solve
            self._step(solve)
            estimate = self._estimate(self._window.frames - 1 - self.settings.lag_frames, began)
            found += [estimate] if estimate is not None else []
        return found

    def _leap(self, last: int) -> None:
        """Begin again shortly before a frame, as the streams were silent for long or their clock jumped."""
        self.hurried += last - self._window.head - 1
        self._window.first = last - self._window.frames
        self._window.smoother.restart(self._window.smoother.state(-1)[0])
        self._placed.clear()

    def finish(self) -> list[OnlineEstimate]:
        """Return the frames that remain in the lag."""
        if self._origin is None:
            return []
        began = perf_counter()
        self._window.smoother.finish(_LAST_ITERATIONS)
        first = self._window.frames - self.settings.lag_frames
        estimates = [self._estimate(i, began) for i in range(first, self._window.frames)]
        return [estimate for estimate in estimates if estimate is not None]

    def _step(self, solve: bool) -> None:
        """Apply what the calibration found, and append the next frame; lift and solve it if asked to."""
        window = self._window
        if self._refinement is not None:
            assert self._sensors is not None
            found = self._refinement.step(float(self._time(window.first)) + self._delay_s)
            self._delay_s = self.settings.video_delay_s + found.delay
            self._sensors.correct(found.heading, found.R_mounting)
        window.append(window.smoother.predicted())
        times = self._time(window.first + np.arange(window.frames))
        if self._sensors is not None:
            changed = self._sensors.clean()
            first = int(np.clip(np.ceil((changed - times[0]) * self._rate - 1), 0, window.frames - 1))
            window.sense(first, times[first:])
        self._see(solve)
        if solve:
            window.stand(times)
            try:
                window.smoother.iterate(1)
            except SolverError:
                self._restart(window.smoother.state(-1)[0])

    def _restart(self, x: Array) -> None:
        smoother = self._window.smoother
        smoother.restart(x)
        smoother.inside[-1], smoother.rows["w_prior"][-1] = True, 1.0

    def _see(self, lift: bool) -> None:
        """Put the frames of the video that are due into the window, and lift them if asked to."""
        waiting, window = deque[FrameSample](), self._window
        assert self._origin is not None
        while self._pending:
            sample = self._pending.popleft()
            frame = round((sample.time - self._origin) * self._rate)
            i = frame - window.first
            if i >= window.frames:
                waiting.append(sample)
            elif frame < window.oldest:
                self._drop("video")
            else:
                self._place(i, frame, sample, lift)
        self._pending = waiting

    def _place(self, i: int, frame: int, sample: FrameSample, lift: bool) -> None:
        window, offset = self._window, float(self._time(frame)) - sample.time
        before = self._last_seen
        assert self._lifter is not None
        self._lifter.put(sample.time, sample.uv_px, sample.confidence, window.sensed(i))
        if window.lost_s > _BACK_S and (pose := self._lifter.lift([sample.time])[0]) is not None:
            self._move(pose, sample, _BACK_M)
        shortly = before is not None and 0 < sample.time - before.time <= 2.5 / self._rate
        speed = (sample.uv_px - before.uv_px) / (sample.time - before.time) if before is not None and shortly else None
        window.see(i, sample, offset, speed)
        age = (window.head - frame) / self._rate
        window.latency_s += 0.1 * (age - window.latency_s)
        if before is None or sample.time > before.time:
            self._last_seen = sample
        self._placed[frame] = sample.time
        self._placed = {k: t for k, t in self._placed.items() if k >= window.oldest}
        self._images += 1
        usual = frame - self._lifted >= _LIFT_EVERY_S * self._rate and window.needs_lift
        if not lift or not (usual or frame % _CHECK_EVERY == 0):
            return
        ages = [frame - round(age * self._rate) for age in _LOOKAHEADS_S]
        due = [k for k in ages if k in self._placed]
        lifts = self._lifter.lift([self._placed[k] for k in due])
        known = {k - window.first: pose for k, pose in zip(due, lifts, strict=True) if pose is not None}
        if known:
            window.lift(list(known), list(known.values()), self._images)
            if self._errors is not None and i in known:
                self._errors.lifted(known[i].sigma_rad[list(self.skeleton.index(*TORSO))])
            self._images, self._lifted = 0, frame
        if i in known and frame % _CHECK_EVERY == 0:
            self._check(i, known[i], sample)

    def _check(self, i: int, pose: StreamedPose, sample: FrameSample) -> None:
        """Begin again from the lift where poses have been far from it for long, and move a root that is."""
        p = self._window.data.space.poses(self._window.smoother.state(i))[0][0]
        lifted = pose.p_world_joint
        far = np.linalg.norm((p - p[0]) - (lifted - lifted[0]), axis=1).mean() > _ASTRAY_M
        if np.linalg.norm(p[0] - lifted[0]) > _ASTRAY_ROOT_M:
            self._move(pose, sample, _ASTRAY_ROOT_M)
        self._astray = self._astray + 1 if far else 0
        if self._astray >= _ASTRAY_TIMES:
            self._restart(self._first_lifted(pose, sample))
            self._astray = 0

    def _R_world_bone(self, time: float) -> dict[str, Array]:
        if self._sensors is None:
            return {}
        q, known, _, _ = self._sensors.at(np.array([time]))
        R = so3.from_quat_wxyz(q[0])
        return {joint: R[s] for s, joint in enumerate(self._sensors.joints) if known[0, s]}

    def _move(self, pose: StreamedPose, sample: FrameSample, least_m: float) -> None:
        """Move the person to where an image and its lift show her, if that is farther than a distance."""
        poses = self._window.poses(self._window.frames - 1, sample.time)
        lifted = pose.p_world_joint[0] - poses.p_world_joint[0, 0]
        poses = replace(poses, p_world_joint=poses.p_world_joint + lifted)
        shown = refit_root(poses, self._keypoints(sample))
        shift = shown.p_world_joint[0, 0] - poses.p_world_joint[0, 0] + lifted
        if np.linalg.norm(shift) > least_m:
            self._window.translate(shift)

    # --- begin -----------------------------------------------------------------------------------

    def _begin(self) -> bool:
        """Begin with the first frame in which the person is seen or sensed; return whether there is one."""
        x = self._first_by_camera() if self._camera is not None else self._first_by_sensors()
        if x is None:
            return False
        self._window.first = -self._window.frames  # the first frame is number 0
        self._window.smoother.restart(x)
        return True

    def _first_by_camera(self) -> Array | None:
        assert self._lifter is not None
        while self._pending:
            sample = self._pending[0]
            self._lifter.put(sample.time, sample.uv_px, sample.confidence, self._R_world_bone(sample.time))
            (pose,) = self._lifter.lift([sample.time])
            if pose is not None:
                self._origin = sample.time
                return self._first_lifted(pose, sample)
            self._pending.popleft()
        return None

    def _keypoints(self, sample: FrameSample) -> KeypointSequence:
        assert self._camera is not None
        return KeypointSequence(
            self._camera, np.array([sample.time]), sample.uv_px[None], sample.confidence[None], self._landmarks
        )

    def _first_lifted(self, pose: StreamedPose, sample: FrameSample) -> Array:
        """State of a lifted pose with measured orientations, its root on the rays of its landmarks."""
        skeleton, p = self.skeleton, pose.p_world_joint[None]
        R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
        R = np.where(np.isfinite(pose.R_world_bone), pose.R_world_bone, R)
        for joint, own in self._R_world_bone(sample.time).items():
            R[0, skeleton.names.index(joint)] = own
        p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p[:, 0], R)
        poses = PoseSequence(np.array([sample.time]), p, R, skeleton.names)
        return self._state(refit_root(poses, self._keypoints(sample)))

    def _first_by_sensors(self) -> Array | None:
        """State that the sensors show, above the origin with the lower ankle on the floor; None without data."""
        sensors = self._sensors
        if sensors is None or not np.isfinite(sensors.newest).any():
            return None
        at = float(sensors.newest[np.isfinite(sensors.newest)].min())
        q, known, a, _ = sensors.at(np.array([at]))
        if not known.any():
            return None
        R = np.where(known[..., None, None], so3.from_quat_wxyz(q), np.nan)
        measured = BoneImuSequence(np.array([at]), R, a, sensors.levers, sensors.joints)
        poses = poses_from_sensors(self.skeleton, measured)
        lowest = float(poses.p_world_joint[0, self.skeleton.index(*FEET), 2].min())
        height = (self._solver.floor_height or 0.0) + self._solver.ankle_height - lowest
        p = poses.p_world_joint + np.array([0.0, 0.0, height])
        self._origin = at
        return self._state(poses.with_poses(slice(None), p, poses.R_world_bone))

    def _state(self, poses: PoseSequence) -> Array:
        """State (3 + 4A,) of the only frame of poses."""
        data = self._window.data
        x = data.space.from_poses(poses.p_world_joint[:, 0], poses.R_world_bone)
        return np.asarray((x if data.limits is None else data.limits.within(x))[0])

    # --- results ---------------------------------------------------------------------------------

    def _estimate(self, i: int, began: float) -> OnlineEstimate | None:
        """Pose of frame i of the window; None before the first frame."""
        window = self._window
        if not window.smoother.inside[i]:
            return None
        time = float(self._time(window.first + i))
        confidence = None if self._errors is None else self._errors.of(i, time)
        poses = self._window.poses(i, time)
        return OnlineEstimate(poses, max(self._newest - time, 0.0), perf_counter() - began, confidence)
