"""Protocols and camera places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.plan.protocol import CameraPlace, Protocol, centre_of, facing_of, place_of
from rtof_kin.plan.setup import Setup

WHOLE = """
movement = "squat"
repetitions = 4
height_m = 1.6

[camera]
angle_deg = 90
distance_m = 3
height_m = 1.1
field_of_view_deg = 60
width_px = 1280
height_px = 720
rate_hz = 30

[camera.possible]
angle_deg = [0, 90]
height_m = [1.1, 2]

[sensors]
worn = ["L_LowLeg"]
possible = ["Pelvis", "L_LowLeg"]

[detector]
points = "coco17"
error_factor = 0.5

[wanted]
angles = ["left_knee_flexion"]
sd_deg = 5
"""


def read(folder: Path, text: str) -> Protocol:
    path = folder / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return Protocol.read(path)


def test_a_protocol_is_read(tmp_path: Path) -> None:
    protocol = read(tmp_path, WHOLE)
    assert (protocol.movement, protocol.repetitions, protocol.height_m) == ("squat", 4, 1.6)
    assert protocol.camera.field_of_view_deg == pytest.approx(60)
    assert protocol.camera.focal_px == pytest.approx(640 / np.tan(np.radians(30)))
    assert protocol.further_sensors == ("Pelvis",)
    assert len(protocol.further_cameras) == 4
    assert protocol.camera in protocol.further_cameras
    assert (protocol.detector, protocol.error_factor) == ("coco17", 0.5)
    assert (protocol.wanted, protocol.wanted_sd_deg) == (("left_knee_flexion",), 5)


def test_a_movement_is_enough(tmp_path: Path) -> None:
    protocol = read(tmp_path, 'movement = "gait"')
    assert protocol == Protocol("gait", any_camera=True)
    assert len(protocol.further_cameras) == 8
    assert len(protocol.further_sensors) == 13


@pytest.mark.parametrize(
    ("before", "after", "error", "named"),
    [
        ('"L_LowLeg"]\np', '"Shin"]\np', UnknownNameError, "Shin"),
        ('"left_knee_flexion"', '"knee"', UnknownNameError, "knee"),
        ('"coco17"', '"hrnet"', UnknownNameError, "hrnet"),
        ('"coco17"', '"joints"', InvalidInputError, "joints are points of the skeleton; name the layout of a detector"),
        ('"coco17"', '"none.toml"', FileFormatError, "none.toml"),
        ("distance_m = 3", "distance_m = 300", InvalidInputError, "distance_m"),
        ("distance_m = 3", "distanz_m = 3", UnknownNameError, "distanz_m"),
        ("field_of_view_deg = 60", "focal_px = 26", InvalidInputError, "pixels, not mm"),
        ("height_m = 1.6", "height_m = 160", InvalidInputError, "160"),
        ("repetitions = 4", "repetitions = 0", InvalidInputError, "repetitions"),
        ('movement = "squat"', "", FileFormatError, "movement"),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, before: str, after: str, error: type[Exception], named: str) -> None:
    assert before in WHOLE
    with pytest.raises(error, match=named):
        read(tmp_path, WHOLE.replace(before, after))


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0, 180.0, -120.0])
def test_a_camera_stands_where_its_place_says(setup: Setup, angle_deg: float) -> None:
    place = CameraPlace(angle_deg=angle_deg, distance_m=3.5, height_m=1.4)
    camera = place.camera(setup.poses)
    off = camera.center_world - centre_of(setup.poses)
    facing = facing_of(setup.poses)
    forward = np.array([np.cos(facing), np.sin(facing), 0.0])
    left = np.cross([0.0, 0.0, 1.0], forward)
    assert np.hypot(*off[:2]) == pytest.approx(3.5)
    assert camera.center_world[2] == pytest.approx(1.4)
    assert off @ forward == pytest.approx(3.5 * np.cos(np.radians(angle_deg)))
    assert off @ left == pytest.approx(3.5 * np.sin(np.radians(angle_deg)))
    found = place_of(camera, setup.poses, 60.0)
    assert (found.angle_deg + 360) % 360 == pytest.approx((angle_deg + 360) % 360, abs=0.1)
    assert (found.distance_m, found.height_m) == (3.5, 1.4)
    assert found.focal_px == pytest.approx(place.focal_px)
