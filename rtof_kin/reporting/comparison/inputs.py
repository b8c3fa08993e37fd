"""What is compared: outputs of a reconstruction, motions, or the coordinates of another system."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from rtof_kin.body.motion_file import EARLIER, MOTION, MotionReader, motion_path
from rtof_kin.clinical.comparison import Compared, compared
from rtof_kin.clinical.comparison_opensim import opensim_angles
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.formats.opensim_table import SUFFIXES, read_opensim_table
from rtof_kin.reporting.summary_file import SUMMARY, read_summary

_LISTED: Final = 6  # coordinates that a note lists


def read_compared(path: str | Path) -> Compared:
    """Read one side of a comparison.

    Args:
        path: output folder of reconstruct or run, a ``motion.h5``, or an OpenSim ``.mot`` or ``.sto``.

    Raises:
        FileFormatError: it is none of these, or damaged.
    """
    path = Path(path)
    if path.suffix.lower() in SUFFIXES:
        return _other_system(path)
    file = motion_path(path)
    recording, mode = "", ""
    if (summary := file.parent / SUMMARY).is_file():
        found = read_summary(summary)
        recording, mode = found.recording, found.mode
    with MotionReader(file) as reader:
        motion, mode = reader.read(), mode or reader.mode
    name = _name(path) + (f" ({mode})" if mode else "")
    return compared(name, motion, recording)


def distinct(a: Compared, b: Compared, paths: tuple[str | Path, str | Path]) -> tuple[str, str]:
    """Return names of both that differ, with as many of their folders as tell them apart."""
    if a.name != b.name:
        return a.name, b.name
    parts = [Path(path).resolve().parts[1:] for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        first, second = ("/".join(own[-count:]) for own in parts)
        if first != second:
            return first, second
    return f"{a.name}, first", f"{b.name}, second"


def _name(path: Path) -> str:
    """Name of the folder that a user gave the result, or of the file."""
    if path.is_dir():
        return path.resolve().name
    return path.resolve().parent.name if path.name in (MOTION, EARLIER) else path.name


def _other_system(path: Path) -> Compared:
    table = read_opensim_table(path)
    try:
        angles, others = opensim_angles(table)
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error
    notes: tuple[str, ...] = ()
    if others:
        more = f" and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
        notes = (f"coordinates that are no clinical angle of this package: {', '.join(others[:_LISTED])}{more}",)
    return Compared(path.name, angles, other_system=True, own_export=bool(table.skeleton), notes=notes)
