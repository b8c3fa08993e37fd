"""`RobotMap`: which link of a robot follows which segment of a person, and how closely; a TOML file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Final, Self

from pydantic import BaseModel, ConfigDict, PositiveFloat, ValidationError

from rtof_kin.body.soles import FEET
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.text import read_text
from rtof_kin.core.resources import model_path

Triple = tuple[float, float, float]
SHIPPED: Final = "robots"  #: Folder of the shipped maps


class Link(BaseModel):
    """A link and the segment that it follows.

    Tolerances are standard deviations, whose inverses are the weights. Turns are about the axes of the posture with
    hanging arms, x forward, y left, z up, whatever the axes of the link are.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str
    segment: str  #: Joint of the person's skeleton at which the segment begins
    parent: str = ""  #: Link that carries this one; '': the first of all
    position_mm: PositiveFloat | None = None  #: Tolerance of its position; None: it has no target
    orientation_deg: PositiveFloat | tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None = None
    heel_mm: Triple | None = None
    toe_mm: Triple | None = None  #: The ends of a foot's sole, in the frame of the link


class RobotMap(BaseModel):
    """Links, parents before children, and the angles of the posture in which the arms hang; other angles are 0."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    link: tuple[Link, ...]
    posture_deg: dict[str, float] = {}

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file, in which ``{side}`` and ``{Side}`` stand for left and right.

        Raises:
            FileFormatError: damaged; a parent does not come before its child; not one foot of each side.
        """
        try:
            table = tomllib.loads(read_text(path, "a table of a robot's links, TOML"))
            rows: list[dict[str, object]] = []
            for row in table.get("link", []):
                sides = ("left", "right") if any("{side}" in str(value) for value in row.values()) else ("",)
                rows += [
                    {key: v.format(side=side, Side=side.title()) if isinstance(v, str) else v for key, v in row.items()}
                    for side in sides
                ]
            found = cls.model_validate(table | {"link": rows})
        except (tomllib.TOMLDecodeError, AttributeError, KeyError, IndexError) as error:
            raise FileFormatError(path, str(error)) from error
        except ValidationError as error:
            first = error.errors()[0]
            raise FileFormatError(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
        names = [one.name for one in found.link]
        for i, one in enumerate(found.link):
            if one.name in names[:i] or (one.parent and one.parent not in names[:i]):
                raise FileFormatError(path, f"link {one.name}: stands twice, or before its parent {one.parent}")
        feet = sorted(one.segment for one in found.link if one.heel_mm and one.toe_mm and one.position_mm)
        if feet != sorted(FEET):
            raise FileFormatError(path, f"need heel_mm, toe_mm and position_mm of a link for each of {', '.join(FEET)}")
        return found

    @classmethod
    def choose(cls, word: str | None, links: set[str]) -> Self:
        """Return the map that a word names, a file or a shipped one; None: the shipped one of these links.

        Raises:
            UnknownNameError: a link or name is not known. InvalidInputError: no shipped map is of these links.
        """
        folder = model_path(SHIPPED)
        shipped = {path.stem: path for path in sorted(folder.glob("*.toml"))}
        if word is None:
            for path in shipped.values():
                found = cls.read(path)
                if {one.name for one in found.link} <= links:
                    return found
            known = ", ".join(shipped)
            raise InvalidInputError(f"no map ships for the links of this robot, only for {known}; give --map FILE.toml")
        path = shipped.get(word, Path(word))
        found = cls.read(path)
        if missing := [one.name for one in found.link if one.name not in links]:
            raise UnknownNameError(f"link of {path.name} in the robot", missing, sorted(links))
        return found
