"""The picture of the people with their numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread
from setup_support import LAYOUT, pair, people_in, write_keypoints

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
