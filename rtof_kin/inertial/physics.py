"""Checks of sensor streams by physics, and the likely meaning of a file that fails them.

Nothing is changed: a failed check names the change of the declaration under which the same numbers obey the
law. The laws are in `gravity` and `turning`, clocks and channels in `sampling`, other declarations in
`alternatives`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial import gravity, turning
from rtof_kin.inertial.alternatives import likely_changes
from rtof_kin.inertial.sampling import check_sampling

LAWS: Final = (
    gravity.FORCE, gravity.DIRECTION, gravity.MEAN_ACCELERATION, gravity.LEVER, turning.GYROSCOPE,
)  # fmt: skip
"""Names of the checks that fail for a wrong declaration of a unit or of axes."""


def check_log(log: SensorLog) -> tuple[Check, ...]:
    """Check all sensors of a file, which share one declaration.

    Args:
        log: the sensors.

    Returns:
        For each sensor the laws, then clock and channels. `Check.likely` of a failed law is the change of
        the declaration under which all failing sensors obey, if there is a single one.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers give infinite figures, which fail
        return _check(log.streams, log.declaration)


def _check(streams: Sequence[SensorStream], declared: Declaration) -> tuple[Check, ...]:
    found = [_laws(stream, declared) for stream in streams]
    wrong = [stream for stream, checks in zip(streams, found, strict=True) if _broken(checks)]
    changes = likely_changes(wrong, declared) if wrong else []
    out: list[Check] = []
    for stream, checks in zip(streams, found, strict=True):
        if broken := _broken(checks):
            why, likely = _explanation(stream, declared, broken, changes)
            checks = tuple(
                replace(c, advice=f"{c.advice}. {why}", likely=likely) if c in broken else c for c in checks
            )
        out += [*checks, *check_sampling(stream, declared)]
    return tuple(out)


def _laws(stream: SensorStream, declared: Declaration) -> tuple[Check, ...]:
    per_metre = gravity.turning_acceleration(stream)
    force, direction, mean, lever = gravity.gravity_checks(stream, gravity.at_rest(stream), per_metre)
    if declared.gravity == "removed" and direction.passed:  # what `Declaration` put back points up
        why = "gravity was removed, so that no direction of it is left"
        direction = Check.unknown(gravity.DIRECTION, stream.name, "deg", why)
    return (force, direction, mean, lever, *turning.turning_checks(stream))


def _broken(checks: Sequence[Check]) -> list[Check]:
    return [check for check in checks if check.failed and check.name in LAWS]


def _explanation(
    stream: SensorStream, declared: Declaration, broken: Sequence[Check], changes: Sequence[Mapping[str, str]]
) -> tuple[str, Mapping[str, Any]]:
    """Return why laws do not hold, as a sentence and, if unique, as a change of the declaration."""
    if changes:
        text = "; or with ".join(_declared(change) for change in changes)
        return f"It would hold with {text}", changes[0] if len(changes) == 1 else {}
    fixed = turning.fixed_axes(stream)
    if fixed is not None:
        then = "" if fixed.mirrored else f"; {_then(fixed.applied(stream), declared)}"
        return f"By the gyroscope, {fixed}{then}", {}
    rate_hz = turning.likely_rate(stream)
    if rate_hz is not None and [check.name for check in broken] == [turning.GYROSCOPE]:
        likely = {"rate_hz": round(rate_hz, 1)}
        return f"It would hold with {_declared(likely)}", likely
    return "No other declaration makes it hold", {}


def _then(stream: SensorStream, declared: Declaration) -> str:
    """Return what else a stream needs once its orientation is of its own axes."""
    wrong = _broken(_laws(stream, declared))
    if not wrong:
        return "with that rotation gravity points up"
    changes = likely_changes([stream], declared)
    if len(changes) == 1:
        return f"with that rotation, and {_declared(changes[0])}, gravity points up"
    return f"with that rotation {wrong[0].name} is still off by {wrong[0].value:.3g} {wrong[0].unit}"


def _declared(change: Mapping[str, Any]) -> str:
    return " and ".join(f"{field} = {value}" for field, value in change.items())
