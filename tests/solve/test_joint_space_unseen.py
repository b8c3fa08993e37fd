"""Covariance of joints that nobody sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.covariance import unseen_covariance, unseen_times
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings

BODY = SkeletonModel.default()
T, HIDDEN = 150, slice(30, 120)
POSES = planted.human(BODY, T).poses
LEG = ("LeftLeg", "LeftFoot")


def data(keypoints: KeypointSequence, *sensors: str) -> Observations:
    imus = planted.bone_imus(BODY, POSES, sensors) if sensors else None
    return Observations(
        BODY, 8, JointSpaceSettings(refit_root=False), InitialGuess(POSES, np.zeros(T)), keypoints, imus
    )


def hidden() -> KeypointSequence:
    return planted.unseen(planted.keypoints(POSES), HIDDEN, BODY.index(*LEG))


def sigmas(observations: Observations, joint: str) -> NDArray[np.float64]:
    """(T,) rad, root mean square of the axes."""
    space = observations.space
    covariance = unseen_covariance(observations, unseen_times(observations))
    variances = np.diagonal(covariance, axis1=1, axis2=2)[:, space.columns(BODY.index(joint)[0])]
    return np.asarray(np.sqrt(variances.mean(axis=1)))


def test_unseen_thigh_and_knee_return_to_the_spread_of_the_prior() -> None:
    for joint in ("LeftLeg", "LeftUpLeg"):
        found = sigmas(data(hidden()), joint)
        assert not found[: HIDDEN.start].any()
        assert not found[HIDDEN.stop :].any()
        middle = found[(HIDDEN.start + HIDDEN.stop) // 2]
        assert np.degrees(middle) > 15
        assert found[HIDDEN.start] < 0.1 * middle  # next to an observation
    assert not sigmas(data(hidden()), "RightLeg").any()


def test_a_sensor_sees_what_turns_its_segment() -> None:
    observations = data(hidden(), "LeftUpLeg", "LeftLeg")
    assert not sigmas(observations, "LeftUpLeg").any()
    assert not sigmas(observations, "LeftLeg").any()
    assert sigmas(data(hidden(), "LeftUpLeg"), "LeftLeg").max() > 0.2


def test_everything_seen_has_no_spread() -> None:
    seen = data(planted.keypoints(POSES))
    assert not unseen_covariance(seen, unseen_times(seen)).any()


def test_what_is_never_seen_has_the_whole_spread() -> None:
    never = replace(hidden(), times=POSES.times)
    never = planted.unseen(never, slice(None), BODY.index(*LEG))
    assert np.ptp(sigmas(data(never), "LeftLeg")) < 1e-9
