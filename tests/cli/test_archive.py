"""`export --to archive`: one ZIP that verifies, without video, names and paths, and that computes the same again."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtof_kin.recording.labels import Session
from rtof_kin.recording.recording import Recording


def test_an_archive_verifies_and_holds_no_video_name_or_path(cli: Any, short: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "Roe_Jane" / "take 7", tmp_path / "out"
    two = Recording.load(short)
    session = Session("Jane Roe", "Otto Mann", "2026-01-31", "Gait Lab 4", "squats")
    labels = {"name": "Roe, left knee", "session": session, "notes": "Jane limps", "acknowledgement": "by Ms Roe"}
    replace(two, keypoints=two.video[:60], **labels).save(folder)  # type: ignore[arg-type]
    (folder / "jane.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    assert cli("reconstruct", folder, "-o", out, "--mode", "sf2").code == 0
    summary = json.loads((out / "summary.json").read_text())
    summary["warnings"] = [f"{folder}/jane.mp4: Jane is far away", "Maud.toml is of another person"]
    summary["inputs"]["session"]["subject"] = "Maud"  # of the person's file
    (out / "summary.json").write_text(json.dumps(summary))
    for name in ("a.zip", "b.zip"):
        cli.ok("export", out, tmp_path / name, "--to", "archive", "--recording", folder)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        archive.extractall(tmp_path / "unpacked")
        members = {name: archive.read(name) for name in archive.namelist()}
    sums = dict(reversed(line.split("  ")) for line in members.pop("SHA256SUMS").decode().splitlines())
    assert sums == {name: hashlib.sha256(content).hexdigest() for name, content in members.items()}
    assert {"recording/recording.toml", "result/motion.h5", "result/summary.json"} <= set(members)
    text = b"\n".join(members.values()).decode("latin1")
    assert not re.search(
        r"jane|\broe\b|maud|otto|gait lab|2026-01-31|take 7|\.mp4|" + re.escape(str(tmp_path)), text, re.I
    )
    kept = json.loads(members["result/summary.json"])
    assert all(warning.startswith("[left out]") for warning in kept["warnings"][-2:])
    assert kept["settings"] == summary["settings"]
    assert kept["run"] == summary["run"]
    again = tmp_path / "again"
    bare = tmp_path / "unpacked" / "recording"
    assert cli("reconstruct", bare, "-o", again, "--mode", "sf2").code == 0
    assert (again / "motion.h5").read_bytes() == members["result/motion.h5"]


def test_another_recording_and_an_existing_file_are_refused(
    cli: Any, short: Path, reconstructed: Path, tmp_path: Path
) -> None:
    done = cli("export", reconstructed, tmp_path / "a.zip", "--to", "archive")
    assert (done.code, "no recording beside it is the one" in done.err) == (2, True)
    other = replace(Recording.load(short), height=1.5)
    other.save(tmp_path / "other")
    done = cli("export", reconstructed, tmp_path / "a.zip", "--to", "archive", "--recording", tmp_path / "other")
    assert (done.code, "other is not the recording that it was made from" in done.err) == (2, True)
    (tmp_path / "a.zip").write_bytes(b"mine")
    assert cli("export", reconstructed, tmp_path / "a.zip", "--to", "archive", "--recording", short).code == 2
    assert (tmp_path / "a.zip").read_bytes() == b"mine"
    assert cli("export", reconstructed, tmp_path / "a.zip", "--to", "archive,csv").code == 2
