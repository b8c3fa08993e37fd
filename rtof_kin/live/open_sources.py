"""Sources and sinks by the words of a command line: ``0``, ``walk.mp4``, ``lsl:NAME``."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError, SourceError, UnknownNameError
from rtof_kin.core.files.folder import check_new_file
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS
from rtof_kin.formats.ros_log import PersonLog
from rtof_kin.formats.sensors.sensor_map import read_sensor_map, same_sensor
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.live.lsl import LslFrameSource, LslImuSource, load_pylsl
from rtof_kin.live.replay import RecordingReplay, ReplayClock
from rtof_kin.live.samples import Clock, OnlineEstimate, Sink, Source
from rtof_kin.live.video import VideoSource, is_webcam
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording, RecordingReader
from rtof_kin.robots.retarget import Retargeter
from rtof_kin.vision.keypoint_files import FORMATS
from rtof_kin.vision.person_detector import Detector, choose_detector

CAMERAS: Final = "number of a webcam, VIDEO, a detector's file, lsl:NAME, or the folder of a recording"
"""Words of a camera, for messages."""
SENSORS: Final = "lsl:NAME, a file or folder of sensors, or the folder of a recording"
"""Words of sensors, for messages."""
OUTPUTS: Final = "lsl, lsl:NAME, ws or ws:PORT"  #: Words of outputs, for messages
_LSL, _WS = "lsl", "ws"
_OUTLET: Final = "rtof_kin"
_PORT: Final = 8765  # Of the WebSocket, unless another is given
_SKELETON: Final = "total_capture"


@dataclass(frozen=True)
class Streams:
    """Sources of a session."""

    sources: tuple[Source, ...]  #: The camera first; not started yet
    replay: ReplayClock  #: Clock of those that are replayed
    live: tuple[Source, ...]  #: Those that are not replayed

    @property
    def replayed(self) -> bool:
        """Whether all are replayed, so that they end."""
        return not self.live

    @property
    def in_real_time(self) -> bool:
        """Whether time passes by itself; else by polls of the sources."""
        return self.replay.paced or not self.replayed


def open_sources(
    cameras: Sequence[str],
    sensors: Sequence[str],
    setup: Recording,
    closing: ExitStack,
    *,
    speed: float = 1.0,
    names: str | Path | None = None,
    detector: Callable[[], Detector] = choose_detector,
) -> Streams:
    """Return the sources that words name; nothing is started.

    Replayed streams share a clock. Beside a live stream they are replayed at their own speed, on a clock of their own.

    `cameras`, `sensors`: words of `CAMERAS` and `SENSORS`. `closing`: closes them and the recordings that they read.
    `speed`: of replays, times real time; inf: without pace. `names`: map of sensors, see `names_of_map`; None: they
    have the names of the calibration. `detector`: gives the detector of a webcam's or a video's images.

    Raises:
        SourceError: nothing is named, or twice; more than one camera; no such file; a speed for what is live.
        RtofError: a recording or the map is damaged, or what a source needs is not installed.
    """
    cameras, sensors = ([word.strip() for word in words] for words in (cameras, sensors))
    words = [*cameras, *sensors]
    if not words:
        raise SourceError(f"no stream: give --camera ({CAMERAS}), --imus ({SENSORS}), or both")
    if len(cameras) > 1:
        raise SourceError(f"cameras {', '.join(cameras)}: give one of them")
    if twice := {word for word in sensors if sensors.count(word) > 1}:
        raise SourceError(f"{', '.join(sorted(twice))}: given twice; give each stream once")
    live = any(map(_is_live, words))
    if live and speed != 1.0:
        raise SourceError(f"speed {speed:g}: is for replays; leave it out where a stream is live")
    replay, clock = ReplayClock(speed), Clock.OWN if live else Clock.COMMON  # no stamp of a replay is of now
    renamed = str if names is None else names_of_map(names, setup)
    now: Callable[[], float] = time.monotonic
    if any(map(_is_lsl, words)):
        now = load_pylsl().local_clock
    recording = cache(lambda path: closing.enter_context(RecordingReader.open(path)))
    how: dict[str, Any] = {"replay": replay, "clock": clock}
    sources = [_camera(word, setup, recording, detector, now, **how) for word in cameras]
    for word in sensors:
        path = Path(word)
        if _is_lsl(word):
            sources.append(LslImuSource(_stream(word), renamed=renamed))
        elif not path.exists():
            raise SourceError(f"sensors {word}: there is no such file or folder; give {SENSORS}")
        elif (path / INDEX).is_file():
            sources.append(RecordingReplay.of_recording(recording(path), video=False, renamed=renamed, **how))
        else:
            sources.append(RecordingReplay.of_sensor_file(path, renamed=renamed, **how))
    for source in sources:
        closing.callback(source.close)
    own = tuple(source for word, source in zip(words, sources, strict=True) if _is_live(word))
    return Streams(tuple(sources), replay, own)


def names_of_map(path: str | Path, setup: Recording) -> Callable[[str], str]:
    """Return the name of a sensor in the calibration, by its own; those that a map does not name keep theirs.

    `path`: two columns, the stream's sensor (serial number, its last characters, or name), and its segment or its name
    in the calibration.

    Raises:
        FileFormatError: no such map. CalibrationError: the setup has no calibration.
        UnknownNameError: a segment without a sensor.
    """
    if setup.calibration is None:
        raise CalibrationError(f"map {path}: the setup {setup.name} has no sensors that it could name")
    sensors = setup.calibration.sensors
    worn = dict(zip(setup.calibration.joints, sensors, strict=True))
    names: dict[str, str] = {}
    for key, place in read_sensor_map(path).items():
        joint = "" if place in sensors else known_segment(place, setup.skeleton, path)
        if joint and joint not in worn:
            raise UnknownNameError(f"segment in {path} (no sensor of the setup is on it)", [place], sensors)
        names[key] = worn[joint] if joint else place
    return lambda sensor: next((name for key, name in names.items() if same_sensor(key, sensor)), sensor)


def open_sinks(words: Sequence[str], setup: Recording) -> list[Sink]:
    """Return the outputs that words name. `words`: of `OUTPUTS`. `SourceError`: another word, twice the same, or a port
    that is taken. `RtofError`: what an output needs is not installed.
    """
    if twice := {word for word in words if list(words).count(word) > 1}:
        raise SourceError(f"--send {', '.join(sorted(twice))}: given twice; give each output once")
    return [_sink(word, setup) for word in words]


def _is_lsl(word: str) -> bool:
    return word.lower().startswith(f"{_LSL}:")


def _is_live(word: str) -> bool:
    return _is_lsl(word) or word.isdecimal() or is_webcam(word)


def _camera(
    word: str,
    setup: Recording,
    recording: Callable[[Path], RecordingReader],
    detector: Callable[[], Detector],
    now: Callable[[], float],
    **how: Any,
) -> Source:
    """Return the source of a camera's points. `recording`: opens one. `how`: its replays' clocks."""
    if setup.keypoints is None:
        raise SourceError(
            f"camera {word}: the setup {setup.name} has no camera; make one with it: rtof-kin run "
            "VIDEO --only recording"
        )
    camera, path = setup.keypoints.camera, Path(word)
    size = camera.width_px, camera.height_px
    if _is_lsl(word):
        return LslFrameSource(_stream(word))
    if not _is_live(word) and path.is_dir():
        if not (path / INDEX).is_file():
            raise SourceError(f"camera {word}: a folder without {INDEX}; give {CAMERAS}")
        replayed = recording(path)
        own = camera if (video := replayed.facts.keypoints) is None else video.camera
        if (own.width_px, own.height_px) != size:
            raise SourceError(
                f"camera {word}: its images have {own.width_px} x {own.height_px} px, those of the setup "
                f"{setup.name} {size[0]} x {size[1]} px; take a setup of this camera"
            )
        return RecordingReplay.of_recording(replayed, sensors=False, **how)
    if not _is_live(word) and not path.is_file():
        raise SourceError(f"camera {word}: there is no such file or folder; give {CAMERAS}")
    if not _is_live(word) and path.suffix.lower() in FORMATS:
        return RecordingReplay.of_keypoint_file(path, camera, **how)
    if setup.skeleton_table != _SKELETON:
        raise SourceError(
            f"camera {word}: what a detector sees is for the skeleton {_SKELETON}; the setup {setup.name} "
            f"has {setup.skeleton_table}"
        )
    if _is_live(word):
        how["clock"] = Clock.COMMON
    device = int(word) if word.isdecimal() else word if _is_live(word) else path
    return VideoSource(device, detector, camera_px=size, now=now, **how)


def _stream(word: str) -> str:
    name = word.partition(":")[2].strip()
    if not name:
        raise SourceError(f"{word}: names no stream; give lsl:NAME")
    return name


def _sink(word: str, setup: Recording) -> Sink:
    kind, _, rest = word.strip().partition(":")
    if kind.lower() == _LSL:
        return LslOutlet(rest.strip() or _OUTLET, setup.skeleton)
    if kind.lower() == _WS and (not rest or rest.isdecimal()):
        from rtof_kin.live.websocket_server import WebSocketServer

        port = int(rest) if rest else _PORT
        return WebSocketServer(setup.skeleton, port, floor_height=setup.floor_height)
    raise SourceError(f"--send {word}: there is no such output; give {OUTPUTS}")


_BUFFER_S: Final = 60  # What a listener that has fallen behind is kept, s; LSL drops older samples
_APART_S: Final = 5.0  # Age of the newest sample above which the clock of the poses is taken to be another than LSL's
_FLUSH_S: Final = 2.0  # Time after which estimates are in an MCAP file
_IRREGULAR: Final = 0.0  # No nominal rate, so that receivers do not space the frames equally over a gap


class LslOutlet:
    """Sends every estimate as one sample, see `channels`, stamped with the time of its pose.

    A receiver sees the lag as the age of a sample. Where poses are on another clock than LSL's, as in a replay, stamps
    are shifted so that the newest sample of the sensors is of now. Messages are a stream of text, NAME_messages.
    """

    def __init__(self, name: str, skeleton: SkeletonModel):
        """Open both streams. `SourceError`: pylsl is not installed."""
        self._pylsl = load_pylsl()
        self._skeleton = skeleton
        self._name = name
        self._robot: Any = None
        self._shift_s: float | None = None
        host = f"rtof-kin:{name}@{socket.gethostname()}"
        rows = list(channels(skeleton))
        info = self._pylsl.StreamInfo(name, "MoCap", len(rows), _IRREGULAR, "float32", host)
        _describe(info, rows)
        facts = info.desc().append_child("skeleton")
        facts.append_child_value("name", skeleton.name)
        facts.append_child_value("frame", "world: z up, metres; base: root link in world")
        facts.append_child_value("urdf", skeleton.to_urdf())
        self._outlet: Any = self._pylsl.StreamOutlet(info, max_buffered=_BUFFER_S)
        text = self._pylsl.StreamInfo(f"{name}_messages", "Markers", 1, _IRREGULAR, "string", f"{host}:messages")
        self._messages: Any = self._pylsl.StreamOutlet(text)

    def send(self, estimate: OnlineEstimate) -> None:
        """Send an estimate; a listener is not waited for. `UnknownNameError`, `InvalidInputError`: its joints are not
        those of the skeleton.
        """
        if self._outlet is None:
            return
        poses = estimate.poses[-1:]
        self._skeleton.check_joints(poses.names)
        q = self._skeleton.inverse_kinematics(poses.p_world_joint, poses.R_world_bone)
        angles = self._skeleton.angles(q)[0]
        sample = np.concatenate([q[0, :7], angles, poses.valid[0], [estimate.lag_s, estimate.seconds]])
        time = float(poses.times[0])
        if self._shift_s is None:
            self._shift_s = self._to_lsl_clock(time + estimate.lag_s)
        self._outlet.push_sample(sample.astype(np.float32), time + self._shift_s)

    def _to_lsl_clock(self, newest: float) -> float:
        """Return what poses' times lack to the LSL clock, s; 0 where they are on it."""
        apart = float(self._pylsl.local_clock()) - newest
        if abs(apart) < _APART_S:
            return 0.0
        self.tell(f"poses are on another clock than LSL's; stamps are their times {apart:+.3f} s")
        return apart

    def send_robot(self, time: float, joints: Sequence[str], root: str, q: Array) -> None:
        """Send base position, m, quaternion x y z w and angles, rad, of a robot as a stream NAME_robot; time: s."""
        if self._robot is None:
            name, kinds = f"{self._name}_robot", ["meters"] * 3 + ["quaternion"] * 4 + ["radians"] * len(joints)
            info = self._pylsl.StreamInfo(name, "MoCap", len(q), _IRREGULAR, "float32", f"{name}:{root}")
            labels = (*BASE_COLUMNS, *joints)
            _describe(info, [{"label": n, "unit": unit} for n, unit in zip(labels, kinds, strict=True)])
            self._robot = self._pylsl.StreamOutlet(info, max_buffered=_BUFFER_S)
        self._robot.push_sample(q.astype(np.float32), time + (self._shift_s or 0.0))

    def tell(self, sentence: str) -> None:
        """Send a message about the streams."""
        if self._messages is not None:
            self._messages.push_sample([sentence])

    def close(self) -> None:
        """Close both streams; may be called twice."""
        self._outlet = self._messages = self._robot = None


def _describe(info: Any, rows: Sequence[Mapping[str, str]]) -> None:
    """Write the metadata of the channels of a stream."""
    described = info.desc().append_child("channels")
    for row in rows:
        channel = described.append_child("channel")
        for field, text in row.items():
            channel.append_child_value(field, text)


class RobotSink:
    """Puts every estimate on a robot and sends its configuration to outputs of the session, which come first."""

    def __init__(self, robot: Retargeter, outputs: Sequence[Sink]):
        """Take the outputs that can send a robot's configuration; `SourceError` where none can."""
        self._robot, self._outputs = robot, [one for one in outputs if hasattr(one, "send_robot")]
        if not self._outputs:
            raise SourceError(f"--robot: nobody would get its joints; give --send {OUTPUTS}, or --browser")

    def send(self, estimate: OnlineEstimate) -> None:
        """Retarget an estimate and send it."""
        q = self._robot.follow(estimate.poses, estimate.confidence)[-1]
        for output in self._outputs:
            output.send_robot(float(estimate.poses.times[-1]), self._robot.joints, self._robot.root, q)

    def tell(self, sentence: str) -> None:
        """Do nothing."""

    def close(self) -> None:
        """End the stances of the feet."""
        self._robot.finish()


class McapSink(PersonLog):
    """Writes estimates into an MCAP file as they come; a session that is killed loses two seconds of it."""

    def __init__(self, path: Path, skeleton: SkeletonModel):
        """Open a file that must not exist, else `OutputExistsError`; `RtofError`: the extra is not installed."""
        check_new_file(path, overwrite=False)
        make_folders(path.parent)
        super().__init__(path, skeleton)
        self._say, self._time, self._flushed = self.topic("/messages", "std_msgs/msg/String"), 0.0, 0.0

    def send(self, estimate: OnlineEstimate) -> None:
        """Write an estimate; errors as those of `LslOutlet.send`."""
        motion = self._skeleton.motion(estimate.poses[-1:], estimate.confidence)
        angles = self._skeleton.angles(motion.q)
        self.write_motion(replace(motion, q=np.concatenate([motion.q[:, :7], angles], axis=1)))
        self._time = float(motion.times[-1])
        if abs(self._time - self._flushed) > _FLUSH_S:
            self._mcap.flush()
            self._flushed = self._time

    def tell(self, sentence: str) -> None:
        """Write a message about the streams."""
        self._say(self._time, data=sentence)


def channels(skeleton: SkeletonModel) -> Iterator[dict[str, str]]:
    """Yield the metadata of every channel, in order.

    Pose of the root link in world (m, quaternion x y z w); an angle of each revolute of the URDF, rad, on the turn
    nearest to the middle of its limits, with its clinical and OpenSim names (a leading '-': of opposite sign); for
    each joint 1 where its position is reliable; lag and time of the estimate, s. What is unknown is NaN.
    """
    for label in BASE_COLUMNS:
        axis = label[-1].upper()
        kind, unit = ("Orientation", "quaternion") if "_q" in label else ("Position", "meters")
        yield {"label": label, "unit": unit, "type": kind + axis}
    dofs = {dof.urdf: dof for joint in skeleton.table.joints for dof in joint.dofs}
    for name, (low, high) in zip(skeleton.dof_names, skeleton.limits.tolist(), strict=True):
        yield {
            "label": name,
            "unit": "radians",
            "type": "Angle",
            "clinical": dofs[name].clinical,
            "opensim": dofs[name].opensim,
            "lower_limit": f"{low:.6g}",
            "upper_limit": f"{high:.6g}",
        }
    for name in skeleton.names:
        yield {"label": f"{name}_valid", "unit": "boolean", "type": "Validity"}
    for name in ("lag", "frame_time"):
        yield {"label": name, "unit": "seconds", "type": "Duration"}
