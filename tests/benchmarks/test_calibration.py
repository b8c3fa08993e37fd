"""The study of planted errors: `SelfCalibration.apply` undoes planting, rows and tables add up."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import planted as synthetic
import pytest
from numpy.typing import NDArray

from benchmarks.calibration import excerpt_length, optimum, planted_figure, planted_rows, planted_tables, planting
from benchmarks.calibration.planted_rows import ALL, BUT, GOOD, KNOWN, PLAIN, Job, Row
from benchmarks.calibration.planting import ERRORS, Wrong
from lifting.predict import Lifter
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
SIZES = {name: error.size for name, error in ERRORS.items()}


@cache
def recording() -> Recording:
    body = SkeletonModel.default()
    return synthetic.recording(synthetic.human(body, 60), sigma_px=0.0, degrees=0.0)


def calibration(wrong: Wrong) -> SelfCalibration:
    """What a perfect calibration finds."""
    known = planting.unknowns(recording(), wrong)
    quantities = []
    for (kind, item), value in known.items():
        if (kind, item) != ("bones", "all"):
            ones = np.ones(len(value))
            quantities.append(Quantity(kind, item, value, ones, ones, 1.0))
    return SelfCalibration(tuple(quantities))


@pytest.mark.parametrize("chosen", [*((name,) for name in ERRORS), tuple(ERRORS)])
def test_the_true_calibration_removes_planted_errors(chosen: tuple[str, ...]) -> None:
    right = recording()
    wrong = planting.drawn(right, {name: SIZES[name] for name in chosen}, seed=3)
    wrong_recording = planting.planted(right, wrong)
    found = calibration(wrong)
    back = found.apply(wrong_recording)
    seen = back.video
    np.testing.assert_allclose(seen.times, right.video.times, atol=1e-9)
    np.testing.assert_allclose(seen.uv_px, right.video.uv_px, atol=1e-6)
    np.testing.assert_allclose(back.joint_offsets, right.joint_offsets, atol=1e-12)
    assert right.imus is not None
    ours, theirs = back.bone_imus(times=seen.times), right.bone_imus(times=right.video.times)
    assert ours is not None
    assert theirs is not None
    known = np.isfinite(ours.R_world_bone + theirs.R_world_bone).all(axis=(1, 2, 3))
    assert known.mean() > 0.9
    np.testing.assert_allclose(ours.R_world_bone[known], theirs.R_world_bone[known], atol=1e-4)


@pytest.mark.parametrize("name", list(ERRORS))
def test_an_error_changes_the_recording(name: str) -> None:
    right = recording()
    wrong_recording = planting.planted(right, planting.drawn(right, {name: SIZES[name]}, seed=1))
    parts = ("uv_px", "times")
    same = all(np.array_equal(getattr(wrong_recording.video, p), getattr(right.video, p)) for p in parts)
    same &= np.array_equal(wrong_recording.joint_offsets, right.joint_offsets)
    ours, theirs = wrong_recording.bone_imus(times=right.video.times), right.bone_imus()
    assert ours is not None
    assert theirs is not None
    same &= np.allclose(ours.R_world_bone, theirs.R_world_bone, atol=1e-7)
    assert not same


# --- rows and tables -----------------------------------------------------------------------------


def test_estimates_are_listed_beside_planted_values() -> None:
    right = recording()
    known = planted_rows.truths(right, planting.drawn(right, {"delay": 0.033}, seed=0))
    ones = np.ones(1)
    calibration = SelfCalibration((Quantity("delay", "video", 0.03 * ones, ones, ones, 0.99),))
    columns = planted_rows.found(calibration, known)
    assert columns["delay"]["truth"] == [0.033]
    assert columns["delay"]["value"] == [0.03]
    assert columns["delay"]["verdict"] == ["observed"]


def row(case: str, after: float = 20.0, **more: object) -> Row:
    """A row in which ten headings of 10 degrees were found to 1 degree, and said to be so."""
    sizes = {
        name: np.radians([value] * 10).tolist()
        for name, value in {"truth": 10.0, "value": 11.0, "sigma": 0.75, "prior": 10.0}.items()
    }
    heading = {"item": ["LeftArm"] * 10, "verdict": ["observed"] * 10, **sizes}
    calibrated = {"after": dict.fromkeys(planted_rows.FIGURES, after), "found": {"heading": heading}, "converged": True}
    job = Job("planted", "walking", case)
    before = dict.fromkeys(planted_rows.FIGURES, 10.0 if case == KNOWN else 40.0)
    return {**vars(job), "frames": 100, "before": before, **({} if case == KNOWN else calibrated), **more}


def test_tables_have_planted_remaining_and_claimed_errors() -> None:
    rows = planted_tables.with_known([row(KNOWN), row("heading"), row(ALL)])
    assert len(rows) == 2
    line = planted_tables.alone(rows).splitlines()[2]
    assert line == "| heading | x1 | - | deg | 10 | 1 | 0.75 | 0 / 100 | 100 / 0 / 0 / 0 | 10 |"
    assert "40.0 / 20.0 / 10.0" in planted_tables.motion(rows)
    assert "| observed | 20 | 0 | 100 | 100 |" in planted_tables.coverage(rows)


def test_the_report_and_its_figure_are_written(tmp_path: Path) -> None:
    rows = [row(KNOWN), row(PLAIN), row(ALL), row("heading"), row(GOOD, study="harm")]
    rows += [row(BUT + "size", 15.0, study="measured")]
    rows += [row(KNOWN, floor=True), row(ALL, floor=True)]
    text = planted_tables.report(rows)
    assert text.count("###") == 7
    lines = text.split("### ")[2].splitlines()[4:]
    assert [line.split(" | ")[0] for line in lines if line] == ["| nothing", "| size"]
    planted_figure.write_figure(tmp_path / "planted.png", rows)
    assert (tmp_path / "planted.png").stat().st_size > 10_000


def test_a_calibration_from_nothing_and_one_from_the_truth_are_compared() -> None:
    right, job = recording(), Job("", "synthetic", "image bias")
    wrong = planting.drawn(right, {"image bias": 6.0}, seed=3)
    known = planting.unknowns(right, wrong)
    row = optimum.row(planting.planted(right, wrong), known, job, Lifter.load(None))
    assert row["unknowns"] == 1 + 24 + 42
    assert row["energies"]["found"] < row["energies"]["truth"]
    assert set(row["apart"]["found - truth"]) == {"delay", "mounting", "image bias"}
    assert 0 < row["apart"]["from truth - found"]["image bias"] < 0.3
    line = optimum.report([row]).splitlines()[-1]
    assert line.startswith("| synthetic, camera 0 | ")
    assert line.count(" / ") == 2 + 3


def of_setting(setting: float | None, camera: int, rr: float) -> Row:
    """A row of `excerpt_length`: the heading is found to 1 degree of 10, and 0.75 is claimed."""
    about = {"session": "walking", "camera": camera, "seconds": 20.0, "case": "all", "setting": setting}
    figures = dict.fromkeys(planted_rows.FIGURES, rr)
    found = {} if setting is None else {"found": row("heading")["found"], "cpu_s": setting / 2}
    return {**about, **figures, **found}


def test_settings_are_compared_on_the_same_recordings() -> None:
    rows = [of_setting(s, c, 10.0 * c + (30.0 if s is None else 60 / s)) for c in (1, 2) for s in (None, 10.0, 30.0)]
    rows += [of_setting(60.0, 2, 20.0)]  # of the other, 30 s were all
    lines = excerpt_length.report(rows).splitlines()
    assert lines[0] == "2 recordings of 20 s:"
    assert lines[4].startswith("| not calibrated | 45.00 / 45.0, 45.00 | +29.00 ± 1.00, ")
    assert lines[5].startswith("| 10 | 21.00 / 21.0, 21.00 | ")
    assert " +5.00 ± 1.00, +5.00 ± 1.00, +5.00 ± 1.00 | 2 / 2 / 2 | 5.0 |" in lines[5]
    assert lines[7] == "| 60 | 16.00 / 16.0, 16.00 |  |  | 22.5 |"
    same = "0.10 (+0.00 ± 0.00); 1.00 (+0.00 ± 0.00)"
    assert lines[-1] == f"| heading | 2 | {same} | {same} | 0.10; 1.00 |"
