"""Films have the skeleton where and when the projection says, and nothing else of the source's file."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

av: Any = pytest.importorskip("av")
from overlay_support import motion_with, number_of, numbered, read_film, upright_camera, write_film, write_output  # noqa: E402

from rtof_kin.body.skeleton import Motion, SkeletonModel  # noqa: E402
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, RtofError  # noqa: E402
from rtof_kin.data.camera import Camera  # noqa: E402
from rtof_kin.data.imu_stream import FaultKind, StreamFault  # noqa: E402
from rtof_kin.data.poses import COLOURS, Provenance  # noqa: E402
from rtof_kin.formats.measurements_file import read_measurements  # noqa: E402
from rtof_kin.view import film_files  # noqa: E402
from rtof_kin.view.film import write_overlay  # noqa: E402
from rtof_kin.view.overlay_settings import OverlaySettings  # noqa: E402
from rtof_kin.vision.video import read_video  # noqa: E402

FRAMES = 30
WIDTH, HEIGHT = 540, 960
TIMES_MS = [0, 33, 66, 150, 183, 216, 300, 400, 433, 480, 600]
"""Of the video's frames, at no constant rate; the last ones are after the motion."""
METADATA = {"location": "+48.1234+011.5678/", "make": "Phone", "creation_time": "2024-05-01T10:00:00Z"}
HOW = {"RightLeg": Provenance.BRIDGED, "RightForeArm": Provenance.IMU, "LeftLeg": Provenance.CAMERA_AND_IMU}
GREEN = (60, 140, 90)
Drawn = tuple[list[np.ndarray], list[float], Path]
NO_LABELS = OverlaySettings(angles=())


@cache
def moving(skeleton: SkeletonModel) -> Motion:
    """A person that moves by 0.3 m: no place is passed twice."""
    return motion_with(skeleton, FRAMES, HOW, sigma=0.02, way=0.3)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return upright_camera(WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def out(skeleton: SkeletonModel, camera: Camera, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of half a second of motion."""
    folder = tmp_path_factory.mktemp("overlay")
    return write_output(folder / "out", moving(skeleton), [camera])


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A portrait video of a phone: stored lying, turned, with sound, place and date."""
    images = [numbered(WIDTH, HEIGHT, i) for i in range(len(TIMES_MS))]
    path = tmp_path_factory.mktemp("video") / "phone.mp4"
    return write_film(path, images, TIMES_MS, rotation=90, metadata=METADATA, sound=True)


@pytest.fixture(scope="module")
def drawn(out: Path, video: Path) -> Drawn:
    path = out.parent / "drawn.mp4"
    result = write_overlay(out, path, video, settings=NO_LABELS)
    assert result.frames == len(TIMES_MS)
    assert result.without_motion == sum(ms > 1000 * (FRAMES - 1 + 0.75) / 60 for ms in TIMES_MS)
    return *read_film(path), path


def middles(skeleton: SkeletonModel, camera: Camera, time: float) -> dict[str, np.ndarray]:
    """Middle of the bone to each joint in the picture at an instant of the motion, px."""
    motion = moving(skeleton)
    uv = camera.project(motion.poses.p_world_joint)
    now = np.array([[np.interp(time, motion.times, uv[:, j, k]) for k in (0, 1)] for j in range(uv.shape[1])])
    parents = motion.skeleton.parents
    names = motion.skeleton.names
    return {names[j]: (now[j] + now[p]) / 2 for j, p in enumerate(parents) if p >= 0}


def colour_at(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    u, v = np.round(place).astype(int)
    return image[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3).astype(float).mean(axis=0)


def amber(image: np.ndarray) -> int:
    """Number of pixels with the colour of sentences on faults."""
    red, green, blue = np.moveaxis(image.astype(int), 2, 0)
    return int(((red > 200) & (green > 150) & (blue < 140)).sum())


def test_bones_lie_where_the_projection_says_at_the_time_of_the_frame(
    drawn: Drawn, skeleton: SkeletonModel, camera: Camera
) -> None:
    images, _, _ = drawn
    for number, ms in enumerate(TIMES_MS[:8]):
        assert images[number].shape == (HEIGHT, WIDTH, 3)
        assert number_of(images[number]) == number
        at = middles(skeleton, camera, ms / 1000)
        for joint in ("RightLeg", "RightFoot", "RightForeArm", "LeftLeg"):
            colour = COLOURS[HOW.get(joint, Provenance.CAMERA)]
            others = [c for how, c in COLOURS.items() if c != colour]
            found = colour_at(images[number], at[joint])
            distance = np.linalg.norm(found - np.array(colour))
            assert distance < 75, (joint, number, found)
            assert distance < min(np.linalg.norm(found - np.array(c)) for c in others)


def test_time_stamps_are_those_of_the_input(drawn: Drawn) -> None:
    _, stamps, _ = drawn
    np.testing.assert_allclose(stamps, np.array(TIMES_MS) / 1000, atol=1e-4)


def test_sound_place_date_and_rotation_are_gone(drawn: Drawn, video: Path) -> None:
    path = drawn[2]
    with av.open(str(video)) as container:  # the input has them
        assert len(container.streams.audio) == 1
        assert "48.1234" in str(container.metadata)
        assert next(container.decode(video=0)).rotation == 90
    with av.open(str(path)) as container:
        assert [stream.type for stream in container.streams] == ["video"]
        assert container.streams.video[0].codec_context.name == "h264"
        assert next(container.decode(video=0)).rotation == 0
    content = path.read_bytes()
    for secret in (b"48.1234", b"Phone", b"2024", b"phone.mp4", b"John Doe"):
        assert secret not in content


def test_colours_of_the_video_are_kept(drawn: Drawn, video: Path) -> None:
    corner = np.s_[HEIGHT // 4 : HEIGHT // 4 + 60, WIDTH - 60 :]
    before = next(read_video(video)).image[corner][..., ::-1].reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(drawn[0][0][corner].reshape(-1, 3).mean(axis=0), before, atol=4)


def test_pictures_outside_the_motion_say_so_and_have_no_skeleton(
    drawn: Drawn, skeleton: SkeletonModel, camera: Camera
) -> None:
    images = drawn[0]
    at = middles(skeleton, camera, 0.48)
    assert np.linalg.norm(colour_at(images[-1], at["LeftLeg"]) - GREEN) < 12
    assert amber(images[-1][:40]) > 100
    assert amber(images[0][:40]) == 0


def test_shift_moves_the_motion(
    out: Path, video: Path, camera: Camera, skeleton: SkeletonModel, tmp_path: Path
) -> None:
    """A video that begins 0.1 s later shows in its first frame what the other shows after 0.1 s."""
    write_overlay(out, tmp_path / "o.mp4", video, settings=replace(NO_LABELS, shift=0.1, stop=0.01))
    (image,), _ = read_film(tmp_path / "o.mp4")
    at = middles(skeleton, camera, 0.1)["LeftLeg"]
    assert np.linalg.norm(colour_at(image, at) - COLOURS[Provenance.CAMERA_AND_IMU]) < 75
    with pytest.raises(InvalidInputError, match="--video-shift 60"):
        write_overlay(out, tmp_path / "p.mp4", video, settings=replace(NO_LABELS, shift=60.0))
    assert not (tmp_path / "p.mp4").exists()


def test_a_smaller_copy_of_the_video_is_scaled_and_another_shape_refused(
    out: Path, camera: Camera, skeleton: SkeletonModel, tmp_path: Path
) -> None:
    size = WIDTH * 2 // 3, HEIGHT * 2 // 3
    small = write_film(tmp_path / "small.mp4", [numbered(*size, 0)] * 4, [0, 40, 80, 120])
    result = write_overlay(out, tmp_path / "o.mp4", small, settings=NO_LABELS)
    images, _ = read_film(tmp_path / "o.mp4")
    assert images[0].shape[:2] == size[::-1]
    at = middles(skeleton, camera, 0.0)["RightLeg"] * 2 / 3
    distances = [np.linalg.norm(colour_at(images[0], at) - c) for c in (COLOURS[HOW["RightLeg"]], GREEN)]
    assert distances[0] < 0.7 * distances[1]
    assert any("frames per second" in note for note in result.notes)
    other = write_film(tmp_path / "other.mp4", [numbered(640, 480, 0)] * 2, [0, 40])
    with pytest.raises(InvalidInputError, match=r"640 x 480 px upright.*540 x 960"):
        write_overlay(out, tmp_path / "p.mp4", other)


@pytest.mark.parametrize(
    ("height", "frames", "said"), [(HEIGHT - 8, 30, ("by 8 px",)), (HEIGHT, 3, ("0.00 to 0.48 s", "--video-shift"))]
)
def test_a_video_that_is_cut_or_too_short_is_said(
    out: Path, tmp_path: Path, height: int, frames: int, said: tuple[str, ...]
) -> None:
    cut = write_film(tmp_path / "cut.mp4", [numbered(WIDTH, height, 0)] * frames, [17 * i for i in range(frames)])
    notes = write_overlay(out, tmp_path / "o.mp4", cut, settings=NO_LABELS).notes
    assert any(all(word in note for word in said) for note in notes)


def test_slow_motion_keeps_its_stamps_and_shows_real_time(
    out: Path, tmp_path: Path, camera: Camera, skeleton: SkeletonModel
) -> None:
    """Frames 1/30 s apart in the file that were taken at 240 Hz."""
    images = [numbered(WIDTH, HEIGHT, i) for i in range(9)]
    times = [round(1000 * i / 30) for i in range(9)]
    slow = write_film(tmp_path / "slow.mp4", images, times, metadata={"com.android.capture.fps": "240.0"})
    write_overlay(out, tmp_path / "o.mp4", slow, settings=NO_LABELS)
    drawn, stamps = read_film(tmp_path / "o.mp4")
    np.testing.assert_allclose(stamps, np.array(times) / 1000, atol=2e-3)
    at = middles(skeleton, camera, 8 / 240)["LeftLeg"]
    assert np.linalg.norm(colour_at(drawn[8], at) - COLOURS[Provenance.CAMERA_AND_IMU]) < 75


def test_the_face_of_the_video_is_gone_and_all_of_it_outside_the_motion(
    out: Path, camera: Camera, skeleton: SkeletonModel, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    noise = np.kron(rng.integers(0, 2, (HEIGHT // 6, WIDTH // 6, 1)), np.full((6, 6, 3), 255)).astype(np.uint8)
    times = [0, 100, 200, 300, 400, 600]
    video = write_film(tmp_path / "v.mp4", [noise] * 6, times)
    write_overlay(out, tmp_path / "o.mp4", video, settings=replace(NO_LABELS, blur_face=True))
    images, _ = read_film(tmp_path / "o.mp4")
    motion = moving(skeleton)
    j = motion.skeleton.names.index("Head")
    for image, ms in list(zip(images, times, strict=True))[:5]:
        u, v = camera.project(motion.poses.p_world_joint[min(round(ms * 0.06), FRAMES - 1), j]).astype(int)
        face = image[v - 45 : v - 15, u + 15 : u + 45].astype(float)  # beside the bones
        assert (np.ptp(face, axis=(0, 1)) < 110).all()
        assert np.abs(np.diff(face, axis=1)).mean() < 6
        below = image[v + 300 : v + 340, 20:60].astype(float)
        assert np.ptp(below) > 180
    whole = images[-1][200:760].astype(float)
    assert 30 < np.median(whole) < 220
    assert np.abs(np.diff(whole, axis=1)).mean() < 3  # blocks only


def test_without_a_video_the_picture_is_plain_and_the_geometry_the_same(
    out: Path, camera: Camera, skeleton: SkeletonModel, tmp_path: Path
) -> None:
    for background, level in (("white", 255), ("dark", 32)):
        path = tmp_path / f"{background}.mp4"
        settings = replace(NO_LABELS, background=background)  # type: ignore[arg-type]
        result = write_overlay(out, path, settings=settings)
        assert (result.frames, result.without_motion) == (FRAMES, 0)
        images, stamps = read_film(path)
        np.testing.assert_allclose(stamps, np.arange(FRAMES) / 60, atol=1e-4)
        at = middles(skeleton, camera, 10 / 60)["LeftLeg"]
        assert np.linalg.norm(colour_at(images[10], at) - COLOURS[Provenance.CAMERA_AND_IMU]) < 75
        assert np.abs(images[10][HEIGHT // 2, :40].astype(int) - level).max() < 6


def test_from_and_to_cut_the_film(out: Path, video: Path, tmp_path: Path) -> None:
    settings = replace(NO_LABELS, start=0.1, stop=0.31)
    write_overlay(out, tmp_path / "o.mp4", video, settings=settings)
    images, stamps = read_film(tmp_path / "o.mp4")
    assert [number_of(image) for image in images] == [3, 4, 5, 6]
    np.testing.assert_allclose(stamps, [0, 0.033, 0.066, 0.15], atol=1e-4)
    with pytest.raises(InvalidInputError, match="from 5 s to its end"):
        write_overlay(out, tmp_path / "p.mp4", video, settings=replace(NO_LABELS, start=5.0))
    assert not (tmp_path / "p.mp4").exists()


def test_odd_sizes_are_written(out: Path, tmp_path: Path) -> None:
    result = write_overlay(out, tmp_path / "o.mp4", settings=replace(NO_LABELS, width_px=241, stop=0.1))
    assert (result.width_px, result.height_px) == (241, 428)
    images, _ = read_film(tmp_path / "o.mp4")
    assert images[0].shape[:2] == (428, 242)


@pytest.mark.parametrize(("width", "height"), [(320, 568), (568, 320), (2160, 3840)])
def test_captions_fit_into_small_and_large_pictures(
    skeleton: SkeletonModel, width: int, height: int, tmp_path: Path
) -> None:
    """The skeleton's middle stays free of captions, and text is neither tiny nor cut."""
    faults = [StreamFault(FaultKind.DISAGREES, "right thigh", 0.0, 1.0)]
    motion = motion_with(skeleton, 1, HOW, sigma=0.02)
    folder = write_output(tmp_path / "out", motion, [upright_camera(width, height)], faults=faults)
    write_overlay(folder, tmp_path / "o.mp4", settings=OverlaySettings(bands=True, points=True))
    images, _ = read_film(tmp_path / "o.mp4")
    plain = (images[0] > 235).all(axis=2).mean(axis=1)  # share of white background in each row
    assert (plain > 0.2).mean() > 0.5
    assert (plain[:8] < 0.2).all()
    assert (plain[-8:] < 0.2).all()


def test_the_verdict_is_told_but_not_drawn_on_the_picture(
    skeleton: SkeletonModel, camera: Camera, tmp_path: Path
) -> None:
    pictures = []
    for name, grade in (("good", "pass"), ("likely", "plausible"), ("wrong", "fail")):
        verdict = {"grade": grade, "headline": "the camera is wrong"}
        folder = write_output(tmp_path / name, motion_with(skeleton, 1), [camera], verdict=verdict)
        found = write_overlay(folder, tmp_path / f"{name}.mp4", settings=NO_LABELS)
        assert found.verdict.line == f"{grade}: the camera is wrong"
        pictures.append(read_film(tmp_path / f"{name}.mp4")[0][0])
    for other in pictures[1:]:
        np.testing.assert_array_equal(pictures[0], other)


def test_faults_are_shown_while_they_last(skeleton: SkeletonModel, camera: Camera, tmp_path: Path) -> None:
    faults = [StreamFault(FaultKind.STUCK, "left shank", 0.1, 0.2)]
    folder = write_output(tmp_path / "out", motion_with(skeleton, 20), [camera], faults=faults)
    write_overlay(folder, tmp_path / "o.mp4", settings=NO_LABELS)
    images, _ = read_film(tmp_path / "o.mp4")
    shown = np.array([amber(image) for image in images]) > 100
    np.testing.assert_array_equal(shown, [6 <= i <= 12 for i in range(20)])


def test_sensors_alone_have_a_virtual_camera_and_no_video(skeleton: SkeletonModel, video: Path, tmp_path: Path) -> None:
    motion = motion_with(skeleton, 6, dict.fromkeys(skeleton.names, Provenance.IMU))
    folder = write_output(tmp_path / "out", motion, mode="imu")
    with pytest.raises(InvalidInputError, match=r"sensors alone.*--no-video"):
        write_overlay(folder, tmp_path / "o.mp4", video)
    result = write_overlay(folder, tmp_path / "o.mp4", settings=OverlaySettings(bands=True, points=True))
    assert (result.frames, result.without_motion) == (6, 0)
    images, _ = read_film(tmp_path / "o.mp4")
    orange = np.linalg.norm(images[0].astype(float) - COLOURS[Provenance.IMU], axis=2) < 40
    assert orange.sum() > 500


def test_an_older_output_says_what_to_do(skeleton: SkeletonModel, camera: Camera, tmp_path: Path) -> None:
    folder = write_output(tmp_path / "out", motion_with(skeleton, 3), [camera])
    (folder / "measurements.h5").unlink()
    with pytest.raises(FileFormatError, match=r"measurements.h5.*earlier version.*reconstruct"):
        write_overlay(folder, tmp_path / "o.mp4")
    other = write_output(tmp_path / "other", motion_with(skeleton, 4), [camera])
    (folder / "measurements.h5").write_bytes((other / "measurements.h5").read_bytes())
    with pytest.raises(FileFormatError, match="not of the motion.h5 beside it"):
        write_overlay(folder, tmp_path / "o.mp4")


def test_views_are_chosen_by_number(skeleton: SkeletonModel, camera: Camera, tmp_path: Path) -> None:
    second = upright_camera(640, 480)
    folder = write_output(tmp_path / "out", motion_with(skeleton, 3), [camera, second])
    result = write_overlay(folder, tmp_path / "o.mp4", view=2)
    assert (result.width_px, result.height_px) == (640, 480)
    for number in (0, 3):
        with pytest.raises(InvalidInputError, match="from 1 to 2"):
            write_overlay(folder, tmp_path / "p.mp4", view=number)


def test_a_video_of_a_stabilised_camera_with_unknown_turning_is_refused(
    skeleton: SkeletonModel, camera: Camera, video: Path, tmp_path: Path
) -> None:
    still = replace(camera, stabilised=True)
    folder = write_output(tmp_path / "out", motion_with(skeleton, 3), [still])
    assert read_measurements(folder / "measurements.h5").views[0].camera.stabilised
    with pytest.raises(InvalidInputError, match="handheld"):
        write_overlay(folder, tmp_path / "o.mp4", video)
    assert write_overlay(folder, tmp_path / "o.mp4").frames == 3


def test_nothing_is_replaced_and_nothing_half_is_left(
    out: Path, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "o.mp4"
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        write_overlay(out, path, video)
    assert path.read_text() == "mine"

    def failing(*_: object) -> None:
        raise OSError("disk is full")

    monkeypatch.setattr(film_files.Mp4Writer, "write", failing)
    with pytest.raises(Exception, match="disk is full"):
        write_overlay(out, tmp_path / "p.mp4", video, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["o.mp4"]
    with pytest.raises(InvalidInputError, match=r"must end with \.mp4"):
        write_overlay(out, tmp_path / "o.avi", video)


def test_without_h264_the_encoders_are_named(
    out: Path, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtof_kin.vision.video.H264_ENCODERS", ("no_such_encoder",))
    with pytest.raises(RtofError, match="no_such_encoder"):
        write_overlay(out, tmp_path / "p.mp4", video, settings=NO_LABELS)
