"""Make models/detectors.npz: how a person's points lie to each other in images.

``python -m models.build_adapters CORPUS`` with CORPUS as in benchmarks/README.md. Fitted to the training
subjects' motion at 10 Hz, mirrored as often as not, on bodies of varied bone lengths, every frame seen by
cameras all around; a third of the frames are tilted by up to 40 degrees, for what people do on the floor.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from benchmarks.views import Views
from lifting.training.corpus import BENCHMARK_SPLIT, read_split
from rtof_kin.simulation.mocap import read_corpus
from rtof_kin.vision.layouts import detector_table

RATE_HZ, VIEWS, SEED = 10.0, 12, 0
NOISE = 0.04
"""A detector's error per axis in RMS radii of the joints, as measured on a real one: 6 px for a person 4
m away where f = 1250 px."""


def main(corpus: str) -> None:
    """Read, look, fit, write."""
    split, table = read_split(BENCHMARK_SPLIT), detector_table().fitted
    rng, views, seen = np.random.default_rng(SEED), Views(table), []
    joints = len(views.skeleton.names)
    for clip in read_corpus(Path(corpus), output_rate_hz=RATE_HZ):
        if split.get(clip.subject, "train") != "train":
            continue
        root, R = clip.poses.p_world_joint[:, 0], clip.poses.R_world_bone
        for _ in range(VIEWS):
            points, _ = views.see(root, R, rng)
            centre = points[:, :joints].mean(axis=1, keepdims=True)
            radius = np.sqrt(((points[:, :joints] - centre) ** 2).sum(axis=-1).mean(axis=1))
            seen.append(((points - centre) / radius[:, None, None]).reshape(len(points), -1))
    z = np.concatenate(seen)
    np.savez_compressed(
        Path(__file__).with_name("detectors.npz"),
        mean=z.mean(axis=0).reshape(-1, 2).astype(np.float32),
        covariance=np.cov(z.T).astype(np.float32),
        noise=np.float64(NOISE),
        offsets=np.array([point.offset for point in table.points]),
    )
    print(f"fitted {z.shape[1] // 2} points to {len(z)} views")


if __name__ == "__main__":
    main(sys.argv[1])
