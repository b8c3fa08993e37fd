"""BVH files: conventions, broken files, and round trips."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.bvh import read_bvh, write_bvh

EXCERPT = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"
TWO_JOINTS = """HIERARCHY
ROOT Base
{
  OFFSET 1.0 2.0 3.0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT Upper Arm
  {
    OFFSET 0.0 5.0 0.0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 0.0 2.0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.02
0 0 0 0 0 0 0 0 0
10 20 30 40 -50 60 70 15 -25
"""


@pytest.fixture
def write(tmp_path):
    def write_file(text):
        path = tmp_path / "motion.bvh"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write_file


def test_joints_are_chains_of_scipy_rotations(write):
    motion = read_bvh(write(TWO_JOINTS))
    assert (motion.names, motion.parents, motion.end_parents) == (("Base", "Upper Arm"), (-1, 0), (1,))
    assert motion.rate_hz == pytest.approx(50)
    assert motion.p_parent_joint is None
    p, R = motion.forward_kinematics()
    base = Rotation.from_euler("YXZ", [40, -50, 60], degrees=True)
    upper = base * Rotation.from_euler("ZXY", [70, 15, -25], degrees=True)
    np.testing.assert_allclose(p[1, 1] - [10, 20, 30], base.apply([0, 5, 0]), atol=1e-12)
    np.testing.assert_allclose(R[1, 1], upper.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(motion.end_offsets, [[0, 0, 2]])


def test_position_channels_replace_the_offset(write):
    text = TWO_JOINTS.replace("CHANNELS 3 Zrotation Xrotation Yrotation", "CHANNELS 3 Xposition Yposition Zrotation")
    motion = read_bvh(write(text))
    p, R = motion.forward_kinematics()
    np.testing.assert_allclose(p[1, 1], [10, 20, 30] + R[1, 0] @ [70, 15, 0], atol=1e-12)
    np.testing.assert_allclose(motion.offsets[1], [0, 5, 0])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("End Site", "EndSite"),
        ("End Site\n    {", "End Site {\n CHANNELS 0\n"),
        (
            "OFFSET 0.0 5.0 0.0\n    CHANNELS 3 Zrotation Xrotation Yrotation",
            "CHANNELS 3 ZROTATION xrotation Yrotation\n\tOFFSET\t0.0\t5.0\t0.0",
        ),
        ("\n", "\r"),
        ("\n", "\r\n"),
        ("HIERARCHY\nROOT Base\n{", "\ufeffHIERARCHY\nroot Base {"),
        ("Frames: 2\nFrame Time: 0.02", "FRAMES:2\nFRAME TIME:\t2.0E-2"),
    ],
)
def test_spellings_of_other_programs(write, old, new):
    assert old in TWO_JOINTS
    plain, other = read_bvh(write(TWO_JOINTS)), read_bvh(write(TWO_JOINTS.replace(old, new)))
    np.testing.assert_array_equal(other.R_parent_joint, plain.R_parent_joint)
    np.testing.assert_array_equal(other.end_offsets, plain.end_offsets)
    assert (other.names, other.rate_hz) == (plain.names, plain.rate_hz)


@pytest.mark.parametrize("line", ["", "Frame Time: 0\n"])
def test_file_without_a_frame_time_needs_a_declared_rate(write, line):
    path = write(TWO_JOINTS.replace("Frame Time: 0.02\n", line))
    with pytest.raises(FileFormatError, match="declare the rate"):
        read_bvh(path)
    assert read_bvh(path, rate_hz=50).rate_hz == 50
    assert len(read_bvh(path, rate_hz=50)) == 2
    with pytest.raises(FileFormatError, match="motion.bvh: .*rate_hz: -1"):
        read_bvh(path, rate_hz=-1)


@pytest.mark.parametrize(
    ("old", "new", "line", "says"),
    [
        ("HIERARCHY", "HIERARCHIE", 1, "expected HIERARCHY"),
        ("CHANNELS 3 Z", "CHANNELS 9 Z", 9, "0 to 6 channels"),
        ("Frames: 2", "Frames: 0", 17, "number of frames is 0"),
        ("40 -50", "40 x", 20, "found 9, among them 'x'"),
    ],
)
def test_broken_file_is_named_with_its_line(write, old, new, line, says):
    path = write(TWO_JOINTS.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        read_bvh(path)
    assert (caught.value.path, caught.value.line) == (path, line)
    assert says in str(caught.value)


@pytest.mark.parametrize("order", ["zxy", "xzy", "yxz"])
def test_written_motion_is_read_back(tmp_path, order):
    motion = read_bvh(EXCERPT)[:20]
    write_bvh(tmp_path / "out.bvh", motion, order=order)
    again = read_bvh(tmp_path / "out.bvh")
    assert (again.names, again.parents) == (motion.names, motion.parents)
    assert again.rate_hz == pytest.approx(motion.rate_hz, rel=1e-12)
    np.testing.assert_allclose(again.R_parent_joint, motion.R_parent_joint, atol=1e-9)
    np.testing.assert_allclose(again.p_root, motion.p_root, atol=1e-9)
    assert again.end_parents == motion.end_parents
    np.testing.assert_allclose(again.end_offsets, motion.end_offsets, atol=1e-7)
    text = (tmp_path / "out.bvh").read_text()
    channels = {line.split("CHANNELS")[1] for line in text.splitlines() if "CHANNELS 3" in line}
    assert channels == {" 3 " + " ".join(f"{axis.upper()}rotation" for axis in order)}


def a_motion(names, parents, moving=False):
    rng, J = np.random.default_rng(2), len(names)
    R = Rotation.from_rotvec(rng.normal(size=(5 * J, 3))).as_matrix().reshape(5, J, 3, 3)
    p = rng.normal(size=(5, J, 3)) if moving else None
    root = rng.normal(size=(5, 3)) if p is None else p[:, 0]
    return ArticulatedMotion(names, parents, rng.normal(size=(J, 3)), R, root, 50.0, p_parent_joint=p)


@pytest.mark.parametrize("moving", [False, True])
def test_joints_are_written_depth_first(tmp_path, moving):
    motion = a_motion(("root", "left", "right", "left end"), (-1, 0, 0, 1), moving)
    write_bvh(tmp_path / "out.bvh", motion)
    again = read_bvh(tmp_path / "out.bvh")
    assert again.names == ("root", "left", "left end", "right")
    same = [motion.names.index(name) for name in again.names]
    p, R = motion.forward_kinematics()
    p_again, R_again = again.forward_kinematics()
    np.testing.assert_allclose(p_again, p[:, same], atol=1e-8)
    np.testing.assert_allclose(R_again, R[:, same], atol=1e-9)
    assert len(again.end_parents) == 2  # a joint with nothing below it has an end site, as readers expect


@pytest.mark.parametrize(
    ("name", "order", "says"),
    [
        ("a{b", "zxy", "joint name 'a{b'"),
        (" ", "zxy", "joint name ' ': empty"),
        ("a\nb", "zxy", "rename it"),
        ("a", "zxz", "order: 'zxz'"),
    ],
)
def test_invalid_names_and_orders_are_not_written(tmp_path, name, order, says):
    with pytest.raises(InvalidInputError, match=says):
        write_bvh(tmp_path / "out.bvh", a_motion((name,), (-1,)), order=order)
    assert not list(tmp_path.iterdir())


def test_unknown_position_is_not_written(tmp_path):
    motion = a_motion(("root",), (-1,))
    p = np.array(motion.p_root)
    p[3] = np.nan
    with pytest.raises(InvalidInputError, match="BVH has no gaps"):
        write_bvh(tmp_path / "out.bvh", replace(motion, p_root=p))
