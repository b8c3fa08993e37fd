"""The wide table; `test_motion_files` reads its files with other readers."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import OutputExistsError
from rtof_kin.formats.motion_files import motion_columns, write_motion_csv, write_motion_parquet


def test_columns_have_different_names_and_a_row_per_frame(motion: Motion) -> None:
    columns = motion_columns(motion)
    names = [column.name for column in columns]
    # A revolute LeftLeg_y and the y of the landmark LeftLeg are two things.
    assert len(set(names)) == len(names) == 1 + 7 + 60 + 3 * 33 + 2 * 21 + 1 + 60 + 12
    assert {len(column.values) for column in columns} == {60}
    assert {column.unit for column in columns} == {"s", "m", "1", "rad", ""}
    hip = columns[names.index("RightUpLeg_y")]
    assert hip.also == {"clinical": "-right hip flexion", "opensim": "-hip_flexion_r"}


@pytest.mark.parametrize("write", [write_motion_csv, write_motion_parquet])
def test_existing_table_is_not_overwritten(write: object, motion: Motion, tmp_path: Path) -> None:
    assert callable(write)
    path = tmp_path / "motion.table"
    write(path, motion)
    with pytest.raises(OutputExistsError, match=r"motion\.table"):
        write(path, motion)
    write(path, motion[:2], overwrite=True)
