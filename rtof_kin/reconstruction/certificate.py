"""Certificate of a recording: each sensor predicted from all the rest, and compared with what it measured.

The recording is solved once more without a sensor, as if its segment had never had one. Sensor and prediction give the
rotation of the measured against the predicted segment, R_predicted^T R_measured, frame by frame, with the mounting and
heading that the recording declares: a constant error of the prediction is in it, and so is the sensor's own error. With
mounting and heading found anew from the other half of the time (both halves in turn) the constant part is gone: that is
the error of the movement.

**From the measured to the true error.** Let S^2 be the mean variance that the reconstruction without the sensor states
of the segment, g the measured root mean square, s the sensor's own (soft tissue, mounting). With an unknown factor of
the variance, rho,

    g^2 ~ rho S^2 + s^2,    log rho ~ N(0, tau^2),

the mode of rho by n independent errors gives the certified error sqrt(rho) S: of swing, where sensors are exact, it is
what they measured, of twist, where they are not, rather what was stated. A mounting that was found from this motion may
only widen (rho >= 1). Constants and what they reach on held-out people: benchmarks/results/certificate.md.

The same for the image: points at the ends of the limbs are left out, and cameras beyond the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import RtofError
from rtof_kin.core.jobs import side_by_side
from rtof_kin.data.confidence import WORLD
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.camera_evidence import without_heading_drift
from rtof_kin.reconstruction.checks.position import PositionErrors
from rtof_kin.reconstruction.prepare import Job, silent
from rtof_kin.reconstruction.quality import with_covariances
from rtof_kin.reconstruction.sensors_alone import reconstruct_from_sensors
from rtof_kin.vision.image_points import image_points, measurements

SWING, TWIST = 0, 1  #: Columns: across the bone, and about it
SENSOR_SD: Final = np.radians((3.5, 9.0))  #: s, [rad] of a sensor on a body, swing and twist
_INDEPENDENT: Final = 2.0  #: n of one sensor and component: mostly constant errors
_TAU: Final = 3.0  #: of log rho
_LOG_FACTORS: Final = np.linspace(-4.0, 6.0, 401)  #: log rho that are tried
_FOUND_SD: Final = np.radians(3.0)  #: [rad] Stated standard deviation of a mounting that was estimated, not held
_BLOCK_S: Final = 2.0  #: [s] of the block bootstrap
_DRAWS: Final = 500
LEAST_SECONDS: Final = 4.0  #: [s] Shorter recordings are not certified
MOST_SECONDS: Final = 15.0  #: [s] of a longer recording that are certified: those in which the sensors turn most
_MARGIN_S: Final = 1.0  #: [s] of samples on both sides of them
LEAST_KNOWN_S: Final = 2.0  #: [s] of samples that a sensor needs to be compared
_MOVING: Final = 0.15  #: [rad/s] RMS below which a sensor does not show movement
_ENDS: Final = (("LeftHand", "RightFoot"), ("RightHand", "LeftFoot"), ("Head",))
"""Joints whose points in the image are left out together."""


@dataclass(frozen=True)
class LeftOut:
    """A sensor that was predicted from the rest; columns of (T, 2) are swing and twist."""

    sensor: str
    joint: str  #: Segment that carries it, by its proximal joint
    times: Array  #: (T,) s
    error: Array  #: (T, 2) rad, size of measured against predicted with the declared mounting; NaN where unknown
    movement: Array  #: (T, 2) rad, the same with mounting and heading of the other half of the time
    stated: Array  #: (T, 2) rad, standard deviations stated of the prediction; NaN in mode imu, and where `error` is
    sensor_sd: Array  #: (2,) rad, error of the sensor itself
    found: bool  #: Whether its mounting was found from this motion
    drift: Array  #: (2,) rad/s: drift of its heading against the prediction, and the standard deviation of that
    predicted: Array  #: (T, 3, 3) orientation of the segment in world without the sensor
    bone: Array  #: (3,) unit vector along the bone in the segment's axes; zero without one: all is swing
    rate_rms: Array  #: (2,) rad/s: RMS error of the predicted angular velocity, and RMS of the measured one
    force_rms: Array  #: (2,) m/s^2: of the acceleration at its place, likewise

    @property
    def moves(self) -> bool:
        """Whether the sensor moved enough to show an error of movement."""
        return bool(self.rate_rms[1] > _MOVING)

    @property
    def measured(self) -> Array:
        """(2,) rad, root mean square of measured against predicted."""
        return _rms(self.error)

    @property
    def moved(self) -> Array:
        """(2,) rad, root mean square of the error of the movement."""
        return _rms(self.movement)

    @property
    def expected(self) -> Array:
        """(2,) rad, root mean square of what was stated."""
        return _rms(self.stated)

    @property
    def certified(self) -> Array:
        """(2,) rad, error of the segment without its sensor, RMS."""
        factors = [factor([self], component) for component in (SWING, TWIST)]
        less = np.sqrt(np.maximum(self.measured**2 - self.sensor_sd**2, self.measured**2 / 4))
        return np.where(np.isfinite(self.expected), np.sqrt(factors) * self.expected, less)

    def against(self, R_world_bone: Array) -> Array:
        """Return swing and twist (T, 2), rad, of orientations (T, 3, 3) against the predicted ones."""
        return _parts(so3.known_log(np.swapaxes(self.predicted, -1, -2) @ R_world_bone), self.bone)

    def interval(self, values: Array) -> tuple[float, float]:
        """Return the 95 % interval of the RMS of values (T, ...), rad, by a bootstrap of blocks of `_BLOCK_S`."""
        known = np.asarray(np.isfinite(values).all(axis=1))
        squares, count = np.sum(np.nan_to_num(values) ** 2, axis=1) * known, _blocks(self.times)
        parts = np.array_split(np.arange(len(values)), count)
        blocks = np.array([[squares[part].sum(), known[part].sum()] for part in parts])
        drawn = blocks[np.random.default_rng(0).integers(count, size=(_DRAWS, count))].sum(axis=1)
        rms = np.sqrt(drawn[:, 0] / np.maximum(drawn[:, 1], 1))
        low, high = np.quantile(rms, (0.025, 0.975))
        return float(low), float(high)

    @property
    def sizes(self) -> Array:
        """(n,) rad, errors of the frames that are known, of the certified size."""
        size = np.linalg.norm(self.error, axis=1)
        scale = np.linalg.norm(self.certified) / np.linalg.norm(self.measured)
        return np.asarray(scale * size[np.isfinite(size)])

    def below(self, share: float) -> float:
        """Return the error, rad, that a share of the frames is below, of the certified size."""
        return float(np.quantile(self.sizes, share))


@dataclass(frozen=True)
class LeftOutPoints:
    """Points of the image that were predicted from the rest."""

    what: str  #: Joint whose points were left out, or 'view N'
    times: Array  #: (T,) s
    error: Array  #: (T,) m, beside the line of sight, at the distance of the person; NaN where unseen
    stated: Array  #: (T,) m, standard deviation of the predicted joint relative to the root, beside the line of sight

    @property
    def rms(self) -> float:
        """Root mean square error, m."""
        return float(_rms(self.error[:, None])[0])

    @property
    def expected(self) -> float:
        """Root mean square of what was stated, m; NaN where nothing was."""
        return float(_rms(self.stated[:, None])[0])


@dataclass(frozen=True)
class Certificate:
    """What left-out sensors and points say of a recording, or of its liveliest part."""

    start: float
    stop: float  #: [s] The part that was certified
    left_out: tuple[LeftOut, ...] = ()
    points: tuple[LeftOutPoints, ...] = ()
    untested: tuple[tuple[str, str], ...] = ()  #: Segments whose sensor shows nothing, and why
    reason: str = ""  #: Why nothing is certified; '' where something is

    @property
    def error(self) -> float:
        """Error of a segment without its sensor, RMS over sensors, rad; NaN without any."""
        return _pooled([one.certified for one in self.left_out])

    @property
    def expected(self) -> float:
        """The same as the reconstruction without the sensor stated it."""
        return _pooled([one.expected for one in self.left_out])

    @property
    def below_90(self) -> float:
        """Error, rad, that nine in ten frames of all left-out sensors are below."""
        if not self.left_out:
            return float("nan")
        sizes = [one.sizes for one in self.left_out]
        each = np.concatenate([np.full(len(own), 1 / len(own)) for own in sizes])  # a sensor counts as another
        return float(np.quantile(np.concatenate(sizes), 0.9, weights=each, method="inverted_cdf"))

    @property
    def ratio(self) -> float:
        """Certified error relative to the stated one, all sensors together; NaN where none was stated."""
        return float(np.sqrt(np.mean([factor(self.left_out, c) for c in (SWING, TWIST)])))

    def limb(self, skeleton: SkeletonModel) -> tuple[str, ...]:
        """Return the segments of the limb that carries all sensors; () where there are sensors elsewhere."""
        limbs = {_limb(skeleton, skeleton.index(one.joint)[0]) for one in self.left_out}
        if len(limbs) != 1:
            return ()
        return tuple(name for j, name in enumerate(skeleton.names) if _limb(skeleton, j) in limbs)

    def neighbours(self, joint: str, skeleton: SkeletonModel) -> tuple[LeftOut, ...]:
        """Return the left-out sensors nearest to a segment along the skeleton, all at the same distance."""
        lines = {name: {*kinematics.line_to_root(skeleton.parents, j)} for j, name in enumerate(skeleton.names)}
        far = {one.joint: len(lines[joint] ^ lines[one.joint]) for one in self.left_out}  # bones between them
        return tuple(one for one in self.left_out if far[one.joint] == min(far.values()))


def factor(left_out: Sequence[LeftOut], component: int) -> float:
    """Return rho of one component by all sensors given; NaN where nothing was stated."""
    known = [one for one in left_out if np.isfinite(one.expected[component] + one.measured[component])]
    if not known:
        return float("nan")
    loss = _LOG_FACTORS**2 / (2 * _TAU**2)
    for one in known:
        variance = np.exp(_LOG_FACTORS) * one.expected[component] ** 2 + one.sensor_sd[component] ** 2
        loss = loss + _INDEPENDENT / 2 * (np.log(variance) + one.measured[component] ** 2 / variance)
    best = float(np.exp(_LOG_FACTORS[np.argmin(loss)]))
    return max(best, 1.0) if all(one.found for one in known) else best


def certify(
    job: Job,
    mode: Mode,
    motion: Motion,
    rejected: tuple[StreamFault, ...] = (),
    calibration: SelfCalibration | None = None,
) -> Certificate:
    """Predict each sensor, and groups of points of the image, from all the rest.

    Args:
        job: with the recording as it was solved. motion: that was found with all sensors.
        rejected: intervals of sensors that are not used, by segment. calibration: that was applied.
    """
    times, measured = motion.times, job.recording.bone_imus()
    start, stop = float(times[0]), float(times[-1])
    reason = impossible(mode, () if measured is None else measured.joints, stop - start)
    if any(fault.kind is FaultKind.FOREIGN for fault in rejected):
        reason = "the sensors do not belong to this video, and testify nothing of it"
    if reason or measured is None:
        return Certificate(start, stop, reason=reason)
    if stop - start > MOST_SECONDS:
        times = times[_liveliest(measured.resample(times), motion.poses.rate_hz)]
        start, stop = float(times[0]), float(times[-1])
        job = replace(job, recording=job.recording.between(start - _MARGIN_S, stop + _MARGIN_S))
    report, job = job.progress, replace(job, times=times, progress=silent)
    imus, measured = job.recording.imus, job.recording.bone_imus(times=times)
    if imus is None or measured is None:
        return Certificate(start, stop, reason="the sensors have no samples")
    seconds = np.isfinite(measured.R_world_bone[:, :, 0, 0]).sum(axis=0) / motion.poses.rate_hz
    carried = zip(imus.names, measured.joints, seconds >= LEAST_KNOWN_S, strict=True)
    work = [_Without(job, mode, rejected, calibration, sensor=s, joint=joint) for s, joint, known in carried if known]
    untold = set(measured.joints) - {one.joint for one in work}
    untested = [(joint, f"its sensor has less than {LEAST_KNOWN_S:g} s of samples there") for joint in sorted(untold)]
    if mode == "rtof":
        views = len(job.recording.views)
        work += [_Without(job, mode, rejected, calibration, joints=ends) for ends in _ENDS]
        work += [_Without(job, mode, rejected, calibration, views=True)] if views else []
    found, points = list[LeftOut](), list[LeftOutPoints]()
    report("certificate", 0, len(work))
    for done, (one, predicted) in enumerate(zip(work, side_by_side(_Without.predicted, work), strict=True), start=1):
        report("certificate", done, len(work))
        if predicted is None:
            untested += [(one.joint, "without its sensor nothing could be reconstructed")] if one.sensor else []
        elif one.sensor:
            found.append(_compared(one, predicted, measured.select((one.joint,))))
        else:
            points += one.compared_points(predicted)
    reason = "" if found else f"no sensor could be left out: {untested[0][0]}, {untested[0][1]}"
    return Certificate(start, stop, tuple(found), tuple(points), tuple(untested), reason)


def _liveliest(measured: BoneImuSequence, rate_hz: float) -> slice:
    """Return the frames of `MOST_SECONDS` in which the sensors turn most."""
    R, count = measured.R_world_bone, round(MOST_SECONDS * rate_hz)
    turns = np.nan_to_num(so3.angle_between(R[:-1], R[1:])).sum(axis=1)
    so_far = np.concatenate([[0.0], np.cumsum(turns)])
    first = int(np.argmax(so_far[count:] - so_far[:-count]))
    return slice(first, first + count)


def impossible(mode: Mode, joints: Sequence[str], seconds: float) -> str:
    """Return why no sensor can be left out; '' if one can. joints: of the segments with sensors."""
    if not joints:
        return "a camera alone proves no angle: add a sensor, or evaluate against a reference"
    if mode not in ("rtof", "imu"):
        return f"mode {mode} is not tested by sensors: use rtof"
    if len(joints) < 2:
        return "one sensor leaves no other to predict it from: add one"
    if seconds < LEAST_SECONDS:
        return f"{seconds:.1f} s are too short: record {LEAST_SECONDS:g} s at least"
    return ""


@dataclass(frozen=True)
class _Without:
    """A reconstruction without a sensor, without the points of some joints, or by the first camera alone."""

    job: Job
    mode: Mode
    rejected: tuple[StreamFault, ...]
    calibration: SelfCalibration | None
    sensor: str = ""
    joint: str = ""
    joints: tuple[str, ...] = ()
    views: bool = False

    def predicted(self) -> Motion | None:
        """Return the motion; None where it cannot be solved."""
        imus = self.job.recording.imus
        assert imus is not None
        recording = replace(self.job.recording, truth=None)
        if self.sensor:
            recording = replace(recording, imus=imus.select([name for name in imus.names if name != self.sensor]))
        if self.joints:
            recording = replace(recording, keypoints=self._masked(recording.video))
        if self.views:
            recording = replace(recording, views=())
        # Room for all sensors, so that the compiled energy is the same.
        places = (*self.job.settings.sensor_joints, *(recording.calibration.joints if recording.calibration else ()))
        settings = replace(self.job.settings, sensor_joints=places, checks=False)
        job = replace(self.job, recording=recording, settings=settings)
        rejected = tuple(fault for fault in self.rejected if fault.what != self.joint)
        try:
            if self.mode == "imu":
                return reconstruct_from_sensors(job).motion
            prepared = job.prepare(self.mode, rejected, self.calibration)
            solution = job.solve(prepared, confidence=True)
        except RtofError:
            return None
        motion = prepared.skeleton.motion(solution.poses)
        return with_covariances(motion, prepared, solution, (), PositionErrors.declared(recording))[0]

    def _masked(self, keypoints: KeypointSequence) -> KeypointSequence:
        """The keypoints without what shows the joints that are left out."""
        skeleton = self.job.subject
        used = dict.fromkeys((*keypoints.landmarks.names, *measurements(keypoints, skeleton).names))
        anchors, ends = image_points(skeleton, tuple(used)).anchors, skeleton.index(*self.joints)
        gone = {name for name, anchor in zip(used, anchors, strict=True) if anchor in ends}
        hidden = np.array([name in gone for name in keypoints.names])
        return replace(keypoints, confidence=np.where(hidden, 0.0, keypoints.confidence))

    def compared_points(self, predicted: Motion) -> Iterator[LeftOutPoints]:
        """Yield the errors of the points that were left out."""
        recording, poses, known = self.job.recording, predicted.poses, predicted.confidence
        imus = recording.bone_imus(times=predicted.times)
        cameras = recording.views if self.views else (recording.video,)
        for number, seen in enumerate(cameras, start=2):
            seen = seen.resample(predicted.times)
            if not self.views and seen.camera.heading_drift and imus is not None:  # as `Job.prepare` removes it
                seen = without_heading_drift(seen, imus, self.job.subject, self.job.lifter)
            seen = seen.landmarks
            points = image_points(self.job.subject, seen.names)
            at = points.positions(poses.p_world_joint, poses.R_world_bone)
            off = seen.uv_px - seen.camera.project(at)
            off = np.linalg.norm(off, axis=-1) * seen.camera.to_camera(at)[..., 2] / seen.camera.K[0, 0]
            anchors = list(points.anchors)
            sigma = off * np.nan if known is None else np.sqrt(2) * known.relative_sigma[:, anchors]
            groups = [f"view {number}"] if self.views else self.joints
            for group in groups:
                own = np.full(len(anchors), True)
                if not self.views:
                    own = np.equal(anchors, self.job.subject.index(group)[0])
                if np.isfinite(off[:, own]).any():
                    yield LeftOutPoints(group, predicted.times, _mean_square(off[:, own]), _mean_square(sigma[:, own]))


def _compared(one: _Without, predicted: Motion, measured: BoneImuSequence) -> LeftOut:
    skeleton, poses = predicted.skeleton, predicted.poses
    j = skeleton.index(one.joint)[0]
    B, M = poses.R_world_bone[:, j], measured.R_world_bone[:, 0]
    bone = skeleton.bone_axis(one.joint)
    covariance = None if predicted.confidence is None else predicted.confidence.turn(WORLD, one.joint)
    stated = np.full((len(B), 2), np.nan)
    if covariance is not None:
        about = np.einsum("i,tij,j->t", bone, covariance, bone)
        across = np.trace(covariance, axis1=1, axis2=2) - about
        stated = np.sqrt(np.maximum(np.stack([across, about], axis=1), 0.0))
    error, aligned = so3.known_log(np.swapaxes(B, -1, -2) @ M), M.copy()
    known = np.isfinite(error).all(axis=1)
    stated[~known] = np.nan
    first = np.cumsum(known) <= known.sum() // 2
    for own, other in ((first, ~first), (~first, first)):
        H, C = _mounting(B[other & known], M[other & known])
        aligned[own] = H @ M[own] @ C
    movement = so3.known_log(np.swapaxes(B, -1, -2) @ aligned)
    turning = so3.known_log(M @ np.swapaxes(B, -1, -2))[:, 2]
    declared, sd = one.job.recording.calibration, 0.0
    assert declared is not None
    if declared.mounting_sd_deg is not None:
        sd = float(np.nan_to_num(np.radians(declared.mounting_sd_deg[declared.sensors.index(one.sensor)])))
    estimated = one.calibration is not None and bool(one.calibration.of_kind("mounting"))
    lever = np.einsum("tij,j->ti", poses.R_world_bone[:, j], measured.p_bone_sensor[0])
    path = poses.p_world_joint[:, j] + lever
    acceleration = np.diff(path, n=2, axis=0) * poses.rate_hz**2
    return LeftOut(
        one.sensor,
        one.joint,
        predicted.times,
        _parts(error, bone),
        _parts(movement, bone),
        stated,
        np.sqrt(SENSOR_SD**2 + np.array([2.0, 1.0]) * sd**2),
        bool(estimated or sd > _FOUND_SD),
        _slope(predicted.times, turning),
        B,
        bone,
        _pair(_rates(B, poses.rate_hz), _rates(aligned, poses.rate_hz)),
        _pair(acceleration, measured.a_world[1:-1, 0]),
    )


def _mounting(B: Array, M: Array) -> tuple[Array, Array]:
    """Return the rotation H about the vertical and the constant C (3, 3) that bring H M C next to B (n, 3, 3)."""
    H, C = np.eye(3), np.eye(3)
    for _ in range(20):
        C = so3.nearest_rotation(np.einsum("tji,tjk->ik", H @ M, B))
        W = np.einsum("tij,tkj->ik", B, M @ C)
        H = so3.about_axis("z", np.arctan2(W[1, 0] - W[0, 1], W[0, 0] + W[1, 1]))
    return H, C


def _parts(error: Array, bone: Array) -> Array:
    """Return swing and twist (T, 2) of rotation vectors (T, 3)."""
    about = error @ bone
    return np.stack([np.linalg.norm(error - about[:, None] * bone, axis=1), about], axis=1)


def _rates(R: Array, rate_hz: float) -> Array:
    """Return angular velocities (T - 2, 3) in the axes of R (T, 3, 3), rad/s."""
    return so3.known_log(np.swapaxes(R[:-2], -1, -2) @ R[2:]) * rate_hz / 2


def _pair(predicted: Array, measured: Array) -> Array:
    """Return the RMS of the difference of vectors (T, 3), and of the measured ones."""
    off = predicted - measured
    known = np.isfinite(off).all(axis=1)
    both = [np.sqrt(np.mean(np.sum(v[known] ** 2, axis=1))) if known.any() else np.nan for v in (off, measured)]
    return np.array(both)


def _slope(times: Array, values: Array) -> Array:
    """Return the slope (2,) of values (T,) over times (T,), 1/s, and its standard deviation by independent blocks."""
    known = np.isfinite(values)
    if known.sum() < 3:
        return np.full(2, np.nan)
    t, y = times[known], values[known]
    slope, offset = np.polyfit(t, y, 1)
    return np.array([slope, np.std(y - slope * t - offset) / (np.std(t) * np.sqrt(_blocks(times)))])


def _blocks(times: Array) -> int:
    """Return the number of blocks that are independent."""
    return max(1, round(float(times[-1] - times[0]) / _BLOCK_S))


def _rms(values: Array) -> Array:
    """Root mean square over frames of (T, n)."""
    known = np.isfinite(values).all(axis=1)
    return np.sqrt(np.mean(values[known] ** 2, axis=0)) if known.any() else np.full(values.shape[1], np.nan)


def _mean_square(values: Array) -> Array:
    """Root mean square (T,) over points of (T, L); NaN where none is known."""
    known = np.isfinite(values)
    total, count = np.sum(np.where(known, values, 0.0) ** 2, axis=1), known.sum(axis=1)
    return np.asarray(np.sqrt(np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)))


def _pooled(parts: Sequence[Array]) -> float:
    """Root of the mean over sensors of the squares of swing and twist (2,) together."""
    return float(np.sqrt(np.mean([np.sum(part**2) for part in parts]))) if parts else float("nan")


def _limb(skeleton: SkeletonModel, joint: int) -> int:
    """Return the first segment of the chain without branches that a segment belongs to."""
    while (parent := skeleton.parents[joint]) >= 0 and len(kinematics.children_of(skeleton.parents, parent)) == 1:
        joint = parent
    return joint
