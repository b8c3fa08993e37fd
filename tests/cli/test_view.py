"""The command view: what it says, how soon a page is there, how it ends."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from scene_support import measured, walking, written

pytest.importorskip("viser")
Cli = Callable[..., Any]
ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    motion = walking(100)
    folder = tmp_path_factory.mktemp("run")
    written(folder / "motion", motion, measured(motion))  # as `run` writes it
    return folder


def process_of(*arguments: object) -> subprocess.Popen[str]:
    """The command in a process of its own."""
    command = [sys.executable, "-m", "rtof_kin.cli", "view", *map(str, arguments), "--no-browser"]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, env=ENVIRONMENT, cwd=ROOT, **pipes)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="Linux's processor times")
def test_page_is_there_soon_and_ctrl_c_ends_cleanly(out: Path) -> None:
    started = time.monotonic()
    used = [0.0]
    process = process_of(out)
    assert process.stdout is not None
    lines: list[str] = []
    try:
        while not lines or "address" not in lines[-1]:
            lines.append(process.stdout.readline())
            assert lines[-1], process.communicate()
        url = re.search(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", lines[-1])
        assert url is not None
        with urllib.request.urlopen(url[0], timeout=10) as page:
            assert b"<html" in page.read()[:2000]
        seconds = time.monotonic() - started
        clock = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        used[0] = (int(clock[11]) + int(clock[12])) / os.sysconf("SC_CLK_TCK")
    finally:
        process.send_signal(signal.SIGINT)
    rest, errors = process.communicate(timeout=20)
    assert (process.returncode, errors, rest) == (0, "", "")
    assert used[0] < 3.0, f"{used[0]:.1f} s of processor time, {seconds:.1f} s in all"
    assert "2.0 s at 50 Hz, 1 camera, 2 IMUs, the truth" in lines[0]
    assert "fail: planted & bad" in lines[1]
    assert "this machine only" in lines[2]


def test_motion_without_measurements_says_what_is_missing(cli: Cli, tmp_path: Path) -> None:
    folder = written(tmp_path / "old", walking(40))
    done = cli.ok("view", folder, "--html", tmp_path / "page.html", "--fps", 10)
    done.says("No measurements.h5 beside the motion", "Reconstruct again")
    assert re.search(r"wrote .*page\.html: 0\.[89] MB, 8 frames at 10 Hz; opens in any browser", done.out)
    assert "--overwrite" in cli.refused("view", folder, "--html", tmp_path / "page.html").err


def test_wrong_input_is_told_in_one_line(cli: Cli, out: Path, tmp_path: Path) -> None:
    for arguments, words in (
        ((out, "--html", tmp_path / "a.html", "--video", "a.mp4"), "the file has no video"),
        ((tmp_path,), "no such file; name the output folder"),
        ((out, "--beside", tmp_path), "no such file; name the output folder"),
        ((out, "--no-browser", "--video", "a", "--video", "b"), "2 videos, but the motion has 1 camera"),
        ((out, "--no-browser", "--port", 99999), "a port is a number"),
        ((out, "--html", tmp_path / "a.html", "--start", 50), "the motion is from 2 to"),
    ):
        done = cli("view", *arguments)
        assert done.code == 2, arguments
        assert words in done.err, arguments
