"""Plans: comparisons of cameras and sensors, sentences and files."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.plan import plan as planning
from rtof_kin.plan.document import COLUMNS, MARKER, advice, cautions, headline, write_plan
from rtof_kin.plan.identifiability import ROOT, Information
from rtof_kin.plan.operator_page import INSTRUCTIONS
from rtof_kin.plan.plan import Plan, plan
from rtof_kin.plan.prediction import ENOUGH, PLANTED, CalibrationTime, Prediction, calibration_time, planted
from rtof_kin.plan.protocol import CameraPlace, Protocol
from rtof_kin.plan.setup import Setup, planned
from rtof_kin.recording.subject import read_subject

NAMES = ("pelvis_tilt", "right_hip_flexion", "right_knee_flexion", "right_wrist_flexion")


def stub_prediction(setup: Setup) -> Prediction:
    """Best with a sensor on the pelvis, and from the left."""
    sigma = np.radians([12.0, 10.0, 4.0, np.nan])
    sigma[:2] /= 4.0 if "Pelvis" in setup.sensors else 1.0
    sigma *= 1.0 + 0.2 * (setup.camera.center_world[1] < 0)
    return Prediction(NAMES, sigma, 0.9 * sigma, np.full(4, 0.95), np.array([1.0, 1, 1, 0]), 2)


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch, setup: Setup) -> Setup:
    """The simulations are replaced by numbers that are known."""

    def predict(setups: Mapping[str, Setup], *_: Any, **__: Any) -> dict[str, Prediction | str]:
        return {name: stub_prediction(own) for name, own in setups.items()}

    correlation = np.zeros((4, 4 + len(ROOT)))
    correlation[0, 1] = correlation[1, 0] = 0.98
    found = Information(NAMES, np.radians([70.0, 70.0, 3.0, 100.0]), correlation)
    times = CalibrationTime(
        np.array([5.0, 10.0]),
        *({kind: scale * ENOUGH[kind] * np.array([2.0, 0.5]) for kind in PLANTED} for scale in (1.0, 0.8)),
    )
    monkeypatch.setattr(planning, "predict", predict)
    monkeypatch.setattr(planning, "information", lambda *_: found)
    monkeypatch.setattr(planning, "calibration_time", lambda *_, **__: times)
    return setup


@pytest.fixture
def made(stubbed: Setup) -> Plan:
    place = CameraPlace(angle_deg=-90.0, distance_m=4.5)
    protocol = Protocol("squat", camera=place, sensors=stubbed.sensors, wanted=NAMES, wanted_sd_deg=6.0)
    return plan(protocol, replace(stubbed, camera=place.camera(stubbed.poses)))


def test_the_best_camera_and_sensor_come_first(made: Plan) -> None:
    assert made.sensors[0].name == "Pelvis"
    assert made.sensors[0].most == "pelvis_tilt"
    assert made.sensors[0].gain > 0
    losses = [option.loss for option in made.cameras]
    assert losses == sorted(losses)
    assert made.cameras[0].gain > 0


def test_a_camera_that_is_too_near_is_a_caution_and_no_option(stubbed: Setup) -> None:
    near = CameraPlace(angle_deg=0.0, distance_m=0.9)
    further = CameraPlace(angle_deg=0.0, distance_m=5.0)
    protocol = Protocol("squat", camera=near, possible_cameras=(near, further), wanted=NAMES)
    found = plan(protocol, replace(stubbed, camera=near.camera(stubbed.poses), sensors=()))
    assert any("of the body is in the image" in line for line in cautions(found))
    assert found.calibration is None
    swapped = Protocol("squat", camera=further, possible_cameras=(near, further), wanted=NAMES)
    found = plan(swapped, replace(stubbed, camera=further.camera(stubbed.poses)))
    assert [option.problem for option in found.cameras][1].startswith("only")


def test_a_camera_that_is_not_told_is_the_best_of_those_compared(stubbed: Setup) -> None:
    protocol = Protocol("squat", wanted=NAMES, any_camera=True)
    worst = replace(protocol, camera=CameraPlace(angle_deg=-90.0))
    steps: list[tuple[str, int, int]] = []
    found = plan(
        worst, replace(stubbed, camera=worst.camera.camera(stubbed.poses)), progress=lambda *step: steps.append(step)
    )
    assert found.protocol.camera.words == found.cameras[0].name
    assert found.setup.camera.center_world[1] > 0  # the better side of the stubs
    assert [option.gain for option in found.cameras] == sorted((o.gain for o in found.cameras), reverse=True)
    assert any(line.startswith(f"Camera place: {found.cameras[0].name}, the best") for line in advice(found))
    assert steps[:3] == [("cameras", 0, 16), ("predict", 0, 3), ("sensors", 0, 2 * len(found.sensors))]
    told = plan(replace(worst, any_camera=False), replace(stubbed, camera=worst.camera.camera(stubbed.poses)))
    assert told.protocol.camera == worst.camera


def test_files_have_every_angle(made: Plan, tmp_path: Path) -> None:
    write_plan(made, tmp_path / "out")
    tmp_path /= "out"
    with (tmp_path / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(COLUMNS)
    assert [row["angle"] for row in rows] == list(NAMES)
    assert rows[3]["sd_deg"] == ""
    assert (rows[0]["identifiable"], rows[0]["confused_with"]) == ("False", "right_hip_flexion")
    data = json.loads((tmp_path / MARKER).read_text())
    assert data["headline"] == headline(made)
    assert data["sensors"][0]["name"] == "Pelvis"
    assert (tmp_path / "plan.png").stat().st_size > 10_000
    page = (tmp_path / INSTRUCTIONS).read_text()
    assert "4.50 m from the cross" in page
    assert "For the calibration: Move for at least 10 s" in page
    assert all(sensor in page for sensor in made.protocol.sensors)


# --- how long to move ----------------------------------------------------------------------------


def test_time_is_needed_until_statement_and_simulation_agree() -> None:
    enough = ENOUGH["delay"]
    seconds = np.array([5.0, 10.0, 20.0])
    sigma, error = enough * np.array([0.5, 0.5, 0.4]), enough * np.array([0.6, 1.5, 0.9])
    found = CalibrationTime(seconds, {"delay": sigma}, {"delay": error})
    assert found.needed("delay") == 20.0
    never = CalibrationTime(seconds, {"delay": sigma}, {"delay": 3 * error})
    assert never.needed("delay") is None
    assert f"delay ({2.7 * 1e3 * enough:.0f} ms left)" in never.words


# --- sources -------------------------------------------------------------------------------------


def test_an_unknown_movement_is_named() -> None:
    with pytest.raises(UnknownNameError, match="moonwalk"):
        planned("moonwalk")


def test_the_persons_file_gives_the_body_and_the_operators_page_the_identifier(made: Plan, tmp_path: Path) -> None:
    path = tmp_path / "P07.toml"
    leg = "LeftLeg = { value = [0, 0, -0.5], sd = 0.01 }"
    path.write_text(f'subject = "P07"\nheight_m = {{ value = 1.9 }}\njoint_offsets_m = {{ {leg} }}\n')
    _, setup = planned("squat", subject=(subject := read_subject(path)))
    assert setup.skeleton.bone_lengths["LeftLeg"] == 0.5
    assert setup.skeleton.bone_lengths["RightForeArm"] == pytest.approx(
        SkeletonModel.default().with_height(1.9).bone_lengths["RightForeArm"]
    )
    write_plan(replace(made, setup=replace(made.setup, subject=subject)), tmp_path / "out")
    assert "Recording of P07: squat" in (tmp_path / "out" / INSTRUCTIONS).read_text(encoding="utf-8")
    assert json.loads((tmp_path / "out" / MARKER).read_text())["subject"] == "P07"


def test_a_recording_is_planned_as_it_was_recorded(setup: Setup, tmp_path: Path) -> None:
    recording = setup.recorded(1)
    recording.save(tmp_path / "recording")
    protocol, found = planned(tmp_path / "recording")
    assert {*found.sensors} == {*setup.sensors}
    assert found.sensors == protocol.sensors
    np.testing.assert_allclose(found.camera.center_world, setup.camera.center_world)
    assert protocol.camera.focal_px == pytest.approx(np.trace(setup.camera.K[:2, :2]) / 2)


def test_what_is_planted_is_what_is_measured_as_left(setup: Setup) -> None:
    from rtof_kin.plan.prediction import _left

    true = setup.recorded(0, late=False)
    wrong = planted(true, 3)
    left = _left(wrong, true)
    assert left["delay"] == pytest.approx((wrong.video.times[0] - true.video.times[0]) ** 2)
    assert 0.3 < np.sqrt(left["heading"]) / PLANTED["heading"] < 2.0
    assert 0.3 < np.sqrt(left["mounting"]) / PLANTED["mounting"] < 2.0
    assert wrong.calibration is not None
    assert true.calibration is not None
    turned = wrong.calibration.R_world_inertial @ np.swapaxes(true.calibration.R_world_inertial, -1, -2)
    np.testing.assert_allclose(so3.log(turned)[:, :2], 0.0, atol=1e-9)  # about the vertical only
    assert all(value == pytest.approx(0.0, abs=1e-12) for value in _left(true, true).values())


def test_a_calibration_needs_sensors(setup: Setup) -> None:
    with pytest.raises(InvalidInputError, match="without sensors"):
        calibration_time(replace(setup, sensors=()))


def test_a_plan_without_search_compares_nothing(stubbed: Setup, tmp_path: Path) -> None:
    found = plan(Protocol("squat", wanted=NAMES), stubbed, search=False)
    assert (found.cameras, found.sensors, found.calibration) == ((), (), None)
    write_plan(found, tmp_path / "out")
