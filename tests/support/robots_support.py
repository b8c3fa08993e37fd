"""Robots of the packages on PyPI, and one written by hand with the names of Unitree's H1."""

from __future__ import annotations

from importlib.metadata import files
from pathlib import Path

from fourier_robot_descriptions.fourier import BASE_PACKAGE_PATH

H1_LEG = (
    ("hip_yaw", "pelvis", "0 .0875 -.1742", "z", -0.43, 0.43, 23),
    ("hip_roll", "hip_yaw", ".0395 0 0", "x", -0.43, 0.43, 23),
    ("hip_pitch", "hip_roll", "0 .1154 0", "y", -3.14, 2.53, 23),
    ("knee", "hip_pitch", "0 0 -.4", "y", -0.26, 2.05, 14),
    ("ankle", "knee", "0 0 -.4", "y", -0.87, 0.52, 9),
)
H1_ARM = (
    ("shoulder_pitch", "torso_link", "0 .155 .43", "y", -2.87, 2.87, 9),
    ("shoulder_roll", "shoulder_pitch", "0 .0565 0", "x", -0.34, 3.11, 9),
    ("shoulder_yaw", "shoulder_roll", "0 0 -.134", "z", -1.3, 4.45, 20),
    ("elbow", "shoulder_yaw", ".0185 0 -.198", "y", -1.25, 2.61, 20),
)
"""Joint, parent, place, axis, limits, rad, and velocity, rad/s, of the left side, as in unitree_ros/h1_description."""


def published(package: str, file: str) -> Path:
    """A file of an installed package."""
    return next(Path(str(path.locate())) for path in files(package) or () if path.name == file)


def h1_urdf() -> str:
    """H1 without shapes and with 1 kg in each link."""
    rows = [("torso_joint", "pelvis", "torso_link", "0 0 0", "z", -2.35, 2.35, 23.0)]
    for side, sign in (("left", 1), ("right", -1)):
        for name, parent, place, axis, low, high, velocity in (*H1_LEG, *H1_ARM):
            limits = (low, high) if sign > 0 or axis == "y" else (-high, -low)
            x, y, z = place.split()
            at = f"{x} {sign * float(y)} {z}"
            above = parent if parent in ("pelvis", "torso_link") else f"{side}_{parent}_link"
            rows.append((f"{side}_{name}_joint", above, f"{side}_{name}_link", at, axis, *limits, float(velocity)))
    mass = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = "".join(f'<link name="{name}">{mass}</link>' for name in ("pelvis", *(row[2] for row in rows)))
    for name, parent, child, at, axis, low, high, velocity in rows:
        unit = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}[axis]
        text += f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        text += f'<origin xyz="{at}"/><axis xyz="{unit}"/>'
        text += f'<limit lower="{low}" upper="{high}" velocity="{velocity}" effort="1"/></joint>'
    return f'<robot name="h1">{text}</robot>'


TALOS = published("example-robot-data", "talos_full_v2.urdf")
G1 = published("example-robot-data", "g1_29dof_rev_1_0.urdf")
GR1 = BASE_PACKAGE_PATH / "gr1t2.urdf"
OTHERS = {
    "talos": [published("example-robot-data", "talos_reduced.urdf")],
    "gr1": [BASE_PACKAGE_PATH / "gr1t1.urdf"],
    "g1": [published("example-robot-data", "g1_29dof_with_hand_rev_1_0.urdf")],
}
"""Further robots of the same map."""
