"""Export of a reconstruction to a folder."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from clinical_support import walking
from report_support import folder_of

from rtof_kin.body.motion_file import MotionReader, motion_folder, motion_path
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.core.resources import model_path
from rtof_kin.formats.measurements_file import read_measurements
from rtof_kin.reconstruction.part_results import joined
from rtof_kin.reconstruction.parts import reconstruct_in_parts
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting import export as exporting
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import headline
from rtof_kin.reporting.export import export, results_of, summary
from rtof_kin.reporting.statistics import ReconstructionStatistics

BODY = SkeletonModel.default().with_height(1.66)
T = 16
FILES = {
    "motion.h5",
    "skeleton.urdf",
    "joint_trajectory.csv",
    "joint_trajectory.json",
    "ros_joint_trajectory.json",
    "ros_base_trajectory.json",
    "summary.json",
    "files.json",
    "motion.csv",
    "measurements.h5",
    MANIFEST,
}


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    truth = planted.moving(BODY, T)
    recording = replace(
        planted.recording(truth), joint_offsets=BODY.joint_offsets, first_frame=300, acknowledgement="Thanks."
    )
    lifter = planted.PlantedLifter(truth, blind=slice(4, 8))
    settings = ReconstructionSettings(frames=16)
    return reconstruct(recording, lifter=lifter, settings=settings, calibrate=False)


@pytest.fixture(scope="module")
def folder(result: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "out"
    export(result, folder)
    return folder


def strict_json(path: Path) -> Any:
    """JSON without NaN."""

    def reject(constant: str) -> float:
        raise ValueError(f"{constant} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=reject)


def test_all_files_are_written(result: Reconstruction, folder: Path, tmp_path: Path) -> None:
    assert {path.name for path in folder.iterdir()} == FILES
    assert all(strict_json(path) for path in folder.glob("*.json"))
    export(result, tmp_path / "out", formats=("osim", "mot", "trc"))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    pieces = {"motion_1.mot", "motion_2.mot"}  # one for each side of the gap
    assert names >= pieces | {"skeleton.osim", "motion.trc", "motion.h5"}
    assert not any(name.endswith(".csv") for name in names)
    with pytest.raises(UnknownNameError, match="'dae'"):
        export(result, tmp_path / "other", formats=("dae",))
    assert not (tmp_path / "other").exists()


def test_motion_file_contains_the_motion(result: Reconstruction, folder: Path) -> None:
    with MotionReader(folder) as file:
        read = file.read()
        assert (file.mode, file.first_frame) == ("rtof", 300)
    np.testing.assert_allclose(read.q, result.motion.q, rtol=0, atol=3e-8)
    assert not read.poses.valid[4:8].any()
    np.testing.assert_array_equal(read.poses.provenance, result.motion.poses.provenance)
    assert SkeletonModel.from_urdf(folder / "skeleton.urdf").height == pytest.approx(1.66, abs=1e-6)


def test_measurements_are_those_that_were_used(result: Reconstruction, folder: Path) -> None:
    found, poses = read_measurements(folder / "measurements.h5"), result.motion.poses
    np.testing.assert_array_equal(found.times, poses.times)
    (view,) = found.views
    assert result.keypoints is not None
    assert result.bone_imus is not None
    np.testing.assert_allclose(view.uv_px, result.keypoints.landmarks.uv_px, rtol=0, atol=1 / 128)
    np.testing.assert_array_equal(view.video_times, result.recording.video.video_times)
    assert found.segments == result.bone_imus.joints
    R_world_bone = found.R_world_sensor @ np.swapaxes(found.R_bone_sensor, -1, -2)
    np.testing.assert_allclose(R_world_bone, result.bone_imus.R_world_bone, atol=5e-5)
    assert found.truth is not None
    assert result.recording.truth is not None
    np.testing.assert_allclose(found.truth.p_world_joint, result.recording.truth.p_world_joint, atol=1e-5)


def test_the_motion_is_found_in_the_output_of_reconstruct_and_run(folder: Path, tmp_path: Path) -> None:
    of_run = tmp_path / "run"
    (of_run / "motion").mkdir(parents=True)
    (of_run / "motion" / "motion.h5").touch()
    assert motion_path(folder) == motion_path(folder / "motion.h5") == folder / "motion.h5"
    assert motion_folder(of_run) == of_run / "motion"
    with pytest.raises(FileFormatError, match="output folder of reconstruct or run"):
        motion_path(tmp_path)
    for wrong in ("nowhere", "walk.mp4"):
        (tmp_path / "walk.mp4").touch()
        with pytest.raises(FileFormatError, match=f"{wrong}: .*; name the output folder of reconstruct or run"):
            motion_folder(tmp_path / wrong)


def test_summary_of_a_reconstruction(result: Reconstruction, folder: Path) -> None:
    found = strict_json(folder / "summary.json")
    assert list(found)[:3] == ["recording", "mode", "verdict"]
    assert (found["recording"], found["mode"], found["frames"]) == ("planted", "rtof", T)
    assert found["acknowledgement"] == "Thanks."
    assert found["rate_hz"] == pytest.approx(60.0)
    assert found["height_m"] == pytest.approx(1.66, abs=1e-6)
    assert found["sensors"] == list(planted.LIMBS)
    assert sum(found["provenance"].values()) == pytest.approx(1.0)
    assert found["provenance"]["bridged"] > 0
    assert found["valid_share"] == pytest.approx(1 - 4 / T)
    assert found["dofs_from_prior"]["RightFoot_y"] == 1.0
    assert "RightUpLeg_y" not in found["dofs_from_prior"]
    solver = found["solver"]
    assert (solver["status"], solver["fragments"]) == ("CONVERGED", 3)
    assert solver["outcome"] == "3 of 3 fragments converged"
    assert found["verdict"] == headline(audit(result)).plain()
    settings = found["settings"]
    assert (settings["lifter"], settings["calibrate"]) == ("PlantedLifter", "no")
    assert (settings["frames"], settings["energy"]) == (16, "default")
    assert result.metrics is not None
    assert found["metrics"]["rtof"] == pytest.approx(dict(result.metrics))
    assert set(found["metrics"]) == {"lift", "sf2", "rtof"}
    head = result.metrics.per_joint["Head"]
    assert found["metrics_per_joint"]["Head"] == pytest.approx(head)


def test_summary_omits_missing_parts_and_writes_null_for_nan(result: Reconstruction) -> None:
    assert result.metrics is not None
    unknown = replace(result.metrics, pooled=result.metrics.pooled | {"mpjje": float("nan")})
    found = summary(replace(result, stage_metrics={"rtof": unknown}))
    assert found["metrics"]["rtof"]["mpjje"] is None
    json.dumps(found, allow_nan=False)
    found = summary(replace(result, solution=None, bone_imus=None, stage_metrics={}))
    assert not {"solver", "metrics"} & set(found)
    assert found["sensors"] == []


def test_limit_violations_are_in_degrees(result: Reconstruction) -> None:
    q = np.array(result.motion.q)
    q[3, 7] = BODY.limits[0, 1] + np.radians(12.0)
    found = summary(replace(result, motion=replace(result.motion, q=q, report=BODY.check(q))))
    assert found["limit_violations_deg"][BODY.dof_names[0]] == pytest.approx(12.0)


# --- in parts --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def parts() -> list[Reconstruction]:
    demo = Recording.load(model_path("demo")).between(0.0, 3.0)
    return list(reconstruct_in_parts(demo, mode="rtof", seconds=1.0))


def test_the_files_have_the_motion_of_all_parts(parts: list[Reconstruction], tmp_path: Path) -> None:
    found = export(parts, tmp_path / "out")
    motion = Motion.load(tmp_path / "out" / "motion.h5")
    p = np.concatenate([part.motion.poses.p_world_joint for part in parts])
    np.testing.assert_allclose(motion.poses.p_world_joint, p, atol=1e-5)
    measured = read_measurements(tmp_path / "out" / "measurements.h5")
    np.testing.assert_allclose(measured.times, motion.times)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == found.frames == len(motion.times)
    assert summary["parts"] == len(parts) > 1
    assert summary["solver"]["fragments"] == sum(len(part.solution.fragments) for part in parts)
    assert (tmp_path / "out" / "motion.csv").is_file()
    assert not (tmp_path / "out" / "figures").exists()


def test_long_motions_are_not_written_as_text_unless_asked_for(
    parts: list[Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "MOST_SECONDS", 2.0)
    export(parts, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").glob("[a-z]*")) == [
        "files.json",
        "measurements.h5",
        "motion.h5",
        "skeleton.urdf",
        "summary.json",
    ]
    export(parts, tmp_path / "asked", formats=("csv",))
    assert (tmp_path / "asked" / "motion.csv").is_file()


def test_parts_joined_to_one_result_are_written_as_the_parts(parts: list[Reconstruction], tmp_path: Path) -> None:
    whole = joined(parts)
    p = np.concatenate([part.motion.poses.p_world_joint for part in parts])
    np.testing.assert_array_equal(whole.motion.poses.p_world_joint, p)
    frames = len(p)
    assert len(whole.keypoints.times) == len(whole.bone_imus.times) == len(whole.stages["rtof"]) == frames
    assert len(whole.recording.video.times) == frames
    assert len(whole.solution.fragments) == sum(len(part.solution.fragments) for part in parts)
    assert whole.metrics["mpjpe_mm"] == pytest.approx(ReconstructionStatistics.of(whole).metrics["mpjpe_mm"], rel=1e-3)
    export(whole, tmp_path / "whole")
    export(parts, tmp_path / "parts")
    for name in ("motion.h5", "measurements.h5", "summary.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()


def test_an_error_in_a_later_part_leaves_no_folder(parts: list[Reconstruction], tmp_path: Path) -> None:
    def broken() -> object:
        yield parts[0]
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        export(broken(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_results_of_an_exported_c3d_are_of_the_subject_in_the_summary(tmp_path: Path) -> None:
    motion = walking(2.0)
    about = {"subject": {"mass_kg": 70.0, "sex": "female"}, "session": {"subject": "P07"}}
    found = results_of(MotionSource.of(motion), folder_of(motion, tmp_path / "walk", inputs=about))
    assert (found.subject, found.mass_kg) == ("P07", 70.0)
    assert "GroundReactionForce" in found.points["FORCES"]
    (tmp_path / "walk" / "summary.json").unlink()
    assert results_of(MotionSource.of(motion), tmp_path / "walk").subject == ""
