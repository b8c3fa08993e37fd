"""Settings of a training."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from math import log
from typing import Final, Literal

import numpy as np

from lifting.training.corpus import Corpus
from lifting.training.data import AugmentConfig
from rtof_kin.body.pose_prior import NeutralPosture, PosePrior, posture_from_t_pose, shipped_prior
from rtof_kin.body.pose_prior_fit import PersonMotion, fit_pose_prior, of_one_rig
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence

PriorChoice = Literal["auto", "even", "own", "none"]
"""Pose prior of a training. even: for several rigs; own: the trunk of the one rig; auto: one of the
two, by the skeletons; none: no prior, the shipped one is used."""
LEAST_FRAMES: Final = 30  #: Frames of the shortest clip that a prior is fitted to


def prior_of_corpus(corpus: Corpus, choice: PriorChoice = "auto") -> PosePrior | None:
    """Return the pose prior of the training clips; None for 'none', for joints other than the package's 21
    and where every clip is too short.
    """
    motions = motions_of(corpus)
    table = read_skeleton_table(model_path("skeleton.toml"))
    if choice == "none" or not motions or (table.names, table.parents) != (corpus.names, corpus.parents):
        return None
    one_rig = of_one_rig(corpus.names, corpus.joint_offsets[corpus.clips("train")].astype(float))
    even = choice == "even" or (choice == "auto" and not one_rig)
    known = shipped_prior(corpus.names)
    return fit_pose_prior(corpus.names, corpus.parents, motions, even, postures_of(corpus), known)


def motions_of(corpus: Corpus) -> list[PersonMotion]:
    """Return the training clips of `LEAST_FRAMES` or more."""
    return [
        PersonMotion(
            corpus.subjects[clip],
            corpus.R_world_bone[corpus.frames(clip)].astype(float),
            corpus.p_world_root[corpus.frames(clip)].astype(float),
            corpus.rate_hz,
        )
        for clip in corpus.clips("train")
        if corpus.start[clip + 1] - corpus.start[clip] >= LEAST_FRAMES
    ]


def postures_of(corpus: Corpus) -> dict[str, NeutralPosture]:
    """Return the neutral postures of those training subjects who stand in a T-pose, from the first one, in a
    corpus of the 21-joint skeleton with orientations in the link frames.
    """
    found: dict[str, NeutralPosture] = {}
    for clip in corpus.clips("train"):
        p, subject = corpus.positions(clip).astype(float), corpus.subjects[clip]
        if subject in found or len(p) < 2:
            continue
        times = np.arange(len(p)) / corpus.rate_hz
        R = corpus.R_world_bone[corpus.frames(clip)].astype(float)
        poses = PoseSequence(times, p, R, corpus.names)
        if (posture := posture_from_t_pose(poses, corpus.parents)) is not None:
            found[subject] = posture
    return found


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training, which ends at `windows` or `minutes`, whichever comes first."""

    windows: int | None = None  #: Number of windows to learn from
    minutes: float | None = None  #: Duration without reading the corpus, min; a resumed training continues counting
    receptive_field: int = 27
    """Frames of a window, 9 or a higher power of 3: 27 as the paper's, 81 for recordings (39.7 in place of 41.3 mm
    root-relative on validation, but 40 frames of delay in place of 13)."""
    channels: int = 256  #: Width of the network
    dropout: float = 0.0  #: Share of hidden values dropped
    batch: int = 512  #: Windows per step
    learning_rate: float = 2e-3  #: Largest step of the optimiser
    weight_decay: float = 0.01  #: AdamW's, per unit of learning rate
    warm_up: float = 0.02  #: Share of the training in which the rate rises from 0, before it falls as a cosine
    ema: float = 0.998  #: Factor per step of the running mean of the weights
    clip: float = 1.0  #: Largest norm of the gradient
    validations: int = 20  #: Number of validations, evenly over the training
    validation_windows: int = 4096  #: Validation windows per kind of 2D
    report_every: int = 20  #: Steps between progress reports
    seed: int = 0  #: Seed of the first weights and of all random draws
    device: Literal["cpu", "cuda"] = "cpu"  #: Device of the computation
    bfloat16: bool = True  #: Whether matrices are multiplied in bfloat16
    causal: bool = False
    """Whether the last frame of a window is estimated, not the middle one: no delay, some mm worse."""
    skeletons: int = 12  #: Number of the corpus's bodies that every motion is transferred to, besides the package's
    augment: AugmentConfig = field(default_factory=AugmentConfig)  #: Distributions of the windows
    prior: PriorChoice = "auto"  #: Pose prior that is learned beside, see `prior_of_corpus`
    deterministic: bool = False  #: Whether results are bit-identical on a GPU too; requires `windows` and no `minutes`

    def __post_init__(self) -> None:
        if self.windows is None and self.minutes is None:
            raise InvalidInputError("training: give a number of windows, of minutes, or both")
        for name in ("windows", "minutes", "batch", "learning_rate", "channels"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InvalidInputError(f"training: {name} is {value}; it must be positive")
        if 3 ** len(self.filter_widths) != self.receptive_field or self.receptive_field < 9:
            raise InvalidInputError(f"training: receptive_field is {self.receptive_field}; give 9, 27, 81 or 243")
        if self.deterministic and self.minutes is not None:
            raise InvalidInputError(
                "training: deterministic, but ended by the clock, which the learning rate follows; "
                "give a number of windows and no minutes"
            )

    @property
    def filter_widths(self) -> tuple[int, ...]:
        """Frames seen by each convolution; their product is the receptive field."""
        return (3,) * round(log(max(self.receptive_field, 1), 3))

    def fixed(self) -> str:
        """Return the settings that a resumed training must share, as JSON."""
        free = {"windows", "minutes", "device", "deterministic", "prior"}
        free |= {"report_every", "validations", "validation_windows"}
        settings = {name: value for name, value in asdict(self).items() if name not in free}
        return json.dumps(settings, sort_keys=True)
