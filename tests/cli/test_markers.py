"""Marker trials through reconstruct and evaluate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from marker_support import planted

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.formats.markers import write_trc


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of markers, and the same with a clock that is 7.25 s late."""
    folder, markers = tmp_path_factory.mktemp("markers"), planted(5, frames=120).markers
    write_trc(folder / "trial.trc", markers)
    write_trc(folder / "late.trc", replace(markers, times=markers.times + 7.25))
    return folder / "trial.trc"


def test_a_trial_is_reconstructed_and_its_clock_is_found(trial: Path, tmp_path: Path, cli: Any) -> None:
    (tmp_path / "events.txt").write_text("\tLHS\tRTO\nITEM\tX\tX\n1\t1.25\t1.5\n")
    events = ("--events", tmp_path / "events.txt")
    done = cli.ok("reconstruct", trial, "-o", tmp_path / "out", "--marker-set", "plug_in_gait", *events)
    with MotionReader(tmp_path / "out") as motion:
        assert [(one.kind, one.what, one.who) for one in motion.corrections] == [
            ("no_event", "left", "events.txt"),
            ("no_event", "right", "events.txt"),
            ("foot_strike", "left", "events.txt"),
            ("foot_off", "right", "events.txt"),
        ]
    done.says("39 markers (plug_in_gait) on a body of 1.", "residual")
    assert (tmp_path / "out" / "motion.h5").is_file()
    cli.refused("reconstruct", trial, "-o", tmp_path / "out")
    cli.ok("report", tmp_path / "out")
    assert "from optical markers" in (tmp_path / "out" / "report.html").read_text()
    late = trial.with_name("late.trc")
    done = cli.ok("evaluate", tmp_path / "out", "--truth", late, "-o", tmp_path / "errors")
    done.says("Joint angles against late.trc", "-7.25", "estimated among all shifts", "39 markers")
    rows = (tmp_path / "errors" / "angle_errors.csv").read_text().splitlines()
    column = rows[0].split(",").index("rmse_deg")
    errors = {row.split(",")[0]: float(row.split(",")[column]) for row in rows[1:]}
    assert errors["knee_flexion"] < 0.5
    assert errors["all"] < 2.0


def test_what_is_no_trial_is_refused(trial: Path, tmp_path: Path, cli: Any) -> None:
    done = cli.refused("reconstruct", trial, "-o", tmp_path / "out", "--marker-set", "vicon")
    assert "known: plug_in_gait, helen_hayes, opencap" in done.err
    done = cli.refused("evaluate", tmp_path, "--truth", tmp_path / "none.c3d")
    assert "motion" in done.err
