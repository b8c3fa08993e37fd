"""Places of a detector's points in the body, and what moves them beside their segments."""

from __future__ import annotations

import numpy as np
import planted
import pytest
from detector_support import LAYOUTS

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.keypoints import KeypointSequence, detector_point
from rtof_kin.vision.image_points import ImagePoints, detector_points, harmonics, image_points, measurements
from rtof_kin.vision.layouts import detector_table

BODY = SkeletonModel.default()
POSES = planted.human(BODY, 5).poses
CAMERA = planted.camera()


def points(layout: str, body: SkeletonModel = BODY) -> ImagePoints:
    return image_points(body, [detector_point(layout, name) for name in detector_points(layout)])


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "mediapipe33"])
def test_points_of_unmeasured_layouts_lie_where_the_table_of_detectors_says(layout: str) -> None:
    known = {point.name: point for point in detector_table().points}
    found = points(layout)
    for name, (j, _), place in zip(detector_points(layout), found.on, found.places, strict=True):
        assert BODY.names[j] == known[name].joint
        np.testing.assert_allclose(place, known[name].offset, atol=1e-12)


def test_measured_points_lie_near_the_usual_places_in_the_t_pose() -> None:
    p, R = BODY.forward_kinematics(BODY.t_pose()[None])
    found, usual = points("mediapipe33"), {point.name: point for point in detector_table().points}
    at = found.positions(p, R)[0] + found.second_places
    for name, own in zip(detector_points("mediapipe33"), at, strict=True):
        j = BODY.names.index(usual[name].joint)
        assert np.linalg.norm(own - p[0, j] - usual[name].offset) < 0.08, name
    assert len(found.names) == 27


def test_a_rig_with_turned_link_frames_has_the_same_points() -> None:
    Q = np.tile(np.eye(3), (len(BODY.names), 1, 1))
    Q[0] = so3.about_axis("y", 0.15)
    for name, axis in (("LeftUpLeg", "x"), ("RightLeg", "y"), ("LeftArm", "z"), ("RightForeArm", "x")):
        Q[BODY.index(name)[0]] = so3.about_axis(axis, 0.2)
    above = Q[np.maximum(BODY.parents, 0)]
    turned = BODY.with_offsets(np.einsum("jba,jb->ja", above, BODY.joint_offsets))
    p, R = POSES.p_world_joint, POSES.R_world_bone
    own, other = points("mediapipe33"), points("mediapipe33", turned)
    np.testing.assert_allclose(other.positions(p, R @ Q), own.positions(p, R), atol=1e-9)
    np.testing.assert_allclose(other.displaced(CAMERA, p, R @ Q), own.displaced(CAMERA, p, R), atol=1e-6)


def test_points_of_a_person_are_moved_in_their_segments() -> None:
    p, R = POSES.p_world_joint, POSES.R_world_bone
    shift = np.array([0.02, -0.01, 0.03])
    own = BODY.with_image_points({"mediapipe33": {"LeftLeg": shift}, "halpe26": {"Head": shift}})
    moved = points("mediapipe33", own).positions(p, R) - points("mediapipe33").positions(p, R)
    knee = [*detector_points("mediapipe33")].index("LeftKnee")
    np.testing.assert_allclose(moved[:, knee], R[:, BODY.index("LeftUpLeg")[0]] @ shift, atol=1e-12)
    assert not np.delete(moved, knee, axis=1).any()


def test_sides_are_mirror_images() -> None:
    p, R = BODY.forward_kinematics(BODY.t_pose()[None])
    found, M = points("mediapipe33"), np.array([1.0, -1.0, 1.0])
    at = dict(zip(detector_points("mediapipe33"), found.positions(p, R)[0], strict=True))
    toward = so3.unit(np.array([0.4, 0.8, 0.1]))
    views = dict(zip(detector_points("mediapipe33"), found.views, strict=True))
    for name in (name for name in at if name.startswith("Left")):
        other = name.replace("Left", "Right", 1)
        np.testing.assert_allclose(at[name], at[other] * M, atol=1e-9)
        seen, opposite = harmonics(toward) @ views[name], harmonics(toward * M) @ views[other]
        np.testing.assert_allclose(seen, opposite * M, atol=1e-12)


def test_measurements_are_the_detectors_points_or_else_the_landmarks() -> None:
    names = ("Nose", "Hips", "coco17:LeftEar", "coco17:Nose")
    seen = KeypointSequence(CAMERA, np.arange(2.0), np.ones((2, 4, 2)), np.ones((2, 4)), names)
    assert measurements(seen, BODY).names == ("coco17:LeftEar", "coco17:Nose")
    assert measurements(seen.landmarks, BODY).names == (*BODY.names, "Nose")
    assert seen.landmarks.names == names[:2]
    assert measurements(seen, SkeletonModel.human36m()).names == SkeletonModel.human36m().names


def test_placed_points_share_what_is_next_to_a_joint() -> None:
    found, coco = detector_points("anatomical52"), detector_points("coco17")
    knee, lateral = found["LeftKnee"], found["LeftKneeLateral"]
    assert lateral.anchor == knee.anchor == "LeftLeg"
    assert lateral.independent == knee.independent == pytest.approx(1 / (1 + 2 * 0.42))
    assert knee.size == pytest.approx(np.hypot(coco["LeftKnee"].size, 0.02))
    assert found["C7"].independent == 1.0
    assert found["LeftAsis"].size < found["L2"].size
