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
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.reconstruction.result import Choices
from rtof_kin.recording.recording import Recording
from rtof_kin.report.sensor_study import study as sensor_study
from rtof_kin.report.sensor_study.figures import error_by_number, write_study_figures
from rtof_kin.report.sensor_study.files import NO_ERROR, sentences, study_data, write_study
from rtof_kin.report.sensor_study.study import SensorStudy, measure_set, number_of_runs, study_sensors
from rtof_kin.solve.compiled import fragment_energy

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


def test_singular_frames_are_excluded(angles: ClinicalAngles) -> None:
    values, singular = angles.values.copy(), angles.singular.copy()
    values[3, 2] += 1.0
    singular[3, 2] = True
    found = measure_set(("a",), replace(angles, values=values, singular=singular), angles, None)
    np.testing.assert_allclose(found.difference, 0.0, atol=1e-12)


@dataclass(frozen=True)
class Imus:
    names: tuple[str, ...]

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
        runs.append(own)
        lost = [0.0 if name in own else w for name, w in zip(names, losses, strict=True)]
        return type("Result", (), {"motion": np.array((lost + [0.0] * 3)[:3]), "choices": Choices()})

    monkeypatch.setattr(sensor_study, "reconstruct", reconstructed)
    monkeypatch.setattr(sensor_study, "clinical_angles", lambda lost: off_by(angles, lost))
    return FakeRecording(Imus(names), "some" if camera else None, names), runs


@pytest.mark.parametrize(
    ("sensors", "camera"), [(1, True), (2, True), (2, False), (5, True), (5, False), (9, True)]
)
@pytest.mark.parametrize("greedy", [True, False, None])
def test_number_of_runs_is_known_beforehand(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, sensors: int, camera: bool,
    greedy: bool | None,
) -> None:  # fmt: skip
    recording, runs = fake(monkeypatch, angles, np.full(sensors, 0.1), camera)
    progress: list[tuple[int, int]] = []
    study = study_sensors(
        recording, greedy=greedy, progress=lambda stage, done, total: progress.append((done, total))
    )
    assert len(runs) == number_of_runs(sensors, camera, greedy)
    assert progress[-1] == (len(runs), len(runs))
    assert [len(found.sensors) for found in study.path] == list(range(sensors, -1 if camera else 0, -1))
    assert runs[0] == study.full.sensors


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


def test_sentences_name_the_needed_sensors(study: SensorStudy) -> None:
    names = ("LeftLeg", "RightLeg", "Spine3")
    named = replace(study, segments=dict(zip(study.segments, names, strict=True)))
    opening, *found = sentences(named)
    assert opening.startswith("Within 5 deg (RMS) of the full set")
    assert found == ["knee: flexion needs 2: LeftLeg, RightLeg.", "spine: flexion needs no sensor."]
    assert sentences(named, np.radians(0.5))[2] == "spine: flexion needs all 3 sensors."


def test_sentences_state_what_exceeds_the_tolerance(study: SensorStudy) -> None:
    data = study_data(study)
    assert (data["compared_with"], data["note"]) == ("the full set of sensors", NO_ERROR)
    assert [found["left_out"] for found in data["without"]] == ["S0", "S1", "S2"]
    full = replace(study.full, error=np.full(3, 0.2))
    off = replace(study, has_truth=True, full=full, path=(full, *study.path[1:]))
    assert "is not within it even with all 3 (11.5 deg)" in sentences(off)[1]
    assert study_data(off)["compared_with"] == "the truth"
    error = np.where([name == "right_knee_flexion" for name in study.angles], 0.2, 0.01)
    path = tuple(replace(found, error=error) for found in study.path)
    one_side = sentences(replace(off, full=path[0], path=path))[1]
    assert "on the right is not within it even with all 3" in one_side
    assert "on the left needs no sensor" in one_side


def test_table_and_figures_have_all_sets_and_angles(study: SensorStudy, tmp_path: Path) -> None:
    write_study(study, tmp_path)
    with (tmp_path / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == (1 + 3 + 3) * 3
    row = next(r for r in rows if (r["set"], r["angle"]) == ("without S0", "left_knee_flexion"))
    assert float(row["difference_deg"]) == pytest.approx(8.0, abs=1e-4)
    assert (row["number"], row["kept"], row["error_deg"]) == ("2", "no", "")
    json.loads((tmp_path / "study.json").read_text())
    paths = write_study_figures(study, tmp_path / "figures")
    assert [path.name for path in paths] == ["sensors.png", "number.png"]
    assert all(path.stat().st_size > 10_000 for path in paths)
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


def test_study_of_two_sensors() -> None:
    body = SkeletonModel.default()
    truth = planted.moving(body, 30)
    recording: Recording = replace(planted.recording(truth), joint_offsets=body.joint_offsets)
    assert recording.imus is not None
    recording = replace(recording, imus=recording.imus.select(recording.imus.names[:2]))
    built = fragment_energy._frame_energy.cache_info().misses
    study = study_sensors(recording, lifter=planted.PlantedLifter(truth))
    assert (
        fragment_energy._frame_energy.cache_info().misses <= built + 1
    )  # all sets share one compiled problem
    assert study.has_truth
    assert [len(found.sensors) for found in study.path] == [2, 1, 0]
    assert np.isfinite(study.full.error).any()
    own = study.full.difference[np.isfinite(study.full.difference)]
    np.testing.assert_allclose(own, 0.0, atol=1e-12)
    assert np.nanmax(study.path[-1].difference) > 0
