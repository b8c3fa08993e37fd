"""Search for what identifies: planted leaks of every kind, and sentences of this package that have none."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.batch.privacy import Search, of_this_machine

SEARCH = Search(["Jane O. Roe", "Müller"], ["take 7, left knee"], ["ok/but.csv"])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("in /home/x/takes", "an absolute path"),
        ("'/srv/lab/one'", "an absolute path"),
        ("in /root", "an absolute path"),
        ("~/takes", "an absolute path"),
        ("C:\\Users\\x", "an absolute path"),
        (r"\\server\share", "an absolute path"),
        ("file:///x", "an absolute path"),
        ("subject/imus.npz: short", "a path of a file"),
        ("..\\subject\\imus.npz", "a path of a file"),
        ("film.MP4", "a video or picture"),
        ("ask x@example.org", "an address"),
        ("on 2026-01-31T10:00", "a date"),
        ("on 31.1.2026", "a date"),
        ("JANE walks", "a name"),
        ("roe_arm", "a name"),
        ("Herr MÜLLER", "a name"),
        ("of Take 7, left knee", "a name"),
    ],
)
def test_planted_text_is_found(text: str, what: str) -> None:
    assert what in [finding.what for finding in SEARCH.in_text("here", text)]


@pytest.mark.parametrize(
    "text",
    [
        "4.56 m/s2 (above 4 m/s2) at 2.0 s; 0.1 rad/s^0.5, and/or kg/m^3; 1/64 px",
        "see docs/calibration.md and benchmarks/results/planted.md",
        "left knee of a Roedeer, in January",
        "ok/but.csv",
        "relative to the root, version 1.2.20",
        "R_world_bone @ x",
    ],
)
def test_plain_sentences_are_let_be(text: str) -> None:
    assert SEARCH.in_text("here", text) == []


def test_texts_inside_files_are_found_with_their_place(tmp_path: Path) -> None:
    header = json.dumps({"faults": [{"source": "jane"}]})
    times = 1.7e9 + np.arange(3)
    np.savez(tmp_path / "a.npz", header=header, view_0_video_times=times, names=["x", "Roe"], q=times)
    (tmp_path / "a.toml").write_text('name = "x"\n# of Jane\n')
    (tmp_path / "a.json").write_text(json.dumps({"deep": [{"roe": 1}]}))
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as weights:
        weights.writestr("a/data.pkl", b"\x80\x02" + b"/home/jane/corpus.npz" + bytes(9) + b"weights/of/layer")
        weights.writestr("a/data/0", b"Jane")
    found = {path.name: [str(one) for one in SEARCH.in_file(path.name, path)] for path in tmp_path.iterdir()}
    since = "times that count from a date, not from the recording's start"
    assert found["a.npz"] == [
        "a.npz, header, faults[0].source: a name, 'jane'",
        f"a.npz, view_0_video_times: {since}, '1700000000'",
        "a.npz, names: a name, 'Roe'",
    ]
    assert found["a.toml"] == ["a.toml, line 2: a name, 'Jane'"]
    assert found["a.json"] == ["a.json, deep[0]: a name, 'roe'"]
    assert [one.split(": ")[1].split(",")[0] for one in found["a.pt"]] == ["a name", "an absolute path"]


def test_names_of_nobody_are_not_searched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.node", lambda: "gait-pc.clinic.org")
    monkeypatch.setattr("getpass.getuser", lambda: "root")
    monkeypatch.setattr(Path, "home", lambda: Path("/home/otto"))
    assert of_this_machine() == ["gait-pc", "otto"]
