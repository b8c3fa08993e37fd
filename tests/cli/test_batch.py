"""The command batch on real recordings: table, index, exit codes, resuming."""

from __future__ import annotations

import csv
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtof_kin.recording.recording import Recording

CHAIN = "reconstruct, report --no-figures --code 'A, B'"


@pytest.fixture(scope="module")
def takes(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One good recording of a second and two that cannot be read."""
    root = tmp_path_factory.mktemp("takes")
    two = Recording.load(short)
    replace(two, keypoints=two.video[:60]).save(root / "s1" / "good")
    shutil.copytree(root / "s1" / "good", root / "s1" / "cut")
    whole = (root / "s1/cut/keypoints.npz").read_bytes()
    (root / "s1/cut/keypoints.npz").write_bytes(whole[: len(whole) // 2])
    (root / "garbage").mkdir()
    (root / "garbage" / "recording.toml").write_text("camera = [[[")
    return root


def table(out: Path) -> dict[str, dict[str, str]]:
    with (out / "batch.csv").open(encoding="utf-8", newline="") as stream:
        return {row["recording"]: row for row in csv.DictReader(stream)}


def test_batch_of_good_and_unreadable_recordings(cli: Any, takes: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = cli("batch", takes, "-o", out, "--chain", CHAIN, "--threads", 2, "--memory-per-job", 0)
    assert done.code == 1
    done.says("2 error", f"wrote {out}/batch.csv and {out}/index.html")
    assert "2 failed; the same command tries them again" in done.err
    rows = table(out)
    assert list(rows) == ["garbage", "s1/cut", "s1/good"]
    assert "recording.toml: not readable as TOML" in rows["garbage"]["error"]
    assert rows["s1/cut"]["error"].startswith("s1/cut/keypoints.npz: damaged, or no NPZ archive")
    assert str(takes) not in (out / "batch.csv").read_text() + (out / "index.html").read_text()
    good = rows["s1/good"]
    assert (good["frames"], good["duration_s"], good["error"]) == ("60", "1.0", "")
    assert good["verdict"] in ("pass", "plausible", "warn", "fail")
    assert float(good["cpu_seconds"]) > 0.5
    assert float(good["peak_memory_mb"]) > 100
    assert "A, B" in (out / "s1/good/report.html").read_text(encoding="utf-8")
    assert 's1/good/report.html"' in (out / "index.html").read_text(encoding="utf-8")
    assert "accuracy" in (out / "s1/good/log/reconstruct.txt").read_text(encoding="utf-8")

    shutil.rmtree(takes / "garbage")
    shutil.rmtree(takes / "s1" / "cut")
    inode = (out / "s1/good/motion/motion.h5").stat().st_ino
    command = ["batch", str(takes), "-o", str(out), "--chain", CHAIN, "--threads", "1"]
    code = f"import sys; from rtof_kin.cli import main; assert main({command}) == 0; print(*sys.modules)"
    again = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "1/1" in again.stderr
    assert not {"torch", "matplotlib", "casadi", "pinocchio"} & {*again.stdout.split()}  # nor does the driver need them
    assert table(out) == {"s1/good": good}
    assert (out / "s1/good/motion/motion.h5").stat().st_ino == inode


@pytest.mark.parametrize(
    "arguments, named",
    [
        (
            ["--chain", "reconstruct --framez 3"],
            "s1/good, reconstruct: Unknown option: --framez. Did you mean --frames?",
        ),
        (["--chain", "reconstruct --help"], "asks for help"),
        (["--chain", "batch"], "batch is no command"),
        (["--chain", "reconstruct,analyse"], "chain: analyse is now report OUT --analysis FOLDER"),
        (["--chain", "view"], "what view reads and writes is not known"),
        (["--address", "host:6379"], "add --engine ray"),
        (["--shard", "2/1"], "shard 2/1"),
        (["--threads", "0"], "workers: 0"),
        (["--memory-per-job", "100000"], "this machine has"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(
    arguments: list[str], named: str, cli: Any, short: Path, tmp_path: Path
) -> None:
    root = tmp_path / "takes"
    (root / "s1").mkdir(parents=True)
    (root / "s1" / "good").symlink_to(short)
    assert named in cli.refused("batch", root, "-o", tmp_path / "out", *arguments).err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_batch_says_how_to_go_on(sent: signal.Signals, short: Path, tmp_path: Path) -> None:
    for k in range(4):
        shutil.copytree(short, tmp_path / "takes" / str(k))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "rtof_kin.cli", "batch", str(tmp_path / "takes"), "-o", str(out)]
    batch = subprocess.Popen([*command, "--threads", "1"], stderr=subprocess.PIPE, text=True)
    for _ in range(6000):
        if list(out.glob("*/log/reconstruct.txt")) or batch.poll() is not None:
            break
        time.sleep(0.02)
    batch.send_signal(sent)
    _, said = batch.communicate(timeout=60)
    assert batch.returncode == 130
    assert "the same command goes on from here" in " ".join(said.split())
    assert "Traceback" not in said
    assert (out / "index.html").is_file()
    assert not list(out.rglob("motion"))
