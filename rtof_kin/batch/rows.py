"""Rows of a batch's table, and the files that keep those of each shard.

A row is appended to its shard's file, one line of JSON, as soon as its recording ends; a line that a killed
process left incomplete is ignored. Of several rows of one recording the one of the latest run counts: runs
are numbered, since clocks may differ or be set back.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final, Self

from rtof_kin.core.errors import WritingError
from rtof_kin.core.files.text import write_text
from rtof_kin.reporting.audit_results import Grade

ERROR: Final = "error"
"""Verdict of a recording on which a command failed."""
DONE: Final = "done"
"""Verdict of one without a motion, whose commands all succeeded."""
WORST_FIRST: Final = (
    ERROR,
    *(g.value for g in (Grade.FAIL, Grade.WARN, Grade.WEAK, Grade.NOT_CHECKED, Grade.PASS)),
    DONE,
)


@dataclass(frozen=True)
class Row:
    """What is known of one recording after its commands."""

    recording: str
    """Its name, which is its folder in the output."""
    verdict: str = ERROR
    """`ERROR`, a `Grade`'s value of the reconstruction, or `DONE`."""
    sentence: str = ""
    """Why."""
    step: str = ""
    """Command that failed."""
    error: str = ""
    frames: int = 0
    duration_s: float = 0.0
    """Of the motion."""
    seconds: float = 0.0
    """Sum over its commands, of the runs that gave the present results."""
    cpu_seconds: float = 0.0
    """The same of the processor."""
    peak_memory_mb: float = 0.0
    output_mb: float = 0.0
    version: str = ""
    """Of this package."""
    report: str = ""
    """Page of the report in its folder; '' if there is none."""
    log: str = ""
    """What the last command printed, in its folder."""

    @classmethod
    def of_plain(cls, plain: Any) -> Self | None:
        """Return a row, or None if it is none."""
        if not isinstance(plain, dict) or not isinstance(plain.get("recording"), str):
            return None
        row = cls("")
        known = {f.name: type(getattr(row, f.name)) for f in fields(cls)}
        try:
            values = {name: known[name](value) for name, value in plain.items() if name in known}
        except (TypeError, ValueError):
            return None
        bad = any(isinstance(value, float) and not math.isfinite(value) for value in values.values())
        return None if bad else cls(**values)

    def plain(self) -> dict[str, Any]:
        """Return the row as JSON data."""
        return asdict(self)

    @property
    def severity(self) -> tuple[int, str]:
        """Sort key, worst first."""
        place = WORST_FIRST.index(self.verdict) if self.verdict in WORST_FIRST else len(WORST_FIRST)
        return place, self.recording


Numbered = tuple[int, Row]
"""Number of the run, and its row."""


class RowFile:
    """Rows of one shard, kept as they come."""

    def __init__(self, path: Path, run: int, rows: Mapping[str, Numbered]):
        """Write the rows of earlier runs anew, without what a killed process left, and open for more."""
        self.path, self.run, self.rows = path, run, dict(rows)
        write_text(path, "".join(_line(n, row) for n, row in rows.values()), overwrite=True)

    def add(self, row: Row) -> None:
        """Append a row.

        Raises:
            WritingError: it cannot be written; the file is as before then.
        """
        self.rows[row.recording] = (self.run, row)
        size = None
        try:
            with self.path.open("ab", buffering=0) as stream:
                size = os.fstat(stream.fileno()).st_size
                line = _line(self.run, row).encode()
                if stream.write(line) != len(line):
                    raise OSError("no room for a whole line")
        except OSError as error:
            if size is not None:
                os.truncate(self.path, size)
            raise WritingError(f"{self.path}: cannot be written ({error}); make room and go on") from error


def read_rows(paths: Iterable[Path]) -> dict[str, Numbered]:
    """Return the latest row of each recording.

    Args:
        paths: files of `RowFile`; incomplete lines are ignored.
    """
    latest: dict[str, Numbered] = {}
    for path in paths:
        for line in path.read_bytes().splitlines():
            try:
                plain = json.loads(line)
                run, row = int(plain["run"]), Row.of_plain(plain["row"])
            except (ValueError, KeyError, TypeError):
                continue
            if row is not None and latest.get(row.recording, (-1, row))[0] <= run:
                latest[row.recording] = (run, row)
    return latest


def _line(run: int, row: Row) -> str:
    return json.dumps({"run": run, "row": row.plain()}, separators=(",", ":")) + "\n"
