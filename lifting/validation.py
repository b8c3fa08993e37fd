"""Errors of a lifter on the validation subjects: always the same windows, cameras and noise."""

from __future__ import annotations

from dataclasses import replace

import torch

from lifting.corpus import Corpus
from lifting.data import Batch, MotionBank, plain
from lifting.model import TemporalNetwork
from lifting.noise import perfect, realistic
from lifting.windows import answer, decode, encode

SEED = 20_000


class Validation:
    """Fixed windows of the validation subjects; empty where the corpus has none."""

    def __init__(self, corpus: Corpus, window: int, device: torch.device, count: int = 4096):
        """Draw the windows.

        Args:
            corpus: the motion.
            window: frames in each.
            device: where they are kept.
            count: how many of each kind, evenly over the motion.
        """
        self.body = corpus.body()
        self.batches: dict[str, Batch] = {}
        clips = corpus.clips("validation", required=False)
        if not clips:
            return
        bank = MotionBank(corpus, clips, device)
        frames = torch.linspace(0, len(bank) - 1, count, device=device).long()
        kinds = {
            "perfect": plain(perfect()),
            "realistic": plain(realistic()),
            "perfect, bones unknown": replace(plain(perfect()), hide_bones=1.0),
            "realistic, floor known": replace(plain(realistic()), hide_height=0.0),
        }
        for name, config in kinds.items():
            generator = torch.Generator(device).manual_seed(SEED)
            self.batches[name] = bank.draw(count, window, config, generator, frames)

    def measure(self, network: TemporalNetwork, flip: bool = True) -> dict[str, dict[str, float]]:
        """Mean per joint position error in mm, root-relative (the root's 0 counted) and absolute.

        Args:
            network: in evaluation mode.
            flip: average with the mirrored windows, as prediction does.
        """
        errors = {}
        for name, batch in self.batches.items():
            encoded = encode(
                self.body, batch.rays_world, batch.seen, batch.bones, batch.camera_height
            )
            pose, root = decode(self.body, answer(self.body, network, encoded, flip), encoded)
            error = pose - batch.pose
            absolute = error + (root - batch.root)[:, :, None]
            errors[name] = {
                "rr_mm": round(1000 * float(error.norm(dim=1).mean()), 2),
                "abs_mm": round(1000 * float(absolute.norm(dim=1).mean()), 2),
            }
        return errors
