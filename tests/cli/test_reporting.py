"""The commands report and study: output and files."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

from report_support import Page

from rtof_kin.core.files.manifest import MANIFEST


def test_report_writes_one_page(reconstructed: Path, tmp_path: Path, cli: Any) -> None:
    path = tmp_path / "page.html"
    labels = ("--subject", "P07", "--date", "2026-01-31", "--protocol", "jumps")
    done = cli("report", reconstructed, "-o", path, *labels)
    assert done.code == 0
    assert str(path) in done.out
    page = Page(path.read_text(encoding="utf-8"))
    assert page.wrong == []
    assert "P07" in page.text[""]
    verdicts, audit = (" ".join(page.text[name].split()) for name in ("verdicts", "audit"))
    assert re.search(r"sensors (pass|warn) ", verdicts)
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
    assert {result["section"] for result in summary["audit"]} >= {
        "inputs", "streams", "image", "sensors", "body", "calibration", "solver", "confidence"
    }  # fmt: skip
    assert [sensor["segment"] for sensor in summary["inputs"]["sensors"]] == summary["sensors"]


def test_study_writes_the_contribution_of_each_sensor(stuck: Path, tmp_path: Path, cli: Any) -> None:
    command = ("study", stuck, "-o", tmp_path / "study", "--path", "ranked")
    done = cli(*command)
    assert done.code == 0
    for text in ("2 sensors: 4 reconstructions", "difference", "knee: flexion"):
        assert text in done.out
    names = {path.name for path in (tmp_path / "study").iterdir()}
    assert names == {"study.csv", "study.json", "figures", MANIFEST}
    study = json.loads((tmp_path / "study" / "study.json").read_text())
    assert study["verdict"]["headline"] in done.out
    assert (study["settings"]["space"], study["settings"]["frames"]) == ("joint", 50)
    assert "--overwrite" in cli(*command).err
