"""What a lifter gains from motion, receptive field and width, from the first weights, at one number of windows.

``python -m benchmarks learning CORPUS.npz`` with a corpus of models/build_corpus.py: half an hour on one core. Every
lifter is measured on people that none learns from, those of joint rotations (CMU's and Meredith) and those of
markers (UI-PRMD's 7 and 8), with the simulated detector, random cameras and no flip.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.command_line import study_parser
from lifting import checkpoint
from lifting.model import FoldedNetwork
from lifting.training.corpus import Corpus, read_corpus
from lifting.training.losses import Validation
from lifting.training.settings import TrainConfig
from lifting.training.train import train

MARKERS = "UIPRMD"
KINDS = {"realistic": "no sensors", "realistic, 8 sensors": "8 sensors", "realistic, 10 sensors": "10 sensors"}


def some(corpus: Corpus, minutes: float, share: float | None = None) -> Corpus:
    """Leave training clips out: so many minutes remain, of which a share is of markers; None keeps the corpus'."""
    parts = {None: 1.0} if share is None else {True: share, False: 1 - share}
    left = {kind: 60 * minutes * corpus.rate_hz * part for kind, part in parts.items()}
    split = list(corpus.split)
    clips = torch.randperm(len(split), generator=torch.Generator().manual_seed(0)).tolist()
    for clip in clips:
        if split[clip] != "train":
            continue
        kind = None if share is None else corpus.subjects[clip].startswith(MARKERS)
        if left[kind] <= 0:
            split[clip] = "excluded"
        left[kind] -= int(corpus.start[clip + 1] - corpus.start[clip])
    return replace(corpus, split=tuple(split))


def only(corpus: Corpus, markers: bool) -> Corpus:
    """Leave out validation people of markers, or all others."""
    pairs = zip(corpus.subjects, corpus.split, strict=True)
    wrong = (split == "validation" and subject.startswith(MARKERS) != markers for subject, split in pairs)
    return replace(corpus, split=tuple("excluded" if w else s for w, s in zip(wrong, corpus.split, strict=True)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("learning", __doc__, motion=False, page="{}.md")
    parser.add_argument("corpus", type=Path, metavar="CORPUS.npz")
    parser.add_argument("--windows", type=int, default=500_000)
    options = parser.parse_args(arguments)
    corpus = read_corpus(options.corpus)
    usual = TrainConfig(windows=options.windows, validations=1, validation_windows=64, prior="none", ema=0.99)
    runs = {
        "13 minutes of joint rotations": (some(corpus, 13, 0.0), usual),
        "50 minutes of joint rotations": (some(corpus, 50, 0.0), usual),
        "50 minutes of markers": (some(corpus, 50, 1.0), usual),
        "13 minutes of all": (some(corpus, 13), usual),
        "50 minutes of all": (some(corpus, 50), usual),
        "all (105 minutes)": (corpus, usual),
        "all, 9 frames": (corpus, replace(usual, receptive_field=9)),
        "all, 81 frames": (corpus, replace(usual, receptive_field=81)),
        "all, 128 channels": (corpus, replace(usual, channels=128)),
        "all, 512 channels": (corpus, replace(usual, channels=512)),
    }
    people = {"joint rotations": False, "markers": True}
    heads = ["trained on", *(f"{name}, {kind}" for name in people for kind in KINDS.values())]
    lines = ["# Motion, receptive field and width of the lifter", ""]
    lines += ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name, (motion, config) in runs.items():
        with tempfile.TemporaryDirectory() as folder:
            weights, made = checkpoint.load_checkpoint(train(config, motion, Path(folder) / "model.npz"))
        tensors = {key: torch.tensor(value) for key, value in weights.items()}
        network = FoldedNetwork(made.body, made.network, tensors, flip=False)
        cells = []
        for markers in people.values():
            own = only(corpus, markers).in_shared_frames()
            validation = Validation(own, made.network.receptive_field(), torch.device("cpu"), 2048)
            found = validation.measure(network)
            cells += [f"{found[kind]['rr_mm']:.1f} / {found[kind]['abs_mm']:.0f}" for kind in KINDS]
        lines.append("| " + " | ".join([name, *cells]) + " |")
        print(lines[-1], flush=True)
    rest = f"Root-relative / absolute error, mm, after {options.windows / 1e6:g} M windows from the first weights."
    options.out.write_text("\n".join([*lines, "", rest, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
