"""The commands report and study: what they print, write, refuse and return."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_support import Page

from rtof_kin.cli import main
from rtof_kin.core.files.manifest import MANIFEST
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of the demo with two sensors, no truth and no weight."""
    demo = Recording.load(model_path("demo"))
    assert demo.imus is not None
    imus = demo.imus.select(demo.imus.names[-2:])
    folder = tmp_path_factory.mktemp("recordings") / "short"
    replace(demo, keypoints=demo.video[600:660], imus=imus, truth=None).save(folder)
    return folder


@pytest.fixture(scope="module")
def motion(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("outputs") / "short"
    assert main(["reconstruct", str(short), "-o", str(out), "--no-figures"]) == 0
    return out


def test_report_writes_one_page_from_what_reconstruct_left(
    motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "page.html"
    options = ["--subject", "P07", "--date", "2026-01-31", "--protocol", "jumps"]
    assert main(["report", str(motion), "-o", str(path), *options]) == 0
    assert "opens in any browser" in capsys.readouterr().out
    page = Page(path.read_text(encoding="utf-8"))
    assert page.wrong == []
    assert "P07: motion report" in page.text[""]
    verdicts = " ".join(page.text["verdicts"].split())
    assert re.search(r"Agreement with the sensors (pass|warn) ", verdicts)
    assert "no weight is given" in verdicts
    assert "Against the known truth" not in verdicts
    audit = " ".join(page.text["audit"].split())
    assert "orientation residual across the bone, RMS" in audit
    assert "reprojection error, median" in audit


def test_report_goes_beside_the_motion_and_replaces_nothing_unasked(
    motion: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = motion / "report.html"
    assert main(["report", str(motion)]) == 0
    page.write_text("mine")
    assert main(["report", str(motion)]) == 2
    assert "report.html: is there already" in " ".join(capsys.readouterr().err.split())
    assert page.read_text() == "mine"
    assert main(["report", str(motion), "--overwrite"]) == 0
    assert "motion report" in page.read_text(encoding="utf-8")
    page.unlink()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--date", "31.1.2026"], "no day; write year, month and day"),
        (["--weight", "-3"], "mass: -3 kg is no person's; give kilograms"),
    ],
)
def test_report_refuses_labels_that_are_none(
    motion: Path, tmp_path: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "page.html"
    assert main(["report", str(motion), "-o", str(path), *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not path.exists()


def test_report_of_what_is_no_reconstruction_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert "summary.json: there is no such file" in " ".join(capsys.readouterr().err.split())


def test_the_audit_travels_in_the_summary(motion: Path) -> None:
    facts = json.loads((motion / "summary.json").read_text())
    sections = {finding["section"] for finding in facts["audit"]}
    assert sections == {
        "inputs", "streams", "image", "sensors", "body", "calibration", "solver", "confidence"
    }  # fmt: skip
    assert [s["segment"] for s in facts["inputs"]["sensors"]] == facts["sensors"]
    assert facts["inputs"]["camera"]["rate_hz"] == pytest.approx(60.0)


def test_study_says_how_many_runs_and_what_each_sensor_is_worth(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "study"
    assert main(["study", str(short), "-o", str(out), "--path", "ranked"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "2 sensors: 4 reconstructions" in text
    assert "not an error" in text
    assert "knee: flexion" in text
    assert {path.name for path in out.iterdir()} == {"study.csv", "study.json", "figures", MANIFEST}
    facts = json.loads((out / "study.json").read_text())
    assert f"all sensors: {facts['verdict']['grade']}: {facts['verdict']['headline']}" in text
    assert (facts["settings"]["space"], facts["settings"]["frames"]) == ("joint", 50)
    with (out / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    full = [float(row["difference_deg"] or 0) for row in rows if row["set"] == "full"]
    np.testing.assert_allclose(full, 0.0, atol=1e-9)
    assert any(float(row["difference_deg"] or 0) > 0.5 for row in rows if row["number"] == "1")
    assert main(["study", str(short), "-o", str(out)]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "is there already; ask to overwrite it (--overwrite;" in message


def test_study_without_sensors_is_one_line(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "blind"
    replace(Recording.load(short), imus=None, calibration=None).save(folder)
    assert main(["study", str(folder), "-o", str(tmp_path / "out")]) == 2
    assert "has no IMUs" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
