"""Training of a lifter, from top to bottom.

``rtof-kin train`` and ``python -m lifting`` call `train`; ``torchrun`` starts either of them in several
processes. Settings are in `settings`, a step in `run`, what is particular to a model in `recipes`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from lifting.corpus import Corpus, read_corpus
from lifting.distributed import workers
from lifting.run import Run
from lifting.settings import TrainConfig
from lifting.threads import torch_threads
from rtof_kin.core.files.folder import check_new_file

Progress = Callable[[dict[str, Any]], None]
"""Called after every `TrainConfig.report_every` steps with the step, the share done, the loss, the
windows per second, and the validation errors where they were just measured."""


def train(
    config: TrainConfig,
    corpus: Corpus | str | Path,
    out: str | Path,
    progress: Progress | None = None,
    resume: bool = False,
    start: str | Path | None = None,
    overwrite: bool = False,
) -> Path:
    """Train a lifter on the training subjects, measured on the validation subjects.

    Beside the lifter stand ``<out>.state``, from which an interrupted training goes on, and its curves,
    ``<out>.curves.json`` and ``<out>.curves.png``. An exception, also one raised by `progress`, first
    saves the state and the curves.

    Processes that ``torchrun`` started train one lifter together, see `distributed`: each needs the
    corpus, the first one alone reads and writes the other files and calls `progress`.

    Args:
        config: settings.
        corpus: motion, or the folder or .npz file to read it from.
        out: file to write.
        progress: see `Progress`.
        resume: go on from the state file where there is one.
        start: a lifter of the same shape, or the name of a shipped one, whose weights are the first ones.
        overwrite: replace a lifter, and without `resume` the state of an earlier training.

    Returns:
        The path of the lifter.

    Raises:
        OutputExistsError: a lifter or a state is there, or a lifter appeared meanwhile, and neither
            `resume` nor `overwrite` was asked for.
        ShapeError: the corpus has no training clip; processes have different motion or settings, or
            cannot share a batch.
        SolverError: the training diverged.
        FileFormatError: the corpus, the lifter to start from or the state to resume from cannot be read,
            or the state is that of other settings or other motion.
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
            with run.supply:
                while run.share_done < 1:
                    run.step()
                    report = run.report()
                    if not report or not team.first:
                        continue
                    if "validation" in report:
                        run.save(state_file)
                    if progress:
                        progress(report)
        finally:
            if team.first:
                run.save(state_file)
                _write_curves(out, run)
        if team.first:
            run.save_lifter(out, overwrite)
        team.agree(0.0)  # nobody goes on before the lifter is there
        return out


def _write_curves(out: Path, run: Run) -> None:
    """Curves as a file and a figure."""
    from lifting.curves import write_curves  # plotting is loaded where something is plotted

    write_curves(out, run.facts(), run.history)


@contextmanager
def _own_randomness(deterministic: bool) -> Iterator[None]:
    """Leave torch's global random state, and whether it may choose its algorithms, as they were."""
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
