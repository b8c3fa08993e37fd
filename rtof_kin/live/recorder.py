"""`Recorder`: writes everything that arrives in a session, while it runs.

The folder has ``live/``: the setup, and every two seconds a file with the samples as they came, their stamps
and arrivals, the estimates and the messages. Each file appears whole or not at all, so a session that was
killed loses two seconds; `rtof_kin.live.recorded_session.finish` makes a recording of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import WritingError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.files.folder import check_replaceable, locked
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.recorded_session import CHUNK, LIVE, SETUP, finish
from rtof_kin.live.samples import FrameSample, OnlineEstimate
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording

_PENDING: Final = 30  # files that wait for a slow or full disk
_AGAIN: Final = 1.0  # [s] until a file that could not be written is tried again
_CLOSING: Final = 30.0  # [s] for which the last files are waited for
_SLOW: Final = "the disk is too slow"


@dataclass
class _Chunk:
    """What came in two seconds."""

    start: float
    landmarks: tuple[str, ...]  #: Names of the points of its frames
    sensors: list[Arrived] = field(default_factory=list)
    frames: list[Arrived] = field(default_factory=list)
    estimates: list[OnlineEstimate] = field(default_factory=list)
    sentences: list[str] = field(default_factory=list)

    def arrays(self, video_delay_s: float) -> dict[str, NDArray[Any]]:
        """Return the content of a file; kinds of data that there are none of are left out."""
        arrays: dict[str, NDArray[Any]] = {"video_delay_s": np.array(video_delay_s)}
        if self.sensors:
            names = sorted({arrived.stream for arrived in self.sensors})
            arrays |= {f"imu_{name}": values for name, values in _stamps(self.sensors).items()}
            arrays["sensors"] = np.array(names)
            arrays["imu_sensor"] = np.array([names.index(arrived.stream) for arrived in self.sensors])
            samples: list[Any] = [arrived.sample for arrived in self.sensors]
            arrays["R_inertial_sensor"] = np.array([sample.R_inertial_sensor for sample in samples])
            arrays["f_sensor"] = np.array([sample.f_sensor for sample in samples])
        if self.frames:
            samples = [arrived.sample for arrived in self.frames]
            arrays |= {f"video_{name}": values for name, values in _stamps(self.frames).items()}
            arrays["landmarks"] = np.array(self.landmarks, dtype=str)
            arrays["uv_px"] = np.array([sample.uv_px for sample in samples])
            arrays["confidence"] = np.array([sample.confidence for sample in samples])
        if self.estimates:
            poses = [estimate.poses for estimate in self.estimates]
            arrays["joints"] = np.array(poses[0].names)
            arrays["pose_time"] = np.concatenate([one.times for one in poses])
            for name in ("p_world_joint", "R_world_bone", "provenance"):
                arrays[name] = np.concatenate([getattr(one, name) for one in poses])
            arrays["lag_s"] = np.array([estimate.lag_s for estimate in self.estimates])
            arrays["seconds"] = np.array([estimate.seconds for estimate in self.estimates])
        if self.sentences:
            arrays["sentences"] = np.array(self.sentences)
        return arrays


def _stamps(arrived: Sequence[Arrived]) -> dict[str, NDArray[Any]]:
    sources = sorted({one.source for one in arrived})
    return {
        "sources": np.array(sources),
        "source": np.array([sources.index(one.source) for one in arrived]),
        "stamp": np.array([one.sample.time for one in arrived]),
        "arrival": np.array([one.arrival for one in arrived]),
        "time": np.array([one.time for one in arrived]),
    }


class Recorder:
    """Writes a session into a folder of its own.

    A file that cannot be written is tried again, while others wait for it; one sentence says so, and another
    what was lost.
    """

    def __init__(
        self,
        folder: str | Path,
        setup: Recording,
        *,
        video_delay_s: float = 0.0,
        chunk_s: float = 2.0,
        in_background: bool = True,
    ):
        """Make the folder and write the setup.

        `folder`: to be written; new, or empty. `video_delay_s`: by how much the video's stamps are late. `chunk_s`:
        length of a file, s. `in_background`: write in a thread, so that a slow disk does not delay the estimate.
        `OutputExistsError`: the folder has files. `WritingError`: it cannot be written.
        """
        self.folder = Path(folder)
        self.video_delay_s = video_delay_s
        self._chunk_s, self._count = chunk_s, 0
        self._landmarks: tuple[str, ...] = ()
        self._chunk: _Chunk | None = None
        self._notices: list[str] = []
        self._closed = False
        self._problem, self._lost = "", 0
        check_replaceable(self.folder, INDEX)
        _bare(setup, self.folder.name).save(self.folder / LIVE / SETUP)
        self._held = ExitStack()
        self._held.enter_context(locked(self.folder / LIVE))
        self._jobs: deque[_Chunk] = deque()
        self._wake = Event()
        self._thread: Thread | None = None
        if in_background:
            self._thread = Thread(target=self._write_all, name="recorder", daemon=True)
            self._thread.start()

    def landmarks(self, names: Sequence[str]) -> None:
        """Take the names of the points of the frames that follow."""
        self._put()
        self._landmarks = tuple(names)

    def add(self, arrived: Arrived) -> None:
        """Take a sample, also one without a time."""
        chunk = self._current(arrived.arrival)
        (chunk.frames if isinstance(arrived.sample, FrameSample) else chunk.sensors).append(arrived)

    def add_estimate(self, estimate: OnlineEstimate, arrival: float) -> None:
        """Take an estimate. `arrival`: now, s on the clock of the arrivals."""
        self._current(arrival).estimates.append(estimate)

    def tell(self, sentence: str, arrival: float) -> None:
        """Take a message. `arrival`: now, s on the clock of the arrivals."""
        self._current(arrival).sentences.append(sentence)

    def notices(self) -> list[str]:
        """Return sentences since the last call about what could not be written."""
        notices, self._notices = self._notices, []
        return notices

    def close(self) -> None:
        """Write what is left; may be called twice."""
        if self._closed:
            return
        self._put()
        self._closed = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join(_CLOSING)
        self._held.close()
        if self._jobs:
            problem = self._problem or _SLOW
            seconds = (len(self._jobs) + self._lost) * self._chunk_s
            self._notices.append(f"{self.folder}: the last {seconds:g} s are not recorded ({problem})")

    def finish(self) -> tuple[str, ...]:
        """Make a recording of the folder and return notes about it. `RtofError`: nothing was recorded, or it cannot be
        written.
        """
        self.close()
        return finish(self.folder)

    # --- files -----------------------------------------------------------------------------------

    def _current(self, arrival: float) -> _Chunk:
        if self._chunk is not None and not 0 <= arrival - self._chunk.start < self._chunk_s:
            self._put()
        if self._chunk is None:
            self._chunk = _Chunk(arrival, self._landmarks)
        return self._chunk

    def _put(self) -> None:
        """Let what came be written."""
        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        if len(self._jobs) < _PENDING:
            self._jobs.append(chunk)
        else:
            if not self._lost:
                problem = self._problem or _SLOW
                self._notices.append(f"{self.folder}: the session goes on without being recorded ({problem})")
            self._lost += 1
        if self._thread is None:
            self._write_due()
        else:
            self._wake.set()

    def _write_all(self) -> None:
        closed = False
        while not closed:
            self._wake.wait(_AGAIN)
            self._wake.clear()
            closed = self._closed
            self._write_due()

    def _write_due(self) -> None:
        """Write what waits, up to the first file that cannot be written."""
        while self._jobs:
            path = self.folder / LIVE / CHUNK.format(self._count + 1)
            try:
                write_npz(path, self._jobs[0].arrays(self.video_delay_s), overwrite=True)
            except (WritingError, OSError, MemoryError) as error:
                told, self._problem = self._problem, str(error.__cause__ or error) or type(error).__name__
                if not told:
                    self._notices.append(
                        f"{self.folder}: {path.name} cannot be written ({self._problem}); make room, it is tried "
                        "again every second"
                    )
                return
            self._jobs.popleft()
            self._count += 1
            if self._problem:
                lost = f"{self._lost * self._chunk_s:g} s in between" if self._lost else "nothing"
                self._notices.append(f"{self.folder}: files are written again; lost: {lost}")
                self._problem, self._lost = "", 0


def _bare(setup: Recording, name: str) -> Recording:
    """Return a setup with one empty frame and one empty sample in place of its streams."""
    video, imus = setup.keypoints, setup.imus
    if video is not None:
        empty = np.full((1, *video.uv_px.shape[1:]), np.nan)
        video = KeypointSequence(video.camera, np.zeros(1), empty, np.zeros(empty.shape[:2]), video.names)
    worn = setup.calibration.sensors if setup.calibration is not None else imus.names if imus else ()
    if worn:
        R, f = np.full((1, len(worn), 3, 3), np.nan), np.full((1, len(worn), 3), np.nan)
        imus = ImuSequence(np.zeros(1), R, f, worn)
    return replace(setup, name=name, keypoints=video, imus=imus, truth=None, views=(), model_prior=None, first_frame=0)
