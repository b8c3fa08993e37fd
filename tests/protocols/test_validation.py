"""Validation of angles on small made sets: planted errors, failing takes, resuming."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import public_sets as made
import pytest
from overlay_support import write_film
from protocol_support import read_json
from public_sets import known, true_motion

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_errors import ALL, AngleDifferences, error_rows
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, UnknownNameError
from rtof_kin.core.jobs import Outcome
from rtof_kin.datasets.marker_sets import CENTRES, OpenCapValidation
from rtof_kin.datasets.public_sets import MOVEMENTS
from rtof_kin.protocols import Measured, run, validation
from rtof_kin.protocols.angles import against_opensim, against_recording
from rtof_kin.protocols.tables import write_results
from rtof_kin.protocols.validation import ValidationProtocol, compared_with, first_line
from rtof_kin.vision.detections import Detections

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
    line = first_line(ValidationProtocol(Path(), "opencap"), Outcome(Path(), {"a": facts}, {}))
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


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial of OpenCap with detections, and another whose reference is missing."""
    root = tmp_path_factory.mktemp("sets")
    made.write_detections(root / "kp" / f"{made.write_opencap(root / 'opencap')}.npz")
    lost = root / "opencap" / "subject2" / "VideoData" / "Session1" / "Cam1" / "squats1"
    lost.mkdir()
    return root


def validate(sets: Path, out: Path, **settings: Any) -> Measured:
    """Measure the trials by the network alone, which is quick."""
    settings = {"keypoints": sets / "kp", "mode": "lift"} | settings
    return run("opencap", sets / "opencap", out, workers=1, **settings)


@pytest.fixture(scope="module")
def measured(sets: Path) -> Path:
    assert list(validate(sets, sets / "out").outcome.failed) == ["subject2_Session1_Cam1_squats1"]
    return sets / "out"


def test_a_failed_take_is_counted_and_named(measured: Path) -> None:
    first = (measured / "tables.md").read_text().splitlines()[0]
    assert first.startswith("OpenCap's laboratory validation, mode lift: 1 of 2 takes measured, 1 FAILED")
    assert "subject2_Session1_Cam1_squats1:" in first
    assert "the inverse kinematics of the markers is missing" in first


def test_errors_are_those_of_the_written_motion(measured: Path) -> None:
    out = measured
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
    motion = out / "takes" / "subject2_Session1_Cam1_walking1" / "motion.h5"
    mot = out.parent / "opencap" / "subject2" / "OpenSimData" / "Mocap" / "IK" / "walking1.mot"
    write_results(against_opensim(Motion.load(motion), mot, "walk"), out / "own")
    again = read_json(out / "own" / "tables.json")["rows"]
    for name in ("rmse_deg", "mae_deg", "median_deg", "offset_deg"):
        assert again[0][name] == pytest.approx(overall[name], rel=1e-5)


def test_it_goes_on_where_it_was_stopped(sets: Path, measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []

    def measure(job: validation.ValidationJob) -> Any:
        ran.append(job.take.key)
        raise FileFormatError(job.folder, "still missing")

    monkeypatch.setattr(validation, "measure", measure)
    out = measured
    before = (out / "angle_errors.csv").read_text()
    validate(sets, out)
    assert ran == ["subject2_Session1_Cam1_squats1"]  # the other one has its result
    assert (out / "angle_errors.csv").read_text() == before
    with pytest.raises(OutputExistsError, match=r"holds results of other settings \(mode\)"):
        validate(sets, out, mode="rto")


def test_takes_are_listed_and_chosen(sets: Path) -> None:
    takes = ValidationProtocol(sets / "opencap", "opencap").chosen
    assert [(take.key, take.kind) for take in takes] == [
        ("subject2_Session1_Cam1_squats1", "squat"),
        ("subject2_Session1_Cam1_walking1", "walk"),
    ]
    with pytest.raises(InvalidInputError, match=r"--takes \*_Cam7_\*: none of 2, such as subject2_Session1_Cam1_sq"):
        validate(sets, sets / "none", takes=("*_Cam7_*",))


def test_nothing_measured_is_a_problem(sets: Path, tmp_path: Path) -> None:
    problem = validate(sets, tmp_path / "a", keypoints=None, mode=None, takes=("*walking1",)).problem
    assert problem.startswith("nothing could be measured; first of all:")
    assert "there is no video and no detection of it" in problem
    problem = validate(sets, tmp_path / "b", mode="rtof", takes=("*walking1",)).problem
    assert "it has no sensors, which mode rtof needs; use --mode rto" in problem


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
        ValidationProtocol(**({"root": Path(), "dataset": "opencap"} | changes))


def test_gaitex_recovers_the_planted_knees_from_orientations_alone(tmp_path: Path) -> None:
    made.write_gaitex(tmp_path / "set")
    assert run("gaitex", tmp_path / "set", tmp_path / "out", workers=1).outcome.failed == {}
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
    found = run("movi", root, tmp_path / "out", workers=1, takes=("*_PG1",), mode="lift")
    assert seen == ["F_PG1_Subject_1_L.avi"]
    content = read_json(tmp_path / "out" / "tables.json")
    walk = content["takes"]["Subject_1_02_walking_PG1"]
    # The cut begins with the motion; the detector of the demo is 50 ms late.
    assert walk["clock"]["shift_s"] == pytest.approx(0.05, abs=0.025)
    assert walk["clock"]["agreement"] > 0.8
    assert list(content["failed"]) == ["Subject_1_01_kicking_PG1"]  # which has no joint centres
    assert "1 of 2 takes measured, 1 FAILED" in found.document.headline


# --- evaluate -------------------------------------------------------------------------------------


def test_angles_of_a_perfect_motion_are_those_of_the_truth() -> None:
    found = known()
    recording = replace(found.recording, keypoints=found.video, imus=None, calibration=None, truth=found.poses)
    document = against_recording(true_motion(), replace(recording, name="walk"))
    assert document.headline.startswith("Joint angles against the truth of walk: ")
    assert max(one["rmse_deg"] for one in document.facts["rows"]) < 1e-3
