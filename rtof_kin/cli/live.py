"""The command live: poses while a person moves, from cameras, sensors, or recordings replayed."""

from __future__ import annotations

import math
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

import numpy as np
from cyclopts import Parameter
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Column, Table
from rich.text import Text

from rtof_kin.cli.options import FetchModels, Fields, Models, Seconds, command, written
from rtof_kin.cli.record import detector_of
from rtof_kin.cli.terminal import ended_by_signals, line, out, print_calibration, remark, say
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import InvalidInputError, RtofError, SourceError
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.setup.settings import ReconstructionTask

if TYPE_CHECKING:
    from rtof_kin.body.skeleton import SkeletonModel
    from rtof_kin.calibration.result import SelfCalibration
    from rtof_kin.live.open_sources import Streams
    from rtof_kin.live.samples import OnlineEstimate, Sink, Source
    from rtof_kin.live.session import LiveSession, SessionSummary
    from rtof_kin.live.websocket_server import WebSocketServer
    from rtof_kin.recording.recording import Recording

CALIBRATION: Final = "calibration.toml"
"""File of what was refined, in the folder of the recording."""
_LONGEST_WAIT: Final = 10.0  # [s] for the names of the points of a camera's stream
_MEASURING: Final = 2.0  # [s] for the first examined image of a webcam
_LATENCY, _MARGIN = (0.2, 0.6), 1.5
"""[s] Least and largest latency of images that is prepared for; the latter relative to the measured one."""
_ANGLES: Final = ("hip_flexion", "knee_flexion", "elbow_flexion")
_FRAMES: Final = 600  # Frames of which the times are summarised
_TABLE_EVERY, _LINE_EVERY = 0.5, 1.0  # [s]
_STYLES: Final = {"ok": "green", "waiting": "dim", "late": "yellow", "lossy": "yellow"}


@command
def live(
    setup: Path | None = None,
    /,
    *,
    camera: Annotated[list[str] | None, Parameter(metavar="SOURCE")] = None,
    imus: Annotated[list[str] | None, Parameter(metavar="SOURCE")] = None,
    map: Annotated[Path | None, Parameter(metavar="FILE")] = None,
    output: Annotated[Path | None, written("record everything into a new folder", "FOLDER")] = None,
    send: Annotated[list[str] | None, Parameter(metavar="OUTPUT")] = None,
    mcap: Annotated[Path | None, Parameter(metavar="FILE")] = None,
    browser: bool = False,
    robot: Annotated[Path | None, Parameter(metavar="FILE.urdf")] = None,
    settings: Annotated[
        OnlineSettings, Fields(rate_hz="fps", lag_s="lag", video_delay_s="video-delay", defaults={"lag_s": 0.25})
    ],
    refine: Annotated[
        tuple[Literal["delay", "heading", "mounting"], ...], Parameter(show_default=lambda _: "delay")
    ] = ("delay",),
    calibration: Annotated[Path | None, Parameter(metavar="FILE")] = None,
    task: Annotated[ReconstructionTask, Fields("model subject")],
    seconds: Seconds = None,
    speed: Annotated[float, Parameter(metavar="X")] = 1.0,
    detector: Models,
    fetch_models: FetchModels = None,
    finish: Annotated[Path | None, Parameter(metavar="FOLDER")] = None,
) -> None:
    """Poses while a person moves, from cameras and sensors, recorded on request.

    SETUP is a recording (of run --only recording, or an earlier take) with the camera, the body and the calibration of
    the sensors; its streams are not used. Ctrl-C, as SIGTERM and SIGHUP, ends and finishes the recording; --finish does
    so for a session that was killed. Nothing leaves this machine unless an output says so. Needs the extra: pip install
    'rtof-kin[live]'. docs/live.md has examples.

    Cameras: 0 or /dev/video2, a webcam, in which the person is detected on this machine; walk.mp4, a video, at its
    speed; lsl:NAME, points that another program detects, over LSL; take.xdf or walk.npz, points that a detector wrote,
    replayed; FOLDER, the keypoints of a recording, replayed. Sensors: lsl:NAME, in an LSL stream; FILE, sensor files,
    replayed; FOLDER, the sensors of a recording, replayed.

    Args:
        setup: folder of the recording that was set up
        camera: source of the points; may be given several times
        imus: source of the sensors; may be given several times
        map: two columns: each sensor of the streams, and its segment or its name in SETUP; default: they have the names
            that SETUP has for them
        send: lsl[:NAME], an LSL stream of joint angles; ws[:PORT], JointState as JSON over a WebSocket of this machine;
            may be given several times
        mcap: new file of joint states, transforms and bands, written as they are estimated, for Foxglove and ROS 2
            (extra connect)
        browser: show the skeleton in the browser
        robot: also send the joints of this robot, which follows the person, see rtof-kin retarget
        refine: what is refined while the person moves: delay (of the video), heading, mounting (of the sensors),
            with commas between, or none; with -o into FOLDER/calibration.toml. Open more than the delay where
            it is known to be wrong
        calibration: of an earlier session, that --refine begins with
        speed: of replayed recordings and videos, times real time; inf: as fast as they are estimated
        finish: make a recording of a session that was killed, and end
    """
    if (setup is None) == (finish is None):
        raise InvalidInputError("name the folder of the recording that was set up, or --finish FOLDER")
    if finish is not None:
        from rtof_kin.live.recorded_session import finish as finished

        for note in finished(finish):
            line("note", note)
        _print_recorded(finish)
        return
    assert setup is not None
    from rtof_kin.calibration.result import read_self_calibration_toml
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.live.estimator import OnlineEstimator
    from rtof_kin.live.open_sources import McapSink, RobotSink, open_sinks, open_sources
    from rtof_kin.live.recorder import Recorder
    from rtof_kin.live.refinement import refinement_priors
    from rtof_kin.live.session import LiveSession
    from rtof_kin.reconstruction.person import Person
    from rtof_kin.recording.index import INDEX
    from rtof_kin.recording.recording import RecordingReader
    from rtof_kin.robots.retarget import Retargeter

    with ended_by_signals(), ExitStack() as stack:
        if output is not None:
            check_replaceable(output, INDEX)
        known = None if calibration is None else read_self_calibration_toml(calibration)
        lifter: Any = task.lifter()
        with without_warnings("rtof_kin.recording.cameras"):
            with RecordingReader.open(setup) as reader:
                take = replace(reader.facts, model_prior=getattr(lifter, "prior", None))
            if not imus and take.keypoints is not None:
                take = replace(take, imus=None, calibration=None)
            given, person = take, Person.of(task.person(), take)
            take, found = person.informed(given).whole(), partial(detector_of, detector, fetch_models)
            streams = open_sources(camera or [], imus or [], take, stack, speed=speed, names=map, detector=found)
        sinks = list(open_sinks(send or [], take))
        if mcap is not None:
            sinks.append(McapSink(mcap, take.skeleton))
        servers = _served(sinks, take, browser)
        if robot is not None:
            follower = Retargeter(take.skeleton, robot, floor=take.floor_height)
            sinks.append(RobotSink(follower, sinks))
        for sink in sinks:
            stack.callback(sink.close)
        landmarks = _points_of(streams.sources[0]) if camera else ()
        latency = _latency(streams.sources[0])
        settings = replace(settings, video_latency_s=latency, refined=refinement_priors(refine))
        for sentence in filter(None, (person.doubt, *person.remarks)):
            line("doubtful", sentence, "bold red")
        remark("preparing the estimator")
        estimator = OnlineEstimator(take, landmarks, settings, lifter, known)
        _start(streams.sources)
        display = LiveDisplay(out, take.skeleton)
        session = LiveSession(
            take,
            streams.sources,
            estimator,
            sinks=(*sinks, display),
            recorder=None if output is None else Recorder(output, given, video_delay_s=settings.video_delay_s),
            video_delay_s=settings.video_delay_s,
            in_background=streams.in_real_time,
        )
        summary = _run(session, display, servers, streams, seconds)
        _print_summary(summary, estimator.calibration, output)
        if robot is not None:
            line("robot", f"{follower.map.name}: {follower.track}")


def _print_recorded(folder: Path | str) -> None:
    line("recorded", f"{folder}")
    line("next", f"rtof-kin reconstruct {folder} -o OUT")


def _points_of(camera: Source) -> tuple[str, ...]:
    """Start a camera and return the names of its points; those of a port come with the first frames."""
    from rtof_kin.live.lsl import wait_until

    camera.start()
    if not camera.landmarks:
        remark(f"waiting for the points of {camera.name}")
    if not wait_until(lambda: bool(camera.landmarks), _LONGEST_WAIT):
        raise SourceError(f"{camera.name}: no names of points in {_LONGEST_WAIT:g} s; start what sends them first")
    return camera.landmarks


def _start(sources: Sequence[Source]) -> None:
    """Start sources; sensors of the network that are not there, beside others, are left to the session."""
    missing = 0
    for source in sources:
        try:
            source.start()
        except SourceError:
            missing += 1
            if not source.name.startswith("lsl:") or missing == len(sources):
                raise


def _latency(camera: Source) -> float:
    """Return the age, s, up to which images are expected when they were examined; 0 where unknown."""
    from rtof_kin.live.lsl import wait_until
    from rtof_kin.live.video import VideoSource

    if not isinstance(camera, VideoSource):
        return 0.0
    wait_until(lambda: not camera.live or math.isfinite(camera.latency_s), _MEASURING)
    measured = camera.latency_s if math.isfinite(camera.latency_s) else 0.0
    return min(max(_LATENCY[0], _MARGIN * measured), _LATENCY[1])


def _served(sinks: list[Sink], setup: Recording, browser: bool) -> list[WebSocketServer]:
    """Return the servers among the outputs and print their addresses; with `browser` there is one."""
    from rtof_kin.live.websocket_server import WebSocketServer

    servers = [sink for sink in sinks if isinstance(sink, WebSocketServer)]
    if browser and not servers:
        servers = [WebSocketServer(setup.skeleton, floor_height=setup.floor_height)]
        sinks += servers
    for server in servers:
        remark(f"{server.url} shows the skeleton in a browser, to who has this address")
    if browser:
        webbrowser.open(servers[0].url_once)
    return servers


def _run(
    session: LiveSession,
    display: LiveDisplay,
    servers: Sequence[WebSocketServer],
    streams: Streams,
    seconds: float | None,
) -> SessionSummary:
    """Run until the end, Ctrl-C, or the time given, and show what happens."""
    replay = streams.replay
    clock: Callable[[], float] = (lambda: replay.time) if streams.replayed else time.monotonic
    for source in streams.live:
        source.poll()  # when this came is not known
    begun = clock()

    def stop() -> bool:
        if display.due():
            status = session.status()
            display.show(status)
            for server in servers:
                server.send_status(status)
        return seconds is not None and clock() - begun >= seconds

    with display:
        waits = {} if streams.in_real_time else {"period_s": 0.0}
        return session.run(stop, clock=clock, **waits)


def _print_summary(summary: SessionSummary, found: SelfCalibration | None, output: Path | None) -> None:
    """Print what happened, by stream, what comes next and what was refined, which is written beside the recording."""
    from rtof_kin.calibration.result import write_self_calibration_toml

    frames = f"{summary.frames} poses in {summary.seconds:.1f} s"
    if summary.frames:
        frames += f", {summary.frame_ms_p50:.1f} ms each (99 % below {summary.frame_ms_p99:.1f} ms)"
    line("session", frames)
    for name, one in summary.streams.items():
        counts = {"did not come": one.lost, "late": one.late, "too late": one.too_late, "not used": one.left_out}
        said = "".join(f", {count} {what}" for what, count in counts.items() if count)
        line("stream", f"{name}: {one.received} samples{said}")
    if summary.folder is not None:
        _print_recorded(summary.folder)
    elif output is not None:
        line(
            "recorded",
            f"nothing that is a recording; what came is in {output}, and rtof-kin live --finish {output} tries again",
        )
    if found is not None:
        print_calibration(found)
        if summary.folder is not None:
            write_self_calibration_toml(summary.folder / CALIBRATION, found)
            say(f"wrote {summary.folder / CALIBRATION}")


class LiveDisplay:
    """Output of a live session on the console: on a terminal a table that is drawn again, else a line a second.

    Args:
        now: seconds of the system.
    """

    def __init__(self, console: Console, skeleton: SkeletonModel, now: Callable[[], float] = time.monotonic):
        self._console, self._skeleton, self._now = console, skeleton, now
        self._recent: deque[OnlineEstimate] = deque(maxlen=_FRAMES)
        self._begun = self._shown = now()
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None

    def __enter__(self) -> Self:
        self._begun = self._shown = self._now()
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, estimate: OnlineEstimate) -> None:
        """Take an estimate."""
        self._recent.append(estimate)

    def tell(self, sentence: str) -> None:
        """Print a message, above the table if there is one."""
        self._console.print(sentence, soft_wrap=True)

    def due(self) -> bool:
        """Return whether it is time to show the present state again."""
        return self._now() - self._shown >= (_LINE_EVERY if self._live is None else _TABLE_EVERY)

    def show(self, status: Mapping[str, Any]) -> None:
        """Show the present state; `status`: of the streams, see `rtof_kin.live.monitor.Monitor.status`."""
        self._shown = self._now()
        streams = [*([status["camera"]] if status["camera"] else []), *status["sensors"]]
        good = sum(one["state"] == "ok" for one in streams)
        parts = [f"{self._now() - self._begun:6.1f} s", *self._figures(status["rate_hz"])]
        parts.append(f"{good} of {len(streams)} streams ok")
        text = "; ".join([", ".join(parts), *self._angles()])
        if self._live is None:
            self._console.print(text, soft_wrap=True)
        else:
            self._live.update(Group(_table(streams), Text(f"{text}. Ctrl-C ends", "bold")), refresh=True)

    def close(self) -> None:
        """Take the table away; may be called twice."""
        if self._live is not None:
            self._live.stop()

    def _figures(self, rate: float | None) -> list[str]:
        """Rate, lag and time of a frame in words."""
        if not self._recent:
            return ["no estimate yet"]
        p50, p99 = 1000 * np.percentile([one.seconds for one in self._recent], [50, 99])
        lag = 1000 * np.median([one.lag_s for one in self._recent])
        parts = [] if rate is None else [f"{rate:.0f} Hz"]
        return [*parts, f"lag {lag:.0f} ms", f"frame {p50:.1f} ms (p99 {p99:.1f})"]

    def _angles(self) -> Iterator[str]:
        """Names and values of the shown angles that are known."""
        from rtof_kin.clinical.angles import clinical_angles

        if not self._recent:
            return
        try:
            angles = clinical_angles(self._recent[-1].poses, self._skeleton)
        except RtofError:  # the skeleton has no clinical angles
            return
        for name in (f"{side}_{angle}" for angle in _ANGLES for side in ("left", "right")):
            if name in angles.names and math.isfinite(value := float(angles.select([name]).values[0, 0])):
                yield f"{name.replace('_', ' ')} {np.degrees(value):.0f} deg"


def _table(streams: Sequence[Mapping[str, Any]]) -> Table:
    """State of each stream."""
    heads = (Column(head, justify="right") for head in ("rate\n[Hz]", "loss\n[%]", "late\n[ms]"))
    table = Table("stream", Column("state", no_wrap=True), *heads, "says", box=SIMPLE_HEAD, pad_edge=False)
    for one in streams:
        state, figures = str(one["state"]), (one[key] for key in ("rate_hz", "loss_percent", "latency_ms"))
        table.add_row(
            Text(str(one["name"])),
            Text(state, _STYLES.get(state, "bold red")),
            *("" if value is None or not math.isfinite(value) else f"{value:.0f}" for value in figures),
            Text("" if state == "ok" else str(one["sentence"])),
        )
    return table
