"""Energies at the estimated and at the true calibration.

``python -m benchmarks calibration.optimum --corpus DIR``

With all errors of `planting.ERRORS`, the unknowns are estimated from zero and from their true values. Where
both give the same result, the initial guess is not the cause of remaining errors, and the energies show
whether the truth is more likely than the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.progress import track

from benchmarks.calibration.planted_rows import ALL, SESSIONS, Job, Row, recorded, session, truths
from benchmarks.command_line import study_parser
from benchmarks.harness import write_results
from lifting.predict import Lifter
from rtof_kin.calibration.estimate import shared_fragments
from rtof_kin.calibration.shared_fragments import SharedFragments, Slice
from rtof_kin.core.array_types import Array
from rtof_kin.reconstruction.prepare import Job as Reconstructing
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.initial_guess import initial_guess
from rtof_kin.solve.settings import JointSpaceSettings


def row(given: Recording, known: Mapping[tuple[str, str], Array], job: Job, lifter: Lifter) -> Row:
    """Energies, and distances in standard deviations of the priors, root mean square by kind."""
    settings, priors = ReconstructionSettings(), job.priors
    prepared = Reconstructing.of(given, None, lifter, settings).prepare("sf2")
    solver = JointSpaceSettings(floor_height=given.floor_height)
    guess = initial_guess(prepared.start, prepared.recording.video, prepared.bone_imus, given.skeleton)
    assert prepared.bone_imus is not None  # without IMUs, mode sf2 has raised
    whole = Slice(prepared.recording, guess, prepared.bone_imus)
    own, again = (  # each with a prior of its own to learn
        shared_fragments([whole], priors, solver, settings.frames) for _ in range(2)
    )
    sigma, truth = np.sqrt(np.diag(np.linalg.inv(own.prior))), values(own, known)
    found = own.estimate(priors.rounds)
    back = again.estimate(priors.rounds, start=truth)
    energies = back.energies[0], found.energies[-1], back.energies[-1]
    apart = {"found - truth": found.y - truth, "from truth - found": back.y - found.y}
    return {
        "session": job.session,
        "camera": job.camera,
        "unknowns": len(truth),
        "energies": dict(zip(("truth", "found", "from truth"), energies, strict=True)),
        "apart": {
            name: {
                unknown.name: float(np.sqrt(np.mean((off[part] / sigma[part]) ** 2)))
                for unknown, part in zip(own.unknowns, own.columns, strict=True)
            }
            for name, off in apart.items()
        },
    }


def values(fragments: SharedFragments, known: Mapping[tuple[str, str], Array]) -> Array:
    """(G,) true values of the unknowns."""
    y = np.zeros(len(fragments.prior))
    for unknown, own in zip(fragments.unknowns, fragments.columns, strict=True):
        parts = np.split(y[own], len(unknown.items))
        of_items = zip(unknown.items, parts, strict=True)
        y[own] = np.concatenate([known[unknown.name, item][: len(part)] for item, part in of_items])
    return y


def report(rows: list[Row]) -> str:
    """Return the table as Markdown."""
    kinds = list(rows[0]["apart"]["found - truth"])
    head = ["recording", "energy of truth / found / from truth", *kinds]
    lines = [head, ["---"] * len(head)]
    for r in rows:
        energy = " / ".join(f"{value:.0f}" for value in r["energies"].values())
        cells = [" / ".join(f"{off[kind]:.2f}" for off in r["apart"].values()) for kind in kinds]
        lines.append([f"{r['session']}, camera {r['camera']}", energy, *cells])
    return (
        f"{rows[0]['unknowns']} unknowns, all wrong, 20 s, realistic 2D, 8 sensors. Of each kind, in "
        "standard deviations of its prior: how far what was found is from the truth / how far what is "
        "found when one starts at the truth is from what was found.\n\n"
        + "".join(f"| {' | '.join(line)} |\n" for line in lines)
    )


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("calibration.optimum", __doc__)
    parser.add_argument("--subset", default="test", choices=tuple(SESSIONS))
    parser.add_argument("--cameras", type=int, default=2, choices=range(1, 5))
    options = parser.parse_args(arguments)
    lifter, rows = Lifter.load(None), []
    jobs = [Job("", s, ALL, camera=c) for s in SESSIONS[options.subset] for c in range(options.cameras)]
    for job in track(jobs, "recordings"):
        clip = session(options.corpus, options.subset, job.session, job.seconds)
        right, wrong, given = recorded(clip, job)
        rows.append(row(given, truths(right, wrong), job, lifter))
    text = report(rows)
    write_results(options.out, {"subset": options.subset, "rows": rows}, text.removesuffix("\n"))
    print(text)


if __name__ == "__main__":
    main()
