"""The scene of a motion as one HTML file that plays in any browser without a network."""

from __future__ import annotations

from array import array
from base64 import b64encode
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from hashlib import sha256
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, Final

import numpy as np

from rtof_kin.body.motion_file import MOTION, write_motion
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.packages import optional
from rtof_kin.view.legend import Verdict, corner_html, legend_html
from rtof_kin.view.motion_scene import ELLIPSOIDS, MotionScene
from rtof_kin.view.viewer import Opened, local_server, motion_files
from rtof_kin.vision.video import Progress

LARGEST_MB: Final = 50.0  #: [MB] Default limit of the file
FASTEST_HZ: Final = 30.0  #: Default rate of the frames
SLOWEST_HZ: Final = 5.0  #: Least rate to which a long motion is thinned out
_DATA: Final = '__VISER_EMBED_DATA__="'  #: Before what the player of viser's page reads
_LEVEL: Final = 12  #: Of zstd, as viser has it
_REMEMBERED: Final = 1 << 16  # Arrays that are not written again where they repeat; those of a minute and a half
_PART: Final = 1 << 20  # [bytes] that are compressed at once
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
    with new_file(path, overwrite) as file, ExitStack() as stack:
        scene = stack.enter_context(closing(MotionScene(server, files.motion, files.measurements, files.second)))
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
        _show(scene, frames[0])
        page = _finished(server.get_scene_serializer().as_html(), files.verdict, scene, _part(times, frames))
        before, mark, after = page.partition(_DATA)
        messages = _Messages(server, *(stack.enter_context((file.parent / name).open("w+b")) for name in ("1", "2")))
        _record(messages, scene, times, frames, progress)
        with file.open("wb") as out:
            out.write((before + mark).encode())
            for part in messages.compressed():
                out.write(b64encode(part))
            out.write(after[after.index('"') :].encode())
    return StaticPage(Path(path), len(frames), rate, Path(path).stat().st_size / 1e6, thin)


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


def _record(
    messages: _Messages, scene: MotionScene, times: Array, frames: list[int], progress: Progress | None
) -> None:
    """Show the frames at their times; the player begins again at the end."""
    ends = np.append(times[frames], times[frames[-1]] + 1.0)  # the last frame stays for a second
    for number, frame in enumerate(frames):
        _show(scene, frame)
        messages.serializer.insert_sleep(float(ends[number + 1] - ends[number]))
        messages.take()
        if progress is not None:
            progress("page", number + 1, len(frames))


class _Messages:
    """What a `StateSerializer` of viser holds in memory, 30 kB a frame, in two files until it is compressed."""

    def __init__(self, server: Any, messages: IO[bytes], arrays: IO[bytes]):
        self.serializer, self._encode = server.get_scene_serializer(), optional("msgspec.msgpack", "view").encode
        self._renumber = optional("viser.infra._infra", "view")._remap_binary_placeholder_indices
        self._messages, self._arrays, self._count, self._sizes = messages, arrays, 0, array("Q")
        self._numbers: dict[bytes, int] = {}  # by digest, of the arrays that were used last

    def take(self) -> None:
        """Take from the serializer what it holds."""
        own = self.serializer
        with own._handler._record_lock:
            (messages, own._messages), (arrays, own._binary_buffers) = (own._messages, []), (own._binary_buffers, [])
        numbers = list(map(self._number, arrays))
        for message in messages:
            self._renumber(message, numbers)
            self._messages.write(self._encode(message))
        self._count += len(messages)

    def _number(self, content: Any) -> int:
        """Return the number of an array, which is written unless it has one."""
        digest = sha256(content).digest()
        number = self._numbers[digest] = self._numbers.pop(digest, len(self._sizes))
        if number == len(self._sizes):
            self._sizes.append(content.nbytes)
            self._arrays.write(bytes(-self._arrays.tell() % 8))
            self._arrays.write(content)
            if len(self._numbers) > _REMEMBERED:
                del self._numbers[next(iter(self._numbers))]
        return number

    def compressed(self) -> Iterator[bytes]:
        """Yield what `StateSerializer.serialize` returns, by parts of a multiple of three bytes but for the last."""
        own = self.serializer
        with own._handler._record_lock:
            own._handler._record_handles.remove(own)
        self.take()
        facts = {"durationSeconds": own._time, "viserVersion": optional("viser", "view").__version__}
        head = self._encode(facts | {"binaryBufferLengths": self._sizes.tolist(), "messages": []})[:-1]
        head += b"\xdd" + self._count.to_bytes(4, "big")  # they follow
        head = (len(head) + self._messages.tell()).to_bytes(8, "little") + head
        self._messages.write(bytes(-(len(head) + self._messages.tell()) % 8))
        whole = len(head) + self._messages.tell() + self._arrays.tell()
        compressor = optional("zstandard", "view").ZstdCompressor(level=_LEVEL).compressobj(size=whole)
        rest = whole.to_bytes(8, "little") + compressor.compress(head)
        for file in (self._messages, self._arrays):
            file.seek(0)
            while part := file.read(_PART):
                rest += compressor.compress(part)
                yield rest[: len(rest) // 3 * 3]
                rest = rest[len(rest) // 3 * 3 :]
        yield rest + compressor.flush()


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
