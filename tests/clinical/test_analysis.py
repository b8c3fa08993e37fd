"""The whole analysis: what `rtof-kin analyse` writes, draws, says, and refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from clinical_support import walk
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.clinical.analysis import MotionAnalysis, analyse_motion
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.files import write_analysis
from rtof_kin.core.errors import ShapeError, UnknownNameError
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.motion_npz import write_motion_npz
from rtof_kin.report.clinical_figures import SHOWN, angles_over_time, gait_cycles

ALWAYS = {
    "angles.csv", "angles.json", "angles_provenance.csv", "angles_trusted.csv", "range_of_motion.csv",
    "gait.json", "notes.json",
}  # fmt: skip


@pytest.fixture(scope="module")
def analysis() -> MotionAnalysis:
    return analyse_motion(walk(), weight_kg=70.0, height=1.72, repetitions="squat")


@pytest.fixture(scope="module")
def motion_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("motion") / "motion.npz"
    write_motion_npz(path, walk(), mode="rtof")
    return path


@pytest.mark.parametrize("step", [20, 40, 80])
def test_at_one_frame_a_second_everything_but_the_gait_is_still_told(step: int) -> None:
    slow = walk()[::step]
    analysis = analyse_motion(slow, weight_kg=70.0, repetitions="squat")
    assert "too low a rate for gait events" in analysis.notes["gait"][0]
    assert np.isfinite(analysis.angles["right_hip_flexion"]).all()
    assert {row.name: row.peak_velocity for row in analysis.ranges}["right_hip_flexion"] > 0.1
    assert analysis.repetitions is not None
    assert analysis.torques is not None


def test_angles_come_back_from_their_file_in_degrees_with_gaps_as_empty_cells(
    analysis: MotionAnalysis, tmp_path: Path
) -> None:
    values = np.array(analysis.angles.values)
    values[10:20, 3] = np.nan
    write_analysis(replace(analysis, angles=replace(analysis.angles, values=values)), tmp_path)
    columns = read_csv(tmp_path / "angles.csv")
    names = analysis.angles.names
    assert list(columns) == ["time", *(f"{name}_deg" for name in names)]
    back = np.stack(list(columns.values())[1:], axis=-1)
    np.testing.assert_allclose(np.radians(back), values, atol=1e-10)
    np.testing.assert_allclose(columns["time"], analysis.angles.times, atol=1e-12)
    assert ",," in (tmp_path / "angles.csv").read_text().splitlines()[12]
    who = read_csv(tmp_path / "angles_provenance.csv")
    np.testing.assert_array_equal(np.stack(list(who.values())[1:], -1), analysis.angles.provenance)


def test_the_table_travels_with_the_angles(analysis: MotionAnalysis, tmp_path: Path) -> None:
    write_analysis(analysis, tmp_path)
    table = json.loads((tmp_path / "angles.json").read_text())
    assert [entry["name"] for entry in table["angles"]] == list(analysis.angles.names)
    knee = next(entry for entry in table["angles"] if entry["name"] == "left_knee_flexion")
    assert knee["opensim"] == "knee_angle_l"
    assert knee["urdf"] == ["LeftLeg_y", "LeftLeg_x", "LeftLeg_z"]
    assert knee["sequence"] == "ZXY"
    assert knee["sign"] == -1
    assert "heel towards the buttock" in knee["positive"]
    assert table["provenance"][str(int(Provenance.PRIOR))] == "prior"


def test_every_part_is_written_with_its_numbers(analysis: MotionAnalysis, tmp_path: Path) -> None:
    write_analysis(analysis, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == ALWAYS | {
        "gait_cycles.csv", "repetitions.json", "torques.csv", "torques.json",
    }  # fmt: skip
    gait = json.loads((tmp_path / "gait.json").read_text())
    cadence = gait["summary"]["right"]["cadence_steps_per_min"]
    assert cadence["mean"] == pytest.approx(analysis.gait.summary["right"]["cadence"][0])
    assert cadence["strides"] == 3
    assert len(gait["strides"]) == 5
    cycles = read_csv(tmp_path / "gait_cycles.csv")
    assert len(cycles["cycle_percent"]) == 101
    curve = next(c for c in analysis.curves if c.name == "right_knee_flexion")
    np.testing.assert_allclose(cycles["right_knee_flexion_mean_deg"], np.degrees(curve.mean))
    assert {"pelvis_list_right_cycle_mean_deg", "pelvis_list_left_cycle_sd_deg"} <= set(cycles)
    torques = read_csv(tmp_path / "torques.csv")
    assert analysis.torques is not None
    np.testing.assert_allclose(torques["outer_fz_N"], analysis.torques.root_wrench[:, 2], atol=1e-8)
    assert json.loads((tmp_path / "torques.json").read_text())["weight_kg"] == 70.0
    repetitions = json.loads((tmp_path / "repetitions.json").read_text())
    assert (repetitions["count"], repetitions["total_time_s"]) == (0, None)


def test_ranges_stand_in_their_file(analysis: MotionAnalysis, tmp_path: Path) -> None:
    write_analysis(analysis, tmp_path)
    lines = (tmp_path / "range_of_motion.csv").read_text().splitlines()
    assert len(lines) == 1 + len(analysis.angles.names)
    cells = dict(zip(lines[0].split(","), lines[1 + analysis.angles.names.index("right_knee_flexion")]
                     .split(","), strict=True))  # fmt: skip
    knee = next(r for r in analysis.ranges if r.name == "right_knee_flexion")
    assert float(cells["high_deg"]) == pytest.approx(np.degrees(knee.high))
    assert float(cells["range_deg"]) == pytest.approx(np.degrees(knee.range))


def test_without_a_weight_everything_else_is_there_and_a_note_says_what_is_not(tmp_path: Path) -> None:
    standing = planted.standing(SkeletonModel.default(), 120)
    analysis = analyse_motion(standing)
    write_analysis(analysis, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == ALWAYS
    notes = json.loads((tmp_path / "notes.json").read_text())
    assert notes["torques"] == ["not computed: no weight is given, and torques are proportional to it"]
    assert any("no heel strike" in note for note in notes["gait"])
    assert any("right_ankle_dorsiflexion" in note for note in notes["angles"])
    assert "repetitions" not in notes


def test_every_panel_has_its_unit_and_one_that_nobody_saw_says_so(analysis: MotionAnalysis) -> None:
    for figure, label in ((gait_cycles(analysis), "[%]"), (angles_over_time(analysis), "[s]")):
        axes = figure.axes
        assert [ax.get_title(loc="left") for ax in axes] == [name.replace("_", " ") for name in SHOWN]
        assert all(ax.get_ylabel() == "[deg]" and ax.lines for ax in axes)
        assert all(label in ax.get_xlabel() for ax in axes[-3:])
    blind = angles_over_time(analyse_motion(planted.standing(SkeletonModel.default(), 30)))
    ankle = blind.axes[SHOWN.index("ankle_dorsiflexion")]
    assert [text.get_text() for text in ankle.texts] == ["nobody saw it"]


def test_an_angle_that_nobody_saw_is_told_in_its_cycle_panel_too(analysis: MotionAnalysis) -> None:
    seen = tuple(curve for curve in analysis.curves if not curve.name.endswith("ankle_inversion"))
    single = [replace(curve, curves=curve.curves[:1]) for curve in seen]
    axes = gait_cycles(replace(analysis, curves=tuple(single))).axes
    ankle = axes[SHOWN.index("ankle_inversion")]
    assert [text.get_text() for text in ankle.texts] == ["nobody saw it"]
    (legend,) = [ax.get_legend() for ax in axes if ax.get_title(loc="left") == "knee flexion"]
    assert [text.get_text() for text in legend.get_texts()] == ["right, 1 stride", "left, 1 stride"]


@pytest.mark.parametrize("drawn", [gait_cycles, angles_over_time])
def test_no_legend_hides_a_curve(drawn: Callable[..., Figure], analysis: MotionAnalysis) -> None:
    figure = drawn(analysis)
    FigureCanvasAgg(figure).draw()
    for ax in figure.axes:
        if (legend := ax.get_legend()) is not None:
            assert not legend.get_window_extent().overlaps(ax.get_window_extent().padded(-1))


def test_the_cycle_panels_hold_the_mean_of_either_side(analysis: MotionAnalysis) -> None:
    ax = gait_cycles(analysis).axes[SHOWN.index("knee_flexion")]
    for line, side in zip(ax.lines, ("right", "left"), strict=False):
        curve = next(c for c in analysis.curves if c.name == f"{side}_knee_flexion")
        np.testing.assert_allclose(line.get_ydata(), np.degrees(curve.mean))
        assert line.get_label() == f"{side}, {len(curve.curves)} strides"


def test_a_height_without_a_weight_and_an_unknown_repetition_are_refused() -> None:
    with pytest.raises(ShapeError, match="height and sex are for joint torques, which need a weight"):
        analyse_motion(walk(), height=1.8)
    with pytest.raises(UnknownNameError, match="Known: squat, sit_to_stand"):
        analyse_motion(walk(), repetitions="lunge")  # type: ignore[arg-type]


@pytest.mark.parametrize("frames", [1, 2, 10])
def test_a_motion_of_few_frames_has_angles_and_notes(frames: int, any_skeleton: SkeletonModel) -> None:
    motion = planted.moving(any_skeleton, frames)
    motion = replace(motion, poses=all_observed(motion.poses))
    analysis = analyse_motion(motion, weight_kg=70.0, repetitions="sit_to_stand")
    assert np.isfinite(analysis.angles["right_hip_flexion"]).all()
    assert analysis.torques is not None
    assert np.isnan(analysis.torques.torques).all()
    assert "1 stretch(es) shorter than 0.5 s have no torques" in analysis.torques.notes
    assert any("no heel strike" in note for note in analysis.gait.notes)


def test_a_motion_that_nobody_saw_has_no_number_and_says_so(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.default(), 60)
    nothing = replace(
        motion.poses,
        p_world_joint=np.full_like(motion.poses.p_world_joint, np.nan),
        R_world_bone=np.full_like(motion.poses.R_world_bone, np.nan),
        provenance=None, valid=None,
    )  # fmt: skip
    unseen = replace(motion, q=np.full_like(motion.q, np.nan), poses=nothing)
    analysis = analyse_motion(unseen, weight_kg=70.0, repetitions="squat")
    write_analysis(analysis, tmp_path)
    assert not analysis.angles.known.any()
    assert np.all(analysis.angles.provenance == Provenance.NOBODY)
    assert "no value at all (not in the data)" in analysis.angles.notes[0]
    assert "right foot: never seen, so it has no events and no strides" in analysis.gait.notes
    assert analysis.torques is not None
    assert np.isnan(analysis.torques.root_wrench).all()
    angles_over_time(analysis)


# --- the command ---


def test_analyse_writes_the_folder_and_prints_what_it_found(
    motion_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "analysis"
    assert main(["analyse", str(motion_file), "-o", str(out), "--weight", "70"]) == 0
    text = capsys.readouterr().out
    assert "right_knee_flexion" in text
    assert "cadence steps/min" in text
    assert "torques of the legs in" in text
    names = {p.name for p in out.iterdir()}
    assert names == ALWAYS | {"gait_cycles.csv", "torques.csv", "torques.json", "figures", MANIFEST}
    for name in ("angles.png", "gait_cycles.png"):
        assert (out / "figures" / name).read_bytes().startswith(b"\x89PNG")


def test_analyse_replaces_nothing_unasked(
    motion_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "analysis"
    command = ["analyse", str(motion_file.parent), "-o", str(out), "--no-figures"]
    assert main(command) == 0
    before = (out / "angles.csv").read_bytes()
    assert main([*command, "--weight", "70"]) == 2
    assert "ask to overwrite it" in capsys.readouterr().err
    assert (out / "angles.csv").read_bytes() == before
    assert not (out / "torques.csv").exists()
    assert main([*command, "--weight", "70", "--overwrite"]) == 0
    assert (out / "torques.csv").exists()


def test_analyse_takes_the_weight_that_the_recording_has_unless_another_is_given(
    motion_file: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "motion"
    folder.mkdir()
    motion = Path(shutil.copy(motion_file, folder))
    subject = {"mass_kg": 62.0, "sex": "female"}
    (folder / "summary.json").write_text(json.dumps({"inputs": {"subject": subject}}))
    for given, more, weight in ((folder, [], 62.0), (motion, ["--weight", "70"], 70.0)):
        out = tmp_path / str(weight)
        assert main(["analyse", str(given), "-o", str(out), "--no-figures", *more]) == 0
        assert json.loads((out / "torques.json").read_text())["weight_kg"] == weight


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--height", "1.7"], "need a weight"),
        (["--weight", "70000"], "no person's; give kilograms"),
        (["--weight", "70", "--height", "170"], "no person's; give metres"),
    ],
)
def test_impossible_people_are_one_clear_line(
    motion_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert main(["analyse", str(motion_file), "-o", str(tmp_path / "out"), *more]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert not (tmp_path / "out").exists()


def test_a_missing_motion_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyse", str(tmp_path / "none.npz"), "-o", str(tmp_path / "out")]) == 2
    assert "none.npz" in capsys.readouterr().err
