"""A person as a model of MuJoCo (MJCF) with de Leva's masses and inertias, and configurations in MuJoCo's order.

Bodies are the links of the URDF, with its three revolutes each. Capsules, of a foot from heel to ball, collide with the
floor only; toes, which the skeleton does not bend, have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Joint
from rtof_kin.body.soles import FEET, sole_offsets
from rtof_kin.body.urdf import segment_inertia
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.arrays import write_npz

FOOT_RADIUS: Final = 0.02  #: [m] of the capsules of the feet, which touch the sole


def to_mjcf(skeleton: SkeletonModel, floor: float) -> str:
    """Return the model; its joints are in the order of the configuration. floor: height of the floor in world, m."""
    root = ET.Element("mujoco", model=skeleton.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(ET.SubElement(root, "default"), "geom", contype="0")
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "geom", type="plane", name="floor", pos=_text([0, 0, floor]), size="0 0 0.1", contype="1")
    _add_body(world, skeleton, skeleton.table.joints[0])
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_body(parent: ET.Element, skeleton: SkeletonModel, joint: Joint) -> None:
    body = ET.SubElement(parent, "body", name=joint.name, pos=_text(joint.offset))
    if joint.parent is None:
        ET.SubElement(body, "freejoint", name=f"{joint.name}_free")
    for dof, axis, limits in zip(joint.dofs, joint.axes, joint.limits, strict=True):
        unit = " ".join("1" if one == axis else "0" for one in "xyz")
        ET.SubElement(body, "joint", name=dof.urdf, axis=unit, range=_text(limits))
    mass, center, matrix = segment_inertia(joint, skeleton.table)
    inertia = _text([*np.diag(matrix), *matrix[[0, 0, 1], [1, 2, 2]]])
    ET.SubElement(body, "inertial", pos=_text(center), mass=f"{mass:.12g}", fullinertia=inertia)
    ends, radius = [np.zeros(3), joint.end], joint.radius
    if joint.name in FEET:
        ends, radius = [*(sole_offsets(skeleton)[FEET.index(joint.name)] + [0, 0, FOOT_RADIUS])], FOOT_RADIUS
    ET.SubElement(body, "geom", name=joint.name, type="capsule", fromto=_text([*ends[0], *ends[1]]), size=f"{radius:g}")
    children = [one for one in skeleton.table.joints if one.parent == joint.name]
    for child in sorted(children, key=lambda one: skeleton.dof_names.index(one.dofs[0].urdf)):
        _add_body(body, skeleton, child)


def _text(vector: Sequence[float] | Array) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(vector, dtype=float) + 0.0)


def write_qpos(path: Path, times: Array, q: Array, joints: Sequence[str]) -> None:
    """Write ``qpos`` (T, nq): base position, m, quaternion w x y z, angles, rad, in the order of ``joint_names``;
    ``times`` (T,), s, and ``fps``. q: (T, nq) of Pinocchio. An existing file is replaced.
    """
    fps = 1 / np.median(np.diff(times)) if len(times) > 1 else np.nan
    qpos = np.concatenate([q[:, :3], q[:, [6, 3, 4, 5]], q[:, 7:]], axis=1)
    arrays = {"qpos": qpos, "times": times, "fps": np.array(fps), "joint_names": np.array(joints)}
    write_npz(path, arrays, overwrite=True)
