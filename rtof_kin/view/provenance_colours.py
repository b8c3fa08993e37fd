"""Colours and words by which pictures tell how a joint was observed."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.data.poses import Provenance

Rgb = tuple[int, int, int]
COLOURS: Final[dict[Provenance, Rgb]] = {
    Provenance.CAMERA_AND_IMU: (0, 158, 115),
    Provenance.CAMERA: (86, 180, 233),
    Provenance.IMU: (230, 159, 0),
    Provenance.BRIDGED: (204, 121, 167),
    Provenance.PRIOR: (150, 150, 150),
    Provenance.NOBODY: (150, 150, 150),
}
"""RGB by provenance, distinguishable with a colour vision deficiency (Okabe and Ito, 2008)."""
PALETTE: Final[NDArray[np.uint8]] = np.array([COLOURS[kind] for kind in sorted(Provenance)], dtype=np.uint8)
"""(kinds, 3) the same, by the number of the provenance."""
WORDS: Final[dict[Provenance, str]] = {
    Provenance.CAMERA_AND_IMU: "camera and IMU",
    Provenance.CAMERA: "camera",
    Provenance.IMU: "IMU",
    Provenance.BRIDGED: "bridged",
    Provenance.PRIOR: "prior",
    Provenance.NOBODY: "not observed",
}
"""Legend by provenance."""
