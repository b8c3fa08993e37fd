"""Make models/assignment.npz: which segment a sensor is on, by its motion and that of the others.

``python -m models.build_assignment CORPUS`` with CORPUS as in benchmarks/README.md. Sensors are simulated on
the training subjects' motion, at varied places and speeds and mirrored. Score tables of single sensors and of
pairs (`rtof_kin.calibration.motion_score`) are trained so that the true assignment has a larger score than those
that differ from it by one move or exchange, or by exchanged sides. The validation subjects tell when to stop
and set the temperature.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.motion_score import RATE_HZ, SensorMotions, pair_features, sensor_motions, single_features
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.simulation.simulate import low_passed

SPLIT = Path(__file__).parents[1] / "benchmarks" / "split.toml"
VERSIONS, WINDOWS, WINDOWS_KEPT = 6, 6000, 500
"""Simulations of each motion; windows that are learned from and that are kept to stop."""
SECONDS, LEAST_PIECE = (4.0, 40.0), 1.5
"""[s] Range of windows, and shortest piece of a motion in them."""
SPEED, LEVER_M = 0.2, 0.04
"""[-] spread of the log of speed; [m] of sensors' places."""
HIDDEN, BATCH, EPOCHS, RATE, DECAY, DROPOUT, FEATURE_NOISE = (48, 96), 50, 16, 2e-3, 1e-2, 0.4, 0.3
SCALES = (1.4, 1.0, 0.7, 0.5)
"""Of the scores, of which the best on the kept windows is taken."""


@dataclass(frozen=True)
class Take:
    """One simulation of one person: the same sensors in all motions."""

    subject: str
    motions: tuple[SensorMotions, ...]


def main(corpus: str) -> None:
    """Simulate, describe, train, write."""
    rows = tomllib.loads(SPLIT.read_text(encoding="utf-8"))
    rng = np.random.default_rng(0)
    people = read_people(Path(corpus), set(rows["test"]))
    train = {name: clips for name, clips in people.items() if name not in rows["validation"]}
    kept = {name: clips for name, clips in people.items() if name in rows["validation"]}
    learned = windows(rng, [take for v in range(VERSIONS) for take in takes(rng, train, v)], WINDOWS)
    held = windows(rng, [take for v in range(2) for take in takes(rng, kept, v)], WINDOWS_KEPT)
    torch.manual_seed(0)
    model = fit(*learned, *held)
    write(model, Path(__file__).with_name("assignment.npz"))


def read_people(corpus: Path, without: set[str]) -> dict[str, list[MocapClip]]:
    """Return motions by subject."""
    people: dict[str, list[MocapClip]] = {}
    for clip in read_corpus(corpus, output_rate_hz=120.0, min_seconds=2.0):
        if clip.subject not in without and len(clip.poses) >= 2.0 * clip.poses.rate_hz:
            people.setdefault(clip.subject, []).append(resample_clip(low_passed(clip, 10.0), 60.0))
    return people


def takes(rng: np.random.Generator, people: dict[str, list[MocapClip]], version: int) -> list[Take]:
    """Simulate everyone once, every other version mirrored."""
    out = []
    for subject, clips in people.items():
        speed = float(np.exp(SPEED * rng.standard_normal()))
        seed = int(rng.integers(2**31))
        moved = LEVER_M * rng.standard_normal((len(SkeletonModel.default().sensors), 3))
        motions = []
        for clip in clips:
            with suppress(InvalidInputError):  # faster than any sensor measures
                motions.append(simulated(clip, speed, moved, seed))
        if motions:
            out.append(Take(subject, tuple(map(mirrored, motions) if version % 2 else motions)))
    return out


def simulated(clip: MocapClip, speed: float, moved: Array, seed: int) -> SensorMotions:
    """Return the motion of all usual sensors in a clip."""
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    places = [replace(s, offset=s.offset + d) for s, d in zip(skeleton.table.sensors, moved, strict=True)]
    skeleton = SkeletonModel(replace(skeleton.table, sensors=tuple(places)))
    poses = replace(clip.poses, times=clip.poses.times / speed)
    times = np.arange(poses.times[0], poses.times[-1], 1 / 60)
    imus, _ = simulate_imus(np.random.default_rng(seed), poses, skeleton, list(skeleton.sensors), times, ImuNoise())
    return sensor_motions(SensorLog.of_imus(imus, clip.name))


def mirrored(motions: SensorMotions) -> SensorMotions:
    """Return the motion of a mirrored person, sensors in the same order of names."""
    order = [motions.names.index(other_side(name)) for name in motions.names]
    M = np.diag([1.0, -1.0, 1.0])
    fields = {"R": M @ motions.R @ M, "w": -motions.w @ M, "a": motions.a @ M, "D": M @ motions.D @ M}
    return replace(motions, **{name: values[:, order] for name, values in fields.items()})


def other_side(name: str) -> str:
    """Return the name of the sensor on the other side."""
    return {"L": "R", "R": "L"}[name[0]] + name[1:] if name[1] == "_" else name


def windows(rng: np.random.Generator, of: Sequence[Take], count: int) -> tuple[Tensor, Tensor]:
    """Return features (N, S, F) and (N, S, S, G) of random pieces, people by the root of their time."""
    lengths = np.array([sum(map(len, take.motions)) for take in of])
    share = np.sqrt(lengths) / np.sqrt(lengths).sum()
    singles, pairs = [], []
    for _ in range(count):
        take = of[int(rng.choice(len(of), p=share))]
        window = piece(rng, take.motions, float(np.exp(rng.uniform(*np.log(SECONDS)))))
        singles.append(single_features(window))
        pairs.append(pair_features(window))
    return torch.from_numpy(np.stack(singles)).float(), torch.from_numpy(np.stack(pairs)).float()


def piece(rng: np.random.Generator, motions: Sequence[SensorMotions], seconds: float) -> SensorMotions:
    """Return pieces of motions in random order, so long together or as long as there are."""
    wanted, parts = round(seconds * RATE_HZ), []
    for i in rng.permutation(len(motions)):
        least = min(len(motions[i]), round(LEAST_PIECE * RATE_HZ))
        length = min(len(motions[i]), max(wanted, least))
        first = int(rng.integers(len(motions[i]) - length + 1))
        parts.append(motions[i][first : first + length])
        wanted -= length
        if wanted < LEAST_PIECE * RATE_HZ:
            break
    fields = {name: np.concatenate([getattr(p, name) for p in parts]) for name in ("times", "R", "w", "a", "D")}
    return SensorMotions(parts[0].names, **fields)


class Scores(nn.Module):
    """Scores (N, S, K) of single sensors on segments and (N, S, S, K, K) of pairs."""

    def __init__(self, single: Tensor, pair: Tensor) -> None:
        super().__init__()
        self.K = K = single.shape[1]
        off = ~torch.eye(K, dtype=torch.bool)
        self.scale = nn.ParameterDict(
            {
                "single_mean": single.mean(dim=(0, 1)),
                "single_sd": single.std(dim=(0, 1)) + 1e-3,
                "pair_mean": pair[:, off].mean(dim=(0, 1)),
                "pair_sd": pair[:, off].std(dim=(0, 1)) + 1e-3,
            }
        )
        self.scale.requires_grad_(False)
        F, G = single.shape[-1], pair.shape[-1]
        self.single = nn.Sequential(nn.Linear(F, HIDDEN[0]), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(HIDDEN[0], K))
        self.pair = nn.Sequential(
            nn.Linear(2 * F + G, HIDDEN[1]), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(HIDDEN[1], K * K)
        )

    def forward(self, single: Tensor, pair: Tensor) -> tuple[Tensor, Tensor]:
        f = ((single - self.scale["single_mean"]) / self.scale["single_sd"]).clamp(-4, 4)
        g = ((pair - self.scale["pair_mean"]) / self.scale["pair_sd"]).clamp(-4, 4)
        if self.training:
            f, g = f + FEATURE_NOISE * torch.randn_like(f), g + FEATURE_NOISE * torch.randn_like(g)
        N, S, F = f.shape
        first, second = f[:, :, None].expand(N, S, S, F), f[:, None].expand(N, S, S, F)
        table = self.pair(torch.cat([first, second, g], dim=-1)).reshape(N, S, S, self.K, self.K)
        table = (table + table.permute(0, 2, 1, 4, 3)) / 2
        return self.single(f), table * (1 - torch.eye(S))[:, :, None, None]


def loss_of(U: Tensor, P: Tensor, exchanges: Tensor, present: Tensor) -> Tensor:
    """Return the mean of minus the log probability of the truth among its alternatives.

    Sensor s is on segment s, and `present` (N, S) or not. The alternatives of a sensor are the other
    segments, whose sensors take its place; those of all are exchanges of sides, given as permutations.
    """
    S, i = U.shape[1], torch.arange(U.shape[1])
    U = U * present[..., None]
    P = P * (present[:, :, None] * present[:, None])[..., None, None]
    at = U + P[:, :, i, :, i].sum(dim=0)
    own, there = at[:, i, i], present[:, None]
    s, t = i[:, None].expand(S, S), i.expand(S, S)
    twice = P[:, s, t, t, t] + P[:, s, t, s, s] - P[:, s, t, t, s] - P[:, s, t, s, t]
    change = at - own[:, :, None] + there * (at.transpose(1, 2) - own[:, None] - twice)
    change = change * (1 - torch.eye(S))
    single = (torch.logsumexp(change, dim=2) * present).sum(dim=1) / present.sum(dim=1)
    total = total_of(U, P, i)
    others = torch.stack([torch.zeros_like(total), *(total_of(U, P, p) - total for p in exchanges)], dim=1)
    return (single + torch.logsumexp(others, dim=1)).mean()


def total_of(U: Tensor, P: Tensor, labels: Tensor) -> Tensor:
    """Return the score (N,) of sensor s on segment labels[s]."""
    i = torch.arange(U.shape[1])
    s, t = torch.triu_indices(len(i), len(i), 1)
    return U[:, i, labels].sum(dim=1) + P[:, s, t, labels[s], labels[t]].sum(dim=1)


def side_exchanges(names: Sequence[str]) -> Tensor:
    """Return permutations (M, S): all sides, arms, legs."""
    all_ = [names.index(other_side(name)) for name in names]
    arms = [o if "Arm" in n else s for s, (n, o) in enumerate(zip(names, all_, strict=True))]
    legs = [o if "Arm" not in n else s for s, (n, o) in enumerate(zip(names, all_, strict=True))]
    return torch.tensor([all_, arms, legs])


def some(count: int, S: int) -> Tensor:
    """Return which sensors are present (N, S): at least four of them, all in every other row."""
    fewer = torch.rand(count, S).argsort(dim=1) < torch.randint(4, S + 1, (count, 1))
    return (fewer | (torch.arange(count) % 2 == 0)[:, None]).float()


def fit(single: Tensor, pair: Tensor, single_kept: Tensor, pair_kept: Tensor) -> Scores:
    """Return the model that is best on the kept windows, its scores scaled by its best temperature."""
    model, names = Scores(single, pair), list(SkeletonModel.default().sensors)
    exchanges, S = side_exchanges(names), len(names)
    present, best = some(len(single_kept), S), (np.inf, 1.0, model.state_dict())
    optimiser = torch.optim.AdamW(model.parameters(), lr=RATE, weight_decay=DECAY)
    batches = len(single) // BATCH
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=EPOCHS * batches)
    for epoch in range(EPOCHS):
        model.train()
        for rows in torch.randperm(len(single)).split(BATCH)[:batches]:
            loss = loss_of(*model(single[rows], pair[rows]), exchanges, some(BATCH, S))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        model.eval()
        with torch.no_grad():
            U, P = model(single_kept, pair_kept)
            for scale in SCALES:
                held = float(loss_of(U * scale, P * scale, exchanges, present))
                if held < best[0]:
                    best = (held, scale, {name: p.clone() for name, p in model.state_dict().items()})
        print(f"epoch {epoch}: {loss.item():.3f}, kept {best[0]:.3f} at scale {best[1]:g}", flush=True)
    model.load_state_dict(best[2])
    with torch.no_grad():
        for layer in (model.single[-1], model.pair[-1]):
            layer.weight *= best[1]
            layer.bias *= best[1]
    return model


def write(model: Scores, path: Path) -> None:
    """Write layers in half precision."""
    arrays = {name: p.detach().numpy() for name, p in model.scale.items()}
    for name, net in (("single", model.single), ("pair", model.pair)):
        for i, layer in enumerate((net[0], net[3])):
            arrays[f"{name}_weight{i}"] = layer.weight.detach().numpy().astype(np.float16)
            arrays[f"{name}_bias{i}"] = layer.bias.detach().numpy()
    segments = [joint for joint, _ in SkeletonModel.default().sensors.values()]
    np.savez_compressed(path, segments=np.array(segments), **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
