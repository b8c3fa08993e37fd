"""The command that hands a lifter to other languages."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rtof_kin.cli.terminal import command, out


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "export-lifter",
        _export_lifter,
        "write a lifter as ONNX, for other languages",
        "One graph from rays and sensor orientations in world to poses in world; its inputs, outputs, "
        "joints and rate are in the file's metadata. Needs the package onnx.",
    )
    parser.add_argument(
        "lifter",
        nargs="?",
        type=Path,
        metavar="LIFTER",
        help="checkpoint, or the name of a shipped one: detections (the default), perfect",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.onnx", help="file to write")
    parser.add_argument("--no-flip", action="store_true", help="without the mirrored scene: faster and less exact")
    parser.add_argument("--overwrite", action="store_true", help="replace the file if there is one")


def _export_lifter(options: argparse.Namespace) -> None:
    from lifting.onnx_export import export_onnx
    from lifting.predict import Lifter
    from rtof_kin.core.files.folder import check_new_file

    check_new_file(options.output, options.overwrite)
    lifter = Lifter.load(options.lifter)
    path = export_onnx(lifter, options.output, not options.no_flip, options.overwrite)
    out.print(f"wrote {path}", soft_wrap=True)
