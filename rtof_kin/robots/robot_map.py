"""`RobotMap`: which link of a robot follows which segment of a person, and how closely; a TOML file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, PositiveFloat, ValidationError

from rtof_kin.body.soles import FEET
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.text import read_text
from rtof_kin.core.resources import model_path


class Link(BaseModel):
    """A link and the segment that it follows; tolerances are standard deviations, whose inverses are the weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str
    segment: str  #: Joint of the person's skeleton at which the segment begins
    parent: str = ""  #: Link that carries this one; '': the first of all
    position_mm: PositiveFloat | None = None  #: Tolerance of its position; None: it has no target
    orientation_deg: PositiveFloat | tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None = None
    """Tolerance of its orientation, or of turns about x forward, y left and z up in the posture with hanging arms."""
    sole_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None  #: Heel, toe, in its frame


class RobotMap(BaseModel):
    """Links, parents before children, and the angles of the posture in which the arms hang; other angles are 0."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    link: tuple[Link, ...]
    posture_deg: dict[str, float] = {}
    name: str = ""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file, in which ``{side}`` and ``{Side}`` stand for left and right; `FileFormatError`: it is damaged, a
        parent does not come before its child, or there is not a sole of each foot.
        """
        try:
            text = read_text(path, "a table of a robot's links, TOML")
            head, *rows = text.split("[[link]]")
            pairs = [[row.replace("{side}", s.lower()).replace("{Side}", s) for s in ("Left", "Right")] for row in rows]
            both = [row for pair in pairs for row in dict.fromkeys(pair)]
            found = cls.model_validate(tomllib.loads("[[link]]".join([head, *both])) | {"name": path.stem})
        except (tomllib.TOMLDecodeError, LookupError, ValidationError) as error:
            raise FileFormatError(path, " ".join(str(error).split())) from error
        names = [one.name for one in found.link]
        for i, one in enumerate(found.link):
            if one.name in names[:i] or one.parent not in ("", *names[:i]):
                raise FileFormatError(path, f"link {one.name}: stands twice, or before its parent {one.parent}")
        if sorted(one.segment for one in found.link if one.sole_mm and one.position_mm) != [*FEET]:
            raise FileFormatError(path, "needs sole_mm and position_mm of one link for LeftFoot and one for RightFoot")
        return found

    @classmethod
    def choose(cls, word: str | None, links: set[str]) -> Self:
        """Return the map that a word names, a file or a shipped one; None: the shipped one of these links.
        `UnknownNameError`: a link is not known; `InvalidInputError`: no shipped map is of these links.
        """
        shipped = {path.stem: path for path in sorted(model_path("robots").glob("*.toml"))}
        for path in shipped.values() if word is None else [shipped.get(word, Path(word))]:
            found = cls.read(path)
            missing = [one.name for one in found.link if one.name not in links]
            if word is not None and missing:
                raise UnknownNameError(f"link of {path.name} in the robot", missing, sorted(links))
            if not missing:
                return found
        raise InvalidInputError(f"no map ships for this robot's links, only {', '.join(shipped)}; give --map FILE.toml")
