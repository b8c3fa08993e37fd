"""Chains: written as the commands are typed; what each reads and writes is added."""

from __future__ import annotations

from pathlib import Path

import pytest
from batch_support import COMMANDS

from rtof_kin.batch.chain import Step, read_chain, steps_of
from rtof_kin.batch.recordings import Entry
from rtof_kin.core.errors import InvalidInputError


def test_commands_are_separated_by_commas_and_options_may_have_some() -> None:
    chain = read_chain("reconstruct --guards jumps,spikes --frames 60 ,export, report --place 'a, b'", COMMANDS)
    assert [step.command for step in chain] == ["reconstruct", "export", "report"]
    assert chain[0].arguments[3:] == ("--guards", "jumps,spikes", "--frames", "60")
    assert chain[2].arguments[5:] == ("--place", "a, b")
    assert [step.output for step in chain] == ["motion", "export", "report.html"]
    line = chain[0].line(Path("in/a b"), Path("out"), overwrite=True)
    assert line[:4] == ["reconstruct", "in/a b", "-o", "out/motion"]
    assert line[-1] == "--overwrite"


def test_a_command_that_names_its_files_is_taken_as_it_is() -> None:
    text = "overlay {out}/motion {recording}/video.mp4 -o {out}/overlay.mp4, evaluate"
    overlay, evaluate = read_chain(text, COMMANDS)
    assert overlay.output == "overlay.mp4"
    assert overlay.line(Path("r"), Path("o"), False) == ["overlay", "o/motion", "r/video.mp4", "-o", "o/overlay.mp4"]
    assert evaluate.output is None
    assert evaluate.line(Path("r"), Path("o"), True) == ["evaluate", "o/motion", "--truth", "r"]


@pytest.mark.parametrize(
    "text, named",
    [
        ("", "an empty part is no command"),
        ("reconstrct", "reconstrct is no command; e.g. inspect, reconstruct"),
        ("overlay", "what overlay reads and writes is not known"),
        ("reconstruct, reconstruct --mode imu", "two commands write motion"),
        ("reconstruct --mode 'imu", "No closing quotation"),
    ],
)
def test_a_wrong_chain_is_refused(text: str, named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        read_chain(text, COMMANDS)


def test_a_recording_has_options_of_its_own() -> None:
    chain = read_chain("reconstruct, report", COMMANDS)
    own = steps_of(chain, Entry("a", Path("a"), {"reconstruct": ("--mode", "imu")}))
    assert own == (Step("reconstruct", (*chain[0].arguments, "--mode", "imu")), chain[1])
    with pytest.raises(InvalidInputError, match="a: options of export, which is not in the chain"):
        steps_of(chain, Entry("a", Path("a"), {"export": ("--weight", "70")}))
