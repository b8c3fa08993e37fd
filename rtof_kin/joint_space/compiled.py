"""CasADi functions as machine code, compiled once and kept; interpreted where there is no compiler."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import casadi as ca

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
        library = _library(functions, compiler)
    except (OSError, subprocess.SubprocessError) as error:
        _log.warning(
            "the energy could not be compiled (%s): it is interpreted, which is slower", error
        )
        return functions
    if library is None:
        _log.warning("there is no C compiler: the energy is interpreted, which is slower")
        return functions
    return [ca.external(function.name(), str(library)) for function in functions]


def _library(functions: list[Any], compiler: str | None) -> Path | None:
    """The shared library of some functions, compiled if it is not in the cache."""
    text = "".join(function.serialize() for function in functions)
    key = hashlib.sha256(f"{ca.CasadiMeta.version()} {_OPTIONS} {text}".encode()).hexdigest()[:24]
    library = cache_folder() / f"energy_{key}.so"
    if library.is_file():
        return library
    if compiler is None:
        return None
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
    return library
