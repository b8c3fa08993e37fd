"""Sources and sinks by the words of a command line: ``0``, ``walk.mp4``, ``lsl:NAME``."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

from rtof_kin.core.errors import CalibrationError, SourceError, UnknownNameError
from rtof_kin.formats.sensors.sensor_map import read_sensor_map, same_sensor
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.live.replay import RecordingReplay, ReplayClock
from rtof_kin.live.samples import Clock, ImuSample, Sample, Sink, Source
from rtof_kin.live.video import VideoSource, is_webcam
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.keypoint_files import FORMATS
from rtof_kin.vision.person_detector import PersonDetector, choose_detector

CAMERAS: Final = "number of a webcam, VIDEO, a detector's file, lsl:NAME, or the folder of a recording"
"""Words of a camera, for messages."""
SENSORS: Final = "lsl:NAME, a file or folder of sensors, or the folder of a recording"
"""Words of sensors, for messages."""
OUTPUTS: Final = "lsl, lsl:NAME, ws or ws:PORT"  #: Words of outputs, for messages
_LSL, _WS = "lsl", "ws"
_OUTLET: Final = "rtof_kin"
_PORT: Final = 8765  # Of the WebSocket, unless another is given
_SKELETON: Final = "total_capture"


class RenamedSensors:
    """A source with other names of its sensors; those that a map does not name keep theirs.

    `names`: in the calibration, by serial number, its last characters, or name.
    """

    def __init__(self, source: Source, names: Mapping[str, str]):
        self._source, self._names = source, dict(names)
        self._known: dict[str, str] = {}
        self.name, self.clock = source.name, source.clock
        self.start, self.notices, self.close = source.start, source.notices, source.close

    @classmethod
    def of_file(cls, source: Source, path: str | Path, setup: Recording) -> Self:
        """Rename by a map of sensors.

        `path`: two columns, the stream's sensor, and its segment or its name in the calibration.

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
            if place in sensors:
                names[key] = place
                continue
            joint = known_segment(place, setup.skeleton, path)
            if joint not in worn:
                where = f"segment in {path} (no sensor of the setup is on it)"
                raise UnknownNameError(where, [place], sensors)
            names[key] = worn[joint]
        return cls(source, names)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors seen so far, as in the calibration."""
        return tuple(map(self._renamed, self._source.sensors))

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the points of a frame."""
        return self._source.landmarks

    @property
    def finished(self) -> bool:
        """Whether no further sample will come."""
        return self._source.finished

    def poll(self) -> list[Sample]:
        """Return what has arrived since the last call, renamed."""
        return [
            replace(sample, sensor=self._renamed(sample.sensor)) if isinstance(sample, ImuSample) else sample
            for sample in self._source.poll()
        ]

    def _renamed(self, sensor: str) -> str:
        if sensor not in self._known:
            fits = (name for key, name in self._names.items() if same_sensor(key, sensor))
            self._known[sensor] = next(fits, sensor)
        return self._known[sensor]


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


@dataclass
class _Opening:
    """What the words of one command line share."""

    setup: Recording
    replay: ReplayClock
    live: bool
    now: Callable[[], float]
    detector: Callable[[], PersonDetector]
    recordings: dict[Path, Recording] = field(default_factory=dict)

    @property
    def clock(self) -> Clock:
        """Clock of replays: none of its stamps are of now where something is live."""
        return Clock.OWN if self.live else Clock.COMMON

    def recording(self, folder: Path) -> Recording:
        path = folder.resolve()
        if path not in self.recordings:
            self.recordings[path] = Recording.load(folder)
        return self.recordings[path]


def open_sources(
    cameras: Sequence[str],
    sensors: Sequence[str],
    setup: Recording,
    *,
    speed: float = 1.0,
    names: str | Path | None = None,
    detector: Callable[[], PersonDetector] = choose_detector,
) -> Streams:
    """Return the sources that words name; nothing is started.

    Replayed streams share a clock. Beside a live stream they are replayed at their own speed, on a clock of their own.

    `cameras`, `sensors`: words of `CAMERAS` and `SENSORS`. `speed`: of replays, times real time; inf: without pace.
    `names`: map of sensors, see `RenamedSensors`; None: they have the names of the calibration. `detector`: gives the
    detector of a webcam's or a video's images.

    Raises:
        SourceError: nothing is named, or twice; more than one camera; no such file; a speed for what is live.
        RtofError: a recording or the map is damaged, or what a source needs is not installed.
    """
    words = [word.strip() for word in (*cameras, *sensors)]
    if not words:
        raise SourceError(f"no stream: give --camera ({CAMERAS}), --imus ({SENSORS}), or both")
    if old := [word for word in words if word.lower().startswith("udp:")]:
        raise SourceError(f"{old[0]}: UDP is no longer read; send it to an LSL stream and give lsl:NAME")
    if len(cameras) > 1:
        raise SourceError(f"cameras {', '.join(cameras)}: give one of them")
    for same in (cameras, sensors):
        if twice := {word for word in same if list(same).count(word) > 1}:
            raise SourceError(f"{', '.join(sorted(twice))}: given twice; give each stream once")
    live = any(_is_live(word) for word in words)
    if live and speed != 1.0:
        raise SourceError(f"speed {speed:g}: is for replays; leave it out where a stream is live")
    now: Callable[[], float] = time.monotonic
    if any(map(_is_lsl, words)):
        from rtof_kin.live.lsl import load_pylsl

        now = load_pylsl().local_clock
    opening = _Opening(setup, ReplayClock(speed), live, now, detector)
    found = [(word, _camera(word, opening)) for word in cameras]
    found += [(word, _sensors(word, opening)) for word in sensors]
    sources = tuple(source for _, source in found)
    if names is not None:
        sources = tuple(
            source if isinstance(source, VideoSource) else RenamedSensors.of_file(source, names, setup)
            for source in sources
        )
    own = tuple(source for (word, _), source in zip(found, sources, strict=True) if _is_live(word))
    return Streams(sources, opening.replay, own)


def open_sinks(words: Sequence[str], setup: Recording) -> list[Sink]:
    """Return the outputs that words name. `words`: of `OUTPUTS`.

    Raises:
        SourceError: another word, twice the same, or a port that is taken.
        RtofError: what an output needs is not installed.
    """
    if twice := {word for word in words if list(words).count(word) > 1}:
        raise SourceError(f"--send {', '.join(sorted(twice))}: given twice; give each output once")
    return [_sink(word, setup) for word in words]


def _is_lsl(word: str) -> bool:
    return word.strip().lower().startswith(f"{_LSL}:")


def _is_live(word: str) -> bool:
    return _is_lsl(word) or word.strip().isdecimal() or is_webcam(word.strip())


def _camera(word: str, opening: _Opening) -> Source:
    setup = opening.setup
    if setup.keypoints is None:
        raise SourceError(
            f"camera {word}: the setup {setup.name} has no camera; make one with it: rtof-kin run "
            "VIDEO --only recording"
        )
    word = word.strip()
    camera = setup.keypoints.camera
    if _is_lsl(word):
        from rtof_kin.live.lsl import LslFrameSource

        return LslFrameSource(_stream(word))
    path = Path(word)
    webcam = _is_live(word)
    if not webcam and path.is_dir():
        if not (path / INDEX).is_file():
            raise SourceError(f"camera {word}: a folder without {INDEX}; give {CAMERAS}")
        recording = opening.recording(path)
        own = recording.keypoints.camera if recording.keypoints is not None else camera
        if (own.width_px, own.height_px) != (camera.width_px, camera.height_px):
            raise SourceError(
                f"camera {word}: its images have {own.width_px} x {own.height_px} px, those of the setup "
                f"{setup.name} {camera.width_px} x {camera.height_px} px; take a setup of this camera"
            )
        return RecordingReplay.of_recording(recording, opening.replay, sensors=False, clock=opening.clock)
    if not webcam and not path.is_file():
        raise SourceError(f"camera {word}: there is no such file or folder; give {CAMERAS}")
    if not webcam and path.suffix.lower() in FORMATS:
        return RecordingReplay.of_keypoint_file(path, camera, opening.replay, clock=opening.clock)
    if setup.skeleton_table != _SKELETON:
        raise SourceError(
            f"camera {word}: what a detector sees is for the skeleton {_SKELETON}; the setup {setup.name} "
            f"has {setup.skeleton_table}"
        )
    return VideoSource(
        int(word) if word.isdecimal() else path if not webcam else word,
        opening.detector,
        camera_px=(camera.width_px, camera.height_px),
        replay=opening.replay,
        clock=Clock.COMMON if webcam else opening.clock,
        now=opening.now,
    )


def _sensors(word: str, opening: _Opening) -> Source:
    word = word.strip()
    if _is_lsl(word):
        from rtof_kin.live.lsl import LslImuSource

        return LslImuSource(_stream(word))
    path = Path(word)
    if not path.exists():
        raise SourceError(f"sensors {word}: there is no such file or folder; give {SENSORS}")
    if (path / INDEX).is_file():
        return RecordingReplay.of_recording(opening.recording(path), opening.replay, video=False, clock=opening.clock)
    return RecordingReplay.of_sensor_file(path, opening.replay, clock=opening.clock)


def _stream(word: str) -> str:
    name = word.partition(":")[2].strip()
    if not name:
        raise SourceError(f"{word}: names no stream; give lsl:NAME")
    return name


def _sink(word: str, setup: Recording) -> Sink:
    kind, _, rest = word.strip().partition(":")
    if kind.lower() == _LSL:
        from rtof_kin.live.lsl_outlet import LslOutlet

        return LslOutlet(rest.strip() or _OUTLET, setup.skeleton)
    if kind.lower() == _WS and (not rest or rest.isdecimal()):
        from rtof_kin.live.websocket_server import WebSocketServer

        port = int(rest) if rest else _PORT
        return WebSocketServer(setup.skeleton, port, floor_height=setup.floor_height)
    raise SourceError(f"--send {word}: there is no such output; give {OUTPUTS}")
