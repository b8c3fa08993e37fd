"""The command validate on small made sets: planted errors, failing takes, resuming, and evaluate --angles."""

from __future__ import annotations

import contextlib
import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import public_sets as made
import pytest
from overlay_support import write_film
from protocol_support import read_json
from public_sets import known, true_motion

from rtof_kin.cli import main
from rtof_kin.clinical.angle_errors import ALL, AngleDifferences, error_rows
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.jobs import Outcome
from rtof_kin.datasets.movi import CENTRES
from rtof_kin.datasets.opencap_validation import OpenCapValidation
from rtof_kin.datasets.public_sets import MOVEMENTS
from rtof_kin.formats.motion_writer import write_motion_npz
from rtof_kin.protocols import validation
from rtof_kin.protocols.angle_tables import error_table, published_table, write_angle_tables
from rtof_kin.protocols.published_angles import PUBLISHED
from rtof_kin.protocols.validation import SETS, Validation, ValidationProtocol, compared_with
from rtof_kin.protocols.validation_tables import first_line
from rtof_kin.vision.detections import Detections


def silent(*arguments: str) -> tuple[int, str]:
    """Run a command; return its exit code and what it printed."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        code = main(list(arguments))
    return code, " ".join(text.getvalue().split())


# --- a take against its reference -----------------------------------------------------------------


def compared(root: Path, **planted: float) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The known motion, reconstructed without any error, against a reference with planted errors."""
    made.write_opencap(root, **planted)
    adapter = OpenCapValidation(root)
    (take,) = adapter.takes()
    return compared_with(clinical_angles(true_motion()), adapter.truth(take), take)


def test_a_planted_offset_and_a_planted_lag_come_out(tmp_path: Path) -> None:
    facts, arrays = compared(tmp_path, offset=-5.0, shift=0.31)
    clock = facts["clock"]
    assert clock["shift_s"] == pytest.approx(-0.31, abs=2e-3)
    assert clock["agreement"] > 0.99
    assert clock["how"] == "estimated within 1 s"
    differences = [
        AngleDifferences(name.removeprefix("difference "), "walk", "t", values)
        for name, values in arrays.items()
        if name.startswith("difference ")
    ]
    overall = error_rows(differences, MOVEMENTS)[0]
    for figure in (overall.rmse, overall.mae, overall.median, overall.offset):
        assert np.degrees(figure) == pytest.approx(5.0, abs=0.05)
    assert np.degrees(overall.offset_removed) < 0.3  # what the shift's error leaves
    assert facts["reference"] == "OpenSim inverse kinematics of optical markers"


def test_a_lag_that_is_not_found_is_in_doubt_in_the_first_line(tmp_path: Path) -> None:
    facts, _ = compared(tmp_path / "edge", shift=1.0)
    assert facts["clock"]["how"] == "estimated within 1 s, at the edge of what was searched"
    facts, _ = compared(tmp_path / "beyond", shift=1.6)
    assert facts["clock"]["shift_s"] == 0.0
    assert facts["clock"]["how"] == "as recorded: the movements hardly agree at any shift"
    found = Validation((), Outcome(Path(), {"a": facts}, {}))
    line = first_line(ValidationProtocol("opencap", Path()), found)
    assert "IN DOUBT: in 1 takes the movements hardly agree at any shift" in line
    assert line.endswith("another movement: a; leave them out by --takes.")


def test_without_a_common_angle_the_take_says_so(tmp_path: Path) -> None:
    made.write_opencap(tmp_path)
    adapter = OpenCapValidation(tmp_path)
    (take,) = adapter.takes()
    estimate = clinical_angles(true_motion()).select(["spine_flexion"])
    truth = adapter.truth(take)
    with pytest.raises(InvalidInputError, match="no angle is in the motion and the reference"):
        compared_with(estimate, truth, take)
    other = replace(truth, coordinates=("wrist_flex_r",))
    with pytest.raises(InvalidInputError, match="none of the measured coordinates, wrist_flex_r"):
        compared_with(estimate, other, take)


# --- tables ---------------------------------------------------------------------------------------


def test_published_values_stand_beside_the_same_metric() -> None:
    degrees = np.radians(np.array([1.0, 2.0, 3.0, 10.0]))
    rows = error_rows([AngleDifferences("left_knee_flexion", "walk", "t", degrees)], MOVEMENTS)
    table = published_table(rows)
    own = {(cells[0], cells[1]): cells[2] for cells in table.rows}
    assert own["knee flexion", "median absolute error"] == pytest.approx(2.5)
    assert own["all angles", "mean absolute error"] == pytest.approx(4.0)
    assert own["all angles", "RMSE"] == pytest.approx(np.sqrt(114 / 4))
    assert own["elbow flexion", "median absolute error"] is None  # not measured here
    assert {one.metric for one in PUBLISHED} == {"rmse", "mae", "median"}
    assert all("arXiv" in one.source or "not verified" in one.source for one in PUBLISHED)


def test_the_files_hold_the_same_numbers(tmp_path: Path) -> None:
    degrees = np.radians(np.array([1.0, 2.0, 3.0, 10.0]))
    found = AngleDifferences("left_knee_flexion", "walk", "t<1>", degrees, np.radians(np.full(4, 2.0)))
    rows = error_rows([found], MOVEMENTS)
    tables = (error_table(rows, "Joint angles <here>"), published_table(rows))
    write_angle_tables(tmp_path, rows, tables, "first & foremost", {})
    with (tmp_path / "angle_errors.csv").open(encoding="utf-8") as stream:
        (knee,) = [one for one in csv.DictReader(stream) if (one["angle"], one["movement"]) == ("knee_flexion", ALL)]
    assert float(knee["median_deg"]) == pytest.approx(2.5)
    assert float(knee["within_95_share"]) == 0.75  # 10 degrees are beyond 1.96 of 2
    content = read_json(tmp_path / "tables.json")
    assert content["rows"][0]["mae_deg"] == pytest.approx(4.0)
    assert content["first"] == "first & foremost"
    assert (tmp_path / "tables.md").read_text().startswith("first & foremost\n")
    page = (tmp_path / "angle_errors.html").read_text()
    assert "first &amp; foremost" in page
    assert "Joint angles &lt;here&gt;" in page
    assert "<svg" in page


def test_sensors_that_made_the_reference_are_said_first() -> None:
    facts = {"of_sensors": True, "kind": "walk", "clock": {"how": "as recorded"}}
    found = Validation((), Outcome(Path(), {"a": facts}, {}))
    line = first_line(ValidationProtocol("vidimu", Path(), mode="rtof"), found)
    assert "NOT ACCURACY" in line
    assert "use --mode rto" in line
    assert "NOT" not in first_line(ValidationProtocol("vidimu", Path()), found)


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial of OpenCap with detections, and another whose reference is missing."""
    root = tmp_path_factory.mktemp("sets")
    made.write_detections(root / "kp" / f"{made.write_opencap(root / 'opencap')}.npz")
    lost = root / "opencap" / "subject2" / "VideoData" / "Session1" / "Cam1" / "squats1"
    lost.mkdir()
    return root


@pytest.fixture(scope="module")
def measured(sets: Path) -> tuple[int, str, Path]:
    """What the command says of it, by the network alone, which is quick."""
    out = sets / "out"
    code, said = silent(
        "evaluate",
        "opencap",
        "--root",
        str(sets / "opencap"),
        "--keypoints",
        str(sets / "kp"),
        "--mode",
        "lift",
        "--workers",
        "1",
        "-o",
        str(out),
    )
    return code, said, out


def test_a_failed_take_is_counted_named_and_makes_the_exit_code(measured: tuple[int, str, Path]) -> None:
    code, said, out = measured
    assert code == 1
    first = (out / "tables.md").read_text().splitlines()[0]
    assert first.startswith("OpenCap's laboratory validation, mode lift: 1 of 2 takes measured, 1 FAILED")
    assert "subject2_Session1_Cam1_squats1:" in first
    assert "the inverse kinematics of the markers is missing" in first
    assert first[:60] in said


def test_errors_are_those_of_the_written_motion(measured: tuple[int, str, Path]) -> None:
    out = measured[2]
    content = read_json(out / "tables.json")
    (facts,) = content["takes"].values()
    angles = facts["methods"]["angles"]
    assert {"right_knee_flexion", "left_hip_flexion", "left_elbow_flexion"} <= set(angles)
    overall = next(one for one in content["rows"] if (one["angle"], one["movement"]) == (ALL, ALL))
    assert overall["samples"] == sum(angles.values())
    assert overall["takes"] == 1
    with (out / "angle_errors_by_take.csv").open(encoding="utf-8") as stream:
        own = {one["angle"]: one for one in csv.DictReader(stream)}
    assert {name: int(one["samples"]) for name, one in own.items()} == angles
    squares = sum(int(one["samples"]) * float(one["rmse_deg"]) ** 2 for one in own.values())
    assert overall["rmse_deg"] == pytest.approx(np.sqrt(squares / overall["samples"]))
    assert 2.0 < overall["rmse_deg"] < 30.0  # the shipped network on simulated detections
    assert overall["median_deg"] < overall["mae_deg"] < overall["rmse_deg"]
    motion = out / "takes" / "subject2_Session1_Cam1_walking1" / "motion.npz"
    mot = out.parent / "opencap" / "subject2" / "OpenSimData" / "Mocap" / "IK" / "walking1.mot"
    code, said = silent("evaluate", str(motion), "--truth", str(mot), "--movement", "walk", "-o", str(out / "own"))
    assert code == 0, said
    again = read_json(out / "own" / "tables.json")["rows"]
    for name in ("rmse_deg", "mae_deg", "median_deg", "offset_deg"):
        assert again[0][name] == pytest.approx(overall[name], rel=1e-6)


def test_it_goes_on_where_it_was_stopped(
    sets: Path, measured: tuple[int, str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran = []

    def measure(job: validation.ValidationJob) -> Any:
        ran.append(job.take.key)
        raise FileFormatError(job.folder, "still missing")

    monkeypatch.setattr(validation, "measure", measure)
    out = measured[2]
    before = (out / "angle_errors.csv").read_text()
    command = (
        "evaluate",
        "opencap",
        "--root",
        str(sets / "opencap"),
        "--keypoints",
        str(sets / "kp"),
        "--workers",
        "1",
        "-o",
        str(out),
    )
    assert silent(*command, "--mode", "lift")[0] == 1
    assert ran == ["subject2_Session1_Cam1_squats1"]  # the other one has its result
    assert (out / "angle_errors.csv").read_text() == before
    code, said = silent(*command, "--mode", "rto")
    assert code == 2
    assert "holds results of other settings (mode)" in said


def test_takes_are_listed_and_chosen(sets: Path) -> None:
    root = ("--root", str(sets / "opencap"))
    code, said = silent("evaluate", "opencap", *root, "--list")
    assert code == 0
    assert said == "subject2_Session1_Cam1_squats1 squat subject2_Session1_Cam1_walking1 walk"
    code, said = silent("evaluate", "opencap", *root, "--takes", "*_Cam7_*")
    assert code == 2
    assert "--takes *_Cam7_*: none of 2, such as subject2_Session1_Cam1_squats1" in said


def test_nothing_measured_is_an_error(sets: Path, tmp_path: Path) -> None:
    code, said = silent(
        "evaluate", "opencap", "--root", str(sets / "opencap"), "--workers", "1", "-o", str(tmp_path / "out")
    )
    assert code == 2
    assert "no take could be measured; first of all:" in said
    assert "there is no video and no detection of it" in said


def test_sensors_are_wanted_of_a_set_that_has_them(sets: Path, tmp_path: Path) -> None:
    code, said = silent(
        "evaluate",
        "opencap",
        "--root",
        str(sets / "opencap"),
        "--keypoints",
        str(sets / "kp"),
        "--mode",
        "rtof",
        "--takes",
        "*walking1",
        "--workers",
        "1",
        "-o",
        str(tmp_path / "out"),
    )
    assert code == 2
    assert "it has no sensors, which mode rtof needs; use --mode rto" in said


@pytest.mark.parametrize(
    "changes, error, message",
    [
        ({"dataset": "kit"}, UnknownNameError, "data set"),
        ({"seconds": 0.0}, InvalidInputError, "is no duration"),
        ({"keypoints": Path("nowhere")}, FileFormatError, "no such folder of detections"),
    ],
)
def test_wrong_settings_are_refused(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ValidationProtocol(**({"dataset": "opencap", "root": Path()} | changes))


def test_every_set_of_the_command_line_exists() -> None:
    code, said = silent("evaluate", "opencap", "--root", "/nowhere")
    assert code == 2
    assert "there is no such folder; give the one into which LabValidation_withVideos was unpacked" in said
    assert list(SETS) == ["opencap", "vidimu", "movi", "gaitex"]


def test_gaitex_recovers_the_planted_knees_from_orientations_alone(tmp_path: Path) -> None:
    made.write_gaitex(tmp_path / "set")
    code, said = silent(
        "evaluate", "gaitex", "--root", str(tmp_path / "set"), "--workers", "1", "-o", str(tmp_path / "out")
    )
    assert code == 0, said
    rows = {one["angle"]: one for one in read_json(tmp_path / "out" / "tables.json")["rows"]}
    assert rows["knee_flexion"]["rmse_deg"] < 3.0
    assert abs(rows["knee_flexion"]["offset_deg"]) < 1.5


def test_one_video_of_many_motions_is_detected_once_and_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, seen = tmp_path / "set", []
    made.write_movi(root, CENTRES)
    write_film(root / "film.mp4", [np.zeros((600, 800, 3), np.uint8)] * 4, [0, 33, 67, 100])
    (root / "film.mp4").rename(root / "F_PG1_Subject_1_L.avi")
    video = known().video
    before = np.arange(60) / 60  # of another motion, of a person who stands
    uv = made.MOVI_SCALE * np.concatenate([np.repeat(video.uv_px[:1], 60, axis=0), video.uv_px])
    times = np.concatenate([before, video.times + 1.0])

    def detect_video(path: Path, models: Path | None) -> Detections:
        seen.append(path.name)
        return Detections(uv[:, None], np.ones(uv.shape[:2])[:, None], times)

    monkeypatch.setattr(validation, "detect_video", detect_video)
    code, said = silent(
        "evaluate",
        "movi",
        "--root",
        str(root),
        "--takes",
        "*_PG1",
        "--mode",
        "lift",
        "--workers",
        "1",
        "-o",
        str(tmp_path / "out"),
    )
    assert seen == ["F_PG1_Subject_1_L.avi"]
    content = read_json(tmp_path / "out" / "tables.json")
    walk = content["takes"]["Subject_1_02_walking_PG1"]
    # The cut begins with the motion; the detector of the demo is 50 ms late.
    assert walk["clock"]["shift_s"] == pytest.approx(0.05, abs=0.025)
    assert walk["clock"]["agreement"] > 0.8
    assert code == 1  # the first motion has no joint centres
    assert list(content["failed"]) == ["Subject_1_01_kicking_PG1"]
    assert "1 of 2 takes measured, 1 FAILED" in said


# --- evaluate -------------------------------------------------------------------------------------


def test_evaluate_prints_the_table_of_angles_against_a_recording(tmp_path: Path) -> None:
    found = known()
    take = tmp_path / "take"
    recording = replace(
        found.recording, keypoints=found.video, imus=None, calibration=None, truth=found.poses, name="walk"
    )
    recording.save(take)
    motion = true_motion()
    write_motion_npz(tmp_path / "motion.npz", motion, mode="rto")
    code, said = silent(
        "evaluate", str(tmp_path / "motion.npz"), "--truth", str(take), "--angles", "-o", str(tmp_path / "out")
    )
    assert code == 0, said
    assert "Joint angles against the truth of walk:" in said
    rows = read_json(tmp_path / "out" / "tables.json")["rows"]
    assert max(one["rmse_deg"] for one in rows) < 1e-3
