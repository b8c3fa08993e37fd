"""The online estimator: accuracy beside reconstruction, late and lost samples, cameras that come and go."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from live_support import demo, frame_samples, imu_samples
from numpy.typing import NDArray

from lifting.predict import Lifter
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.data.poses import Provenance
from rtof_kin.live.estimator import OnlineEstimator
from rtof_kin.live.online_settings import OnlineSettings
from rtof_kin.live.samples import FrameSample, ImuSample, OnlineEstimate, Sample
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
SECONDS = 2.0
LAGGED = OnlineSettings(lag_s=0.25)


def estimator(settings: OnlineSettings = LAGGED, setup: Recording | None = None) -> OnlineEstimator:
    setup = setup or demo()
    return OnlineEstimator(setup, setup.video.names, settings)


def arrivals(seconds: float = SECONDS) -> list[tuple[float, Sample]]:
    """Samples with the times at which they arrive: when they are taken."""
    samples = [*imu_samples(seconds), *frame_samples(seconds)]
    return sorted(((sample.time, sample) for sample in samples), key=lambda pair: pair[0])


def played(
    own: OnlineEstimator, arriving: Iterable[tuple[float, Sample]], rate_hz: float = 60.0
) -> list[OnlineEstimate]:
    """Estimates of samples that arrive at times, s, looked for at a rate."""
    found, due = list[OnlineEstimate](), -np.inf
    for arrival, sample in sorted(arriving, key=lambda pair: pair[0]):
        if arrival >= due + 1 / rate_hz - 1e-9:
            found += own.advance()
            due = arrival
        own.push(sample)
    return found + own.advance() + own.finish()


def errors_mm(found: Sequence[OnlineEstimate], relative: bool = True) -> Array:
    """(T,) mean distance of the joints from the truth, about the root or in world."""
    truth = demo().truth
    assert truth is not None
    times = np.array([estimate.poses.times[0] for estimate in found])
    frames = np.clip(np.searchsorted(truth.times, times - 1e-6), 0, len(truth) - 1)
    p = np.concatenate([estimate.poses.p_world_joint for estimate in found])
    q = truth.p_world_joint[frames]
    if relative:
        p, q = p - p[:, :1], q - q[:, :1]
    return np.asarray(1000 * np.linalg.norm(p - q, axis=-1).mean(axis=1))


@cache
def usual() -> tuple[OnlineEstimate, ...]:
    """Estimates of the demo at the usual lag, everything in time."""
    return tuple(played(estimator(), arrivals()))


@cache
def batch_mm() -> float:
    recording = replace(demo(), keypoints=demo().video[: round(SECONDS * 60)])
    truth = recording.truth
    assert truth is not None
    motion = reconstruct(recording, lifter=Lifter.load("live")).motion
    p, q = motion.poses.p_world_joint, truth.p_world_joint[: round(SECONDS * 60)]
    return float(1000 * np.linalg.norm((p - p[:, :1]) - (q - q[:, :1]), axis=-1).mean())


def test_a_quarter_of_a_second_late_it_is_nearly_as_accurate_as_reconstruction() -> None:
    assert errors_mm(usual()).mean() < 1.25 * batch_mm()


def test_at_once_it_is_a_little_less_accurate() -> None:
    at_once = errors_mm(played(estimator(OnlineSettings()), arrivals())).mean()
    assert errors_mm(usual()).mean() < at_once < 1.5 * batch_mm()


def test_there_is_one_estimate_for_every_frame_at_the_lag() -> None:
    times = np.array([estimate.poses.times[0] for estimate in usual()])
    np.testing.assert_allclose(np.diff(times), 1 / 60, atol=1e-9)
    assert len(times) == len(frame_samples(SECONDS))
    lags = np.array([estimate.lag_s for estimate in usual()[20:-20]])
    assert np.median(lags) == pytest.approx(0.25, abs=0.02)


def test_provenance_is_that_of_camera_and_sensors() -> None:
    poses = usual()[60].poses
    by_name = dict(zip(poses.names, poses.provenance[0], strict=True))
    assert by_name["LeftForeArm"] == Provenance.CAMERA_AND_IMU
    assert by_name["Hips"] == Provenance.CAMERA
    assert poses.valid.all()
    observed = dict(zip(poses.names, poses.orientation_observed[0], strict=True))
    assert observed["LeftUpLeg"]


def test_jitter_and_loss_cost_little() -> None:
    rng = np.random.default_rng(0)
    jittered = [(t + rng.uniform(0, 0.05), sample) for t, sample in arrivals() if t < 0.2 or rng.random() > 0.1]
    assert errors_mm(played(estimator(), jittered)).mean() < 1.1 * errors_mm(usual()).mean()


def test_a_late_video_is_bridged_by_the_sensors() -> None:
    late = [(t + 0.1 * isinstance(sample, FrameSample), sample) for t, sample in arrivals()]
    found = played(estimator(OnlineSettings(video_latency_s=0.1)), late)
    ages = [estimate.lag_s for estimate in found[10:-10]]
    assert np.median(ages) < 0.02
    assert errors_mm(found)[10:].mean() < 2.0 * batch_mm()


def test_samples_that_are_too_late_are_counted() -> None:
    own = estimator()
    late = [(t + 2.0 * (isinstance(s, FrameSample) and 0.5 < t < 0.7), s) for t, s in arrivals(1.2)]
    played(own, late)
    expected = sum(isinstance(s, FrameSample) and 0.5 < t < 0.7 for t, s in arrivals(1.2))
    assert own.dropped["video"] == expected


def test_without_images_the_pose_goes_on_and_the_root_stays_near() -> None:
    shown = [(t, s) for t, s in arrivals() if isinstance(s, ImuSample) or not 0.7 < t < 1.5]
    found = played(estimator(), shown)
    times = np.array([estimate.poses.times[0] for estimate in found])
    assert len(found) == len(usual())
    blind = (times > 1.0) & (times < 1.5)
    dark = found[int(np.flatnonzero(blind)[10])].poses
    by_name = dict(zip(dark.names, dark.provenance[0], strict=True))
    assert by_name["LeftForeArm"] == Provenance.IMU
    assert by_name["Hips"] == Provenance.BRIDGED
    assert errors_mm(found)[blind].mean() < 4 * batch_mm()
    assert errors_mm(found, relative=False)[blind].max() < 600
    assert errors_mm(found)[times > 1.7].mean() < 1.5 * errors_mm(usual())[times > 1.7].mean()


def test_a_sensor_that_dies_and_comes_back_is_bridged_by_the_camera() -> None:
    died = demo().imus
    assert died is not None
    dead = [(t, s) for t, s in arrivals() if getattr(s, "sensor", "") != died.names[0] or not 0.7 < t < 1.4]
    found = played(estimator(), dead)
    assert errors_mm(found).mean() < 1.4 * errors_mm(usual()).mean()


def test_sensors_alone_begin_on_the_floor() -> None:
    own = OnlineEstimator(demo(), (), OnlineSettings(lag_s=0.1))
    found = played(own, [(s.time, s) for s in imu_samples(2.0)])
    lowest = np.array([estimate.poses.p_world_joint[0, :, 2].min() for estimate in found])
    assert len(found) > 100
    assert np.abs(lowest).max() < 0.3
    poses = found[60].poses
    assert poses.valid[0, 0]
    np.testing.assert_array_equal(poses.valid[0, 1:], poses.provenance[0, 1:] >= Provenance.IMU)
    assert errors_mm(found)[30:].mean() < 120


def test_the_camera_alone_is_enough() -> None:
    found = played(
        estimator(setup=replace(demo(), imus=None, calibration=None)), [(s.time, s) for s in frame_samples(1.2)]
    )
    assert errors_mm(found)[20:].mean() < 120


def test_a_root_that_was_lost_is_found_by_the_image() -> None:
    own, found = estimator(OnlineSettings()), list[OnlineEstimate]()
    for t, sample in arrivals(1.8):
        if t >= 1.0 > own._newest:
            own._window.translate(np.array([30.0, -400.0, 5.0]))
        own.push(sample)
        found += own.advance()
    times = np.array([estimate.poses.times[0] for estimate in found])
    off = errors_mm(found, relative=False)
    assert off[(times > 1.0) & (times < 1.05)].max() > 1e4
    assert off[times > 1.5].max() < 3 * off[times < 0.9].max()


def test_covariances_are_given_on_request() -> None:
    own = estimator(OnlineSettings(confidence=True))
    found = played(own, arrivals(1.0))
    confidence = found[-1].confidence
    assert confidence is not None
    sigma = np.sqrt(np.trace(confidence.relative_covariance[0], axis1=1, axis2=2))
    assert ((sigma[1:] > 0.002) & (sigma[1:] < 0.5)).all()


def test_a_hurry_solves_fewer_frames_and_stays_on_the_body() -> None:
    own, found = estimator(), list[OnlineEstimate]()
    for k, (_, sample) in enumerate(arrivals()):
        own.push(sample)
        if k % 150 == 149:
            found += own.advance(hurry=True)
    found += own.finish()
    assert own.hurried > 30
    assert errors_mm(found).mean() < 1.5 * errors_mm(usual()).mean()


def test_a_wrong_heading_is_found_while_the_person_moves() -> None:
    setup = demo()
    calibration = setup.calibration
    assert calibration is not None
    s, wrong = calibration.joints.index("LeftLeg"), np.radians(20.0)
    R = calibration.R_world_inertial.copy()
    R[s] = so3.about_axis("z", wrong) @ R[s]
    setup = replace(setup, calibration=replace(calibration, R_world_inertial=R))
    priors = CalibrationPriors(
        sigma_delay=None,
        sigma_heading=np.radians(8.0),
        sigma_swing=None,
        sigma_image_bias=None,
        sigma_ankle_height=None,
    )
    own = estimator(replace(LAGGED, refined=priors), setup)
    played(own, arrivals(4.0))
    found = own.calibration
    assert found is not None
    heading = {q.item: float(q.value[0]) for q in found.quantities}["LeftLeg"]
    assert heading == pytest.approx(-wrong, abs=np.radians(9.0))


@pytest.mark.parametrize(("settings", "name"), [({"lag_s": 1.5}, "lag_s"), ({"rate_hz": 0.0}, "rate_hz")])
def test_settings_that_cannot_be_are_refused(settings: dict[str, float], name: str) -> None:
    with pytest.raises(InvalidInputError, match=name):
        OnlineSettings(**settings)  # type: ignore[arg-type]


def test_a_clock_that_leaps_costs_no_time_and_no_sense() -> None:
    own, shift = estimator(), 5000.0
    leaping = [(t + shift * (t > 1.0), replace(s, time=s.time + shift * (s.time > 1.0))) for t, s in arrivals(1.5)]
    found = played(own, leaping)
    times = np.array([estimate.poses.times[0] for estimate in found])
    assert len(found) < 200
    assert times[-1] > shift
    assert (np.diff(times) > 0).all()
    assert all(np.isfinite(estimate.poses.p_world_joint).all() for estimate in found)


def test_samples_and_setups_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="time"):
        estimator().push(ImuSample("L_LowArm", np.nan, np.eye(3), np.zeros(3)))
    with pytest.raises(ShapeError):
        estimator().push(FrameSample(0.0, np.zeros((3, 2)), np.ones(3)))
    with pytest.raises(InvalidInputError, match="setup"):
        OnlineEstimator(replace(demo(), imus=None, calibration=None))
