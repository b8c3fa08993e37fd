"""Batches: what is done is kept, what fails is in the table, faults leave neither half results nor gaps."""

from __future__ import annotations

import csv
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import batch_support
import pytest
from batch_support import batch_of, calls, facts, obey, write_recordings

from rtof_kin.batch.recordings import Shard
from rtof_kin.batch.rows import Row
from rtof_kin.batch.run import Batch, check_chain, claim, run_batch
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.core.jobs import Engine, InThisProcess

VERDICTS = {"e": "error", "s1/a": "pass", "s1/b": "warn", "s2/c": "fail", "s2/d": "error"}
DRIVER = """
import sys
from pathlib import Path
import batch_support
from rtof_kin.batch.run import run_batch
from rtof_kin.core.jobs import Processes
if __name__ == "__main__":
    batch = batch_support.batch_of(Path(sys.argv[1]), Path(sys.argv[2]))
    rows = run_batch(batch, batch_support.obey, Processes(2))
    print(sorted((row.recording, row.verdict) for row in rows))
"""


def run(batch: Batch, engine: Engine | None = None, **how: Any) -> list[Row]:
    return run_batch(batch, obey, engine or InThisProcess(), **how)


def table(out: Path) -> dict[str, dict[str, str]]:
    """Rows of batch.csv by recording."""
    with (out / "batch.csv").open(encoding="utf-8", newline="") as stream:
        return {row["recording"]: row for row in csv.DictReader(stream)}


def files_of(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Content and inode of every file of the results, but for logs."""
    paths = (p for p in folder.rglob("*") if p.is_file() and ".batch" not in p.parts and "log" not in p.parts)
    return {str(p.relative_to(folder)): (p.read_bytes(), p.stat().st_ino) for p in paths}


def results_of(folder: Path) -> dict[str, bytes]:
    """Content of what the commands wrote."""
    own = ("batch.csv", "index.html", "batch.json")
    return {name: content for name, (content, _) in files_of(folder).items() if Path(name).name not in own}


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# --- table and resuming --------------------------------------------------------------------------


def test_every_recording_has_a_row_and_a_failure_stops_none(root: Path, out: Path, log: Path) -> None:
    reports: list[tuple[int, int, str]] = []
    rows = run(batch_of(root, out), progress=lambda *report: reports.append(report))
    assert facts(rows) == VERDICTS
    found = table(out)
    assert list(found) == list(VERDICTS)
    assert {name: row["verdict"] for name, row in found.items()} == VERDICTS
    assert found["s2/d"]["error"] == "s2+d: the take is too short"
    assert found["e"]["error"] == "ZeroDivisionError: divided by nothing"
    assert found["e"]["step"] == "reconstruct"
    good = found["s1/a"]
    assert (good["sentence"], good["frames"], good["duration_s"]) == ("this is <pass> & more", "120", "2.0")
    assert float(good["peak_memory_mb"]) > 10
    assert float(good["output_mb"]) > 0
    assert (out / "s1" / "a" / good["report"]).is_file()
    assert (out / "s1/a/log/reconstruct.txt").read_text() == "doing pass\n"
    assert "Traceback" in (out / "e/log/reconstruct.txt").read_text()
    assert reports[0] == (0, 5, "")
    assert reports[1] == (1, 5, "e failed: reconstruct: ZeroDivisionError: divided by nothing")
    assert calls(log)["e export"] == 0


def test_what_is_done_is_kept_and_what_failed_is_tried_again(root: Path, out: Path, log: Path) -> None:
    run(batch_of(root, out))
    before = calls(log)
    (root / "s2/d/recording.toml").write_text("pass")
    assert facts(run(batch_of(root, out))) == VERDICTS | {"s2/d": "pass"}
    new = calls(log) - before
    assert new == {"e reconstruct": 1, "s2/d reconstruct": 1, "s2/d export": 1, "s2/d report": 1}
    kept = table(out)["s1/a"]
    assert float(kept["seconds"]) > 0  # of the run that made it


def test_only_steps_after_a_change_are_done_again(root: Path, out: Path, log: Path) -> None:
    one = write_recordings(root.parent / "one", a="pass")
    run(batch_of(one, out))
    before = calls(log)
    run(batch_of(one, out, "reconstruct, export --weight 70, report"))
    assert calls(log) - before == {"a export": 1, "a report": 1}
    assert (out / "a/export/angles.csv").read_text() == "--weight 70 --overwrite"
    before = calls(log)
    run(batch_of(one, out, "reconstruct, export --weight 70, report, evaluate"))
    assert calls(log) - before == {"a evaluate": 1}
    assert (out / "a/log/evaluate.txt").read_text() == "evaluate says so\n"
    run(batch_of(one, out, "reconstruct, export --weight 70, report, evaluate"))
    assert calls(log)["a evaluate"] == 1
    (one / "a" / "note.txt").write_text("a new file of the recording")
    before = calls(log)
    run(batch_of(one, out))
    assert calls(log) - before == {"a reconstruct": 1, "a export": 1, "a report": 1}
    run(batch_of(one, out, version="2"))
    assert calls(log)["a reconstruct"] == 3
    (out / "a/motion/motion.h5").unlink()
    run(batch_of(one, out, version="2"))
    assert (out / "a/motion/motion.h5").is_file()


def test_a_file_that_an_option_names_counts_by_its_content(root: Path, out: Path, log: Path) -> None:
    one, model = write_recordings(root.parent / "one", a="pass"), root.parent / "model.pt"
    for content, times in (("first", 1), ("first", 1), ("second", 2)):
        model.write_text(content)
        run(batch_of(one, out, f"reconstruct --model {model}"))
        assert calls(log)["a reconstruct"] == times


def test_overwriting_does_everything_again_even_where_it_was_interrupted(root: Path, out: Path, log: Path) -> None:
    two = write_recordings(root.parent / "two", a="pass", b="pass")
    run(batch_of(two, out))

    def stop(done: int, total: int, text: str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(batch_of(two, out), overwrite=True, progress=stop)
    run(batch_of(two, out))
    assert (calls(log)["a reconstruct"], calls(log)["b reconstruct"]) == (2, 2)


def test_another_source_is_not_mixed_with_the_first(root: Path, out: Path, log: Path) -> None:
    run(batch_of(root, out))
    other = write_recordings(root.parent / "other", s1__a="fail")
    with pytest.raises(OutputExistsError, match=r"holds results of .*takes"):
        run(batch_of(other, out))
    assert table(out)["s1/a"]["verdict"] == "pass"
    assert facts(run(batch_of(other, out), overwrite=True)) == {"s1/a": "fail"}
    assert list(table(out)) == ["s1/a"]


# --- files of the user ---------------------------------------------------------------------------


def test_folders_with_other_files_are_not_changed(root: Path, out: Path, log: Path) -> None:
    (out.parent / "mine").mkdir()
    (out.parent / "mine" / "thesis.txt").write_text("mine")
    with pytest.raises(OutputExistsError, match="files that no batch wrote"):
        run(batch_of(root, out.parent / "mine"))
    assert [p.name for p in (out.parent / "mine").iterdir()] == ["thesis.txt"]
    run(batch_of(root, out))
    (out / "new").mkdir()
    (out / "new" / "thesis.txt").write_text("mine")
    write_recordings(root, new="pass")
    row = run(batch_of(root, out))[1]
    assert (row.recording, row.verdict) == ("new", "error")
    assert "files that no batch wrote" in row.error
    assert [p.name for p in (out / "new").iterdir()] == ["thesis.txt"]


def test_an_output_that_the_user_changed_is_not_replaced(root: Path, out: Path, log: Path) -> None:
    one = write_recordings(root.parent / "one", a="pass")
    run(batch_of(one, out))
    (out / "a/report.html").write_text("with my remarks")
    (row,) = run(batch_of(one, out))
    assert row.verdict == "error"
    assert "report.html: no batch wrote it, or it was changed" in row.error
    assert (out / "a/report.html").read_text() == "with my remarks"


# --- faults --------------------------------------------------------------------------------------


def test_a_killed_driver_is_resumed_and_its_table_is_that_of_an_undisturbed_run(
    root: Path, out: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_recordings(root, a="pass endless", b="warn slow", z="pass slow")
    path = os.pathsep.join([str(Path(batch_support.__file__).parent), *sys.path])
    script = root.parent / "driver.py"
    script.write_text(DRIVER)
    command = [sys.executable, str(script), str(root), str(out)]
    environment = {**os.environ, "PYTHONPATH": path}
    driver = subprocess.Popen(command, env=environment)
    try:
        until(lambda: (log / "endless").is_file() and (log / "endless").read_text() and calls(log)["s1/b report"])
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    finally:
        driver.kill()
        driver.wait()
    worker = Path("/proc") / (log / "endless").read_text()
    until(lambda: not worker.exists())  # it ended with its driver
    (log / "endless").unlink()
    done = [name.partition(" ")[0] for name, count in calls(log).items() if name.endswith("report") and count]
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    assert all(calls(log)[f"{name} reconstruct"] == 1 for name in done)
    assert calls(log)["a reconstruct"] == 2

    alone = root.parent / "alone"
    monkeypatch.setenv("BATCH_OUT", str(alone))
    run(batch_of(root, alone))
    varying = ("seconds", "cpu_seconds", "peak_memory_mb", "output_mb")
    first, second = (
        [{k: v for k, v in row.items() if k not in varying} for row in table(place).values()] for place in (out, alone)
    )
    assert first == second
    assert results_of(out) == results_of(alone)
    assert not list(out.rglob(".rtof_kin-*"))


def until(true: Any) -> None:
    for _ in range(3000):
        if true():
            return
        time.sleep(0.02)
    raise AssertionError("it did not become so in a minute")


@pytest.mark.parametrize("step", ["motion", "export", "report.html", "batch.json"])
def test_a_run_that_was_killed_while_it_wrote_goes_on(step: str, root: Path, out: Path, log: Path) -> None:
    """The state says that the step began, and its output is there or half there."""
    one = write_recordings(root.parent / "one", a="pass")
    run(batch_of(one, out))
    whole = results_of(out)
    state = out / "a/batch.json"
    if step == "batch.json":
        state.write_text('{"steps": {"mot')  # a file system that lost what was written last
        (out / "a/report.html").unlink()
    else:
        steps = json.loads(state.read_text())["steps"]
        state.write_text(json.dumps({"steps": steps | {step: {"begun": True}}}))
    rows = out / ".batch/shard-1-of-1.jsonl"
    rows.write_bytes(rows.read_bytes()[:-20])
    assert facts(run(batch_of(one, out))) == {"a": "pass"}
    assert results_of(out) == whole
    assert calls(log)["a reconstruct"] == (2 if step in ("motion", "batch.json") else 1)


def test_a_full_disk_is_an_error_in_the_table_and_leaves_nothing_half(root: Path, out: Path, log: Path) -> None:
    two = write_recordings(root.parent / "two", a="pass", b="pass " + "x" * 400)
    with full_disk(30_000):
        rows = {row.recording: row for row in run(batch_of(two, out))}
    assert facts(list(rows.values())) == {"a": "pass", "b": "error"}
    assert "cannot be written" in rows["b"].error
    assert not (out / "b/motion").exists()
    assert not list(out.rglob(".rtof_kin-*"))
    assert facts(run(batch_of(two, out))) == {"a": "pass", "b": "pass"}
    assert calls(log)["a reconstruct"] == 1


def test_two_drivers_do_not_share_a_folder(root: Path, out: Path, log: Path) -> None:
    with claim(out, root, Shard(), False):
        with pytest.raises(OutputExistsError, match=rf"process {os.getpid()} on .*, since .* is at work on it"):
            run(batch_of(root, out))
        with pytest.raises(OutputExistsError, match="divide by the same number"):
            run(batch_of(root, out, shard="1/2"))
    assert not calls(log)
    assert facts(run(batch_of(root, out))) == VERDICTS


def test_shards_share_a_folder_and_one_table(root: Path, out: Path, log: Path) -> None:
    write_recordings(root, **{f"t{k}": "pass" for k in range(8)})
    with claim(out, root, Shard(2, 3), False):
        first = run(batch_of(root, out, shard="1/3"))
        assert set(table(out)) == set(facts(first))
    second, third = run(batch_of(root, out, shard="2/3")), run(batch_of(root, out, shard="3/3"))
    names = [row.recording for row in (*first, *second, *third)]
    assert sorted(names) == sorted({*VERDICTS, *(f"t{k}" for k in range(8))})
    assert all((first, second, third))
    assert list(table(out)) == sorted(names)
    assert calls(log).most_common(1)[0][1] == 1
    with pytest.raises(InvalidInputError, match="a shard does not overwrite"):
        run(batch_of(root, out, shard="2/3"), overwrite=True)
    before = calls(log)
    assert len(run(batch_of(root, out))) == 13  # as a whole, with what the shards did
    assert calls(log) - before == {"e reconstruct": 1, "s2/d reconstruct": 1}


def test_a_worker_that_sees_another_folder_says_so(root: Path, out: Path, log: Path) -> None:
    class Elsewhere:
        def run(self, function: Any, jobs: Any) -> Any:
            moved = ((key, replace(task, out=root)) for key, task in jobs)
            return InThisProcess().run(function, moved)

    rows = run(batch_of(root, out), Elsewhere())
    assert {row.verdict for row in rows} == {"error"}
    assert "all must share it under one name" in rows[0].error


def test_command_lines_are_checked_before_the_first_is_run(root: Path, out: Path) -> None:
    seen = []

    def check(line: list[str]) -> None:
        seen.append(line)
        if "--wrong" in line:
            raise InvalidInputError("unrecognized arguments: --wrong")

    check_chain(batch_of(root, out), check)
    assert [line[0] for line in seen] == ["reconstruct", "export", "report"]  # all recordings have the same
    with pytest.raises(RtofError, match="e, export: unrecognized arguments: --wrong"):
        check_chain(batch_of(root, out, "reconstruct, export --wrong"), check)
