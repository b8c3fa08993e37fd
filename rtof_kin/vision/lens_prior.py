"""`lens_prior`: focal length and distortion of a camera that was not calibrated, with standard deviations.

What is known decides: the focal length that the file states, the model's entry in ``models/phones.toml``, or
nothing, where the fields of view of phones' main cameras and of webcams give a wide prior. Focal lengths are
kept relative to the longer side of the image, so that they hold for every resolution of a camera.

An equivalent focal length f35 is stated for the diagonal of 35 mm film (43.27 mm) and the 4:3 sensor of a phone, whose
diagonal is 5/4 of its width: f / width = f35 / 34.61 mm. The iPhones of the table whose lenses were calibrated have
0.955 +- 0.017 of that in videos. A phone's own camera application then crops the image to stabilise it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.vision.video_metadata import VideoMetadata

UNKNOWN_FOCAL: Final = 0.76
"""Focal length over the longer side of the image of an unknown camera: 67 degrees of view."""
UNKNOWN_SIGMA: Final = 0.15
"""Its relative standard deviation: 55 to 80 degrees of view are one away."""
STABILISED, STABILISED_SIGMA = 1.08, 0.07
"""Factor on the focal length by cropping to stabilise, 0 to about 20 %, and its standard deviation."""
_FILM_WIDTH_MM = 34.61  # diagonal of 35 mm film times 4/5
_VIDEO = 0.955  # of the stated equivalent focal length, in videos
_UNKNOWN_K1_SIGMA = 0.08
_UNKNOWN = (UNKNOWN_FOCAL, UNKNOWN_SIGMA, 0.0, _UNKNOWN_K1_SIGMA)
_STATED_SIGMA = 0.04  # relative, of a whole number of mm
_SAME_LENS = 0.12  # relative difference in focal length below which a stated one is the main camera's
_OTHER_LENSES = {"front": _UNKNOWN, "ultra": (0.42, 0.15, 0.0, 0.1), "tele": (1.9, 0.4, 0.0, 0.05)}
_ODD_SIGMA = 0.12  # relative, for images cropped to another shape than 4:3 to 16:9
_SHAPES = (1.25, 1.95)


@dataclass(frozen=True)
class LensPrior:
    """Lens of a camera before calibration."""

    focal_px: float
    """Focal length, px."""
    sigma_focal: float
    """Relative standard deviation of the focal length."""
    k1: float
    """First radial coefficient of OpenCV's distortion model."""
    sigma_k1: float
    """Its standard deviation."""
    source: str
    """Where this is from: a sentence for reports."""


class Phone(NamedTuple):
    """Main camera of a phone or tablet in ``models/phones.toml``."""

    make: str
    models: tuple[str, ...]
    """Names in files, as patterns of `fnmatch`."""
    focal: float
    """Focal length over the longer side of the image, without stabilisation."""
    sigma: float
    """Relative standard deviation of `focal`."""
    k1: float
    sigma_k1: float
    source: str


def lens_prior(width_px: int, height_px: int, metadata: VideoMetadata | None = None) -> LensPrior:
    """Return what can be assumed of the lens of an uncalibrated camera.

    Args:
        metadata: of the video; None where there is none.

    Raises:
        InvalidInputError: a size is not positive.
    """
    if min(width_px, height_px) <= 0:
        raise InvalidInputError(f"image of {width_px} x {height_px} px: both have to be positive")
    long, shape = max(width_px, height_px), max(width_px, height_px) / min(width_px, height_px)
    focal, sigma, k1, sigma_k1, source = _lens(metadata)
    if not _SHAPES[0] <= shape <= _SHAPES[1]:
        sigma = math.hypot(sigma, _ODD_SIGMA)
        source += f"; the image of {width_px} x {height_px} px is cropped, by an unknown factor"
    degrees = math.degrees(2 * math.atan(0.5 / focal))
    view = f"field of view {degrees:.0f} degrees along the longer side, focal length +- {100 * sigma:.0f} %"
    return LensPrior(focal * long, sigma, k1, sigma_k1, f"{view}: {source}")


def _lens(metadata: VideoMetadata | None) -> tuple[float, float, float, float, str]:
    """Return focal length over the longer side, relative sd, k1, its sd and the source."""
    if metadata is None:
        return *_UNKNOWN, "that of phones and webcams in general, as nothing is known of the camera"
    cropped = "with an allowance for stabilisation, which crops the image by up to 20 %"
    camera = f"{metadata.make or ''} {metadata.model or 'camera'}".strip()
    phone = find_phone(metadata.make, metadata.model)
    if metadata.focal_35mm_mm is not None:
        focal = metadata.focal_35mm_mm * _VIDEO / _FILM_WIDTH_MM
        main = phone is not None and abs(focal / phone.focal - 1) < _SAME_LENS
        if phone is None or not main:
            sigma = math.hypot(_STATED_SIGMA, STABILISED_SIGMA)
            stated = f"{metadata.focal_35mm_mm:g} mm (as for 35 mm film), as the file of this {camera} states"
            return focal * STABILISED, sigma, 0.0, _UNKNOWN_K1_SIGMA, f"{stated}, {cropped}"
    else:
        for word, of_other in _OTHER_LENSES.items():
            if word in (metadata.lens or "").lower():
                return (*of_other, f"that of phones' {word} lenses in general, which this {camera} used")
    if phone is None:
        known = f"{camera} is not in the table of phones" if metadata.model else "the file does not name it"
        return *_UNKNOWN, f"that of phones and webcams in general, as the camera is unknown ({known})"
    sigma = math.hypot(phone.sigma, STABILISED_SIGMA)
    source = f"main camera of {camera} ({phone.source}), {cropped}"
    return phone.focal * STABILISED, sigma, phone.k1, phone.sigma_k1, source


def find_phone(make: str | None, model: str | None) -> Phone | None:
    """Return the entry of a phone or tablet in the shipped table, None if it has none.

    Args:
        make, model: names of maker and model as in files; case does not matter.
    """
    wanted, maker = (model or "").strip().lower(), (make or "").strip().lower()
    for phone in phone_table():
        own = phone.make.lower() in (maker or phone.make.lower())
        if own and any(fnmatchcase(wanted, name.lower()) for name in phone.models):
            return phone
    return None


@cache
def phone_table() -> tuple[Phone, ...]:
    """Return the shipped table of phones."""
    return read_phone_table(model_path("phones.toml"))


def read_phone_table(path: str | Path) -> tuple[Phone, ...]:
    """Read a table of phones.

    Raises:
        FileFormatError: not TOML, a field missing or of the wrong kind, a focal length beyond any phone's.
    """
    data = load_toml(Path(path))
    try:
        return tuple(_phone(entry, data["sources"]) for entry in data["phone"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(path, f"an entry is incomplete or of the wrong kind: {error!r}") from error


def _phone(entry: dict[str, Any], sources: dict[str, dict[str, Any]]) -> Phone:
    source = sources[entry["source"]]
    focal = float(entry["focal"]) if "focal" in entry else entry["focal_35mm_mm"] * _VIDEO / _FILM_WIDTH_MM
    if not 0.3 < focal < 3:
        raise ValueError(f"{entry['models']}: focal length {focal:g} of the longer side")
    k1, sigma_k1 = float(entry.get("k1", source["k1"])), float(source["sigma_k1"])
    models = tuple(map(str, entry["models"]))
    return Phone(str(entry["make"]), models, focal, float(source["sigma"]), k1, sigma_k1, str(source["title"]))
