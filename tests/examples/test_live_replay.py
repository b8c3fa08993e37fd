"""The example of a live session, with an estimator that does no mathematics."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
from live_support import FakeEstimator

from rtof_kin.core.resources import model_path

EXAMPLE = Path(__file__).parents[2] / "examples" / "live_replay.py"


def test_a_replayed_recording_prints_lag_and_what_was_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [EXAMPLE.name, str(model_path("demo")), "1.2"])
    monkeypatch.setattr("rtof_kin.live.estimator.OnlineEstimator", lambda *_: FakeEstimator())
    runpy.run_path(str(EXAMPLE))
    printed = capsys.readouterr().out
    assert "lag 0 ms" in printed
    assert "of the samples do not come" in printed
