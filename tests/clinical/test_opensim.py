"""Comparison with OpenSim: a model of its joints in the ISB order, posed by OpenSim in a separate process."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical import decomposition as jcs
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
CHAINS = {
    "pelvis": ("ground", ("pelvis_tilt", "pelvis_list", "pelvis_rotation"), "zxy"),
    "torso": ("pelvis", ("lumbar_extension", "lumbar_bending", "lumbar_rotation"), "zxy"),
    "femur_r": ("pelvis", ("hip_flexion_r", "hip_adduction_r", "hip_rotation_r"), "zxy"),
    "femur_l": ("pelvis", ("hip_flexion_l", "hip_adduction_l", "hip_rotation_l"), "zXY"),
    "tibia_r": ("femur_r", ("knee_angle_r", "knee_adduction_r", "knee_rotation_r"), "Zxy"),
    "tibia_l": ("femur_l", ("knee_angle_l", "knee_adduction_l", "knee_rotation_l"), "ZXY"),
    "foot_r": ("tibia_r", ("ankle_angle_r", "subtalar_angle_r", "foot_rotation_r"), "zxy"),
    "foot_l": ("tibia_l", ("ankle_angle_l", "subtalar_angle_l", "foot_rotation_l"), "zXY"),
    "humerus_r": ("torso", ("arm_plane_r", "arm_elevation_r", "arm_rot_r"), "yxy"),
    "humerus_l": ("torso", ("arm_plane_l", "arm_elevation_l", "arm_rot_l"), "YXY"),
    "forearm_r": ("humerus_r", ("elbow_flex_r", "elbow_carry_r", "pro_sup_r"), "zxy"),
    "forearm_l": ("humerus_l", ("elbow_flex_l", "elbow_carry_l", "pro_sup_l"), "zXY"),
    "hand_r": ("forearm_r", ("wrist_flex_r", "wrist_dev_r", "hand_rotation_r"), "zxy"),
    "hand_l": ("forearm_l", ("wrist_flex_l", "wrist_dev_l", "hand_rotation_l"), "zXY"),
}
"""Body -> parent, coordinates, axes in order; a capital is a negative axis, as on OpenSim's left."""
SEGMENTS = {
    "pelvis": "pelvis",
    "torso": "thorax",
    "femur": "thigh",
    "tibia": "shank",
    "foot": "foot",
    "humerus": "upper_arm",
    "forearm": "forearm",
    "hand": "hand",
}
OWN_NAMES = {
    "knee_adduction_{}": "{}_knee_adduction",
    "knee_rotation_{}": "{}_knee_internal_rotation",
    "foot_rotation_{}": "{}_ankle_internal_rotation",
    "hand_rotation_{}": "{}_wrist_axial_rotation",
    "arm_plane_{}": "{}_shoulder_plane_of_elevation",
    "arm_elevation_{}": "-{}_shoulder_elevation",
    "arm_rot_{}": "{}_shoulder_axial_rotation",
    "elbow_carry_{}": "-{}_elbow_carrying_angle",
}
"""Coordinates that Rajagopal2016 does not have -> the clinical angle."""
POSE = """
import json, os, sys
import opensim as osim
chains, poses = json.load(sys.stdin)
model = osim.Model()
bodies, kept = {"ground": model.getGround()}, []  # references that keep OpenSim objects alive
vectors = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}

def add(name, parent, coordinates, axes):
    body = osim.Body(name, 1.0, osim.Vec3(0), osim.Inertia(1, 1, 1))
    transform = osim.SpatialTransform()
    for k, axis in enumerate(axes):
        own = getattr(transform, f"upd_rotation{k + 1}")()
        sign = -1 if axis.isupper() else 1
        own.setAxis(osim.Vec3(*(sign * v for v in vectors[axis.lower()])))
        if k < len(coordinates):
            own.setCoordinateNames(osim.ArrayStr(coordinates[k], 1))
            kept.append(osim.LinearFunction(1.0, 0.0))
            own.setFunction(kept[-1])
    joint = osim.CustomJoint(name + "_joint", bodies[parent], body, transform)
    kept.extend([body, joint, transform])
    model.addBody(body)
    model.addJoint(joint)
    bodies[name] = body

for name, (parent, coordinates, axes) in chains.items():
    if axes[0] == axes[2]:  # OpenSim needs a body between two rotations about one axis
        add(name + "_between", parent, coordinates[:2], axes[:2] + "z")
        add(name, name + "_between", coordinates[2:], axes[2] + axes[1] + "z")
    else:
        add(name, parent, coordinates, axes)
state = model.initSystem()
out = []
for pose in poses:
    for name, value in pose.items():
        model.getCoordinateSet().get(name).setValue(state, value, False)
    model.realizePosition(state)
    out.append({})
    for name in chains:
        R = model.getBodySet().get(name).getTransformInGround(state).R()
        out[-1][name] = [[R.get(i, j) for j in range(3)] for i in range(3)]
print("RESULT" + json.dumps(out), flush=True)
os._exit(0)  # avoids a double free by Python and OpenSim
"""


def posed_by_opensim(poses: list[dict[str, float]]) -> list[dict[str, Any]]:
    """Body -> R_ground_body of every pose."""
    done = subprocess.run(
        [sys.executable, "-c", POSE], input=json.dumps([CHAINS, poses]), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found: list[dict[str, Any]] = json.loads(done.stdout.split("RESULT")[1])
    return found


def random_pose(rng: np.random.Generator) -> dict[str, float]:
    """Coordinates of a body: hinges bend one way, arms are raised by 10 to 170 degrees, others +-60."""
    one_way = ("knee_angle", "elbow_flex", "pro_sup")
    pose = {}
    for _, coordinates, axes in CHAINS.values():
        for k, name in enumerate(coordinates):
            low, high = (0, 130) if name.startswith(one_way) else (-60, 60)
            if axes.lower() == "yxy" and k == 1:
                low, high = -170, -10
            pose[name] = float(np.radians(rng.uniform(low, high)))
    return pose


def as_segments(found: list[dict[str, Any]]) -> PoseSequence:
    """OpenSim's bodies, y up, as segments of our skeleton, z up."""
    table = angle_table(BODY.table)
    R_bone_isb = jcs.isb_frames(BODY, table)
    R = np.tile(np.eye(3), (len(found), len(BODY.names), 1, 1))
    for body in CHAINS:
        kind, _, side = body.partition("_")
        side_word = {"r": "right ", "l": "left "}.get(side, "")
        (j,) = BODY.index(table.segments[side_word + SEGMENTS[kind]])
        R_ground_body = np.array([pose[body] for pose in found])
        R[:, j] = jcs.R_ROS_ISB @ R_ground_body @ R_bone_isb[j].T
    p = np.zeros((len(found), len(BODY.names), 3))
    return all_observed(PoseSequence(np.arange(len(found)), p, R, BODY.names))


@pytest.mark.skipif(importlib.util.find_spec("opensim") is None, reason="OpenSim is not installed")
def test_clinical_angles_equal_opensim_coordinates() -> None:
    rng = np.random.default_rng(0)
    poses = [random_pose(rng) for _ in range(40)]
    poses.append(dict.fromkeys(poses[0], 0.0) | {"knee_angle_r": np.pi / 2, "hip_flexion_r": np.pi / 2})
    segments = as_segments(posed_by_opensim(poses))
    # One by one, because continuity over time does not apply to random poses.
    each = [clinical_angles(segments[i : i + 1], BODY) for i in range(len(poses))]
    angles = replace(
        each[0],
        times=segments.times,
        values=np.concatenate([a.values for a in each]),
        provenance=np.concatenate([a.provenance for a in each]),
        singular=np.concatenate([a.singular for a in each]),
        trusted=None,
    )
    expected = {row.opensim: row.name for row in angles.rows if row.opensim}
    for short, name in OWN_NAMES.items():
        for side in ("right", "left"):
            sign, plain = ("-", name[1:]) if name[0] == "-" else ("", name)
            expected[sign + short.format(side[0])] = plain.format(side)
    coordinates = {name for _, names, _ in CHAINS.values() for name in names}
    assert {name.strip("-") for name in expected} == coordinates
    for coordinate, name in expected.items():
        sign = -1 if coordinate[0] == "-" else 1
        theirs = np.array([pose[coordinate.strip("-")] for pose in poses])
        # The last pose has hanging arms, where plane and axial rotation are not defined.
        count = 40 if "arm_" in coordinate else 41
        error = np.angle(np.exp(1j * (angles[name] - sign * theirs)))[:count]
        assert np.abs(error).max() < 1e-9, (coordinate, name)
    assert np.degrees(angles["right_knee_flexion"][-1]) == pytest.approx(90)
