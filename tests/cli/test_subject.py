"""The options --subject and --update-subject."""

from __future__ import annotations

import json
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import walking, watching
from marker_support import planted
from setup_support import beside, walker, write_keypoints

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.markers import write_trc
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import read_subject


def test_a_recording_makes_the_file_and_another_one_uses_it(short: Path, tmp_path: Path, cli: Any) -> None:
    file, take = tmp_path / "P07.toml", Recording.load(short)
    options = ("--mode", "lift", "--subject", file)
    done = cli.ok("reconstruct", short, "-o", tmp_path / "a", *options, "--update-subject")
    done.says("subject P07: joint_offsets_m.LeftLeg: ")
    leg = take.skeleton.index("LeftLeg")[0]
    np.testing.assert_allclose(read_subject(file).joint_offsets_m["LeftLeg"].value, take.joint_offsets[leg])
    text = file.read_text()
    digest = json.loads((tmp_path / "a" / "summary.json").read_text())["run"]["recording_sha256"]
    assert f"recording {digest[:8]}" in text
    assert take.name not in text
    cli.ok("reconstruct", short, "-o", tmp_path / "b", *options, "--update-subject").says("P07: nothing new in this")
    person = json.loads((tmp_path / "b" / "summary.json").read_text())["run"]["person"]
    assert (person["subject"], person["sd_joint_offsets_m"]) == ("P07", pytest.approx(0.01))
    cli.ok("export", tmp_path / "b", tmp_path / "b.zip", "--to", "archive", "--recording", short)
    with zipfile.ZipFile(tmp_path / "b.zip") as archive:
        assert b"P07" not in archive.read("result/summary.json")
    silent = tmp_path / "silent"
    replace(take, joint_offsets=None, bone_lengths=None, height=None).save(silent)
    cli.ok("batch", silent.parent, "-o", tmp_path / "c", "--chain", f"reconstruct {' '.join(map(str, options))}")
    (motion,) = (tmp_path / "c").rglob("summary.json")
    run = json.loads(motion.read_text())["run"]
    assert run["subject_sha256"]
    assert run["person"] == person  # the same bones, whether the recording gives them or the file


def test_the_file_of_another_person_is_named_first(short: Path, tmp_path: Path, cli: Any) -> None:
    file = tmp_path / "P07.toml"
    file.write_text('subject = "P07"\nheight_m = { value = 1.2 }\n')
    options = ("--mode", "lift", "--subject", file)
    done = cli.ok("reconstruct", short, "-o", tmp_path / "out", *options, "--update-subject")
    sentence = "P07.toml is likely of another person and is not used: height_m 1.73"
    done.says(f"subject P07: nothing is merged: {sentence}")
    assert sentence in done.out[: len(done.out) // 2]
    kept = tomllib.loads(file.read_text())
    assert kept["height_m"] == {"value": 1.2}
    assert all(rows[-1]["refused"] for rows in kept["history"].values())


def test_run_takes_the_height_from_the_file_and_events_of_another_program(tmp_path: Path, cli: Any) -> None:
    file, seen = tmp_path / "P07.toml", beside(walker(), 0.4, (1100.0, 400.0))
    given, camera = write_keypoints(tmp_path / "walk.npz", walker(), seen), tmp_path / "calib.toml"
    write_camera_toml(camera, {"camera": watching(walking())})
    command = ("run", given, camera, "-o", tmp_path / "out", "--no-figures", "--no-certificate", "--subject", file)
    assert "no such file; --update-subject makes it" in cli.refused(*command).err
    assert "height is not given" in cli.refused(*command, "--update-subject").err
    (tmp_path / "events.txt").write_text("\tLHS\nITEM\tX\n1\t0.75\n")
    command = (*command, "--events", tmp_path / "events.txt")
    file.write_text('subject = "P07"\nheight_m = { value = 1.72, sd = 0.01 }\nmass_kg = { value = 70 }\n')
    cli.ok(*command, "--update-subject").says("the person is 1.72 m tall", "subject P07: ")
    with MotionReader(tmp_path / "out" / "motion") as motion:
        assert [(one.kind, one.what, one.start_s) for one in motion.corrections][1:] == [("foot_strike", "left", 0.75)]
    text = file.read_text()
    assert "height_m = { value = 1.72, sd = 0.01 }" in text  # it does not count again
    again = cli.ok(*command, "--update-subject")
    assert "motion: its inputs are the same; kept" in again.err
    assert file.read_text() == text


def test_markers_give_bones(tmp_path: Path, cli: Any) -> None:
    write_trc(tmp_path / "trial.trc", planted(5, frames=60).markers)
    file = tmp_path / "P07.toml"
    options = ("-o", tmp_path / "out", "--marker-set", "plug_in_gait", "--subject", file, "--update-subject")
    cli.ok("reconstruct", tmp_path / "trial.trc", *options).says("subject P07: joint_offsets_m.LeftLeg: ")
    assert read_subject(file).joint_offsets_m["LeftLeg"].source.startswith("markers ")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--update-subject",), "add --subject FILE"),
        (("--subject", "P07.toml", "--calibration", "c.toml"), "give only one of the two"),
        (("--subject", "P07.toml", "--calibrate-only"), "leave out --calibrate-only, or --subject"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    short: Path, tmp_path: Path, cli: Any, options: tuple[str, ...], problem: str
) -> None:
    assert problem in cli.refused("reconstruct", short, "-o", tmp_path / "out", *options).err
