"""First steps in a real browser, and what holds on every page: names, headings, contrast, focus, widths."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import date
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from app_support import Server, Window
from browser_support import needs_browser

from rtof_kin.app.start import _looked, add_demo
from rtof_kin.app.store import State, Store
from rtof_kin.setup.sources import Sources

pytest.importorskip("nicegui")
browser = [needs_browser, pytest.mark.slow]
DEMO = f"people/demo/{date.today().isoformat()}"
RECORD = f"record/demo/{date.today().isoformat()}"
PAGES = (
    *("", "start", "trash", "people/demo", "people/demo/comparisons", "people/demo/plans", RECORD),
    *(f"{DEMO}/{name}" for name in ("exercises", "waits", "failed", "done")),
)
"""Addresses of all pages; another page is another line."""
MODELS = """
import sys
from rtof_kin.app import start
from rtof_kin.vision.model_download import ModelFile, ModelSet
files = (ModelFile("points.onnx", {url!r}, {sha256!r}, 3),)
start.model_sets = lambda: (ModelSet("rtmpose", "Models of the test", "a licence", (), "", files),)
from rtof_kin.cli import main
sys.exit(main(["app", "--workspace", {workspace!r}, "--no-browser"]))
"""
"""The application with models of another server."""
_CONTRAST = r"""
(() => {
  const rgba = text => (text.match(/[\d.]+/g) ?? []).map(Number);
  const over = ([r, g, b, a = 1], under) => [r, g, b].map((c, i) => a * c + (1 - a) * under[i]);
  const light = color => {
    const [r, g, b] = color.map(c => c / 255).map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const out = new Set(), walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const seen = { opacityProperty: true, visibilityProperty: true };
  while (walker.nextNode()) {
    const text = walker.currentNode.textContent.trim(), own = walker.currentNode.parentElement;
    if (!text || own.closest("script, style, [disabled], .q-notifications") || !own.checkVisibility(seen)) continue;
    const chain = [];
    for (let box = own; box; box = box.parentElement) chain.unshift(box);
    let under = matchMedia("(prefers-color-scheme: dark)").matches ? [18, 18, 18] : [255, 255, 255], opacity = 1;
    for (const box of chain) {
      const style = getComputedStyle(box);
      under = over(rgba(style.backgroundColor), under);
      opacity *= Number(style.opacity);
    }
    const style = getComputedStyle(own), [r, g, b, a = 1] = rgba(style.color), size = parseFloat(style.fontSize);
    const [low, high] = [light(over([r, g, b, a * opacity], under)), light(under)].sort((x, y) => x - y);
    const large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700), found = (high + 0.05) / (low + 0.05);
    if (found < (large ? 3 : 4.5)) out.add(`${found.toFixed(2)}: ${text.slice(0, 40)} ${own.className}`);
  }
  return [...out];
})()
"""
_FOCUSED = """
(() => {
  const one = document.activeElement;
  if (!one || one === document.body) return null;
  const drawn = style => style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2;
  const boxes = [one, one.closest(".q-field__control")].filter(box => box);
  return [one.outerHTML, boxes.some(box => drawn(getComputedStyle(box))) || one.tagName === "IFRAME"];
})()
"""
_NAME = re.compile(r"[^a-z_]|^[a-z]+$")
"""Of a name that is more than that of an icon, as add_box."""
_CONTROLS = (
    "button link textbox spinbutton combobox image radio radiogroup checkbox switch tab slider progressbar Iframe"
)


class Files(SimpleHTTPRequestHandler):
    """Files of a folder; `asked`: how often."""

    asked = 0

    def do_GET(self) -> None:
        type(self).asked += 1
        super().do_GET()

    def log_message(self, *_: Any) -> None: ...


class WithModels(Server):
    """The application with models of another server."""

    def __init__(self, workspace: Path, **models: str):
        code = MODELS.format(workspace=str(workspace), **models)
        self.process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        found = re.search(r"http://\S+/", self.process.stdout.readline())
        assert found is not None
        self.address = found[0]


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("RTOF_KIN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    (tmp_path / "files").mkdir()
    (tmp_path / "files/points.onnx").write_bytes(b"x" * 3_000_000)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, directory=str(tmp_path / "files"))) as models:
        threading.Thread(target=models.serve_forever, daemon=True).start()
        sha256 = hashlib.sha256(b"x" * 3_000_000).hexdigest()
        url = f"http://127.0.0.1:{models.server_port}/points.onnx"
        server = WithModels(tmp_path / "workspace", url=url, sha256=sha256)
        yield server
        server.end()
        models.shutdown()


def names_and_headings(window: Window) -> list[str]:
    """Controls without a name, and headings out of order, as the browser tells a screen reader."""
    nodes = [node for node in window.call("Accessibility.getFullAXTree")["nodes"] if not node["ignored"]]
    roles = [(node["role"]["value"], node.get("name", {}).get("value", "").strip(), node) for node in nodes]
    faults = [
        f"{role} without a name: {node}"
        for role, name, node in roles
        if role in _CONTROLS.split() and not _NAME.search(name)
    ]
    levels = [
        next(one["value"]["value"] for one in node["properties"] if one["name"] == "level")
        for role, _, node in roles
        if role == "heading"
    ]
    if levels.count(1) != 1 or any(b > a + 1 for a, b in zip([0, *levels], levels, strict=False)):
        faults.append(f"headings of the levels {levels}")
    return faults


def focus(window: Window) -> list[str]:
    """What has the focus, by the key Tab, without showing it."""
    faults, seen = [], set()
    for _ in range(60):
        for kind in ("rawKeyDown", "keyUp"):
            window.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab", windowsVirtualKeyCode=9)
        found = window.value(_FOCUSED)
        if found is None or found[0] in seen:
            break
        seen.add(found[0])
        if not found[1]:
            faults.append(f"focus is not shown: {found[0][:300]}")
    assert seen
    return faults


@pytest.mark.slow
@needs_browser
def test_first_steps_lead_to_the_demo_and_fetch_models_after_consent(served: Server, tmp_path: Path) -> None:
    Files.asked = 0
    with Window(tmp_path / "browser", 1024, 900) as window:
        window.open(served.address)
        window.says("5. Read the report")
        window.click("Understood, do not show this again")
        window.click("First steps, language and a check of this computer")
        window.says("Models of the test: missing")
        window.says("a licence")
        assert "5. Read" not in window.value("document.body.innerText")
        assert not Files.asked
        window.click("Agree and fetch 3 MB")
        window.says("Models of the test: good")
        assert Files.asked == 1
        window.click("Deutsch")
        window.says("Arbeitsspeicher: ")
        assert window.value("document.documentElement.lang") == "de"
        window.click("Beispiel ausprobieren")
        window.says("Bereit: ")
        assert window.value("location.pathname").endswith(f"/{DEMO}/exercises")
        store = Store(tmp_path / "workspace")
        assert (store.settings.language, store.settings.toured) == ("de", True)

        done, failed, waits = (store.add_take("demo", DEMO[-10:], name) for name in ("done", "failed", "waits"))
        (done / "report.html").write_text("<!doctype html><html lang=en><title>x</title><p>The report")
        store.change(done, state=State.ATTENTION)
        store.change(failed, state=State.FAILED, said="The video is damaged")
        store.change(waits, state=State.WAITING)
        store.delete("demo", DEMO[-10:], store.add_take("demo", DEMO[-10:], "gone").name)
        faults = []
        for dark, language, code in ((False, "English", "en-US"), (True, "Deutsch", "de")):
            scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
            window.call("Emulation.setEmulatedMedia", features=[scheme])
            window.click(language)
            window.until(f"document.documentElement?.lang === '{code}'")
            for page in PAGES:
                window.resize(1024, 900)
                window.open(served.address + page)
                there = f"location.href === {json.dumps(served.address + page)}"
                window.until(f"{there} && window.socket?.connected && window.did_handshake")
                found = [*window.layout_faults(), *names_and_headings(window), *window.value(_CONTRAST), *focus(window)]
                window.resize(768, 1024)
                found += [f"at 768 px: {fault}" for fault in window.layout_faults()]
                faults += [f"{page or 'people'}, {language}: {fault}" for fault in dict.fromkeys(found)]
        assert not faults, "\n".join(faults)


def test_demo_comes_as_raw_files_once_a_day(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = add_demo(store)
    assert add_demo(store) == folder
    found = Sources.of(store.files(folder))
    assert (len(found.sensors), found.video) == (8, None)
    assert None not in (found.keypoints, found.camera, found.sensor_map)
    height = store.subject("demo").height_m
    assert height is not None
    assert height.value == pytest.approx(1.733)
    assert not [path for path in folder.rglob("*") if path.stat().st_mode & 0o077]


@pytest.mark.parametrize(
    ("code", "good", "said"),
    [
        ("found = ['0', '2']", True, "0, 2"),
        ("found = []", False, "None was found"),
        ("import nothing_of_this_name", False, "not installed"),
        ("import os; os.abort()", False, "no answer"),
        ("import time; time.sleep(60)", False, "no answer"),
    ],
)
def test_a_library_that_crashes_or_hangs_is_a_line(
    code: str, good: bool, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtof_kin.app.start._LONGEST", 0.7)
    found = _looked(code, "Cameras", "connect one", "app")
    assert (found.good, said in found.said) == (good, True), found
    assert found.todo == ('pip install "rtof-kin[app]"' if "nothing" in code else "connect one")
