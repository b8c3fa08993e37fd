"""Calibration of a recording from its own motion: stages before it, and what if it is impossible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.estimate import calibrate as estimate_calibration
from rtof_kin.calibration.excerpt import Slice
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.errors import CalibrationError
from rtof_kin.reconstruction.consistency_checks import check_height, consistency_warnings
from rtof_kin.reconstruction.job import Job
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.prepare import Progress
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
    """Calibrate a recording from its own motion; see `rtof_kin.calibration.estimate`.

    Args:
        skeleton: the subject's. Default: that of the recording.
        priors: unknowns and their prior standard deviations. Default: `CalibrationPriors.of` the recording.
        lifter, settings, progress: as for `reconstruct`.

    Raises:
        CalibrationError: the recording has no IMUs, or too little in common with its video. Errors of
            the stages.
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
    slices = [_slice(job, solver, known) for job in own]
    progress = partial(own[0].progress, "calibrate")
    found = estimate_calibration(
        slices, priors, solver, settings.frames, progress, without_slipped="motion" in settings.guards
    )
    return found if known is None else known.followed_by(found)


def _prior_body(job: Job, known: SelfCalibration | None) -> Job:
    """The job on the body from which the calibration starts."""
    recording = job.recording
    check_height(recording)
    if job.skeleton is not None:
        offsets = job.skeleton.joint_offsets
        recording = replace(recording, joint_offsets=offsets, height=None, bone_lengths=None)
    recording = recording if known is None else known.apply(recording)
    return replace(job, recording=recording, skeleton=None).with_solver(known)


def _slice(job: Job, solver: JointSpaceSettings, known: SelfCalibration | None) -> Slice:
    prepared = job.prepare("sf2", calibration=known)
    assert prepared.bone_imus is not None  # without IMUs, mode sf2 has raised
    used = replace(prepared, settings=job.settings.with_fragment(solver))
    return Slice(replace(prepared.recording, keypoints=prepared.keypoints), used.guess, prepared.bone_imus)
