"""Writers of version 1 of ``motion.npz`` and ``measurements.npz``, whose files are still read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.observability import observed_dofs
from rtof_kin.body.skeleton import Motion
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.camera_motion import video_arrays

POSES = ("times", "p_world_joint", "R_world_bone", "valid", "provenance", "orientation_observed", "direction_observed")
COVARIANCES = ("position_covariance", "relative_covariance", "turn_covariance")
CAMERA = ("K", "R_camera_world", "t_camera_world", "distortion")


def write_motion(path: Path, motion: Motion) -> None:
    confidence = motion.confidence
    arrays: dict[str, Any] = {name: getattr(motion.poses, name) for name in POSES} | {
        "schema_version": np.array(1),
        "q": motion.q,
        "dof_observed": observed_dofs(motion),
        "singular": motion.report.singular,
        "names": np.array(motion.poses.names),
        "dof_names": np.array(motion.skeleton.dof_names),
        "joint_offsets": motion.skeleton.joint_offsets,
        "first_frame": np.array(42),
        "mode": np.array("rtof"),
        "skeleton": np.array(motion.skeleton.name),
    }
    if confidence is not None:
        arrays["confidence_pairs"] = np.array(confidence.pairs)
        arrays |= {name: getattr(confidence, name).astype(np.float32) for name in COVARIANCES}
    np.savez_compressed(path, **arrays)


def write_measurements(path: Path, m: Measurements) -> None:
    arrays: dict[str, Any] = {"times": m.times}
    header = {
        "schema_version": 1,
        "sensors": m.sensors,
        "segments": m.segments,
        "floor_height": m.floor_height,
        "faults": [[fault.kind.name, fault.what, fault.start, fault.stop] for fault in m.faults],
        "views": [{"names": view.names, "camera": camera_header(view.camera)} for view in m.views],
        "joints": () if m.truth is None else m.truth.names,
    }
    for i, view in enumerate(m.views):
        own = {"uv_px": short(view.uv_px), "confidence": short(view.confidence)} | video_arrays(view)
        arrays |= {f"view_{i}_{name}": array for name, array in own.items()}
    arrays |= {
        "quat_wxyz_world_sensor": short(so3.known_to_quat_wxyz(m.R_world_sensor)),
        "quat_wxyz_bone_sensor": short(so3.known_to_quat_wxyz(m.R_bone_sensor)),
        "p_bone_sensor": m.p_bone_sensor,
    }
    if m.truth is not None:
        arrays["truth_p_world_joint"] = short(m.truth.p_world_joint)
        arrays["truth_quat_wxyz"] = short(so3.known_to_quat_wxyz(m.truth.R_world_bone))
        arrays["truth_valid"] = m.truth.valid
    np.savez_compressed(path, **arrays, header=np.array(json.dumps(header)))


def camera_header(camera: Any) -> dict[str, Any]:
    return {name: getattr(camera, name).tolist() for name in CAMERA} | {
        "width_px": int(camera.width_px),
        "height_px": int(camera.height_px),
        "assumed": camera.assumed,
        "stabilised": camera.stabilised,
    }


def short(values: Array) -> Any:
    return values.astype(np.float32)
