"""Files in the formats of Total Capture, written from data in this package's units and frames.

World of the package: z up, m; link frames x forward, y left, z up in the T-pose. World of the files: y
up, inches; segment frames x right, y back, z down in the T-pose::

    p_world = C p_tc                R_world_bone  = C R_tc M
    R_world_inertial = C R_ref      R_sensor_bone = R_ib^T M

so that R_tc = R_ref R_imu R_ib^T. Nothing here reads, and the package's reader was not looked at: what
that reads back from these files is proof of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap_families import NAMES, PARENTS

C_WORLD_TC = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""World axes of the package from those of the files: (x, y, z) becomes (x, -z, y)."""
M_TC_BONE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
"""Segment axes of the files from link axes of the package; its own inverse."""
INCH = 0.0254  # [m]
LAYOUTS = ("one", "vendor", "split")
"""All of a take in one folder; as the archives unpack; a folder for each kind of file."""
END_SITES_MM: dict[str, tuple[tuple[str, tuple[float, float, float]], ...]] = {
    "Head": (("", (0, 0, -149.5)),),
    "RightHand": (("RightHandEnd", (65.9, 0, 0)), ("RightHandThumb1", (20, -40, 5))),
    "RightFoot": (("RightToeBase", (0, -144.0, 52.4)),),
    "RightHandEnd": (("", (30, 0, 0)),),
    "RightHandThumb1": (("", (15, -30, 0)),),
    "RightToeBase": (("", (0, -70, 0)),),
}
"""Joints of a BVH file beyond the 21, in segment axes of the parent; a joint without a name is an
End Site. The left side mirrors x."""
_CHANNELS = "Xposition Yposition Zposition Zrotation Xrotation Yrotation"
_MAGNETIC_FIELD = np.array([0.0, 0.45, -0.9])


def take_paths(layout: str, subject: str, take: str) -> dict[str, Path]:
    """Return the paths of a take's files below the folder of the dataset, by kind.

    Args:
        layout: one of `LAYOUTS`. subject: 'S1'. take: 'acting3'.

    Returns:
        Paths of 'positions', 'orientations', 'bvh', 'sensors', 'aux', 'ref' and 'bone'.
    """
    own, low = Path(subject), subject.lower()
    folders = {
        "one": (own / take, own / take, own / take, own / take),
        "vendor": (own / take, own, Path(low), Path(low)),
        "split": (Path("vicon") / subject / take, Path("vicon") / subject, Path("imu") / low, Path("gyro_mag") / low),
    }
    vicon, bvh, imu, aux = folders[layout]
    return {
        "positions": vicon / "gt_skel_gbl_pos.txt",
        "orientations": vicon / "gt_skel_gbl_ori.txt",
        "bvh": bvh / f"{take}_BlenderZXY_YmZ.bvh",
        "sensors": imu / f"{low}_{take}_Xsens.sensors",
        "aux": aux / f"{take.capitalize()}_Xsens_AuxFields.sensors",
        "ref": imu / f"{low}_{take}_calib_imu_ref.txt",
        "bone": imu / f"{low}_{take}_calib_imu_bone.txt",
    }


def tc_positions(p_world: ArrayLike) -> Array:
    """World points (..., 3), m, in the files' world, inches."""
    return np.asarray(np.asarray(p_world) @ C_WORLD_TC / INCH)


def tc_rotations(R_world_bone: ArrayLike) -> Array:
    """Segment orientations (..., 3, 3) in the files' world and segment axes."""
    return np.asarray(C_WORLD_TC.T @ np.asarray(R_world_bone) @ M_TC_BONE)


def quat_xyzw(R: ArrayLike) -> Array:
    """Quaternions (..., 4), scalar last, continuous along the first axis."""
    return np.roll(so3.to_quat_wxyz(R), -1, axis=-1)


# --- Vicon ---------------------------------------------------------------------------------------


def write_joints(path: Path, values: Array, names: Sequence[str] = NAMES) -> None:
    """gt_skel_gbl_pos.txt or _ori.txt of (T, J, 3) inches or (T, J, 4) x y z w."""
    cell = " ".join(["%.6g"] * values.shape[-1])
    row = f"{cell}\t" * values.shape[1] + "\n"
    lines = ["\t".join([*names, "\n"])]
    lines += [row % tuple(frame) for frame in values.reshape(len(values), -1).tolist()]
    _write(path, lines)


def write_bvh(path: Path, poses: PoseSequence, joint_offsets: Array) -> None:
    """The motion as BVH with six channels for every joint.

    Args:
        poses: joints in the order of `rtof_kin.simulation.mocap.NAMES`. joint_offsets: (21, 3) m, link axes.
    """
    offsets = joint_offsets @ M_TC_BONE / INCH
    lines = ["HIERARCHY\n"]
    order: list[tuple[int, Array]] = []
    _bvh_joint(lines, order, 0, offsets)
    local = kinematics.local_rotations(PARENTS, tc_rotations(poses.R_world_bone))
    degrees = np.degrees(so3.matrix_to_euler("zxy", local))
    values = np.zeros((len(poses), len(order), 6))
    for column, (joint, offset) in enumerate(order):
        values[:, column, :3] = offset
        if joint >= 0:
            values[:, column, 3:] = degrees[:, joint]
    values[:, 0, :3] = tc_positions(poses.p_world_joint[:, 0])
    lines += ["MOTION\n", f"Frames: {len(poses)}\n", f"Frame Time: {1 / poses.rate_hz:.6g}\n"]
    row = " ".join(["%.6f"] * (6 * len(order))) + "\n"
    lines += [row % tuple(frame) for frame in values.reshape(len(poses), -1).tolist()]
    _write(path, lines)


def _bvh_joint(lines: list[str], order: list[tuple[int, Array]], joint: int, offsets: Array, depth: int = 0) -> None:
    """Append a joint and all below it: lines, and its index and offset in the order of the channels."""
    order.append((joint, offsets[joint]))
    _open(lines, f"JOINT {NAMES[joint]}" if depth else f"ROOT {NAMES[joint]}", offsets[joint], depth)
    for child in kinematics.children_of(PARENTS, joint):
        _bvh_joint(lines, order, child, offsets, depth + 1)
    _bvh_ends(lines, order, NAMES[joint], depth + 1)
    lines.append("  " * depth + "}\n")


def _bvh_ends(lines: list[str], order: list[tuple[int, Array]], parent: str, depth: int) -> None:
    """Append what hangs on a joint beyond the 21."""
    mirrored = parent.startswith("Left")
    for name, place_mm in END_SITES_MM.get(parent.replace("Left", "Right"), ()):
        offset = np.array(place_mm) * [-1 if mirrored else 1, 1, 1] / 1000 / INCH
        if not name:
            _open(lines, "End Site", offset, depth, channels=False)
        else:
            name = name.replace("Right", "Left") if mirrored else name
            order.append((-1, offset))
            _open(lines, f"JOINT {name}", offset, depth)
            _bvh_ends(lines, order, name, depth + 1)
        lines.append("  " * depth + "}\n")


def _open(lines: list[str], head: str, offset: Array, depth: int, channels: bool = True) -> None:
    pad = "  " * depth
    place = " ".join(f"{x:.6f}" for x in offset)
    lines += [f"{pad}{head}\n", f"{pad}{{\n", f"{pad}  OFFSET {place}\n"]
    if channels:
        lines.append(f"{pad}  CHANNELS 6 {_CHANNELS}\n")


# --- IMUs ----------------------------------------------------------------------------------------


def write_sensors(path: Path, imus: ImuSequence, aux: bool = False, seed: int = 0) -> None:
    """Orientation and specific force as .sensors.

    Args:
        aux: with gyroscope, rad/s, and magnetometer, made to fit the orientations. seed: of their noise.
    """
    columns = [so3.to_quat_wxyz(imus.R_inertial_sensor), imus.f_sensor]
    if aux:
        columns += _gyroscope_and_magnetometer(imus, np.random.default_rng(seed))
    values = np.concatenate(columns, axis=-1)
    lines = [f"{len(imus.names)}\t{len(imus)}\n"]
    cells = "\t%.6g" * values.shape[-1] + "\n"
    frame_text = "%d\n" + "".join(name + cells for name in imus.names)
    for number, frame in enumerate(values.reshape(len(imus), -1).tolist(), 1):
        lines.append(frame_text % (number, *frame))
    _write(path, lines)


def _gyroscope_and_magnetometer(imus: ImuSequence, rng: np.random.Generator) -> list[Array]:
    R_sensor_inertial = np.swapaxes(imus.R_inertial_sensor, -1, -2)
    steps = so3.log(R_sensor_inertial[:-1] @ imus.R_inertial_sensor[1:])
    rate_hz = 1 / np.median(np.diff(imus.times))
    w_sensor = np.concatenate([steps, steps[-1:]]) * rate_hz
    field = R_sensor_inertial @ _MAGNETIC_FIELD
    return [w_sensor + 0.01 * rng.standard_normal(w_sensor.shape), field + 0.01 * rng.standard_normal(field.shape)]


def write_imu_calibration(path_ref: Path, path_bone: Path, calibration: ImuCalibration) -> None:
    """The pair calib_imu_ref.txt and calib_imu_bone.txt; the second in another order of sensors."""
    R_ref = C_WORLD_TC.T @ calibration.R_world_inertial
    R_ib = M_TC_BONE @ np.swapaxes(calibration.R_sensor_bone, -1, -2)
    sensors = calibration.sensors
    for path, R, order in ((path_ref, R_ref, range(len(sensors))), (path_bone, R_ib, reversed(range(len(sensors))))):
        quat = [quat_xyzw(matrix) for matrix in R]
        lines = [f"{len(sensors)}\n"]
        lines += [f"{sensors[s]} {' '.join(f'{q:.6g}' for q in quat[s])}\n" for s in order]
        _write(path, lines)


# --- cameras -------------------------------------------------------------------------------------


def write_cameras(path: Path, cameras: Mapping[int, Camera]) -> None:
    """calibration.cal of cameras in the package's world, in the order of their numbers."""
    lines = [f"{len(cameras)} 1 \r\n"]
    for number in sorted(cameras):
        camera = cameras[number]
        K, R_camera_tc = camera.K, camera.R_camera_world @ C_WORLD_TC
        rows: list[Iterable[float]] = [
            (0, camera.height_px - 1, 0, camera.width_px - 1),
            (K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
            camera.distortion[:1],
            *R_camera_tc,
            camera.t_camera_world,
        ]
        lines += [" ".join(f"{x:.10g}" for x in row) + " \r\n" for row in rows]
    _write(path, lines)


def _write(path: Path, lines: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("".join(lines).encode("ascii"))
