"""Sources and sinks by the words of a command line: ``0``, ``walk.mp4``, ``lsl:NAME``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rtof_kin.core.errors import SourceError
from rtof_kin.live.samples import Clock, Sink, Source
from rtof_kin.live.sources.renamed_sensors import RenamedSensors
from rtof_kin.live.sources.replay import RecordingReplay
from rtof_kin.live.sources.replay_clock import ReplayClock
from rtof_kin.live.sources.video_source import VideoSource, is_webcam
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.keypoint_files import FORMATS
from rtof_kin.vision.person_detector import PersonDetector, choose_detector

CAMERAS: Final = "number of a webcam, VIDEO, a detector's file, lsl:NAME, or the folder of a recording"
"""Words of a camera, for messages."""
SENSORS: Final = "lsl:NAME, a file or folder of sensors, or the folder of a recording"
"""Words of sensors, for messages."""
OUTPUTS: Final = "lsl, lsl:NAME, ws or ws:PORT"
"""Words of outputs, for messages."""
_LSL, _WS = "lsl", "ws"
_OUTLET: Final = "rtof_kin"
_PORT: Final = 8765
"""Of the WebSocket, unless another is given."""
_SKELETON: Final = "total_capture"


@dataclass(frozen=True)
class Streams:
    """Sources of a session."""

    sources: tuple[Source, ...]
    """The camera first; not started yet."""
    replay: ReplayClock
    """Clock of those that are replayed."""
    live: tuple[Source, ...]
    """Those that are not replayed."""

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

    Args:
        cameras, sensors: words of `CAMERAS` and `SENSORS`. speed: of replays, times real time; inf: without pace.
        names: map of sensors, see `RenamedSensors`; None: they have the names of the calibration.
        detector: gives the detector of a webcam's or a video's images.

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
    lsl = any(map(_is_lsl, words))
    opening = _Opening(setup, ReplayClock(speed), live, _lsl_clock() if lsl else time.monotonic, detector)
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
    """Return the outputs that words name.

    Args:
        words: of `OUTPUTS`.

    Raises:
        SourceError: another word, twice the same, or a port that is taken.
        RtofError: what an output needs is not installed.
    """
    if twice := {word for word in words if list(words).count(word) > 1}:
        raise SourceError(f"--out {', '.join(sorted(twice))}: given twice; give each output once")
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
        from rtof_kin.live.sources.lsl_source import LslFrameSource

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
        from rtof_kin.live.sources.lsl_source import LslImuSource

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


def _lsl_clock() -> Callable[[], float]:
    from rtof_kin.live.sources.lsl_inlet import load_pylsl

    clock: Callable[[], float] = load_pylsl().local_clock
    return clock


def _sink(word: str, setup: Recording) -> Sink:
    kind, _, rest = word.strip().partition(":")
    if kind.lower() == _LSL:
        from rtof_kin.live.outputs.lsl_outlet import LslOutlet

        return LslOutlet(rest.strip() or _OUTLET, setup.skeleton)
    if kind.lower() == _WS and (not rest or rest.isdecimal()):
        from rtof_kin.live.outputs.websocket_server import WebSocketServer

        port = int(rest) if rest else _PORT
        return WebSocketServer(setup.skeleton, port, floor_height=setup.floor_height)
    raise SourceError(f"--out {word}: there is no such output; give {OUTPUTS}")
