"""State, curves and determinism of a training, and its command."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import pytest
import torch

from lifting.checkpoint import load_checkpoint
from lifting.predict import Lifter
from lifting.training import train as curves
from lifting.training.corpus import Corpus
from lifting.training.data import plain
from lifting.training.run import Prefetch, Run
from lifting.training.settings import TrainConfig
from lifting.training.train import train
from rtof_kin import cli
from rtof_kin.core.errors import FileFormatError, InvalidInputError

QUICK = TrainConfig(
    windows=64,
    batch=16,
    channels=8,
    skeletons=0,
    report_every=1,
    validations=2,
    validation_windows=8,
    bfloat16=False,
    augment=plain(),
)
PNG = b"\x89PNG\r\n"


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return support.tiny_corpus(frames=30)


# --- the corpus of a state -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda c: replace(c, p_world_root=c.p_world_root + 1e-3),
        lambda c: replace(c, R_world_bone=c.R_world_bone[::-1].copy()),
        lambda c: replace(c, split=("train", "train", "test", "validation")),
        lambda c: replace(c, rate_hz=50.0),
        lambda c: replace(c, beyond_rigid=np.zeros((120, 21, 3), np.float32)),
    ],
)
def test_the_digest_depends_on_all_of_the_motion(corpus: Corpus, change: Any) -> None:
    assert change(corpus).digest() != corpus.digest()


def test_a_state_of_other_motion_is_refused(corpus: Corpus, tmp_path: Path) -> None:
    path = train(QUICK, corpus, tmp_path / "lifter.npz")
    assert load_checkpoint(path)[1].recipe["corpus_sha256"] == corpus.digest()
    longer = replace(QUICK, windows=96)
    message = r"lifter\.npz\.state: belongs to a training on other motion"
    with pytest.raises(FileFormatError, match=message):
        train(longer, support.tiny_corpus(frames=30, seed=7), path, resume=True)
    steps: list[int] = []
    train(longer, corpus, path, lambda report: steps.append(report["step"]), resume=True)
    assert steps == [5, 6]


def test_a_start_of_another_shape_is_refused(corpus: Corpus, tmp_path: Path) -> None:
    path = train(QUICK, corpus, tmp_path / "lifter.npz")
    message = "a lifter of 8 channels and 21 joints; this training is of 9 channels"
    with pytest.raises(FileFormatError, match=message):
        train(replace(QUICK, channels=9), corpus, tmp_path / "other.npz", start=path)
    with pytest.raises(FileFormatError, match=r"lifter_live\.npz: .*start from one that fits"):
        train(QUICK, corpus, tmp_path / "other.npz", start="live")


@pytest.mark.usefixtures("undrawn")
def test_a_start_of_a_shorter_receptive_field_answers_first_for_the_middle(corpus: Corpus, tmp_path: Path) -> None:
    start = train(replace(QUICK, windows=320, receptive_field=9), corpus, tmp_path / "short.npz")
    short = support.network_of(Lifter.load(start))
    for run in (Run(replace(QUICK, receptive_field=27), corpus), Run(replace(QUICK, receptive_field=81), corpus)):
        run.start(start)
        size, shape = run.size, run.network.config
        features, constants = torch.randn(4, size, shape.inputs), torch.randn(4, shape.constants)
        middle = features[:, (size - 9) // 2 : (size + 9) // 2]
        own, known = run.averaged(features, constants), short(middle, constants)
        assert torch.linalg.norm(own - known) < 0.2 * torch.linalg.norm(known)
    with pytest.raises(InvalidInputError, match="receptive_field is 30"):
        replace(QUICK, receptive_field=30)


@pytest.mark.usefixtures("undrawn")
def test_a_start_gives_the_first_weights(corpus: Corpus, tmp_path: Path) -> None:
    path = train(replace(QUICK, windows=320, learning_rate=1e-2), corpus, tmp_path / "lifter.npz")
    losses: dict[bool, list[float]] = {}
    for causal in (False, True):
        reports: list[dict[str, Any]] = []
        config = replace(QUICK, windows=16, causal=causal)
        train(config, corpus, tmp_path / "tuned.npz", reports.append, start=path, overwrite=True)
        losses[causal] = [reports[0]["loss_mm"]]
        reports.clear()
        train(config, corpus, tmp_path / "fresh.npz", reports.append, overwrite=True)
        losses[causal].append(reports[0]["loss_mm"])
    for tuned, fresh in losses.values():
        assert tuned < 0.8 * fresh
    origin = Lifter.load(tmp_path / "tuned.npz").description.recipe["started_from_sha256"]
    assert origin == Lifter.load(path).sha256


# --- curves --------------------------------------------------------------------------------------


def test_curves_are_written_also_by_an_interrupted_training(corpus: Corpus, tmp_path: Path) -> None:
    out = tmp_path / "lifter.npz"

    def interrupt(report: dict[str, Any]) -> None:
        if report["step"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(QUICK, corpus, out, interrupt)
    assert not out.exists()
    history = json.loads(curves.data_file(out).read_text())["history"]
    assert [row["windows"] for row in history] == [32]
    before = curves.figure_file(out).read_bytes()
    assert before.startswith(PNG)
    train(QUICK, corpus, out, resume=True)
    content = json.loads(curves.data_file(out).read_text())
    assert [row["windows"] for row in content["history"]] == [32, 64]
    assert content["recipe"]["windows_seen"] == 64
    assert curves.figure_file(out).read_bytes() != before


# --- deterministic -------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn")
def test_deterministic_trainings_are_bit_identical_and_restore_torch(corpus: Corpus, tmp_path: Path) -> None:
    config = replace(QUICK, deterministic=True, dropout=0.2, bfloat16=True)
    states, during = [], []
    for name in ("a", "b"):
        path = train(
            config,
            corpus,
            tmp_path / f"{name}.npz",
            lambda report: during.append(torch.are_deterministic_algorithms_enabled()),
        )
        states.append(load_checkpoint(path)[0])
    assert all(during)
    assert len(during) == 8
    assert not torch.are_deterministic_algorithms_enabled()
    assert all(np.array_equal(states[0][key], states[1][key]) for key in states[0])


# --- the command ---------------------------------------------------------------------------------


def test_the_command_trains_with_every_option(
    corpus: Corpus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = str(corpus.save(tmp_path / "corpus.npz")), tmp_path / "lifter.npz"
    common = ["train", file, "--windows", "32", "--batch", "16", "--channels", "8"]
    common += ["--validation-windows", "8", "--ema", "0.9", "--no-bfloat16"]
    assert cli.main([*common, "-o", str(out), "--causal", "--camera-at", "4", "1.5", "--seed", "3"]) == 0
    assert f"curves: {out}.curves.png" in capsys.readouterr().out
    description = load_checkpoint(out)[1]
    assert description.network.causal
    assert description.network.channels == 8
    assert description.recipe["augment"]["distance"] == [4.0, 4.0]
    assert description.recipe["augment"]["camera_height"] == [1.5, 1.5]
    tuned = tmp_path / "tuned.npz"
    assert cli.main([*common, "-o", str(tuned), "--initial", str(out)]) == 0
    assert cli.main([*common, "-o", str(tmp_path / "x.npz"), "--initial", str(tmp_path / "none.npz")]) == 2
    assert "none.npz: no such file" in capsys.readouterr().err


def test_an_interrupted_command_names_the_state_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: object) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr("lifting.training.train.train", interrupted)
    assert cli.main(["train", "corpus.npz", "-o", "x.npz"]) == 130
    message = capsys.readouterr().err
    assert "--resume" in message
    assert "x.npz.state" in message


def test_an_error_of_the_second_thread_reaches_the_caller_and_the_thread_ends() -> None:
    with pytest.raises(ZeroDivisionError), Prefetch(lambda step: 1 // step) as prefetch:
        prefetch(0)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("windows")]


@pytest.mark.usefixtures("undrawn")
def test_validation_takes_a_twentieth_of_the_time(
    corpus: Corpus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty validations of 40 ms in a run of 1 s: the first one is paid before the second, the last always made."""
    seconds = iter(np.arange(0.0, 1e6, 0.01))  # each look at the clock is 10 ms later than the last
    monkeypatch.setattr("lifting.training.run.time.perf_counter", lambda: float(next(seconds)))
    monkeypatch.setattr("lifting.training.run.Validation.measure", lambda *_: [next(seconds) for _ in range(4)] and {})
    reports: list[dict[str, Any]] = []
    config = replace(QUICK, windows=16 * 250, validations=20)
    train(config, corpus, tmp_path / "lifter.npz", reports.append)
    made = [report["seconds"] for report in reports if "validation" in report]
    assert 3 <= len(made) < 12
    assert min(np.diff(made[:-1])) > 19 * 0.04
    assert "validation" in reports[-1]
