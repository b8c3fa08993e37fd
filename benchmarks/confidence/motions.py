"""Recordings that the inflation is fitted on: people of the training split on rigs of two kinds.

Those that the factors of whole curves are made of are of other people (`curve_recordings`).

The test people and the held-out rigs take no part, nor do those of validation. Half of the recordings are
re-posed on a rig like Total Capture's (`benchmarks.rerigged`), with a neutral posture of each person's own:
else the bands would know the rigs that lifter and prior were learned on, and nothing of a body that stands
and bends otherwise. Length, camera and number of sensors take turns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import harness
from benchmarks.rerigged import rerigged
from lifting.training.corpus import Corpus, read_corpus
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import low_passed

FITTED_ON = {
    "CMU001": {"01_01": 2, "01_05": 2, "01_14[0:1516]": 2},
    "CMU003": {"03_01": 1},
    "CMU005": {"05_02[0:657]": 1, "05_04[0:684]": 1, "05_09[0:734]": 1, "05_12": 1, "gs_pirouette[280:591]": 1},
    "CMU006": {"06_01": 1, "06_05": 1, "06_07": 1, "06_10": 1, "06_13": 2},
    "CMU007": {"07_01": 1, "07_04": 1},
    "CMU010": {"10_04": 1},
    "CMU032": {"32_01": 1},
    "CMU035": {"35_01": 1, "35_15": 1},
    "CMU038": {"38_01": 1, "38_02": 1},
    "CMU039": {"39_02": 1, "39_12": 1},
    "CMU043": {"43_01": 1},
    "CMU049": {"49_01": 1},
    "CMU055": {"55_04": 1, "gs_lambada": 3},
    "CMU (renamed by repo: zombie)": {"gs_zombie": 2},
    "CMU (indian dance, 94?)": {"indian_06": 3},
}
"""Motions by subject, with the number of parts each is cut into."""
EXERCISES = tuple(f"UIPRMD{person:02d}" for person in range(1, 7))
REPETITIONS = 5
"""Of rehabilitation exercises, by each of these people."""
SECONDS = (2.0, 10.0)
"""Shortest and longest recording, where the motion is that long."""
SAME_PEOPLE = ("CMU094",)
"""Names of `FITTED_ON` in a corpus of models/build_corpus.py, where they differ."""
DAMAGED = ("CMU (renamed by repo: charleston2)",)
"""Of a corpus: no sensor would read what these motions make it read."""
PER_PERSON = 4
"""Recordings with each number of sensors, of a person whom the factors of whole curves are made of."""


def clips(corpus: Path, exercises: Path | None) -> list[MocapClip]:
    """The middle of every part, as long as the benchmark's motions, and repetitions of exercises.

    Args:
        corpus: the folder of free motion. exercises: a corpus of models/build_corpus.py.
    """
    parts = {name: count for motions in FITTED_ON.values() for name, count in motions.items()}
    whole = harness.whole_clips(corpus, list(FITTED_ON), list(parts))
    own = [part for clip in whole for part in harness.parts_of(clip, parts[clip.name])]
    return own + (harness.exercise_clips(exercises, EXERCISES, REPETITIONS) if exercises else [])


def recordings(clips: Sequence[MocapClip], sensors: Sequence[str]) -> Iterator[tuple[MocapClip, int, str]]:
    """What is recorded, by which camera, with how many sensors: every motion once with each number.

    Args:
        clips: the motions. sensors: the numbers.
    """
    rng = np.random.default_rng(0)
    for i, clip in enumerate(clips):
        for k, count in enumerate(sensors):
            part = harness.middle(clip, rng.uniform(*SECONDS))
            yield (rerigged(part) if (i + k) % 2 else part), int(rng.integers(4)), count


def curve_people(corpus: Corpus) -> dict[str, list[int]]:
    """People whom nothing of the bands was fitted on and who are not tested on, with their clips of `SECONDS`.

    Args:
        corpus: of models/build_corpus.py.
    """
    others = {*FITTED_ON, *SAME_PEOPLE, *DAMAGED, *EXERCISES, *harness.split()["test"]}
    found: dict[str, list[int]] = {}
    for clip, person in enumerate(corpus.subjects):
        if person not in others and corpus.start[clip + 1] - corpus.start[clip] >= SECONDS[0] * corpus.rate_hz:
            found.setdefault(person, []).append(clip)
    return found


def curve_recordings(path: Path, sensors: Sequence[str]) -> Iterator[tuple[MocapClip, int, str]]:
    """What the factors of whole curves are made of; cameras and rigs take turns, and each person has all of them.

    Args:
        path: of a corpus of models/build_corpus.py. sensors: the numbers.
    """
    corpus, rng = read_corpus(path), np.random.default_rng(0)
    for p, (person, own) in enumerate(curve_people(corpus).items()):
        groups = np.array_split(own, min(len(own), PER_PERSON))
        for k in range(PER_PERSON):
            clip = max(groups[k % len(groups)], key=lambda c: corpus.start[c + 1] - corpus.start[c])
            whole = low_passed(harness.built_clip(corpus, clip), 10.0)
            for i, count in enumerate(sensors):
                frames = min(round(rng.uniform(*SECONDS) * corpus.rate_hz), len(whole.poses))
                first = int(rng.integers(len(whole.poses) - frames + 1))
                cut = replace(whole, poses=whole.poses[first : first + frames], name=f"{person}-{k}{count}")
                part = harness.middle(cut, SECONDS[1])
                yield (rerigged(part) if (i + k) % 2 else part), (p + i + k) % 4, count
