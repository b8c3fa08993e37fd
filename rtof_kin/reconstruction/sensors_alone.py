"""Mode ``imu``: a motion from inertial sensors alone, by the same energy and solver as the other modes.

Calibrated sensors -> poses frame by frame (`inertial.initial_poses`) -> foot contacts -> root path
(`inertial.root_path`) -> contact_points -> `FragmentSolver` without keypoints. Heading and position are those of
the calibration and the first frame; both drift.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.body.pose_prior import has_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.inertial.initial_poses import poses_from_sensors
from rtof_kin.inertial.root_path import Contacts, by_hand, contact_points, detect_contacts, root_path
from rtof_kin.reconstruction.checks.sensors import check_sensor_form
from rtof_kin.reconstruction.points_beside_sensors import beside_sensors, decorrelated, on_path, rooted
from rtof_kin.reconstruction.prepare import Job, cleaned
from rtof_kin.reconstruction.result import Choices, Reconstruction
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.terms import PointData, PointTerm

_LOW = 0.75  # Fraction of the standing root height below which a person sits, kneels or lies
_LONG = 1.0  # [s] of that, or without contact, that causes a warning


RATE_HZ: Final = 60.0  #: [Hz] Frame rate; the sensors' rate where that is lower


def reconstruct_from_sensors(job: Job) -> Reconstruction:
    """Reconstruct a recording without its keypoints; its floor height counts, 0 where it has none.
    `InvalidInputError`: there are no IMUs, none has samples, the skeleton has no pose prior, or the settings are of
    cartesian space; `CalibrationError`: the IMUs are not calibrated.
    """
    settings, skeleton = job.settings, job.subject
    if settings.space == "cartesian" or isinstance(settings.fragment, CartesianSettings):
        raise InvalidInputError("mode imu is solved in joint space; leave out the other space and its settings")
    solver = settings.fragment or replace(settings, space="joint").solver(skeleton)
    assert isinstance(solver, JointSpaceSettings)
    recording, faults = cleaned(job.recording, settings, camera=False)
    if recording.imus is None:
        raise InvalidInputError("mode imu needs IMUs and the recording has none; use 'lift' or 'rto'")
    if not has_prior(skeleton.name):
        raise InvalidInputError(f"mode imu: no pose prior is shipped for the skeleton {skeleton.name!r}")
    bone_imus = recording.bone_imus(times=frame_times(recording.imus) if job.times is None else job.times)
    assert bone_imus is not None
    ankle_height = (recording.floor_height or 0.0) + solver.ankle_height
    start = poses_from_sensors(skeleton, bone_imus)
    read = [beside_sensors(lift, start, bone_imus, skeleton) for lift in recording.lifts]
    points = next((found for found, agreement in read if not agreement.doubt), None)
    left_out = (agreement.warning for _, agreement in read if agreement.doubt)
    said = job.recording.corrections
    contacts = by_hand(detect_contacts(start, bone_imus, skeleton), start.times, said)
    path = root_path(start, bone_imus, contacts, skeleton, ankle_height)
    provenance = start.provenance.copy()
    provenance[:, 0] = Provenance.IMU if contacts.joints else Provenance.PRIOR  # sensors on the legs observe the path
    start = rooted(replace(start, provenance=provenance), path.p_world, skeleton)
    if points is not None:
        points, start, path, contacts = on_path(points, start, path, bone_imus, skeleton, ankle_height, said)
    ankles = start.p_world_joint[:, skeleton.index(*contacts.joints)]
    stand = contact_points(contacts, ankles, ankle_height)
    places = *bone_imus.joints, *settings.sensor_joints
    terms, observed, used = tuple[PointTerm, ...](), dict[str, PointData](), replace(solver, floor_height=None)
    if points is not None:  # they place the contacts too, and their errors last
        factor = solver.largest_correlation_factor
        terms, observed = points.terms(skeleton), points.observed(skeleton, factor)
        used = replace(used, sigma_contact=factor * solver.sigma_contact)
    solution = FragmentSolver(skeleton, settings.frames, used, places, terms=terms).solve(
        start,
        None,
        bone_imus,
        lambda done, total: job.progress("imu", done, total),
        stand,
        points is not None and settings.confidence,
        observed=observed,
    )  # the contact points contain the floor
    motion = skeleton.motion(solution.poses)
    if points is not None:
        motion = replace(motion, confidence=decorrelated(solution, path))
    stages = {"start": start, "imu": motion.poses}
    return Reconstruction(
        job.recording,
        "imu",
        motion,
        stages,
        None,
        bone_imus,
        solution,
        path.sigma,
        faults,
        (*left_out, *(_warnings(start, contacts, skeleton, ankle_height) if points is None else ())),
        checks=check_sensor_form(job.recording) if settings.checks else (),
        lifts=tuple(agreement for _, agreement in read),
        choices=Choices(settings=settings.with_fragment(solver)),
    )


def frame_times(imus: ImuSequence, rate_hz: float = RATE_HZ, stop: float | None = None) -> Array:
    """Return even frame times (T,), s, at `rate_hz` or the sensors' lower one, to `stop`, s, or their last sample."""
    first, last = imus.times[[0, -1]]
    last = last if stop is None else stop
    own = 1 / float(np.median(np.diff(imus.times))) if len(imus) > 1 else rate_hz
    rate_hz = min(rate_hz, own)
    count = int(np.floor((last - first) * rate_hz + 1e-6)) + 1
    return np.asarray(np.minimum(first + np.arange(count) / rate_hz, last))


def _warnings(start: PoseSequence, contacts: Contacts, skeleton: SkeletonModel, ankle_height: float) -> tuple[str, ...]:
    if not contacts.joints:
        return ("no sensor on a foot or shank: the root stays at its first position, whatever the person does",)
    out, rate = [], start.rate_hz
    flights = signals.runs(~contacts.standing.any(axis=1))
    longest = max((stop - start_ for start_, stop in flights), default=0) / rate
    if longest > _LONG:
        out.append(
            f"no foot contact for {longest:.1f} s at a stretch: there the root follows accelerations and "
            "the lower foot, and drifts by decimetres per second"
        )
    upright, _ = skeleton.forward_kinematics(skeleton.t_pose()[None])
    standing = upright[0, 0, 2] - upright[0, skeleton.index(*contacts.joints), 2].min()
    low = start.p_world_joint[:, 0, 2] - ankle_height < _LOW * standing
    seconds = sum(stop - start_ for start_, stop in signals.runs(low)) / rate
    if seconds > _LONG:
        out.append(
            f"for {seconds:.1f} s the pelvis is low, as in sitting, kneeling or lying: contacts are "
            "detected for feet only, so where they do not carry the weight the root may be off"
        )
    return tuple(out)
