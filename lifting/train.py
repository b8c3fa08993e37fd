"""Training of a lifter.

``rtof-kin train`` calls `train`; ``torchrun`` starts it in several processes. Settings are in `settings`,
a step in `run`, what is particular to a model in `recipes`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from lifting.corpus import Corpus, read_corpus
from lifting.curves import write_curves
from lifting.distributed import workers
from lifting.model import torch_threads
from lifting.run import Run
from lifting.settings import TrainConfig
from rtof_kin.core.files.folder import check_new_file

Progress = Callable[[dict[str, Any]], None]
"""Called every `TrainConfig.report_every` steps with the step, share done, loss, windows per second, and
the validation errors when they were measured."""


def train(
    config: TrainConfig,
    corpus: Corpus | str | Path,
    out: str | Path,
    progress: Progress | None = None,
    resume: bool = False,
    start: str | Path | None = None,
    overwrite: bool = False,
) -> Path:
    """Train a lifter on the training subjects and validate it on the validation subjects.

    Writes ``<out>``, ``<out>.state`` to resume from, ``<out>.curves.json`` and ``<out>.curves.png``; an
    exception, also one of `progress`, saves the state and the curves first. Processes that ``torchrun``
    started train together: all read the corpus, the first one writes and calls `progress`.

    Args:
        corpus: motion, or the folder or .npz file to read it from. progress: see `Progress`.
        resume: continue from the state file if there is one.
        start: lifter of the same shape, or name of a shipped one, for the first weights.
        overwrite: replace a lifter and, without `resume`, the state of an earlier training.

    Raises:
        OutputExistsError: a lifter or a state exists, and neither `resume` nor `overwrite` was given.
        InvalidInputError: no training clip; processes differ or cannot share a batch.
        SolverError: the training diverged.
        FileFormatError: the corpus, the lifter to start from or the state cannot be read or does not fit.
    """
    out = Path(out)
    state_file = out.with_name(out.name + ".state")
    overwrite = overwrite or resume
    for file in (out, state_file):
        check_new_file(file, overwrite)
    if not isinstance(corpus, Corpus):
        corpus = read_corpus(corpus)
    with _own_randomness(config.deterministic), torch_threads(1), workers(config.device) as team:
        run = Run(config, corpus, team)
        if start is not None:
            run.start(start)
        if resume:
            run.restore(state_file)
        try:
            _learn(run, state_file, progress)
        finally:
            if team.first:
                run.save(state_file)
                write_curves(out, run.facts(), run.history)
        return team.from_first(lambda: run.save_lifter(out, overwrite))


def _learn(run: Run, state_file: Path, progress: Progress | None) -> None:
    with run.batches:
        while run.share_done < 1:
            run.step()
            report = run.report()
            if not report or not run.workers.first:
                continue
            if "validation" in report:
                run.save(state_file)
            if progress:
                progress(report)


@contextmanager
def _own_randomness(deterministic: bool) -> Iterator[None]:
    """Restore torch's random state and choice of algorithms afterwards."""
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_available() else []
    with torch.random.fork_rng(devices=devices):
        if not deterministic or torch.are_deterministic_algorithms_enabled():
            yield
            return
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True)
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(False)
