"""Visits read from folders; a follow-up in words, as files and as a page."""

from __future__ import annotations

import csv
import json
import re
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from follow_support import visit_folders, walk_at
from report_support import Page, folder_of

from rtof_kin.clinical.follow_up import FollowUp, Outcome, follow_up
from rtof_kin.clinical.visits import Visit, trial
from rtof_kin.core.errors import FileFormatError, RtofError, UnknownNameError
from rtof_kin.reporting.audit_results import AuditResult
from rtof_kin.reporting.document import write_files
from rtof_kin.reporting.visit_folders import read_plan, read_visits
from rtof_kin.reporting.visits import document, reasoning, value_text

SPEEDS = {"2026-03-01": 1.4, "2026-01-10 <b>": 1.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return visit_folders(tmp_path_factory.mktemp("visits"), SPEEDS)


@pytest.fixture(scope="module")
def found(folder: Path) -> FollowUp:
    read = read_visits(folder)
    names = ["gait_speed", "gait_cadence", "stance_share_symmetry", "right_knee_flexion", "left_hip_flexion"]
    return follow_up(read.visits, better={"right_knee_flexion_range": "up"}, names=names)


def small(folder: Path, names: tuple[str, ...], **inputs: object) -> Path:
    """Visits of one short trial each."""
    for place, name in enumerate(names):
        folder_of(walk_at(1.0, place)[:90], folder / name / "out", inputs=inputs)
    return folder


# --- folders -------------------------------------------------------------------------------------


def test_visits_are_in_the_order_of_their_days(folder: Path) -> None:
    seen: list[tuple[int, int]] = []
    read = read_visits(folder, lambda done, total: seen.append((done, total)))
    assert [visit.name for visit in read.visits] == ["2026-01-10 <b>", "2026-03-01"]
    assert [visit.day for visit in read.visits] == [date(2026, 1, 10), date(2026, 3, 1)]
    assert [one.name for one in read.visits[0].trials] == ["walk0", "walk1"]
    assert seen == [(done, 4) for done in (1, 2, 3, 4)]
    assert read.visits[0].trials[0].setup.software == "rtof_kin 1.0"
    assert not read.notes


def test_days_of_sessions_order_visits_without_one_in_their_name(tmp_path: Path) -> None:
    for name, day in (("a", "2026-02-02"), ("b", "2026-01-01")):
        small(tmp_path, (name,), session={"date": day})
    assert [visit.name for visit in read_visits(tmp_path).visits] == ["b", "a"]


def test_without_days_the_order_is_that_of_names_and_said(tmp_path: Path) -> None:
    read = read_visits(small(tmp_path, ("visit 10", "visit 2")))
    assert [visit.name for visit in read.visits] == ["visit 2", "visit 10"]
    assert any("order of their names" in note for note in read.notes)


def test_a_plan_names_orders_and_declares(tmp_path: Path) -> None:
    small(tmp_path, ("x", "y", "z"))
    (tmp_path / "follow.toml").write_text(
        'baseline = "after"\nby = "range"\nmeasures = ["right_knee_flexion"]\n'
        '[[visit]]\nfolder = "z"\nname = "before"\ndate = 2026-02-01\n'
        '[[visit]]\nfolder = "x"\nname = "after"\ndate = "2026-01-01"\n'
        '[better]\nright_knee_flexion_range = "up"\n'
    )
    read = read_visits(tmp_path)
    assert [(visit.name, visit.day) for visit in read.visits] == [
        ("before", date(2026, 2, 1)),
        ("after", date(2026, 1, 1)),
    ]
    assert read.baseline == 1
    assert read.plan.better == {"right_knee_flexion_range": "up"}
    assert read.notes == ("Left out, as follow.toml does not list them: y",)


@pytest.mark.parametrize(
    "text, words",
    [
        ('by = "cycles"', "Did you mean 'cycle'"),
        ('[better]\ngait_speed = "more"', "not one of up, down, zero"),
        ("[bands]\nvisit = 0.5", "bands"),
        ('[[visit]]\nname = "a"', "folder: missing"),
        ('[[visit]]\nfolder = "a"\ndate = "1.2.2026"', "2026-01-31"),
        ('basline = "a"', "baseline"),
        ('measures = "gait_speed"', "not a list of names"),
    ],
)
def test_a_wrong_plan_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "follow.toml").write_text(text + "\n")
    with pytest.raises(RtofError, match=words.replace("[", r"\[")):
        read_plan(tmp_path)


def test_wrong_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such folder"):
        read_visits(tmp_path / "none")
    small(tmp_path, ("a",))
    with pytest.raises(FileFormatError, match=r"has 1 visit"):
        read_visits(tmp_path)
    with pytest.raises(FileFormatError, match="is one motion"):
        read_visits(tmp_path / "a" / "out")
    (tmp_path / "follow.toml").write_text('[[visit]]\nfolder = "a"\n[[visit]]\nfolder = "c"\n')
    with pytest.raises(FileFormatError, match="visit 'c' has no motion.h5; there are a"):
        read_visits(tmp_path)
    small(tmp_path, ("c",))
    (tmp_path / "follow.toml").write_text('baseline = "aa"\n')
    with pytest.raises(UnknownNameError, match="Did you mean 'a'"):
        read_visits(tmp_path)


def test_another_day_in_the_recording_is_noted(tmp_path: Path) -> None:
    small(tmp_path, ("2026-01-01", "2026-02-02"), session={"date": "2026-01-01"})
    assert read_visits(tmp_path).notes == ("2026-02-02 is of 2026-02-02, but its recordings say 2026-01-01",)


@pytest.mark.parametrize("size", [3.0, 0.5])
def test_a_failed_audit_is_the_first_line_and_a_plausible_one_is_not(tmp_path: Path, size: float) -> None:
    audit = AuditResult("inputs", "size", "camera", size, "", 1.0, 2.0, note="wrong focal length")
    lone = AuditResult.not_checked("certificate", "motion", "add a sensor")
    visit_folders(tmp_path, {"2026-01-01": 1.0})
    for place in (2, 3):
        folder_of(
            walk_at(1.0, place),
            tmp_path / "2026-02-02" / f"w{place}",
            audit=[audit.plain(), lone.plain()],
            inputs={"software": "rtof_kin 1.0"},
        )
    first = document(follow_up(read_visits(tmp_path).visits)).headline
    failed = "The visits may not be comparable: 2026-02-02: the audit of w2, w3 failed (wrong"
    assert first.startswith(failed) == (size > 2.0)
    assert ("audit" in first) == (size > 2.0)


# --- words ---------------------------------------------------------------------------------------


def test_the_first_lines_say_what_changed(found: FollowUp) -> None:
    said = document(found)
    first, second = said.headline, *said.sentences
    assert first.startswith("2 visits with their trials: 2026-01-10 <b> (2), 2026-03-01 (2)")
    assert "measured over gait cycles, as all visits are walking" in first
    assert second.startswith("2026-03-01: ")
    assert "measures changed (5 % for all measures and visits together)" in second
    assert any("one day to the next" in line for line in said.cautions)


def test_every_outcome_has_its_reason(found: FollowUp) -> None:
    outcomes = {one.outcome(1) for one in found.measures}
    assert {Outcome.CHANGED, Outcome.NOT_SHOWN} <= outcomes
    for one in found.measures:
        text, change = reasoning(one, 1), one.changes[1]
        assert change is not None
        assert text.startswith(f"{value_text(one.measure, change.difference, True)} {one.measure.unit}")
        expected = {
            Outcome.NOT_SHOWN: "smallest change that could be shown among all measures: ",
            Outcome.CHANGED: "no direction is known or declared to be better",
            Outcome.IMPROVED: " is better",
            Outcome.WORSE: " is better",
            Outcome.NOT_TESTED: "not tested: nothing states its error",
        }[one.outcome(1)]
        assert expected in text


def test_a_known_person_lowers_the_detectable_change_in_words(tmp_path: Path) -> None:
    def lines(*digests: str) -> str:
        folder = tmp_path / "".join(digests)
        for number, digest in enumerate(digests):
            run = {"person": {"subject": "P07", "constants_sha256": digest}}
            fields = {"inputs": {"software": "rtof_kin 1.0"}, "run": run}
            folder_of(walk_at(1.0, number), folder / f"2026-01-1{number}" / "out", **fields)
        shown = document(follow_up(read_visits(folder).visits))
        rows = [row for row in shown.facts["rows"] if row["measure"] == "right_knee_flexion_mean"]
        assert (rows[1]["detectable_independent"] is None) == (len({*digests}) > 1)
        return " ".join([shown.headline, *shown.sentences, *map(str, shown.printed)])

    same = lines("3f2a", "3f2a")
    found = re.search(
        r"Smallest detectable change ([\d.]+) deg .*? of independent recordings it would be ([\d.]+) deg", same
    )
    assert found is not None
    assert 0.7 <= float(found[1]) / float(found[2]) < 1
    other = lines("3f2a", "77d0")
    assert "independent" not in other
    assert "reconstruct all of them with the file as it is now" in other


def test_single_trials_and_missing_bands_are_cautions() -> None:
    visits = [Visit(name, (trial("t", walk_at(1.0, place, certain=False)),)) for place, name in enumerate("ab")]
    single = follow_up(visits, names=["gait_speed", "right_knee_flexion_range"])
    lines = " ".join(document(single).cautions)
    assert "Each visit has one trial" in lines
    assert "Not known how all trials of a, b were recorded" in lines
    assert "The motions have no bands" in lines
    assert reasoning(single.measures[-1], 1).endswith("record each walk two times or more.")
    whole = follow_up(visits, by="range", names=["right_knee_flexion_range"])
    assert "Nothing is repeated" in " ".join(document(whole).cautions)
    assert document(whole).sentences[-1].startswith("b: nothing is tested (nothing states its error")


# --- files ---------------------------------------------------------------------------------------


def test_files_have_all_numbers(found: FollowUp, tmp_path: Path) -> None:
    write_files(document(found, ["a note"]), tmp_path)
    with (tmp_path / "follow.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    data = json.loads((tmp_path / "follow.json").read_text("utf-8"))
    assert len(rows) == 2 * len(found.measures) == len(data["rows"])
    assert data["cautions"][0] == "a note"
    assert data["comparable"] is True
    speed = next(row for row in rows if row["measure"] == "gait_speed" and row["visit"] == "2026-03-01")
    own = next(one for one in found.measures if one.measure.name == "gait_speed")
    assert float(speed["value"]) == pytest.approx(own.estimates[1], rel=1e-5)
    assert float(speed["sem_both"]) == pytest.approx(own.errors.both.sigma, rel=1e-5)
    knee = next(row for row in rows if row["measure"] == "right_knee_flexion_range")
    angle = next(one for one in found.measures if one.measure.name == "right_knee_flexion_range")
    assert float(knee["value"]) == pytest.approx(np.degrees(angle.estimates[0]), rel=1e-5)
    assert (knee["unit"], knee["better"], knee["change"]) == ("deg", "up", "")


def test_the_page_is_well_formed_and_loads_nothing(found: FollowUp, tmp_path: Path) -> None:
    write_files(document(found), tmp_path)
    html = (tmp_path / "follow.html").read_text("utf-8")
    page = Page(html)
    assert page.wrong == []
    sources = [value for _, name, value in page.attributes if name in ("src", "href")]
    assert sources
    assert all(value.startswith("data:image/png;base64,") for value in sources)
    assert "&lt;b&gt;" in html
    assert "2026-01-10 <b>" not in html
    assert "Changes from 2026-01-10" in page.text["changes"]
    assert "SEM, bands" in page.text["errors"]
    assert {path.name for path in (tmp_path / "figures").iterdir()} >= {"changed.png", "gait.png", "range.png"}


def test_plain_data_say_what_each_error_contains(found: FollowUp) -> None:
    texts = document(found).plain()["definitions"]
    assert list(texts) == ["SEM, bands", "SEM, repeats", "SEM, both", "MDC95"]
