"""The results of a motion as gait laboratories know them: Plug-in Gait's angles, events, parameters, forces, moments.

Angles are recomputed in the sequences of Plug-in Gait (Vicon Nexus 2.16, angles as output from Plug-in Gait), so that a
component has that name's meaning and sign; zero is the anatomical standing posture (`decomposition`). Moments are net
internal ones about the axes of the joint's own angles; Plug-in Gait's are external, so these have other names.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.ground_reaction import Contact, GroundReaction
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.environment import return_free_memory
from rtof_kin.formats.motion_views import AnyMotion
from rtof_kin.formats.trial_results import TrialResults

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
_Points = dict[str, NDArray[np.float32]]  # in the 32 bits of the file
_MEANS: Final = {
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
    forces = dict[str, _Points]()
    if found.ground_reaction is not None:
        forces = {"FORCES": _forces(found.ground_reaction), "MOMENTS": _moments(found)}
        found = replace(found, torques=None, ground_reaction=None)  # large, of an hour
        return_free_memory()
    points = {"ANGLES": plug_in_gait_angles(found)} | forces
    events = sorted(
        (float(time), side, kind)
        for side, foot in found.gait.events.feet.items()
        for kind, times in (("foot_strike", foot.strikes), ("foot_off", foot.offs))
        for time in times
    )
    walked = tuple(means(found.gait)) if found.gait.is_gait else ()
    return TrialResults(tuple(events), points, walked, subject, mass_kg, found.paths.skeleton.height)


def plug_in_gait_angles(found: MotionAnalysis) -> _Points:
    """Return three components (T, 3), deg, of each name, e.g. 'LHipAngles'; NaN where unobserved."""
    joints, out = {joint.name: (j, joint) for j, joint in enumerate(found.table.joints)}, {}
    for side in SIDES:
        for name, ours, sequence, order, signs in _ANGLES:
            j, joint = joints[ours.format(side=side)]
            raw = found.angles.values[:, 3 * j : 3 * j + 3] * [angle.sign for angle in joint.angles]
            if name == "Pelvis" and np.isfinite(raw[:, 0]).any():  # from the axis of world that it faces most
                raw[:, 0] -= np.pi / 2 * np.round(np.angle(np.nanmean(np.exp(1j * raw[:, 0]))) / (np.pi / 2))
            if joint.sequence != sequence:
                known = np.isfinite(raw).all(axis=1)
                raw[~known, int(joint.sequence[0] == sequence[0]) :] = np.nan  # an equal first angle stays
                for start, stop in signals.runs(known):
                    R = so3.euler_to_matrix(joint.sequence, raw[start:stop])
                    raw[start:stop] = so3.euler_continuous(so3.matrix_to_euler(sequence, R))
            mirrored = -1 if side == "left" and not joint.side else 1
            raw = raw[:, order] * signs * [1, mirrored, mirrored]
            out[f"{side[0].upper()}{name}Angles"] = np.degrees(raw).astype(np.float32)
    return out


def _forces(found: GroundReaction) -> _Points:
    """Force of the floor on the person, N, in world: of all contacts, and of each foot that bears all or none of it."""
    out = {"GroundReactionForce": found.force.astype(np.float32)}
    for name, own, other in (("R", Contact.RIGHT, Contact.LEFT), ("L", Contact.LEFT, Contact.RIGHT)):
        share = np.select([found.state == own, np.isin(found.state, (other, Contact.NONE))], [1.0, 0.0], np.nan)
        out[f"{name}GroundReactionForce"] = (found.force * share[:, None]).astype(np.float32)
    return out


def _moments(found: MotionAnalysis) -> _Points:
    """Net moments, N mm, positive where they turn the joint to the positive side of the three angles."""
    torques, joints, out = found.torques, {one.name: one for one in found.paths.skeleton.table.joints}, {}
    assert torques is not None  # there is a body mass
    for side in SIDES:
        for name, segment in (("Hip", "thigh"), ("Knee", "shank"), ("Ankle", "foot")):
            dofs = joints[found.table.segments[f"{side} {segment}"]].dofs
            signs = [-1000.0 if dof.clinical.startswith("-") else 1000.0 for dof in dofs]
            own = torques.torques[:, [torques.dof_names.index(dof.urdf) for dof in dofs]]
            out[f"{side[0].upper()}{name}MomentISB"] = (own * signs).astype(np.float32)
    return out


def means(gait: GaitAnalysis) -> list[tuple[str, str, str, float]]:
    """Means over the strides of walking, by side; steps are from strike to strike, of the other foot and this one."""
    out, feet, times = [], gait.events.feet, gait.events.times
    for side, own in gait.summary.items():
        out += [(name, side, unit, factor * own[measure][0]) for measure, (name, unit, factor) in _MEANS.items()]
        strikes = np.array([stride.start for stride in gait.counted if stride.side == side])
        for foot in (foot for other, foot in feet.items() if other != side and len(foot.strikes)):
            before = foot.strikes[np.maximum(np.searchsorted(foot.strikes, strikes) - 1, 0)]
            ahead = signals.interpolate(times, feet[side].heel, strikes) - signals.interpolate(times, foot.heel, before)
            steps = np.sum(ahead * signals.interpolate(times, gait.events.forward, strikes), axis=1)
            follows = np.isfinite(steps) & (before < strikes) & (strikes - before < own["stride_time"][0])
            if follows.any():
                out.append(("Step Time", side, "s", float(np.mean((strikes - before)[follows]))))
                if not gait.verdict.on_the_spot:
                    out.append(("Step Length", side, "m", float(np.mean(steps[follows]))))
    return out
