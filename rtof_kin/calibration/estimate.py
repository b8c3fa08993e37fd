"""Self-calibration of a recording from its motion, without calibration poses.

`calibrate` estimates the unknowns of `CalibrationPriors` (listed in `calibration.unknowns`) with the
residuals of the joint-space solver: delay of the video, mounting and heading of sensors, bone lengths,
errors of the detector's landmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rtof_kin.calibration.bone_images import check_clocks
from rtof_kin.calibration.priors import EFFECTIVE_SECONDS, OVERCOUNT, CalibrationPriors
from rtof_kin.calibration.result import BONE_GROUPS, Quantity, SelfCalibration, Verdict, bone_groups
from rtof_kin.calibration.shared_fragments import Excerpt, Shared, SharedFragments, Slice
from rtof_kin.calibration.straight_legs import StraightLeg, straight_legs
from rtof_kin.calibration.unknowns import (
    Ankles,
    Bones,
    Delay,
    ImageBias,
    Places,
    Sampled,
    Unknown,
    items_of,
    open_sensors,
)
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import CalibrationError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.inertial.outlier_rejection import mask_faults
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.joint_space.observations import low_passed, sensor_data
from rtof_kin.solve.settings import JointSpaceSettings

_NARROW, _AT_ARMS = 0.5, ("ForeArm", "Hand")
"""Spread of the places at elbows and wrists, relative to those of other joints."""
_UNMOUNTED = float(np.radians(4.0))
"""[rad] Mountings that are better known than this say more of a person's knees than other people's do."""
_USUAL_HEIGHT_PX = 500.0  # [px] Height of the person that `sigma_image_bias` is for


def calibrate(
    slices: Sequence[Slice],
    priors: CalibrationPriors | None = None,
    settings: JointSpaceSettings | None = None,
    frames: int = 50,
    progress: Callable[[int, int], None] | None = None,
    without_slipped: bool = False,
) -> SelfCalibration:
    """Estimate the unknowns of a recording. `CalibrationError`: there are no IMUs, or they and the video have too
    little time in common; `SolverError`: the recording cannot be solved.

    Args:
        slices: the recording, or parts of it in the order of time; of a long one some tens of seconds, spread over
            it, are enough.
        priors: by default `CalibrationPriors.of` the recording. progress: called with (steps done, steps in all).
    """
    recording = slices[0].recording
    priors = priors or CalibrationPriors.of(recording)
    settings = settings or JointSpaceSettings(floor_height=recording.floor_height)
    fragments = shared_fragments(slices, priors, settings, frames)
    fragments.begin()
    if without_slipped and (slipped := fragments.slipped()):
        fragments = fragments_of(replace(fragments.excerpt, left_out=slipped), priors, settings)
        fragments.begin()
    shared = fragments.estimate(priors.rounds, progress)
    quantities = quantities_of(fragments.unknowns, shared.y, shared.hessian, fragments.prior)
    times = fragments.excerpt.times
    return SelfCalibration(
        quantities=tuple(_doubted(q, slices, shared) for q in quantities if q.kind != "place"),
        places=tuple(q for q in quantities if q.kind == "place"),
        middle=float(times[0] + times[-1]) / 2,
        converged=shared.converged,
    )


def shared_fragments(
    slices: Sequence[Slice], priors: CalibrationPriors, settings: JointSpaceSettings, frames: int
) -> SharedFragments:
    """Return the problem that `calibrate` solves; arguments and errors are those of `calibrate`."""
    for part in slices:
        recording = part.recording
        if recording.imus is None or recording.calibration is None or recording.keypoints is None:
            raise CalibrationError(
                f"recording {recording.name}: without calibrated IMUs and a video there is nothing to calibrate by"
            )
    _check_long_enough(slices, priors)
    return fragments_of(Excerpt.chosen(slices, frames, settings, priors.most_seconds), priors, settings)


def fragments_of(excerpt: Excerpt, priors: CalibrationPriors, settings: JointSpaceSettings) -> SharedFragments:
    """Return the fragments with the unknowns that priors leave open; without sensors only those of body and image."""
    sensors = excerpt.data[0].sensors
    slow = [
        low_passed(even_noise(mask_faults(_sensed(part.recording), excerpt.left_out)), settings)
        for part in excerpt.slices
        if sensors
    ]

    def sampled(times: Array) -> tuple[Array, Array, Array, Array]:
        found = [sensor_data(own, slow[i], sensors, settings) for i, own in excerpt.by_slice(times)]
        q, w, a, w_a, _ = (np.concatenate(values) for values in zip(*found, strict=True))
        return q, w, a, w_a

    unknowns = _unknowns(excerpt, priors, sampled)
    seconds = len(excerpt.times) / excerpt.data[0].rate_hz
    legs: tuple[StraightLeg, ...] = ()
    if priors.sigma_swing is not None and priors.sigma_swing > _UNMOUNTED:
        sensed = [(part.bone_imus, part.guess.poses) for part in excerpt.slices]
        legs = straight_legs([(imus, poses) for imus, poses in sensed if imus is not None], sensors)
    return SharedFragments(excerpt, unknowns, EFFECTIVE_SECONDS / max(seconds, EFFECTIVE_SECONDS), legs)


def _sensed(recording: Recording) -> BoneImuSequence:
    assert recording.imus is not None
    assert recording.calibration is not None
    return recording.calibration.apply(recording.imus)


def even_noise(imus: BoneImuSequence) -> BoneImuSequence:
    """Sensors with accelerations smoothed by a Gaussian of one sample.

    Interpolation reduces noise between samples only, which would favour delays of half a sample.
    """
    known = np.isfinite(imus.a_world)
    smooth = gaussian_filter1d(np.where(known, imus.a_world, 0.0), 1.0, axis=0)
    share = gaussian_filter1d(known.astype(float), 1.0, axis=0)
    a_world = np.where(known, smooth / np.where(known, share, 1.0), np.nan)
    return replace(imus, a_world=a_world)


def _check_long_enough(slices: Sequence[Slice], priors: CalibrationPriors) -> None:
    common = 0.0
    for part in slices:
        seen, imus = part.recording.video.times, part.recording.imus
        assert imus is not None
        common += max(0.0, min(seen[-1], imus.times[-1]) - max(seen[0], imus.times[0]))
    searched = 0.0 if priors.sigma_delay is None else 4 * priors.sigma_delay
    if common <= searched:
        raise CalibrationError(
            f"video and IMUs have {common:.2f} s in common, too little to look for a delay of "
            f"{searched:.2f} s; record longer, or give sigma_delay=None where the clocks agree"
        )


def _unknowns(excerpt: Excerpt, priors: CalibrationPriors, sampled: Sampled) -> list[Unknown]:
    data, skeleton = excerpt.data[0], excerpt.slices[0].recording.skeleton
    p, found = priors, list[Unknown]()
    if p.sigma_delay is not None:
        found.append(Delay(p.sigma_delay, sampled))
    found += open_sensors(p, skeleton, data.sensors)
    if p.sigma_size is not None:
        names = ("all",) if p.sigma_proportion is None else tuple(BONE_GROUPS)
        groups = bone_groups(skeleton, names)
        found.append(Bones(tuple(skeleton.parents), groups, p.sigma_size, p.sigma_proportion or 0.0, data.attached))
    if p.sigma_image_bias is not None:
        sizes = p.sigma_image_bias * _height_px(excerpt.slices) / _USUAL_HEIGHT_PX * data.points.sizes
        found.append(ImageBias(data.names, sizes))
    if data.sensors and p.sigma_swing is not None and p.sigma_place is not None and data.attached.free.any():
        joints = tuple(sorted({*data.points.anchors}))
        seen = tuple(skeleton.names[j] for j in joints)
        sigma = p.sigma_place * np.array([_NARROW if name.endswith(_AT_ARMS) else 1.0 for name in seen])
        found.append(Places(seen, tuple(map(joints.index, data.points.anchors)), sigma))
    if p.sigma_ankle_height is not None and data.rows["w_floor"].any():
        found.append(Ankles(p.sigma_ankle_height))
    if not found:
        raise CalibrationError("nothing is left open: give at least one standard deviation")
    return found


def _height_px(slices: Sequence[Slice]) -> float:
    """Median extent of the landmarks in the image, px."""
    seen = np.concatenate([k.uv_px[k.seen.sum(axis=1) > 1] for k in (s.recording.video.landmarks for s in slices)])
    if len(seen) == 0:
        raise CalibrationError("the video sees nothing of the person: there is nothing to calibrate by")
    extent = np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1)
    return float(np.median(np.linalg.norm(extent, axis=1)))


def quantities_of(
    unknowns: Sequence[Unknown],
    y: Array,
    hessian: Array,
    prior: Array,
    variance_prior: Array | None = None,
    significant: float = 0.0,
) -> tuple[Quantity, ...]:
    """Return every item with its standard deviations. Unobserved and insignificant items, except nuisances,
    are fixed at zero, and the others estimated given that.

    With prior P and information D, which autocorrelated errors make k times too large, the estimate's
    covariance is (P + D)^-1 (P + k D) (P + D)^-1 (White 1982, eq. 3.3).

    Args:
        y: (G,) the estimate. hessian: (G, G) P + D. prior: (G, G) P.
        variance_prior: (G,) that verdicts refer to; by default that of P.
    """
    P, S = prior, hessian
    inverse = np.linalg.inv(S)
    variance = np.diag(np.linalg.inv(P)) if variance_prior is None else variance_prior
    known = np.clip(1 - np.diag(inverse) / variance, 0.0, 1.0)
    claimed = np.minimum(np.diag(inverse @ (P + OVERCOUNT * (S - P)) @ inverse), variance)
    parts = items_of(unknowns)

    def listed(y: Array, variance_now: Array) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(kind, item, y[own], np.sqrt(variance_now[own]), np.sqrt(variance[own]), float(known[own].max()))
            for kind, item, own in parts
        )

    kept, observed = np.zeros(len(y), dtype=bool), np.zeros(len(y), dtype=bool)
    nuisances = {u.name for u in unknowns if u.nuisance}
    for quantity, (_, _, own) in zip(listed(y, claimed), parts, strict=True):
        size = float(np.sqrt(np.mean((quantity.value / quantity.sigma) ** 2)))
        observed[own] = quantity.verdict is not Verdict.PRIOR or quantity.kind in nuisances
        kept[own] = observed[own] & (size >= significant or quantity.kind in nuisances)
    given = np.where(kept, y, 0.0)
    if kept.any() and not kept.all():
        given[kept] += np.linalg.solve(S[np.ix_(kept, kept)], S[np.ix_(kept, ~kept)] @ y[~kept])
    return listed(given, np.where(observed, claimed, variance))


def _doubted(quantity: Quantity, slices: Sequence[Slice], shared: Shared) -> Quantity:
    """A delay in doubt, by the search or by `check_clocks` of most slices, gets its prior's standard deviation."""
    if quantity.kind != "delay" or quantity.verdict is Verdict.PRIOR:
        return quantity
    given = [(part.recording, part.guess.poses) for part in slices]
    checks = [check_clocks(own.video, _sensed(own), start, own.skeleton) for own, start in given]
    causes = [clocks.cause for clocks in checks if clocks.failed]
    apart = len(causes) > sum(clocks.passed for clocks in checks)
    doubt = causes[0] if apart else next(iter(shared.doubts.values()), "")
    return replace(quantity, sigma=quantity.sigma_prior, doubt=doubt) if doubt else quantity
