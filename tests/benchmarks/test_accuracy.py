"""The accuracy benchmark: faults, scores, arithmetic of tables, and resumed runs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from benchmarks import harness
from benchmarks.accuracy import __main__ as command
from benchmarks.accuracy import rows as scoring
from benchmarks.accuracy import tables
from benchmarks.accuracy.cases import Case, cases
from benchmarks.accuracy.faults import FAULTS, NOMINAL, Fault
from benchmarks.accuracy.row_file import RowFile
from benchmarks.accuracy.rows import FIGURES, Job, Scene
from benchmarks.accuracy.tables import TABLES
from benchmarks.accuracy.windows import MIDDLE_SECOND
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.reconstruction import self_calibration
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import LIMB_SENSORS

Array = NDArray[np.float64]
SKELETON = SkeletonModel.default()
MOTION = planted.human(SKELETON, 180)
CLIP = MocapClip("moving", MOTION.poses, SKELETON.joint_offsets)
RECORDING = harness.recorded(CLIP, 0, "white", LIMB_SENSORS, 0)


def faulty(name: str, recording: Recording = RECORDING) -> Recording:
    return FAULTS[name].apply(recording, np.random.default_rng(3))


def sensors(recording: Recording) -> ImuSequence:
    assert recording.imus is not None
    return recording.imus


def calibration(recording: Recording) -> ImuCalibration:
    assert recording.calibration is not None
    return recording.calibration


def arrays(recording: Recording) -> dict[str, Any]:
    """Everything that the solver sees."""
    camera, imus, own = recording.keypoints.camera, sensors(recording), calibration(recording)
    return {
        "times": recording.keypoints.times,
        "uv": recording.keypoints.uv_px,
        "confidence": recording.keypoints.confidence,
        "K": camera.K,
        "R": camera.R_camera_world,
        "t": camera.t_camera_world,
        "imu times": imus.times,
        "orientation": imus.R_inertial_sensor,
        "force": imus.f_sensor,
        "heading": own.R_world_inertial,
        "mounting": own.R_sensor_bone,
        "offsets": recording.joint_offsets,
    }


def changed(recording: Recording) -> set[str]:
    before, after = arrays(RECORDING), arrays(recording)
    return {n for n in before if not np.array_equal(before[n], after[n], equal_nan=True)}


# --- faults --------------------------------------------------------------------------------------


PARTS: dict[str, set[str]] = {
    NOMINAL: set(),
    "10 % outliers of 80 px": {"uv"},
    "left arm and leg unseen for 1 s": {"uv", "confidence"},
    "person out of the picture for 1 s": {"uv", "confidence"},
    "left and right exchanged for 0.5 s": {"uv"},
    "left and right leg exchanged for 0.5 s": {"uv"},
    "somebody else followed for 0.5 s": {"uv"},
    "0.5 s of frames lost, stamps jitter": {"times", "uv", "confidence"},
    "video's clock jumps by 100 ms halfway": {"times", "uv", "confidence"},
    "sensors of 40 and 100 Hz, clocks of their own": {"imu times", "orientation", "force"},
    "10 % of packets lost, one by one": {"orientation", "force"},
    "10 % of packets lost, in bursts of 0.5 s": {"orientation", "force"},
    "packets twice and late, counter wraps": {"imu times"},
    "accelerometers saturate at 2 g": {"force"},
    "left forearm's sensor missing": {"orientation", "force"},
    "left forearm's sensor sticks halfway": {"orientation", "force"},
    "left forearm's sensor slips by 30 deg halfway": {"orientation", "force"},
    "left forearm's heading off by 40 deg for 1 s": {"orientation"},
    "left forearm's heading drifts by 20 deg from halfway": {"orientation"},
    "left forearm's sensor stops halfway": {"orientation", "force"},
    "all sensors stop halfway": {"orientation", "force"},
    "bones wrong by 3 % at random": {"offsets"},
    "all bones 3 % too long": {"offsets"},
    "focal length + 2 %": {"K"},
    "camera tilted by 1 deg": {"R", "t"},
    "video late by 33 ms": {"times", "uv", "confidence"},
    "video late by 100 ms": {"times", "uv", "confidence"},
    "headings off by 10 deg": {"heading"},
    "mounting off by 6 deg per axis": {"mounting"},
}
"""What each fault is about."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_changes_only_its_own_data(name: str) -> None:
    assert changed(faulty(name)) == PARTS[name]
    assert faulty(name).truth is RECORDING.truth
    one, other = arrays(faulty(name)), arrays(faulty(name))
    assert all(np.array_equal(one[n], other[n], equal_nan=True) for n in one)


def turned_deg(name: str) -> Array:
    """(T, 3) deg, error of the left forearm's orientation in world axes."""
    wrong, own = (calibration(RECORDING).apply(sensors(r)) for r in (faulty(name), RECORDING))
    s = own.joints.index("LeftForeArm")
    turn = wrong.R_world_bone[:, s] @ np.swapaxes(own.R_world_bone[:, s], -1, -2)
    return np.asarray(np.degrees(so3.log(turn)))


def test_sizes_of_faults_are_those_of_their_names() -> None:
    shift = faulty("10 % outliers of 80 px").keypoints.uv_px - RECORDING.keypoints.uv_px
    size = np.linalg.norm(shift, axis=-1)
    np.testing.assert_allclose(size[size > 0], 80.0, atol=1e-9)
    assert (size > 0).mean() == pytest.approx(0.1, abs=0.02)
    after = sensors(RECORDING).times - RECORDING.video.times[[0, -1]].mean()
    slip = np.linalg.norm(turned_deg("left forearm's sensor slips by 30 deg halfway"), axis=1)
    np.testing.assert_allclose(slip[after < 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(slip[after > 0.2], 30.0, atol=1e-6)
    magnet = turned_deg("left forearm's heading off by 40 deg for 1 s")
    np.testing.assert_allclose(magnet[np.abs(after) < 0.4], [[0, 0, 40]] * 48, atol=1e-6)
    np.testing.assert_allclose(magnet[np.abs(after) > 0.5], 0.0, atol=1e-6)
    heading = calibration(faulty("headings off by 10 deg")).R_world_inertial
    turn = heading @ np.swapaxes(calibration(RECORDING).R_world_inertial, -1, -2)
    np.testing.assert_allclose(so3.log(turn), np.radians([[0, 0, 10.0]] * 8), atol=1e-9)
    wrong, camera = faulty("camera tilted by 1 deg").keypoints.camera, RECORDING.keypoints.camera
    np.testing.assert_allclose(wrong.center_world, camera.center_world, atol=1e-12)
    elevation = [np.degrees(np.arcsin(c.R_camera_world[2, 2])) for c in (wrong, camera)]
    assert abs(elevation[0] - elevation[1]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("name, longest", [("one by one", 8), ("in bursts of 0.5 s", 60)])
def test_a_tenth_of_the_packets_is_lost(name: str, longest: int) -> None:
    imus = sensors(faulty(f"10 % of packets lost, {name}"))
    gone = np.isnan(imus.f_sensor).all(axis=2)
    assert gone.mean() == pytest.approx(0.1, abs=0.08)
    np.testing.assert_array_equal(np.isnan(imus.R_inertial_sensor).all(axis=(2, 3)), gone)
    assert max(b - a for s in range(8) for a, b in signals.runs(gone[:, s])) <= longest


# --- cases and motions ---------------------------------------------------------------------------


# --- one motion and camera -----------------------------------------------------------------------


@pytest.fixture
def lifter(monkeypatch: pytest.MonkeyPatch) -> planted.PlantedLifter:
    own = planted.PlantedLifter(MOTION)
    monkeypatch.setattr(scoring.harness, "lifter", lambda path: own)
    return own


def job(table: str = "ablation", frames: int = 180) -> Job:
    return Job(table, replace(CLIP, poses=MOTION.poses[:frames]), 0, 0, None)


def test_each_recording_is_lifted_once(lifter: planted.PlantedLifter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_calibration, "_SUSPECT", 0.0)  # sensors that explain little are lifted twice more
    scene = Scene(job())
    faults = NOMINAL, "left forearm's sensor missing", "10 % outliers of 80 px", "all bones 3 % too long"
    for asked, name in enumerate(faults, start=1):
        for changes in ({}, {"limits": False}):
            scene.prepared(Case(name, "white", "8", name, changes, as_given=True))
        whole = [one for one in lifter.asked if len(one[0]) == 180]  # checks ask about an excerpt
        assert len(whole) == 2 * asked, name  # once more without sensors, for the clocks
    offsets = lifter.asked[-1][1]
    assert offsets is not None
    np.testing.assert_allclose(offsets, 1.03 * SKELETON.joint_offsets)


def test_scores_include_the_torso_and_every_second(lifter: planted.PlantedLifter) -> None:
    prepared = Scene(job()).prepared(Case("", "white", "8", as_given=True))
    truth = prepared.truth
    R = truth.R_world_bone.copy()
    R[:, SKELETON.index("Spine3")] @= so3.about_axis("y", np.radians(7.0))
    p = truth.p_world_joint.copy()
    p[60:120, 5] += [0.021, 0.0, 0.0]
    row = scoring.scored(replace(truth, p_world_joint=p, R_world_bone=R), prepared, NOMINAL)
    assert row["pelvis_deg"] == pytest.approx(0.0, abs=1e-5)
    assert row["upper_trunk_deg"] == pytest.approx(7.0)
    assert [frames for frames, _ in row["seconds_rr_mm"]] == [60, 60, 60]
    np.testing.assert_allclose([e for _, e in row["seconds_rr_mm"]], [0.0, 1.0, 0.0], atol=1e-9)
    assert row["mpjpe_rr_mm"] == pytest.approx(1 / 3)
    assert set(FIGURES) <= set(row)


def test_a_job_gives_a_row_for_each_stage_and_the_error_of_a_case_that_fails(
    lifter: planted.PlantedLifter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(recording: Recording, rng: np.random.Generator) -> Recording:
        raise InvalidInputError("the planted fault")

    monkeypatch.setitem(FAULTS, "broken", Fault(broken))
    both = [Case(name, "white", "8", name) for name in (NOMINAL, "broken")]
    monkeypatch.setattr(scoring, "cases", lambda table: both)
    rows = scoring.run(job(frames=40))
    assert [row["mode"] for row in rows] == ["zero motion", "lift", "sf2", "rtof", "failed"]
    assert rows[-1]["error"] == "the planted fault"
    assert 0 <= rows[3]["converged"] <= 1
    assert tables.failures(rows) == ["FAILED: moving, camera 0, white, broken: the planted fault"]
    assert json.loads(json.dumps(command.rounded(rows)))[3]["mode"] == "rtof"


@pytest.mark.parametrize("as_given", [True, False])
def test_scores_are_those_of_the_pipeline(lifter: planted.PlantedLifter, as_given: bool) -> None:
    case = Case("", "white", "8", as_given=as_given)
    prepared = Scene(job("ablation", frames=60)).prepared(case)
    assert prepared.solution is None
    poses, _ = scoring.solved(prepared, case.settings)
    own = {"lift": prepared.lifted, "sf2": prepared.sf2, "rtof": poses}
    result = reconstruct(prepared.recording, mode="rtof", lifter=lifter, calibrate=not as_given)
    scores = result.stage_metrics
    assert set(scores) == set(own)
    for mode, metrics in scores.items():
        figures = scoring.scored(own[mode], prepared, NOMINAL)
        # A delay puts the first or last frame beyond the truth, where the pipeline scores nothing.
        names, near = (set(figures) & set(metrics), 1e-9) if as_given else ({"mpjpe_rr_mm"}, 0.05)
        for name in names:
            assert figures[name] == pytest.approx(metrics[name], rel=near), (mode, name)
    assert scores["rtof"]["mpjpe_rr_mm"] < 0.7 * scores["sf2"]["mpjpe_rr_mm"]


# --- arithmetic ----------------------------------------------------------------------------------


def row(motion: str, mode: str, seconds: list[float], **fields: Any) -> dict[str, Any]:
    """A row with the same value in all figures, the mean of its seconds."""
    base: dict[str, Any] = {
        "motion": motion,
        "source": motion.split("/")[0],
        "camera": 0,
        "keypoints": "white",
        "sensors": "8",
        "case": NOMINAL,
        "mode": mode,
        "frames": 60 * len(seconds),
        "coverage": 1.0,
        "converged": 1.0,
        "found": [],
        "seconds_rr_mm": [[60, value] for value in seconds],
    }
    phases = {n: [[60, 1.0, 2.0]] * 3 for n, f in FAULTS.items() if f.window is not None}
    figures = dict.fromkeys(FIGURES, float(np.mean(seconds)))
    return {**base, **figures, "phases": phases, **fields}


def test_errors_are_split_before_in_and_after_the_window() -> None:
    times = np.arange(181) / 60
    fault = Fault(FAULTS[NOMINAL].apply, MIDDLE_SECOND, ("LeftHand",))
    error = np.zeros((181, 21))
    error[60:120, SKELETON.index("LeftHand")[0]] = 42.0
    assert scoring.around(error, times, fault, SKELETON) == [[60, 0.0, 0.0], [60, 42.0, 2.0], [61, 0.0, 0.0]]
    short = scoring.around(error[:45], times[:45], fault, SKELETON)
    assert [frames for frames, *_ in short] == [0, 45, 0]


def test_costs_are_paired_by_source_motion() -> None:
    base = [row("a/1", "rtof", [10.0]), row("a/2", "rtof", [20.0]), row("b", "rtof", [30.0])]
    rows = [row("b", "rtof", [38.0]), row("a/2", "rtof", [23.0]), row("a/1", "rtof", [11.0])]
    mean, interval = tables.cost(rows, base, "mpjpe_rr_mm")
    assert mean == pytest.approx(4.0)
    assert interval == pytest.approx([2.0, 8.0])
    only_a, interval = tables.cost(rows[1:], base, "mpjpe_rr_mm")
    assert only_a == pytest.approx(2.0)
    assert interval == pytest.approx([2.0, 2.0])  # one unit: nothing to draw


def test_the_comparison_with_sf2_finds_significantly_worse_motions() -> None:
    rows = [
        row("worse", "sf2", [20.0, 21.0, 19.0]),
        row("worse", "rtof", [25.0, 26.0, 25.0]),
        row("noisy", "sf2", [20.0, 20.0, 20.0]),
        row("noisy", "rtof", [10.0, 15.0, 40.0]),
        row("better", "sf2", [20.0, 20.0, 20.0]),
        row("better", "rtof", [12.0, 11.0, 13.0]),
        row("better", "rto", [99.0] * 3, sensors="0"),
        row("better", "sf2", [90.0] * 3, sensors="0"),
    ]
    found = {(d["motion"], d["sensors"]): d for d in tables.against_sf2(rows)}
    assert found["worse", "8"]["difference"] == pytest.approx(16 / 3)
    assert found["worse", "8"]["interval"][0] > 0
    assert found["noisy", "8"]["difference"] > 0 > found["noisy", "8"]["interval"][0]
    assert found["better", "8"]["interval"][1] < 0
    assert found["better", "0"]["difference"] == pytest.approx(9.0)
    _, check, exceptions = tables.sensors_tables(rows)
    assert [line[2:] for line in check.rows] == [("3", "2", "1"), ("1", "1", "1")]
    assert [(line[2], line[-1]) for line in exceptions.rows] == [("worse", "yes"), ("noisy", "no"), ("better", "yes")]


# --- tables --------------------------------------------------------------------------------------


def all_rows(table: str) -> Iterator[dict[str, Any]]:
    """Planted rows of two motions for every case; a case's error is its place in the table."""
    for i, case in enumerate(cases(table)):
        for motion in ("a", "b"):
            about: dict[str, Any] = {"keypoints": case.keypoints, "sensors": case.sensors, "case": case.name}
            for mode in ("zero motion", "lift", "sf2"):
                yield row(motion, mode, [100.0], **about)
            yield row(motion, "rto" if case.sensors == "0" else "rtof", [10.0 + i], **about)


@pytest.mark.parametrize("table", TABLES)
def test_every_table_has_every_case_and_the_row_of_zero_motion(table: str) -> None:
    main, *_ = TABLES[table](list(all_rows(table)))
    text = main.markdown()
    assert "zero motion" in text
    for case in cases(table):
        wanted = f"| {case.keypoints} | {case.sensors} |" if table == "sensors" else case.name
        assert wanted in text
    assert all(len(line) == len(main.columns) == len(main.digits) for line in main.rows)


# --- rows on disk --------------------------------------------------------------------------------


def test_an_interrupted_run_resumes_after_its_last_whole_line(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    kept = RowFile(path, "v1")
    kept.add("a 0", [row("a", "rtof", [1.0])])
    kept.add("a 1", [row("a", "rtof", [2.0])])
    path.write_text(path.read_text(encoding="utf-8")[:-40], encoding="utf-8")  # cut in mid-line
    again = RowFile(path, "v1")
    assert set(again.rows) == {"a 0"}
    again.add("a 1", [row("a", "rtof", [3.0])])
    third = RowFile(path, "v1")
    assert {job: rows[0]["mpjae"] for job, rows in third.rows.items()} == {"a 0": 1.0, "a 1": 3.0}


def test_rows_of_another_version_are_not_mixed_in(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    RowFile(path, "v1").add("a 0", [])
    with pytest.raises(RtofError, match="prepared with other code.*--restart"):
        RowFile(path, "v2")
    assert RowFile(path, "v2", restart=True).rows == {}
    assert RowFile(path, "v2").rows == {}


def test_jobs_of_tables_use_all_cameras_or_one_in_turn() -> None:
    motions = [replace(CLIP, name=name) for name in "abcdef"]
    options = command._parser().parse_args(["--corpus", "x", "--motions", "b,f"])
    assert [j.key for j in command.jobs("sensors", motions, options)] == [
        *(f"b {c}" for c in range(4)),
        *(f"f {c}" for c in range(4)),
    ]
    assert [j.key for j in command.jobs("ablation", motions, options)] == ["b 1", "f 1"]


def test_unknown_motions_and_tables_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "clips", lambda corpus, subset: [CLIP])
    with pytest.raises(SystemExit, match="no motion walk; there are moving"):
        command.main(["--corpus", "x", "--motions", "walk"])
    with pytest.raises(SystemExit, match="no table speed; there are sensors, robustness, ablation"):
        command.main(["--corpus", "x", "--tables", "speed"])
