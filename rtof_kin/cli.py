"""The command line ``rtof-kin``: the only place that prints.

Exit codes: 0 done, 2 wrong input (one line says what, where and what to do), 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table

from rtof_kin.errors import RtofError

_out, _err = Console(), Console(stderr=True)
_COLUMNS = {
    "mpjpe_rr_mm": "relative\nto root\n[mm]",
    "mpjpe_mm": "absolute\n\n[mm]",
    "mpjae": "MPJAE\n\n[m/s2]",
    "mpjje": "MPJJE\n\n[m/s3]",
    "angle_deg": "joint\nangle\n[deg]",
    "flexion_deg": "flexion\n\n[deg]",
    "coverage": "valid",
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        options.run(options)
    except RtofError as error:
        _err.print(f"error: {error}", style="bold red", markup=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        _err.print("interrupted")
        return 130
    return 0


# --- commands ------------------------------------------------------------------------------------


def _demo(options: argparse.Namespace) -> None:
    from rtof_kin.recording import Recording
    from rtof_kin.resources import model_path

    recording = Recording.load(model_path("demo"))
    _out.print(f"The demo recording: {recording.notes}", soft_wrap=True)
    _out.print(recording.acknowledgement, style="dim", soft_wrap=True)
    result = _reconstruct_to(recording, "rtof", options)
    scores = dict(result.stage_metrics)
    if result.recording.truth is not None:
        from rtof_kin.pipeline import reconstruct

        with _progress() as tell:
            vision = reconstruct(recording, mode="rto", progress=tell)
        scores = _with_zero_motion(recording) | vision.stage_metrics | scores
    _print_scores(scores)
    _print_files(options.output)


def _reconstruct(options: argparse.Namespace) -> None:
    from rtof_kin.recording import Recording

    recording = Recording.load(options.recording)
    result = _reconstruct_to(recording, options.mode, options)
    if result.stage_metrics:
        _print_scores(_with_zero_motion(recording) | result.stage_metrics)
    _print_files(options.output)


def _reconstruct_to(recording: Any, mode: str, options: argparse.Namespace) -> Any:
    """Reconstruct and export, asking first whether the output may be written."""
    from rtof_kin.export import MARKER, export, summary
    from rtof_kin.io.folder import check_replaceable
    from rtof_kin.pipeline import ReconstructionSettings, reconstruct

    check_replaceable(options.output, MARKER, options.overwrite)
    settings = ReconstructionSettings(frames=options.frames)
    lifter = None
    if options.lifter is not None:
        from lifting.predict import Lifter

        lifter = Lifter.load(options.lifter)
    with _progress() as tell:
        result = reconstruct(
            recording, mode=mode, lifter=lifter, settings=settings, progress=tell
        )
    export(result, options.output, options.overwrite, figures=not options.no_figures)
    facts = summary(result)
    shares = {k: v for k, v in facts["provenance"].items() if v > 0}
    _out.print("who saw the joints: " + ", ".join(f"{k} {100 * v:.1f} %" for k, v in shares.items()))
    if facts["limit_violations_deg"]:
        worst = sorted(facts["limit_violations_deg"].items(), key=lambda item: -item[1])[:3]
        _out.print(
            f"{len(facts['limit_violations_deg'])} angles leave their anatomical limits somewhere "
            "(nothing is clipped), most: " + ", ".join(f"{k} by {v:.0f} deg" for k, v in worst)
        )
    if result.solution is not None:
        _out.print(f"solver: {result.solution.status.value}")
    return result


def _evaluate(options: argparse.Namespace) -> None:
    from rtof_kin.errors import ShapeError
    from rtof_kin.io.motion_npz import read_motion_npz
    from rtof_kin.metrics import evaluate
    from rtof_kin.recording import Recording

    path = Path(options.motion)
    motion = read_motion_npz(path / "motion.npz" if path.is_dir() else path)
    recording = Recording.load(options.truth)
    if recording.truth is None:
        raise ShapeError(f"{options.truth}: the recording has no truth to compare with")
    metrics = evaluate(motion.poses, recording.truth, recording.skeleton)
    _print_scores(_with_zero_motion(recording) | {motion.mode or "motion": metrics})
    columns = {key: label for key, label in _COLUMNS.items() if key != "coverage"}
    table = Table(Column("joint", no_wrap=True), *columns.values())
    for joint, figures in metrics.per_joint.items():
        table.add_row(joint, *(_figure(key, figures.get(key)) for key in columns))
    _out.print(table)


def _simulate(options: argparse.Namespace) -> None:
    from dataclasses import replace

    from rtof_kin.io.folder import check_replaceable
    from rtof_kin.recording import INDEX
    from rtof_kin.simulation import SimulationSettings, simulate_file

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
    seconds = recording.keypoints.times[-1] - recording.keypoints.times[0]
    _out.print(f"wrote {options.output}: {len(recording.keypoints)} frames, {seconds:.1f} s")


def _train(options: argparse.Namespace) -> None:
    from lifting.train import TrainConfig, train

    config = TrainConfig(
        minutes=options.minutes,
        windows=options.windows,
        seed=options.seed,
        device=options.device,
        batch=options.batch,
    )
    text = "{task.fields[note]}"
    with Progress(TextColumn("training"), BarColumn(), TextColumn(text), console=_err) as progress:
        task = progress.add_task("training", total=1.0, note="")

        def tell(report: Mapping[str, Any]) -> None:
            note = f"loss {report['loss_mm']:.0f} mm, {report['windows_per_second']:,.0f} windows/s"
            progress.update(task, completed=report["share_done"], note=note)
            for name, value in report.get("validation", {}).items():
                line = f"{report['windows'] / 1e6:.2f} M windows, validation, {name} 2D: "
                line += f"{value['rr_mm']:.1f} mm root-relative, {value['abs_mm']:.1f} absolute"
                progress.console.print(line)

        path = train(config, options.corpus, options.output, tell, options.resume)
    _out.print(f"wrote {path}")


def _export(options: argparse.Namespace) -> None:
    from rtof_kin.io.folder import new_folder
    from rtof_kin.io.joint_trajectory import write_joint_trajectory_csv, write_ros_trajectory
    from rtof_kin.io.motion_npz import read_motion_npz

    path = Path(options.motion)
    motion = read_motion_npz(path / "motion.npz" if path.is_dir() else path).motion()
    with new_folder(options.output, "skeleton.urdf", options.overwrite) as folder:
        urdf = motion.skeleton.to_urdf()
        (folder / "skeleton.urdf").write_text(urdf, encoding="utf-8")
        if "csv" in options.formats:
            write_joint_trajectory_csv(folder / "joint_trajectory.csv", motion)
        if "ros" in options.formats:
            write_ros_trajectory(folder, motion)
    _print_files(options.output)


# --- printing ------------------------------------------------------------------------------------


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """A bar for each stage, on the error stream."""
    columns = (
        TextColumn("{task.description:>5}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=_err) as progress:
        tasks: dict[str, Any] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield tell


def _with_zero_motion(recording: Any) -> dict[str, Any]:
    """The row of a predictor that never moves, by the same code as every other."""
    from rtof_kin.metrics import evaluate, motionless

    if recording.truth is None:
        return {}
    still = motionless(recording.truth)
    return {"zero motion": evaluate(still, recording.truth, recording.skeleton)}


def _print_scores(scores: Mapping[str, Mapping[str, float]]) -> None:
    title = "error against the truth, mean over frames"
    table = Table(Column("stage", no_wrap=True), *_COLUMNS.values(), title=title)
    for stage, metrics in scores.items():
        table.add_row(stage, *(_figure(key, metrics[key]) for key in _COLUMNS))
    _out.print(table)


def _figure(key: str, value: float | None) -> str:
    if value is None:
        return ""
    if key == "coverage":
        return f"{100 * value:.0f} %"
    return f"{value:.2f}" if key == "mpjae" else f"{value:.1f}"


def _print_files(folder: str | Path) -> None:
    folder = Path(folder)
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    _out.print(f"wrote {folder}: {', '.join(files)}", soft_wrap=True)


# --- arguments -----------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rtof-kin",
        description="Human motion from one camera and a handful of IMUs. Everything stays on this "
        "machine. Start with: rtof-kin demo",
        epilog="Each command explains itself: rtof-kin reconstruct --help",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_reconstruct(commands)
    _add_evaluate(commands)
    _add_simulate(commands)
    _add_train(commands)
    _add_export(commands)
    return parser


def _command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], None], summary: str, more: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}. {more}",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def _add_output(parser: argparse.ArgumentParser, default: str | None, what: str) -> None:
    parser.add_argument(
        "-o", "--output", default=default, required=default is None, metavar="OUT", help=what
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace what an earlier run wrote there"
    )


def _add_reconstruction(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, default=50, metavar="N", help="frames in a fragment")
    parser.add_argument(
        "--lifter", type=Path, metavar="FILE", help="checkpoint to use instead of the shipped one"
    )
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")


def _add_demo(commands: Any) -> None:
    parser = _command(
        commands, "demo", _demo, "reconstruct the recording that travels with the package",
        "Real motion (CMU), with a simulated camera and eight simulated IMUs: prints the error of "
        "each stage and writes the motion and its figures.",
    )  # fmt: skip
    _add_output(parser, "out/demo", "folder to write")
    _add_reconstruction(parser)


def _add_reconstruct(commands: Any) -> None:
    parser = _command(
        commands, "reconstruct", _reconstruct, "reconstruct the motion of a recording",
        "RECORDING is a folder with recording.toml, keypoints and (for sf2 and rtof) IMUs; its "
        "format is described in the README. OUT gets motion.npz, the URDF and its trajectory as "
        "CSV and for ROS, a summary and figures.",
    )  # fmt: skip
    parser.add_argument("recording", metavar="RECORDING", help="folder of the recording")
    _add_output(parser, None, "folder to write")
    parser.add_argument(
        "--mode",
        choices=["lift", "sf2", "rto", "rtof"],
        default="rtof",
        help="lift: network alone; sf2: + IMU orientations, frame by frame; rto: optimised, vision "
        "alone; rtof: everything",
    )
    _add_reconstruction(parser)


def _add_evaluate(commands: Any) -> None:
    parser = _command(
        commands, "evaluate", _evaluate, "compare a reconstructed motion with the truth",
        "Prints position, acceleration, jerk and angle errors, pooled and per joint, beside a "
        "predictor that never moves.",
    )  # fmt: skip
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.npz")
    parser.add_argument(
        "--truth", required=True, metavar="RECORDING", help="folder of a recording with the truth"
    )


def _add_simulate(commands: Any) -> None:
    parser = _command(
        commands, "simulate", _simulate, "make a recording from motion capture",
        "A virtual camera and virtual IMUs watch a BVH or ASF/AMC file; the motion itself travels "
        "along as the truth.",
    )  # fmt: skip
    parser.add_argument("motion", metavar="MOTION", help=".bvh or .amc file")
    _add_output(parser, None, "folder to write")
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
        "--camera", type=int, choices=range(4), default=0, help="which of four around the motion"
    )
    parser.add_argument("--rate", type=float, metavar="HZ", help="true frame rate of the file")
    parser.add_argument("--seed", type=int, default=0, help="of the camera and all errors")
    parser.add_argument("--acknowledgement", default="", help="what the data's owner asks to print")


def _add_train(commands: Any) -> None:
    parser = _command(
        commands, "train", _train, "train a lifter on motion capture",
        "CORPUS is a folder of BVH and AMC files with an index.csv (see benchmarks/README.md). "
        "Subjects are split once and for all; the test subjects are never used.",
    )  # fmt: skip
    parser.add_argument("corpus", metavar="CORPUS", help="folder, or .npz made from one")
    parser.add_argument("-o", "--output", default="lifter.pt", help="checkpoint to write")
    parser.add_argument("--minutes", type=float, help="stop after this many minutes")
    parser.add_argument("--windows", type=int, help="stop after this many windows")
    parser.add_argument("--batch", type=int, default=512, help="windows in a step")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where to train")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true", help="go on where a run was interrupted")


def _add_export(commands: Any) -> None:
    parser = _command(
        commands, "export", _export, "write a reconstructed motion in other formats",
        "Always writes the subject's URDF, and with it the joint trajectory as CSV with units and "
        "as ROS messages.",
    )  # fmt: skip
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.npz")
    _add_output(parser, None, "folder to write")
    parser.add_argument(
        "--formats", nargs="+", choices=["csv", "ros"], default=["csv", "ros"], help="what to write"
    )


if __name__ == "__main__":
    sys.exit(main())
