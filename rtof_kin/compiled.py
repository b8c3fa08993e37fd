"""CasADi functions as machine code, compiled once and kept; interpreted where there is no compiler."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)
_OPTIONS = ("-O1", "-shared", "-fPIC")
COMPILERS = ("cc", "gcc", "clang")
SWITCH = "RTOF_KIN_COMPILE"
"""Environment variable that turns compilation off where it is 'never'."""


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
    if os.environ.get(SWITCH) == "never":
        return functions
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    try:
        library = _library(functions)
        if not library.is_file():
            _compile(functions, library, compiler)
        try:
            return _loaded(functions, library)
        except RuntimeError:  # damaged, or of another machine: CasADi says so with this
            library.unlink(missing_ok=True)
            _compile(functions, library, compiler)
            return _loaded(functions, library)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        _log.warning(
            "the energy could not be compiled (%s): it is interpreted, which is slower", error
        )
        return functions


def _loaded(functions: list[Any], library: Path) -> list[Any]:
    return [ca.external(function.name(), str(library)) for function in functions]


def _library(functions: list[Any]) -> Path:
    """Where the shared library of some functions is, or will be."""
    text = "".join(function.serialize() for function in functions)
    made = f"{ca.CasadiMeta.version()} {platform.system()} {platform.machine()} {_OPTIONS}"
    key = hashlib.sha256(f"{made} {text}".encode()).hexdigest()[:24]
    return cache_folder().absolute() / f"energy_{key}.so"


def _compile(functions: list[Any], library: Path, compiler: str | None) -> None:
    """Make the shared library of some functions."""
    if compiler is None:
        raise OSError("there is no C compiler")
    library.parent.mkdir(parents=True, exist_ok=True)
    _log.warning("compiling the energy, once for this kind of recording: 10 to 30 s ...")
    with tempfile.TemporaryDirectory(dir=library.parent) as name:
        generator = ca.CodeGenerator("energy.c")
        for function in functions:
            generator.add(function)
        source, built = Path(name, "energy.c"), Path(name, library.name)
        source.write_text(generator.dump(), encoding="utf-8")
        subprocess.run(
            [compiler, *_OPTIONS, str(source), "-o", str(built)],
            check=True, capture_output=True, timeout=300,
        )  # fmt: skip
        built.replace(library)  # whole or not at all, also with several processes


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
