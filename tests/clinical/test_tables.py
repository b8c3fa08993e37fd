"""A motion in xarray, and its analysis in pandas and DuckDB."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import walking
from long_motion import with_confidence

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import MotionAnalysis, analyse

DOCS = Path(__file__).parents[2] / "docs" / "files.md"


@pytest.fixture(scope="module")
def motion() -> Motion:
    return with_confidence(walking(3.0))


@pytest.fixture(scope="module")
def analysis(motion: Motion) -> MotionAnalysis:
    return analyse(motion)


def test_xarray_selects_by_name_with_units_frames_and_sigma(motion: Motion, tmp_path: Path) -> None:
    pytest.importorskip("xarray")
    found = motion.to_xarray()
    assert dict(found.sizes) == {"time": 180, "joint": 21, "xyz": 3, "bone_xyz": 3, "dof": 60}
    foot = found.position.sel(joint="LeftFoot", time=1.0, xyz="z")
    assert float(foot) == motion.poses.p_world_joint[60, motion.poses.names.index("LeftFoot"), 2]
    knee = motion.skeleton.dof_names.index("LeftLeg_y")
    np.testing.assert_array_equal(found.angle.sel(dof="LeftLeg_y"), motion.q[:, 7 + knee])
    units = {name: one.attrs.get("units") for name, one in found.items()}
    assert units["position"] == units["position_sigma"] == "m"
    assert (found.position.attrs["frame"], found.time.attrs["units"], units["angle"]) == ("world", "s", "rad")
    np.testing.assert_allclose(found.position_sigma, 0.01)
    np.testing.assert_allclose(found.rotation_sigma, np.radians(2.0))
    assert found.provenance.attrs["flag_meanings"].split()[4] == "CAMERA"
    assert bool(found.position_valid.all())
    assert "position_sigma" not in walking(0.5).to_xarray()


def test_pandas_has_a_row_for_each_time_and_angle(analysis: MotionAnalysis) -> None:
    pytest.importorskip("pandas")
    table: Any = analysis.to_frame()
    assert [*table.columns] == ["time", "side", "joint", "angle", "degrees", "sigma", "reliable"]
    assert len(table) == analysis.angles.values.size
    own = table[(table.side == "left") & (table.joint == "knee") & (table.angle == "flexion")]
    np.testing.assert_array_equal(own.degrees, np.degrees(analysis.angles["left_knee_flexion"]))
    np.testing.assert_array_equal(own.time, analysis.angles.times)
    column = analysis.angles.names.index("left_knee_flexion")
    assert analysis.angles.sigma is not None
    np.testing.assert_array_equal(own.sigma, np.degrees(analysis.angles.sigma[:, column]))
    trunk = table[table.joint == "pelvis_opensim"]
    assert {*trunk.side} == {""}
    assert {*trunk.angle} == {"tilt", "list", "rotation"}
    assert not table[table.degrees.isna()].reliable.any()


def test_the_query_of_the_docs_runs_in_duckdb(analysis: MotionAnalysis) -> None:
    duckdb = pytest.importorskip("duckdb")
    pytest.importorskip("pandas")
    (query,) = [part.partition('"""')[0] for part in DOCS.read_text(encoding="utf-8").split('duckdb.sql("""')[1:]]
    angles = analysis.to_frame()  # noqa: F841  duckdb reads the variable
    rows = {(side, joint): (low, high) for side, joint, low, high in duckdb.sql(query).fetchall()}
    flexion = np.degrees(analysis.angles["right_knee_flexion"])
    assert rows["right", "knee"] == pytest.approx((flexion.min(), flexion.max()))
