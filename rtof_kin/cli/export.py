"""The command export: a motion in other formats, an archive of a result, a lifter for other languages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rtof_kin.cli.options import Overwrite, command
from rtof_kin.cli.terminal import out, print_files
from rtof_kin.core.errors import InvalidInputError


@command
def export(
    motion: str,
    target: Path | None = None,
    /,
    *,
    output: Annotated[
        Path | None, Parameter(name=("--output", "-o"), metavar="OUT", help="the same, as for other commands")
    ] = None,
    to: tuple[str, ...] = (),
    recording: Annotated[Path | None, Parameter(metavar="FOLDER")] = None,
    flip: bool = True,
    overwrite: Overwrite = False,
) -> None:
    """Write a reconstructed motion in other formats.

    Always writes the subject's URDF and files.json, which lists axes, units and names of every file. Unobserved frames
    are marked or missing in every format.

    --to archive makes one ZIP file of recording, settings, versions and result, without names and video. --to onnx
    writes a lifter, MOTION being its file or name (detections, perfect), as one graph from rays and sensor orientations
    in world to poses in world; its inputs, outputs, joints and rate are in the metadata. It needs the package onnx.

    Args:
        motion: output folder of reconstruct or run, or its motion.npz
        target: folder or file to write
        to: separated by commas: csv,ros (the default), parquet; osim,mot,sto,trc (OpenSim); c3d; bvh; archive; onnx
        recording: recording of MOTION for the archive; default: that of run, or the demo
        flip: of a lifter, estimate the mirrored scene too; without it faster and less exact
    """
    if (target is None) == (output is None):
        raise InvalidInputError("export: name one folder or file to write, as OUT or with -o OUT")
    written = output if target is None else target
    assert written is not None
    if {"archive", "onnx"} & {*to}:
        if len(to) > 1:
            raise InvalidInputError(f"--to {to[0]}: one file of its own; other formats go to a folder of their own")
        (_write_archive if to[0] == "archive" else _write_lifter)(motion, written, recording, flip, overwrite)
        return
    from rtof_kin.core.files.folder import new_folder
    from rtof_kin.formats.motion_files import DEFAULT, URDF, check_formats, write_motion_files
    from rtof_kin.formats.motion_npz import MotionReader, motion_path

    formats = to or DEFAULT
    check_formats(formats)
    with MotionReader(motion_path(motion)) as reader, new_folder(written, URDF, overwrite) as folder:
        write_motion_files(folder, reader.source(), formats)
    print_files(written)


def _write_archive(motion: str, path: Path, recording: Path | None, _: bool, overwrite: bool) -> None:
    from rtof_kin.reporting.archive import write_result_archive

    write_result_archive(path, Path(motion), recording, overwrite)
    out.print(f"wrote {path}: recording, settings, versions and result, without names and video", soft_wrap=True)


def _write_lifter(name: str, path: Path, _: Path | None, flip: bool, overwrite: bool) -> None:
    from lifting.onnx_export import export_onnx
    from lifting.predict import Lifter
    from rtof_kin.core.files.folder import check_new_file

    check_new_file(path, overwrite)
    out.print(f"wrote {export_onnx(Lifter.load(Path(name)), path, flip, overwrite)}", soft_wrap=True)
