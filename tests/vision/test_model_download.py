"""Models come from a (loopback) server once, with consent and the right checksum, or not at all."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from rtof_kin.cli import main
from rtof_kin.core.errors import FileFormatError, RtofError, UnknownNameError
from rtof_kin.vision import model_download
from rtof_kin.vision.model_download import (
    ModelFile,
    ModelSet,
    cached_models,
    fetch_models,
    model_set,
    model_sets,
    models_folder,
)

PLAIN = bytes(range(256)) * 4000  # 1 MB


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def zipped(**members: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"20230605/{name.replace('_', '.')}", data)
    return stream.getvalue()


ARCHIVE = zipped(end2end_onnx=b"network" * 5000, detail_json=b"{}")


class Server(ThreadingHTTPServer):
    """Serves `contents`; ends each answer after `most` bytes and keeps the requests."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.contents = {"/plain.task": PLAIN, "/pose.zip": ARCHIVE}
        self.most: int | None = None
        self.asked: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        data = self.server.contents.get(self.path)
        if data is None:
            return self.send_error(404)
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data[: self.server.most])
        return None

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("RTOF_KIN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Server() as served:
        thread = Thread(target=served.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield served
        served.shutdown()
        thread.join()


def wanted(server: Server) -> ModelSet:
    files = (
        ModelFile("plain.task", f"{server.url}/plain.task", sha256(PLAIN), 2),
        ModelFile("pose.onnx", f"{server.url}/pose.zip", sha256(ARCHIVE), 3, "end2end.onnx", sha256(b"network" * 5000)),
    )
    return ModelSet("test", "Test models", "BSD-3-Clause, nobody", ("numpy",), "pip install x", files)


def test_models_are_fetched_once_and_checked_at_each_use(server: Server) -> None:
    models, told = wanted(server), list[tuple[str, int, int]]()
    assert cached_models(models) is None
    folder = fetch_models(models, lambda *args: told.append(args))
    assert (folder / "plain.task").read_bytes() == PLAIN
    assert (folder / "pose.onnx").read_bytes() == b"network" * 5000
    assert sorted(path.name for path in folder.iterdir()) == [".lock", "plain.task", "pose.onnx"]
    assert cached_models(models) == folder == fetch_models(models)
    assert server.asked == ["/plain.task", "/pose.zip"]
    assert {(what, total) for what, _, total in told} == {("fetch", 5)}
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)
    (folder / "pose.onnx").write_bytes(b"network" * 4999 + b"Network")
    with pytest.raises(FileFormatError, match="pose.onnx: its SHA-256 .* is not the published .*; delete it"):
        cached_models(models)


def test_an_interrupted_download_keeps_nothing_and_can_be_repeated(server: Server) -> None:
    models, server.most = wanted(server), 400_000
    with pytest.raises(RtofError, match=r"Test models: not downloaded \(.*\); try again"):
        fetch_models(models)
    assert [path.name for path in models_folder(models).iterdir()] == [".lock"]
    server.most = None
    assert (fetch_models(models) / "plain.task").read_bytes() == PLAIN


def test_another_file_than_the_published_one_is_not_kept(server: Server) -> None:
    models = wanted(server)
    server.contents["/plain.task"] = PLAIN[:-1] + b"!"
    with pytest.raises(FileFormatError, match="plain.task: its SHA-256 .* not the published .*nothing was kept"):
        fetch_models(models)
    assert [path.name for path in models_folder(models).iterdir()] == [".lock"]
    server.contents["/plain.task"] = PLAIN
    assert fetch_models(models).is_dir()


def test_another_file_in_the_archive_is_not_kept(server: Server) -> None:
    models, archive = wanted(server), zipped(end2end_onnx=b"Network")
    server.contents["/pose.zip"] = archive
    models = replace(models, files=(replace(models.files[1], sha256=sha256(archive)),))
    with pytest.raises(RtofError, match="pose.zip: its SHA-256 .* is not the published"):
        fetch_models(models)
    assert cached_models(models) is None


def test_nothing_is_fetched_for_a_detector_that_cannot_run(server: Server) -> None:
    models = replace(wanted(server), needs=("numpy", "no_such_module"))
    with pytest.raises(RtofError, match="no_such_module: not installed, Test models needs it: pip install x"):
        fetch_models(models)
    assert not server.asked


def test_no_server_and_no_file_are_one_sentence(server: Server) -> None:
    models = wanted(server)
    gone = replace(models.files[0], url=f"{server.url}/gone.task")
    with pytest.raises(RtofError, match=r"Test models: not downloaded \(404 .*gone.task\); try again"):
        fetch_models(replace(models, files=(gone,)))
    closed = replace(models.files[0], url="http://127.0.0.1:9/plain.task")
    with pytest.raises(RtofError, match=r"Test models: not downloaded \(.*refused.*\); try again"):
        fetch_models(replace(models, files=(closed,)))


def test_the_shipped_sets_have_checksums_licences_and_secure_addresses() -> None:
    assert [each.name for each in model_sets()] == ["rtmpose", "mediapipe"]
    for each in model_sets():
        assert each.licence.startswith("Apache-2.0")
        for file in each.files:
            assert file.url.startswith("https://")
            assert {len(file.sha256), len(file.checksum)} == {64}
            assert (file.member is None) == (file.member_sha256 is None)
    with pytest.raises(UnknownNameError, match="unknown set of models 'rtmpos'.*'rtmpose'"):
        model_set("rtmpos")


def test_the_command_fetches_only_when_asked_and_shows_the_licence(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    models = replace(wanted(server), files=wanted(server).files[:1])
    monkeypatch.setattr(model_download, "model_sets", lambda: (replace(models, name="mediapipe"),))
    monkeypatch.chdir(tmp_path)
    assert main(["detect", "walk.mp4"]) == 2
    assert not server.asked
    assert main(["detect", "walk.mp4", "--fetch-models", "mediapipe"]) == 2  # it is no model
    said = " ".join(capsys.readouterr().out.split())
    assert "Test models. Licence: BSD-3-Clause, nobody" in said
    assert f"plain.task: SHA-256 {sha256(PLAIN)}, as published" in said
    assert server.asked == ["/plain.task"]
    assert main(["detect", "walk.mp4", "--fetch-models", "--model-dir", "models"]) == 2
