from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.core import resources
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.resources import LIFTERS, lifter_path, model_path


def test_shipped_files_are_found() -> None:
    assert model_path("skeleton.toml").read_text(encoding="utf-8").startswith("#")


def test_the_installed_package_goes_before_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "skeleton.toml").write_text("installed")
    monkeypatch.setattr(resources, "PACKAGED", tmp_path)
    assert model_path("skeleton.toml").read_text() == "installed"


def test_a_file_that_does_not_ship_is_named_with_those_that_do() -> None:
    with pytest.raises(FileFormatError, match=r"lifter9\.pt: no such file ships .*skeleton\.toml"):
        model_path("lifter9.pt")


def test_without_any_models_the_message_still_helps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resources, "PACKAGED", tmp_path / "a")
    monkeypatch.setattr(resources, "CHECKOUT", tmp_path / "b")
    with pytest.raises(FileFormatError, match="there is: nothing.*reinstall the package"):
        model_path("skeleton.toml")


@pytest.mark.parametrize("name", list(LIFTERS))
def test_a_shipped_lifter_is_found_by_its_name_and_by_its_file(name: str) -> None:
    path = lifter_path(name)
    assert path == lifter_path(Path(name)) == lifter_path(path) == model_path(LIFTERS[name])


def test_the_default_lifter_is_that_for_detections() -> None:
    assert lifter_path(None) == lifter_path("detections")


def test_a_lifter_that_is_none_is_named_with_those_that_ship(tmp_path: Path) -> None:
    for nothing in (tmp_path / "none.pt", tmp_path):
        with pytest.raises(FileFormatError, match="no such file; .*: detections, perfect, causal"):
            lifter_path(nothing)
