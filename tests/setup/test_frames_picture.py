"""The picture of the people with their numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread
from setup_support import LAYOUT, pair, people_in, walker, write_keypoints

from rtof_kin.setup.people import write_frames_picture

FIRST, SECOND = np.array([0xE6, 0x9F, 0x00]) / 255, np.array([0x00, 0x72, 0xB2]) / 255


def share(path: Path, color: np.ndarray) -> float:
    image = np.asarray(imread(path))[..., :3]
    return float((np.abs(image - color).max(axis=-1) < 0.02).mean())


def test_every_person_is_drawn_in_a_colour_of_its_own(tmp_path: Path) -> None:
    one = people_in(write_keypoints(tmp_path / "one.npz", pair()[0]))
    two = people_in(write_keypoints(tmp_path / "two.npz", *pair()))
    for name, people in {"one": one, "two": two}.items():
        write_frames_picture(tmp_path / f"{name}.png", people, LAYOUT, (1920, 1080))
    assert share(tmp_path / "one.png", FIRST) > 1e-3
    assert share(tmp_path / "one.png", SECOND) == 0.0
    assert share(tmp_path / "two.png", SECOND) > 1e-3


def test_the_panels_have_the_shape_of_the_image(tmp_path: Path) -> None:
    people = people_in(write_keypoints(tmp_path / "one.npz", walker()))
    shapes = []
    for size in ((1920, 1080), (1080, 1920)):
        write_frames_picture(tmp_path / "frames.png", people, LAYOUT, size)
        shapes.append(np.asarray(imread(tmp_path / "frames.png")).shape[:2])
    assert shapes[0][0] < shapes[0][1]
    assert shapes[1][1] / shapes[1][0] > 2  # six upright panels side by side


def test_a_person_who_is_not_seen_all_the_time_is_drawn_where_seen(tmp_path: Path) -> None:
    uv = walker()
    uv[:40] = np.nan
    people = people_in(write_keypoints(tmp_path / "one.npz", uv))
    write_frames_picture(tmp_path / "frames.png", people, LAYOUT, (1920, 1080))
    assert share(tmp_path / "frames.png", FIRST) > 1e-3
