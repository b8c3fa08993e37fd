"""Reader of OpenSim's tables: forms of other programs, and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.opensim import read_opensim_table

GOOD = "Coordinates\nversion=1\nnRows=2\nnColumns=3\ninDegrees=yes\nendheader\ntime\tknee_angle_r\tpelvis_tx\n"
ROWS = "0.0\t10.0\t1.0\n0.1\t20.0\t1.1\n"


def read(tmp_path: Path, text: str, name: str = "a.mot") -> object:
    (tmp_path / name).write_text(text)
    return read_opensim_table(tmp_path / name)


def test_tabs_blanks_and_states_are_read(tmp_path: Path) -> None:
    for text in (GOOD + ROWS, (GOOD + ROWS).replace("\t", "   "), (GOOD + ROWS).replace("\n", "\r\n")):
        read(tmp_path, text)
        found = read_opensim_table(tmp_path / "a.mot")
        assert found.names == ("knee_angle_r", "pelvis_tx")
        np.testing.assert_allclose(found.values, [[10, 1.0], [20, 1.1]])
        assert found.rotation("knee_angle_r") == pytest.approx(np.radians([10, 20]))
        assert found.skeleton == ""
    states = "x\ninDegrees=no\nendheader\ntime\t/jointset/k/knee_angle_r/value\t/jointset/k/knee_angle_r/speed\n"
    read(tmp_path, states + ROWS)
    found = read_opensim_table(tmp_path / "a.mot")
    assert found.names == ("knee_angle_r",)
    assert found.rotation("knee_angle_r") == pytest.approx([10, 20])


def test_an_empty_cell_is_missing(tmp_path: Path) -> None:
    read(tmp_path, GOOD + "0.0\t\t1.0\n0.1\t5\t1.0\n")
    assert np.isnan(read_opensim_table(tmp_path / "a.mot").values[0, 0])


@pytest.mark.parametrize(
    "text, named",
    [
        (GOOD.replace("inDegrees=yes", "") + ROWS, "inDegrees"),
        (GOOD.replace("time", "frame") + ROWS, "time"),
        (GOOD + "0.0\tx\t1.0\n", "numbers"),
        (GOOD.replace("pelvis_tx", "knee_angle_r") + ROWS, "more than once"),
    ],
)
def test_damage_is_named(text: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=named):
        read(tmp_path, text)
