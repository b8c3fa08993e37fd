"""The four limbs: which segments they have, and which of them carry sensors."""

from __future__ import annotations

from collections.abc import Collection

LIMBS = tuple(
    tuple(side + part for part in parts)
    for side in ("Left", "Right")
    for parts in (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"))
)
"""Segments of each by their joints: two long bones, and the end."""


def bare(sensors: Collection[str]) -> set[str]:
    """Segments of the limbs that carry no sensor at all.

    Args:
        sensors: joints whose segments carry one.
    """
    return {name for limb in LIMBS if not {*limb} & {*sensors} for name in limb}


def both_bones_sensed(sensors: Collection[str]) -> bool:
    """Whether a limb has a sensor on each of its two bones, whose accelerations tell the root's path."""
    return any({*limb[:2]} <= {*sensors} for limb in LIMBS)
