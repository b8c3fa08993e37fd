"""Maps of sensors: the ways in which people write two columns, and which sensor a line means."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.formats.sensors.sensor_map import matched, read_sensor_map
from rtof_kin.inertial.segment_names import known_segment

PLACES = {"00B42279": "pelvis", "00B4227D": "right shank"}
OPENSENSE = """<?xml version="1.0" encoding="UTF-8" ?>
<OpenSimDocument Version="40000"><XsensDataReaderSettings><trial_prefix>MT</trial_prefix>
<ExperimentalSensors>
  <ExperimentalSensor name="_00B42279"><!-- a comment --><name_in_model>pelvis</name_in_model>
  </ExperimentalSensor>
  <ExperimentalSensor name="_00B4227D"><name_in_model>right shank</name_in_model></ExperimentalSensor>
</ExperimentalSensors></XsensDataReaderSettings></OpenSimDocument>"""


def read(folder: Path, text: str) -> dict[str, str]:
    path = folder / "map.txt"
    path.write_text(text, encoding="utf-8-sig")
    return read_sensor_map(path)


@pytest.mark.parametrize(
    "text",
    [
        "00B42279,pelvis\n00B4227D,right shank\n",
        "serial, segment\r\n00B42279, pelvis\r\n00B4227D, right shank",
        "Sensor\tPlace\n00B42279\tpelvis\n\n00B4227D\t\tright shank\n",
        "# worn on 3 May\n00B42279   pelvis # loose\n  00B4227D right shank\n",
        '"serial number";"body part"\n"00B42279";"pelvis"\n"00B4227D";"right shank"\n',
        OPENSENSE,
    ],
)
def test_every_way_to_write_two_columns(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text) == PLACES


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("00B42279,pelvis\n00B4227D\n", "line 2: 1 columns"),
        ("a,pelvis\nb,pelvis\n", "line 2: 'pelvis' stands there twice"),
        ("", "empty"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "broken XML"),
    ],
)
def test_what_is_no_map_is_refused(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path, text)


def test_a_sensor_is_found_by_its_number_or_the_end_of_it() -> None:
    trial = ("00B42279", "00B4227D")
    for places in (
        {"00b42279": "pelvis", "_00B4227D": "shank"},
        {"279": "pelvis", "27D": "shank"},
        {"00:B4:22:79": "pelvis", "00B4227D": "shank"},
    ):
        assert matched(places, trial) == {"00B42279": "pelvis", "00B4227D": "shank"}
    assert matched({"Left Foot": "foot"}, ["left_foot"]) == {"left_foot": "foot"}


def test_a_map_of_the_whole_set_or_a_spare_sensor_is_no_error() -> None:
    assert matched({"A1": "pelvis", "B2": "head"}, ["A1"]) == {"A1": "pelvis"}
    assert matched({"A1": "pelvis"}, ["A1", "B2"]) == {"A1": "pelvis"}


@pytest.mark.parametrize(
    ("places", "problem"),
    [
        ({"0042": "pelvis"}, "the map has 0042, which the trial has not, and the trial has A0077, B0077"),
        ({"A0077": "pelvis", "B0078": "head"}, "the map has B0078"),
        ({"077": "pelvis"}, "'077' in the map means A0077 and B0077"),
        ({"A0077": "pelvis", "A-0077": "head"}, "'A-0077' in the map means A0077"),
        ({"7": "pelvis"}, "the map has 7"),
    ],
)
def test_a_line_that_fits_none_or_several_sensors_is_an_error(places: dict[str, str], problem: str) -> None:
    with pytest.raises(InvalidInputError, match=problem):
        matched(places, ["A0077", "B0077"])


def test_a_mistyped_map_names_file_line_and_what_may_be_meant(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text("serial,segment\n# B0078 was lost\nA0077,pelvis\nB0078,right shnk\n")
    with pytest.raises(InvalidInputError, match=r"map\.csv, line 4, the map has B0078.*mean 'B0077'\?"):
        matched(read_sensor_map(path), ["A0077", "B0077"], path)
    skeleton = SkeletonModel.default()
    with pytest.raises(
        UnknownNameError, match=r"segment in .*map\.csv, line 4 'right shnk'\. Did you mean 'right shank'"
    ):
        known_segment("right shnk", skeleton, path)
    with pytest.raises(UnknownNameError, match=r"^unknown segment 'LEFTLEGG'\. Did you mean 'LeftLeg'\?"):
        known_segment("LEFTLEGG", skeleton)
