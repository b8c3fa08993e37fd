"""Clinical angles: known postures, comparison with SciPy, mirror images, continuity, observability."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from clinical_support import ARM, LEG, limb, posture, turn, walk
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body.metrics import flexion
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical import decomposition as jcs
from rtof_kin.clinical.angle_table import angle_table, clinical_name
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles, opensim_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, ShapeError, UnknownNameError
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.opensim import OpenSimTable, read_opensim_table, write_mot, write_sto

Array = NDArray[np.float64]
BODY = SkeletonModel.default()


def degrees(poses: PoseSequence, skeleton: SkeletonModel = BODY) -> dict[str, float]:
    angles = clinical_angles(poses, skeleton)
    return dict(zip(angles.names, np.degrees(angles.values[0]).tolist(), strict=True))


def known_names(angles: ClinicalAngles) -> set[str]:
    """Angles with a value in every frame."""
    return {name for name, column in zip(angles.names, angles.known.T, strict=True) if column.all()}


def posed(q: Array) -> PoseSequence:
    """Observed poses of configurations."""
    p, R = BODY.forward_kinematics(q)
    return all_observed(PoseSequence(np.arange(len(q)) / 60, p, R, BODY.names))


def both(segments: tuple[str, ...], R_turn: Array) -> dict[str, Array]:
    return limb("right", segments, R_turn) | limb("left", segments, R_turn)


def either_side(right: Array, left: Array, *segments: str) -> dict[str, Array]:
    return limb("right", segments, right) | limb("left", segments, left)


THIGHS_FORWARD = both(("thigh",), turn(y=-90))
POSTURES = {
    "seated, shanks down, feet flat": (THIGHS_FORWARD, {"hip_flexion": 90, "knee_flexion": 90}),
    "lying thighs up, shanks level": (
        THIGHS_FORWARD | both(("shank", "foot"), turn(y=0)),
        {"hip_flexion": 90, "knee_flexion": 90},
    ),
    "leg swung forward, straight": (both(LEG, turn(y=-30)), {"hip_flexion": 30}),
    "leg swung back, straight": (both(LEG, turn(y=20)), {"hip_flexion": -20}),
    "heels at the buttocks": (both(("shank", "foot"), turn(y=120)), {"knee_flexion": 120}),
    "legs spread": (either_side(turn(x=-25), turn(x=25), *LEG), {"hip_adduction": -25}),
    "legs turned inwards": (either_side(turn(z=15), turn(z=-15), *LEG), {"hip_internal_rotation": 15}),
    "standing on the heels": (both(("foot",), turn(y=-20)), {"ankle_dorsiflexion": 20}),
    "standing on tiptoe": (both(("foot",), turn(y=40)), {"ankle_dorsiflexion": -40}),
    "soles facing each other": (either_side(turn(x=15), turn(x=-15), "foot"), {"ankle_inversion": 15}),
    "arms forward, palms up": (
        both(ARM, turn(y=-90)),
        {
            "shoulder_elevation": 90,
            "shoulder_plane_of_elevation": 90,
            "shoulder_axial_rotation": -90,
            "shoulder_xzy_flexion": 90,
        },
    ),
    "arms sideways, palms forward": (
        either_side(turn(x=-90), turn(x=90), *ARM),
        {"shoulder_elevation": 90, "shoulder_xzy_abduction": 90},
    ),
    "forearms forward, palms up": (both(("forearm", "hand"), turn(y=-90)), {"elbow_flexion": 90}),
    "thumbs forward": (either_side(turn(z=90), turn(z=-90), "forearm", "hand"), {"elbow_pronation": 90}),
    "palms back": (either_side(turn(z=170), turn(z=-170), "forearm", "hand"), {"elbow_pronation": 170}),
    "hands bent forward": (both(("hand",), turn(y=-60)), {"wrist_flexion": 60}),
    "hands bent to the thighs": (either_side(turn(x=20), turn(x=-20), "hand"), {"wrist_ulnar_deviation": 20}),
    "forearms spread": (either_side(turn(x=-10), turn(x=10), "forearm", "hand"), {"elbow_carrying_angle": 10}),
}


@pytest.mark.parametrize("name", POSTURES)
def test_known_postures_have_their_angles(name: str) -> None:
    turns, expected = POSTURES[name]
    found = degrees(posture(BODY, **turns))
    undefined = {"shoulder_plane_of_elevation", "shoulder_axial_rotation"}
    singular = {"shoulder_xzy_abduction", "shoulder_xzy_internal_rotation"}
    skipped = undefined | singular if "arms forward" in name else undefined
    for angle, value in found.items():
        side, _, short = angle.partition("_")
        short = short if side in ("right", "left") else angle
        if short in expected or short not in skipped:
            assert value == pytest.approx(expected.get(short, 0), abs=1e-9), angle


def test_all_angles_are_zero_in_the_anatomical_posture(any_skeleton: SkeletonModel) -> None:
    np.testing.assert_allclose(list(degrees(posture(any_skeleton), any_skeleton).values()), 0, atol=1e-9)


@pytest.mark.parametrize("heading", [0.0, 90.0, 180.0, -135.0])
def test_pelvis_tilt_and_list_do_not_depend_on_heading(heading: float) -> None:
    found = degrees(posture(BODY, body=turn(z=heading) @ turn(x=5, y=20)))
    assert found["pelvis_tilt"] == pytest.approx(20)
    assert found["pelvis_list"] == pytest.approx(5)
    assert np.cos(np.radians(found["pelvis_rotation"] - heading)) == pytest.approx(1)
    if heading == 90.0:
        assert abs(found["pelvis_opensim_tilt"]) < 6  # depends on heading in OpenSim's sequence


@pytest.mark.parametrize(
    ("axis", "name"), [("y", "spine_flexion"), ("x", "spine_lateral_bending"), ("z", "spine_axial_rotation")]
)
def test_signs_of_trunk_angles(axis: str, name: str) -> None:
    assert degrees(posture(BODY, thorax=turn(**{axis: 30})))[name] == pytest.approx(30)


def test_leg_angles_equal_the_urdf_angles_of_the_same_clinical_name() -> None:
    q = planted.moving(BODY, 40, radians=0.3).q
    angles = clinical_angles(posed(q), BODY)
    names = {dof.urdf: dof.clinical for joint in BODY.table.joints for dof in joint.dofs}
    legs = {k: v for k, v in names.items() if any(word in v for word in (" hip ", " knee ", " ankle "))}
    assert len(legs) == 18
    for urdf, clinical in legs.items():
        expected = (-1 if clinical[0] == "-" else 1) * q[:, 7 + BODY.dof_names.index(urdf)]
        name = clinical.lstrip("-").replace(" ", "_")
        np.testing.assert_allclose(angles[name], expected, atol=1e-9)


def test_opensim_names_agree_with_the_skeleton_table() -> None:
    own = {row.opensim.strip("-") for row in angle_table(BODY.table).rows} - {""}
    theirs = {dof.opensim.strip("-") for joint in BODY.table.joints for dof in joint.dofs} - {""}
    assert theirs <= own
    assert own - theirs == {"pelvis_tilt", "pelvis_list", "pelvis_rotation"}


def test_mirrored_poses_exchange_left_and_right_angles() -> None:
    poses = all_observed(planted.moving(BODY, 30, radians=0.2).poses)
    swap = {"Left": "Right", "Right": "Left"}
    other = [next((swap[s] + n[len(s) :] for s in swap if n.startswith(s)), n) for n in poses.names]
    index, M = [poses.names.index(n) for n in other], np.diag([1.0, -1.0, 1.0])
    p, R = poses.p_world_joint[:, index] @ M, M @ poses.R_world_bone[:, index] @ M
    mirrored = clinical_angles(replace(poses, p_world_joint=p, R_world_bone=R), BODY)
    angles = clinical_angles(poses, BODY)
    for name in angles.names:
        side, _, short = name.partition("_")
        same = side in ("right", "left") or name.endswith(("tilt", "spine_flexion"))
        image = f"{swap[side.title()].lower()}_{short}" if side in ("right", "left") else name
        np.testing.assert_allclose(mirrored[image], angles[name] * (1 if same else -1), atol=1e-9)


@pytest.mark.parametrize("sequence", ["zxy", "yxz", "xzy", "yxy"])
def test_decompose_agrees_with_scipy_and_is_inverted_by_composition(sequence: str) -> None:
    rotations = Rotation.random(200, rng=3)
    R = rotations.as_matrix()
    found = jcs.decompose(sequence, R)
    np.testing.assert_allclose(so3.euler_to_matrix(sequence, found), R, atol=1e-9)
    a, b, c = rotations.as_euler(sequence.upper()).T
    if sequence == "yxy":  # SciPy's elevation is positive, ISB's negative
        a, b, c = a + np.pi, -b, c + np.pi
    error = found - np.stack([a, b, c], axis=-1)
    np.testing.assert_allclose(np.angle(np.exp(1j * error)), 0, atol=1e-9)


@pytest.mark.parametrize("elevation", [0.0, -np.pi])
def test_decompose_is_exact_at_singular_postures(elevation: float) -> None:
    R = so3.euler_to_matrix("yxy", np.array([0.4, elevation, 0.3]))
    angles = jcs.decompose("yxy", R)
    np.testing.assert_allclose(so3.euler_to_matrix("yxy", angles), R, atol=1e-12)
    assert jcs.near_singular("yxy", angles)


def test_heading_is_continuous_over_whole_turns_and_in_its_range_after_a_gap() -> None:
    poses = posture(BODY, 300, body=so3.about_axis("z", np.linspace(0, 5 * np.pi, 300)))
    rotation = clinical_angles(poses, BODY)["pelvis_rotation"]
    assert rotation[-1] - rotation[0] == pytest.approx(5 * np.pi)
    assert np.abs(np.diff(rotation)).max() < 0.06
    assert np.abs(np.median(rotation)) <= np.pi
    R = np.array(poses.R_world_bone)
    R[100:200] = np.nan
    angles = clinical_angles(replace(poses, R_world_bone=R), BODY)
    assert np.isnan(angles["pelvis_rotation"][100:200]).all()
    assert angles.provenance[150, 0] == Provenance.NOBODY
    assert abs(np.median(angles["pelvis_rotation"][200:])) <= np.pi
    assert "have gaps" in angles.notes[0]
    assert "33 %" in angles.notes[0]


def test_angles_of_walking_have_no_jumps() -> None:
    angles = clinical_angles(walk())
    steps = np.abs(np.diff(angles.values, axis=0))
    defined = ~(angles.singular[1:] | angles.singular[:-1])
    glitch = np.array(["left_wrist" in name for name in angles.names])  # in the first frames of the file
    assert np.degrees(np.nanmax(steps[defined & ~glitch])) < 15
    assert defined[:, ~glitch].mean() > 0.9


def test_plane_of_elevation_of_a_circling_arm_stays_in_its_range() -> None:
    T = 360
    plane = np.linspace(0, 6 * np.pi, T)
    elevation = np.where(np.sin(plane / 2) ** 2 > 0.3, np.radians(-30), np.radians(-1))
    R_isb = so3.euler_to_matrix("yxy", np.stack([plane, elevation, -plane], axis=-1))
    poses = posture(BODY, T, **limb("right", ARM, jcs.R_ROS_ISB @ R_isb @ jcs.R_ROS_ISB.T))
    angles = clinical_angles(poses, BODY)
    name = "right_shoulder_plane_of_elevation"
    singular = angles.singular[:, angles.names.index(name)]
    assert 0.2 < singular.mean() < 0.6
    assert np.degrees(np.abs(angles[name][~singular]).max()) < 180 + 250 / 2  # a cone spans 250
    np.testing.assert_allclose(np.degrees(angles["right_shoulder_elevation"][~singular]), 30)
    assert not angles.singular[:, angles.names.index("right_shoulder_elevation")].any()


def test_a_glitch_of_one_frame_does_not_change_other_frames() -> None:
    bent = so3.about_axis("y", np.radians(np.linspace(10, 60, 90)))
    smooth = posture(BODY, 90, **limb("right", ("shank", "foot"), bent))
    R = np.array(smooth.R_world_bone)
    R[40, BODY.index("RightLeg")[0]] = so3.exp(np.array([2.0, -1.5, 1.0]))
    angles = clinical_angles(replace(smooth, R_world_bone=R), BODY)
    expected = clinical_angles(smooth, BODY)
    known = expected.known & (np.arange(90) != 40)[:, None]
    np.testing.assert_allclose(angles.values[known], expected.values[known], atol=1e-9)
    assert known[:, expected.names.index("right_knee_flexion")].sum() == 89


@pytest.mark.parametrize(("axis", "name"), [("y", "flexion"), ("x", "abduction")])
def test_arm_elevation_is_continuous_up_to_overhead(axis: str, name: str) -> None:
    raised = np.linspace(5, 175, 120)
    turns = limb("right", ARM, so3.about_axis(axis, -np.radians(raised)))
    angles = clinical_angles(posture(BODY, 120, **turns), BODY)
    regular = ~angles.singular[:, angles.names.index("right_shoulder_xzy_abduction")]
    found = np.degrees(angles[f"right_shoulder_xzy_{name}"])
    np.testing.assert_allclose(found[regular], raised[regular], atol=1e-6)
    np.testing.assert_allclose(np.degrees(angles["right_shoulder_elevation"]), raised, atol=1e-6)


def seen_by(poses: PoseSequence, sensors: tuple[str, ...], who: Provenance, alone: bool = False) -> PoseSequence:
    """Poses with one provenance, and segments with sensors; `alone` without landmarks."""
    observed = np.isin(BODY.names, sensors) if alone else BODY.orientation_observed(sensors)
    provenance = np.full(poses.valid.shape, who, dtype=np.uint8)
    return replace(poses, provenance=provenance, orientation_observed=observed)


@pytest.fixture(scope="module")
def moving() -> PoseSequence:
    return planted.human(BODY, 40).poses


def test_angles_that_a_camera_cannot_observe_are_nan(moving: PoseSequence) -> None:
    angles = clinical_angles(seen_by(moving, (), Provenance.CAMERA), BODY)
    known = known_names(angles)
    assert not any("_ankle_" in name or "_wrist_" in name for name in known)
    assert {"right_hip_flexion", "right_hip_adduction", "left_knee_flexion"} <= known
    assert {"left_shoulder_elevation", "right_elbow_flexion", "pelvis_tilt", "spine_flexion"} <= known
    assert not known & {
        "right_hip_internal_rotation",
        "left_knee_adduction",
        "left_shoulder_axial_rotation",
        "right_elbow_pronation",
    }
    sources = dict(zip(angles.names, angles.provenance.T, strict=True))
    assert np.all(sources["right_ankle_dorsiflexion"] == Provenance.PRIOR)
    assert np.all(sources["right_hip_flexion"] == Provenance.CAMERA)
    assert "right_ankle_dorsiflexion" in angles.notes[0]


def test_knee_flexion_without_axial_rotation_of_the_thigh_is_between_the_bones(moving: PoseSequence) -> None:
    poses = seen_by(moving, (), Provenance.CAMERA)
    R = np.array(poses.R_world_bone)
    thigh, knee = BODY.index("RightUpLeg", "RightLeg")
    bone = so3.unit(poses.p_world_joint[:, knee] - poses.p_world_joint[:, thigh])
    R[:, thigh] = so3.exp(np.radians(50) * bone) @ R[:, thigh]
    angles = clinical_angles(replace(poses, R_world_bone=R), BODY)
    expected = flexion(poses.p_world_joint, BODY)[:, knee]
    np.testing.assert_allclose(np.abs(angles["right_knee_flexion"]), expected, atol=1e-6)


def test_a_knee_that_glitched_through_a_whole_turn_keeps_its_sign_afterwards() -> None:
    angle = np.radians([*np.full(100, 30), *np.linspace(30, -330, 20), *np.full(40, -330)])
    leg = limb("right", ("shank", "foot"), so3.about_axis("y", angle))
    angles = clinical_angles(seen_by(posture(BODY, 160, **leg), (), Provenance.CAMERA), BODY)
    np.testing.assert_allclose(np.degrees(angles["right_knee_flexion"][120:]), 30, atol=1e-6)


def test_sensors_make_axial_rotations_observable() -> None:
    sensors = ("RightUpLeg", "RightLeg", "RightFoot")
    poses = seen_by(planted.moving(BODY, 40).poses, sensors, Provenance.CAMERA_AND_IMU)
    angles = clinical_angles(poses, BODY)
    for name in ("hip_internal_rotation", "knee_adduction", "ankle_inversion"):
        assert np.isfinite(angles[f"right_{name}"]).all()
        assert np.isnan(angles[f"left_{name}"]).all()


def test_angles_fixed_by_a_hinge_model_are_unobserved(moving: PoseSequence) -> None:
    angles = clinical_angles(seen_by(moving, BODY.names, Provenance.CAMERA_AND_IMU), BODY)
    hinged = ("knee_adduction", "knee_internal_rotation", "elbow_carrying_angle", "elbow_pronation")
    fixed = {f"{side}_{name}" for side in ("right", "left") for name in hinged}
    assert known_names(angles) == set(angles.names) - fixed
    for name, who in zip(angles.names, angles.provenance.T, strict=True):
        assert np.all(who == (Provenance.PRIOR if name in fixed else Provenance.CAMERA_AND_IMU))
    assert "fixed by the model" in angles.notes[0]


def test_interpolated_joints_have_no_angles(moving: PoseSequence) -> None:
    poses = seen_by(moving, (), Provenance.CAMERA)
    provenance, valid = np.array(poses.provenance), np.array(poses.valid)
    observed = np.array(poses.orientation_observed)
    provenance[10:20], valid[10:20], observed[10:20] = Provenance.BRIDGED, False, False
    poses = replace(poses, provenance=provenance, valid=valid, orientation_observed=observed)
    angles = clinical_angles(poses, BODY)
    assert np.isnan(angles.values[10:20]).all()
    assert np.all(angles.provenance[10:20] == Provenance.BRIDGED)
    assert np.isfinite(angles["right_knee_flexion"][[9, 20]]).all()


def test_sensors_observe_angles_out_of_the_image(moving: PoseSequence) -> None:
    poses = seen_by(moving, ("Hips", "RightUpLeg", "RightLeg"), Provenance.IMU)
    angles = clinical_angles(replace(poses, valid=np.zeros_like(poses.valid)), BODY)
    assert np.isfinite(angles["right_hip_flexion"]).all()
    assert np.isnan(angles["left_hip_flexion"]).all()


def test_sensors_alone_observe_only_the_angles_between_them() -> None:
    moving = planted.moving(BODY, 40).poses
    poses = seen_by(moving, planted.LIMBS, Provenance.PRIOR, alone=True)
    angles = clinical_angles(poses, BODY)
    names = (
        "knee_flexion",
        "knee_adduction",
        "knee_internal_rotation",
        "elbow_flexion",
        "elbow_carrying_angle",
        "elbow_pronation",
    )
    assert known_names(angles) == {f"{side}_{name}" for side in ("right", "left") for name in names}
    expected = clinical_angles(all_observed(poses), BODY)
    np.testing.assert_array_equal(angles.values[angles.known], expected.values[angles.known])
    assert np.all(angles.provenance[angles.known] == Provenance.IMU)
    trunk = clinical_angles(seen_by(moving, ("Hips", "Spine3"), Provenance.PRIOR, alone=True), BODY)
    known = known_names(trunk)
    assert known >= {"pelvis_tilt", "spine_flexion", "spine_lateral_bending", "spine_axial_rotation"}
    assert not any("hip_" in name for name in known)


def test_provenance_of_the_pelvis_is_that_of_its_children() -> None:
    poses = seen_by(planted.moving(BODY, 40).poses, (), Provenance.CAMERA)
    provenance = np.array(poses.provenance)
    provenance[:, 0] = Provenance.PRIOR
    angles = clinical_angles(replace(poses, provenance=provenance), BODY)
    assert np.all(angles.provenance[:, angles.names.index("pelvis_tilt")] == Provenance.CAMERA)


def test_angles_are_selected_by_name() -> None:
    angles = clinical_angles(walk())
    angles = replace(angles, sigma=np.abs(angles.values))
    some = angles.select(["left_hip_flexion", "pelvis_tilt"])
    assert some.names == ("left_hip_flexion", "pelvis_tilt")
    np.testing.assert_array_equal(some.values[:, 0], angles["left_hip_flexion"])
    np.testing.assert_allclose(some.sigma, np.abs(some.values), rtol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        some.values[0] = 0
    with pytest.raises(UnknownNameError, match="Did you mean 'right_knee_flexion'"):
        angles["right_knee_flexions"]


def test_wrong_input_is_rejected() -> None:
    with pytest.raises(InvalidInputError, match="skeleton"):
        clinical_angles(posture(BODY))
    with pytest.raises(UnknownNameError):
        clinical_angles(posture(BODY), SkeletonModel.human36m())
    with pytest.raises(ShapeError, match="angle values: expected shape"):
        ClinicalAngles(np.zeros(1), np.zeros((2, 0)), np.zeros((1, 0)), np.zeros((1, 0)), ())
    with pytest.raises(UnknownNameError, match="'robot'"):
        angle_table(replace(BODY.table, name="robot"))


@pytest.mark.parametrize(
    ("dof", "name"),
    [
        ("LeftUpLeg_z", "left hip internal/external rotation (LeftUpLeg_z)"),
        ("RightFoot_y", "right ankle dorsiflexion/plantarflexion (RightFoot_y)"),
        ("Spine1_x", "Spine1 left/right bending (Spine1_x)"),
        ("base_q", "pelvis orientation (base_q)"),
        ("other", "other"),
    ],
)
def test_degrees_of_freedom_have_clinical_names(dof: str, name: str) -> None:
    assert clinical_name(BODY.table, dof) == name


def test_the_table_describes_each_angle(any_skeleton: SkeletonModel) -> None:
    table = angle_table(any_skeleton.table)
    entries = table.sidecar()
    assert len({entry["name"] for entry in entries}) == len(entries) == 9 + 2 * 21
    for entry, row in zip(entries, table.rows, strict=True):
        assert entry["sign"] in (-1, 1)
        low, high = entry["range_deg"]
        assert high - low in (180, 360)
        assert low <= 0 <= high
        assert all(entry[key] for key in ("positive", "zero", "parent", "child", "sequence", "singular"))
        assert entry["clinical"] == row.label
        assert (entry["parent"] == "world") == (not entry["urdf"])
        assert set(entry["urdf"]) <= set(any_skeleton.dof_names)


def table(in_degrees: bool = True, **columns: float) -> OpenSimTable:
    values = np.tile(list(columns.values()), (3, 1))
    return OpenSimTable(np.arange(3.0), tuple(columns), values, in_degrees)


@pytest.mark.parametrize("write, name", [(write_mot, "walk.mot"), (write_sto, "walk.sto")])
def test_exported_motion_has_the_angles_of_the_motion(write: object, name: str, tmp_path: Path) -> None:
    write(tmp_path / name, walk())  # type: ignore[operator]
    angles, others = opensim_angles(read_opensim_table(tmp_path / name))
    own = clinical_angles(walk())
    assert others == ()
    both = own.known & angles.known
    assert both[:, own.names.index("spine_flexion")].all()
    assert both.any(axis=0).sum() > 30
    difference = np.degrees(angles.values - own.values)[both]
    assert np.abs((difference + 180) % 360 - 180).max() < 1e-6


def test_signs_are_those_of_the_table() -> None:
    angles, others = opensim_angles(
        table(hip_flexion_r=30.0, lumbar_extension=-12.0, knee_angle_l=50.0, ankle_angle_r=-8.0, mtp_angle_r=3.0)
    )
    expected = {
        "right_hip_flexion": 30.0,
        "spine_flexion": 12.0,
        "left_knee_flexion": 50.0,
        "right_ankle_dorsiflexion": -8.0,
    }
    known = [name for name in angles.names if np.isfinite(angles[name]).all()]
    assert {name: float(np.degrees(angles[name][0])) for name in known} == pytest.approx(expected)
    assert others == ("mtp_angle_r",)
    assert angles.sigma is None


def test_turns_are_continuous_and_within_the_range_of_the_angle() -> None:
    values = np.array([[350.0], [355.0], [2.0]])
    angles, _ = opensim_angles(OpenSimTable(np.arange(3.0), ("hip_flexion_r",), values, True))
    assert np.degrees(angles["right_hip_flexion"]) == pytest.approx([-10, -5, 2])


def test_a_model_without_a_known_coordinate_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="hip_flexion_r"):
        opensim_angles(table(KneeFlexion=3.0))
