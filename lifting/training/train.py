"""Training of a lifter.

``rtof-kin train`` calls `train`. Settings are in `settings`, a step in `run`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch

from lifting.training.corpus import Corpus, read_corpus
from lifting.training.run import Run
from lifting.training.settings import TrainConfig
from rtof_kin.core.files.folder import check_new_file, new_file
from rtof_kin.core.files.text import write_text
from rtof_kin.core.packages import can_draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Row = Mapping[str, Any]  #: A report with a validation, see `train.Progress`
COLORS: Final = ("#0072b2", "#c0392b", "#56b4e9", "#e69f00", "#2e8b57", "#8e44ad", "#8c8c8c")
PANELS: Final = {"rr_mm": "joint error relative to the root [mm]", "abs_mm": "absolute joint error [mm]"}


def data_file(lifter: str | Path) -> Path:
    """Return the path of the curves' data."""
    return Path(f"{lifter}.curves.json")


def figure_file(lifter: str | Path) -> Path:
    """Return the path of the curves' figure."""
    return Path(f"{lifter}.curves.png")


def write_curves(lifter: str | Path, recipe: Row, history: Sequence[Row]) -> None:
    """Write the data, and the figure if there was a validation."""
    text = json.dumps({"recipe": recipe, "history": history}, indent=1)
    write_text(data_file(lifter), text, overwrite=True)
    if history and can_draw():
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        figure = draw(history, Path(lifter).name)
        figure.set_canvas(FigureCanvasAgg(figure))  # no global pyplot state
        with new_file(figure_file(lifter), overwrite=True) as whole:
            figure.savefig(whole, dpi=100)


def draw(history: Sequence[Row], title: str) -> Figure:
    """Plot the loss and the errors of each kind of 2D against the windows seen."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 5))
    figure.subplots_adjust(left=0.05, right=0.99, bottom=0.11, top=0.9)
    loss, *panels = figure.subplots(1, 1 + len(PANELS))
    windows = [row["windows"] for row in history]
    loss.plot(windows, [row["loss_mm"] for row in history], "o-", color="black", markersize=3)
    _decorate(loss, "loss: joints + 0.3 x root, with all augmentation [mm]")
    kinds = dict.fromkeys(kind for row in history for kind in row["validation"])
    for ax, (key, label) in zip(panels, PANELS.items(), strict=True):
        for i, kind in enumerate(kinds):
            known = [row for row in history if kind in row["validation"]]
            values, seen = [row["validation"][kind][key] for row in known], [row["windows"] for row in known]
            name = f"{kind}: {values[-1]:.1f}"
            ax.plot(seen, values, "o-", color=COLORS[i % len(COLORS)], markersize=3, label=name)
        _decorate(ax, label)
        if kinds:
            ax.legend(fontsize=8, title="2D of the validation: last", title_fontsize=8, loc="lower left")
    figure.suptitle(title)
    return figure


def windows_axis(ax: Axes, label: str) -> None:
    """Format the horizontal axis as a logarithmic number of windows, in millions."""
    from matplotlib.ticker import LogLocator, NullLocator

    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(lambda x, _: f"{x / 1e6:g} M" if x >= 1e4 else f"{x:g}")
    ax.set_xlabel(label)


def _decorate(ax: Axes, label: str) -> None:
    windows_axis(ax, "windows seen")
    ax.set_ylabel(label)
    ax.set_ylim(bottom=0)
    ax.grid(True, alpha=0.3)


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
    exception, also one of `progress`, saves the state and the curves first.

    Args:
        corpus: motion, or the folder or .npz file to read it from. progress: see `Progress`.
        resume: continue from the state file if there is one.
        start: lifter of the same shape, or name of a shipped one, for the first weights.
        overwrite: replace a lifter and, without `resume`, the state of an earlier training.

    Raises:
        OutputExistsError: a lifter or a state exists, and neither `resume` nor `overwrite` was given.
        InvalidInputError: no training clip.
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
    with _own_settings(config.deterministic):
        run = Run(config, corpus)
        if start is not None:
            run.start(start)
        if resume:
            run.restore(state_file)
        try:
            with run.batches:
                while run.share_done < 1:
                    run.step()
                    report = run.report()
                    if report and "validation" in report:
                        run.save(state_file)
                    if report and progress:
                        progress(report)
        finally:
            run.save(state_file)
            write_curves(out, run.facts(), run.history)
        return run.save_lifter(out, overwrite)


@contextmanager
def _own_settings(deterministic: bool) -> Iterator[None]:
    """Restore torch's random state, threads and choice of algorithms afterwards."""
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_available() else []
    before, threads = torch.are_deterministic_algorithms_enabled(), torch.get_num_threads()
    with torch.random.fork_rng(devices=devices):
        try:
            torch.set_num_threads(1)  # a second one costs more than it gains on small windows
            if deterministic:
                os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
                torch.use_deterministic_algorithms(True)
            yield
        finally:
            torch.use_deterministic_algorithms(before)
            torch.set_num_threads(threads)
