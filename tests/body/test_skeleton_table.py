"""Skeleton tables: validation by the reader, and anatomy of the shipped tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton_table import (
    SEGMENTS,
    SEXES,
    Joint,
    SkeletonTable,
    inertia,
    mass_fraction,
    read_skeleton_table,
)
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.resources import model_path

Array = NDArray[np.float64]
TABLES = {name: read_skeleton_table(model_path(f"{name}.toml")) for name in ("skeleton", "human36m")}
TOTAL_CAPTURE = (
    "Hips",
    "Spine",
    "Spine1",
    "Spine2",
    "Spine3",
    "Neck",
    "Head",
    "RightShoulder",
    "RightArm",
    "RightForeArm",
    "RightHand",
    "LeftShoulder",
    "LeftArm",
    "LeftForeArm",
    "LeftHand",
    "RightUpLeg",
    "RightLeg",
    "RightFoot",
    "LeftUpLeg",
    "LeftLeg",
    "LeftFoot",
)
TOTAL_CAPTURE_PARENTS = (-1, 0, 1, 2, 3, 4, 5, 4, 7, 8, 9, 4, 11, 12, 13, 0, 15, 16, 0, 18, 19)
HUMAN36M = (
    "Hip",
    "RHip",
    "RKnee",
    "RFoot",
    "LHip",
    "LKnee",
    "LFoot",
    "Spine",
    "Thorax",
    "Neck",
    "Head",
    "LShoulder",
    "LElbow",
    "LWrist",
    "RShoulder",
    "RElbow",
    "RWrist",
)
GOOD = """
name = "stick"
mass_kg = 70
sex = "female"
[[joint]]
name = "Base"
mass = [{ segment = "lower trunk", share = 1.0 }]
end_mm = [0, 0, 100]
radius_mm = 50
[[joint]]
name = "Rod"
parent = "Base"
offset_mm = [0, 0, 100]
axes = "yxz"
limits_deg = [[-10, 20], [-30, 30], [-40, 40]]
clinical = ["rod flexion", "", ""]
opensim = ["-rod_angle", "", ""]
mass = [{ segment = "shank", share = 1.0 }]
end_mm = [0, 0, 200]
radius_mm = 20
[n_pose_deg]
Rod_y = 90
[[landmark]]
name = "Tip"
joint = "Rod"
offset_mm = [0, 0, 200]
[[sensor]]
name = "S1"
joint = "Rod"
lever_arm_mm = [10, 0, 50]
"""


def read(tmp_path: Path, *changes: tuple[str, str]) -> SkeletonTable:
    text = GOOD
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "table.toml"
    path.write_text(text)
    return read_skeleton_table(path)


# --- reading ----------------------------------------------------------------------------------------


def test_table_is_read_in_metres_and_radians(tmp_path: Path) -> None:
    table = read(tmp_path)
    assert (table.name, table.mass_kg, table.sex) == ("stick", 70.0, "female")
    assert table.names == ("Base", "Rod")
    assert table.parents == (-1, 0)
    np.testing.assert_allclose(table.offsets, [[0.0, 0, 0], [0, 0, 0.1]])
    rod = table.joints[1]
    np.testing.assert_allclose(np.degrees(rod.limits), [[-10, 20], [-30, 30], [-40, 40]])
    assert [dof.urdf for dof in rod.dofs] == ["Rod_y", "Rod_x", "Rod_z"]
    assert (rod.dofs[0].clinical, rod.dofs[0].opensim) == ("rod flexion", "-rod_angle")
    assert rod.mass_shares == (("shank", 1.0),)
    assert rod.radius == 0.02
    assert table.n_pose == {"Rod_y": pytest.approx(np.pi / 2)}
    assert (table.landmarks[0].name, table.landmarks[0].joint) == ("Tip", "Rod")
    np.testing.assert_allclose(table.sensors[0].offset, [0.01, 0, 0.05])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "stick"', "name =", "not readable as TOML: .*line 2"),
        ("mass_kg = 70", "", "the field 'mass_kg' is missing"),
        ("mass_kg = 70", 'mass_kg = "heavy"', "a field is not of the right kind: .*heavy"),
        ("offset_mm = [0, 0, 100]", "offset_mm = [0, 100]", r"a field .*: \[0, 100\] is no point"),
        ("mass_kg = 70", "mass_kg = -1", "mass_kg -1.0 must be positive and sex 'female' one of"),
        ('sex = "female"', 'sex = "f"', ".* and sex 'f' one of .'male', 'female'"),
        ('parent = "Base"', 'parent = "Rod"', "joint Rod: its parent must come before it"),
        ('name = "Rod"', 'name = "Base"', "joint Base occurs twice"),
        ('axes = "yxz"', 'axes = "yxy"', "joint Rod: axes 'yxy' are not x, y and z in some order"),
        ('name = "Base"', 'name = "Base"\naxes = "xyz"', "joint Base: axes 'xyz' .*none for the root"),
        ('["rod flexion", "", ""]', '["rod flexion"]', "joint Rod: needs three clinical and three"),
        ("[[-10, 20]", "[[20, -10]", "joint Rod: limits are not three ranges low, high"),
        (", [-40, 40]", "", "joint Rod: limits are not three ranges"),
        ("end_mm = [0, 0, 200]", "end_mm = [0, 0, 0]", "joint Rod: end_mm or offset_mm is a bone"),
        ('"shank"', '"shin"', "joint Rod: no segment 'shin'; known: head, upper trunk, .*foot"),
        ('"shank", share = 1.0', '"shank", share = 0', "joint Rod: its share of the shank is not pos"),
        ('[{ segment = "shank", share = 1.0 }]', "[]", "joint Rod: carries no mass"),
        ('name = "Tip"\njoint = "Rod"', 'name = "Tip"\njoint = "X"', "landmark Tip: there is no joint X"),
        ('name = "Tip"', 'name = "Base"', "landmark Base: another has this name"),
        ('name = "S1"\njoint = "Rod"', 'name = "S1"\njoint = "X"', "sensor S1: there is no joint X"),
        ("Rod_y = 90", "Rod_w = 90", "n_pose_deg: there is no revolute Rod_w"),
    ],
)
def test_invalid_table_is_refused_with_file_and_joint(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(FileFormatError, match=f"table.toml: {message}"):
        read(tmp_path, (old, new))


def test_a_table_without_joints_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("name = 'x'\nmass_kg = 1\njoint = []")
    with pytest.raises(FileFormatError, match="there is no joint in it"):
        read_skeleton_table(tmp_path / "c.toml")
    (tmp_path / "d.toml").write_text("name = 'x'\nmass_kg = 1\njoint = 3")
    with pytest.raises(FileFormatError, match="a field is not of the right kind"):
        read_skeleton_table(tmp_path / "d.toml")


# --- another body -------------------------------------------------------------------------------------


def test_offsets_scale_the_points_of_each_segment() -> None:
    table = TABLES["skeleton"]
    offsets = np.array(table.offsets)
    knee, elbow = table.names.index("LeftLeg"), table.names.index("RightForeArm")
    offsets[knee] *= 1.2  # a longer thigh
    new = table.scaled_to(offsets)
    np.testing.assert_array_equal(new.offsets, offsets)
    thigh = table.names.index("LeftUpLeg")
    np.testing.assert_array_equal(new.joints[thigh].end, offsets[knee])
    offsets[knee] += [0.02, -0.01, 0.0]  # and one that is bowed: it ends where the knee is
    np.testing.assert_array_equal(table.scaled_to(offsets).joints[thigh].end, offsets[knee])
    offsets[knee] -= [0.02, -0.01, 0.0]
    np.testing.assert_allclose(lever(new, "L_UpLeg"), 1.2 * lever(table, "L_UpLeg"))
    np.testing.assert_array_equal(lever(new, "R_UpLeg"), lever(table, "R_UpLeg"))
    np.testing.assert_array_equal(new.joints[elbow].end, table.joints[elbow].end)
    overall = np.linalg.norm(offsets, axis=1).sum() / np.linalg.norm(table.offsets, axis=1).sum()
    head = table.names.index("Head")
    np.testing.assert_allclose(new.joints[head].end, overall * table.joints[head].end)
    assert table.offsets[knee][2] == -0.396  # the old one is as it was


def test_scaling_there_and_back_gives_the_same_table() -> None:
    table, rng = TABLES["skeleton"], np.random.default_rng(0)
    there = table.scaled_to(table.offsets * rng.uniform(0.8, 1.2, (21, 1)))
    turned = there.scaled_to(np.einsum("ij,nj->ni", so3.exp([0.1, 0.2, 0.0]), there.offsets))
    for back in (there.scaled_to(table.offsets), turned.scaled_to(table.offsets)):
        for a, b in zip(back.joints, table.joints, strict=True):
            np.testing.assert_allclose(np.linalg.norm(a.end), np.linalg.norm(b.end), rtol=1e-12)
            assert a.radius == pytest.approx(b.radius)
        for p, q in zip((*back.landmarks, *back.sensors), (*table.landmarks, *table.sensors), strict=True):
            np.testing.assert_allclose(p.offset, q.offset, atol=1e-12)


def lever(table: SkeletonTable, sensor: str) -> Array:
    return next(point.offset for point in table.sensors if point.name == sensor)


# --- anatomy of the shipped tables --------------------------------------------------------------------


def test_joints_are_those_of_total_capture_and_human36m() -> None:
    assert TABLES["skeleton"].names == TOTAL_CAPTURE
    assert TABLES["skeleton"].parents == TOTAL_CAPTURE_PARENTS
    assert TABLES["human36m"].names == HUMAN36M
    assert TABLES["human36m"].parents == (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 9, 8, 11, 12, 8, 14, 15)


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_mass_of_every_segment_is_carried_once(table: SkeletonTable) -> None:
    shares: dict[str, float] = {}
    for joint in table.joints:
        for segment, share in joint.mass_shares:
            shares[segment] = shares.get(segment, 0.0) + share
    trunk = ("head", "upper trunk", "middle trunk", "lower trunk")
    assert shares == pytest.approx({name: 1.0 if name in trunk else 2.0 for name in SEGMENTS})


def side_of(name: str) -> int:
    """+1 for a name on the left, -1 on the right, 0 in the middle."""
    if name.startswith(("Left", "L_")) or (name[0] == "L" and name[1].isupper()):
        return 1
    return -1 if name.startswith(("Right", "R_")) or (name[0] == "R" and name[1].isupper()) else 0


def mirrored_name(name: str) -> str:
    swap = {"Left": "Right", "Right": "Left", "L": "R", "R": "L"}
    prefix = next((p for p in swap if name.startswith(p)), "") if side_of(name) else ""
    return swap.get(prefix, "") + name.removeprefix(prefix)


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_left_and_right_are_mirror_images(table: SkeletonTable) -> None:
    mirror = np.array([1.0, -1.0, 1.0])
    by_name = {joint.name: joint for joint in table.joints}
    for joint in table.joints:
        twin = by_name[mirrored_name(joint.name)]
        np.testing.assert_allclose(joint.offset, mirror * twin.offset, atol=1e-12)
        np.testing.assert_allclose(joint.end, mirror * twin.end, atol=1e-12)
        assert (joint.axes, joint.mass_shares, joint.radius) == (twin.axes, twin.mass_shares, twin.radius)
        assert joint.offset[1] * side_of(joint.name) >= 0
        # A mirror keeps turns about y and reverses those about x and z.
        for axis, mine, its in zip(joint.axes, joint.limits, twin.limits, strict=True):
            np.testing.assert_allclose(mine, its if axis == "y" else -its[::-1])
    points = {point.name: point for point in table.landmarks}
    for point in table.landmarks:
        np.testing.assert_allclose(point.offset, mirror * points[mirrored_name(point.name)].offset, atol=1e-12)


FORWARD, BACK, LEFT, UP, DOWN = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
OUT = "out"
"""Away from the body's midline: left on the left side."""
IN = "in"
MOVEMENTS: dict[str, tuple[Any, Any]] = {
    # what: (a point of the segment in the T-pose, where the movement takes it)
    "Spine flexion": (UP, FORWARD),
    "Spine left bending": (UP, LEFT),
    "Spine left rotation": (FORWARD, LEFT),
    "hip flexion": (DOWN, FORWARD),
    "hip adduction": (DOWN, IN),
    "hip internal rotation": (FORWARD, IN),
    "knee flexion": (DOWN, BACK),
    "knee adduction": (DOWN, IN),
    "knee internal rotation": (FORWARD, IN),
    "ankle dorsiflexion": (FORWARD, UP),
    "ankle inversion": (IN, UP),  # the inner edge of the foot is lifted
    "ankle internal rotation": (FORWARD, IN),
    "clavicle protraction": (OUT, FORWARD),
    "clavicle elevation": (OUT, UP),
    "clavicle backward rotation": (UP, BACK),
    "shoulder horizontal adduction": (OUT, FORWARD),
    "shoulder elevation above horizontal": (OUT, UP),
    "shoulder internal rotation": (FORWARD, DOWN),  # a forearm bent forward sinks
    "elbow flexion": (OUT, FORWARD),
    "elbow carrying angle": (OUT, UP),  # outwards once the arm hangs with its palm forward
    "forearm pronation": (FORWARD, DOWN),  # the thumb
    "wrist pronation": (FORWARD, DOWN),
    "wrist flexion": (OUT, DOWN),  # the fingers towards the palm
    "wrist ulnar deviation": (OUT, BACK),  # and away from the thumb
}
OPENSIM = {
    # Coordinates of Rajagopal2016, read from its joint axes: what is positive there.
    "hip_flexion": "hip flexion",
    "hip_adduction": "hip adduction",
    "hip_rotation": "hip internal rotation",
    "knee_angle": "knee flexion",
    "ankle_angle": "ankle dorsiflexion",
    "subtalar_angle": "ankle inversion",
    "elbow_flex": "elbow flexion",
    "pro_sup": "forearm pronation",
    "wrist_flex": "wrist flexion",
    "wrist_dev": "wrist ulnar deviation",
    "-lumbar_extension": "Spine flexion",
    "-lumbar_bending": "Spine left bending",
    "lumbar_rotation": "Spine left rotation",
}


def signed(name: str) -> tuple[float, str]:
    return (-1.0, name[1:]) if name.startswith("-") else (1.0, name)


def movement(clinical: str) -> str:
    """The movement of a clinical name, without side and, in the trunk, without level."""
    words = clinical.removeprefix("right ").removeprefix("left ")
    for level in ("Spine1", "Spine2", "Spine3", "lumbar", "thorax", "neck", "head"):
        if words.startswith(level):
            return "Spine" + words.removeprefix(level)
    return words


def direction(where: Any, side: int) -> Array:
    return where if isinstance(where, np.ndarray) else LEFT * side * (1 if where == OUT else -1)


DOFS = [
    pytest.param(joint, i, id=f"{name}-{joint.dofs[i].urdf}")
    for name, table in TABLES.items()
    for joint in table.joints[1:]
    for i in range(3)
]


@pytest.mark.parametrize(("joint", "i"), DOFS)
def test_sign_of_every_clinical_name_is_anatomical(joint: Joint, i: int) -> None:
    sign, name = signed(joint.dofs[i].clinical)
    side = side_of(joint.name)
    assert name.startswith("left ") == (side == 1) or side == 0
    assert name.startswith("right ") == (side == -1)
    start, target = (direction(where, side) for where in MOVEMENTS[movement(name)])
    moved = so3.about_axis(joint.axes[i], 0.1) @ start - start  # by a positive URDF angle
    assert np.sign(moved @ target) == sign
    assert abs(moved @ target) > 0.09  # and it is this axis that does it


@pytest.mark.parametrize(("joint", "i"), DOFS)
def test_sign_of_every_opensim_name_agrees_with_the_clinical_one(joint: Joint, i: int) -> None:
    if not joint.dofs[i].opensim:
        return
    sign, coordinate = signed(joint.dofs[i].opensim)
    clinical_sign, name = signed(joint.dofs[i].clinical)
    side = {1: "_l", -1: "_r", 0: ""}[side_of(joint.name)]
    assert coordinate.endswith(side)
    plain = coordinate.removesuffix(side) if side else coordinate
    opposite = f"-{plain}" in OPENSIM
    assert OPENSIM[f"-{plain}" if opposite else plain] == movement(name)
    assert sign == clinical_sign * (-1 if opposite else 1)


def test_every_movement_occurs_in_the_tables() -> None:
    joints = [joint for table in TABLES.values() for joint in table.joints]
    named = {movement(signed(dof.clinical)[1]) for joint in joints for dof in joint.dofs}
    assert named == set(MOVEMENTS)


RANGES = {
    # degrees a healthy adult reaches, and beyond which no limit should lie
    "hip flexion": ((-20, 120), (-70, 150)),
    "hip adduction": ((-45, 30), (-90, 60)),
    "knee flexion": ((0, 150), (-15, 170)),
    "knee adduction": ((-5, 5), (-15, 15)),
    "knee internal rotation": ((-10, 10), (-30, 30)),
    "ankle dorsiflexion": ((-50, 20), (-80, 60)),
    "elbow flexion": ((0, 150), (-15, 165)),
    "elbow carrying angle": ((0, 15), (-35, 35)),
    "forearm pronation": ((-50, 50), (-60, 60)),
    "shoulder horizontal adduction": ((-30, 130), (-80, 160)),
    "shoulder elevation above horizontal": ((-90, 90), (-130, 120)),
    "clavicle elevation": ((-10, 40), (-30, 60)),
}


@pytest.mark.parametrize(("joint", "i"), DOFS)
def test_limits_contain_the_physiological_range(joint: Joint, i: int) -> None:
    sign, name = signed(joint.dofs[i].clinical)
    low, high = sorted(sign * np.degrees(joint.limits[i]))
    if movement(name) in RANGES:
        (need_low, need_high), (most_low, most_high) = RANGES[movement(name)]
        assert most_low - 1e-9 <= low <= need_low
        assert need_high <= high <= most_high + 1e-9
    assert low < 0 < high  # the T-pose is inside


def test_thirteen_sensors_of_total_capture_are_on_their_segments() -> None:
    table = TABLES["skeleton"]
    joints = {sensor.name: sensor.joint for sensor in table.sensors}
    limbs = {"UpArm": "Arm", "LowArm": "ForeArm", "UpLeg": "UpLeg", "LowLeg": "Leg", "Foot": "Foot"}
    expected = {"Head": "Head", "Sternum": "Spine3", "Pelvis": "Hips"}
    expected |= {f"{s[0]}_{k}": s + v for s in ("Left", "Right") for k, v in limbs.items()}
    assert joints == expected
    by_name = {joint.name: joint for joint in table.joints}
    for sensor in table.sensors:
        end = by_name[sensor.joint].end
        along = np.clip(sensor.offset @ end / (end @ end), 0, 1)
        off_the_bone = np.linalg.norm(sensor.offset - along * end)
        assert off_the_bone < by_name[sensor.joint].radius + 0.09, sensor.name
    front, behind = lever(table, "Sternum"), lever(table, "Pelvis")
    assert front[0] > 0.1
    assert behind[0] < -0.05


TRUNK_AND_HEAD = ("head", "upper trunk", "middle trunk", "lower trunk")


def test_values_without_a_sex_are_the_mean_of_both() -> None:
    assert mass_fraction("thigh", None) == pytest.approx((0.1416 + 0.1478) / 2)
    end = np.array([0.0, 0.0, -0.4])
    centers = [inertia("thigh", 8.0, end, sex)[0] for sex in SEXES]
    np.testing.assert_allclose(inertia("thigh", 8.0, end, None)[0], np.mean(centers, axis=0))


def test_thigh_of_a_man() -> None:
    center, matrix = inertia("thigh", 10.0, np.array([0.0, 0.0, -0.4]), "male")
    np.testing.assert_allclose(center, [0, 0, -0.4 * 0.4095])
    across, along = 10 * (0.329 * 0.4) ** 2, 10 * (0.149 * 0.4) ** 2
    np.testing.assert_allclose(matrix, np.diag([across, across, along]), atol=1e-15)


def test_trunk_segment_is_measured_from_its_top() -> None:
    center, _ = inertia("upper trunk", 10.0, np.array([0.0, 0.0, 0.3]), "male")
    assert center[2] == pytest.approx(0.3 * (1 - 0.5066))


@pytest.mark.parametrize("sex", ["male", "female", None])
@pytest.mark.parametrize("name", SEGMENTS)
def test_inertias_are_physical(name: str, sex: str | None) -> None:
    """Positive, and no principal moment larger than the sum of the other two."""
    rng = np.random.default_rng(0)
    for end in rng.normal(size=(10, 3)):
        center, matrix = inertia(name, 3.0, end, sex)
        moments = np.sort(np.linalg.eigvalsh(matrix))
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1]
        np.testing.assert_allclose(matrix, matrix.T)
        assert 0 < center @ end / (end @ end) < 1
        np.testing.assert_allclose(np.cross(center, end), 0, atol=1e-12)
        if name not in TRUNK_AND_HEAD:  # slim: the smallest moment is about the bone
            assert end @ matrix @ end / (end @ end) == pytest.approx(moments[0])
