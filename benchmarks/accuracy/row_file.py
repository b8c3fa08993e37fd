"""Rows on disk, to resume an interrupted run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from rich.progress import Progress

import rtof_kin
from benchmarks.accuracy.rows import Row
from benchmarks.harness import HERE
from rtof_kin.core.errors import RtofError
from rtof_kin.core.resources import model_path


class RowFile:
    """Rows of finished jobs, one job a line, of one version of everything that makes them."""

    def __init__(self, path: Path, version: str, restart: bool = False) -> None:
        """Go on with a file, or begin it.

        Raises:
            RtofError: it was prepared by another version, and is not to be thrown away.
        """
        self.path, self.rows = path, dict[str, list[Row]]()
        if path.is_file() and not restart:
            self._read(version)
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [{"version": version}, *({"job": k, "rows": v} for k, v in self.rows.items())]
        path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    def _read(self, version: str) -> None:
        whole = [s for s in self.path.read_text(encoding="utf-8").splitlines(True) if s[-1] == "\n"]
        lines = [json.loads(line) for line in whole]  # an interrupted last line is no line
        if lines and lines[0].get("version") != version:
            raise RtofError(f"{self.path}: prepared with other code, models or options; --restart throws it away")
        self.rows = {line["job"]: line["rows"] for line in lines[1:]}

    def add(self, job: str, rows: list[Row]) -> None:
        """Keep the rows of a finished job."""
        self.rows[job] = rows
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"job": job, "rows": rows}) + "\n")

    def collect(self, work: Mapping[str, Callable[[], list[Row]]], workers: int) -> list[Row]:
        """Rows of all jobs in their order, of several processes; those done earlier are taken from the file."""
        left = {job: function for job, function in work.items() if job not in self.rows}
        with Progress() as progress, ProcessPoolExecutor(workers) as pool:
            task = progress.add_task("recordings", total=len(work), completed=len(work) - len(left))
            futures = {pool.submit(function): job for job, function in left.items()}
            try:
                for future in as_completed(futures):
                    self.add(futures[future], future.result())
                    progress.advance(task)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return [row for job in work for row in self.rows[job]]


def write_rows(out: Path, text: str, content: Row, rows: Sequence[Row]) -> str:
    """Write the JSON, a line a row, and the Markdown beside it; the Markdown."""
    body = json.dumps(content, indent=1)[:-2]
    lines = ",\n".join("  " + json.dumps(row) for row in rows)
    out.with_suffix(".json").write_text(f'{body},\n "rows": [\n{lines}\n ]\n}}\n', encoding="utf-8")
    out.with_suffix(".md").write_text(text.rstrip() + "\n", encoding="utf-8")
    return text


def version_of(*options: object) -> str:
    """Digest of the code, the models and some options that rows depend on."""
    package = Path(rtof_kin.__file__).parent
    sources = [*package.rglob("*.py"), *(HERE.parent / "lifting").rglob("*.py")]
    sources += [*Path(__file__).parent.glob("*.py"), HERE / "harness.py", HERE / "split.toml"]
    sources += [model_path(name) for name in ("lifter.npz", "pose_prior.npz", "skeleton.toml")]
    digest = hashlib.sha256(repr(options).encode())
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()
