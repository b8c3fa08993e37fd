"""A result beside its video in a real browser: a range is chosen, corrected by hand, taken back."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from app_support import Server, Window
from browser_support import needs_browser

from rtof_kin.app.store import Store
from rtof_kin.app.work import REVIEW, write_review
from rtof_kin.core.resources import model_path
from rtof_kin.data.corrections import Correction
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.index import read_corrections
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.export import export

pytest.importorskip("nicegui")
pytestmark = [needs_browser, pytest.mark.slow]
INSIDE = "document.querySelector('iframe')?.contentDocument"
ITEM = "[...document.querySelectorAll('.q-item')].find(one => one.innerText === 'Leave out the picture')"
TAKE_BACK = "[...document.querySelectorAll('button')].find(one => one.ariaLabel?.startsWith('Take back'))"
AT = """(page => {
  const slider = page.getElementById("time");
  slider.value = %s;
  slider.dispatchEvent(new Event("input"));
  page.getElementById("%s").click();
  return parseFloat(page.getElementById("clock").textContent);
})(%s)"""


def filmed(path: Path, frames: int) -> None:
    """Write a small grey video of 60 Hz."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=60)
        stream.width, stream.height, stream.pix_fmt = 192, 108, "yuv420p"
        for i in range(frames):
            picture = np.full((108, 192, 3), 40 + 2 * (i % 60), dtype=np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        file.mux(stream.encode())


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the application that is reconstructed, with a video."""
    store = Store(tmp_path_factory.mktemp("workspace"))
    store.add_person("P07", 1.73)
    store.add_visit("P07", "2026-02-03")
    folder = store.add_take("P07", "2026-02-03", "walk")
    demo = Recording.load(model_path("demo"))
    short = demo.between(demo.start_s, demo.start_s + 1.0)
    short.save(folder / "recording")
    export(reconstruct(Recording.load(folder / "recording"), mode="lift"), folder / "motion", figures=False, formats=())
    filmed(folder / "files" / "walk.mp4", 60)
    return folder


@pytest.fixture(scope="module")
def server(take: Path) -> Iterator[Server]:
    own = Server(take.parents[2])
    yield own
    own.end()


def test_a_range_is_chosen_corrected_and_taken_back(take: Path, server: Server, tmp_path: Path) -> None:
    with Window(tmp_path / "browser", 1024, 900) as window:
        window.open(f"{server.address}people/P07/2026-02-03/walk/review")
        window.until(f"{INSIDE}?.documentElement?.dataset.state === 'ready'", 60)
        window.until(f"{INSIDE}.getElementById('video').readyState > 1")
        start, stop = (window.value(AT % (frame, end, INSIDE)) for frame, end in ((6, "from"), (15, "to")))
        assert 0.2 < stop - start < 0.5
        assert window.value(f"Math.abs({INSIDE}.getElementById('video').currentTime - {stop - start} - 0.2) < 0.1")
        window.until("document.querySelector('input[aria-label=\"From, s\"]').value !== ''")
        window.click("Add")
        window.says("Say what is corrected, who you are, and why")
        at = tuple(
            window.value("(b => [b.x + 20, b.y + 20])(document.querySelector('.q-select').getBoundingClientRect())")
        )
        window.drag(at, at)
        window.until(f"{ITEM} !== undefined")
        window.value(f"{ITEM}.click()")
        window.fill("Who (initials)", "AB")
        window.fill("Why", "<b>a helper</b>")
        window.press("Enter")
        window.says("Leave out the picture from")
        window.says("<b>a helper</b>")
        window.says("What was corrected is not in the result yet.")
        (one,) = read_corrections(take / "recording")
        assert (one.kind, one.what, one.who) == ("leave_out", "image", "AB")
        assert one.span == pytest.approx((start, stop), abs=0.01)
        assert not window.layout_faults()
        assert not [error for error in window.errors if server.address in error]
        window.click(window.value(f"{TAKE_BACK}.ariaLabel"))
        window.until("!document.body.innerText.includes('Leave out the picture from')")
        assert read_corrections(take / "recording") == ()


def test_the_video_is_sent_in_parts_and_nothing_else_is(take: Path, server: Server) -> None:
    address = f"{server.address}review/P07/2026-02-03/walk"
    part = urllib.request.Request(f"{address}/video", headers={"Range": "bytes=0-99"})
    with urllib.request.urlopen(part) as answer:
        assert answer.status == 206
        assert len(answer.read()) == 100
    for other in ("take.json", "..%2Ftake.json", "recording%2Frecording.toml"):
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(f"{address}/{other}")


def test_the_page_is_of_this_result_and_shows_what_was_corrected(take: Path) -> None:
    recording = Recording.load(take / "recording")
    start = recording.start_s + 0.2
    made = Correction("exchange_sides", start_s=start, stop_s=start + 0.2)
    result = reconstruct(replace(recording, corrections=(made,)), mode="lift")
    export(result, take / "motion", figures=False, formats=(), overwrite=True)
    write_review(take)
    page = (take / REVIEW).read_text()
    assert f'"mended":[[{made.start_s}' in page
