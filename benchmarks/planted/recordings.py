"""Right recordings of people whom nothing was fitted on: 5 to 8 s of motion, drawn cameras, realistic 2D.

Camera, clocks, body, mounting and floor are exact, the detector errs as a real one does, and so do the
sensors.
"""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks import harness
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.articulated import ArticulatedMotion
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import ANKLE_HEIGHT, MocapClip, map_motion, without_spikes
from rtof_kin.simulation.mocap_families import recognise_family, recognise_unit
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate

SECONDS: Final = 8.0
_SHORTEST: Final = 5.0  # [s]
_FASTEST: Final = 30.0  # [m/s] of a joint; beyond are glitches of one frame
_EACH: Final = 8
"""Most motions of a person."""
PEOPLE: Final = ("2", "9", "12", "14", "16", "13", "17", "26", "27", "29", "37", "46", "124")
"""Numbers in the second collection. The first five are those of the benchmark's test subjects; the others
are in no other collection, and their bones are not within 3.5 % (RMS) of a training subject's, as those of
64, 127 and 135 are, for one person may have several numbers (37 has the bones of 12)."""


@dataclass(frozen=True)
class Scene:
    """One motion, filmed once."""

    clip: MocapClip
    sensors: str
    """Key of `harness.SENSOR_SETS`, or '0'."""
    floor: bool
    """Whether the floor is declared."""
    seed: int

    @property
    def key(self) -> str:
        """Its name."""
        return f"{self.clip.name}, {self.sensors} sensors"

    def recording(self) -> Recording:
        """Simulate it, without any fault; its floor is at z = 0."""
        own = self.seed * 1_000_003 + zlib.crc32(self.clip.name.encode())
        settings = SimulationSettings(
            keypoints=DetectorErrors(camera=0.0, delay_frames=(0,)), sensors=harness.SENSOR_SETS.get(self.sensors, ())
        )
        found = simulate(
            self.clip.poses,
            self.clip.joint_offsets,
            camera=cameras(self.clip.poses, own),
            settings=settings,
            seed=own,
            name=self.key,
        )
        return replace(found, floor_height=0.0)


def cameras(poses: PoseSequence, seed: int) -> list[Camera]:
    """Draw four cameras around a motion, with lenses of 45 to 90 degrees, far enough for all of it."""
    rng, p = np.random.default_rng(seed), poses.p_world_joint
    low, high = p.min(axis=(0, 1)), p.max(axis=(0, 1))
    centre, radius = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) / 2
    found = []
    for _ in range(4):
        focal = float(np.exp(rng.uniform(np.log(950.0), np.log(2300.0))))
        distance = max(rng.uniform(2.5, 6.0), 1.1 * (radius + focal * 1.9 / 1080))
        azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 2.4)
        direction = np.array([np.cos(azimuth), np.sin(azimuth)])
        found.append(Camera.looking_at([*(centre[:2] + distance * direction), height], centre, focal))
    return found


def scenes(folders: Sequence[Path], sensors: Sequence[str], seed: int) -> list[Scene]:
    """All motions of the held-out people, people and numbers of sensors in turn.

    Args:
        folders: of free motion, as of `harness.test_clips`, and of the second collection (with ``cmu/``).
    """
    by_person: dict[str, list[MocapClip]] = {}
    for folder in sorted(folders, key=lambda one: not (one / "cmu").is_dir()):  # other rigs last
        for clip in _clips(folder):
            by_person.setdefault(clip.subject, []).append(clip)
    rounds = [clips[i] for i in range(_EACH) for clips in by_person.values() if i < len(clips)]
    return [Scene(clip, sensors[i % len(sensors)], i // len(sensors) % 2 == 0, seed) for i, clip in enumerate(rounds)]


@cache
def _clips(folder: Path) -> list[MocapClip]:
    if (folder / "cmu" / "index.csv").is_file():
        return list(_second_collection(folder / "cmu"))
    rigs = harness.split()["benchmark"]["rigs"]
    return [
        harness.middle(clip, SECONDS)
        for clip in harness.test_clips(folder)
        if clip.rig in rigs and len(clip.poses) >= _SHORTEST * clip.poses.rate_hz
    ]


def _second_collection(folder: Path) -> Iterator[MocapClip]:
    """Motions of `PEOPLE`, evenly chosen among the long ones, their middles."""
    rows = list(csv.DictReader((folder / "index.csv").read_text(encoding="utf-8").splitlines()))
    for number in PEOPLE:
        own = [
            row
            for row in rows
            if row["subject"] == number
            and float(row["max_joint_speed"]) < _FASTEST
            and float(row["seconds"]) > _SHORTEST
            and float(row["root_path_m"]) > 0.3
        ]
        for i in range(min(_EACH, len(own))):
            row = own[(2 * i + 1) * len(own) // (2 * min(_EACH, len(own)))]
            clip = _read(folder / f"s{row['set']}.npz", row["clip"], f"CMU{int(number):03d}")
            pieces = without_spikes(low_passed(clip, 10.0))
            longest = harness.middle(max(pieces, key=lambda piece: len(piece.poses)), SECONDS)
            if len(longest.poses) >= _SHORTEST * longest.poses.rate_hz:
                yield longest


def _read(path: Path, name: str, subject: str) -> MocapClip:
    """One motion of the second collection, 60 Hz, the floor at z = 0."""
    with np.load(path) as arrays:
        hierarchy = json.loads(bytes(arrays["hierarchy"]))
        quat = arrays[f"{name}/quat"].astype(float)
        root = arrays[f"{name}/root"].astype(float)
    R = so3.from_quat_wxyz(quat / np.linalg.norm(quat, axis=-1, keepdims=True))
    motion = ArticulatedMotion(
        tuple(hierarchy["names"]), tuple(hierarchy["parents"]), np.array(hierarchy["offsets"]), R, root, 60.0
    )
    family = recognise_family(path, motion)
    clip = map_motion(motion, family, recognise_unit(path, motion, family), 60.0, name)
    p = clip.poses.p_world_joint.copy()
    feet = [j for j, joint in enumerate(clip.poses.names) if joint.endswith("Foot")]
    p[..., 2] -= np.percentile(p[:, feet, 2].min(axis=1), 5) - ANKLE_HEIGHT
    return replace(clip, poses=replace(clip.poses, p_world_joint=p), subject=subject)
