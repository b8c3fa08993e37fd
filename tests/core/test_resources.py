from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.core import resources
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.resources import LIFTERS, lifter_path, model_path


def test_installed_package_takes_precedence_over_the_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, checkout = tmp_path / "package", tmp_path / "checkout"
    monkeypatch.setattr(resources, "PACKAGED", package)
    monkeypatch.setattr(resources, "CHECKOUT", checkout)
    with pytest.raises(FileFormatError, match="there is: nothing.*reinstall the package"):
        model_path("both.toml")
    for path in (package / "both.toml", checkout / "both.toml", checkout / "one.toml"):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert model_path("both.toml") == package / "both.toml"
    assert model_path("one.toml") == checkout / "one.toml"
    with pytest.raises(FileFormatError, match=r"none\.toml: no such file ships .*one\.toml"):
        model_path("none.toml")


@pytest.mark.parametrize("name", list(LIFTERS))
def test_shipped_lifter_is_found_by_name_and_by_file(name: str) -> None:
    path = lifter_path(name)
    assert path == lifter_path(Path(name)) == lifter_path(path) == model_path(LIFTERS[name])
    assert lifter_path(None) == lifter_path("detections")
