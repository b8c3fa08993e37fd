"""Walking is recognised among planted and real motions, and what is none has a sentence that says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clinical_support import squatting, walk, walking

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.clinical.gait import GaitAnalysis, StrideShape, analyse_gait, departures, stride_shape
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.paths import body_paths
from rtof_kin.data.poses import Provenance

BODY = SkeletonModel.default()
WALKING = StrideShape(0.64, 0.5, swing=0.8, progress=1.3, forward=1.0, turn=0.0, slip=0.01)
SPOT = replace(WALKING, progress=0.02, forward=0.0, slip=0.45)


def analysed(motion: Motion) -> GaitAnalysis:
    return analyse_gait(gait_events(body_paths(motion.poses, motion.skeleton)))


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
def test_planted_walking_is_gait(heading: float) -> None:
    gait = analysed(walking(heading=heading))
    assert (gait.is_gait, gait.why_not) == (True, "")
    assert gait.verdict.walking == gait.strides
    assert not gait.verdict.on_the_spot


def test_shape_of_a_planted_stride() -> None:
    gait = analysed(walking(speed=1.1, stride_time=1.2, late=0.4))
    right = next(stride for stride in gait.strides if stride.side == "right")
    shape = stride_shape(right, gait.events)
    assert shape.progress == pytest.approx(1.32, abs=0.01)
    assert shape.phase == pytest.approx(0.4, abs=0.01)
    assert shape.forward == pytest.approx(1)
    assert abs(shape.turn) < 1e-6
    assert shape.slip < 0.03
    assert gait.is_gait  # a limp is gait too


def test_real_walking_is_gait_and_without_feet_too() -> None:
    motion = walk()
    assert analysed(motion).is_gait
    observed = np.ones(len(motion.skeleton.names), dtype=bool)
    observed[motion.skeleton.index("RightFoot", "LeftFoot")] = False
    assert analysed(replace(motion, poses=replace(motion.poses, orientation_observed=observed))).is_gait


def test_treadmill_walking_is_gait_on_the_spot() -> None:
    verdict = analysed(walking(treadmill=True)).verdict
    assert verdict.is_gait
    assert verdict.on_the_spot


def standing_first(motion: Motion, seconds: float) -> Motion:
    """A motion whose first frame is held before it."""
    poses, held = motion.poses, round(60 * seconds)
    p, R = (np.concatenate([np.repeat(x[:1], held, axis=0), x]) for x in (poses.p_world_joint, poses.R_world_bone))
    longer = replace(
        poses,
        times=np.arange(len(p)) / 60,
        p_world_joint=p,
        R_world_bone=R,
        provenance=None,
        valid=None,
        orientation_observed=None,
        direction_observed=None,
        sigma_rad=None,
    )
    return BODY.motion(all_observed(longer))


@pytest.mark.parametrize(("seconds", "strides"), [(1.8, 1), (2.4, 2)])
def test_a_short_walk_is_gait_from_one_stride_on_and_says_on_what(seconds: float, strides: int) -> None:
    gait = analysed(walking(seconds))
    assert gait.is_gait
    assert len(gait.verdict.walking) == strides
    assert gait.rests_on.startswith(f"{strides} stride")
    assert gait.notes[0] == f"all measures rest on {gait.rests_on}: they may not represent usual walking"
    assert gait.verdict.too_few.startswith(f"Only {strides} complete stride")  # for gait scores and visits
    (side,) = list(gait.summary)[:1]
    assert gait.summary[side]["stride_length"][0] == pytest.approx(1.32, abs=0.05)


@pytest.mark.parametrize(
    ("motion", "why"),
    [
        (lambda: walking(12, jitter=0.15), "The strides are not steady: their times vary by"),
        (lambda: walking(2.4, treadmill=True), "Only 2 complete strides of walking: at least 3"),
        (lambda: standing_first(walking(2.4), 3.0), "Only 2 complete strides of walking: at least 3"),
        (lambda: walking(speed=-1.0), "none of 7 stride-like movements has the shape of walking"),
        (squatting, "No complete stride was found"),
        (lambda: planted.standing(BODY, 120), "No complete stride was found"),
    ],
)
def test_other_motions_have_a_reason(motion: object, why: str) -> None:
    gait = analysed(motion())  # type: ignore[operator]
    assert not gait.is_gait
    assert why in gait.why_not
    assert gait.why_not.count(".") - gait.why_not.count("0.") == 1  # one sentence


@pytest.mark.parametrize(
    ("shape", "phrase"),
    [
        (replace(WALKING, stance_share=0.4), "running and jumping"),
        (replace(WALKING, stance_share=0.9), "more than 82 %"),
        (replace(WALKING, phase=0.2), "alternate evenly"),
        (replace(WALKING, swing=0.1), "swings less than 0.20 m"),
        (replace(WALKING, progress=0.25), "0.2 to 0.3 m"),
        (replace(WALKING, forward=-1.0), "backward or sideways"),
        (replace(WALKING, turn=-2.0), "turns by more than 70 deg"),
        (replace(WALKING, slip=0.3), "slides or hops"),
        (replace(SPOT, swing=0.3, slip=0.15), "swings less than 0.35 m"),
        (replace(SPOT, slip=0.1), "glide back as on a treadmill"),
        (replace(SPOT, slip=0.9), "glide back as on a treadmill"),
        (replace(SPOT, phase=0.4), "alternate evenly"),
        (replace(WALKING, swing=np.nan), "swings less"),
        (replace(WALKING, turn=np.nan), "turns by more"),
    ],
)
def test_each_departure_from_walking_is_named(shape: StrideShape, phrase: str) -> None:
    (text,) = departures(shape)
    assert phrase in text


def test_walking_of_every_kind_has_no_departure() -> None:
    assert departures(WALKING) == departures(SPOT) == ()
    assert departures(replace(WALKING, phase=np.nan)) == ()  # one foot was never observed


def test_a_walk_among_other_movements_is_judged_by_its_share_of_strides() -> None:
    gait = analysed(walking(6.0))
    turned = walking(6.0, speed=-1.0)
    walk_poses, back = walking(6.0).poses, turned.poses
    p = np.concatenate([walk_poses.p_world_joint, back.p_world_joint + np.array([6.6, 0, 0])])
    R = np.concatenate([walk_poses.R_world_bone, back.R_world_bone])
    both = replace(
        walk_poses,
        times=np.arange(len(p)) / 60,
        p_world_joint=p,
        R_world_bone=R,
        provenance=None,
        valid=None,
        orientation_observed=None,
        direction_observed=None,
        sigma_rad=None,
    )
    mixed = analyse_gait(gait_events(body_paths(all_observed(both), BODY)))
    assert len(mixed.verdict.walking) >= len(gait.strides) - 1
    assert not mixed.is_gait
    assert "backward or sideways" in mixed.why_not or "stance takes less" in mixed.why_not


def test_unobserved_feet_and_low_rates_are_named() -> None:
    motion = walking()
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[:, BODY.index("RightFoot", "LeftFoot")] = Provenance.PRIOR
    unseen = analyse_gait(gait_events(body_paths(replace(motion.poses, provenance=provenance), BODY)))
    assert unseen.why_not.startswith("Walking cannot be recognised: right foot: never observed")
    slow = analyse_gait(gait_events(body_paths(motion.poses[::15], BODY)))
    assert slow.why_not.startswith("Walking cannot be recognised: 4 Hz is too low a rate")
