"""The live page in a real browser, where there is one."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import planted
import pytest
from browser_support import BrowserPage
from report_support import BROWSER

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.poses import Provenance
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.live.websocket_server import WebSocketServer

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no headless browser here")
BODY = SkeletonModel.default()
MOTION = planted.walking(BODY, 5.0)[0].poses
POSES = replace(MOTION, provenance=np.full(MOTION.provenance.shape, Provenance.CAMERA_AND_IMU))
STATE = "document.documentElement.dataset.state"
PICTURE = "document.getElementById('scene').toDataURL()"
LOST = {"name": "S1 <b>bold</b>", "state": "lost", "rate_hz": None, "sentence": "nothing has come for 2 s"}
STATUS = {
    "sensors": [LOST, {"name": "S2", "state": "ok", "rate_hz": 60.0, "sentence": ""}],
    "camera": {"name": "video", "state": "frozen", "rate_hz": None, "sentence": "no frame for 1 s"},
}


class Feed:
    """A server that sends poses at 50 Hz until it is stopped."""

    def __init__(self, port: int = 0):
        self.server = WebSocketServer(BODY, port)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        frame = 0
        while not self._stop.wait(0.02):
            pose = POSES[frame % len(POSES) : frame % len(POSES) + 1]
            pose = replace(pose, times=np.array([1000 + 0.02 * frame]))
            self.server.send(OnlineEstimate(pose, 0.123, 0.0045))
            frame += 1

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def close(self) -> None:
        self.stop()
        self.server.close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserPage]:
    with BrowserPage(tmp_path_factory.mktemp("browser"), 1200, 900) as page:
        yield page


@pytest.fixture
def feed(browser: BrowserPage) -> Iterator[Feed]:
    feed = Feed()
    feed.server.send_status(STATUS)
    feed.server.tell("S1: <i>lost</i>")
    browser.open(feed.server.url)
    browser.until(f"{STATE} === 'live'")
    yield feed
    browser.open("about:blank")
    feed.close()
    browser.errors.clear()
    browser.requests.clear()


def test_page_shows_figures_states_messages_and_curves(browser: BrowserPage, feed: Feed, tmp_path: Path) -> None:
    browser.until("document.querySelectorAll('path.curve').length >= 6")
    text = str(browser.value("document.body.innerText"))
    for part in ("123 ms", "4.5 ms", LOST["name"], LOST["sentence"], "60 Hz", "frozen", "S1: <i>lost</i>"):
        assert str(part) in text
    browser.until("Number(document.getElementById('rate').textContent) > 5")
    assert "deg" in str(browser.value("document.querySelector('#angle-charts').textContent"))
    browser.value(
        "(select => { select.value = 'ankle dorsiflexion'; select.dispatchEvent(new Event('change')); })"
        "(document.querySelector('#angle-charts select'))"
    )
    address = urlsplit(feed.server.url).netloc
    assert {urlsplit(url).netloc for url in browser.requests} == {address}
    for width in (390, 1200):
        browser.resize(width, 900)
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.picture(tmp_path / f"{width}.png").stat().st_size > 10_000
    assert browser.errors == []


def test_scene_turns_by_drag_and_keys(browser: BrowserPage, feed: Feed) -> None:
    feed.stop()
    browser.until(f"{STATE} === 'stale'")
    x, y = browser.value(
        "(box => [box.x + box.width / 2, box.y + box.height / 2])"
        "(document.getElementById('scene').getBoundingClientRect())"
    )
    seen = [browser.value(PICTURE)]
    browser.drag((x, y), (x + 60, y))
    seen.append(browser.value(PICTURE))
    browser.value("document.getElementById('scene').focus()")
    for key in ("ArrowLeft", "ArrowUp", "+"):
        browser.press(key)
        seen.append(browser.value(PICTURE))
    assert len(set(seen)) == len(seen)
    assert browser.errors == []


def test_page_connects_again_by_itself(browser: BrowserPage, feed: Feed) -> None:
    feed.close()
    browser.until(f"{STATE} === 'lost'")
    again = Feed(urlsplit(feed.server.url).port or 0)
    again.server._door = feed.server._door  # the same server, which was not reached for a while
    began = time.monotonic()
    browser.until(f"{STATE} === 'live'")
    assert time.monotonic() - began < 15
    again.close()
