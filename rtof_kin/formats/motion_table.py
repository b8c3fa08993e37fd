"""A motion as one wide table, for spreadsheets (CSV) and data frames (Parquet).

One row per frame. Columns: time, pose of the root link, every revolute of the URDF, coordinates of every
landmark; for every joint whether its position is valid and its provenance; for the root link's
orientation, every revolute and every other landmark whether it was observed. Unknown values are empty cells
or nulls; bridged values and those of a prior alone are present and not valid.
"""

from __future__ import annotations

import csv
import json
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import ObservationMasks, observed_dofs, observed_landmarks, root_turn_observed
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.packages import optional
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS, BASE_TURN

CONVENTION: Final = (
    "world: z up, m; base: pose of the root link in world, quaternion x y z w; revolutes as in the "
    "URDF, zero in the T-pose; p_NAME: landmark in world; NAME_valid: whether the position of that joint "
    "was estimated and not bridged; NAME_seen_by: its provenance, 'prior' where unobserved; of a "
    "revolute, base_q and other landmarks, NAME_valid: whether it was observed, else it is a prior's"
)


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    name: str
    unit: str
    """'s', 'm', 'rad', '1' (no unit), or '' of values that are no numbers."""
    values: NDArray[Any]
    """(T,) numbers (NaN where unknown), booleans or texts."""
    also: dict[str, str] = field(default_factory=dict)
    """'clinical' and 'opensim' names, '-' in front where the sign is opposite."""


def motion_columns(motion: Motion, masks: ObservationMasks | None = None) -> list[Column]:
    """Return the columns of the table of a motion, in their order."""
    skeleton, poses = motion.skeleton, motion.poses
    masks = masks or ObservationMasks.of(motion)
    dofs = {dof.urdf: dof for joint in skeleton.table.joints for dof in joint.dofs}
    columns = [Column("time", "s", motion.times)]
    for name, values in zip(BASE_COLUMNS, motion.q[:, :7].T, strict=True):
        columns.append(Column(name, "1" if name.startswith("base_q") else "m", values))
    for name, values in zip(skeleton.dof_names, motion.q[:, 7:].T, strict=True):
        also = {"clinical": dofs[name].clinical, "opensim": dofs[name].opensim}
        columns.append(Column(name, "rad", values, also))
    p = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    for landmark, name in enumerate(skeleton.landmarks):
        columns += [Column(f"p_{name}_{axis}", "m", p[:, landmark, i]) for i, axis in enumerate("xyz")]
    words = np.array([provenance.name.lower() for provenance in Provenance])
    for j, name in enumerate(skeleton.names):
        columns.append(Column(f"{name}_valid", "", poses.valid[:, j]))
        columns.append(Column(f"{name}_seen_by", "", words[poses.provenance[:, j]]))
    beside = len(skeleton.names)  # landmarks are the joints first
    names = (BASE_TURN, *skeleton.dof_names, *tuple(skeleton.landmarks)[beside:])
    observed = np.column_stack([root_turn_observed(masks), observed_dofs(masks), observed_landmarks(masks)[:, beside:]])
    return columns + [Column(f"{n}_valid", "", valid) for n, valid in zip(names, observed.T, strict=True)]


def write_motion_csv(path: str | Path, motion: Motion | MotionSource, *, overwrite: bool = False) -> None:
    """Write the table; units are in brackets in the names of its columns, e.g. ``LeftLeg_y [rad]``.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
    """
    with new_file(path, overwrite) as whole, whole.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        for number, (block, masks) in enumerate(MotionSource.of(motion).observed_blocks()):
            columns = motion_columns(block, masks)
            if number == 0:
                writer.writerow([f"{c.name} [{c.unit}]" if c.unit else c.name for c in columns])
            writer.writerows(zip(*(_cells(c.values) for c in columns), strict=True))


def _cells(values: NDArray[Any]) -> list[str]:
    """Texts of the values (T,) of a column; '' for NaN."""
    if values.dtype.kind == "U":
        return [str(value) for value in values.tolist()]
    if values.dtype.kind == "b":
        return ["1" if value else "0" for value in values.tolist()]
    return ["" if value != value else repr(value) for value in values.tolist()]


def write_motion_parquet(path: str | Path, motion: Motion | MotionSource, *, overwrite: bool = False) -> None:
    """Write the table with units, clinical and OpenSim names in the metadata of its columns, and
    convention, skeleton and joint offsets in that of the table.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        RtofError: pyarrow is not installed, or the file cannot be written.
        OutputExistsError: the file exists and `overwrite` is False.
    """
    pa, parquet = (optional(name, "parquet", "Parquet") for name in ("pyarrow", "pyarrow.parquet"))
    source = MotionSource.of(motion)
    skeleton = source.skeleton
    offsets = dict(zip(skeleton.names, skeleton.joint_offsets.tolist(), strict=True))
    about = {"convention": CONVENTION, "skeleton": skeleton.name, "joint_offsets_m": json.dumps(offsets)}
    with new_file(path, overwrite) as file, ExitStack() as stack:
        writer = None
        for block, masks in source.observed_blocks():
            columns = motion_columns(block, masks)
            arrays = [pa.array(c.values, from_pandas=True) for c in columns]  # from_pandas: NaN is null
            fields = [
                pa.field(c.name, array.type, metadata=({"unit": c.unit} if c.unit else {}) | c.also)
                for c, array in zip(columns, arrays, strict=True)
            ]
            schema = pa.schema(fields, about)
            writer = writer or stack.enter_context(parquet.ParquetWriter(file, schema))
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
