"""Checks of what a recording declares, against its samples (`sensors.check_sensor_form`) and, by `run`, its motion.

Every finding is a `rtof_kin.core.checks.Check`; of several that one mistake fails, the one that names it comes first.
`image` looks at the picture, `camera` at camera, body and floor, `sensors` and `causes` at sensors and clocks,
`position` at what is left open of positions in world.
"""

from __future__ import annotations

from dataclasses import replace

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import CalibrationError, InvalidInputError, RtofError, SolverError, ViewError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.checks.camera import ROOM_CHECKS, check_camera_alone, check_camera_evidence, check_legs
from rtof_kin.reconstruction.checks.causes import HEADING, RATE, VIEW
from rtof_kin.reconstruction.checks.image import OF_IMAGE
from rtof_kin.reconstruction.checks.position import PositionErrors
from rtof_kin.reconstruction.checks.sensors import check_sensor_evidence, check_sensor_form
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.prepare import Prepared
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.uncertainty import LegMisfit


def run(
    recording: Recording,
    prepared: Prepared,
    poses: PoseSequence,
    lifter: LifterLike | None = None,
    *,
    suspect: bool = False,
    belonging: tuple[Check, ...] = (),
    legs: LegMisfit | None = None,
) -> tuple[tuple[Check, ...], PositionErrors]:
    """Check what a recording declares against its motion.

    Args:
        recording: as declared. prepared: its streams and the poses of each stage before the solver.
        poses: solved. lifter: as for `reconstruct`.
        suspect: another finding may be explained by a wrong setup of the sensors.
        belonging: checks that the sensors belong to the video; of sensors that do not, nothing else is checked.
        legs: misfit of the solution at the legs, in modes that optimise.

    Returns:
        Every check that the recording allows, and what it leaves open of positions in world.
    """
    camera, position = check_camera_evidence(recording, prepared, poses, lifter)
    view_suspect = any(check.failed and check.name in OF_IMAGE for check in camera)
    sensors = check_sensor_evidence(recording, prepared, poses, lifter, suspect, view_suspect)
    if not any(check.failed for check in belonging):
        found = (*belonging, *sensors, *camera)
        if legs is not None:
            found = _with_legs(found, check_legs(legs, poses.times, prepared.bone_imus is not None))
    elif any(check.failed and check.name == RATE for check in sensors):  # at the right rate they may belong to it
        found = (*sensors, *camera)
    else:
        found = (*check_sensor_form(recording), *belonging, *camera)
    return found, position


def explained(
    error: RtofError, recording: Recording, skeleton: SkeletonModel, lifter: LifterLike | None
) -> RtofError | None:
    """Return an error of a reconstruction with its likely cause, if a check before it finds one; None for no cause."""
    if isinstance(error, ViewError):
        found = check_camera_alone(recording, skeleton, lifter)
        cause = next((check.cause for check in found if check.failed and check.cause), None)
        return None if cause is None else ViewError(f"{cause}: {error}")
    causes = [check.message for check in check_sensor_form(recording) if check.failed]
    if causes and isinstance(error, CalibrationError | InvalidInputError | SolverError):
        return type(error)("; ".join([*causes, f"therefore {error}"]))
    return None


def _with_legs(checks: tuple[Check, ...], legs: Check) -> tuple[Check, ...]:
    """The checks with that of the legs' keypoints: before those of directions that it would mislead, and
    unknown where another cause is likelier.
    """
    others = (c for c in checks if c.name not in (VIEW, HEADING) and not c.name.startswith(ROOM_CHECKS))
    wrong = next((check for check in others if check.failed), None)
    if legs.failed and wrong is not None:
        legs = replace(legs, value=float("nan"), advice=f"first {wrong.cause}")
    return (legs, *checks) if legs.failed else (*checks, legs)
