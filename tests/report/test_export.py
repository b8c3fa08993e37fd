"""The folder that a reconstruction leaves behind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import OutputExistsError, UnknownNameError
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.formats.joint_trajectory import read_joint_trajectory_csv
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.reconstruction.pipeline import Reconstruction, ReconstructionSettings, reconstruct
from rtof_kin.report import figures
from rtof_kin.report.audit import audit
from rtof_kin.report.export import export, summary
from rtof_kin.report.headline import headline

BODY = SkeletonModel.default().with_height(1.66)
T = 16
FILES = {
    "motion.npz", "skeleton.urdf", "joint_trajectory.csv", "joint_trajectory.json",
    "ros_joint_trajectory.json", "ros_base_trajectory.json", "summary.json", "files.json",
    "motion.csv", MANIFEST,
}  # fmt: skip


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    truth = planted.moving(BODY, T)
    recording = replace(
        planted.recording(truth),
        joint_offsets=BODY.joint_offsets,
        first_frame=300,
        acknowledgement="Motion by nobody.",
    )
    lifter = planted.PlantedLifter(truth, blind=slice(4, 8))
    settings = ReconstructionSettings(frames=16)
    return reconstruct(recording, lifter=lifter, settings=settings, calibrate=False)


@pytest.fixture(scope="module")
def folder(result: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(result, tmp_path_factory.mktemp("export") / "out", figures=False)


def strict_json(path: Path) -> Any:
    """JSON as every other program reads it, without NaN."""

    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_every_file_is_there_and_figures_when_asked(
    result: Reconstruction, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {path.name for path in folder.iterdir()} == FILES
    drawn: list[Path] = []
    monkeypatch.setattr(figures, "write_figures", lambda result, folder: drawn.append(folder))
    assert export(result, tmp_path / "out") == tmp_path / "out"
    assert [path.name for path in drawn] == ["figures"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_files_of_other_tools_come_where_they_are_asked_for(
    result: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "write_figures", lambda result, folder: None)
    export(result, tmp_path / "out", formats=("osim", "mot", "trc"))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    pieces = {"motion_1.mot", "motion_2.mot"}  # nobody saw the person in between
    assert names >= pieces | {"skeleton.osim", "motion.trc", "motion.npz"}
    assert not any(name.endswith(".csv") for name in names)
    with pytest.raises(UnknownNameError, match="unknown format 'dae'"):
        export(result, tmp_path / "other", formats=("dae",))
    assert not (tmp_path / "other").exists()


def test_the_motion_file_holds_the_motion(result: Reconstruction, folder: Path) -> None:
    read = read_motion_npz(folder / "motion.npz")
    np.testing.assert_array_equal(read.q, result.motion.q)
    assert (read.mode, read.first_frame) == ("rtof", 300)
    assert not read.poses.valid[4:8].any()
    np.testing.assert_array_equal(read.poses.provenance, result.motion.poses.provenance)


def test_the_urdf_plays_the_table_to_where_the_joints_are(folder: Path) -> None:
    model = pin.buildModelFromUrdf(str(folder / "skeleton.urdf"), pin.JointModelFreeFlyer())
    data = model.createData()
    names, table = read_joint_trajectory_csv(folder / "joint_trajectory.csv")
    column = {name: table[:, i] for i, name in enumerate(names)}
    found = read_motion_npz(folder / "motion.npz")
    poses = found.poses
    np.testing.assert_array_equal(column["time"], poses.times)
    base = [column[f"base_{part}"] for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    for t in range(T):
        q = pin.neutral(model)
        q[:7] = [values[t] for values in base]
        for name in found.dof_names:
            q[model.joints[model.getJointId(name)].idx_q] = column[name][t]
        pin.framesForwardKinematics(model, data, q)
        p = [data.oMf[model.getFrameId(n, pin.FrameType.BODY)].translation for n in poses.names]
        np.testing.assert_allclose(np.array(p), poses.p_world_joint[t], atol=1e-9)


def test_the_urdf_of_the_subject_is_as_tall_as_the_subject(folder: Path) -> None:
    assert SkeletonModel.from_urdf(folder / "skeleton.urdf").height == pytest.approx(1.66, abs=1e-6)


def test_the_summary_says_what_happened(result: Reconstruction, folder: Path) -> None:
    facts = strict_json(folder / "summary.json")
    assert (facts["recording"], facts["mode"], facts["frames"]) == ("planted", "rtof", T)
    assert facts["acknowledgement"] == "Motion by nobody."
    assert facts["rate_hz"] == pytest.approx(60.0)
    assert facts["height_m"] == pytest.approx(1.66, abs=1e-6)
    assert facts["sensors"] == list(planted.LIMBS)
    assert sum(facts["provenance"].values()) == pytest.approx(1.0)
    assert facts["provenance"]["bridged"] > 0
    assert facts["valid_share"] == pytest.approx(1 - 4 / T)
    assert facts["dofs_from_prior"]["RightFoot_y"] == 1.0
    assert "RightUpLeg_y" not in facts["dofs_from_prior"]
    assert facts["solver"]["status"] == "CONVERGED"
    assert "tolerance" in facts["solver"]["meaning"]
    assert facts["solver"]["fragments"] == 3
    assert facts["solver"]["outcome"] == "3 of 3 fragments converged"
    assert list(facts)[:3] == ["recording", "mode", "verdict"]
    assert facts["verdict"] == headline(audit(result)).plain()
    assert facts["settings"]["lifter"] == "PlantedLifter"
    assert (facts["settings"]["calibrate"], facts["settings"]["frames"]) == ("no", 16)
    assert facts["settings"]["energy"] == "default"
    assert result.metrics is not None
    assert facts["metrics"]["rtof"] == pytest.approx(dict(result.metrics))
    assert set(facts["metrics"]) == {"lift", "sf2", "rtof"}
    head = result.metrics.per_joint["Head"]
    assert facts["metrics_per_joint"]["Head"] == pytest.approx(head)


def test_every_json_file_is_json(folder: Path) -> None:
    for path in folder.glob("*.json"):
        assert strict_json(path)


def test_a_figure_without_data_is_null(result: Reconstruction) -> None:
    assert result.metrics is not None
    unknown = replace(result.metrics, pooled=result.metrics.pooled | {"mpjje": float("nan")})
    facts = summary(replace(result, stage_metrics={"rtof": unknown}))
    assert facts["metrics"]["rtof"]["mpjje"] is None
    json.dumps(facts, allow_nan=False)


def test_a_mode_without_solver_or_truth_leaves_those_parts_out(result: Reconstruction) -> None:
    plain = replace(result, solution=None, bone_imus=None, stage_metrics={}, metrics=None)
    facts = summary(plain)
    assert "solver" not in facts
    assert "metrics" not in facts
    assert facts["sensors"] == []


def test_limits_that_are_left_are_named_in_degrees(result: Reconstruction) -> None:
    q = np.array(result.motion.q)
    upper = BODY.limits[0, 1]
    q[3, 7] = upper + np.radians(12.0)
    report = BODY.check(q)
    facts = summary(replace(result, motion=replace(result.motion, q=q, report=report)))
    assert facts["limit_violations_deg"][BODY.dof_names[0]] == pytest.approx(12.0)


def test_what_stands_there_is_kept_unless_overwriting_is_asked_for(
    result: Reconstruction, tmp_path: Path
) -> None:
    export(result, tmp_path / "out", figures=False)
    (tmp_path / "out" / "note").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(OutputExistsError, match="out: contains .*: note; move it elsewhere"):
            export(result, tmp_path / "out", overwrite=overwrite, figures=False)
    assert (tmp_path / "out" / "note").read_text() == "mine"
    (tmp_path / "out" / "note").unlink()
    with pytest.raises(OutputExistsError, match="ask to overwrite it"):
        export(result, tmp_path / "out", figures=False)
    export(result, tmp_path / "out", overwrite=True, figures=False)
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_a_folder_of_other_things_is_never_replaced(result: Reconstruction, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter").write_text("dear")
    with pytest.raises(OutputExistsError, match="home: contains .* never replaced: letter"):
        export(result, tmp_path / "home", overwrite=True, figures=False)
    assert (tmp_path / "home" / "letter").read_text() == "dear"


def test_a_failure_half_way_leaves_nothing(
    result: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("out of ink")

    monkeypatch.setattr(figures, "write_figures", fail)
    with pytest.raises(RuntimeError, match="out of ink"):
        export(result, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
