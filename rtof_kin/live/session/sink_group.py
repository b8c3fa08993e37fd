"""`SinkGroup`: the sinks of a session; one that fails is dropped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

from rtof_kin.live.samples import OnlineEstimate, Sink


class SinkGroup:
    """Gives estimates and messages to all sinks that still take them."""

    def __init__(self, sinks: Sequence[Sink]):
        """Take the sinks."""
        self._sinks = list(sinks)

    def send(self, estimate: OnlineEstimate) -> list[str]:
        """Give an estimate; return a sentence for each sink that is dropped."""
        return self._each(lambda sink: sink.send(estimate))

    def tell(self, sentence: str) -> list[str]:
        """Give a message; return a sentence for each sink that is dropped."""
        return self._each(lambda sink: sink.tell(sentence))

    def close(self) -> None:
        """Close all; may be called twice."""
        for sink in self._sinks:
            with suppress(Exception):
                sink.close()

    def _each(self, call: Callable[[Sink], None]) -> list[str]:
        dropped = []
        for sink in tuple(self._sinks):
            try:
                call(sink)
            except Exception as error:  # of a foreign listener or library
                self._sinks.remove(sink)
                with suppress(Exception):
                    sink.close()
                why = str(error) or type(error).__name__
                dropped.append(f"{type(sink).__name__}: gets no more estimates ({why})")
        return dropped
