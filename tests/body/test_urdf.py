"""URDF files: made from the tables, valid for simulators, readable by yourdfpy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import SkeletonTable, inertia, read_skeleton_table
from rtof_kin.body.urdf import LIGHT_MASS_KG, to_urdf
from rtof_kin.core.resources import model_path

Array = NDArray[np.float64]
MODELS = Path(__file__).parents[2] / "models"
NAMES = ("skeleton", "human36m")
TABLES = {name: read_skeleton_table(model_path(f"{name}.toml")) for name in NAMES}
every_table = pytest.mark.parametrize("table", TABLES.values(), ids=NAMES)


def floats(text: str) -> Array:
    return np.array(text.split(), dtype=float)


def part(element: ET.Element, tag: str) -> ET.Element:
    found = element.find(tag)
    assert found is not None, tag
    return found


def matrix_of(inertial: ET.Element) -> Array:
    get = {key: float(value) for key, value in part(inertial, "inertia").attrib.items()}
    return np.array([[get["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"])


def links(urdf: str) -> dict[str, ET.Element]:
    return {link.attrib["name"]: link for link in ET.fromstring(urdf).iter("link")}


# --- the committed files ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_committed_urdf_equals_that_of_the_table(name: str) -> None:
    assert (MODELS / f"{name}.urdf").read_bytes() == to_urdf(TABLES[name]).encode()


# --- the tree -----------------------------------------------------------------------------------------


@every_table
def test_ball_joint_is_three_revolutes_through_one_point(table: SkeletonTable) -> None:
    robot = ET.fromstring(to_urdf(table))
    joints = list(robot.iter("joint"))
    assert len(joints) == 3 * (len(table.joints) - 1)
    by_child = {part(j, "child").attrib["link"]: j for j in joints}
    for joint in table.joints[1:]:
        link, axes, origins = joint.name, "", []
        for _ in range(3):
            element = by_child[link]
            assert element.attrib["type"] == "revolute"
            assert element.attrib["name"] == f"{joint.name}_{element.attrib['name'][-1]}"
            axis = floats(part(element, "axis").attrib["xyz"])
            axes = "xyz"[int(np.argmax(axis))] + axes
            assert sorted(axis) == [0, 0, 1]
            origin = part(element, "origin")
            assert not floats(origin.attrib["rpy"]).any()
            origins.append(floats(origin.attrib["xyz"]))
            link = part(element, "parent").attrib["link"]
        assert (axes, link) == (joint.axes, joint.parent)
        np.testing.assert_allclose(origins, [np.zeros(3), np.zeros(3), joint.offset], atol=1e-12)


@every_table
def test_limits_are_those_of_the_table(table: SkeletonTable) -> None:
    limits = {j.attrib["name"]: part(j, "limit").attrib for j in ET.fromstring(to_urdf(table)).iter("joint")}
    for joint in table.joints[1:]:
        for dof, (low, high) in zip(joint.dofs, joint.limits, strict=True):
            assert float(limits[dof.urdf]["lower"]) == pytest.approx(low, abs=1e-11)
            assert float(limits[dof.urdf]["upper"]) == pytest.approx(high, abs=1e-11)
            assert float(limits[dof.urdf]["effort"]) > 0
            assert float(limits[dof.urdf]["velocity"]) > 0


# --- masses and inertias ------------------------------------------------------------------------------


@pytest.mark.parametrize("sex", ["male", "female", None])
@every_table
def test_inertias_are_physical(table: SkeletonTable, sex: str | None) -> None:
    for name, link in links(to_urdf(replace(table, sex=sex))).items():
        inertial = part(link, "inertial")
        matrix = matrix_of(inertial)
        moments = np.sort(np.linalg.eigvalsh(matrix))
        assert moments[0] > 0, name
        assert moments[2] <= moments[0] + moments[1] + 1e-12, name
        assert float(part(inertial, "mass").attrib["value"]) > 0
        light = name not in table.names
        assert (float(part(inertial, "mass").attrib["value"]) == LIGHT_MASS_KG) == light


@pytest.mark.parametrize(("sex", "total"), [("male", 1.0), ("female", 0.9999), (None, 0.99995)])
@every_table
def test_masses_sum_to_the_body_mass(table: SkeletonTable, sex: str | None, total: float) -> None:
    model = pin.buildModelFromXML(to_urdf(replace(table, sex=sex, mass_kg=80.0)), pin.JointModelFreeFlyer())
    light = LIGHT_MASS_KG * 2 * (len(table.joints) - 1)
    assert pin.computeTotalMass(model) == pytest.approx(80 * total + light, abs=1e-9)
    assert light < 0.001 * 80


@every_table
def test_centre_of_mass_of_a_standing_body(table: SkeletonTable) -> None:
    """The centre of mass of a person standing is at 53-61 % of the height, between the hips."""
    model = pin.buildModelFromXML(to_urdf(table), pin.JointModelFreeFlyer())
    skeleton = SkeletonModel(table)
    q = skeleton.n_pose()
    p, R = skeleton.forward_kinematics(q[None])
    floor = skeleton.landmark_positions(p, R)[0, :, 2].min()
    center = pin.centerOfMass(model, model.createData(), q)
    assert 0.53 < (center[2] - floor) / skeleton.height < 0.61
    assert abs(center[1]) < 1e-3
    assert abs(center[0]) < 0.05


def test_link_with_two_segments_has_their_composite_inertia() -> None:
    """Against the composite of two Pinocchio bodies, parallel axes included."""
    table = TABLES["human36m"]
    i = table.names.index("RFoot")
    shares = (("foot", 1.0), ("head", 0.5))
    joints = tuple(replace(j, mass_shares=shares) if k == i else j for k, j in enumerate(table.joints))
    foot = links(to_urdf(replace(table, joints=joints, sex="male")))["RFoot"]
    link = part(foot, "inertial")
    whole = pin.Inertia.Zero()
    for name, share in shares:
        mass = share * {"foot": 0.0137, "head": 0.0694}[name] * table.mass_kg
        center, matrix = inertia(name, mass, table.joints[i].end, "male")
        whole += pin.Inertia(mass, center, matrix)
    assert float(part(link, "mass").attrib["value"]) == pytest.approx(whole.mass)
    np.testing.assert_allclose(floats(part(link, "origin").attrib["xyz"]), whole.lever, atol=1e-11)
    np.testing.assert_allclose(matrix_of(link), whole.inertia, atol=1e-11)


# --- what viewers show --------------------------------------------------------------------------------


@every_table
def test_visuals_extend_from_joint_to_end(table: SkeletonTable) -> None:
    drawn = links(to_urdf(table))
    for joint in table.joints:
        spheres = []
        for visual in drawn[joint.name].iter("visual"):
            origin, geometry = part(visual, "origin"), part(visual, "geometry")
            at = floats(origin.attrib["xyz"])
            if (cylinder := geometry.find("cylinder")) is not None:
                turn = Rotation.from_euler("xyz", floats(origin.attrib["rpy"])).as_matrix()
                half = turn[:, 2] * float(cylinder.attrib["length"]) / 2
                np.testing.assert_allclose(at + half, joint.end, atol=1e-9)
                np.testing.assert_allclose(at - half, 0, atol=1e-9)
            else:
                spheres.append(at)
        np.testing.assert_allclose(spheres, [np.zeros(3), joint.end], atol=1e-11)
    light = set(drawn) - set(table.names)
    assert all(drawn[name].find("visual") is None for name in light)
