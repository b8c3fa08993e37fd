"""Small data sets in the layouts of the public ones, made from seconds of the demo, whose motion is known."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.pose_calibration import pose_rotations
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
SECONDS = (4.0, 7.0)
"""Of the demo that a take is made of."""
COORDINATES = {
    "hip_flexion_r": "right_hip_flexion",
    "hip_flexion_l": "left_hip_flexion",
    "knee_angle_r": "right_knee_flexion",
    "knee_angle_l": "left_knee_flexion",
    "ankle_angle_r": "right_ankle_dorsiflexion",
    "elbow_flex_r": "right_elbow_flexion",
    "elbow_flex_l": "left_elbow_flexion",
}
"""Columns of a .mot of another system -> clinical angle, all of one sign."""


@dataclass(frozen=True)
class Known:
    """What the sets are made from; times begin at 0."""

    recording: Recording
    video: KeypointSequence
    imus: ImuSequence
    poses: PoseSequence
    """At the times of the video."""
    angles: ClinicalAngles


@cache
def known() -> Known:
    """Seconds of the demo."""
    demo = Recording.load(model_path("demo"))
    start, stop = SECONDS
    part = demo.between(start, stop)
    assert part.imus is not None
    assert demo.truth is not None
    own = (demo.truth.times >= start - 1e-9) & (demo.truth.times <= stop + 1e-9)
    truth = demo.truth
    poses = PoseSequence(truth.times[own] - start, truth.p_world_joint[own], truth.R_world_bone[own], truth.names)
    video = part.video
    video = KeypointSequence(video.camera, video.times - start, video.uv_px, video.confidence, video.names)
    imus = ImuSequence(part.imus.times - start, part.imus.R_inertial_sensor, part.imus.f_sensor, part.imus.names)
    return Known(demo, video, imus, poses, clinical_angles(all_observed(poses), demo.skeleton))


def true_motion() -> Motion:
    """The known motion as it is reconstructed without any error."""
    found = known()
    return found.recording.skeleton.motion(all_observed(found.poses))


def write_detections(path: Path, scale: float = 1.0, shift: float = 0.0) -> Path:
    """The known video's points as a detector's file, in a smaller image and later by `shift`, s."""
    path.parent.mkdir(parents=True, exist_ok=True)
    video = known().video
    np.savez(path, uv_px=scale * video.uv_px, confidence=video.confidence, times=video.times + shift)
    return path


def write_mot(path: Path, columns: dict[str, Array], times: Array, degrees: str = "yes", header: bool = True) -> Path:
    """A table as OpenSim's inverse kinematics writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["Coordinates", "version=1", f"nRows={len(times)}", f"nColumns={len(columns) + 1}"]
    lines += [f"inDegrees={degrees}"] if degrees else []
    lines += ["", "endheader"] if header else []
    lines.append("\t".join(["time", *columns]))
    table = np.column_stack([times, *columns.values()])
    lines += ["\t".join(f"{value:.8f}" for value in row) for row in table]
    path.write_text("\n".join(lines) + "\n")
    return path


def true_columns(offset: float = 0.0) -> dict[str, Array]:
    """Columns of the known angles, degrees, plus an offset."""
    return {name: np.degrees(known().angles[angle]) + offset for name, angle in COORDINATES.items()}


def write_opencap(root: Path, offset: float = 0.0, shift: float = 0.0, trial: str = "walking1") -> str:
    """One trial of OpenCap's validation, the reference late by `shift`, s; returns the name of its take."""
    subject = root / "subject2"
    folder = subject / "VideoData" / "Session1" / "Cam1"
    (folder / trial).mkdir(parents=True)
    height = known().recording.skeleton.height
    (subject / "sessionMetadata.yaml").write_text(f"height_m: {height:.3f}\nmass_kg: 70.0\n")
    camera = known().video.camera
    saved = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_matrix": camera.K.tolist(),
        "distortion_coefficients": camera.distortion.tolist(),
        "R": camera.R_camera_world.tolist(),
        "T": camera.t_camera_world.tolist(),
    }
    (folder / "cameraIntrinsicsExtrinsics.json").write_text(json.dumps(saved))
    path = subject / "OpenSimData" / "Mocap" / "IK" / f"{trial}.mot"
    write_mot(path, true_columns(offset), known().poses.times + shift)
    return f"subject2_Session1_Cam1_{trial}"


def write_vidimu(root: Path, activity: str = "A01") -> str:
    """One trial of VIDIMU; returns the name of its take."""
    key = f"S40_{activity}_T01"
    folder = root / "dataset" / "videoandimus" / "S40"
    folder.mkdir(parents=True, exist_ok=True)
    joints = {"qsHIPS": "Hips", "qsRUL": "RightUpLeg", "qsRLL": "RightLeg", "qsLUL": "LeftUpLeg", "qsLLL": "LeftLeg"}
    poses = known().poses
    lines = ["QUAT,w,x,y,z,timestamp"]
    quats = {name: so3.to_quat_wxyz(poses.R_world_bone[:, poses.names.index(joint)]) for name, joint in joints.items()}
    lines += [f"{name},{','.join(map(repr, quat[0].tolist()))},0.0" for name, quat in quats.items()]
    for t, time in enumerate(poses.times):
        lines += [
            f"{name},{','.join(map(repr, quat[t].tolist()))},{1660000000 + time:.3f}" for name, quat in quats.items()
        ]
    (folder / f"{key}.raw").write_text("\r\n".join(lines) + "\r\n")
    fixed = {"arm_flex_r": np.zeros(len(poses.times)), "mtp_angle_r": np.zeros(len(poses.times))}
    write_mot(folder / f"ik_{key}.mot", true_columns() | fixed, poses.times)
    return key


MOVI_SCALE = 0.4
"""Of the known image, so that it fits into that of MoVi."""
MOVI_JOINTS = {
    "left_hip": "LeftUpLeg",
    "left_knee": "LeftLeg",
    "left_ankle": "LeftFoot",
    "right_hip": "RightUpLeg",
    "right_knee": "RightLeg",
    "right_ankle": "RightFoot",
    "left_shoulder": "LeftArm",
    "left_elbow": "LeftForeArm",
    "left_wrist": "LeftHand",
    "right_shoulder": "RightArm",
    "right_elbow": "RightForeArm",
    "right_wrist": "RightHand",
}


def write_movi(root: Path, order: tuple[str, ...], **changed: object) -> str:
    """A person of MoVi with two motions, the second one known; returns the name of its take in PG1."""
    poses, camera = known().poses, known().video.camera
    times = np.arange(0, poses.times[-1], 1 / 120)
    p = np.stack([np.interp(times, poses.times, c) for c in poses.p_world_joint.reshape(len(poses.times), -1).T], 1)
    p = 1000 * p.reshape(len(times), -1, 3)
    points = np.zeros((120 + len(times), len(order), 3))
    for column, name in enumerate(order):
        if name in MOVI_JOINTS:
            points[120:, column] = p[:, poses.names.index(MOVI_JOINTS[name])]
    count30 = len(times) // 4
    move = {
        "motions_list": np.array([["kicking"], ["walking"]], dtype=object),
        "flags120": np.array([[1, 120], [121, 120 + len(times)]]),
        "flags30": np.array([[1, 30], [31, 30 + count30]]),
        "virtualMarkerLocation": points,
    } | changed
    cell = np.empty((1, 1), dtype=object)
    cell[0, 0] = {name: value for name, value in move.items() if value is not None}
    root.mkdir(parents=True, exist_ok=True)
    savemat(root / "F_v3d_Subject_1.mat", {"Subject_1_F": {"move": cell}})
    K = camera.K.copy()
    K[:2] *= MOVI_SCALE
    K[:2, 2] += 1.0
    np.savez(root / "cameraParams_PG1.npz", IntrinsicMatrix=K.T, RadialDistortion=camera.distortion[:2])
    np.savez(
        root / "Extrinsics_PG1.npz",
        rotationMatrix=camera.R_camera_world.T,
        translationVector=camera.t_camera_world * 1000,
    )
    return "Subject_1_02_walking_PG1"


GAITEX_BODIES = {
    "pelvis": ("Hips", "XSens_Pelvis"),
    "torso": ("Spine3", "XSens_Sternum"),
    "femur_r": ("RightUpLeg", "XSens_UpperLeg_Right"),
    "femur_l": ("LeftUpLeg", "XSens_UpperLeg_Left"),
    "tibia_r": ("RightLeg", "XSens_LowerLeg_Right"),
    "tibia_l": ("LeftLeg", "XSens_LowerLeg_Left"),
    "calcn_r": ("RightFoot", "XSens_Foot_Right"),
    "calcn_l": ("LeftFoot", "XSens_Foot_Left"),
    "toes_r": ("RightFoot", "XSens_Hand_Right"),
}


def write_gaitex(root: Path, start: float = 0.4) -> str:
    """A trial of GAITEX: a T-pose, then the known motion, with markers; returns the name of its take."""
    times, R, p, names = posed_motion()
    folder = root / "austra" / "ng"
    folder.mkdir(parents=True, exist_ok=True)
    bodies = {body: {"imu_name": imu, "marker_names": []} for body, (_, imu) in GAITEX_BODIES.items()}
    metadata = {"start_ts": start, "scaling": {}, "inverse_kinematics": bodies}
    (folder / "metadata_austra_ng.json").write_text(json.dumps(metadata))
    columns: dict[str, Array] = {"time [s]": times}
    for joint, imu in GAITEX_BODIES.values():
        quats = so3.to_quat_wxyz(R[:, names.index(joint)])
        columns |= {f"{imu}_Q{c}": q for c, q in zip("WXYZ", quats.T, strict=True)}
    _csv(folder / "xsens_imu_data_austra_ng.csv", columns)
    columns = {"time_[s]": times}
    for marker, point in gaitex_markers(R, p, names).items():
        columns |= {f"{marker}_{axis}_[mm]": 1000 * point[:, i] for i, axis in enumerate("XYZ")}
    _csv(folder / "qualisys_marker_data_austra_ng.csv", columns)
    return "austra_ng"


@cache
def posed_motion() -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Times, orientations, positions and joints: a T-pose, a second between, and the known motion."""
    found = known()
    skeleton, own = found.recording.skeleton, found.poses.R_world_bone
    R_T = pose_rotations("T", skeleton)
    ramp = np.linspace(0, 1, 60)[:, None, None]
    between = R_T @ so3.exp(ramp * so3.log(np.swapaxes(R_T, -1, -2) @ own[0]))
    R = np.concatenate([np.repeat(R_T[None], 90, axis=0), between, own])
    p = np.zeros(R.shape[:3])
    p[:, 0, 2] = 1.0
    for j, parent in enumerate(skeleton.parents):
        if j:
            p[:, j] = p[:, parent] + R[:, parent] @ skeleton.joint_offsets[j]
    return np.arange(len(R)) / 60, R, p, skeleton.names


def gaitex_markers(R: Array, p: Array, names: tuple[str, ...]) -> dict[str, Array]:
    """Markers whose joint centres are those of the skeleton, by the hips' regressions solved for them."""
    at = {name: p[:, names.index(name)] for name in names}
    points: dict[str, Array] = {}
    for side, word in (("R", "Right"), ("L", "Left")):
        points |= dict.fromkeys((f"{side}_FLE", f"{side}_FME"), at[f"{word}Leg"])
        points |= dict.fromkeys((f"{side}_FAL", f"{side}_TAM"), at[f"{word}Foot"])
    middle, apart = (at["RightUpLeg"] + at["LeftUpLeg"]) / 2, at["RightUpLeg"] - at["LeftUpLeg"]
    distance = np.linalg.norm(apart, axis=1, keepdims=True)
    right = apart / distance
    width, depth = (distance / 2 - 0.0073) / 0.33, 0.15  # Harrington's regressions, solved for the pelvis
    up = R[:, 0] @ np.array([0.0, 0.0, 1.0])
    up = up - np.sum(up * right, axis=1, keepdims=True) * right
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    forward = np.cross(up, right)
    front = middle + (0.24 * depth + 0.0099) * forward + (0.30 * width + 0.0109) * up
    for sign, side in ((1, "R"), (-1, "L")):
        points[f"{side}_IAS"] = front + sign * width / 2 * right
        points[f"{side}_IPS"] = front - depth * forward + sign * 0.05 * right
    return points


def _csv(path: Path, columns: dict[str, Array]) -> None:
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.9f")
