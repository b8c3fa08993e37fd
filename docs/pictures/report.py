"""``report.png``: the report of the demo on a desktop and on a phone."""

from pathlib import Path

from PIL import Image

from docs.pictures.studio import Studio, save, side_by_side

LABELS = ("--code", "P07", "--operator", "A. Analyst", "--date", "2026-01-31", "--weight", "70")
DESKTOP, PHONE, NARROWEST = (1180, 1500), (390, 1500), 520
"""[px] width and height; the narrowest window of a headless browser."""
WIDTH = 1400


def make(studio: Studio) -> list[Path]:
    page = studio.folder / "report.html"
    studio.rtof_kin("report", studio.demo, "-o", page, *LABELS)
    framed = studio.folder / "phone.html"
    width, height = PHONE
    framed.write_text(
        f'<body style="margin:0"><iframe src="{page.name}" width="{width}" height="{height}" '
        'style="border:0"></iframe></body>'
    )
    images = []
    for source, (wide, high), window in ((page, DESKTOP, DESKTOP[0]), (framed, PHONE, NARROWEST)):
        picture = studio.folder / f"{source.stem}.png"
        studio.photograph(source, picture, window, high)
        with Image.open(picture) as image:
            images.append(image.convert("RGB").crop((0, 0, wide, high)))
    return [save(side_by_side(images, 24), "report.png", WIDTH)]
