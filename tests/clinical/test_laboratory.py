"""The C3D file of a walk as laboratories know it, read by ezc3d; Plug-in Gait's angles against planted postures."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pytest
from clinical_support import limb, posture, turn, walking
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.laboratory import plug_in_gait_angles, trial_results
from rtof_kin.formats.markers import read_c3d
from rtof_kin.formats.motion_files import write_motion_files
from rtof_kin.formats.trial_results import MOST_EVENTS, Beside, TrialResults

Array = NDArray[np.float64]
MASS = 70.0
ARM = ("upper_arm", "forearm", "hand")


@pytest.fixture(scope="module")
def walk() -> Motion:
    return walking(5.0)


@pytest.fixture(scope="module")
def folder(walk: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    results = partial(trial_results, subject="P07", mass_kg=MASS)
    return write_motion_files(tmp_path_factory.mktemp("c3d"), walk, ("c3d",), Beside(results))


@pytest.fixture(scope="module")
def file(folder: Path) -> Any:
    return ezc3d.c3d(str(folder / "motion.c3d"))


def parameters(file: Any, group: str) -> dict[str, Any]:
    return {name: one["value"] for name, one in file["parameters"][group].items() if name != "__METADATA__"}


def points(file: Any, name: str) -> Array:
    """(T, 3), NaN where the residual is negative."""
    at = file["parameters"]["POINT"]["LABELS"]["value"].index(name)
    seen = file["data"]["meta_points"]["residuals"][0, at] >= 0
    return np.where(seen[:, None], file["data"]["points"][:3, at].T, np.nan)


def test_ezc3d_reads_gait_events_in_minutes_and_seconds(walk: Motion, file: Any) -> None:
    event = parameters(file, "EVENT")
    feet = analyse(walk).gait.events.feet
    expected = sorted(
        (time, context, label)
        for side, context in (("right", "Right"), ("left", "Left"))
        for times, label in ((feet[side].strikes, "Foot Strike"), (feet[side].offs, "Foot Off"))
        for time in times
    )
    assert len(expected) == event["USED"][0] > 8
    assert np.allclose(60 * event["TIMES"][0] + event["TIMES"][1], [time for time, _, _ in expected], atol=1e-5)
    assert [*zip(event["CONTEXTS"], event["LABELS"], strict=True)] == [(c, label) for _, c, label in expected]
    assert [*event["ICON_IDS"]] == [{"Foot Strike": 1, "Foot Off": 2}[label] for _, _, label in expected]
    assert {*event["SUBJECTS"]} == {"P07"}
    assert parameters(file, "EVENT_CONTEXT")["LABELS"] == ["General", "Left", "Right"]


def test_ezc3d_reads_angles_forces_and_moments_with_units(walk: Motion, file: Any) -> None:
    point, found = parameters(file, "POINT"), analyse(walk, weight_kg=MASS)
    units = {name: point[name] for name in ("UNITS", "ANGLE_UNITS", "FORCE_UNITS", "MOMENT_UNITS")}
    assert units == {"UNITS": ["mm"], "ANGLE_UNITS": ["deg"], "FORCE_UNITS": ["N"], "MOMENT_UNITS": ["Nmm"]}
    assert {"LHipAngles", "RAnkleAngles", "LPelvisAngles"} < {*point["ANGLES"]}
    np.testing.assert_allclose(
        points(file, "LKneeAngles")[:, 0], np.degrees(found.angles["left_knee_flexion"]), atol=1e-4
    )
    whole, left, right = (points(file, f"{side}GroundReactionForce") for side in ("", "L", "R"))
    assert np.nanmean(whole[:, 2]) == pytest.approx(MASS * 9.81, rel=0.1)
    alone = np.isfinite(left[:, 0])
    assert 0.3 < alone.mean() < 0.9
    np.testing.assert_allclose((left + right)[alone], whole[alone], atol=1e-3)
    assert found.torques is not None
    own = found.torques.torques[:, found.torques.dof_names.index("RightFoot_y")]
    np.testing.assert_allclose(points(file, "RAnkleMomentISB")[:, 0], -1000 * own, atol=0.1)  # dorsiflexion: -y


def test_ezc3d_reads_parameters_of_gait_by_side_and_the_subject(file: Any, walk: Motion) -> None:
    found = parameters(file, "ANALYSIS")
    values = dict(zip(zip(found["NAMES"], found["CONTEXTS"], strict=True), found["VALUES"], strict=True))
    for side in ("Left", "Right"):
        assert values["Cadence", side] == pytest.approx(100, abs=1)
        assert values["Walking Speed", side] == pytest.approx(1.1, abs=0.03)
        assert values["Stride Time", side] == pytest.approx(1.2, abs=0.01)
        assert values["Step Length", side] == pytest.approx(0.66, abs=0.05)
    assert dict(zip(found["NAMES"], found["UNITS"], strict=True))["Cadence"] == "steps/min"
    assert parameters(file, "SUBJECTS")["NAMES"] == ["P07"]
    body = parameters(file, "PROCESSING")
    assert (body["Bodymass"][0], body["Height"][0]) == pytest.approx((MASS, 1000 * walk.skeleton.height))


def test_landmarks_are_read_back_without_the_results(folder: Path, walk: Motion) -> None:
    markers = read_c3d(folder / "motion.c3d")
    assert markers.names == tuple(walk.skeleton.landmarks)
    own = walk.skeleton.landmark_positions(walk.poses.p_world_joint, walk.poses.R_world_bone)
    np.testing.assert_allclose(markers.p_world, own, atol=1e-6)


def test_a_recording_without_labels_names_nobody(tmp_path: Path) -> None:
    write_motion_files(tmp_path, walking(2.0), ("c3d",), Beside(trial_results))
    file = ezc3d.c3d(str(tmp_path / "motion.c3d"))
    assert parameters(file, "SUBJECTS")["NAMES"] == ["Subject"]
    assert "FORCES" not in parameters(file, "POINT")
    assert "Bodymass" not in parameters(file, "PROCESSING")


def test_events_beyond_one_parameter_continue_and_the_rest_is_counted(tmp_path: Path) -> None:
    events = tuple((0.5 * n, "left", "foot_off") for n in range(MOST_EVENTS + 3))
    write_motion_files(tmp_path, walking(0.5), ("c3d",), Beside(lambda _: TrialResults(events, subject="x" * 40)))
    event = parameters(ezc3d.c3d(str(tmp_path / "motion.c3d")), "EVENT")
    assert [event["USED"][0], len(event["LABELS"]), len(event["LABELS8"])] == [MOST_EVENTS, 255, 255]
    assert event["TIMES2"][:, 0].tolist() == [2, 7.5]
    assert json.loads((tmp_path / "files.json").read_text())["files"]["motion.c3d"]["events_left_out"] == 3


A, B, C = 20.0, 8.0, 12.0


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("name", "segments", "order"),
    [("Hip", "thigh shank foot", "yxz"), ("Knee", "shank foot", "yxz"), ("Ankle", "foot", "yzx")],
)
def test_angles_of_the_leg_are_those_of_the_table_of_plug_in_gait(
    side: str, name: str, segments: str, order: str
) -> None:
    """Axes forward, left, up; flexion is clockwise about y but at the knee, the others anticlockwise on the right."""
    own = 1.0 if side == "right" else -1.0
    about = {"y": A if name == "Knee" else -A, "x": own * B, "z": own * C}
    turns = limb(side, tuple(segments.split()), turn(**{axis: about[axis] for axis in order}))
    found = angles(**turns)[f"{side[0].upper()}{name}Angles"]
    np.testing.assert_allclose(found[0], [A, B, C], atol=1e-6)


def test_angles_of_pelvis_spine_and_arm_are_those_of_the_table_of_plug_in_gait() -> None:
    """The person faces world y, the axis from which the pelvis counts; the pelvis tilts forward, its left side is up
    and its right side forward. The left arm is flexed, then abducted."""
    whole = turn(z=90) @ turn(y=A, x=B, z=C)
    found = angles(body=whole, **limb("left", ARM, turn(y=-A, x=B)))
    np.testing.assert_allclose(found["LPelvisAngles"][0], [A, B, -C], atol=1e-6)
    np.testing.assert_allclose(found["RPelvisAngles"][0], [A, -B, C], atol=1e-6)
    np.testing.assert_allclose(found["LShoulderAngles"][0], [A, B, 0], atol=1e-6)
    bent = angles(thorax=turn(y=A, x=-B, z=C))
    np.testing.assert_allclose(bent["LSpineAngles"][0], [A, B, C], atol=1e-6)
    np.testing.assert_allclose(bent["RSpineAngles"][0], [A, -B, -C], atol=1e-6)
    elbow = angles(**limb("right", ("forearm", "hand"), turn(y=-A)))["RElbowAngles"][0]
    assert elbow[0] == pytest.approx(A)
    assert np.isnan(elbow[1:]).all()


def angles(**turns: Array) -> dict[str, Array]:
    skeleton = SkeletonModel.default()
    return plug_in_gait_angles(analyse(skeleton.motion(posture(skeleton, 30, **turns))))
