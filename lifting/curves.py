"""Learning curves of a training, as a file and as a figure."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import write_text
from rtof_kin.core.packages import can_draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]
"""A report with a validation, see `train.Progress`."""
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
            values = [row["validation"][kind][key] for row in known]
            ax.plot(
                [row["windows"] for row in known],
                values,
                "o-",
                color=COLORS[i % len(COLORS)],
                markersize=3,
                label=f"{kind}: {values[-1]:.1f}",
            )
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
