"""Folder of small recordings and of the output of a batch on them."""

from __future__ import annotations

from pathlib import Path

import batch_support
import pytest


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder in which every command leaves a file."""
    folder = tmp_path / "calls"
    folder.mkdir()
    monkeypatch.setenv(batch_support.CALLS, str(folder))
    return folder


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BATCH_OUT", str(tmp_path / "out"))
    return tmp_path / "out"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return batch_support.write_recordings(
        tmp_path / "takes", s1__a="pass", s1__b="warn", s2__c="fail", s2__d="refuse", e="crash"
    )
