"""A result beside its video in a real browser: a range is chosen, corrected by hand, taken back."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from app_support import Server, Window
from browser_support import needs_browser

from rtof_kin.app import work as module
from rtof_kin.app.review import ReviewPages, _waits
from rtof_kin.app.store import State, Store
from rtof_kin.app.work import REVIEW, write_review
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.resources import model_path
from rtof_kin.data.corrections import Correction
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.index import read_corrections, write_corrections
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.export import export
from rtof_kin.setup.run import run
from rtof_kin.simulation.simulate import write_raw_files

pytest.importorskip("nicegui")
pytestmark = pytest.mark.slow
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
    export(reconstruct(Recording.load(folder / "recording"), mode="lift"), folder / "motion", formats=())
    filmed(folder / "files" / "walk.mp4", 60)
    return folder


@pytest.fixture(scope="module")
def server(take: Path) -> Iterator[Server]:
    own = Server(take.parents[2])
    yield own
    own.end()


@needs_browser
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
        window.says(f"Leave out the picture, {start:.2f} - {stop:.2f} s (AB, ")
        window.says("<b>a helper</b>")
        window.says("What was corrected is not in the result yet.")
        (one,) = read_corrections(take / "recording")
        assert (one.kind, one.what, one.who) == ("leave_out", "image", "AB")
        assert one.span == pytest.approx((start, stop), abs=0.01)
        assert not window.layout_faults()
        assert not [error for error in window.errors if server.address in error]
        window.click(window.value(f"{TAKE_BACK}.ariaLabel"))
        window.until("!document.body.innerText.includes('Leave out the picture, ')")
        assert read_corrections(take / "recording") == ()


@needs_browser
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
    export(result, take / "motion", formats=(), overwrite=True)
    write_review(take)
    page = (take / REVIEW).read_text()
    assert f'"mended":[[{made.start_s}' in page


def solved(folder: Path, monkeypatch: pytest.MonkeyPatch, **values: Any) -> dict[str, bytes]:
    """Reconstruct a recording as the queue does, but for the process, and return all numbers of the result."""
    sent: list[Any] = []
    monkeypatch.setattr(module, "end_with_parent", lambda: None)
    monkeypatch.setattr(module, "run", partial(run, mode="lift"))
    sender: Any = SimpleNamespace(send=sent.append)
    module._reconstruct(str(folder), Store.change(folder, **values), sender, 1)
    assert sent[-1]["state"] in (State.DONE, State.ATTENTION), sent[-1]
    return {path.name: path.read_bytes() for path in (folder / "motion/motion.h5", *(folder / "angles").glob("*.csv"))}


def test_the_result_follows_a_correction_and_comes_back_to_the_bit_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path / "workspace")
    store.add_person("P07", 1.73)
    store.add_visit("P07", "2026-02-03")
    folder, demo = store.add_take("P07", "2026-02-03", "walk"), Recording.load(model_path("demo"))
    write_raw_files(demo.between(demo.start_s + 9.0, demo.start_s + 10.5), tmp_path / "raw")
    for name in ("keypoints.csv", "camera.toml"):
        (tmp_path / "raw" / name).rename(store.new_file(folder, name))
    first = solved(folder, monkeypatch, size_px=(1920, 1080))
    start = Recording.load(folder / "recording").start_s
    by = {"who": "AB", "when": "2026-02-04T10:15", "why": "<b>a helper</b>"}
    made = (
        Correction("leave_out", "image", start_s=start + 0.3, stop_s=start + 1.0, **by),
        Correction("repetition", "squat", start_s=start, stop_s=start + 1.4, **by),
    )
    write_corrections(folder / "recording", made)
    assert _waits(folder)
    second = solved(folder, monkeypatch, person=1)  # the recording is made anew, and keeps them
    assert not _waits(folder)
    assert read_corrections(folder / "recording") == made
    motion = Motion.load(folder / "motion")
    assert not motion.poses.valid[made[0].within(motion.poses.times)].any()
    page = (folder / "report.html").read_text("utf-8")
    assert "by AB, 2026-02-04T10:15: &lt;b&gt;a helper" in page
    assert "1 squat; " in page
    for one in made:  # from two windows, each of which shows both
        ReviewPages._without(SimpleNamespace(), folder, one, lambda: None)()  # type: ignore[arg-type]
    assert read_corrections(folder / "recording") == ()
    assert _waits(folder)
    third = solved(folder, monkeypatch, person=None)
    assert second != third == first
    write_corrections(folder / "recording", made)
    write_corrections(folder / "recording", ())
    assert not _waits(folder)  # nothing is to be solved
