"""The commands report and study: output, files, refusals and exit codes."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_support import Page

from rtof_kin.cli import main
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.recording.recording import Recording

Cli = Any


@pytest.fixture(scope="module")
def motion(few_sensors_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("outputs") / "short"
    assert main(["reconstruct", str(few_sensors_folder), "-o", str(out), "--no-figures"]) == 0
    return out


def test_report_writes_one_page(motion: Path, tmp_path: Path, cli: Cli) -> None:
    path = tmp_path / "page.html"
    labels = ("--subject", "P07", "--date", "2026-01-31", "--protocol", "jumps")
    done = cli("report", motion, "-o", path, *labels)
    assert done.code == 0
    assert str(path) in done.out
    page = Page(path.read_text(encoding="utf-8"))
    assert page.wrong == []
    assert "P07" in page.text[""]
    verdicts, audit = (" ".join(page.text[name].split()) for name in ("verdicts", "audit"))
    assert re.search(r"sensors (pass|warn) ", verdicts)
    assert "weight" in verdicts
    assert "known truth" not in verdicts
    assert "orientation residual" in audit
    assert "reprojection error" in audit


def test_report_goes_beside_the_motion_and_overwrites_only_if_asked(motion: Path, cli: Cli) -> None:
    page = motion / "report.html"
    assert cli("report", motion).code == 0
    page.write_text("mine")
    done = cli("report", motion)
    assert done.code == 2
    assert "report.html" in done.err
    assert page.read_text() == "mine"
    assert cli("report", motion, "--overwrite").code == 0
    assert page.read_text() != "mine"
    page.unlink()


@pytest.mark.parametrize("options, named", [
    (["{motion}", "--date", "31.1.2026"], "31.1.2026"), (["{motion}", "--weight", "-3"], "-3 kg"),
    (["nowhere"], "summary.json"),
])  # fmt: skip
def test_report_refuses_wrong_input(
    motion: Path, tmp_path: Path, cli: Cli, options: list[str], named: str
) -> None:
    path = tmp_path / "page.html"
    done = cli("report", *(option.format(motion=motion) for option in options), "-o", path)
    assert done.code == 2
    assert named in done.err
    assert not path.exists()


def test_summary_has_the_audit(motion: Path) -> None:
    summary = json.loads((motion / "summary.json").read_text())
    sections = {result["section"] for result in summary["audit"]}
    assert sections == {
        "inputs", "streams", "image", "sensors", "body", "calibration", "solver", "confidence"
    }  # fmt: skip
    assert [sensor["segment"] for sensor in summary["inputs"]["sensors"]] == summary["sensors"]
    assert summary["inputs"]["camera"]["rate_hz"] == pytest.approx(60.0)


def test_study_writes_the_contribution_of_each_sensor(
    few_sensors_folder: Path, tmp_path: Path, cli: Cli
) -> None:
    out = tmp_path / "study"
    done = cli("study", few_sensors_folder, "-o", out, "--path", "ranked")
    assert done.code == 0
    assert "2 sensors: 4 reconstructions" in done.out
    assert "difference" in done.out  # without a truth there are no errors
    assert "knee: flexion" in done.out
    assert {path.name for path in out.iterdir()} == {"study.csv", "study.json", "figures", MANIFEST}
    study = json.loads((out / "study.json").read_text())
    assert study["verdict"]["headline"] in done.out
    assert (study["settings"]["space"], study["settings"]["frames"]) == ("joint", 50)
    with (out / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    full = [float(row["difference_deg"] or 0) for row in rows if row["set"] == "full"]
    np.testing.assert_allclose(full, 0.0, atol=1e-9)
    assert any(float(row["difference_deg"] or 0) > 0.5 for row in rows if row["number"] == "1")
    again = cli("study", few_sensors_folder, "-o", out)
    assert again.code == 2
    assert "--overwrite" in again.err


def test_study_needs_sensors(few_sensors: Recording, tmp_path: Path, cli: Cli) -> None:
    folder = tmp_path / "camera_only"
    replace(few_sensors, imus=None, calibration=None).save(folder)
    done = cli("study", folder, "-o", tmp_path / "out")
    assert done.code == 2
    assert "no IMUs" in done.err
    assert not (tmp_path / "out").exists()
