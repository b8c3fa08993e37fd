"""Errors of a lifter on fixed windows of the validation subjects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from lifting import losses
from lifting.body import Body
from lifting.corpus import Corpus
from lifting.data import AugmentConfig, Batch, MotionBank, plain
from lifting.model import TemporalNetwork
from lifting.models import RAYS, model_of
from lifting.noise import VALIDATION_NOISE
from lifting.sensors import TRUNK, SensorConfig
from lifting.windows import Estimate

SEED = 20_000
_SENSED = SensorConfig(
    none=0.0, limbs=0.0, limbs_and_trunk=0.0, ends=0.0, every=0.0, amplitude=(1.0, 1.0), lag=(1.0, 3.0), missing=0.0
)


class Validation:
    """Fixed windows of the validation subjects; none if the corpus has no such subjects."""

    def __init__(
        self,
        corpus: Corpus,
        window: int,
        device: torch.device,
        count: int = 4096,
        causal: bool = False,
        model: str = RAYS,
    ):
        """Draw the windows.

        Args:
            window: frames per window. count: windows of each kind, evenly over the motion.
        """
        self.model, self.body = model_of(model), corpus.body()
        if not self.model.senses:
            self.body = replace(self.body, sensors=())
        self.batches: dict[str, Batch] = {}
        clips = corpus.clips("validation", required=False)
        if not clips:
            return
        bank = MotionBank(corpus, clips, device)
        frames = torch.linspace(0, len(bank) - 1, count, device=device).long()
        for name, config in _kinds(bool(self.body.sensors)).items():
            generator = torch.Generator(device).manual_seed(SEED)
            self.batches[name] = bank.draw(count, window, config, generator, frames, causal)

    def measure(self, network: TemporalNetwork, flip: bool = True) -> dict[str, dict[str, float]]:
        """Return errors by kind of 2D: mean per joint position error, root-relative (with the root's 0) and
        absolute, mm, and for a body with sensors the angles of pelvis and upper trunk, deg.
        """
        return {
            name: _errors(self.body, self._estimate(network, batch, flip), batch)
            for name, batch in self.batches.items()
        }

    def _estimate(self, network: TemporalNetwork, batch: Batch, flip: bool) -> Estimate:
        encoded = self.model.encode(self.body, batch.windows)
        return self.model.decode(self.body, self.model.answer(self.body, network, encoded, flip), encoded)


def _kinds(sensed: bool) -> dict[str, AugmentConfig]:
    """Settings of each kind, by name."""
    realistic = plain(VALIDATION_NOISE["realistic"])
    kinds = {
        "perfect": plain(),
        "realistic": realistic,
        "independent": plain(VALIDATION_NOISE["independent"]),
        "perfect, bones unknown": replace(plain(), hide_bones=1.0),
        "realistic, floor known": replace(realistic, hide_height=0.0),
    }
    if sensed:
        worn = {"8": replace(_SENSED, limbs=1.0), "10": replace(_SENSED, limbs_and_trunk=1.0)}
        for name, sensors in worn.items():
            kinds[f"realistic, {name} sensors"] = replace(realistic, sensors=sensors)
    return kinds


def _errors(body: Body, estimate: Estimate, batch: Batch) -> dict[str, float]:
    error = estimate.pose - batch.pose
    absolute = error + (estimate.root - batch.root)[:, :, None]

    def mean(x: Tensor, unit: Callable[[Tensor], Tensor] = lambda x: 1000 * x) -> float:
        return round(float(unit(x.mean())), 2)

    errors = {"rr_mm": mean(error.norm(dim=1)), "abs_mm": mean(absolute.norm(dim=1))}
    if estimate.axes is not None:
        chord = losses.turn_angles(estimate.axes, batch.axes)
        angle = 2 * torch.asin((chord / 2).clamp(max=1))
        for name, key in zip(TRUNK, ("pelvis_deg", "upper_trunk_deg"), strict=True):
            errors[key] = mean(angle[:, body.names.index(name)], torch.rad2deg)
    return errors
