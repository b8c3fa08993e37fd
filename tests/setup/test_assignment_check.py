"""Wrong maps of sensors are found and corrected, right ones are left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assignment_support import SOME, exchanged, places, some, walk, walking_log, walking_poses

from rtof_kin.calibration.assignment import check_assignment
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.reconstruction.checks.sensors import check_recording


def test_a_right_map_is_left_alone() -> None:
    own = {name: places()[name] for name in SOME}
    for poses in (None, walking_poses()):
        check = check_assignment(walking_log(), own, walk().skeleton, poses)
        assert check.joints == own
        assert not check.wrong
        assert check.check().passed


def test_exchanged_legs_are_named_with_the_correction() -> None:
    own = {name: places()[name] for name in SOME}
    wrong = own | {"L_LowLeg": "RightLeg", "R_LowLeg": "LeftLeg"}
    check = check_assignment(walking_log(), wrong, walk().skeleton, walking_poses())
    assert check.joints == own
    assert {sensor.sensor for sensor in check.wrong} == {"L_LowLeg", "R_LowLeg"}
    assert check.check().failed
    assert "L_LowLeg, declared on RightLeg, is on LeftLeg" in check.check().advice


def test_two_sensors_on_one_segment_are_an_error() -> None:
    twice = {"L_LowLeg": "LeftLeg", "R_LowLeg": "LeftLeg"}
    with pytest.raises(InvalidInputError, match="two sensors on LeftLeg"):
        check_assignment(walking_log(), twice, walk().skeleton)


def test_exchanged_samples_of_a_recording_get_each_other_s_calibration() -> None:
    right = some()
    check, corrected = check_recording(exchanged(right, "L_UpLeg", "R_UpLeg"))
    assert {sensor.sensor for sensor in check.wrong} == {"L_UpLeg", "R_UpLeg"}
    assert corrected.calibration is not None
    assert right.calibration is not None
    a, b = SOME.index("L_UpLeg"), SOME.index("R_UpLeg")
    np.testing.assert_allclose(corrected.calibration.R_sensor_bone[[a, b]], right.calibration.R_sensor_bone[[b, a]])
    assert corrected.calibration.joints[a] == "RightUpLeg"


def test_a_right_recording_comes_back_as_it_is() -> None:
    right = some()
    check, same = check_recording(right)
    assert not check.wrong
    assert same is right


def test_a_recording_without_sensors_is_an_error() -> None:
    with pytest.raises(InvalidInputError, match="no calibrated sensors"):
        check_recording(replace(walk(), imus=None, calibration=None))
