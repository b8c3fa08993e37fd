"""Peers of the fragment solvers: the same energy, whoever writes it; everyone scored by one evaluator."""

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

from benchmarks import solvers
from benchmarks.peers import (
    Answer,
    CartesianScene,
    Ceres,
    Fragment,
    JointScene,
    Lbfgs,
    Scene,
    ScipyLeastSquares,
    Score,
    Solver,
    Trace,
)
from rtof_kin.errors import ShapeError
from rtof_kin.fragment_settings import FragmentSettings
from rtof_kin.inertial_ik import InertialGuidedIK
from rtof_kin.joint_space.settings import JointSpaceSettings
from rtof_kin.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.skeleton import SkeletonModel

Array = NDArray[np.float64]
N, T = 8, 24
BODY = SkeletonModel.default()
PAPER = FragmentSettings.paper()
JOINT = JointSpaceSettings(sigma_reprojection=5.0)
SPACES = ("cartesian", "joint")
PEERS: dict[str, Callable[[Scene], Solver]] = {
    "L-BFGS": lambda scene: Lbfgs(scene, 20),
    "SciPy": lambda scene: ScipyLeastSquares(scene, 10),
    "Ceres": lambda scene: Ceres(scene, 50),
}


@pytest.fixture(scope="module")
def material() -> solvers.Material:
    """Somebody who moves, seen with errors."""
    truth = planted.human(BODY, T)
    imus = planted.bone_imus(BODY, truth.poses, planted.LIMBS, 5.0, 0.5)
    seen = planted.unseen(planted.keypoints(truth.poses, 5.0), slice(9, 12), slice(3, 5))
    start = InertialGuidedIK(BODY).refine(planted.lifted_poses(truth), imus)
    return solvers.Material(BODY, start, seen, imus)


@pytest.fixture(scope="module")
def scenes(material: solvers.Material) -> dict[str, Scene]:
    m = material
    return {
        "cartesian": CartesianScene(m.skeleton, N, PAPER, m.start, m.keypoints, m.imus),
        "joint": JointScene(m.skeleton, N, JOINT, m.start, m.keypoints, m.imus),
    }


@pytest.fixture(params=SPACES)
def scene(request: pytest.FixtureRequest, scenes: dict[str, Scene]) -> Scene:
    return scenes[request.param]


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
def test_autograd_has_the_packages_energy(scene: Scene, first: int) -> None:
    fragment = scene.fragment(first)
    z = somewhere(scene, fragment, first + 4)
    score = scene.score(fragment, scene.state(fragment, z))
    assert torch_value(scene, fragment, z)[0] == pytest.approx(score.energy, rel=1e-9)


@pytest.mark.parametrize("first", [-4, 8, 20])
def test_half_the_squares_of_the_residuals_are_the_packages_energy(
    scene: Scene, first: int
) -> None:
    fragment = scene.fragment(first)
    z = somewhere(scene, fragment, first + 4)
    energy, gradient = least_squares_value(scene, fragment, z)
    score = scene.score(fragment, scene.state(fragment, z))
    assert energy == pytest.approx(score.energy, rel=1e-9)
    by_autograd = torch_value(scene, fragment, z)[1]
    np.testing.assert_allclose(gradient, by_autograd, atol=1e-8 * np.abs(by_autograd).max())


def test_residuals_have_finite_derivatives_at_the_start_and_where_nothing_is_seen(
    scene: Scene,
) -> None:
    fragment = scene.fragment(-4)
    energy, gradient = least_squares_value(scene, fragment, scene.variables(fragment))
    assert np.isfinite(gradient).all()
    assert energy == pytest.approx(scene.score(fragment, fragment.x0).energy, rel=1e-9)


def test_the_gradient_by_steps_is_that_of_finite_differences(scenes: dict[str, Scene]) -> None:
    scene = scenes["joint"]
    fragment = scene.fragment(8)
    z = somewhere(scene, fragment, size=0.3)
    d = np.random.default_rng(1).normal(size=z.shape)
    ahead, behind = (torch_value(scene, fragment, z + s * d)[0] for s in (1e-6, -1e-6))
    slope = float(np.sum(torch_value(scene, fragment, z)[1] * d))
    assert slope == pytest.approx((ahead - behind) / 2e-6, rel=1e-6)


def test_the_cartesian_gradient_is_the_packages(scenes: dict[str, Scene]) -> None:
    scene = scenes["cartesian"]
    fragment = scene.fragment(8)
    z = somewhere(scene, fragment)
    gradient = np.abs(torch_value(scene, fragment, z)[1]).max()
    assert scene.score(fragment, z).gradient == pytest.approx(gradient, rel=1e-9)


# --- the peers -----------------------------------------------------------------------------------


@pytest.mark.parametrize("peer", PEERS)
def test_each_peer_lowers_the_energy_and_tells_how(scene: Scene, peer: str) -> None:
    fragment, trace = scene.fragment(8), Trace()
    start = scene.score(fragment, fragment.x0).energy
    answer = PEERS[peer](scene).solve(fragment, trace)
    energy = scene.score(fragment, answer.x).energy
    assert energy < 0.9 * start
    assert answer.seconds > 0
    assert answer.iterations > 2
    curve = solvers.curve(scene, fragment, trace)
    seconds, energies = np.array(curve).T
    assert np.all(np.diff(seconds) >= 0)
    assert seconds[-1] <= answer.seconds
    assert np.all(np.diff(energies) <= 0)
    assert energies[-1] == pytest.approx(energy, rel=1e-6)


@pytest.mark.parametrize("peer", PEERS)
def test_a_peer_gives_the_same_answer_twice_whatever_it_solved_between(
    scene: Scene, peer: str
) -> None:
    solver = PEERS[peer](scene)
    one = solver.solve(scene.fragment(8)).x
    solver.solve(scene.fragment(-4))
    np.testing.assert_array_equal(solver.solve(scene.fragment(8), []).x, one)


def test_ceres_and_the_packages_solvers_find_one_minimum(scenes: dict[str, Scene]) -> None:
    cartesian, joint = scenes["cartesian"], scenes["joint"]
    assert isinstance(cartesian, CartesianScene)
    assert isinstance(joint, JointScene)
    own: list[tuple[Scene, Solver]] = [
        (cartesian, solvers.Cartesian(cartesian, settings))
        for settings in solvers.CARTESIAN_BACKENDS.values()
    ]
    own.append((joint, solvers.Joint(joint, LevenbergMarquardt, None, 1e-10, 200)))
    for scene, solver in own:
        fragment, ceres = scene.fragment(8), Ceres(scene, 100)
        answers = [s.solve(fragment) for s in (solver, ceres)]
        assert all(a.converged for a in answers)
        energies = [scene.score(fragment, a.x).energy for a in answers]
        assert energies[0] == pytest.approx(energies[1], rel=1e-5)
        assert 0 < ceres.shares[0] < 1


def test_l_bfgs_says_whether_it_stopped_by_itself(scenes: dict[str, Scene]) -> None:
    scene = scenes["cartesian"]
    fragment = scene.fragment(8)
    cut_short = Lbfgs(scene, 3).solve(fragment)
    assert cut_short.iterations == 3
    assert not cut_short.converged


@pytest.mark.parametrize(
    "settings",
    [
        FragmentSettings(),
        replace(PAPER, huber_reprojection=2.0),
        replace(PAPER, sigma_reprojection=None),
        replace(PAPER, prior="bones"),
    ],
)
def test_an_energy_that_is_not_the_printed_one_is_refused(
    material: solvers.Material, settings: FragmentSettings
) -> None:
    m = material
    with pytest.raises(ShapeError, match="printed alone: use FragmentSettings.paper"):
        CartesianScene(m.skeleton, N, settings, m.start, m.keypoints, m.imus)


@pytest.mark.parametrize(
    "change, what",
    [
        ({"sigma_reprojection": None}, "sigma_reprojection given"),
        ({"floor_height": 0.0}, "no floor"),
        ({"limits": False}, "limits=True"),
    ],
)
def test_joint_space_settings_the_peers_do_not_know_are_refused(
    material: solvers.Material, change: dict[str, Any], what: str
) -> None:
    m = material
    with pytest.raises(ShapeError, match=what):
        JointScene(m.skeleton, N, replace(JOINT, **change), m.start, m.keypoints, m.imus)


# --- the evaluator -------------------------------------------------------------------------------


def test_a_limit_that_is_missed_is_scored_in_degrees(scenes: dict[str, Scene]) -> None:
    scene = scenes["joint"]
    assert isinstance(scene, JointScene)
    fragment, space = scene.fragment(8), scene.space
    x = fragment.x0.copy()
    inside = scene.score(fragment, x).violation_deg
    knee = scene.limits.names.index("LeftLeg_y")
    a = space.names.index("LeftLeg")
    axis, beyond = space.hinge_axis[a], scene.limits.upper[knee] + np.radians(10.0)
    x[2, 3 + 4 * a : 7 + 4 * a] = 0.0
    x[2, 3 + 4 * a] = np.cos(beyond / 2)
    x[2, 4 + 4 * a + axis] = np.sin(beyond / 2)
    assert inside < 10.0
    assert scene.score(fragment, x).violation_deg == pytest.approx(10.0, abs=1e-6)


def test_multipliers_enter_the_gradient(scenes: dict[str, Scene]) -> None:
    scene = scenes["joint"]
    assert isinstance(scene, JointScene)
    fragment = scene.fragment(8)
    multipliers = np.zeros((N, len(scene.limits.names)))
    plain = scene.score(fragment, fragment.x0)
    assert scene.score(fragment, fragment.x0, multipliers) == plain
    multipliers[3] = 1e6
    pushed = scene.score(fragment, fragment.x0, multipliers)
    assert pushed.energy == plain.energy
    assert pushed.gradient > 2 * plain.gradient


def test_ipopt_and_real_time_agree_on_planted_fragments(scenes: dict[str, Scene]) -> None:
    scene = scenes["joint"]
    assert isinstance(scene, JointScene)
    told: list[str] = []
    found = solvers.agreement(scene, [4, 8], told.append)
    assert len(told) == 2
    assert found["fragments"] == 2
    parts = ("different_minima", "not_certified_by_both")
    assert found["same_minimum"] + sum(len(found[part]) for part in parts) == 2
    assert found["same_minimum"] > 0
    assert found["largest_relative_energy_difference"] < 1e-6
    assert found["largest_distance_mm"] < 0.1


# --- tables --------------------------------------------------------------------------------------


def row(name: str, energies: dict[int, float], seconds: float = 0.05) -> solvers.Row:
    out = solvers.Row(name)
    for first, energy in energies.items():
        x = np.zeros(1)
        out.add(
            Fragment(first, x, None), Answer(x, seconds, 4, True), Score(energy, energy / 10, 0.0)
        )
    return out


def test_an_answer_is_compared_with_the_best_of_the_same_fragment() -> None:
    rows = [row("a", {0: 2.0, 25: 8.0, 50: 3.0}), row("b", {25: 4.0}), row("c", {0: 1.0, 50: 3.0})]
    a, b, c = solvers.summaries(rows, 25)
    assert a["ratio_to_best"] == pytest.approx(2.0)
    assert a["largest_ratio"] == pytest.approx(2.0)
    assert b["ratio_to_best"] == c["largest_ratio"] == pytest.approx(1.0)
    assert a["energy"] == pytest.approx(3.0)
    assert a["gradient"] == pytest.approx(0.8)
    assert a["milliseconds"] == pytest.approx(50.0)
    assert a["frames_per_second"] == pytest.approx(500.0)
    assert (a["fragments"], a["converged"]) == (3, 3)


def test_what_took_no_time_has_no_rate() -> None:
    (start,) = solvers.summaries([row("start", {0: 1.0}, seconds=0.0)], 25)
    assert start["milliseconds"] is None
    assert start["frames_per_second"] is None


def test_a_table_has_a_line_for_each_row_and_dashes_for_what_is_missing() -> None:
    columns: solvers.Columns = {"name": ("solver", str), "ms": ("time [ms]", solvers.digits(1))}
    lines = solvers.table(
        [{"name": "a", "ms": 1.25}, {"name": "b", "ms": None}, {"name": "c"}], columns
    )
    assert lines.splitlines() == [
        "| solver | time [ms] |", "|---|---|", "| a | 1.2 |", "| b | - |", "| c | - |",
    ]  # fmt: skip


def test_fragments_are_spread_from_the_first_to_the_last() -> None:
    assert solvers.spread(3, 50, 150) == [-25, 50, 125]
    assert solvers.spread(99, 50, 100) == [-25, 0, 25, 50, 75]


def test_slow_solvers_get_some_of_the_fragments_the_typical_one_among_them(
    scenes: dict[str, Scene],
) -> None:
    effort = replace(solvers.Effort.quick(), fragments=5, slow_fragments=2)
    choice = solvers.Choice.of(scenes["joint"], effort, T)
    assert len(choice.firsts) == 5
    assert len(choice.slow) == 2
    assert choice.typical in choice.slow
    assert set(choice.slow) < set(choice.firsts)
    assert all(0 <= first <= T - N for first in choice.slow)


def test_rising_caps_end_where_the_solver_converges(scenes: dict[str, Scene]) -> None:
    scene = scenes["joint"]
    assert isinstance(scene, JointScene)

    def capped(cap: int) -> Solver:
        return solvers.Joint(scene, LevenbergMarquardt, None, 1e-6, cap)

    fragment = scene.fragment(8)
    trace = solvers.rising(capped, fragment, range(1, 60), 1)
    assert 3 < len(trace) < 59
    assert trace[0][0] == 0.0
    assert np.all(np.diff([seconds for seconds, _ in trace]) >= 0)
    energies = [energy for _, energy in solvers.curve(scene, fragment, trace)]
    assert energies[0] == pytest.approx(scene.score(fragment, fragment.x0).energy)
    assert energies[-1] < 0.9 * energies[0]


def test_a_recording_is_tiled_to_and_fro(material: solvers.Material) -> None:
    long = material.tiled(3 * T)
    p = long.start.p_world_joint
    np.testing.assert_array_equal(p[:T], material.start.p_world_joint)
    np.testing.assert_array_equal(p[T : 2 * T], p[:T][::-1])
    np.testing.assert_array_equal(p[2 * T :], p[:T])
    np.testing.assert_array_equal(long.keypoints.times, long.start.times)
    np.testing.assert_array_equal(long.imus.times, long.start.times)
    np.testing.assert_allclose(np.diff(long.start.times), 1 / 60, rtol=1e-9)


def result() -> dict[str, Any]:
    """Everything that is written, with made-up numbers."""
    rows = solvers.summaries([row("start (SF2)", {0: 9.0}, 0.0), row("real time", {0: 1.0})], 25)
    answers = {"energy": 1.0, "gradient": 0.1, "violation_deg": 0.0}
    apart = {
        "first_frame": 300, "distance_mm": 12.0, "real_time": answers,
        "ipopt": {**answers, "energy": 0.75}, "real_time_converged": True, "ipopt_converged": False,
    }  # fmt: skip
    common = {
        "ceres_share_in_python": 0.66, "typical_first_frame": 0,
        "curves": {"real time": [(0.0, 9.0), (0.01, 1.0)], "IPOPT": [(0.0, 9.0), (0.1, 0.99)]},
    }  # fmt: skip
    agreement = {
        "fragments": 9, "same_minimum": 8, "largest_relative_energy_difference": 2e-9,
        "largest_distance_mm": 0.01, "different_minima": [], "not_certified_by_both": [apart],
    }  # fmt: skip
    return {
        "command": "python -m benchmarks.solvers", "machine": {"threads": "1"},
        "effort": asdict(solvers.Effort()), "cartesian": {"rows": rows, **common},
        "joint": {
            "without_limits": rows, "with_limits": rows, "agreement": agreement, **common,
            "degrees_of_freedom": {"per_frame": 43, "per_fragment": 2150},
        },
        "by_length": [{"N": 20, "paper": 1256, "joint, real time": 300.0}],
        "by_settings": [
            {"settings": "joint space", "frames_per_second": 600.0, "iterations_per_fragment": 5.6,
             "converged": 5, "fragments": 5, "build_seconds": 0.1}
        ],
        "build_seconds": {"interpreted": 0.7},
        "by_duration": [{"recording_seconds": 10, "seconds": 1.0, "seconds_per_second": 0.1,
                         "resident_growth_mb": 0.5}],
    }  # fmt: skip


def test_the_text_has_every_table_and_the_fragments_that_are_not_certified() -> None:
    text = solvers.markdown(json.loads(json.dumps(result(), allow_nan=False)))
    assert text.count("| real time | 50.0 |") == 3
    assert "| start (SF2) | - |" in text
    assert "43 degrees of freedom a frame, 2150 a fragment" in text
    assert "Of 9 fragments both certify the same minimum in 8" in text
    assert "Not certified by both" in text
    assert "different minima:" not in text
    assert "| 300 | 1.0000 | 0.7500 | 12.00 | 0.000 | 0.000 | yes | no |" in text
    assert "66 % of its time" in text
    assert "| 20 | 1256 | 300.0 |" in text


def test_the_figure_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "solvers.png"
    solvers.figure(result(), path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_the_command_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        solvers.main(["--help"])
    assert "--quick" in capsys.readouterr().out


def test_memory_is_told_in_megabytes() -> None:
    before = solvers.resident_mb()
    kept = np.ones(25_000_000)
    assert 100 < solvers.resident_mb() - before < 300
    assert len(kept)
