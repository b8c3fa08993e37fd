"""Standard deviations of joint torques and of the external force, against the errors of held-out people.

``python -m benchmarks dynamics --corpus DIR`` with DIR the folder of free motion (README.md). Each motion of
the people and rigs that nothing was learned from is recorded by one of the benchmark's four cameras
(realistic 2D) with 0, 8 and 10 sensors and reconstructed. Torques, with no foot's load, and the external
wrench are computed of the reconstruction and of the truth with the same body (75 kg), so that only the
motion differs, and the errors are compared with the standard deviations of that component alone. What the
low-pass takes away of the true motion is not in the errors.

``--fit`` computes the constants `SPECTRA` of `rtof_kin.clinical.body_dynamics` from the validation people, half
of their motions also on another rig, and prints them. It minimises the logarithms of the ratios of stated
and actual root mean squares by joint and by number of sensors; those below 1 count more, of the force
most: its band is to be too wide rather than too narrow.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks import harness
from benchmarks.command_line import in_parallel, study_parser
from benchmarks.range_bands import clips
from benchmarks.rerigged import rerigged
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.body_dynamics import SPECTRA, UNKNOWN, BodyDynamics, ErrorSpectrum, error_gains, pose_errors
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.clinical.torques import joint_torques
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.data.confidence import BAND_95
from rtof_kin.formats.joint_trajectory import joint_velocities
from rtof_kin.plan.prediction import SETTINGS
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.simulation.mocap import MocapClip

SENSORS = ("0", "8", "10")
SECONDS, RATE_HZ, KG, SEED = 6.0, 60.0, 75.0, 5
EVERY = 12
"""Step between the frames that are compared; neighbours are correlated."""
WRENCH = ("force x", "force y", "force up", *["moment"] * 3)
GROUPS = {
    "Arm": "shoulder",
    "ForeArm": "elbow",
    "UpLeg": "hip",
    "Leg": "knee",
    "Foot": "ankle",
    "Spine": "spine",
    "Spine1": "spine",
    "Spine2": "spine",
    "Spine3": "spine",
    **{name: name for name in WRENCH[:3]},
}
TYPICAL_SECONDS = 0.12
"""[s] where correlation times are held near, as the data say little about them."""
ALL_FAST = 0.1
"""Weight of shares near 1, the cautious end, where the data do not tell (the foot)."""
BELOW, BELOW_FORCE = 2.0, 10.0
"""Weights of ratios below 1: of joints and the moment, and of the force."""


@dataclass(frozen=True)
class Case:
    """A motion, a camera and a set of sensors."""

    clip: MocapClip
    camera: int
    sensors: str
    fit: bool = False


@dataclass(frozen=True)
class Found:
    """Of one case, by the revolutes and the rows of the wrench (C)."""

    about: dict[str, str]
    labels: tuple[str, ...]
    error: Array
    """(n, C) N, N m."""
    sigma: Array
    """(n, C) stated for the component of the motion."""
    products: Array | None
    """(4, G, C) factors of `error_gains` by group in `SPECTRA`, sums over the frames."""


def run(case: Case) -> Found | None:
    """Errors and standard deviations of one case; None without a frame to compare."""
    logging.disable(logging.WARNING)
    sensors = harness.SENSOR_SETS.get(case.sensors, ())
    recording = harness.recorded(case.clip, case.camera, "realistic", sensors, SEED)
    result = reconstruct(recording, mode="rtof" if sensors else "rto", settings=SETTINGS, calibrate=False)
    motion = result.motion
    assert recording.truth is not None
    truth = motion.skeleton.motion(all_observed(at_times(recording.truth, motion.times)))
    found, true = joint_torques(motion, KG), joint_torques(truth, KG)
    error = np.hstack([found.torques - true.torques, found.wrench - true.wrench])
    wrench = np.diagonal(found.wrench_covariances(slice(None))[:, 0], axis1=1, axis2=2)
    sigma = np.hstack([found.sigma_parts(slice(None))[:, 0], np.sqrt(wrench)])
    known = np.isfinite(error + sigma).all(axis=1)
    known[np.arange(len(known)) % EVERY != 0] = False
    if not known.any():
        return None
    joints = [name[:-2].removeprefix("Right").removeprefix("Left") for name in found.dof_names]
    about = {"motion": case.clip.name, "subject": case.clip.subject, "sensors": case.sensors}
    products = _products(motion, known) if case.fit else None
    return Found(about, (*joints, *WRENCH), error[known], sigma[known], products)


def _products(motion: Motion, chosen: Mask) -> Array:
    """`Found.products` of the chosen frames (T,)."""
    skeleton = motion.skeleton.with_mass(KG)
    total: Array = np.zeros((4, len(SPECTRA), skeleton.nv))
    for start, stop in signals.runs(motion.poses.valid.all(axis=1) & np.isfinite(motion.q).all(axis=1)):
        frames = np.flatnonzero(chosen[start:stop])
        if len(frames):
            total += _products_of_run(skeleton, motion[start:stop], frames)
    return total


def _products_of_run(skeleton: SkeletonModel, motion: Motion, frames: Index) -> Array:
    """The same of frames of one stretch, filtered as `joint_torques` does."""
    body = BodyDynamics(skeleton)
    q = np.array(smoothed(motion.q, RATE_HZ, CUTOFF_HZ))
    q[:, 3:7] = so3.unit(q[:, 3:7])
    v = joint_velocities(skeleton, q, motion.times)
    a = np.gradient(v, motion.times, axis=0)
    assert motion.confidence is not None
    R = skeleton.forward_kinematics(q[frames])[1]
    errors = pose_errors(skeleton, q[frames], motion.confidence[frames], R)
    own = np.array([[group == name for group in errors.groups] for name in SPECTRA], dtype=float)
    total = np.zeros((4, len(SPECTRA), skeleton.nv))
    for factors, frame in zip(errors.factors, frames, strict=True):
        S = body.derivatives(q[frame], v[frame], a[frame], UNKNOWN)
        value, velocity, acceleration = (rows @ factors for rows in (S.value, S.velocity, S.acceleration))
        for i, square in enumerate((value**2, velocity**2, acceleration**2, 2 * value * acceleration)):
            total[i] += own @ square.T
    return total


def cases(corpus: Path, fit: bool) -> list[Case]:
    """What is recorded: of the test people, or of the validation people for the fit."""
    if fit:
        chosen = [clip for clip in clips(corpus, "validation") if "GLITCH" not in clip.quality]
        chosen = [harness.middle(clip, SECONDS) for clip in chosen]
        chosen += [rerigged(clip) for clip in chosen[::2]]
    else:
        chosen = [harness.middle(clip, SECONDS) for clip in harness.test_clips(corpus)]
    return [Case(clip, i % 4, sensors, fit) for i, clip in enumerate(chosen) for sensors in SENSORS]


def fitted(found: Sequence[Found]) -> dict[str, ErrorSpectrum]:
    """The constants that make stated and actual root mean squares agree."""
    labels = np.array([label.split()[0] for label in found[0].labels])
    products, actual, weights = [], [], []
    for sensors in SENSORS:
        own = [one for one in found if one.about["sensors"] == sensors]
        by_column = np.sum([one.products for one in own if one.products is not None], axis=0)
        squares = np.sum([np.sum(one.error**2, axis=0) for one in own], axis=0)
        for name in dict.fromkeys(labels):
            products.append(by_column[..., labels == name].sum(axis=-1))
            actual.append(squares[labels == name].sum())
            weights.append(BELOW_FORCE if name == "force" else BELOW)
    by_gain, total, below = np.array(products), np.array(actual), np.array(weights)

    def spectra(x: Array) -> list[ErrorSpectrum]:
        return [ErrorSpectrum(*pair) for pair in np.exp(x).reshape(-1, 2).tolist()]

    def residuals(x: Array) -> Array:
        gains = np.array([error_gains(RATE_HZ, spectrum) for spectrum in spectra(x)])
        ratio = 0.5 * np.log(np.einsum("rmg,gm->r", by_gain, gains) / total)
        typical = 0.5 * (x[1::2] - np.log(TYPICAL_SECONDS))
        return np.concatenate([np.where(ratio < 0, below, 1.0) * ratio, typical, ALL_FAST * x[0::2]])

    start = np.log([[min(s.share, 0.99), s.seconds] for s in SPECTRA.values()]).ravel()
    low, high = (np.tile(np.log(end), len(SPECTRA)).tolist() for end in ([1e-4, 0.04], [1.0, 0.4]))
    best = least_squares(residuals, start, bounds=(low, high), diff_step=[1e-3] * len(start))
    return dict(zip(SPECTRA, spectra(best.x), strict=True))


def tabulated(own: Sequence[Found]) -> list[dict[str, Any]]:
    """A row for each joint or component of the force, and set of sensors."""
    rows = []
    for name in dict.fromkeys(GROUPS.values()):
        columns = [GROUPS.get(label) == name for label in own[0].labels]
        for sensors in SENSORS:
            chosen = [one for one in own if one.about["sensors"] == sensors]
            error = np.concatenate([one.error[:, columns].ravel() for one in chosen])
            sigma = np.concatenate([one.sigma[:, columns].ravel() for one in chosen])
            stated, actual = (float(np.sqrt(np.mean(values**2))) for values in (sigma, error))
            rows.append(
                {
                    "of": name,
                    "sensors": sensors,
                    "stated": round(stated, 2),
                    "actual": round(actual, 2),
                    "ratio": round(stated / actual, 2),
                    "inside": round(float(np.mean(np.abs(error) <= BAND_95 * sigma)), 3),
                }
            )
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Stated and actual root mean squares, their ratio and the share inside the 95 % band."""
    lines = ["| of | sensors | stated | actual | ratio | inside 95 % |", "|---|---|---|---|---|---|"]
    for row in rows:
        unit = "N" if row["of"].startswith("force") else "N m"
        figures = f"{row['stated']:.1f} | {row['actual']:.1f} | {row['ratio']:.2f} | {row['inside']:.2f}"
        lines.append(f"| {row['of']} ({unit}) | {row['sensors']} | {figures} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("dynamics", __doc__)
    parser.add_argument("--fit", action="store_true", help="print the constants of the validation people")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    options = parser.parse_args(arguments)
    os.environ["OMP_NUM_THREADS"] = "1"
    chosen = cases(options.corpus, options.fit)
    found = [one for one in in_parallel(run, chosen, options.workers) if one is not None]
    rows = tabulated(found)
    if options.fit:
        for name, spectrum in fitted(found).items():
            print(f'    "{name}": ErrorSpectrum({spectrum.share:.2g}, {spectrum.seconds:.2g}),')
        print(f"With the constants as committed:\n\n{table(rows)}")
        return
    motions, people = (len({one.about[key] for one in found}) for key in ("motion", "subject"))
    words = " ".join(sys.argv[1:]).replace(str(options.corpus), "DIR")
    text = (
        f"`python -m benchmarks dynamics {words}`: {motions} motions of {people} people, "
        f"{KG:g} kg, root mean squares over frames and axes.\n\n{table(rows)}"
    )
    print(harness.write_results(options.out, {"command": words, "rows": rows}, text))


if __name__ == "__main__":
    main()
