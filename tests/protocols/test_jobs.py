"""Jobs: each kept as soon as it is done, none stops the others, and no folder of others is touched."""

from __future__ import annotations

import logging
import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from protocol_orders import Order, calls, obey, orders, values
from protocol_support import read_json

from rtof_kin.core.errors import OutputExistsError, RtofError, ShapeError
from rtof_kin.protocols.jobs import open_runs, run_jobs

SETTINGS: dict[str, Any] = {"cameras": [1, 3], "noise_px": 0.0, "seed": 0}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


# --- what comes back -----------------------------------------------------------------------------


def test_facts_and_arrays_come_back_in_the_order_of_the_jobs(log: Path, runs: Path) -> None:
    outcome = run_jobs(obey, orders(log, z="work", a="work", m="work"), runs, workers=1)
    assert list(values(outcome.done).items()) == [("z", 0.0), ("a", 1.0), ("m", 2.0)]
    assert outcome.failed == {}
    np.testing.assert_array_equal(outcome.arrays("m")["squares"], np.arange(4.0) ** 2 + 1 / 3)


def test_no_jobs_are_no_work(runs: Path) -> None:
    for workers in (1, 2, None):
        outcome = run_jobs(obey, {}, runs, workers)
        assert (outcome.done, outcome.failed) == ({}, {})


def test_nan_and_infinity_become_null_because_json_has_neither(log: Path, runs: Path) -> None:
    fact = {"mean": float("nan"), "most": [1.5, float("-inf"), (float("inf"), "text", None, 3)]}
    log.mkdir()
    outcome = run_jobs(obey, {"a": Order("a", log, fact=fact)}, runs, workers=1)
    assert outcome.done["a"]["fact"] == {"mean": None, "most": [1.5, None, [None, "text", None, 3]]}
    assert read_json(runs / "a.json")["fact"] == outcome.done["a"]["fact"]


# --- going on ------------------------------------------------------------------------------------


def test_a_job_that_is_done_is_not_run_again_and_one_that_failed_is(log: Path, runs: Path) -> None:
    first = run_jobs(obey, orders(log, a="work", b="refuse", c="work"), runs, workers=1)
    assert (list(first.done), list(first.failed)) == (["a", "c"], ["b"])
    second = run_jobs(obey, orders(log, a="work", b="work", c="work"), runs, workers=1)
    assert calls(log) == ["a", "b", "b", "c"]
    assert (list(second.done), second.failed) == (["a", "b", "c"], {})
    assert {key: second.done[key] for key in first.done} == first.done


@pytest.mark.parametrize("damage", ["", '{"fact": 1', "[1, 2]", "\x00\x00"])
def test_a_result_that_was_cut_off_counts_as_not_done(damage: str, log: Path, runs: Path) -> None:
    run_jobs(obey, orders(log, a="work", b="work"), runs, workers=1)
    (runs / "a.json").write_text(damage)
    outcome = run_jobs(obey, orders(log, a="work", b="work"), runs, workers=1)
    assert calls(log) == ["a", "a", "b"]
    assert values(outcome.done) == {"a": 0.0, "b": 1.0}


def test_arrays_without_facts_are_no_result(log: Path, runs: Path) -> None:
    np.savez(runs / "a.npz", squares=np.zeros(4))
    outcome = run_jobs(obey, orders(log, a="work"), runs, workers=1)
    assert calls(log) == ["a"]
    assert outcome.arrays("a")["squares"][3] == 9 + 1 / 3


def test_an_interruption_leaves_what_is_done_and_the_next_run_goes_on(log: Path, runs: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_jobs(obey, orders(log, a="work", b="interrupt", c="work"), runs, workers=1)
    assert sorted(path.name for path in runs.iterdir()) == ["a.json", "a.npz"]
    outcome = run_jobs(obey, orders(log, a="work", b="work", c="work"), runs, workers=1)
    assert calls(log) == ["a", "b", "b", "c"]
    assert values(outcome.done) == {"a": 0.0, "b": 1.0, "c": 2.0}


# --- what fails ----------------------------------------------------------------------------------


def test_neither_a_refusal_nor_a_crash_stops_the_others(
    log: Path, runs: Path, caplog: pytest.LogCaptureFixture
) -> None:
    jobs = orders(log, a="refuse", b="work", c="crash", d="work")
    outcome = run_jobs(obey, jobs, runs, workers=1)
    assert list(outcome.done) == ["b", "d"]
    assert outcome.failed == {"a": "a: the take is too short", "c": "ZeroDivisionError: c divided by nothing"}
    assert "Traceback" in caplog.text  # of the crash, for whoever must mend it
    assert "a: a: the take is too short" in caplog.text
    assert not list(runs.glob("[ac].*"))


def test_what_cannot_be_written_fails_alone(log: Path, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = np.savez_compressed

    def full(path: Path, **arrays: Any) -> None:
        if path.name == "a.npz":
            raise OSError(28, "No space left on device")
        whole(path, **arrays)

    monkeypatch.setattr(np, "savez_compressed", full)
    jobs = orders(log, a="work", b="work") | {"c": Order("c", log, fact=Path("no value of JSON"))}
    outcome = run_jobs(obey, jobs, runs, workers=1)
    assert list(outcome.done) == ["b"]
    assert "No space left on device" in outcome.failed["a"]
    assert "not JSON serializable" in outcome.failed["c"]
    assert not (runs / "c.json").exists()


def test_progress_hears_of_every_job_and_then_nothing_is_logged(
    log: Path, runs: Path, caplog: pytest.LogCaptureFixture
) -> None:
    jobs = orders(log, a="work", b="refuse", c="work")
    told: list[tuple[int, int, str]] = []
    run_jobs(obey, jobs, runs, 1, lambda *report: told.append(report))
    assert told == [(0, 3, ""), (1, 3, "a"), (2, 3, "b failed: b: the take is too short"), (3, 3, "c")]
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]
    told.clear()
    run_jobs(obey, jobs, runs, 1, lambda *report: told.append(report))
    assert told[0] == (2, 3, "2 of 3 were done before")


@pytest.mark.parametrize("workers", [0, -2])
def test_fewer_than_one_worker_is_refused(workers: int, log: Path, runs: Path) -> None:
    with pytest.raises(ShapeError, match=f"workers: {workers} processes do no work"):
        run_jobs(obey, orders(log, a="work"), runs, workers)


# --- processes -----------------------------------------------------------------------------------


def test_two_workers_are_new_processes_with_one_thread_each_and_change_no_result(
    log: Path, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    doing = {"a": "meet", "b": "crash", "c": "meet", "d": "refuse"}
    outcome = run_jobs(obey, orders(log, **doing), runs, workers=2)
    processes = {path.name.split("-")[2] for path in log.iterdir()}
    assert len(processes) == 2
    assert str(os.getpid()) not in processes
    assert {facts["process"] for facts in outcome.done.values()} == {"SpawnProcess"}
    assert {facts["threads"] for facts in outcome.done.values()} == {"1"}
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


def test_a_killed_process_is_reported_and_takes_no_other_job_with_it(log: Path, runs: Path) -> None:
    jobs = orders(log, a="work", b="die", c="work", d="work")
    outcome = run_jobs(obey, jobs, runs, workers=2)
    assert list(outcome.done) == ["a", "c", "d"]
    assert list(outcome.failed) == ["b"]
    assert "its process was killed" in outcome.failed["b"]
    before = [name for name in calls(log) if name != "b"]
    again = run_jobs(obey, jobs, runs, workers=2)  # in a process of its own, though it is alone
    assert list(again.failed) == ["b"]
    assert [name for name in calls(log) if name != "b"] == before


def test_an_interruption_ends_the_processes_at_once_and_only_those(log: Path, runs: Path) -> None:
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


# --- whose folder it is --------------------------------------------------------------------------


def opened(folder: Path, overwrite: bool = False, save: Path | None = None, **changed: Any) -> Path:
    return open_runs(folder, SETTINGS | changed, overwrite, save, {})


def files_of(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its content."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_folder_is_made_and_gone_on_with_by_the_same_settings(tmp_path: Path) -> None:
    runs = opened(tmp_path / "deep" / "out")
    (runs / "a.json").write_text("{}")
    before = files_of(tmp_path)
    assert opened(tmp_path / "deep" / "out") == runs
    assert opened(tmp_path / "deep" / "out", overwrite=True) == runs
    assert files_of(tmp_path) == before


def test_other_settings_are_refused_by_name_and_may_be_overwritten(tmp_path: Path) -> None:
    runs = opened(tmp_path / "out")
    (runs / "a.json").write_text("{}")
    (tmp_path / "out" / "tables.md").write_text("")
    before = files_of(tmp_path)
    expected = r"out: holds results of other settings \(cameras, seed, studies\); name another"
    with pytest.raises(OutputExistsError, match=expected):
        opened(tmp_path / "out", seed=1, cameras=[1], studies=True)
    assert files_of(tmp_path) == before
    opened(tmp_path / "out", overwrite=True, seed=1)
    assert list(runs.iterdir()) == []
    with pytest.raises(OutputExistsError, match=r"\(seed\)"):
        opened(tmp_path / "out")


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("mark", [None, "{}", '{"editor.tabSize": 4}', "[]", "{", "\x80"])
def test_a_folder_with_other_things_is_never_touched(
    mark: str | None, overwrite: bool, tmp_path: Path
) -> None:
    """Not even one with a settings.json of its own and results of somebody else in runs."""
    project = tmp_path / "project"
    (project / "runs").mkdir(parents=True)
    (project / "runs" / "experiment.json").write_text("{}")
    (project / "S5/acting3/cam1/rtof").mkdir(parents=True)
    (project / "S5/acting3/cam1/rtof/motion.npz").write_text("mine")
    if mark is not None:
        (project / "settings.json").write_text(mark, encoding="latin-1")
    before = files_of(tmp_path)
    with pytest.raises(OutputExistsError, match=r"project.*name a new folder"):
        opened(project, overwrite)
    with pytest.raises(OutputExistsError, match=r"project.*name a new folder"):
        opened(tmp_path / "out", overwrite, save=project)
    assert files_of(tmp_path) == before
    assert not (tmp_path / "out").exists()


def test_results_stay_where_the_folder_for_the_motions_is_refused(tmp_path: Path) -> None:
    runs = opened(tmp_path / "out")
    (runs / "a.json").write_text("{}")
    foreign = tmp_path / "motions"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("")
    before = files_of(tmp_path)
    with pytest.raises(OutputExistsError, match="motions: holds other things"):
        opened(tmp_path / "out", overwrite=True, save=foreign, seed=1)
    assert files_of(tmp_path) == before


def test_overwriting_removes_the_motions_of_other_settings_and_nothing_else(tmp_path: Path) -> None:
    save = tmp_path / "motions"
    opened(tmp_path / "out", save=save)
    motion = save / "S1" / "walking2" / "cam1" / "lift" / "motion.npz"
    motion.parent.mkdir(parents=True)
    motion.write_text("")
    (save / "note.txt").write_text("")
    opened(tmp_path / "other", save=save)  # of the same settings
    assert motion.exists()
    with pytest.raises(OutputExistsError, match="motions: holds results of other settings"):
        opened(tmp_path / "third", save=save, seed=1)
    assert not (tmp_path / "third").exists()
    opened(tmp_path / "third", overwrite=True, save=save, seed=1)
    assert not motion.exists()
    assert (save / "note.txt").exists()


def test_a_file_where_a_folder_shall_be_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(RtofError, match="cannot be written .*; name another folder"):
            opened(folder)
    assert (tmp_path / "file").read_text() == ""


def test_a_job_whose_motions_are_wanted_now_is_run_again(tmp_path: Path, log: Path) -> None:
    """But not for a method that it has not: no run would ever write that one's."""
    out, save = tmp_path / "out", tmp_path / "motions"
    jobs = orders(log, a="work", b="work", c="work")
    run_jobs(obey, jobs, opened(out), workers=1)
    there = tmp_path / "there.npz"
    there.touch()
    files: dict[str, dict[str, Path | None]] = {
        "a": {"a": save / "not there.npz"},
        "b": {"a": there, "not measured": save / "not there.npz"},
        "c": {"a": None},
    }
    runs = open_runs(out, SETTINGS, False, save, files)
    run_jobs(obey, jobs, runs, workers=1)
    assert calls(log) == ["a", "a", "b", "c"]
