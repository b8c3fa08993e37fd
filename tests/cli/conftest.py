"""Commands run in this process, and excerpts of the demo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from rtof_kin.cli import main
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording


@dataclass(frozen=True)
class Done:
    """A command that ended."""

    code: int
    out: str
    """Standard output with single spaces."""
    err: str
    """Standard error, likewise."""


Cli = Callable[..., Done]


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    """Run the command line with arguments of any type."""

    def run(*arguments: object) -> Done:
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:  # argparse
            code = int(stop.code or 0)
        printed = capsys.readouterr()
        return Done(code, " ".join(printed.out.split()), " ".join(printed.err.split()))

    return run


@pytest.fixture(scope="session")
def few_sensors() -> Recording:
    """One second of the demo with two sensors and no truth."""
    demo = Recording.load(model_path("demo"))
    assert demo.imus is not None
    imus = demo.imus.select(demo.imus.names[-2:])
    return replace(demo, keypoints=demo.video[600:660], imus=imus, truth=None)


@pytest.fixture(scope="session")
def few_sensors_folder(few_sensors: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "few sensors"
    few_sensors.save(folder)
    return folder
