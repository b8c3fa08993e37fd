from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lifting_support as support
import numpy as np
import pytest

from lifting.corpus import Corpus, make_corpus, read_corpus, read_split
from rtof_kin.errors import FileFormatError, ShapeError
from rtof_kin.mocap import read_mocap

EXCERPT = Path(__file__).parent / "data" / "mocap" / "02_01_excerpt.bvh"


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return support.tiny_corpus()


def test_a_corpus_survives_its_file(corpus: Corpus, tmp_path: Path) -> None:
    back = read_corpus(corpus.save(tmp_path / "motion.npz"))
    np.testing.assert_allclose(back.R_world_bone, corpus.R_world_bone, atol=1e-6)
    np.testing.assert_array_equal(back.p_world_root, corpus.p_world_root)
    np.testing.assert_array_equal(back.joint_offsets, corpus.joint_offsets)
    assert (back.names, back.parents) == (corpus.names, corpus.parents)
    assert (back.subjects, back.split) == (corpus.subjects, corpus.split)
    assert back.body() == corpus.body()


def test_positions_are_those_of_the_clip_read(tmp_path: Path) -> None:
    clip = replace(read_mocap(EXCERPT), subject="somebody")
    corpus = make_corpus([clip], {"somebody": "validation"})
    np.testing.assert_allclose(corpus.positions(0), clip.poses.p_world_joint, atol=1e-5)
    assert corpus.clips("validation") == [0]


def test_subjects_that_no_list_names_train() -> None:
    corpus = make_corpus([replace(read_mocap(EXCERPT), subject="unheard of")], {"x": "test"})
    assert corpus.split == ("train",)


def test_clips_at_another_rate_are_refused() -> None:
    clip = read_mocap(EXCERPT, output_rate_hz=None)
    with pytest.raises(ShapeError, match="is at 30 Hz; resample it to 60"):
        make_corpus([clip], {})


def test_an_empty_corpus_is_refused() -> None:
    with pytest.raises(ShapeError, match="there is no clip"):
        make_corpus([], {})


def test_a_split_without_clips_names_the_subjects(corpus: Corpus) -> None:
    everyone_tests = replace(corpus, split=("test",) * 4)
    with pytest.raises(ShapeError, match="no clip is in the split 'train'.*subject 0, subject 1"):
        everyone_tests.clips("train")
    assert everyone_tests.clips("train", required=False) == []


def test_different_bodies_are_listed_once_largest_first(corpus: Corpus) -> None:
    offsets = corpus.joint_offsets.copy()
    offsets[1] = offsets[0]
    twins = replace(corpus, joint_offsets=offsets, split=("train", "train", "train", "test"))
    bodies = twins.skeletons("train", at_most=5)
    assert len(bodies) == 2
    np.testing.assert_array_equal(bodies[0], offsets[0])
    assert len(twins.skeletons("train", at_most=1)) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.array([0, 5, 5, 180, 360])}, "does not cut the frames"),
        ({"split": ("train", "train", "train", "holdout")}, "no holdout; known: train"),
        ({"subjects": ("a", "b")}, "joint_offsets: expected shape"),
        ({"parents": (-1, 0)}, "parents: expected shape"),
    ],
)
def test_inconsistent_corpora_are_refused(corpus: Corpus, change: dict, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        replace(corpus, **change)


def test_motion_with_gaps_is_refused(corpus: Corpus) -> None:
    p = corpus.p_world_root.copy()
    p[7] = np.nan
    with pytest.raises(ShapeError, match="p_world_root: not finite; leave gaps out"):
        replace(corpus, p_world_root=p)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 broken", b"not an archive at all"])
def test_files_that_are_no_corpus_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.npz"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"bad\.npz: not a corpus of motion"):
        read_corpus(path)


def test_a_missing_file_and_a_missing_field_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="not a corpus of motion"):
        read_corpus(tmp_path / "nowhere.npz")
    np.savez(tmp_path / "half.npz", joint_names=["a"], parents=[-1])
    with pytest.raises(FileFormatError, match="quat_wxyz"):
        read_corpus(tmp_path / "half.npz")


def test_a_split_is_read_by_subject(tmp_path: Path) -> None:
    path = tmp_path / "split.toml"
    path.write_text('test = ["a"]\nvalidation = ["b", "c"]\n[benchmark]\nseconds = 10.0\n')
    assert read_split(path) == {"a": "test", "b": "validation", "c": "validation"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('vaildation = ["a"]', "'vaildation' is no list of one of: train"),
        ('test = "a"', "'test' is no list"),
        ('test = ["a"]\nvalidation = ["a"]', "subject a stands in two lists"),
        ("test = [", "not a readable split"),
    ],
)
def test_wrong_splits_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "split.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_split(path)
