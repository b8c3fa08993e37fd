"""Marker names become places on the skeleton, in any spelling, and a table of the user's adds sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from marker_support import PLUG_IN_GAIT

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.markers.marker_sets import places_of, read_marker_sets


def test_every_set_is_of_points_and_segments_that_exist() -> None:
    sets, joints = read_marker_sets(), SkeletonModel.default().names
    assert {"plug_in_gait", "helen_hayes", "opencap", "cast", "ior", "rajagopal", "qualisys"} == {*sets.set}
    for one in sets.set.values():
        assert {point.partition(".")[0] for point in one.markers.values()} <= {*sets.point}
    assert {point.segment for point in sets.point.values()} <= {*joints}


def test_both_sides_mirror_each_other() -> None:
    places = places_of(PLUG_IN_GAIT)
    assert len(places.names) == 39
    at = dict(zip(places.names, places.p_bone_marker, strict=True))
    segment = dict(zip(places.names, places.segments, strict=True))
    for left in (name for name in places.names if name.startswith("L")):
        np.testing.assert_allclose(at["R" + left[1:]], at[left] * [1, -1, 1])
        assert segment["R" + left[1:]] == segment[left].replace("Left", "Right")
    assert places.points[places.names.index("RBAK")] == "right scapula"


@pytest.mark.parametrize(
    "names, expected",
    [
        (["Anna:" + name.lower() for name in PLUG_IN_GAIT] + ["Anna:wand"], "plug_in_gait"),
        (["L.ASIS", "R.ASIS", "V.Sacral", "L.Knee.Lat", "R.Knee.Lat", "L.Heel", "R.Heel"], "helen_hayes"),
        (["LASI", "RASI", "LPSI", "RTH1", "LTH1", "LTB1", "RTB1", "LCAL", "RCAL", "RLFC"], "cast"),
        (["L.ASIS", "R.ASIS", "L.GTR", "R.GTR", "L.HF", "R.HF", "L.TT", "R.TT", "L.Knee"], "ior"),
        (["L.ASIS", "R.ASIS", "S2", "L.TH1", "R.TH1", "L.SH1", "R.SH1", "L.Heel", "R.Heel"], "rajagopal"),
        (["L_IAS", "R_IAS", "L_IPS", "L_FLE", "R_FLE", "L_FAL", "R_FAL", "CV7"], "qualisys"),
        (["L.ASIS_study", "r.ASIS_study", "L.PSIS_study", "L_knee_study", "r_knee_study", "C7_study"], "opencap"),
    ],
)
def test_sets_are_recognised_by_their_names(names: list[str], expected: str) -> None:
    places = places_of(names)
    assert places.set_name == expected
    assert set(places.names) <= set(names)
    assert len(places.names) == len(names) - ("Anna:wand" in names)


def test_unknown_markers_name_what_is_expected() -> None:
    with pytest.raises(InvalidInputError, match=r"m1, m2, \.\.\.: of no known marker set \(plug_in_gait has LASI"):
        places_of(["m1", "m2"])
    with pytest.raises(InvalidInputError, match="marker set 'vicon': not in the table; known: plug_in_gait"):
        places_of(PLUG_IN_GAIT, set_name="vicon")


def test_one_of_several_people_is_chosen_by_name() -> None:
    both = [f"{who}:{name}" for who in ("Anna", "Ben") for name in PLUG_IN_GAIT]
    with pytest.raises(InvalidInputError, match="markers of several people: choose one by --marker-person: Anna, Ben"):
        places_of(both)
    places = places_of(both, person="Ben")
    assert len(places.names) == 39
    assert all(name.startswith("Ben:") for name in places.names)
    with pytest.raises(InvalidInputError, match="of no known marker set of Carl"):
        places_of(both, person="Carl")


def test_a_table_of_the_user_adds_a_set(tmp_path: Path) -> None:
    path = tmp_path / "sets.toml"
    path.write_text(
        '[set.own]\nsides = ["links", "rechts"]\nsignature = ["hueftelinks"]\n'
        '[set.own.markers]\n"huefte{s}" = "asis"\n"knie{s}" = "knee_lateral"\n',
        encoding="utf-8",
    )
    places = places_of(["hueftelinks", "huefterechts", "knielinks"], path)
    assert places.points == ("left asis", "right asis", "left knee_lateral")


@pytest.mark.parametrize(
    "text, message",
    [
        ("[set.own", "Expected"),
        ('[set.own]\nsides = ["L"]\nsignature = ["a"]\nmarkers = {}\n', "set.own.sides"),
        (
            '[set.own]\nsides = ["L", "R"]\nsignature = ["a"]\nmarkers = {a = "ear"}\n',
            "no point 'ear'; known: acromion",
        ),
        ('[set.own]\nsides = ["L", "R"]\nsignature = ["a"]\nmarkers = {}\ncolour = 1\n', "set.own.colour"),
    ],
)
def test_a_damaged_table_is_refused_with_its_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "sets.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=message):
        places_of(["a"], path)
