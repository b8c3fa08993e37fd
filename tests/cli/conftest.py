"""Commands run in this process, and recordings and outputs for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.cli import main
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording


@dataclass(frozen=True)
class Done:
    """A command that ended; its texts have single spaces."""

    code: int
    out: str
    err: str

    def says(self, *texts: str) -> None:
        """Check that each of some texts was printed."""
        assert [text for text in texts if text not in self.out] == [], self.out


@dataclass(frozen=True)
class Cli:
    """The command line with arguments of any type."""

    capsys: pytest.CaptureFixture[str]

    def __call__(self, *arguments: object) -> Done:
        self.capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        printed = self.capsys.readouterr()
        return Done(code, " ".join(printed.out.split()), " ".join(printed.err.split()))

    def ok(self, *arguments: object) -> Done:
        """Run a command that succeeds."""
        done = self(*arguments)
        assert done.code == 0, done.err
        return done

    def refused(self, *arguments: object) -> Done:
        """Run a command that refuses its input in one line."""
        done = self(*arguments)
        assert (done.code, done.err.count("error: ")) == (2, 1), done.err
        return done


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(capsys)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="session")
def short(folder: Path) -> Path:
    """Two seconds of the demo as a recording folder."""
    demo = Recording.load(model_path("demo"))
    replace(demo, keypoints=demo.video[600:720]).save(folder / "short")
    return folder / "short"


@pytest.fixture(scope="session")
def reconstructed(short: Path, folder: Path) -> Path:
    """The output folder of `reconstruct` on it."""
    assert main(["reconstruct", str(short), "-o", str(folder / "out")]) == 0
    return folder / "out"


@pytest.fixture(scope="session")
def stuck(folder: Path) -> Path:
    """Half a second of the demo without truth; one of two sensors repeats a sample for most of it."""
    demo = Recording.load(model_path("demo"))
    assert demo.imus is not None
    imus, keypoints = demo.imus.select(demo.imus.names[-2:]), demo.video[600:632]
    repeated = np.flatnonzero((imus.times > keypoints.times[2]) & (imus.times < keypoints.times[-2]))
    R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
    R[repeated, 0], f[repeated, 0] = R[repeated[0], 0], f[repeated[0], 0]
    imus = replace(imus, R_inertial_sensor=R, f_sensor=f)
    replace(demo, keypoints=keypoints, imus=imus, truth=None).save(folder / "stuck")
    return folder / "stuck"
