"""Commands on recordings: demo, reconstruct, calibrate, evaluate."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Column, Table

from rtof_kin.cli.protocols import print_first, print_tables
from rtof_kin.cli.solver_options import add_solver_options, settings_of, use_threads
from rtof_kin.cli.terminal import (
    SCORE_COLUMNS,
    add_model,
    add_output,
    command,
    figure_text,
    out,
    print_calibration,
    print_headline,
    print_scores,
    print_sections,
    print_summary,
    progress,
    warnings_in_summary,
    with_zero_motion,
)
from rtof_kin.core.choices import MODES, Mode

REPEATED = ("frames", "space", "backend", "paper", "guards", "lift_with_sensors", "calibrate")
"""Options of a run that its numbers depend on, beside its mode, files and threads."""

if TYPE_CHECKING:
    from rtof_kin.body.skeleton import Motion
    from rtof_kin.recording.recording import Recording
    from rtof_kin.recording.streams import RecordingSource
    from rtof_kin.reporting.statistics import ReconstructionStatistics


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_demo(commands)
    _add_reconstruct(commands)
    _add_calibrate(commands)
    _add_evaluate(commands)


# --- what they do --------------------------------------------------------------------------------


def _demo(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.core.resources import model_path
    from rtof_kin.reconstruction.pipeline import reconstruct
    from rtof_kin.recording.recording import Recording

    recording = Recording.load(model_path("demo"))
    if options.files is not None:
        _write_files(recording, options)
        return
    result = _reconstruct_to(recording, "rtof", options)
    with progress() as update, warnings_in_summary():
        image_only = reconstruct(
            recording, mode="rto", lifter=lifter_of(options), settings=settings_of(options), progress=update
        )
    vision = {f"{name} (image)": score for name, score in image_only.stage_metrics.items()}
    print_scores(with_zero_motion(recording) | vision | result.stage_metrics)
    out.print(f"The demo: {recording.notes} {recording.acknowledgement}", style="dim", soft_wrap=True)


def _write_files(recording: Recording, options: argparse.Namespace) -> None:
    """Write files to practise `init` and `run` on."""
    from rtof_kin.simulation.simulate import write_raw_files

    first = recording.times[0]
    recording = recording.between(first, first + options.seconds)
    write_raw_files(recording, options.files, options.overwrite)
    folder, height = options.files, recording.skeleton.height
    out.print(f"wrote {folder}: what a phone and sensors would have written of the demo. Next:")
    files = f"{folder}/keypoints.csv {folder}/dots {folder}/places.csv"
    out.print(f"  rtof-kin run {files} --size 1920x1080 --height {height:.2f} -o OUT", soft_wrap=True)


def _reconstruct(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.recording.recording import Recording

    with opened(options.recording) as recording:
        found = _reconstruct_to(recording, options.mode or recording.usual_mode, options)
    if found.stage_metrics:
        zero = with_zero_motion(recording) if isinstance(recording, Recording) else {}
        print_scores(zero | found.stage_metrics)


@contextmanager
def opened(folder: str | Path) -> Iterator[RecordingSource]:
    """Yield the recording in a folder, a long one as a reader of its parts."""
    from rtof_kin.reconstruction.parts import is_long
    from rtof_kin.recording.reader import RecordingReader

    with RecordingReader.open(folder) as reader:
        yield reader if is_long(reader) else reader.whole()


def _calibrate(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.calibration.result import write_self_calibration_toml
    from rtof_kin.core.files.folder import check_new_file, check_replaceable
    from rtof_kin.reconstruction.self_calibration import calibrate_recording, consistency_warnings
    from rtof_kin.recording.index import INDEX
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.audit import calibration_results
    from rtof_kin.reporting.audit_results import AuditResult
    from rtof_kin.reporting.headline import headline

    settings = settings_of(options, "calibrate")
    if options.recording_output is not None:
        check_replaceable(options.recording_output, INDEX, options.overwrite)
    check_new_file(options.output, options.overwrite)
    recording = Recording.load(options.recording)
    with progress() as update:
        found = calibrate_recording(recording, lifter=lifter_of(options), settings=settings, progress=update)
    doubts = (AuditResult.warning("calibration", "recording", s) for s in consistency_warnings(recording, found))
    print_headline(headline((*doubts, *calibration_results(found))))
    print_calibration(found)
    write_self_calibration_toml(options.output, found, options.overwrite)
    out.print(f"wrote {options.output}", soft_wrap=True)
    if options.recording_output is not None:
        found.apply(recording).save(options.recording_output, options.overwrite)
        out.print(f"wrote {options.recording_output}", soft_wrap=True)


def lifter_of(options: argparse.Namespace) -> Any:
    """Load the model that is named; None for the shipped one.

    Args:
        options: those of `add_model`.
    """
    if options.model is None:
        return None
    from lifting.predict import Lifter

    return Lifter.load(options.model)


def _known(options: argparse.Namespace) -> Any:
    """Read the calibration of another recording of the same person, if one is named."""
    if options.calibration is None:
        return None
    from rtof_kin.calibration.result import read_self_calibration_toml

    return read_self_calibration_toml(options.calibration)


def reconstruct_and_export(
    recording: RecordingSource, mode: Mode, options: argparse.Namespace, inputs: Mapping[str, str] | None = None
) -> ReconstructionStatistics:
    """Reconstruct and export; a folder that may not be written is refused first.

    Args:
        recording: to reconstruct; a `Recording` in one part, another source in parts.
        options: those of `add_reconstruction`, and the output. inputs: fingerprints for `export`.
    """
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.reconstruction.parts import reconstruct_in_parts
    from rtof_kin.reporting.export import MARKER, export

    check_replaceable(options.output, MARKER, options.overwrite)
    digest = recording.digest()
    how: Any = {
        "mode": mode,
        "lifter": lifter_of(options),
        "settings": settings_of(options, mode),
        "calibrate": options.calibrate,
        "known": _known(options),
    }
    with progress() as update, warnings_in_summary():
        return export(
            reconstruct_in_parts(recording, progress=update, **how),
            options.output,
            options.overwrite,
            not options.no_figures,
            inputs=inputs,
            run=lambda: run_record(mode, options, digest),
        )


def run_record(mode: Mode, options: argparse.Namespace, recording_digest: str) -> dict[str, Any]:
    """Return what a run can be repeated by, for ``summary.json``; files are named by their SHA-256 alone.

    Args:
        options: those of `add_reconstruction`.
    """
    from rtof_kin.core.environment import environment
    from rtof_kin.core.files.manifest import file_digest
    from rtof_kin.core.resources import lifter_path

    calibration = None if options.calibration is None else Path(options.calibration)
    return {
        "options": {"mode": mode} | {name: getattr(options, name) for name in REPEATED},
        "recording_sha256": recording_digest,
        "model_sha256": file_digest(lifter_path(options.model)),
        "calibration_sha256": None if calibration is None else file_digest(calibration),
        "environment": environment(),
    }


def _reconstruct_to(recording: RecordingSource, mode: Mode, options: argparse.Namespace) -> ReconstructionStatistics:
    """Reconstruct, export and print the summary."""
    from rtof_kin.reporting.audit import audit
    from rtof_kin.reporting.headline import headline

    found = reconstruct_and_export(recording, mode, options)
    verdict = headline(audit(found))
    print_summary(found, verdict, options.output)
    print_sections(verdict)
    shares = {k: v for k, v in found.provenance_shares.items() if v > 0}
    by = ", ".join(f"{k.replace('_', ' ').replace('imu', 'IMU')} {100 * v:.1f} %" for k, v in shares.items())
    out.print(f"joints observed by: {by}", soft_wrap=True)
    calibration = found.first.calibration
    if calibration is not None and options.verbose:
        print_calibration(calibration)
    elif calibration is not None:
        count = len(calibration.quantities)
        out.print(f"self-calibration: {count} quantities; --verbose prints them", soft_wrap=True)
    return found


def _evaluate(options: argparse.Namespace) -> None:
    from rtof_kin.body.metrics import aligned_worlds, comparable, evaluate
    from rtof_kin.body.motion_file import MotionReader
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.formats.opensim import SUFFIXES
    from rtof_kin.recording.recording import Recording

    with MotionReader(options.motion) as reader:
        motion, mode = reader.read(), reader.mode
    if Path(options.truth).suffix.lower() in SUFFIXES:
        _evaluate_angles(options, motion, None)
        return
    recording = Recording.load(options.truth)
    if recording.truth is None:
        raise InvalidInputError(f"{options.truth}: the recording has no truth to compare with")
    poses = comparable(motion.poses, recording.truth, mode)
    moved, turn, shift = aligned_worlds(poses, recording.truth)
    metrics, aligned = (evaluate(p, recording.truth, recording.skeleton) for p in (poses, moved))
    name = mode or "motion"
    print_scores(with_zero_motion(recording) | {name: metrics, f"{name}, worlds\naligned": aligned})
    out.print(
        f"worlds aligned: the motion is turned by {math.degrees(turn):.1f} deg about the vertical and moved "
        f"by {math.hypot(*shift):.2f} m, once for all frames; without that, its world counts as the truth's. "
        "By joint below: not aligned.",
        soft_wrap=True,
    )
    columns = {key: label for key, label in SCORE_COLUMNS.items() if key != "coverage"}
    table = Table(Column("joint", no_wrap=True), *columns.values())
    for joint, figures in metrics.per_joint.items():
        table.add_row(joint, *(figure_text(key, figures.get(key)) for key in columns))
    out.print(table)
    if options.angles or options.output:
        _evaluate_angles(options, motion, recording)


def _evaluate_angles(options: argparse.Namespace, motion: Motion, recording: Recording | None) -> None:
    """Print the errors of clinical angles, and write them if asked."""
    from rtof_kin.protocols.angles import against_opensim, against_recording
    from rtof_kin.protocols.tables import write_results

    if recording is None:
        found = against_opensim(motion, Path(options.truth), options.movement)
    else:
        found = against_recording(motion, recording, options.movement)
    print_first(found)
    print_tables(found.printed)
    if options.output:
        written = write_results(found, Path(options.output))
        out.print("wrote " + ", ".join(map(str, written)), soft_wrap=True)


# --- their arguments ---


def _add_demo(commands: Any) -> None:
    parser = command(
        commands,
        "demo",
        _demo,
        "reconstruct the recording that travels with the package",
        "Real motion (CMU), with a simulated camera and eight simulated IMUs: prints the error of "
        "each stage and writes the motion and its figures.",
    )
    add_output(parser, "out/demo", "folder to write")
    parser.add_argument(
        "--files",
        metavar="FOLDER",
        help="write the files that a phone and sensors would have written instead, to practise on",
    )
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="of these, how many at most")
    add_reconstruction(parser)


def _add_reconstruct(commands: Any) -> None:
    parser = command(
        commands,
        "reconstruct",
        _reconstruct,
        "reconstruct the motion of a recording",
        "RECORDING is a folder with recording.toml, keypoints and (for sf2, rtof and imu) IMUs; "
        "docs/recording.md describes it. OUT gets motion.h5, the URDF, a summary and, up to ten minutes, "
        "the trajectory as CSV and for ROS; of recordings up to two minutes figures. Longer ones are "
        "reconstructed in parts, in bounded memory.",
    )
    parser.add_argument("recording", metavar="RECORDING", help="folder of the recording")
    add_output(parser, None, "folder to write")
    parser.add_argument(
        "--mode",
        choices=MODES,
        help="lift: network only; sf2: + IMU orientations, frame by frame; rto: optimised, vision "
        "only; rtof: everything; imu: sensors only, without a camera; default: uses all that was recorded",
    )
    add_reconstruction(parser)


def add_reconstruction(parser: argparse.ArgumentParser) -> None:
    """Declare the options that `reconstruct_and_export` reads."""
    add_solver_options(parser)
    add_model(parser)
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")
    parser.add_argument("--verbose", action="store_true", help="print every calibrated quantity too")
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="calibrate the recording from its own motion first, against gross errors of delay, mounting "
        "and bones; default: use it as given",
    )
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        help="calibration of another recording of the same person: bones, ankles and landmark offsets "
        "are taken from it; with --calibrate delay, mounting and biases are estimated for this one",
    )


def _add_calibrate(commands: Any) -> None:
    parser = command(
        commands,
        "calibrate",
        _calibrate,
        "calibrate a recording from its own motion",
        "Estimates the delay of the video, the mounting of the sensors, bone lengths and landmark "
        "offsets of the detector; no calibration pose is required. Prints each quantity with its "
        "standard deviation and writes it to OUT.",
    )
    parser.add_argument("recording", metavar="RECORDING", help="folder of the recording")
    add_output(parser, "calibration.toml", "file to write")
    parser.add_argument(
        "--recording-output", metavar="FOLDER", help="also write the calibrated recording to this folder"
    )
    add_model(parser)
    add_solver_options(parser)


def _add_evaluate(commands: Any) -> None:
    parser = command(
        commands,
        "evaluate",
        _evaluate,
        "compare a reconstructed motion with the truth",
        "Prints position, acceleration, jerk and angle errors, pooled and per joint, beside a "
        "predictor that never moves; --angles: of clinical joint angles, as published for other systems.",
    )
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.h5")
    parser.add_argument(
        "--truth",
        required=True,
        metavar="TRUTH",
        help="folder of a recording with the truth, or an OpenSim .mot or .sto (angles alone)",
    )
    parser.add_argument(
        "--angles",
        action="store_true",
        help="also RMSE, mean and median absolute error of joint angles, beside published values",
    )
    parser.add_argument(
        "--movement",
        default="other",
        choices=["walk", "squat", "sit-to-stand", "arms", "floor", "other"],
        help="class of the movement, for that table",
    )
    parser.add_argument("-o", "--output", metavar="DIR", help="write the table of angles there too")
