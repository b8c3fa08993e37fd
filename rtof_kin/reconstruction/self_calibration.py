"""Calibration of a recording from its own motion: stages before it, and what if it is impossible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np

from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.camera_estimate import CameraEstimate, Evidence, estimate_camera
from rtof_kin.calibration.clock_scan import (
    AngularVelocities,
    ClockScan,
    angular_velocities,
    joined,
    velocities_in_image,
)
from rtof_kin.calibration.clocks import REPEATED, ClockEstimate, small_offset
from rtof_kin.calibration.estimate import calibrate as estimate_calibration
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SIGMA_DETECTOR, Quantity, SelfCalibration, Verdict
from rtof_kin.calibration.shared_fragments import Slice
from rtof_kin.calibration.straight_legs import NEVER_STILL
from rtof_kin.core.array_types import blocks_of
from rtof_kin.core.checks import Check
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import CalibrationError, InvalidInputError, RtofError
from rtof_kin.core.jobs import side_by_side
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.camera_evidence import Scene, evidence, standing_feet
from rtof_kin.reconstruction.checks.camera import check_camera_alone
from rtof_kin.reconstruction.checks.sensors import check_sensor_form
from rtof_kin.reconstruction.lift import LifterLike, lift
from rtof_kin.reconstruction.prepare import Job, Prepared, Progress, silent
from rtof_kin.reconstruction.quality import reprojection_errors
from rtof_kin.reconstruction.result import Choices
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.settings import JointSpaceSettings


def calibrate_recording(
    recording: Recording,
    skeleton: SkeletonModel | None = None,
    priors: CalibrationPriors | None = None,
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    progress: Progress | None = None,
) -> SelfCalibration:
    """Calibrate a recording from its own motion; see `rtof_kin.calibration.estimate`. `CalibrationError`: the recording
    has no IMUs, or too little in common with its video. Errors of the stages.

    Args:
        skeleton: default: that of the recording.
        priors: unknowns and their prior standard deviations. Default: `CalibrationPriors.of` the recording.
        lifter, settings, progress: as for `reconstruct`.
    """
    if recording.imus is None:
        raise CalibrationError(
            f"recording {recording.name}: has no IMUs, and self-calibration needs them; "
            "add them, or reconstruct it as it is with mode 'rto'"
        )
    job = Job.of(recording, skeleton, lifter, settings, progress)
    return calibrated([job], priors, None)


def estimated(
    jobs: Sequence[Job], priors: CalibrationPriors | None, known: SelfCalibration | None
) -> tuple[SelfCalibration | None, tuple[str, ...]]:
    """Return the self-calibration of a recording, joined with what is known, and warnings.

    Where it is impossible, a warning says why; with `priors` that is an error.

    Args:
        jobs: on the recording, or on parts of it in the order of time. priors, known: as for `reconstruct`.
    """
    try:
        found = calibrated(jobs, priors, known)
    except CalibrationError as error:
        if priors is not None:
            raise
        return known, (f"not calibrated from the recording, which is used as given: {error}",)
    return found, consistency_warnings(jobs[0].recording, found)


def calibrated(jobs: Sequence[Job], priors: CalibrationPriors | None, known: SelfCalibration | None) -> SelfCalibration:
    """Self-calibration, joined with what is known."""
    own = [_prior_body(job, known) for job in jobs]
    recording, settings = own[0].recording, own[0].settings
    priors = priors or CalibrationPriors.of(recording)
    if known is not None and known.ankle_height:
        priors = replace(priors, sigma_ankle_height=None)
    solver = settings.fragment
    if not isinstance(solver, JointSpaceSettings):  # calibration is always solved in joint space
        solver = JointSpaceSettings(floor_height=recording.floor_height)
    slices = list[Slice]()
    for job in own:
        prepared = job.prepare("sf2", calibration=known)
        assert prepared.bone_imus is not None  # without IMUs, mode sf2 has raised
        used = replace(prepared, settings=job.settings.with_fragment(solver))
        slices.append(Slice(prepared.recording, used.guess, prepared.bone_imus))
    progress = partial(own[0].progress, "calibrate")
    found = estimate_calibration(
        slices, priors, solver, settings.frames, progress, without_slipped="motion" in settings.guards
    )
    return found if known is None else known.followed_by(found)


def _prior_body(job: Job, known: SelfCalibration | None) -> Job:
    recording = job.recording
    if job.skeleton is not None:
        offsets = job.skeleton.joint_offsets
        recording = replace(recording, joint_offsets=offsets, height=None, bone_lengths=None, sigma_bones=None)
    recording = recording if known is None else known.apply(recording)
    return replace(job, recording=recording, skeleton=None).with_solver(known)


_SIGMAS = 6.0
"""Prior standard deviations beyond which an estimate contradicts the prior; sensors that slip all through
a short recording reach four in one of three."""


def consistency_warnings(recording: Recording, calibration: SelfCalibration) -> tuple[str, ...]:
    """Describe estimates that contradict their priors or the declared height."""
    found = []
    for q, row in zip(calibration.quantities, calibration.table(), strict=True):
        if q.doubt:
            found.append(f"{row[0]} of {row[1]}: {row[2]} is unreliable: {q.doubt}")
        away = float(np.max(np.abs(q.value) / q.sigma_prior))
        if q.verdict is not Verdict.PRIOR and away > _SIGMAS:
            kind, item, value, _, prior, _ = row
            found.append(
                f"{kind} of {item}: {value} is {away:.0f} times its prior standard deviation {prior}; "
                "its declared value is wrong, or another declaration is"
            )
    declared = recording.height
    if declared is not None and any(line.startswith("bones") for line in found):
        made = calibration.apply(recording).skeleton.height
        found.append(f"the declared height is {declared:.2f} m; the estimated bones make {made:.2f} m")
    return tuple(found)


_MOST_SECONDS = 40.0  # [s] of a longer recording that are used: those in which the person comes and goes most
_ENOUGH_HZ = 25.0  # Frames per second that are enough; of faster videos, every second, third ... frame is used.
_STEP = 5.0  # [s] between the beginnings of excerpts that are compared


def with_camera(recording: Recording, camera: Camera) -> Recording:
    """Return a recording with another first camera, those of further views carried along."""
    before, views = recording.video.camera, recording.views
    views = tuple(replace(view, camera=view.camera.carried(before, camera)) for view in views)
    return replace(recording, keypoints=replace(recording.video, camera=camera), views=views)


def find_camera(job: Job, mode: Mode) -> CameraEstimate:
    """Estimate the unknowns of the first camera without further views; by solved poses in modes with sensors, else by
    lifted ones. Errors of the stages, with the camera as declared.
    """
    sensed, job = job.sensed(mode), job.with_solver(None)
    report = partial(job.progress, "camera")
    seen = job.recording.video
    recording = replace(job.recording, keypoints=excerpt(seen), views=(), truth=None)

    job = replace(job, recording=recording, progress=silent)
    prepared, poses = _solved(job, sensed)
    clean, imus, floor = prepared.recording, prepared.bone_imus, recording.floor_height
    if imus is not None and not np.isfinite(imus.R_world_bone).any():
        imus = None
    fresh = seen.camera.uncertainty is None or not seen.camera.uncertainty.of_motion
    scene = Scene(job.subject, floor, standing_feet(clean.video, poses, job.subject), imus, fresh)
    seen_by = partial(_evidence, replace(job, recording=clean), sensed, scene)
    return estimate_camera(seen.camera, seen_by, report)


def _solved(job: Job, sensed: bool) -> tuple[Prepared, PoseSequence]:
    if sensed:
        return job.solved_again(job.recording, "rtof")
    prepared = job.prepare("rto")
    return prepared, prepared.start


def _evidence(job: Job, sensed: bool, scene: Scene, camera: Camera) -> Evidence:
    """Evidence of a recording if it was made by a camera."""
    job = replace(job, recording=with_camera(job.recording, camera))
    prepared, poses = _solved(job, sensed)
    by_image = prepared.lifted.poses
    if scene.bone_imus is not None:
        by_image = lift(job.recording.video, job.subject, job.lifter, None, job.recording.floor_height).poses
    return evidence(scene, job.recording.video, by_image, poses)


def excerpt(keypoints: KeypointSequence) -> KeypointSequence:
    """Return the part of a long video in which the person's size changes most; of a fast one, fewer frames."""
    rate_hz = 1 / float(np.median(np.diff(keypoints.times))) if len(keypoints) > 1 else 0.0
    step = max(1, int(rate_hz / _ENOUGH_HZ))
    times, v = keypoints.times[::step], keypoints.uv_px[::step, :, 1]
    if times[-1] - times[0] <= _MOST_SECONDS:
        return keypoints[::step]
    tall = np.full(len(times), np.nan)
    for rows in blocks_of(len(times)):
        enough = np.flatnonzero(np.isfinite(v[rows]).sum(axis=1) > v.shape[1] / 2) + rows.start
        tall[enough] = np.log(np.nanmax(v[enough], axis=1) - np.nanmin(v[enough], axis=1) + 1.0)
    starts = np.arange(times[0], times[-1] - _MOST_SECONDS + _STEP, _STEP)
    parts = [slice(*np.searchsorted(times, [t, t + _MOST_SECONDS])) for t in starts]

    def spread(part: slice) -> float:
        known = tall[part][np.isfinite(tall[part])]
        return float(np.subtract(*np.percentile(known, [90, 10]))) if len(known) else -1.0

    part = max(parts, key=spread)
    return keypoints[part.start * step : part.stop * step : step]


NAME: Final = "motion that the sensors do not explain, relative to what they explain"
DAYS_APART: Final = "video and sensors are of different days"
CLOCK_DOUBT: Final = "when the sensors began is in doubt"  # Beginnings of notes of a recording that was set up so
_SIGMAS_APART: Final = 3.0
_LEAST = 0.01  # Standard deviations and [s] from which an offset is corrected
_NAMED = 0.03  # [s] Offset, also by drift, from which it is named
_UNSHARP = 0.01  # [s] Standard deviation above which the energy decides
_EXCERPT = 2.5  # [s] of the recording that it takes
_SURE_DRIFT_UNNAMED = 1.5  # Standard deviations from which a drift that is not sure counts as uncertain
_FEW: Final = 4
_EXPLAINED: Final = (0.05, 0.1)
"""[1] Part of the image's motion that the sensors of a recording explain at least, of fewer than `_FEW`
sensors and of more; right ones explain 0.2 at least, of those of other takes one in twenty explains 0.1
(benchmarks/results/clock_offsets.md)."""
_SUSPECT: Final = 0.3  # [1] Part below which it is looked at whether they contradict the image
_ANYWHERE: Final = (0.15, 0.2)
"""[1] The same at offsets up to `_ELSEWHERE` or on other segments, by which a wrong start or map is named."""
_FURTHER: Final = 1.4
"""[1] Mean reprojection error with the sensors, relative to that without them, from which they contradict the image:
at most 1.3 with right ones, at least 1.5 with a wrong start, 1.8 of other takes, 2.5 with sides exchanged."""
_ELSEWHERE = 6.0  # [s] Offsets at which sensors may be that belong to the video
_MOVING = 0.15  # [rad/s] per axis: motion of the sensors below which nothing relates them to the image


@dataclass(frozen=True)
class ClockOffset:
    """What is known of the clocks of a recording."""

    delay: Quantity | None = None  # Delay of the video; None where the motion does not show it
    applied: SelfCalibration | None = None  # Correction of the recording; None where none is sure
    checks: tuple[Check, ...] = ()  # That the sensors belong to the video
    warnings: tuple[str, ...] = ()
    middle: float = 0.0  # [s] Time stamp of the constant of the delay
    uncertain_drift: float = 0.0  # [s/s] Drift that is likely, but not sure
    repeats: float = 0.0
    """[s] Time after which the motion repeats itself, where the sensors may be a repetition off; else 0."""

    @property
    def foreign(self) -> bool:
        """Whether the sensors are of another recording."""
        return any(check.failed for check in self.checks)

    def corrected(self, job: Job) -> Job:
        """Return the job on the recording with corrected clocks."""
        if self.applied is None:
            return job
        times = None if job.times is None else self.applied.on_clock(job.times)
        return replace(job, recording=self.applied.apply(job.recording), times=times)

    def left_out(self, job: Job) -> tuple[StreamFault, ...]:
        """Return faults of all sensors where they are of another recording."""
        imus, calibration = job.recording.imus, job.recording.calibration
        if not self.foreign or imus is None or calibration is None:
            return ()
        a, b = float(imus.times[0]), float(imus.times[-1])
        joints = calibration.select(imus.names).joints
        return tuple(StreamFault(FaultKind.FOREIGN, joint, a, b) for joint in joints)

    def apart(self, poses: PoseSequence) -> tuple[PoseSequence, ...]:
        """Return the motion one standard deviation of the clocks later, for its covariances."""
        if self.delay is None or self.foreign:
            return ()
        sigma = float(self.delay.sigma[0])
        if self.applied is not None and self.applied.sensors_late:
            sigma = float(np.hypot(sigma, SIGMA_DETECTOR))
        rate = self.uncertain_drift or float(np.append(self.delay.sigma, 0.0)[1])
        later = np.hypot(sigma, rate * (poses.times - self.middle))
        shifted = (replace(at_times(poses, poses.times + later), times=poses.times),)
        return (*shifted, self._repeated(poses)) if self.repeats else shifted

    def _repeated(self, poses: PoseSequence) -> PoseSequence:
        """Return the motion of the next repetition, of the last one at the end, at the same place."""
        ahead, back = (at_times(poses, poses.times + by) for by in (self.repeats, -self.repeats))
        within = (ahead.times >= poses.times[0]) & (ahead.times <= poses.times[-1])
        p = np.where(within[:, None, None], ahead.p_world_joint, back.p_world_joint)
        R = np.where(within[:, None, None, None], ahead.R_world_bone, back.R_world_bone)
        return replace(poses, p_world_joint=p + (poses.p_world_joint - p)[:, :1], R_world_bone=R)


@dataclass(frozen=True)
class Given:
    """What a caller of `reconstruct` knows or wants of the calibration of a recording."""

    calibrate: bool = False
    priors: CalibrationPriors | None = None
    calibration: SelfCalibration | None = None
    known: SelfCalibration | None = None  # Of another recording of the same person


@dataclass(frozen=True)
class SetupEstimate:
    """What is estimated once of a recording, before its motion is solved: clocks, camera and calibration."""

    calibration: SelfCalibration | None = None
    camera: CameraEstimate | None = None  # None for a calibrated one
    clocks: ClockOffset = field(default_factory=ClockOffset)
    choices: Choices = field(default_factory=Choices)
    warnings: tuple[str, ...] = ()

    def corrected(self, job: Job) -> Job:
        """Return the job on a recording with these clocks and this camera."""
        job = self.clocks.corrected(job)
        return job if self.camera is None else replace(job, recording=with_camera(job.recording, self.camera.found))


def estimate_setup(
    job: Job, mode: Mode, given: Given, slices: Sequence[Job] | None = None, filmed: Job | None = None
) -> SetupEstimate:
    """Estimate the clocks, a camera that is not calibrated, and the calibration unless it is given. Errors of the
    stages.

    Args:
        job: on the recording, or its first part. slices: on excerpts of a long one, in the order of time, by which
            clocks and calibration are estimated; filmed: the same for its camera, which the image alone shows then.
    """
    if mode == "imu":
        return SetupEstimate()
    own = job.recording.keypoints
    if own is None:
        raise InvalidInputError(f"mode {mode} needs keypoints and the recording has none; use 'imu'")
    sensed, calibration, known = job.sensed(mode), given.calibration, given.known
    name = "detections" if job.lifter is None else getattr(job.lifter, "name", type(job.lifter).__name__)
    calibrate = given.calibrate and sensed and calibration is None
    choices = Choices("given" if calibration is not None else "yes" if calibrate else "no", known is not None, name)
    jobs, clocks, camera = [job] if slices is None else slices, ClockOffset(), None
    if sensed and (calibration is None or not calibration.of_kind("delay")):
        clocks = find_offset(jobs)
    warnings = clocks.warnings
    if own.camera.uncertainty is not None:
        camera = find_camera(clocks.corrected(filmed or job), mode if filmed is None else "lift")
        warnings += camera.sentences
    known = None if known is None else known.for_another_recording()
    setup = SetupEstimate(known, camera, clocks, choices, warnings)
    if calibration is not None:
        return replace(setup, calibration=calibration if known is None else known.followed_by(calibration))
    if calibrate and jobs and not clocks.foreign:
        calibration, more = estimated([setup.corrected(own) for own in jobs], given.priors, known)
        return replace(setup, calibration=calibration, warnings=(*warnings, *more))
    return setup


def find_offset(jobs: Sequence[Job]) -> ClockOffset:
    """Estimate the clocks of jobs in the order of time; nothing where no person is seen or nothing moves.

    Angular velocities of the limbs in a lift of the image alone are compared with those of the sensors
    (`calibration.clocks.small_offset`); where that leaves more than `_UNSHARP`, the energy of a short excerpt decides.
    """
    if not jobs:
        return ClockOffset()
    try:
        seen, sensed, columns = _angular_velocities(jobs)
        found = small_offset(seen.of(columns), sensed)
    except RtofError:  # without keypoints or calibration the stages say so
        return ClockOffset()
    moves = bool(np.nanmean(sensed.w_world**2) >= _MOVING**2)
    suspect = moves and found.explained < _SUSPECT and as_declared(jobs[0])
    contradict = suspect and _contradicts_image(jobs[0])
    check = _check_belonging(jobs[0], seen, sensed, columns, found, contradict)
    middle = float(found.middle + found.offset)
    rates = [found.drift] if found.drift else []
    sigmas = [found.sigma, *(found.sigma_drift for _ in rates)]
    delay = _delay([found.offset, *rates], sigmas, found.doubt)
    lines, told = jobs[0].recording.notes.splitlines(), (DAYS_APART, CLOCK_DOUBT, NEVER_STILL)
    noted = tuple(line[line.index(note) :] for note in told for line in lines if note in line)
    if check.failed:
        return ClockOffset(checks=(check,), warnings=noted)
    if not found.doubt and not rates and found.sigma > _UNSHARP:
        delay = _refined(jobs, delay, middle)
    larger = abs(found.offset) > max(_SIGMAS_APART * delay.sigma[0], _LEAST)
    applied = None
    if not found.doubt and (larger or rates):
        applied = SelfCalibration((delay,), middle=middle)
    unsure = 0.0
    if not rates and abs(found.likely_drift) > _SURE_DRIFT_UNNAMED * found.sigma_drift:
        unsure = found.likely_drift
    seconds = float(jobs[-1].recording.video.times[-1] - jobs[0].recording.video.times[0])
    warnings = (*noted, *_sentences(delay, applied, found, seconds, contradict))
    doubt = next((note for note in noted if note.startswith(CLOCK_DOUBT)), "")
    if not doubt:
        return ClockOffset(delay, applied, (check,), warnings, middle, unsure)
    others = ClockScan.of(seen.of(columns), sensed, 0.0, _ELSEWHERE).rivals(REPEATED)
    stride = min(others, key=abs, default=0.0)
    return ClockOffset(replace(delay, doubt=doubt), applied, (check,), warnings, middle, unsure, stride)


def _delay(value: Sequence[float], sigma: Sequence[float], doubt: str = "") -> Quantity:
    prior = np.array([0.29, 0.01])[: len(value)]
    sigmas = np.minimum(sigma, prior)
    known = float(1 - (sigmas[0] / prior[0]) ** 2)
    return Quantity("delay", "video", np.array(value), sigmas, prior, known, doubt)


def _angular_velocities(jobs: Sequence[Job]) -> tuple[AngularVelocities, AngularVelocities, list[int]]:
    """Angular velocities of segments by the image alone and of sensors, and the segments of the sensors."""
    quiet, parts = [replace(job, progress=silent) for job in jobs], list[Any]()
    jobs[0].progress("lift", 0, len(jobs))
    for found in side_by_side(_velocities_of, quiet):
        parts.append(found)
        jobs[0].progress("lift", len(parts), len(jobs))
    seen, sensed, columns = zip(*parts, strict=True)
    return joined(seen), joined(sensed), columns[-1]


def _velocities_of(job: Job) -> tuple[AngularVelocities, AngularVelocities, list[int]]:
    """`_angular_velocities` of one job."""
    recording = job.recording
    if recording.imus is None or recording.calibration is None:
        raise CalibrationError(f"recording {recording.name}: has no calibrated IMUs")
    lifted = replace(job, recording=replace(recording, views=())).prepare("lift")
    native = recording.calibration.apply(recording.imus)
    seen = velocities_in_image(lifted.stages["lift"], lifted.recording.video, lifted.skeleton)
    return seen, angular_velocities(native.times, native.R_world_bone), list(lifted.skeleton.index(*native.joints))


def _refined(jobs: Sequence[Job], delay: Quantity, middle: float) -> Quantity:
    only = CalibrationPriors(
        sigma_delay=float(delay.sigma[0]),
        sigma_swing=None,
        sigma_image_bias=None,
        sigma_ankle_height=None,
        most_seconds=_EXCERPT,
        rounds=1,
    )
    first = ClockOffset(applied=SelfCalibration((delay,), middle=middle))
    quiet = [replace(first.corrected(job), progress=silent) for job in jobs]
    try:
        found = calibrated(quiet, only, None)["delay", "video"]
    except RtofError:
        return delay
    return _delay([delay.value[0] + found.value[0]], [found.sigma[0]])


def _check_belonging(
    job: Job,
    seen: AngularVelocities,
    sensed: AngularVelocities,
    columns: list[int],
    found: ClockEstimate,
    contradict: bool,
) -> Check:
    S = len(columns)
    least, explained = _EXPLAINED[S >= _FEW], found.explained
    cause = "the sensors do not belong to this video"
    advice = f"At no offset within {_ELSEWHERE:g} s and on no segment do they turn as the limbs in the video"
    if explained < least:
        if not contradict:
            why = "the sensors or what the image shows of them hardly move, or they or the camera are not as declared"
            return Check.unknown(NAME, "sensors", "", why)
        carriers = {joint for joint, _ in job.subject.sensors.values()}
        carriers |= {job.subject.names[j] for j in columns}
        anywhere = list(job.subject.index(*sorted(carriers)))
        for segments, known in ((columns, True), (anywhere, False)):
            scan = ClockScan.of(seen.of(segments), sensed, 0.0, _ELSEWHERE, known)
            best = scan.peaks[0][0]
            if scan.explained >= _ANYWHERE[S >= _FEW]:
                when = f"{abs(best):.1f} s {'later' if best > 0 else 'earlier'} than declared"
                other = f"began {when}" if known else "are on other segments"
                cause += f", or they {other}"
                advice = f"They would turn as the limbs in the video if they {other}"
                break
    return Check(
        NAME,
        "sensors",
        (1 - explained) / max(explained, 1e-3),
        (1 - least) / least,
        "times",
        f"{advice}; they are left out. Give the sensors' file of this take, or check the rates of video and "
        "sensors, start_s and which sensor is where",
        cause=cause,
    )


def as_declared(job: Job) -> bool:
    """Return whether no check of the sensors' form, or of the camera alone, fails: such an error would explain more."""
    form = (*check_sensor_form(job.recording), *check_camera_alone(job.recording, job.subject, job.lifter))
    return not any(check.failed for check in form)


def _contradicts_image(job: Job) -> bool:
    """Return whether the motion with the sensors is further from the keypoints than that without them."""
    job, modes, errors = job.with_solver(None), tuple[Mode, ...](("rtof", "rto")), list[float]()
    for mode in modes:
        prepared, poses = job.solved_again(job.recording, mode)
        off = reprojection_errors(prepared.recording.video, prepared.skeleton, poses)
        errors.append(float(np.nanmean(off)))
    return errors[0] > _FURTHER * errors[1]


def _sentences(
    delay: Quantity, applied: SelfCalibration | None, found: ClockEstimate, seconds: float, contradict: bool
) -> list[str]:
    said, ms = [], 1000 * delay.sigma[0]
    if len(delay.value) > 1 and abs(delay.value[1]) * seconds / 2 > _NAMED:
        rate, sigma = -100 * delay.value[1], 100 * delay.sigma[1]
        word = "fast" if rate > 0 else "slow"
        said.append(f"the sensors' clock runs {abs(rate):.2g} ± {sigma:.1g} % {word} against the video's; corrected")
    late = 0.0 if applied is None else 1000 * applied.sensors_late
    if abs(late) > 1000 * _NAMED:
        word = "late" if late > 0 else "early"
        ms = float(np.hypot(ms, 1000 * SIGMA_DETECTOR))
        said.append(f"the sensors are {abs(late):.0f} ± {ms:.0f} ms {word} against the video; corrected")
    off = max(-found.offset, found.offset - 2 * _NAMED) - 2 * delay.sigma[0]
    if applied is None and contradict:
        said.append(
            f"the sensors explain only {100 * found.explained:.0f} % of the motion in the video and contradict it: "
            "check that they are of this take, which sensor is where, and their headings"
        )
    elif applied is None and found.candidates and off > _NAMED:
        word = "late" if found.offset < 0 else "early"
        said.append(
            f"the sensors are perhaps {abs(1000 * found.offset):.0f} ms {word} against the video, which is "
            f"not corrected: {found.doubt}"
        )
    return said
