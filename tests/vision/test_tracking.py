"""Tracking of one of several people: ambiguous and lost frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.vision.detections import Detections, Person
from rtof_kin.vision.tracking import NOBODY, PersonFollower, track_person

Array = NDArray[np.float64]
T = 90
TIMES = np.arange(T) / 30.0
BODY = np.random.default_rng(0).uniform(-1, 1, (17, 2)) * [60, 200]
IMAGE = (1920.0, 1080.0)


def walker(start: float, stop: float, size: float = 1.0, height: float = 540.0) -> Array:
    """(T, 17, 2) points of a person who crosses the image."""
    u = np.linspace(start, stop, T)
    swing = 10 * np.sin(2 * np.pi * TIMES)[:, None, None] * np.sin(np.arange(34)).reshape(17, 2)
    return size * (BODY + swing) + np.stack([u, np.full(T, height)], axis=-1)[:, None]


def filmed(people: list[Array], seed: int = 0, hidden: Array | None = None) -> tuple[Detections, Array]:
    """Detections with everybody in random order, and (T,) where person 0 is among them, -1 where not."""
    rng = np.random.default_rng(seed)
    uv = np.stack(people, axis=1) + rng.normal(size=(T, len(people), 17, 2))
    confidence = np.full(uv.shape[:3], 0.8)
    if hidden is not None:
        confidence[hidden] = 0.0
    index = np.empty(T, dtype=int)
    for t in range(T):
        order = rng.permutation(len(people))
        uv[t], confidence[t] = uv[t, order], confidence[t, order]
        index[t] = int(np.flatnonzero(order == 0)[0]) if confidence[t][order == 0].any() else NOBODY
    return Detections(uv, confidence), index


def test_a_single_person_is_never_ambiguous() -> None:
    found, _ = filmed([walker(400, 1500)])
    track = track_person(found, TIMES)
    np.testing.assert_array_equal(track.person, 0)
    assert (track.people, track.ambiguous.any(), track.lost.any()) == (1, False, False)


def test_people_are_tracked_in_any_order() -> None:
    found, index = filmed([walker(700, 1200), walker(100, 300, 0.5), walker(1800, 1700, 0.8)])
    track = track_person(found, TIMES, image_px=IMAGE)
    np.testing.assert_array_equal(track.person, index)
    assert track.people == 3
    assert "of 3 people the largest" in track.reason
    uv, confidence = track.of(found)
    np.testing.assert_array_equal(uv[7], found.uv_px[7, index[7]])
    assert np.all(confidence == 0.8)
    crossing, index = filmed([walker(300, 1600), walker(1600, 300, height=640.0)])
    track = track_person(crossing, TIMES, person=int(index[0]), frame=0)
    np.testing.assert_array_equal(track.person, index)
    assert f"person {index[0] + 1} in frame 0" in track.reason


def test_overlapping_people_are_ambiguous() -> None:
    found, _ = filmed([walker(900, 1000), walker(900, 1000) + np.array([4.0, 2.0])])
    track = track_person(found, TIMES, image_px=IMAGE)
    assert track.ambiguous[1:].mean() > 0.9
    apart, _ = filmed([walker(300, 400), walker(1300, 1400)])
    assert not track_person(apart, TIMES, image_px=IMAGE).ambiguous.any()


def test_short_gaps_are_bridged_and_lost() -> None:
    hidden = np.zeros((T, 2), dtype=bool)
    hidden[40:55, 0] = True  # half a second
    found, index = filmed([walker(700, 900), walker(1500, 1600, 0.6)], hidden=hidden)
    track = track_person(found, TIMES, image_px=IMAGE)
    np.testing.assert_array_equal(track.person, index)
    np.testing.assert_array_equal(np.flatnonzero(track.lost), np.arange(40, 55))
    uv, confidence = track.of(found)
    assert np.isnan(uv[40:55]).all()
    assert not confidence[40:55].any()
    assert track.people == 2


def test_a_return_after_a_long_gap_is_ambiguous() -> None:
    hidden = np.zeros((T, 2), dtype=bool)
    hidden[20:70, 0] = True  # longer than a person is expected back
    found, index = filmed([walker(700, 900), walker(1500, 1600, 0.5)], hidden=hidden)
    track = track_person(found, TIMES, person=int(index[0]), frame=0)
    np.testing.assert_array_equal(track.person, index)
    np.testing.assert_array_equal(np.flatnonzero(track.ambiguous), [70])
    assert track.people == 2


def test_another_person_does_not_fill_a_gap() -> None:
    hidden = np.zeros((T, 2), dtype=bool)
    hidden[30:, 0] = True
    found, index = filmed([walker(800, 1000), walker(1100, 1300)], hidden=hidden)
    where = int(np.flatnonzero(index >= 0)[0])
    track = track_person(found, TIMES, person=int(index[where]), frame=where)
    np.testing.assert_array_equal(track.person, index)
    assert track.lost[30:].all()


def test_identities_of_a_tracker_override_positions() -> None:
    found, index = filmed([walker(900, 1000), walker(905, 1005)])
    identity = np.where(np.arange(2) == index[:, None], 7, 3)
    known = Detections(found.uv_px, found.confidence, identity=identity)
    track = track_person(known, TIMES, person=int(index[0]), frame=0)
    np.testing.assert_array_equal(track.person, index)


@pytest.mark.parametrize("person, frame", [(2, 0), (-1, 0), (0, T), (0, -1), (5, None)])
def test_unknown_persons_are_refused(person: int, frame: int | None) -> None:
    found, _ = filmed([walker(300, 400), walker(1300, 1400)])
    with pytest.raises(InvalidInputError, match=f"person {person + 1} in frame .*there is no such person"):
        track_person(found, TIMES, person=person, frame=frame)


def test_a_brief_false_detection_elsewhere_does_not_continue_a_person() -> None:
    found, index = filmed([walker(300, 600)])
    uv, confidence = np.array(found.uv_px), np.array(found.confidence)
    uv[:50], confidence[:50] = np.nan, 0.0
    ghost = slice(5, 10)
    uv[ghost, 0], confidence[ghost, 0] = BODY + np.array([1500.0, 300.0]), 0.8
    track = track_person(Detections(uv, confidence), TIMES, person=0, frame=60)
    np.testing.assert_array_equal(track.person, np.where(np.arange(T) < 50, NOBODY, index))
    seen = slice(5, 20)  # half a second is somebody who comes back
    uv[seen, 0], confidence[seen, 0] = BODY + np.array([400.0, 540.0]), 0.8
    track = track_person(Detections(uv, confidence), TIMES, person=0, frame=60)
    assert (track.person[seen] == 0).all()


def follow(*frames: list[tuple[float, float]]) -> tuple[PersonFollower, list[float | None]]:
    """Where the followed person stands in each frame, px; people are (place, size) in an image of 1000 px."""
    body = np.array([[0, 0], [0, 1], [0.3, 0.5], [-0.3, 0.5], [0, 0.4]])
    follower = PersonFollower((1000.0, 800.0))
    at: list[float | None] = []
    for i, people in enumerate(frames):
        found = [Person(np.column_stack([body * size + [place, 100], np.full(5, 0.9)])) for place, size in people]
        index = follower.follow(found, i / 30)
        at.append(None if index is None else people[index][0])
    return follower, at


def test_the_follower_keeps_the_person_chosen_first_whatever_the_order_and_others_do() -> None:
    follower, at = follow([(100, 200), (480, 220)], [(485, 220), (110, 210)], [(120, 300), (490, 220)], [(495, 220)])
    assert at == [480, 485, 490, 495]
    assert (follower.chosen, follower.ambiguous) == (1, 0)


def test_the_follower_waits_a_second_for_a_person_who_is_hidden_and_then_takes_another() -> None:
    other, gone = [(900.0, 200.0)], [(500.0, 200.0), (900.0, 200.0)]
    follower, at = follow(gone, *[other] * 40)
    assert at[:31] == [500, *[None] * 30]
    assert at[-1] == 900
    assert follower.chosen == 2
    _, back = follow(gone, *[other] * 20, gone)
    assert back[-1] == 500


def test_the_follower_counts_frames_in_which_two_people_are_near() -> None:
    near = [(500.0, 200.0), (505.0, 200.0)]
    follower, at = follow([(500.0, 200.0)], near, near, [])
    assert follower.ambiguous >= 1
    assert at[-1] is None
