"""What sensors are worth: measures on planted angles, the way down, and a small study."""

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
from rtof_kin.core.errors import ShapeError
from rtof_kin.reconstruction.result import Choices
from rtof_kin.recording.recording import Recording
from rtof_kin.report.sensor_study import study as sensor_study
from rtof_kin.report.sensor_study.figures import error_by_number, write_study_figures
from rtof_kin.report.sensor_study.files import NO_ERROR, sentences, study_facts, write_study
from rtof_kin.report.sensor_study.sensor_sets import measured
from rtof_kin.report.sensor_study.study import SensorStudy, number_of_runs, study_sensors
from rtof_kin.solve.compiled import fragment_energy

Array = NDArray[np.float64]
NAMES = ("L_LowLeg", "R_LowLeg", "Sternum")
SEGMENTS = ("LeftLeg", "RightLeg", "Spine3")
WORTH = np.radians([8.0, 6.0, 1.0])


@pytest.fixture(scope="module")
def angles() -> ClinicalAngles:
    return clinical_angles(walk()).select(["left_knee_flexion", "right_knee_flexion", "spine_flexion"])


def off_by(angles: ClinicalAngles, radians: Array) -> ClinicalAngles:
    return replace(angles, values=angles.values + radians)


# --- measures ------------------------------------------------------------------------------------


def test_a_set_is_off_by_what_was_planted(angles: ClinicalAngles) -> None:
    planted_ = np.array([0.1, -0.2, 2 * np.pi])  # a whole turn is nothing
    found = measured(("a",), off_by(angles, planted_), angles, None)
    np.testing.assert_allclose(found.difference, [0.1, 0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.seen, 1.0)
    assert np.isnan(found.error).all()
    assert np.isnan(found.half_band).all()
    assert found.loss == pytest.approx(0.1)


def test_with_a_truth_the_loss_is_the_error_and_the_full_set_has_one(angles: ClinicalAngles) -> None:
    truth = off_by(angles, np.array([0.1, 0.1, 0.4]))
    found = measured(("a",), angles, angles, truth)
    np.testing.assert_allclose(found.difference, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.error, [0.1, 0.1, 0.4])
    assert found.loss == pytest.approx(0.2)


def test_an_angle_that_is_not_seen_costs_its_own_spread(angles: ClinicalAngles) -> None:
    values = angles.values.copy()
    values[:, 0] = np.nan
    half = len(angles) // 2
    values[:half, 1] = np.nan
    found = measured(("a",), replace(angles, values=values), angles, None)
    assert np.isnan(found.difference[0])
    np.testing.assert_allclose(found.seen, [0.0, 1 - half / len(angles), 1.0])
    spread = angles.values.std(axis=0)
    own = [spread[0], spread[1] * np.sqrt(half / len(angles)), 0.0]
    assert found.loss == pytest.approx(np.mean(own))


def test_singular_frames_do_not_count(angles: ClinicalAngles) -> None:
    values, singular = angles.values.copy(), angles.singular.copy()
    values[3, 2] += 1.0
    singular[3, 2] = True
    found = measured(("a",), replace(angles, values=values, singular=singular), angles, None)
    np.testing.assert_allclose(found.difference, 0.0, atol=1e-12)


def test_half_the_band_is_told(angles: ClinicalAngles) -> None:
    certain = replace(angles, sigma=np.full(angles.values.shape, 0.01))
    found = measured(("a",), certain, angles, None)
    np.testing.assert_allclose(found.half_band, 0.0196, rtol=1e-3)


# --- the way down --------------------------------------------------------------------------------


@pytest.mark.parametrize("sensors", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("camera", [True, False])
@pytest.mark.parametrize("greedy", [True, False, None])
def test_the_number_of_runs_is_stated_beforehand(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, sensors: int, camera: bool,
    greedy: bool | None,
) -> None:  # fmt: skip
    if sensors == 1 and not camera:
        return
    runs: list[tuple[str, ...]] = []
    told: list[tuple[int, int]] = []
    recording = fake(monkeypatch, angles, np.full(sensors, 0.1), camera, runs)
    study = study_sensors(
        recording, greedy=greedy, progress=lambda stage, done, total: told.append((done, total))
    )
    assert len(runs) == number_of_runs(sensors, camera, greedy)
    assert told[-1] == (len(runs), len(runs))
    assert [len(found.sensors) for found in study.path] == list(range(sensors, -1 if camera else 0, -1))
    assert runs[0] == study.full.sensors


def fake(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles, worth: Array, camera: bool,
    runs: list[tuple[str, ...]],
) -> Any:  # fmt: skip
    """A recording in which angle number s is off by what sensor s is worth where that is not there."""
    names = tuple(f"S{s}" for s in range(len(worth)))

    @dataclass(frozen=True)
    class Imus:
        names: tuple[str, ...]
        times: Any = (0.0, 1.0)

        def select(self, wanted: tuple[str, ...]) -> Imus:
            return replace(self, names=wanted)

    @dataclass(frozen=True)
    class Fake:
        imus: Imus | None
        name: str = "fake"
        keypoints: Any = "some" if camera else None
        calibration: Any = None
        truth: Any = None
        skeleton: SkeletonModel = field(default_factory=SkeletonModel.default)

        def bone_imus(self) -> Any:
            return type("Bones", (), {"joints": names})

    def reconstructed(recording: Fake, mode: str, **options: Any) -> Any:
        own = () if recording.imus is None else recording.imus.names
        assert mode == ("imu" if not camera else "rtof" if own else "rto")
        runs.append(own)
        lost = [0.0 if name in own else w for name, w in zip(names, worth, strict=True)]
        motion = np.array((lost + [0.0] * 3)[:3])
        return type("Result", (), {"motion": motion, "choices": Choices()})

    monkeypatch.setattr(sensor_study, "reconstruct", reconstructed)
    monkeypatch.setattr(sensor_study, "clinical_angles", lambda lost: off_by(angles, lost))
    return Fake(Imus(names))


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles) -> SensorStudy:
    return study_sensors(fake(monkeypatch, angles, WORTH, True, []), greedy=True)


def test_each_sensor_left_out_is_missed_by_what_it_is_worth(study: SensorStudy) -> None:
    for s, found in enumerate(study.without):
        assert found.difference[s] == pytest.approx(WORTH[s])
        assert found.loss == pytest.approx(WORTH[s] / 3)


def test_the_sensor_missed_least_goes_first(study: SensorStudy) -> None:
    assert [found.sensors for found in study.path] == [("S0", "S1", "S2"), ("S0", "S1"), ("S0",), ()]


def test_an_angle_needs_the_sensors_without_which_it_leaves_the_tolerance(study: SensorStudy) -> None:
    left = study.fewest("left_knee_flexion")
    assert left is not None
    assert left.sensors == ("S0",)
    spine = study.fewest("spine_flexion")
    assert spine is not None
    assert spine.sensors == ()
    assert study.fewest("spine_flexion", np.radians(0.5)) == study.path[0]


def test_sentences_name_the_sensors_that_are_needed(study: SensorStudy) -> None:
    named = replace(study, segments=dict(zip(study.segments, SEGMENTS, strict=True)))
    opening, *told = sentences(named)
    assert opening.startswith("Within 5 deg (RMS) of what all sensors give")
    assert told == ["knee: flexion needs 2: LeftLeg, RightLeg.", "spine: flexion needs no sensor."]
    _, knee, spine = sentences(named, np.radians(0.5))
    assert (knee, spine) == (
        "knee: flexion needs 2: LeftLeg, RightLeg.", "spine: flexion needs all 3 sensors."
    )  # fmt: skip


def test_what_is_compared_is_said(study: SensorStudy) -> None:
    facts = study_facts(study)
    assert (facts["compared_with"], facts["note"]) == ("the full set of sensors", NO_ERROR)
    assert [found["left_out"] for found in facts["without"]] == ["S0", "S1", "S2"]
    off = replace(study, has_truth=True, full=replace(study.full, error=np.full(3, 0.2)))
    off = replace(off, path=(off.full, *off.path[1:]))
    assert "is not within it even with all 3 (11.5 deg)" in sentences(off)[1]
    assert study_facts(off)["compared_with"] == "the truth"


def test_a_side_that_is_never_within_the_tolerance_is_named(study: SensorStudy) -> None:
    error = np.where([name == "right_knee_flexion" for name in study.angles], 0.2, 0.01)
    path = tuple(replace(found, error=error) for found in study.path)
    off = replace(study, has_truth=True, full=path[0], path=path)
    assert sentences(off)[1] == (
        "knee: flexion on the right is not within it even with all 3 (11.5 deg), on the left needs no sensor."
    )


def test_table_and_figures_hold_every_set_and_angle(study: SensorStudy, tmp_path: Path) -> None:
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


def test_the_axis_of_the_number_of_sensors_has_whole_numbers(study: SensorStudy) -> None:
    figure = error_by_number(study)
    FigureCanvasAgg(figure).draw()
    ticks = [tick for ax in figure.axes for tick in ax.get_xticks()]
    assert ticks == [round(tick) for tick in ticks]


def test_there_must_be_something_to_leave_out(
    monkeypatch: pytest.MonkeyPatch, angles: ClinicalAngles
) -> None:
    with pytest.raises(ShapeError, match="has no IMUs, so there is nothing to leave out"):
        study_sensors(replace(fake(monkeypatch, angles, WORTH, True, []), imus=None))
    with pytest.raises(ShapeError, match="with one sensor and no camera nothing can be left out"):
        study_sensors(fake(monkeypatch, angles, WORTH[:1], False, []))


# --- the whole thing -----------------------------------------------------------------------------


def test_a_study_of_two_sensors_goes_down_to_vision_alone() -> None:
    body = SkeletonModel.default()
    truth = planted.moving(body, 30)
    recording: Recording = replace(planted.recording(truth), joint_offsets=body.joint_offsets)
    assert recording.imus is not None
    recording = replace(recording, imus=recording.imus.select(recording.imus.names[:2]))
    built = fragment_energy._frame_energy.cache_info().misses
    study = study_sensors(recording, lifter=planted.PlantedLifter(truth))
    assert fragment_energy._frame_energy.cache_info().misses <= built + 1, "all sets take one compiled problem"
    assert study.has_truth
    assert [len(found.sensors) for found in study.path] == [2, 1, 0]
    assert np.isfinite(study.full.error).any()
    own = study.full.difference[np.isfinite(study.full.difference)]
    np.testing.assert_allclose(own, 0.0, atol=1e-12)
    assert np.nanmax(study.path[-1].difference) > 0
