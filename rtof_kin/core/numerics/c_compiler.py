"""CasADi functions as machine code, compiled once and kept; interpreted where there is no compiler."""

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
from numpy.typing import NDArray

from rtof_kin.core.numerics.library_cache import Origin, kept, make, trusted

Array = NDArray[np.float64]
Built = TypeVar("Built")
_log = logging.getLogger(__name__)
_OPTIONS = ("-O1", "-shared", "-fPIC")
COMPILERS = ("cc", "gcc", "clang")
SWITCH = "RTOF_KIN_COMPILE"
"""Environment variable that turns compilation off where it is 'never'."""
BUILDING = threading.RLock()
"""Held while CasADi builds or compiles, and while IPOPT solves. CasADi lets other Python threads run
meanwhile, but it counts references to the nodes of expressions as if there were one thread; MUMPS knows
one alone too. Functions that are built may be evaluated by any thread, each with buffers of its own."""


def cache_folder() -> Path:
    """Where compiled functions are kept: ``RTOF_KIN_CACHE``, or the user's cache folder."""
    given = os.environ.get("RTOF_KIN_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "rtof_kin"


def compiled(functions: list[Any]) -> list[Any]:
    """The same functions compiled together, from the cache where they are there.

    A first compilation takes 10 to 30 s. Where it cannot be done, or ``RTOF_KIN_COMPILE`` is 'never',
    the functions come back as they are and are interpreted: the same numbers, several times slower.
    """

    def source() -> str:
        generator = ca.CodeGenerator("energy.c")
        for function in functions:
            generator.add(function)
        return str(generator.dump())

    def loaded(library: Path) -> list[Any]:
        return [ca.external(function.name(), str(library)) for function in functions]

    made_of = "".join(function.serialize() for function in functions)
    return built(made_of, source, loaded) or functions


def built(
    made_of: str, source: Callable[[], str], loaded: Callable[[Path], Built],
    options: tuple[str, ...] = (), name: str = "energy",
) -> Built | None:  # fmt: skip
    """What a shared library holds, which is made where it is not in the cache; None where it cannot be.

    Args:
        made_of: what tells it from other libraries. source: its C. loaded: opens it.
        options: for the compiler, beside the usual ones; those of one kind of processor are told apart.
        name: of the library; that an energy is being compiled, which takes long, is told.
    """
    if os.environ.get(SWITCH) == "never":
        return None
    try:
        with BUILDING:
            return _loaded(_identity(made_of, options), source, loaded, options, name)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        _log.warning("the energy could not be compiled (%s): it is interpreted, which is slower", error)
        return None


def _loaded(
    identity: str, source: Callable[[], str], loaded: Callable[[Path], Built],
    options: tuple[str, ...], name: str,
) -> Built:  # fmt: skip
    """What a library holds, made where it is not there or cannot be loaded."""
    given = cache_folder().absolute()
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None and not given.is_dir():
        raise OSError("there is no C compiler")
    folder = trusted(given)
    if compiler is None:  # one that any compiler made
        there = sorted(folder.glob(f"{name}_{identity[:24]}_*.so"))
        if library := next((found for found in there if kept(found, identity)), None):
            return loaded(library)
        raise OSError("there is no C compiler")
    origin = Origin(identity, _version(compiler))
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
    except (OSError, RuntimeError):  # of another machine
        make(library, origin, write, again=True)
        return loaded(library)


def native() -> tuple[str, ...]:
    """Compiler options for the processor at hand, where its kind can be told from others'."""
    return ("-march=native",) if _processor() else ()


@lru_cache
def _processor() -> str:
    """What tells one kind of processor from another; empty where that is not known."""
    path = Path("/proc/cpuinfo")
    if platform.system() != "Linux" or not path.is_file():
        return ""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    known = ("flags", "Features", "model name", "CPU implementer", "CPU part")
    return " ".join(sorted({line for line in lines if line.startswith(known)}))


@lru_cache
def _version(compiler: str) -> str:
    """What tells a compiler from others."""
    told = subprocess.run([compiler, "--version"], capture_output=True, text=True, timeout=60)
    return f"{Path(compiler).name}: {told.stdout.partition(chr(10))[0]}"


def _identity(made_of: str, options: tuple[str, ...]) -> str:
    """SHA-256 of what a library follows from, but for the compiler."""
    kind = _processor() if options else ""
    made = f"{ca.CasadiMeta.version()} {platform.system()} {platform.machine()} {kind}"
    return hashlib.sha256(f"{made} {_OPTIONS} {options} {made_of}".encode()).hexdigest()


def _compile(source: str, library: Path, compiler: str, options: tuple[str, ...]) -> None:
    """Make a shared library; its source stays beside it."""
    written = library.with_name("energy.c")
    written.write_text(source, encoding="utf-8")
    subprocess.run(
        [compiler, *_OPTIONS, *options, str(written), "-o", str(library), "-lm"],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip


class Buffered:
    """A CasADi function on buffers of its own: no conversions, no copies of what does not change."""

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
        """Evaluate with these as the first inputs; the outputs hold until the next call."""
        for array, value in zip(self.inputs, values, strict=False):
            array[:] = value
        self._evaluate()
        return self.outputs
