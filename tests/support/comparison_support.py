"""Clinical angles with planted values and standard deviations, for the tests of comparisons."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.comparison import Compared

Array = NDArray[np.float64]
ROWS = {row.name: row for row in angle_table(SkeletonModel.default().table).rows}


def angles_of(
    times: ArrayLike, columns: dict[str, ArrayLike], sigma: float | None = None, **fields: Any
) -> ClinicalAngles:
    """Angles over time, degrees, with one standard deviation in degrees; None for no bands."""
    times = np.asarray(times, dtype=float)
    values = np.radians(np.stack([np.broadcast_to(c, times.shape) for c in columns.values()], axis=1))
    nothing = np.zeros(values.shape)
    bands = None if sigma is None else np.full(values.shape, np.radians(sigma))
    return ClinicalAngles(
        times,
        values,
        nothing.astype(np.uint8),
        nothing.astype(np.bool_),
        tuple(ROWS[n] for n in columns),
        sigma=bands,
        **fields,
    )


def one(
    name: str, times: ArrayLike, columns: dict[str, ArrayLike], sigma: float | None = None, **fields: Any
) -> Compared:
    """One side of a comparison."""
    return Compared(name, angles_of(times, columns, sigma), **fields)
