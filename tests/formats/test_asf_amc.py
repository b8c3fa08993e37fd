"""ASF and AMC files: conventions and broken files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.asf_amc import read_asf_amc

ASF = """# two bones
:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name thigh
    direction 0 -2 0
    length 7.5
    axis 10 20 30 XYZ
    dof rx rz
    limits (-160.0 20.0)
           (-70.0 70.0)
  end
  begin
    id 2
    name shank
    direction 0 -1 0
    length 7
    axis 0 0 0 ZYX
    dof ry
  end
:hierarchy
  begin
    root thigh
    thigh shank
  end
"""
AMC = """:FULLY-SPECIFIED
:DEGREES
1
root 0 0 0 0 0 0
thigh 0 0
shank 0
2
root 1 2 3 15 25 35
thigh 40 50
shank 60
"""


@pytest.fixture
def read(tmp_path):
    def read_texts(asf=ASF, amc=AMC):
        asf = asf if isinstance(asf, bytes) else asf.encode()
        amc = amc if isinstance(amc, bytes) else amc.encode()
        (tmp_path / "a.asf").write_bytes(asf)
        (tmp_path / "a.amc").write_bytes(amc)
        return read_asf_amc(tmp_path / "a.asf", tmp_path / "a.amc")

    return read_texts


def fixed_axes(order, angles, degrees=True):
    """SciPy's extrinsic rotation: about fixed axes, in the order given."""
    return Rotation.from_euler(order, angles, degrees=degrees)


def test_bone_turns_about_its_own_axes(read):
    motion = read()
    C = fixed_axes("xyz", [10, 20, 30])
    thigh = C * fixed_axes("xz", [40, 50]) * C.inv()
    np.testing.assert_allclose(motion.R_parent_joint[1, 1], thigh.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(motion.R_parent_joint[0], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)


def test_bones_are_chained_end_to_end_from_the_root(read):
    motion = read()
    p, R = motion.forward_kinematics()
    root = fixed_axes("xyz", [15, 25, 35])
    np.testing.assert_allclose(R[1, 0], root.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(p[1, :2], [[1, 2, 3], [1, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(p[1, 2], p[1, 1] + R[1, 1] @ [0, -7.5, 0], atol=1e-12)
    assert motion.end_parents == (2,)
    np.testing.assert_allclose(motion.end_offsets, [[0, -7, 0]], atol=1e-12)


def test_unit_is_an_inch_divided_by_the_stated_length(read):
    assert read().unit_m == pytest.approx(0.0254 / 0.45)
    assert read(ASF.replace("length 0.45", "length 1.0")).unit_m == pytest.approx(0.0254)


def test_angles_may_be_radians_in_either_file(read):
    radians = read(amc=AMC.replace(":DEGREES", ":RADIANS"))
    thigh = fixed_axes("xyz", [10, 20, 30])
    turned = thigh * fixed_axes("xz", [40, 50], degrees=False) * thigh.inv()
    np.testing.assert_allclose(radians.R_parent_joint[1, 1], turned.as_matrix(), atol=1e-12)
    both = read(ASF.replace("angle deg", "angle rad"), AMC.replace(":DEGREES\n", ""))
    C = fixed_axes("xyz", [10, 20, 30], degrees=False)
    turned = C * fixed_axes("xz", [40, 50], degrees=False) * C.inv()
    np.testing.assert_allclose(both.R_parent_joint[1, 1], turned.as_matrix(), atol=1e-12)


def test_root_channels_have_the_order_listed(read):
    swapped = ASF.replace("order TX TY TZ RX RY RZ", "order RZ RY RX TX TY TZ")
    amc = AMC.replace("root 1 2 3 15 25 35", "root 15 25 35 1 2 3")
    motion = read(swapped, amc)
    np.testing.assert_allclose(motion.p_root[1], [1, 2, 3])
    root = fixed_axes("zyx", [15, 25, 35]).as_matrix()
    np.testing.assert_allclose(motion.R_parent_joint[1, 0], root, atol=1e-12)


def test_sliding_bone_moves_its_joint_in_its_parent(read):
    motion = read(
        ASF.replace("dof ry", "dof ry ty"), AMC.replace("shank 60", "shank 60 0.5").replace("shank 0", "shank 0 0")
    )
    p, R = motion.forward_kinematics()
    np.testing.assert_allclose(p[1, 2], p[1, 1] + R[1, 1] @ [0, -7.0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "line", "says"),
    [
        ("1\nroot 0", "root 0", 3, "expected a frame number"),
        ("thigh 40 50", "thigh 40 inf", 9, "expected 2 numbers of thigh"),
        ("shank 0\n", "", 6, "frame 1 ends without shank"),
        (AMC, ":FULLY-SPECIFIED\n:DEGREES\n", 2, "no frames"),
    ],
)
def test_broken_motion_is_named_with_its_line(read, tmp_path, old, new, line, says):
    with pytest.raises(FileFormatError) as caught:
        read(amc=AMC.replace(old, new, 1))
    assert (caught.value.path, caught.value.line) == (tmp_path / "a.amc", line)
    assert says in str(caught.value)
