"""The first line that a user reads: the most serious finding, or what was checked and what was not."""

from __future__ import annotations

import json

from rtof_kin.report.audit_results import FAILED_FRAGMENTS, UNOBSERVED_FRAGMENTS, Finding, Grade
from rtof_kin.report.headline import headline

SEEN = Finding("image", "error", "Head", 1.0, "px", 2.0, 5.0)
OFF = Finding("image", "error", "Foot", 50.0, "px", 2.0, 5.0, note="the camera is off")
LOOSE = Finding("sensors", "residual", "LeftLeg", 3.0, "deg", 2.0, 5.0, note="mounting")
LOST = Finding("solver", UNOBSERVED_FRAGMENTS, "all", 10.0, "%", 0.0, 50.0, note="the prior alone.")
GONE = Finding("solver", FAILED_FRAGMENTS, "all", 20.0, "%", 0.0, 10.0, note="gave up.")
FOCAL = Finding(
    "inputs", "height in the picture", "camera", 0.2, "1", 0.1, 0.1, "limit of the check",
    "the focal length is too short: compare it with the camera's file",
)  # fmt: skip
DOUBT = Finding.doubt("streams", "motion", "two sensors are exchanged")


def test_what_is_declared_wrongly_comes_first_and_begins_with_its_likely_cause() -> None:
    found = headline([OFF, LOST, GONE, LOOSE, FOCAL, SEEN])
    assert found.grade is Grade.FAIL
    assert found.line.startswith("fail: the focal length is too short")
    assert "camera: height in the picture 0.2 1, above 0.1 1" in found.text
    assert "more fails in image, solver; more warns in solver, sensors" in found.text
    assert "\n" not in found.line


def test_then_lost_frames_then_what_fails_then_what_warns() -> None:
    assert "gave up" in headline([OFF, LOOSE, LOST, GONE]).text
    lost = headline([OFF, LOOSE, LOST])
    assert "the prior alone" in lost.text
    assert lost.grade is Grade.FAIL  # of the image, which stands beside it
    assert "the camera is off" in headline([LOOSE, DOUBT, OFF]).text
    assert headline([SEEN, LOOSE]).line == "warn: LeftLeg: residual 3 deg (above 2 deg): mounting"


def test_what_is_told_in_words_goes_before_a_figure_that_warns() -> None:
    fault = Finding("streams", "fault, duration", "LeftLeg", 2.0, "s", -1.0, note="it stuck")
    assert headline([LOOSE, fault, DOUBT]).text.startswith("motion: two sensors are exchanged")


def test_where_nothing_is_found_it_says_what_was_checked_and_what_could_not_be() -> None:
    unknown = Finding.untold("inputs", "camera", "the person does not move", "distance")
    weak = Finding.remark("calibration", "30 quantities", "1 observed, 29 weakly observed", weak=True)
    found = headline([unknown, SEEN, weak])
    assert found.grade is Grade.PASS
    assert "nothing found in image;" in found.text
    assert "calibration: 30 quantities: 1 observed, 29 weakly observed" in found.text
    assert "not checked: camera: distance: the person does not move" in found.text
    assert "no truth" in found.text
    truth = Finding("truth", "error", "motion", 20.0, "mm")
    assert "no truth" not in headline([unknown, SEEN, weak, truth]).text


def test_without_a_single_check_nothing_passes() -> None:
    assert headline([]).grade is Grade.UNTOLD
    assert headline([Finding.untold("gait", "strides", "two seconds")]).grade is Grade.UNTOLD
    weak = Finding.remark("calibration", "2 quantities", "2 taken from the prior", weak=True)
    assert headline([weak]).grade is Grade.WEAK


def test_the_summary_has_grade_headline_and_the_sections_that_were_looked_at() -> None:
    plain = json.loads(json.dumps(headline([SEEN, LOOSE]).plain()))
    assert plain["grade"] == "warn"
    assert plain["headline"].startswith("LeftLeg")
    assert plain["sections"] == {"image": "pass", "sensors": "warn"}
