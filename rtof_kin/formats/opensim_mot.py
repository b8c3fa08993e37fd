"""OpenSim's motions: ``.mot`` (coordinates in degrees) and ``.sto`` (states: values and speeds in rad).

Tables for the .osim of the same skeleton: a header that ends with ``endheader``, then tab-separated columns,
the first one time in s. Translations are in m. OpenSim needs even times and takes a NaN for the end of the
file, so a motion with gaps becomes several files. A ``.mot`` lacks the coordinates that were never
observed, for which OpenSim's tools take the model's zero; a ``.sto`` must have all states, so its header
names them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.files.text import write_text
from rtof_kin.formats.motion_views import dofs_from_prior, even_times, from_prior
from rtof_kin.formats.opensim_coordinates import coordinate_values, coordinates

Array = NDArray[np.float64]


def write_mot(path: str | Path, motion: MotionSequence, *, overwrite: bool = False) -> None:
    """Write coordinates, angles in degrees, without those that were never observed.

    Args:
        path: the file. motion: known configurations at even times.
        overwrite: whether an existing file is replaced.

    Raises:
        InvalidInputError: a frame is unknown, or times are uneven.
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
    """
    every, values = coordinate_values(motion)
    unit = [180 / np.pi if c.is_rotation else 1.0 for c in every]
    unseen = never_observed(motion)
    kept = [i for i, c in enumerate(every) if c.urdf not in unseen]
    names = [every[i].name for i in kept]
    _write_table(Path(path), motion, names, (values * unit)[:, kept], True, overwrite)


def write_sto(path: str | Path, motion: MotionSequence, *, overwrite: bool = False) -> None:
    """Write states under their paths in the model: values, rad and m, and speeds, rad/s and m/s, by central
    differences (0 for a single frame).

    Args:
        path: the file. motion: known configurations at even times.
        overwrite: whether an existing file is replaced.

    Raises:
        As `write_mot`.
    """
    every, values = coordinate_values(motion)
    speeds = np.zeros_like(values)
    if len(values) > 1:
        speeds = np.gradient(values, even_times(motion.times), axis=0)
    names = [f"/jointset/{c.joint}/{c.name}/{kind}" for kind in ("value", "speed") for c in every]
    _write_table(Path(path), motion, names, np.hstack([values, speeds]), False, overwrite)


def _write_table(
    path: Path, motion: MotionSequence, names: list[str], values: Array, in_degrees: bool, overwrite: bool
) -> None:
    table = np.column_stack([even_times(motion.times), values])
    header = [
        path.stem,
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={table.shape[1]}",
        f"inDegrees={'yes' if in_degrees else 'no'}",
        f"Coordinates of the .osim of the skeleton {motion.skeleton.name}, zero in the T-pose; y is up.",
        f"Units are S.I. units, angles in {'degrees' if in_degrees else 'radians'}.",
        *_unseen(motion),
        "endheader",
        "\t".join(["time", *names]),
    ]
    rows = ["\t".join(map(repr, row)) for row in table.tolist()]
    write_text(path, "\n".join([*header, *rows, ""]), overwrite)


def _unseen(motion: MotionSequence) -> list[str]:
    """Return a line each on unobserved joints and coordinates, if any."""
    dofs = dofs_from_prior(motion)
    unseen = {c.name: dofs[c.urdf] for c in coordinates(motion.skeleton.table) if c.urdf in dofs}
    return [
        f"Unobserved {what} and the share of the frames: "
        + ", ".join(f"{name} {100 * share:.3g} %" for name, share in shares.items()) + "."
        for what, shares in (("joints", from_prior(motion)), ("coordinates", unseen)) if shares
    ]  # fmt: skip
