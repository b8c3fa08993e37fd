"""Events of another program in the motion of a recording."""

from __future__ import annotations

from pathlib import Path

import planted
import pytest

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.setup.run import reconstruct_folder
from rtof_kin.setup.settings import ReconstructionTask


def test_events_of_a_file_are_corrections_of_the_motion(tmp_path: Path) -> None:
    recording = planted.recording(planted.moving(SkeletonModel.default(), 12))
    start, table = recording.times[0], tmp_path / "events.tsv"
    task = ReconstructionTask(mode="sf2", events=table)
    table.write_text(f"LHS\n{start + 0.1:.3f}\n")
    found = reconstruct_folder(recording, tmp_path / "out", task=task, settings=ReconstructionSettings())
    with MotionReader(tmp_path / "out") as motion:
        assert [(one.kind, one.who) for one in motion.corrections] == [
            ("no_event", "events.tsv"),
            ("foot_strike", "events.tsv"),
        ]
    assert found.first.recording.corrections == motion.corrections
    table.write_text(f"LHS\n{start + 100:.3f}\n")
    with pytest.raises(InvalidInputError, match=r"events.tsv: its events are at .* the recording from"):
        reconstruct_folder(recording, tmp_path / "other", task=task, settings=ReconstructionSettings())
