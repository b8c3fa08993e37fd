"""A motion as one wide table, for spreadsheets (CSV) and data frames (Parquet).

A row for each frame; a column each for the time, the pose of the root link, every revolute of the URDF,
the coordinates of every landmark, for every joint whether its position is valid and who saw it, and for
the root link's turn, every revolute and every landmark beside the joints whether it was observed. What is
not known is an empty cell or a null; what was bridged, or is a prior's alone, is there, and not valid.
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.observability import observed_dofs, observed_landmarks, root_turn_observed
from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import write_text
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS, BASE_TURN

CONVENTION = (
    "world: z up, m; base: pose of the root link in world, quaternion x y z w; revolutes as in the "
    "URDF, zero in the T-pose; p_NAME: landmark in world; NAME_valid: whether the position of that joint "
    "is an estimate and was not bridged; NAME_seen_by: its provenance, 'prior' where nobody saw it; of a "
    "revolute, base_q and other landmarks, NAME_valid: whether anybody observed it, else it is a prior's"
)


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    name: str
    unit: str
    """'s', 'm', 'rad', '1' (a number without one), or '' where the values are no numbers."""
    values: NDArray[Any]
    """(T,) numbers (NaN where not known), booleans or texts."""
    also: dict[str, str]
    """What else the column is called: 'clinical' and 'opensim' names, '-' where the sign is opposite."""


def motion_columns(motion: MotionSequence) -> list[Column]:
    """The columns of the table of a motion, in their order."""
    skeleton, poses = motion.skeleton, motion.poses
    dofs = {dof.urdf: dof for joint in skeleton.table.joints for dof in joint.dofs}
    columns = [Column("time", "s", motion.times, {})]
    for name, values in zip(BASE_COLUMNS, motion.q[:, :7].T, strict=True):
        columns.append(Column(name, "1" if name.startswith("base_q") else "m", values, {}))
    for name, values in zip(skeleton.dof_names, motion.q[:, 7:].T, strict=True):
        also = {"clinical": dofs[name].clinical, "opensim": dofs[name].opensim}
        columns.append(Column(name, "rad", values, also))
    p = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    for landmark, name in enumerate(skeleton.landmarks):
        for i, axis in enumerate("xyz"):
            columns.append(Column(f"p_{name}_{axis}", "m", p[:, landmark, i], {}))
    words = np.array([provenance.name.lower() for provenance in Provenance])
    for j, name in enumerate(skeleton.names):
        columns.append(Column(f"{name}_valid", "", poses.valid[:, j], {}))
        columns.append(Column(f"{name}_seen_by", "", words[poses.provenance[:, j]], {}))
    columns += _validity((BASE_TURN,), root_turn_observed(motion)[:, None])
    columns += _validity(skeleton.dof_names, observed_dofs(motion))
    beside = len(skeleton.names)  # landmarks are the joints first
    columns += _validity(tuple(skeleton.landmarks)[beside:], observed_landmarks(motion)[:, beside:])
    return columns


def _validity(names: tuple[str, ...], observed: NDArray[np.bool_]) -> list[Column]:
    return [Column(f"{n}_valid", "", valid, {}) for n, valid in zip(names, observed.T, strict=True)]


def write_motion_csv(path: str | Path, motion: MotionSequence, *, overwrite: bool = False) -> None:
    """Write the table; units stand in brackets in the names of its columns, e.g. ``LeftLeg_y [rad]``.

    Raises:
        OutputExistsError: the file exists and overwriting was not asked for. RtofError: it cannot be
            written.
    """
    columns = motion_columns(motion)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([f"{c.name} [{c.unit}]" if c.unit else c.name for c in columns])
    writer.writerows(zip(*([_cell(v) for v in c.values.tolist()] for c in columns), strict=True))
    write_text(Path(path), stream.getvalue(), overwrite)


def _cell(value: float | bool | str) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return value if isinstance(value, str) else "" if np.isnan(value) else repr(value)


def write_motion_parquet(path: str | Path, motion: MotionSequence, *, overwrite: bool = False) -> None:
    """Write the table with units, clinical and OpenSim names in the metadata of its columns, and the
    convention, the skeleton and its joint offsets in that of the table.

    Raises:
        RtofError: pyarrow is not installed, or the file cannot be written. OutputExistsError: the file
            exists and overwriting was not asked for.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise RtofError("Parquet needs pyarrow: install the extra, rtof_kin[parquet]") from error
    columns = motion_columns(motion)
    arrays = [pa.array(c.values, from_pandas=True) for c in columns]  # from_pandas: NaN is null
    fields = [
        pa.field(c.name, array.type, metadata=({"unit": c.unit} if c.unit else {}) | c.also)
        for c, array in zip(columns, arrays, strict=True)
    ]
    skeleton = motion.skeleton
    offsets = dict(zip(skeleton.names, skeleton.joint_offsets.tolist(), strict=True))
    about = {"convention": CONVENTION, "skeleton": skeleton.name, "joint_offsets_m": json.dumps(offsets)}
    with new_file(path, overwrite) as file:
        parquet.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields, about)), file)
