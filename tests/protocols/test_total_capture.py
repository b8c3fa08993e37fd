"""The protocol on Total Capture, from files in its formats to tables, figures and motions."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import total_capture_support as tc
from detector_support import flat, points_px
from lifting_support import TABLE_17, untrained_lifter
from protocol_support import cells_of, facts_of, read_json, row
from scipy import signal

from benchmarks.total_capture_motion import cameras
from benchmarks.total_capture_standin import StandInTake, write_detections
from lifting.checkpoint import save_checkpoint
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.cli import main
from rtof_kin.core.errors import FileFormatError, OutputExistsError, ShapeError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.datasets.total_capture import TotalCapture
from rtof_kin.formats.motion_npz import read_motion_npz
from rtof_kin.protocols import pictures, published, total_capture
from rtof_kin.protocols.jobs import Outcome
from rtof_kin.protocols.tables import Table
from rtof_kin.protocols.total_capture import (
    CAMERAS,
    LOW_PASSED,
    SENSOR_SETS,
    SIXTEEN,
    STILL,
    TEST_TAKES,
    TotalCaptureProtocol,
    length_name,
    run,
    weight_name,
)
from rtof_kin.protocols.total_capture_tables import all_tables
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.vision.layouts import detector_table

NAMES = SkeletonModel.default().names
MODES = ("lift", "rto", "sf2", "rtof")
WALKING = tc.take("S1", "walking2", noisy=True)
ACTING = tc.take("S5", "acting3", noisy=True, frames=36)
"""Takes of different length."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two takes; S1 acting3 and S5 walking2 are not there."""
    folder = tmp_path_factory.mktemp("total_capture")
    tc.dataset(folder, WALKING, ACTING)
    return folder


@dataclass(frozen=True)
class Measured:
    """What the command left."""

    out: Path
    save: Path
    json: Path
    printed: str
    told: str

    def arguments(self, root: Path) -> list[str]:
        return ["total-capture", "--root", str(root), "--subjects", "s1,s5", "--takes",
                "Walking2,acting3", "--cameras", "1", "--no-studies", "--space", "cartesian",
                "--workers", "1",
                "-o", str(self.out), "--save", str(self.save), "--json", str(self.json)]  # fmt: skip


@pytest.fixture(scope="module")
def measured(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """Both takes from camera 1 in every mode, by the command, with everything it can write.

    In the space whose problems need not be compiled, which takes half a minute the first time.
    """
    folder = tmp_path_factory.mktemp("measured")
    result = Measured(folder / "out", folder / "motions", folder / "deep" / "all.json", "", "")
    printed, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(told):
        assert main(result.arguments(root)) == 0
    return replace(result, printed=printed.getvalue(), told=told.getvalue())


@pytest.fixture
def unpictured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest."""
    monkeypatch.setattr(pictures, "write_pictures", lambda *about: [])


def protocol(root: Path, **changed: Any) -> TotalCaptureProtocol:
    """The lifter alone on both takes from cameras 1 and 3, which is quick."""
    usual: dict[str, Any] = {"subjects": ("S1", "S5"), "takes": ("walking2", "acting3")}
    usual |= {"cameras": (1, 3), "modes": ("lift",), "studies": False}
    return TotalCaptureProtocol(root, **(usual | changed))


def tables_of(about: TotalCaptureProtocol, outcome: Outcome) -> dict[str, Table]:
    """Every table by its name."""
    return {table.name: table for table in all_tables(about, outcome)}


def figures(outcome: Outcome) -> dict[str, dict[str, Any]]:
    """What was measured of every mode, by job."""
    return {key: facts["methods"] for key, facts in facts_of(outcome).items() if facts["camera"] is not None}


# --- by hand -------------------------------------------------------------------------------------


def position(measured: Measured, take: StandInTake, mode: str) -> np.ndarray:
    """The joints (T, J, 3) m that were saved."""
    path = measured.save / take.subject / take.name / "cam1" / mode / "motion.npz"
    return read_motion_npz(path).poses.p_world_joint


def truth(root: Path, take: StandInTake) -> np.ndarray:
    """The joints (T, J, 3) m as they are in the files, rounded."""
    p = TotalCapture(root).take(take.subject, take.name).truth.p_world_joint
    np.testing.assert_allclose(p, take.poses.p_world_joint, atol=1e-5)
    return p


def by_hand(p: np.ndarray, p_true: np.ndarray) -> dict[str, float]:
    """The figures of joints (T, J, 3) m, as their definitions say."""
    error = p - p_true

    def mean(difference: np.ndarray) -> float:
        return float(np.linalg.norm(difference, axis=-1).mean())

    sixteen = error[::16][:, [NAMES.index(name) for name in SIXTEEN]]
    return {
        "mpjpe_mm": 1000 * mean(error),
        "mpjpe_rr_mm": 1000 * mean(error - error[:, :1]),
        "mpjae": mean(error[2:] - 2 * error[1:-1] + error[:-2]) * 60**2,
        "mpjje": mean(error[3:] - 3 * error[2:-1] + 3 * error[1:-2] - error[:-3]) * 60**3,
        "sixteen_mm": 1000 * mean(sixteen),
        "frames": len(p),
        "sixteen_frames": len(sixteen),
    }


def rows_of(measured: Measured) -> dict[tuple[str, int | None, str], dict[str, Any]]:
    """The rows of the JSON by subject, camera and method."""
    rows = read_json(measured.json)["rows"]
    found = {(one["subject"], one["camera"], one["method"]): one for one in rows}
    assert len(found) == len(rows)
    return found


@pytest.mark.parametrize("mode", MODES)
def test_the_figures_are_those_of_the_saved_motions(mode: str, root: Path, measured: Measured) -> None:
    rows = rows_of(measured)
    for take in (WALKING, ACTING):
        expected = by_hand(position(measured, take, mode), truth(root, take))
        if mode == "lift":  # what is scored are the lifter's points, what is saved a skeleton's
            expected = {name: expected[name] for name in ("frames", "sixteen_frames")}
        found = rows[take.subject, 1, mode]
        assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-6)


def test_the_rows_of_no_motion_and_of_the_truth_low_passed_are_those_by_hand(
    root: Path, measured: Measured
) -> None:
    rows = rows_of(measured)
    sos = signal.butter(2, 6.0, fs=60.0, output="sos")
    for take in (WALKING, ACTING):
        p = truth(root, take)
        still = by_hand(np.broadcast_to(p.mean(axis=0), p.shape), p)
        smooth = by_hand(signal.sosfiltfilt(sos, p, axis=0, padlen=30), p)
        for method, expected in {STILL: still, LOW_PASSED: smooth}.items():
            found = rows[take.subject, None, method]
            assert {n: found[n] for n in expected} == pytest.approx(expected, rel=1e-6)
            assert (found["angle_deg"] is None) == (method == LOW_PASSED)  # the truth's own rotations


def test_a_mean_over_takes_is_one_over_all_their_frames(root: Path, measured: Measured) -> None:
    tables = read_json(measured.json)["tables"]
    p = np.concatenate([position(measured, take, "rtof") for take in (WALKING, ACTING)])
    p_true = np.concatenate([truth(root, take) for take in (WALKING, ACTING)])
    error = 1000 * np.linalg.norm(p - p_true, axis=-1)
    relative = 1000 * np.linalg.norm(p - p[:, :1] - p_true + p_true[:, :1], axis=-1)
    cells = {cells[0]: cells for cells in tables["by_take"]["rows"]}
    assert cells["rtof, ours, absolute"][-1] == pytest.approx(error.mean(), rel=1e-6)
    assert cells["rtof, ours, root-relative"][-1] == pytest.approx(relative.mean(), rel=1e-6)
    count = len(WALKING.poses)
    assert cells["rtof, ours, absolute"][1:7] == [
        pytest.approx(error[:count].mean(), rel=1e-6), None, None,
        None, pytest.approx(error[count:].mean(), rel=1e-6), None,
    ]  # fmt: skip
    index = [NAMES.index(name) for name in SIXTEEN]
    own = np.concatenate([error[:count][::16], error[count:][::16]])[:, index]
    sixteen = {cells[0]: cells[1] for cells in tables["sixteen_joints"]["rows"]}
    assert sixteen["rtof, ours, each camera alone"] == pytest.approx(own.mean(), rel=1e-6)


def test_the_sixteen_joints_are_those_of_the_multi_view_papers() -> None:
    """Root, legs, belly, neck, head, arms: without the spine's inner joints and the shoulder girdle."""
    left_out = {"Spine1", "Spine2", "Spine3", "RightShoulder", "LeftShoulder"}
    assert len(set(SIXTEEN)) == len(SIXTEEN) == 16
    assert set(NAMES) - set(SIXTEEN) == left_out


def test_the_protocol_is_the_papers_where_nothing_else_is_asked_for() -> None:
    usual = TotalCaptureProtocol(Path("data"))
    assert usual.takes == TEST_TAKES == ("walking2", "acting3", "freestyle3")
    assert usual.cameras == CAMERAS == (1, 3, 4, 5, 6, 7, 8)
    assert set(usual.modes) == set(MODES)
    assert len(usual.jobs()) == 15 * (7 + 1)
    known = SkeletonModel.default().sensors
    for count, sensors in SENSOR_SETS.items():
        assert len(set(sensors)) == len(sensors) == int(count)
        assert set(sensors) <= set(known)
    joints = {known[sensor][0] for sensor in usual.sensors}
    assert joints == {f"{side}{limb}" for side in ("Left", "Right")
                      for limb in ("Arm", "ForeArm", "UpLeg", "Leg")}  # fmt: skip


# --- what the command leaves ---------------------------------------------------------------------


def test_every_take_and_mode_has_its_motion(measured: Measured) -> None:
    found = {str(path.relative_to(measured.save)) for path in measured.save.rglob("*.npz")}
    assert found == {
        f"{take}/cam1/{mode}/motion.npz" for take in ("S1/walking2", "S5/acting3") for mode in MODES
    }
    for name in found:
        motion = read_motion_npz(measured.save / name)
        assert motion.mode == name.split("/")[3]
        take = WALKING if name.startswith("S1") else ACTING
        np.testing.assert_allclose(motion.joint_offsets, take.joint_offsets, atol=1e-4)
        np.testing.assert_allclose(motion.poses.times, take.poses.times)
        p, _ = motion.motion().skeleton.forward_kinematics(motion.q)
        np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)


def test_the_json_has_settings_rows_and_what_the_tables_show(measured: Measured) -> None:
    content = read_json(measured.json)
    assert measured.json.read_bytes() == (measured.out / "tables.json").read_bytes()
    settings = content["settings"]
    assert (settings["subjects"], settings["takes"]) == (["S1", "S5"], ["walking2", "acting3"])
    assert settings["sensors"] == list(SENSOR_SETS["8"])
    assert re.fullmatch("[0-9a-f]{64}", settings["lifter_sha256"])
    kept = read_json(measured.out / "settings.json")
    assert {name: kept[name] for name in settings} == settings
    assert len(content["rows"]) == 2 * (len(MODES) + 2)
    assert set(content["failed"]) == {
        "S1_acting3", "S1_acting3_cam1", "S5_walking2", "S5_walking2_cam1",
    }  # fmt: skip
    text = (measured.out / "tables.md").read_text()
    parts = re.split(r"^### ", text, flags=re.MULTILINE)[1:]
    assert len(parts) == len(content["tables"]) == 5
    for part, table in zip(parts, content["tables"].values(), strict=True):
        head, *body = cells_of("### " + part)
        assert part.startswith(table["title"])
        assert head == table["columns"]
        for cells, shown in zip(table["rows"], body, strict=True):
            for cell, what in zip(cells, shown, strict=True):
                if cell is None:
                    assert what == "-"
                elif isinstance(cell, str):
                    assert what == " ".join(cell.split())
                else:
                    assert float(what) == pytest.approx(cell, abs=0.5)
        assert all(f"- {note}\n" in part for note in table["notes"])


def test_what_is_printed_has_every_figure_whole_and_every_unit(measured: Measured) -> None:
    """On a narrow terminal too, where a table would otherwise be cut."""
    content = read_json(measured.json)
    assert "…" not in measured.printed
    for unit in ("[mm]", "[m/s2]", "[m/s3]", "[deg]"):
        assert unit in measured.printed
    text = (measured.out / "tables.md").read_text()
    for part in re.split(r"^### ", text, flags=re.MULTILINE)[1:5]:
        for cells in cells_of("### " + part)[1:]:
            figures = [re.escape(cell) for cell in cells[1:]]
            assert re.search(r"│ +" + r" │ +".join(figures) + r" │", measured.printed), cells
    for table in content["tables"].values():
        assert all(note in measured.printed for note in table["notes"])
    assert "wrote " in measured.printed


def test_the_progress_names_what_failed_once(measured: Measured) -> None:
    assert measured.told.count("S1_acting3_cam1 failed: unknown take") == 1
    assert "8/8" in measured.told


def test_the_figures_show_every_mode(measured: Measured) -> None:
    for name, least in {"error_curves": 500, "skeletons": 700}.items():
        pixels = matplotlib.image.imread(measured.out / "figures" / f"{name}.png")
        assert pixels.shape[0] > least
        assert len(np.unique(pixels[::4, ::4].reshape(-1, pixels.shape[-1]), axis=0)) > 50


def test_fusion_beats_the_baseline_on_a_stand_in(measured: Measured) -> None:
    rows = rows_of(measured)
    for subject in ("S1", "S5"):
        errors = {mode: rows[subject, 1, mode]["mpjpe_rr_mm"] for mode in MODES}
        assert errors["rtof"] < errors["sf2"] < errors["lift"]


def test_a_take_that_is_not_there_is_named_under_every_affected_table(measured: Measured) -> None:
    tables = read_json(measured.json)["tables"]
    for name in ("by_take", "inertial_only", "ablation", "sixteen_joints"):
        assert any(
            note.startswith("INCOMPLETE, without: S1 acting3; S5 walking2.") for note in tables[name]["notes"]
        )
    state = {tuple(cells[:2]) for cells in tables["state_of_data"]["rows"]}
    assert {("S1 acting3", "not measured"), ("S5 walking2", "not measured")} <= state


# --- going on ------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unpictured")
def test_the_same_command_measures_nothing_again_and_gives_the_same_tables(
    root: Path, measured: Measured, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = measured.json.read_bytes(), (measured.out / "tables.md").read_bytes()

    def again(*about: Any) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(total_capture, "_seen_by", again)
    monkeypatch.setattr(total_capture, "_reference", again)
    assert main(measured.arguments(root)) == 0
    assert (measured.json.read_bytes(), (measured.out / "tables.md").read_bytes()) == before


@pytest.mark.usefixtures("unpictured")
def test_other_settings_are_refused_by_name(
    root: Path, measured: Measured, capsys: pytest.CaptureFixture[str]
) -> None:
    before = measured.json.read_bytes()
    arguments = [*measured.arguments(root), "--sensors", "10", "--noise-px", "2", "--seed", "5"]
    assert main([*arguments, "--space", "joint"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "holds results of other settings (noise_px, seed, sensors, space)" in line
    assert measured.json.read_bytes() == before


@pytest.mark.usefixtures("unpictured")
def test_an_interrupted_command_goes_on_where_it_stopped(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run(protocol(root), tmp_path / "whole", workers=1)
    out = tmp_path / "out"
    arguments = ["total-capture", "--root", str(root), "--subjects", "S1,S5", "--modes", "lift",
                 "--takes", "walking2,acting3", "--cameras", "1,3", "--no-studies", "-o", str(out),
                 "--workers", "1"]  # fmt: skip
    measure, called = total_capture._seen_by, []

    def until_somebody_interrupts(*about: Any) -> Any:
        called.append(about[1:])
        if len(called) == 2:
            raise KeyboardInterrupt
        return measure(*about)

    monkeypatch.setattr(total_capture, "_seen_by", until_somebody_interrupts)
    assert main(arguments) == 130
    assert "interrupted" in capsys.readouterr().err
    kept = sorted(path.name for path in (out / "runs").glob("*.json"))
    assert kept == ["S1_walking2.json", "S1_walking2_cam1.json"]
    assert not (out / "tables.md").exists()
    assert main(arguments) == 0
    assert [about[1] for about in called] == [1, 3, 3, 1, 3]
    assert read_json(out / "tables.json")["rows"] == read_json_of(whole)


def read_json_of(outcome: Outcome) -> list[dict[str, Any]]:
    """Rows of an outcome as they are read back from JSON."""
    from rtof_kin.protocols.measures import rows_of

    return json.loads(json.dumps(list(rows_of(outcome))))


def test_motions_can_be_asked_for_later(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    about = protocol(root, cameras=(1,))
    first = run(about, tmp_path / "out", workers=1)
    saving = replace(about, save=tmp_path / "motions")
    again = run(saving, tmp_path / "out", workers=1)
    assert facts_of(again) == facts_of(first)
    found = sorted(str(p.relative_to(saving.save)) for p in saving.save.rglob("*.npz"))
    assert found == ["S1/walking2/cam1/lift/motion.npz", "S5/acting3/cam1/lift/motion.npz"]

    monkeypatch.setattr(total_capture, "_seen_by", None)  # both are there
    assert run(saving, tmp_path / "out", workers=1).done == again.done
    monkeypatch.undo()
    (saving.save / found[0]).unlink()
    run(saving, tmp_path / "out", workers=1)
    assert (saving.save / found[0]).is_file()


def test_overwriting_measures_everything_again(root: Path, tmp_path: Path) -> None:
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(1,))
    run(about, tmp_path, workers=1)
    noisy = replace(about, noise_px=5.0)
    with pytest.raises(OutputExistsError, match=r"\(noise_px\)"):
        run(noisy, tmp_path, workers=1)
    outcome = run(noisy, tmp_path, overwrite=True, workers=1)
    fresh = run(noisy, tmp_path / "fresh", workers=1)
    assert facts_of(outcome) == facts_of(fresh)


# --- the same seed gives the same table ----------------------------------------------------------


@pytest.fixture(scope="module")
def noisy(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """Both takes with noise of seed 3 from cameras 1 and 3."""
    return run(protocol(root, noise_px=4.0, seed=3), tmp_path_factory.mktemp("noisy"), workers=1)


def test_neither_order_nor_company_changes_the_noise_of_a_camera(
    root: Path, tmp_path: Path, noisy: Outcome
) -> None:
    about = protocol(root, noise_px=4.0, seed=3, cameras=(6, 3, 1), takes=("acting3", "walking2"))
    more = run(replace(about, subjects=("S5", "S1")), tmp_path / "more", workers=1)
    assert figures(noisy).items() <= figures(more).items()
    few = run(replace(about, cameras=(3,), subjects=("S5",)), tmp_path / "few", workers=1)
    assert figures(few) == {"S5_acting3_cam3": figures(noisy)["S5_acting3_cam3"]}


def test_two_processes_and_a_resumed_run_give_the_same_as_one(
    root: Path, tmp_path: Path, noisy: Outcome
) -> None:
    about = protocol(root, noise_px=4.0, seed=3)
    two = run(about, tmp_path, workers=2)
    assert facts_of(two) == facts_of(noisy)
    assert two.failed == noisy.failed
    for name, values in noisy.arrays("S1_walking2_cam3").items():
        np.testing.assert_array_equal(two.arrays("S1_walking2_cam3")[name], values)
    (tmp_path / "runs" / "S1_walking2_cam3.json").unlink()
    resumed = run(about, tmp_path, workers=1)
    assert facts_of(resumed) == facts_of(noisy)
    ours = [table.markdown() for table in all_tables(about, resumed)]
    assert ours == [table.markdown() for table in all_tables(about, noisy)]


def test_another_seed_and_no_noise_are_something_else(root: Path, tmp_path: Path, noisy: Outcome) -> None:
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(1,))
    key, errors = "S1_walking2_cam1", set()
    for k, changed in enumerate(({"noise_px": 4.0, "seed": 4}, {"seed": 3}, {"seed": 4})):
        outcome = run(replace(about, **changed), tmp_path / str(k), workers=1)
        errors.add(figures(outcome)[key]["lift"]["mpjpe_rr_mm"])
    errors.add(figures(noisy)[key]["lift"]["mpjpe_rr_mm"])
    assert len(errors) == 3  # without noise the seed means nothing


# --- what is damaged or not there ----------------------------------------------------------------


def test_a_damaged_take_stops_no_other_and_is_told_under_every_table(tmp_path: Path) -> None:
    data = tmp_path / "data"
    paths = tc.dataset(data, WALKING, ACTING)  # the paths of the last
    lines = tc.lines(paths["positions"])
    paths["positions"].write_text("".join([*lines[:5], "broken\n", *lines[6:]]))
    about = protocol(data, modes=("lift", "sf2"), takes=("walking2", "acting3"))
    about = replace(about, subjects=("S1", "S5"))
    outcome = run(about, tmp_path / "out", workers=1)
    assert set(outcome.done) == {"S1_walking2", "S1_walking2_cam1", "S1_walking2_cam3"}
    tables = tables_of(about, outcome)
    for name in ("by_take", "inertial_only", "ablation", "sixteen_joints"):
        (sentence,) = [note for note in tables[name].notes if note.startswith("INCOMPLETE")]
        assert "S5 acting3" in sentence
    state = {cells[0]: cells for cells in tables["state_of_data"].rows if cells[1] != "note"}
    assert state["S5 acting3"][1] == "not measured"
    assert "gt_skel_gbl_pos.txt, line 6" in str(state["S5 acting3"][2])
    assert not any("S5 acting3 camera" in name for name in state)  # said once, not for every camera


def test_a_take_that_was_mended_is_measured_by_the_next_run(tmp_path: Path) -> None:
    data = tmp_path / "data"
    paths = tc.dataset(data, WALKING)
    whole = paths["positions"].read_bytes()
    paths["positions"].write_bytes(whole[: len(whole) // 2])
    about = protocol(data, subjects=("S1",), takes=("walking2",))
    assert not run(about, tmp_path / "out", workers=1).done
    paths["positions"].write_bytes(whole)
    outcome = run(about, tmp_path / "out", workers=1)
    assert (len(outcome.done), outcome.failed) == (3, {})


def test_a_take_without_sensors_still_has_the_modes_that_need_none(tmp_path: Path) -> None:
    data = tmp_path / "data"
    paths = tc.dataset(data, WALKING, ACTING)
    for kind in ("sensors", "aux", "ref", "bone"):
        paths[kind].unlink()
    about = protocol(data, modes=("lift", "sf2"), cameras=(1,), save=tmp_path / "motions")
    outcome = run(about, tmp_path / "out", workers=1)
    methods = {key: set(figures) for key, figures in figures(outcome).items()}
    assert methods == {"S1_walking2_cam1": {"lift", "sf2"}, "S5_acting3_cam1": {"lift"}}
    tables = tables_of(about, outcome)
    for name in ("by_take", "inertial_only", "ablation", "sixteen_joints"):
        (sentence,) = [note for note in tables[name].notes if note.startswith("INCOMPLETE")]
        assert "S5 acting3 (sf2)" in sentence
    told = [cells for cells in tables["state_of_data"].rows if cells[0] == "S5 acting3 camera 1"]
    (note,) = [str(cells[2]) for cells in told]
    assert "sf2 and rtof are left out, without the sensors L_UpArm" in note
    # What no run could write is not waited for.
    before = (tmp_path / "out/runs/S5_acting3_cam1.json").stat().st_mtime_ns
    run(about, tmp_path / "out", workers=1)
    assert (tmp_path / "out/runs/S5_acting3_cam1.json").stat().st_mtime_ns == before


def test_one_sensor_that_is_missing_costs_only_the_modes_that_need_it(tmp_path: Path) -> None:
    data = tmp_path / "data"
    paths = tc.dataset(data, ACTING)
    for kind in ("ref", "bone"):
        (line,) = [text for text in tc.lines(paths[kind]) if text.startswith("R_LowLeg")]
        tc.edit(paths[kind], line, "")
        tc.edit(paths[kind], "13", "12")
    about = protocol(data, subjects=("S5",), takes=("acting3",), modes=("lift", "sf2"), cameras=(1,))
    outcome = run(about, tmp_path / "out", workers=1)
    assert set(figures(outcome)["S5_acting3_cam1"]) == {"lift"}
    (note,) = outcome.done["S5_acting3_cam1"]["notes"]
    assert note.endswith("without the sensors R_LowLeg")
    fewer = replace(about, sensors=("L_LowLeg", "L_UpLeg"))
    outcome = run(fewer, tmp_path / "fewer", workers=1)
    assert set(figures(outcome)["S5_acting3_cam1"]) == {"lift", "sf2"}


@pytest.mark.usefixtures("unpictured")
def test_without_cameras_there_is_nothing_to_measure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    tc.dataset(data, WALKING)["cameras"].unlink()
    arguments = ["--root", str(data), "--subjects", "S1", "--takes", "walking2", "--cameras", "1"]
    options = ["--no-studies", "--modes", "lift", "--workers", "1", "-o", str(tmp_path / "out")]
    assert main(["total-capture", *arguments, *options]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("error: nothing could be measured; first of all: ")
    assert "calibration.cal" in message
    tables = read_json(tmp_path / "out" / "tables.json")["tables"]
    assert tables["inertial_only"]["rows"][-1][0] == LOW_PASSED
    assert tables["inertial_only"]["rows"][-1][1] is not None  # for that no camera is needed


def test_a_glitch_of_the_reference_does_not_reach_the_low_passed_row(tmp_path: Path) -> None:
    """Frames 655 to 659 of S4 acting3 are one; a filter would smear it over the frames beside."""
    take = tc.take("S4", "acting3", frames=690)
    about = protocol(tmp_path, subjects=("S4",), takes=("acting3",))
    job = replace(about.jobs()["S4_acting3"])
    rows = {}
    for name in ("steady", "jumping"):
        p = np.array(take.poses.p_world_joint)
        if name == "jumping":
            p[655:660] += [0.8, 0.0, 0.3]
        poses = replace(take.poses, p_world_joint=p)
        tc.dataset(tmp_path / name, replace(take, poses=poses), bvh=False)
        facts = total_capture.measure(replace(job, protocol=replace(about, root=tmp_path / name))).facts
        rows[name] = facts["methods"][LOW_PASSED]
    assert rows["jumping"]["frames"] == len(take.poses) - 9  # with two frames on either side
    for figure in ("mpjpe_mm", "mpjae", "mpjje"):
        assert rows["jumping"][figure] == pytest.approx(rows["steady"][figure], rel=0.02)


def test_checks_of_the_files_that_fail_are_told(tmp_path: Path) -> None:
    data = tmp_path / "data"
    turned = replace(
        WALKING, poses=replace(WALKING.poses, p_world_joint=WALKING.poses.p_world_joint[::-1],
                               R_world_bone=WALKING.poses.R_world_bone[::-1])
    )  # fmt: skip
    tc.dataset(data, turned)
    about = protocol(data, subjects=("S1",), takes=("walking2",), cameras=(1,))
    outcome = run(about, tmp_path / "out", workers=1)
    (state,) = [t for t in all_tables(about, outcome) if t.name == "state_of_data"]
    failed = [str(cells[2]) for cells in state.rows if cells[1] == "check failed"]
    assert any("T-pose" in message for message in failed)


# --- detections, cameras, sensors, spaces --------------------------------------------------------


@pytest.fixture(scope="module")
def detections(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector's 2D of S1 walking2 in cameras 1 and 2, and none of camera 3."""
    folder = tmp_path_factory.mktemp("detector")
    for number in (1, 2):
        write_detections(folder, WALKING, number, cameras()[number], seed=0)
    return folder


def test_detections_are_used_and_those_that_are_not_there_told(
    root: Path, detections: Path, tmp_path: Path
) -> None:
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(1, 2, 3))
    exact = run(about, tmp_path / "exact", workers=1)
    about = replace(about, keypoints=detections)
    outcome = run(about, tmp_path / "out", workers=1)
    assert set(outcome.failed) == {"S1_walking2_cam3"}
    assert "no detections of S1 walking2 camera 3" in outcome.failed["S1_walking2_cam3"]
    key = "S1_walking2_cam1"
    assert figures(outcome)[key] != figures(exact)[key]
    tables = tables_of(about, outcome)
    assert f"the detections in {detections.name}" in tables["by_take"].notes[0]
    assert "S1 walking2 (camera 3)" in tables["by_take"].notes[1]


@pytest.mark.usefixtures("unpictured")
def test_a_detectors_own_files_are_measured_with_their_layout_and_a_lifter_by_its_name(
    root: Path, tmp_path: Path
) -> None:
    """MediaPipe's 33 in a CSV, BODY_25 in OpenPose's folder of JSON, COCO's 17 in an .npz."""
    folder, (mediapipe, body25, coco) = tmp_path / "detector", (1, 3, 4)
    own = folder / "S1" / "walking2"
    body = SkeletonModel.default().with_offsets(WALKING.joint_offsets)
    walking = body.motion(WALKING.poses)
    uv = {
        number: points_px(layout, walking, cameras()[number])
        for layout, number in (("mediapipe33", mediapipe), ("body25", body25), ("coco17", coco))
    }
    (own / f"cam{body25}").mkdir(parents=True)
    named = [f"{name}_{c}" for name in detector_table().layout("mediapipe33").names for c in "xy"]
    table = uv[mediapipe].reshape(len(uv[mediapipe]), -1)
    np.savetxt(own / f"cam{mediapipe}.csv", table, delimiter=",", header=",".join(named), comments="")
    for frame, points in enumerate(uv[body25]):
        text = json.dumps({"people": [{"pose_keypoints_2d": flat(points)}]})
        (own / f"cam{body25}" / f"walk_{frame:012d}_keypoints.json").write_text(text)
    np.savez(folder / f"TC_S1_walking2_cam{coco}.npz", keypoints=uv[coco])
    arguments = ["total-capture", "--root", str(root), "--subjects", "S1", "--takes", "walking2",
                 "--cameras", ",".join(map(str, uv)), "--modes", "lift", "--workers", "1",
                 "--keypoints", str(folder), "--layout", "auto", "--lifter", "perfect",
                 "-o", str(tmp_path / "out"), "--json", str(tmp_path / "all.json")]  # fmt: skip
    assert main(arguments) == 0
    found = read_json(tmp_path / "all.json")
    assert found["failed"] == {}
    assert {row["camera"] for row in found["rows"] if row["method"] == "lift"} == set(uv)
    for number in uv:  # the landmarks lie where the reference has them
        facts = read_json(tmp_path / "out" / "runs" / f"S1_walking2_cam{number}.json")
        assert facts["failed_checks"] == []
    perfect = model_path("lifter_perfect.pt").read_bytes()
    assert found["settings"]["lifter_sha256"] == hashlib.sha256(perfect).hexdigest()
    assert found["settings"]["layout"] == "auto"


def test_camera_2_is_measured_and_said_to_be_miscalibrated(
    root: Path, detections: Path, tmp_path: Path
) -> None:
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(2,), keypoints=detections)
    outcome = run(about, tmp_path / "out", workers=1)
    (facts,) = [facts for facts in outcome.done.values() if facts["camera"] == 2]
    assert facts["methods"]["lift"]["mpjpe_rr_mm"] > 0
    assert any("camera 2 is miscalibrated" in text for text in [
        message[0].lower() + message[1:] for check in facts["failed_checks"]
        for message in [check.split(". ")[-1]]
    ])  # fmt: skip
    (state,) = [t for t in all_tables(about, outcome) if t.name == "state_of_data"]
    assert any(cells[0] == "S1 walking2 camera 2" for cells in state.rows)


def test_detections_of_another_take_fail_a_check(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "detector"
    other = replace(tc.take("S5", "acting3", seed=9), subject="S1", name="walking2")
    write_detections(folder, other, 1, cameras()[1], seed=0)
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(1,), keypoints=folder)
    outcome = run(about, tmp_path / "out", workers=1)
    (failed,) = outcome.done["S1_walking2_cam1"]["failed_checks"]
    assert "median reprojection" in failed
    assert "another take" in failed


def test_the_sensors_asked_for_are_those_used(tmp_path: Path) -> None:
    """Perfect ones: each more makes a segment right."""
    tc.dataset(tmp_path / "data", tc.take("S1", "walking2"))
    about = protocol(tmp_path / "data", subjects=("S1",), takes=("walking2",), cameras=(1,))
    about = replace(about, modes=("sf2",))
    errors = {}
    for name, sensors in {**SENSOR_SETS, "one": ("Head",)}.items():
        outcome = run(replace(about, sensors=sensors), tmp_path / name, workers=1)
        errors[name] = figures(outcome)["S1_walking2_cam1"]["sf2"]["angle_deg"]
    assert errors["13"] < errors["10"] < errors["8"] < errors["one"]


def test_the_space_asked_for_is_the_solvers(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []

    def reconstructions(
        recording: Any, modes: Any, lifter: Any, settings: Any, calibrate: bool
    ) -> dict[str, Any]:
        given.append(type(settings.fragment))
        return {}

    monkeypatch.setattr(total_capture, "reconstructions", reconstructions)
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(1,))
    spaces = {"joint": type(None), "cartesian": CartesianSettings}  # none: those of joint space
    for space in spaces:
        chosen = replace(about, space=space)
        outcome = run(chosen, tmp_path / space, workers=1)
        assert f"solved in {space} space" in tables_of(chosen, outcome)["by_take"].notes[0]
    assert given == list(spaces.values())


def test_a_take_calibrated_from_itself_makes_up_for_sensors_that_sit_askew(tmp_path: Path) -> None:
    """Noisy sensors are turned by some degrees on their segments."""
    tc.dataset(tmp_path / "data", tc.take("S1", "walking2", noisy=True, frames=240))
    about = protocol(tmp_path / "data", subjects=("S1",), takes=("walking2",), cameras=(1,))
    errors = {}
    for calibrate in (False, True):
        chosen = replace(about, modes=("rtof",), calibrate=calibrate)
        outcome = run(chosen, tmp_path / str(calibrate), workers=1)
        errors[calibrate] = figures(outcome)["S1_walking2_cam1"]["rtof"]["flexion_deg"]
        where = "found from each take itself" if calibrate else "as the files have it"
        assert where in tables_of(chosen, outcome)["by_take"].notes[0]
    assert errors[True] < 0.8 * errors[False]


# --- studies -------------------------------------------------------------------------------------


def test_the_studies_are_of_the_energy_as_printed_from_the_poses_of_sf2(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Solved for two of the eight problems, as building one takes a second."""
    monkeypatch.setattr(total_capture, "FRAGMENT_LENGTH", {20: ()})
    monkeypatch.setattr(total_capture, "VISUAL_WEIGHT", {1.0: (), 0.9: ()})
    about = protocol(root, subjects=("S5",), takes=("acting3",), cameras=(1,), modes=("rtof",))
    about = replace(about, studies=True, space="cartesian")
    outcome = run(about, tmp_path, workers=1)
    methods = outcome.done["S5_acting3_cam1"]["methods"]
    assert set(methods) == {"rtof", "as printed, N = 20", "as printed, k_V = 1"}
    assert methods["as printed, N = 20"]["seconds"] > 0
    assert methods["as printed, N = 20"]["mpjpe_rr_mm"] < 150
    tables = tables_of(about, outcome)
    twenty = row(tables["fragment_length"], "20")
    assert twenty["MPJJE [m/s3]"] == methods["as printed, N = 20"]["mpjje"]
    assert twenty["frames/s"] == pytest.approx(len(ACTING.poses) / methods["as printed, N = 20"]["seconds"])
    one = row(tables["visual_weight"], "1")
    assert one["root-relative [mm]"] == methods["as printed, k_V = 1"]["mpjpe_rr_mm"]


def test_the_studies_vary_n_and_k_v_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    problems: list[tuple[int, CartesianSettings]] = []

    class Recorder:
        def __init__(self, skeleton: Any, frames: int, settings: CartesianSettings) -> None:
            problems.append((frames, settings))

        def solve(self, start: Any, *about: Any) -> Any:
            assert start is sf2
            return type("Solution", (), {"poses": start})

    sf2 = WALKING.poses
    result: Any = type("Result", (), {
        "motion": type("Motion", (), {"skeleton": SkeletonModel.default()}),
        "stages": {"sf2": sf2, "rtof": None}, "keypoints": None, "bone_imus": None,
    })  # fmt: skip
    monkeypatch.setattr(total_capture, "FragmentSolver", Recorder)
    rows = total_capture._studies(result, sf2)
    printed = CartesianSettings.paper()
    for N in published.FRAGMENT_LENGTH:
        assert (N, printed) in problems
        assert rows[length_name(N)]["mpjpe_mm"] == 0
    for k_V in published.VISUAL_WEIGHT:
        assert weight_name(k_V) in rows
        (settings,) = [s for N, s in problems if N == 50 and s.k_V == pytest.approx(k_V)]
        assert settings == replace(printed, k_V=k_V, k_I=settings.k_I)
        assert settings.k_I == pytest.approx(1 - k_V)
    assert len(problems) == len(rows) == 8


# --- bad input -----------------------------------------------------------------------------------

BAD = {
    "an unknown subject": (["--subjects", "S1,S6"], "unknown subject 'S6'"),
    "a misspelt take": (["--takes", "actng3"], "unknown take 'actng3'. Did you mean 'acting3'?"),
    "a camera that is not": (["--cameras", "1,9"], "unknown camera '9'"),
    "a camera that is no number": (["--cameras", "one"], "--cameras one: give numbers"),
    "a misspelt sensor": (["--sensors", "L_LowrArm"], "Did you mean 'L_LowArm'?"),
    "an unknown mode": (["--modes", "rtoff"], "unknown mode 'rtoff'"),
    "no mode": (["--modes", ""], "modes: none are named"),
    "no subject": (["--subjects", ","], "subjects: none are named"),
    "no camera": (["--cameras", ""], "cameras: none are named"),
    "no sensors for modes that need them": (["--sensors", ""], "modes sf2 and rtof need sensors"),
    "noise on detections": (
        ["--keypoints", "{tmp}", "--noise-px", "3"],
        "noise is added to ground-truth 2D only",
    ),
    "negative noise": (["--noise-px=-1"], "noise_px: -1 is not a standard deviation"),
    "noise that is no number": (["--noise-px", "nan"], "noise_px: nan"),
    "endless noise": (["--noise-px", "inf"], "noise_px: inf"),
    "a negative seed": (["--seed=-1"], "seed: -1 is negative"),
    "no folder of detections": (["--keypoints", "{tmp}/none"], "no such folder of detections"),
    "no lifter": (["--lifter", "{tmp}/none.pt"], "none.pt: no such file; give the path of a trained"),
    "no layout": (["--keypoints", "{tmp}", "--layout", "coco"], "unknown layout 'coco'. Did you mean"),
    "a layout of nothing": (["--layout", "auto"], "layout is that of a detector's points"),
    "no data set": (["--root", "{tmp}/none"], "none: there is no such folder"),
    "an empty data set": (["--root", "{tmp}"], "holds no file of Total Capture"),
    "a folder for the JSON": (["--json", "{tmp}"], "is a folder; name a file"),
    "a file for the results": (["-o", "{tmp}/file"], "cannot be written"),
    "a file for the motions": (["--save", "{tmp}/file"], "cannot be written"),
    "no worker": (["--workers", "0"], "workers: 0 processes do no work"),
}


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize("bad", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(
    bad: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, expected = BAD[bad]
    (tmp_path / "file").write_text("mine")
    out = tmp_path.with_name(f"{tmp_path.name}_out")
    arguments = ["total-capture", "--root", str(root), "-o", str(out), "--no-studies"]
    assert main([*arguments, *(text.replace("{tmp}", str(tmp_path)) for text in given)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert expected in lines[0]
    assert not (out / "runs").exists() or not list((out / "runs").iterdir())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize("what", ["17 joints", "no checkpoint"])
def test_a_lifter_that_cannot_be_used_is_said(
    what: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lifter.pt"
    if what == "17 joints":
        lifter = untrained_lifter(table=TABLE_17, rate_hz=50.0)
        save_checkpoint(path, lifter.network, lifter.description)
    else:
        path.write_bytes(b"no checkpoint")
    arguments = ["--root", str(root), "--subjects", "S1", "--takes", "walking2", "--cameras", "1"]
    options = ["--lifter", str(path), "--no-studies", "--workers", "1", "-o", str(tmp_path / "out")]
    assert main(["total-capture", *arguments, *options]) == 2
    assert "error: nothing could be measured" in capsys.readouterr().err


def test_a_protocol_in_python_is_checked_as_well(root: Path) -> None:
    for changed, error in (
        ({"subjects": ("S7",)}, UnknownNameError), ({"takes": ()}, ShapeError),
        ({"space": "polar"}, UnknownNameError), ({"keypoints": root / "none"}, FileFormatError),
    ):  # fmt: skip
        with pytest.raises(error):
            protocol(root, **changed)


@pytest.mark.usefixtures("unpictured")
def test_a_folder_with_other_things_is_not_touched(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter.tex").write_text("mine")
    arguments = ["total-capture", "--root", str(root), "-o", str(thesis), "--overwrite"]
    assert main(arguments) == 2
    assert "thesis: holds other things; name a new folder" in capsys.readouterr().err
    assert [path.name for path in thesis.iterdir()] == ["chapter.tex"]


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["total-capture", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for option in ("--root", "--subjects", "--takes", "--cameras", "--keypoints", "--layout",
                   "--noise-px", "--sensors", "--space", "--lifter", "--modes", "--save", "--json",
                   "--seed", "--workers", "--output", "--overwrite", "--no-studies"):  # fmt: skip
        assert option in text


def test_the_example_is_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import runpy
    import sys

    example = Path(__file__).parents[2] / "examples" / "total_capture.py"
    monkeypatch.setattr(sys, "argv", [str(example), "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(example), run_name="__main__")
    assert stop.value.code == 0
    assert "usage: rtof-kin total-capture" in capsys.readouterr().out
