"""Page on which a recording is made live, by a process of its own, which ends with the server.

What comes is written all the time. At the end, or at the next start after the process was killed, it becomes files as
others drop them, so that it is reconstructed like those.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import threading
import time
from contextlib import ExitStack, closing, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from rtof_kin.app.frame import EVERY, Frame, Show
from rtof_kin.app.store import FILES, SUBJECT, Store
from rtof_kin.app.texts import TEXTS, speak
from rtof_kin.core import rotations as so3
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, SourceError
from rtof_kin.core.files.arrays import write_csv
from rtof_kin.core.files.manifest import make_folders, make_private
from rtof_kin.core.jobs.processes import end_with_parent
from rtof_kin.core.packages import optional
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.live import lsl, video
from rtof_kin.live.estimator import OnlineEstimator
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.live.open_sources import open_sources
from rtof_kin.live.recorded_session import LIVE, SETUP, finish
from rtof_kin.live.recorder import Recorder
from rtof_kin.live.session import LiveSession
from rtof_kin.live.websocket_server import WebSocketServer, live_page, page_headers
from rtof_kin.reconstruction.person import Person
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import read_subject
from rtof_kin.setup.camera import assumed_camera
from rtof_kin.setup.recording_text import Field
from rtof_kin.view.film_files import Mp4Writer
from rtof_kin.vision.person_detector import Detector, choose_detector
from rtof_kin.vision.video_metadata import lens_prior, read_video_metadata

SESSION: Final = "session"  #: Folder of what came, until its files are made
_CONTEXT: Final = multiprocessing.get_context("spawn")
_VIDEO: Final = "video.mkv"  # Can be read also where it is not complete
_USUAL_PX, _USUAL_HZ = (1280, 720), 30.0  # Of a webcam
_STATUS_S, _SEARCH_S, _LAG_S = 0.5, 1.0, 0.25  # [s] between states of streams; to look for them; of the figure
_LONGEST_S: Final = 3600.0


class Wish(NamedTuple):
    """What is recorded."""

    camera: str = ""  #: See `rtof_kin.live.open_sources`; '': none
    streams: tuple[str, ...] = ()  #: Names of LSL streams of sensors
    video: bool = False  #: Whether the video is kept, else points that are found in it
    countdown_s: float = 5.0


class Session:
    """A process that records into a folder."""

    def __init__(self, folder: Path, wish: Wish):
        self.folder, self.url, self.said, self.told = folder, "", "", False
        self.begins = 0.0  #: [s] since 1970, when the countdown ends; 0: not known yet
        self.connection, inner = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_record, args=(str(folder), wish, inner, TEXTS.code), daemon=True)
        self.process.start()
        inner.close()

    def runs(self) -> bool:
        """Take what the process says; return whether it runs."""
        runs = self.process.is_alive()
        with suppress(EOFError, OSError):
            while self.connection.poll():
                vars(self).update(self.connection.recv())
        self.said = self.said or (TEXTS.record_lost if self.process.exitcode else "")
        return runs

    def stop(self) -> None:
        """Let it end and make its files."""
        self.told = True
        with suppress(OSError):
            self.connection.send("stop")


class RecordPages(Frame):
    """A recording that is made; one at a time."""

    def serve(self) -> None:
        """See `Frame`."""
        self._last: Session | None = None
        self._wish = Wish()
        self.work.others.append(lambda folder: (now := self._now()) is not None and now.folder.is_relative_to(folder))
        routing = optional("starlette.routing", "app")
        self.app.router.routes += [routing.Route("/live", _figure), routing.WebSocketRoute("/live", self._relay)]
        self.ui.page("/record/{person}/{visit}")(self.record)
        threading.Thread(target=_recover, args=(self.store,), daemon=True).start()

    def record(self, person: str, visit: str) -> None:
        """A form, or what is going on."""

        def look() -> Any:
            return self._now(), (last := self._last) and (last, last.url, last.said, last.told)

        def fill(show: Show) -> None:
            if (now := self._now()) is not None:
                self._going_on(now)
                return
            if (last := self._last) is not None and last.said:
                self.ui.label(last.said).props("role=alert").classes("doubt text-lg")
            elif last is not None and last.folder.is_dir():
                said = TEXTS.recorded.format(name=last.folder.name)
                self.ui.link(said, self.page_of(last.folder)).classes("text-lg")
            self._form(person, visit, show)

        with self.frame(TEXTS.record, person, visit):
            self.store.path(person, visit)
            self.heading(TEXTS.record, 2)
            self.shown(look, fill)

    def _now(self) -> Session | None:
        return self._last if self._last is not None and self._last.runs() else None

    def _form(self, person: str, visit: str, show: Show) -> None:
        ui, before, boxes = self.ui, self._wish, dict[str, Any]()
        name = ui.input(TEXTS.recording).classes("w-64")
        camera = ui.input(TEXTS.camera, value=before.camera).classes("w-full")
        with ui.column() as found:
            ui.label(TEXTS.searching)
        keep = ui.switch(TEXTS.keep_video, value=before.video)
        ui.label().bind_text_from(keep, "value", lambda on: TEXTS.video_kept if on else TEXTS.points_kept)
        countdown = ui.number(TEXTS.countdown, value=before.countdown_s, min=0, max=60).classes("w-56")

        async def search() -> None:
            streams, said = await self.run.io_bound(_found)
            found.clear()
            with found:
                for stream, sensors in streams.items():
                    boxes[stream] = ui.checkbox(f"{stream}: {sensors}", value=stream in before.streams)
                for sentence in said:
                    ui.label(sentence)
                self.button(TEXTS.search, search)

        def start() -> None:
            streams = tuple(stream for stream, box in boxes.items() if box.value)
            wish = Wish(camera.value.strip(), streams, keep.value, countdown.value or 0)
            if not (wish.camera or streams) or self._now() is not None:
                raise InvalidInputError(TEXTS.no_source if self._now() is None else TEXTS.records_already)
            folder = self.store.add_take(person, visit, name.value.strip())
            self._last, self._wish = Session(folder, wish), wish
            show()

        ui.timer(0.0, lambda: self.tried(search), once=True)
        self.button(TEXTS.start, start, name)

    def _going_on(self, session: Session) -> None:
        line = self.ui.label().props("role=status").classes("text-3xl")
        if not session.told:
            self.button(TEXTS.stop, session.stop)
        if session.url:
            self.ui.element("iframe").props(f'src="{self.prefix}/live" title="{TEXTS.figure}"')

        def update() -> None:
            left, name = session.begins - time.time(), " / ".join(session.folder.relative_to(self.store.root).parts)
            said = TEXTS.counting if left > 0 else TEXTS.recording_now if session.begins else TEXTS.preparing
            line.text = (TEXTS.saving if session.told else said).format(name=name, time=int(np.ceil(abs(left))))

        update()
        self.ui.timer(EVERY, update)

    async def _relay(self, socket: Any) -> None:
        """Pass on what the process's own server sends, which is behind a door of its own."""
        await socket.accept()
        with suppress(Exception):  # either end has gone
            client, url = optional("websockets.asyncio.client", "live"), "" if self._last is None else self._last.url
            async with client.connect(url.replace("http:", "ws:"), compression=None) as inner:
                async for text in inner:
                    await socket.send_text(text)
            await socket.close()


async def _figure(request: Any) -> Any:
    answers = optional("starlette.responses", "app")
    return answers.HTMLResponse(live_page(), headers=page_headers(request.headers["host"], "'self'"))


def _found() -> tuple[dict[str, str], list[str]]:
    """Return LSL streams with the names of their sensors, and what is to be said of these and of cameras."""
    streams, said = dict[str, str](), list[str]()
    try:
        names = [one if one == name else f"{one} ({name})" for one, name in video.cameras_here().items()]
        said.append(TEXTS.cameras_found.format(names=", ".join(names)) if names else TEXTS.no_cameras)
        for stream in sorted({info.name() for info in lsl.load_pylsl().resolve_streams(_SEARCH_S)}):
            with closing(lsl.LslImuSource(stream, _SEARCH_S)) as source, suppress(SourceError):  # others than sensors
                source.start()
                streams[stream] = ", ".join(source.sensors)
        said += [] if streams else [TEXTS.no_streams]
    except RtofError as error:  # the extra is not installed
        said.append(str(error))
    return streams, said


def _recover(store: Store) -> None:
    for folder in store.takes():
        with suppress(RtofError, OSError):  # another process is still at it, or the disk is full
            make_files(folder)


# --- in the process ------------------------------------------------------------------------------


def _record(place: str, wish: Wish, connection: Connection, language: str) -> None:
    """Record until something comes from the other end; sends what changes in the `Session`."""
    end_with_parent()
    speak(language)
    folder = Path(place)
    try:
        with without_warnings("rtof_kin"), ExitStack() as stack:
            _run(folder, wish, connection, stack)
        make_files(folder)
    except Exception as error:
        connection.send({"said": str(error) if isinstance(error, RtofError) else f"{type(error).__name__}: {error}"})
    with suppress(OSError):  # it has something
        (folder / FILES).rmdir()
        folder.rmdir()


def _run(folder: Path, wish: Wish, connection: Connection, stack: ExitStack) -> None:
    """Show what comes and, after the countdown, record it."""
    subject = read_subject(folder.parent.parent / SUBJECT)
    if subject.height_m is None:
        raise InvalidInputError(TEXTS.no_height)
    given = _set_up(folder.name, wish.camera, subject.height_m.value)
    take = Person.of(subject, given).informed(given).whole()
    cameras, sensors = [wish.camera] if wish.camera else [], [f"lsl:{stream}" for stream in wish.streams]
    streams = open_sources(cameras, sensors, take, stack, detector=_detector)
    for source in streams.sources:
        source.start()
    camera, server = streams.sources[0], WebSocketServer(take.skeleton, floor_height=take.floor_height)
    estimator: Any = SimpleNamespace(push=id, advance=lambda *_, **__: [], finish=list, dropped={}, hurried=0)
    if camera.landmarks:
        estimator = OnlineEstimator(take, camera.landmarks, OnlineSettings(lag_s=_LAG_S))
    session, recorders = LiveSession(take, streams.sources, estimator, sinks=[server]), list[Recorder]()
    told, begins = 0.0, time.monotonic() + wish.countdown_s
    connection.send({"url": server.url, "begins": time.time() + wish.countdown_s})

    def stop() -> bool:
        nonlocal told
        if (now := time.monotonic()) > told + _STATUS_S:
            told = now
            server.send_status(session.status())
        if now >= begins and not recorders:
            recorders.append(Recorder(folder / SESSION, given))
            session.record(recorders[0])
            if wish.video and isinstance(camera, video.VideoSource) and camera.examination is not None:
                size = camera.examination.points.image_px
                writer = stack.enter_context(Mp4Writer(folder / SESSION / _VIDEO, size, _USUAL_HZ))
                camera.keep = lambda image: writer.write(image.pixels, image.time)
        return connection.poll() or now > begins + _LONGEST_S

    summary = session.run(stop, clock=(lambda: streams.replay.time) if streams.replayed else time.monotonic)
    if recorders and summary.folder is None:
        raise RtofError(summary.sentences[-1])


def _set_up(name: str, camera: str, height: float) -> Recording:
    """Return a recording with the body and the camera, which is assumed."""
    path, number = Path(camera), int(camera) if camera.isdecimal() else camera
    if not camera:
        R = np.full((1, 1, 3, 3), np.nan)
        return Recording(name, imus=ImuSequence(np.zeros(1), R, R[..., 0], ("any",)), height=height)
    if (path / INDEX).is_file():
        return Recording.load(path)
    if video.is_webcam(number):
        container, stream = video.open_webcam(number, _USUAL_PX)
        with closing(container):
            size = stream.width, stream.height
    elif path.is_file():
        size = (found := read_video_metadata(path)).width_px, found.height_px
    else:
        raise InvalidInputError(TEXTS.no_such_camera.format(camera=camera))
    own = assumed_camera(*size, lens_prior(*size), Field(None)).camera
    keypoints = KeypointSequence(own, np.zeros(1), np.zeros((1, 0, 2)), np.zeros((1, 0)), ())
    return Recording(name, keypoints, height=height, floor_height=0.0)


def _detector() -> Detector:
    try:
        return choose_detector()
    except FileFormatError:
        raise
    except RtofError as error:  # its message is of the command line
        raise RtofError(TEXTS.no_models) from error


def make_files(folder: Path) -> None:
    """Make the files of a recording from its session, if there is one, and remove that; errors: to be tried again."""
    session, files = folder / SESSION, folder / FILES
    if not (session / LIVE / SETUP / INDEX).is_file():
        return
    if not (session / INDEX).is_file():
        finish(session)
    found = Recording.load(session)
    make_folders(files)
    if (imus := found.imus) is not None:
        columns, quat = {"time": imus.times}, so3.to_quat_wxyz(imus.R_inertial_sensor)
        for s, name in enumerate(imus.names):
            columns |= {f"{name}_q{axis}": quat[:, s, i] for i, axis in enumerate("wxyz")}
            columns |= {f"{name}_f{axis}": imus.f_sensor[:, s, i] for i, axis in enumerate("xyz")}
        write_csv(files / "sensors.csv", columns, overwrite=True)
    with suppress(RtofError, OSError):  # none was kept, or it is damaged
        read_video_metadata(session / _VIDEO)
        make_private(session / _VIDEO)
        os.replace(session / _VIDEO, files / _VIDEO)
    if found.keypoints is not None and not (files / _VIDEO).exists():
        write_csv(files / "keypoints.csv", found.keypoints.columns(), overwrite=True)
        Store.change(folder, size_px=(found.keypoints.camera.width_px, found.keypoints.camera.height_px))
    shutil.rmtree(session)
