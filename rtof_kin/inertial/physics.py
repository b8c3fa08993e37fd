"""Checks of sensor streams by physics, and what a file that fails them is likely to mean.

Nothing is changed: a check says by how much a law is missed, and names the change of the declaration
under which the same numbers would obey it. The laws are in `gravity` and `turning`, clocks and channels
in `sampling`, other declarations in `alternatives`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu_declaration import Declaration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.inertial import gravity, turning
from rtof_kin.inertial.alternatives import fixed_axes, likely_changes, likely_rate
from rtof_kin.inertial.sampling import check_sampling

LAWS = (
    gravity.FORCE, gravity.DIRECTION, gravity.MEAN_ACCELERATION, gravity.LEVER, turning.GYROSCOPE,
)  # fmt: skip
"""Names of the checks that a wrong declaration of a unit or of axes fails."""


def check_stream(stream: SensorStream, declaration: Declaration) -> tuple[Check, ...]:
    """All checks of one sensor.

    Args:
        stream: what it measured.
        declaration: what its numbers were read as.

    Returns:
        The laws, then clock and channels. Of a law that does not hold, `Check.likely` is the change of
        the declaration that makes all of them hold, where there is a single one.
    """
    return _check((stream,), declaration)


def check_log(log: SensorLog) -> tuple[Check, ...]:
    """All checks of all sensors of a file, which share one declaration: what is likely is what makes
    the laws hold for all that miss them.
    """
    return _check(log.streams, log.declaration)


@np.errstate(over="ignore", invalid="ignore")  # damaged numbers give infinite figures, which fail
def _check(streams: Sequence[SensorStream], declared: Declaration) -> tuple[Check, ...]:
    found = {stream.name: _laws(stream, declared) for stream in streams}
    wrong = [stream for stream in streams if _broken(found[stream.name])]
    changes = likely_changes(wrong, declared) if wrong else []
    out: list[Check] = []
    for stream in streams:
        checks = found[stream.name]
        broken = _broken(checks)
        if broken:
            why, likely = _explanation(stream, declared, broken, changes)
            checks = tuple(
                replace(c, advice=f"{c.advice}. {why}", likely=likely) if c in broken else c for c in checks
            )
        out += [*checks, *check_sampling(stream, declared)]
    return tuple(out)


def _laws(stream: SensorStream, declared: Declaration) -> tuple[Check, ...]:
    rest, gyroscope = gravity.at_rest(stream), turning.gyroscope(stream)
    direction = gravity.gravity_direction(stream, rest)
    if declared.gravity == "removed" and direction.passed:  # what `Declaration` put back points up
        why = "gravity was removed, so that no direction of it is left"
        direction = Check.unknown(gravity.DIRECTION, stream.name, "deg", why)
    return (
        gravity.specific_force(stream, rest),
        direction,
        gravity.mean_acceleration(stream, rest),
        gravity.lever_arm(stream, gravity.turning_acceleration(stream)),
        gyroscope,
        turning.jumps(stream, gyroscope.passed),
        turning.gyroscope_delay(stream),
        turning.quaternion_norm(stream),
    )


def _broken(checks: Sequence[Check]) -> list[Check]:
    """The laws that do not hold."""
    return [check for check in checks if check.failed and check.name in LAWS]


def _explanation(
    stream: SensorStream, declared: Declaration, broken: Sequence[Check], changes: Sequence[Mapping[str, str]]
) -> tuple[str, Mapping[str, Any]]:
    """Why laws do not hold, as a sentence and, where it is one thing to declare, as a change."""
    if changes:
        text = "; or with ".join(_declared(change) for change in changes)
        return f"It would hold with {text}", changes[0] if len(changes) == 1 else {}
    fixed = fixed_axes(stream)
    if fixed is not None:
        then = "" if fixed.mirrored else f"; {_then(fixed.applied(stream), declared)}"
        return f"By the gyroscope, {fixed}{then}", {}
    rate_hz = likely_rate(stream)
    if rate_hz is not None and [check.name for check in broken] == [turning.GYROSCOPE]:
        likely = {"rate_hz": round(rate_hz, 1)}
        return f"It would hold with {_declared(likely)}", likely
    return "No other declaration makes it hold", {}


def _then(stream: SensorStream, declared: Declaration) -> str:
    """What else a stream needs once its orientation is of its own axes."""
    wrong = _broken(_laws(stream, declared))
    if not wrong:
        return "with that rotation gravity points up"
    changes = likely_changes([stream], declared)
    if len(changes) == 1:
        return f"with that rotation, and {_declared(changes[0])}, gravity points up"
    return f"with that rotation {wrong[0].name} is still off by {wrong[0].value:.3g} {wrong[0].unit}"


def _declared(change: Mapping[str, Any]) -> str:
    return " and ".join(f"{field} = {value}" for field, value in change.items())
