"""Synthetic archives and camera files in the layout of Human3.6M."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import planted
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.datasets.human36m import SUBJECTS_TEST, SUBJECTS_TRAIN
from rtof_kin.datasets.human36m_files import CAMERA_IDS

Array = NDArray[np.float64]
Positions = dict[str, dict[str, Array]]
"""Subject -> action -> (T, 17, 3) m."""
PLACES = ((2.1, 4.9, 1.6), (1.9, -5.1, 1.5), (-1.7, 5.2, 1.4), (-1.8, -3.9, 1.6))
"""Where the cameras stand, m."""
FOCAL_PX = ((1140.0, 1138.5), (1151.0, 1149.0), (1147.0, 1146.2), (1144.0, 1143.1))
CENTRE_PX = ((511.0, 514.0), (507.0, 509.5), (518.0, 502.0), (513.5, 503.0))
RADIAL = ((-0.20, 0.24, -0.003), (-0.19, 0.23, 0.007), (-0.21, 0.25, -0.002), (-0.18, 0.22, -0.009))
TANGENTIAL = ((-0.0011, -0.0015), (-0.0017, -0.0026), (0.0014, -0.0008), (-0.0006, -0.0019))
"""As the source writes them: the first moves a point of the y axis sideways."""
SIZES_PX = ((1000, 1002), (1000, 1000), (1000, 1000), (1000, 1002))
METADATA = {
    "layout_name": "h36m",
    "num_joints": 17,
    "keypoints_symmetry": [[4, 5, 6, 11, 12, 13], [1, 2, 3, 14, 15, 16]],
}
KEPT = [0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27]


@cache
def body(subject: str) -> SkeletonModel:
    """A subject-specific body, with hips and shoulders unlike the table."""
    rng = np.random.default_rng(int(subject[1:]))
    skeleton = SkeletonModel.human36m().with_height(1.6 + 0.03 * int(subject[1:]))
    own = {
        name: skeleton.joint_offsets[skeleton.index(name)[0]] + rng.normal(size=3) * 0.02
        for name in ("RHip", "LHip", "Spine", "Neck", "LShoulder", "RShoulder")
    }
    return skeleton.with_offsets(own)


def motions(subjects: tuple[str, ...], actions: int = 2, frames: int = 30) -> Positions:
    """Planted motions of rigid bodies, one per action; float32 as archived."""
    return {
        subject: {
            f"Action {k}": planted.moving(body(subject), frames, 100 * k + int(subject[1:]))
            .poses.p_world_joint.astype(np.float32)
            .astype(np.float64)
            for k in range(actions)
        }
        for subject in subjects
    }


def orientation(subject: str, camera: int) -> Array:
    """(3, 3) R_camera_world; cameras are turned a little between subjects."""
    target = [0.05 * int(subject[1:]), 0.0, 0.9]
    return Camera.looking_at(PLACES[camera], target, 1000.0).R_camera_world


def projected(p: Array, subject: str, camera: int) -> Array:
    """Pixels (..., 2) of points (..., 3) by Human3.6M's own formula, which is not OpenCV's."""
    seen = (p - np.array(PLACES[camera])) @ orientation(subject, camera).T
    xy = seen[..., :2] / seen[..., 2:]
    r2 = np.sum(xy**2, axis=-1, keepdims=True)
    k, tangential = RADIAL[camera], np.array(TANGENTIAL[camera])
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    bent = xy * (radial + np.sum(tangential * xy, axis=-1, keepdims=True)) + tangential * r2
    return np.asarray(bent * FOCAL_PX[camera] + CENTRE_PX[camera])


def of_32(p: Array) -> NDArray[np.float32]:
    """(T, 32, 3) as archived; unused joints are far away."""
    wide = np.full((len(p), 32, 3), 99.0, dtype=np.float32)
    wide[:, KEPT] = p
    return wide


def keypoints(positions: Positions, sigma_px: float = 0.0, more: int = 0) -> dict[str, Any]:
    """2D of all four cameras, with noise, and with some frames more than the positions have."""
    rng = np.random.default_rng(0)

    def seen(p: Array, subject: str, camera: int) -> NDArray[np.float32]:
        uv = projected(np.concatenate([p, p[:more]]), subject, camera)
        return (uv + sigma_px * rng.normal(size=uv.shape)).astype(np.float32)

    return {
        subject: {a: [seen(p, subject, i) for i in range(4)] for a, p in actions.items()}
        for subject, actions in positions.items()
    }


def plain(**contents: Any) -> dict[str, Any]:
    """Arrays by the path to them in nested contents."""
    found: dict[str, Any] = {}
    for name, value in contents.items():
        nested = value if isinstance(value, dict) else dict(enumerate(value)) if isinstance(value, list) else None
        if nested is None or name == "keypoints_symmetry":
            found[name] = np.asarray(value)
        else:
            found |= {f"{name}/{key}": array for key, array in plain(**{str(k): v for k, v in nested.items()}).items()}
    return found


def write_positions(root: Path, positions: Mapping[str, Mapping[str, Any]]) -> None:
    """``data_3d_h36m.npz``; entries that are not (T, 17, 3) are written as they are."""
    entries = {
        subject: {a: of_32(p) if np.shape(p)[1:] == (17, 3) else p for a, p in actions.items()}
        for subject, actions in positions.items()
    }
    np.savez_compressed(root / "data_3d_h36m.npz", **plain(positions_3d=entries))


def write_keypoints(root: Path, entries: Mapping[str, Any], kind: str = "gt", metadata: Any = METADATA) -> None:
    """``data_2d_h36m_<kind>.npz``."""
    np.savez_compressed(root / f"data_2d_h36m_{kind}.npz", **plain(positions_2d=entries, metadata=metadata))


def camera_json(subjects: tuple[str, ...]) -> dict[str, Any]:
    """The tables of the JSON file."""
    intrinsics = {}
    for i, name in enumerate(CAMERA_IDS):
        (fx, fy), (cx, cy), (k1, k2, k3), (p2, p1) = FOCAL_PX[i], CENTRE_PX[i], RADIAL[i], TANGENTIAL[i]
        intrinsics[name] = {
            "calibration_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
            "distortion": [k1, k2, p1, p2, k3],
        }
    extrinsics: dict[str, Any] = {}
    for subject in subjects:
        extrinsics[subject] = {}
        for i, name in enumerate(CAMERA_IDS):
            R = orientation(subject, i)
            t_mm = -R @ np.array(PLACES[i]) * 1000
            extrinsics[subject][name] = {"R": R.tolist(), "t": t_mm[:, None].tolist()}
    return {"intrinsics": intrinsics, "extrinsics": extrinsics}


def camera_source(subjects: tuple[str, ...]) -> tuple[list[Any], dict[str, Any]]:
    """The two tables of the Python source."""
    intrinsics = [
        {
            "id": name,
            "center": list(CENTRE_PX[i]),
            "focal_length": list(FOCAL_PX[i]),
            "radial_distortion": list(RADIAL[i]),
            "tangential_distortion": list(TANGENTIAL[i]),
            "res_w": SIZES_PX[i][0],
            "res_h": SIZES_PX[i][1],
            "azimuth": 70,
        }
        for i, name in enumerate(CAMERA_IDS)
    ]
    extrinsics: dict[str, Any] = {"S2": [{}, {}, {}, {}]}
    for subject in subjects:
        extrinsics[subject] = [
            {
                "orientation": so3.to_quat_wxyz(orientation(subject, i).T).tolist(),
                "translation": (np.array(PLACES[i]) * 1000).tolist(),
            }
            for i in range(4)
        ]
    return intrinsics, extrinsics


def write_camera_json(root: Path, subjects: tuple[str, ...]) -> Path:
    """``camera-parameters.json``."""
    path = root / "camera-parameters.json"
    path.write_text(json.dumps(camera_json(subjects), indent=2))
    return path


def write_camera_source(root: Path, subjects: tuple[str, ...]) -> Path:
    """``h36m_dataset.py``, with code around the tables that must never run."""
    intrinsics, extrinsics = camera_source(subjects)
    path = root / "h36m_dataset.py"
    path.write_text(
        "import numpy as np\nfrom common.skeleton import Skeleton\n\n"
        "open('it ran', 'w').close()\nraise SystemExit('it ran')\n\n"
        f"h36m_cameras_intrinsic_params = {intrinsics!r}\n\n"
        f"h36m_cameras_extrinsic_params = {extrinsics!r}\n\n"
        "class Human36mDataset:\n    pass\n"
    )
    return path


def write_dataset(
    root: Path, subjects: tuple[str, ...] = SUBJECTS_TRAIN + SUBJECTS_TEST, actions: int = 2, frames: int = 30
) -> Positions:
    """Positions, projected and detected keypoints and both files of cameras; returns the positions."""
    positions = motions(subjects, actions, frames)
    write_positions(root, positions)
    write_keypoints(root, keypoints(positions))
    write_keypoints(root, keypoints(positions, sigma_px=8.0, more=3), "cpn_ft_h36m_dbb")
    write_camera_json(root, subjects)
    write_camera_source(root, subjects)
    return positions
