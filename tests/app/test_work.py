"""The queue of reconstructions."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from inertial_support import walking
from setup_support import pair, walker, write_keypoints, write_sensors

from rtof_kin.app import store as store_module
from rtof_kin.app import work as module
from rtof_kin.app.sources import MAP, write_map
from rtof_kin.app.store import State, Store
from rtof_kin.app.work import Stages, Work
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError, WritingError
from rtof_kin.inertial.pose_calibration import pose_rotations
from rtof_kin.setup.init import read_findings


def until(holds: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path)
    store.add_person("P07", 1.73)
    store.add_visit("P07", "2026-01-31")
    for name in ("first", "second"):
        folder = store.add_take("P07", "2026-01-31", name)
        store.new_file(folder, "walk.mp4").write_bytes(b"\0\0\0\x14ftypqt  damaged")
    return store


@pytest.fixture
def work(store: Store) -> Iterator[Work]:
    work = Work(store)
    yield work
    work.close()


def test_a_recording_without_files_or_with_foreign_ones_is_not_taken(store: Store, work: Work) -> None:
    folder = store.add_take("P07", "2026-01-31", "third")
    with pytest.raises(InvalidInputError, match="Add a video"):
        work.ask(folder)
    store.new_file(folder, "notes.txt").write_text("milk")
    with pytest.raises(FileFormatError, match="nothing that is known"):
        work.ask(folder)
    assert store.take(folder).state is State.DRAFT


def test_a_damaged_video_fails_with_a_sentence_and_the_next_one_is_tried(store: Store, work: Work) -> None:
    first, second = store.takes()
    work.ask(first)
    work.ask(second)
    work.ask(second)
    assert work.busy(store.path("P07"))
    until(lambda: store.take(second).state is State.FAILED)
    assert store.take(first).state is State.FAILED
    assert "walk.mp4" in store.take(first).said
    assert not work.busy(store.path("P07"))


def test_of_two_people_one_is_chosen_by_the_picture(store: Store, work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = store.add_take("P07", "2026-01-31", "third")
    write_keypoints(store.new_file(folder, "keypoints.npz"), *pair())
    store.change(folder, size_px=(1920, 1080))
    work.ask(folder)
    until(lambda: store.take(folder).state is State.ASKING)
    assert (folder / "recording" / "frames.png").is_file()
    store.change(folder, person=2)
    assert outcome(store, folder, monkeypatch)["state"] is State.DRAFT
    assert "person_number = 2" in (folder / "recording" / "recording.toml").read_text()


def outcome(store: Store, folder: Path, monkeypatch: pytest.MonkeyPatch, **values: Any) -> dict[str, Any]:
    """What the process would send at last, done in this one."""
    sent: list[Any] = []
    monkeypatch.setattr(module, "end_with_parent", lambda: None)
    sender: Any = SimpleNamespace(send=sent.append)
    module._reconstruct(str(folder), store.change(folder, look=True, **values), sender, 1)
    assert all(isinstance(one, tuple) for one in sent[:-1])
    found: dict[str, Any] = sent[-1]
    return found


def test_a_recording_is_looked_at_before_it_is_reconstructed(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = store.add_take("P07", "2026-01-31", "third")
    write_keypoints(store.new_file(folder, "first.npz"), walker())
    write_keypoints(store.new_file(folder, "second.npz"), *pair())
    with pytest.raises(InvalidInputError, match=r"first.npz and .*second.npz: each is a detector's keypoints"):
        store.sources(folder)
    store.change(folder, second=("second.npz",), size_px=(1920, 1080))
    assert store.sources(folder).keypoints == folder / "files" / "first.npz"
    assert outcome(store, folder, monkeypatch)["state"] is State.ASKING  # whom the second camera saw
    found = outcome(store, folder, monkeypatch, second_person=2)
    assert found == {"state": State.DRAFT, "said": "", "places": {}, "learned": ()}
    assert read_findings(folder / "recording").given == ("the person is 1.73 m tall",)
    assert "person_number = 2" in (folder / "second" / "recording.toml").read_text()
    assert {path.name for path in folder.iterdir()} == {"files", "take.json", "recording", "second"}
    store.change(folder, second=("first.npz", "second.npz"))
    with pytest.raises(InvalidInputError, match="each is a detector's keypoints"):
        store.sources(folder)


def test_a_picture_without_a_person_is_said(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = store.add_take("P07", "2026-01-31", "third")
    write_keypoints(store.new_file(folder, "nobody.npz"), np.full_like(walker(), np.nan))
    found = outcome(store, folder, monkeypatch, size_px=(1920, 1080))
    assert found["state"] is State.FAILED
    assert "too few to recognise the layout" in found["said"]


def test_sensors_that_are_not_known_are_asked_for_and_a_map_is_the_answer(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = store.add_take("P07", "2026-01-31", "third")
    worn = walking(pose_rotations("N", SkeletonModel.default())).with_one_reference(1.0)
    places = {f"A{n:02d}": place for n, place in enumerate(worn.joints.values())}
    write_sensors(store.new_file(folder, "sensors.csv"), replace(worn.imus, names=tuple(places)))
    found = outcome(store, folder, monkeypatch)
    assert (found["state"], found["places"]) == (State.ASKING, dict.fromkeys(places, ("", 0.0)))
    write_map(folder / "files" / MAP, {"A00": "", **dict(list(places.items())[1:])})
    found = outcome(store, folder, monkeypatch)
    assert found["state"] is State.DRAFT
    assert found["places"] == {name: (place, 1.0) for name, place in places.items()} | {"A00": ("", 0.0)}


def endless(_: str, __: Any, sender: Any, ___: int) -> None:
    sender.send(("lift", 0, 2))
    time.sleep(120)


def test_cancelled_is_a_draft_and_closed_goes_on_with_the_next_server(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_reconstruct", endless)
    first, second = store.takes()
    work = Work(store)
    work.ask(first)
    work.ask(second)
    until(lambda: (found := work.stages(first)) is not None and "lift" in found.done)
    assert work.before(second) == 1
    work.cancel(first)
    until(lambda: work.stages(second) is not None)
    work.close()
    assert [store.take(path).state for path in (first, second)] == [State.DRAFT, State.RUNNING]
    again = Work(store)
    until(lambda: again.stages(second) is not None)
    again.cancel(second)
    again.close()
    assert store.take(second).state is State.DRAFT


def gone(*_: Any) -> None:
    raise SystemExit(3)


def told(_: str, __: Any, sender: Any, cores: int) -> None:
    sender.send({"state": State.FAILED, "said": f"{cores} cores {multiprocessing.current_process().daemon}"})


def test_the_process_may_start_others_for_all_cores(store: Store, work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_reconstruct", told)
    work.ask(first := store.takes()[0])
    until(lambda: store.take(first).state is State.FAILED)
    assert store.take(first).said == f"{len(os.sched_getaffinity(0))} cores False"


def test_a_process_that_ends_without_an_answer_is_said(
    store: Store, work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_reconstruct", gone)
    work.ask(first := store.takes()[0])
    until(lambda: store.take(first).state is State.FAILED)
    assert "exit code 3" in store.take(first).said
    assert not store.take(first).seconds  # no time of a later one is told by it


def test_what_a_full_disk_kept_from_being_said_can_be_cancelled(
    store: Store, work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, write, tried = store.takes()[0], store_module.write_text, list[str]()

    def failed(_: Work, folder: Path) -> dict[str, Any]:
        store.change(folder, state=State.RUNNING)
        return {"state": State.FAILED}

    def full(path: Path, text: str, overwrite: bool = False) -> None:
        if '"failed"' in text:
            tried.append(text)
            raise WritingError(f"{path}: cannot be written ([Errno 28] No space left on device); name another file")
        write(path, text, overwrite)

    monkeypatch.setattr(Work, "_reconstructed", failed)
    monkeypatch.setattr(store_module, "write_text", full)
    work.ask(first)
    until(lambda: bool(tried) and not work.busy(first))
    assert store.take(first).state is State.RUNNING
    work.cancel(first)
    assert store.take(first).state is State.DRAFT
    store.change(first, state=State.DONE)
    work.cancel(first)  # pressed too late
    assert store.take(first).state is State.DONE


def test_time_left_is_of_this_stage_and_of_the_later_ones_of_an_earlier_run(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    alone, known = Stages({}), Stages({"detect": 10.0, "lift": 4.0, "rto": 6.0})
    assert (alone.left, known.left) == (None, 20.0)
    for step in (0, 1, 2):
        for stages in (alone, known):
            stages.report("detect", step, 4)
        now[0] += 10.0
    assert alone.left == pytest.approx(20.0)
    assert known.left == pytest.approx(20.0 + 10.0)
    known.report("detect", 4, 4)
    known.report("lift", 0, 1)
    assert known.left == pytest.approx(3.0 * (4.0 + 6.0))  # three times as slow
