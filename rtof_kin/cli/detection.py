"""The command that finds people's points in a video."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rtof_kin.cli.terminal import command, out, progress


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands, "detect", _detect, "find people's points in a video or in front of a webcam",
        "Runs model files of yours (.onnx: RTMPose or RTMO, and YOLOX or RTMDet to find people) on this "
        "machine; needs the extra: pip install 'rtof_kin[video]'. OUT can be a recording's keypoints.",
    )  # fmt: skip
    parser.add_argument("video", metavar="VIDEO", help="video file, or the number of a webcam")
    parser.add_argument("--model-dir", required=True, metavar="DIR", help="folder of .onnx files")
    parser.add_argument("--out", default="keypoints.npz", metavar="OUT", help=".npz to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier OUT")
    parser.add_argument("--seconds", type=float, metavar="S", help="stop after so many")


def _detect(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import FileFormatError, InvalidInputError
    from rtof_kin.core.files.folder import check_new_file
    from rtof_kin.vision.recognise import recognise
    from rtof_kin.vision.video import detect_video, write_detections

    target = Path(options.out)
    if target.suffix.lower() != ".npz":
        raise FileFormatError(target, "give the file to write a name that ends in .npz")
    check_new_file(target, options.overwrite)
    source = int(options.video) if options.video.isdigit() else options.video
    with progress() as tell:
        found = detect_video(source, options.model_dir, seconds=options.seconds, progress=tell)
    write_detections(target, found, options.overwrite)
    present = found.present
    out.print(
        f"wrote {target}: {len(found)} frames of up to {present.shape[1]} people, somebody in "
        f"{int(present.any(axis=1).sum())} of them",
        soft_wrap=True,
    )
    try:
        layout = recognise(found.uv_px, found.confidence).layout
    except InvalidInputError as error:
        out.print(f"their layout is not recognised: {error}", soft_wrap=True)
        return
    text = f'[keypoints]\nfile = "{target.name}"\nlayout = "{layout.name}"'
    out.print(f"{layout.title}; in recording.toml:\n{text}", soft_wrap=True)
