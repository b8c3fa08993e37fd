"""Commands that record: run, detect, simulate."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from rtof_kin.cli.options import (
    CERTIFIED,
    PERSON,
    FetchModels,
    Fields,
    File,
    Output,
    Overwrite,
    Paper,
    Seconds,
    Seed,
    command,
    written,
)
from rtof_kin.cli.reconstruction import reconstruct_and_print, solver_settings
from rtof_kin.cli.terminal import accuracy, line, out, print_scores, progress, remark, say, with_zero_motion
from rtof_kin.core.environment import RESULT_WARNINGS, without_warnings
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.folder import check_new_file, check_replaceable
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.reporting.settings import AnalysisSettings
from rtof_kin.setup.settings import ReconstructionTask, SecondCamera, SetupSettings

if TYPE_CHECKING:
    from rtof_kin.reconstruction.prepare import Progress
    from rtof_kin.setup.init import Detect, Findings
    from rtof_kin.setup.run import Run
    from rtof_kin.vision.detections import Detections
    from rtof_kin.vision.person_detector import Detector

_KINDS = {"given": "", "file": "", "found": "green", "assumed": "yellow", "doubtful": "bold red"}
_OF_KEYPOINTS = "rtof_kin.recording.cameras"  # Logger of how the person was followed, which the findings say


@command
def run(
    files: list[Path] | None = None,
    /,
    *,
    output: Annotated[Path | None, written("folder for recording, motion, angles and report")] = None,
    only: Literal["recording", "files"] | None = None,
    demo: bool = False,
    setup: Annotated[
        SetupSettings,
        Fields(
            "height pose person camera_name phone_log keep_video model_dir provider layout every people_every",
            rate_hz="rate",
            size_px="size",
            group="Recording",
        ),
    ],
    fetch_models: FetchModels = None,
    second: Annotated[SecondCamera, Fields("second second_person second_camera synchronised", group="Second camera")],
    task: Annotated[ReconstructionTask, Fields(f"model lift calibration events threads {PERSON}", group="Motion")],
    calibrate: Annotated[bool | None, Parameter(group="Motion")] = None,
    analysis: Annotated[
        AnalysisSettings, Fields("sex repetitions from_standing figures", weight_kg="weight", group="Analysis")
    ],
    settings: Annotated[ReconstructionSettings, Fields(CERTIFIED, group="Solver", defaults={"certificate": True})],
    paper: Paper = False,
    seconds: Seconds = None,
    overwrite: Overwrite = False,
) -> None:
    """From a video and sensors to a report, in one command.

    Detects the person, makes the recording, reconstructs the motion, analyses it and writes OUT/report.html. What is
    not given is found from the motion or assumed, and said. A step is not done again while its inputs are the same,
    so that a run that was stopped goes on, and OUT/recording/recording.toml may be corrected. Nothing leaves this
    machine.

    Args:
        files: a video, a detector's keypoints or both; files or folders of sensors, also alone; a calibration of the
            camera and a map of sensors: each is recognised
        only: recording: write the folder that reconstruct takes into OUT, and stop; files: of the demo, what a phone
            and sensors would have written, to practise on
        demo: reconstruct the recording that travels with the package, and print the error of each stage
        calibrate: calibrate the recording from its own motion first (the default, but for the demo); otherwise
            mounting, headings and bones are used as they were found
        seconds: of the demo, use as many seconds at most
    """
    from rtof_kin.core.jobs import work_shared
    from rtof_kin.setup.init import make_recording
    from rtof_kin.setup.run import run as run_steps

    settings = solver_settings(settings, paper)
    task = replace(task, calibrate=not demo if calibrate is None else calibrate)
    if demo:
        _demo(output or Path("out/demo"), only == "files", task, settings, seconds, overwrite)
        return
    if not files or output is None:
        raise InvalidInputError("run: give the FILEs of a take and a folder to write, -o OUT; or --demo")
    if only == "files" or seconds is not None:
        raise InvalidInputError("run: --only files and --seconds are for --demo")
    began, learned = time.monotonic(), list[str]()
    with progress() as update, without_warnings(RESULT_WARNINGS, _OF_KEYPOINTS):
        how: dict[str, Any] = {"overwrite": overwrite, "progress": update}
        how["kept"] = lambda step: remark(f"{step}: its inputs are the same; kept")
        how["detect"] = _detection(setup, fetch_models, update)
        if only:
            setup, name = replace(setup, lifter=task.lifter()), output.resolve().name
            with work_shared(task.threads):
                found = make_recording(files, output, setup, name=name, made_with=task.model, **how)
        else:
            how |= {"task": task, "second": second, "analysis": analysis, "learned": learned.append}
            done = run_steps(files, output, setup, settings, **how)
    if only:
        _print_findings(found)
        say(f"wrote {output}: correct recording.toml where it says so, then")
        say(f"  rtof-kin reconstruct {output} -o OUT")
    else:
        _print_run(done, time.monotonic() - began)
        for change in learned:
            line("subject", change)


def _demo(
    output: Path,
    files: bool,
    task: ReconstructionTask,
    settings: ReconstructionSettings,
    seconds: float | None,
    overwrite: bool,
) -> None:
    """Reconstruct the demo, with and without sensors, or write its files to practise on."""
    from rtof_kin.core.resources import model_path
    from rtof_kin.reconstruction.pipeline import reconstruct
    from rtof_kin.recording.recording import Recording
    from rtof_kin.simulation.simulate import write_raw_files

    recording = Recording.load(model_path("demo"))
    if files or seconds is not None:
        first = recording.times[0]
        recording = recording.between(first, first + (60.0 if seconds is None else seconds))
    if files:
        write_raw_files(recording, output, overwrite)
        out.print(f"wrote {output}: what a phone and sensors would have written of the demo. Next:")
        names = f"{output}/keypoints.csv {output}/dots {output}/places.csv"
        height = recording.skeleton.height
        say(f"  rtof-kin run {names} --size 1920x1080 --height {height:.2f} -o OUT")
        return
    result = reconstruct_and_print(recording, output, replace(task, mode="rtof"), settings, overwrite)
    with progress() as update, without_warnings():
        image_only = reconstruct(recording, mode="rto", lifter=task.lifter(), settings=settings, progress=update)
    vision = {f"{name} (image)": score for name, score in image_only.stage_metrics.items()}
    print_scores(with_zero_motion(recording) | vision | result.stage_metrics)
    say(f"The demo: {recording.notes} {recording.acknowledgement}", style="dim")


def _print_findings(found: Findings) -> None:
    for kind, style in _KINDS.items():
        for number, sentence in enumerate(getattr(found, kind)):
            line("" if number else kind, sentence, style)


def _print_run(done: Run, seconds: float) -> None:
    from rtof_kin.reporting.audit_results import headline

    _print_findings(done.findings)
    for note in done.joined:
        kind, _, sentence = note.partition(": ")
        line(kind, sentence, _KINDS.get(kind, ""))
    rows = (done.summary.inputs.get("camera_estimate") or {}).get("rows", [])
    found = [f"{name}: {now} by the motion, {was} assumed" for name, was, now, *_, said in rows if said == "found"]
    for number, sentence in enumerate(found):
        line("" if number else "camera", sentence)
    for found_of_lift in done.summary.inputs.get("found_of_lifts") or ():
        line("lift", found_of_lift)
    mode = done.summary.mode
    line("accuracy", accuracy(None, done.summary.mean_sigmas, mode))
    line("caution", headline(done.summary.results or ()).line)
    line("report", f"{done.page} ({seconds:.0f} s); open it in a browser")
    film = "" if mode == "imu" else f"; rtof-kin overlay {done.folder} VIDEO -o FILE.mp4"
    line("next", f"rtof-kin view {done.folder} (in 3D){film}")


def detector_of(setup: SetupSettings, fetch: str | None, update: Progress | None = None) -> Detector:
    """Return the detector that the options ask for; downloads models where they say so. `RtofError`: no detector is at
    hand, or the download failed.
    """
    from rtof_kin.vision.model_download import fetch_models, model_set
    from rtof_kin.vision.person_detector import choose_detector

    model_dir = setup.model_dir
    if model_dir is not None and fetch is not None:
        raise InvalidInputError("--model-dir, --fetch-models: give one of them")
    if fetch is not None:
        wanted = model_set(fetch)
        say(f"{wanted.title}. Licence: {wanted.licence}")
        with progress() if update is None else nullcontext(update) as shown:
            model_dir = fetch_models(wanted, shown)
        for file in wanted.files:
            say(f"{model_dir / file.name}: SHA-256 {file.checksum}, as published")
    detector = choose_detector(model_dir, setup.provider, setup.people_every)
    say(f"detector: {detector.name}")
    return detector


def _detection(setup: SetupSettings, fetch: str | None, update: Progress) -> Detect:
    """Return what detects the people in a video by the detector that the options ask for."""

    def detect(video: Path) -> Detections:
        from rtof_kin.vision.video import detect_video

        return detect_video(video, detector_of(setup, fetch, update), every=setup.every, progress=update)

    return detect


@command
def detect(
    video: str,
    /,
    *,
    output: File = Path("keypoints.npz"),
    setup: Annotated[SetupSettings, Fields("model_dir provider layout every people_every")],
    fetch_models: FetchModels = None,
    seconds: Seconds = None,
    camera_motion: Annotated[Path | None, Parameter(metavar="NPZ")] = None,
    phone_log: Annotated[Path | None, Parameter(metavar="LOG")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Detect keypoints of people in a video or webcam.

    Runs a detector on this machine: models of yours, downloaded ones, or MediaPipe's if installed; needs the extra:
    pip install 'rtof-kin[video]'. Images are neither kept nor sent. OUT can be a recording's keypoints.

    Args:
        video: video file, or the number of a webcam
        camera_motion: estimate how the camera turned from the background, and write it
        phone_log: gyroscope and accelerometer of the phone that filmed by hand: adds the tilt to --camera-motion
    """
    from rtof_kin.vision.detections import of_body
    from rtof_kin.vision.landmark_regression import recognise
    from rtof_kin.vision.layouts import layout_named
    from rtof_kin.vision.video import detect_video, write_detections

    if output.suffix.lower() != ".npz":
        raise FileFormatError(output, "give the file to write a name that ends in .npz")
    check_new_file(output, overwrite)
    if camera_motion is not None:
        if video.isdigit():
            raise InvalidInputError("--camera-motion needs a video file, not a webcam")
        check_new_file(camera_motion, overwrite)
    wanted = None if setup.layout is None else layout_named(setup.layout)
    detector = detector_of(setup, fetch_models)
    with progress() as update:
        source = int(video) if video.isdigit() else video
        found = detect_video(source, detector, every=setup.every, seconds=seconds, progress=update)
    write_detections(output, found, overwrite)
    present = found.present
    say(
        f"wrote {output}: {len(found)} frames of up to {present.shape[1]} people, "
        f"{int(present.any(axis=1).sum())} frames with at least one"
    )
    if found.detector:
        say(f"detected by {found.detector}")
    if camera_motion is not None:
        _write_camera_motion(video, found, camera_motion, phone_log, overwrite)
    try:
        body = of_body(found, wanted)
        layout = recognise(body.uv_px, body.confidence, layout=wanted).layout
    except InvalidInputError as error:
        say(f"their layout is not recognised: {error}")
        return
    name = setup.layout or layout.name
    text = f'[keypoints]\nfile = "{output.name}"\nlayout = "{name}"'
    say(f"{layout.title}; in recording.toml:\n{text}")


def _write_camera_motion(video: str, found: Detections, target: Path, phone: Path | None, overwrite: bool) -> None:
    from rtof_kin.formats.camera_motion import write_camera_motion
    from rtof_kin.setup.camera import assumed_camera, rotation_of_video
    from rtof_kin.setup.recording_text import Field
    from rtof_kin.vision.video_metadata import lens_prior, read_video_metadata

    metadata = read_video_metadata(video)
    size = metadata.width_px, metadata.height_px
    lens = lens_prior(*size, metadata)
    camera = assumed_camera(*size, lens, Field(None)).camera
    with progress() as update:
        turned = rotation_of_video(video, found, camera, lens.sigma_focal, phone=phone, progress=update)
    write_camera_motion(target, turned.motion, overwrite)
    say(f"wrote {target}: {turned.summary}")
    if turned.turning().passed:
        out.print("it stood still: [camera.motion] is not needed")
    else:
        focal = f"focal_px = {turned.camera.K[0, 0]:.0f}"
        say(f'in recording.toml, with {focal}:\n[camera.motion]\nfile = "{target.name}"')


@command
def simulate(
    motion: Path,
    /,
    *,
    output: Output,
    noise: Literal["perfect", "white", "independent", "realistic"] = "realistic",
    sensors: tuple[str, ...] | None = None,
    viewpoint: Literal["0", "1", "2", "3"] | None = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    seed: Seed = 0,
    acknowledgement: str = "",
    overwrite: Overwrite = False,
) -> None:
    """Make a recording from motion capture.

    A virtual camera and virtual IMUs observe the motion of a BVH or ASF/AMC file, which is kept as the truth.

    Args:
        motion: .bvh or .amc file
        noise: errors of the 2D: none; white noise of 5 px; of each joint by itself; those of a real detector
        sensors: IMUs, separated by commas (e.g. Pelvis,L_LowArm), or none; default: the eight limb sensors
        viewpoint: of the camera, one of four around the motion; default: the one that sees most of it
        rate: true frame rate of the file
        acknowledgement: acknowledgement that the data's owner asks for
    """
    from rtof_kin.recording.index import INDEX
    from rtof_kin.simulation.simulate import SimulationSettings, simulate_file

    check_replaceable(output, INDEX, overwrite)
    settings: SimulationSettings = getattr(SimulationSettings, noise)()
    if sensors is not None:
        settings = replace(settings, sensors=sensors)
    recording = simulate_file(
        motion,
        settings=settings,
        seed=seed,
        camera=None if viewpoint is None else int(viewpoint),
        rate_hz=rate,
        acknowledgement=acknowledgement,
    )
    recording.save(output, overwrite=overwrite)
    times, seen = recording.video.times, recording.video.seen.any(axis=1).mean()
    say(
        f"wrote {output}: {len(times)} frames, {times[-1] - times[0]:.1f} s, the person is visible "
        f"in {100 * seen:.0f} % of them"
    )
