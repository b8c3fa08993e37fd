"""Drawing and sheet for the operator: numbers of a planted camera, all sensors, one page, no network."""

import base64
import re
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.movements import MOVEMENTS, movement
from rtof_kin.plan.operator_page import draw_setup, operator_page
from rtof_kin.plan.protocol import direction, framing, sensor_places

SKELETON = SkeletonModel.default()
SQUAT = movement("squat", SKELETON, 1, rate_hz=20.0)
SENSORS = tuple(SKELETON.sensors)


def camera_at(angle_deg: float, distance: float, height: float = 1.1, focal_px: float = 1000.0) -> Camera:
    """Camera in a direction from the middle of the squat's path, level with its target."""
    path = SQUAT.p_world_joint[:, 0, :2]
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    way = distance * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    return Camera.looking_at([*(middle + way), height], [*middle, height], focal_px)


@pytest.mark.parametrize(
    "angle_deg, side", [(40, "in front to the left"), (-75, "to the right"), (120, "behind to the left")]
)
def test_a_planted_camera_is_found_again(angle_deg: float, side: str) -> None:
    place = framing(SQUAT, SKELETON, camera_at(angle_deg, 3.5))
    assert place.distance == pytest.approx(3.5)
    assert place.angle_deg == pytest.approx(angle_deg, abs=1.0)  # he sways by less
    assert place.height == pytest.approx(1.1)
    assert place.tilt_deg == pytest.approx(0.0, abs=1e-6)
    assert place.field_deg[0] == pytest.approx(2 * np.degrees(np.arctan(0.96)))
    assert direction(place.angle_deg).startswith(f"{side} of the person")
    assert place.inside == 1
    assert "whole body stays" in place.view


def test_a_camera_that_loses_the_body_is_said_with_the_remedy() -> None:
    near = framing(SQUAT, SKELETON, camera_at(0, 1.0))
    assert near.inside < 1
    assert near.margin < 0
    assert "move the camera back" in near.view
    away = Camera.looking_at([3.0, 0, 1.0], [6.0, 0, 1.0], 1000.0)
    assert framing(SQUAT, SKELETON, away).inside == 0


def texts_of(svg: str) -> str:
    return unescape(" ".join(re.findall(r">([^<>]+)</(?:text|tspan)>", svg)))


def test_the_drawing_has_the_numbers_and_every_sensor(tmp_path: Path) -> None:
    path = tmp_path / "setup.svg"
    place = draw_setup(SQUAT, SKELETON, camera_at(-30, 3.27), SENSORS, path)
    words = texts_of(path.read_text(encoding="utf-8"))
    assert "3.27 m" in words
    assert direction(place.angle_deg) in words
    assert "field of view 88°" in words
    assert "lens 1.10 m high" in words
    assert all(name in words for name in SENSORS)
    assert "flat inner face of the left shin" in words
    again = tmp_path / "again.svg"
    draw_setup(SQUAT, SKELETON, camera_at(-30, 3.27), SENSORS, again)
    assert again.read_bytes() == path.read_bytes()


def page(poses: PoseSequence = SQUAT, doubts: tuple[str, ...] = ("Knee <rotation> is unknown",)) -> str:
    info, places = MOVEMENTS["squat"], sensor_places(SKELETON, SENSORS)
    place = framing(poses, SKELETON, camera_at(-30, 3.27))
    return operator_page("Knee & hip", info, (3, 12.0), place, places, "<svg>http://www.w3.org</svg>", doubts)


def test_the_page_has_all_sensors_and_numbers_and_escapes_texts() -> None:
    html = page()
    assert all(f"{name}: " in html for name in SENSORS)
    assert "3.27 m" in html
    assert "lens 1.10 m" in html
    assert "field of view 88°" in html
    assert "3 times" in html
    assert "still for 2 s" in html
    assert MOVEMENTS["squat"].instructions[1:] in html
    assert "Knee &amp; hip" in html
    assert "Knee &lt;rotation&gt;" in html
    assert html.index("Before you begin") < html.index("What to do")
    assert "Before you begin" not in page(doubts=())

    # It needs no network.
    (drawing,) = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', html)
    assert base64.b64decode(drawing).startswith(b"<svg>")
    rest = html.replace(drawing, "")
    assert "http:" not in rest
    assert "https:" not in rest
    assert "url(" not in rest
    assert "default-src 'none'" in rest
    assert "img-src data:" in rest
    assert "<script" not in rest


@pytest.mark.parametrize("name", MOVEMENTS)
def test_every_movement_with_all_sensors_fits(name: str) -> None:
    place = framing(SQUAT, SKELETON, camera_at(-30, 3.27))
    info = MOVEMENTS[name]
    how, places = (info.repetitions, 30.0), sensor_places(SKELETON, SENSORS)
    assert f"Strap on {len(SENSORS)} sensor(s)" in operator_page(name, info, how, place, places, "<svg/>", ["x" * 90])
    assert "Strap on" not in operator_page(name, info, how, place, {}, "<svg/>")
