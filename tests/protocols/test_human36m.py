"""The protocol on Human3.6M, from archives in VideoPose3D's formats to the table."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import human36m_files as h36m
import numpy as np
import pytest
from lifting_support import TABLE_17, untrained_lifter
from protocol_support import read_json, row

from lifting.checkpoint import save_checkpoint
from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.jobs import Outcome
from rtof_kin.core.resources import model_path
from rtof_kin.protocols import published, run
from rtof_kin.protocols.human36m import Human36MProtocol
from rtof_kin.protocols.tables import STILL, Table

SUBJECTS = ("S9", "S11")


@pytest.fixture(scope="module")
def lifter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A 17-joint lifter that has learned nothing."""
    made = untrained_lifter(seed=2, table=TABLE_17, rate_hz=50.0)
    path = tmp_path_factory.mktemp("lifter") / "lifter17.npz"
    return save_checkpoint(path, made.weights, made.description)


def archive(root: Path, subjects: tuple[str, ...] = SUBJECTS) -> h36m.Positions:
    """Two actions of each subject, of 30 and 18 frames, with exact and detected 2D."""
    positions = h36m.motions(subjects)
    for actions in positions.values():
        actions["Action 1"] = actions["Action 1"][:18]
    h36m.write_positions(root, positions)
    h36m.write_keypoints(root, h36m.keypoints(positions))
    h36m.write_keypoints(root, h36m.keypoints(positions, sigma_px=8.0, more=3), "cpn_ft_h36m_dbb")
    h36m.write_camera_json(root, subjects)
    return positions


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("human36m")
    archive(folder)
    return folder


def protocol(root: Path, lifter: Path, **changed: Any) -> Human36MProtocol:
    """The lifter alone on everything from camera 0, which is quick."""
    return Human36MProtocol(root, lifter, **({"cameras": (0,), "modes": ("lift",)} | changed))


def table_of(about: Human36MProtocol, outcome: Outcome) -> dict[str, Table]:
    """Both tables by name."""
    return {table.name: table for table in about.tables(outcome)}


@pytest.fixture(scope="module")
def measured(root: Path, lifter: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One action of each subject in both modes, with everything that is written."""
    folder = tmp_path_factory.mktemp("measured")
    settings = {"lifter": lifter, "cameras": (1,), "actions": ("Action 1",), "save": folder / "motions"}
    found = run("human36m", root, folder / "out", workers=1, json_file=folder / "all.json", **settings)
    assert found.problem == ""
    return folder


def per_frame(p: np.ndarray, p_true: np.ndarray) -> dict[str, float]:
    """The figures of joints (T, 17, 3) m in mm, mm/frame2 and mm/frame3."""

    def mean(difference: np.ndarray) -> float:
        return float(1000 * np.linalg.norm(difference, axis=-1).mean())

    error = p - p_true
    return {
        "mpjpe_mm": mean(error),
        "mpjpe_rr_mm": mean(error - error[:, :1]),
        "mpjae_frame_mm": mean(np.diff(error, n=2, axis=0)),
        "mpjje_frame_mm": mean(np.diff(error, n=3, axis=0)),
        "frames": len(p),
    }


def test_the_figures_are_those_of_the_saved_motions(measured: Path) -> None:
    rows = read_json(measured / "all.json")["rows"]
    positions = h36m.motions(SUBJECTS)
    for subject in SUBJECTS:
        p_true = positions[subject]["Action 1"][:18]
        saved = measured / "motions" / subject / "Action 1" / "cam1"
        assert sorted(path.name for path in saved.iterdir()) == ["lift", "rto"]
        motion = Motion.load(saved / "rto" / "motion.h5")
        assert motion.skeleton.name == TABLE_17.name
        still = np.broadcast_to(p_true.mean(axis=0), p_true.shape)
        for method, p in {"rto": motion.poses.p_world_joint, STILL: still}.items():
            expected = per_frame(p, p_true)
            (found,) = [r for r in rows if (r["subject"], r["method"]) == (subject, method)]
            rounded = pytest.approx(expected, rel=1e-3)  # positions in the file are of 0.1 um
            assert {name: found[name] for name in expected} == rounded
        assert found["angle_deg"] > 0  # no motion stands in the mean orientation


def test_the_table_has_the_papers_rows_then_ours_then_no_motion(measured: Path) -> None:
    content = read_json(measured / "all.json")
    table = content["tables"]["human36m"]
    labels = [cells[0] for cells in table["rows"]]
    assert labels == [*published.HUMAN36M, "lift, ours", "rto, ours", STILL]
    assert table["rows"][2][1:4] == [46.1, 2.03, 11.25]
    assert all(caveat in table["notes"] for caveat in published.HUMAN36M_CAVEATS)
    assert table["columns"][1:4] == ["MPJPE, root-relative [mm]", "MPJAE [mm/frame2]", "MPJJE [mm/frame3]"]
    assert "S9, S11, cameras 1, 36 frames, all pooled; ground-truth 2D" in table["notes"][0]
    assert "lifter17.npz" in table["notes"][0]
    assert not any("INCOMPLETE" in note for note in table["notes"])


def test_means_are_over_the_frames_of_all_actions(root: Path, lifter: Path, tmp_path: Path) -> None:
    about = protocol(root, lifter, actions=("Action",))
    outcome = about.run(tmp_path, workers=1)
    assert (len(outcome.done), outcome.failed) == (4, {})
    expected = np.average(
        [facts["methods"]["lift"]["mpjpe_rr_mm"] for facts in outcome.done.values()],
        weights=[18 if facts["take"] == "Action 1" else 30 for facts in outcome.done.values()],
    )
    found = row(table_of(about, outcome)["human36m"], "lift, ours")
    assert found["MPJPE, root-relative [mm]"] == pytest.approx(expected)
    usual = Human36MProtocol(root, Path("live"))
    assert (usual.subjects, usual.cameras, usual.modes) == (SUBJECTS, (0, 1, 2, 3), ("lift", "rto"))
    assert len(usual.jobs()) == 2 * 2 * 4
    weights = model_path("lifter_live.npz").read_bytes()
    assert usual.settings()["lifter_sha256"] == hashlib.sha256(weights).hexdigest()


def test_damaged_actions_and_absent_subjects_are_reported(lifter: Path, tmp_path: Path) -> None:
    positions: dict[str, dict[str, Any]] = dict(archive(tmp_path, ("S9",)))
    positions["S9"] = positions["S9"] | {"Action 0": np.zeros((30, 5))}
    h36m.write_positions(tmp_path, positions)
    about = protocol(tmp_path, lifter, actions=("Action 0", "Action 1"), keypoints="cpn_ft_h36m_dbb")
    outcome = about.run(tmp_path / "out", workers=1)
    assert list(outcome.done) == ["S9_Action_1_cam0"]
    tables = table_of(about, outcome)
    note = "INCOMPLETE, without 1 recordings and any of S11: see the last table."
    assert tables["human36m"].notes[1] == note
    assert "2D of cpn_ft_h36m_dbb" in tables["human36m"].notes[0]
    absent, damaged = tables["state_of_data"].rows
    assert absent == ("S11", "not measured", "the archive of positions has no such subject")
    assert damaged[:2] == ("S9_Action_0_cam0", "not measured")
    assert "data_3d_h36m.npz" in str(damaged[2])
    with pytest.raises(FileFormatError, match="has no action by S11"):
        protocol(tmp_path, lifter, subjects=("S11",)).jobs()


@pytest.mark.parametrize(
    "given, message",
    [
        ({"subjects": ("S2",)}, "unknown subject 'S2'"),
        ({"actions": ("Action 1", "Acton 0")}, "unknown action 'Acton 0'. Did you mean 'Action 0'?"),
        ({"modes": ("rtof",)}, "unknown mode without sensors 'rtof'"),
        ({"lifter": Path("none.pt")}, "none.pt: no such file; train a lifter"),
        ({"root": Path("none")}, "data_3d_h36m.npz"),
    ],
)
def test_bad_input_writes_nothing(
    given: dict[str, Any], message: str, root: Path, lifter: Path, tmp_path: Path
) -> None:
    about = {"root": root, "lifter": lifter} | given
    with pytest.raises(RtofError, match=re.escape(message)):
        run("human36m", about.pop("root"), tmp_path / "out", **about)
    assert not list(tmp_path.iterdir())
