"""Trainings whose curves are data alone."""

from __future__ import annotations

import pytest


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take away the figure of the curves, which takes longer than a short training."""
    monkeypatch.setattr("lifting.training.train.can_draw", lambda: False)
