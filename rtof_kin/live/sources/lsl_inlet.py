"""Connections to streams of the Lab Streaming Layer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import SourceError
from rtof_kin.core.packages import optional

_CONNECT_S: Final = 3.0
"""[s] for the connection, the metadata and the first offset of the clock, each."""
_SETTLE_S: Final = 0.7
"""[s] after the first answer within which another stream of the name answers too; LSL asks every 0.5 s."""
_FORGET_S: Final = 1.5
"""[s] without an answer after which a stream is gone."""
_POLL_S: Final = 0.005
_BUFFER_S: Final = 60
_MOST_SAMPLES: Final = 4096
"""Samples of one call to LSL."""


def load_pylsl() -> Any:
    """Return the module pylsl.

    Raises:
        MissingPackageError: it is not installed, or its library does not load.
    """
    return optional("pylsl", "live", "an LSL stream")


class Inlet:
    """An open connection to one stream of numbers."""

    def __init__(self, info: Any):
        """Connect.

        Args:
            info: `pylsl.StreamInfo` of a resolver.

        Raises:
            SourceError: no connection, or a stream of text.
        """
        self._pylsl = load_pylsl()
        stream = info.name()
        if info.channel_format() == self._pylsl.cf_string:
            raise SourceError(f"stream {stream}: sends text; send channels of numbers")
        self._inlet = self._pylsl.StreamInlet(info, max_buflen=_BUFFER_S, as_numpy=True)
        try:
            self._info = self._inlet.info(_CONNECT_S)
            self._inlet.open_stream(_CONNECT_S)
        except (self._pylsl.util.TimeoutError, self._pylsl.util.LostError) as error:
            raise SourceError(
                f"stream {stream}: answers from {info.hostname()}, but no connection opens; check the firewall there"
            ) from error
        self.rate_hz = float(self._info.nominal_srate())
        """Nominal rate, Hz; 0 where irregular."""
        self.count = int(self._info.channel_count())
        """Number of channels."""

    def texts(self, field: str) -> list[str]:
        """Return a field of the channels in the metadata, such as their labels; it may lack some.

        Args:
            field: ``label``, ``unit`` or ``type``.
        """
        node, found = self._info.desc().child("channels").child("channel"), []
        while not node.empty():
            found.append(node.child_value(field))
            node = node.next_sibling("channel")
        return found

    def offset_s(self, wait_s: float = 0.0) -> float | None:
        """Return what is to be added to stamps for this machine's clock, s; None where not known yet.

        Args:
            wait_s: s that the first measurement may take.

        Raises:
            ConnectionError: the stream is lost.
        """
        try:
            return float(self._inlet.time_correction(wait_s))
        except self._pylsl.util.TimeoutError:
            return None
        except self._pylsl.util.LostError as error:
            raise ConnectionError(str(error)) from error

    def pull(self) -> tuple[Array, Array]:
        """Return stamps (T,) and values (T, C) that have arrived, without waiting.

        Raises:
            ConnectionError: the stream is lost.
        """
        stamps, values = [np.zeros(0)], [np.zeros((0, self.count))]
        while len(stamps) == 1 or len(stamps[-1]) == _MOST_SAMPLES:
            try:
                some, at = self._inlet.pull_chunk(0.0, max_samples=_MOST_SAMPLES)
            except self._pylsl.util.LostError as error:
                raise ConnectionError(str(error)) from error
            stamps.append(at)
            values.append(some)
        return np.concatenate(stamps), np.concatenate(values)

    def now(self) -> float:
        """Return the LSL time of this machine, s."""
        return float(self._pylsl.local_clock())

    def close(self) -> None:
        """Close the connection."""
        self._inlet.close_stream()


def find_one(stream: str, timeout_s: float) -> tuple[Inlet, float | None]:
    """Connect to the stream of a name, of which there must be one.

    Args:
        timeout_s: s that it has to answer.

    Returns:
        The connection, and the first measured offset of the sender's clock, s.

    Raises:
        SourceError: no stream, or two, of the name; no connection; a stream of text.
    """
    resolver = load_pylsl().ContinuousResolver()

    def named() -> list[Any]:
        return [info for info in resolver.results() if info.name() == stream]

    if not wait_until(lambda: bool(named()), timeout_s):
        others = ", ".join(sorted({info.name() for info in resolver.results()}))
        raise SourceError(
            f"stream {stream}: no LSL stream has this name after {timeout_s:g} s; "
            + (f"there are {others}" if others else "there is no LSL stream at all; start its sender")
        )
    settled = time.monotonic() + _SETTLE_S
    inlet = Inlet(named()[0])
    try:
        offset = inlet.offset_s(_CONNECT_S)
    except ConnectionError as error:
        raise SourceError(f"stream {stream}: was lost while it was connected; start its sender") from error
    if wait_until(lambda: len(named()) > 1, settled - time.monotonic()):
        inlet.close()
        each = " and ".join(f"source_id {one.source_id() or 'none'} on {one.hostname()}" for one in named())
        raise SourceError(f"stream {stream}: {len(named())} have this name, {each}; stop or rename all but one")
    return inlet, offset


def find_again(stream: str, stop: Callable[[], bool]) -> Inlet | None:
    """Wait until a lost stream is there again, and connect.

    Args:
        stop: returns True to give up.

    Returns:
        The connection; None where it was given up.
    """
    resolver = load_pylsl().ContinuousResolver("name", stream, forget_after=_FORGET_S)
    while not stop():
        if wait_until(lambda: stop() or bool(resolver.results()), _CONNECT_S) and not stop():
            try:
                return Inlet(resolver.results()[0])
            except (SourceError, IndexError):  # it went again meanwhile
                continue
    return None


def wait_until(holds: Callable[[], bool], timeout_s: float) -> bool:
    """Return whether a condition holds within a time; it is asked at least once.

    Args:
        timeout_s: s.
    """
    deadline = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(_POLL_S)
    return True
