"""Sensor study: measures on planted angles, order of removal, files, and a small real study."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from clinical_support import walk
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Choices
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit_results import Grade, Headline, SectionVerdict
from rtof_kin.reporting.sensor_study import runs as sensor_runs
from rtof_kin.reporting.sensor_study.accuracy import PARTS, Part, liveliest_part, measure_set
from rtof_kin.reporting.sensor_study.document import NO_ERROR, document, error_by_number, sentences, write_study
from rtof_kin.reporting.sensor_study.study import SensorStudy, identity_of, number_of_runs, study_sensors
from rtof_kin.solve.joint_space import fragment as fragment_energy

Array = NDArray[np.float64]
LOSSES = np.radians([8.0, 6.0, 1.0])


@pytest.fixture(scope="module")
def angles() -> ClinicalAngles:
    return clinical_angles(walk()).select(["left_knee_flexion", "right_knee_flexion", "spine_flexion"])


def off_by(angles: ClinicalAngles, radians: Array) -> ClinicalAngles:
    return replace(angles, values=angles.values + radians)


def test_differences_from_the_full_set(angles: ClinicalAngles) -> None:
    found = measure_set(("a",), off_by(angles, np.array([0.1, -0.2, 2 * np.pi])), angles, None)
    np.testing.assert_allclose(found.difference, [0.1, 0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.seen, 1.0)
    assert np.isnan(found.error).all()
    assert np.isnan(found.half_band).all()
    assert found.loss == pytest.approx(0.1)


def test_errors_against_the_reference(angles: ClinicalAngles) -> None:
    certain = replace(angles, sigma=np.full(angles.values.shape, 0.01))
    found = measure_set(("a",), certain, angles, off_by(angles, np.array([0.1, 0.1, 0.4])))
    np.testing.assert_allclose(found.difference, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.error, [0.1, 0.1, 0.4])
    np.testing.assert_allclose(found.half_band, 0.0196, rtol=1e-3)
    assert found.loss == pytest.approx(0.2)


def test_unobserved_angles_count_with_their_standard_deviation(angles: ClinicalAngles) -> None:
    values = angles.values.copy()
    values[:, 0] = np.nan
    half = len(angles) // 2
    values[:half, 1] = np.nan
    found = measure_set(("a",), replace(angles, values=values), angles, None)
    assert np.isnan(found.difference[0])
    np.testing.assert_allclose(found.seen, [0.0, 1 - half / len(angles), 1.0])
    spread = angles.values.std(axis=0)
    own = [spread[0], spread[1] * np.sqrt(half / len(angles)), 0.0]
    assert found.loss == pytest.approx(np.mean(own))
    values, singular = angles.values.copy(), angles.singular.copy()
    values[3, 2] += 1.0
    singular[3, 2] = True
    found = measure_set(("a",), replace(angles, values=values, singular=singular), angles, None)
    np.testing.assert_allclose(found.difference, 0.0, atol=1e-12)


@dataclass(frozen=True)
class Imus:
    names: tuple[str, ...]
    times: Array = field(default_factory=lambda: np.array([0.0, 2.0]))

    def select(self, wanted: tuple[str, ...]) -> Imus:
        return replace(self, names=wanted)


@dataclass(frozen=True)
class FakeRecording:
    imus: Imus | None
    keypoints: Any
    joints: tuple[str, ...]
    name: str = "fake"
    calibration: Any = None
    truth: Any = None
    skeleton: SkeletonModel = field(default_factory=SkeletonModel.default)

    def bone_imus(self) -> Any:
        return self


def fake(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, losses: Array, camera: bool = True
) -> tuple[Any, list[tuple[str, ...]]]:
    """A recording whose angle s is off by losses[s] without sensor s, and the sets that are reconstructed."""
    names = tuple(f"S{s}" for s in range(len(losses)))
    runs: list[tuple[str, ...]] = []

    def reconstructed(recording: FakeRecording, mode: str, **options: Any) -> Any:
        own = () if recording.imus is None else recording.imus.names
        assert mode == ("imu" if not camera else "rtof" if own else "rto")
        assert options["settings"].checks == (own == names)
        runs.append(own)
        lost = [0.0 if name in own else w for name, w in zip(names, losses, strict=True)]
        return type("Result", (), {"motion": np.array((lost + [0.0] * 3)[:3]), "choices": Choices()})

    verdict = Headline(Grade.WARN, "doubtful", (SectionVerdict("body", Grade.WARN, ("too tall",)),))
    monkeypatch.setattr(sensor_runs, "reconstruct", reconstructed)
    monkeypatch.setattr(sensor_runs, "clinical_angles", lambda lost: off_by(angles, lost))
    monkeypatch.setattr(sensor_runs, "cleaned", lambda recording, settings: (recording, ()))
    monkeypatch.setattr(sensor_runs, "audit", lambda result: [])
    monkeypatch.setattr(sensor_runs, "headline", lambda results: verdict)
    return FakeRecording(Imus(names), Imus(()) if camera else None, names), runs


@pytest.mark.parametrize(
    ("sensors", "camera", "greedy"),
    [(1, True, True), (2, False, None), (4, True, True), (4, True, False), (4, False, None), (9, True, None)],
)
def test_number_of_runs_is_known_beforehand(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, sensors: int, camera: bool, greedy: bool | None
) -> None:
    recording, runs = fake(monkeypatch, angles, np.full(sensors, 0.1), camera)
    progress: list[tuple[int, int]] = []
    study = study_sensors(recording, greedy=greedy, progress=lambda done, total, what: progress.append((done, total)))
    most = number_of_runs(sensors, camera, greedy)
    assert len(runs) == len(set(runs)) == study.runs <= most
    assert len(runs) == most or greedy is not False
    assert progress[0] == (0, most)
    assert progress[-1] == (len(runs), len(runs))
    assert [len(found.sensors) for found in study.path] == list(range(sensors, -1 if camera else 0, -1))
    assert runs[0] == study.full.sensors


def test_sets_that_a_larger_one_shows_to_be_worse_are_not_tried(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles
) -> None:
    losses = np.radians([9.0, 0.1, 0.2])
    recording, runs = fake(monkeypatch, angles, losses)
    study = study_sensors(recording, greedy=True)
    assert ("S1",) not in runs  # without S0 alone, the loss is larger than that of S0 alone
    assert [found.sensors for found in study.path] == [("S0", "S1", "S2"), ("S0", "S2"), ("S0",), ()]


def test_an_interrupted_study_goes_on_with_the_same_results(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, tmp_path: Path
) -> None:
    recording, runs = fake(monkeypatch, angles, LOSSES)
    whole = document(study_sensors(recording)).plain()
    every, done = runs.copy(), 5
    runs.clear()

    def interrupt(done_now: int, total: int, what: str) -> None:
        if done_now == done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study_sensors(recording, folder=tmp_path, progress=interrupt)
    assert runs == every[:done]
    progress: list[tuple[int, int, str]] = []
    study = study_sensors(recording, folder=tmp_path, progress=lambda *event: progress.append(event))
    assert runs == every
    assert document(study).plain() == whole
    assert study.verdict.line == "warn: doubtful"
    assert study.verdict.sections[0].reasons == ("too tall",)
    assert any("which one is removed" in what for _, _, what in progress)


def test_a_run_that_fails_is_named_and_the_others_are_kept(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, tmp_path: Path
) -> None:
    recording, runs = fake(monkeypatch, angles, LOSSES)
    whole = sensor_runs.reconstruct

    def failing(part: FakeRecording, mode: Any, **options: Any) -> Any:
        if part.imus is not None and part.imus.names == ("S0", "S2"):
            raise InvalidInputError("too dark")
        return whole(part, mode=mode, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(sensor_runs, "reconstruct", failing)
    with pytest.raises(RtofError, match="S0, S2 failed: too dark"):
        study_sensors(recording, folder=tmp_path)
    monkeypatch.setattr(sensor_runs, "reconstruct", whole)
    study_sensors(recording, folder=tmp_path)
    assert len(runs) == len(set(runs))


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles) -> SensorStudy:
    return study_sensors(fake(monkeypatch, angles, LOSSES)[0], greedy=True)


def test_the_least_important_sensor_is_removed_first(study: SensorStudy) -> None:
    for s, found in enumerate(study.without):
        assert found.difference[s] == pytest.approx(LOSSES[s])
        assert found.loss == pytest.approx(LOSSES[s] / 3)
    assert [found.sensors for found in study.path] == [("S0", "S1", "S2"), ("S0", "S1"), ("S0",), ()]


def test_smallest_set_within_the_tolerance(study: SensorStudy) -> None:
    left, spine = (study.fewest(name) for name in ("left_knee_flexion", "spine_flexion"))
    assert left is not None
    assert left.sensors == ("S0",)
    assert spine is not None
    assert spine.sensors == ()
    assert study.fewest("spine_flexion", np.radians(0.5)) == study.path[0]


def group(found: list[str], beginning: str) -> str:
    """The sentence on a group of angles."""
    return next((sentence for sentence in found if sentence.startswith(beginning)), "")


def test_sentences_call_a_sensor_needed_only_where_its_removal_alone_matters(study: SensorStudy) -> None:
    found = sentences(replace(study, places={"S0": "left shank", "S1": "right shank", "S2": "thorax"}))
    assert group(found, "Beyond 5 deg where one sensor alone") == (
        "Beyond 5 deg where one sensor alone is omitted, so that it is needed for this angle: left knee "
        "flexion without left shank (8.0 deg); right knee flexion without right shank (6.0 deg)."
    )
    assert "the left shank matters most" in found[2]
    assert "the thorax matters least" in found[2]
    assert "thorax, right shank, left shank" in found[3]
    assert "3: 3, 2: 3, 1: 2, 0: 1" in found[3]
    assert "possible sets were tried" in found[3]
    assert "does not prove that it is needed" in found[3]


def test_sentences_tell_angles_that_need_no_sensor_from_those_that_hardly_move(study: SensorStudy) -> None:
    moves = replace(study, moved=np.radians([30.0, 30.0, 30.0]))
    assert group(sentences(moves), "No single sensor is needed") == (
        "No single sensor is needed, and these stay within 5 deg in this order of removal: spine flexion down to 0 "
        "sensors."
    )
    still = sentences(replace(study, moved=np.radians([30.0, 30.0, 3.0])))
    assert not group(still, "No single sensor is needed")
    assert "spine flexion" in group(still, "These hardly move here")


def test_a_sensor_that_hardly_changes_an_angle_is_not_called_needed(study: SensorStudy) -> None:
    error = np.radians([4.8, 4.8, 4.8])
    within = replace(study.full, error=error)
    without = tuple(replace(one, error=error + 0.1 * one.difference) for one in study.without)
    off = replace(study, has_truth=True, full=within, steps=(without, *study.steps[1:]))
    found = sentences(off)
    assert "knee flexion down to 2" in group(found, "No single sensor is needed")
    assert not group(found, "Beyond 5 deg where one sensor")


def test_sentences_say_what_the_numbers_are(study: SensorStudy) -> None:
    data = document(study).plain()
    assert (data["compared_with"], data["note"]) == ("the full set of sensors", NO_ERROR)
    assert [found["left_out"] for found in data["without"]] == ["S0", "S1", "S2"]
    assert NO_ERROR in data["sentences"][1]
    assert "one recording of one person" in data["sentences"][0]
    long = sentences(replace(study, part=Part(60.0, 180.0, 3600.0)))
    assert "the 120 s with the most movement (from 60 s) of 3600 s" in long[0]
    full = replace(study.full, error=np.full(3, 0.2))
    steps = tuple(tuple(replace(one, error=one.difference) for one in step) for step in study.steps)
    off = replace(study, has_truth=True, full=full, steps=steps)
    found = sentences(off)
    assert "errors against the truth" in found[1]
    assert "Beyond 5 deg even with all 3 sensors" in found[-1]
    assert "knee flexion (11.5 deg)" in found[-1]
    assert document(off).plain()["compared_with"] == "the truth"


def test_removals_within_the_scatter_are_called_chance(study: SensorStudy) -> None:
    assert "The order is partly chance" not in sentences(study)[3]
    tied = tuple(
        replace(one, loss=0.1 + 0.001 * k, part_losses=np.random.default_rng(k).uniform(0, 0.2, PARTS))
        for k, one in enumerate(study.without)
    )
    found = replace(study, steps=(tied, *study.steps[1:]))
    assert found.as_good(0) == ("S1", "S2")
    assert "The order is partly chance" in sentences(found)[3]
    assert "2 left: " in sentences(found)[3]


def test_a_study_of_a_long_recording_takes_its_liveliest_part() -> None:
    body = SkeletonModel.default()
    truth = planted.moving(body, 600)
    recording: Recording = replace(planted.recording(truth), joint_offsets=body.joint_offsets)
    imus = recording.imus
    assert imus is not None
    times = imus.times
    rest = (times < times[0] + 4) | (times > times[0] + 7)  # moves from the fourth to the seventh second
    R = imus.R_inertial_sensor.copy()
    R[rest] = R[0]
    recording = replace(recording, imus=replace(imus, R_inertial_sensor=R))
    part = liveliest_part(recording, 3.0)
    assert part.start - times[0] == pytest.approx(4.0, abs=0.1)
    cut = part.of(recording)
    assert cut.video.times[-1] - cut.video.times[0] == pytest.approx(3.0, abs=0.1)
    assert cut.imus is not None
    assert cut.imus.times[-1] - cut.imus.times[0] == pytest.approx(3.0 + 2 * 1.0, abs=0.1)  # to compare the clocks
    alone = part.of(replace(recording, keypoints=None))
    assert alone.imus is not None
    assert alone.imus.times[-1] - alone.imus.times[0] == pytest.approx(3.0, abs=0.1)
    whole = liveliest_part(recording, 60.0)
    assert whole.is_whole
    assert whole.of(recording) is recording


def test_table_and_figures_have_all_sets_and_angles(study: SensorStudy, tmp_path: Path) -> None:
    paths = write_study(study, tmp_path)
    with (tmp_path / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == (1 + 3 + 3) * 3
    row = next(r for r in rows if (r["set"], r["angle"]) == ("without S0", "left_knee_flexion"))
    assert float(row["difference_deg"]) == pytest.approx(8.0, abs=1e-4)
    assert (row["number"], row["kept"], row["error_deg"]) == ("2", "no", "")
    json.loads((tmp_path / "study.json").read_text())
    assert [path.name for path in paths] == ["sensors.png", "number.png", "study.csv", "study.json"]
    assert all(path.stat().st_size > 10_000 for path in paths[:2])
    figure = error_by_number(study)
    FigureCanvasAgg(figure).draw()
    ticks = [tick for ax in figure.axes for tick in ax.get_xticks()]
    assert ticks == [round(tick) for tick in ticks]


def test_recordings_without_removable_sensors_are_rejected(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles
) -> None:
    with pytest.raises(InvalidInputError, match="no IMUs"):
        study_sensors(replace(fake(monkeypatch, angles, LOSSES)[0], imus=None))
    with pytest.raises(InvalidInputError, match="no camera"):
        study_sensors(fake(monkeypatch, angles, LOSSES[:1], camera=False)[0])


def test_study_of_two_sensors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = SkeletonModel.default()
    truth = planted.moving(body, 30)
    recording: Recording = replace(planted.recording(truth), joint_offsets=body.joint_offsets)
    assert recording.imus is not None
    recording = replace(recording, imus=recording.imus.select(recording.imus.names[:2]))
    built = fragment_energy._expressions.cache_info().misses
    how: Any = {"lifter": planted.PlantedLifter(truth), "settings": ReconstructionSettings(frames=16)}
    study = study_sensors(recording, **how, folder=tmp_path)
    assert fragment_energy._expressions.cache_info().misses <= built + 1  # all sets share one compiled problem
    assert study.has_truth
    assert [len(found.sensors) for found in study.path] == [2, 1, 0]
    assert np.isfinite(study.full.error).any()
    own = study.full.difference[np.isfinite(study.full.difference)]
    np.testing.assert_allclose(own, 0.0, atol=1e-12)
    assert np.nanmax(study.path[-1].difference) > 0

    # A set is measured as by itself: what the runs share changes no number.
    alone = replace(recording, imus=recording.imus.select(study.path[1].sensors))
    full = clinical_angles(reconstruct(recording, **how).motion).select(study.angles)
    found = clinical_angles(reconstruct(alone, **how).motion).select(study.angles)
    same = measure_set(study.path[1].sensors, found, full, None)
    np.testing.assert_allclose(same.difference, study.path[1].difference, atol=1e-9)

    # In processes of its own, a study has the same numbers.
    monkeypatch.setattr(sensor_runs, "_START", 0.0)
    for path in tmp_path.glob("[01][01].*"):
        if path.stem != "11":
            path.unlink()
    again = study_sensors(recording, **how, folder=tmp_path, workers=2)
    assert document(again).plain() == document(study).plain()


def test_identity_of_a_study_depends_on_the_data_and_the_settings() -> None:
    body = SkeletonModel.default()
    recording: Recording = planted.recording(planted.moving(body, 30))
    first = identity_of(recording, None, ReconstructionSettings(), 120.0)
    assert first == identity_of(replace(recording), None, ReconstructionSettings(), 120.0)
    assert json.loads(json.dumps(first)) == first
    uv = recording.video.uv_px.copy()
    uv[3, 2] += 1e-9
    changed = replace(recording, keypoints=replace(recording.video, uv_px=uv))
    assert identity_of(changed, None, ReconstructionSettings(), 120.0) != first
    assert identity_of(recording, None, ReconstructionSettings(frames=60), 120.0) != first
