"""Commands bundle and reproduce: the same bytes, the same bits, nothing that tells who; hostile files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.batch.bundle_file import MANIFEST
from rtof_kin.core.files.archive import write_archive
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.session import Session

ROOT = Path(__file__).parents[2]
SESSION = Session("Jane Roe", "Otto Mann", "2026-01-31", "Gait Lab 4", "squats")
QUICK = ("--mode", "sf2", "--no-figures")


@pytest.fixture(scope="module")
def named(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a second with every label, beside a video."""
    folder = tmp_path_factory.mktemp("Roe_Jane") / "take 7"
    two = Recording.load(short)
    labels = {"name": "Roe, left knee", "session": SESSION, "notes": "Jane limps", "acknowledgement": "by Ms Roe"}
    replace(two, keypoints=two.video[:60], **labels).save(folder)  # type: ignore[arg-type]
    (folder / "jane.mp4").write_bytes(b"\0\0\0\x18ftypmp42 GPS +52.5+13.4 Jane")
    return folder


@pytest.fixture(scope="module")
def result(named: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from rtof_kin.cli import main

    out = tmp_path_factory.mktemp("results") / "out"
    assert main(["reconstruct", str(named), "-o", str(out), *QUICK]) == 0
    return out


@pytest.fixture(scope="module")
def bundle(named: Path, result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from rtof_kin.cli import main

    path = tmp_path_factory.mktemp("bundles") / "study.rtof"
    assert main(["bundle", str(result), "--recording", str(named), "-o", str(path)]) == 0
    return path


def claimed(result: Path, recording: Path, out: Path) -> Path:
    """Copy a result that says it was made from another recording."""
    shutil.copytree(result, out)
    summary = json.loads((out / "summary.json").read_text())
    summary["run"]["recording_sha256"] = Recording.load(recording).digest()
    (out / "summary.json").write_text(json.dumps(summary))
    return out


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def sealed(path: Path, contents: dict[str, bytes]) -> Path:
    """Write a bundle whose hashes fit, as a forger would."""
    manifest = json.loads(contents.pop(MANIFEST))
    manifest["sha256"] = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    return resealed(path, contents, manifest)


def resealed(path: Path, contents: dict[str, bytes], manifest: Any) -> Path:
    text = json.dumps(manifest).encode()
    write_archive(path, {MANIFEST: text} | contents, hashlib.sha256(text).hexdigest())
    return path


def changed_motion(content: bytes, folder: Path, by: float) -> bytes:
    (folder / "old.npz").write_bytes(content)
    arrays = dict(np.load(folder / "old.npz"))
    arrays["q"] = arrays["q"] + by * (np.arange(arrays["q"].shape[1]) < 3)
    np.savez(folder / "new.npz", **arrays)
    return (folder / "new.npz").read_bytes()


def test_bundle_is_the_same_bytes_and_reproduces_bit_by_bit_in_another_process(
    cli: Any, bundle: Path, named: Path, result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cli("bundle", result, "--recording", named.parent, "-o", "again.rtof")
    assert done.code == 0, done.err
    assert Path("again.rtof").read_bytes() == bundle.read_bytes()
    assert (
        "left out S01-1: title, name of the subject, operator, date, place, protocol, notes, acknowledgement"
        in done.out
    )
    assert "kept S01-1: lengths of the body, keypoints of 1 camera" in done.out
    other = {**os.environ, "PYTHONHASHSEED": "5", "PYTHONPATH": str(ROOT)}
    line = ("reproduce", "again.rtof", "-o", "unpacked", "--threads", "2")
    done = subprocess.run([sys.executable, "-m", "rtof_kin.cli", *line], capture_output=True, text=True, env=other)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("reproduced bit by bit\nagain.rtof: intact, 8 members as bundled")
    assert "-> 2\n" in done.stdout  # threads
    first, again = (Path("unpacked", name, "motion.npz").read_bytes() for name in ("results/1", "reproduced/1"))
    assert first == again == (result / "motion.npz").read_bytes()
    for command in (
        ("report", "unpacked/results/1", "-o", "page.html"),
        ("analyse", "unpacked/results/1", "-o", "a", "--no-figures"),
    ):
        assert cli(*command).code == 0
    assert "Jane" not in Path("page.html").read_text()


def test_nothing_in_a_bundle_tells_who_where_or_when(bundle: Path, named: Path) -> None:
    contents = members(bundle)
    assert not [name for name in contents if not name.endswith((".npz", ".json", ".toml", ".urdf"))]
    text = b"".join(content for name, content in contents.items() if not name.endswith(".npz")).decode()
    words = ("Jane", "Roe", "Otto", "Mann", "Gait Lab", "2026-01-31", "squats", "take 7", "left knee", "mp4")
    assert not [word for word in words if word in text]
    assert str(named.parent) not in text
    assert 'subject = "S01"' in contents["recordings/S01-1/recording.toml"].decode()
    assert {info.date_time for info in zipfile.ZipFile(bundle).infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_planted_leak_is_refused_with_its_place(cli: Any, named: Path, result: Path, tmp_path: Path) -> None:
    out = shutil.copytree(result, tmp_path / "out")
    summary = json.loads((out / "summary.json").read_text())
    planted = {"warnings": ["keypoints of /home/x/take.csv are few"], "stream_faults": ["Ms ROE turned"]}
    (out / "summary.json").write_text(json.dumps(summary | planted))
    given = ("bundle", out, "--recording", named, "-o", tmp_path / "b.rtof")
    done = cli(*given)
    assert done.code == 2
    assert "results/1/summary.json, warnings[0]: an absolute path, '/home/x" in done.err
    assert "results/1/summary.json, stream_faults[0]: a name, 'ROE'" in done.err
    assert not (tmp_path / "b.rtof").exists()
    assert cli(*given, "--redact").code == 0
    kept = json.loads(members(tmp_path / "b.rtof")["results/1/summary.json"])
    assert "left out" in kept["warnings"][0]
    assert kept["audit"] == summary["audit"]


def test_labels_are_kept_on_request_and_searched_for_names(cli: Any, named: Path, result: Path, tmp_path: Path) -> None:
    given = ("bundle", result, "--recording", named, "-o", tmp_path / "b.rtof")
    done = cli(*given, "--keep", "notes")
    assert done.code == 2
    assert "recording.toml, line" in done.err
    assert "a name, 'Jane'" in done.err
    assert cli(*given, "--keep", "date", "--keep", "protocol", "--id", "P-07").code == 0
    index = members(tmp_path / "b.rtof")["recordings/P-07-1/recording.toml"].decode()
    assert '"2026-01-31"' in index
    assert "squats" in index
    assert 'subject = "P-07"' in index
    done = cli("bundle", result, "--recording", named, "-o", tmp_path / "c.rtof", "--forbid", "L_UpArm")
    assert done.code == 2


def test_name_of_a_sensor_and_wall_clock_times_are_refused(cli: Any, named: Path, result: Path, tmp_path: Path) -> None:
    recording = Recording.load(named)
    assert recording.imus is not None
    assert recording.calibration is not None
    names = ("Jane_arm", *recording.imus.names[1:])
    imus = replace(recording.imus, names=names)
    calibration = replace(recording.calibration, sensors=tuple(names))
    replace(recording, imus=imus, calibration=calibration).save(tmp_path / "sensor")
    shift = 1_769_900_000.0
    video = replace(recording.video, times=recording.video.times + shift)
    imus = replace(recording.imus, times=recording.imus.times + shift)
    replace(recording, keypoints=video, imus=imus, truth=None).save(tmp_path / "clock")
    for take, found in (("sensor", "a name, 'Jane"), ("clock", "times: times that count from a date")):
        out = claimed(result, tmp_path / take, tmp_path / f"{take}_out")
        done = cli("bundle", out, "--recording", tmp_path / take, "-o", tmp_path / "b.rtof")
        assert done.code == 2
        assert found in done.err


def test_output_without_its_recording_or_record_is_refused(
    cli: Any, named: Path, short: Path, result: Path, tmp_path: Path
) -> None:
    done = cli("bundle", result, "--recording", short, "-o", tmp_path / "b.rtof")
    assert done.code == 2
    assert "none of the recordings given is the one that it was made from" in done.err
    out = shutil.copytree(result, tmp_path / "out")
    summary = json.loads((out / "summary.json").read_text())
    del summary["run"]
    (out / "summary.json").write_text(json.dumps(summary))
    done = cli("bundle", out, "--recording", named, "-o", tmp_path / "b.rtof")
    assert "does not say how it was made" in done.err


def test_own_calibration_and_settings_travel_with_the_bundle(cli: Any, named: Path, tmp_path: Path) -> None:
    from rtof_kin.calibration.result import Quantity, SelfCalibration, write_self_calibration_toml

    ankle = Quantity("ankle height", "feet", *(np.array([v]) for v in (0.01, 0.01, 0.02)), 0.5)
    write_self_calibration_toml(tmp_path / "known.toml", SelfCalibration((ankle,), (), 0.0, True))
    torch = pytest.importorskip("torch")
    torch.save(torch.load(model_path("lifter_perfect.pt"), weights_only=True), tmp_path / "own.pt")
    options = ("--calibration", tmp_path / "known.toml", "--no-guards", "--model", tmp_path / "own.pt")
    assert cli("reconstruct", named, "-o", tmp_path / "out", *QUICK, *options).code == 0
    given = ("bundle", tmp_path / "out", "--recording", named, "-o", tmp_path / "b.rtof")
    assert "name its file by --with FILE" in cli(*given).err
    done = cli(*given, "--with", tmp_path / "known.toml", "--with", tmp_path / "own.pt", "--verify")
    assert done.code == 0, done.err
    assert "reproduced bit by bit" in done.out
    run = json.loads(members(tmp_path / "b.rtof")[MANIFEST])["runs"][0]
    assert run["run"]["options"]["guards"] == []
    assert {use: name[:6] + name[22:] for use, name in run["files"].items()} == {
        "calibration": "files/.toml",
        "model": "files/.pt",
    }
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["settings"]["lifter"] == "own.pt"  # not its folder


def test_changed_missing_and_added_members_are_named(cli: Any, bundle: Path, tmp_path: Path) -> None:
    whole = bundle.read_bytes()
    at = whole.index(b"recordings/S01-1/imus.npz") + 5000
    (tmp_path / "flipped.rtof").write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    contents, seal = members(bundle), zipfile.ZipFile(bundle).comment.decode()
    less = {name: content for name, content in contents.items() if "truth" not in name}
    write_archive(tmp_path / "less.rtof", less, seal)
    write_archive(tmp_path / "more.rtof", contents | {"files/run.py": b"1"}, seal)
    edited = contents | {MANIFEST: contents[MANIFEST].replace(b'"sf2"', b'"rto"')}
    write_archive(tmp_path / "edited.rtof", edited, seal)
    (tmp_path / "cut.rtof").write_bytes(whole[: len(whole) // 2])
    for name, said in {
        "flipped": "changed: the member recordings/S01-1/imus.npz",
        "less": "changed: the member recordings/S01-1/truth.npz is missing",
        "more": "changed: the member files/run.py was added",
        "edited": "changed: manifest.json is not as it was bundled",
        "cut": "damaged, or no archive",
    }.items():
        done = cli("reproduce", tmp_path / f"{name}.rtof", "--check-only", "-o", tmp_path / "out")
        assert (done.code, said in done.err) == (2, True), done
        assert not (tmp_path / "out").exists()
    assert "intact, 8 members" in cli("reproduce", bundle, "--check-only").out


def _linked(archive: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("results/1/motion.npz")
    info.create_system, info.external_attr = 3, 0o120777 << 16
    archive.writestr(info, "/etc/passwd")


def _bomb(archive: zipfile.ZipFile) -> None:
    archive.writestr("results/1/motion.npz", bytes(300 * 2**20), zipfile.ZIP_DEFLATED, compresslevel=1)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda a: a.writestr("../outside.toml", "x"), "leads out of the archive"),
        (lambda a: a.writestr("/etc/cron.d/x", "x"), "leads out of the archive"),
        (lambda a: a.writestr("results\\..\\x", "x"), "leads out of the archive"),
        (_linked, "is no regular file"),
        (_bomb, "which no recording does"),
        (lambda a: a.writestr("results/1/Motion.npz", "x"), "stands in it twice"),
    ],
)
def test_hostile_archives_are_not_unpacked(
    cli: Any, bundle: Path, tmp_path: Path, write: Callable[[zipfile.ZipFile], None], said: str
) -> None:
    path = tmp_path / "in" / "hostile.rtof"
    path.parent.mkdir()
    shutil.copyfile(bundle, path)
    if write in (_linked, _bomb):
        path.unlink()
    with zipfile.ZipFile(path, "a") as archive:
        write(archive)
    done = cli("reproduce", path, "-o", tmp_path / "in" / "out")
    assert (done.code, said in done.err) == (2, True), done.err
    assert [p.name for p in tmp_path.rglob("*")] == ["in", "hostile.rtof"]


def test_member_that_no_bundle_has_and_hostile_settings_are_refused(cli: Any, bundle: Path, tmp_path: Path) -> None:
    contents = members(bundle)
    path = sealed(tmp_path / "video.rtof", contents | {"recordings/S01-1/jane.mp4": b"film"})
    assert "is nothing that a bundle has" in cli("reproduce", path).err
    manifest = json.loads(contents.pop(MANIFEST))
    for number, (where, value, said) in enumerate(
        [
            ("frames", 10**9, "the option frames = '1000000000', which cannot be"),
            ("guards", "all", "the option guards"),
            ("model", "/etc/passwd", "has the option 'model', unknown here"),
        ]
    ):
        other = json.loads(json.dumps(manifest))
        other["runs"][0]["run"]["options"][where] = value
        path = resealed(tmp_path / f"{number}.rtof", dict(contents), other)
        assert said in cli("reproduce", path).err
    manifest["runs"][0]["recording"] = "../../etc"
    path = resealed(tmp_path / "place.rtof", contents, manifest)
    assert "is no folder of a bundle" in cli("reproduce", path).err


@pytest.mark.parametrize(
    ("by", "code", "said"),
    [(2e-4, 3, "reproduced, not bit by bit: joints differ by up to 0.35 mm"), (0.1, 1, "NOT reproduced: joints")],
)
def test_other_numbers_are_measured_and_other_versions_named(
    cli: Any, bundle: Path, tmp_path: Path, by: float, code: int, said: str
) -> None:
    contents = members(bundle)
    contents["results/1/motion.npz"] = changed_motion(contents["results/1/motion.npz"], tmp_path, by)
    old = contents[MANIFEST].replace(f'"numpy": "{np.__version__}"'.encode(), b'"numpy": "1.0.0"')
    done = cli("reproduce", sealed(tmp_path / "other.rtof", contents | {MANIFEST: old}))
    assert done.code == code
    assert done.out.startswith(said)
    assert f"likely since numpy 1.0.0 -> {np.__version__}" in done.out
    assert "differs: motion.npz q" in done.out


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("skeleton.urdf", b"<mass value", b"<mass  value", "skeleton.urdf"),
        ("summary.json", b'"grade": "', b'"grade": "x', "summary.json"),
    ],
)
def test_a_forged_text_beside_the_same_motion_is_named(
    cli: Any, bundle: Path, tmp_path: Path, file: str, old: bytes, new: bytes, said: str
) -> None:
    contents = members(bundle)
    forged = contents[f"results/1/{file}"].replace(old, new)
    assert forged != contents[f"results/1/{file}"]
    done = cli("reproduce", sealed(tmp_path / "forged.rtof", contents | {f"results/1/{file}": forged}))
    assert done.code == 1
    assert done.out.startswith(f"NOT reproduced: the motion is the same, but not {said}")


def test_several_people_and_results_get_ids_and_the_worst_verdict_comes_first(
    cli: Any, named: Path, result: Path, tmp_path: Path
) -> None:
    other = Recording.load(named)
    session = replace(other.session, subject="Max Muster", operator="", place="")
    replace(other, keypoints=other.video[5:40], session=session).save(tmp_path / "takes" / "b")
    claimed(result, tmp_path / "takes" / "b", tmp_path / "b_out")
    assert cli("reconstruct", named, "-o", tmp_path / "lift", "--mode", "lift", "--no-figures").code == 0
    outs = (result, tmp_path / "b_out", tmp_path / "lift")
    given = ("bundle", *outs, "--recording", tmp_path / "takes", "--recording", named, "-o", tmp_path / "b.rtof")
    assert "--id: 1 given for 2 people" in cli(*given, "--id", "A").err
    assert "3 results" in cli(*given, "--id", "A", "--id", "B").out
    runs = json.loads(members(tmp_path / "b.rtof")[MANIFEST])["runs"]
    assert [run["recording"][11:] for run in runs] == ["A-1", "B-1", "A-1"]
    assert [run["run"]["options"]["mode"] for run in runs] == ["sf2", "sf2", "lift"]
    done = cli("reproduce", tmp_path / "b.rtof")
    assert done.code == 1
    assert done.out.startswith("NOT reproduced: numbers or flags of frames differ, though code, libraries and")
    assert "results/1 of recordings/A-1, mode sf2, 60 frames: reproduced bit by bit" in done.out
    assert "results/2 of recordings/B-1, mode sf2, 35 frames: NOT reproduced" in done.out
    assert "results/3 of recordings/A-1, mode lift, 60 frames: reproduced bit by bit" in done.out
