"""The results of a motion as gait laboratories know them: Plug-in Gait's angles, events, parameters, forces, moments.

Angles are recomputed in the sequences of Plug-in Gait (Vicon Nexus 2.16, lower and upper body angles as output from
Plug-in Gait), so that each component has that name's meaning and sign: flexion, adduction (of the shoulder abduction)
and internal rotation; of the ankle dorsiflexion, inversion and internal rotation, the third axis in between; of the
pelvis anterior tilt, own side up, own side forward, in the axes of world nearest to where it faces; of the spine the
thorax forward, to the own side, and turned to it. Zero is the anatomical standing posture (`decomposition`), where
Plug-in Gait has its static trial.

Moments are net internal ones about the axes of the joint's own angles, which Plug-in Gait's are not (external, in the
axes of the distal segment), so they have other names.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import SIDES, JointCoordinateSystem
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.gait_events import LONGEST_STRIDE
from rtof_kin.clinical.ground_reaction import Contact, GroundReaction
from rtof_kin.clinical.torques import JointTorques
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.formats.motion_views import AnyMotion
from rtof_kin.formats.trial_results import GaitEvent, GaitParameter, TrialResults

_ANGLES: Final = (
    ("Pelvis", "pelvis", "zxy", (0, 1, 2), (-1, -1, 1)),
    ("Spine", "spine", "zxy", (0, 1, 2), (-1, 1, -1)),
    ("Hip", "{side}_hip", "zxy", (0, 1, 2), (1, 1, 1)),
    ("Knee", "{side}_knee", "zxy", (0, 1, 2), (-1, 1, 1)),
    ("Ankle", "{side}_ankle", "zyx", (0, 2, 1), (1, 1, 1)),
    ("Shoulder", "{side}_shoulder", "zxy", (0, 1, 2), (1, -1, 1)),
    ("Elbow", "{side}_elbow", "zxy", (0, 1, 2), (1, np.nan, np.nan)),
)
"""Plug-in Gait's name, our joint, intrinsic axes in ISB frames, which of the three is each component, its sign on the
right; on the left the limbs are mirrored, and pelvis and spine have the other sign in components 2 and 3."""
_MOMENTS: Final = {"Hip": "thigh", "Knee": "shank", "Ankle": "foot"}
_PARAMETERS: Final = {
    "stride_time": ("Stride Time", "s", 1.0),
    "cadence": ("Cadence", "steps/min", 1.0),
    "stride_length": ("Stride Length", "m", 1.0),
    "speed": ("Walking Speed", "m/s", 1.0),
    "stance_share": ("Foot Off", "%", 100.0),
}


def trial_results(
    motion: AnyMotion, subject: str = "", mass_kg: float | None = None, sex: str | None = None
) -> TrialResults:
    """Return the results of a motion for its C3D file.

    Args:
        motion: read in blocks. subject: name or code, '' if unknown.
        mass_kg: body mass, kg; without it there are no forces and moments. sex: 'male', 'female' or None.
    """
    found = analyse(motion, weight_kg=mass_kg, sex=sex if mass_kg is not None else None)
    points = {"ANGLES": plug_in_gait_angles(found)}
    if found.torques is not None and found.ground_reaction is not None:
        points |= {"FORCES": _forces(found.ground_reaction), "MOMENTS": _moments(found, found.torques)}
    events = [
        GaitEvent(float(time), side, kind)
        for side, foot in found.gait.events.feet.items()
        for kind, times in (("foot_strike", foot.strikes), ("foot_off", foot.offs))
        for time in times
    ]
    height = found.paths.skeleton.height
    return TrialResults(tuple(sorted(events)), points, tuple(_parameters(found.gait)), subject, mass_kg, height)


def plug_in_gait_angles(found: MotionAnalysis) -> dict[str, Array]:
    """Return three components (T, 3), deg, of each name, e.g. 'LHipAngles'; NaN where unobserved."""
    joints = {joint.name: (joint, slice(3 * j, 3 * j + 3)) for j, joint in enumerate(found.table.joints)}
    out = {}
    for side in SIDES:
        for name, ours, sequence, order, signs in _ANGLES:
            joint, columns = joints[ours.format(side=side)]
            raw = found.angles.values[:, columns] * [angle.sign for angle in joint.angles]
            if name == "Pelvis" and np.isfinite(raw[:, 0]).any():
                quarter = np.pi / 2
                raw[:, 0] -= quarter * np.round(np.angle(np.nanmean(np.exp(1j * raw[:, 0]))) / quarter)
            mirrored = -1 if side == "left" and not joint.side else 1
            components = _in_sequence(raw, joint, sequence)[:, order] * signs * [1, mirrored, mirrored]
            out[f"{side[0].upper()}{name}Angles"] = np.degrees(components)
    return out


def _in_sequence(raw: Array, joint: JointCoordinateSystem, sequence: str) -> Array:
    """Angles (T, 3), rad, of a joint in another sequence; its first where that is all that is known and the same."""
    if joint.sequence == sequence:
        return raw
    out = np.full(raw.shape, np.nan)
    if joint.sequence[0] == sequence[0]:
        out[:, 0] = raw[:, 0]
    for start, stop in signals.runs(np.isfinite(raw).all(axis=1)):
        R = so3.euler_to_matrix(joint.sequence, raw[start:stop])
        out[start:stop] = so3.euler_continuous(so3.matrix_to_euler(sequence, R))
    return out


def _forces(found: GroundReaction) -> dict[str, Array]:
    """Force of the floor on the person, N, in world: of all contacts, and of each foot that bears all or none of it."""
    out = {"GroundReactionForce": found.force}
    for side, own, other in (("R", Contact.RIGHT, Contact.LEFT), ("L", Contact.LEFT, Contact.RIGHT)):
        state = found.state[:, None]
        zero = np.where(np.isfinite(found.force), 0.0, np.nan)
        free = (state == other) | (state == Contact.NONE)
        out[f"{side}GroundReactionForce"] = np.where(state == own, found.force, np.where(free, zero, np.nan))
    return out


def _moments(found: MotionAnalysis, torques: JointTorques) -> dict[str, Array]:
    """Net moments, N mm, positive where they turn the joint to the positive side of the three angles."""
    joints = {joint.name: joint for joint in found.paths.skeleton.table.joints}
    out = {}
    for side in SIDES:
        for name, segment in _MOMENTS.items():
            dofs = joints[found.table.segments[f"{side} {segment}"]].dofs
            signs = [-1.0 if dof.clinical.startswith("-") else 1.0 for dof in dofs]
            own = [torques.dof_names.index(dof.urdf) for dof in dofs]
            out[f"{side[0].upper()}{name}MomentISB"] = 1000.0 * torques.torques[:, own] * signs
    return out


def _parameters(gait: GaitAnalysis) -> list[GaitParameter]:
    """Means over the strides of walking, by side; none if it is no gait."""
    if not gait.is_gait:
        return []
    out = []
    for side, own in gait.summary.items():
        for measure, (name, unit, factor) in _PARAMETERS.items():
            out.append(GaitParameter(name, side, unit, factor * own[measure][0]))
        seconds, metres = _steps(gait, side)
        if len(seconds):
            out.append(GaitParameter("Step Time", side, "s", float(np.mean(seconds))))
        if np.isfinite(metres).any() and not gait.verdict.on_the_spot:
            out.append(GaitParameter("Step Length", side, "m", float(np.nanmean(metres))))
    return out


def _steps(gait: GaitAnalysis, side: str) -> tuple[Array, Array]:
    """Seconds and metres ahead (n,) from the strike of the other foot to the counted ones of a side."""
    events, feet = gait.events, gait.events.feet
    others = [foot for other, foot in feet.items() if other != side and len(foot.strikes)]
    strikes = np.array([stride.start for stride in gait.counted if stride.side == side])
    if not others or not len(strikes):
        return np.zeros(0), np.zeros(0)
    before = others[0].strikes[np.maximum(np.searchsorted(others[0].strikes, strikes) - 1, 0)]
    follows = (before < strikes) & (strikes - before < LONGEST_STRIDE)
    strikes, before = strikes[follows], before[follows]
    heel, forward = (signals.interpolate(events.times, path, strikes) for path in (feet[side].heel, events.forward))
    other = signals.interpolate(events.times, others[0].heel, before)
    return strikes - before, np.sum((heel - other) * forward, axis=1)
