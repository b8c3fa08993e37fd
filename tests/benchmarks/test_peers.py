"""Peers of the fragment solvers: one energy, one evaluator."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
import torch
from numpy.typing import NDArray

from benchmarks.peers.cartesian import CartesianScene
from benchmarks.peers.fragments import Answer, Fragment, Material, Score, Solver, Trace
from benchmarks.peers.joint_space import JointScene
from benchmarks.peers.solvers import Ceres, Lbfgs, Scene, ScipyLeastSquares
from benchmarks.solvers import measuring, report, side_by_side
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.solve.initial_guess import InertialGuidedIK
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings

Array = NDArray[np.float64]
N, T = 8, 24
BODY = SkeletonModel.default()
PAPER = CartesianSettings.paper()
JOINT = JointSpaceSettings(sigma_reprojection=5.0)
PEERS: dict[str, Callable[[Scene], Solver]] = {
    "L-BFGS": lambda scene: Lbfgs(scene, 20),
    "SciPy": lambda scene: ScipyLeastSquares(scene, 10),
    "Ceres": lambda scene: Ceres(scene, 50),
}


@pytest.fixture(scope="module")
def material() -> Material:
    """Noisy recording of a moving person."""
    truth = planted.human(BODY, T)
    imus = planted.bone_imus(BODY, truth.poses, planted.LIMBS, 5.0, 0.5)
    seen = planted.unseen(planted.keypoints(truth.poses, 5.0), slice(9, 12), slice(3, 5))
    start = InertialGuidedIK(BODY).refine(planted.lifted_poses(truth), imus)
    return Material(BODY, start, seen, imus)


@pytest.fixture(scope="module")
def cartesian(material: Material) -> CartesianScene:
    return CartesianScene(material, N, PAPER)


@pytest.fixture(scope="module")
def joint(material: Material) -> JointScene:
    return JointScene(material, N, JOINT)


@pytest.fixture(params=["cartesian", "joint"])
def scene(request: pytest.FixtureRequest) -> Scene:
    found: Scene = request.getfixturevalue(request.param)
    return found


def somewhere(scene: Scene, fragment: Fragment, seed: int = 0, size: float = 0.05) -> Array:
    """Variables (N, F) off the start."""
    z = scene.variables(fragment)
    return np.asarray(z + size * np.random.default_rng(seed).normal(size=z.shape))


def torch_value(scene: Scene, fragment: Fragment, z: Array) -> tuple[float, Array]:
    """Energy and gradient (N, F) by autograd."""
    tensor = torch.from_numpy(z.copy()).requires_grad_()
    energy = scene.torch_energy(fragment)(tensor)
    torch.autograd.backward(energy)
    assert tensor.grad is not None
    return float(energy.detach()), tensor.grad.numpy()


def least_squares_value(scene: Scene, fragment: Fragment, z: Array) -> tuple[float, Array]:
    """Half the squares of all residuals and their gradient (N, F), window by window."""
    energy, gradient = 0.0, np.zeros(z.shape)
    for r in scene.residuals:
        for t, parameters in enumerate(r.values(fragment)):
            window = z[t : t + r.width].ravel()
            value = np.asarray(r.value(window, parameters)).ravel()
            again, jacobian = r.jacobian(window, parameters)
            np.testing.assert_array_equal(np.asarray(again).ravel(), value)
            energy += 0.5 * float(value @ value)
            gradient[t : t + r.width] += (value @ np.asarray(jacobian)).reshape(r.width, -1)
    return energy, gradient


# --- one energy ----------------------------------------------------------------------------------


@pytest.mark.parametrize("first", [-4, 8, 20])
def test_peers_have_the_energy_and_gradient_of_the_package(scene: Scene, first: int) -> None:
    fragment = scene.fragment(first)
    z = somewhere(scene, fragment, first + 4)
    score = scene.score(fragment, scene.state(fragment, z))
    by_autograd, slope = torch_value(scene, fragment, z)
    by_squares, gradient = least_squares_value(scene, fragment, z)
    assert by_autograd == pytest.approx(score.energy, rel=1e-9)
    assert by_squares == pytest.approx(score.energy, rel=1e-9)
    np.testing.assert_allclose(gradient, slope, atol=1e-8 * np.abs(slope).max())


# --- the peers -----------------------------------------------------------------------------------


@pytest.mark.parametrize("peer", PEERS)
def test_each_peer_lowers_the_energy(scene: Scene, peer: str) -> None:
    fragment, trace = scene.fragment(8), Trace()
    start = scene.score(fragment, fragment.x0).energy
    answer = PEERS[peer](scene).solve(fragment, trace)
    energy = scene.score(fragment, answer.x).energy
    assert energy < 0.95 * start
    assert answer.seconds > 0
    assert answer.iterations > 2
    curve = measuring.curve(scene, fragment, trace)
    seconds, energies = np.array(curve).T
    assert np.all(np.diff(seconds) >= 0)
    assert seconds[-1] <= answer.seconds
    assert np.all(np.diff(energies) <= 0)
    assert energies[-1] == pytest.approx(energy, rel=1e-6)


def test_ceres_and_the_package_find_the_same_minimum(cartesian: CartesianScene, joint: JointScene) -> None:
    own: list[tuple[Scene, Solver]] = [
        (cartesian, side_by_side.Cartesian(cartesian, PAPER)),
        (joint, side_by_side.Joint(joint, LevenbergMarquardt, None, 1e-10, 200)),
    ]
    for scene, solver in own:
        fragment, ceres = scene.fragment(8), Ceres(scene, 100)
        answers = [s.solve(fragment) for s in (solver, ceres)]
        assert all(a.converged for a in answers)
        energies = [scene.score(fragment, a.x).energy for a in answers]
        assert energies[0] == pytest.approx(energies[1], rel=1e-5)
        assert 0 < ceres.shares[0] < 1


@pytest.mark.parametrize(
    "settings", [CartesianSettings(), replace(PAPER, huber_reprojection=2.0), replace(PAPER, sigma_reprojection=None)]
)
def test_other_cartesian_energies_are_refused(material: Material, settings: CartesianSettings) -> None:
    with pytest.raises(InvalidInputError, match="use CartesianSettings.paper"):
        CartesianScene(material, N, settings)


@pytest.mark.parametrize(
    "change, what",
    [
        ({"sigma_reprojection": None}, "sigma_reprojection given"),
        ({"floor_height": 0.0}, "no floor"),
        ({"limits": False}, "limits=True"),
    ],
)
def test_unsupported_joint_space_settings_are_refused(material: Material, change: dict[str, Any], what: str) -> None:
    with pytest.raises(InvalidInputError, match=what):
        JointScene(material, N, replace(JOINT, **change))


# --- the evaluator -------------------------------------------------------------------------------


# --- tables --------------------------------------------------------------------------------------


def row(name: str, energies: dict[int, float], seconds: float = 0.05) -> measuring.Row:
    out = measuring.Row(name)
    for first, energy in energies.items():
        x = np.zeros(1)
        out.add(Fragment(first, x, None), Answer(x, seconds, 4, True), Score(energy, energy / 10, 0.0))
    return out


def test_solutions_are_compared_with_the_best_of_their_fragment() -> None:
    rows = [row("a", {0: 2.0, 25: 8.0, 50: 3.0}), row("b", {25: 4.0}), row("c", {0: 1.0, 50: 3.0})]
    a, b, c = measuring.summaries(rows, 25)
    assert a["ratio_to_best"] == pytest.approx(2.0)
    assert a["largest_ratio"] == pytest.approx(2.0)
    assert b["ratio_to_best"] == c["largest_ratio"] == pytest.approx(1.0)
    assert a["energy"] == pytest.approx(3.0)
    assert a["gradient"] == pytest.approx(0.8)
    assert a["milliseconds"] == pytest.approx(50.0)
    assert a["frames_per_second"] == pytest.approx(500.0)
    assert (a["fragments"], a["converged"]) == (3, 3)


def result() -> dict[str, Any]:
    """Everything that is written, with made-up numbers."""
    rows = measuring.summaries([row("start (SF2)", {0: 9.0}, 0.0), row("real time", {0: 1.0})], 25)
    answers = {"energy": 1.0, "gradient": 0.1, "violation_deg": 0.0}
    apart = {
        "first_frame": 300,
        "distance_mm": 12.0,
        "real_time": answers,
        "ipopt": {**answers, "energy": 0.75},
        "real_time_converged": True,
        "ipopt_converged": False,
    }
    common = {
        "ceres_share_in_python": 0.66,
        "typical_first_frame": 0,
        "curves": {"real time": [(0.0, 9.0), (0.01, 1.0)], "IPOPT": [(0.0, 9.0), (0.1, 0.99)]},
    }
    agreement = {
        "fragments": 9,
        "same_minimum": 8,
        "largest_relative_energy_difference": 2e-9,
        "largest_distance_mm": 0.01,
        "different_minima": [],
        "not_certified_by_both": [apart],
    }
    return {
        "command": "python -m benchmarks solvers",
        "machine": {"threads": "1", "processor": "one"},
        "effort": asdict(measuring.Effort()),
        "cartesian": {"rows": rows, **common},
        "joint": {
            "without_limits": rows,
            "with_limits": rows,
            "agreement": agreement,
            **common,
            "degrees_of_freedom": {"per_frame": 43, "per_fragment": 2150},
        },
        "by_length": [{"N": 20, "paper": 1256, "joint, real time": 300.0}],
        "by_settings": [
            {
                "settings": "joint space",
                "frames_per_second": 600.0,
                "iterations_per_fragment": 5.6,
                "converged": 5,
                "fragments": 5,
                "build_seconds": 0.1,
            }
        ],
        "build_seconds": {"interpreted": 0.7},
        "by_sensors": [{"sensors": 8, "us": 200.0, "iterations_per_fragment": 5.0, "converged": 9, "fragments": 9}],
        "by_duration": [
            {"recording_seconds": 10, "seconds": 1.0, "seconds_per_second": 0.1, "resident_growth_mb": 0.5}
        ],
    }


def test_the_report_has_every_table() -> None:
    text = report.markdown(json.loads(json.dumps(result(), allow_nan=False)))
    assert text.count("| real time | 50.0 |") == 3
    assert "| start (SF2) | - |" in text
    assert "43 degrees of freedom a frame, 2150 a fragment" in text
    assert "Of 9 fragments both certify the same minimum in 8" in text
    assert "Not certified by both" in text
    assert "different minima:" not in text
    assert "| 300 | 1.0000 | 0.7500 | 12.00 | 0.000 | 0.000 | yes | no |" in text
    assert "66 % of its time" in text
    assert "| 20 | 1256 | 300.0 |" in text
    assert "| 8 | 200 | 5.0 | 9 | 9 |" in text


def test_the_figure_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "solvers.png"
    report.figure(result(), path)
    assert path.read_bytes().startswith(b"\x89PNG")
