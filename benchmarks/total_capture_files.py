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

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.simulation.mocap_families import NAMES

C_WORLD_TC = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""World axes of the package from those of the files: (x, y, z) becomes (x, -z, y)."""
M_TC_BONE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
"""Segment axes of the files from link axes of the package; its own inverse."""
INCH = 0.0254  # [m]
LAYOUTS = ("one", "vendor", "split")
"""All of a take in one folder; as the archives unpack; a folder for each kind of file."""
_MAGNETIC_FIELD = np.array([0.0, 0.45, -0.9])


def take_paths(layout: str, subject: str, take: str) -> dict[str, Path]:
    """Return the paths of a take's files below the folder of the dataset, by kind.

    Args:
        layout: one of `LAYOUTS`. subject: 'S1'. take: 'acting3'.

    Returns:
        Paths of 'positions', 'orientations', 'sensors', 'aux', 'ref' and 'bone'.
    """
    own, low = Path(subject), subject.lower()
    folders = {
        "one": (own / take, own / take, own / take),
        "vendor": (own / take, Path(low), Path(low)),
        "split": (Path("vicon") / subject / take, Path("imu") / low, Path("gyro_mag") / low),
    }
    vicon, imu, aux = folders[layout]
    return {
        "positions": vicon / "gt_skel_gbl_pos.txt",
        "orientations": vicon / "gt_skel_gbl_ori.txt",
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
