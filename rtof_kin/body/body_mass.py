"""Mass, centre of mass and inertia of body segments (de Leva, J. Biomech. 29, 1996, table 4).

Limb segments run from the proximal to the distal joint, the head from the vertex to C7, trunk segments from
top to bottom. Fractions are of body mass and of segment length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtof_kin.core.array_types import Array


@dataclass(frozen=True)
class SegmentMass:
    """De Leva's values of a segment, (male, female)."""

    mass: tuple[float, float]
    """Fraction of body mass."""
    center: tuple[float, float]
    """Centre of mass from the first end, fraction of length."""
    radii: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Radii of gyration about the sagittal, transverse, longitudinal axis, fraction of length."""
    from_far_end: bool = False
    """True if de Leva's first end is the far end of the link (head and trunk)."""


SEGMENTS = {
    "head": SegmentMass((0.0694, 0.0668), (0.5002, 0.4841), ((0.303, 0.315, 0.261), (0.271, 0.295, 0.261)), True),
    "upper trunk": SegmentMass(
        (0.1596, 0.1545), (0.5066, 0.5050), ((0.505, 0.320, 0.465), (0.466, 0.314, 0.449)), True
    ),
    "middle trunk": SegmentMass(
        (0.1633, 0.1465), (0.4502, 0.4512), ((0.482, 0.383, 0.468), (0.433, 0.354, 0.415)), True
    ),
    "lower trunk": SegmentMass(
        (0.1117, 0.1247), (0.6115, 0.4920), ((0.615, 0.551, 0.587), (0.433, 0.402, 0.444)), True
    ),
    "upper arm": SegmentMass((0.0271, 0.0255), (0.5772, 0.5754), ((0.285, 0.269, 0.158), (0.278, 0.260, 0.148))),
    "forearm": SegmentMass((0.0162, 0.0138), (0.4574, 0.4559), ((0.276, 0.265, 0.121), (0.261, 0.257, 0.094))),
    "hand": SegmentMass((0.0061, 0.0056), (0.3624, 0.3427), ((0.288, 0.235, 0.184), (0.244, 0.208, 0.154))),
    "thigh": SegmentMass((0.1416, 0.1478), (0.4095, 0.3612), ((0.329, 0.329, 0.149), (0.369, 0.364, 0.162))),
    "shank": SegmentMass((0.0433, 0.0481), (0.4395, 0.4352), ((0.251, 0.246, 0.102), (0.267, 0.263, 0.092))),
    "foot": SegmentMass((0.0137, 0.0129), (0.4415, 0.4014), ((0.257, 0.245, 0.124), (0.299, 0.279, 0.139))),
}
SEXES = ("male", "female")
_COLUMNS: dict[str | None, list[int]] = {"male": [0], "female": [1], None: [0, 1]}


def mass_fraction(segment: str, sex: str | None) -> float:
    """Return the fraction of body mass of a segment.

    Args:
        segment: name in `SEGMENTS`. sex: 'male', 'female' or None for the mean.
    """
    return float(np.mean([SEGMENTS[segment].mass[i] for i in _COLUMNS[sex]]))


def inertia(segment: str, mass_kg: float, end: Array, sex: str | None) -> tuple[Array, Array]:
    """Return centre of mass (3,), m, and inertia about it (3, 3), kg m^2, of a link, in its frame.

    A link with a share of a segment (a vertebral level) has the shape of the segment at its own length. The
    larger of the two transverse inertias is used about both transverse axes.

    Args:
        segment: name in `SEGMENTS`. mass_kg: mass of the link, kg. end: (3,) far end in the link frame, m.
        sex: 'male', 'female' or None for the mean.
    """
    entry = SEGMENTS[segment]
    share = float(np.mean([entry.center[i] for i in _COLUMNS[sex]]))
    radii = np.mean([entry.radii[i] for i in _COLUMNS[sex]], axis=0)
    length = float(np.linalg.norm(end))
    along = end / length
    center = (1 - share if entry.from_far_end else share) * end
    across = mass_kg * (max(radii[0], radii[1]) * length) ** 2
    longitudinal = mass_kg * (radii[2] * length) ** 2
    projector = np.outer(along, along)
    return center, across * (np.eye(3) - projector) + longitudinal * projector
