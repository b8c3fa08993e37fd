"""Bodies and cameras: what a person or an ordinary camera cannot be is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtof_kin.core.checks import Verdict
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording import body_checks as bodies

NAMES = ("RHip", "right_knee", "R.Ankle", "LShoulder", "Left Elbow", "l_wrist", "Nose")
BODY = np.array(
    [
        [0.0, -0.1, 0.9],
        [0.0, -0.1, 0.5],
        [0.0, -0.1, 0.1],
        [0.0, 0.2, 1.4],
        [0.0, 0.25, 1.1],
        [0.1, 0.25, 0.9],
        [0.1, 0.0, 1.65],
    ]
)


def walking(T: int = 50, noise: float = 0.0) -> np.ndarray:
    steps = np.linspace(0, 2, T)[:, None, None] * np.array([1.0, 0.3, 0.0])
    return BODY + steps + np.random.default_rng(0).normal(0, noise, (T, len(BODY), 3))


def camera(**changes: object) -> Camera:
    return replace(Camera.looking_at([4.0, 0, 1.5], [0, 0, 1.0], 1250.0), **changes)  # type: ignore[arg-type]


def test_bones_are_found_by_side_and_joint_however_they_are_spelt() -> None:
    assert bodies.limb_bones(NAMES) == {
        "RHip to right_knee": (0, 1),
        "right_knee to R.Ankle": (1, 2),
        "LShoulder to Left Elbow": (3, 4),
        "Left Elbow to l_wrist": (4, 5),
    }
    assert bodies.limb_bones(("C7", "T10", "RASI")) == {}


def test_bones_of_constant_length_pass_and_swapped_points_do_not() -> None:
    p = walking()
    bones = bodies.limb_bones(NAMES)
    assert all(c.passed for c in bodies.check_bone_lengths(bodies.bone_lengths(p, bones), 1.0))
    p[20:30, [1, 2]] = p[20:30, [2, 1]]
    checks = {c.subject: c for c in bodies.check_bone_lengths(bodies.bone_lengths(p, bones), 50.0)}
    assert checks["RHip to right_knee"].failed
    assert "from 0.400 to 0.800 m; are points swapped" in checks["RHip to right_knee"].advice
    assert checks["LShoulder to Left Elbow"].passed


def test_noise_of_the_points_is_the_spread_of_the_bone() -> None:
    lengths = bodies.bone_lengths(walking(2000, 0.01), bodies.limb_bones(NAMES))
    for check in bodies.check_bone_lengths(lengths, 50.0):
        assert check.value == pytest.approx(1000 * 0.01 * np.sqrt(2), rel=0.1)


def test_a_bone_that_is_never_seen_cannot_be_told() -> None:
    p = walking()
    p[1:, 0] = np.nan
    lengths = bodies.bone_lengths(p, bodies.limb_bones(NAMES))
    check = bodies.check_bone_lengths(lengths, 1.0)[0]
    assert check.verdict is Verdict.NOT_POSSIBLE
    assert check.advice == "it is seen in 1 frames"


@pytest.mark.parametrize("unit, metres", [("mm", 1000.0), ("cm", 100.0), ("inches", 1 / 0.0254)])
def test_lengths_in_another_unit_are_no_person_and_the_unit_is_named(unit: str, metres: float) -> None:
    assert bodies.check_size(bodies.box_sizes(walking())).passed
    check = bodies.check_size(bodies.box_sizes(metres * walking()))
    assert check.failed
    assert unit in check.advice.split("are they in ")[1]


def test_too_few_points_tell_no_size() -> None:
    p = walking()
    p[:, 2:] = np.nan
    assert bodies.check_size(bodies.box_sizes(p)).verdict is Verdict.NOT_POSSIBLE


def test_an_ordinary_camera_passes_and_odd_ones_fail() -> None:
    K = camera().K
    assert all(check.passed for check in bodies.check_camera("left", camera()))
    odd = {
        "focal length": K * [[0.1, 1, 1], [1, 0.1, 1], [1, 1, 1]],
        "pixels not square": K * [[1.3, 1, 1], [1, 1, 1], [1, 1, 1]],
        "principal point off the centre": K * [[1, 1, 0.2], [1, 1, 1], [1, 1, 1]],
    }
    for name, matrix in odd.items():
        checks = bodies.check_camera("left", camera(K=matrix))
        assert [check.name for check in checks if check.failed] == [name]
        assert {check.subject for check in checks} == {"camera left"}


def test_reprojection_is_the_median_distance_of_what_both_have() -> None:
    p = walking()
    seen = camera().project(p) + np.array([3.0, 4.0])
    keypoints = KeypointSequence(camera(), np.arange(50) / 60, seen, np.ones((50, 7)), NAMES)
    check = bodies.check_reprojection([(keypoints, p[:, ::-1])], NAMES[::-1])
    assert check.passed
    assert check.value == pytest.approx(5.0)
    assert bodies.check_reprojection([(keypoints, p + np.array([0, 0.3, 0]))], NAMES).failed
    other = bodies.check_reprojection([(keypoints, p[:, :1])], ("Hips",))
    assert other.verdict is Verdict.NOT_POSSIBLE
