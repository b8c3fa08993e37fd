"""Inflation of covariances by class of observation; its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.solve.joint_space.covariance import segment_pairs
from rtof_kin.solve.uncertainty import (
    OTHER,
    SEEN,
    USUAL_TORSO_SIGMA,
    CovarianceInflation,
    Disagreement,
    ResidualStatistics,
    Widening,
    seen_by,
    unsided,
)

BODY = SkeletonModel.default()
PAIRS = ((WORLD, "Hips"), ("Hips", "LeftUpLeg"))


def confidence(size: float = 1.0) -> Confidence:
    unit = np.tile(size * np.eye(3), (2, 3, 1, 1))
    names = ("Hips", "LeftUpLeg", "RightUpLeg")
    return Confidence(np.arange(2.0), names, unit, unit, PAIRS, unit[:, :2])


def inflation(**others: dict[str, Widening]) -> CovarianceInflation:
    """Factors 1, 2 and 3 by who saw it, and no floor; `others` are of turns, by who saw them."""
    return CovarianceInflation(
        {
            who: {kind: {OTHER: Widening(i, 0.0), **(others.get(who, {}) if kind == "turn" else {})} for kind in kinds}
            for i, (who, kinds) in enumerate(SEEN.items(), start=1)
        }
    )


def test_a_covariance_is_scaled_on_both_sides_and_gets_a_floor() -> None:
    root = np.random.default_rng(0).normal(size=(2, 2, 3, 3))
    covariance = root @ np.swapaxes(root, -1, -2)
    wide = Widening([1.0, 2.0, 4.0], [0.1, 0.2, 0.3])
    found = inflation(camera={"world Hips": wide}).apply(
        replace(confidence(), turn_covariance=covariance), ResidualStatistics()
    )
    K = np.diag([1.0, 2.0, 4.0])
    expected = K @ covariance[:, 0] @ K + np.diag([0.01, 0.04, 0.09])
    np.testing.assert_allclose(found.turn_covariance[:, 0], expected)
    np.testing.assert_allclose(found.turn_covariance[:, 1], covariance[:, 1])


@pytest.mark.parametrize(
    "sensors, position, relative, turns",
    [
        ((), 1, 1, [1, 1]),
        (("LeftLeg",), 1, 2, [2, 2]),
        (("LeftUpLeg", "RightLeg"), 1, 2, [2, 2]),
        (("LeftUpLeg", "LeftLeg"), 2, 2, [2, 2]),
        (("Hips",), 1, 3, [3, 2]),
        (("Hips", "LeftUpLeg", "LeftLeg"), 2, 3, [3, 3]),
    ],
)
def test_sensor_class(sensors: tuple[str, ...], position: float, relative: float, turns: list[float]) -> None:
    found = inflation().apply(confidence(), ResidualStatistics(sensors))
    np.testing.assert_allclose(found.position_sigma, position)
    np.testing.assert_allclose(found.relative_sigma[:, 1:], relative)
    np.testing.assert_allclose(found.turn_covariance[0, :, 0, 0], np.square(turns))
    np.testing.assert_array_equal(found.relative_sigma[:, 0], 0.0)


def test_share_of_the_disagreement_is_added() -> None:
    given = inflation()
    found = CovarianceInflation(given.widenings, {"fused": {"relative": 0.5, "turn": 0.25}})
    off = np.zeros((2, 3, 3, 3))
    off[1, 1, 0, 0] = 4.0
    apart = Disagreement(off, off, off[:, :2])
    statistics = ResidualStatistics(("LeftLeg",))
    plain, wide = (found.apply(confidence(), statistics, of) for of in (None, apart))
    np.testing.assert_allclose(wide.relative_covariance - plain.relative_covariance, 0.25 * off)
    np.testing.assert_allclose(wide.turn_covariance - plain.turn_covariance, off[:, :2] / 16)
    np.testing.assert_array_equal(wide.position_covariance, plain.position_covariance)  # no share


def test_positions_in_world_err_in_proportion_to_the_distance_along_the_line_of_sight() -> None:
    given, statistics = inflation(), ResidualStatistics(autocorrelation=0.5)
    found = CovarianceInflation(given.widenings, depths={"camera": 0.2})
    away = np.random.default_rng(0).normal(size=(2, 3, 3))
    plain, wide = (found.apply(confidence(), statistics, None, p) for p in (None, away))
    more = wide.position_covariance - plain.position_covariance
    distance = np.linalg.norm(away, axis=-1)
    np.testing.assert_allclose(np.sqrt(np.trace(more, axis1=2, axis2=3)), 0.1 * distance)
    along = np.einsum("tji,tjik,tjk->tj", away, more, away) / distance**2
    np.testing.assert_allclose(np.sqrt(along), 0.1 * distance)
    np.testing.assert_array_equal(wide.relative_covariance, plain.relative_covariance)


def test_white_residuals_have_the_least_inflation() -> None:
    wide = {"world Hips": Widening(3.0, 0.5), "Hips UpLeg": Widening(1.1, 0.5)}
    white = inflation(camera=wide).apply(confidence(), ResidualStatistics(autocorrelation=0.0))
    np.testing.assert_allclose(white.turn_covariance[0, :, 0, 0], np.square([1.2, 1.1]))
    half = inflation(camera=wide).apply(confidence(), ResidualStatistics(autocorrelation=0.5))
    np.testing.assert_allclose(half.turn_covariance[0, 0, 0, 0], 2.1**2 + 0.25**2)


def test_uncertain_lifter_raises_floors_without_sensors() -> None:
    wide = {"world Hips": Widening(2.0, 0.5)}
    unsure = ResidualStatistics(torso_sigma=2 * USUAL_TORSO_SIGMA)
    found = inflation(camera=wide, sensed=wide)
    free = found.apply(confidence(), unsure)
    sensed = found.apply(confidence(), replace(unsure, sensors=("Hips",)))
    assert free.turn_covariance[0, 0, 0, 0] == pytest.approx(2.0**2 + 1.0)
    assert sensed.turn_covariance[0, 0, 0, 0] == pytest.approx(2.0**2 + 0.25)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"autocorrelation": 1.1}, r"autocorrelation: 1.1 is not in \[0, 1\]"),
        ({"autocorrelation": np.nan}, "autocorrelation: nan is not"),
        ({"torso_sigma": 0.0}, "torso_sigma: 0.0 must be positive"),
        ({"sensors": ("Hips", "Hips")}, "sensors: Hips occurs more than once"),
    ],
)
def test_invalid_statistics_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ResidualStatistics(**wrong)


def test_right_and_left_have_equal_widenings() -> None:
    assert unsided("Hips LeftUpLeg") == unsided("Hips RightUpLeg") == "Hips UpLeg"
    found = CovarianceInflation.shipped().apply(confidence(1e-4), ResidualStatistics())
    np.testing.assert_array_equal(found.position_sigma[:, 1], found.position_sigma[:, 2])


def test_file_round_trip(tmp_path: Path) -> None:
    plain = inflation(sensed={"Hips UpLeg": Widening([1.0, 2.5, 3.0], [0.0, 0.01, 0.02])})
    given = CovarianceInflation(plain.widenings, {"fused": {"position": 0.0, "turn": 0.25}}, {"camera": 0.02})
    (tmp_path / "a.toml").write_text(given.text())
    read = CovarianceInflation.read(tmp_path / "a.toml")
    assert read.text() == given.text()
    assert (read.shares, read.depths) == (given.shares, given.depths)
    np.testing.assert_array_equal(read.widenings["sensed"]["turn"]["Hips UpLeg"].factor, [1.0, 2.5, 3.0])


def test_shipped_file_has_all_joints_and_pairs() -> None:
    shipped = CovarianceInflation.shipped()
    carriers = tuple(joint for name, (joint, _) in BODY.sensors.items() if name.endswith(("Arm", "Leg")))
    assert len(carriers) == 8
    for kind in ("position", "relative"):
        known = shipped.widenings["fused"][kind]
        assert {unsided(name) for name in BODY.names[1:]} <= set(known)
    for pair in segment_pairs(BODY):
        if not pair[1].endswith(("Head", "Hand", "Foot")):  # leaves, which no sensor of the eight turns
            name = " ".join(pair)
            who = seen_by("turn", name, BODY.root, carriers)
            assert unsided(name) in shipped.widenings[who]["turn"], name


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "empty; expected TOML"),
        ("[fused]", "no table of widenings: 'camera'"),
        ("camera = 3", "no table of widenings"),
        ("[camera.position]\nother = {factor = 0.5, floor = 0}", "factor: 0.5 must be one or three"),
        ("[camera.position]\nother = {factor = 2, floor = -1}", "floor: -1.0 must be"),
        ("[camera.position]\nother = {factor = [1, 2], floor = 0}", "must be one or three numbers"),
        ("[camera.position]\nother = {factor = 2, width = 0}", "no table of widenings"),
        ("[camera.position]\nother = {factor = nan, floor = 0}", "factor: nan must be"),
    ],
)
def test_invalid_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        CovarianceInflation.read(tmp_path / "a.toml")


@pytest.mark.parametrize("depths", [{"sensed": 0.1}, {"fused": -0.1}, {"us": 1.0}])
def test_invalid_depths_are_refused(depths: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match="depth cannot be"):
        CovarianceInflation(inflation().widenings, depths=depths)


@pytest.mark.parametrize("shares", [{"sensed": {"position": 0.1}}, {"fused": {"turn": -0.1}}, {"us": {"turn": 1.0}}])
def test_invalid_shares_are_refused(shares: dict[str, dict[str, float]]) -> None:
    with pytest.raises(InvalidInputError, match="share"):
        CovarianceInflation(inflation().widenings, shares)
