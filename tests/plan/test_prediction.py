"""Expected errors: they follow the sensors and the camera, and agree with those of the simulations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import JOINTS, NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.decomposition import angle_sigmas, relative_rotations
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan import identifiability
from rtof_kin.plan.identifiability import NOT_IDENTIFIABLE, ROOT, Information, information
from rtof_kin.plan.prediction import Prediction, predict
from rtof_kin.plan.setup import Setup
from rtof_kin.recording.subject import Estimate, Subject
from rtof_kin.simulation.simulate import another_person
from rtof_kin.solve.joint_space.covariance import confidence_of
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.vision import layouts


@pytest.fixture(scope="module")
def predicted(setup: Setup) -> dict[str, Prediction | str]:
    away = replace(setup, camera=Camera.looking_at([4.0, 0, 1], [8.0, 0, 1], 1250.0))
    more = replace(setup, sensors=(*setup.sensors, "Pelvis"))
    image = replace(setup, sensors=())
    return predict({"own": setup, "more": more, "image": image, "away": away}, 1, workers=1)


def of(predicted: dict[str, Prediction | str], name: str) -> Prediction:
    found = predicted[name]
    assert isinstance(found, Prediction), found
    return found


def test_a_pelvis_sensor_lowers_the_error_of_the_pelvis(predicted: dict[str, Prediction | str]) -> None:
    names = ["pelvis_tilt", "right_hip_flexion", "left_hip_flexion"]
    before, after = (of(predicted, key).select(names).sigma for key in ("own", "more"))
    assert np.all(after < 0.7 * before)


def test_an_angle_that_nothing_shows_is_not_observed(predicted: dict[str, Prediction | str]) -> None:
    found = of(predicted, "image").select(["right_hip_internal_rotation"])
    assert np.isnan(found.sigma).all()
    assert found.observed[0] < 0.5


def test_stated_and_simulated_errors_are_of_one_size(predicted: dict[str, Prediction | str]) -> None:
    found = of(predicted, "own")
    known = np.isfinite(found.sigma)
    assert 0.4 < np.median(found.error[known] / found.sigma[known]) < 1.6


def test_a_person_out_of_view_is_a_problem_not_a_number(setup: Setup, predicted: dict[str, Prediction | str]) -> None:
    assert isinstance(predicted["away"], str)


def test_the_pelvis_is_confused_with_the_hips_until_it_has_a_sensor(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identifiability, "_FRAGMENTS", 2)
    few, more = (information(replace(setup, sensors=s), 0) for s in (setup.sensors[4:], ("Pelvis",)))
    tilt, flexion = (few.names.index(name) for name in ("pelvis_tilt", "right_hip_flexion"))
    assert abs(few.correlation[tilt, flexion]) > 0.9
    assert few.sigma[tilt] > 3 * more.sigma[tilt]
    assert more.sigma[tilt] < NOT_IDENTIFIABLE
    assert np.isnan(few.sigma[few.names.index("right_knee_adduction")])  # the model has a hinge there


def test_angles_have_the_standard_deviations_of_the_covariances(setup: Setup) -> None:
    skeleton = setup.skeleton
    names = skeleton.names
    space = StateSpace(skeleton, names, False)
    x = space.from_poses(setup.poses.p_world_joint[:1, 0], setup.poses.R_world_bone[:1])
    A = np.random.default_rng(0).standard_normal((space.size, space.size))
    C = 1e-4 * A @ A.T / space.size
    _, R = space.poses(x)
    table = angle_table(skeleton.table)
    confidence = confidence_of(space, np.zeros(1), x, C[None])
    expected = angle_sigmas(relative_rotations(R, skeleton, table), table, skeleton, confidence)[0]
    J = identifiability._rates(space, x, setup.camera)[: len(expected)]
    np.testing.assert_allclose(np.sqrt(np.diag(J @ C @ J.T)), expected, rtol=1e-3)


def test_a_known_person_is_wrong_by_the_standard_deviations_of_the_file(setup: Setup) -> None:
    bones = zip(setup.skeleton.names[1:], setup.skeleton.joint_offsets[1:], strict=True)
    known = {f"joint_offsets_m.{joint}": Estimate[Any](value=offset, sd=0.004) for joint, offset in bones}
    known |= {f"posture_deg.{joint}": Estimate[Any](value=np.zeros(3), sd=0.1) for joint in JOINTS}
    subject = Subject.of({"subject": "P07"}, Path("P07.toml")).with_known(known, {})
    right = setup.recorded(0)
    found = replace(setup, subject=subject).recorded(0)
    assert found.truth is not None
    assert right.truth is not None
    assert np.array_equal(found.truth.R_world_bone, right.truth.R_world_bone)
    assert 0.003 < np.std((found.joint_offsets - right.joint_offsets)[1:]) < 0.005
    assert found.posture is not None
    turned = so3.angle_between(found.posture.R_parent_bone, np.eye(3))
    assert np.degrees(turned).max() > 3  # of the draw's person, not of the file's
    t_pose = another_person(np.random.default_rng([0, 1]), upright(setup.skeleton), setup.skeleton)
    true = NeutralPosture.of(t_pose, setup.skeleton.parents)
    assert np.degrees(so3.angle_between(found.posture.R_parent_bone, true.R_parent_bone)).max() < 0.5


def upright(skeleton: SkeletonModel) -> PoseSequence:
    """The zero pose of a body, twice."""
    R = np.tile(np.eye(3), (2, len(skeleton.names), 1, 1))
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.zeros((2, 3)), R)
    return PoseSequence(np.arange(2.0), p, R, skeleton.names)


def test_a_smaller_detector_shows_fewer_points(setup: Setup) -> None:
    assert len(replace(setup, detector="coco17").recorded(0).video.names) < len(setup.recorded(0).video.names)


def test_a_detector_is_simulated_by_its_layout(setup: Setup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = replace(setup, detector="anatomical52").recorded(0)
    assert "anatomical52:LeftPsis" in found.video.names
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    file = tmp_path / "belt.toml"
    point = '[[point]]\nname = "Buckle"\njoint = "Hips"\noffset_mm = [110, 0, 60]\n'
    names = ("nose", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "buckle")
    file.write_text(f'{point}[[layout]]\nname = "belt"\nnames = {list(names)}\n', encoding="utf-8")
    assert "belt:Buckle" in replace(setup, detector=str(file)).recorded(0).video.names


def test_a_weakness_names_its_direction() -> None:
    names = ("pelvis_tilt", "pelvis_list", "right_wrist_flexion")
    correlation = np.zeros((3, 3 + len(ROOT)))
    correlation[0, 1], correlation[0, 5] = 0.99, -0.9  # list is of the same joint
    sigma = np.array([1.5, 0.1, 3.0]) * NOT_IDENTIFIABLE
    wrist, pelvis = Information(names, sigma, correlation).weaknesses(names, names)
    assert pelvis.words.startswith("pelvis tilt against distance")
    assert wrist.confused_with == ""
    assert "90 deg" in wrist.words
