"""A person's file: round trips, damaged files, merging, and recordings that are silent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.pose_prior import NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, OutputExistsError, RtofError
from rtof_kin.recording.recording import Recording, RecordingReader
from rtof_kin.recording.subject import Estimate, Subject, contradictions, given_by, merged, read_subject, write_subject

NOBODY = Subject.of({"subject": "P07"}, Path("P07.toml"))
SKELETON = SkeletonModel.default()
BY_HAND = """
    subject = "P07"
    height_m = { value = 1.74 }
    mass_kg = { value = 71 }
    sex = { value = "female" }
    [joint_offsets_m]
    LeftLeg = { value = [0.0, 0.0, -0.44], sd = 0.004, source = "laser", date = "2026-01-31" }
    [posture_deg]
    Spine = { value = [0, 10, 0], sd = 4 }
"""


def of(value: Any, sd: float | None = None, source: str = "typed", date: str = "") -> Estimate[Any]:
    return Estimate[Any](
        value=np.array(value, float) if isinstance(value, list) else value, sd=sd, source=source, date=date
    )


def plain(subject: Subject) -> str:
    return repr((subject.subject, subject.skeleton, subject.known, subject.history))


def by_hand(tmp_path: Path, text: str = BY_HAND) -> Subject:
    (tmp_path / "P07.toml").write_text(text, encoding="utf-8")
    return read_subject(tmp_path / "P07.toml")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return planted.recording(planted.human(SKELETON, 8))


# --- files ---------------------------------------------------------------------------------------


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    news = {
        "height_m": of(1.74, date="2026-01-31"),
        "mass_kg": of(71.5, 0.5),
        "sex": of("female"),
        "ankle_height_m": of(0.09, 0.01, "recording 1a2b3c4d"),
        "joint_offsets_m.LeftLeg": of([0.01, 0.0, -0.41], 0.006, "recording 1a2b3c4d"),
        "posture_deg.Spine": of([0.0, 8.2, -1.0], 4.0, 'said "so" in\nÅland \x7f'),
        "image_points_m.halpe 26.LeftLeg": of([0.0, 0.02, 1e-7], 0.008),
        "image_points_m.coco17.LeftLeg": of([0.0, 0.03, 0.0], 0.008),
    }
    subject, said = merged(NOBODY, news)
    subject, refusal = merged(subject, {"height_m": of(1.9, 0.01, "recording 5e6f7a8b")})
    write_subject(tmp_path / "P07.toml", subject)
    again = read_subject(tmp_path / "P07.toml")
    assert plain(again) == plain(subject)
    assert list(again.known) == list(news)
    assert len(said) == len(news)
    assert again.history["height_m"][1].refused in refusal[0]
    with pytest.raises(OutputExistsError):
        write_subject(tmp_path / "P07.toml", subject)
    write_subject(tmp_path / "P07.toml", again, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["P07.toml"]


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ('subject = "P07"', "", "subject: missing; add it: An identifier"),
        ('"P07"', '"Ann Smith"', "subject: 'Ann Smith' is no identifier; use up to 64 letters"),
        ('subject = "P07"', 'subject = "P07"\nname = "Ann"', "unknown field in {file}, line 3 'name'"),
        ('subject = "P07"', 'subject = "P07"\nschema_version = 2', "schema_version: 2 is not one of"),
        ("value = 1.74", "value = 174", "[height_m] value: 174 is no human height; give metres"),
        ("value = 1.74", "valeu = 1.74", "unknown field in {file}, line 3, [height_m] 'valeu'"),
        ("value = 71", "value = 71000", "[mass_kg] value: 71000 is no person's mass; give kilograms"),
        ('"female"', '"f"', "[sex] value: 'f' is not one of female, male"),
        ("sd = 0.004", "sd = -1", "[joint_offsets_m.LeftLeg] sd: -1 is not a positive number"),
        ("[0.0, 0.0, -0.44]", "[0.0, -0.44]", "[joint_offsets_m.LeftLeg] value: expected 3 numbers, got shape (2,)"),
        (
            "[0.0, 0.0, -0.44]",
            "[0, 0, -440]",
            "joint_offsets_m.LeftLeg: is no bone of a person; give its offset in metres",
        ),
        ("LeftLeg =", "LeftKnee =", "line 7, [joint_offsets_m] 'LeftKnee'. Did you mean"),
        ("Spine =", "Back =", "unknown joint in {file}, line 9, [posture_deg] 'Back'"),
        (
            "[posture_deg]",
            "[image_points_m.coco17]\nleft_knee = { value = [0, 0, 0] }\n[posture_deg]",
            "unknown joint in {file}, line 9, [image_points_m.coco17] 'left_knee'",
        ),
        ("{ value = 1.74 }", "1.74", "height_m: not a table; write its fields under [height_m]"),
        ("{ value = 1.74 }", "{ value = 1.74", "not readable as TOML"),
    ],
)
def test_a_damaged_file_is_explained(tmp_path: Path, before: str, after: str, problem: str) -> None:
    assert before in BY_HAND
    with pytest.raises(RtofError) as error:
        by_hand(tmp_path, BY_HAND.replace(before, after))
    assert "P07.toml" in str(error.value)
    assert problem.format(file=tmp_path / "P07.toml") in str(error.value)


def test_a_file_that_is_not_there_is_no_person(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file; --update-subject makes it"):
        read_subject(tmp_path / "P08.toml")


# --- merging -------------------------------------------------------------------------------------


def test_estimates_merge_as_an_information_filter_in_any_order() -> None:
    rng = np.random.default_rng(1)
    sds = rng.uniform(0.012, 0.03, 6)  # whose precisions add to less than what recordings share
    values = np.array([0.01, 0.0, -0.41]) + 0.5 * sds[:, None] * rng.uniform(-1, 1, (6, 3))
    weights = sds**-2 / np.sum(sds**-2)
    for order in (range(6), rng.permutation(6)):
        subject = NOBODY
        for n in order:
            news = {"joint_offsets_m.LeftLeg": of(values[n].tolist(), sds[n], f"recording {n}", f"2026-01-0{n + 1}")}
            subject, _ = merged(subject, news)
        found = subject.joint_offsets_m["LeftLeg"]
        np.testing.assert_allclose(found.value, weights @ values, rtol=0, atol=5e-6)
        assert found.sd == pytest.approx(np.sum(sds**-2) ** -0.5, rel=1e-5)
        assert (found.source, found.date) == ("6 estimates", "2026-01-06")
        assert len(subject.history["joint_offsets_m.LeftLeg"]) == 6


def test_precisions_do_not_add_without_end() -> None:
    subject, leg = NOBODY, "joint_offsets_m.LeftLeg"
    for n in range(50):
        news = {leg: of([0.0, 0.0, -0.4], 0.008, f"recording {n}"), "mass_kg": of(70.0, 3.0, f"recording {n}")}
        subject, _ = merged(subject, news)
    assert (subject.known[leg].sd, subject.known["mass_kg"].sd) == (0.006, 0.5)
    subject, _ = merged(subject, {leg: of([0.0, 0.0, -0.405], 0.001, "magnetic resonance")})
    assert subject.known[leg].sd == 0.001  # one that is better counts as it is
    subject, said = merged(subject, {leg: of([0.0, 0.0, -0.41], 0.008, "recording 51")})
    assert subject.known[leg].sd == pytest.approx(0.001, rel=0.01)
    assert said[0].startswith("joint_offsets_m.LeftLeg: ")


def test_values_without_sd_count_with_the_usual_one() -> None:
    subject, _ = merged(NOBODY, {"height_m": of(1.74)})
    subject, said = merged(subject, {"height_m": of(1.77, 0.02, "recording 1")})
    assert subject.height_m is not None
    assert subject.height_m.value == pytest.approx((1.74 * 4 + 1.77) / 5)
    assert subject.height_m.sd == pytest.approx(0.01 * 0.8**0.5, rel=1e-5)
    assert said == ("height_m: 1.74 ± 0.01 -> 1.746 ± 0.0089",)


def test_an_outlier_is_refused_with_a_reason_and_nothing_is_lost(tmp_path: Path) -> None:
    subject = by_hand(tmp_path)
    before = subject.known
    news = {"height_m": of(1.82, 0.01, "recording 1", "2026-02-03"), "sex": of("male", source="recording 1")}
    subject, said = merged(subject, news)
    assert said == (
        "height_m is refused: 1.82 is 5.7 standard deviations (0.014) from 1.74",
        "sex is refused: male is not female",
    )
    assert repr(subject.known) == repr(before)
    first, second = subject.history["height_m"]
    assert (first.value, first.refused) == (1.74, "")  # what stood in the file
    assert (second.value, second.sd, second.source, second.date) == (1.82, 0.01, "recording 1", "2026-02-03")
    assert "5.7 standard deviations" in second.refused
    assert merged(subject, news)[0].history == subject.history  # once
    subject, said = merged(subject, {"height_m": of(1.75, 0.01, "recording 2")})
    assert len(said) == 1
    assert subject.height_m is not None
    assert (subject.height_m.value, subject.height_m.source) == (1.745, "2 estimates")


def test_with_a_doubt_nothing_is_merged() -> None:
    subject, said = merged(NOBODY, {"height_m": of(1.74)}, doubt="it is another person")
    assert said == ("nothing is merged: it is another person",)
    assert subject.known == {}
    assert subject.history["height_m"][0].refused == "it is another person"


def test_one_source_and_one_typed_value_count_once() -> None:
    news = {"height_m": of(1.74, source="recording 1"), "mass_kg": of(70.0, 1.0, "recording 1")}
    subject, _ = merged(NOBODY, news)
    assert merged(subject, news) == (subject, ())
    again, said = merged(subject, {"height_m": of(1.74, source="recording 2"), "mass_kg": of(70.0, 1.0, "recording 2")})
    assert [line.partition(":")[0] for line in said] == ["mass_kg"]  # measured anew, where the height was typed again
    assert again.height_m == subject.height_m


# --- recordings ----------------------------------------------------------------------------------


def test_a_silent_recording_gets_what_the_file_knows(tmp_path: Path, recording: Recording) -> None:
    subject = by_hand(tmp_path)
    found = recording.with_facts(**subject.informed(recording))
    assert (found.height, found.mass_kg, found.sex) == (1.74, 71, "female")
    assert found.posture is not None
    np.testing.assert_allclose(so3.log(found.posture.R_parent_bone), np.radians([[0, 10, 0]]), atol=1e-12)
    usual = SKELETON.with_height(1.74)
    bones = dict(usual.bone_lengths) | {"LeftLeg": 0.44}
    np.testing.assert_allclose([*found.skeleton.bone_lengths.values()], [*bones.values()], atol=1e-12)
    np.testing.assert_array_equal(found.video.uv_px, recording.video.uv_px)


def test_points_in_the_image_are_moved_without_sensors_by_the_share_that_is_known(recording: Recording) -> None:
    shift, sd = np.array([0.02, 0.0, -0.01]), 0.03
    subject, _ = merged(NOBODY, {"image_points_m.mediapipe33.LeftLeg": of(shift.tolist(), sd)})
    assert "image_points" not in subject.informed(recording)
    alone = replace(recording, imus=None, calibration=None)
    found = alone.with_facts(**subject.informed(alone)).skeleton.table.image_points
    np.testing.assert_allclose(found["mediapipe33"]["LeftLeg"], shift * 0.015**2 / (0.015**2 + sd**2))


def test_what_a_recording_gives_is_not_replaced(tmp_path: Path, recording: Recording) -> None:
    subject = by_hand(tmp_path)
    own = NeutralPosture(("Spine1",), np.array([[1.0, 0, 0, 0]]))
    given = replace(
        recording, joint_offsets=SKELETON.with_bone_lengths({"LeftLeg": 0.43}).joint_offsets, height=1.75, posture=own
    )
    facts = subject.informed(given)
    assert facts.pop("session").subject == subject.subject  # of nobody, as the recording has it
    assert facts == {"mass_kg": 71, "sex": "female"}
    named = replace(given, session=replace(given.session, subject="walker", place="Geneva"))
    assert "session" not in subject.informed(named)
    assert contradictions(subject, given) == ("", ())
    assert set(given_by(given, "")) == {"height_m", "posture_deg.Spine1"} | {
        f"joint_offsets_m.{joint}" for joint in SKELETON.names[1:]
    }
    assert set(subject.informed(replace(recording, joint_offsets=None, height=1.75))) == {
        "session",
        "mass_kg",
        "sex",
        "joint_offsets",
        "posture",
        "sigma_bones",
    }


def test_bones_of_the_file_are_estimated_again_within_their_standard_deviations(recording: Recording) -> None:
    def sigma(count: int, sd: float) -> float:
        joints = SKELETON.names[1 : 1 + count]
        news = {f"joint_offsets_m.{n}": of(SKELETON.joint_offsets[SKELETON.index(n)[0]].tolist(), sd) for n in joints}
        subject, _ = merged(NOBODY, news)
        priors = CalibrationPriors.of(recording.with_facts(**subject.informed(recording)))
        assert priors.sigma_size is not None
        assert priors.sigma_size == priors.sigma_proportion
        return float(np.hypot(priors.sigma_size, priors.sigma_size))

    length = np.sqrt(np.mean(np.square([*SKELETON.bone_lengths.values()])))
    assert sigma(20, 0.002) == pytest.approx(0.002 / length)
    assert sigma(20, 0.2) == sigma(1, 0.2) == 0.036
    assert 0.002 / length < sigma(10, 0.002) < 0.036  # the others are as unknown as by the height
    assert CalibrationPriors.of(recording).sigma_size == 0.05


def test_a_recording_of_another_person_is_named(tmp_path: Path, recording: Recording) -> None:
    subject = by_hand(tmp_path)
    assert contradictions(subject, recording) == ("", ())
    other = replace(recording, joint_offsets=None, height=1.86, sex="male")
    assert contradictions(subject, other) == (
        "P07.toml is likely of another person and is not used: height_m 1.86 is 8.5 standard deviations (0.014) from "
        "1.74 (and 1 more)",
        (),
    )
    for facts in ({"mass_kg": 90.0, "sex": "male"}, {"mass_kg": 90.0, "bone_lengths": {"LeftLeg": 0.5}}):
        doubt, remarks = contradictions(subject, replace(recording, joint_offsets=None, **facts))
        assert doubt.startswith("P07.toml is likely of another person and is not used: mass_kg 90 is ")
        assert remarks == ()


@pytest.mark.parametrize(
    ("facts", "path"),
    [
        ({"mass_kg": 90.0}, "mass_kg"),
        ({"sex": "male"}, "sex"),
        ({"bone_lengths": {"LeftLeg": 0.5}}, "joint_offsets_m.LeftLeg"),
    ],
)
def test_one_other_value_is_the_recordings_and_the_rest_of_the_file_counts(
    tmp_path: Path, recording: Recording, facts: dict[str, Any], path: str
) -> None:
    subject = by_hand(tmp_path)
    given = replace(recording, joint_offsets=None, **facts)
    doubt, (remark,) = contradictions(subject, given)
    assert doubt == ""
    assert remark.startswith(f"P07.toml has another {path}, which is not used: ")
    (field,) = facts
    assert field not in subject.informed(given)
    assert subject.informed(given)["height"] == 1.74


def test_both_sides_of_a_bone_are_one_value(tmp_path: Path, recording: Recording) -> None:
    subject, _ = merged(by_hand(tmp_path), {"joint_offsets_m.RightLeg": of([0.0, 0.0, -0.44], 0.004)})
    given = replace(recording, joint_offsets=None, bone_lengths={"LeftLeg": 0.5, "RightLeg": 0.5})
    doubt, remarks = contradictions(subject, given)
    assert (doubt, len(remarks)) == ("", 2)


def test_bones_that_follow_the_height_are_not_given(recording: Recording) -> None:
    measured = replace(recording, joint_offsets=None, height=1.9, bone_lengths={"LeftLeg": 0.45})
    assert set(given_by(measured, "")) == {"height_m", "joint_offsets_m.LeftLeg"}


def test_bones_and_posture_of_another_skeleton_are_not_used(tmp_path: Path, recording: Recording) -> None:
    subject = by_hand(tmp_path, BY_HAND.replace('"P07"', '"P07"\nskeleton = "human36m"').replace("LeftLeg", "LKnee"))
    assert set(subject.informed(recording)) == {"session", "height", "mass_kg", "sex"}


def test_a_reader_gets_the_same(tmp_path: Path, recording: Recording) -> None:
    subject = by_hand(tmp_path)
    recording.save(tmp_path / "recording")
    with RecordingReader.open(tmp_path / "recording") as reader:
        found = reader.with_facts(**subject.informed(reader.facts))
        wanted = recording.with_facts(**subject.informed(recording))
        assert found.whole().digest() == found.digest() == wanted.digest() != recording.digest()


def test_the_example_of_the_page_is_a_file_with_every_field(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/subject.md").read_text(encoding="utf-8")
    subject = by_hand(tmp_path, page.partition("```toml\n")[2].partition("```")[0])
    assert subject.model_fields_set == set(Subject.model_fields)
    first, second = subject.history["joint_offsets_m.LeftLeg"]
    found, _ = merged(merged(NOBODY, {"joint_offsets_m.LeftLeg": first})[0], {"joint_offsets_m.LeftLeg": second})
    np.testing.assert_allclose(
        found.joint_offsets_m["LeftLeg"].value, subject.joint_offsets_m["LeftLeg"].value, atol=5e-4
    )
    assert found.joint_offsets_m["LeftLeg"].sd == pytest.approx(subject.joint_offsets_m["LeftLeg"].sd, abs=5e-5)
