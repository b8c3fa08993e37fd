"""Engines: every job ends with an answer or a reason, whatever happens to its process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import engine_jobs
import pytest

from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.jobs import Engine, InThisProcess, Processes, RayCluster
from rtof_kin.core.jobs import processes as module
from rtof_kin.core.jobs.memory import available_memory, peak_memory, reset_peak, resident_memory, total_memory

DRIVER = """
import sys
from pathlib import Path
import engine_jobs
from rtof_kin.core.jobs import Processes
if __name__ == "__main__":
    folder = Path(sys.argv[1])
    for _ in Processes(2).run(engine_jobs.sleep_and_tell, ((str(k), folder) for k in range(9))):
        pass
"""


def answers(engine: Engine, function: Any, arguments: dict[str, Any]) -> dict[str, Any]:
    return {e.key: e.answer if e.lost is None else e.lost for e in engine.run(function, arguments.items())}


@pytest.mark.parametrize("engine", [InThisProcess(), Processes(2), Processes(1)])
def test_every_job_has_one_answer(engine: Engine) -> None:
    assert answers(engine, engine_jobs.square, {str(k): k for k in range(20)}) == {str(k): k * k for k in range(20)}
    assert answers(engine, engine_jobs.square, {}) == {}
    assert answers(engine, engine_jobs.fail, {"a": "raise"}) == {"a": "ZeroDivisionError: by nothing"}


def test_jobs_are_taken_as_there_is_room_for_them() -> None:
    taken = []

    def jobs() -> Iterator[tuple[str, int]]:
        for k in range(100):
            taken.append(k)
            yield str(k), k

    results = Processes(1).run(engine_jobs.square, jobs())
    next(results)
    assert len(taken) < 5
    results.close()


def test_workers_are_warm_have_one_thread_and_are_replaced_after_so_many_jobs() -> None:
    found = answers(Processes(1, jobs_per_worker=2), engine_jobs.whereabouts, dict.fromkeys("abcd", 0))
    workers = [process for process, _ in found.values()]
    assert workers[0] == workers[1] != workers[2] == workers[3]
    assert os.getpid() not in workers
    assert {threads for _, threads in found.values()} == {"1"}


def test_a_lost_job_is_tried_once_more_after_the_others_and_then_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    times = {"a": 0, "once": 1, "b": 0, "always": 9, "c": 0}
    ended = list(Processes(2).run(engine_jobs.die, ((k, (tmp_path / k, n)) for k, n in times.items())))
    assert sorted(e.key for e in ended[:3]) == ["a", "b", "c"]
    assert {e.key: e.answer for e in ended} == {"a": 0, "once": 1, "b": 0, "always": None, "c": 0}
    lost = {e.key: e.lost for e in ended if e.lost}
    assert list(lost) == ["always"]
    assert "killed (signal 9), also when it ran alone" in lost["always"]
    assert len(list(tmp_path.glob("always-*"))) == 2
    assert "once: its process was killed" in caplog.text


def test_a_process_that_ends_and_an_answer_that_cannot_be_sent_are_reasons() -> None:
    found = answers(Processes(2), engine_jobs.fail, {"a": "exit", "b": "unsendable"})
    assert "ended (exit code 7)" in found["a"]
    assert "pickle" in found["b"]


def test_workers_end_with_a_killed_driver(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(engine_jobs.__file__).parent), *sys.path])
    script = tmp_path / "driver.py"
    script.write_text(DRIVER)
    driver = subprocess.Popen([sys.executable, str(script), str(tmp_path)], env={**os.environ, "PYTHONPATH": path})
    try:
        _until(lambda: len(list(tmp_path.glob("*.pid"))) == 2)
        workers = [int(p.stem) for p in tmp_path.glob("*.pid")]
        assert all(resident_memory(worker) for worker in workers)
        driver.send_signal(signal.SIGKILL)
        driver.wait()
        _until(lambda: not any(resident_memory(worker) for worker in workers))
    finally:
        driver.kill()
        driver.wait()


def _until(true: Any) -> None:
    for _ in range(3000):
        if true():
            return
        time.sleep(0.02)
    raise AssertionError("it did not become so in a minute")


# --- memory --------------------------------------------------------------------------------------


def test_no_job_starts_while_the_memory_is_promised_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_POLL", 0.01)
    monkeypatch.setattr(module, "available_memory", lambda: 1_500_000_000)
    monkeypatch.setattr(module, "total_memory", lambda: 4_000_000_000)
    found = answers(Processes(3, memory_per_job=1e9), engine_jobs.period, dict.fromkeys("abcd", 0.1))
    periods = sorted(found.values())
    assert all(end <= begin for (_, end), (begin, _) in pairwise(periods))
    monkeypatch.setattr(module, "available_memory", lambda: 4_000_000_000)
    periods = sorted(answers(Processes(3, memory_per_job=1e9), engine_jobs.period, dict.fromkeys("ab", 3.0)).values())
    assert periods[1][0] < periods[0][1]


def test_jobs_wait_for_memory_and_say_so(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(module, "_POLL", 0.01)
    asked: list[int] = []

    def available() -> int:
        asked.append(0)
        return 100_000_000 if len(asked) < 5 else 8_000_000_000

    monkeypatch.setattr(module, "available_memory", available)
    assert answers(Processes(2, memory_per_job=1e9), engine_jobs.square, {"a": 3}) == {"a": 9}
    assert len(asked) >= 5
    assert caplog.text.count("waiting for memory: a job needs 1.0 GB, and 0.1 GB are available") == 1


def test_workers_are_no_more_than_the_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "total_memory", lambda: 8_000_000_000)
    assert Processes(16, memory_per_job=3e9)._most() == 2
    assert Processes(16)._most() == 16
    with pytest.raises(InvalidInputError, match=r"9\.0 GB, but this machine has 8\.0 GB"):
        Processes(memory_per_job=9e9)
    with pytest.raises(InvalidInputError, match="workers: 0"):
        Processes(0)


@pytest.mark.parametrize("version", [1, 2])
def test_limit_of_a_control_group_is_the_memory(version: int, tmp_path: Path) -> None:
    proc, groups = tmp_path / "proc", tmp_path / "cgroup"
    (proc / "self").mkdir(parents=True)
    (proc / "meminfo").write_text("MemTotal: 9000000 kB\nMemAvailable:   8000000 kB\n")
    assert available_memory(proc, groups) == 8_000_000 * 1024
    (proc / "self" / "cgroup").write_text("0::/job/step\n" if version == 2 else "3:cpu:/\n4:memory:/job/step\n")
    top = groups if version == 2 else groups / "memory"
    names = ("max", "current") if version == 2 else ("limit_in_bytes", "usage_in_bytes")
    for folder, limit in (("job", "3000000000"), ("job/step", "max" if version == 2 else str(2**63 - 4096))):
        (top / folder).mkdir(parents=True)
        (top / folder / f"memory.{names[0]}").write_text(limit + "\n")
        (top / folder / f"memory.{names[1]}").write_text("1000000000\n")
        spare = "inactive_file" if version == 2 else "total_inactive_file"
        (top / folder / "memory.stat").write_text(f"anon 5\n{spare} 400000000\n")
    assert available_memory(proc, groups) == 2_400_000_000


def test_memory_of_this_process_is_measured() -> None:
    total = total_memory()
    assert total is not None
    reset_peak()
    before = peak_memory()
    assert before is not None
    block = bytearray(200_000_000)
    block[::4096] = b"x" * len(block[::4096])
    after = peak_memory()
    assert after is not None
    assert 150_000_000 < after - before < 300_000_000
    assert 0 < resident_memory(os.getpid()) <= total
    assert resident_memory(2**22 + 1) == 0


# --- Ray -----------------------------------------------------------------------------------------


def test_ray_that_is_not_installed_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RtofError, match=r"needs ray, which is not installed: .*rtof-kin\[cluster\]"):
        next(RayCluster().run(engine_jobs.square, [("a", 1)]))
