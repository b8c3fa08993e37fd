"""The files of a recording: archives, folders of single frames, the drawing of the body, and their page."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest
from app_support import Server, Window
from browser_support import needs_browser
from setup_support import pair, write_keypoints

from rtof_kin.app import store as module
from rtof_kin.app.sources import MAP, body_drawing, people_picture, write_map
from rtof_kin.app.store import FILES, State, Store
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.formats.sensors.sensor_map import read_sensor_map
from rtof_kin.setup.sources import SourceKind, recognise_source

PERSON = json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": [1.0, 2.0, 0.9] * 25}]})
FRAMES = {f"openpose/walk_{n:012d}_keypoints.json": PERSON for n in range(3)}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "workspace")
    store.add_person("P07", 1.73)
    store.add_visit("P07", "2026-01-31")
    return store


@pytest.fixture
def folder(store: Store) -> Path:
    return store.add_take("P07", "2026-01-31", "walk")


def archive(path: Path, members: dict[str, str], **how: Any) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as whole:
        for name, text in members.items():
            whole.writestr(name, text, **how)
    return path


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder / FILES).as_posix() for path in (folder / FILES).rglob("*") if path.is_file()}


def test_an_archive_becomes_files_and_the_frames_of_a_detector_a_folder(
    store: Store, folder: Path, tmp_path: Path
) -> None:
    members = {**FRAMES, "sensors/a.csv": "x", "__MACOSX/sensors/._a.csv": "", "sensors/.DS_Store": "", "empty/": ""}
    store.take_in(folder, "take.zip", archive(tmp_path / "take.zip", members))
    frames = folder / FILES / "walk_keypoints"
    assert names(folder) == {"a.csv", *(f"walk_keypoints/{Path(name).name}" for name in FRAMES)}
    assert store.files(folder) == [folder / FILES / "a.csv", frames]
    assert recognise_source(frames) is SourceKind.KEYPOINTS
    assert not [path for path in folder.rglob("*") if path.stat().st_mode & 0o077]
    with pytest.raises(OutputExistsError, match=r"a\.csv: is there already"):
        store.take_in(folder, "again.zip", archive(tmp_path / "again.zip", {"b.csv": "y", "else/a.csv": "z"}))
    assert "b.csv" not in names(folder)  # all or nothing
    one = tmp_path / "part"
    one.write_text(PERSON)
    store.take_in(folder, "walk_000000000003_keypoints.json", one)
    assert len(list(frames.iterdir())) == 4


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ({"a/x.csv": "1", "b/X.csv": "2"}, "has two files of one name"),
        ({"a.csv": "1", "a\\..\\b:c.csv": "2"}, "is not taken; rename it"),
        ({"nul": "1"}, "is not taken; rename it"),
        ({f"{n}.csv": "" for n in range(11)}, "has more than 16 GB or 100,000 files"),
        ({"a.csv": "1", "big.csv": "0" * 2000}, "has more than 16 GB"),
    ],
)
def test_hostile_archives_are_refused_and_leave_nothing(
    store: Store, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, members: dict[str, str], said: str
) -> None:
    monkeypatch.setattr(module, "_MOST_FILES", 10)
    monkeypatch.setattr(module, "_MOST_BYTES", 1000)
    with pytest.raises(RtofError, match=said):
        store.take_in(folder, "take.zip", archive(tmp_path / "take.zip", members))
    assert list((folder / FILES).iterdir()) == []


def test_names_that_lead_out_of_an_archive_stay_inside(store: Store, folder: Path, tmp_path: Path) -> None:
    hostile = {"../../../a.csv": "1", "/etc/b.csv": "2", "x/../../c.csv": "3"}
    store.take_in(folder, "take.zip", archive(tmp_path / "take.zip", hostile))
    assert names(folder) == {"a.csv", "b.csv", "c.csv"}


def test_what_is_no_archive_or_is_damaged_is_said(store: Store, folder: Path, tmp_path: Path) -> None:
    whole = archive(tmp_path / "take.zip", {"a.csv": "1" * 5000, "b.csv": "2" * 5000}).read_bytes()
    locked = bytearray(whole)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        locked[locked.find(signature) + flags] |= 1
    damaged = bytearray(whole)
    damaged[40:44] = b"\xff" * 4
    for data in (b"no archive", whole[: len(whole) // 2], bytes(locked), bytes(damaged)):
        (tmp_path / "part").write_bytes(data)
        with pytest.raises(RtofError, match=r"take\.zip: no archive that can be unpacked"):
            store.take_in(folder, "take.zip", tmp_path / "part")
        assert list((folder / FILES).iterdir()) == []


def test_places_are_written_as_a_map_that_run_takes(tmp_path: Path) -> None:
    places = {"00B42279": "LeftLeg", "Chest, upper": "", "00B4227D": "Hips"}
    write_map(tmp_path / MAP, places)
    assert recognise_source(tmp_path / MAP) is SourceKind.SENSOR_MAP
    assert read_sensor_map(tmp_path / MAP) == {"00B42279": "LeftLeg", "00B4227D": "Hips"}
    for bad, said in (
        ({"a": ""}, "at least one"),
        ({"a": "Hips", "b": "Hips"}, "at one place"),
        ({"Chest, upper": "Hips"}, "cannot be written"),
    ):
        with pytest.raises(InvalidInputError, match=said):
            write_map(tmp_path / MAP, bad)


def test_left_of_the_person_is_right_in_the_drawing_and_names_are_text() -> None:
    drawing = body_drawing({"<b>one": "LeftLeg", "two": "", "three": "LeftLeg"})
    left, right = (re.search(rf'"{side}Leg" x1="(\d+)"', drawing) for side in ("Left", "Right"))
    assert left is not None
    assert right is not None
    assert int(left[1]) > 100 > int(right[1])
    assert "left shank: &lt;b&gt;one: three" in drawing
    assert ">1,3</text>" in drawing
    assert drawing.count('class="on"') == 1


def test_boxes_of_people_are_where_they_are_in_the_picture() -> None:
    picture = people_picture("/x.png", [(1, 0.1, 0.2, 0.3, 0.6), (2, 0.5, 0.2, 0.7, 0.6)], 2, "Who")
    found = re.findall(r'data-choice="(\d)" class="(\w*)" style="left: ([\d.]+)%; .*?width: ([\d.]+)%', picture)
    assert [(number, here) for number, here, *_ in found] == [("1", ""), ("2", "on")]
    assert [(float(x), float(w)) for *_, x, w in found] == [pytest.approx((9.0, 22.0)), pytest.approx((49.0, 22.0))]


def test_the_height_of_a_person_is_corrected_and_the_rest_stays(store: Store) -> None:
    path = store.path("P07") / module.SUBJECT
    path.write_text(path.read_text() + "[mass_kg]\nvalue = 71\n")
    store.set_height("P07", 1.81)
    found = store.subject("P07")
    assert found.height_m is not None
    assert found.mass_kg is not None
    assert (found.height_m.value, found.mass_kg.value) == (1.81, 71)
    with pytest.raises(InvalidInputError, match="centimetres"):
        store.set_height("P07", 18.1)


CENTRE = "(one => (box => [box.x + box.width / 2, box.y + box.height / 2])(one.getBoundingClientRect()))"
CHECK = "[...document.querySelectorAll('[role=checkbox]')].find(one => one.innerText.trim() === %s).click()"


class SourcesWindow(Window):
    """A window on the page of a recording."""

    def centre(self, selector: str) -> tuple[float, float]:
        one = f"document.querySelector({json.dumps(selector)})"
        self.until(f"{one} !== null")
        self.value(f"{one}.scrollIntoView({{block: 'center'}})")
        x, y = self.value(f"{CENTRE}({one})")
        return x, y

    def press_at(self, selector: str) -> None:
        at = self.centre(selector)
        self.drag(at, at)


@needs_browser
@pytest.mark.slow
def test_people_sensors_and_cameras_are_chosen_on_the_page(store: Store, folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    keypoints, stray = write_keypoints(tmp_path / "keypoints.npz", *pair()), tmp_path / "notes.txt"
    stray.write_text("milk")
    server = Server(store.root)
    try:
        with SourcesWindow(tmp_path / "browser", 1024, 900) as window:
            window.open(f"{server.address}people/P07/2026-01-31/walk")
            window.drop(archive(tmp_path / "bad.zip", {"a:b.csv": ""}), archive(tmp_path / "take.zip", FRAMES), stray)
            window.says("is not taken; rename it")
            window.says("notes.txt: not recognised")
            window.says("walk_keypoints: a detector's keypoints")
            window.click("Remove notes.txt")
            window.drop(keypoints)
            window.says("each is a detector's keypoints")
            window.value(CHECK % '"walk_keypoints is of the second camera"')
            window.says("Both cameras have one clock")
            assert store.take(folder).second == ("walk_keypoints",)
            window.click("Remove walk_keypoints")
            window.until("!document.body.innerText.includes('walk_keypoints')")
            window.until("!document.body.innerText.includes('Both cameras have one clock')")  # the fields are new
            window.says("No sensors: the motion comes from the image alone")
            window.fill("Width of the image in px", "1920")
            window.drop(stray)
            window.says("notes.txt: not recognised")  # what was typed so far stays
            window.click("Remove notes.txt")
            window.until("!document.body.innerText.includes('notes.txt')")
            window.fill("Height of the image in px", "1080")
            window.click("Look at it first")
            window.says("Several people are in the picture", 60)
            assert store.take(folder).size_px == (1920, 1080)
            window.until("document.querySelector('.people img')?.complete")
            window.press_at(".people [data-choice='2']")
            window.until("document.querySelectorAll('.people .on').length === 6")
            assert store.take(folder).person == 2
            window.says("draft")  # the question is answered
            assert window.value("document.querySelector('[role=radio][aria-checked=true]').innerText") == "Person 2"
            store.change(folder, state=State.ASKING, places={"A1": ("LeftLeg", 0.7), "B2": ("", 0.0)})
            window.says("70 % by its motion")
            window.says("left out")
            window.press_at("[data-choice=RightFoot]")  # no sensor was pressed before
            window.click("2: B2")
            window.press_at("[data-choice=RightLeg]")
            window.until("document.querySelector('.body [data-choice=RightLeg].on') !== null")
            window.value(
                """(() => {
                  const move = new DataTransfer(), fire = (one, what) => one.dispatchEvent(
                    new DragEvent(what, {bubbles: true, cancelable: true, dataTransfer: move}));
                  const chip = [...document.querySelectorAll("button")].find(one => one.innerText.trim() === "1: A1");
                  const place = document.querySelector(".body [data-choice=Hips]");
                  fire(chip, "dragstart"); setTimeout(() => (fire(place, "dragover"), fire(place, "drop")), 300);
                })()"""
            )
            window.until("document.querySelector('.body [data-choice=Hips].on') !== null")
            assert not window.layout_faults()
            window.click("Use these places")
            window.says(f"{MAP}: a map of sensors")
            assert read_sensor_map(folder / FILES / MAP) == {"A1": "Hips", "B2": "RightLeg"}
            window.click("Take the places back")
            window.until(f"!document.body.innerText.includes('{MAP}')")
            window.resize(768, 900)
            assert not window.layout_faults()
            window.open(f"{server.address}people/P07")
            window.fill("Standing height in cm", "181")
            window.press("Enter")
            window.says("181 cm tall")
            assert not [error for error in window.errors if server.address in error]
    finally:
        server.end()
