"""CasADi functions as machine code in a cache; interpreted where there is no C compiler."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import subprocess
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.library_cache import Origin, kept, make, trusted
from rtof_kin.core.resources import cache_folder

Built = TypeVar("Built")
_log = logging.getLogger(__name__)
_OPTIONS = ("-O1", "-shared", "-fPIC")
_USED: dict[str, str] = {}
"""What evaluates each kind of library in this process: its file, or that it is interpreted."""
COMPILERS = ("cc", "gcc", "clang")
SWITCH = "RTOF_KIN_COMPILE"
"""Environment variable; 'never' turns compilation off."""
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
