"""Folders import in one direction, and importing the package is cheap."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator, Set
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = {
    "core": "errors, checks, rotations, signals; files and numerics",
    "data": "camera, keypoints, IMUs, poses, confidence",
    "body": "skeleton, URDF, kinematics, pose prior, metrics",
    "formats": "one file per file format",
    "vision": "detections to landmarks",
    "inertial": "physics checks, alignment, contacts, root path",
    "recording": "`Recording` and its folder",
    "simulation": "recordings from motion capture",
    "datasets": "Total Capture, Human3.6M",
    "solve": "SF2 and the fragment solvers",
    "markers": "trials of optical laboratories to motions",
    "calibration": "self-calibration",
    "reconstruction": "recording to motion",
    "clinical": "angles, gait, repetitions, torques",
    "reporting": "figures, report, audit, export",
    "setup": "raw files to a recording, and on to a report",
    "plan": "expected errors of a recording before it is made",
    "robots": "motions on humanoid robots",
    "live": "sources, online estimator, monitoring, outputs",
    "view": "3D scene in the browser, skeleton on the video",
    "protocols": "the papers' protocols",
    "batch": "many recordings",
    "app": "people, visits and recordings in the browser",
    "cli": "the command line",
}
"""The folders of `rtof_kin`; each imports only from itself and from those above it here."""
LIFTING_USES = {"core", "data", "body", "simulation", "datasets"}
"""Folders that `lifting` may import from."""
LIFTING_USERS = {"reconstruction", "setup", "live", "protocols", "cli"}
"""Folders that may import `lifting`, in functions or for type checking: the package does not load torch."""
HEAVY = {"torch", "matplotlib", "yourdfpy", "casadi", "pinocchio", "viser", "av"}


@cache
def imports(path: Path) -> tuple[tuple[str, bool], ...]:
    """Dotted names that a file imports, and whether only a call or a type checker does so."""
    return tuple(imports_of(ast.parse(path.read_text(encoding="utf-8")), path, late=False))


def imports_of(node: ast.AST, path: Path, late: bool) -> Iterator[tuple[str, bool]]:
    """The same of a part of a file."""
    if isinstance(node, ast.Import):
        yield from ((alias.name, late) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"{path}, line {node.lineno}: relative import"
        yield from ((f"{node.module}.{alias.name}", late) for alias in node.names)
    elif isinstance(node, ast.stmt | ast.Module | ast.ExceptHandler | ast.match_case):
        late = late or isinstance(node, ast.FunctionDef)
        late = late or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        for child in ast.iter_child_nodes(node):
            yield from imports_of(child, path, late)


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def test_package_has_these_folders_and_no_loose_module() -> None:
    entries = {p.name for p in (ROOT / "rtof_kin").iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert entries == set(FOLDERS)
    assert [p.name for p in (ROOT / "rtof_kin").glob("*.py")] == ["__init__.py"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_folder_imports_only_from_those_above_it_and_is_documented(folder: str) -> None:
    allowed = {f"rtof_kin.{name}" for name in list(FOLDERS)[: list(FOLDERS).index(folder) + 1]}
    own = [(path, name, call) for path in files(f"rtof_kin/{folder}") for name, call in imports(path)]
    inner = {(path, ".".join(name.split(".")[:2])) for path, name, _ in own if name.startswith("rtof_kin.")}
    assert not [(str(path), name) for path, name in inner if name not in allowed]
    lifting = {call for _, name, call in own if name.startswith("lifting")}
    assert lifting <= ({True} if folder in LIFTING_USERS else set())
    assert ast.get_docstring(ast.parse((ROOT / "rtof_kin" / folder / "__init__.py").read_text()))


def test_lifting_imports_nothing_above_simulation() -> None:
    names = {
        name.split(".")[1]
        for path in files("lifting")
        for name, _ in imports(path)
        if name[:9] == "rtof_kin." and path.name != "__main__.py"
    }
    assert names == LIFTING_USES


def test_heavy_packages_are_imported_only_where_they_belong() -> None:
    users: dict[str, set[str]] = {name: set() for name in HEAVY}
    for path in files("rtof_kin"):
        for name, call in imports(path):
            package = "casadi" if name == "rtof_kin.core.packages.casadi" else name.split(".")[0]
            if package in HEAVY and not call:
                users[package].add(path.relative_to(ROOT / "rtof_kin").parts[0])
    assert users["torch"] == users["yourdfpy"] == users["viser"] == users["av"] == set()
    assert users["pinocchio"] == set()  # body/rigid_bodies.py asks `optional` for it
    assert users["casadi"] == {"core", "solve"}
    assert users["matplotlib"] <= {"reporting", "plan", "protocols"}


def loaded_by(*statements: str, packages: Set[str] = HEAVY) -> list[tuple[set[str], float]]:
    """Packages loaded after each of some statements in a new interpreter, and the seconds since its start."""
    code = "import sys, time; t = time.perf_counter()" + "".join(
        f"; {statement}; print(*[m for m in {sorted(packages)} if m in sys.modules], time.perf_counter() - t)"
        for statement in statements
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    lines = [line.split() for line in done.stdout.splitlines()]
    return [(set(names), float(seconds)) for *names, seconds in lines]


def test_importing_the_package_takes_less_than_a_second_and_loads_nothing_heavy() -> None:
    ((names, seconds),) = loaded_by("import rtof_kin")
    assert names == set()
    assert seconds < 1.0


def test_threads_are_limited_before_numpy_is_imported() -> None:
    """So that the default of one thread takes effect."""
    ran = "code = rtof_kin.cli.main(['reconstruct', 'none', '-o', 'none/out'])"
    told = "import os; assert (code, os.environ['OPENBLAS_NUM_THREADS']) == (2, '1')"
    loaded = [names for names, _ in loaded_by("import rtof_kin.cli", ran, told, packages={"numpy"})]
    assert loaded == [set(), {"numpy"}, {"numpy"}]


def test_help_takes_less_than_a_third_of_a_second_of_processor_time() -> None:
    code = "import sys, time; from rtof_kin.cli import main; code = main(['--help']); "
    code += "print(time.process_time(), code, *{'numpy', 'casadi'} & {*sys.modules}, file=sys.stderr)"
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT) for _ in range(3)]
    assert [run.stderr.split()[1:] for run in runs] == 3 * [["0"]]
    assert min(float(run.stderr.split()[0]) for run in runs) < 0.3  # other work on the processor only adds


def test_name_of_the_front_door_loads_only_what_it_needs() -> None:
    statements = ("import ImuCalibration, Camera", "import SkeletonModel", "import reconstruct")
    data, body, solver = (names for names, _ in loaded_by(*(f"from rtof_kin {text}" for text in statements)))
    assert data == set()
    assert body == {"pinocchio"}
    assert solver == {"pinocchio"}  # a compiled energy is loaded without CasADi


def test_names_of_the_front_door_exist() -> None:
    import rtof_kin

    for name in rtof_kin.__all__:
        assert getattr(rtof_kin, name).__name__ == name
    assert set(rtof_kin.__all__) <= set(dir(rtof_kin))
    with pytest.raises(AttributeError, match="module 'rtof_kin' has no attribute 'Skeleton'"):
        rtof_kin.Skeleton  # noqa: B018
