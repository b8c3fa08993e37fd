"""URDF files: made from the tables, valid for simulators, readable by yourdfpy."""

from __future__ import annotations

import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy
from numpy.typing import NDArray

from rtof_kin.body.body_mass import inertia
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import SkeletonTable, read_skeleton_table
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


def test_build_script_checks_from_the_command_line() -> None:
    done = subprocess.run(
        [sys.executable, str(MODELS / "build_urdf.py"), "--check"],
        capture_output=True, text=True, cwd=MODELS.parent, check=False,
        env={"PYTHONPATH": str(MODELS.parent)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("agrees with its table") == 2


def test_build_script_reports_a_stale_file_and_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in [*MODELS.glob("*.toml"), *MODELS.glob("*.urdf")]:
        shutil.copy(path, tmp_path)
    main = runpy.run_path(str(MODELS / "build_urdf.py"))["main"]
    assert main(["--check"], tmp_path) == 0
    table = tmp_path / "skeleton.toml"
    table.write_text(table.read_text().replace("mass_kg = 75.0", "mass_kg = 76.0"))
    (tmp_path / "human36m.urdf").unlink()
    before = (tmp_path / "skeleton.urdf").read_bytes()
    capsys.readouterr()
    assert main(["--check"], tmp_path) == 1
    printed = capsys.readouterr().out
    assert "skeleton.urdf: differs from skeleton.toml; run python models/build_urdf.py" in printed
    assert "human36m.urdf: differs from human36m.toml" in printed
    assert (tmp_path / "skeleton.urdf").read_bytes() == before
    assert main([], tmp_path) == 0
    assert main(["--check"], tmp_path) == 0
    assert (tmp_path / "skeleton.urdf").read_text() == to_urdf(read_skeleton_table(table))


@every_table
def test_numbers_have_no_rounding_noise(table: SkeletonTable) -> None:
    """No rounding noise (1e-19, -0) that another processor would round otherwise."""
    assert not re.search(r'(effort|velocity)="-?0(\.0)?"', to_urdf(table))  # simulators need them
    numbers = re.findall(r'(?<=[" ])[-+]?\d[\d.]*(?:e[-+]?\d+)?(?=[" ])', to_urdf(table))
    assert len(numbers) > 1000
    for number in numbers:
        assert number != "-0"
        assert float(number) == 0 or abs(float(number)) > 1e-7


@pytest.mark.parametrize("sex", ["male", "female", None])
@every_table
def test_inertias_are_physical_and_masses_sum_to_the_body_mass(table: SkeletonTable, sex: str | None) -> None:
    total = 0.0
    for name, link in links(to_urdf(replace(table, sex=sex, mass_kg=80.0))).items():
        inertial = part(link, "inertial")
        moments = np.sort(np.linalg.eigvalsh(matrix_of(inertial)))
        assert moments[0] > 0, name
        assert moments[2] <= moments[0] + moments[1] + 1e-12, name
        mass = float(part(inertial, "mass").attrib["value"])
        assert (mass == LIGHT_MASS_KG) == (name not in table.names)
        total += mass
    light = LIGHT_MASS_KG * 2 * (len(table.joints) - 1)
    share = {"male": 1.0, "female": 0.9999, None: 0.99995}[sex]
    assert total == pytest.approx(80 * share + light, abs=1e-9)
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


@pytest.mark.parametrize(("name", "skeleton"), [("skeleton", "total_capture"), ("human36m", "human36m")])
def test_yourdfpy_shows_the_height_and_arm_span(name: str, skeleton: str) -> None:
    low, high = yourdfpy.URDF.load(str(model_path(f"{name}.urdf"))).scene.bounds
    height = SkeletonModel.named(skeleton).height
    assert high[2] - low[2] == pytest.approx(height, abs=0.12)  # half a head's sphere more
    assert 0.9 < (high[1] - low[1]) / height < 1.15  # arm span of the T-pose
    assert 0.25 < high[0] - low[0] < 0.45
    assert high[1] == pytest.approx(-low[1])
