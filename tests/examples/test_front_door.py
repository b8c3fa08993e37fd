"""The examples in the docstrings of the front door are executed, on a second of the demo."""

from __future__ import annotations

import doctest
import inspect
from dataclasses import replace
from pathlib import Path

import pytest

import rtof_kin
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import write_raw_files

FUNCTIONS = [name for name in rtof_kin.__all__ if inspect.isfunction(getattr(rtof_kin, name))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording, the files of a take, and what `export` writes."""
    folder, demo = tmp_path_factory.mktemp("front_door"), Recording.load(model_path("demo"))
    replace(demo, keypoints=demo.video[600:660]).save(folder / "recording")
    write_raw_files(demo.between(0.0, 6.0), folder / "take")
    return folder


@pytest.mark.parametrize("name", sorted(FUNCTIONS, key=lambda name: name != "export"))
def test_the_example_of_a_function_runs(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (example,) = doctest.DocTestFinder(recurse=False).find(getattr(rtof_kin, name), name, globs={})
    assert 3 <= len(example.examples) <= 6
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)
    assert result.failed == 0
    assert result.attempted == len(example.examples)


def test_the_front_door_is_small_and_has_its_functions() -> None:
    assert len(rtof_kin.__all__) <= 24
    steps = ["analyse", "compare", "evaluate", "export", "make_recording", "reconstruct", "report", "run"]
    assert sorted(FUNCTIONS) == steps
