"""Whatever call of writing fails, the old result stays or the new one is whole, and nothing else is left."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import planted
import pytest
from batch_support import CALLS, batch_of, obey, write_recordings
from injected_failures import Failures, each_failure, injected
from live_support import demo, imu_samples

from rtof_kin.batch.rows import Row
from rtof_kin.batch.run import run_batch
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.core.errors import RtofError, WritingError
from rtof_kin.core.jobs import InThisProcess
from rtof_kin.live.clock_map import Arrived
from rtof_kin.live.recorded_session import LIVE, SETUP, finish
from rtof_kin.live.recorder import Recorder
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.export import export

Results = tuple[Reconstruction, Reconstruction]


def disk_full(_: str) -> tuple[BaseException, bool]:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), True


def error_once(_: str) -> tuple[BaseException, bool]:
    return OSError(errno.EIO, os.strerror(errno.EIO)), False


def no_memory(call: str) -> tuple[BaseException, bool]:
    """The error of a call that needs some; of others that of a bad disk."""
    return (MemoryError(), False) if call.startswith(("open ", "write ")) else error_once(call)


KINDS = (disk_full, error_once, no_memory)


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def check_error(raised: BaseException | None, words: str, call: str) -> None:
    """Check that an error is of the package and names the place, or is the want of memory itself."""
    if raised is not None and not isinstance(raised, MemoryError):
        assert isinstance(raised, RtofError), (call, raised)
        assert words in str(raised), (call, raised)
        assert ".rtof_kin-" not in str(raised).split("(")[0], (call, raised)


@pytest.fixture(scope="module")
def results() -> Results:
    truth = planted.moving(SkeletonModel.default(), 8)
    settings = ReconstructionSettings(frames=8)
    recording = planted.recording(truth)
    made = reconstruct(recording, lifter=planted.PlantedLifter(truth), settings=settings, calibrate=False)
    return made, replace(made, recording=replace(made.recording, name="another"))


def test_the_output_of_reconstruct_is_the_old_or_the_new(results: Results, tmp_path: Path) -> None:
    old, new = results
    out, kept = tmp_path / "place" / "out", tmp_path / "kept"
    write = partial(export, formats=["csv"])
    write(new, out)
    expected = tree(out)
    shutil.rmtree(out)
    write(old, out)
    before = tree(out)
    assert before != expected
    shutil.copytree(out, kept)

    def prepare() -> None:
        if tree(out) != before:
            shutil.rmtree(out)
            shutil.copytree(kept, out)

    def act() -> None:
        write(new, out, overwrite=True)

    for call, raised in each_failure(out.parent, act, KINDS, prepare):
        check_error(raised, str(out), call)
        assert tree(out) == (before if raised is not None else expected), call
        assert os.listdir(out.parent) == ["out"], call


def test_the_page_of_report_is_the_old_or_the_new(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    export(results[0], tmp_path / "out")
    page = tmp_path / "pages" / "page.html"
    monkeypatch.setattr("rtof_kin.reporting.page.report", lambda *_: "new" * 10_000)
    codes: list[int] = []

    page.parent.mkdir()

    def act() -> None:
        codes.append(main(["report", str(tmp_path / "out"), "-o", str(page), "--overwrite"]))

    for call, raised in each_failure(page.parent, act, KINDS, lambda: page.write_text("old")):
        assert raised is None, (call, raised)
        said = " ".join(capsys.readouterr().err.split())
        assert page.read_text() == ("new" * 10_000 if codes[-1] == 0 else "old"), call
        assert codes[-1] in (0, 2), call
        assert codes[-1] == 0 or "cannot be written" in said or "not enough memory" in said, (call, said)
        assert os.listdir(page.parent) == ["page.html"], call
    assert codes.count(2) > 3


def test_a_batch_stops_or_names_the_recording_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, source = tmp_path / "place" / "out", write_recordings(tmp_path / "takes", a="warn")
    monkeypatch.setenv("BATCH_OUT", str(out))
    monkeypatch.setenv(CALLS, str(tmp_path / "calls"))
    (tmp_path / "calls").mkdir()
    batch = batch_of(source, out, "reconstruct, report")

    def results_of() -> dict[str, bytes]:
        return {
            name: data
            for name, data in tree(out).items()
            if ".batch/" not in name
            and "log/" not in name
            and not name.endswith(("batch.json", "batch.csv"))
            and not name.startswith("index")
        }

    rows: list[Row] = []

    def prepare() -> None:
        shutil.rmtree(out.parent, ignore_errors=True)
        rows.clear()

    def act() -> None:
        rows.extend(run_batch(batch, obey, InThisProcess()))

    run_batch(batch, obey, InThisProcess())
    expected = results_of()
    for call, raised in each_failure(out.parent, act, KINDS, prepare):
        check_error(raised, str(out), call)
        assert raised is None or isinstance(raised, WritingError | MemoryError), (call, raised)
        assert raised is not None or "No space" not in str([row.error for row in rows]), call
        found = results_of() if out.exists() else {}
        assert found.items() <= expected.items(), call  # each is whole, or not there
        with injected(Failures(out.parent)):  # which does not sync
            assert [row.verdict for row in run_batch(batch, obey, InThisProcess())] == ["warn"], call
        assert results_of() == expected, call
        assert not list(out.rglob(".rtof_kin-*")), call


def test_what_a_live_session_recorded_can_be_finished(tmp_path: Path) -> None:
    setup = replace(demo(), keypoints=None, truth=None)
    take, samples = tmp_path / "place" / "take", imu_samples(0.2, setup)
    failed: list[RtofError] = []

    def prepare() -> None:
        shutil.rmtree(take.parent, ignore_errors=True)
        failed.clear()

    def act() -> None:
        recorder = Recorder(take, setup, chunk_s=0.1, in_background=False)
        for sample in samples:
            recorder.add(Arrived("demo", sample, sample.time, sample.time))
        try:
            recorder.finish()
        except RtofError as error:
            failed.append(error)

    for call, raised in each_failure(take.parent, act, KINDS, prepare):
        check_error(raised or (failed[0] if failed else None), take.name, call)
        whole = (take / INDEX).exists()
        assert whole or failed or raised, call
        if not whole and (take / LIVE / SETUP / INDEX).exists() and list((take / LIVE).glob("0*.npz")):
            finish(take)
            whole = True
        if whole:
            assert len(Recording.load(take).imus or ()) >= 2, call
        assert not list(take.parent.rglob(".rtof_kin-*")), call
