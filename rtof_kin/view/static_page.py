"""The scene of a motion as one HTML file that plays in any browser without a network."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_file import MOTION, write_motion
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.files.text import write_text
from rtof_kin.core.packages import optional
from rtof_kin.view.legend import Verdict, corner_html, legend_html
from rtof_kin.view.motion_scene import ELLIPSOIDS, MotionScene
from rtof_kin.view.viewer import Opened, local_server, motion_files
from rtof_kin.vision.video import Progress

LARGEST_MB: Final = 50.0  #: [MB] Default limit of the file
FASTEST_HZ: Final = 30.0  #: Default rate of the frames
SLOWEST_HZ: Final = 5.0  #: Least rate to which a long motion is thinned out
_TRIAL: Final = 40  # Frames from which the size is estimated
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
    "worker-src blob: data:; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src data: blob:; base-uri 'none'; form-action 'none'"
)
"""The browser loads nothing from elsewhere."""
_PATIENCE: Final = 3600.0  # [s] until a frame is read; a file of hours takes minutes


@dataclass(frozen=True)
class StaticPage:
    """A page that was written."""

    path: Path
    frames: int
    rate_hz: float
    size_mb: float  #: [MB]
    thinned: bool  #: Whether the rate is below what was asked for, to keep the size


def frames_of_page(times: Array, start: float | None, stop: float | None, rate_hz: float) -> list[int]:
    """Return the frames that a page shows. `times`: (T,) s. start, stop: of the part, s; None: that of the motion.
    `InvalidInputError`: the part is empty, or the rate not positive.
    """
    if not 0 < rate_hz < np.inf:
        raise InvalidInputError(f"rate: {rate_hz:g} Hz is not positive")
    first = times[0] if start is None else start
    last = times[-1] if stop is None else stop
    inside = np.flatnonzero((times >= first - 1e-9) & (times <= last + 1e-9))
    if len(inside) == 0:
        raise InvalidInputError(
            f"no frame from {first:g} to {last:g} s; the motion is from {times[0]:g} to {times[-1]:g} s"
        )
    part = times[inside]
    wanted = np.arange(part[0], part[-1] + 1e-9, 1 / rate_hz)
    at = np.clip(np.searchsorted(part, wanted - 1e-6), 0, len(part) - 1)
    return [int(inside[i]) for i in dict.fromkeys(at.tolist())]


def write_static_page(
    server: Any,
    files: Opened,
    path: str | Path,
    *,
    start: float | None = None,
    stop: float | None = None,
    rate_hz: float = FASTEST_HZ,
    largest_mb: float = LARGEST_MB,
    slowest_hz: float = SLOWEST_HZ,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> StaticPage:
    """Write a page; a long motion has fewer frames per second, so that the file stays within its limit.

    `server`: of `local_server`, without a scene. `start`, `stop`: of the part, s. `rate_hz`: frames per second, at
    most. `overwrite`: replace an existing file. `progress`: called with ("page", frames done, frames in all).
    `InvalidInputError`: an empty part, or it would exceed the limit even at `slowest_hz`; `OutputExistsError`,
    `WritingError`: the file cannot be written.
    """
    times = files.motion.times
    frames = frames_of_page(times, start, stop, rate_hz)
    rate = min(rate_hz, files.motion.rate_hz)
    scene = MotionScene(server, files.motion, files.measurements, files.second)
    try:
        if ELLIPSOIDS in scene.layers:
            scene.layers[ELLIPSOIDS](False)
        base, each = _sizes(server, scene, frames)
        most = max(int((largest_mb - base) / each), 0)
        if thin := len(frames) > most:
            rate *= most / len(frames)
            if rate < slowest_hz:
                raise InvalidInputError(
                    f"{path}: would need {base + each * len(frames):.0f} MB, and more than {largest_mb:g} MB "
                    f"even at {slowest_hz:g} frames per second; write a part of it (--start, --stop), or allow "
                    "more (--limit)"
                )
            frames = frames_of_page(times, start, stop, rate)
        text = _recorded(server, scene, times, frames, progress)
        page = _finished(text, files.verdict, scene, _part(times, frames))
    finally:
        scene.close()
    write_text(Path(path), page, overwrite)
    return StaticPage(Path(path), len(frames), rate, len(page.encode()) / 1e6, thin)


@dataclass(frozen=True)
class NotebookPage:
    """A page that a notebook shows below the cell that it is the value of."""

    html: str
    note: str  #: How many frames it has

    def _repr_html_(self) -> str:
        frame = f'<iframe srcdoc="{escape(self.html)}" style="width:100%;height:30em;border:0"></iframe>'
        return f"{frame}<p>{self.note}</p>"


def notebook_page(motion: Motion, largest_mb: float = 20.0) -> NotebookPage:
    """Return a page of a motion, of at most a size, MB; a long one has fewer frames per second, as its note says."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        write_motion(path.with_name(MOTION), motion)
        with motion_files(folder) as files, local_server() as server:
            made = write_static_page(server, files, path, largest_mb=largest_mb, slowest_hz=0.0)
        thinned = f", thinned out to stay below {largest_mb:g} MB" if made.thinned else ""
        return NotebookPage(path.read_text("utf-8"), f"{made.frames} frames, {made.rate_hz:.3g} per second{thinned}")


def _sizes(server: Any, scene: MotionScene, frames: list[int]) -> tuple[float, float]:
    """Return the estimated size of the page without frames and of each frame, MB, by some in its middle."""
    middle, sizes = len(frames) // 2, []
    trial = frames[max(middle - _TRIAL, 0) : middle + 1]
    for some in (trial[:1], trial):
        serializer = server.get_scene_serializer()
        for frame in some:
            _show(scene, frame)
            serializer.insert_sleep(0.02)
        sizes.append(len(serializer.serialize()) * 4 / 3 / 1e6)
    page = Path(optional("viser", "view").__file__).parent / "client" / "build" / "index.html"
    each = (sizes[1] - sizes[0]) / (len(trial) - 1) if len(trial) > 1 else sizes[0]
    return page.stat().st_size / 1e6, each


def _recorded(server: Any, scene: MotionScene, times: Array, frames: list[int], progress: Progress | None) -> str:
    """Return viser's page with the frames at their times; it begins again at the end."""
    _show(scene, frames[0])
    serializer = server.get_scene_serializer()
    ends = np.append(times[frames], times[frames[-1]] + 1.0)  # the last frame stays for a second
    for number, frame in enumerate(frames):
        _show(scene, frame)
        serializer.insert_sleep(float(ends[number + 1] - ends[number]))
        if progress is not None:
            progress("page", number + 1, len(frames))
    return str(serializer.as_html())


def _show(scene: MotionScene, frame: int) -> None:
    """Show a frame as soon as all files are read that far."""
    if scene.show(frame, _PATIENCE) is None:
        raise RtofError(f"frame {frame} was not read within {_PATIENCE:g} s; copy the files to a faster disk")


def _part(times: Array, frames: list[int]) -> str:
    first = float(times[frames[0]])
    begin = f"; 0 in the player is {first:.2f} s" if first >= 0.1 else ""
    return f"{first:.2f} to {times[frames[-1]]:.2f} s, {len(frames)} frames{begin}"


def _finished(text: str, verdict: Verdict, scene: MotionScene, part: str) -> str:
    """Return the page with its policy, title, verdict and legend."""
    legend = legend_html(cameras=bool(scene.cameras), truth=scene.truth is not None, second=scene.second is not None)
    box = corner_html(verdict, part, legend)
    head = f'<head><meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    text = text.replace("<head>", head, 1)
    title = f"<title>{escape(verdict.recording or 'motion')} - rtof_kin</title>"
    before, _, after = text.partition("<title>")
    if after:
        text = before + title + after.partition("</title>")[2]
    place = text.rindex("</body>")
    return text[:place] + box + text[place:]
