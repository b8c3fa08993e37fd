"""The commands init and run: from a video (or keypoints) and sensors to a recording, or to a report."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from rtof_kin.cli.clinical import add_analysis, analyse_and_write
from rtof_kin.cli.detection import add_detector, detector_of
from rtof_kin.cli.recordings import add_reconstruction, lifter_of, opened, reconstruct_and_export
from rtof_kin.cli.solver_options import use_threads
from rtof_kin.cli.terminal import (
    accuracy,
    add_model,
    add_output,
    command,
    decimal,
    err,
    out,
    progress,
    warnings_in_summary,
)
from rtof_kin.core.files.manifest import fingerprint, made_from

if TYPE_CHECKING:
    from rtof_kin.setup.init import Findings, SetupSettings
    from rtof_kin.setup.sources import Sources
    from rtof_kin.vision.detections import Detections

RECORDING, SECOND, JOINED, MOTION, ANGLES = "recording", "second", "joined", "motion", "angles"
"""Folders that `run` writes, beside the report; the second and third where there are two cameras."""
_KINDS: Final = {"given": "", "file": "", "found": "green", "assumed": "yellow", "doubtful": "bold red"}
_OF_KEYPOINTS: Final = "rtof_kin.recording.cameras"
"""Logger of how the person was followed, which the findings say."""
_OF_MOTION: Final = (
    "frames",
    "space",
    "backend",
    "paper",
    "guards",
    "lift_with_sensors",
    "model",
    "calibrate",
    "calibration",
    "no_figures",
)
_OF_ANGLES: Final = ("weight", "sex", "repetitions", "from_standing", "no_figures")


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "run",
        _run,
        "from a video and sensors to a report, in one command",
        "Detects the person, makes the recording (as init does), reconstructs the motion, analyses it and "
        "writes OUT/report.html. What is not given is found from the motion or assumed, and said. A step is "
        "not done again while its inputs are the same, so that a run that was stopped goes on, and "
        "OUT/recording/recording.toml may be corrected. Nothing leaves this machine.",
    )
    _add_setup(parser, "folder for the recording, the motion, the angles and the report")
    add_reconstruction(parser)
    parser.set_defaults(calibrate=True)
    parser.add_argument(
        "--no-calibrate",
        dest="calibrate",
        action="store_false",
        help="use mounting, headings and bones as init found them, without self-calibration",
    )
    add_analysis(parser)
    parser.add_argument(
        "--second",
        nargs="+",
        metavar="FILE",
        help="video or keypoints of a second camera (or both) that saw the same; its place is found",
    )
    parser.add_argument("--second-person", type=int, metavar="N", help="number in second/frames.png")
    parser.add_argument("--second-camera", metavar="NAME", help="of it, in the calibration of --camera")
    _add_synchronised(parser)
    parser = command(
        commands,
        "join",
        _join,
        "join the recordings of two cameras that saw the same",
        "Finds the second camera's clock, place and focal length from the person who moves before both (of "
        "two calibrated cameras the clock alone) and writes one recording with two views.",
    )
    parser.add_argument("first", metavar="FIRST", help="folder of the recording with the sensors, if any")
    parser.add_argument("second", metavar="SECOND", help="folder of the other camera's recording")
    add_output(parser, None, "folder of the joined recording")
    add_model(parser)
    _add_synchronised(parser)
    parser = command(
        commands,
        "init",
        _init,
        "make a recording from a video and sensors",
        "Writes the folder that reconstruct takes: recording.toml with a comment on every value that was "
        "found or assumed, the keypoints, the sensors on the video's clock, and frames.png, a picture of "
        "the people with their numbers.",
    )
    _add_setup(parser, "folder of the recording")


def _add_setup(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument(
        "files",
        metavar="FILE",
        nargs="+",
        help="a video, a detector's keypoints or both; files or folders of sensors, also alone; a "
        "calibration of the camera and a map of sensors: each is recognised",
    )
    add_output(parser, None, what)
    parser.add_argument("--height", type=decimal, metavar="M", help="of the person, m; every length follows it")
    parser.add_argument(
        "--pose",
        choices=["N", "T", "seated"],
        default="N",
        help="of sensors without a video: how the person stood still at first",
    )
    parser.add_argument("--person", type=int, metavar="N", help="number in frames.png, if there are several")
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="calibration (Pose2Sim, OpenCap, OpenCV); default: found from the motion, as far as it shows it",
    )
    parser.add_argument("--camera-name", metavar="NAME", help="of the camera, if FILE has several")
    parser.add_argument(
        "--phone-log",
        type=Path,
        metavar="LOG",
        help="gyroscope and accelerometer of the phone that filmed by hand: tells how it was tilted",
    )
    parser.add_argument(
        "--map",
        type=Path,
        metavar="FILE",
        help="two columns: serial number of each sensor and its segment; default: found from the motion",
    )
    parser.add_argument("--rate", type=decimal, metavar="HZ", help="frames per second of keypoints without times")
    parser.add_argument("--size", type=image_size, metavar="WxH", help="of the image, for keypoints without a video")
    add_detector(parser)
    parser.add_argument(
        "--discard-video",
        action="store_true",
        help="keep the keypoints alone: neither pictures nor the name of the video",
    )


def _add_synchronised(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--synchronised", action="store_true", help="both cameras have one clock; default: it is found")


def image_size(text: str) -> tuple[int, int]:
    """Return width and height, px, of a text such as 1920x1080; raises ArgumentTypeError for another."""
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not width x height, such as 1920x1080")
    return int(width), int(height)


# --- what they do --------------------------------------------------------------------------------


def _init(options: argparse.Namespace) -> None:
    found = _set_up(options, Path(options.output), Path(options.output).resolve().name)
    _print_findings(found)
    out.print(f"wrote {options.output}: correct recording.toml where it says so, then", soft_wrap=True)
    out.print(f"  rtof-kin reconstruct {options.output} -o OUT", soft_wrap=True)


def _run(options: argparse.Namespace) -> None:
    use_threads(options)
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.page import PAGE
    from rtof_kin.reporting.summary_file import SUMMARY, read_summary
    from rtof_kin.setup.join import ABOUT

    if options.height is None:
        raise InvalidInputError(
            "the person's height is not given, and every length follows it: add e.g. --height 1.72 (m)"
        )
    if find_spec("torch") is None:
        import lifting  # noqa: F401  # says so before the work
    folder = Path(options.output)
    started = time.monotonic()
    found, own = _set_up(options, folder / RECORDING, folder.resolve().name), folder / RECORDING

    def join(of_step: argparse.Namespace, inputs: Mapping[str, str]) -> None:
        of_step.first, of_step.second = folder / RECORDING, folder / SECOND
        _join(of_step, inputs)

    if options.second:
        _set_up(_of_second(options), folder / SECOND, f"{folder.resolve().name}, second camera")
        _step(options, JOINED, (own, folder / SECOND, *_values(options, ("model", "synchronised"))), join)
        own = folder / JOINED
    with warnings_in_summary(_OF_KEYPOINTS):
        recording = Recording.load(own)
    mode = recording.usual_mode
    notes, source = recording.notes, own
    del recording  # a long one is read in parts

    def reconstruct(own: argparse.Namespace, inputs: Mapping[str, str]) -> None:
        with warnings_in_summary(_OF_KEYPOINTS), opened(source) as recording:
            reconstruct_and_export(recording, mode, own, inputs)

    def analyse(own: argparse.Namespace, inputs: Mapping[str, str]) -> None:
        own.motion, own.height = folder / MOTION, None
        analyse_and_write(own, inputs)

    _step(options, MOTION, (own, mode, *_values(options, _OF_MOTION)), reconstruct)
    _step(options, ANGLES, (folder / MOTION, *_values(options, _OF_ANGLES)), analyse)
    _write_page(folder, options)
    _print_findings(found)
    for kind, _, sentence in (note.partition(": ") for note in notes.splitlines()):
        if options.second and sentence.startswith(ABOUT):
            _line(kind, sentence, _KINDS.get(kind, ""))
    summary = read_summary(folder / MOTION / SUMMARY)
    for number, sentence in enumerate(_camera_found(summary)):
        _line("" if number else "camera", sentence)
    _line("accuracy", accuracy(None, summary.mean_sigmas, mode))
    _line("caution", _headline(summary))
    _line("report", f"{folder / PAGE} ({time.monotonic() - started:.0f} s); open it in a browser")
    film = "" if mode == "imu" else f"; rtof-kin overlay {folder} VIDEO -o FILE.mp4"
    _line("next", f"rtof-kin view {folder} (in 3D){film}")


def _set_up(options: argparse.Namespace, folder: Path, name: str) -> Findings:
    """Make the recording, or as much of it as is not there already."""
    from rtof_kin.core.errors import OutputExistsError
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.recording.index import INDEX
    from rtof_kin.setup.init import find_people, make_recording, read_findings
    from rtof_kin.setup.sensors_alone import make_sensor_recording
    from rtof_kin.setup.sources import Sources

    told = (path for path in (options.camera, options.map) if path is not None)
    sources = Sources.of((*options.files, *told))
    options.phone_log = options.phone_log or sources.phone
    settings = _settings(options)
    inputs = _fingerprints(sources, options)
    before = made_from(folder)
    if before.get("recording") == inputs["recording"]:
        _kept(folder.name)
        return read_findings(folder)
    if before and before.get("files") != inputs["files"] and not options.overwrite:
        raise OutputExistsError(f"{folder}: was made from other files; name another folder by -o, or add --overwrite")
    check_replaceable(folder, INDEX, bool(before) or options.overwrite)
    if "recording" in before and before.get("person", inputs["person"]) != inputs["person"] and not options.overwrite:
        raise OutputExistsError(
            f"{folder}: is of another person of the video; name another folder by -o, or add --overwrite, "
            "which replaces that person's results"
        )
    if not sources.seen:
        return make_sensor_recording(sources, settings, folder, options.pose, name=name, inputs=inputs)
    if before.get("people") != inputs["people"]:
        begun = {step: inputs[step] for step in ("files", "people")}
        find_people(sources, settings, folder, lambda video: _detect(video, options), begun)
    with progress() as update, warnings_in_summary(_OF_KEYPOINTS):
        return make_recording(sources, settings, folder, name=name, inputs=inputs, progress=update)


def _of_second(options: argparse.Namespace) -> argparse.Namespace:
    """Return the options for the second camera's recording."""
    own = {"files": options.second, "person": options.second_person, "camera_name": options.second_camera}
    return argparse.Namespace(**vars(options) | own | {"map": None, "phone_log": None})


def _join(options: argparse.Namespace, inputs: Mapping[str, str] | None = None) -> None:
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.recording.index import INDEX
    from rtof_kin.recording.recording import Recording
    from rtof_kin.setup.join import join_recordings

    check_replaceable(options.output, INDEX, options.overwrite)
    first, second = Recording.load(options.first), Recording.load(options.second)
    joined = join_recordings(first, second, lifter_of(options), synchronised=options.synchronised)
    joined.recording.save(options.output, options.overwrite, inputs)
    if inputs is None:
        _line("found", joined.found)
        if joined.doubt:
            _line("doubtful", joined.doubt, _KINDS["doubtful"])
        out.print(f"wrote {options.output}", soft_wrap=True)


def _detect(video: Path, options: argparse.Namespace) -> Detections:
    from rtof_kin.vision.video import detect_video

    detector = detector_of(options)
    with progress() as update:
        return detect_video(video, detector, progress=update)


def _settings(options: argparse.Namespace) -> SetupSettings:
    from rtof_kin.setup.init import SetupSettings

    return SetupSettings(
        height=options.height,
        person=options.person,
        camera_name=options.camera_name,
        rate_hz=options.rate,
        size_px=options.size,
        phone_log=options.phone_log,
        keep_video=not options.discard_video,
        lifter=lifter_of(options) if hasattr(options, "model") else None,
    )


def _fingerprints(sources: Sources, options: argparse.Namespace) -> dict[str, str]:
    """Return what a recording is made from: its files, the picture of the people, everything."""
    image = [path for path in (sources.video, sources.keypoints) if path is not None]
    log = [options.phone_log] if options.phone_log is not None else []
    told = ("height", "person", "camera_name", "model", "pose")
    shown = _values(options, ("rate", "size", "model_dir", "fetch_models", "discard_video"))
    return {
        "files": fingerprint(*sources.paths),
        "people": fingerprint(*image, *shown),
        "person": str(options.person or 1),
        "recording": fingerprint(*sources.paths, *log, *shown, *_values(options, told)),
    }


def _values(options: argparse.Namespace, names: tuple[str, ...]) -> tuple[object, ...]:
    """Return options by name, for a fingerprint."""
    return tuple((name, getattr(options, name, None)) for name in names)


def _step(
    options: argparse.Namespace,
    step: str,
    inputs: tuple[object, ...],
    make: Callable[[argparse.Namespace, Mapping[str, str]], None],
) -> None:
    """Make a folder of `run`, unless it is there and its inputs are the same."""
    folder, wanted = Path(options.output) / step, fingerprint(*inputs)
    before = made_from(folder)
    if before.get(step) == wanted:
        _kept(step)
        return
    own = argparse.Namespace(**vars(options) | {"output": str(folder)})
    own.overwrite = options.overwrite or step in before
    make(own, {step: wanted})


def _write_page(folder: Path, options: argparse.Namespace) -> None:
    """Write the report into the folder of `run`, whose manifest has nothing else."""
    from rtof_kin.core.errors import OutputExistsError
    from rtof_kin.core.files.manifest import read_contents, write_manifest
    from rtof_kin.core.files.text import write_text
    from rtof_kin.reporting.page import PAGE, report

    page, inputs = folder / PAGE, {PAGE: fingerprint(folder / MOTION, *_values(options, ("weight", "sex")))}
    if made_from(folder) == inputs:
        _kept(PAGE)
        return
    own = page in read_contents(folder).own
    if page.exists() and not own:
        raise OutputExistsError(f"{page}: this package did not write it, or it was changed; move it elsewhere")
    write_text(page, report(folder / MOTION, None, options.weight, options.sex), overwrite=own)
    write_manifest(folder, PAGE, inputs, [page])


def _kept(step: str) -> None:
    err.print(f"{step}: its inputs are the same; kept", soft_wrap=True)


# --- what is printed -----------------------------------------------------------------------------


def _print_findings(found: Findings) -> None:
    for kind, style in _KINDS.items():
        for number, sentence in enumerate(getattr(found, kind)):
            _line("" if number else kind, sentence, style)


def _line(name: str, text: str, style: str = "") -> None:
    out.print(Text(f"{name:9} ", "bold"), Text(text, style), soft_wrap=True, sep="")


def _camera_found(summary: Any) -> list[str]:
    """Return what the motion told of a camera that is not calibrated, by unknown."""
    rows = (summary.inputs.get("camera_estimate") or {}).get("rows", [])
    return [f"{name}: {now} by the motion, {was} assumed" for name, was, now, *_, verdict in rows if verdict == "found"]


def _headline(summary: Any) -> str:
    from rtof_kin.reporting.audit_results import headline

    return headline(summary.results).line
