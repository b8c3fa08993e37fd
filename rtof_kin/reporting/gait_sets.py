"""Public sets of healthy gait as references of the gait scores; ``gait_sets.toml`` has their files and citations.

Sets of optical markers become motions of this package's own body, so that angles have its definitions. Sets of angles
keep those of their authors, as means alone; signs are checked by what every healthy gait shows.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

import rtof_kin
from rtof_kin.clinical.gait_scores import build_reference
from rtof_kin.clinical.gait_variables import GaitCycles, gait_cycles, joined_cycles
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, reading
from rtof_kin.core.files.text import read_text
from rtof_kin.data.gait_reference import MODEL_ZERO, NAMES, OWN_SYSTEM, SHAPE, GaitReference
from rtof_kin.formats.sensors.imu_mat import matlab_variables
from rtof_kin.markers.fit import MISFIT, fit_body, track
from rtof_kin.markers.trials import MarkerResult, read_trial

SETS: Final[dict[str, dict[str, Any]]] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_FITTED: Final = 3  # passes that the body of a person is fitted to, beside the static trial
_LARGER: Final = {"hip_flexion": (0, 50), "knee_flexion": (72, 40), "ankle_dorsiflexion": (44, 62)}
"""Per cent of the cycle at which a variable is larger, and smaller, in every healthy gait."""


def read_gait_set(
    name: str,
    folder: Path,
    progress: Callable[[int, int], None],
    least_strides: int = 3,
    speeds: tuple[float, float] | None = None,
    up: str | None = None,
) -> tuple[GaitReference, dict[str, str]]:
    """Return the reference of one of `SETS` below a folder, and who is left out with the reason.

    speeds: m/s, slowest and fastest, of trials that state theirs. up: see `read_trial`. `FileFormatError`: no file of
    it, or other signs; `InvalidInputError`: too few people are left.
    """
    indices_of("gait set", [name], list(SETS))
    own, files = SETS[name], dict[str, list[Path]]()
    for path in sorted(folder.rglob("*")):
        if found := re.fullmatch(own["files"], path.name):
            files.setdefault(found[1], []).append(path)
    if speeds and name != "lencioni2019":
        raise InvalidInputError(f"--walking-speed: trials of {name} do not state theirs; they are of comfortable speed")
    if not files:
        raise FileFormatError(folder, f"no file of {name} below it: expected names as {own['files']}")
    people, left_out = dict[str, Any](), dict[str, str]()
    for number, (person, paths) in enumerate(files.items()):
        try:
            if "static" in own:
                people[person] = _strides(paths, own["static"].format(person), up)
            else:
                people[person] = _angles(paths, own["columns"], speeds)
        except RtofError as error:
            left_out[person] = str(error)
        progress(number + 1, len(files))
    about = {key: own[key] for key in ("licence", "source", "system", "zero") if key in own} | {
        "notes": tuple(own["notes"])
    }
    if "static" not in own:
        return _means(folder, people, own, about), left_out
    about |= {"system": f"{OWN_SYSTEM} {rtof_kin.__version__}, on the optical markers of {name}", "zero": MODEL_ZERO}
    made, without = build_reference(people, least_strides=least_strides, **about)
    return made, left_out | without


def _strides(walks: list[Path], static_name: str, up: str | None) -> GaitCycles:
    """Strides of all passes of a person, on one body; events are those that are found in every other motion."""
    static = [path for path in sorted(walks[0].parent.iterdir()) if re.fullmatch(static_name, path.name)]
    trials, parts = [read_trial(path, up) for path in (*static, *walks)], []
    body = fit_body(trials[: len(static) + _FITTED])
    for path, trial in zip(walks, trials[len(static) :], strict=True):
        found = MarkerResult(path.stem, trial, body, track(trial, body))
        if found.rms > MISFIT:
            raise InvalidInputError(f"{path}: {found.headline}")
        parts.append(gait_cycles(found.motion, few=True))
    return joined_cycles(parts)


def _angles(files: list[Path], columns: dict[str, str], speeds: tuple[float, float] | None) -> dict[str, Array]:
    """Mean curves (51,) of a person, deg, over sides and trials."""
    found: dict[str, list[Array]] = {name: [] for name in columns}
    for path in files:
        for trial in _trials(path, speeds):
            for name, column in columns.items():
                if column not in trial or trial[column].shape != (101,):
                    raise FileFormatError(path, f"no {column} at 101 instants; is it of another version of the set?")
                if np.isfinite(trial[column]).all():
                    found[name].append(trial[column][::2])
    if missing := [name for name, curves in found.items() if not curves]:
        raise InvalidInputError(f"{files[0]}: no complete curve of {', '.join(missing)}")
    return {name: np.mean(curves, axis=0) for name, curves in found.items()}


def _trials(path: Path, speeds: tuple[float, float] | None) -> Iterator[dict[str, Array]]:
    """Yield angles by name, deg: of each stride of walking of a .mat, or of the right and left of a table."""
    with reading(path, "is not as the set publishes it ({})", KeyError, TypeError, ValueError):
        if path.suffix == ".mat":
            struct: Any = matlab_variables(path, simplify_cells=True)["s"]
            names = [str(name).strip() for name in struct["AngVarName"]]
            for trial in np.atleast_1d(struct["Data"]):
                wanted = speeds is None or speeds[0] <= float(trial["speed"]) <= speeds[1]
                if wanted and str(trial["Task"]).strip() == "Walking":
                    yield dict(zip(names, np.asarray(trial["Ang"], dtype=float), strict=True))
            return
        head, *lines = read_text(path, "a table of angles, separated by tabs").splitlines()
        rows = [[float(cell or "nan") for cell in line.split("\t")] for line in lines if line.strip()]
        by_name = dict(zip(head.split("\t"), np.array(rows).T, strict=True))
        for side in "RL":
            yield {name.strip()[1:]: values for name, values in by_name.items() if name.startswith(side)}


def _means(folder: Path, people: dict[str, Any], own: dict[str, Any], about: dict[str, Any]) -> GaitReference:
    """Means and standard deviations between people, with the signs of healthy gait."""
    if len(people) < 2:
        raise InvalidInputError(f"{folder}: {len(people)} people can be used, and two are needed")
    mean, sd = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    for name in own["columns"]:
        curves, v = np.array([one[name] for one in people.values()]), NAMES.index(name)
        mean[v], sd[v] = curves.mean(axis=0), curves.std(axis=0, ddof=1)
        high, low = _LARGER.get(name, (0, 0))
        if high != low and not mean[v, high // 2] > mean[v, low // 2]:
            raise FileFormatError(folder, f"{name} is not larger at {high} than at {low} % of the cycle: another sign?")
    return GaitReference(np.radians(mean), np.radians(sd), len(people), **about)
