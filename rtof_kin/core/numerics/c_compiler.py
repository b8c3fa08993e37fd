"""CasADi functions as machine code in a cache; interpreted where there is no C compiler.

Cache folder of shared libraries, shared by all processes of a user; the name of each has the SHA-256 of its source,
options and processor, and its compiler. Nothing is loaded from a folder or file that another user could write to.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from filelock import FileLock, Timeout

from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import package_version, processor
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.core.resources import cache_folder

Built = TypeVar("Built")
_log = logging.getLogger(__name__)
_OPTIONS = ("-O1", "-shared", "-fPIC")
_USED: dict[str, str] = {}  #: What evaluates each kind of library in this process: its file, or that it is interpreted
COMPILERS = ("cc", "gcc", "clang")
SWITCH = "RTOF_KIN_COMPILE"  #: Environment variable; 'never' turns compilation off
BUILDING = threading.RLock()
"""Lock for building and compiling with CasADi and solving with IPOPT: CasADi releases the GIL, but its reference counts
of expression nodes and MUMPS are not thread-safe. Any thread may evaluate a function that is built, with buffers of its
own."""


def built(
    made_of: str,
    source: Callable[[], str],
    loaded: Callable[[Path], Built],
    options: tuple[str, ...] = (),
    name: str = "energy",
) -> Built | None:
    """Return the contents of a shared library, compiled unless it is cached; None if impossible.

    Args:
        options: further compiler options; if any, the library is specific to this kind of processor. name: of the
        library; compiling an 'energy', which takes long, is logged.
    """
    _USED[name] = "interpreted"
    if os.environ.get(SWITCH) == "never":
        return None
    try:
        with BUILDING:
            return _loaded(made_of, source, loaded, options, name)
    except (OSError, RuntimeError, RtofError, subprocess.SubprocessError) as error:
        _log.warning("the energy could not be compiled (%s): it is interpreted, which is slower", error)
        _USED[name] = "interpreted"
        return None


def evaluated() -> str:
    """Return how this process evaluated the energy, which differs in the last bits: compiled, or not."""
    return ", ".join(sorted(set(_USED.values()))) or "interpreted"


def _loaded(
    made_of: str, source: Callable[[], str], loaded: Callable[[Path], Built], options: tuple[str, ...], name: str
) -> Built:
    """Return the contents of a library, compiled if it is missing or cannot be loaded."""
    kind = processor() if options else ""
    system = f"{package_version('casadi')} {platform.system()} {platform.machine()} {kind}"
    identity = hashlib.sha256(f"{system} {_OPTIONS} {options} {made_of}".encode()).hexdigest()
    folder = cache_folder().absolute()
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None:  # accept the library of any compiler
        _USED[name] = "compiled before"
        there = sorted(folder.glob(f"{name}_{identity}_*.so"))
        if there and _is_own(there[0]):
            _check_folder(folder)
            return loaded(there[0])
        raise OSError("there is no C compiler")
    make_folders(folder)
    _check_folder(folder)
    version = _version(compiler)
    _USED[name] = f"compiled by {version}"
    library = folder / f"{name}_{identity}_{hashlib.sha256(version.encode()).hexdigest()[:8]}.so"

    def compiled(again: bool) -> Built:
        if again or not _is_own(library):
            with _locked(library):
                if again or not _is_own(library):  # else another process has compiled it meanwhile
                    if name == "energy":
                        _log.warning("compiling the energy, once for this kind of recording: 10 to 30 s ...")
                    library.unlink(missing_ok=True)
                    with new_file(library, overwrite=True) as made:
                        (written := made.with_name("energy.c")).write_text(source(), encoding="utf-8")
                        command = [compiler, *_OPTIONS, *options, str(written), "-o", str(made), "-lm"]
                        subprocess.run(command, check=True, capture_output=True, timeout=300)
        return loaded(library)

    try:
        return compiled(again=False)
    except (OSError, RuntimeError):  # built on another machine
        return compiled(again=True)


def _locked(library: Path) -> Any:
    """Acquire the lock of a library; waiting is logged."""
    lock = FileLock(library.with_suffix(".lock"), mode=0o600)
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        _log.warning("another process compiles %s: waiting for it ...", library.name)
        return lock.acquire()


def _check_folder(folder: Path) -> None:
    """Raise OSError where another user could put a library into a folder."""
    if sys.platform == "win32":  # access rights are not in the bits
        return
    doubtful = [] if _is_own(folder) else [folder]
    for parent in folder.resolve().parents:
        status = parent.stat()
        open_to_all = status.st_mode & (stat.S_IWOTH | stat.S_ISVTX) == stat.S_IWOTH  # in /tmp, users replace their own
        if open_to_all or status.st_uid not in (0, os.geteuid()):
            doubtful.append(parent)
    if doubtful:
        raise OSError(f"others may write to {doubtful[0]}; set RTOF_KIN_CACHE to a folder of your own")


def _is_own(path: Path) -> bool:
    """Return whether a file or folder exists and no other user than root can write to it."""
    if not path.exists() or sys.platform == "win32":
        return path.exists()
    status = path.stat()
    return status.st_uid in (0, os.geteuid()) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def native() -> tuple[str, ...]:
    """Return compiler options for this processor, if its kind can be identified."""
    return ("-march=native",) if Path("/proc/cpuinfo").is_file() else ()


@lru_cache
def _version(compiler: str) -> str:
    """Return name and version of a compiler."""
    answer = subprocess.run([compiler, "--version"], capture_output=True, text=True, timeout=60)
    return f"{Path(compiler).name}: {answer.stdout.partition(chr(10))[0]}"


class Buffered:
    """A CasADi function with its own buffers, without conversions or copies of constant inputs."""

    def __init__(self, function: Any) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._function = function
        self.inputs = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self.outputs = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self.inputs):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type]
        for i, array in enumerate(self.outputs):
            self._buffer.set_res(i, memoryview(array))  # type: ignore[arg-type]

    def __call__(self, *values: Array) -> list[Array]:
        """Evaluate with new first inputs; the outputs are valid until the next call."""
        for array, value in zip(self.inputs, values, strict=False):
            array[:] = value
        self._evaluate()
        return self.outputs
