"""Recordings of a batch: found in a fixed order, or listed in a manifest, each with an output of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from batch_support import write_recordings

from rtof_kin.batch.recordings import Entry, Shard, find_recordings
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
        ("folder\na\n", "line 1.*named recording"),
        ("recording,name,name\n", "line 1.*stands once"),
        ("recording,name\na\n", "line 2: 1 cells"),
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


def test_a_name_is_in_the_output_of_another_even_where_a_third_is_between(tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("recording,name\na,x\nb,x-1\nc,x/y\n")
    with pytest.raises(InvalidInputError, match="x/y would lie in the output of x"):
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
