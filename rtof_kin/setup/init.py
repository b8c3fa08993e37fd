"""From raw files to the folder of a recording: detection, person, camera, sensors, ``recording.toml``.

`find_people` writes keypoints.npz and frames.png, `write_recording` recording.toml and imus.npz, both into the same
folder, so that a person can be chosen by the picture without detecting again; `make_recording` does both.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.core.files.folder import check_replaceable, new_folder
from rtof_kin.core.files.manifest import fingerprint, made_from
from rtof_kin.core.files.text import load_json, write_text
from rtof_kin.core.packages import can_draw
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.camera_motion import write_camera_motion
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.parts import moved_in
from rtof_kin.reconstruction.prepare import Progress, evenly_spaced
from rtof_kin.reconstruction.self_calibration import CLOCK_DOUBT
from rtof_kin.recording.index import INDEX, SCHEMA_VERSION, read_corrections, with_corrections
from rtof_kin.recording.recording import RecordingReader
from rtof_kin.recording.sensor_files import IMUS, write_imus
from rtof_kin.setup.camera import MOTION, assumed_camera, calibrated_camera, filming_camera, seen_camera
from rtof_kin.setup.people import (
    PICTURE,
    People,
    choose_person,
    number_people,
    read_people,
    write_frames_picture,
    write_people,
)
from rtof_kin.setup.recording_text import Field, Origin, Tables, recording_text, summaries
from rtof_kin.setup.sensors import SetupSensors, sensors_by_pose, set_up_sensors
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.setup.sources import Sources
from rtof_kin.vision.detections import Detections, of_body
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.keypoints import keypoints_from_detections
from rtof_kin.vision.landmark_regression import recognise
from rtof_kin.vision.layouts import Layout, is_layout_file, layout_named
from rtof_kin.vision.person_detector import choose_detector
from rtof_kin.vision.video import detect_video
from rtof_kin.vision.video_metadata import VideoMetadata, lens_prior, read_video_metadata

KEYPOINTS: Final = "keypoints.npz"
FINDINGS, LAYOUT = "findings.json", "layout.toml"  #: Files of the folder beside `INDEX`, `PICTURE` and `IMUS`
_LEAST_SEEN: Final = 0.7  # Share of the frames below which it is said that the person is seen rarely
_ENOUGH: Final = 300.0  # [s] of a video by which sensors are set up
_SHORTEST: Final = 5.0  # [s] of a take below which it is said that it is short
Detect = Callable[[Path], Detections]


@dataclass(frozen=True)
class Findings:
    """Sentences on a recording that was set up, for the summary."""

    given: tuple[str, ...] = ()
    file: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()
    places: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    """Likeliest segment of each sensor of the files, '' where there is none, and its probability."""

    @property
    def text(self) -> str:
        """All sentences, a line each; notes of the recording, which the report shows."""
        kinds = [(kind, sentences) for kind, sentences in vars(self).items() if kind != "places"]
        return "\n".join(f"{kind}: {sentence}" for kind, sentences in reversed(kinds) for sentence in sentences)


@dataclass(frozen=True)
class _Video:
    """Image size, rate and metadata of a take."""

    size_px: tuple[int, int]
    size: Field  #: Its origin
    rate_hz: float | None
    metadata: VideoMetadata | None


def find_people(
    sources: Sources,
    settings: SetupSettings,
    folder: str | Path,
    detect: Detect | None = None,
    inputs: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> People:
    """Detect the people, number them and write `KEYPOINTS` and `PICTURE`.

    `folder`: to write; an unfinished one is replaced. `detect`: detects the people in a video, where there are no
    keypoints; default: the detector of `settings`. `inputs`: fingerprints for the folder's manifest.
    `InvalidInputError`: there is no person, or the keypoints lack the image's size or times.
    """
    video = _described(sources, settings)
    if detect is None:

        def detect(path: Path) -> Detections:
            detector = choose_detector(settings.model_dir, settings.provider, settings.people_every)
            return detect_video(path, detector, every=settings.every, progress=progress)

    wanted = None if settings.layout is None else layout_named(settings.layout)
    found = _detections(sources, video, detect, wanted)
    known = recognise(found.uv_px, found.confidence, found.names, wanted)
    found = found.of_points(known.order)
    assert found.times is not None
    people = number_people(found, found.times, video.size_px)
    shown = sources.video if settings.keep_video else None
    with new_folder(folder, INDEX, overwrite=True, inputs=inputs) as fresh:
        write_people(fresh / KEYPOINTS, people)
        if can_draw():
            write_frames_picture(fresh / PICTURE, people, known.layout.name, video.size_px, shown)
    return people


def make_recording(
    files: Iterable[str | Path],
    folder: str | Path,
    settings: SetupSettings | None = None,
    *,
    height: float | None = None,
    name: str | None = None,
    detect: Detect | None = None,
    made_with: object = None,
    overwrite: bool = False,
    kept: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Findings:
    """Make the recording of one take: person, camera and sensors are found from the files.

    What is there and made from the same files and settings is kept.

    >>> from rtof_kin import make_recording
    >>> files = ["take/keypoints.csv", "take/camera.toml"]  # or a video; and files of sensors
    >>> found = make_recording(files, "walk", height=1.72)
    >>> found.given
    ('the person is 1.72 m tall',)

    Args:
        files: a video, a detector's keypoints or both; files or folders of sensors, also alone; a calibration of the
            camera and a map of sensors: each is recognised, in any order.
        folder: to write. height: standing height of the person, m, if not in `settings`.
        name: title in reports; default: of the video or keypoints.
        detect: detects the people in a video; default: the detector of `settings`.
        made_with: what the recording depends on beside files and settings, e.g. the name of a lifter.
        overwrite: replace a recording of other files or of another person.
        kept: called with the name of the folder where it is kept as it is. progress: called with (stage, steps done,
            in all).

    Returns:
        What was given, found, assumed and is in doubt.

    Raises:
        OutputExistsError: the folder is of other files, or has what this package did not write. Errors of the files,
            of `find_people` and of `write_recording`.
    """
    folder, settings, sources = Path(folder), settings or SetupSettings(), Sources.of(files)
    settings = settings if height is None else replace(settings, height=height)
    settings = replace(settings, phone_log=settings.phone_log or sources.phone)
    inputs, before = _fingerprints(sources, settings, made_with), made_from(folder)
    if before.get("recording") == inputs["recording"]:
        if kept is not None:
            kept(folder.name)
        return read_findings(folder)
    if before and before.get("files") != inputs["files"] and not overwrite:
        raise OutputExistsError(f"{folder}: was made from other files; name another folder by -o, or add --overwrite")
    check_replaceable(folder, INDEX, bool(before) or overwrite)
    if "recording" in before and before.get("person", inputs["person"]) != inputs["person"] and not overwrite:
        raise OutputExistsError(
            f"{folder}: is of another person of the video; name another folder by -o, or add --overwrite, "
            "which replaces that person's results"
        )
    if sources.seen and before.get("people") != inputs["people"]:
        begun = {step: inputs[step] for step in ("files", "people")}
        find_people(sources, settings, folder, detect, begun, progress)
    return write_recording(sources, settings, folder, name=name, inputs=inputs, progress=progress)


def _fingerprints(sources: Sources, settings: SetupSettings, made_with: object) -> dict[str, str]:
    """Return what a recording is made from: its files, the picture of the people, everything."""
    image = [path for path in (sources.video, sources.keypoints) if path is not None]
    log = [settings.phone_log] if settings.phone_log is not None else []
    own = [Path(str(settings.layout))] if is_layout_file(settings.layout) else []
    names = [one.name for one in fields(settings) if one.compare and one.name != "phone_log"]
    seen = ("rate_hz", "size_px", "model_dir", "keep_video", "layout", "every")
    values = {name: str(getattr(settings, name)) for name in names}
    return {
        "files": fingerprint(*sources.paths),
        "people": fingerprint(*image, *own, *(values[name] for name in seen)),
        "person": str(settings.person or 1),
        "recording": fingerprint(*sources.paths, *log, *own, values, str(made_with)),
    }


def write_recording(
    sources: Sources,
    settings: SetupSettings,
    folder: str | Path,
    *,
    name: str | None = None,
    inputs: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> Findings:
    """Write ``recording.toml`` and the sensors beside what `find_people` wrote, or a recording of sensors alone.

    `sources`, `settings`: as for `find_people`. `name`: title in reports; default: of the video, the keypoints or the
    sensors. `inputs`: fingerprints for the folder's manifest. `progress`: called with (stage, steps done, in all).

    Returns:
        What was given, found, assumed and is in doubt; `read_findings` reads it again.

    Raises:
        UndecidedError: several people and none was chosen, or the segment of no sensor is known. InvalidInputError: no
            plausible height, or sensors that cannot belong to the video. CalibrationError: nothing relates the sensors
            to the video, or without one they never rest.
    """
    folder, usual = Path(folder), SkeletonModel.default()
    skeleton = usual if settings.height is None else usual.with_height(settings.height)
    if settings.height is None:
        tall = round(usual.height, 2)
        note = "a usual one; every length follows it: give --height, or write it here"
        height = Field(tall, Origin.ASSUMED, note, f"the person is {tall:.2f} m tall")
    else:
        height = Field(settings.height, Origin.GIVEN, summary=f"the person is {settings.height:.2f} m tall")
    about: dict[str, Field | Tables] = {
        "schema_version": Field(SCHEMA_VERSION),
        "name": Field(name or sources.name),
        "subject": {"height_m": height},
    }
    tell = progress or (lambda *_: None)
    seen = _seen(sources, settings, folder, tell) if sources.seen else None
    sensors = _sensors(seen, sources, settings, skeleton, tell) if sources.sensors else None
    tables: Tables = {**about, **(seen.tables if seen else {}), **({"imus": sensors.fields} if sensors else {})}
    doubts = [*(seen.doubts if seen else ()), *(sensors.doubts if sensors else ())]
    said = list(summaries(tables))
    sentences = {one.value: tuple(sentence for origin, sentence in said if origin is one) for one in Origin}
    found = Findings(**sentences, doubtful=tuple(doubts), places={} if sensors is None else sensors.places)
    title = f"Recording, made by rtof-kin run from {', '.join(path.name for path in sources.paths)}"
    texts = {
        FINDINGS: json.dumps(vars(found), indent=1, ensure_ascii=False) + "\n",
        INDEX: with_corrections(
            recording_text({**tables, "notes": {"text": Field(found.text)}}, title), read_corrections(folder)
        ),
    }
    with new_folder(folder, INDEX, overwrite=True, inputs=inputs) as fresh:
        for kept in (KEYPOINTS, PICTURE) if sources.seen else ():
            if kept == KEYPOINTS or (folder / kept).exists():
                shutil.copyfile(folder / kept, fresh / kept)
        if seen is not None and seen.turned is not None:
            write_camera_motion(fresh / MOTION, seen.turned)
        if sensors is not None:
            write_imus(fresh / IMUS, sensors.imus)
        if sources.seen and is_layout_file(settings.layout):
            shutil.copyfile(str(settings.layout), fresh / LAYOUT)
        for file, text in texts.items():
            if sources.video is not None and not settings.keep_video:
                text = text.replace(str(sources.video), "the video").replace(sources.video.name, "the video")
            write_text(fresh / file, text)
        del seen, sensors  # an hour of them is large, and so is what is read now
        return_free_memory()
        with RecordingReader.open(fresh):
            pass
    return found


class _Seen(NamedTuple):
    """What a video shows: tables of camera, keypoints and session, and the keypoints that sensors are related to."""

    tables: dict[str, Tables]
    doubts: list[str]
    turned: CameraMotion | None
    placed: bool  #: Whether it is known where the camera stands
    enough: KeypointSequence  #: By which sensors are set up
    whole: Callable[[], KeypointSequence] | None  #: Reads all keypoints again, where those are a part
    start_utc: datetime | None


def _sensors(
    seen: _Seen | None, sources: Sources, settings: SetupSettings, skeleton: SkeletonModel, progress: Progress
) -> SetupSensors:
    log = read_sensor_log(sources.sensors)
    return_free_memory()
    if seen is None:
        return sensors_by_pose(log, sources.sensor_map, settings.pose, skeleton)

    def set_up(some: KeypointSequence) -> SetupSensors:
        """Return the sensors by these keypoints, with errors of `set_up_sensors`."""
        even = evenly_spaced(some)
        progress("lift", 0, 1)
        poses = lift(even, skeleton, settings.lifter, None, None if seen.placed else 0.0).poses
        progress("lift", 1, 1)
        progress("sensors", 0, 1)
        found = set_up_sensors(log, sources.sensor_map, poses, even, skeleton, seen.start_utc)
        progress("sensors", 1, 1)
        return found

    if seen.whole is None:
        return set_up(seen.enough)
    with suppress(RtofError):  # perhaps the sensors began later or ended earlier
        found = set_up(seen.enough)
        if not any(doubt.startswith(CLOCK_DOUBT) for doubt in found.doubts):
            return found
    return set_up(seen.whole())


def _seen(sources: Sources, settings: SetupSettings, folder: Path, progress: Progress) -> _Seen:
    people, video = read_people(folder / KEYPOINTS), _described(sources, settings)
    start_utc = None if video.metadata is None else video.metadata.start_utc
    number = choose_person(people, settings.person, str(folder / PICTURE))
    if sources.camera is not None:
        known = video.size_px if sources.video is not None or settings.size_px is not None else None
        title = sources.video.name if sources.video is not None else "the image"
        camera = calibrated_camera(sources.camera, settings.camera_name, known, title)
    else:
        camera = assumed_camera(*video.size_px, lens_prior(*video.size_px, video.metadata), video.size)
    filmed = replace(people.detections, times=people.times)
    filming = filming_camera(sources.video, filmed, camera, settings.phone_log, progress)
    at_first, turned = filming.camera.camera, filming.motion
    layout = None if settings.layout is None else layout_named(settings.layout)

    def of_person(people: People) -> tuple[Layout, KeypointSequence]:
        """Return the detector's layout, and the keypoints of the person as of a camera that stands still."""
        first = people.first_frame(number)
        found = keypoints_from_detections(people.detections, people.times, at_first, layout, number - 1, first)
        return found.recognition.layout, found.keypoints if turned is None else stabilised(found.keypoints, turned)

    camera, (kind, still) = filming.camera, of_person(people)
    described = _keypoints(sources, settings, kind, people, number)
    doubts = [*_doubts(settings, still, people, number), *filming.doubts]
    del people, filmed  # of an hour they are large
    return_free_memory()
    if sources.sensors and not camera.placed:
        camera = seen_camera(camera, still, settings.height, settings.lifter, progress)
        still = replace(still, camera=camera.camera)
    tables: dict[str, Tables] = {}
    if start_utc is not None:
        tables["session"] = {"date": Field(start_utc.date().isoformat(), Origin.FILE, "the video, in UTC")}
    if not camera.placed:
        note = "take this line out where the floor is not flat"
        floor = Field(0.0, Origin.ASSUMED, note, "the person stands on a flat floor")
        tables["scene"] = {"floor_height_m": floor}
    tables["camera"] = camera.fields
    tables["keypoints"] = described

    def whole() -> KeypointSequence:
        """Return all keypoints, which are not kept: an hour of them is half of what a command may take."""
        return replace(of_person(read_people(folder / KEYPOINTS))[1], camera=camera.camera)

    enough = liveliest(still)
    again = whole if len(enough) < len(still) else None
    return _Seen(tables, doubts, turned, camera.placed, enough, again, start_utc)


def liveliest(keypoints: KeypointSequence) -> KeypointSequence:
    """Return the `_ENOUGH` seconds of a longer video in which the person moves most."""
    times, (moved, last) = keypoints.times, moved_in(keypoints, _ENOUGH)
    first = int(np.argmax(np.where(times <= max(times[0], times[-1] - _ENOUGH), moved, -1.0)))
    return keypoints[first : last[first] + 1]


def read_findings(folder: str | Path) -> Findings:
    """Read what `make_recording` returned. `FileFormatError`: missing or damaged."""
    data = load_json(Path(folder) / FINDINGS)
    places = {name: (str(segment), float(sure)) for name, (segment, sure) in data.pop("places", {}).items()}
    return Findings(**{kind: tuple(map(str, sentences)) for kind, sentences in data.items()}, places=places)


def _described(sources: Sources, settings: SetupSettings) -> _Video:
    """Return the size and rate of the image, from the video or as the user says."""
    if sources.video is None and sources.keypoints is None:
        raise InvalidInputError(f"{', '.join(map(str, sources.paths))}: no video and no keypoints among them; give one")
    if sources.video is not None:
        meta = read_video_metadata(sources.video)
        size = Field(None, Origin.FILE, f"{sources.video.name}, upright")
        return _Video((meta.width_px, meta.height_px), size, meta.rate_hz, meta)
    if settings.size_px is not None:
        return _Video(settings.size_px, Field(None, Origin.GIVEN), settings.rate_hz, None)
    if sources.camera is not None:
        camera = calibrated_camera(sources.camera, settings.camera_name, None, "").camera
        return _Video((camera.width_px, camera.height_px), Field(None, Origin.FILE), settings.rate_hz, None)
    raise InvalidInputError(
        f"{sources.keypoints}: keypoints do not say how large the image is; give the video beside them, its "
        "calibration, or --size 1920x1080"
    )


def _detections(sources: Sources, video: _Video, detect: Detect, layout: str | None) -> Detections:
    """Return the people of a video with times."""
    if sources.keypoints is None:
        assert sources.video is not None
        return of_body(detect(sources.video), layout)
    found = read_detector_file(sources.keypoints, *video.size_px, layout)
    if found.times is not None:
        return found
    if video.rate_hz is None:
        raise InvalidInputError(
            f"{sources.keypoints}: has no times; give the video beside it, or its rate by --rate 60 (Hz)"
        )
    return replace(found, times=np.arange(len(found)) / video.rate_hz)


def _keypoints(sources: Sources, settings: SetupSettings, kind: Layout, people: People, number: int) -> Tables:
    origin = Origin.FOUND if settings.person is None else Origin.GIVEN
    source = "the detector" if sources.keypoints is None else sources.keypoints.name
    by = people.detections.detector
    who = f"person {number} of {len(people)} in {PICTURE}"
    other = "; --person takes another one" if settings.person is None and len(people) > 1 else ""
    return {
        "file": Field(KEYPOINTS, Origin.FILE, f"{source}; all people"),
        "layout": Field(
            LAYOUT if is_layout_file(settings.layout) else kind.name,
            Origin.FOUND if settings.layout is None else Origin.GIVEN,
            kind.title,
            by and f"{kind.title}, by {by}",
        ),
        "person_number": Field(number, origin, who, who + other if len(people) > 1 else ""),
        "frame": Field(people.first_frame(number), note="in which the person has that number, from 0"),
    }


def _doubts(settings: SetupSettings, keypoints: KeypointSequence, people: People, number: int) -> list[str]:
    """Return sentences on what makes the take poor."""
    share, seconds = float(people.share[number - 1]), float(keypoints.times[-1] - keypoints.times[0])
    out = []
    if share < _LEAST_SEEN:
        out.append(f"the person is seen in {100 * share:.0f} % of the frames only; the rest is bridged, or missing")
    if seconds < _SHORTEST:
        out.append(f"the take lasts {seconds:.1f} s; 20 s with walking and turning tell camera and sensors")
    if settings.height is None:
        out.append("the person's height is not known, and every length follows it; give --height 1.72")
    return out
