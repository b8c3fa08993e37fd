"""The command validate: joint angles on a public data set that the user has downloaded."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

from rtof_kin.cli.protocols import measure
from rtof_kin.cli.start import image_size
from rtof_kin.cli.terminal import add_model, add_output, command, out
from rtof_kin.core.choices import MODES

_FAILED = 1


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "validate",
        _validate,
        "errors of joint angles on a public data set",
        "SET is opencap (OpenCap's laboratory validation), vidimu, movi (BML-MoVi) or gaitex, unpacked "
        "below DIR (layouts: docs/validate.md). Every take is set up, reconstructed and compared with the "
        "set's own reference; the table has RMSE, mean and median absolute error and RMSE without offset by "
        "joint angle and movement, beside published values of the same metric. Goes on where it was stopped. "
        "Exit code 1: a take failed.",
    )
    parser.add_argument("set", metavar="SET", choices=["opencap", "vidimu", "movi", "gaitex"])
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="folder of the data set")
    parser.add_argument(
        "--takes",
        default="*",
        metavar="PATTERNS",
        help="names of takes, separated by commas, with * and ?, e.g. 'subject2_*_Cam1_*'; default: all",
    )
    parser.add_argument("--list", action="store_true", help="print the takes and their classes, and stop")
    parser.add_argument("--mode", choices=MODES, help="of reconstruct; default: what the set has inputs for")
    parser.add_argument(
        "--camera",
        choices=["set", "unknown"],
        default="set",
        help="the set's calibration, or none, as of a phone that was put anywhere",
    )
    parser.add_argument(
        "--keypoints",
        type=Path,
        metavar="DIR",
        help="detections by the name of the take or of its video (TAKE.npz, ...), instead of the detector",
    )
    parser.add_argument("--model-dir", type=Path, metavar="DIR", help="the detector's models, see detect")
    parser.add_argument(
        "--heights", type=Path, metavar="CSV", help="columns subject,height_m, where the set has no heights"
    )
    parser.add_argument("--calibrate", action="store_true", help="calibrate each take from its own motion first")
    parser.add_argument("--no-align", action="store_true", help="take the clocks of video and reference as equal")
    parser.add_argument("--seconds", type=float, metavar="S", help="use the first S seconds of each take")
    parser.add_argument("--size", type=image_size, metavar="WxH", help="of the image, for detections without the video")
    parser.add_argument("--workers", type=int, metavar="N", help="processes; one per core if not given")
    add_model(parser)
    add_output(parser, "out/validation", "folder for tables, page, motions and what is done so far")


def _validate(options: argparse.Namespace) -> int:
    settings = {
        "takes": tuple(name.strip() for name in options.takes.split(",") if name.strip()),
        "mode": options.mode,
        "lifter": options.model,
        "camera": options.camera,
        "keypoints": options.keypoints,
        "models": options.model_dir,
        "heights": None if options.heights is None else _heights(options.heights),
        "calibrate": options.calibrate,
        "align": not options.no_align,
        "seconds": options.seconds,
        "size_px": options.size,
    }
    if options.list:
        from rtof_kin.protocols.validation import ValidationProtocol

        for take in ValidationProtocol(options.root, options.set, **settings).chosen:
            out.print(f"{take.key}  {take.kind}", soft_wrap=True, highlight=False)
        return 0
    failed = measure(options.set, options, Path(options.output), **settings)
    return _FAILED if failed else 0


def _heights(path: Path) -> dict[str, float]:
    """Return the height, m, of each subject."""
    from rtof_kin.core.errors import FileFormatError
    from rtof_kin.core.files.text import read_text

    rows = list(csv.DictReader(read_text(path, "a CSV with the columns subject,height_m").splitlines()))
    try:
        found = {row["subject"].strip(): float(row["height_m"]) for row in rows}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(path, "expected the columns subject,height_m and a number in each row") from error
    for subject, height in found.items():
        if not 0.4 < height < 2.6:
            raise FileFormatError(path, f"{subject}: {height:g} is no human height in metres")
    return found
