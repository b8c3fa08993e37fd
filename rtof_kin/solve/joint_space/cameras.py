"""Landmarks of one or more cameras, arranged for the joint-space energy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.solve.energy.frame_energy import camera_names


def camera_data(seen: Sequence[KeypointSequence], frames: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """Undistorted landmarks by frame, and the cameras; a camera that sees nothing where there is none.

    Args:
        seen: what each camera sees, the first one first.
    """
    rows = {"uv_px": np.zeros((frames, 0, 2)), "w_visual": np.zeros((frames, 0))}
    if not seen:
        return rows, {"K": np.eye(3), "R_camera_world": np.eye(3), "t_camera_world": np.zeros(3)}
    constant: dict[str, Array] = {}
    for which, view in enumerate(seen):
        camera = view.camera
        uv = camera.normalise(view.uv_px) @ camera.K[:2, :2].T + camera.K[:2, 2]
        own = {"uv_px": np.where(view.seen[..., None], uv, 0.0), "w_visual": view.seen.astype(float)}
        rows = {name: np.concatenate([rows[name], own[name]], axis=1) for name in rows}
        values = camera.K, camera.R_camera_world, camera.t_camera_world
        constant |= dict(zip(camera_names(which), values, strict=True))
    return rows, constant
