"""The command reconstruct: a recording to a motion."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from rtof_kin.cli.options import CERTIFIED, PERSON, Fields, Overwrite, Paper, command, written
from rtof_kin.cli.terminal import (
    line,
    print_calibration,
    print_headline,
    print_scores,
    print_sections,
    print_summary,
    progress,
    say,
    with_zero_motion,
)
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import check_new_file, check_replaceable
from rtof_kin.markers.settings import TRIALS, MarkerSettings
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.setup.settings import ReconstructionTask
from rtof_kin.solve.settings import CartesianSettings

if TYPE_CHECKING:
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.statistics import ReconstructionStatistics


def solver_settings(
    settings: ReconstructionSettings, paper: bool, mode: str | None = None, calibrate_only: bool = False
) -> ReconstructionSettings:
    """Return the settings that the options choose. `InvalidInputError`: options contradict each other."""
    if paper and settings.space == "joint":
        raise InvalidInputError("--paper is an energy in cartesian space; leave out --space joint, or --paper")
    if mode in ("lift", "sf2") and (paper or settings.space):
        raise InvalidInputError(f"mode {mode} optimises nothing; leave out --space and --paper")
    if (paper or settings.space == "cartesian") and (mode == "imu" or calibrate_only):
        what = "calibration" if calibrate_only else "mode imu"
        named = "--paper" if paper else "--space cartesian"
        raise InvalidInputError(f"{what} is solved in joint space; leave out {named}")
    return settings.with_fragment(CartesianSettings.paper()) if paper else settings


@command
def reconstruct(
    recording: Path,
    /,
    *,
    output: Annotated[Path | None, written("folder to write; with --calibrate-only a file")] = None,
    task: Annotated[
        ReconstructionTask, Fields(f"mode model lift layout calibrate calibration events threads {PERSON}")
    ],
    calibrate_only: bool = False,
    calibrated: Annotated[Path | None, Parameter(metavar="FOLDER")] = None,
    verbose: bool = False,
    settings: Annotated[ReconstructionSettings, Fields(CERTIFIED, group="Solver")],
    paper: Paper = False,
    markers: Annotated[
        MarkerSettings, Fields("trials marker_set marker_table marker_person up", group="Marker trials")
    ],
    overwrite: Overwrite = False,
) -> None:
    """Reconstruct the motion of a recording, or of a marker trial.

    RECORDING is a folder with recording.toml, keypoints and (for sf2, rtof and imu) IMUs; docs/recording.md describes
    it. OUT gets motion.h5, the URDF, a summary and, up to ten minutes, the trajectory as CSV and for ROS.
    Recordings of more than two minutes are reconstructed in parts, in bounded memory.

    With --calibrate-only the delay of the video, the mounting of the sensors, bone lengths and landmark offsets of the
    detector are estimated, without a pose of calibration: each quantity is printed with its standard deviation, and
    OUT, by default calibration.toml, is a file for --calibration.

    RECORDING may also be a trial of an optical laboratory, .c3d, .trc or .npz: a body is fitted to the markers of all
    trials of the person and the movement is solved on it (docs/markers.md). OUT is as of a recording.

    Args:
        recording: folder of the recording, or a marker trial
        calibrate_only: estimate the calibration, write it, and stop
        calibrated: with --calibrate-only: also write the calibrated recording to this folder
        verbose: print every calibrated quantity too
    """
    settings = solver_settings(settings, paper, task.mode, calibrate_only)
    if task.layout is not None:
        from rtof_kin.vision.layouts import layout_named

        layout_named(task.layout)
    if calibrate_only:
        if task.subject is not None:
            raise InvalidInputError("--subject is for a reconstruction: leave out --calibrate-only, or --subject")
        _calibrate(recording, output or Path("calibration.toml"), calibrated, task, settings, overwrite)
        return
    if output is None:
        raise InvalidInputError("required: --output (rtof-kin reconstruct --help has all options)")
    if recording.suffix.lower() in TRIALS:
        _reconstruct_markers(recording, output, markers, overwrite, task)
        return
    found = reconstruct_and_print(recording, output, task, settings, overwrite, verbose)
    if found.stage_metrics:
        print_scores((with_zero_motion(found.first.recording) if found.parts == 1 else {}) | found.stage_metrics)


def _reconstruct_markers(
    trial: Path, output: Path, settings: MarkerSettings, overwrite: bool, task: ReconstructionTask
) -> None:
    from rtof_kin.body.motion_file import MOTION
    from rtof_kin.core.files.manifest import fingerprint
    from rtof_kin.formats.gait_events import read_event_corrections
    from rtof_kin.markers.trials import motion_of_markers
    from rtof_kin.reconstruction.person import news_of_markers, update_subject
    from rtof_kin.reporting.audit_results import headline
    from rtof_kin.reporting.export import export_markers

    check_replaceable(output, MOTION, overwrite)
    with progress() as update:
        found = motion_of_markers(trial, settings, progress=partial(update, "fitting the body"))
    if task.events is not None:
        events = read_event_corrections(task.events, found.motion.times)
        found = replace(found, motion=replace(found.motion, corrections=events))
    results = export_markers(found, output, overwrite)
    print_headline(headline(results))
    say(found.headline)
    say(f"wrote {output}")
    if task.update_subject and (subject := task.subject) is not None:
        bones, sigma = found.body.skeleton, found.body.sigma_offsets
        news = news_of_markers(bones, sigma, f"markers {fingerprint(bones.joint_offsets.tolist())[:8]}")
        for changed in update_subject(subject, news, bones.name):
            line("subject", changed)


def reconstruct_and_print(
    recording: Path | Recording,
    output: Path,
    task: ReconstructionTask,
    settings: ReconstructionSettings,
    overwrite: bool,
    verbose: bool = False,
) -> ReconstructionStatistics:
    """Reconstruct, export and print the summary."""
    from rtof_kin.reporting.audit import audit
    from rtof_kin.reporting.audit_results import headline
    from rtof_kin.setup.run import reconstruct_folder

    learned = list[str]()
    how: Any = {"task": task, "settings": settings, "learned": learned.append}
    with progress() as update, without_warnings():
        found = reconstruct_folder(recording, output, overwrite, **how, progress=update)
    verdict = headline(audit(found))
    print_summary(found, verdict, output)
    print_sections(verdict)
    shares = {k: v for k, v in found.provenance_shares.items() if v > 0}
    by = ", ".join(f"{k.replace('_', ' ').replace('imu', 'IMU')} {100 * v:.1f} %" for k, v in shares.items())
    say(f"joints observed by: {by}")
    calibration = found.first.calibration
    if calibration is not None and verbose:
        print_calibration(calibration)
    elif calibration is not None:
        count = len(calibration.quantities)
        say(f"self-calibration: {count} quantities; --verbose prints them")
    for change in learned:
        line("subject", change)
    return found


def _calibrate(
    folder: Path,
    output: Path,
    calibrated: Path | None,
    task: ReconstructionTask,
    settings: ReconstructionSettings,
    overwrite: bool,
) -> None:
    from rtof_kin.calibration.result import write_self_calibration_toml
    from rtof_kin.reconstruction.self_calibration import calibrate_recording, consistency_warnings
    from rtof_kin.recording.index import INDEX
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.audit import calibration_results
    from rtof_kin.reporting.audit_results import AuditResult, headline

    if calibrated is not None:
        check_replaceable(calibrated, INDEX, overwrite)
    check_new_file(output, overwrite)
    recording = task.with_lifts(Recording.load(folder)).whole()
    with progress() as update:
        found = calibrate_recording(recording, lifter=task.lifter(), settings=settings, progress=update)
    doubts = (AuditResult.warning("calibration", "recording", s) for s in consistency_warnings(recording, found))
    print_headline(headline((*doubts, *calibration_results(found))))
    print_calibration(found)
    write_self_calibration_toml(output, found, overwrite)
    say(f"wrote {output}")
    if calibrated is not None:
        found.apply(recording).save(calibrated, overwrite)
        say(f"wrote {calibrated}")
