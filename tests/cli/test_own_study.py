"""A study of one's own: planted people, raters and sessions beside planted references."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import walking
from public_sets import write_mot
from report_support import Page

from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical import agreement
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core.errors import FileFormatError, MissingPackageError
from rtof_kin.datasets.public_sets import kind_of
from rtof_kin.protocols import own_study

COLUMNS = {
    "knee_angle_r": "right_knee_flexion",
    "knee_angle_l": "left_knee_flexion",
    "hip_flexion_r": "right_hip_flexion",
}
OFFSET, SCALE = 4.0, 1.1
"""Of the estimate against the reference: deg, and of the range of motion."""


@cache
def motion(person: int, session: int, rater: int) -> Motion:
    """Walking of a person, with differences between sessions and, larger ones, between raters."""
    rng = np.random.default_rng([person, session, rater])
    return walking(4.0, speed=0.9 + 0.1 * person + 0.04 * rater + 0.01 * rng.standard_normal(), stride_time=1.15)


def study(folder: Path, people: int = 6, sessions: int = 2, raters: int = 2) -> Path:
    rows = []
    for person, session, rater in np.ndindex(people, sessions, raters):
        place = f"P{person}/{session}/{'AB'[rater]}"
        (folder / place).mkdir(parents=True)
        own = motion(person, session, rater)
        write_motion(folder / place / "motion.h5", own, mode="rtof")
        angles = clinical_angles(own)
        columns = {name: (np.degrees(angles[angle]) - OFFSET) / SCALE for name, angle in COLUMNS.items()}
        write_mot(folder / place / "reference.mot", columns, own.times)
        rows.append((f"P{person}", session, "AB"[rater], "walk", place, f"{place}/reference.mot"))
    with (folder / "trials.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([own_study.COLUMNS, *rows])
    return folder


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six people; the motion of one trial is lost, and one trial has no reference."""
    folder = study(tmp_path_factory.mktemp("study"))
    (folder / "P2" / "1" / "B" / "motion.h5").unlink()
    table = (folder / "trials.csv").read_text()
    (folder / "trials.csv").write_text(table.replace("P5/1/B/reference.mot", ""))
    return folder


@pytest.fixture(scope="module")
def out(six: Path) -> Path:
    """What the command makes of them."""
    from rtof_kin.cli import main

    assert main(["evaluate", "validation", str(six), "-o", str(six / "out")]) == 1  # a trial failed
    return six / "out"


def records(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def shrout_fleiss(values: np.ndarray) -> tuple[float, float, float]:
    """ICC(2,1), ICC(3,1) and the root of the error mean square of (n, k), from the mean squares."""
    n, k = values.shape
    people, raters, mean = values.mean(axis=1), values.mean(axis=0), values.mean()
    rows, columns = k * np.sum((people - mean) ** 2) / (n - 1), n * np.sum((raters - mean) ** 2) / (k - 1)
    error = np.sum((values - people[:, None] - raters + mean) ** 2) / ((n - 1) * (k - 1))
    absolute = (rows - error) / (rows + (k - 1) * error + k * (columns - error) / n)
    return float(absolute), float((rows - error) / (rows + (k - 1) * error)), float(np.sqrt(error))


def test_one_command_makes_the_whole(out: Path) -> None:
    first = (out / "tables.md").read_text().splitlines()[0]
    assert first.startswith("Validation of 6 people, 2 sessions, 2 raters: 23 of 24 trials measured, 1 FAILED and are")
    assert "P2 session 1 rater B walk: " in first
    assert "without a reference, and in no error: 1" in first
    rows = {(one["angle"], one["movement"]): one for one in records(out / "angle_errors.csv")}
    knee = {name: float(rows["knee_flexion", "all"][name] or "nan") for name in list(rows["knee_flexion", "all"])[2:]}
    ours, theirs = np.array([
        [np.ptp(own), np.ptp(own) / SCALE]
        for p, s, r in np.ndindex(6, 2, 2)
        if (p, s, r) not in ((2, 1, 1), (5, 1, 1))
        for own in [np.degrees(clinical_angles(motion(p, s, r))[f"{side}_knee_flexion"]) for side in ("right", "left")]
    ]).T  # fmt: skip
    assert knee["takes"] == 22
    assert knee["range_error_deg"] == pytest.approx(np.mean(ours - theirs), abs=0.2)
    assert knee["range_bias_deg"] == pytest.approx(np.mean(ours - theirs), abs=0.2)
    assert knee["range_limit_low_deg"] < knee["range_bias_deg"] < knee["range_limit_high_deg"]
    assert knee["nrmse_share"] == pytest.approx(knee["rmse_deg"] / theirs.mean(), rel=0.05)
    assert 0.9 < knee["cmc"] < 1
    page = Page((out / "tables.html").read_text())
    assert not page.wrong
    text = " ".join(page.text["methods"].split())
    assert "6 people, 2 sessions, 2 raters took part (trials: walk); 23 of 24 trials could be analysed" in text
    assert "OpenSim coordinates (22 trials)" in text
    assert "ICC(2,1), absolute agreement, between raters in session 0" in text
    assert "left_hip_flexion".replace("_", " ") not in " ".join(page.text["cautions"].split())
    assert {path.name for path in (out / "figures").iterdir()} == {"angle_errors.png", "agreement.png"}


def test_reliability_is_that_of_the_ranges_of_motion(out: Path) -> None:
    (row,) = [one for one in records(out / "reliability.csv") if one["angle"] == "right hip flexion"]

    def ranges(*trials: tuple[int, int, int]) -> list[float]:
        found = [{own.name: own for own in ranges_of_motion(clinical_angles(motion(*one)))} for one in trials]
        return [float(np.degrees(own["right_hip_flexion"].range)) for own in found]

    raters = np.array([ranges((p, 0, 0), (p, 0, 1)) for p in range(6)])
    sessions = np.array([ranges((p, 0, 0), (p, 1, 0)) for p in range(6)])
    assert float(row["ICC(2,1)"]) == pytest.approx(shrout_fleiss(raters)[0], abs=1e-3)
    assert float(row["ICC(3,1)"]) == pytest.approx(shrout_fleiss(sessions)[1], abs=1e-3)
    assert float(row["SEM [deg]"]) == pytest.approx(shrout_fleiss(sessions)[2], rel=1e-2)
    assert float(row["MDC [deg]"]) == pytest.approx(2.77 * float(row["SEM [deg]"]), rel=1e-3)
    assert shrout_fleiss(sessions)[1] - shrout_fleiss(raters)[0] > 0.01  # the planted difference of raters


def test_what_cannot_be_computed_is_not_shown_and_said(tmp_path: Path) -> None:
    folder = study(tmp_path / "one", people=1, sessions=1)
    table = (folder / "trials.csv").read_text()
    (folder / "trials.csv").write_text(table.replace("P0/0/B/reference.mot", "P0/0/B"))  # another result: the same
    same = [one for one in own_study.measure(folder).differences if "rater B" in one.take]
    assert {"right_hip_flexion", "left_ankle_dorsiflexion"} <= {one.angle for one in same}
    assert max(float(np.abs(one.difference).max()) for one in same) < 1e-9
    (folder / "trials.csv").write_text(table)
    found = own_study.report(own_study.measure(folder))
    cautions = "; ".join(found.cautions)
    assert "limits of agreement are not shown" in cautions
    assert "for some angles: ICC(2,1): 1 people with all 2; 5 are needed" in cautions
    assert "for some angles: ICC(3,1): no second one" in cautions
    assert found.plain()["rows"][0]["limit_low_deg"] is None
    (folder / "trials.csv").write_text(table + table.splitlines()[1])
    with pytest.raises(FileFormatError, match="P0 session 0 rater A walk occurs twice"):
        own_study.read_index(folder)


def test_a_missing_package_and_a_missing_side_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = tuple(own_study.Trial(f"P{p}", s, "A", "squat", Path(), None) for p in range(6) for s in "12")
    ranges = {(one, "left_knee_flexion"): 1.0 + 0.1 * k for k, one in enumerate(trials[:-1])}
    planted = own_study.Study(trials[:-1], ranges=ranges)
    found = own_study.report(planted)
    assert "; 1 combinations of person, session, rater and trial are not in trials.csv" in found.headline
    assert "one side alone was measured: left knee flexion" in found.cautions
    assert [row[6] for row in found.tables["reliability.csv"].rows] == [5]  # one has no second session

    def absent(name: str, *_: str) -> Any:
        raise MissingPackageError(f"an intraclass correlation needs {name}")

    monkeypatch.setattr(agreement, "optional", absent)
    found = own_study.report(planted)
    assert "reliability is left out: an intraclass correlation needs pingouin" in found.cautions
    assert "reliability.csv" not in found.tables


def test_the_protocol_is_printed_with_an_index_of_its_trials(cli: Any, tmp_path: Path) -> None:
    cli.ok("evaluate", "validation", tmp_path / "new", "--template")
    trials = own_study.read_index(tmp_path / "new")
    assert len(trials) == 10 * 2 * 2 * 5
    assert trials[0].reference == tmp_path / "new" / "P01/1/A/walk_slow/reference.mot"
    assert {kind_of(one.trial, own_study._KINDS) for one in trials} == {"walk", "squat", "sit-to-stand"}
    text = (tmp_path / "new" / "protocol.html").read_text()
    assert "Two raters, A and B" in text
    assert not Page(text).wrong
    assert text.count("&#9744;") == len(trials)
    assert "trials.csv" in cli.refused("evaluate", "validation", tmp_path / "new", "--template").err
    assert "no trial could be measured" in cli.refused("evaluate", "validation", tmp_path / "new").err
