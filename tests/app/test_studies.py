"""Notes, archives, comparisons, plans and other formats, by finished folders of planted walking."""

from __future__ import annotations

import csv
import io
import shutil
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import openpyxl
import pypdf
import pytest
from app_support import Server, Window
from browser_support import needs_browser
from follow_support import walk_at
from report_support import folder_of

from rtof_kin.app import studies
from rtof_kin.app import take as downloads
from rtof_kin.app.people import write_archive
from rtof_kin.app.store import NOTES, SUBJECT, State, Store
from rtof_kin.app.texts import worded
from rtof_kin.core.errors import RtofError
from rtof_kin.formats.opensim import read_opensim_table
from rtof_kin.plan.document import write_plan
from rtof_kin.plan.plan import Plan
from rtof_kin.plan.prediction import Prediction
from rtof_kin.plan.protocol import Protocol
from rtof_kin.plan.setup import Setup, setup_of
from rtof_kin.reporting.document import Document, Section
from rtof_kin.reporting.page import report


def until(holds: Callable[[], bool], said: str) -> None:
    deadline = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < deadline, said
        time.sleep(0.05)


DAYS = ("2026-01-31", "2026-03-02")
NAMES = ("right_hip_flexion", "right_knee_flexion")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Workspace with a person of two visits, with a recording of walking each."""
    store = Store(tmp_path_factory.mktemp("finished") / "workspace")
    store.add_person("P07", 1.73)
    for number, day in enumerate(DAYS):
        store.add_visit("P07", day)
        take = store.add_take("P07", day, "walk")
        folder_of(walk_at(1.0 + 0.3 * number, number), take / "motion", inputs={"subject": {"height_m": 1.73}})
        (take / "report.html").write_text(report(take / "motion"))
        store.change(take, state=(State.DONE, State.ATTENTION)[number])
    return store.root


@pytest.fixture
def store(finished: Path, tmp_path: Path) -> Store:
    return Store(shutil.copytree(finished, tmp_path / "workspace"))


@pytest.fixture
def take(store: Store) -> Path:
    return store.path("P07", DAYS[0], "walk")


def planned(protocol: Protocol, setup: Setup) -> Plan:
    sigma = np.radians([9.0, 4.0])
    found = Prediction(NAMES, sigma, 0.9 * sigma, np.full(2, 0.95), np.ones(2), 2)
    return Plan(protocol, setup, found, NAMES, (), (), (), None, 1.0)


def test_a_plan_is_of_the_person_and_its_page_says_what_to_expect(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def plan(protocol: Protocol, setup: Setup, **how: Any) -> Plan:
        assert setup.skeleton.height == pytest.approx(1.73)
        assert how == {"search": False, "workers": 1}
        return planned(protocol, setup)

    monkeypatch.setattr(studies, "plan", plan)
    subject = store.path("P07") / SUBJECT
    studies.make_plan(Protocol("squat", sensors=("Pelvis",)), subject, False, tmp_path / "plan")
    page = (tmp_path / "plan/plan.html").read_text()
    assert "Expected standard deviation: 6.5 deg" in page
    assert "right knee flexion" in page
    assert "P07" in (tmp_path / "plan/instructions.html").read_text()


def test_visits_are_those_of_the_persons_folder(take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def follow(visits: Path, baseline: str) -> Document:
        assert (visits, baseline) == (take.parent.parent, DAYS[1])
        return Document("follow", "Follow-up", "Nothing has changed.", sections=[Section("all", "All", ["Nothing."])])

    monkeypatch.setattr(studies, "follow", follow)
    studies.compare_visits(take.parent.parent, DAYS[1], tmp_path / "made")
    assert "Nothing has changed." in (tmp_path / "made/follow.html").read_text()


def test_a_message_has_no_options_of_the_command_line() -> None:
    said = "compare: left has no gait cycle; compare by another axis (--by)"
    assert worded(said) == "left has no gait cycle; compare by another axis"


def test_a_workbook_has_the_same_numbers_as_the_tables(take: Path, tmp_path: Path) -> None:
    downloads.write_xlsx(take, tmp_path / "walk.xlsx")
    downloads.write_files((), take, tmp_path / "walk_csv.zip")
    book = openpyxl.load_workbook(tmp_path / "walk.xlsx")
    assert {"information", "gait", "angles", "range of motion"} <= {*book.sheetnames}
    facts = {row[0].value: row[1].value for row in book["information"].iter_rows()}
    assert facts["Body"] == "1.73 m, weight not given"
    assert {"Who", "How good", "Careful", "sign"} <= facts.keys()
    with zipfile.ZipFile(tmp_path / "walk_csv.zip") as archive:
        rows = list(csv.reader(io.TextIOWrapper(archive.open("angles.csv"), encoding="utf-8")))
    columns, *cells = [[cell.value for cell in row] for row in book["angles"].iter_rows()]
    assert columns == rows[0]
    assert {"right_knee_flexion_deg", "right_knee_flexion_sigma_deg"} <= {*columns}
    np.testing.assert_allclose(
        np.array(cells, dtype=float), [[float(cell or "nan") for cell in row] for row in rows[1:]]
    )


def test_texts_of_a_workbook_are_no_formulas(take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "recording_facts", lambda *_: {"=1+1": "=HYPERLINK(1)"})
    downloads.write_xlsx(take, tmp_path / "walk.xlsx")
    sheet = openpyxl.load_workbook(tmp_path / "walk.xlsx")["information"]
    assert [(cell.value, cell.data_type) for cell in sheet[2]] == [("=1+1", "s"), ("=HYPERLINK(1)", "s")]


def test_other_programs_read_the_formats(take: Path, tmp_path: Path) -> None:
    downloads.write_files(("c3d",), take, tmp_path / "walk.c3d")
    points = ezc3d.c3d(str(tmp_path / "walk.c3d"))["data"]["points"]
    assert np.isfinite(points[:3]).any()
    downloads.write_files(("osim", "mot"), take, tmp_path / "walk_opensim.zip")
    with zipfile.ZipFile(tmp_path / "walk_opensim.zip") as archive:
        assert {"skeleton.osim", "motion.mot", "files.json"} <= {*archive.namelist()}
        archive.extractall(tmp_path / "opensim")
    assert any("knee" in name for name in read_opensim_table(tmp_path / "opensim/motion.mot").names)


@needs_browser
def test_the_report_is_printed(take: Path, tmp_path: Path) -> None:
    downloads.write_pdf(take, tmp_path / "walk.pdf")
    pages = pypdf.PdfReader(tmp_path / "walk.pdf").pages
    assert 2 <= len(pages) <= 12
    assert "Findings" in pages[0].extract_text()


def test_without_a_browser_it_is_said_how_to_print(take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "pdf_browser", lambda: None)
    with pytest.raises(RtofError, match="print it there as PDF"):
        downloads.write_pdf(take, tmp_path / "walk.pdf")
    monkeypatch.setattr(downloads, "pdf_browser", lambda: "/bin/false")
    with pytest.raises(RtofError, match="did not print"):
        downloads.write_pdf(take, tmp_path / "walk.pdf")


@needs_browser
@pytest.mark.slow
def test_notes_comparisons_plans_and_archives_in_the_browser(store: Store, tmp_path: Path) -> None:
    plans = store.root / "P07/plans/2026-01-01_10-00-00"
    protocol = Protocol("squat")
    write_plan(planned(protocol, setup_of(protocol)), plans)
    archive = tmp_path / "P09.zip"
    (store.root / "P07").rename(store.root / "P09")
    write_archive(store, "P09", True, archive)
    (store.root / "P09").rename(store.root / "P07")
    server = Server(store.root)
    try:
        with Window(tmp_path / "profile", 1024, 900) as window:
            window.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path / "downloads"))
            window.open(server.address)
            window.says("needs attention: 1")
            window.drop(archive)
            window.until("location.pathname.endsWith('/people/P09')")
            window.fill(f"Notes on {DAYS[0]}", "limps")
            note = store.root / "P09" / DAYS[0] / NOTES
            until(lambda: note.is_file() and note.read_text() == "limps", "the note is not saved")
            note.write_text("limps, with a cane")
            window.until("[...document.querySelectorAll('textarea')].some(one => one.value === 'limps, with a cane')")
            note.unlink()
            note.symlink_to(store.root / "P09" / SUBJECT)
            window.until("[...document.querySelectorAll('textarea')].every(one => one.value === '')")
            window.open(f"{server.address}people/P07/comparisons")
            motion = store.root / f"P07/{DAYS[0]}/walk/motion/motion.h5"
            motion.write_bytes(motion.read_bytes()[:5000])
            window.click("Compare all visits")
            window.says("motion.h5: ", 60)
            window.click("Compare")
            window.until("document.querySelector('iframe')?.src.endsWith('/comparison.html')", 60)
            assert str(store.root) not in window.value("document.body.innerText")
            assert not window.layout_faults()
            page = window.value("document.querySelector('iframe').src")
            window.open(f"{server.address}people/P07/plans")
            window.says("What to expect, in a new tab")
            assert not window.layout_faults()
            window.open(f"{server.address}people/P07/{DAYS[1]}/walk")
            window.click("C3D")
            until((tmp_path / f"downloads/P07_{DAYS[1]}_walk.c3d").is_file, "nothing was downloaded")
            assert not window.errors
            window.open(page)
            window.says("left")
            for wrong in ("P07/comparisons/1/subject.toml", "P07/motion/1/plan.html", "P07/plans/2026/plan.html"):
                window.open(f"{server.address}made/{wrong}")
                window.says("There is no such file yet")
    finally:
        server.end()
