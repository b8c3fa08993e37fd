"""Segments of the four limbs, and which of them carry sensors."""

from __future__ import annotations

from collections.abc import Collection

LIMBS = tuple(
    tuple(side + part for part in parts)
    for side in ("Left", "Right")
    for parts in (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"))
)
"""Segments of each limb by their joints: two long bones and the end."""


def bare(sensors: Collection[str]) -> set[str]:
    """Return the segments of limbs without any sensor."""
    return {name for limb in LIMBS if not {*limb} & {*sensors} for name in limb}


def both_bones_sensed(sensors: Collection[str]) -> bool:
    """Return whether a limb has sensors on both long bones, which makes the root position observable."""
    return any({*limb[:2]} <= {*sensors} for limb in LIMBS)
