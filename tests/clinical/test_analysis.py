"""The complete analysis: files, figures and the command `rtof-kin report --analysis`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from clinical_support import walk, walking, write_analysis
from report_support import certain_to

from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.data.poses import Provenance
from rtof_kin.solve.uncertainty import CovarianceInflation

BODY = SkeletonModel.default()
REACTION = {"ground_reaction.csv", "ground_reaction.json"}
ALWAYS = {
    "angles.csv",
    "angles.json",
    "angles_provenance.csv",
    "angles_trusted.csv",
    "range_of_motion.csv",
    "gait.json",
    "notes.json",
    "travel.json",
}


@pytest.fixture(scope="module")
def analysis() -> MotionAnalysis:
    return analyse(walk(), weight_kg=70.0, height=1.72, repetitions="squat")


@pytest.fixture(scope="module")
def folder(analysis: MotionAnalysis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The analysis as files, with a gap in one angle."""
    values = np.array(analysis.angles.values)
    values[10:20, 3] = np.nan
    folder = tmp_path_factory.mktemp("analysis")
    write_analysis(replace(analysis, angles=replace(analysis.angles, values=values)), folder)
    return folder


@pytest.fixture(scope="module")
def motion_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("motion") / "motion.h5"
    write_motion(path, walk(), mode="rtof")
    return path


def read(path: Path) -> Any:
    return json.loads(path.read_text())


@pytest.mark.parametrize("step", [20, 80])
def test_low_frame_rates_disable_only_gait_events(step: int) -> None:
    analysis = analyse(walk()[::step], weight_kg=70.0, repetitions="squat")
    assert "too low a rate for gait events" in analysis.notes["gait"][0]
    assert np.isfinite(analysis.angles["right_hip_flexion"]).all()
    assert {row.name: row.peak_velocity for row in analysis.ranges}["right_hip_flexion"] > 0.1
    assert analysis.repetitions is not None
    assert analysis.torques is not None


def test_angles_are_written_in_degrees_with_gaps_as_empty_cells(analysis: MotionAnalysis, folder: Path) -> None:
    columns = read_csv(folder / "angles.csv")
    assert list(columns) == ["time", *(f"{name}_deg" for name in analysis.angles.names)]
    back = np.radians(np.stack(list(columns.values())[1:], axis=-1))
    assert np.isnan(back[10:20, 3]).all()
    np.testing.assert_allclose(back[20:], analysis.angles.values[20:], atol=1e-10)
    np.testing.assert_allclose(columns["time"], analysis.angles.times, atol=1e-12)
    assert ",," in (folder / "angles.csv").read_text().splitlines()[12]
    provenance = read_csv(folder / "angles_provenance.csv")
    np.testing.assert_array_equal(np.stack(list(provenance.values())[1:], -1), analysis.angles.provenance)


def test_sidecar_describes_each_angle(analysis: MotionAnalysis, folder: Path) -> None:
    table = read(folder / "angles.json")
    assert [entry["name"] for entry in table["angles"]] == list(analysis.angles.names)
    knee = next(entry for entry in table["angles"] if entry["name"] == "left_knee_flexion")
    assert knee["opensim"] == "knee_angle_l"
    assert knee["urdf"] == ["LeftLeg_y", "LeftLeg_x", "LeftLeg_z"]
    assert (knee["sequence"], knee["sign"]) == ("ZXY", -1)
    assert "heel towards the buttock" in knee["positive"]
    assert table["provenance"][str(int(Provenance.PRIOR))] == "prior"


def test_gait_torques_and_repetitions_are_written(analysis: MotionAnalysis, folder: Path) -> None:
    assert {p.name for p in folder.iterdir()} == ALWAYS | {
        "gait_cycles.csv",
        "repetitions.json",
        "torques.csv",
        "torques.json",
        *REACTION,
    }
    gait = read(folder / "gait.json")
    cadence = gait["summary"]["right"]["cadence_steps_per_min"]
    assert cadence["mean"] == pytest.approx(analysis.gait.summary["right"]["cadence"][0])
    assert (cadence["strides"], len(gait["strides"])) == (3, 5)
    assert (gait["is_gait"], gait["why_not"], gait["walking_strides"]) == (True, "", 5)
    travel = read(folder / "travel.json")
    assert travel["path_length_m"] == pytest.approx(analysis.travel.path_length)
    assert travel["turned_left_deg"] == travel["turned_right_deg"] == 0
    cycles = read_csv(folder / "gait_cycles.csv")
    assert len(cycles["cycle_percent"]) == 101
    curve = next(c for c in analysis.curves if c.name == "right_knee_flexion")
    np.testing.assert_allclose(cycles["right_knee_flexion_mean_deg"], np.degrees(curve.mean))
    assert {"pelvis_list_right_cycle_mean_deg", "pelvis_list_left_cycle_sd_deg"} <= set(cycles)
    torques = read_csv(folder / "torques.csv")
    assert analysis.torques is not None
    np.testing.assert_allclose(torques["outer_fz_N"], analysis.torques.root_wrench[:, 2], atol=1e-8)
    assert read(folder / "torques.json")["weight_kg"] == 70.0
    repetitions = read(folder / "repetitions.json")
    assert (repetitions["count"], repetitions["total_time_s"]) == (0, None)


def test_ranges_are_written_in_degrees(analysis: MotionAnalysis, folder: Path) -> None:
    lines = (folder / "range_of_motion.csv").read_text().splitlines()
    assert len(lines) == 1 + len(analysis.angles.names)
    row = lines[1 + analysis.angles.names.index("right_knee_flexion")]
    cells = dict(zip(lines[0].split(","), row.split(","), strict=True))
    knee = next(r for r in analysis.ranges if r.name == "right_knee_flexion")
    assert float(cells["high_deg"]) == pytest.approx(np.degrees(knee.high))
    assert float(cells["range_deg"]) == pytest.approx(np.degrees(knee.range))


def test_bands_of_ranges_and_headings_are_written(tmp_path: Path) -> None:
    motion = walk()
    analysis = analyse(replace(motion, confidence=certain_to(3.0, motion)))
    write_analysis(analysis, tmp_path)
    header, *lines = (tmp_path / "range_of_motion.csv").read_text().splitlines()
    rows = {line.split(",")[0]: dict(zip(header.split(","), line.split(","), strict=True)) for line in lines}
    knee = rows["right_knee_flexion"]
    assert float(knee["range_sigma_deg"]) == pytest.approx(3 * np.sqrt(2), rel=0.02)
    assert (knee["about_vertical"], rows["pelvis_rotation"]["about_vertical"]) == ("0.0", "1.0")
    assert (knee["comparable"], rows["pelvis_rotation"]["comparable"]) == ("1.0", "0.0")
    assert (knee["uncertain_high_s"], knee["uncertain_high_deg"]) == ("0.0", "")
    least, most = (float(knee[f"range_interval_{end}_deg"]) for end in ("low", "high"))
    assert least < float(knee["range_deg"]) < most


def test_bands_of_whole_curves_are_written_where_the_sensors_are_known(tmp_path: Path) -> None:
    motion = walk()
    analysis = analyse(replace(motion, confidence=certain_to(3.0, motion)))
    factors = CovarianceInflation.shipped().curves
    assert factors is not None
    factor = factors.factor("right_knee_flexion", 8)
    assert factor is not None
    for sensors in (8, None):
        folder = tmp_path / str(sensors)
        folder.mkdir()
        write_analysis(analysis, folder, sensors)
        header, *lines = (folder / "range_of_motion.csv").read_text().splitlines()
        rows = {line.split(",")[0]: dict(zip(header.split(","), line.split(","), strict=True)) for line in lines}
        half = rows["right_knee_flexion"]["curve_half_width_deg"]
        told = read(folder / "angles.json")["whole_curves"]
        if sensors:
            assert float(half) == pytest.approx(3 * factor, rel=0.02)
            assert told["factor"]["right_knee_flexion"] == factor
            assert f"in 90 % of recordings of 2 to 10 s of people like the {factors.people} measured" in told["meaning"]
        else:
            assert (half, told) == ("", None)


def test_the_band_of_a_whole_curve_is_that_of_its_least_certain_reliable_frame() -> None:
    motion = walk()
    analysis = analyse(replace(motion, confidence=certain_to(3.0, motion)))
    (column,) = (a for a, name in enumerate(analysis.angles.names) if name == "right_knee_flexion")
    sigma, trusted = (np.array(own) for own in (analysis.angles.sigma, analysis.angles.trusted))
    sigma[40, column], sigma[50, column] = np.radians([7.0, 40.0])
    trusted[50, column] = False
    (knee,) = ranges_of_motion(replace(analysis.angles, sigma=sigma, trusted=trusted).select(["right_knee_flexion"]))
    assert knee.largest_sigma == pytest.approx(np.radians(7.0))


def test_without_a_weight_a_note_replaces_the_torques(tmp_path: Path) -> None:
    write_analysis(analyse(planted.standing(BODY, 120)), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == ALWAYS
    notes = read(tmp_path / "notes.json")
    assert "no weight" in notes["torques"][0]
    assert any("no heel strike" in note for note in notes["gait"])
    assert any("right_ankle_dorsiflexion" in note for note in notes["angles"])
    assert "repetitions" not in notes


def test_height_without_weight_and_unknown_repetitions_are_rejected() -> None:
    with pytest.raises(InvalidInputError, match="need a weight"):
        analyse(walk(), height=1.8)
    with pytest.raises(UnknownNameError, match="Known: squat, sit_to_stand"):
        analyse(walk(), repetitions="lunge")  # type: ignore[arg-type]


@pytest.mark.parametrize("frames", [1, 2, 10])
def test_few_frames_give_angles_and_notes(frames: int, any_skeleton: SkeletonModel) -> None:
    motion = planted.moving(any_skeleton, frames)
    motion = replace(motion, poses=all_observed(motion.poses))
    analysis = analyse(motion, weight_kg=70.0, repetitions="sit_to_stand")
    assert np.isfinite(analysis.angles["right_hip_flexion"]).all()
    assert analysis.torques is not None
    assert np.isnan(analysis.torques.torques).all()
    assert any("shorter than 0.5 s" in note for note in analysis.torques.notes)
    assert any("no heel strike" in note for note in analysis.gait.notes)


def test_an_unobserved_motion_has_no_values(tmp_path: Path) -> None:
    motion = planted.moving(BODY, 60)
    nothing = replace(
        motion.poses,
        p_world_joint=np.full_like(motion.poses.p_world_joint, np.nan),
        R_world_bone=np.full_like(motion.poses.R_world_bone, np.nan),
        provenance=None,
        valid=None,
    )
    unseen = replace(motion, q=np.full_like(motion.q, np.nan), poses=nothing)
    analysis = analyse(unseen, weight_kg=70.0, repetitions="squat")
    write_analysis(analysis, tmp_path)
    assert not analysis.angles.known.any()
    assert np.all(analysis.angles.provenance == Provenance.NOBODY)
    assert "not in the data" in analysis.angles.notes[0]
    assert any("right foot: never observed" in note for note in analysis.gait.notes)
    assert analysis.torques is not None
    assert np.isnan(analysis.torques.root_wrench).all()


def test_command_writes_the_folder_and_prints_tables(
    motion_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "analysis"
    assert main(["report", str(motion_file), "--analysis", str(out), "--weight", "70"]) == 0
    text = capsys.readouterr().out
    for part in ("right_knee_flexion", "cadence [steps/min]", "torques of the legs in", "m forward, without"):
        assert part in text
    assert MANIFEST in {path.name for path in out.iterdir()}
    assert (out / "figures" / "ground_reaction.png").read_bytes().startswith(b"\x89PNG")


def test_command_shows_gait_only_where_it_is_gait(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two strides on a treadmill are too few; their numbers are in the files all the same."""
    path = tmp_path / "motion.h5"
    write_motion(path, walking(2.4, treadmill=True), mode="rtof")
    assert main(["report", str(path), "--analysis", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "gait: Only 2 complete strides of walking" in text
    assert "cadence [steps/min]" not in text
    gait = read(tmp_path / "out" / "gait.json")
    assert (gait["is_gait"], len(gait["strides"])) == (False, 2)


def test_command_uses_the_weight_of_the_recording_unless_one_is_given(motion_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "motion"
    folder.mkdir()
    motion = Path(shutil.copy(motion_file, folder))
    subject = {"mass_kg": 62.0, "sex": "female"}
    (folder / "summary.json").write_text(json.dumps({"inputs": {"subject": subject}}))
    for given, more, weight in ((folder, [], 62.0), (motion, ["--weight", "70"], 70.0)):
        out = tmp_path / str(weight)
        assert main(["report", str(given), "--analysis", str(out), "--no-figures", *more]) == 0
        assert read(out / "torques.json")["weight_kg"] == weight
