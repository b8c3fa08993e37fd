"""The benchmark of planted faults: what counts as named, what a fault changes, and its tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from benchmarks.planted.faults import FAULTS, RIGHT, Draws, matching
from benchmarks.planted.measuring import cases, cause
from benchmarks.planted.recordings import Scene, cameras, scenes
from benchmarks.planted.tables import false_alarm, markdown, silent, totals
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.simulation.mocap import MocapClip

BODY = SkeletonModel.default()


def scene(sensors: str = "8") -> Scene:
    """Two seconds of made-up motion."""
    clip = MocapClip("m", planted.moving(BODY, 120, 1).poses, BODY.joint_offsets, subject="s")
    return Scene(clip, sensors, floor=True, seed=0)


def test_every_fault_changes_the_recording_and_no_fault_its_motion() -> None:
    right = scene().recording()
    other = Scene(replace(scene().clip, name="n"), "8", floor=True, seed=1).recording()
    draws = Draws(np.random.default_rng(0), lambda _: other)
    for name, size in cases(list(FAULTS)):
        wrong = FAULTS[name].plant(right, size, draws)
        assert wrong is not right, name
        assert wrong.truth is not None
        assert right.truth is not None
        np.testing.assert_array_equal(wrong.truth.p_world_joint, right.truth.p_world_joint)


def test_larger_sizes_are_larger_faults() -> None:
    right = scene().recording()
    draws = Draws(np.random.default_rng(0), lambda _: right)
    turned = [FAULTS["camera rolled"].plant(right, size, draws).video.camera for size in (3.0, 10.0)]
    off = [np.linalg.norm(camera.R_camera_world - right.video.camera.R_camera_world) for camera in turned]
    assert off[0] < off[1]
    np.testing.assert_allclose(turned[1].center_world, right.video.camera.center_world, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "name", "named"),
    [
        ("fail: the clocks are off: Check them (the sensors: delay 0.4 s, above 0.1)", "sensors late", True),
        ("fail: the bones are too long: Or the clock (the person: size 1.2 times, above 1.1)", "sensors late", False),
        ("warn: LeftLeg: acceleration residual 7 m/s2 (above 4 m/s2) at 3 s: synchronisation", "sensors late", False),
        (
            "warn: LeftLeg: share of frames unseen 30 % (above 10 %): occluded; more warns in image",
            "legs of the keypoints exchanged",
            False,
        ),
        (
            "pass for the angles; position in the room fails: the focal length is too short: Measure it (the "
            "feet: walk 1.3 times, above 1.2 times); checked, no problem found",
            "focal length wrong",
            True,
        ),
        (
            "pass for the angles; position in the room uncertain: the focal length is not known; checked",
            "focal length wrong",
            False,
        ),
        (
            "warn: LeftLeg: share unseen 3 % (above 2 %); more warns in body; position in the room fails: the "
            "floor is wrong: Look (the person: ankle 0.4 m, above 0.2 m)",
            "floor too high or low",
            True,
        ),
        ("pass: checked, no problem found; not checked: the focal length", "focal length wrong", False),
        ("plausible: checked; not proven: walk; not checked: the focal length", "focal length wrong", False),
    ],
)
def test_a_fault_is_named_by_the_cause_and_not_by_advice_or_a_list(line: str, name: str, named: bool) -> None:
    assert (name in matching(cause(line))) is named


def row(fault: str, **fields: Any) -> dict[str, Any]:
    """One row of results."""
    known: dict[str, Any] = {
        "motion": "m",
        "person": "p",
        "sensors": "8",
        "fault": fault,
        "line": "pass: fine",
        "grade": "pass",
        "causes": [],
        "named": False,
        "inside": {"world": 0.95, "relative": 0.5, "angles": 0.5},
        "mpjpe_rr_mm": 20.0,
        "mpjpe_mm": 50.0,
        "flexion_deg": 3.0,
        "size": "0" if fault in RIGHT else f"{FAULTS[fault].sizes[0]:g}",
    }
    return known | fields


def test_totals_count_named_and_silent_faults_and_false_alarms() -> None:
    rows = [
        row("right"),
        row("right", grade="fail", line="fail: the floor is wrong"),
        row("focal length wrong"),
        row("sensors late"),
        row("sensors late", named=True, grade="fail"),
    ]
    assert [false_alarm(one) for one in rows[:2]] == [False, True]
    assert [silent(one) for one in rows[2:]] == [False, True, False]
    found = totals(rows)
    assert found["named"] == pytest.approx(1 / 3)
    assert found["coverage under unnamed"] == pytest.approx((0.95 + 0.5) / 2)
    text = markdown(rows, "Here.")
    for words in ("**33%** of 3", "**1** of 2", "| sensors late | 0.05 s | 2 | 50% | 50% |", "the floor is"):
        assert words in text


def test_a_folder_without_motion_of_the_people_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="index.csv"):
        scenes([tmp_path], ["8"], 0)


def test_drawn_cameras_see_the_whole_motion() -> None:
    poses = planted.moving(BODY, 60, 1).poses
    for camera in cameras(poses, 3):
        uv = camera.project(poses.p_world_joint)
        assert ((uv > 0) & (uv < [1920, 1080])).all(axis=-1).mean() > 0.9
