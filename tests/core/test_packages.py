"""Optional packages: one sentence where they are missing."""

from __future__ import annotations

import logging
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from rtof_kin.core.errors import MissingPackageError
from rtof_kin.core.packages import can_draw, install, optional

ROOT = Path(__file__).parents[2]


def test_a_package_that_is_there_is_imported() -> None:
    assert optional("numpy.linalg", "lift") is sys.modules["numpy.linalg"]


def test_a_missing_package_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    said = 'reading a video needs av, which is not installed: pip install "rtof-kin[video]"'
    with pytest.raises(MissingPackageError) as caught:
        optional("av", "video", "reading a video")
    assert str(caught.value) == said
    with pytest.raises(MissingPackageError, match="no_such, which is not installed: conda install x"):
        optional("no_such.part", "", remedy="conda install x")


def test_a_broken_package_is_told_from_a_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "half.py").write_text("import no_such_part", encoding="utf-8")
    (tmp_path / "without_library.py").write_text("raise OSError('libx.so: not found')", encoding="utf-8")
    with pytest.raises(MissingPackageError, match=r"half, which cannot be loaded \(No module named 'no_such"):
        optional("half", "live")
    with pytest.raises(MissingPackageError, match=r"cannot be loaded \(libx.so: not found\)"):
        optional("without_library", "live")


def test_every_extra_that_is_named_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = [path.read_text(encoding="utf-8") for folder in ("rtof_kin", "lifting") for path in files(folder)]
    called = {extra for extra in project["optional-dependencies"] if any(f'"{extra}"' in t for t in texts)}
    assert called >= {"lift", "figures", "video", "view", "live", "cluster", "parquet", "onnx", "mediapipe"}
    assert install("lift") == 'pip install "rtof-kin[lift]"'


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def test_without_torch_the_lifter_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "lifting"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPackageError, match=r"the lifter.* needs torch.*\"rtof-kin\[lift\]\""):
        import_module("lifting.predict")


def test_without_matplotlib_figures_are_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with caplog.at_level(logging.WARNING):
        assert not can_draw()
    assert "figures are left out: a figure needs matplotlib" in caplog.text
