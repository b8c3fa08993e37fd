"""Ways to damage a file, and limits of time and memory for what reads it."""

from __future__ import annotations

import io
import re
import resource
import signal
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import strategies as st

CPU_SECONDS = 5.0
"""Limit of a reader's processor time for a small file."""
MEMORY_BYTES = 2**30
"""Limit of its memory."""

NUMBER = re.compile(rb"-?\d+(\.\d*)?([eE][-+]?\d+)?")
EXTREME = (
    b"1e400",
    b"NaN",
    b"-1",
    b"0",
    b"999999999999",
    b"text",
    b"",
    b"inf",
    b"1e300",
    b"-1e-300",
    b"9" * 5000,
    b"0x10",
    b"null",
    b"[]",
    b"{}",
    b"\xb5",
    b"true",
    b'"',
    b"-0.5",
)
JUNK = (b"\0", b"\0" * 64, b"\xff\xfe", b"\xb5", b"\r", b"\n", b"\t", b'"', b"{", b"[" * 3000, b"(" * 3000)
"""Inserted bytes: NULs, invalid UTF-8, line ends, brackets."""


class Content(bytes):
    """A file's content, named in a failure by its size: the file itself stays in the test's folder."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> Content:
    """A file's content with one kind of damage."""
    archive = content[:2] == b"PK" and draw(st.booleans())
    return Content(_damaged_member(draw, content) if archive else _damaged(draw, content))


def _damaged(draw: st.DrawFn, content: bytes) -> bytes:
    at = draw(st.integers(0, max(len(content) - 1, 0)))
    kind = draw(st.sampled_from(["numbers", "bytes", "cut", "junk", "swap", "repeat", "drop", "other"]))
    if kind == "numbers":
        numbers = list(NUMBER.finditer(content[:200_000]))
        for found in sorted(
            draw(st.lists(st.sampled_from(numbers), max_size=3)) if numbers else [], key=lambda m: -m.start()
        ):
            extreme = draw(st.sampled_from(EXTREME))
            content = content[: found.start()] + extreme + content[found.end() :]
        return content
    if kind == "bytes":
        return content[:at] + draw(st.binary(min_size=1, max_size=4)) + content[at + 2 :]
    if kind == "cut":
        return content[:at]
    if kind == "junk":
        return content[:at] + draw(st.sampled_from(JUNK)) + content[at:]
    if kind == "other":
        text = st.text(max_size=50).map(str.encode)
        return draw(st.one_of(st.just(b""), st.binary(max_size=300), text))
    lines = content.split(b"\n")
    i, j = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
    if kind == "swap":
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == "repeat":
        lines[j:j] = lines[i : i + 3]
    else:
        del lines[i]
    return b"\n".join(lines)


def _damaged_member(draw: st.DrawFn, content: bytes) -> bytes:
    """An archive with one damaged or missing member."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    if draw(st.integers(0, 9)) == 0:
        del members[name]
    else:
        members[name] = _damaged(draw, members[name])
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return stream.getvalue()


class TooSlowError(BaseException):
    """A reader that took longer than `CPU_SECONDS`; no reader's ``except Exception`` stops it."""


@contextmanager
def bounded() -> Iterator[None]:
    """Limits of time and memory for what runs inside."""

    def stop(*_: object) -> None:
        raise TooSlowError(f"more than {CPU_SECONDS} s")

    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGPROF, stop)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, hard))
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGPROF, before)
