"""The commands report and study: output and files."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from report_support import Page


def test_report_writes_one_page(reconstructed: Path, tmp_path: Path, cli: Any) -> None:
    path = tmp_path / "page.html"
    labels = ("--code", "P07", "--date", "2026-01-31", "--protocol", "jumps")
    done = cli.ok("report", reconstructed, "-o", path, *labels)
    assert str(path) in done.out
    page = Page(path.read_text(encoding="utf-8"))
    assert page.wrong == []
    assert "P07" in page.text[""]
    verdicts, audit = (" ".join(page.text[name].split()) for name in ("verdicts", "audit"))
    assert re.search(r"Angles (good|plausible|use with care|do not use)", verdicts)
    assert "weight" in verdicts
    assert "orientation residual" in audit
    assert "reprojection error" in audit


def test_report_goes_beside_the_motion_and_overwrites_only_if_asked(
    reconstructed: Path, tmp_path: Path, cli: Any
) -> None:
    motion = shutil.copytree(reconstructed, tmp_path / "out")
    page = motion / "report.html"
    assert cli("report", motion).code == 0
    page.write_text("mine")
    assert "report.html" in cli("report", motion).err
    assert page.read_text() == "mine"
    assert cli("report", motion, "--overwrite").code == 0
    assert page.read_text() != "mine"


def test_summary_has_the_audit(reconstructed: Path) -> None:
    summary = json.loads((reconstructed / "summary.json").read_text())
    sections = ["inputs", "streams", "image", "sensors", "body", "calibration", "solver", "confidence"]
    assert {*sections} <= {result["section"] for result in summary["audit"]}
    assert [sensor["segment"] for sensor in summary["inputs"]["sensors"]] == summary["sensors"]


def test_study_writes_the_contribution_of_each_sensor(stuck: Path, tmp_path: Path, cli: Any) -> None:
    folder = tmp_path / "study"
    command = ("study", stuck, "-o", folder, "--path", "ranked", "--threads", "1")
    done = cli.ok(*command)
    done.says("2 sensors: at most 4 reconstructions", "mean difference", "matters most", "0.517 s of")
    names = {path.name for path in folder.iterdir()}
    assert names == {"study.csv", "study.json", "figures", "runs", "settings.json"}
    study = json.loads((folder / "study.json").read_text())
    assert study["verdict"]["headline"] in done.out
    assert (study["settings"]["space"], study["settings"]["frames"]) == ("joint", 50)
    assert all(sentence.split()[0] in done.out for sentence in study["sentences"])

    # The same command goes on where it stopped, with the same results.
    kept = {path.name: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}
    (folder / "runs" / "01.json").unlink()
    table = (folder / "study.csv").read_bytes()
    (folder / "study.csv").unlink()
    assert cli(*command).code == 0
    assert (folder / "study.csv").read_bytes() == table
    assert json.loads((folder / "study.json").read_text()) == study
    for path in (folder / "runs").iterdir():
        assert (path.stat().st_mtime_ns == kept[path.name]) == (path.stem != "01")

    # Results of other settings are refused, or replaced where that is wanted.
    refused = cli.refused(*command, "--frames", "60")
    assert "other settings (settings)" in refused.err
    assert "--overwrite" in refused.err
    assert (folder / "study.csv").read_bytes() == table
    assert cli(*command, "--frames", "60", "--overwrite", "--no-figures").code == 0
    assert json.loads((folder / "study.json").read_text())["settings"]["frames"] == 60
    assert not list((folder / "figures").iterdir())


@pytest.mark.parametrize("seconds", ["0", "-3", "nan"])
def test_study_of_no_seconds_is_refused(stuck: Path, tmp_path: Path, cli: Any, seconds: str) -> None:
    assert "seconds" in cli.refused("study", stuck, "-o", tmp_path / "study", "--seconds", seconds).err
    assert not (tmp_path / "study").exists()
