"""Where a computation runs: versions of code and libraries, the processor, threads and memory.

Nothing of it names a person, a machine or a folder.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


RESULT_WARNINGS: Final = "rtof_kin.reconstruction.pipeline.warnings"
"""Logger of failed checks, stream faults and warnings of a reconstruction, which its audit and summary list too."""


@contextmanager
def without_warnings(*loggers: str) -> Iterator[None]:
    """Silence warnings of loggers and of those below them, by default of `RESULT_WARNINGS`."""
    silent = [logging.getLogger(name) for name in loggers or (RESULT_WARNINGS,)]
    before = [logger.level for logger in silent]
    try:
        for logger in silent:
            logger.setLevel(logging.ERROR)
        yield
    finally:
        for logger, level in zip(silent, before, strict=True):
            logger.setLevel(level)


def threads() -> int | None:
    """Return the number of threads set in the environment; None if unset."""
    text = os.environ.get(VARIABLES[0], "")
    return int(text) if text.isdecimal() else None


def limit_threads() -> None:
    """Give numerical libraries the threads of the environment, by default one, unless they are loaded already: matrices
    are small, and a second thread doubles the processor time of the demo without a gain.
    """
    if "numpy" not in sys.modules:
        os.environ.update(dict.fromkeys(VARIABLES, str(threads() or 1)))


def keep_freed_memory() -> None:
    """Let this process and those that it starts serve arrays below 32 MB from freed memory, where the C library is
    glibc: a lift otherwise has a hundred thousand pages mapped and cleared anew.
    """
    with suppress(AttributeError, OSError, TypeError):
        for number, name in ((-1, "MALLOC_TRIM_THRESHOLD_"), (-3, "MALLOC_MMAP_THRESHOLD_")):  # those of its mallopt
            os.environ.setdefault(name, str(2**25))
            ctypes.CDLL(None).mallopt(number, int(os.environ[name]))


def return_free_memory() -> None:
    """Return memory that was freed to the system, where the C library (glibc) keeps it in pieces; elsewhere
    nothing. A loop with large arrays of changing sizes otherwise grows.
    """
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


PACKAGES: Final = ("numpy", "scipy", "casadi", "pin")  #: Dependencies that compute
SWITCHES: Final = (
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "NPY_ENABLE_CPU_FEATURES",
    "ATEN_CPU_CAPABILITY",
    "ONEDNN_MAX_CPU_ISA",
    "MKL_ENABLE_INSTRUCTIONS",
    "MKL_CBWR",
    "GLIBC_TUNABLES",
)
"""Environment variables by which libraries choose a processor's instructions."""
_ROOT: Final = Path(__file__).parents[2]
_CODE: Final = (".py", ".c", ".h")
_TABLES: Final = (".npz", ".toml", ".urdf", ".msg")
_UNKNOWN: Final = "unknown"


def environment() -> dict[str, str]:
    """Return versions, processor and threads by name; to be called after a computation."""
    found = {}  # linear algebra that NumPy and SciPy were built with, if they are loaded
    for name in ("numpy", "scipy"):
        if (module := sys.modules.get(name)) is not None:
            blas = module.show_config(mode="dicts")["Build Dependencies"]["blas"]
            found[f"BLAS of {name}"] = f"{blas.get('name', _UNKNOWN)} {blas.get('version', '')}".strip()
    return {
        "rtof_kin": package_version("rtof_kin"),
        "rtof_kin source": source_digest()[:16],
        "python": platform.python_version(),
        **{name: package_version(name) for name in PACKAGES},
        **found,
        "C library": " ".join(platform.libc_ver()).strip() or _UNKNOWN,
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor(),
        "instructions": " ".join(f"{n}={os.environ[n]}" for n in SWITCHES if n in os.environ) or "all",
        "threads": str(threads() or _UNKNOWN),
    }


def package_version(name: str) -> str:
    """Return the version of an installed package, else that it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


@cache
def source_digest() -> str:
    """Return the SHA-256 of this package's code and tables, which tells versions of one number apart."""
    found = [path for folder in ("rtof_kin", "lifting", "models") for path in (_ROOT / folder).rglob("*")]
    # tables lie beside the package in a checkout and inside it once installed: the same names either way
    named = [(path.relative_to(_ROOT).as_posix().removeprefix("rtof_kin/"), path) for path in found]
    whole = hashlib.sha256()
    for name, path in sorted(named):
        if path.suffix in _TABLES or (path.suffix in _CODE and not name.startswith("models/")):
            whole.update(f"{name} ".encode())
            whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


@cache
def processor() -> str:
    """Return the processor's model and a digest of its instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    pairs = (line.partition(":") for line in reversed(lines))  # the first processor's win
    facts = {name.strip(): value.strip() for name, _, value in pairs}
    model = facts.get("model name") or facts.get("CPU part") or platform.machine()
    flags = " ".join(sorted((facts.get("flags") or facts.get("Features") or "").split()))
    return f"{model}, instructions {hashlib.sha256(flags.encode()).hexdigest()[:8]}"
