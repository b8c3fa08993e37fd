"""``certificate.png``: what left-out sensors say of the demo, as on the page of its report."""

from pathlib import Path

from PIL import Image

from docs.pictures.studio import Studio, save
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.reporting.certificate import picture
from rtof_kin.reporting.html import asset
from rtof_kin.reporting.summary_file import SUMMARY, read_summary

SIZE = 640, 232


def make(studio: Studio) -> list[Path]:
    found = read_summary(studio.demo / SUMMARY).certificate
    assert found is not None
    page, drawn = studio.folder / "certificate.html", studio.folder / "certificate.png"
    bars = picture(found, angle_table(SkeletonModel.default().table))
    styles = f"<style>{asset('page.css')}{asset('report.css')}</style>"
    page.write_text(f"{styles}<body>{bars}</body>", encoding="utf-8")
    studio.photograph(page, drawn, *SIZE)
    with Image.open(drawn) as image:
        return [save(image.convert("RGB"), "certificate.png", SIZE[0])]
