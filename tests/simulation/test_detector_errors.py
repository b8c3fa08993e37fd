"""Simulated detections: places, sizes, correlations and events are those of the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import detector_point
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.detector_errors import (
    Covariance,
    DetectorErrors,
    DetectorErrorTable,
    detector_error_table,
    episodes,
    ornstein_uhlenbeck,
    self_occluded,
    simulate_detections,
)
from rtof_kin.simulation.simulate import SimulationSettings, simulate
from rtof_kin.vision.image_points import image_points
from rtof_kin.vision.layouts import detector_table

Array = NDArray[np.float64]
SKELETON = SkeletonModel.default().with_height(1.68)
TABLE = detector_error_table()
POSES = planted.moving(SKELETON, 120).poses
STANDING = planted.upright(SKELETON, 900).poses
NONE = DetectorErrors.none()
HIPS, FORWARD, LEFTWARD = STANDING.p_world_joint[0, 0], *STANDING.R_world_bone[0, 0].T[:2]
UP = np.array([0.0, 0.0, 1.0])
FRONT = Camera.looking_at(HIPS + 4.0 * FORWARD + 0.2 * UP, HIPS, 1250.0)
LEFT = Camera.looking_at(HIPS + 4.0 * LEFTWARD + 0.2 * UP, HIPS, 1250.0)


def found(
    errors: DetectorErrors, poses: PoseSequence = STANDING, camera: Camera = FRONT, seed: int = 0
) -> tuple[Array, Array]:
    detections = simulate_detections(np.random.default_rng(seed), poses, SKELETON, camera, errors)
    return detections.uv_px[:, 0], detections.confidence[:, 0]


def errors_mm(errors: DetectorErrors, camera: Camera = FRONT, seed: int = 0) -> Array:
    """Errors (T, K, 2) of a standing person at the depth of the points, mm."""
    depth = camera.to_camera(STANDING.p_world_joint[0, list(SKELETON.index(*TABLE.places.anchor))])[:, 2:]
    exact = found(NONE, STANDING[:2], camera)[0][0]
    difference = found(errors, camera=camera, seed=seed)[0] - exact
    return np.asarray(difference * depth / 1250 * 1e3)


def point(name: str) -> int:
    return TABLE.layout.names.index(name)


def test_recordings_of_one_person_have_the_same_places() -> None:
    person = replace(NONE, person=1.0, view=1.0)
    one, same = (found(replace(person, who=7), STANDING[:2], seed=seed)[0] for seed in (0, 1))
    np.testing.assert_array_equal(one, same)
    others = [found(who, STANDING[:2])[0] for who in (person, replace(person, who=8))]
    assert all(np.abs(one - other).max() > 1.0 for other in others)


def test_without_errors_points_are_projected_from_their_places() -> None:
    camera = replace(planted.camera(), distortion=np.array([0.1, -0.05, 0.001, 0.002, 0.01]))
    uv, _ = found(NONE, POSES, camera)
    bones = np.linalg.norm(SKELETON.joint_offsets[SKELETON.index("RightLeg", "RightFoot")], axis=-1).sum()
    rows = load_toml(model_path("detector_errors.toml"))["point"]
    for name, side, sign in (("nose", "", 1), ("right_wrist", "Right", 1), ("left_heel", "Left", -1)):
        row = rows[name.split("_")[-1]]
        anchor, frame, second = (
            SKELETON.index(row[field].replace("Right", side))[0] for field in ("anchor", "frame", "second_frame")
        )
        mirrored = [1, sign, 1]
        p = POSES.R_world_bone[:, frame] @ np.multiply(row["mean_mm"], mirrored)
        p += POSES.R_world_bone[:, second] @ np.multiply(row["pose_mm"], mirrored)
        expected = camera.project(POSES.p_world_joint[:, anchor] + p / 750 * bones)
        np.testing.assert_allclose(uv[:, point(name)], expected, atol=1e-6)


def test_the_mirror_image_of_a_motion_gives_the_mirror_image_of_the_detections() -> None:
    swapped = SKELETON.index(
        *(name.replace("Left", "X").replace("Right", "Left").replace("X", "Right") for name in SKELETON.names)
    )
    M, flip = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, 1.0])
    poses = PoseSequence(
        POSES.times, POSES.p_world_joint[:, swapped] @ M, M @ POSES.R_world_bone[:, swapped] @ M, POSES.names
    )
    camera = planted.camera()
    other = replace(
        camera, R_camera_world=flip @ camera.R_camera_world @ M, t_camera_world=flip @ camera.t_camera_world
    )
    errors = replace(NONE, view=1.0)
    uv, mirrored = found(errors, POSES, camera)[0], found(errors, poses, other)[0][:, TABLE.mirror]
    mirrored[..., 0] = 2 * camera.K[0, 2] - mirrored[..., 0]
    sided = TABLE.mirror != np.arange(33)
    np.testing.assert_allclose(uv[:, sided], mirrored[:, sided], atol=1e-6)
    assert np.abs(uv - found(NONE, POSES, camera)[0]).max() > 3, "the view matters"


def test_parts_of_the_errors_add_up_and_the_seed_determines_them() -> None:
    both = errors_mm(replace(NONE, constant=1.0, coloured=1.0), seed=3)
    parts = errors_mm(replace(NONE, constant=1.0), seed=3) + errors_mm(replace(NONE, coloured=1.0), seed=3)
    np.testing.assert_allclose(both, parts, atol=1e-6)
    np.testing.assert_array_equal(both, errors_mm(replace(NONE, constant=1.0, coloured=1.0), seed=3))
    assert not np.array_equal(both, errors_mm(replace(NONE, constant=1.0, coloured=1.0), seed=4))


def dense(covariance: Covariance, index: int | tuple[()] = ()) -> Array:
    """Covariance (66, 66), mm2."""
    factor = covariance.factor[index].reshape(66, -1) * 1e3
    return np.asarray(factor @ factor.T + np.diag((covariance.rest[index].ravel() * 1e3) ** 2))


def test_the_constant_errors_have_the_covariance_of_the_table() -> None:
    short = STANDING[:2]
    exact = found(NONE, short)[0][0]
    drawn = np.array([found(replace(NONE, constant=1.0), short, seed=s)[0][0] - exact for s in range(400)])
    depth = FRONT.to_camera(STANDING.p_world_joint[0, list(SKELETON.index(*TABLE.places.anchor))])[:, 2:]
    sample, expected = np.cov((drawn * depth / 1.25).reshape(400, -1).T), dense(TABLE.constant)
    np.testing.assert_allclose(np.sqrt(np.diag(sample)), np.sqrt(np.diag(expected)), rtol=0.2)
    assert np.linalg.norm(sample - expected) < 0.25 * np.linalg.norm(expected)


@pytest.fixture(scope="module")
def coloured() -> Array:
    """Coloured errors (S, T, K, 2) of a person who stands and is seen from the front, mm."""
    return np.array([errors_mm(replace(NONE, coloured=1.0), seed=seed) for seed in range(32)])


@pytest.mark.parametrize("name", ["left_hip", "nose", "right_shoulder"])
def test_coloured_errors_have_the_size_of_the_table(coloured: Array, name: str) -> None:
    k = point(name)
    size = np.sqrt(np.diag(dense(TABLE.coloured, 0)).reshape(33, 2)[k]) * TABLE.amplitude["gain"][k]
    np.testing.assert_allclose(np.sqrt((coloured[:, :, k] ** 2).mean(axis=(0, 1))), size, rtol=0.2)


def windowed(lag: float) -> Array:
    """Autocovariance (C,) of an unsmoothed unit process of each time constant under the window."""
    steps = np.linspace(-4, 4, 161)
    weight = np.exp(-0.5 * steps**2)
    lags = np.abs(lag + np.sqrt(2) * TABLE.smoothing * steps)
    return np.asarray(weight @ np.exp(-lags[:, None] / np.maximum(TABLE.time_constants, 1e-6)) / weight.sum())


@pytest.mark.parametrize("group", ["face", "hip", "wrist"])
def test_coloured_errors_have_the_correlation_times_of_the_table(coloured: Array, group: str) -> None:
    k = np.flatnonzero(TABLE.kind == TABLE.group.index(group))
    shares, mood_sd = TABLE.shares[k[0]], TABLE.amplitude["mood_sd"][k[0]]
    for lag in (0.1, 0.5, 2.0):
        steps, slow = round(lag * 60), TABLE.time_constants > 0
        x = coloured[:, :, k]
        measured = (x[:, steps:] * x[:, :-steps]).mean() / (x**2).mean()
        expected = (shares[slow] * windowed(lag)[slow]).sum() / (shares[slow] * windowed(0.0)[slow]).sum()
        expected *= np.exp(-(mood_sd**2) * (1 - np.exp(-lag / 0.3)))
        assert measured == pytest.approx(expected, abs=0.1), lag


def test_errors_of_shoulders_and_hips_are_correlated_as_in_the_table(coloured: Array) -> None:
    own = (2 * TABLE.points_of(["shoulder", "hip"])[:, None] + [0, 1]).ravel()
    C = dense(TABLE.coloured, 0)[np.ix_(own, own)]
    expected = C / np.sqrt(np.outer(np.diag(C), np.diag(C)))
    assert np.abs(expected - np.eye(8)).max() > 0.5
    np.testing.assert_allclose(np.corrcoef(coloured.reshape(-1, 66)[:, own].T), expected, atol=0.2)


def test_a_body_in_profile_hides_its_other_side_which_errs_more_and_is_less_visible() -> None:
    def hidden(camera: Camera) -> NDArray[np.bool_]:
        p = camera.to_camera(STANDING.p_world_joint[:1])
        return self_occluded(p, p[:, SKELETON.index(*TABLE.places.anchor)], TABLE.limb, SKELETON)[0]

    right_knee, left_knee = point("right_knee"), point("left_knee")
    assert hidden(LEFT)[right_knee]
    assert not hidden(LEFT)[left_knee]
    assert not hidden(FRONT)[[right_knee, left_knee]].any()
    size = np.sqrt(np.mean([errors_mm(replace(NONE, coloured=1.0), LEFT, s) ** 2 for s in range(6)], axis=(0, 1, 3)))
    seen = np.mean([found(DetectorErrors(), camera=LEFT, seed=s)[1] for s in range(4)], axis=(0, 1))
    assert size[right_knee] > 1.3 * size[left_knee]
    assert seen[right_knee] < seen[left_knee] - 0.2
    assert seen[:11].min() > 0.98, "of the face it says nothing"


def test_left_and_right_are_exchanged_in_profile_only_as_often_as_in_the_table() -> None:
    legs = TABLE.points_of(["knee", "ankle", "foot"])
    front, exact, minutes, starts = found(NONE)[0], found(NONE, camera=LEFT)[0], 0.0, 0
    for seed in range(10):
        uv, _ = found(replace(NONE, exchanges=1.0), camera=LEFT, seed=seed)
        swapped = np.abs(uv - exact[:, TABLE.mirror])[:, legs].max(axis=(1, 2)) < 1e-6
        assert np.all(swapped | (np.abs(uv - exact)[:, legs].max(axis=(1, 2)) < 1e-6)), "all of a limb at once"
        starts += int(np.count_nonzero(np.diff(swapped.astype(int)) > 0))
        minutes += len(uv) / 3600
        np.testing.assert_allclose(found(replace(NONE, exchanges=1.0), seed=seed)[0], front)
    depth = 4000 / 1250
    apart = np.linalg.norm(exact - exact[:, TABLE.mirror], axis=-1)[0, legs].mean() * depth
    expected = 100 * (0.06 + np.exp(-max(apart - 60, 0) / 60))
    assert starts / minutes == pytest.approx(expected, rel=0.25)


def test_limbs_jump_and_the_person_is_lost_for_some_frames() -> None:
    exact = found(NONE)[0]
    jumped = np.mean([np.abs(found(replace(NONE, jumps=1.0), seed=s)[0] - exact) > 1e-6 for s in range(6)], (0, 1, 3))
    assert 0.01 < jumped[point("left_wrist")] < 0.04
    assert jumped[TABLE.points_of(["face", "shoulder", "hip"])].max() == 0
    aside = Camera.looking_at(FRONT.center_world, HIPS + 2.7 * UP, 1250.0)
    uv, visibility = found(DetectorErrors(), camera=aside)
    lost = np.isnan(uv).all(axis=(1, 2))
    assert lost.mean() > 0.5
    assert np.all(visibility[lost] == 0)


def test_the_camera_stands_a_little_differently_from_what_is_said() -> None:
    exact, found_px = found(NONE, POSES[:2])[0][0], []
    for seed in range(100):
        found_px.append(found(replace(NONE, camera=1.0), POSES[:2], seed=seed)[0][0])
    z, w = (uv @ [1, 1j] for uv in (exact, np.array(found_px)))
    z0, w0 = z - z.mean(), w - w.mean(axis=1, keepdims=True)
    scale = (w0 @ z0.conj()) / (z0 @ z0.conj())
    assert np.degrees(np.angle(scale)).std() == pytest.approx(0.89, rel=0.25)
    shift = (w - z).mean(axis=1) * 4000 / 1250
    assert shift.real.std() == pytest.approx(15, rel=0.5)


@pytest.mark.parametrize("rate_hz", [60.0, 30.0])
def test_the_delay_is_in_what_the_frames_show(rate_hz: float) -> None:
    settings = replace(SimulationSettings.noiseless(), keypoints=NONE, sensors=())
    poses = POSES[:: round(60 / rate_hz)]

    def recorded(delay: float) -> tuple[Array, Array, int]:
        late = replace(settings, keypoints=replace(NONE, delay_frames=(delay,)))
        one = simulate(poses, SKELETON.joint_offsets, camera=planted.camera(), settings=late, seed=0)
        return one.keypoints.uv_px, one.keypoints.times, one.first_frame

    frames = round(2 * rate_hz / 60)
    (uv, times, _), (late, late_times, first) = recorded(0), recorded(2)
    assert first == frames
    np.testing.assert_array_equal(late_times, times[frames:])
    both = np.isfinite(late) & np.isfinite(uv[:-frames])
    assert np.median(np.abs(late - uv[:-frames])[both]) < 1e-6
    assert np.nanmedian(np.abs(late - uv[frames:])) > 0.2, "or else the test says nothing"


def test_a_realistic_recording_has_the_keypoints_of_a_detectors_file_and_the_camera_as_said() -> None:
    camera = planted.camera()
    settings = SimulationSettings.realistic()
    recording = simulate(POSES, SKELETON.joint_offsets, camera=camera, settings=settings, seed=1)
    assert recording.keypoints.camera is camera
    assert set(SKELETON.names) < set(recording.keypoints.names)
    assert recording.first_frame in (1, 2, 3)
    few = simulate(
        POSES, SKELETON.joint_offsets, camera=camera, settings=replace(settings, landmarks=("Nose",)), seed=1
    )
    np.testing.assert_array_equal(few.keypoints.uv_px, recording.keypoints.select(["Nose"]).uv_px)


def test_processes_and_episodes_have_their_memory_rate_and_duration() -> None:
    rng = np.random.default_rng(0)
    x = ornstein_uhlenbeck(rng, 4000, (50,), 20.0)
    assert x[0].std() == pytest.approx(1, abs=0.25)
    assert x.std() == pytest.approx(1, rel=0.05)
    assert (x[20:] * x[:-20]).mean() == pytest.approx(np.exp(-1), abs=0.05)
    runs = episodes(rng, np.full(600_000, 12.0), 60.0, {"duration": 0.5, "duration_spread": 0.3})
    assert len(runs) == pytest.approx(12 * 600_000 / 3600, rel=0.1)
    assert np.median([run.stop - run.start for run in runs]) == pytest.approx(30, abs=2)


ANATOMICAL = detector_error_table("anatomical52")
LEG = sum(SKELETON.bone_lengths[name] for name in ("RightLeg", "RightFoot"))


def places_of(who: int | None, seed: int = 0, **factors: float) -> Array:
    """(52, 2) px of one standing person."""
    errors = replace(NONE, layout="anatomical52", person=1.0, who=who)
    return found(replace(errors, **factors), STANDING[:2], seed=seed)[0][0]


def test_points_of_a_layout_stand_where_the_reconstruction_looks_for_them() -> None:
    """Also on a rig with turned link frames."""
    Q = np.tile(np.eye(3), (len(SKELETON.names), 1, 1))
    Q[0] = so3.about_axis("y", 0.15)
    for name, axis in (("LeftUpLeg", "x"), ("RightArm", "z")):
        Q[SKELETON.index(name)[0]] = so3.about_axis(axis, 0.2)
    above = Q[np.maximum(SKELETON.parents, 0)]
    turned = SKELETON.with_offsets(np.einsum("jba,jb->ja", above, SKELETON.joint_offsets))
    poses = replace(POSES, R_world_bone=POSES.R_world_bone @ Q)
    errors = replace(NONE, layout="anatomical52")
    uv = simulate_detections(np.random.default_rng(0), poses, turned, FRONT, errors).uv_px[:, 0]
    names = ANATOMICAL.layout.points
    seen = image_points(turned, [detector_point("anatomical52", name) for name in names])
    exact = FRONT.project(seen.positions(poses.p_world_joint, poses.R_world_bone))
    placed = [k for k, name in enumerate(names) if name in detector_table().places]
    np.testing.assert_allclose(uv[:, placed], exact[:, placed], atol=1e-6)
    assert len(placed) == 33


def test_a_persons_points_stand_elsewhere_by_their_spread() -> None:
    exact = found(replace(NONE, layout="anatomical52"), STANDING[:2])[0][0]
    np.testing.assert_array_equal(places_of(7, seed=1), places_of(7, seed=2))
    off = np.array([places_of(who) - exact for who in range(200)])
    depth = FRONT.to_camera(STANDING.p_world_joint[0, list(SKELETON.index(*ANATOMICAL.places.anchor))])[:, 2]
    mm = off * (depth / 1250 * 1e3)[:, None]
    size = LEG / TABLE.places.leg
    for name, across, up in (("RightAsis", 12, 12), ("C7", 6, 20), ("LeftKneeLateral", 8, 7)):
        k = ANATOMICAL.layout.points.index(name)
        np.testing.assert_allclose(mm[:, k].std(axis=0), np.multiply(size, [across, up]), rtol=0.2)
    left, right = (ANATOMICAL.layout.points.index(f"{side}Asis") for side in ("Left", "Right"))
    assert np.corrcoef(mm[:, left, 0], mm[:, right, 0])[0, 1] < -0.99  # people are symmetric
    thigh, chest = (ANATOMICAL.layout.points.index(name) for name in ("LeftKneeLateral", "C7"))
    assert abs(np.corrcoef(mm[:, thigh, 1], mm[:, chest, 1])[0, 1]) < 0.25


def test_points_of_other_layouts_err_as_those_next_to_them() -> None:
    coco = detector_error_table("coco17")
    k = [TABLE.layout.points.index(name) for name in coco.layout.points]
    np.testing.assert_array_equal(coco.coloured.factor, TABLE.coloured.factor[:, k])
    np.testing.assert_allclose(coco.coloured.rest, TABLE.coloured.rest[:, k], atol=1e-9)
    np.testing.assert_array_equal(coco.places.view, TABLE.places.view[k])
    assert [TABLE.group[g] for g in coco.kind] == [TABLE.group[g] for g in TABLE.kind[k]]

    def variance(table: DetectorErrorTable, name: str) -> Array:
        k, of = table.layout.points.index(name), table.coloured
        return np.asarray((of.factor[:, k] ** 2).sum(axis=-1) + of.rest[:, k] ** 2)

    np.testing.assert_allclose(variance(ANATOMICAL, "LeftKneeLateral"), variance(TABLE, "LeftKnee"), rtol=0.02)
    between = variance(ANATOMICAL, "T11")
    assert np.all(between > variance(TABLE, "LeftHip").min())
    assert np.all(between < variance(TABLE, "LeftShoulder").max())
    assert ANATOMICAL.mirror[ANATOMICAL.layout.points.index("LeftPsis")] == ANATOMICAL.layout.points.index("RightPsis")
    assert ANATOMICAL.mirror[ANATOMICAL.layout.points.index("T6")] == ANATOMICAL.layout.points.index("T6")
    np.testing.assert_allclose(ANATOMICAL.shares.sum(axis=1), 1.0, atol=1e-3)


def test_a_point_on_the_skin_is_hidden_where_its_side_faces_away() -> None:
    names = ANATOMICAL.layout.points
    front, behind = (
        [names.index(n) for n in ("Sternum", "LeftAsis")],
        [names.index(n) for n in ("T6", "C7", "LeftPsis")],
    )
    quiet = replace(NONE, layout="anatomical52")
    back = Camera.looking_at(HIPS - 4.0 * FORWARD + 0.2 * UP, HIPS, 1250.0)
    seen = {name: found(quiet, camera=camera)[1].mean(axis=0) for name, camera in (("front", FRONT), ("back", back))}
    assert np.all(seen["front"][front] > seen["back"][front])
    assert np.all(seen["front"][behind] < seen["back"][behind])
