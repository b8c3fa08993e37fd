"""Settings of a training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from lifting.data import AugmentConfig
from lifting.models import RAYS, VIDEOPOSE3D, model_of
from rtof_kin.core.errors import ShapeError

OWN: Mapping[str, Mapping[str, Any]] = {
    RAYS: {
        "channels": 256, "dropout": 0.0, "batch": 512, "learning_rate": 2e-3, "bfloat16": True,
    },
    VIDEOPOSE3D: {
        "channels": 1024, "dropout": 0.25, "batch": 1024, "learning_rate": 1e-3, "bfloat16": False,
    },
}  # fmt: skip
"""What each model is trained with where nothing else is asked for; the baseline's as published."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training. It ends at `windows` or `minutes`, whichever comes first."""

    windows: int | None = None
    """How many windows to learn from."""
    minutes: float | None = None
    """How long to train and measure, minutes; resumed time counts, reading the corpus does not."""
    model: str = RAYS
    """One of `models.MODELS`: 'rays', or 'videopose3d', the baseline with its published recipe."""
    filter_widths: tuple[int, ...] = (3, 3, 3)
    """Frames seen by each convolution; the product is the receptive field."""
    channels: int = None  # type: ignore[assignment]
    """Width of the network; see `OWN` where not given."""
    dropout: float = None  # type: ignore[assignment]
    """Share of hidden values dropped; see `OWN`."""
    batch: int = None  # type: ignore[assignment]
    """Windows per step, of all processes together; see `OWN`."""
    learning_rate: float = None  # type: ignore[assignment]
    """Largest step of the optimiser; see `OWN`."""
    weight_decay: float = 0.01
    """AdamW's, per unit of learning rate. Of 'rays' alone, as are the next three."""
    warm_up: float = 0.02
    """Share of the training over which the rate rises from 0; then it falls as a cosine."""
    ema: float = 0.998
    """Memory of the running mean of the weights, per step."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    validations: int = 20
    """How often the validation subjects are measured, evenly over the training."""
    validation_windows: int = 4096
    """Windows per kind of 2D that they are measured on."""
    report_every: int = 20
    """Steps between progress reports."""
    seed: int = 0
    """Of the initial weights and everything drawn."""
    device: str = "cpu"
    """'cpu' or 'cuda'."""
    threads: int = 2
    """1: windows are drawn and learnt from in turn. 2: the next ones are drawn meanwhile. The lifter is
    the same."""
    bfloat16: bool = None  # type: ignore[assignment]
    """Multiply matrices in bfloat16; see `OWN`."""
    causal: bool = False
    """Whether the last frame of a window is estimated, not the middle one: no delay, some mm worse."""
    skeletons: int = 12
    """How many bodies of the corpus every motion is also carried over to, besides the package's."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """What is drawn for each window."""
    deterministic: bool = False
    """Only algorithms that give the same bits every time, on a GPU too; to be ended by `windows`, as
    time is never the same twice."""
    same_windows: bool = False
    """Several processes draw what one would, and each takes its rows: the curves are those of one process
    but for rounding, and drawing takes as long as in one. Otherwise each draws its own, and the curves
    are the same within what the draw makes."""

    def __post_init__(self) -> None:
        model_of(self.model)
        for name, value in OWN[self.model].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        if self.windows is None and self.minutes is None:
            raise ShapeError("training: give a number of windows, of minutes, or both")
        positive = {
            "windows": self.windows, "minutes": self.minutes, "batch": self.batch,
            "learning_rate": self.learning_rate, "channels": self.channels, "threads": self.threads,
        }  # fmt: skip
        for name, value in positive.items():
            if value is not None and not value > 0:
                raise ShapeError(f"training: {name} is {value}; it must be positive")
        if self.threads > 2:
            raise ShapeError(f"training: {self.threads} threads; more than 2 gain nothing")
        if self.deterministic and self.minutes is not None:
            raise ShapeError(
                "training: deterministic, but ended by the clock, which the learning rate follows; "
                "give a number of windows and no minutes"
            )

    def fixed(self) -> str:
        """The settings that a resumed training must share; how long it lasts may change."""
        free = {"windows", "minutes", "device", "threads", "deterministic"}
        free |= {"report_every", "validations", "validation_windows"}
        settings = {name: value for name, value in asdict(self).items() if name not in free}
        return json.dumps(settings, sort_keys=True)
