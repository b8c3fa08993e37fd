"""The lifter's benchmark: camera placements, scores of planted errors, tables, resumed runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.lifter import __main__ as command
from benchmarks.lifter import figure, measures, tables
from benchmarks.lifter.measures import gaussian_share
from benchmarks.lifter.placements import PLACEMENTS, Placement
from benchmarks.lifter.rows import KINDS, STILL, Job, run
from lifting.checkpoint import save_checkpoint
from rtof_kin.body import metrics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.mocap import MocapClip

Array = NDArray[np.float64]
SKELETON = SkeletonModel.default()
FRAMES = 50


def motion(walk: float = 0.0) -> PoseSequence:
    """A waving person who walks along x, m/s."""
    _, R = support.moving(3, FRAMES)
    times = np.arange(FRAMES) / 60
    p = support.positions(3, FRAMES) + np.stack([walk * times, 0 * times, 0 * times], axis=1)[:, None]
    return PoseSequence(times, p, R, SKELETON.names)


CLIP = MocapClip("waving", motion(), SKELETON.joint_offsets, "s1", "acting")


@pytest.fixture(scope="module")
def lifter(tmp_path_factory: pytest.TempPathFactory) -> str:
    made = support.untrained_lifter()
    path = tmp_path_factory.mktemp("lifter") / "mine.npz"
    return str(save_checkpoint(path, made.weights, made.description))


# --- placements ----------------------------------------------------------------------------------


@pytest.mark.parametrize("walk", [0.0, 8.0])
@pytest.mark.parametrize("placement", PLACEMENTS, ids=lambda placement: placement.name)
def test_cameras_have_their_distance_from_the_path(placement: Placement, walk: float) -> None:
    poses = motion(walk)
    camera = placement.camera(poses)
    root = poses.p_world_joint[:, 0]
    away = np.linalg.norm(root[:, :2] - camera.center_world[:2], axis=1)
    assert away.min() >= placement.distance - 1e-9
    if walk:
        assert away.min() == pytest.approx(placement.distance)
    assert camera.center_world[2] == pytest.approx(placement.height)
    middle = (root.min(axis=0) + root.max(axis=0)) / 2
    np.testing.assert_allclose(camera.project(middle), [960, 540], atol=1e-6)
    offset = camera.center_world[:2] - middle[:2]
    assert np.degrees(np.arctan2(offset[1], offset[0])) % 360 == pytest.approx(placement.azimuth)


# --- figures -------------------------------------------------------------------------------------


def test_positions_are_scored_as_by_the_package() -> None:
    truth = motion()
    rng = np.random.default_rng(0)
    estimate = replace(truth, p_world_joint=truth.p_world_joint + rng.normal(0, 0.02, (FRAMES, 21, 3)))
    expected = metrics.evaluate(estimate, truth, SKELETON)
    figures = measures.position_figures(estimate.p_world_joint, truth, np.ones(FRAMES, bool))
    for name in ("mpjpe_rr_mm", "mpjpe_mm", "mpjae", "mpjje"):
        assert figures[name] == pytest.approx(expected[name])
    assert figures["LeftHand mm"] == pytest.approx(expected.per_joint["LeftHand"]["mpjpe_rr_mm"])
    assert figures["Hips mm"] == 0


def test_errors_as_large_as_their_sigmas_have_the_expected_coverage() -> None:
    truth, rng = motion(), np.random.default_rng(1)
    centre = np.array([4.0, 0.5, 1.5])
    ray = so3.unit(truth.p_world_joint[:, 0] - centre)
    spread = {"across": 0.01, "along": 0.05, "root across": 0.02, "root along": 0.2}

    def error(across: float, along: float) -> Array:
        e = rng.normal(0, across, (FRAMES, 21, 3))
        e -= np.sum(e * ray[:, None], axis=-1, keepdims=True) * ray[:, None]
        return np.asarray(e + rng.normal(0, along, (FRAMES, 21, 1)) * ray[:, None])

    root = error(spread["root across"], spread["root along"])[:, :1]
    p = truth.p_world_joint + root + error(spread["across"], spread["along"])
    p[:, 0] = truth.p_world_joint[:, 0] + root[:, 0]
    sigma = np.empty((FRAMES, 21, 2))
    sigma[:, 1:] = spread["across"], spread["along"]
    sigma[:, 0] = spread["root across"], spread["root along"]
    R = truth.R_world_bone @ so3.exp(rng.normal(0, 0.1, (FRAMES, 21, 3)))
    sigma_rad = np.full((FRAMES, 21), 0.1)
    figures = measures.calibration_figures(p, R, sigma, sigma_rad, truth, centre)
    for name in measures.DIRECTIONS:
        few = name.startswith("root")
        for k in (1, 2):
            value = figures[f"{name} within {k}"]
            assert value == pytest.approx(gaussian_share(k), abs=0.16 if few else 0.03), name
    for column, direction in enumerate(("across", "along")):
        wider = sigma.copy()
        wider[..., column] *= 10
        figures = measures.calibration_figures(p, R, wider, sigma_rad, truth, centre)
        assert figures[f"joints {direction} within 1"] == 1
        assert figures[f"root {direction} within 1"] == 1
        other = "along" if direction == "across" else "across"
        assert figures[f"joints {other} within 1"] < 0.75


# --- rows and tables -----------------------------------------------------------------------------


def test_a_job_has_a_row_for_each_input_and_lifter(lifter: str) -> None:
    rows = run(Job(CLIP, PLACEMENTS[3], 0, (lifter,)))
    ways = [(row["keypoints"], row["lifter"], row["sensors"]) for row in rows]
    each = [(STILL, "0"), ("mine", "0"), ("mine", "8"), ("mine", "10")]
    assert ways == [(kind, *way) for kind in KINDS for way in each]
    assert all("error" not in row for row in rows)
    assert rows[1]["mpjpe_rr_mm"] != rows[2]["mpjpe_rr_mm"] != rows[3]["mpjpe_rr_mm"]
    for table in tables.TABLES:
        made = table(rows)
        assert made.rows
        assert all(len(line) == len(made.columns) == len(made.digits) for line in made.rows)
        assert "nan" not in made.markdown()


def row(**changes: Any) -> dict[str, Any]:
    """A planted row."""
    base = {
        "motion": "a",
        "source": "a",
        "category": "acting",
        "placement": "low",
        "keypoints": "perfect",
        "sensors": "0",
        "lifter": "x",
        "frames": 100,
        "all_frames": 100,
        "coverage": 1.0,
        "mpjpe_rr_mm": 10.0,
        "mpjpe_mm": 20.0,
        "mpjae": 1.0,
        "mpjje": 2.0,
        "Hips mm": 0.0,
        "Head mm": 5.0,
        **{f"{n} {p} deg": 4.0 for n in measures.TORSO for p in measures.PARTS},
        **{f"{n} within {k}": 0.5 for n in measures.DIRECTIONS for k in measures.SIGMAS},
    }
    return base | changes


def test_rows_are_pooled_over_frames() -> None:
    other = row(frames=300, mpjpe_rr_mm=30.0, source="b", coverage=0.5, all_frames=600)
    rows = [row(), other]
    (line,) = tables.overall(rows).rows
    assert line[3] == pytest.approx((10 + 3 * 30) / 4)
    assert line[-1] == pytest.approx(100 * (100 + 300) / 700)
    assert line[-2] == "10.0-30.0"


def test_seeds_of_a_training_are_pooled() -> None:
    found = {"ours_seed0": 40.0, "ours_seed1": 43.0, "ours_seed2": 46.0, "v_seed0 (videopose3d)": 90.0}
    rows = [row(lifter=name, mpjpe_rr_mm=rr) for name, rr in found.items()] + [row()]
    assert tables.seeds(rows).rows == (
        ("perfect", "ours", "image only", "3", 43.0, 3.0, 20.0, 0.0),
        ("perfect", "v (videopose3d)", "image only", "1", 90.0, None, 20.0, None),
    )
    first = [line["lifter"] for line in tables.first_seeds(rows)]
    assert first == ["ours_seed0", "v_seed0 (videopose3d)", "x"]


def test_the_calibration_table_has_expected_shares() -> None:
    silent = {name: None for name in row() if "within" in name}
    lines = tables.calibration([row(), row(lifter="base", **silent)]).rows
    assert {line[1] for line in lines} == {"x"}
    assert [line[3] for line in lines] == list(measures.DIRECTIONS)
    along = next(line for line in lines if line[3] == "joints along")
    assert along[4:] == pytest.approx((50, 75.69, 68.27, 50, 94.09, 95.45), abs=0.01)


# --- the command ---------------------------------------------------------------------------------


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """One motion, two placements, read from nowhere."""
    monkeypatch.setattr(command, "clips", lambda corpus, subset: [CLIP])
    monkeypatch.setattr(command, "PLACEMENTS", PLACEMENTS[:2])


def test_an_interrupted_run_resumes_and_writes_everything(
    few: None, tmp_path: Path, lifter: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--corpus", "x", "--lifter", lifter, "--workers", "1", "--out", str(tmp_path)]
    done: list[str] = []

    def interrupted(job: Job) -> list[dict[str, Any]]:
        if done:
            raise KeyboardInterrupt
        done.append(job.key)
        return run(job)

    monkeypatch.setattr(command, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        command.main(options)
    assert len((tmp_path / "lifter.jsonl").read_text().splitlines()) == 2

    def counted(job: Job) -> list[dict[str, Any]]:
        done.append(job.key)
        return run(job)

    monkeypatch.setattr(command, "run", counted)
    command.main(options)
    assert done == ["waving eye height, 4 m", "waving low, 4 m"]
    content = json.loads((tmp_path / "lifter.json").read_text())
    assert len(content["rows"]) == 2 * 2 * 4
    assert content["command"] == "python -m benchmarks lifter --corpus DIR --lifter 'mine'"
    assert set(content["lifters"]) == {"mine"}
    assert str(tmp_path) not in json.dumps(content)
    text = (tmp_path / "lifter.md").read_text()
    assert "### By placement" in text
    assert "### Calibration" in text
    assert (tmp_path / "lifter.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "lifter.jsonl").exists()


def test_learning_curves_are_drawn(tmp_path: Path) -> None:
    files = []
    for seed in (0, 1):
        history = [{"windows": w, "validation": {"perfect": {"rr_mm": 50 / w, "abs_mm": 90 / w}}} for w in (1, 2)]
        files.append(tmp_path / f"s{seed}.pt.curves.json")
        files[-1].write_text(json.dumps({"recipe": {"seed": seed}, "history": history}))
    rows = [row(keypoints="realistic"), row(keypoints="realistic", placement="high")]
    figure.write_figure(tmp_path / "x.png", rows, files)
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    files[0].write_text("{}")
    with pytest.raises(FileFormatError, match="not the curves of a training"):
        figure.write_figure(tmp_path / "x.png", rows, files)
