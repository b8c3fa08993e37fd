"""How far a solution is from its start: sizes, directions, neighbours in time, and what is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import WORLD
from rtof_kin.solve.uncertainty import WINDOW, disagreement

BODY = SkeletonModel.default()
SOLVED = planted.moving(BODY, 60, 2).poses
PAIRS = ((WORLD, "Hips"), ("Hips", "LeftUpLeg"), (WORLD, "LeftUpLeg"))
(THIGH,) = BODY.index("LeftUpLeg")


def test_it_has_the_size_and_the_direction_of_the_difference() -> None:
    shift, turn = np.array([0.03, 0.0, -0.04]), np.array([0.0, 0.2, 0.0])
    p, R = SOLVED.p_world_joint + shift, np.array(SOLVED.R_world_bone)
    R[:, THIGH] = R[:, THIGH] @ so3.exp(-turn)
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p, R_world_bone=R), PAIRS)
    np.testing.assert_allclose(found.position[10, THIGH], np.outer(shift, shift), atol=1e-12)
    assert np.abs(found.relative).max() < 1e-12  # the root is off as far
    np.testing.assert_allclose(found.turn[10, 1], np.outer(turn, turn), atol=1e-12)
    np.testing.assert_allclose(found.turn[10, 2], found.turn[10, 1], atol=1e-12)
    assert np.abs(found.turn[:, 0]).max() < 1e-12


def test_neighbours_in_time_count_alike_and_the_ends_have_fewer() -> None:
    p = np.array(SOLVED.p_world_joint)
    p[30, THIGH, 2] += 0.1
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p), PAIRS).relative[:, THIGH, 2, 2]
    reach = round(WINDOW * SOLVED.rate_hz)
    assert found[30 - reach] == found[30 + reach] == pytest.approx(0.01 / (2 * reach + 1))
    assert found[29 - reach] == pytest.approx(0.0, abs=1e-15)
    p[:, THIGH] = SOLVED.p_world_joint[:, THIGH]
    p[0, THIGH, 2] += 0.1
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p), PAIRS).relative[:, THIGH, 2, 2]
    assert found[0] == pytest.approx(0.01 / (reach + 1))


def test_what_is_not_known_is_not_apart() -> None:
    p, R = np.array(SOLVED.p_world_joint), np.array(SOLVED.R_world_bone)
    p[:20], R[:20] = np.nan, np.nan
    found = disagreement(SOLVED, replace(SOLVED, p_world_joint=p, R_world_bone=R), PAIRS)
    for part in (found.position, found.relative, found.turn):
        assert np.isfinite(part).all()
        assert np.abs(part).max() < 1e-12
