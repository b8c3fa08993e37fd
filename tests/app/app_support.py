"""The application as a process, and a window of it in a headless browser."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from browser_support import BrowserPage

TEXT = "(document.body?.innerText ?? '')"
_CLICK = """
[...document.querySelectorAll("button, a")]
  .find(one => [one.innerText.trim(), one.getAttribute("aria-label")].includes(%s)).click()
"""


class Server:
    """The command in a process of its own."""

    def __init__(self, workspace: Path):
        command = [sys.executable, "-m", "rtof_kin.cli", "app", "--workspace", str(workspace), "--no-browser"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env={**os.environ, "LC_ALL": "C.UTF-8"}
        )
        assert self.process.stdout is not None
        found = re.search(r"http://\S+/", self.process.stdout.readline())
        assert found is not None
        self.address = found[0]

    def end(self, how: signal.Signals = signal.SIGINT) -> None:
        if self.process.poll() is None:
            self.process.send_signal(how)
        self.process.communicate(timeout=20)


class Window(BrowserPage):
    """A window of the application."""

    def click(self, text: str) -> None:
        named = f"[one.innerText.trim(), one.getAttribute('aria-label')].includes({json.dumps(text)})"
        there = f"[...document.querySelectorAll('button, a')].some(one => {named})"
        deadline = time.monotonic() + 20.0
        while not self.value(there):
            assert time.monotonic() < deadline, f"no button {text!r} within 20 s: {self.value(TEXT)}"
            time.sleep(0.05)
        self.value(_CLICK % json.dumps(text))

    def fill(self, label: str, text: str) -> None:
        """Type into the input of a label, by the keyboard."""
        found = f"document.querySelector(':is(input, textarea)[aria-label={json.dumps(label)}]')"
        self.until(f"{found} !== null && window.socket?.connected && window.did_handshake")
        self.value(f"(one => (one.focus(), one.select()))({found})")
        self.call("Input.insertText", text=text)

    def says(self, text: str, seconds: float = 20.0) -> None:
        self.until(f"{TEXT}.includes({json.dumps(text)})", seconds)

    def drop(self, *files: Path) -> None:
        """Give files to the upload."""
        self.until("document.querySelector('input[type=file]') !== null")
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = self.call("DOM.querySelector", nodeId=root, selector="input[type=file]")["nodeId"]
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])
