"""The protocol on Total Capture, from files in its formats to tables, figures and motions."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import total_capture_support as tc
from protocol_support import cells_of, facts_of, read_json
from scipy import signal

from benchmarks.total_capture_motion import cameras
from benchmarks.total_capture_standin import StandInTake, make_take, write_detections
from rtof_kin.body.motion_file import MotionReader
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.errors import OutputExistsError, RtofError
from rtof_kin.core.jobs import Outcome
from rtof_kin.datasets.total_capture import TotalCapture
from rtof_kin.protocols import Measured, measures, published, run, total_capture
from rtof_kin.protocols.tables import LOW_PASSED, STILL, Table
from rtof_kin.protocols.total_capture import SENSOR_SETS, SIXTEEN, TotalCaptureProtocol, length_name, weight_name
from rtof_kin.simulation.simulate import another_person
from rtof_kin.solve.settings import CartesianSettings

NAMES = SkeletonModel.default().names
MODES = ("lift", "rto", "sf2", "rtof")
WALKING = tc.take("S1", "walking2", noisy=True, frames=45)
ACTING = tc.take("S5", "acting3", noisy=True, frames=36)
"""Takes of different length."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two takes; S1 acting3 and S5 walking2 are not there."""
    folder = tmp_path_factory.mktemp("total_capture")
    tc.dataset(folder, WALKING, ACTING)
    return folder


@dataclass(frozen=True)
class Found:
    """Where results are, and what they are."""

    out: Path
    save: Path
    json: Path
    document: Any = None

    def run(self, root: Path, **changed: Any) -> Measured:
        """Measure both takes from camera 1 in every mode, with everything that is written."""
        settings = {"subjects": ("s1", "s5"), "takes": ("Walking2", "acting3"), "cameras": (1,), "studies": False}
        settings |= {"save": self.save} | changed
        return run("total-capture", root, self.out, workers=1, json_file=self.json, **settings)


@pytest.fixture(scope="module")
def measured(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Found:
    folder = tmp_path_factory.mktemp("measured")
    result = Found(folder / "out", folder / "motions", folder / "deep" / "all.json")
    return replace(result, document=result.run(root).document)


@pytest.fixture
def unpictured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest."""
    monkeypatch.setattr(measures, "figures", lambda *about: [])


def protocol(root: Path, **changed: Any) -> TotalCaptureProtocol:
    """The lifter alone on both takes from cameras 1 and 3, which is quick."""
    usual: dict[str, Any] = {"subjects": ("S1", "S5"), "takes": ("walking2", "acting3")}
    usual |= {"cameras": (1, 3), "modes": ("lift",), "studies": False}
    return TotalCaptureProtocol(root, **(usual | changed))


def tables_of(about: TotalCaptureProtocol, outcome: Outcome) -> dict[str, Table]:
    """Every table by its name."""
    return {table.name: table for table in about.tables(outcome)}


def figures(outcome: Outcome) -> dict[str, dict[str, Any]]:
    """What was measured of every mode, by job."""
    return {key: facts["methods"] for key, facts in facts_of(outcome).items() if facts["camera"] is not None}


# --- by hand -------------------------------------------------------------------------------------


def position(measured: Found, take: StandInTake, mode: str) -> np.ndarray:
    """The joints (T, J, 3) m that were saved."""
    path = measured.save / take.subject / take.name / "cam1" / mode / "motion.h5"
    return Motion.load(path).poses.p_world_joint


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


def rows_of(measured: Found) -> dict[tuple[str, int | None, str], dict[str, Any]]:
    """The rows of the JSON by subject, camera and method."""
    rows = read_json(measured.json)["rows"]
    found = {(one["subject"], one["camera"], one["method"]): one for one in rows}
    assert len(found) == len(rows)
    return found


@pytest.mark.parametrize("mode", MODES)
def test_the_figures_are_those_of_the_saved_motions(mode: str, root: Path, measured: Found) -> None:
    rows = rows_of(measured)
    for take in (WALKING, ACTING):
        expected = by_hand(position(measured, take, mode), truth(root, take))
        if mode == "lift":  # what is scored are the lifter's points, what is saved a skeleton's
            expected = {name: expected[name] for name in ("frames", "sixteen_frames")}
        found = rows[take.subject, 1, mode]
        assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-4)


def test_the_calibration_rows_are_those_by_hand(root: Path, measured: Found) -> None:
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


def test_a_glitch_of_the_reference_does_not_affect_the_low_passed_row(tmp_path: Path) -> None:
    """Frames 655 to 659 of S4 acting3 are one; a filter would smear it over the frames beside."""
    take = tc.take("S4", "acting3", frames=690)
    about = protocol(tmp_path, subjects=("S4",), takes=("acting3",))
    rows = {}
    for name, jump in {"steady": 0.0, "jumping": 0.8}.items():
        p = np.array(take.poses.p_world_joint)
        p[655:660, :, 0] += jump
        tc.dataset(tmp_path / name, replace(take, poses=replace(take.poses, p_world_joint=p)))
        facts = replace(about, root=tmp_path / name).measure(about.jobs()["S4_acting3"]).facts
        rows[name] = facts["methods"][LOW_PASSED]
    assert rows["jumping"]["frames"] == len(take.poses) - 9  # with two frames on either side
    for figure in ("mpjpe_mm", "mpjae", "mpjje"):
        assert rows["jumping"][figure] == pytest.approx(rows["steady"][figure], rel=0.02)


# --- what the command leaves ---------------------------------------------------------------------


def test_every_take_and_mode_has_its_motion(measured: Found) -> None:
    found = {str(path.relative_to(measured.save)) for path in measured.save.rglob("*.h5")}
    assert found == {f"{take}/cam1/{mode}/motion.h5" for take in ("S1/walking2", "S5/acting3") for mode in MODES}
    for name in found:
        with MotionReader(measured.save / name) as file:
            motion = file.read()
            assert file.mode == name.split("/")[3]
        take = WALKING if name.startswith("S1") else ACTING
        np.testing.assert_allclose(motion.skeleton.joint_offsets, take.joint_offsets, atol=1e-4)
        np.testing.assert_allclose(motion.poses.times, take.poses.times)
        p, _ = motion.skeleton.forward_kinematics(motion.q)
        np.testing.assert_allclose(p, motion.poses.p_world_joint, atol=1e-9)


def test_the_json_has_settings_and_rows_and_the_tables_are_complete(measured: Found) -> None:
    content = read_json(measured.json)
    assert measured.json.read_bytes() == (measured.out / "tables.json").read_bytes()
    settings = content["settings"]
    assert (settings["subjects"], settings["takes"]) == (["S1", "S5"], ["walking2", "acting3"])
    assert settings["sensors"] == list(SENSOR_SETS["8"])
    assert re.fullmatch("[0-9a-f]{64}", settings["lifter_sha256"])
    kept = read_json(measured.out / "settings.json")
    assert {name: kept[name] for name in settings} == settings
    assert len(content["rows"]) == 2 * (len(MODES) + 2)
    absent = {"S1_acting3", "S1_acting3_cam1", "S5_walking2", "S5_walking2_cam1"}
    assert set(content["failed"]) == absent
    assert content["failed"]["S1_acting3_cam1"].startswith("unknown take")
    assert content["headline"] == "Total Capture: 2 recordings measured, 4 FAILED."
    tables = content["tables"]
    assert list(tables) == ["by_take", "inertial_only", "ablation", "sixteen_joints", "state_of_data"]
    incomplete = "INCOMPLETE, without: S1 acting3, S1 acting3 camera 1, S5 walking2"
    for name in list(tables)[:4]:
        assert any(note.startswith(incomplete) for note in tables[name]["notes"])
    state = {tuple(cells[:2]) for cells in tables["state_of_data"]["rows"]}
    assert {("S1 acting3", "not measured"), ("S5 walking2", "not measured")} <= state
    rows = rows_of(measured)
    for subject in ("S1", "S5"):
        errors = {mode: rows[subject, 1, mode]["mpjpe_rr_mm"] for mode in MODES}
        assert errors["rtof"] < errors["sf2"] < errors["lift"]


def test_figures_are_drawn_and_tables_written(measured: Found) -> None:
    text = (measured.out / "tables.md").read_text(encoding="utf-8")
    for table in measured.document.printed:
        assert table.markdown() in text
        assert len(cells_of(table.markdown())) == 1 + len(table.rows)
    for name, least in {"error_curves": 500, "skeletons": 700}.items():
        pixels = matplotlib.image.imread(measured.out / "figures" / f"{name}.png")
        assert pixels.shape[0] > least
        assert len(np.unique(pixels[::4, ::4].reshape(-1, pixels.shape[-1]), axis=0)) > 50


# --- resuming ------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unpictured")
def test_a_second_run_measures_nothing_and_other_settings_are_refused(
    root: Path, measured: Found, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = measured.json.read_bytes(), (measured.out / "tables.md").read_bytes()
    monkeypatch.setattr(total_capture, "_seen_by", None)
    monkeypatch.setattr(total_capture, "_reference", None)
    measured.run(root)
    with pytest.raises(OutputExistsError, match=r"other settings \(noise_px, seed, sensors, space\)"):
        measured.run(root, sensors=("10",), noise_px=2.0, seed=5, space="cartesian")
    assert (measured.json.read_bytes(), (measured.out / "tables.md").read_bytes()) == before


# --- what is damaged or not there ----------------------------------------------------------------


def test_a_take_without_sensors_has_the_modes_that_need_none(tmp_path: Path) -> None:
    data = tmp_path / "data"
    paths = tc.dataset(data, WALKING, ACTING)
    for kind in ("sensors", "aux", "ref", "bone"):
        paths[kind].unlink()
    about = protocol(data, modes=("lift", "sf2"), cameras=(1,), save=tmp_path / "motions")
    outcome = about.run(tmp_path / "out", workers=1)
    methods = {key: set(figures) for key, figures in figures(outcome).items()}
    assert methods == {"S1_walking2_cam1": {"lift", "sf2"}, "S5_acting3_cam1": {"lift"}}
    tables = tables_of(about, outcome)
    for name in ("by_take", "inertial_only", "ablation", "sixteen_joints"):
        (sentence,) = [note for note in tables[name].notes if note.startswith("INCOMPLETE")]
        assert "S5 acting3 camera 1 (sf2)" in sentence
    rows = tables["state_of_data"].rows
    (note,) = [str(cells[2]) for cells in rows if cells[0] == "S5 acting3 camera 1"]
    assert "sf2 and rtof are left out, without the sensors L_UpArm" in note
    # What no run could write is not waited for.
    before = (tmp_path / "out/runs/S5_acting3_cam1.json").stat().st_mtime_ns
    about.run(tmp_path / "out", workers=1)
    assert (tmp_path / "out/runs/S5_acting3_cam1.json").stat().st_mtime_ns == before


# --- detections, cameras, sensors, spaces --------------------------------------------------------


@pytest.fixture(scope="module")
def detections(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector's 2D of S1 walking2 in cameras 1 and 2, and none of camera 3."""
    folder = tmp_path_factory.mktemp("detector")
    for number in (1, 2):
        write_detections(folder, WALKING, number, cameras()[number], seed=0)
    return folder


def test_detections_are_used_and_checked(root: Path, detections: Path, tmp_path: Path) -> None:
    about = protocol(root, subjects=("S1",), takes=("walking2",), cameras=(1, 2, 3))
    exact = about.run(tmp_path / "exact", workers=1)
    other = replace(tc.take("S5", "acting3", seed=9), subject="S1", name="walking2")
    write_detections(detections, other, 4, cameras()[4], seed=0)
    about = replace(about, keypoints=detections, cameras=(1, 2, 3, 4))
    outcome = about.run(tmp_path / "out", workers=1)
    assert set(outcome.failed) == {"S1_walking2_cam3"}
    assert "no detections of S1 walking2 camera 3" in outcome.failed["S1_walking2_cam3"]
    key = "S1_walking2_cam1"
    assert figures(outcome)[key] != figures(exact)[key]
    tables = tables_of(about, outcome)
    assert f"the detections in {detections.name}" in tables["by_take"].notes[0]
    assert "S1 walking2 camera 3" in tables["by_take"].notes[1]
    assert outcome.done[key]["failed_checks"] == []
    failed = outcome.done["S1_walking2_cam2"]["failed_checks"]
    assert all("amera 2 is miscalibrated" in message for message in failed)
    (failed,) = outcome.done["S1_walking2_cam4"]["failed_checks"]
    assert "median reprojection" in failed
    assert "another take" in failed


# --- studies -------------------------------------------------------------------------------------


def test_the_posture_is_the_takes_the_persons_or_unknown_as_rows(tmp_path: Path) -> None:
    """Two takes show the neutral posture in their T-poses; the test take begins without one."""

    def take(name: str, seed: int) -> StandInTake:
        found, skeleton = tc.take("S5", name, noisy=True, frames=80, seed=seed), SkeletonModel.default()
        own = another_person(np.random.default_rng(3), found.poses, skeleton.with_offsets(found.joint_offsets))
        own = own[50:] if name == "acting3" else own
        own = replace(own, times=own.times - own.times[0])
        return make_take("S5", name, own, found.joint_offsets)

    tc.dataset(tmp_path / "data", *(take(name, seed) for seed, name in enumerate(("acting3", "walking2", "rom3"))))
    about = protocol(
        tmp_path / "data",
        subjects=("S5",),
        takes=("acting3",),
        cameras=(1,),
        modes=("lift", "rto"),
        posture=("take", "person", "unknown"),
    )
    data = TotalCapture(about.root)
    test, others = data.take("S5", "acting3"), [data.take("S5", name).posture for name in ("walking2", "rom3")]
    assert test.posture is None
    found = total_capture._posture(about.root, test, "person")
    assert found is not None
    for one in others:
        assert one is not None
        assert tc.degrees_apart(found.R_parent_bone, one.R_parent_bone) < 4  # takes differ by 1.5 deg an axis
    assert total_capture._posture(about.root, data.take("S5", "rom3"), "take") is not None
    job = about.jobs()["S5_acting3_cam1"]
    facts = about.measure(job).facts
    rows = facts["methods"]
    assert [*rows] == ["lift", "rto", "rto, posture person", "rto, posture unknown"]
    first, person, unknown = (rows[name]["mpjpe_rr_mm"] for name in [*rows][1:])
    assert first == unknown != person
    assert "posture take: no T-pose, so unknown" in facts["notes"]
    table = tables_of(about, Outcome(tmp_path, {job.name: facts}, {}))["posture"]
    assert [row[1] for row in table.rows] == list(total_capture.POSTURES.values())
    assert table.rows[0][2:] == table.rows[2][2:]
    assert protocol(about.root, posture=()).posture == ("unknown",)  # --posture none


def test_the_studies_vary_n_and_k_v_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    problems: list[tuple[int, CartesianSettings]] = []

    class Recorder:
        def __init__(self, skeleton: Any, frames: int, settings: CartesianSettings) -> None:
            problems.append((frames, settings))

        def solve(self, start: Any, *about: Any) -> Any:
            assert start is sf2
            return type("Solution", (), {"poses": start})

    sf2 = WALKING.poses
    result: Any = type(
        "Result",
        (),
        {
            "motion": type("Motion", (), {"skeleton": SkeletonModel.default()}),
            "stages": {"sf2": sf2, "rtof": None},
            "keypoints": None,
            "bone_imus": None,
        },
    )
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


@pytest.mark.parametrize(
    "given, message",
    [
        ({"sensors": ("L_LowrArm",)}, "Did you mean 'L_LowArm'?"),
        ({"modes": ()}, "modes: none are named"),
        ({"sensors": ()}, "modes sf2 and rtof need sensors"),
        ({"keypoints": Path(), "noise_px": 3.0}, "noise is added to ground-truth 2D only"),
        ({"lifter": Path("none.pt")}, "none.pt: no such file; give the path of a trained"),
        ({"keypoints": Path(), "layout": "coco"}, "unknown layout 'coco'. Did you mean"),
        ({"layout": "auto"}, "layout is that of a detector's points"),
        ({"root": Path("empty")}, "holds no file of Total Capture"),
        ({"folder": Path("file")}, "cannot be written"),
    ],
)
def test_bad_input_writes_nothing(
    given: dict[str, Any], message: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "empty").mkdir()
    about = {"root": root, "folder": tmp_path / "out", "studies": False} | given
    with pytest.raises(RtofError, match=re.escape(message)):
        run("total-capture", about.pop("root"), about.pop("folder"), **about)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "file"]
    assert (tmp_path / "file").read_text() == "mine"
