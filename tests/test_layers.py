"""A file imports only from rows above its own, and importing the package is cheap."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator, Set
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROWS = """
errors   plausibility   limbs
threads
rotations   resources   body_mass   io   io.manifest
io.temporary   library_cache
io.folder
io.text
signals   skeleton_table   kinematics   checks   quaternions   compiled   lane_code
levenberg_marquardt   banded   lanes
types   urdf   stream_faults   confidence
skeleton   keypoint_guards   disagreement
energies   fragment_settings   calibration   metrics   inertial_ik   root_position   contacts
inflation
observation   sensor_guards   circumstances   bone_images
clock_evidence
fragment_problem   fragment_solution   joint_space   joint_space.settings   root_path
io.arrays   io.articulated   io.markers   io.pickled   io.section
io.world_axes
io.asf_amc   io.bvh   io.c3d   io.camera_toml   io.joint_trajectory   io.motion_npz   io.object_npz
io.imu_calibration_toml   io.total_capture   io.trc   inertial   inertial.declaration
io.motion_table   io.motion_views
io.opensim_coordinates
io.opensim_model   io.opensim_mot
motion_files
inertial.streams   inertial.packets   io.opencv_yaml   io.sensor_text
inertial.readings
io.xsens_columns
io.imu_csv   io.imu_mat   io.mvnx   io.opensense_sto   io.total_capture_sensors   io.ximu3
io.xsens_dot   io.xsens_mt
inertial.files   inertial.orientation
inertial.turning   inertial.sampling   inertial.recorded_form
inertial.gravity
inertial.alternatives
inertial.physics
cartesian_banded   joint_space.prior   joint_space.state
inertial.stillness   inertial.poses   inertial.axes
inertial.segment_motion   inertial.free_motion
inertial.evidence
inertial.alignment   inertial.headings
inertial.faults   inertial.functional   inertial.pose_calibration
inertial.mounting
inertial_start   cartesian   joint_space.frame_energy   joint_space.limits   joint_space.jerk
joint_space.problem   joint_space.windows
joint_space.couplings
joint_space.lane_problem
joint_space.annealing   joint_space.bordered   joint_space.building   joint_space.gaps
joint_space.ipopt   joint_space.observations   joint_space.uncertainty
joint_space.solver   joint_space.evidence   joint_space.learned_prior
fragment   joint_space.border   joint_space.unknowns
joint_space.shared   joint_space.sensor_unknowns   joint_space.vision_unknowns
detectors   detectors.layouts   detectors.detections
detectors.views   detectors.gaussian   detectors.json_files   detectors.people   detectors.models
detectors.adapter   detectors.files   detectors.video
detectors.recognise
detectors.keypoints
clinical   clinical.angle_table
clinical.joint_coordinate_systems
clinical.angle_confidence   clinical.trust
clinical.angles
clinical.range_of_motion
clinical.gait_events   clinical.repetitions
clinical.gait
clinical.torques
clinical.analysis
clinical.files   sensor_sets
session
recording_files   mocap_families   simulation_noise
recording_imus   mocap_mapping   simulation_sensors
recording   mocap   body_checks
self_calibration   calibration_priors
contradictions
self_calibrate   io.self_calibration_toml
datasets   datasets.total_capture_files   datasets.human36m_cameras   datasets.human36m_body
datasets.detections   datasets.total_capture_truth   datasets.human36m_files
datasets.total_capture_checks   datasets.human36m
datasets.total_capture_take
datasets.total_capture   inspection
simulation
lifting   lifting.body   lifting.curves   lifting.draws   lifting.model   lifting.splits
lifting.threads
lifting.corpus   lifting.distributed   lifting.noise   lifting.sensors   lifting.windows
lifting.data   lifting.datasets   lifting.folded   lifting.source   lifting.videopose3d
lifting.losses   lifting.models   lifting.supply
lifting.checkpoint   lifting.graph   lifting.settings   lifting.single_window   lifting.validation
lifting.predict   lifting.recipes
lifting.onnx_export   lifting.run   lifting.streaming
lifting.train
lifting.__main__
sensors_alone
stages
picture_evidence
scale_evidence
camera_evidence   sensor_evidence   choices
pipeline
sensor_study
figures   report   report.findings   report.isb
report.facts   report.headline   report.outcomes   report.residuals   report.summary_file
report.audit   report.drawn
report.page   sensor_study_files
report.html
report.writing
inspection_figures   clinical_figures   sensor_study_figures
export
rtof_kin
protocols   protocols.published   protocols.tables   protocols.jobs
protocols.measures   protocols.pictures
protocols.human36m   protocols.total_capture
protocols.total_capture_tables
cli.solver_options   cli.terminal
cli.clinical   cli.detection   cli.inspection   cli.lifters   cli.recordings   cli.training
cli.reporting
cli.protocols
cli
cli.__main__
"""
"""From top to bottom. `rtof_kin` is the package's front door, ``rtof_kin/__init__.py``."""
UPWARD = {("pipeline", "export")}
"""`Reconstruction.export` is a shortcut to the function of that name, imported when it is called."""
HEAVY = {"torch", "matplotlib", "yourdfpy", "casadi", "pinocchio"}


@dataclass(frozen=True)
class Import:
    """One module of this repository imported by another."""

    importer: str
    imported: str
    line: int
    when: str
    """'import': when the importer is. 'call': inside a function. 'typing': for a type checker alone."""


def short(module: str) -> str:
    return module.removeprefix("rtof_kin.")


def modules() -> dict[str, Path]:
    """Every module of both packages by its name in `ROWS`."""
    found = {}
    for package in ("rtof_kin", "lifting"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[short(".".join(p for p in parts if p != "__init__"))] = path
    return found


MODULES = modules()


def rows() -> dict[str, int]:
    return {name: i for i, line in enumerate(ROWS.split("\n")) for name in line.split()}


def walk(node: ast.AST, when: str = "import") -> Iterator[tuple[ast.Import | ast.ImportFrom, str]]:
    """Import statements below a node, and when they run."""
    for child in ast.iter_child_nodes(node):
        inside = when
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            inside = "call"
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            for statement in child.body:
                yield from walk(ast.Module([statement], []), "typing")
            for statement in child.orelse:
                yield from walk(ast.Module([statement], []), when)
            continue
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, inside
        yield from walk(child, inside)


def imports_of(name: str, source: str) -> list[Import]:
    """What a module of the repository imports from the repository."""
    out = []
    for node, when in walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        else:
            # A relative import counts its dots from the file itself.
            above = MODULES[name].relative_to(ROOT).parts[: -node.level] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            members = [f"{base}.{alias.name}" for alias in node.names]
            targets = [m if short(m) in MODULES else base for m in members]
        out += [
            Import(name, short(target), node.lineno, when)
            for target in targets
            if target.split(".")[0] in ("rtof_kin", "lifting")
        ]
    return out


ALL = [found for name, path in MODULES.items() for found in imports_of(name, path.read_text())]


def test_every_module_stands_in_one_row_and_every_row_exists() -> None:
    names = ROWS.split()
    assert len(names) == len(set(names))
    assert sorted(names) == sorted(MODULES)


def test_a_file_imports_only_from_rows_above_its_own() -> None:
    row = rows()
    wrong = [
        f"{i.importer}, line {i.line}: imports {i.imported}"
        for i in ALL
        if row[i.imported] >= row[i.importer]
        and not ((i.importer, i.imported) in UPWARD and i.when == "call")
    ]
    assert not wrong


def test_the_exception_is_still_needed() -> None:
    assert {(i.importer, i.imported) for i in ALL if i.when == "call"} >= UPWARD


def test_the_walk_finds_real_imports() -> None:
    """So that an empty walk cannot pass for a clean one."""
    known = {(i.importer, i.imported, i.when) for i in ALL}
    assert ("skeleton", "urdf", "import") in known
    assert ("signals", "rotations", "import") in known
    assert ("io.motion_npz", "skeleton", "import") in known
    assert ("stages", "lifting.predict", "call") in known
    assert ("rtof_kin", "pipeline", "typing") in known
    assert ("export", "pipeline", "typing") in known
    assert len(ALL) > 120


@pytest.mark.parametrize(
    ("name", "source", "expected"),
    [
        ("types", "import rtof_kin.errors as e", ("errors", "import")),
        ("types", "from rtof_kin import errors", ("errors", "import")),
        ("types", "from rtof_kin import SkeletonModel", ("rtof_kin", "import")),
        ("types", "from .errors import ShapeError", ("errors", "import")),
        ("types", "from . import errors", ("errors", "import")),
        ("io.bvh", "from .articulated import A", ("io.articulated", "import")),
        ("io.bvh", "from ..errors import ShapeError", ("errors", "import")),
        ("lifting.data", "from .noise import add", ("lifting.noise", "import")),
        ("types", "def f():\n    from lifting import predict", ("lifting.predict", "call")),
        ("types", "async def f():\n    import lifting.model", ("lifting.model", "call")),
        ("types", "try:\n    import lifting.model\nexcept E: pass", ("lifting.model", "import")),
        ("types", "if TYPE_CHECKING:\n    import rtof_kin.cli", ("cli", "typing")),
        ("types", "if TYPE_CHECKING:\n    pass\nelse:\n    import rtof_kin.cli", ("cli", "import")),
    ],
)  # fmt: skip
def test_the_walk_reads_every_way_to_import(
    name: str, source: str, expected: tuple[str, str]
) -> None:
    assert [(i.imported, i.when) for i in imports_of(name, source)] == [expected]


def test_only_a_call_makes_rtof_kin_import_lifting() -> None:
    """torch must not come with the package: `lifting` is imported where a lifter is made."""
    outside = [i for i in ALL if i.imported.split(".")[0] == "lifting" != i.importer.split(".")[0]]
    assert {i.importer for i in outside} == {
        "stages", "protocols.measures", "cli.lifters", "cli.recordings", "cli.reporting",
        "cli.training",
    }  # fmt: skip
    assert {i.when for i in outside} <= {"call", "typing"}


def test_each_heavy_package_is_imported_where_it_belongs() -> None:
    users: dict[str, set[str]] = {name: set() for name in HEAVY}
    for name, path in MODULES.items():
        for node, when in walk(ast.parse(path.read_text())):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
            )
            for package in {n.split(".")[0] for n in names} & HEAVY:
                if when == "import":
                    users[package].add(name)
    assert all(name.startswith("lifting.") for name in users["torch"])
    assert users["pinocchio"] == {"skeleton", "io.joint_trajectory", "clinical.torques"}
    symbolic = ("frame_energy", "limits", "problem", "ipopt", "windows", "couplings")
    joint_space = {f"joint_space.{n}" for n in symbolic}
    assert users["casadi"] <= {"energies", "compiled", "lane_code", "fragment_problem"} | joint_space
    pictures = {"figures", "inspection_figures", "protocols.pictures", "lifting.curves"}
    assert users["matplotlib"] <= pictures | {"clinical_figures", "sensor_study_figures"}
    assert not users["yourdfpy"]


def loaded_by(statement: str, packages: Set[str] = HEAVY) -> tuple[set[str], float]:
    """Packages loaded by a statement in a new interpreter, and the seconds it took."""
    code = (
        f"import sys, time; t = time.perf_counter(); {statement}; "
        f"print(*[m for m in {sorted(packages)} if m in sys.modules], time.perf_counter() - t)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=True, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    *names, seconds = done.stdout.split()
    return set(names), float(seconds)


def test_importing_the_package_takes_less_than_a_second_and_loads_nothing_heavy() -> None:
    names, seconds = loaded_by("import rtof_kin")
    assert names == set()
    assert seconds < 1.0


def test_the_command_line_is_there_before_numpy_which_reads_how_many_threads_it_may_use() -> None:
    names, _ = loaded_by("import rtof_kin.cli", {"numpy"})
    assert names == set()


def test_a_name_of_the_front_door_loads_what_it_needs_and_no_more() -> None:
    names, _ = loaded_by("from rtof_kin import ImuCalibration, Camera")
    assert names == set()
    names, _ = loaded_by("from rtof_kin import SkeletonModel")
    assert names == {"pinocchio"}
    names, _ = loaded_by("from rtof_kin import reconstruct")
    assert not names & {"torch", "matplotlib", "yourdfpy"}


def test_every_name_of_the_front_door_is_there_and_an_unknown_one_is_an_attribute_error() -> None:
    import rtof_kin

    for name in rtof_kin.__all__:
        assert getattr(rtof_kin, name).__name__ == name
    assert set(rtof_kin.__all__) <= set(dir(rtof_kin))
    with pytest.raises(AttributeError, match="module 'rtof_kin' has no attribute 'Skeleton'"):
        rtof_kin.Skeleton  # noqa: B018
