"""Corrections by hand in ``recording.toml``: what they do to samples, solve and analysis, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clinical_support import body_paths
from numpy.testing import assert_array_equal

from rtof_kin.body.motion_file import MotionReader, write_motion
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.core.errors import RtofError
from rtof_kin.core.resources import model_path
from rtof_kin.data.corrections import Correction
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.index import read_corrections, write_corrections
from rtof_kin.recording.recording import Recording, RecordingReader
from rtof_kin.recording.streams import corrected
from rtof_kin.reporting.export import export
from rtof_kin.reporting.page import report

BY = 'who = "AB"\nwhen = "2026-11-28T10:15"\nwhy = "a helper"\n'


@pytest.fixture(scope="module")
def short() -> Recording:
    demo = Recording.load(model_path("demo"))
    return demo.between(demo.start_s, demo.start_s + 2.0)


def written(recording: Recording, folder: Path, *texts: str) -> Path:
    recording.save(folder)
    with (folder / "recording.toml").open("a", encoding="utf-8") as file:
        file.writelines(f"\n[[corrections]]\n{text}\n{BY}" for text in texts)
    return folder


def test_left_out_parts_are_missing_and_nothing_else_is_changed(short: Recording, tmp_path: Path) -> None:
    start, stop = short.start_s + 0.5, short.start_s + 1.0
    span = f"start_s = {start}\nstop_s = {stop}"
    assert short.imus is not None
    sensor = short.imus.names[1]
    folder = written(
        short,
        tmp_path / "a",
        f'kind = "leave_out"\nwhat = "image"\n{span}',
        f'kind = "leave_out"\nwhat = "{sensor}"\nstart_s = {stop}',
    )
    found = Recording.load(folder)
    assert found.imus is not None
    gone = (short.video.times >= start) & (short.video.times <= stop)
    assert 10 < gone.sum() < len(gone)
    assert not found.video.confidence[gone].any()
    assert_array_equal(found.video.uv_px[~gone], short.video.uv_px[~gone])
    late = short.imus.times >= stop
    assert np.isnan(found.imus.f_sensor[late, 1]).all()
    assert np.isnan(found.imus.R_inertial_sensor[late, 1]).all()
    assert_array_equal(found.imus.f_sensor[~late], short.imus.f_sensor[~late])
    assert_array_equal(found.imus.f_sensor[:, 0], short.imus.f_sensor[:, 0])


def test_exchanged_sides_are_exchanged_once_however_it_is_read_and_saved(short: Recording, tmp_path: Path) -> None:
    middle = short.start_s + 1.0
    folder = written(short, tmp_path / "a", f'kind = "exchange_sides"\nstop_s = {middle}')
    found = Recording.load(folder)
    left, right = short.video.names.index("LeftFoot"), short.video.names.index("RightFoot")
    early = short.video.times <= middle
    assert_array_equal(found.video.uv_px[early, left], short.video.uv_px[early, right])
    assert_array_equal(found.video.uv_px[~early, left], short.video.uv_px[~early, left])
    found.save(tmp_path / "b")
    again = Recording.load(tmp_path / "b")
    assert_array_equal(again.video.uv_px, found.video.uv_px)
    assert [one.why for one in again.corrections] == ["a helper"]
    with RecordingReader.open(folder) as reader:
        part = reader.between(short.start_s + 0.5, short.start_s + 1.5)
    assert_array_equal(part.video.uv_px, found.between(short.start_s + 0.5, short.start_s + 1.5).video.uv_px)


def test_points_of_a_detector_are_exchanged_with_their_other_side(short: Recording, tmp_path: Path) -> None:
    points = {"LeftFoot": "coco17:LeftAnkle", "RightFoot": "coco17:RightAnkle"}
    names = tuple(points.get(name, name) for name in short.video.names)
    other = replace(short, keypoints=replace(short.video, names=names))
    streams = corrected(other.streams, [Correction("exchange_sides")], Path())
    assert streams.keypoints is not None
    found = streams.keypoints.part(slice(None))
    left, right = map(names.index, points.values())
    assert_array_equal(found.uv_px[:, left], short.video.uv_px[:, right])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('kind = "leave_out"', "says not what is left out"),
        ('kind = "leave_out"\nwhat = "L_UpArn"', "L_UpA"),
        ('kind = "leave_out"\nwhat = "image"\nstart_s = 2.0\nstop_s = 1.0', "stops at 1 s, not after 2 s"),
        ('kind = "foot_strike"\nwhat = "left"', "has no instant"),
        ('kind = "foot_strike"\nwhat = "heel"\nstart_s = 1.0', "is no foot"),
        ('kind = "repetition"\nwhat = "hop"\nstart_s = 1.0\nstop_s = 2.0', "is not repeated"),
        ('kind = "stride"\nwhat = "left"\nstart_s = 1.0', "has no start and stop"),
        ('kind = "leave_it"', "leave_out"),
    ],
)
def test_what_says_nothing_sensible_is_refused_with_file_and_remedy(
    short: Recording, tmp_path: Path, text: str, said: str
) -> None:
    folder = written(short, tmp_path / "a", text)
    with pytest.raises(RtofError, match=said) as caught:
        Recording.load(folder)
    assert "recording.toml" in str(caught.value)


def test_the_report_says_who_corrected_what_and_the_motion_keeps_it(short: Recording, tmp_path: Path) -> None:
    start = short.start_s
    squat = f'kind = "repetition"\nwhat = "squat"\nstart_s = {start + 0.2}\nstop_s = {start + 1.8}'
    folder = written(short, tmp_path / "a", f'kind = "leave_out"\nwhat = "image"\nstop_s = {start + 0.2}', squat)
    result = reconstruct(Recording.load(folder), mode="lift")
    assert [one.kind for one in result.motion.corrections] == ["leave_out", "repetition"]
    export(result, tmp_path / "out", formats=())
    page = report(tmp_path / "out")
    assert "Corrected by hand 2 times" in page
    assert "by AB, 2026-11-28T10:15: a helper" in page
    analysis = analyse(tmp_path / "out")
    assert analysis.repetitions is not None
    (squatted,) = analysis.repetitions.repetitions
    assert squatted.descent is not None
    assert squatted.ascent is not None
    assert squatted.descent[0] == pytest.approx(start + 0.2)
    assert squatted.ascent[1] == pytest.approx(start + 1.8)


def test_gait_events_by_hand_replace_those_that_were_found(motion: Motion, tmp_path: Path) -> None:
    first, last = motion.times[[0, -1]]
    marks = (
        Correction("no_event", "left", first, last),
        Correction("stride", "left", first + 0.1, first + 0.3),
        Correction("foot_off", "left", first + 0.2),
    )
    write_motion(tmp_path / "motion.h5", replace(motion, corrections=marks))
    with MotionReader(tmp_path / "motion.h5") as reader:
        assert reader.corrections == marks
        found = gait_events(body_paths(reader)).feet["left"]
    assert_array_equal(found.strikes, [first + 0.1, first + 0.3])
    assert_array_equal(found.offs, [first + 0.2])


def test_corrections_are_written_beside_what_a_person_wrote_and_taken_back(short: Recording, tmp_path: Path) -> None:
    folder = written(short, tmp_path / "a", 'kind = "exchange_sides"')
    path = folder / "recording.toml"
    path.write_text(f"# measured in the hall\n{path.read_text()}\n[scene]\nfloor_height_m = 0.0 # by tape\n")
    before = read_corrections(folder)
    added = Correction("leave_out", "image", 1.0, 2.0, "CD", "2026-11-29T08:00", 'a "rail"\nin front')
    write_corrections(folder, [*before, added])
    assert read_corrections(folder) == (*before, added)
    text = path.read_text()
    assert "# measured in the hall" in text
    assert "floor_height_m = 0.0 # by tape" in text
    with pytest.raises(RtofError, match="is no foot"):
        write_corrections(folder, [replace(added, kind="foot_contact", what="hand")])
    assert path.read_text() == text
    write_corrections(folder, [])
    assert read_corrections(folder) == ()
    assert Recording.load(folder).floor_height == 0.0


def test_a_folder_that_only_the_package_wrote_stays_its_own(short: Recording, tmp_path: Path) -> None:
    short.save(tmp_path / "a")
    write_corrections(tmp_path / "a", [Correction("exchange_sides")])
    short.save(tmp_path / "a", overwrite=True)
    assert read_corrections(tmp_path / "a") == ()
    write_corrections(tmp_path / "a", [Correction("exchange_sides")])
    with (tmp_path / "a/recording.toml").open("a") as file:
        file.write("# mine\n")
    write_corrections(tmp_path / "a", [])
    with pytest.raises(RtofError, match="never replaced"):
        short.save(tmp_path / "a", overwrite=True)


def test_a_foot_that_stands_is_held_in_the_solve(short: Recording) -> None:
    settings = ReconstructionSettings(guards=(), confidence=False)
    one = short.between(short.start_s, short.start_s + 0.8)
    span = one.start_s + 0.2, one.start_s + 0.6

    def way(*corrections: Correction) -> float:
        motion = reconstruct(replace(one, corrections=corrections), mode="rto", settings=settings).motion
        own = (motion.times >= span[0]) & (motion.times <= span[1])
        foot = motion.poses.p_world_joint[own, motion.skeleton.names.index("LeftFoot")]
        return float(np.ptp(foot, axis=0).max())

    free = way()
    assert free > 0.02
    assert way(Correction("foot_contact", "left", *span)) < 0.5 * free
