"""Commands that make other files: a recording of motion capture, a reconstructed motion in other formats."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rtof_kin.cli.terminal import add_output, command, out, print_files

if TYPE_CHECKING:
    from rtof_kin.simulation.simulate import SimulationSettings


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    _add_simulate(commands)
    _add_export(commands)


# --- what they do --------------------------------------------------------------------------------


def _simulate(options: argparse.Namespace) -> None:
    from dataclasses import replace

    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.recording.index import INDEX
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
        f"wrote {options.output}: {len(times)} frames, {times[-1] - times[0]:.1f} s, the person is visible "
        f"in {100 * seen:.0f} % of them",
        soft_wrap=True,
    )


def _export(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import InvalidInputError
    from rtof_kin.core.files.folder import new_folder
    from rtof_kin.formats.motion_files import DEFAULT, URDF, check_formats, write_motion_files
    from rtof_kin.formats.motion_npz import MotionReader, motion_path

    if options.output and options.folder:
        raise InvalidInputError("export: name one folder to write, as OUT or with -o OUT")
    output = options.output or options.folder
    formats = DEFAULT if options.to is None else [name.strip() for name in options.to.split(",")]
    if "archive" in formats:
        from rtof_kin.reporting.archive import write_result_archive

        if len(formats) > 1:
            raise InvalidInputError(
                "--to archive: one ZIP file of everything; other formats go to a folder of their own"
            )
        write_result_archive(output, options.motion, options.recording, options.overwrite)
        out.print(f"wrote {output}: recording, settings, versions and result, without names and video", soft_wrap=True)
        return
    check_formats(formats)
    with MotionReader(motion_path(options.motion)) as reader, new_folder(output, URDF, options.overwrite) as folder:
        write_motion_files(folder, reader.source(), formats)
    print_files(output)


# --- their arguments ---


def _add_simulate(commands: Any) -> None:
    parser = command(
        commands,
        "simulate",
        _simulate,
        "make a recording from motion capture",
        "A virtual camera and virtual IMUs observe the motion of a BVH or ASF/AMC file, which is kept as the truth.",
    )
    parser.add_argument("motion", metavar="MOTION", help=".bvh or .amc file")
    add_output(parser, None, "folder to write")
    parser.add_argument(
        "--keypoints",
        choices=["perfect", "white", "independent", "realistic"],
        default="realistic",
        help="errors of the 2D: none; white noise of 5 px; of each joint by itself; those of a real detector",
    )
    parser.add_argument(
        "--sensors",
        metavar="NAMES",
        help="IMUs, separated by commas (e.g. Pelvis,L_LowArm); default: the eight limb sensors, '' for none",
    )
    parser.add_argument(
        "--camera",
        type=int,
        choices=range(4),
        help="one of four around the motion; default: the one that sees most of it",
    )
    parser.add_argument("--rate", type=float, metavar="HZ", help="true frame rate of the file")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the camera and all errors")
    parser.add_argument("--acknowledgement", default="", help="acknowledgement that the data's owner asks for")


def _add_export(commands: Any) -> None:
    parser = command(
        commands,
        "export",
        _export,
        "write a reconstructed motion in other formats",
        "Always writes the subject's URDF and files.json, which lists axes, units and names of every "
        "file. Unobserved frames are marked or missing in every format.",
    )
    parser.add_argument("motion", metavar="MOTION", help="output folder, or its motion.npz")
    folder = parser.add_argument("folder", metavar="OUT", help="folder to write")

    class InPlaceOfFolder(argparse.Action):
        """Option that replaces the positional OUT; argparse would skip an optional positional."""

        def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:  # noqa: ARG002
            folder.required = False
            namespace.output = values

    add_output(parser, "", "the same, as for other commands", action=InPlaceOfFolder)
    parser.add_argument(
        "--to",
        metavar="FORMATS",
        help="separated by commas: csv,ros (the default), parquet; osim,mot,sto,trc (OpenSim); c3d; bvh. "
        "archive: OUT is one ZIP file of recording, settings, versions and result, without names and video",
    )
    parser.add_argument(
        "--recording", metavar="FOLDER", help="recording of MOTION for the archive; default: that of run, or the demo"
    )
