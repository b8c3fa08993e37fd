"""Commands that compare and plan: compare, study, gait-reference, plan."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from rich.table import Table

from rtof_kin.cli.options import SOLVER, Fields, File, Model, Overwrite, Paper, Seed, Threads, command, written
from rtof_kin.cli.reconstruction import solver_settings
from rtof_kin.cli.terminal import job_progress, out, print_files, print_headline, progress, say
from rtof_kin.core.choices import Repeated
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import check_new_file, check_replaceable
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.setup.settings import ReconstructionTask

if TYPE_CHECKING:
    from rtof_kin.data.gait_reference import GaitReference

Folder = Annotated[Path | None, written("folder to write; nothing is written without")]


@command
def compare(
    motions: list[Path],
    /,
    *,
    output: Folder = None,
    by: Literal["time", "cycle", "repetition", "range"] | None = None,
    repetitions: Repeated | None = None,
    sides: bool = False,
    shift: Annotated[float | None, Parameter(metavar="S", group="Two motions")] = None,
    align: Annotated[bool, Parameter(group="Two motions")] = False,
    angles: Annotated[tuple[str, ...], Parameter(group="Two motions")] = (),
    spm: Annotated[bool, Parameter(group="Two motions")] = False,
    baseline: Annotated[str, Parameter(metavar="VISIT", group="Visits")] = "",
    measures: Annotated[tuple[str, ...], Parameter(group="Visits")] = (),
    overwrite: Overwrite = False,
) -> None:
    """Two motions, both sides of one, or the visits of a person.

    Two MOTIONS are outputs of reconstruct or run, a motion.h5, or a .mot or .sto of another system: printed are what
    is compared and how, which angles have changed, and differences B - A with 95 % intervals and errors; OUT gets a
    page with the curves, a table and JSON.

    One folder has a folder for each visit, with the outputs of reconstruct of its trials: repeated recordings of the
    same movement; three MOTIONS and more are such folders, or one motion each. Printed are the measures that improved,
    got worse or changed since the first visit, with standard errors of measurement and the smallest change that could
    be shown; OUT gets a page with trajectories, figures, a table and JSON. follow.toml in the folder may name visits,
    baseline, measures and which direction is better.

    Args:
        motions: two motions, the first one's clock is used; or the folder of the visits, or those of three visits and
            more; or with --sides one motion
        by: the same instants, phases of the gait cycle, phases of repetitions, or ranges of motion alone; default:
            chosen from the data, and said
        repetitions: what is repeated
        sides: compare left (A) and right (B) of one motion
        shift: seconds to add to the times of the second motion
        align: estimate that shift from the angular velocities of both
        angles: to compare, separated by commas; fewer are tested more sharply
        spm: by cycle or repetition: Student's t along the cycle with clusters, by spm1d (extra clinical)
        baseline: visit to compare with; default: the first
        measures: to follow over visits, or angles with all of theirs, separated by commas; fewer are tested more
            sharply
    """
    from rtof_kin.reporting.comparison import compare as compare_motions
    from rtof_kin.reporting.document import show, write
    from rtof_kin.reporting.visits import follow

    if sides and len(motions) > 1:
        raise InvalidInputError("compare: --sides compares those of one motion")
    if shift is not None and align:
        raise InvalidInputError("--shift, --align: give one of them")
    visits = len(motions) != 2 and not sides
    if visits and by == "time":
        raise InvalidInputError("compare: visits have no common instants; leave out --by time")
    if output is not None:
        check_replaceable(output, "follow.json" if visits else "comparison.json", overwrite)
    if visits:
        with job_progress("reading") as update:
            document = follow(
                motions[0] if len(motions) == 1 else motions,
                baseline=baseline,
                by=None if by == "time" else by,
                kind=repetitions or "",
                measures=measures,
                progress=lambda done, total: update(done, total, ""),
            )
    else:
        document = compare_motions(
            motions[0],
            None if sides else motions[1],
            by=by,
            shift=shift,
            align=align,
            repetitions=repetitions or "",
            angles=angles,
            spm=spm,
        )
    show(document, out)
    if output is not None:
        write(document, output, overwrite)
        print_files(output)


@command
def study(
    recording: Path,
    /,
    *,
    output: Annotated[
        Path, written("folder for results and every run: the same command resumes there after an interruption")
    ],
    path: Literal["greedy", "ranked"] | None = None,
    seconds: Annotated[float, Parameter(metavar="S", help="use as many seconds at most")] = 120.0,
    task: Model,
    threads: Threads = None,
    figures: Annotated[bool, Parameter(help="draw figures, where matplotlib is installed")] = True,
    settings: Annotated[ReconstructionSettings, SOLVER],
    paper: Paper = False,
    overwrite: Overwrite = False,
) -> None:
    """Contribution of each sensor of a recording, angle by angle.

    Reconstructs RECORDING with all its sensors, without each of them, and with fewer and fewer, the one with the
    smallest effect removed first. OUT gets a table, figures, and sentences on what the sensors contribute to each
    angle. Without a truth in the recording, the table has the difference from the full set, which is no error. Of a
    longer recording the seconds with the most movement are used.

    Args:
        recording: folder of the recording
        path: greedy: each step tries every remaining sensor; ranked: in the order of their effect alone, with fewer
            runs; default: greedy up to eight sensors
    """
    from lifting.predict import Lifter
    from rtof_kin.core.jobs import open_runs
    from rtof_kin.recording.recording import Recording
    from rtof_kin.reporting.document import show
    from rtof_kin.reporting.sensor_study.document import document, remove_results, write_study
    from rtof_kin.reporting.sensor_study.study import identity_of, number_of_runs, study_sensors

    source = Recording.load(recording)
    camera = source.keypoints is not None
    settings = solver_settings(settings, paper, "rtof" if camera else "imu")
    greedy = {"greedy": True, "ranked": False}.get(path or "")
    lifter = Lifter.load(task.model) if camera else None
    runs = open_runs(output, identity_of(source, lifter, settings, seconds), overwrite, None, {})
    remove_results(output)
    sensors = len(source.imus.names) if source.imus is not None else 0
    out.print(f"{sensors} sensors: at most {number_of_runs(sensors, camera, greedy)} reconstructions")
    with job_progress("study") as update, without_warnings("rtof_kin"):
        found = study_sensors(
            source,
            greedy=greedy,
            lifter=lifter,
            settings=settings,
            longest=seconds,
            folder=runs,
            workers=threads,
            progress=update,
        )
    print_headline(found.verdict, "all sensors: ")
    written = write_study(found, output, figures)
    show(document(found), out)
    say(f"wrote {', '.join(map(str, written))}")


@command
def gait_reference(
    source: Path,
    /,
    *,
    output: File,
    licence: Annotated[str, Parameter(metavar="TEXT")] = "",
    origin: Annotated[str, Parameter(metavar="TEXT")] = "",
    of_set: Annotated[str, Parameter(name="--set", metavar="NAME", group="Of a public set")] = "",
    up: Annotated[str | None, Parameter(group="Of a public set")] = None,
    strides: Annotated[int, Parameter(metavar="N", group="Of recordings")] = 3,
    from_standing: Annotated[bool, Parameter(group="Of recordings")] = False,
    people: Annotated[int | None, Parameter(metavar="N", group="Of a table")] = None,
    system: Annotated[str, Parameter(metavar="TEXT", group="Of a table")] = "",
    zero: Annotated[str, Parameter(metavar="TEXT", group="Of a table")] = "",
    walking_speed: Annotated[tuple[float, float] | None, Parameter(metavar="M/S", group="Of a table")] = None,
    negate: Annotated[tuple[str, ...], Parameter(group="Of a table")] = (),
    overwrite: Overwrite = False,
) -> None:
    """A reference of healthy gait, for report --gait-reference.

    SOURCE is a folder of recordings of healthy people, outputs of reconstruct, run or batch: each person counts once,
    by the subject of the session. Or it is a CSV table of a published normal set, with the columns variable, percent,
    mean and sd in degrees. Or, with --set, a folder into which a public set was unpacked, whose licence and citation
    are then in the reference: fukuchi2018 and schreiber2019 (markers), fukuchi2018-angles and lencioni2019 (angles of
    their authors). FILE is JSON. Who is left out is said, with the reason.

    Args:
        source: folder of recordings, or CSV table
        licence: terms of use of the reference; required but for a public set
        origin: who was recorded, where and how, or a citation; required but for a public set
        of_set: name of the public set
        up: axis of its C3D files that points up; default: the one that they declare
        strides: of each side that a person needs
        from_standing: angles of trunk and legs relative to each person's quiet standing
        people: number of people
        system: what measured it, with its model
        zero: posture in which its angles are 0
        walking_speed: slowest and fastest walking speed, m/s; of lencioni2019, of the trials that count
        negate: variables with the opposite sign, separated by commas
    """
    from rtof_kin.formats.gait_reference import read_gait_reference_table, write_gait_reference
    from rtof_kin.reporting.gait_sets import read_gait_set

    check_new_file(output, overwrite)
    table: dict[str, Any] = {"--people": people, "--system": system, "--zero": zero}
    if not of_set and not (licence and origin):
        raise InvalidInputError("gait-reference: --licence and --origin are missing; only a --set has its own")
    if source.is_file() and not of_set:
        if absent := [name for name, value in table.items() if not value]:
            raise InvalidInputError(f"gait-reference: a table needs {', '.join(absent)} too")
        about = {"licence": licence, "source": origin, "system": system, "zero": zero, "speed_range": walking_speed}
        reference = read_gait_reference_table(source, negated=negate, people=people or 0, **about)
    else:
        table |= {"--negate": negate, "--walking-speed": not of_set and walking_speed, "--origin": of_set and origin}
        table |= {"--licence": of_set and licence, "--from-standing": of_set and from_standing}
        if given := [name for name, value in table.items() if value]:
            raise InvalidInputError(f"gait-reference: {', '.join(given)} is not for {of_set or 'recordings'}")
        if not of_set:
            reference = _from_recordings(source, licence, origin, strides, from_standing)
        else:
            with progress() as update:
                said = partial(update, "reading people")
                reference, left_out = read_gait_set(of_set, source, said, strides, walking_speed, up)
            for code, reason in left_out.items():
                say(f"left out: {code}: {reason}", "yellow")
    _print_reference(reference)
    write_gait_reference(output, reference, overwrite)
    say(f"wrote {output}")


def _from_recordings(source: Path, licence: str, origin: str, strides: int, from_standing: bool) -> GaitReference:
    """Reference from a folder of recordings; says who is left out, and why."""
    import rtof_kin
    from rtof_kin.clinical.gait_scores import build_reference
    from rtof_kin.data.gait_reference import MODEL_ZERO, OWN_SYSTEM, STANDING_ZERO
    from rtof_kin.reporting.gait import find_people

    found, notes = find_people(source, from_standing), []
    for place, reason in found.left_out.items():
        say(f"left out: {place}: {reason}", "yellow")
    if alone := [code for code, places in found.recordings.items() if places == [code]]:
        notes.append(
            f"{len(alone)} of {len(found.recordings)} people are single recordings without a subject in their "
            "session; recordings of one person count as several people then"
        )
    if any(cycles.sigma is None for cycles in found.people.values()):
        notes.append("some motions have no covariances, so that errors of the reference are unknown")
    reference, without = build_reference(
        found.people,
        least_strides=strides,
        licence=licence,
        source=origin,
        system=f"{OWN_SYSTEM} {rtof_kin.__version__}, skeleton {', '.join(found.skeletons)}",
        zero=STANDING_ZERO if from_standing else MODEL_ZERO,
        notes=tuple(notes),
    )
    for code, reason in without.items():
        say(f"left out: {code}: {reason}", "yellow")
    return reference


def _print_reference(reference: GaitReference) -> None:
    """Print what the reference is of, and what it cannot be used for."""
    from rtof_kin.clinical.gait_scores import FEW, gait_features

    speeds = "" if reference.speed_range is None else " at {:.2f} to {:.2f} m/s".format(*reference.speed_range)
    say(f"reference of {reference.people} people{speeds}: {reference.system}", "bold")
    if reference.people < FEW:
        say(f"caution: fewer than {FEW} people: scores are relative to few", "yellow")
    if reference.missing:
        say(f"caution: without {', '.join(reference.missing)}: no GPS and GDI, only single scores", "yellow")
    try:
        say(f"GDI: {gait_features(reference).basis.shape[1]} features have 98 % of the variance")
    except InvalidInputError as error:
        say(f"GDI will not be computed: {error}")
    for note in reference.notes:
        say(f"note: {note}")


@command
def plan(
    what: Path | None = None,
    /,
    *,
    output: Folder = None,
    movements: bool = False,
    draws: Annotated[int, Parameter(metavar="N")] = 3,
    search: bool = True,
    seed: Seed = 0,
    task: Annotated[ReconstructionTask, Fields("model subject")],
    threads: Threads = None,
    overwrite: Overwrite = False,
) -> None:
    """Expected errors of a recording before it is made, and how to lower them.

    WHAT is a protocol's TOML file, the name of a movement (--movements lists them), the folder of a recording, or the
    output of reconstruct. The recording is simulated with the errors of a real detector and real sensors and solved as
    a real one. Prints the standard deviation to expect of every clinical angle, what camera and sensors do not identify
    and why, the best place of the camera and of one more sensor, and how long to move for the calibration; OUT gets
    tables, a figure and a page of instructions for the operator.

    Args:
        what: what is to be recorded
        movements: list the movements of the library and exit
        draws: simulated recordings of the plan, each with other errors of person, detector and sensors
        search: compare cameras, sensors and lengths for the calibration too, not predict only
    """
    from lifting.predict import Lifter
    from rtof_kin.plan.document import MARKER, document, write_plan
    from rtof_kin.plan.movements import MOVEMENTS
    from rtof_kin.plan.plan import plan as predict
    from rtof_kin.plan.setup import planned
    from rtof_kin.reporting.document import show

    if movements:
        table = Table("movement", "what it is")
        for name, movement in MOVEMENTS.items():
            table.add_row(name, movement.description)
        out.print(table)
        return
    if what is None:
        raise InvalidInputError("plan: name a protocol's file, a movement, a recording or a motion")
    if output is not None:
        check_replaceable(output, MARKER, overwrite)
    lifter = Lifter.load(task.model)
    with progress() as update:
        protocol, setup = planned(str(what), lifter, update, task.person())
        found = predict(
            protocol, setup, draws=draws, seed=seed, lifter=lifter, search=search, workers=threads, progress=update
        )
    show(document(found), out)
    if output is not None:
        write_plan(found, output, overwrite)
        print_files(output)
