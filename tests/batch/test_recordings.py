"""Recordings of a batch: found in a fixed order, or listed in a manifest, each with an output of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from batch_support import COMMANDS, write_recordings

from rtof_kin.batch.recordings import Entry, Shard, Step, find_recordings, read_chain, steps_of
from rtof_kin.core.errors import FileFormatError, InvalidInputError


def names(source: Path, out: Path) -> list[str]:
    return [entry.name for entry in find_recordings(source, out)]


def test_all_folders_below_are_found_but_for_the_output_and_hidden_ones(tmp_path: Path) -> None:
    write_recordings(tmp_path, b__2="", b__10="", a="", a__inner="", out__x="", **{".hidden__y": ""})
    assert names(tmp_path, tmp_path / "out") == ["a", "b/10", "b/2"]
    assert names(tmp_path / "a", tmp_path / "out") == ["a"]
    with pytest.raises(InvalidInputError, match="no recordings; each is a folder with recording.toml"):
        find_recordings(tmp_path / "out", tmp_path / "out" / "x")
    with pytest.raises(FileFormatError, match="no such folder or manifest"):
        find_recordings(tmp_path / "nowhere", tmp_path)


def test_a_manifest_names_recordings_and_options_of_each(tmp_path: Path) -> None:
    manifest = tmp_path / "list.csv"
    manifest.write_text(
        "recording,name,reconstruct,export\n"
        'takes/b,,"--mode imu --guards ""a b"",c",\n'
        "../far/a,first,,--weight 70\n"
        "../far/z,,,\n\n"
    )
    assert find_recordings(manifest, tmp_path / "out") == [
        Entry("first", tmp_path / "../far/a", {"export": ("--weight", "70")}),
        Entry("takes/b", tmp_path / "takes/b", {"reconstruct": ("--mode", "imu", "--guards", "a b,c")}),
        Entry("z", tmp_path / "../far/z", {}),
    ]


@pytest.mark.parametrize(
    "text, named",
    [
        ("", "empty"),
        ("folder\na\n", "line 1.*names the columns recording, each once; found folder"),
        ("recording,name,name\n", "line 1.*each once"),
        ("recording,name\na\n", "line 2: more or fewer cells than the 2 columns"),
        ("recording,name\n,x\n", "line 2: no recording"),
        ("recording,reconstruct\na,--x 'y\n", "line 2: options: No closing quotation"),
        ('recording\n"a\n', "not a readable CSV"),
        ("recording\n", "no recordings"),
        ("recording,name\na,x\nb,x\n", "two recordings are named x"),
        ("recording,name\na,x\nb,x/y\n", "x/y would lie in the output of x"),
        ("recording,name\na,../x\n", "no name of an output folder"),
        ("recording,name\na,.batch\n", "no name of an output folder"),
        ("recording,name\na,/x\n", "no name of an output folder"),
    ],
)
def test_a_wrong_manifest_is_an_error_with_its_line(text: str, named: str, tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises((FileFormatError, InvalidInputError), match=rf"list\.csv.*{named}"):
        find_recordings(tmp_path / "list.csv", tmp_path / "out")


def test_shards_are_disjoint_complete_and_do_not_depend_on_the_others() -> None:
    takes = [f"s{k}/take" for k in range(3000)]
    shards = [Shard(k, 7) for k in range(1, 8)]
    parts = [{name for name in takes if shard.has(name)} for shard in shards]
    assert sum(map(len, parts)) == len(set.union(*parts)) == 3000
    assert max(map(len, parts)) < 1.3 * 3000 / 7
    assert Shard.of(" 3/10 ") == Shard(3, 10)
    for wrong in ("0/3", "4/3", "3", "1/0", "a/b", "-1/3"):
        with pytest.raises(InvalidInputError, match="shard"):
            Shard.of(wrong)


def test_commands_are_separated_by_commas_and_options_may_have_some() -> None:
    chain = read_chain("reconstruct --guards jumps,spikes --frames 60 ,export, report --place 'a, b'", COMMANDS)
    assert [step.command for step in chain] == ["reconstruct", "export", "report"]
    assert chain[0].arguments[3:] == ("--guards", "jumps,spikes", "--frames", "60")
    assert chain[2].arguments[5:] == ("--place", "a, b")
    assert [step.output for step in chain] == ["motion", "export", "report.html"]
    line = chain[0].line(Path("in/a b"), Path("out"), overwrite=True)
    assert line[:4] == ["reconstruct", "in/a b", "-o", "out/motion"]
    assert line[-1] == "--overwrite"


def test_a_command_that_names_its_files_is_taken_as_it_is() -> None:
    text = "overlay {out}/motion {recording}/video.mp4 -o {out}/overlay.mp4, evaluate"
    overlay, evaluate = read_chain(text, COMMANDS)
    assert overlay.output == "overlay.mp4"
    assert overlay.line(Path("r"), Path("o"), False) == ["overlay", "o/motion", "r/video.mp4", "-o", "o/overlay.mp4"]
    assert evaluate.output is None
    assert evaluate.line(Path("r"), Path("o"), True) == ["evaluate", "o/motion", "--truth", "r"]


@pytest.mark.parametrize(
    "text, named",
    [
        ("", "an empty part is no command"),
        ("reconstrct", "reconstrct is no command; e.g. inspect, reconstruct"),
        ("overlay", "what overlay reads and writes is not known"),
        ("reconstruct, reconstruct --mode imu", "two commands write motion"),
        ("reconstruct --mode 'imu", "No closing quotation"),
    ],
)
def test_a_wrong_chain_is_refused(text: str, named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        read_chain(text, COMMANDS)


def test_a_recording_has_options_of_its_own() -> None:
    chain = read_chain("reconstruct, report", COMMANDS)
    own = steps_of(chain, Entry("a", Path("a"), {"reconstruct": ("--mode", "imu")}))
    assert own == (Step("reconstruct", (*chain[0].arguments, "--mode", "imu")), chain[1])
    with pytest.raises(InvalidInputError, match="a: options of export, which is not in the chain"):
        steps_of(chain, Entry("a", Path("a"), {"export": ("--weight", "70")}))
