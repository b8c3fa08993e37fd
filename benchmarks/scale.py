"""Cost, storage and limits of batches of 10^4 and 10^6 recordings, computed from measured numbers.

    python -m benchmarks scale [--measured OUT/batch.csv] [--jobs 10000] [--minutes 1 10]

Measured are: what the commands cost per recording and per recorded minute (a batch on cuts of the demo, or
the table of a batch of yours); what the driver costs per recording (a batch of as many recordings whose
command does nothing); time and size of table and index. All else is computed from these and the prices.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.command_line import resident_memory, study_parser, table_head
from rtof_kin.batch.recordings import Shard, find_recordings, read_chain
from rtof_kin.batch.rows import Row, RowFile
from rtof_kin.batch.run import SHARE, Batch, Place, run_batch, write_tables
from rtof_kin.core.jobs import Processes
from rtof_kin.core.jobs.memory import peak_memory, reset_peak

CHAIN = "reconstruct, report"
SIZES = 10**4, 10**6
CUTS_S = 2.0, 10.0
RESULT = Path(__file__).parent / "results" / "scale.md"


@dataclass(frozen=True)
class Cost:
    """Cost of the commands: at every recording, and per recorded minute."""

    recordings: int
    cpu_s: tuple[float, float]
    output_mb: tuple[float, float]
    peak_mb: float
    longest_min: float


@dataclass(frozen=True)
class Driver:
    """Cost of the driver for so many recordings whose command does nothing."""

    jobs: int
    wall_s: float
    driver_cpu_s: float
    resumed_s: float
    driver_mb: float


@dataclass(frozen=True)
class TableCost:
    """Reading all rows and writing the table and the index."""

    rows: int
    seconds: float
    csv_mb: float
    index_mb: float
    rows_mb: float
    memory_mb: float


def nothing(line: list[str]) -> int:
    """Command line of which every command does nothing."""
    return len(line) * 0


def cost_of(table: Path) -> Cost:
    """Fit cost to the rows of a batch; lines through two or more durations, else through zero."""
    with table.open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["verdict"] != "error" and float(row["duration_s"])]
    if not rows:
        raise SystemExit(f"{table}: no recording with a motion")
    minutes = np.array([float(row["duration_s"]) / 60 for row in rows])
    columns = [np.ones_like(minutes), minutes] if np.ptp(minutes) > 0 else [0 * minutes, minutes]

    def fit(name: str) -> tuple[float, float]:
        values = np.array([float(row[name]) for row in rows])
        found = np.linalg.lstsq(np.stack(columns, axis=1), values, rcond=None)[0]
        return max(0.0, float(found[0])), max(0.0, float(found[1]))

    peak = max(float(row["peak_memory_mb"]) for row in rows)
    return Cost(len(rows), fit("cpu_seconds"), fit("output_mb"), peak, float(minutes.max()))


def measure_demo(folder: Path) -> Path:
    """Run a batch on cuts of the demo in one worker, which has done one before; return its table."""
    from rtof_kin.cli import main
    from rtof_kin.core.resources import model_path
    from rtof_kin.recording.recording import Recording

    demo = Recording.load(model_path("demo"))
    rate = 1 / float(np.median(np.diff(demo.video.times)))
    for name, seconds in (("a first one", CUTS_S[0]), *((f"{s:g} s, {k}", s) for s in CUTS_S for k in "ab")):
        cut = demo.video[: round(seconds * rate)]
        replace(demo, keypoints=cut, name=name).save(folder / "takes" / name)
    main(["batch", str(folder / "takes"), "-o", str(folder / "out"), "--chain", CHAIN, "--threads", "1"])
    table = folder / "out" / "batch.csv"
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not line.startswith("a first one")]  # it loads the libraries
    table.write_text("".join(kept), encoding="utf-8")
    return table


def measure_driver(folder: Path, jobs: int) -> Driver:
    """Run a batch of commands that do nothing, and resume it."""
    for k in range(jobs):
        take = folder / "takes" / f"s{k // 100:04d}" / f"take{k % 100:02d}"
        take.mkdir(parents=True)
        (take / "recording.toml").write_text(f"name = 'take {k}'\n", encoding="utf-8")
    source, out = folder / "takes", folder / "out"
    batch = Batch(source, find_recordings(source, out), read_chain("inspect", ["inspect"]), out, "scale")
    times = []
    for _ in range(2):
        began, cpu = time.perf_counter(), time.process_time()
        rows = run_batch(batch, nothing, Processes())
        times.append((time.perf_counter() - began, time.process_time() - cpu))
        assert {row.verdict for row in rows} == {"done"}
    return Driver(jobs, *times[0], times[1][0], resident_memory(os.getpid()) / 1e6)


def measure_table(folder: Path, count: int) -> TableCost:
    """Write the table and the index of so many rows."""
    sentence = "RightHand: reprojection error, median 35.5 px (above 24 px) at 12.3 s: errors of detector, bone "
    row = Row(
        "",
        "warn",
        sentence + "lengths, camera or synchronisation; more warns in sensors",
        frames=3600,
        duration_s=60.0,
        seconds=60.123,
        cpu_seconds=55.456,
        peak_memory_mb=800.1,
        output_mb=40.12,
        version="0.1.0",
        report="report.html",
        log="log/report.txt",
    )
    place = Place(folder, Shard(), 1, 0, "")
    (folder / ".batch").mkdir(parents=True)
    names = [f"s{k // 100:05d}/take{k % 100:02d}" for k in range(count)]
    rows = {name: (1, replace(row, recording=name)) for name in names}
    RowFile(place.rows_file, 1, rows)
    del rows
    reset_peak()
    before = resident_memory(os.getpid())
    began = time.process_time()
    write_tables(folder, "takes", frozenset(names), place)
    seconds = time.process_time() - began
    sizes = [
        sum(p.stat().st_size for p in folder.glob(name)) / 1e6
        for name in ("batch.csv", "index*.html", ".batch/*.jsonl")
    ]
    return TableCost(count, seconds, *sizes, ((peak_memory() or 0) - before) / 1e6)


def report(cost: Cost, driver: Driver, tables: list[TableCost], options: argparse.Namespace) -> str:
    """Return the page."""
    machine = f"{os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()}"
    lines = [
        "# Batches of 10^4 and 10^6 recordings",
        "",
        f"Made by `python -m benchmarks scale` ({options.source}), chain `{CHAIN}`, on {machine}.",
        "",
        *measured(cost, driver, tables),
        *computed(cost, driver, options),
        *limits(cost, driver, tables[-1], options.minutes[0]),
    ]
    return "\n".join(lines) + "\n"


def measured(cost: Cost, driver: Driver, tables: list[TableCost]) -> list[str]:
    per_job = [1e3 * seconds / driver.jobs for seconds in (driver.driver_cpu_s, driver.wall_s, driver.resumed_s)]
    commands = f"processor time of the commands, {cost.recordings} recordings up to {cost.longest_min:.2f} min"
    nothing = f"driver, {driver.jobs} recordings whose command does nothing"
    rows = {
        commands: f"{cost.cpu_s[0]:.1f} s + {cost.cpu_s[1]:.0f} s per recorded minute",
        "output": f"{cost.output_mb[0]:.2f} MB + {cost.output_mb[1]:.1f} MB per recorded minute",
        "most memory of a worker": f"{cost.peak_mb:.0f} MB",
        nothing: f"{per_job[0]:.2f} ms of its processor, {per_job[1]:.1f} ms in all per recording",
        "the same resumed, nothing left to do": f"{per_job[2]:.1f} ms per recording",
        "memory of the driver then": f"{driver.driver_mb:.0f} MB",
    }
    for t in tables:
        rows[f"table and index of {t.rows} rows, each time they are written"] = (
            f"{t.seconds:.2f} s, {t.memory_mb:.0f} MB of memory; batch.csv {t.csv_mb:.1f} MB, index "
            f"{t.index_mb:.1f} MB, rows {t.rows_mb:.1f} MB"
        )
    lines = [f"| {name} | {number} |" for name, number in rows.items()]
    return ["## Measured", "", "| what | number |", "|---|---|", *lines, ""]


def computed(cost: Cost, driver: Driver, options: argparse.Namespace) -> list[str]:
    prices = f"{options.core_hour} per core-hour, {options.gb_month} per GB and month"
    columns = "recordings | minutes each | core-hours | price | output [TB] | price per month"
    lines = [
        "## Computed",
        "",
        f"Prices, which are assumptions: {prices}. Recordings longer than {cost.longest_min:.2f} min, the "
        "longest measured, are extrapolated. Times that are not of the processor depend on the disk and on "
        "what else the machine does.",
        "",
    ]
    lines += table_head(f"{columns} | days on {options.cores} cores | hours of the driver")
    for count in SIZES:
        for minutes in options.minutes:
            hours = count * (cost.cpu_s[0] + cost.cpu_s[1] * minutes) / 3600
            tb = count * (cost.output_mb[0] + cost.output_mb[1] * minutes) / 1e6
            own = count * driver.driver_cpu_s / driver.jobs / 3600
            days = hours / options.cores / 24
            lines.append(
                f"| {count:,} | {minutes:g} | {hours:,.0f} | {hours * options.core_hour:,.0f} | "
                f"{tb:.2f} | {1e3 * tb * options.gb_month:,.0f} | {days:.2f} | {own:.2f} |"
            )
    return [*lines, ""]


def limits(cost: Cost, driver: Driver, table: TableCost, minutes: float) -> list[str]:
    own, core = driver.driver_cpu_s / driver.jobs, cost.cpu_s[0] + cost.cpu_s[1] * minutes
    scale = SIZES[1] / table.rows
    seconds, gb = table.seconds * scale, table.memory_mb * scale / 1e3
    return [
        "## What saturates first",
        "",
        f"- The cores. A recording of {minutes:g} min takes {core:.0f} s of one and {1e3 * own:.1f} ms of "
        f"the driver, which so keeps about {core / own:,.0f} cores busy.",
        f"- Then the table. For 10^6 rows, in proportion, it takes {seconds:.0f} s and {gb:.1f} GB each time "
        f"it is written, and so is renewed every {seconds / SHARE / 60:.0f} min (at most "
        f"{100 * SHARE:.0f} % of the time goes there); batch.csv has {table.csv_mb * scale:.0f} MB, "
        f"the index {table.index_mb:.0f} MB. Shards keep their "
        "rows apart, but the table is one: above some 10^5 recordings give each study an OUT of its own.",
        f"- Files. {SIZES[1]:,} recordings are as many folders of about 25 files: the metadata server of a "
        "shared file system, and its number of inodes, are the limit, not the bytes. A chain "
        "without `export` writes the fewest. Recordings in one folder for each person or day, as "
        "`study/person/take`, keep folders small; OUT has the same.",
        "- Reading. To go on, workers read all recordings once to compare their contents: their size divided "
        "by the bandwidth of the file system, whatever the number of cores.",
    ]


def main() -> None:
    parser = study_parser("scale", __doc__, motion=False, page="")
    parser.add_argument("--measured", type=Path, metavar="CSV", help="batch.csv of recordings of yours")
    parser.add_argument("--jobs", type=int, default=10**4, help="recordings of the empty batch")
    parser.add_argument("--rows", type=int, nargs="+", default=[10**4, 10**5], help="rows of tables")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0, 10.0], help="length of a recording")
    parser.add_argument("--cores", type=int, default=1000)
    parser.add_argument("--core-hour", type=float, default=0.05, help="price")
    parser.add_argument("--gb-month", type=float, default=0.02, help="price")
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options.source = "costs of the table given" if options.measured else "costs of cuts of the demo"
        cost = cost_of(options.measured or measure_demo(folder / "demo"))
        driver = measure_driver(folder / "driver", options.jobs)
        tables = [measure_table(folder / f"table{count}", count) for count in options.rows]
    page = report(cost, driver, tables, options)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(page, encoding="utf-8")
    sys.stdout.write(page)


if __name__ == "__main__":
    main()
