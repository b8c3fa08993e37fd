"""Names that people and devices give to the segments that carry sensors.

A name is split into words: ``tibia_r_imu``, ``RTibia``, ``right shank``, ``Shank RT``, ``R_LowLeg`` and
``RightLeg`` are the same segment. A word that is not known makes the whole name unknown: nothing is guessed.
``segment_names.toml`` has the words.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import UnknownNameError

_TABLES: Final[dict[str, dict[str, list[str]]]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
_SIDES, _MIDDLE, _LIMBS, _HUMAN36M = (
    {word: meaning for meaning, words in _TABLES[name].items() for word in words}
    for name in ("sides", "middle", "limbs", "human36m")
)
"""Word, or words, -> what they mean."""
_SAME: Final = {"upper": "up", "lower": "low"}
_IDLE = frozenset({"imu", "sensor", "segment"})  # Words that say nothing about the place
_SERIAL: Final = re.compile(r"(?=.*\d)[0-9A-Fa-f]{8}")
_WORDS: Final = re.compile(r"[A-Z]+(?![a-z])\d*|[A-Z]?[a-z]+\d*|\d+")


def segment_of(name: str, skeleton: SkeletonModel) -> str | None:
    """Return the segment, by its proximal joint, of the name of a segment, sensor or place on the body, e.g. 'LeftLeg',
    'L_LowLeg', 'tibia_l_imu', or of a sensor in the skeleton's table; None where the name is not known.
    """
    if name in skeleton.names:
        return name
    if name in skeleton.sensors:
        return skeleton.sensors[name][0]
    words = _words(name)
    own = {_words(joint): joint for joint in skeleton.names}
    own |= {_words(sensor): joint for sensor, (joint, _) in skeleton.sensors.items()}
    found = _of_words(words, skeleton.name) or own.get(words)
    return found if found in skeleton.names else None


def segments_of(names: Iterable[str], skeleton: SkeletonModel) -> dict[str, str]:
    """Return the segments of those names that `segment_of` knows, each segment at most once. Two names of the same
    segment are both left out, as one of them must be somewhere else.
    """
    found = {name: joint for name in names if (joint := segment_of(name, skeleton)) is not None}
    taken = list(found.values())
    return {name: joint for name, joint in found.items() if taken.count(joint) == 1}


def known_segment(name: str, skeleton: SkeletonModel, path: str | Path | None = None) -> str:
    """Return the segment that a name means, see `segment_of`; `UnknownNameError` where it means none."""
    found = segment_of(name, skeleton)
    if found is None:
        words = (*_MIDDLE, *(f"{side} {place}" for side in ("left", "right") for place in _LIMBS))
        known = (*skeleton.names, *skeleton.sensors)
        raise UnknownNameError("segment", [name], known, path, also=words)
    return found


def _words(name: str) -> frozenset[str]:
    """Return the words of a name in small letters, without those that say nothing."""
    pieces = [piece for piece in re.split(r"[^0-9A-Za-z]+", name) if not _SERIAL.fullmatch(piece)]
    words = [word.lower() for piece in pieces for word in _WORDS.findall(piece)]
    words = [part for word in words for part in _parts(word)]
    return frozenset(_SAME.get(word, word) for word in words if word not in _IDLE)


def _parts(word: str) -> tuple[str, ...]:
    """Split words that are written as one: 'ltibia', 'upperarm'."""
    for start in (*_SAME, *_SAME.values()):
        rest = word.removeprefix(start)
        if rest in ("arm", "leg", "back", "spine", "trunk") and rest != word:
            return start, rest
    if word[:1] in ("l", "r") and word[1:] in _LIMBS:
        return word[0], word[1:]
    return (word,)


def _of_words(words: frozenset[str], skeleton: str) -> str | None:
    """Return the joint of a side and a place; None where there is not exactly one of each."""
    sides = {_SIDES[word] for word in words if word in _SIDES}
    place = frozenset(word for word in words if word not in _SIDES)
    if len(sides) > 1:
        return None
    table = _LIMBS if sides else _MIDDLE
    joint = next((to for spelt, to in table.items() if frozenset(spelt.split()) == place), None)
    if joint is None:
        return None
    side = next(iter(sides), "")
    if skeleton != "human36m":
        return side + joint
    return side[:1] + _HUMAN36M[joint] if joint in _HUMAN36M else None


def other_side(name: str) -> str:
    """Return the segment on the other side of the body; one in the middle is its own."""
    if name.startswith("Left"):
        return "Right" + name.removeprefix("Left")
    return "Left" + name.removeprefix("Right") if name.startswith("Right") else name
