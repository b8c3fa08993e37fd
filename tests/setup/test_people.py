"""Numbering of the people in a video, and the choice of one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from setup_support import LAYOUT, beside, pair, people_in, walker, write_keypoints

from rtof_kin.core.errors import InvalidInputError, UndecidedError
from rtof_kin.setup.people import (
    choose_person,
    number_people,
    people_in_picture,
    read_people,
    write_frames_picture,
    write_people,
)
from rtof_kin.vision.keypoint_files import read_detector_file


def test_the_largest_person_in_the_middle_is_number_one_in_every_frame(tmp_path: Path) -> None:
    uv = walker()
    small = beside(uv, 0.6, (900.0, 300.0))
    people = people_in(write_keypoints(tmp_path / "two.npz", small, uv))
    np.testing.assert_allclose(people.detections.uv_px[:, 0], uv)
    np.testing.assert_allclose(people.detections.uv_px[:, 1], small)
    assert people.weights[0] == 1.0 > people.weights[1]


def test_the_numbers_survive_writing_and_crossing_people(tmp_path: Path) -> None:
    uv = walker()
    people = people_in(write_keypoints(tmp_path / "two.npz", uv, beside(uv, 0.8, (700.0, 100.0))))
    write_people(tmp_path / "keypoints.npz", people)
    again = read_people(tmp_path / "keypoints.npz")
    np.testing.assert_array_equal(again.detections.uv_px, people.detections.uv_px)
    np.testing.assert_array_equal(again.detections.identity, people.detections.identity)
    assert again.weights == people.weights


def test_points_in_space_stay_with_their_person(tmp_path: Path) -> None:
    uv = walker()
    both = read_detector_file(write_keypoints(tmp_path / "two.npz", uv, beside(uv, 0.8, (700.0, 100.0))))
    of_column = np.arange(2.0)
    of_column = np.where(np.arange(len(uv))[:, None] % 2, of_column[::-1], of_column)  # the order of the file changes
    p_model = np.broadcast_to(of_column[..., None, None], (*both.confidence.shape, 3))
    people = number_people(replace(both, p_model=p_model), np.arange(len(uv)) / 30, (1920, 1080))
    write_people(tmp_path / "keypoints.npz", people)
    again = read_people(tmp_path / "keypoints.npz").detections.p_model
    assert again is not None
    np.testing.assert_array_equal(np.nanmin(again, axis=(0, 2, 3)), [0, 1])
    np.testing.assert_array_equal(np.nanmax(again, axis=(0, 2, 3)), [0, 1])


def test_a_passer_by_is_neither_numbered_nor_asked_about(tmp_path: Path) -> None:
    uv, passing = walker(), beside(walker(), 0.2, (1500.0, 500.0))
    passing[8:] = np.nan
    people = people_in(write_keypoints(tmp_path / "two.npz", uv, passing))
    assert len(people) == 1
    assert choose_person(people, None, "frames.png") == 1


def test_two_equal_people_are_left_to_the_user_in_one_sentence(tmp_path: Path) -> None:
    people = people_in(write_keypoints(tmp_path / "two.npz", *pair()))
    with pytest.raises(UndecidedError) as error:
        choose_person(people, None, "out/frames.png")
    assert str(error.value) == (
        "2 people are in the video: look at out/frames.png and choose one with --person 1 or --person 2"
    )
    assert choose_person(people, 2, "out/frames.png") == 2


@pytest.mark.parametrize("number", [0, 3, -1])
def test_a_number_that_nobody_has_is_refused(tmp_path: Path, number: int) -> None:
    people = people_in(write_keypoints(tmp_path / "two.npz", *pair()))
    with pytest.raises(InvalidInputError, match=f"--person {number}: there is no such person; look at a.png"):
        choose_person(people, number, "a.png")


def test_scattered_points_are_no_person(tmp_path: Path) -> None:
    uv = np.full_like(walker(), np.nan)
    uv[:, :3] = 100.0
    with pytest.raises(InvalidInputError, match="no person was found in the video: film the whole person"):
        people_in(write_keypoints(tmp_path / "none.npz", uv))


def test_a_person_whom_the_detector_found_twice_is_one(tmp_path: Path) -> None:
    uv = walker()
    again = uv + np.random.default_rng(0).normal(0, 4.0, uv.shape)
    again[::3] = np.nan
    people = people_in(write_keypoints(tmp_path / "twice.npz", uv, again))
    assert len(people) == 1
    assert people.detections.present.all()


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


def test_the_picture_says_where_everybody_is_in_it(tmp_path: Path) -> None:
    picture = tmp_path / "two.png"
    write_frames_picture(picture, people_in(write_keypoints(tmp_path / "two.npz", *pair())), LAYOUT, (1920, 1080))
    image = np.asarray(imread(picture))[..., :3]
    height, width = image.shape[:2]
    boxes = people_in_picture(picture)
    assert [number for number, *_ in boxes] == [1, 2] * 6
    for number, *box in boxes:
        left, top, right, bottom = np.round(np.multiply(box, [width, height, width, height])).astype(int)
        inside, color = image[top:bottom, left:right], (FIRST, SECOND)[int(number) - 1]
        assert (np.abs(inside - color).max(axis=-1) < 0.02).mean() > 0.05
    assert people_in_picture(tmp_path / "none.png") == []
    picture.write_bytes(b"damaged")
    assert people_in_picture(picture) == []
