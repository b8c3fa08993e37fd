"""Clinical angles of .mot files: signs of other models, and round trips of this package's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clinical_support import walk

from rtof_kin.clinical.angles import clinical_angles, opensim_angles
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.formats.opensim import OpenSimTable, read_opensim_table, write_mot, write_sto


def table(in_degrees: bool = True, **columns: float) -> OpenSimTable:
    values = np.tile(list(columns.values()), (3, 1))
    return OpenSimTable(np.arange(3.0), tuple(columns), values, in_degrees)


@pytest.mark.parametrize("write, name", [(write_mot, "walk.mot"), (write_sto, "walk.sto")])
def test_exported_motion_has_the_angles_of_the_motion(write: object, name: str, tmp_path: Path) -> None:
    write(tmp_path / name, walk())  # type: ignore[operator]
    angles, others = opensim_angles(read_opensim_table(tmp_path / name))
    own = clinical_angles(walk())
    assert others == ()
    both = own.known & angles.known
    assert both[:, own.names.index("spine_flexion")].all()
    assert both.any(axis=0).sum() > 30
    difference = np.degrees(angles.values - own.values)[both]
    assert np.abs((difference + 180) % 360 - 180).max() < 1e-6


def test_signs_are_those_of_the_table() -> None:
    angles, others = opensim_angles(
        table(hip_flexion_r=30.0, lumbar_extension=-12.0, knee_angle_l=50.0, ankle_angle_r=-8.0, mtp_angle_r=3.0)
    )
    expected = {
        "right_hip_flexion": 30.0,
        "spine_flexion": 12.0,
        "left_knee_flexion": 50.0,
        "right_ankle_dorsiflexion": -8.0,
    }
    known = [name for name in angles.names if np.isfinite(angles[name]).all()]
    assert {name: float(np.degrees(angles[name][0])) for name in known} == pytest.approx(expected)
    assert others == ("mtp_angle_r",)
    assert angles.sigma is None


def test_radians_are_radians() -> None:
    angles, _ = opensim_angles(table(in_degrees=False, knee_angle_r=1.5))
    assert angles["right_knee_flexion"] == pytest.approx([1.5] * 3)


def test_turns_are_continuous_and_within_the_range_of_the_angle() -> None:
    values = np.array([[350.0], [355.0], [2.0]])
    angles, _ = opensim_angles(OpenSimTable(np.arange(3.0), ("hip_flexion_r",), values, True))
    assert np.degrees(angles["right_hip_flexion"]) == pytest.approx([-10, -5, 2])


def test_a_model_without_a_known_coordinate_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="hip_flexion_r"):
        opensim_angles(table(KneeFlexion=3.0))
