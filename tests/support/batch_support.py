"""Small recordings and a command line with a prescribed behaviour for batches in tests."""

from __future__ import annotations

import json
import os
import signal
import time
import uuid
from collections import Counter
from pathlib import Path
from typing import Any

from rtof_kin.batch.recordings import Shard, find_recordings, read_chain
from rtof_kin.batch.run import Batch
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.text import read_text, write_text

COMMANDS = ("reconstruct", "export", "report", "evaluate", "overlay", "inspect")
CALLS = "BATCH_CALLS"
"""Environment variable: folder in which every command leaves a file."""


def write_recordings(root: Path, **doing: str) -> Path:
    """Make folders that look like recordings; what their commands do stands in them.

    Args:
        root: their parent. doing: by name, with '__' for '/': a verdict, or see `obey`.
    """
    for name, what in doing.items():
        folder = root / name.replace("__", "/")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "recording.toml").write_text(what, encoding="utf-8")
    return root


def batch_of(
    source: Path, out: Path, chain: str = "reconstruct, export, report", shard: str = "1/1", version: str = "1"
) -> Batch:
    steps = read_chain(chain, COMMANDS)
    return Batch(source, find_recordings(source, out), steps, out, version, Shard.of(shard))


def calls(folder: Path) -> Counter[str]:
    """Number of calls by 'name command'."""
    return Counter(path.name.rpartition("-")[0].replace("+", "/").replace("-", " ") for path in folder.iterdir())


def obey(line: list[str]) -> int:
    """Write what the command would, or fail as the recording says."""
    command, first, *_ = line
    output = Path(line[line.index("-o") + 1]) if "-o" in line else Path(first)
    name = output.parent.relative_to(os.environ["BATCH_OUT"]).as_posix().replace("/", "+")
    mine = Path(os.environ[CALLS]) / f"{name}-{command}-{uuid.uuid4().hex}"
    mine.touch()
    if command == "reconstruct":
        doing = read_text(Path(first) / "recording.toml", "a behaviour")
        print(f"doing {doing}")
        _do(doing, mine)
        with new_folder(output, "motion.h5", "--overwrite" in line) as folder:
            (folder / "motion.h5").write_text(doing * 100, encoding="utf-8")
            verdict = {"grade": doing.split()[0], "headline": f"this is <{doing}> & more"}
            summary = {"frames": 120, "rate_hz": 60.0, "verdict": verdict}
            (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    elif command == "report":
        write_text(output, "<p>page</p>" * 10, overwrite="--overwrite" in line)
    elif command == "export":
        with new_folder(output, "angles.csv", "--overwrite" in line) as folder:
            (folder / "angles.csv").write_text(" ".join(line[4:]), encoding="utf-8")
    else:
        print(f"{command} says so")
    return 0


def _do(doing: str, mine: Path) -> None:
    times = len(list(mine.parent.glob(mine.name.rpartition("-")[0] + "-*")))
    if doing == "refuse":
        raise InvalidInputError(f"{mine.name.split('-')[0]}: the take is too short")
    if doing == "crash":
        raise ZeroDivisionError("divided by nothing")
    if doing == "exit":
        raise SystemExit(3)
    if doing == "die" or (doing.endswith("dies once") and times == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if doing.endswith("slow"):
        time.sleep(0.5)
    if doing == "pass endless" and times == 1:
        mine.with_name("endless").write_text(str(os.getpid()))
        time.sleep(120)


def facts(rows: list[Any]) -> dict[str, str]:
    """Verdict by recording."""
    return {row.recording: row.verdict for row in rows}
