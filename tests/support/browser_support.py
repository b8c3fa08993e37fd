"""A page in a headless browser, driven by its DevTools protocol: pictures, paper, faults of the layout."""

from __future__ import annotations

import base64
import json
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

import pytest
from report_support import BROWSER
from websockets.sync.client import connect

WIDTHS: Final = (390, 768, 1280)
"""[px] of a phone, a tablet and a desktop."""
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or google-chrome here: `apt install chromium` to test the pages"
)
_FAULTS: Final = r"""
(() => {
  const out = [], root = document.documentElement, width = root.clientWidth;
  if (root.scrollWidth > innerWidth) out.push(`the page is ${root.scrollWidth} px wide`);
  const cut = box => getComputedStyle(box).overflowX !== "visible" && box.scrollWidth > box.clientWidth + 1;
  const leaves = (inner, outer) =>
    inner.left < outer.left - 1 || inner.right > outer.right + 1 || inner.bottom > outer.bottom + 1;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const text = walker.currentNode.textContent.trim(), own = walker.currentNode.parentElement;
    if (!text || own.closest("script, style, option, .skip") || !own.checkVisibility()) continue;
    const range = document.createRange(), what = text.slice(0, 40);
    range.selectNodeContents(walker.currentNode);
    const boxes = [...range.getClientRects()].filter(box => box.width > 0);
    const lines = new Set(boxes.map(box => Math.round(box.top))).size;
    if (boxes.some(box => box.right > width + 1 || box.left < -1)) out.push(`outside the page: ${what}`);
    if (lines > 2 && text.length / lines < 4) out.push(`${lines} lines: ${what}`);
    for (let box = own; box && box !== document.body; box = box.parentElement)
      if (cut(box)) out.push(`cut: ${what}`);
    const chart = own.closest("svg");
    if (chart && boxes.some(box => leaves(box, chart.getBoundingClientRect())))
      out.push(`outside its chart: ${what}`);
  }
  return out;
})()
"""
_TARGETS: Final = """
[...document.querySelectorAll("a:not(.skip), button, select, summary, label, input[type=range]")]
  .filter(one => one.checkVisibility() && one.getBoundingClientRect().height < 40)
  .map(one => one.textContent.trim() || one.id)
"""


SOFTWARE_3D = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Flags for WebGL without a graphics card."""


class BrowserPage:
    """One page; `errors` are what its console and its policy complained about."""

    def __init__(
        self, profile: Path, width: int, height: int, dark: bool = False, flags: Sequence[str] = ("--disable-gpu",)
    ):
        assert BROWSER is not None
        self._process = subprocess.Popen(
            [
                BROWSER,
                "--headless",
                "--no-sandbox",
                *flags,
                "--disable-quic",
                "--no-first-run",
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
                "--remote-debugging-port=0",
                f"--user-data-dir={profile}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._open = ExitStack()
        self._open.callback(self._end)
        port, path = self._endpoint(profile / "DevToolsActivePort")
        address = f"ws://127.0.0.1:{port}{path}"
        self._socket = self._open.enter_context(connect(address, max_size=None, proxy=None, compression=None))
        self._number, self._session = 0, None
        self.errors: list[str] = []
        target = self.call("Target.getTargets")["targetInfos"][0]["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(width, height)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.requests: list[str] = []

    @staticmethod
    def _endpoint(file: Path) -> list[str]:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            if file.exists() and len(lines := file.read_text().split()) == 2:
                return lines
            time.sleep(0.02)
        raise TimeoutError("the browser does not start")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _end(self) -> None:
        self._process.terminate()
        self._process.wait(20)

    def call(self, method: str, **parameters: Any) -> Any:
        """Result of a command."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            found = json.loads(self._socket.recv(timeout=30))
            if found.get("id") == self._number:
                if "Inspected target navigated" in str(found.get("error")):  # meanwhile: asked of the page that follows
                    return self.call(method, **parameters)
                assert "error" not in found, found
                return found["result"]
            self._event(found.get("method", ""), found.get("params", {}))

    def _event(self, method: str, found: dict[str, Any]) -> None:
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(found["exceptionDetails"].get("exception", found)))
        elif method == "Runtime.consoleAPICalled":
            self.errors.append(str(found["args"]))
        elif method == "Log.entryAdded":
            self.errors.append(f"{found['entry']['text']} {found['entry'].get('url', '')}")
        elif method == "Network.requestWillBeSent":
            self.requests.append(found["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(found["url"])

    def resize(self, width: int, height: int) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.until("document.documentElement && document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        """Value of a JavaScript expression."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str, seconds: float = 20.0) -> None:
        """Wait until an expression holds."""
        deadline = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < deadline, (expression, self.errors, self.value("document.body.innerText"))
            time.sleep(0.05)

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag with the left button."""
        for kind, (x, y), buttons in (("mousePressed", start, 1), ("mouseMoved", end, 1), ("mouseReleased", end, 0)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def picture(self, file: Path, whole: bool = True) -> Path:
        """Write a picture of the page."""
        found = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        file.write_bytes(base64.b64decode(found["data"]))
        return file

    def layout_faults(self) -> list[str]:
        """Texts that are outside of the page or their chart, clipped, or broken into single letters."""
        found: list[str] = self.value(_FAULTS)
        return found

    def small_targets(self) -> list[str]:
        """Controls that are too low for a finger."""
        found: list[str] = self.value(_TARGETS)
        return found

    def pdf(self, file: Path) -> Path:
        """Write the page as it is printed."""
        found = self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
        file.write_bytes(base64.b64decode(found["data"]))
        return file
