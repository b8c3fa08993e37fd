"""Jobs: each result is kept as soon as it is done, failures are reported, foreign folders are not changed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import engine_jobs
import numpy as np
import pytest
from protocol_orders import Order, calls, obey, orders, values
from protocol_support import read_json

from benchmarks.command_line import resident_memory
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.core.jobs import (
    Engine,
    InThisProcess,
    Processes,
    RayCluster,
    is_shared,
    open_runs,
    run_jobs,
    side_by_side,
    work_shared,
)
from rtof_kin.core.jobs import processes as module
from rtof_kin.core.jobs.engine import cores_limited, usable_cores
from rtof_kin.core.jobs.memory import available_memory, peak_memory, reset_peak, total_memory

SETTINGS: dict[str, Any] = {"cameras": [1, 3], "noise_px": 0.0, "seed": 0}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


def test_results_keep_the_order_of_the_jobs_and_nan_becomes_null(log: Path, runs: Path) -> None:
    fact = {"mean": float("nan"), "most": [1.5, (float("inf"), "text", None, 3)]}
    jobs = {**orders(log, z="work", a="work"), "m": Order("m", log, fact=fact)}
    outcome = run_jobs(obey, jobs, runs, workers=1)
    expected = {"mean": None, "most": [1.5, [None, "text", None, 3]]}
    assert list(values(outcome.done).items()) == [("z", 0.0), ("a", 1.0), ("m", expected)]
    assert read_json(runs / "m.json")["fact"] == expected
    np.testing.assert_array_equal(outcome.arrays("m")["squares"], np.arange(4.0) ** 2 + 1 / 3)
    assert run_jobs(obey, {}, runs).done == {}


@pytest.mark.parametrize("damage", ["", '{"fact": 1', "[1, 2]", "\x00\x00"])
def test_only_missing_failed_and_damaged_results_are_run_again(damage: str, log: Path, runs: Path) -> None:
    np.savez(runs / "a.npz", squares=np.zeros(4))  # arrays without facts are not a result
    first = run_jobs(obey, orders(log, a="work", b="refuse", c="work", d="work"), runs, workers=1)
    assert (list(first.done), list(first.failed)) == (["a", "c", "d"], ["b"])
    (runs / "d.json").write_text(damage)
    second = run_jobs(obey, orders(log, a="work", b="work", c="work", d="work"), runs, workers=1)
    assert calls(log) == ["a", "b", "b", "c", "d", "d"]
    assert values(second.done) == {"a": 0.0, "b": 1.0, "c": 2.0, "d": 3.0}
    assert second.arrays("a")["squares"][3] == 9 + 1 / 3


def test_an_interrupted_run_resumes(log: Path, runs: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_jobs(obey, orders(log, a="work", b="interrupt", c="work"), runs, workers=1)
    assert sorted(path.name for path in runs.iterdir()) == ["a.json", "a.npz"]
    outcome = run_jobs(obey, orders(log, a="work", b="work", c="work"), runs, workers=1)
    assert calls(log) == ["a", "b", "b", "c"]
    assert values(outcome.done) == {"a": 0.0, "b": 1.0, "c": 2.0}


def test_failures_are_reported_by_job_and_do_not_stop_the_others(
    log: Path, runs: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    whole = np.savez_compressed

    def full(path: Path, **arrays: Any) -> None:
        if path.name == "d.npz":
            raise OSError(28, "No space left on device")
        whole(path, **arrays)

    monkeypatch.setattr(np, "savez_compressed", full)
    jobs = orders(log, a="refuse", b="work", c="crash", d="work")
    outcome = run_jobs(obey, jobs | {"e": Order("e", log, fact=Path("not JSON"))}, runs, workers=1)
    assert list(outcome.done) == ["b"]
    assert outcome.failed["a"] == "a: the take is too short"
    assert outcome.failed["c"] == "ZeroDivisionError: c divided by nothing"
    assert "No space left" in outcome.failed["d"]
    assert "not JSON serializable" in outcome.failed["e"]
    assert "Traceback" in caplog.text  # of the crash
    assert "a: a: the take is too short" in caplog.text
    assert not [path for path in runs.glob("*.json") if path.stem != "b"]


def test_progress_is_called_after_every_job(log: Path, runs: Path, caplog: pytest.LogCaptureFixture) -> None:
    jobs = orders(log, a="work", b="refuse", c="work")
    reports: list[tuple[int, int, str]] = []
    run_jobs(obey, jobs, runs, 1, lambda *report: reports.append(report))
    assert reports == [(0, 3, ""), (1, 3, "a"), (2, 3, "b failed: b: the take is too short"), (3, 3, "c")]
    assert not caplog.records
    run_jobs(obey, jobs, runs, 1, lambda *report: reports.append(report))
    assert reports[4] == (2, 3, "2 of 3 were done before")
    with pytest.raises(InvalidInputError, match="workers: 0"):
        run_jobs(obey, jobs, runs, 0)


def test_worker_processes_change_no_result_and_no_environment(
    log: Path, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    doing = {"a": "meet", "b": "crash", "c": "meet", "d": "refuse"}
    outcome = run_jobs(obey, orders(log, **doing), runs, workers=2)
    assert {facts["process"] for facts in outcome.done.values()} == {"SpawnProcess"}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ

    alone = tmp_path / "alone"
    alone.mkdir()
    again = run_jobs(obey, orders(tmp_path / "log 2", **dict.fromkeys("abcd", "work")), alone, workers=1)
    kept = {key: facts["fact"] for key, facts in again.done.items() if key in outcome.done}
    assert list(values(outcome.done).items()) == list(kept.items())
    assert outcome.failed["b"] == "ZeroDivisionError: b divided by nothing"
    assert outcome.failed["d"] == "d: the take is too short"
    assert (runs / "a.npz").read_bytes() == (alone / "a.npz").read_bytes()


def test_an_interruption_terminates_the_worker_processes_only(log: Path, runs: Path) -> None:
    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    other.start()

    def tell(done: int, total: int, text: str) -> None:
        if done:
            raise KeyboardInterrupt

    began = time.perf_counter()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_jobs(obey, orders(log, a="work", b="sleep", c="sleep"), runs, 2, tell)
        for _ in range(500):
            if multiprocessing.active_children() == [other]:
                break
            time.sleep(0.01)
        assert multiprocessing.active_children() == [other]
        assert other.is_alive()
        assert time.perf_counter() - began < 30
    finally:
        other.kill()
        other.join()
    assert sorted(path.name for path in runs.iterdir()) == ["a.json", "a.npz"]


def opened(folder: Path, overwrite: bool = False, save: Path | None = None, **changed: Any) -> Path:
    return open_runs(folder, SETTINGS | changed, overwrite, save, {})


def files_of(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_folder_is_reused_for_equal_settings_and_overwritten_for_others(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    runs = opened(out)
    (runs / "a.json").write_text("{}")
    (out / "tables.md").write_text("")
    before = files_of(tmp_path)
    assert opened(out) == opened(out, overwrite=True) == runs
    with pytest.raises(OutputExistsError, match=r"out: .*other settings \(cameras, seed, studies\)"):
        opened(out, seed=1, cameras=[1], studies=True)
    assert files_of(tmp_path) == before
    with pytest.raises(RtofError, match="cannot be written .*; name another folder"):
        opened(out / "tables.md")
    opened(out, overwrite=True, seed=1)
    assert list(runs.iterdir()) == []
    with pytest.raises(OutputExistsError, match=r"\(seed\)"):
        opened(out)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("mark", [None, "{}", '{"editor.tabSize": 4}', "[]", "{", "\x80"])
def test_a_folder_with_other_files_is_not_changed(mark: str | None, overwrite: bool, tmp_path: Path) -> None:
    project = tmp_path / "project"
    (project / "runs").mkdir(parents=True)
    (project / "runs" / "experiment.json").write_text("{}")
    if mark is not None:
        (project / "settings.json").write_text(mark, encoding="latin-1")
    opened(tmp_path / "out")
    before = files_of(tmp_path)
    with pytest.raises(OutputExistsError, match=r"project.*name a new folder"):
        opened(project, overwrite)
    with pytest.raises(OutputExistsError, match=r"project.*name a new folder"):
        opened(tmp_path / "out", True, save=project, seed=1)
    assert files_of(tmp_path) == before


def test_overwriting_removes_motions_of_other_settings_only(tmp_path: Path) -> None:
    save = tmp_path / "motions"
    opened(tmp_path / "out", save=save)
    motion = save / "S1" / "walking2" / "cam1" / "lift" / "motion.h5"
    motion.parent.mkdir(parents=True)
    motion.write_text("")
    (save / "note.txt").write_text("")
    opened(tmp_path / "other", save=save)
    assert motion.exists()
    with pytest.raises(OutputExistsError, match="motions: holds results of other settings"):
        opened(tmp_path / "third", save=save, seed=1)
    assert not (tmp_path / "third").exists()
    opened(tmp_path / "third", overwrite=True, save=save, seed=1)
    assert not motion.exists()
    assert (save / "note.txt").exists()


def test_a_job_runs_again_where_a_motion_it_measured_is_missing(tmp_path: Path, log: Path) -> None:
    out, save = tmp_path / "out", tmp_path / "motions"
    jobs = orders(log, a="work", b="work", c="work")
    run_jobs(obey, jobs, opened(out), workers=1)
    there, missing = tmp_path / "there.npz", save / "missing.npz"
    there.touch()
    files: dict[str, dict[str, Path | None]] = {
        "a": {"a": missing},
        "b": {"a": there, "not measured": missing},
        "c": {"a": None},
    }
    run_jobs(obey, jobs, open_runs(out, SETTINGS, False, save, files), workers=1)
    assert calls(log) == ["a", "a", "b", "c"]


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


def test_a_worker_has_its_next_job_while_an_answer_is_used(tmp_path: Path) -> None:
    results = Processes(1).run(engine_jobs.die, ((name, (tmp_path / name, 0)) for name in "abc"))
    assert next(results).key == "a"
    _until((tmp_path / "b-0").is_file)  # nobody has asked for it yet
    assert not (tmp_path / "c-0").exists()
    assert [one.key for one in results] == ["b", "c"]


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


def test_workers_are_no_more_than_the_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "total_memory", lambda: 8_000_000_000)
    for available, most in ((7_000_000_000, 2), (1_000_000_000, 1), (None, 16)):
        monkeypatch.setattr(module, "available_memory", lambda available=available: available)
        assert module.Workers(Processes(16, memory_per_job=3e9), print).most == most
    assert module.Workers(Processes(16), print).most == 16
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


# --- threads ---------------------------------------------------------------------------------------


def test_work_is_shared_by_processes_inside_and_done_here_outside() -> None:
    with work_shared(2):
        assert is_shared()
        with work_shared(1):  # the outer one holds
            shared = list(side_by_side(engine_jobs.whereabouts, range(4)))
    here = list(side_by_side(engine_jobs.whereabouts, range(2)))
    assert not is_shared()
    assert here == [(os.getpid(), os.environ.get("OMP_NUM_THREADS"))] * 2
    assert 1 <= len({*shared}) <= 2
    assert {threads for _, threads in shared} == {"1"}
    assert os.getpid() not in {process for process, _ in shared}


def test_one_core_does_all_itself() -> None:
    with cores_limited(3):
        assert usable_cores() == 3
        with cores_limited(None):
            assert usable_cores() == 3
        with work_shared(1):
            assert not is_shared()


def test_work_inside_shared_work_is_done_here() -> None:
    with work_shared(2):
        inner = [[*side_by_side(engine_jobs.square, [n])] for n in side_by_side(engine_jobs.square, [2, 3])]
    assert inner == [[16], [81]]


def test_the_first_error_of_shared_work_is_raised_and_ends_what_runs(tmp_path: Path) -> None:
    tasks = [partial(engine_jobs.refuse, "so it is"), *[partial(engine_jobs.sleep_and_tell, tmp_path)] * 5]
    begun = time.monotonic()
    with work_shared(2):
        with pytest.raises(InvalidInputError, match="so it is"):
            list(side_by_side(engine_jobs.call, tasks))
        assert list(side_by_side(engine_jobs.square, [1, 2, 3])) == [1, 4, 9]
    assert time.monotonic() - begun < 60


def test_shared_work_does_not_repeat_warnings(capfd: pytest.CaptureFixture[str]) -> None:
    with work_shared(2):
        list(side_by_side(engine_jobs.warn, ["again"] * 3))
    assert "again" not in capfd.readouterr().err


def test_a_script_that_shares_work_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from math import sqrt\n"
        "from rtof_kin.core.jobs import side_by_side, work_shared\n"
        "print('begun', flush=True)\n"
        "with work_shared(2):\n"
        "    print(list(side_by_side(sqrt, [4.0, 9.0])))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "begun\n[2.0, 3.0]\n", "")


def test_a_worker_uses_one_core_unless_it_is_told_more() -> None:
    ended = Processes(1).run(engine_jobs.cores, [("told", 3), ("not told", None)])
    assert {one.key: one.answer for one in ended} == {"told": 3, "not told": 1}


# --- Ray -----------------------------------------------------------------------------------------


def test_ray_that_is_not_installed_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RtofError, match=r"needs ray, which is not installed: .*rtof-kin\[cluster\]"):
        next(RayCluster().run(engine_jobs.square, [("a", 1)]))
