"""The protocol on Human3.6M, from archives in VideoPose3D's formats to the table."""

from __future__ import annotations

import contextlib
import hashlib
import io
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import human36m_files as h36m
import matplotlib.image
import numpy as np
import pytest
from lifting_support import TABLE_17, untrained_lifter
from protocol_support import facts_of, read_json, row

from lifting.checkpoint import save_checkpoint
from rtof_kin.cli import main
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.protocols import human36m, pictures, published
from rtof_kin.protocols.human36m import STILL, Human36MProtocol, all_tables, run
from rtof_kin.protocols.jobs import Outcome
from rtof_kin.protocols.tables import Table

SUBJECTS = ("S9", "S11")


@pytest.fixture(scope="module")
def lifter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A 17-joint lifter that has learned nothing."""
    made = untrained_lifter(seed=2, table=TABLE_17, rate_hz=50.0)
    path = tmp_path_factory.mktemp("lifter") / "lifter17.pt"
    return save_checkpoint(path, made.network, made.description)


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
    return {table.name: table for table in all_tables(about, outcome)}


# --- by hand -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(root: Path, lifter: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One action of each subject in both modes by the command, with everything it can write."""
    folder = tmp_path_factory.mktemp("measured")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = main(
            ["human36m", "--root", str(root), "--lifter", str(lifter), "--cameras", "1",
             "--actions", "Action 1", "--workers", "1", "-o", str(folder / "out"),
             "--save", str(folder / "motions"), "--json", str(folder / "all.json")]
        )  # fmt: skip
    assert code == 0
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


def test_the_figures_are_those_of_the_saved_motions_per_frame(measured: Path) -> None:
    rows = read_json(measured / "all.json")["rows"]
    positions = h36m.motions(SUBJECTS)
    for subject in SUBJECTS:
        p_true = positions[subject]["Action 1"][:18]
        saved = measured / "motions" / subject / "Action 1" / "cam1"
        assert sorted(path.name for path in saved.iterdir()) == ["lift", "rto"]
        motion = read_motion_npz(saved / "rto" / "motion.npz")
        assert (motion.mode, motion.skeleton) == ("rto", TABLE_17.name)
        still = np.broadcast_to(p_true.mean(axis=0), p_true.shape)
        for method, p in {"rto": motion.poses.p_world_joint, STILL: still}.items():
            expected = per_frame(p, p_true)
            (found,) = [r for r in rows if (r["subject"], r["method"]) == (subject, method)]
            assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-5)
        assert found["angle_deg"] > 0  # no motion stands in the mean orientation


def test_the_table_has_the_papers_rows_then_ours_then_no_motion(measured: Path) -> None:
    content = read_json(measured / "all.json")
    table = content["tables"]["human36m"]
    labels = [cells[0] for cells in table["rows"]]
    assert labels == [*published.HUMAN36M, "lift, ours", "rto, ours", STILL]
    assert table["rows"][2][1:4] == [46.1, 2.03, 11.25]
    assert all(caveat in table["notes"] for caveat in published.HUMAN36M_CAVEATS)
    assert table["columns"][1:4] == [
        "MPJPE, root-relative [mm]", "MPJAE [mm/frame2]", "MPJJE [mm/frame3]",
    ]  # fmt: skip
    assert "S9, S11, cameras 1, 36 frames, all pooled; ground-truth 2D" in table["notes"][0]
    assert "lifter17.pt" in table["notes"][0]
    assert not any("INCOMPLETE" in note for note in table["notes"])
    for name, least in {"error_curves": 500, "skeletons": 400}.items():
        pixels = matplotlib.image.imread(measured / "out" / "figures" / f"{name}.png")
        assert pixels.shape[0] > least
        assert len(np.unique(pixels[::4, ::4].reshape(-1, pixels.shape[-1]), axis=0)) > 50


def test_a_mean_is_one_over_the_frames_of_all_actions(root: Path, lifter: Path, tmp_path: Path) -> None:
    about = protocol(root, lifter)
    outcome = run(about, tmp_path, workers=1)
    assert (len(outcome.done), outcome.failed) == (4, {})
    expected = np.average(
        [facts["methods"]["lift"]["mpjpe_rr_mm"] for facts in outcome.done.values()],
        weights=[18 if facts["take"] == "Action 1" else 30 for facts in outcome.done.values()],
    )
    found = row(table_of(about, outcome)["human36m"], "lift, ours")
    assert found["MPJPE, root-relative [mm]"] == pytest.approx(expected)


# --- jobs ----------------------------------------------------------------------------------------


def test_the_protocol_is_the_papers_where_nothing_else_is_asked_for(root: Path, lifter: Path) -> None:
    usual = Human36MProtocol(root, lifter)
    assert (usual.subjects, usual.cameras, usual.modes) == (SUBJECTS, (0, 1, 2, 3), ("lift", "rto"))
    assert len(usual.jobs()) == 2 * 2 * 4


def test_a_lifter_may_be_named(root: Path) -> None:
    named = Human36MProtocol(root, Path("perfect")).settings()["lifter_sha256"]
    assert named == hashlib.sha256(model_path("lifter_perfect.pt").read_bytes()).hexdigest()


def test_an_action_is_found_with_and_without_its_number(root: Path, lifter: Path) -> None:
    def actions(*names: str) -> set[str]:
        return {job.action for job in protocol(root, lifter, actions=names).jobs().values()}

    assert actions("Action 1") == {"Action 1"}
    assert actions("Action") == actions() == {"Action 0", "Action 1"}


def test_two_processes_give_the_same_as_one_and_nothing_is_measured_again(
    root: Path, lifter: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = protocol(root, lifter, actions=("Action 1",))
    two = run(about, tmp_path / "two", workers=2)
    one = run(about, tmp_path / "one", workers=1)
    assert facts_of(two) == facts_of(one)
    monkeypatch.setattr(human36m, "measure", None)
    assert run(about, tmp_path / "two", workers=1).done == two.done


def test_detected_keypoints_are_used_where_they_are_named(root: Path, lifter: Path, tmp_path: Path) -> None:
    about = protocol(root, lifter, actions=("Action 1",), subjects=("S9",))
    exact = run(about, tmp_path / "exact", workers=1)
    detected = replace(about, keypoints="cpn_ft_h36m_dbb")
    outcome = run(detected, tmp_path / "detected", workers=1)
    (a,), (b,) = facts_of(exact).values(), facts_of(outcome).values()
    assert a["methods"]["lift"] != b["methods"]["lift"]
    assert a["methods"][STILL] == b["methods"][STILL]
    assert "2D of cpn_ft_h36m_dbb" in table_of(detected, outcome)["human36m"].notes[0]


# --- what is damaged or not there ----------------------------------------------------------------


def test_a_damaged_action_stops_no_other_and_is_told(lifter: Path, tmp_path: Path) -> None:
    positions: dict[str, dict[str, Any]] = dict(archive(tmp_path))
    positions["S9"] = positions["S9"] | {"Action 0": np.zeros((30, 5))}
    h36m.write_positions(tmp_path, positions)
    about = protocol(tmp_path, lifter)
    outcome = run(about, tmp_path / "out", workers=1)
    assert list(outcome.done) == ["S9_Action_1_cam0", "S11_Action_0_cam0", "S11_Action_1_cam0"]
    tables = table_of(about, outcome)
    note = tables["human36m"].notes[1]
    assert note == "INCOMPLETE, without 1 recordings: see the last table."
    ((where, what, message),) = tables["state_of_data"].rows
    assert (where, what) == ("S9_Action_0_cam0", "not measured")
    assert "data_3d_h36m.npz" in str(message)


def test_a_subject_that_the_archive_does_not_have_is_told(lifter: Path, tmp_path: Path) -> None:
    archive(tmp_path, ("S9",))
    about = protocol(tmp_path, lifter)
    outcome = run(about, tmp_path / "out", workers=1)
    assert len(outcome.done) == 2
    tables = table_of(about, outcome)
    assert tables["human36m"].notes[1] == "INCOMPLETE, without any of S11: see the last table."
    assert tables["state_of_data"].rows == (
        ("S11", "not measured", "the archive of positions has no such subject"),
    )
    with pytest.raises(FileFormatError, match="has no action by S11"):
        protocol(tmp_path, lifter, subjects=("S11",)).jobs()


def test_a_truth_in_the_wrong_place_is_measured_and_told(lifter: Path, tmp_path: Path) -> None:
    """As a few actions of S9 are: detected keypoints fit all but one of them."""
    positions = archive(tmp_path)
    h36m.write_positions(tmp_path, {"S9": positions["S9"] | {"Action 1": positions["S9"]["Action 1"] + 0.4}})
    about = protocol(tmp_path, lifter, subjects=("S9",), keypoints="cpn_ft_h36m_dbb")
    outcome = run(about, tmp_path / "out", workers=1)
    assert len(outcome.done) == 2
    ((where, what, message),) = table_of(about, outcome)["state_of_data"].rows
    assert (where, what) == ("S9_Action_1_cam0", "note")
    assert "this truth stands in the wrong place" in str(message)


# --- bad input -----------------------------------------------------------------------------------

BAD = {
    "an unknown subject": (["--subjects", "S2"], "unknown subject 'S2'"),
    "one of two subjects unknown": (["--subjects", "S9,S10"], "unknown subject 'S10'"),
    "no subject": (["--subjects", ""], "subjects: none are named"),
    "a misspelt action": (
        ["--actions", "Action 1,Acton 0"],
        "unknown action 'Acton 0'. Did you mean 'Action 0'?",
    ),
    "a camera that is not": (["--cameras", "4"], "unknown camera '4'"),
    "a mode with sensors": (["--modes", "rtof"], "unknown mode without sensors 'rtof'"),
    "no mode": (["--modes", ""], "modes: none are named"),
    "no lifter": (["--lifter", "{tmp}/none.pt"], "none.pt: no such file; train a lifter"),
    "no archives": (["--root", "{tmp}"], "data_3d_h36m.npz"),
    "a folder for the JSON": (["--json", "{tmp}"], "is a folder; name a file"),
    "no worker": (["--workers", "0"], "workers: 0 processes do no work"),
}


@pytest.fixture
def unpictured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "write_pictures", lambda *about: [])


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize("bad", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(
    bad: str, root: Path, lifter: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, expected = BAD[bad]
    out = tmp_path.with_name(f"{tmp_path.name}_out")
    arguments = ["human36m", "--root", str(root), "--lifter", str(lifter), "-o", str(out)]
    assert main([*arguments, *(text.replace("{tmp}", str(tmp_path)) for text in given)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert expected in lines[0]
    assert not (out / "runs").exists() or not list((out / "runs").iterdir())
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize(
    "options, expected",
    [
        (["--keypoints", "hrnet"], "unknown keypoints"),
        (["--cameras-file", "{tmp}/none.json"], "none.json"),
        (["--lifter", "{tmp}/21.pt"], "joint"),
    ],
)
def test_what_only_the_measurement_finds_out_is_an_error_too(
    options: list[str],
    expected: str,
    root: Path,
    lifter: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    made = untrained_lifter(rate_hz=50.0)
    save_checkpoint(tmp_path / "21.pt", made.network, made.description)
    arguments = ["human36m", "--root", str(root), "--lifter", str(lifter), "--modes", "lift",
                 "--workers", "1", "-o", str(tmp_path / "out")]  # fmt: skip
    assert main([*arguments, *(text.replace("{tmp}", str(tmp_path)) for text in options)]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("error: ")
    assert expected in message


def test_a_protocol_in_python_is_checked_as_well(root: Path, lifter: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown camera '7'"):
        protocol(root, lifter, cameras=(0, 7))
    with pytest.raises(FileFormatError, match="rtof-kin train --human36m"):
        protocol(root, root / "none.pt")


def test_help_and_the_example_are_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["human36m", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for option in ("--root", "--lifter", "--cameras-file", "--keypoints", "--subjects", "--actions",
                   "--cameras", "--modes", "--save", "--json", "--workers", "--overwrite"):  # fmt: skip
        assert option in text
    example = Path(__file__).parents[2] / "examples" / "human36m.py"
    monkeypatch.setattr(sys, "argv", [str(example), "--help"])
    with pytest.raises(SystemExit):
        runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out == text
