"""Served page and written page in a real browser: they show the scene and ask for nothing elsewhere."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser_support import SOFTWARE_3D, BrowserPage
from matplotlib.image import imread
from report_support import BROWSER
from scene_support import measured, walking, written

from rtof_kin.core.errors import InvalidInputError, OutputExistsError
from rtof_kin.view.static_page import notebook_page, write_static_page
from rtof_kin.view.viewer import MotionViewer, address, local_server, motion_files

pytest.importorskip("viser")
INSIDE = ("data:", "blob:")
NOISE = (
    "Detected chrome",
    "WebGL support",
    "THREE.Clock",
    "Connect",
    "Embedded data loaded",
    "GPU stall",
    "Tried to send ViewerCameraMessage",
)
"""Begins of messages in the console that are no complaint."""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    motion = walking(60)
    return written(tmp_path_factory.mktemp("page") / "out", motion, measured(motion))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserPage]:
    if BROWSER is None:
        pytest.skip("no headless browser here")
    with BrowserPage(tmp_path_factory.mktemp("profile"), 320, 200, flags=SOFTWARE_3D) as opened:
        yield opened


def complaints(page: BrowserPage) -> list[str]:
    return [error for error in page.errors if not any(noise in error for noise in NOISE)]


def test_written_page_opens_from_the_disk_and_asks_for_nothing(out: Path, page: BrowserPage, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    with motion_files(out) as files, local_server() as server:
        made = write_static_page(server, files, path, rate_hz=10.0, start=2.0, stop=3.0)
    assert (made.frames, made.thinned) == (11, False)
    assert made.size_mb == pytest.approx(path.stat().st_size / 1e6)
    assert made.size_mb < 1.5
    text = path.read_text()
    assert "planted &amp; bad" in text
    assert "<title>glide &lt;b&gt; - rtof_kin</title>" in text
    assert text.index("Content-Security-Policy") < text.index("<script")
    page.errors.clear()
    page.requests.clear()
    page.open(f"{path.as_uri()}?fixedDpr=0.2")
    page.until("document.querySelector('canvas') !== null", 60)
    page.until("document.body.innerText.includes('planted & bad')")
    page.until("performance.now() > 3000")
    assert any("Embedded data loaded" in error for error in page.errors)
    assert complaints(page) == []
    elsewhere = [url for url in page.requests if not url.startswith(INSIDE)]
    assert elsewhere == [f"{path.as_uri()}?fixedDpr=0.2"]
    refused = page.value("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'refused'); 1")
    assert refused == 1
    page.until("performance.now() > 3500")
    assert any("Content Security Policy" in error for error in page.errors)


def test_a_notebook_plays_the_motion_and_says_what_it_left_out(page: BrowserPage, tmp_path: Path) -> None:
    shown = walking(60).show()
    assert "36 frames, 30 per second" in shown._repr_html_()
    assert "thinned out" in notebook_page(walking(60), len(shown.html) / 1e6 - 0.01).note
    path = tmp_path / "notebook.html"
    path.write_text(f"<html><body>{shown._repr_html_()}</body></html>")
    page.errors.clear()
    page.requests.clear()
    page.open(path.as_uri())
    inside = "document.querySelector('iframe').contentDocument"
    page.until(f"{inside}.querySelector('canvas') !== null", 60)
    deadline, drawn = time.monotonic() + 30, 0
    while drawn < 50 and time.monotonic() < deadline:
        red, green, blue = imread(page.picture(tmp_path / "page.png", whole=False))[..., :3].T
        drawn = np.sum((green > red + 0.2) & (green > blue + 0.05))  # the colour of what camera and IMU observed
    assert drawn >= 50
    assert complaints(page) == []
    assert [url for url in page.requests if not url.startswith((*INSIDE, "about:"))] == [path.as_uri()]
    page.open("about:blank")


def test_served_page_shows_the_motion_and_asks_its_own_server_only(out: Path, page: BrowserPage) -> None:
    with motion_files(out) as files, local_server() as server, MotionViewer(server, files) as viewer:
        page.errors.clear()
        page.requests.clear()
        page.open(f"{address(server)}?fixedDpr=0.2")
        page.until("document.body.innerText.includes('planted & bad')", 60)
        page.until("document.body.innerText.includes('joint angles')", 60)
        viewer.update(0.0)
        page.until("document.body.innerText.includes('frame 0 of 60')", 60)
        assert len(server.get_clients()) == 1
        for kind in ("keyDown", "keyUp"):
            page.call("Input.dispatchKeyEvent", type=kind, key=" ", code="Space")
        deadline = time.monotonic() + 20
        while not viewer.playback.playing and time.monotonic() < deadline:
            time.sleep(0.05)
        assert viewer.playback.playing
        assert complaints(page) == []
        own = re.compile(rf"(http|ws|blob:http)://127\.0\.0\.1:{server.get_port()}(/.*)?")
        assert [url for url in page.requests if not (own.fullmatch(url) or url.startswith("data:"))] == []
        page.open("about:blank")


def test_long_motion_is_thinned_out_or_refused_and_files_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    with motion_files(written(tmp_path / "out", walking(60, shaking=0.1))) as files:
        with local_server() as server:
            whole = write_static_page(server, files, path, rate_hz=80.0)
        assert whole.rate_hz == pytest.approx(50)  # that of the motion, although more was allowed
        with local_server() as server, pytest.raises(OutputExistsError):
            write_static_page(server, files, path)
        limit = whole.size_mb - 0.05
        with local_server() as server:
            thin = write_static_page(server, files, path, rate_hz=80.0, largest_mb=limit, overwrite=True)
        assert thin.thinned
        assert thin.size_mb < limit * 1.02
        assert thin.frames < whole.frames == 60
        assert thin.rate_hz < 50
        with local_server() as server, pytest.raises(InvalidInputError, match="--start, --stop"):
            write_static_page(server, files, tmp_path / "b.html", largest_mb=0.82)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["out", "page.html"]
