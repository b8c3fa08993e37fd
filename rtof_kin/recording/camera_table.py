"""The table ``[camera]`` of a recording, read and written. The format is described in docs/recording.md."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.formats.cameras import read_camera as read_camera_file
from rtof_kin.recording.files import data_path, naming

_SHORTEST_FOCAL: Final = 0.1  # of the image's width; a shorter focal length is in another unit
_UNCERTAINTY, _ACCURACY, _OF_MOTION = "uncertainty", "accuracy", "of_motion"
_FIELDS: Final = {
    "focal": ("focal", 1.0),
    "tilt": ("tilt_deg", float(np.radians(1.0))),
    "height": ("height_m", 1.0),
    "k1": ("k1", 1.0),
    "roll": ("roll_deg", float(np.radians(1.0))),
}
"""Field of `CameraUncertainty` -> field in the table and its unit."""


def read_camera(section: Section) -> Camera:
    """Read a camera given by its matrices, by position, target and focal length, or by a calibration file.

    Args:
        section: table ``[camera]``; its ``motion`` is read by `camera_motion_files`.
    """
    section.has("motion")
    uncertainty, accuracy = _uncertainty(section, _UNCERTAINTY), _uncertainty(section, _ACCURACY)
    if section.has("file"):
        path, name, up = data_path(section), section.optional_text("name"), section.optional_text("up")
        with naming(section.path):
            metres_per_unit = section.optional_number("metres_per_unit")
            camera = read_camera_file(path, name, up=up, metres_per_unit=metres_per_unit)
        section.close()
        return replace(camera, uncertainty=uncertainty, accuracy=accuracy)
    width, height = section.integer("width_px"), section.integer("height_px")
    with naming(section.path):
        if section.has("position_m") or section.has("target_m"):
            position, target = section.array("position_m", (3,)), section.array("target_m", (3,))
            if np.linalg.norm(np.cross(target - position, [0, 0, 1])) < 1e-6:
                raise section.error(
                    "target_m",
                    "straight above, below or at position_m, so upright is undefined; "
                    "give R_camera_world and t_camera_world_m",
                )
            aimed = Camera.looking_at(position, target, 1.0, max(width, 1), max(height, 1))
            R, t = aimed.R_camera_world, aimed.t_camera_world
        else:
            R, t = section.array("R_camera_world", (3, 3)), section.array("t_camera_world_m", (3,))
        K = _intrinsics(section, width, height)
        distortion = section.array("distortion", (5,)) if section.has("distortion") else np.zeros(5)
        assumed = section.optional_names("assumed") or ()
        stabilised = section.flag("stabilised")
        drift = section.number("heading_drift_deg_s", 0.0) * float(np.radians(1.0))
        camera = Camera(K, R, t, width, height, distortion, assumed, uncertainty, stabilised, drift, accuracy)
    if K[0, 0] < _SHORTEST_FOCAL * width:
        raise section.error(
            "K" if section.has("K") else "focal_px",
            f"a focal length of {K[0, 0]:g} px in images {width} "
            "px wide sees nearly everything before the camera; is it in mm? Give px: mm / width of the "
            "sensor in mm * width_px",
        )
    section.close()
    return camera


def _uncertainty(section: Section, name: str) -> CameraUncertainty | None:
    """Return a table of standard deviations; None without one."""
    if not section.has(name):
        return None
    table = section.table(name)
    given = {name: (table.optional_number(field), unit) for name, (field, unit) in _FIELDS.items()}
    values = {name: value * unit for name, (value, unit) in given.items() if value is not None}
    of_motion = name == _UNCERTAINTY and table.flag(_OF_MOTION)
    table.close()
    with naming(section.path):
        return CameraUncertainty(**values, of_motion=of_motion)


def _intrinsics(section: Section, width: int, height: int) -> Array:
    if section.has("K"):
        return section.array("K", (3, 3))
    focal = section.number("focal_px")
    centre = section.optional_array("principal_point_px", (2,))
    cx, cy = (width / 2, height / 2) if centre is None else centre
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def camera_table(camera: Camera) -> dict[str, Any]:
    """Return the table that `read_camera` reads back exactly.

    Args:
        camera: to write; of uncertainties that were not read from a table, the last bit may change.
    """
    more: dict[str, Any] = {"assumed": list(camera.assumed)} if camera.assumed else {}
    if camera.stabilised:
        more["stabilised"] = True
    if camera.heading_drift:
        more["heading_drift_deg_s"] = _number_of(camera.heading_drift, float(np.radians(1.0)))
    for table, sigmas in ((_UNCERTAINTY, camera.uncertainty), (_ACCURACY, camera.accuracy)):
        if sigmas is None:
            continue
        own = vars(sigmas)
        given = {name: pair for name, pair in _FIELDS.items() if own[name] is not None}
        more[table] = {field: _number_of(own[name], unit) for name, (field, unit) in given.items()}
        if sigmas.of_motion:
            more[table][_OF_MOTION] = True
    return more | {
        "width_px": int(camera.width_px),
        "height_px": int(camera.height_px),
        "K": camera.K.tolist(),
        "R_camera_world": camera.R_camera_world.tolist(),
        "t_camera_world_m": camera.t_camera_world.tolist(),
        "distortion": camera.distortion.tolist(),
    }


def _number_of(value: float, unit: float) -> float:
    """Return the number whose product with the unit is the value, exactly where there is one."""
    near = float(value / unit)
    about = (near, float(np.nextafter(near, np.inf)), float(np.nextafter(near, -np.inf)))
    return next((number for number in about if number * unit == value), near)
