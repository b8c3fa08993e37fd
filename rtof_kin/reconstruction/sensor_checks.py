"""Checks of a recording's sensors and clocks against physics, the image and the reconstructed motion.

What makes other checks fail too comes first: samples in another form than a recording takes, then the
clocks, then which sensor is where. A check that an earlier failure would mislead is not made.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import best_exchange, bone_images
from rtof_kin.calibration.clock_check import NAME as CLOCKS
from rtof_kin.calibration.clock_check import check_clocks
from rtof_kin.core.errors import CalibrationError, InvalidInputError, SolverError
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.inertial.recorded_form import check_form
from rtof_kin.inertial.setup_diagnosis import LEAST_RATIO, Fault, FaultKind, diagnose_setup
from rtof_kin.reconstruction.prepare import LifterLike, Prepared, ReconstructionSettings, prepare
from rtof_kin.recording.recording import Recording

SETUP = "evidence for another setup"
_SURE, _SURE_OF_ONE = 25.0, 40.0
"""Nats from which sensors are accused where nobody asked; and one alone, as which odd movement looks."""
_OF_ALL, _OF_ONE = (FaultKind.WORLD, FaultKind.FACING), (FaultKind.SEGMENT, FaultKind.MOUNTING)
"""Faults of all sensors together, for which `LEAST_RATIO` is enough, and of one."""
_THINNED = 0.05
"""[s] between samples that are looked at for whether they were exchanged."""
_LEAST_SECONDS = 2.0
"""[s] of movement by which sensors' places and references can be judged."""
_ELSEWHERE = (FaultKind.SIDES, FaultKind.NEIGHBOURS, FaultKind.SWAPPED, FaultKind.SEGMENT)
"""What looks otherwise where sensors were calibrated in an N-pose, before they were declared wrongly."""
_DISAGREES, _EXCHANGED = 2.8, 0.7
"""Nats a frame by which a sensor differs from the image, and by which two differ less on each other's
segments, for the setup to be looked into: one good recording in twenty reaches one of them."""


def check_sensor_form(recording: Recording) -> tuple[Check, ...]:
    """Checks by physics alone that samples are in the form that a recording takes."""
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None or not set(imus.names) <= set(calibration.sensors):
        return ()
    return check_form(imus, calibration.select(imus.names).R_world_inertial)


def check_sensor_evidence(
    recording: Recording, prepared: Prepared, skeleton: SkeletonModel, lifter: LifterLike | None,
    settings: ReconstructionSettings, doubted: bool = False, view_doubted: bool = False,
) -> tuple[Check, ...]:  # fmt: skip
    """Checks of what the recording declares about sensors and clocks.

    Args:
        recording: as declared, before calibration and outlier rejection.
        prepared: the prepared streams and the poses of each stage before the solver.
        skeleton: the subject's. lifter, settings: as for `reconstruct`.
        doubted: whether something else that was found may be explained by how sensors are set up.
        view_doubted: whether a check of the camera failed: a picture that is turned or mirrored makes
            sensors look turned all together.

    Returns:
        Every check that the recording allows; failed ones name their likely `cause`.
    """
    form = check_sensor_form(recording)
    if not form or recording.imus is None or recording.calibration is None:
        return form
    if wrong := next((check for check in form if check.failed), None):
        why = f"samples are not what they are declared to be: {wrong.cause}"
        unknown = ((CLOCKS, "video and sensors", "s"), (SETUP, "sensors", "nats"))
        return (*form, *(Check.unknown(*what, why) for what in unknown))
    seen, lifted = _as_seen(recording, prepared), prepared.stages["lift"]
    native = recording.calibration.apply(recording.imus)
    clocks = check_clocks(seen, native, lifted, skeleton)
    if clocks.failed:
        return (*form, clocks, Check.unknown(SETUP, "sensors", "nats", f"first {clocks.cause}"))
    images = bone_images(seen, native, lifted, skeleton)
    off = np.full(1, np.nan) if images is None else images.by_sensor()
    if np.isnan(off).all() and not doubted:
        why = "the image shows no bone of theirs"
        return (*form, clocks, Check.unknown(SETUP, "sensors", "nats", why))
    doubted = doubted or bool(np.nanmax(off, initial=0.0) > _DISAGREES)
    readings = (_exchanged_segments(native), _exchanged_samples(recording.imus, recording.calibration))
    if not doubted and all(
        best_exchange(seen, reading, lifted, skeleton) <= _EXCHANGED for reading in readings
    ):
        return (*form, clocks, Check(SETUP, "sensors", 0.0, _SURE, "nats"))
    setup = _check_setup(recording, skeleton, lifter, settings, view_doubted)
    return (*form, clocks, setup)


@contextmanager
def naming_wrong_samples(recording: Recording) -> Iterator[None]:
    """Errors of what runs inside begin with what is wrong with the sensors' samples, if anything."""
    try:
        yield
    except (CalibrationError, InvalidInputError, SolverError) as error:
        causes = [check.message for check in check_sensor_form(recording) if check.failed]
        if not causes:
            raise
        raise type(error)("; ".join([*causes, f"therefore {error}"])) from error


def _as_seen(recording: Recording, prepared: Prepared) -> KeypointSequence:
    """The keypoints that were lifted, on the clock that was declared."""
    lifted, declared = prepared.recording.video, recording.video
    return replace(lifted, times=lifted.times + declared.times[0] - lifted.times[0])


def _exchanged_segments(native: BoneImuSequence) -> Iterator[BoneImuSequence]:
    """The sensors on each other's segments, as `best_exchange` takes them."""
    for joints in _rolled(native.joints):
        yield replace(native, joints=joints)


def _exchanged_samples(imus: ImuSequence, calibration: ImuCalibration) -> Iterator[BoneImuSequence]:
    """The samples read with each other's calibrations, as `best_exchange` takes them."""
    step = float(np.median(np.diff(imus.times))) if len(imus) > 1 else _THINNED
    few = slice(None, None, max(1, int(_THINNED / step)))
    R, f = imus.R_inertial_sensor[few], imus.f_sensor[few]
    thin = replace(imus, times=imus.times[few], R_inertial_sensor=R, f_sensor=f)
    for names in _rolled(imus.names):
        yield calibration.apply(replace(thin, names=names))


def _rolled(names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    for shift in range(len(names)):
        yield names[shift:] + names[:shift]


def _check_setup(
    recording: Recording, skeleton: SkeletonModel, lifter: LifterLike | None,
    settings: ReconstructionSettings, view_doubted: bool,
) -> Check:  # fmt: skip
    """Whether each sensor is where it is declared, and its world the camera's, by all that movement
    tells.
    """
    seen = prepare(recording, skeleton, "lift", lifter, settings, lambda *_: None)
    bone_imus = seen.recording.bone_imus()
    if bone_imus is None or not _long_enough(bone_imus):
        why = f"there are less than {_LEAST_SECONDS:g} s of video and sensors together"
        return Check.unknown(SETUP, "sensors", "nats", why)
    found = [
        fault for pose, kinds in (("T", tuple(FaultKind)), ("N", _ELSEWHERE)) for fault in diagnose_setup(
            bone_imus, skeleton, pose=pose, visual=seen.start, calibration=recording.calibration,
            kinds=kinds, most=1)
    ]  # fmt: skip
    if not found:
        return Check(SETUP, "sensors", 0.0, _SURE, "nats")
    fault = max(found, key=lambda fault: fault.log_likelihood_ratio / _least(fault))
    if view_doubted and fault.kind in _OF_ALL:
        why = "all sensors seem turned, which the camera may be the cause of"
        return Check.unknown(SETUP, "sensors", "nats", why)
    others = f". Or else: {'; '.join(fault.alternatives)}" if fault.alternatives else ""
    return Check(
        SETUP, "sensors", fault.log_likelihood_ratio, _least(fault), "nats", f"{fault.remedy}{others}",
        cause=fault.what,
    )  # fmt: skip


def _least(fault: Fault) -> float:
    """Nats from which a fault is named."""
    if fault.kind in _OF_ALL:
        return LEAST_RATIO
    return _SURE_OF_ONE if fault.kind in _OF_ONE else _SURE


def _long_enough(bone_imus: BoneImuSequence) -> bool:
    known = np.isfinite(bone_imus.R_world_bone).all(axis=(-2, -1)).any(axis=-1)
    return bool(known.any() and np.ptp(bone_imus.times[known]) >= _LEAST_SECONDS)
