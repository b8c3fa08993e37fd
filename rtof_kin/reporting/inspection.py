"""Inspection of input files: type, contents and plausibility checks of every file that the package reads.

Sensor logs are checked by `rtof_kin.inertial.physics`, bodies and cameras by
`rtof_kin.recording.body_checks`. Nothing is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.body.motion_file import MotionReader, motion_path
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.arrays import npz_names
from rtof_kin.core.over_time import Stream
from rtof_kin.core.signals import interpolate, runs
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.total_capture_files import CAMERA_FILE
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.formats.asf_amc import read_asf_amc
from rtof_kin.formats.bvh import read_bvh
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.formats.cameras import read_opencv_yaml
from rtof_kin.formats.markers import MarkerSequence, read_c3d, read_trc
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.total_capture import read_cameras
from rtof_kin.inertial.laws import at_rest, rates_of_orientation
from rtof_kin.inertial.physics import SIGNALS, check_log
from rtof_kin.recording import body_checks as bodies
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import RecordingReader
from rtof_kin.reporting.document import ESTIMATE, TRUTH, subplots
from rtof_kin.simulation.mocap import find_asf
from rtof_kin.simulation.mocap_families import recognise_family, recognise_unit
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.landmark_regression import recognise

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

Bones = Mapping[str, tuple[int, int]]
_LONGEST_GAP: Final = 1.0  # [s] of the truth that is interpolated


@dataclass(frozen=True)
class Inspection:
    """Type, contents and checks of one file or folder."""

    path: Path
    title: str
    contents: tuple[tuple[str, str], ...]  #: Rows of a name and a value
    checks: tuple[Check, ...] = ()
    notes: tuple[str, ...] = ()
    log: SensorLog | None = None
    bone_lengths: Mapping[str, Array] = field(default_factory=dict)
    """Bone -> its length (T,) over the frames, m, if the file contains bodies."""

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that fail."""
        return tuple(check for check in self.checks if check.failed)


def inspect(path: str | Path, **declared: Any) -> Inspection:
    """Inspect a file, or a folder with a recording or the sensor log of a trial. `FileFormatError`: the file is
    missing, of an unknown type, or damaged; `InvalidInputError`: something is declared of a file that is not a sensor
    log.

    Args:
        declared: of a sensor log, fields of `Declaration` to override.
    """
    path = Path(path)
    if not path.exists():
        raise FileFormatError(path, "there is no such file or folder")
    inspector = _inspector(path)
    if inspector is None:
        try:
            return _log(path, read_sensor_log(path, **declared))
        except FileFormatError:
            if path.suffix.lower() != ".csv" or declared:
                raise
            inspector = _keypoints
    if declared:
        raise InvalidInputError(f"{path}: no sensor log, so {', '.join(declared)} cannot be declared of it")
    return inspector(path)


def _inspector(path: Path) -> Callable[[Path], Inspection] | None:
    """Function for the type of a file; None if it may be a sensor log."""
    if path.name == INDEX or (path / INDEX).is_file():
        return _recording
    if path.is_dir():
        with suppress(FileFormatError):
            motion_path(path)
            return _motion
        return _keypoints if any(path.glob("*_keypoints.json")) else None
    if path.suffix.lower() == ".h5":
        return _motion
    if path.suffix.lower() == ".npz":
        return _motion if {"schema_version", "q"} <= set(npz_names(path)) else _keypoints
    return _BY_SUFFIX.get(path.suffix.lower())


def _log(path: Path, log: SensorLog) -> Inspection:
    declared = ((f.name, getattr(log.declaration, f.name)) for f in fields(log.declaration))
    contents = (
        *((f"sensor {stream.name}", _stream(stream)) for stream in log.streams),
        *((f"declared {name.replace('_', ' ')}", str(v)) for name, v in declared if v is not None),
    )
    return Inspection(path, log.format, contents, check_log(log), log.notes, log=log)


def _stream(stream: SensorStream) -> str:
    seconds = float(stream.times[-1] - stream.times[0])
    signals = ", ".join(SIGNALS[name] for name in stream.holds)
    return f"{len(stream)} samples at {stream.rate_hz:.4g} Hz, {seconds:.1f} s: {signals}"


def _span(times: Array) -> str:
    seconds = float(times[-1] - times[0])
    rate = f" at {(len(times) - 1) / seconds:.4g} Hz" if seconds > 0 else ""
    return f"{len(times)} samples{rate}, {seconds:.1f} s"


def _percent(seen: Mask) -> str:
    return f"{100 * float(seen.mean()):.0f} %"


def _with_body(
    found: Inspection, parts: Iterable[Array], bones: Bones, limit_mm: float = bodies.RIGID_MM
) -> Inspection:
    """Add the checks of a body with joints or markers, by parts (n, J, 3)."""
    each = [(bodies.bone_lengths(p, bones), bodies.box_sizes(p)) for p in parts]
    lengths = {bone: np.concatenate([own[bone] for own, _ in each]) for bone in bones}
    sizes = np.concatenate([own for _, own in each])
    checks = (*found.checks, bodies.check_size(sizes), *bodies.check_bone_lengths(lengths, limit_mm))
    return replace(found, checks=checks, bone_lengths=lengths)


def _recording(path: Path) -> Inspection:
    path = path.parent if path.name == INDEX and path.is_file() else path
    contents: list[tuple[str, str]] = []
    checks: list[Check] = []
    log: SensorLog | None = None
    body = Inspection(path, "recording", ())
    with RecordingReader.open(path) as reader:
        streams, skeleton = reader.streams, reader.facts.skeleton
        if streams.keypoints is not None:
            camera, seen = reader.facts.video.camera, [block.seen for block in streams.keypoints.blocks()]
            contents += [
                ("keypoints", f"{_span(streams.keypoints.times)}: {seen[0].shape[1]} landmarks"),
                ("seen", f"{_percent(np.concatenate(seen))} of them"),
                ("camera", _camera(camera)),
            ]
            checks += bodies.check_camera("of the recording", camera)
        if streams.truth is not None:
            if streams.keypoints is not None:
                pairs = _with_truth(streams.keypoints, streams.truth)
                body = replace(body, checks=(bodies.check_reprojection(pairs, skeleton.names),))
            parts = (block.p_world_joint for block in streams.truth.blocks())
            body = _with_body(body, parts, bodies.skeleton_bones(skeleton.names, skeleton.parents))
        if streams.imus is not None:
            log = SensorLog.of_imus(streams.imus, path)
            contents.append(("IMUs", f"{_span(streams.imus.times)}: {', '.join(log.names)}"))
            checks += check_log(log)
        if streams.truth is not None:
            contents.append(("truth", f"{_span(streams.truth.times)}: {len(skeleton.names)} joints"))
    return replace(body, contents=tuple(contents), checks=(*checks, *body.checks), log=log)


def _with_truth(
    keypoints: Stream[KeypointSequence], truth: Stream[PoseSequence]
) -> Iterator[tuple[KeypointSequence, Array]]:
    """Yield the keypoints by blocks with the true positions (n, J, 3), m, then, NaN in longer gaps."""
    for block in keypoints.blocks():
        near = truth.between(block.times[0] - _LONGEST_GAP, block.times[-1] + _LONGEST_GAP)
        if near is not None:
            yield block, interpolate(near.times, near.p_world_joint, block.times, _LONGEST_GAP)


def _motion(path: Path) -> Inspection:
    found = Inspection(path, "reconstructed motion", ())
    with MotionReader(path) as file:
        skeleton, mode = file.skeleton, file.mode
        parts = (block.motion.poses.p_world_joint for block in file.blocks())
        found = _with_body(found, parts, bodies.skeleton_bones(skeleton.names, skeleton.parents))
        valid = file.masks.valid
    contents = (
        ("frames", _span(file.times)),
        ("skeleton", f"{skeleton.name}, {len(skeleton.names)} joints, {len(skeleton.dof_names)} angles"),
        ("mode", mode or "not stated"),
        ("valid", f"{_percent(valid)} of the joints"),
    )
    return replace(found, contents=contents)


def _articulated(path: Path, title: str, motion: ArticulatedMotion) -> Inspection:
    """Inspect motion capture, whose unit follows from the length of the legs if the joint names are known."""
    unit_m, notes = motion.unit_m or 1.0, []
    try:
        family = recognise_family(path, motion)
        unit_m = recognise_unit(path, motion, family)
        known = f"known: {family.name}, 1 unit is {unit_m:.4g} m by the length of its legs"
    except FileFormatError as error:
        known = "not known"
        notes.append(f"The skeleton cannot be converted: {error}")
    p = unit_m * motion.forward_kinematics()[0]
    contents = (
        ("frames", _span(np.arange(len(motion)) / motion.rate_hz)),
        ("joints", f"{len(motion.names)}, root {motion.names[0]}"),
        ("skeleton", known),
    )
    bones = bodies.skeleton_bones(motion.names, motion.parents)
    return _with_body(Inspection(path, title, contents, notes=tuple(notes)), [p], bones)


def _markers(path: Path, title: str, markers: MarkerSequence) -> Inspection:
    bones = bodies.limb_bones(markers.names)
    names = ", ".join(markers.names[:8]) + (", ..." if len(markers.names) > 8 else "")
    seen = np.asarray(np.isfinite(markers.p_world).all(axis=-1))
    contents = (
        ("frames", _span(markers.times)),
        ("markers", f"{len(markers.names)}: {names}"),
        ("seen", f"{_percent(seen)} of them"),
    )
    notes = () if bones else ("No two names give a joint and a side, so no bone can be checked",)
    found = Inspection(path, title, contents, notes=notes)
    return _with_body(found, [markers.p_world], bones, bodies.TRIANGULATED_MM)


def _keypoints(path: Path) -> Inspection:
    found = read_detector_file(path)
    T, P, K = found.confidence.shape
    confidence = np.median(found.confidence[found.confidence > 0])
    contents = [
        ("frames", str(T) if found.times is None else _span(found.times)),
        ("people", f"up to {P}, at least one in {int(found.present.any(axis=1).sum())} frames"),
        ("points", f"{K}, median confidence {confidence:.2f}"),
    ]
    notes = []
    try:
        layout = recognise(found.uv_px, found.confidence, found.names)
        contents.append(("layout", f"{layout.layout.name}; {layout.reason}"))
    except InvalidInputError as error:
        notes.append(f"The layout is not recognised: {error}")
    return Inspection(path, "keypoints of a detector", tuple(contents), notes=tuple(notes))


def _yaml(path: Path) -> Inspection:
    title = "cameras in OpenCV's YAML"
    try:
        return _cameras(path, title, read_opencv_yaml(path))
    except FileFormatError:  # without a pose, the world has the axes of the camera
        found = _cameras(path, title, read_opencv_yaml(path, up="-y"))
        return replace(found, notes=("There is no pose: the camera is assumed to be level, at the origin",))


def _cameras(path: Path, title: str, cameras: Mapping[Any, Camera]) -> Inspection:
    contents = tuple((f"camera {name}", _camera(camera)) for name, camera in cameras.items())
    checks = [check for name, camera in cameras.items() for check in bodies.check_camera(str(name), camera)]
    return Inspection(path, title, contents, tuple(checks))


def _camera(camera: Camera) -> str:
    x, y, z = camera.center_world
    return (
        f"{camera.width_px} x {camera.height_px} px, focal length {camera.K[0, 0]:.4g} px, at "
        f"({x:.2f}, {y:.2f}, {z:.2f}) m"
    )


_BY_SUFFIX: Final[dict[str, Callable[[Path], Inspection]]] = {
    ".bvh": lambda path: _articulated(path, "BVH motion capture", read_bvh(path)),
    ".amc": lambda path: _articulated(
        path, f"AMC motion capture with {(asf := find_asf(path)).name}", read_asf_amc(asf, path)
    ),
    ".trc": lambda path: _markers(path, "TRC markers", read_trc(path)),
    ".c3d": lambda path: _markers(path, "C3D points", read_c3d(path)),
    ".toml": lambda path: _cameras(path, "cameras in TOML", read_camera_toml(path)),
    ".yml": _yaml,
    ".yaml": _yaml,
    ".cal": lambda path: _cameras(path, f"cameras of Total Capture, as in {CAMERA_FILE}", read_cameras(path)),
    ".json": _keypoints,
    ".npy": _keypoints,
}
"""By suffix; `.csv` may contain sensor data or keypoints."""


MOST: Final = 4  #: Largest number of sensors or bones that are plotted; those furthest beyond a limit come first


def picture(inspection: Inspection) -> Plot | None:
    """Plot the sensors or the bone lengths of a file; None if it has neither."""
    excess = {check.subject: 0.0 for check in inspection.checks}
    for check in inspection.failed:
        excess[check.subject] = max(excess[check.subject], check.value / check.limit)
    names = inspection.log.names if inspection.log is not None else inspection.bone_lengths
    worst = sorted(names, key=lambda name: -excess.get(name, 0.0))[:MOST]
    if inspection.log is not None:
        figure = _sensors(inspection.log.select(worst).streams)
    elif worst:
        figure = _bones({name: inspection.bone_lengths[name] for name in worst})
    else:
        return None
    count = len(inspection.failed)
    verdict = f"{count} of {len(inspection.checks)} checks fail" if count else "all checks pass"
    figure.suptitle(f"{inspection.path.name}: {inspection.title}; {verdict}")
    return figure


def _sensors(streams: tuple[SensorStream, ...]) -> Plot:
    """Specific force with intervals at rest in grey, angular speed of gyroscope and orientation, steps of the times."""
    figure, axes = subplots(3, len(streams), (max(4.5 * len(streams), 7), 8), sharex="col")
    for (force, turn, step), stream in zip(axes.T, streams, strict=True):
        force.set_title(stream.name)
        force.set_ylabel("specific force [m/s2]")
        if stream.f_sensor is not None:
            for start, stop in runs(at_rest(stream)):
                force.axvspan(stream.times[start], stream.times[stop - 1], color="0.85", zorder=0)
            size = np.linalg.norm(stream.f_sensor, axis=-1)
            force.plot(stream.times, size, color=ESTIMATE, lw=0.8, label="measured (grey: at rest)")
            force.axhline(STANDARD_GRAVITY, color=TRUTH, lw=1, label="9.81")
        turn.set_ylabel("angular velocity [deg/s]")
        if stream.R_inertial_sensor is not None:
            times, w = rates_of_orientation(stream)
            speed = np.degrees(np.linalg.norm(w, axis=-1))
            turn.plot(times, speed, color=TRUTH, lw=1.2, label="of the orientation")
        if stream.w_sensor is not None:
            speed = np.degrees(np.linalg.norm(stream.w_sensor, axis=-1))
            turn.plot(stream.times, speed, color=ESTIMATE, lw=0.8, label="gyroscope")
        for ax, missing in ((force, "no accelerations"), (turn, "neither gyroscope nor orientation")):
            if ax.lines:
                ax.legend(loc="upper right", fontsize=8)
            else:
                ax.text(0.5, 0.5, missing, ha="center", va="center", transform=ax.transAxes, color="0.4")
        steps_ms = 1000 * np.diff(stream.times)
        step.plot(stream.times[1:], steps_ms, ".", color=ESTIMATE, ms=3)
        step.set_ylim(0, 1.2 * float(steps_ms.max(initial=1.0)))
        step.set_ylabel("step of time stamps [ms]")
        step.set_xlabel("time [s]")
        for ax in (force, turn, step):
            ax.grid(alpha=0.3)
    return figure


def _bones(lengths: dict[str, Array]) -> Plot:
    figure, ((ax,),) = subplots(1, 1, (9, 4.5))
    for name, length in lengths.items():
        ax.plot(1000 * length, lw=1, label=f"{name}: spread {1000 * np.nanstd(length):.1f} mm")
    ax.set_xlabel("frame")
    ax.set_ylabel("length of the bone [mm]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    return figure
