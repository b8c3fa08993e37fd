"""Clinical angles from the coordinates of an OpenSim model, to compare them with those of a motion.

Coordinates of another system's model are taken by their names, with the sign of `AngleRow.opensim`; their
zero is that of their model. Files of this package's own .osim contain all revolutes of its skeleton, so they
give segment orientations, and from these the same angles as the motion: its ``lumbar_extension`` is one of
four joints of the spine, not the whole angle.
"""

from __future__ import annotations

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import AngleRow, AngleTable, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.opensim_mot import ROOT_AXES, coordinates
from rtof_kin.formats.opensim_table import OpenSimTable

_PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation")


def opensim_angles(found: OpenSimTable) -> tuple[ClinicalAngles, tuple[str, ...]]:
    """Return clinical angles, and the coordinates that are none of them.

    Args:
        found: coordinates of this package's model or another.

    Raises:
        InvalidInputError: no coordinate is a clinical angle.
    """
    if found.skeleton:
        return _of_own_model(found, SkeletonModel.named(found.skeleton)), ()
    table = angle_table(SkeletonModel.default().table)
    values, used = np.full((len(found.times), len(table.rows)), np.nan), set()
    for column, row in enumerate(table.rows):
        name = row.opensim.removeprefix("-")
        if name and (angle := found.rotation(name)) is not None:
            values[:, column] = _continuous(-angle if row.opensim.startswith("-") else angle, row)
            used.add(name)
    others = tuple(name for name in found.names if name not in used)
    if not used:
        raise InvalidInputError(
            f"no coordinate is a clinical angle of this package: {', '.join(others[:8])}; rename columns to "
            f"those of Rajagopal's model, e.g. {', '.join(_names(table)[:4])}"
        )
    return _plain(found.times, values, table), others


def _names(table: AngleTable) -> list[str]:
    return [row.opensim.removeprefix("-") for row in table.rows if row.opensim and "hip" in row.opensim]


def _plain(times: Array, values: Array, table: AngleTable) -> ClinicalAngles:
    """Angles without provenance, bands and singular postures."""
    nothing = np.zeros(values.shape)
    return ClinicalAngles(times, values, nothing.astype(np.uint8), nothing.astype(np.bool_), table.rows)


def _continuous(angle: Array, row: AngleRow) -> Array:
    """Unwrap each stretch without a gap, by whole turns into the angle's range."""
    out = np.array(angle)
    for start, stop in signals.runs(np.isfinite(out)):
        stretch = np.unwrap(out[start:stop])
        turns = np.round((np.median(stretch) - np.mean(row.range)) / (2 * np.pi))
        out[start:stop] = stretch - 2 * np.pi * turns
    return out


def _of_own_model(found: OpenSimTable, skeleton: SkeletonModel) -> ClinicalAngles:
    """Angles of the segment orientations; those of joints without a column are NaN."""
    q = np.zeros((len(found.times), skeleton.nq))
    root, given = np.zeros((len(found.times), 3)), set()
    for number, coordinate in enumerate(coordinates(skeleton.table)):
        angle = found.rotation(coordinate.name) if coordinate.is_rotation else None
        if angle is None:
            continue
        given.add(coordinate.name if number < 3 else coordinate.urdf)
        if number < 3:
            root[:, number] = coordinate.sign * angle
        else:
            q[:, 7 + skeleton.dof_names.index(coordinate.urdf)] = coordinate.sign * angle
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(so3.euler_to_matrix(ROOT_AXES, root)), -1, axis=-1)
    p, R = skeleton.forward_kinematics(q)
    angles = clinical_angles(all_observed(PoseSequence(found.times, p, R, skeleton.names)), skeleton)
    table, values = angle_table(skeleton.table), np.array(angles.values)
    for number, joint in enumerate(table.joints):
        if not given & set(joint.urdf or _PELVIS):
            values[:, 3 * number : 3 * number + 3] = np.nan
    return ClinicalAngles(found.times, values, angles.provenance, angles.singular, angles.rows)
