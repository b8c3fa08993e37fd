"""Tables of coordinates and states; in `test_motion_files` OpenSim moves the model by them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.core.errors import InvalidInputError, OutputExistsError
from rtof_kin.formats.opensim_mot import coordinate_values, write_mot, write_sto


def read(path: Path) -> tuple[list[str], list[str], np.ndarray]:
    """Header, names and numbers, taken apart by hand."""
    lines = path.read_text().splitlines()
    end = lines.index("endheader")
    rows = [[float(cell) for cell in line.split("\t")] for line in lines[end + 2 :]]
    return lines[:end], lines[end + 1].split("\t"), np.array(rows)


def test_mot_has_degrees_metres_and_the_announced_counts(motion: MotionSequence, tmp_path: Path) -> None:
    write_mot(tmp_path / "walk.mot", motion)
    header, names, table = read(tmp_path / "walk.mot")
    assert header[:5] == ["walk", "version=1", "nRows=60", "nColumns=67", "inDegrees=yes"]
    assert any("total_capture, zero in the T-pose; y is up" in line for line in header)
    assert table.shape == (60, 67)
    np.testing.assert_allclose(table[:, 0], motion.times, rtol=1e-15)
    knee = motion.q[:, 7 + motion.skeleton.dof_names.index("RightLeg_y")]
    np.testing.assert_allclose(table[:, names.index("knee_angle_r")], np.degrees(knee), rtol=1e-14)
    np.testing.assert_array_equal(table[:, names.index("pelvis_ty")], motion.q[:, 2])


def test_sto_has_radians_speeds_and_state_paths(motion: MotionSequence, tmp_path: Path) -> None:
    write_sto(tmp_path / "walk.sto", motion)
    header, names, table = read(tmp_path / "walk.sto")
    assert header[2:5] == ["nRows=60", "nColumns=133", "inDegrees=no"]
    assert names[1] == "/jointset/Hips/pelvis_tilt/value"
    assert names[-1] == "/jointset/LeftFoot/LeftFoot_z/speed"
    _, values = coordinate_values(motion)
    np.testing.assert_array_equal(table[:, 1:67], values)
    central = (values[2:] - values[:-2]) * 60 / 2
    np.testing.assert_allclose(table[1:-1, 67:], central, atol=1e-9)


def test_single_frame_has_no_speed(motion: MotionSequence, tmp_path: Path) -> None:
    write_sto(tmp_path / "one.sto", motion[:1])
    assert not read(tmp_path / "one.sto")[2][:, 67:].any()


@pytest.mark.parametrize("write", [write_mot, write_sto])
def test_gaps_uneven_times_and_existing_files_are_refused(
    write: object, motion: MotionSequence, tmp_path: Path
) -> None:
    assert callable(write)
    q = np.array(motion.q)
    q[7] = np.nan
    with pytest.raises(InvalidInputError, match="frame 7"):
        write(tmp_path / "a.mot", replace(motion, q=q))
    times = np.array(motion.times)
    times[30:] += 0.1
    with pytest.raises(InvalidInputError, match="even times"):
        write(tmp_path / "a.mot", replace(motion, poses=replace(motion.poses, times=times)))
    assert not (tmp_path / "a.mot").exists()
    write(tmp_path / "a.mot", motion)
    with pytest.raises(OutputExistsError, match=r"a\.mot"):
        write(tmp_path / "a.mot", motion)
    write(tmp_path / "a.mot", motion[:9], overwrite=True)
    assert len(read(tmp_path / "a.mot")[2]) == 9
