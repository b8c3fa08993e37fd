"""Subjects that the inflation is fitted on: all but the test's, one kind of rig.

Most of them are people of the lifter's training; what that does is measured in docs/clinical.md. Two
validation subjects are left out, whose rigs define a pelvis that is turned by 14 to 20 degrees against
everyone else's: a constant of theirs, not of the method's.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks import harness
from rtof_kin.simulation.mocap import MocapClip

FITTED_ON = {
    "CMU008": {"08_04": 1, "08_05": 1, "08_11": 1},
    "CMU131": {"131_01": 1, "131_02": 1, "131_03": 3},
    "CMU001": {"01_01": 2, "01_05": 2, "01_14[0:1516]": 2},
    "CMU003": {"03_01": 1},
    "CMU005": {
        "05_02[0:657]": 1, "05_04[0:684]": 1, "05_09[0:734]": 1, "05_12": 1, "gs_pirouette[280:591]": 1,
    },
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
}  # fmt: skip
"""Motions by subject, with the number of parts each is cut into."""


def person(motion: str) -> str:
    """Return the subject of a motion of `FITTED_ON`, or of a part of one.

    Raises:
        KeyError: it is none of them.
    """
    owners = {name: who for who, motions in FITTED_ON.items() for name in motions}
    return owners[motion] if motion in owners else owners[motion.rpartition("-")[0]]


def clips(corpus: Path) -> list[MocapClip]:
    """The middle of every part, as long as the benchmark's motions."""
    parts = {name: count for motions in FITTED_ON.values() for name, count in motions.items()}
    whole = harness.whole_clips(corpus, list(FITTED_ON), list(parts))
    return [part for clip in whole for part in harness.parts_of(clip, parts[clip.name])]
