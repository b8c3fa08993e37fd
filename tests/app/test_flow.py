"""The application in a real browser, from the first person to the report, with the demo's raw files."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from app_support import Server, Window
from browser_support import needs_browser

from rtof_kin.app.store import Store
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.summary_file import read_summary
from rtof_kin.simulation.simulate import write_raw_files

pytest.importorskip("nicegui")
pytestmark = [needs_browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """What a phone and two sensors would have written of some seconds of the demo."""
    demo, folder = Recording.load(model_path("demo")), tmp_path_factory.mktemp("raw") / "files"
    first = demo.times[0]
    write_raw_files(demo.between(first + 9.0, first + 12.5), folder)
    return [folder / "keypoints.csv", *sorted((folder / "dots").iterdir())[:2], folder / "places.csv"]


@pytest.fixture
def window(tmp_path: Path) -> Iterator[Window]:
    with Window(tmp_path / "browser", 1024, 900) as page:
        yield page


@pytest.fixture
def ends() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_first_person_to_report_over_a_cancelled_run_and_a_killed_server(
    tmp_path: Path, raw: list[Path], window: Window, ends: ExitStack
) -> None:
    workspace, bad = tmp_path / "workspace", tmp_path / "notes.txt"
    bad.write_text("shopping list")
    server = Server(workspace)
    ends.callback(lambda: server.end())
    window.open(server.address)
    window.says("Nobody is here yet")
    window.fill("Identifier (no name)", "../P07")
    window.fill("Standing height in cm", "173")
    window.click("Add person")
    window.says("use 1 to 64 letters")
    window.fill("Identifier (no name)", "P07")
    window.press("Tab")
    window.click("Add person")
    window.says("173 cm tall")
    window.fill("Date of the visit, as 2026-01-31", "2026-02-03")
    window.press("Enter")
    window.fill("Name of the recording, as walk", "walk")
    window.press("Enter")
    window.says("Add a video")
    window.drop(bad)
    window.says("notes.txt: not recognised")
    window.click("Remove notes.txt")
    window.drop(*raw)
    window.says("Ready: a detector's keypoints, a map of sensors, files of sensors.")
    window.click("Reconstruct")
    window.says("Keypoints do not say how large the image is")
    state = workspace / "P07/2026-02-03/walk/take.json"
    state.unlink(missing_ok=True)
    state.mkdir()  # where nothing can be written
    window.value("document.querySelector('[role=switch]').click()")
    window.says("; free some space")
    state.rmdir()
    window.fill("Width of the image in px", "1920")
    window.fill("Height of the image in px", "1080")
    window.click("Reconstruct")
    window.says("from image to space", 60)
    window.click("Cancel")
    window.says("Learn from this recording")
    Store(workspace).change(workspace / "P07/2026-02-03/walk", learn=True)
    window.says("draft")
    window.click("Reconstruct")
    window.says("What was found", 120)
    window.says("in doubt: ")
    place = window.value("location.pathname").split("/", 2)[2]
    server.end(signal.SIGKILL)
    server = Server(workspace)
    window.open(server.address + place)
    window.says("3. Result", 300)
    foreign = [url for url in window.requests if not re.match(r"(https?|ws)://127\.0\.0\.1:|data:|blob:", url)]
    assert not foreign
    window.until("document.querySelector('iframe')?.src.endsWith('/results/P07/2026-02-03/walk/report.html')")
    assert not window.layout_faults()
    assert not [error for error in window.errors if server.address in error]
    take = workspace / "P07/2026-02-03/walk"
    assert not [path for path in take.rglob("*") if path.stat().st_mode & 0o077]
    assert read_summary(take / "motion" / "summary.json").session.subject == "P07"
    assert Store(workspace).take(take).learned[0].startswith("P07: ")
    assert {"recording", "motion", "angles", "report.html"} <= {path.name for path in take.iterdir()}
    window.open(f"{server.address}results/P07/2026-02-03/walk/report.html")
    for line in ("Who", "What", "How good", "Careful", "Findings"):
        window.says(line)
    window.until("document.querySelector('svg, canvas') !== null")  # drawn by its own script
    window.open(f"{server.address}people/P08")
    window.says("There is no person P08")
    window.open(f"{server.address}people/P07")
    window.click("Move walk to the trash")
    window.says("walk is in the trash")
    window.open(f"{server.address}trash")
    window.click("Take walk back")
    window.says("The trash is empty")
    assert (take / "report.html").is_file()
