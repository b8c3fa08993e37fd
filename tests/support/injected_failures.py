"""Failures at every write: each call that writes, opens, renames, links, syncs or makes a folder, in turn."""

from __future__ import annotations

import builtins
import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from rtof_kin.core.files import folder as folder_module

SYSTEM_CALLS = ("replace", "rename", "link", "fsync", "mkdir", "open", "truncate")
REAL_OPEN = io.open


class Failures:
    """Counts the calls in a folder, and lets one of them fail, or all from it on."""

    def __init__(self, root: Path, error: BaseException | None = None, at: int = 0, lasting: bool = False):
        self.root, self.error, self.at, self.lasting = os.path.realpath(root), error, at, lasting
        self.calls: list[str] = []

    def call(self, what: str) -> None:
        self.calls.append(what)
        n = len(self.calls)
        if self.error is not None and (n == self.at or (self.lasting and n > self.at)):
            raise self.error

    def concerns(self, path: Any) -> bool:
        return isinstance(path, str | os.PathLike) and os.path.realpath(path).startswith(self.root)

    def open(
        self,
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: Any = None,
        errors: Any = None,
        newline: Any = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        """`open` whose files count what reaches the system."""
        if not self.concerns(file) or not set(mode) & set("wxa+"):
            return REAL_OPEN(file, mode, buffering, encoding, errors, newline, closefd, opener)
        self.call(f"open {os.path.basename(file)}")
        raw = _File(self, file, mode.replace("b", "").replace("t", ""), closefd, opener)
        if buffering == 0:
            return raw
        whole: Any = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return whole if "b" in mode else io.TextIOWrapper(whole, encoding or "utf-8", errors, newline)


class _File(io.FileIO):
    def __init__(self, failures: Failures, file: Any, *how: Any):
        self._failures, self._label = failures, os.path.basename(file)
        super().__init__(file, *how)

    def write(self, data: Any) -> int:
        self._failures.call(f"write {self._label}")
        return super().write(data) or 0


@contextmanager
def injected(failures: Failures) -> Iterator[Failures]:
    """Let the calls of this process go through `failures`."""
    real = {name: getattr(os, name) for name in SYSTEM_CALLS}
    exchange = folder_module._exchange_at_once

    def counted(name: str) -> Callable[..., Any]:
        def call(path: Any, *rest: Any, **how: Any) -> Any:
            writes = name != "open" or (rest and rest[0] & (os.O_WRONLY | os.O_RDWR))
            if writes and (name == "fsync" or failures.concerns(path)):
                failures.call(name)
            return None if name == "fsync" else real[name](path, *rest, **how)  # syncing takes long

        return call

    def exchanged(first: Path, second: Path) -> None:
        failures.call("exchange")
        exchange(first, second)

    with (
        patch.multiple(os, **{name: counted(name) for name in SYSTEM_CALLS}),
        patch.object(io, "open", failures.open),
        patch.object(builtins, "open", failures.open),
        patch.object(folder_module, "_exchange_at_once", exchanged),
    ):
        yield failures


Kind = Callable[[str], tuple[BaseException, bool]]
"""Gives the error of a call, and whether all calls after it fail too."""


def each_failure(
    root: Path, act: Callable[[], object], kinds: Sequence[Kind], prepare: Callable[[], object]
) -> Iterator[tuple[str, BaseException | None]]:
    """Do something once for each of its calls, which fails; yields the call and what was raised.

    Of calls in a row that differ in a number alone, as of the arrays of one file, the first fails.

    Args:
        root: folder whose files count. act: is done. kinds: taken in turn. prepare: done before it.
    """
    prepare()
    with injected(Failures(root)) as clean:
        act()
    names = [re.sub(r"[0-9]+", "", call) for call in clean.calls]
    edges = [at for at, name in enumerate(names, start=1) if at == 1 or name != names[at - 2]]
    for n, at in enumerate(edges):
        error, lasting = kinds[n % len(kinds)](names[at - 1])
        raised: BaseException | None = None
        prepare()
        with injected(Failures(root, error, at, lasting)) as failures:
            try:
                act()
            except BaseException as caught:  # whatever it is, the test looks at it
                raised = caught
        assert len(failures.calls) >= at
        yield f"call {at}, {failures.calls[at - 1]}: {error!r}", raised
