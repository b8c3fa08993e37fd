"""OpenSim's coordinates of a skeleton and its motions: ``.mot`` (degrees) and ``.sto`` (states, rad).

The skeleton table has OpenSim's names. With a leading minus, as in ``-hip_flexion_r``, a coordinate turns
about the opposite of the revolute's axis, so that its values have OpenSim's sign; a revolute without a name
in OpenSim keeps the URDF's. Every angle is zero in the T-pose. The root has OpenSim's pelvis_tilt, _list,
_rotation, _tx, _ty and _tz: rotations about z, x, y and translations along x, y, z of its ground, y up.

Both files are tables for the .osim of the same skeleton: a header that ends with ``endheader``, then tab-separated
columns, the first one time in s. OpenSim needs even times and takes a NaN for the end of the file, so a motion with
gaps becomes several files. A ``.mot`` lacks the coordinates that were never observed, for which OpenSim's tools take
the model's zero; a ``.sto`` must have all states, so its header names them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.motion_source import Block, MotionSource
from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names
from rtof_kin.core.files.folder import new_file
from rtof_kin.formats.joint_trajectory import BASE_TURN
from rtof_kin.formats.motion_views import AnyMotion, check_known, dofs_from_prior, even_times, from_prior
from rtof_kin.formats.world_axes import R_WORLD_GROUND

ROOT_AXES: Final = "yxz"
"""Rotation axes of the root in world: z, x and y of OpenSim's ground, the first one reversed."""
_ROOT_ROTATIONS: Final = ("-pelvis_tilt", "pelvis_list", "pelvis_rotation")
_ROOT_TRANSLATIONS: Final = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
_ROOT_RANGE_M: Final = 10.0


@dataclass(frozen=True)
class Coordinate:
    """One degree of freedom of an .osim."""

    name: str
    joint: str
    """The joint of the skeleton that it moves."""
    axis: Array
    """(3,) axis of rotation or translation, in the joint's axes with all angles zero."""
    is_rotation: bool
    range: tuple[float, float]
    """Radians or metres."""
    urdf: str = ""
    """Its URDF name; `BASE_TURN` for the root's rotations, empty for its translations."""

    @property
    def sign(self) -> float:
        """-1 where the axis is the opposite of a link frame's, else 1."""
        return float(np.sign(self.axis.sum()))


def coordinates(table: SkeletonTable) -> tuple[Coordinate, ...]:
    """Return all coordinates: three rotations and three translations of the root, then three rotations of
    each joint in the order of its axes.

    Raises:
        InvalidInputError: two would have one name.
    """
    root = table.names[0]
    out = [
        _rotation(root, axis, name, BASE_TURN, (-np.pi, np.pi))
        for axis, name in zip(ROOT_AXES, _ROOT_ROTATIONS, strict=True)
    ]
    for name, axis in zip(_ROOT_TRANSLATIONS, R_WORLD_GROUND.T, strict=True):
        out.append(Coordinate(name, root, axis, False, (-_ROOT_RANGE_M, _ROOT_RANGE_M)))
    for joint in table.joints[1:]:
        for axis, dof, (low, high) in zip(joint.axes, joint.dofs, joint.limits, strict=True):
            out.append(_rotation(joint.name, axis, dof.opensim, dof.urdf, (low, high)))
    checked_names("OpenSim coordinates", [c.name for c in out])
    return tuple(out)


def _rotation(joint: str, axis: str, opensim: str, urdf: str, limits: tuple[float, float]) -> Coordinate:
    low, high = map(float, limits)
    unit = np.eye(3)["xyz".index(axis)]
    if opensim.startswith("-"):
        return Coordinate(opensim[1:], joint, -unit, True, (-high, -low), urdf)
    return Coordinate(opensim or urdf, joint, unit, True, (low, high), urdf)


def coordinate_values(motion: AnyMotion) -> tuple[tuple[Coordinate, ...], Array]:
    """Return the coordinates of a motion and their values (T, C), rad and m, continuous over time.

    Args:
        motion: its configurations must be known, see `formats.motion_views.pieces`.

    Raises:
        InvalidInputError: a configuration is unknown.
    """
    source = MotionSource.of(motion)
    values = [values[block.own] for block, values in _value_blocks(source)]
    return coordinates(source.skeleton.table), np.concatenate(values)


def _value_blocks(motion: MotionSource) -> Iterator[tuple[Block, Array]]:
    """The motion in blocks with a margin of one frame, and the values of both (n, C)."""
    check_known(motion)
    skeleton, last = motion.skeleton, np.zeros((0, 3))
    signs = [c.sign for c in coordinates(skeleton.table)]
    index = [skeleton.dof_names.index(d.urdf) for j in skeleton.table.joints for d in j.dofs]
    for block in motion.blocks(margin=1):
        turns = so3.matrix_to_euler(ROOT_AXES, block.motion.poses.R_world_bone[block.before :, 0])
        turns = so3.euler_continuous(np.concatenate([last, turns]))  # goes on from the block before
        last = turns[block.own][-1:]
        q = block.motion.q
        unsigned = [turns, q[:, :3] @ np.abs(R_WORLD_GROUND), q[:, 7:][:, index]]
        yield block, np.concatenate(unsigned, axis=1) * signs


# --- files ---------------------------------------------------------------------------------------


def write_mot(path: str | Path, motion: AnyMotion, *, overwrite: bool = False) -> None:
    """Write coordinates, angles in degrees, without those that were never observed.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        InvalidInputError: a frame is unknown, or times are uneven.
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
    """
    source = MotionSource.of(motion)
    every, unseen = coordinates(source.skeleton.table), never_observed(source.masks)
    unit = [180 / np.pi if c.is_rotation else 1.0 for c in every]
    kept = [i for i, c in enumerate(every) if c.urdf not in unseen]
    names = [every[i].name for i in kept]
    values = ((values * unit)[block.own][:, kept] for block, values in _value_blocks(source))
    _write_table(Path(path), source, names, values, True, overwrite)


def write_sto(path: str | Path, motion: AnyMotion, *, overwrite: bool = False) -> None:
    """Write states under their paths in the model: values, rad and m, and speeds, rad/s and m/s, by central
    differences (0 for a single frame).

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        As `write_mot`.
    """
    source = MotionSource.of(motion)
    every = coordinates(source.skeleton.table)
    names = [f"/jointset/{c.joint}/{c.name}/{kind}" for kind in ("value", "speed") for c in every]
    _write_table(Path(path), source, names, _states(source), False, overwrite)


def _states(motion: MotionSource) -> Iterator[Array]:
    """Values and speeds (n, 2 C) in blocks."""
    times = even_times(motion.times)
    for block, values in _value_blocks(motion):
        first = block.start - block.before
        speeds = np.zeros_like(values)
        if len(values) > 1:
            speeds = np.gradient(values, times[first : first + len(values)], axis=0)
        yield np.hstack([values, speeds])[block.own]


def _write_table(
    path: Path, motion: MotionSource, names: list[str], blocks: Iterable[Array], in_degrees: bool, overwrite: bool
) -> None:
    header = [
        path.stem,
        "version=1",
        f"nRows={len(motion)}",
        f"nColumns={1 + len(names)}",
        f"inDegrees={'yes' if in_degrees else 'no'}",
        f"Coordinates of the .osim of the skeleton {motion.skeleton.name}, zero in the T-pose; y is up.",
        f"Units are S.I. units, angles in {'degrees' if in_degrees else 'radians'}.",
        *_unseen(motion),
        "endheader",
        "\t".join(["time", *names]),
    ]
    times, first = even_times(motion.times), 0
    with new_file(path, overwrite) as whole, whole.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines(f"{line}\n" for line in header)
        for values in blocks:
            table = np.column_stack([times[first : first + len(values)], values])
            stream.writelines("\t".join(map(repr, row)) + "\n" for row in table.tolist())
            first += len(values)


def _unseen(motion: MotionSource) -> list[str]:
    """Return a line each on unobserved joints and coordinates, if any."""
    dofs = dofs_from_prior(motion)
    unseen = {c.name: dofs[c.urdf] for c in coordinates(motion.skeleton.table) if c.urdf in dofs}
    return [
        f"Unobserved {what} and the share of the frames: "
        + ", ".join(f"{name} {100 * share:.3g} %" for name, share in shares.items())
        + "."
        for what, shares in (("joints", from_prior(motion)), ("coordinates", unseen))
        if shares
    ]
