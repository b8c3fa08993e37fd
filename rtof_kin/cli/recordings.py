"""Commands on recordings and motions: demo, reconstruct, evaluate, simulate, export."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Column, Table

from rtof_kin.cli.solver_options import add_solver_options, settings_of, use_threads
from rtof_kin.cli.terminal import (
    SCORE_COLUMNS,
    add_output,
    command,
    doubts_in_headline,
    figure_text,
    out,
    print_calibration,
    print_files,
    print_headline,
    print_scores,
    progress,
    with_zero_motion,
)


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_demo(commands)
    _add_reconstruct(commands)
    _add_calibrate(commands)
    _add_evaluate(commands)
    _add_simulate(commands)
    _add_export(commands)


# --- what they do --------------------------------------------------------------------------------


def _demo(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.core.resources import model_path
    from rtof_kin.recording.recording import Recording

    recording = Recording.load(model_path("demo"))
    out.print(f"The demo recording: {recording.notes}", soft_wrap=True)
    out.print(recording.acknowledgement, style="dim", soft_wrap=True)
    result = _reconstruct_to(recording, "rtof", options)
    scores = dict(result.stage_metrics)
    if result.recording.truth is not None:
        from rtof_kin.reconstruction.pipeline import reconstruct

        with progress() as tell, doubts_in_headline():
            vision = reconstruct(
                recording, mode="rto", lifter=_lifter(options), settings=settings_of(options),
                progress=tell,
            )  # fmt: skip
        scores = with_zero_motion(recording) | vision.stage_metrics | scores
    print_scores(scores)
    print_files(options.output)


def _reconstruct(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.recording.recording import Recording

    recording = Recording.load(options.recording)
    result = _reconstruct_to(recording, options.mode, options)
    if result.stage_metrics:
        print_scores(with_zero_motion(recording) | result.stage_metrics)
    print_files(options.output)


def _calibrate(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.calibration.file import write_self_calibration_toml
    from rtof_kin.core.files.folder import check_new_file, check_replaceable
    from rtof_kin.reconstruction.consistency_checks import consistency_warnings
    from rtof_kin.reconstruction.pipeline import calibrate_recording
    from rtof_kin.recording.recording import INDEX, Recording
    from rtof_kin.report.audit import calibration_results
    from rtof_kin.report.audit_results import AuditResult
    from rtof_kin.report.headline import headline

    settings = settings_of(options, "calibrate")
    if options.recording_output is not None:
        check_replaceable(options.recording_output, INDEX, options.overwrite)
    check_new_file(options.output, options.overwrite)
    recording = Recording.load(options.recording)
    with progress() as tell:
        found = calibrate_recording(recording, lifter=_lifter(options), settings=settings, progress=tell)
    warnings = consistency_warnings(recording, found)
    warned = (AuditResult.warning("calibration", "recording", text) for text in warnings)
    print_headline(headline((*warned, *calibration_results(found))))
    print_calibration(found)
    write_self_calibration_toml(options.output, found, options.overwrite)
    out.print(f"wrote {options.output}", soft_wrap=True)
    if options.recording_output is not None:
        found.apply(recording).save(options.recording_output, options.overwrite)
        out.print(f"wrote {options.recording_output}", soft_wrap=True)


def _lifter(options: argparse.Namespace) -> Any:
    """The lifter that was named; None for the shipped one."""
    if options.lifter is None:
        return None
    from lifting.predict import Lifter

    return Lifter.load(options.lifter)


def _known(options: argparse.Namespace) -> Any:
    """What `reconstruct` is told of another recording of the same person."""
    if getattr(options, "calibration", None) is None:
        return None
    from rtof_kin.calibration.file import read_self_calibration_toml

    return read_self_calibration_toml(options.calibration)


def _reconstruct_to(recording: Any, mode: str, options: argparse.Namespace) -> Any:
    """Reconstruct and export, asking first whether the output may be written."""
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.reconstruction.pipeline import reconstruct
    from rtof_kin.report.audit import audit
    from rtof_kin.report.export import MARKER, export, provenance_shares
    from rtof_kin.report.headline import headline

    settings = settings_of(options, mode)
    check_replaceable(options.output, MARKER, options.overwrite)
    with progress() as tell, doubts_in_headline():
        result = reconstruct(
            recording, mode=mode, lifter=_lifter(options), settings=settings,
            calibrate=options.calibrate, known=_known(options), progress=tell,
        )  # fmt: skip
    print_headline(headline(audit(result)))
    if result.calibration is not None:
        print_calibration(result.calibration)
    export(result, options.output, options.overwrite, figures=not options.no_figures)
    shares = {k: v for k, v in provenance_shares(result.motion.poses).items() if v > 0}
    out.print("who saw the joints: " + ", ".join(f"{k} {100 * v:.1f} %" for k, v in shares.items()))
    return result


def _evaluate(options: argparse.Namespace) -> None:
    from rtof_kin.body.metrics import comparable, evaluate
    from rtof_kin.core.errors import ShapeError
    from rtof_kin.formats.motion_npz import read_motion_npz
    from rtof_kin.recording.recording import Recording

    path = Path(options.motion)
    motion = read_motion_npz(path / "motion.npz" if path.is_dir() else path)
    recording = Recording.load(options.truth)
    if recording.truth is None:
        raise ShapeError(f"{options.truth}: the recording has no truth to compare with")
    poses = comparable(motion.poses, recording.truth, motion.mode)
    metrics = evaluate(poses, recording.truth, recording.skeleton)
    print_scores(with_zero_motion(recording) | {motion.mode or "motion": metrics})
    columns = {key: label for key, label in SCORE_COLUMNS.items() if key != "coverage"}
    table = Table(Column("joint", no_wrap=True), *columns.values())
    for joint, figures in metrics.per_joint.items():
        table.add_row(joint, *(figure_text(key, figures.get(key)) for key in columns))
    out.print(table)


def _simulate(options: argparse.Namespace) -> None:
    from dataclasses import replace

    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.recording.recording import INDEX
    from rtof_kin.simulation.simulate import SimulationSettings, simulate_file

    check_replaceable(options.output, INDEX, options.overwrite)
    make: Callable[[], SimulationSettings] = getattr(SimulationSettings, options.keypoints)
    settings = make()
    if options.sensors is not None:
        names = tuple(name for name in options.sensors.split(",") if name)
        settings = replace(settings, sensors=names)
    recording = simulate_file(
        options.motion,
        settings=settings,
        seed=options.seed,
        camera=options.camera,
        rate_hz=options.rate,
        acknowledgement=options.acknowledgement,
    )
    recording.save(options.output, overwrite=options.overwrite)
    times, seen = recording.video.times, recording.video.seen.any(axis=1).mean()
    out.print(
        f"wrote {options.output}: {len(times)} frames, {times[-1] - times[0]:.1f} s, somebody in the "
        f"picture for {100 * seen:.0f} % of them",
        soft_wrap=True,
    )


def _export(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import ShapeError
    from rtof_kin.core.files.folder import new_folder
    from rtof_kin.formats.motion_files import DEFAULT, URDF, check_formats, write_motion_files
    from rtof_kin.formats.motion_npz import read_motion_npz

    if options.output and options.folder:
        raise ShapeError("export: name one folder to write, as OUT or with -o OUT")
    output = options.output or options.folder
    formats = DEFAULT if options.to is None else [name.strip() for name in options.to.split(",")]
    check_formats(formats)
    path = Path(options.motion)
    motion = read_motion_npz(path / "motion.npz" if path.is_dir() else path).motion()
    with new_folder(output, URDF, options.overwrite) as folder:
        write_motion_files(folder, motion, formats)
    print_files(output)


# --- their arguments ---


def _add_demo(commands: Any) -> None:
    parser = command(
        commands, "demo", _demo, "reconstruct the recording that travels with the package",
        "Real motion (CMU), with a simulated camera and eight simulated IMUs: prints the error of "
        "each stage and writes the motion and its figures.",
    )  # fmt: skip
    add_output(parser, "out/demo", "folder to write")
    _add_reconstruction(parser)


def _add_reconstruct(commands: Any) -> None:
    parser = command(
        commands, "reconstruct", _reconstruct, "reconstruct the motion of a recording",
        "RECORDING is a folder with recording.toml, keypoints and (for sf2, rtof and imu) IMUs; its "
        "format is described in the README. OUT gets motion.npz, the URDF and its trajectory as "
        "CSV and for ROS, a summary and figures.",
    )  # fmt: skip
    parser.add_argument("recording", metavar="RECORDING", help="folder of the recording")
    add_output(parser, None, "folder to write")
    parser.add_argument(
        "--mode",
        choices=["lift", "sf2", "rto", "rtof", "imu"],
        default="rtof",
        help="lift: network alone; sf2: + IMU orientations, frame by frame; rto: optimised, vision "
        "alone; rtof: everything; imu: sensors alone, without a camera",
    )
    _add_reconstruction(parser)


def _add_reconstruction(parser: argparse.ArgumentParser) -> None:
    add_solver_options(parser)
    parser.add_argument(
        "--lifter", type=Path, metavar="FILE",
        help="checkpoint, or the name of a shipped one: detections (the default), perfect, causal",
    )  # fmt: skip
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--calibrate", action="store_true", default=True,
        help="estimate from the recording what is not known well about it, first (the default)",
    )  # fmt: skip
    how.add_argument(
        "--no-calibrate", dest="calibrate", action="store_false", help="take everything as it is given"
    )
    parser.add_argument(
        "--calibration", metavar="FILE",
        help="what `calibrate` wrote of another recording of the same person: bones, ankles and where "
        "the detector sees joints are taken from it; delay, mounting and biases are this one's own",
    )  # fmt: skip


def _add_calibrate(commands: Any) -> None:
    parser = command(
        commands, "calibrate", _calibrate, "estimate from a recording what is not known well about it",
        "How late the video is, how the sensors are mounted, how long the bones are and where the "
        "detector sees its landmarks; no pose is required. Prints what was found and how well it was "
        "observed, and writes it to OUT.",
    )  # fmt: skip
    parser.add_argument("recording", metavar="RECORDING", help="folder of the recording")
    add_output(parser, "calibration.toml", "file to write")
    parser.add_argument(
        "--recording-output", metavar="FOLDER", help="also write the recording put right, to this folder"
    )
    parser.add_argument(
        "--lifter", type=Path, metavar="FILE", help="as for reconstruct",
    )  # fmt: skip
    add_solver_options(parser)


def _add_evaluate(commands: Any) -> None:
    parser = command(
        commands, "evaluate", _evaluate, "compare a reconstructed motion with the truth",
        "Prints position, acceleration, jerk and angle errors, pooled and per joint, beside a "
        "predictor that never moves.",
    )  # fmt: skip
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.npz")
    parser.add_argument(
        "--truth", required=True, metavar="RECORDING", help="folder of a recording with the truth"
    )


def _add_simulate(commands: Any) -> None:
    parser = command(
        commands, "simulate", _simulate, "make a recording from motion capture",
        "A virtual camera and virtual IMUs watch a BVH or ASF/AMC file; the motion itself travels "
        "along as the truth.",
    )  # fmt: skip
    parser.add_argument("motion", metavar="MOTION", help=".bvh or .amc file")
    add_output(parser, None, "folder to write")
    parser.add_argument(
        "--keypoints",
        choices=["perfect", "white", "realistic"],
        default="realistic",
        help="errors of the 2D: none; white noise of 5 px; as real detectors make them",
    )
    parser.add_argument(
        "--sensors",
        metavar="NAMES",
        help="IMUs, separated by commas (e.g. Pelvis,L_LowArm); the eight limb sensors where not "
        "given, '' for none",
    )
    parser.add_argument(
        "--camera",
        type=int,
        choices=range(4),
        help="which of four around the motion; the one that sees most of it where not given",
    )
    parser.add_argument("--rate", type=float, metavar="HZ", help="true frame rate of the file")
    parser.add_argument("--seed", type=int, default=0, help="of the camera and all errors")
    parser.add_argument("--acknowledgement", default="", help="what the data's owner asks to print")


def _add_export(commands: Any) -> None:
    parser = command(
        commands, "export", _export, "write a reconstructed motion in other formats",
        "Always writes the subject's URDF and files.json, which says what axes, units and names every "
        "file has. Where nobody saw the person, no file says that somebody did.",
    )  # fmt: skip
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.npz")
    folder = parser.add_argument("folder", metavar="OUT", help="folder to write")

    class InPlaceOfFolder(argparse.Action):
        """An optional positional would be passed over where options stand before it."""

        def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
            folder.required = False
            namespace.output = values

    add_output(parser, "", "the same, as other commands have it", action=InPlaceOfFolder)
    parser.add_argument(
        "--to", metavar="FORMATS",
        help="separated by commas: csv,ros (the default), parquet; osim,mot,sto,trc (OpenSim); c3d; bvh",
    )  # fmt: skip
