"""`Feed`: a source that is started again where it fails."""

from __future__ import annotations

from threading import Thread
from typing import Final

from rtof_kin.live.samples import Sample, Source

_FIRST_PAUSE: Final = 0.5
_LONGEST_PAUSE: Final = 8.0  # [s] between attempts


class Feed:
    """Polls one source; whatever it raises becomes a sentence and another attempt after a pause.

    An attempt is another `Source.start`, which does nothing where the source is open, and polls from then on.
    """

    def __init__(self, source: Source, in_background: bool = False):
        """Take a source that is not started yet.

        `in_background`: start it in a thread, as finding a stream may take seconds.
        """
        self.source, self.name = source, source.name
        self._in_background = in_background
        self._running, self._closed = False, False
        self._starting: Thread | None = None
        self._problem: BaseException | None = None
        self._next, self._pause = float("-inf"), _FIRST_PAUSE
        self._told = ""
        self._sentences: list[str] = []
        self.finished = False
        """Whether no further sample will come."""

    def poll(self, arrival: float) -> list[Sample]:
        """Return what has arrived; start the source where that is due. `arrival`: now, s on this machine's clock."""
        if self._closed or self.finished or not (self._running or self._started(arrival)):
            return []
        try:
            over = self.source.finished
            samples = self.source.poll()
            self._sentences += [self._named(text) for text in self.source.notices()]
        except Exception as error:  # of a foreign device or library
            self._fail(error, arrival)
            return []
        if samples:
            self._pause = _FIRST_PAUSE
            if self._told:
                self._told = ""
                self._sentences.append(f"{self.name}: goes on")
        self.finished = over and not samples
        return samples

    def sentences(self) -> list[str]:
        """Return sentences since the last call: those of the source, failures and recoveries."""
        sentences, self._sentences = self._sentences, []
        return sentences

    def close(self) -> None:
        """Stop; may be called twice."""
        self._closed = True
        try:
            self.source.close()
        except Exception as error:  # of a foreign device or library
            self._tell(error, "")

    def _started(self, arrival: float) -> bool:
        """Begin or go on to start the source; return whether it runs."""
        if self._starting is not None:
            if self._starting.is_alive():
                return False
            self._starting = None
            return self._outcome(arrival)
        if arrival < self._next:
            return False
        self._problem = None
        if self._in_background:
            self._starting = Thread(target=self._start, name=f"start {self.name}", daemon=True)
            self._starting.start()
            return False
        self._start()
        return self._outcome(arrival)

    def _start(self) -> None:
        try:
            self.source.start()
        except Exception as error:  # of a foreign device or library
            self._problem = error
        if self._closed:  # meanwhile
            self.source.close()

    def _outcome(self, arrival: float) -> bool:
        if self._problem is not None:
            self._fail(self._problem, arrival)
        else:
            self._running = True
        return self._running

    def _fail(self, error: BaseException, arrival: float) -> None:
        self._running = False
        self._next, self._pause = arrival + self._pause, min(2 * self._pause, _LONGEST_PAUSE)
        self._tell(error, "; it is tried again")

    def _tell(self, error: BaseException, what_follows: str) -> None:
        text = self._named(str(error) or type(error).__name__)
        if text != self._told:
            self._told = text
            self._sentences.append(text + what_follows)

    def _named(self, text: str) -> str:
        return text if text.startswith(self.name) else f"{self.name}: {text}"
