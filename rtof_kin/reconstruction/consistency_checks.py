"""Facts told of a recording that cannot all be true, and what the recording itself says against them."""

from __future__ import annotations

import numpy as np

from rtof_kin.calibration.result import SelfCalibration, Verdict
from rtof_kin.core.errors import CalibrationError
from rtof_kin.recording.recording import Recording

_HEIGHT_SHARE = 0.1
"""By how much a body's height may differ from that of its bones: five times what bodies do of one sum of
bone lengths, where only some of them were measured."""
_SIGMAS = 6.0
"""Prior standard deviations beyond which a value contradicts what was held before; sensors that slip all
through a recording of some seconds reach four in one of three."""


def check_height(recording: Recording) -> None:
    """Check that a height and the bones told beside it are of one body.

    Raises:
        CalibrationError: no bone lengths of such a body fit the height; names both heights.
    """
    told, made = recording.height, recording.skeleton.height
    if told is not None and abs(made / told - 1) > _HEIGHT_SHARE:
        raise CalibrationError(
            f"recording {recording.name}: its height is told to be {told:.2f} m, but its bone lengths "
            f"make a body {made:.2f} m tall; measure again, or give only one of the two"
        )


def consistency_warnings(recording: Recording, calibration: SelfCalibration) -> tuple[str, ...]:
    """Sentences about what the recording says against what was told or held of it.

    Args:
        recording: as it was told.
        calibration: what was estimated of it.
    """
    found = []
    for q, row in zip(calibration.quantities, calibration.table(), strict=True):
        if q.doubt:
            found.append(f"{row[0]} of {row[1]}: {row[2]} is in doubt: {q.doubt}")
        away = float(np.max(np.abs(q.value) / q.sigma_prior))
        if q.verdict is not Verdict.PRIOR and away > _SIGMAS:
            kind, item, value, _, prior, _ = row
            found.append(
                f"{kind} of {item}: {value} is {away:.0f} times the {prior} that it was held to be known "
                "to; what was told of it is wrong, or what else was told"
            )
    told = recording.height
    if told is not None and any(line.startswith("bones") for line in found):
        made = calibration.apply(recording).skeleton.height
        found.append(f"the height is told to be {told:.2f} m; the bones found make {made:.2f} m")
    return tuple(found)
