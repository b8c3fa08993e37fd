"""3D points of another model: brought to the recording, better where they are right, no harm where they are not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.markers import MarkerSequence, write_trc
from rtof_kin.reconstruction.external_lift import LiftWith, read_points
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.vision.layouts import detector_table

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
TRUTH = planted.human(BODY, 120)
VIDEO = planted.keypoints(TRUTH.poses, sigma_px=2.0)
TABLE = detector_table()
LAYOUT = TABLE.layout("mediapipe33")
PLACES = {point.name: (BODY.names.index(point.joint), point.offset) for point in TABLE.points}


def points(truth: Motion = TRUTH, sigma: float = 0.0, unit: float = 1.0, late: float = 0.0) -> MarkerSequence:
    """Points about the hips on the camera's axes, as a model gives them."""
    segments, offsets = zip(*(PLACES[name] for name in LAYOUT.points), strict=True)
    poses = truth.poses
    R = poses.R_world_bone[:, list(segments)]
    p = poses.p_world_joint[:, list(segments)] + np.einsum("tkij,kj->tki", R, np.array(offsets))
    p = p - poses.p_world_joint[:, :1] + np.random.default_rng(0).normal(0, sigma or 1e-9, p.shape)
    return MarkerSequence(truth.times + late, LAYOUT.names, unit * p @ planted.camera().R_camera_world.T)


def error_mm(lifter: Any, keypoints: KeypointSequence = VIDEO) -> float:
    found = lifter.predict(keypoints, BODY.joint_offsets)
    return planted.root_relative_mm(found.p_world_joint, TRUTH.poses.p_world_joint)


BASE = planted.PlantedLifter(TRUTH)


def test_right_points_make_the_lift_better() -> None:
    alone = error_mm(BASE)
    assert error_mm(LiftWith(points(), "points.trc", BASE)) < 0.6 * alone
    assert error_mm(LiftWith(points(sigma=0.02), "points.trc", BASE)) < 0.8 * alone


@pytest.mark.parametrize(("unit", "late"), [(1000.0, 0.0), (0.9, 0.08)])
def test_axes_scale_and_clock_are_found(unit: float, late: float) -> None:
    lean = so3.exp(np.radians([20.0, 80.0, -120.0]))
    given = points(unit=unit, late=late)
    turned = MarkerSequence(given.times, given.names, given.p_world @ lean.T)
    lifter = LiftWith(turned, "points.trc", BASE)
    assert error_mm(lifter) < 0.7 * error_mm(BASE)
    found = lifter.agreement
    assert found is not None
    assert found.scale == pytest.approx(1 / unit, rel=0.03)
    assert found.delay == pytest.approx(late, abs=0.02)
    R = planted.camera().R_camera_world.T @ lean.T
    assert np.degrees(so3.angle_between(found.R_world_file, R)) < 3.0


def test_motion_of_somebody_else_is_named_and_left_out() -> None:
    other = LiftWith(points(planted.moving(BODY, 120, seed=9, radians=1.0)), "other.trc", BASE)
    assert error_mm(other) == pytest.approx(error_mm(BASE), abs=1e-6)
    assert other.warnings[0].startswith("other.trc is not used as a lift: its motion is not that in the video")
    result = reconstruct(planted.recording(TRUTH, sigma_px=2.0), mode="lift", lifter=other)
    assert other.warnings[0] in result.warnings
    late = LiftWith(points(late=100.0), "late.trc", BASE)
    assert error_mm(late) == pytest.approx(error_mm(BASE), abs=1e-6)
    assert late.warnings == ("late.trc is not used as a lift: it has no frame of this video",)


def test_gaps_are_filled_by_the_own_lift() -> None:
    given = points()
    p = np.array(given.p_world)
    p[40:80] = np.nan
    lifter = LiftWith(MarkerSequence(given.times, given.names, p), "points.trc", BASE)
    found = lifter.predict(VIDEO, BODY.joint_offsets).p_world_joint
    true, own = TRUTH.poses.p_world_joint, BASE.p
    np.testing.assert_allclose(found[50:70], own[50:70], atol=1e-6)
    assert planted.root_relative_mm(found[:30], true[:30]) < 0.7 * planted.root_relative_mm(own[:30], true[:30])


def test_files_of_every_kind_are_read(tmp_path: Path) -> None:
    given = points()
    p = np.array(given.p_world)
    p[3, 2] = np.nan
    given = MarkerSequence(given.times, given.names, p)
    plain = [[None if np.isnan(q).any() else q.tolist() for q in frame] for frame in p]
    (tmp_path / "a.json").write_text(
        json.dumps({"times": given.times.tolist(), "names": given.names, "points": plain}), encoding="utf-8"
    )
    np.savez(tmp_path / "a.npz", times=given.times, names=np.array(given.names), p_world=p)
    head = ",".join(["time", *(f"{name}_{axis}" for name in given.names for axis in "xyz")])
    rows = np.column_stack([given.times, p.reshape(len(p), -1)])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=head, comments="")
    write_trc(tmp_path / "a.trc", given)
    for suffix in ("json", "npz", "csv"):
        found = read_points(tmp_path / f"a.{suffix}")
        assert found.names == given.names
        np.testing.assert_allclose(found.p_world, p, atol=1e-9)
    assert read_points(tmp_path / "a.trc").names == given.names
    (tmp_path / "bad.json").write_text('{"times": [0], "names": ["a"]}', encoding="utf-8")
    with pytest.raises(FileFormatError, match=r"bad\.json.*needs times, names and points"):
        read_points(tmp_path / "bad.json")


def test_names_of_no_known_convention_are_refused() -> None:
    given = points()
    odd = MarkerSequence(given.times, tuple(f"p{k}" for k in range(len(given.names))), given.p_world)
    with pytest.raises(InvalidInputError, match="of no known marker set"):
        error_mm(LiftWith(odd, "odd.trc", BASE))
