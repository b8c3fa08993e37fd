"""The command detect: keypoints of people in a video."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtof_kin.cli.terminal import command, out, progress

if TYPE_CHECKING:
    from rtof_kin.vision.detections import Detections
    from rtof_kin.vision.person_detector import PersonDetector


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "detect",
        _detect,
        "detect keypoints of people in a video or webcam",
        "Runs a detector on this machine: models of yours, downloaded ones, or MediaPipe's if installed; "
        "needs the extra: pip install 'rtof-kin[video]'. Images are neither kept nor sent. OUT can be a "
        "recording's keypoints.",
    )
    parser.add_argument("video", metavar="VIDEO", help="video file, or the number of a webcam")
    add_detector(parser)
    parser.add_argument("--out", default="keypoints.npz", metavar="OUT", help=".npz to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier OUT")
    parser.add_argument("--seconds", type=float, metavar="S", help="stop after so many")
    parser.add_argument(
        "--camera-motion", metavar="NPZ", help="estimate how the camera turned from the background, and write it"
    )
    parser.add_argument(
        "--phone-log",
        metavar="LOG",
        help="gyroscope and accelerometer of the phone that filmed: adds the tilt to --camera-motion",
    )


def add_detector(parser: argparse.ArgumentParser) -> None:
    """Declare --model-dir and --fetch-models, see `detector_of`."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--model-dir",
        metavar="DIR",
        default=argparse.SUPPRESS,
        help="folder of .onnx files (RTMPose or RTMO, and YOLOX or RTMDet to find people), or with "
        "MediaPipe's .task; without it what is at hand: downloaded models, else MediaPipe",
    )
    which.add_argument(
        "--fetch-models",
        metavar="NAME",
        nargs="?",
        const="rtmpose",
        default=argparse.SUPPRESS,
        choices=("rtmpose", "mediapipe"),
        help="agree to download the detector's models once: rtmpose (the default, 26 points, 158 MB) or "
        "mediapipe (33 points, 10 MB); prints licence and checksums",
    )


def detector_of(options: argparse.Namespace) -> PersonDetector:
    """Return the detector that the options ask for; downloads models where they say so.

    Args:
        options: of `add_detector`.

    Raises:
        RtofError: no detector is at hand, or the download failed.
    """
    from rtof_kin.vision.model_download import fetch_models, model_set
    from rtof_kin.vision.person_detector import choose_detector

    models = getattr(options, "model_dir", None)
    if name := getattr(options, "fetch_models", None):
        wanted = model_set(name)
        out.print(f"{wanted.title}. Licence: {wanted.licence}", soft_wrap=True)
        with progress() as update:
            models = fetch_models(wanted, update)
        for file in wanted.files:
            out.print(f"{models / file.name}: SHA-256 {file.checksum}, as published", soft_wrap=True)
    detector = choose_detector(models)
    out.print(f"detector: {detector.name}", soft_wrap=True)
    return detector


def _detect(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import FileFormatError, InvalidInputError
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.vision.landmark_regression import recognise
    from rtof_kin.vision.video import detect_video, write_detections

    target = Path(options.out)
    if target.suffix.lower() != ".npz":
        raise FileFormatError(target, "give the file to write a name that ends in .npz")
    check_new_file(target, options.overwrite)
    if options.camera_motion is not None:
        if options.video.isdigit():
            raise InvalidInputError("--camera-motion needs a video file, not a webcam")
        check_new_file(Path(options.camera_motion), options.overwrite)
    source = int(options.video) if options.video.isdigit() else options.video
    detector = detector_of(options)
    with progress() as update:
        found = detect_video(source, detector, seconds=options.seconds, progress=update)
    write_detections(target, found, options.overwrite)
    present = found.present
    out.print(
        f"wrote {target}: {len(found)} frames of up to {present.shape[1]} people, "
        f"{int(present.any(axis=1).sum())} frames with at least one",
        soft_wrap=True,
    )
    if options.camera_motion is not None:
        _write_camera_motion(options, found)
    try:
        layout = recognise(found.uv_px, found.confidence).layout
    except InvalidInputError as error:
        out.print(f"their layout is not recognised: {error}", soft_wrap=True)
        return
    text = f'[keypoints]\nfile = "{target.name}"\nlayout = "{layout.name}"'
    out.print(f"{layout.title}; in recording.toml:\n{text}", soft_wrap=True)


def _write_camera_motion(options: argparse.Namespace, found: Detections) -> None:
    from rtof_kin.formats.camera_motion_npz import write_camera_motion
    from rtof_kin.setup.camera import assumed_camera, turning_of_video
    from rtof_kin.setup.recording_text import Field
    from rtof_kin.vision.video_metadata import lens_prior, read_video_metadata

    target = Path(options.camera_motion)
    metadata = read_video_metadata(options.video)
    size = metadata.width_px, metadata.height_px
    lens = lens_prior(*size, metadata)
    camera = assumed_camera(*size, lens, Field(None)).camera
    with progress() as update:
        turned = turning_of_video(
            options.video, found, camera, lens.sigma_focal, phone=options.phone_log, progress=update
        )
    write_camera_motion(target, turned.motion, options.overwrite)
    out.print(f"wrote {target}: {turned.summary}", soft_wrap=True)
    if turned.turning().passed:
        out.print("it stood still: [camera.motion] is not needed")
    else:
        focal = f"focal_px = {turned.camera.K[0, 0]:.0f}"
        out.print(f'in recording.toml, with {focal}:\n[camera.motion]\nfile = "{target.name}"', soft_wrap=True)
