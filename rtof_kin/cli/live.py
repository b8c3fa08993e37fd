"""The command live: poses while a person moves, from cameras, sensors, or recordings replayed."""

from __future__ import annotations

import argparse
import math
import textwrap
import time
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from rtof_kin.cli.detection import add_detector, detector_of
from rtof_kin.cli.recordings import lifter_of
from rtof_kin.cli.terminal import add_model, command, ended_by_signals, err, out, print_calibration, warnings_in_summary

if TYPE_CHECKING:
    from pathlib import Path

    from rtof_kin.calibration.result import SelfCalibration
    from rtof_kin.cli.live_display import LiveDisplay
    from rtof_kin.live.outputs.websocket_server import WebSocketServer
    from rtof_kin.live.samples import Sink, Source
    from rtof_kin.live.session.session import LiveSession
    from rtof_kin.live.session.session_summary import SessionSummary
    from rtof_kin.live.sources.open_sources import Streams
    from rtof_kin.recording.recording import Recording

CALIBRATION: Final = "calibration.toml"
"""File of what was refined, in the folder of the recording."""
_LONGEST_WAIT: Final = 10.0
"""[s] for the names of the points of a camera's stream."""
_MEASURING: Final = 2.0
"""[s] for the first examined image of a webcam."""
_LATENCY, _MARGIN = (0.2, 0.6), 1.5
"""[s] Least and largest latency of images that is prepared for; the latter relative to the measured one."""
_EXAMPLES: Final = """
cameras (--camera):
  0, /dev/video2           a webcam: the person is detected on this machine
  walk.mp4                 a video, at its speed
  lsl:NAME                 points that another program detects, over LSL
  take.xdf, walk.npz       points that a detector wrote, replayed
  FOLDER                   the keypoints of a recording, replayed

sensors (--imus, may be given several times):
  lsl:NAME                 sensors in an LSL stream
  FILE                     sensor files, replayed
  FOLDER                   the sensors of a recording, replayed

examples:
  rtof-kin live out/setup --camera 0 --imus lsl:DOTs -o out/take1
  rtof-kin live out/setup --imus lsl:DOTs --out ws --view
  rtof-kin live out/take1 --camera out/take1 --imus out/take1 --speed 4
"""


def add_commands(commands: Any) -> None:
    """Declare the commands of this module."""
    parser = command(
        commands,
        "live",
        _live,
        "poses while a person moves, from cameras and sensors, recorded on request",
        "SETUP is a recording (of init, or an earlier take) with the camera, the body and the calibration of "
        "the sensors; its streams are not used. Ctrl-C, as SIGTERM and SIGHUP, ends and finishes "
        "the recording; --finish does so for a session that was killed. Nothing leaves this machine unless "
        "an output says so. Needs the extra: pip install 'rtof-kin[live]'.",
    )
    parser.formatter_class = _Help
    parser.description, parser.epilog = textwrap.fill(parser.description or "", 80), _EXAMPLES
    parser.add_argument("setup", metavar="SETUP", nargs="?", help="folder of the recording that was set up")
    parser.add_argument("--finish", metavar="FOLDER", help="make a recording of a session that was killed, and end")
    parser.add_argument("--camera", action="append", default=[], metavar="SOURCE", help="of the points; see below")
    parser.add_argument("--imus", action="append", default=[], metavar="SOURCE", help="of the sensors; see below")
    parser.add_argument(
        "--map",
        metavar="FILE",
        help="two columns: each sensor of the streams, and its segment or its name in SETUP; default: they "
        "have the names that SETUP has for them",
    )
    _add_outputs(parser)
    _add_estimate(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="end after so many")
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="X",
        help="of replayed recordings and videos, times real time; inf: as fast as they are estimated",
    )
    add_detector(parser)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", metavar="FOLDER", help="record everything into a new folder")
    parser.add_argument(
        "--out",
        action="append",
        default=[],
        metavar="OUTPUT",
        help="lsl[:NAME], an LSL stream of joint angles; ws[:PORT], JointState as JSON over a WebSocket of "
        "this machine; may be given several times",
    )
    parser.add_argument("--view", action="store_true", help="show the skeleton in the browser")


def _add_estimate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--lag",
        type=float,
        default=0.25,
        metavar="S",
        help="age of the shown poses, 0 to 1 s: the older, the more accurate",
    )
    parser.add_argument("--rate", type=float, default=60.0, metavar="HZ", help="poses per second")
    parser.add_argument(
        "--video-delay", type=float, default=0.0, metavar="S", help="by how much stamps of the video are late"
    )
    parser.add_argument(
        "--calibrate",
        default="delay",
        metavar="KINDS",
        help="what is refined while the person moves: delay (of the video), heading, mounting (of the "
        "sensors), posture, with commas between, or none; with -o into FOLDER/calibration.toml. Open more "
        "than the delay where it is known to be wrong",
    )
    parser.add_argument("--calibration", metavar="FILE", help="of an earlier session, that --calibrate begins with")
    add_model(parser)


class _Help(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Help with defaults, and with the examples as they are written."""


# --- what it does --------------------------------------------------------------------------------


def _live(options: argparse.Namespace) -> None:
    from rtof_kin.core.errors import InvalidInputError

    if (options.setup is None) == (options.finish is None):
        raise InvalidInputError("name the folder of the recording that was set up, or --finish FOLDER")
    if options.finish is not None:
        _finish(options.finish)
        return
    with ended_by_signals():
        _run_session(options)


def _finish(folder: str) -> None:
    """Make a recording of a session that was killed."""
    from rtof_kin.live.session.recorded_session import finish

    for note in finish(folder):
        _line("note", note)
    _print_recorded(folder)


def _print_recorded(folder: Path | str) -> None:
    _line("recorded", f"{folder}")
    _line("next", f"rtof-kin reconstruct {folder} -o OUT")


def _run_session(options: argparse.Namespace) -> None:
    from rtof_kin.core.environment import limit_threads

    limit_threads(None)
    from rtof_kin.calibration.file import read_self_calibration_toml
    from rtof_kin.cli.live_display import LiveDisplay
    from rtof_kin.core.files.folder import check_replaceable
    from rtof_kin.live.estimation.estimator import OnlineEstimator
    from rtof_kin.live.estimation.online_settings import OnlineSettings
    from rtof_kin.live.estimation.refinement import refinement_priors
    from rtof_kin.live.session.recorder import Recorder
    from rtof_kin.live.session.session import LiveSession
    from rtof_kin.live.sources.open_sources import open_sinks, open_sources
    from rtof_kin.recording.index import INDEX
    from rtof_kin.recording.recording import Recording

    settings = OnlineSettings(options.rate, options.lag, video_delay_s=options.video_delay)
    if options.output is not None:
        check_replaceable(options.output, INDEX)
    known = None if options.calibration is None else read_self_calibration_toml(options.calibration)
    lifter = lifter_of(options)
    with warnings_in_summary("rtof_kin.recording.files"):
        setup = replace(Recording.load(options.setup), model_prior=getattr(lifter, "prior", None))
        if not options.imus and setup.keypoints is not None:
            setup = replace(setup, imus=None, calibration=None)
        streams = open_sources(
            options.camera,
            options.imus,
            setup,
            speed=options.speed,
            names=options.map,
            detector=lambda: detector_of(options),
        )
    sinks: list[Sink] = []
    try:
        sinks += open_sinks(options.out, setup)
        servers = _served(sinks, setup, options.view)
        landmarks = _points_of(streams.sources[0]) if options.camera else ()
        settings = replace(
            settings,
            video_latency_s=_latency(streams.sources[0]),
            refined=refinement_priors(() if options.calibrate == "none" else options.calibrate.split(",")),
        )
        err.print("preparing the estimator", soft_wrap=True)
        estimator = OnlineEstimator(setup, landmarks, settings, lifter, known)
        _start(streams.sources)
        recorder = None
        if options.output is not None:
            recorder = Recorder(options.output, setup, video_delay_s=options.video_delay)
        display = LiveDisplay(out, setup.skeleton)
        session = LiveSession(
            setup,
            streams.sources,
            estimator,
            sinks=(*sinks, display),
            recorder=recorder,
            video_delay_s=options.video_delay,
            in_background=streams.in_real_time,
        )
        summary = _run(session, display, servers, streams, options.seconds)
        _print_summary(summary, options)
        _finish_calibration(estimator.calibration, summary)
    finally:
        for source in streams.sources:
            source.close()
        for sink in sinks:
            sink.close()


def _points_of(camera: Source) -> tuple[str, ...]:
    """Start a camera and return the names of its points; those of a port come with the first frames."""
    from rtof_kin.core.errors import SourceError

    camera.start()
    deadline = time.monotonic() + _LONGEST_WAIT
    if not camera.landmarks:
        err.print(f"waiting for the points of {camera.name}", soft_wrap=True)
    while not camera.landmarks:
        if time.monotonic() > deadline:
            raise SourceError(f"{camera.name}: no names of points in {_LONGEST_WAIT:g} s; start what sends them first")
        time.sleep(0.02)
    return camera.landmarks


def _start(sources: Sequence[Source]) -> None:
    """Start sources; sensors of the network that are not there, beside others, are left to the session."""
    from rtof_kin.core.errors import SourceError

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
    from rtof_kin.live.sources.video_source import VideoSource

    if not isinstance(camera, VideoSource):
        return 0.0
    deadline = time.monotonic() + _MEASURING
    while camera.live and not math.isfinite(camera.latency_s) and time.monotonic() < deadline:
        time.sleep(0.02)
    measured = camera.latency_s if math.isfinite(camera.latency_s) else 0.0
    return min(max(_LATENCY[0], _MARGIN * measured), _LATENCY[1])


def _served(sinks: list[Sink], setup: Recording, view: bool) -> list[WebSocketServer]:
    """Return the servers among the outputs and print their addresses; with `view` there is one."""
    from rtof_kin.live.outputs.websocket_server import WebSocketServer

    servers = [sink for sink in sinks if isinstance(sink, WebSocketServer)]
    if view and not servers:
        servers = [WebSocketServer(setup.skeleton, floor_height=setup.floor_height)]
        sinks += servers
    for server in servers:
        err.print(f"{server.url} shows the skeleton in a browser, to who has this address", soft_wrap=True)
    if view:
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


def _print_summary(summary: SessionSummary, options: argparse.Namespace) -> None:
    """Print what happened, by stream, and what comes next."""
    frames = f"{summary.frames} poses in {summary.seconds:.1f} s"
    if summary.frames:
        frames += f", {summary.frame_ms_p50:.1f} ms each (99 % below {summary.frame_ms_p99:.1f} ms)"
    _line("session", frames)
    for name, one in summary.streams.items():
        counts = {"did not come": one.lost, "late": one.late, "too late": one.too_late, "not used": one.left_out}
        said = "".join(f", {count} {what}" for what, count in counts.items() if count)
        _line("stream", f"{name}: {one.received} samples{said}")
    if summary.folder is not None:
        _print_recorded(summary.folder)
    elif options.output is not None:
        _line(
            "recorded",
            f"nothing that is a recording; what came is in {options.output}, and rtof-kin live "
            f"--finish {options.output} tries again",
        )


def _finish_calibration(found: SelfCalibration | None, summary: SessionSummary) -> None:
    """Print what was refined, and write it beside the recording."""
    from rtof_kin.calibration.file import write_self_calibration_toml

    if found is None:
        return
    print_calibration(found)
    if summary.folder is not None:
        write_self_calibration_toml(summary.folder / CALIBRATION, found)
        out.print(f"wrote {summary.folder / CALIBRATION}", soft_wrap=True)


def _line(name: str, text: str) -> None:
    out.print(Text(f"{name:9} ", "bold"), Text(text), soft_wrap=True, sep="")
