"""Commands on files: inspect identifies and checks them, export writes motions in other formats, retarget on robots."""

from __future__ import annotations

import math
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import Parameter

from rtof_kin.cli.options import Output, Overwrite, command, written
from rtof_kin.cli.terminal import line, out, print_files, say
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.files.folder import check_new_file, new_file
from rtof_kin.core.packages import optional

_ENOUGH_S: Final = 180.0  #: [s] of a recording by which the places of its sensors are judged


@command
def inspect(
    files: list[Path] | None = None,
    /,
    *,
    declare: Annotated[list[str] | None, Parameter(consume_multiple=True, metavar="FIELD=VALUE")] = None,
    every: Annotated[bool, Parameter(name="--all")] = False,
    fix: bool = False,
    output: Annotated[Path | None, written("new folder for --fix")] = None,
    plot: Annotated[Path | None, Parameter(metavar="PNG")] = None,
    schema: bool = False,
    overwrite: Overwrite = False,
) -> int:
    """Identify files and check their contents by physics.

    FILES are sensor logs or folders of them, recordings, motions, motion capture, markers, cameras or a detector's
    keypoints. Every check is printed with its figure and limit; where a declaration is wrong, the likely right one is
    named as the option to add. Of a recording with calibrated sensors, those that are on another segment than declared
    are named, and --fix writes the corrected recording. Exit code 1: a check does not hold.

    Args:
        files: files or folders
        declare: units and conventions of a sensor log, e.g. acceleration_unit=g gravity=removed
        every: figures of every sensor and bone
        fix: correct the segments of sensors that are elsewhere; of one recording, with -o
        plot: draw what looks wrong; of one FILE
        schema: print the path of the JSON Schema of recording.toml and exit
    """
    from rtof_kin.reporting.inspection import inspect as examine

    if schema:
        from rtof_kin.recording.tables import SCHEMA

        say(SCHEMA)
        return 0
    files = files or []
    if not files:
        raise InvalidInputError("inspect: name the files or folders to examine")
    if plot is not None:
        if len(files) > 1:
            raise InvalidInputError(f"--plot draws one FILE, {len(files)} are named")
        if plot.suffix.lower() != ".png":
            raise InvalidInputError(f"--plot {plot}: give the picture a name that ends in .png")
        check_new_file(plot, overwrite)
    if fix != (output is not None) or (fix and len(files) > 1):
        raise InvalidInputError("--fix corrects one recording and needs a new folder for it: --fix -o OUT")
    declared = dict(map(_declaration, declare or []))
    failed = False
    for file in files:
        found, corrected = _with_places(examine(file, **declared), drawn=plot is not None)
        _print(found, every)
        if output is not None:
            _fix(found, corrected, output)
        if plot is not None:
            _draw(found, plot, overwrite)
        failed |= bool(found.failed)
    return int(failed)


def _declaration(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise InvalidInputError(f"{text!r} is not FIELD=VALUE, such as acceleration_unit=g")
    try:
        return name, float(value) if name == "rate_hz" else value
    except ValueError as error:
        raise InvalidInputError(f"rate_hz: {value!r} is not a number of samples per second") from error


def _with_places(found: Any, drawn: bool) -> tuple[Any, Any]:
    """Add the check of where a recording's sensors are; with the corrected calibration, if any is wrong."""
    from rtof_kin.calibration.assignment import NAME
    from rtof_kin.core.checks import Check
    from rtof_kin.reconstruction.checks.sensors import check_recording
    from rtof_kin.recording.recording import RecordingReader

    if found.title != "recording" or found.log is None:
        return found, None
    found = found if drawn else replace(found, log=None)  # an hour of it is large, and so is what is read now
    with RecordingReader.open(found.path) as reader:
        if reader.facts.calibration is None:
            return found, None
        start, cut = reader.start_s, reader.stop_s - reader.start_s > _ENOUGH_S
        recording = reader.between(start, start + _ENOUGH_S) if cut else reader.whole()
    try:
        places, corrected = check_recording(recording)
    except RtofError as error:
        check = Check.unknown(NAME, "sensors", "", str(error))
        return replace(found, checks=(*found.checks, check)), None
    notes = [f"sensors: {places.doubt}"] if places.doubt else []
    notes += [f"sensors: their places are judged by the first {_ENOUGH_S:g} s"] if cut else []
    found = replace(found, checks=(*found.checks, places.check()), notes=(*found.notes, *notes))
    return found, corrected.calibration if places.wrong else None


def _fix(found: Any, calibration: Any, target: Path) -> None:
    from rtof_kin.recording.recording import Recording

    if found.title != "recording":
        raise InvalidInputError(f"--fix: {found.path} is a {found.title}; only recordings are corrected")
    if calibration is None:
        text = "no sensor is found elsewhere: there is nothing to correct, and nothing was written"
        say(text)
        return
    replace(Recording.load(found.path), calibration=calibration).save(target)
    places = zip(calibration.sensors, calibration.joints, strict=True)
    say(f"wrote {target}: {', '.join(f'{sensor} on {joint}' for sensor, joint in places)}")


def _print(found: Any, every: bool) -> None:
    from rtof_kin.reporting.document import Badge, Table, show_table

    say(f"\n{found.path}: {found.title}", style="bold")
    show_table(Table(("content", ""), found.contents, notes=[f"note: {note}" for note in found.notes]), out)
    shown = list(found.checks) if every else _worst(found.checks)
    if shown:
        rows = [
            (Badge(one.verdict.value, "fail" if one.failed else ""), one.name, _figure(one, shown, found.checks))
            for one in shown
        ]
        advice = [f"{one.subject}: {one.name}. {one.advice}" for one in shown if one.failed]
        show_table(Table(("verdict", "check", "figure"), rows, notes=advice), out)
    likely = {tuple(check.likely.items()) for check in found.failed if check.likely}
    if likely:
        pairs = sorted({f"{name}={value}" for one in likely for name, value in one})
        say(f"likely: --declare {' '.join(map(shlex.quote, pairs))}", style="bold")


def _worst(checks: Any) -> list[Any]:
    """Of checks of the same name, the one that failed most or comes nearest to it."""
    worst: dict[str, Any] = {}
    for check in sorted(checks, key=lambda one: -1.0 if math.isnan(one.value) else one.value / one.limit, reverse=True):
        worst.setdefault(check.name, check)
    return [worst[name] for name in dict.fromkeys(check.name for check in checks)]


def _figure(check: Any, shown: list[Any], checks: Any) -> str:
    """Value and limit, or why there are none; of the worst of several, for how many the check holds."""
    if math.isnan(check.value):
        return f"{check.subject}: {check.advice}"
    text = f"{check.value:.3g} {check.unit}".rstrip() + f", limit {check.limit:.3g}"
    alike = [other for other in checks if other.name == check.name]
    if len(alike) == 1 or len(shown) == len(checks):
        return f"{text}; {check.subject}"
    holding = sum(other.passed for other in alike)
    return f"{text}; worst is {check.subject}, {holding} of {len(alike)} hold"


def _draw(found: Any, target: Path, overwrite: bool) -> None:
    from rtof_kin.core.packages import optional

    canvas = optional("matplotlib.backends.backend_agg", "figures", "a picture")
    from rtof_kin.reporting.inspection import picture

    figure = picture(found)
    if figure is None:
        out.print("nothing of this file can be drawn")
        return
    canvas.FigureCanvasAgg(figure)
    with new_file(target, overwrite) as whole:
        figure.savefig(whole)
    say(f"wrote {target}")


@command
def export(
    motion: str,
    target: Path | None = None,
    /,
    *,
    output: Annotated[Path | None, written("the same, as for other commands")] = None,
    to: tuple[str, ...] = (),
    recording: Annotated[Path | None, Parameter(metavar="FOLDER")] = None,
    code: str = "",
    pdf: Annotated[Path | None, Parameter(metavar="FILE")] = None,
    video: Annotated[Path | None, Parameter(metavar="FILE")] = None,
    flip: bool = True,
    overwrite: Overwrite = False,
) -> None:
    """Write a reconstructed motion in other formats.

    Always writes the subject's URDF and files.json, which lists axes, units and names of every file. Unobserved frames
    are marked or missing in every format.

    --to archive makes one ZIP file of recording, settings, versions and result, without names and video. --to bids
    makes a Motion-BIDS data set of the recorded sensors and the motion, fhir a bundle of observations of the summary,
    redcap a row with its data dictionary, dicom a file of the report, printed to the PDF of --pdf: of a person's code.
    --to onnx writes a lifter, MOTION being its file or name (detections, live), as one graph from rays and sensor
    orientations in world to poses in world; inputs, outputs, joints and rate are in the metadata. It needs onnx.

    Args:
        motion: output folder of reconstruct or run, or its motion.h5
        target: folder or file to write
        to: separated by commas: csv,ros (the default), parquet,npz; osim,mot,sto,trc (OpenSim); c3d;
            bvh,bvh-lafan1,glb; mjcf (MuJoCo); mcap,rosbag (Foxglove, ROS 2); rrd (Rerun); or one of archive, bids,
            fhir, redcap, dicom, onnx
        recording: recording of MOTION for archive and bids; default: that of run, or the demo
        code: of the person, for bids, fhir, redcap and dicom; default: that of the session where it is one, else 01
        pdf: the report as PDF, for dicom
        video: of the first camera, uncropped, for mcap, rosbag and rrd: encoded anew, without sound and metadata
        flip: of a lifter, estimate the mirrored scene too; without it faster and less exact
    """
    if (target is None) == (output is None):
        raise InvalidInputError("export: name one folder or file to write, as OUT or with -o OUT")
    written = output if target is None else target
    assert written is not None
    if {"archive", "bids", "fhir", "redcap", "dicom", "onnx"} & {*to}:
        if len(to) > 1:
            raise InvalidInputError(f"--to {to[0]}: one file of its own; other formats go to a folder of their own")
        if to[0] == "archive":
            from rtof_kin.reporting.archive import write_result_archive

            write_result_archive(written, Path(motion), recording, overwrite)
            say(f"wrote {written}: recording, settings, versions and result, without names and video")
        elif to[0] == "onnx":
            optional("torch", "onnx", "writing ONNX")
            from lifting.onnx_export import export_onnx
            from lifting.predict import Lifter

            check_new_file(written, overwrite)
            say(f"wrote {export_onnx(Lifter.load(Path(motion)), written, flip, overwrite)}")
        else:
            from rtof_kin.reporting.hospital import WRITERS, Result

            WRITERS[to[0]](written, Result.of(Path(motion), code, recording=recording, pdf=pdf), overwrite)
            say(f"wrote {written}")
        return
    from rtof_kin.body.motion_file import MotionReader, motion_path
    from rtof_kin.core.files.folder import new_folder
    from rtof_kin.formats.motion_files import DEFAULT, URDF, check_formats, write_motion_files
    from rtof_kin.reporting.export import beside_of

    formats = to or DEFAULT
    check_formats(formats)
    path = motion_path(motion)
    new = new_folder(written, URDF, overwrite)
    with MotionReader(path) as reader, beside_of(path.parent, video) as beside, new as folder:
        write_motion_files(folder, reader, formats, beside)
    print_files(written)


@command
def retarget(
    motion: Path,
    /,
    *,
    robot: Annotated[Path, Parameter(metavar="FILE.urdf")],
    map: Annotated[str | None, Parameter(metavar="NAME")] = None,
    output: Output,
    overwrite: Overwrite = False,
) -> None:
    """Put a person's motion on a humanoid robot.

    Feet that stand are held on the floor, limits are kept, what nobody observed is followed weakly; the first line says
    what was reached. Needs the extra: pip install 'rtof-kin[robots]'. docs/robots.md has examples.

    Args:
        motion: output folder of reconstruct or run, or its motion.h5
        robot: the robot's URDF; its meshes are not needed
        map: talos, gr1, g1, h1 or a TOML file: which link follows which segment; default: by the robot's links
    """
    from rtof_kin.body.motion_file import MotionReader, motion_path
    from rtof_kin.core.files.folder import new_folder
    from rtof_kin.robots.retarget import FIGURES, RobotMotion

    with MotionReader(motion_path(motion)) as reader, new_folder(output, FIGURES, overwrite) as folder:
        found = RobotMotion.of(reader, robot, map)
        found.write(folder)
    line("robot", f"{found.robot.map.name}: {found.robot.track}")
    if failures := found.robot.track.failures:
        line("doubtful", f"{len(failures)} frames without a step; {'; '.join(failures[:3])}", "bold red")
    print_files(output)
