"""CasADi functions as machine code in a cache; interpreted where there is no C compiler.

Cache folder of shared libraries, shared by all processes of a user. Beside each library is a record with the SHA-256 of
its bytes, its source and its compiler. A library that differs from its record (truncated, exchanged, of another source)
is compiled again. Nothing is loaded from a folder that another user could write to; `trusted` returns a private folder
instead.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import logging
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from filelock import FileLock, Timeout

from rtof_kin.core.array_types import Array
from rtof_kin.core.files.manifest import sync
from rtof_kin.core.resources import cache_folder


@dataclass(frozen=True)
class Origin:
    """Source and compiler of a library."""

    source: str  #: SHA-256 of everything that determines the C source and the options
    compiler: str  #: Name and version


def trusted(folder: Path) -> Path:
    """Return the cache folder, created if missing; if others can write to it, a private one and a warning."""
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    doubt = _doubt(folder.resolve())
    return folder if doubt is None else _private(folder, doubt)


def kept(library: Path, source: str) -> bool:
    """Return whether a library exists, matches its record and has this source. source: see `Origin`."""
    try:
        record = json.loads(_own_bytes(library.with_suffix(".json")))
        sha256 = hashlib.sha256(_own_bytes(library)).hexdigest()
        return bool(record["source"] == source and record["sha256"] == sha256)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def make(library: Path, origin: Origin, write: Callable[[Path], None], again: bool = False) -> None:
    """Build a library and its record, unless another process has done so meanwhile; `again`: even if it matches its
    record.
    """
    with _locked(library):
        if kept(library, origin.source) and not again:
            return
        _remove_dead_builds(library)
        build = library.with_suffix(".build")
        build.mkdir(mode=0o700)
        try:
            made, record = build / library.name, build / "record.json"
            write(made)
            sha256 = hashlib.sha256(made.read_bytes()).hexdigest()
            record.write_text(json.dumps({"sha256": sha256, **asdict(origin)}), encoding="utf-8")
            for new, place in ((made, library), (record, library.with_suffix(".json"))):
                new.chmod(0o700)
                sync(new)
                new.replace(place)  # atomic
        finally:
            shutil.rmtree(build, ignore_errors=True)


def _locked(library: Path) -> AbstractContextManager[object]:
    """Acquire the lock of a library; waiting is logged."""
    lock = FileLock(library.with_suffix(".lock"), mode=0o600)
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        _log.warning("another process compiles %s: waiting for it ...", library.name)
        return lock.acquire()


def _remove_dead_builds(library: Path) -> None:
    """Remove leftovers of killed builds: of this library, and of others that are not locked."""
    for left in library.parent.glob("*.build"):
        try:
            own = left.stem == library.stem
            lock = FileLock(left.with_suffix(".lock"), timeout=0, mode=0o600)
            with nullcontext() if own else lock:
                shutil.rmtree(left, ignore_errors=True)
        except Timeout:
            pass  # being built


def _own_bytes(path: Path) -> bytes:
    """Return the contents of a file; raise OSError if other users can write to it."""
    with path.open("rb") as file:
        if _writable_by_others(os.fstat(file.fileno())):
            raise PermissionError(f"{path}: others may write to it")
        return file.read()


# --- permissions ---------------------------------------------------------------------------------


def _writable_by_others(status: os.stat_result) -> bool:
    """Return whether anyone except this user and root may write."""
    if sys.platform == "win32":  # access rights are not in these bits
        return False
    return status.st_uid not in (0, os.geteuid()) or bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def _doubt(folder: Path) -> str | None:
    """Return why another user could put a library there; None if not possible."""
    if _writable_by_others(folder.stat()):
        return f"others may write to {folder} (chmod 700 it after a look at its contents, or delete it)"
    for parent in folder.parents:
        status = parent.stat()
        if _writable_by_others(status) and not _sticky(status) and not _of_own_group(status):
            return f"others may replace folders in {parent}"
    return None


def _sticky(status: os.stat_result) -> bool:
    """Return whether users can replace only their own entries of a folder of this user or root."""
    own = sys.platform == "win32" or status.st_uid in (0, os.geteuid())
    return own and bool(status.st_mode & stat.S_ISVTX)


def _of_own_group(status: os.stat_result) -> bool:
    """Return whether a folder belongs to this user and its group has no other member."""
    if sys.platform == "win32":
        return True
    import grp
    import pwd

    if status.st_uid != os.geteuid() or status.st_mode & stat.S_IWOTH:
        return False
    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(status.st_gid)
    except KeyError:
        return False
    return group.gr_name == user.pw_name and {*group.gr_mem} <= {user.pw_name}


@lru_cache
def _private(folder: Path, doubt: str) -> Path:
    """Return a folder of this process in place of an unsafe one."""
    private = Path(tempfile.mkdtemp(prefix="rtof_kin_"))
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    _log.warning(
        "compiled code is not kept in %s: %s. It is compiled for this process alone; "
        "set RTOF_KIN_CACHE to a folder of your own to keep it",
        folder,
        doubt,
    )
    return private


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
            return _loaded(_identity(made_of, options), source, loaded, options, name)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        _log.warning("the energy could not be compiled (%s): it is interpreted, which is slower", error)
        _USED[name] = "interpreted"
        return None


def evaluated() -> str:
    """Return how this process evaluated the energy, which differs in the last bits: compiled, or not."""
    return ", ".join(sorted(set(_USED.values()))) or "interpreted"


def _loaded(
    identity: str, source: Callable[[], str], loaded: Callable[[Path], Built], options: tuple[str, ...], name: str
) -> Built:
    """Return the contents of a library, compiled if it is missing or cannot be loaded."""
    given = cache_folder().absolute()
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None and not given.is_dir():
        raise OSError("there is no C compiler")
    folder = trusted(given)
    if compiler is None:  # accept the library of any compiler
        _USED[name] = "compiled before"
        there = sorted(folder.glob(f"{name}_{identity[:24]}_*.so"))
        if library := next((found for found in there if kept(found, identity)), None):
            return loaded(library)
        raise OSError("there is no C compiler")
    origin = Origin(identity, _version(compiler))
    _USED[name] = f"compiled by {origin.compiler}"
    of_compiler = hashlib.sha256(origin.compiler.encode()).hexdigest()[:8]
    library = folder / f"{name}_{identity[:24]}_{of_compiler}.so"

    def write(made: Path) -> None:
        if name == "energy":
            _log.warning("compiling the energy, once for this kind of recording: 10 to 30 s ...")
        _compile(source(), made, compiler, options)

    if not kept(library, identity):
        make(library, origin, write)
    try:
        return loaded(library)
    except (OSError, RuntimeError):  # built on another machine
        make(library, origin, write, again=True)
        return loaded(library)


def native() -> tuple[str, ...]:
    """Return compiler options for this processor, if its kind can be identified."""
    return ("-march=native",) if _processor() else ()


@lru_cache
def _processor() -> str:
    """Return the identity of this kind of processor; empty if unknown."""
    path = Path("/proc/cpuinfo")
    if platform.system() != "Linux" or not path.is_file():
        return ""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    known = ("flags", "Features", "model name", "CPU implementer", "CPU part")
    return " ".join(sorted({line for line in lines if line.startswith(known)}))


@lru_cache
def _version(compiler: str) -> str:
    """Return name and version of a compiler."""
    answer = subprocess.run([compiler, "--version"], capture_output=True, text=True, timeout=60)
    return f"{Path(compiler).name}: {answer.stdout.partition(chr(10))[0]}"


def _identity(made_of: str, options: tuple[str, ...]) -> str:
    """Return the SHA-256 of everything that determines a library except the compiler."""
    kind = _processor() if options else ""
    made = f"{ca.CasadiMeta.version()} {platform.system()} {platform.machine()} {kind}"
    return hashlib.sha256(f"{made} {_OPTIONS} {options} {made_of}".encode()).hexdigest()


def _compile(source: str, library: Path, compiler: str, options: tuple[str, ...]) -> None:
    """Compile a shared library; its source stays beside it."""
    written = library.with_name("energy.c")
    written.write_text(source, encoding="utf-8")
    subprocess.run(
        [compiler, *_OPTIONS, *options, str(written), "-o", str(library), "-lm"],
        check=True,
        capture_output=True,
        timeout=300,
    )


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
