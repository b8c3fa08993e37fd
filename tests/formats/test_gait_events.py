"""Gait events of files that ezc3d and a hand wrote, as corrections that replace those that are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from clinical_support import body_paths, walking

from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.laboratory import trial_results
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.corrections import Correction
from rtof_kin.formats.gait_events import read_event_corrections
from rtof_kin.formats.motion_files import write_motion_files
from rtof_kin.formats.trial_results import Beside

CLOCK = np.arange(0.0, 9.1, 0.1)
VISUAL3D = (
    "\twalk.c3d\twalk.c3d\twalk.c3d\twalk.c3d\n"
    "\tLHS\tRTO\tRHS\tSTART\n"
    "\tEVENT_LABEL\tEVENT_LABEL\tEVENT_LABEL\tEVENT_LABEL\n"
    "\tORIGINAL\tORIGINAL\tORIGINAL\tORIGINAL\n"
    "ITEM\tX\tX\tX\tX\n"
    "1\t1.25\t1.5\t0.7\t0\n"
    "2\t2.5\t\t1.9\t\n"
)


def test_a_table_of_visual3d_has_events_in_columns(tmp_path: Path) -> None:
    (tmp_path / "walk.txt").write_text(VISUAL3D)
    found = read_event_corrections(tmp_path / "walk.txt", CLOCK)
    assert found[:2] == (
        Correction("no_event", "left", who="walk.txt"),
        Correction("no_event", "right", who="walk.txt"),
    )
    assert [(one.kind, one.what, one.start_s) for one in found[2:]] == [
        ("foot_strike", "right", 0.7),
        ("foot_strike", "left", 1.25),
        ("foot_off", "right", 1.5),
        ("foot_strike", "right", 1.9),
        ("foot_strike", "left", 2.5),
    ]


def c3d_of(path: Path, events: list[tuple[float, str, str]]) -> Path:
    """A file by ezc3d's own method for events."""
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    file["data"]["points"] = np.ones((4, 1, 2))
    for time, context, label in events:
        file.add_event([*divmod(time, 60)], context, label, "x", "x")
    file.write(str(path))
    return path


def test_events_of_a_c3d_by_ezc3d_replace_those_of_their_feet(tmp_path: Path) -> None:
    planted = [
        (61.5, "Left", "Foot Strike"),
        (62.25, "General", "Event"),
        (63.0, "Left", "Foot Off"),
        (63.5, "R", "RTO"),
    ]
    path = c3d_of(tmp_path / "lab.c3d", planted)
    corrections = read_event_corrections(path, CLOCK + 60)
    assert {one.who for one in corrections} == {"lab.c3d"}
    motion = walking(3.0)
    times = motion.times + 60.5
    motion = replace(motion, poses=replace(motion.poses, times=times), corrections=corrections)
    feet = gait_events(body_paths(motion)).feet
    np.testing.assert_allclose([feet["left"].strikes[0], feet["left"].offs[0]], [61.5, 63.0], atol=1e-5)
    assert [len(feet[side].strikes) + len(feet[side].offs) for side in ("left", "right")] == [2, 1]
    with pytest.raises(InvalidInputError, match="events are at 61.50 to 63.50 s, the recording from 0.00 to 9"):
        read_event_corrections(path, CLOCK)


def test_exported_events_are_read_back(tmp_path: Path) -> None:
    motion = walking(3.0)
    write_motion_files(tmp_path, motion, ("c3d",), Beside(trial_results))
    before = gait_events(body_paths(motion)).feet
    corrected = replace(motion, corrections=read_event_corrections(tmp_path / "motion.c3d", motion.times))
    after = gait_events(body_paths(corrected)).feet
    for side, foot in before.items():
        np.testing.assert_allclose(after[side].strikes, foot.strikes, atol=1e-6)
        np.testing.assert_allclose(after[side].offs, foot.offs, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content"), [("a.txt", "time\tside\n1\tL\n"), ("b.c3d", None), ("c.tsv", "LHS\tRTO\nnan\t\n")]
)
def test_a_file_without_usable_events_is_refused(name: str, content: str | None, tmp_path: Path) -> None:
    if content is None:
        c3d_of(tmp_path / name, [])
    else:
        (tmp_path / name).write_text(content)
    with pytest.raises(FileFormatError, match="no foot strike"):
        read_event_corrections(tmp_path / name, CLOCK)
