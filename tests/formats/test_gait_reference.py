"""Files of gait references: round trip, tables, and hostile inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gait_support import ABOUT, MEAN, means_only, people_curves, reference_of

from rtof_kin.core.errors import FileFormatError, OutputExistsError, UnknownNameError
from rtof_kin.data.gait_reference import NAMES, PERCENT
from rtof_kin.formats.gait_reference import read_gait_reference, read_gait_reference_table, write_gait_reference


def test_round_trip_with_and_without_people(tmp_path: Path) -> None:
    mean = np.array(MEAN)
    mean[8] = np.nan
    for number, given in enumerate((reference_of(people_curves(3, 1), notes=("one",)), means_only(mean))):
        path = tmp_path / f"{number}.json"
        write_gait_reference(path, given)
        read = read_gait_reference(path)
        np.testing.assert_allclose(read.mean, given.mean, atol=2e-8)
        assert (read.curves is None) == (given.curves is None)
        if given.curves is not None and read.curves is not None:
            np.testing.assert_allclose(read.curves, given.curves, atol=2e-8)
        same = ("people", "licence", "source", "system", "zero", "names", "strides", "notes", "missing", "is_own")
        assert [getattr(read, name) for name in same] == [getattr(given, name) for name in same]
        assert read.speeds == pytest.approx(given.speeds)
        with pytest.raises(OutputExistsError):
            write_gait_reference(path, given)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, "null", '{"format": "gait reference"}'])
def test_no_reference_at_all(tmp_path: Path, text: str) -> None:
    path = tmp_path / "reference.json"
    path.write_text(text)
    with pytest.raises(FileFormatError):
        read_gait_reference(path)


def table(path: Path, percent: Any = PERCENT, names: Any = NAMES, header: str = "variable,percent,mean,sd") -> Path:
    lines = [header]
    for name in names:
        curve = np.interp(percent, PERCENT, np.degrees(MEAN[NAMES.index(name)]))
        lines += [f"{name},{p:g},{value:.8f},2.5" for p, value in zip(percent, curve, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_of_means_is_a_reference_without_people(tmp_path: Path) -> None:
    path = table(tmp_path / "normal.csv", names=NAMES[:-1])
    found = read_gait_reference_table(path, negated=["hip_rotation"], people=30, **(ABOUT | {"system": "Vicon"}))
    sign = np.where(np.array(NAMES[:-1]) == "hip_rotation", -1, 1)[:, None]
    np.testing.assert_allclose(found.mean[:-1], sign * MEAN[:-1], atol=1e-9)
    assert found.missing == ("foot_progression",)
    assert not found.is_own
    assert found.curves is None
    fine = table(tmp_path / "fine.csv", percent=np.arange(101))
    np.testing.assert_allclose(read_gait_reference_table(fine, people=30, **ABOUT).mean, MEAN, atol=1e-9)


def test_radians_and_unknown_names_are_refused(tmp_path: Path) -> None:
    path = table(tmp_path / "normal.csv", percent=[0, 50, 100])
    with pytest.raises(FileFormatError, match="5 % apart"):
        read_gait_reference_table(path, people=3, **ABOUT)
    with pytest.raises(UnknownNameError, match="hip_rotation"):
        read_gait_reference_table(path, negated=["hip_rotatoin"], people=3, **ABOUT)


@pytest.mark.parametrize(
    "change, named",
    [
        (lambda t: t.replace("variable,", "name,", 1), "variable"),
        (lambda t: t.replace(",2.5", ",x", 1), "sd"),
        (lambda t: t.replace(",2.5", "", 1), "cells"),
        (lambda t: t + "pelvic_tilt,0,nan,1\n", "finite"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path: Path, change: Any, named: str) -> None:
    path = table(tmp_path / "normal.csv")
    path.write_text(change(path.read_text()))
    with pytest.raises(FileFormatError, match=named):
        read_gait_reference_table(path, people=3, **ABOUT)
