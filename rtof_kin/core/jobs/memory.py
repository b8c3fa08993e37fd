"""Memory of this machine and of processes, in bytes; None where the system does not tell.

A limit of a container or of a Slurm job (its control group) counts as the machine's memory.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")
_FILES = {
    "": ("memory.max", "memory.current", "inactive_file"),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}
"""Files of a limit and of what is used, and the field of memory that can be taken back, of control groups of
version 2 and 1.
"""


def total_memory() -> int | None:
    """Return the memory of this machine, or the limit of this process's control group."""
    known = [limit for limit, _ in _limits(_PROC, _GROUPS)]
    if sys.platform != "win32":
        with suppress(ValueError, OSError):
            known.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(known, default=None)


def available_memory(proc: Path = _PROC, groups: Path = _GROUPS) -> int | None:
    """Return the memory that new work can have without swapping."""
    known = [limit - used for limit, used in _limits(proc, groups)]
    field = _field(proc / "meminfo", "MemAvailable")
    if field is not None:
        known.append(field)
    return min(known, default=None)


def reset_peak() -> None:
    """Forget this process's peak so far; without effect where the system cannot."""
    with suppress(OSError):
        (_PROC / "self" / "clear_refs").write_text("5", encoding="ascii")


def peak_memory() -> int | None:
    """Return the most memory that this process had since `reset_peak`, else since it began."""
    peak = _field(_PROC / "self" / "status", "VmHWM")
    if peak is None and sys.platform != "win32":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # macOS: bytes
    return peak


def _field(path: Path, name: str) -> int | None:
    """Return a field in kB of a file of /proc, in bytes."""
    try:
        found = re.search(rf"^{name}:\s*(\d+) kB", path.read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        return None
    return 1024 * int(found.group(1)) if found else None


def _limits(proc: Path, groups: Path) -> Iterator[tuple[int, int]]:
    """Yield limit and used memory of every control group that this process is in and that has a limit."""
    try:
        lines = (proc / "self" / "cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        kind = "memory" if "memory" in controllers.split(",") else controllers
        if kind not in _FILES:
            continue
        top = groups / kind
        folder = top / name.strip("/")
        for group in (folder, *(p for p in folder.parents if p.is_relative_to(top))):
            with suppress(OSError, ValueError):  # no such file, or no limit ("max")
                limit_file, used_file, spare = _FILES[kind]
                limit = int((group / limit_file).read_text(encoding="ascii"))
                used = int((group / used_file).read_text(encoding="ascii"))
                stat = (group / "memory.stat").read_text(encoding="ascii")
                found = re.search(rf"^{spare} (\d+)$", stat, re.MULTILINE)
                yield limit, max(0, used - int(found.group(1) if found else 0))
