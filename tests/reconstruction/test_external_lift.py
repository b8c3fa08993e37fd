"""3D points of other models: brought to the recording, better where they are right, no harm where they are not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import planted
import pytest

from rtof_kin.body.kinematics import children_of
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.reconstruction.external_lift import Agreement, _sigma, external, mean_joints, spread_of_joints
from rtof_kin.reconstruction.lift import Lifted, fused, lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.vision.lift_points import LiftPoints, convention, conventions

BODY = SkeletonModel.default()
TRUTH = planted.human(BODY, 120)
VIDEO = planted.keypoints(TRUTH.poses, sigma_px=2.0)
OWN = lift(VIDEO, BODY, planted.PlantedLifter(TRUTH))


def points(
    name: str = "mhr70", truth: Motion = TRUTH, sigma: float = 0.0, unit: float = 1.0, late: float = 0.0
) -> LiftPoints:
    """Points of a convention about the hips on the camera's axes, as a model gives them."""
    form, poses = convention(name), truth.poses
    segments = [BODY.names.index(segment) for segment in form.segments]
    p = poses.p_world_joint[:, segments] + np.einsum("tkij,kj->tki", poses.R_world_bone[:, segments], form.places)
    p = p - poses.p_world_joint[:, :1] + np.random.default_rng(0).normal(0, sigma or 1e-9, p.shape)
    turned = unit * p @ planted.camera().R_camera_world.T
    return LiftPoints("points.npz", MarkerSequence(truth.times + late, form.layout.names, turned))


def changed(given: LiftPoints, p_world: Array | None = None, times: Array | None = None) -> LiftPoints:
    own = given.points
    p_world, times = (own.p_world if p_world is None else p_world), (own.times if times is None else times)
    return replace(given, points=MarkerSequence(times, own.names, p_world))


def combined(*lifts: LiftPoints) -> tuple[Lifted, tuple[Agreement, ...]]:
    """The own lift with others, as `Job.prepare` combines them."""
    found = [external(one, OWN, VIDEO, BODY) for one in lifts]
    used = [other for other, agreement in found if not agreement.doubt]
    return fused([OWN, *used], [VIDEO] * (1 + len(used)), BODY), tuple(agreement for _, agreement in found)


def error_mm(found: Lifted, frames: slice = slice(None)) -> float:
    return planted.root_relative_mm(found.poses.p_world_joint[frames], TRUTH.poses.p_world_joint[frames])


def reconstructed(*lifts: LiftPoints) -> Reconstruction:
    recording = replace(planted.recording(TRUTH, sigma_px=2.0), lifts=lifts)
    return reconstruct(recording, mode="lift", lifter=planted.PlantedLifter(TRUTH))


@pytest.mark.parametrize("name", [name for name in conventions() if name != "mediapipe33"])
def test_right_points_of_every_convention_make_the_lift_better(name: str) -> None:
    found, (agreement,) = combined(points(name, sigma=0.01))
    assert error_mm(found) < 0.75 * error_mm(OWN)
    assert agreement.title == convention(name).layout.title
    assert agreement.scale == pytest.approx(1.0, rel=0.03)


def test_several_lifts_are_better_than_one() -> None:
    one, other = points(sigma=0.03), changed(points("smpl24"), points("smpl24", sigma=0.04).points.p_world)
    both, agreements = combined(one, other)
    assert error_mm(both) < min(error_mm(combined(one)[0]), error_mm(combined(other)[0]))
    assert [agreement.title for agreement in agreements] == ["MHR of SAM 3D Body, 70 points", "SMPL, 24 joints"]


@pytest.mark.parametrize(
    ("unit", "late", "said"), [(1000.0, 0.0, "in mm"), (0.9, 0.08, "in m"), (37.0, 0.0, "in a unit of its own")]
)
def test_axes_scale_and_clock_are_found_and_said(unit: float, late: float, said: str) -> None:
    lean = so3.exp(np.radians([20.0, 80.0, -120.0]))
    given = points(unit=unit, late=late)
    both, (found,) = combined(changed(given, given.points.p_world @ lean.T))
    assert error_mm(both) < 0.7 * error_mm(OWN)
    assert found.scale == pytest.approx(1 / unit, rel=0.03)
    assert found.delay == pytest.approx(late, abs=0.02)
    R = planted.camera().R_camera_world.T @ lean.T
    assert np.degrees(so3.angle_between(found.R_world_file, R)) < 3.0
    assert f": {said} (scale" in str(found)


def test_y_up_is_found_and_said() -> None:
    given = points()
    world = given.points.p_world @ planted.camera().R_camera_world
    assert ", -y up, " in str(combined(given)[1][0])  # as the camera's
    for up, R_file_world in (("z", np.eye(3)), ("y", so3.exp(np.radians([-90.0, 0.0, 0.0])))):
        assert f", {up} up, " in str(combined(changed(given, world @ R_file_world.T))[1][0])


def cases() -> dict[str, tuple[LiftPoints, str]]:
    """Bad input, and the cause that is said."""
    given = points()
    p, times = given.points.p_world, given.points.times
    return {
        "another person": (points(truth=planted.moving(BODY, 120, seed=9, radians=1.0)), "its motion is not that in"),
        "another time": (points(late=100.0), "it has no frame of this video: it shows somebody from 100.00 to 101.98"),
        "nobody, missing": (changed(given, p * np.nan), "it shows nobody: no frame has 8 of the points"),
        "nobody, zeros": (changed(given, p * 0.0), "it shows nobody: no frame has 8 of the points"),
        "mirrored": (changed(given, p * [-1, 1, 1]), "its points are mirrored: its axes are left-handed, or left and"),
        "another rate": (changed(given, times=times * 1.5), "its times are at another rate: it lasts 2.98 s, the"),
    }


@pytest.mark.parametrize("name", cases())
def test_what_is_not_of_the_video_is_left_out_with_its_cause(name: str) -> None:
    given, cause = cases()[name]
    found, (agreement,) = combined(given)
    assert error_mm(found) == error_mm(OWN)
    assert agreement.warning.startswith(f"points.npz is not used as a lift: {cause}")
    assert f"left out, {cause}" in str(agreement)


def test_the_result_names_every_lift_and_why_one_is_not_used() -> None:
    alone, both = reconstructed(), reconstructed(cases()["mirrored"][0], points(sigma=0.01))
    p = TRUTH.poses.p_world_joint
    errors = (planted.root_relative_mm(result.motion.poses.p_world_joint, p) for result in (both, alone))
    assert next(errors) < 0.75 * next(errors)
    wrong, right = both.lifts
    assert (wrong.warning in both.warnings, right.doubt) == (True, "")
    assert not [warning for warning in alone.warnings if "as a lift" in warning]


def test_one_of_two_cameras_is_the_one_that_the_lift_is_of() -> None:
    recording = planted.recording(TRUTH, sigma_px=2.0)
    recording = replace(recording, views=(VIDEO,), lifts=(points(),))
    assert len(reconstruct(recording, mode="lift", lifter=planted.PlantedLifter(TRUTH)).lifts) == 1


def test_times_are_those_of_the_videos_own_clock() -> None:
    shifted = VIDEO.on_clock(VIDEO.times + 30.0)
    own = replace(OWN, poses=replace(OWN.poses, times=shifted.times))
    assert external(points(), own, shifted, BODY)[1].doubt == ""


def test_gaps_are_filled_by_the_own_lift() -> None:
    given = points()
    p = np.array(given.points.p_world)
    p[40:80] = np.nan
    found, _ = combined(changed(given, p))
    own = OWN.poses.p_world_joint
    np.testing.assert_allclose(found.poses.p_world_joint[50:70], own[50:70], atol=1e-6)
    assert error_mm(found, slice(0, 30)) < 0.75 * error_mm(OWN, slice(0, 30))


def crossed(given: LiftPoints, frames: slice, words: tuple[str, ...]) -> LiftPoints:
    """The points with left and right exchanged in some frames, of joints that have such words in their names."""
    p, names = given.points.p_world.copy(), given.points.names
    other = [names.index(n.replace("left", "?").replace("right", "left").replace("?", "right")) for n in names]
    own = [k for k, name in enumerate(names) if any(word in name for word in words)]
    p[frames, own] = given.points.p_world[frames][:, [other[k] for k in own]]
    return changed(given, p)


@pytest.mark.parametrize("words", [("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"), ("",)])
def test_sides_that_are_exchanged_for_some_frames_are_mended(words: tuple[str, ...]) -> None:
    given = points("coco17", sigma=0.01)
    right, _ = combined(given)
    found, (agreement,) = combined(crossed(given, slice(30, 54), words))
    assert error_mm(found) < 1.03 * error_mm(right) < 0.8 * error_mm(OWN)
    assert agreement.exchanged == pytest.approx(0.2, abs=0.02)
    assert f", sides exchanged back in {100 * agreement.exchanged:.0f} % of its frames; joints" in str(agreement)


def test_sides_that_are_exchanged_for_long_make_the_points_unused() -> None:
    given = points("coco17", sigma=0.01)
    found, (agreement,) = combined(crossed(given, slice(20, 110), ("hip", "knee", "ankle")))
    assert error_mm(found) == error_mm(OWN)
    assert re.fullmatch("left and right are exchanged in (6|7). % of its frames", agreement.doubt)


def test_what_is_known_of_a_model_counts_more_than_its_agreement() -> None:
    about_hips = points("mediapipe33")
    p = np.array(about_hips.points.p_world)
    names = about_hips.points.names
    hips = p[:, [names.index("left_hip"), names.index("right_hip")]].mean(axis=1)
    _, (known,) = combined(changed(about_hips, p - hips[:, None]))
    _, (unknown,) = combined(changed(about_hips, p + TRUTH.poses.p_world_joint[:, :1]))
    assert known.sigma[0] > 0.13 > unknown.sigma[0]  # the latter may be of several cameras


def test_sensors_tell_which_lift_is_better_on_their_segments() -> None:
    turned = points(truth=planted.moving(BODY, 120, seed=9, radians=0.3))
    sensors = planted.recording(TRUTH, sigma_px=2.0).bone_imus(times=VIDEO.times)
    assert sensors is not None
    alone, informed = (external(turned, OWN, VIDEO, BODY, imus)[0] for imus in (None, sensors))
    ratio = np.nanmedian(informed.sigma_m / alone.sigma_m, axis=(0, 2))
    at_ends = {child for name in sensors.joints for child in children_of(BODY.parents, BODY.names.index(name))}
    assert at_ends
    assert {j for j in range(len(BODY.names)) if ratio[j] > 1.01} <= at_ends
    assert error_mm(fused([OWN, informed], [VIDEO] * 2, BODY)) < error_mm(fused([OWN, alone], [VIDEO] * 2, BODY))


@pytest.mark.parametrize(
    ("away", "worse", "least", "error", "weight"),
    [
        (0.10, 0.0, 0.01, 0.03 + np.sqrt(0.1**2 - 0.91 * 0.1**2), None),
        (0.05, 0.0, 0.01, 0.07, 0.7),  # both may err alike
        (0.10, 0.0, 0.12, 0.12, 0.28),
        (0.10, 2.0, 0.01, 0.20, 0.01),
    ],
)
def test_the_weight_follows_from_difference_error_and_what_is_known(
    away: float, worse: float, least: float, error: float, weight: float | None
) -> None:
    shape = (4, 3, 2)
    own, ratio, known = np.full(shape, 0.1), np.ones(3), np.ones(shape[:2], dtype=bool)
    found, sigma = _sigma(np.full(shape, away), own, known, ratio, np.full(3, worse), np.full((3, 2), least))
    error = max(error, 0.07)
    np.testing.assert_allclose(found[1:, 1], error)
    weight = min((1 + (0.1**2 - error**2) / away**2) / 2, 0.7) if weight is None else weight
    np.testing.assert_allclose(0.1**2 / (0.1**2 + sigma[1:, 1] ** 2), weight)


def test_a_joint_by_several_points_follows_those_whose_place_is_known_better() -> None:
    off = np.zeros((1, 2, 3))
    off[0, 0, 0] = 0.1
    joints, spread = np.array([4, 4]), np.array([0.03, 0.01])
    np.testing.assert_allclose(mean_joints(joints, spread, (1, 21, 3), off)[0, 4], [0.01, 0, 0])
    np.testing.assert_allclose(spread_of_joints(joints, spread, 21)[4], 1 / np.hypot(1 / 0.03, 1 / 0.01))
    off[0, 1] = np.nan
    np.testing.assert_allclose(mean_joints(joints, spread, (1, 21, 3), off)[0, 4], [0.1, 0, 0])


def test_names_of_no_known_convention_are_refused() -> None:
    given = points()
    odd = MarkerSequence(given.points.times, tuple(f"p{k}" for k in range(23)), given.points.p_world)
    with pytest.raises(InvalidInputError, match="of no known marker set"):
        combined(LiftPoints("odd.trc", odd))
    few = [given.points.names.index(f"{side}-{name}") for name in ("hip", "knee") for side in ("left", "right")]
    names = tuple(given.points.names[k] for k in few)
    some = MarkerSequence(given.points.times, names, given.points.p_world[:, few])
    with pytest.raises(InvalidInputError, match=r"few\.trc: its points are on 3 segments; give 8 or more"):
        combined(LiftPoints("few.trc", some, "mhr70"))
