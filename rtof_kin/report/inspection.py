"""What a file is, what it holds, and whether that can be true: `inspect`, for every file that is read.

Sensor logs are checked by physics (`rtof_kin.inertial.physics`), bodies and cameras by
`rtof_kin.recording.body_checks`. Nothing is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.files.arrays import npz_names
from rtof_kin.core.plausibility import Check
from rtof_kin.core.signals import interpolate
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.datasets.total_capture_files import CAMERA_FILE
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.asf_amc import read_asf_amc
from rtof_kin.formats.bvh import read_bvh
from rtof_kin.formats.c3d import read_c3d
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.formats.opencv_yaml import read_opencv_yaml
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.total_capture import read_cameras
from rtof_kin.formats.trc import read_trc
from rtof_kin.inertial.physics import check_log
from rtof_kin.recording import body_checks as bodies
from rtof_kin.recording.recording import INDEX, Recording
from rtof_kin.simulation.mocap import find_asf
from rtof_kin.simulation.mocap_families import recognise_family, recognise_unit
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.recognise import recognise

Array = NDArray[np.float64]
_NO_POSE = "There is no pose: the camera is taken to be level, at the origin"


@dataclass(frozen=True)
class Inspection:
    """What was found of one file or folder."""

    path: Path
    title: str
    """What it is, in words."""
    contents: tuple[tuple[str, str], ...]
    """What it holds: rows of a name and a value."""
    checks: tuple[Check, ...] = ()
    """Every check that its content allows."""
    notes: tuple[str, ...] = ()
    """What else a user should know, in sentences."""
    log: SensorLog | None = None
    """The sensors, of a file that has some."""
    bone_lengths: Mapping[str, Array] = field(default_factory=dict)
    """Bone -> its length (T,) over the frames, m, of a file that has bodies."""

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that do not hold."""
        return tuple(check for check in self.checks if check.failed)


def inspect(path: str | Path, **declared: Any) -> Inspection:
    """Look at a file, or at a folder that is a recording or the log of a trial.

    Args:
        path: the file or folder.
        declared: of a sensor log, fields of `Declaration` to set otherwise than its format does.

    Raises:
        FileFormatError: no such file, none that is known, or a damaged one.
        ShapeError: something is declared of a file that is no sensor log.
    """
    path = Path(path)
    if not path.exists():
        raise FileFormatError(path, "there is no such file or folder")
    look = _look(path)
    if look is None:
        try:
            return _log(path, read_sensor_log(path, **declared))
        except FileFormatError:
            if path.suffix.lower() != ".csv" or declared:
                raise
            return _keypoints(path)
    if declared:
        raise ShapeError(f"{path}: no sensor log, so {', '.join(declared)} cannot be declared of it")
    return look(path)


def _look(path: Path) -> Callable[[Path], Inspection] | None:
    """How to look at a file that is no sensor log; None where it may be one."""
    if path.is_dir():
        if (path / INDEX).is_file():
            return _recording
        return _keypoints if any(path.glob("*_keypoints.json")) else None
    if path.name == INDEX:
        return lambda index: _recording(index.parent)
    if path.suffix.lower() == ".npz":
        return _motion if {"schema_version", "q"} <= set(npz_names(path)) else _keypoints
    return _BY_SUFFIX.get(path.suffix.lower())


# --- sensors -------------------------------------------------------------------------------------


def _log(path: Path, log: SensorLog) -> Inspection:
    declared = [
        (f"declared {f.name.replace('_', ' ')}", str(getattr(log.declaration, f.name)))
        for f in fields(log.declaration)
        if getattr(log.declaration, f.name) is not None
    ]
    contents = ((f"sensor {s.name}", _stream(s)) for s in log.streams)
    return Inspection(path, log.format, (*contents, *declared), check_log(log), log.notes, log=log)


def _stream(stream: SensorStream) -> str:
    names = {"f_sensor": "acceleration", "w_sensor": "gyroscope", "m_sensor": "magnetometer",
             "R_inertial_sensor": "orientation"}  # fmt: skip
    seconds = float(stream.times[-1] - stream.times[0])
    held = ", ".join(names[name] for name in stream.holds)
    return f"{len(stream)} samples at {stream.rate_hz:.4g} Hz, {seconds:.1f} s: {held}"


def _span(times: Array) -> str:
    seconds = float(times[-1] - times[0])
    rate = f" at {(len(times) - 1) / seconds:.4g} Hz" if seconds > 0 else ""
    return f"{len(times)} samples{rate}, {seconds:.1f} s"


def _imu_log(path: Path, imus: ImuSequence) -> SensorLog:
    streams = [
        SensorStream(name, imus.times, imus.f_sensor[:, i], imus.R_inertial_sensor[:, i])
        for i, name in enumerate(imus.names)
    ]
    return SensorLog(path, "IMUs of a recording", tuple(streams), Declaration())


# --- recordings and motions ----------------------------------------------------------------------


def _recording(path: Path) -> Inspection:
    recording = Recording.load(path)
    keypoints, truth = recording.keypoints, recording.truth
    contents: list[tuple[str, str]] = []
    checks: list[Check] = []
    if keypoints is not None:
        contents += [
            ("keypoints", f"{_span(keypoints.times)}: {len(keypoints.names)} landmarks"),
            ("seen", f"{100 * float(keypoints.seen.mean()):.0f} % of them"),
            ("camera", _camera(keypoints.camera)),
        ]
        checks += bodies.check_camera("of the recording", keypoints.camera)
    lengths: Mapping[str, Array] = {}
    log = None
    if recording.imus is not None:
        contents.append(("IMUs", f"{_span(recording.imus.times)}: {', '.join(recording.imus.names)}"))
        log = _imu_log(path, recording.imus)
        checks += check_log(log)
    if truth is not None:
        contents.append(("truth", f"{_span(truth.times)}: {len(truth.names)} joints"))
        bones = bodies.skeleton_bones(truth.names, recording.skeleton.parents)
        lengths = bodies.bone_lengths(truth.p_world_joint, bones)
        if keypoints is not None:
            at = interpolate(truth.times, truth.p_world_joint, keypoints.times)
            checks.append(bodies.check_reprojection(keypoints, at, truth.names))
        checks += [bodies.check_size(truth.p_world_joint)]
        checks += bodies.check_bone_lengths(lengths, bodies.RIGID_MM)
    return Inspection(path, "recording", tuple(contents), tuple(checks), log=log, bone_lengths=lengths)


def _motion(path: Path) -> Inspection:
    file = read_motion_npz(path)
    poses = file.poses
    skeleton = file.motion().skeleton
    lengths = bodies.bone_lengths(poses.p_world_joint, bodies.skeleton_bones(poses.names, skeleton.parents))
    contents = (
        ("frames", _span(poses.times)),
        ("skeleton", f"{file.skeleton}, {len(poses.names)} joints, {len(file.dof_names)} angles"),
        ("mode", file.mode or "not told"),
        ("valid", f"{100 * float(poses.valid.mean()):.0f} % of the joints"),
    )
    checks = (bodies.check_size(poses.p_world_joint), *bodies.check_bone_lengths(lengths, bodies.RIGID_MM))
    return Inspection(path, "reconstructed motion", contents, checks, bone_lengths=lengths)


def _bvh(path: Path) -> Inspection:
    return _articulated(path, "BVH motion capture", read_bvh(path))


def _amc(path: Path) -> Inspection:
    asf = find_asf(path)
    return _articulated(path, f"AMC motion capture with {asf.name}", read_asf_amc(asf, path))


def _articulated(path: Path, title: str, motion: ArticulatedMotion) -> Inspection:
    """A tree of joints in its own unit, which the length of its legs tells if its names are known."""
    unit_m, notes = motion.unit_m or 1.0, []
    try:
        family = recognise_family(path, motion)
        unit_m = recognise_unit(path, motion, family)
        known = f"known: {family.name}, 1 unit is {unit_m:.4g} m by the length of its legs"
    except FileFormatError as error:
        known = "not known"
        notes.append(f"The skeleton cannot be carried over: {error}")
    p = unit_m * motion.forward_kinematics()[0]
    lengths = bodies.bone_lengths(p, bodies.skeleton_bones(motion.names, motion.parents))
    contents = (
        ("frames", _span(np.arange(len(motion)) / motion.rate_hz)),
        ("joints", f"{len(motion.names)}, root {motion.names[0]}"),
        ("skeleton", known),
    )
    checks = (bodies.check_size(p), *bodies.check_bone_lengths(lengths, bodies.RIGID_MM))
    return Inspection(path, title, contents, checks, tuple(notes), bone_lengths=lengths)


# --- markers, keypoints, cameras -----------------------------------------------------------------


def _trc(path: Path) -> Inspection:
    return _markers(path, "TRC markers", read_trc(path))


def _c3d(path: Path) -> Inspection:
    return _markers(path, "C3D points", read_c3d(path))


def _markers(path: Path, title: str, markers: MarkerSequence) -> Inspection:
    lengths = bodies.bone_lengths(markers.p_world, bodies.limb_bones(markers.names))
    seen = np.isfinite(markers.p_world).all(axis=-1)
    contents = (
        ("frames", _span(markers.times)),
        ("markers", f"{len(markers.names)}: {_listed(markers.names)}"),
        ("seen", f"{100 * float(seen.mean()):.0f} % of them"),
    )
    checks = (bodies.check_size(markers.p_world), *bodies.check_bone_lengths(lengths, bodies.TRIANGULATED_MM))
    notes = () if lengths else ("No two names tell a joint and a side, so no bone can be checked",)
    return Inspection(path, title, contents, checks, notes, bone_lengths=lengths)


def _keypoints(path: Path) -> Inspection:
    found: Detections = read_detector_file(path)
    T, P, K = found.confidence.shape
    confidence = np.median(found.confidence[found.confidence > 0])
    contents = [
        ("frames", str(T) if found.times is None else _span(found.times)),
        ("people", f"up to {P}, somebody in {int(found.present.any(axis=1).sum())} frames"),
        ("points", f"{K}, confidence {confidence:.2f} in the median"),
    ]
    try:
        layout = recognise(found.uv_px, found.confidence, found.names)
        contents.append(("layout", f"{layout.layout.name}; {layout.reason}"))
        notes: tuple[str, ...] = ()
    except InvalidInputError as error:
        notes = (f"The layout is not recognised: {error}",)
    return Inspection(path, "keypoints of a detector", tuple(contents), (), notes)


def _toml(path: Path) -> Inspection:
    return _cameras(path, "cameras in TOML", read_camera_toml(path))


def _yaml(path: Path) -> Inspection:
    title = "cameras in OpenCV's YAML"
    try:
        return _cameras(path, title, read_opencv_yaml(path))
    except FileFormatError:  # perhaps for want of a pose: then the world is the camera's own axes
        found = _cameras(path, title, read_opencv_yaml(path, up="-y"))
        return replace(found, notes=(_NO_POSE,))


def _cal(path: Path) -> Inspection:
    cameras = {str(number): camera for number, camera in read_cameras(path).items()}
    return _cameras(path, f"cameras of Total Capture, as in {CAMERA_FILE}", cameras)


def _cameras(path: Path, title: str, cameras: Mapping[str, Camera]) -> Inspection:
    contents = tuple((f"camera {name}", _camera(camera)) for name, camera in cameras.items())
    checks = [check for name, camera in cameras.items() for check in bodies.check_camera(name, camera)]
    return Inspection(path, title, contents, tuple(checks))


def _camera(camera: Camera) -> str:
    x, y, z = camera.center_world
    return (
        f"{camera.width_px} x {camera.height_px} px, focal length {camera.K[0, 0]:.4g} px, at "
        f"({x:.2f}, {y:.2f}, {z:.2f}) m"
    )


def _listed(names: tuple[str, ...], most: int = 8) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


_BY_SUFFIX: dict[str, Callable[[Path], Inspection]] = {
    ".bvh": _bvh, ".amc": _amc, ".trc": _trc, ".c3d": _c3d, ".toml": _toml, ".yml": _yaml,
    ".yaml": _yaml, ".cal": _cal, ".json": _keypoints, ".npy": _keypoints,
}  # fmt: skip
"""Files whose ending says what they are; their readers make sure. `.csv` may be sensors or keypoints."""
