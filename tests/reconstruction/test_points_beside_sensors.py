"""Joints of a file beside sensors: brought to their clock and axes, better than sensors alone, no harm where wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from reconstruction_support import BODY

from rtof_kin.body.skeleton import Motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.inertial.initial_poses import poses_from_sensors
from rtof_kin.inertial.root_path import Contacts
from rtof_kin.reconstruction.external_lift import Agreement
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.points_beside_sensors import MeasuredJoints, _level, beside_sensors
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.simulation.noise import coloured_noise
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.vision.lift_points import LiftPoints, convention

TRUTH = planted.human(BODY, 240)
WALK = planted.walking(BODY, 4.0)[0]
Y_UP = so3.exp(np.radians([-90.0, 0.0, 0.0])) @ so3.exp(np.radians([0.0, 8.0, 70.0]))
FEW = ("LeftForeArm", "RightForeArm", "LeftLeg", "RightLeg")
AXES = np.array([1.0, -2.0, 0.3])  # [m] where the file's origin is


def trial(
    truth: Motion = TRUTH, error: float = 0.0, unit: float = 1.0, late: float = 0.0, exchanged: slice = slice(0)
) -> LiftPoints:
    """Joints as of COCO, y up, with errors that last a second, and sides exchanged in some frames."""
    form, poses = convention("coco17"), truth.poses
    segments = [BODY.names.index(segment) for segment in form.segments]
    p = poses.p_world_joint[:, segments] + np.einsum("tkij,kj->tki", poses.R_world_bone[:, segments], form.places)
    p = p + error / np.sqrt(3) * coloured_noise(np.random.default_rng(1), truth.times, 1.0, form.places.shape)
    names = form.layout.names
    other = [names.index(n.replace("left", "?").replace("right", "left").replace("?", "right")) for n in names]
    p[exchanged] = p[exchanged][:, other]
    return LiftPoints("trial.trc", MarkerSequence(truth.times + late, names, unit * (p + AXES) @ Y_UP.T))


def changed(given: LiftPoints, p_world: Array) -> LiftPoints:
    return replace(given, points=replace(given.points, p_world=p_world))


def sensed(truth: Motion = TRUTH) -> tuple[PoseSequence, BoneImuSequence]:
    recording = planted.recording(truth)
    imus = recording.bone_imus(times=truth.times)
    assert imus is not None
    return poses_from_sensors(BODY, imus), imus


ALONE = sensed()


def found(given: LiftPoints) -> tuple[MeasuredJoints, Agreement]:
    return beside_sensors(given, *ALONE, BODY)


def off_mm(measured: MeasuredJoints, truth: Motion = TRUTH, frames: slice = slice(None)) -> float:
    """Mean distance of shown joints from the true ones, both about their mean."""
    off = (measured.p_world - truth.poses.p_world_joint)[frames]
    return float(1000 * np.nanmean(np.linalg.norm(off - np.nanmean(off, axis=(0, 1)), axis=-1)))


@pytest.mark.parametrize(("unit", "late", "said"), [(1000.0, 0.08, "in mm"), (1.0, 3.43, "in m"), (0.7, -1.2, "own")])
def test_axes_unit_and_clock_are_found(unit: float, late: float, said: str) -> None:
    measured, agreement = found(trial(unit=unit, late=late, error=0.02))
    assert agreement.doubt == ""
    assert agreement.delay == pytest.approx(late, abs=0.012)
    assert np.degrees(so3.angle_between(agreement.R_world_file, Y_UP.T)) < 2.5
    assert off_mm(measured) < 30.0
    assert f"{said} (scale" in str(agreement)
    assert "y up" in str(agreement)
    assert "the own lift" not in str(agreement)


def test_sides_that_are_exchanged_are_exchanged_back() -> None:
    right, wrong = (found(trial(exchanged=frames))[0] for frames in (slice(0), slice(100, 150)))
    assert off_mm(wrong) < off_mm(right) + 3.0
    assert found(trial(exchanged=slice(100, 150)))[1].exchanged == pytest.approx(50 / 240, abs=0.02)


@pytest.mark.parametrize("error", [0.0, 0.05, 0.1])
def test_errors_are_estimated_by_the_bones_with_sensors(error: float) -> None:
    measured, _ = found(trial(error=error))
    knees = measured.sigma[BODY.index("LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm")]
    true = max(float(np.hypot(error / np.sqrt(3), 0.0)), convention("coco17").sigma[0])
    assert np.sqrt(np.mean(knees**2)) == pytest.approx(true, rel=0.35)


@pytest.mark.parametrize(
    ("given", "cause"),
    [
        (trial(planted.human(BODY, 240, seed=9)), "its motion is not that of the sensors (bones turn alike by 0."),
        (changed(trial(), trial().points.p_world * [-1, 1, 1]), "its points are mirrored: its axes are left-handed"),
        (changed(trial(), trial().points.p_world * np.nan), "it shows nobody: no frame has 8 of the points"),
        (
            replace(trial(), points=trial().points[:20]),
            "it shows bones with sensors for 0.3 s at their times, and 0.5 s",
        ),
    ],
)
def test_what_is_not_of_the_sensors_is_left_out_with_its_cause(given: LiftPoints, cause: str) -> None:
    _, agreement = found(given)
    assert agreement.doubt.startswith(cause)
    assert f"left out, {cause}" in str(agreement)


def test_points_about_the_hips_say_nothing_of_the_path() -> None:
    given = trial()
    hips = [given.points.names.index(f"{side}_hip") for side in ("left", "right")]
    p = given.points.p_world
    measured, agreement = found(changed(given, p - p[:, hips].mean(axis=1, keepdims=True)))
    assert agreement.doubt == ""
    assert np.isnan(measured.root).all()
    assert {term.joint[1] for term in measured.terms(BODY)} == {"Hips"}
    assert np.isfinite(found(given)[0].root[5:-5]).all()


def test_what_is_up_follows_from_where_feet_stand() -> None:
    turn, poses = so3.exp(np.radians([1.5, -2.0, 0.0])), WALK.poses
    tilted = replace(poses, p_world_joint=poses.p_world_joint @ turn.T)
    contacts = Contacts(("LeftFoot", "RightFoot"), planted.walking(BODY, 4.0)[1])
    level = _level(tilted, contacts, BODY) @ turn
    assert np.degrees(so3.log(level))[1] == pytest.approx(0.0, abs=0.7)  # along the walk; across it is short
    np.testing.assert_allclose(_level(tilted, Contacts(contacts.joints, contacts.standing & False), BODY), np.eye(3))


def solved(*lifts: LiftPoints) -> Reconstruction:
    recording = replace(planted.recording(WALK, joints=FEW, degrees=4.0), keypoints=None, lifts=lifts)
    settings = ReconstructionSettings(frames=20, fragment=JointSpaceSettings(compile="never"))
    return reconstruct(recording, mode="imu", settings=settings)


def test_a_file_makes_the_motion_of_sensors_better_with_bands_and_another_one_leaves_it() -> None:
    given = trial(WALK, error=0.03, unit=1000.0, late=0.08, exchanged=slice(20, 50))
    p = np.array(given.points.p_world)
    p[100:150] = np.nan
    alone, both, other = solved(), solved(changed(given, p)), solved(trial(planted.human(BODY, 240, seed=9)))
    true = WALK.poses.p_world_joint
    errors = []
    for result in (alone, both):
        p = result.motion.poses.p_world_joint
        away = (p - p[:, :1]) - (true - true[:, :1])
        path = p[:, 0] - true[:, 0]
        errors.append((np.linalg.norm(away, axis=-1).mean(), np.linalg.norm(path - path.mean(axis=0), axis=-1).mean()))
    assert errors[1][0] < 0.9 * errors[0][0]
    assert errors[1][1] < 0.6 * errors[0][1]
    stated = both.motion.confidence
    assert stated is not None
    inside = np.abs(away[:, 1:]) <= BAND_95 * np.sqrt(np.diagonal(stated.relative_covariance, axis1=2, axis2=3))[:, 1:]
    assert 0.85 < inside.mean() < 0.995
    foot = BODY.names.index("LeftFoot")
    assert {*both.motion.poses.provenance[:90, foot]} == {Provenance.CAMERA_AND_IMU}
    assert {*both.motion.poses.provenance[110:140, foot]} == {Provenance.IMU}
    assert both.root_sigma is not None
    assert both.root_sigma[125] > 2 * both.root_sigma[50]
    assert (both.warnings, [one.doubt for one in both.lifts]) == ((), [""])
    assert other.lifts[0].warning in other.warnings
    assert other.motion.confidence is None
    np.testing.assert_array_equal(other.motion.q, alone.motion.q)
