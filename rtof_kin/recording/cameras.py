"""Cameras of a recording and their keypoints: ``[camera]``, ``[keypoints]`` and further ``[[views]]``.

The format is described in docs/recording.md.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.over_time import Stream
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.camera_motion import CameraMotion, still_camera_of, turned
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.camera_motion import VIDEO_AXES, VIDEO_CONSTANTS, read_camera_motion, video_arrays, with_video
from rtof_kin.formats.cameras import read_camera as read_camera_file
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.tables import phone_files, read_phone
from rtof_kin.inertial.orientation import HELD, held_of_gravity, motion_of_gyroscope
from rtof_kin.recording.streams import Source, Table, csv_names, data_path, naming, needed, times_of
from rtof_kin.recording.tables import (
    OWN_LAYOUT,
    RECOGNISE,
    AccuracyTable,
    CameraMotionTable,
    CameraTable,
    KeypointsTable,
    UncertaintyTable,
)
from rtof_kin.vision.keypoints import DetectedKeypoints, read_detector_keypoints
from rtof_kin.vision.layouts import is_detector_point, is_layout_file, layout_named

_SHORTEST_FOCAL: Final = 0.1  # of the image's width; a shorter focal length is in another unit
_FOCAL: Final = 0.05  # relative difference of the focal length that is remarked on
_FIELDS: Final = {
    "focal": ("focal", 1.0),
    "tilt": ("tilt_deg", float(np.radians(1.0))),
    "height": ("height_m", 1.0),
    "k1": ("k1", 1.0),
    "roll": ("roll_deg", float(np.radians(1.0))),
}
"""Field of `CameraUncertainty` -> field in the table and its unit."""
_COLUMNS: Final = ("_u_px", "_v_px", "_confidence")
_AXES: Final = {"uv_px": 3, "confidence": 2, "times": 1}
_log = logging.getLogger(__name__)


# --- cameras -------------------------------------------------------------------------------------


def read_camera(table: CameraTable) -> Camera:
    """Return a camera given by its matrices, by position, target and focal length, or by a calibration file;
    `FileFormatError`, `UnknownNameError` and `UnitError` name file, field and remedy.
    """
    if table.file is None:
        camera = _declared_camera(table)
    else:
        path = data_path(table)
        with naming(table.path):
            camera = read_camera_file(path, table.name, up=table.up, metres_per_unit=table.metres_per_unit)
    with naming(table.path):
        return replace(camera, uncertainty=_sigmas(table.uncertainty), accuracy=_sigmas(table.accuracy))


def _declared_camera(table: CameraTable) -> Camera:
    width, height = table.width_px, table.height_px
    assert width is not None  # these are rules of the table
    assert height is not None
    with naming(table.path):
        if table.position_m is not None and table.target_m is not None:
            if np.linalg.norm(np.cross(table.target_m - table.position_m, [0, 0, 1])) < 1e-6:
                raise table.error(
                    "target_m",
                    "straight above, below or at position_m, so upright is undefined; "
                    "give R_camera_world and t_camera_world_m",
                )
            aimed = Camera.looking_at(table.position_m, table.target_m, 1.0, width, height)
            R, t = aimed.R_camera_world, aimed.t_camera_world
        else:
            assert table.R_camera_world is not None
            assert table.t_camera_world_m is not None
            R, t = table.R_camera_world, table.t_camera_world_m
        if table.K is None:
            centre = table.principal_point_px
            cx, cy = (width / 2, height / 2) if centre is None else centre
            K = np.array([[table.focal_px, 0.0, cx], [0.0, table.focal_px, cy], [0.0, 0.0, 1.0]], dtype=np.float64)
        else:
            K = table.K
        distortion = np.zeros(5) if table.distortion is None else table.distortion
        drift = table.heading_drift_deg_s * float(np.radians(1.0))
        camera = Camera(
            K, R, t, width, height, distortion, table.assumed, stabilised=table.stabilised, heading_drift=drift
        )
    if K[0, 0] < _SHORTEST_FOCAL * width:
        raise table.error(
            "focal_px" if table.K is None else "K",
            f"a focal length of {K[0, 0]:g} px in images {width} px wide sees nearly everything before the camera; is "
            "it in mm? Give px: mm / width of the sensor in mm * width_px",
        )
    return camera


def _sigmas(table: UncertaintyTable | AccuracyTable | None) -> CameraUncertainty | None:
    if table is None:
        return None
    given = {name: (getattr(table, field), unit) for name, (field, unit) in _FIELDS.items()}
    values = {name: value * unit for name, (value, unit) in given.items() if value is not None}
    return CameraUncertainty(**values, of_motion=isinstance(table, UncertaintyTable) and table.of_motion)


def camera_table(camera: Camera) -> dict[str, Any]:
    """Return the table that `read_camera` reads back exactly; of uncertainties not read from a table, the last bit may
    change.
    """
    more: dict[str, Any] = {"assumed": list(camera.assumed)} if camera.assumed else {}
    if camera.stabilised:
        more["stabilised"] = True
    if camera.heading_drift:
        more["heading_drift_deg_s"] = _number_of(camera.heading_drift, float(np.radians(1.0)))
    for table, sigmas in (("uncertainty", camera.uncertainty), ("accuracy", camera.accuracy)):
        if sigmas is None:
            continue
        own = vars(sigmas)
        given = {name: pair for name, pair in _FIELDS.items() if own[name] is not None}
        more[table] = {field: _number_of(own[name], unit) for name, (field, unit) in given.items()}
        if sigmas.of_motion:
            more[table]["of_motion"] = True
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


# --- a camera with its keypoints -----------------------------------------------------------------


def filmed_stream(
    camera: CameraTable, keypoints: KeypointsTable, skeleton: SkeletonModel, source: Source
) -> tuple[Stream[KeypointSequence], str]:
    """Read a camera and open its keypoints, which are checked; those of a camera that turns are stabilised, and a
    note, else empty, says so. Errors as `read_camera`.
    """
    seen = read_camera(camera)
    found = source.checked(_keypoint_stream(keypoints, seen, skeleton, source))
    if camera.motion is None:
        return found, ""
    motion = _camera_motion(camera.motion).shifted(camera.motion.start_s)
    with naming(camera.path):
        times = checked_times("keypoint times", found.times)
        R_still_camera, still_camera = still_camera_of(seen, times, motion)

    def part(rows: slice) -> KeypointSequence:
        return turned(found.part(rows), R_still_camera[rows], still_camera)

    focal = float(np.trace(seen.K[:2, :2])) / 2
    if motion.focal_px is not None and abs(motion.focal_px / focal - 1) > _FOCAL:
        _log.warning(
            "%s: the turning was estimated with a focal length of %.0f px, [camera] has %.0f px; its angles "
            "are wrong by their ratio: give both the same",
            camera.path,
            motion.focal_px,
            focal,
        )
    note = (
        f"The camera turned by up to {np.degrees(np.nanmax(motion.angles)):.0f} deg; the keypoints are those "
        "of a camera that stands still in the mean orientation; those seen while its rotation is unknown, or far from "
        "that, are left out. The translation of the hand is not modelled."
    )
    if motion.sigma:
        note += f" The turning is known to {np.degrees(motion.sigma):.2f} deg."
    return Stream(times, part), note


def _camera_motion(table: CameraMotionTable) -> CameraMotion:
    path = data_path(table, or_folder=True)
    if path.suffix.lower() == ".npz":
        return read_camera_motion(path)
    phone = phone_files(path)
    log = read_phone(phone) if phone else read_sensor_log(path)
    stream = log.select([log.names[0] if table.sensor is None else table.sensor]).streams[0]
    with naming(path):
        return motion_of_gyroscope(stream, HELD[table.held or held_of_gravity(stream)])


def camera_and_keypoints(keypoints: KeypointSequence, which: int) -> dict[str, Any]:
    """Return the tables ``camera`` and ``keypoints`` that are read back exactly, for `keypoint_file` of a camera, from
    0.
    """
    seen = {"file": keypoint_file(which), "landmarks": list(keypoints.names)}
    return {"camera": camera_table(keypoints.camera), "keypoints": seen}


def keypoint_file_arrays(keypoints: KeypointSequence) -> dict[str, Any]:
    """Return the arrays of a `keypoint_file`."""
    arrays = {"uv_px": keypoints.uv_px, "confidence": keypoints.confidence, "times": keypoints.times}
    return arrays | video_arrays(keypoints)


def keypoint_file(which: int) -> str:
    """Return the name of the file with a camera's keypoints; which: camera, 0 for the first."""
    return f"keypoints_{which + 1}.npz" if which else "keypoints.npz"


# --- keypoints -----------------------------------------------------------------------------------


def _keypoint_stream(
    table: KeypointsTable, camera: Camera, skeleton: SkeletonModel, source: Source
) -> Stream[KeypointSequence]:
    """Open keypoints whose names are landmarks of the skeleton."""
    if table.is_detected:
        found = _read_detected(table, camera, skeleton)
        return source.keep(found.times, (_on_video(part, table.start_s) for part in found.blocks()))
    if table.frame is not None:
        raise table.error("frame", "belongs to a detector's file; give its layout, or auto")
    path = data_path(table)
    is_csv = path.suffix.lower() == ".csv"
    if is_csv and table.layout is not None:
        raise table.error("layout", "a .csv names its points itself; leave the layout out")
    names, arrays = source.csv(path, arranged_keypoints) if is_csv else _keypoint_npz(table, path, skeleton, source)
    unknown = [n for n in names if n and n not in skeleton.landmarks and not is_detector_point(n)]
    if unknown:
        where = str(path) if is_csv else f"{table.path}, {table.where('landmarks')}"
        raise UnknownNameError(f"landmark in {where}", unknown, list(skeleton.landmarks))
    kept = [i for i, name in enumerate(names) if name]
    with naming(path):
        times, named = times_of(table, path, arrays, arrays.shapes["uv_px"][0]), tuple(names[i] for i in kept)

    def part(rows: slice) -> KeypointSequence:
        own = arrays.rows(rows)
        with naming(path):
            uv, confidence = keypoint_arrays(own)
            keypoints = KeypointSequence(camera, times[rows], uv[:, kept], confidence[:, kept], named)
            return with_video(_on_video(keypoints, table.start_s), own)

    return Stream(times, part)


def keypoint_arrays(arrays: dict[str, Array]) -> tuple[Array, Array]:
    """Return pixels (T, L, 2) and confidences (T, L), 1 for every point seen where the file has none."""
    uv = arrays["uv_px"]
    confidence: Array = arrays.get("confidence", np.isfinite(uv).all(axis=-1).astype(float))
    if confidence.shape != uv.shape[:2]:
        raise InvalidInputError(f"confidence: expected shape {uv.shape[:2]} as uv_px has, got {confidence.shape}")
    return uv, confidence


def _keypoint_npz(
    table: KeypointsTable, path: Path, skeleton: SkeletonModel, source: Source
) -> tuple[tuple[str, ...], Table]:
    arrays = source.npz(path, _AXES | VIDEO_AXES, VIDEO_CONSTANTS)
    points = needed(path, arrays.shapes, "uv_px", "(T, L, 2)")[1]
    names = table.landmarks if table.layout is None else skeleton.names
    if names is None:
        raise table.error("landmarks", "missing; list the names of the points in the file's order")
    if len(names) != points:
        raise table.error(
            "landmarks",
            f'{len(names)} names, but {path} has {points} points; name each one, with "" for those to leave out',
        )
    return names, arrays


def _read_detected(table: KeypointsTable, camera: Camera, skeleton: SkeletonModel) -> DetectedKeypoints:
    """Read keypoints from a detector's own file or folder, in its own layout; see `rtof_kin.vision`."""
    layout = table.layout
    if skeleton.name != "total_capture":
        raise table.error(
            "layout",
            f"{layout!r} is for the skeleton total_capture, not {skeleton.name}; list the "
            f"names of the points in landmarks, or write {OWN_LAYOUT!r} for its joints in their order",
        )
    if is_layout_file(layout):
        layout = layout_named(data_path(table, field="layout"))
    person = table.person if table.person_number is None else table.person_number - 1
    found = read_detector_keypoints(
        data_path(table, or_folder=True),
        camera,
        layout=None if layout == RECOGNISE else layout,
        rate_hz=table.rate_hz,
        start=table.start_s,
        person=person,
        frame=table.frame,
    )
    doubtful = (found.track.people > 1 and person is None) or np.any(found.track.ambiguous | found.track.lost)
    _log.log(logging.WARNING if doubtful else logging.INFO, "%s: %s", table.path, found.summary)
    return found


def _on_video(keypoints: KeypointSequence, start: float) -> KeypointSequence:
    """Return keypoints whose times are those of the video, s, and `start`."""
    return replace(keypoints, own_times=keypoints.times - start) if start else keypoints


def arranged_keypoints(path: Path, columns: dict[str, Array]) -> tuple[tuple[str, ...], dict[str, Array]]:
    """Return landmark names and the arrays uv_px (T, L, 2), confidence (T, L) and, if present, times (T,) from the
    columns (T,) of a recording's .csv file.
    """
    arrays = {"times": columns["time"]} if "time" in columns else {}
    names = csv_names(path, [name for name in columns if name != "time"], _COLUMNS, optional=1)
    uv = np.stack([[columns[n + end] for end in _COLUMNS[:2]] for n in names]).transpose(2, 0, 1)
    seen = np.isfinite(uv).all(axis=-1).astype(float)
    given = [columns.get(f"{n}_confidence", seen[:, i]) for i, n in enumerate(names)]
    return names, arrays | {"uv_px": uv, "confidence": np.stack(given, axis=1)}
