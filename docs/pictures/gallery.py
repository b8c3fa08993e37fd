"""``gallery.md``: what each command gives, as a picture or as the text that it prints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from docs.pictures.studio import DOCS, Studio
from rtof_kin.core.resources import model_path

MOST_LINES = 26
HEAD = """# Gallery: what each command gives

Pictures and texts are made by `make pictures` from the recording that comes with the package (24 s of
exercises, one simulated camera with a real detector's errors, eight simulated sensors), unless said
otherwise. Every command is described in [command_line.md](command_line.md).
"""


@dataclass(frozen=True)
class Entry:
    """One command: a picture of the docs, or the text that it prints."""

    command: str
    what: str
    picture: str = ""
    alternative: str = ""
    """Text in the place of the picture."""
    printed: Callable[[Studio], str] | None = None


def text_of(studio: Studio, *arguments: str | Path) -> str:
    """Return what a command prints, without its folders."""
    text = studio.printed(*arguments).replace(f"{studio.folder}/", "out/")
    text = text.replace(str(model_path("demo")), "models/demo")
    lines = [line.rstrip() for line in text.strip("\n").splitlines()]
    kept = lines if len(lines) <= MOST_LINES else [*lines[:MOST_LINES], "..."]
    return "\n".join(kept)


ENTRIES = (
    Entry(
        "rtof-kin run walk.mp4 dots/ --height 1.72 -o out/walk",
        "From a video and sensor files to a report in one command ([how](phone.md)); `run --demo` does the last "
        "steps on the recording of the package. The first lines say how good it is, and cautions:",
        printed=lambda studio: text_of(studio, "run", "--demo", "-o", studio.folder / "printed"),
    ),
    Entry(
        "rtof-kin report out/demo",
        "[A page](report.md) that opens offline, on a phone, and on paper.",
        "report.png",
        "The report on a screen, and on a phone",
    ),
    Entry(
        "rtof-kin view out/demo",
        "[The motion in 3D](view.md) in the browser, with camera, sensors, bands, truth and curves; `--html` "
        "writes one file.",
        "view.png",
        "The motion in the viewer, with its panel and curves",
    ),
    Entry(
        "rtof-kin overlay out/walk walk.mp4 -o out/walk.mp4",
        "[The skeleton on the video](overlay.md), or on a plain background, with angles, their bands and "
        "what observed each bone.",
        "overlay.png",
        "A frame of the overlay",
    ),
    Entry(
        "rtof-kin compare out/before out/after -o out/compared",
        "[Two motions](compare.md), left and right, or another system's `.mot`: which angles changed.",
        "compare.png",
        "The page of a comparison",
    ),
    Entry(
        "rtof-kin compare visits -o out/follow",
        "[Visits of one person](follow.md): improved, worse or not shown, and the smallest change that could be.",
        "follow.png",
        "The page of three visits",
    ),
    Entry(
        "rtof-kin live SETUP --camera 0 --imus lsl:DOTs --browser",
        "[Poses while a person moves](live.md), from a webcam, LSL, or recordings replayed as here.",
        "live.png",
        "The live page: skeleton, angles and streams",
    ),
    Entry(
        "rtof-kin study models/demo -o out/study",
        "[What each sensor contributes](report.md), angle by angle.",
        "study.png",
        "Contribution of each sensor",
    ),
    Entry(
        "rtof-kin reconstruct REC --mode imu -o out/imu",
        "[Sensors alone](without_camera.md); here a real recording of 17 sensors.",
        "sensors_only.png",
        "Skeletons of a walk over time, from sensors alone",
    ),
    Entry(
        "rtof-kin reconstruct REC -o out/rec",
        "[The files](output.md) of a result; here the skeletons of the demo over the truth.",
        "skeletons.png",
        "Skeletons of the demo over the truth",
    ),
    Entry(
        "rtof-kin reconstruct models/demo --calibrate-only",
        "[What a recording tells about its own setup](calibration.md), with standard deviations:",
        printed=lambda studio: text_of(
            studio, "reconstruct", model_path("demo"), "--calibrate-only", "-o", studio.folder / "calibration.toml"
        ),
    ),
    Entry(
        "rtof-kin evaluate out/demo --truth models/demo",
        "Errors against a known truth:",
        printed=lambda studio: text_of(studio, "evaluate", studio.demo, "--truth", model_path("demo")),
    ),
    Entry(
        "rtof-kin report out/demo --analysis out/angles --weight 70",
        "[Clinical angles](clinical.md) as tables:",
        printed=lambda studio: text_of(
            studio, "report", studio.demo, "--analysis", studio.folder / "angles", "--weight", "70"
        ),
    ),
    Entry(
        "rtof-kin export out/demo --to osim,mot,trc,c3d,bvh out/files",
        "[Files for every tool](files.md):",
        printed=lambda studio: text_of(
            studio, "export", studio.demo, studio.folder / "files", "--to", "osim,mot,trc,c3d,bvh"
        ),
    ),
    Entry(
        "rtof-kin inspect models/demo",
        "A recording, or sensor files of [all kinds](sensors.md), checked by physics:",
        printed=lambda studio: text_of(studio, "inspect", model_path("demo")),
    ),
)


def make(studio: Studio) -> list[Path]:
    parts = [HEAD]
    for entry in ENTRIES:
        parts.append(f"## `{entry.command}`\n\n{entry.what}\n")
        if entry.picture:
            parts.append(f"![{entry.alternative}]({entry.picture})\n")
        if entry.printed is not None:
            parts.append(f"```text\n{entry.printed(studio)}\n```\n")
    path = DOCS / "gallery.md"
    path.write_text("\n".join(parts), encoding="utf-8")
    return [path]
