"""Chain of commands that a batch runs on every recording, written as the commands are typed.

``reconstruct --calibrate, report --weight 70``: a comma before the name of a command begins the
next one. What a command reads and writes is added to its options. A command that names ``{recording}`` or
``{out}`` itself is taken as it is written.
"""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rtof_kin.batch.recordings import Entry
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.manifest import fingerprint

RECORDING, OUT = "{recording}", "{out}"
"""Stand for the folder of the recording and for that of its output."""
MOTION, PAGE = "motion", "report.html"
_FILES: Final = {
    "inspect": (RECORDING,),
    "reconstruct": (RECORDING, "-o", f"{OUT}/{MOTION}"),
    "evaluate": (f"{OUT}/{MOTION}", "--truth", RECORDING),
    "report": (f"{OUT}/{MOTION}", "-o", f"{OUT}/{PAGE}", "--analysis", f"{OUT}/angles"),
    "export": (f"{OUT}/{MOTION}", "-o", f"{OUT}/export"),
    "study": (RECORDING, "-o", f"{OUT}/study"),
}
"""What each command reads and writes."""


@dataclass(frozen=True)
class Step:
    """One command of a chain."""

    command: str
    arguments: tuple[str, ...]
    """All of them, with `RECORDING` and `OUT`."""

    @property
    def output(self) -> str | None:
        """File or folder that it writes below `OUT`; None if it only prints."""
        for option, value in zip(self.arguments, self.arguments[1:], strict=False):
            if option in ("-o", "--output") and value.startswith(f"{OUT}/"):
                return value.removeprefix(f"{OUT}/")
        return None

    def line(self, recording: Path, out: Path, overwrite: bool) -> list[str]:
        """Return the command line.

        Args:
            overwrite: replace the output.
        """
        own = [a.replace(RECORDING, str(recording)).replace(OUT, str(out)) for a in self.arguments]
        return [self.command, *own, *(["--overwrite"] if overwrite and self.output else [])]

    def with_options(self, options: Iterable[str]) -> Step:
        """Return the step with more options."""
        return Step(self.command, (*self.arguments, *options))


def read_chain(text: str, commands: Collection[str]) -> tuple[Step, ...]:
    """Return the steps of a chain.

    Args:
        text: see the top of this module.

    Raises:
        InvalidInputError: a command does not exist or needs its files named, or two write the same.
    """
    parts: list[str] = []
    for piece in text.split(","):
        if parts and (not piece.split() or piece.split()[0] not in commands):
            parts[-1] += f",{piece}"  # a comma in an option
        else:
            parts.append(piece)
    try:
        steps = tuple(_step(shlex.split(part), commands) for part in parts)
    except ValueError as error:
        raise InvalidInputError(f"chain: {error}") from error
    names = [output_name(step) for step in steps]
    if double := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInputError(f"chain: two commands write {double[0]}; name outputs of their own, -o {OUT}/...")
    return steps


def output_name(step: Step) -> str:
    """Return what identifies the result of a step: what it writes, else its command."""
    return step.output or step.command


def _step(words: list[str], commands: Collection[str]) -> Step:
    if not words or words[0] not in commands:
        raise InvalidInputError(
            f"chain: {words[0] if words else 'an empty part'} is no command; e.g. {', '.join(_FILES)}"
        )
    command, *options = words
    if any(RECORDING in word or OUT in word for word in options):
        return Step(command, tuple(options))
    if command not in _FILES:
        raise InvalidInputError(
            f"chain: what {command} reads and writes is not known; write it with {RECORDING} and {OUT}, "
            f"such as 'overlay {OUT}/motion {RECORDING}/video.mp4 -o {OUT}/overlay.mp4'"
        )
    return Step(command, (*_FILES[command], *options))


def steps_of(chain: Iterable[Step], entry: Entry) -> tuple[Step, ...]:
    """Return the steps for one recording, with its own options.

    Raises:
        InvalidInputError: it has options of a command that is not in the chain.
    """
    chain = tuple(chain)
    unknown = sorted(set(entry.options) - {step.command for step in chain})
    if unknown:
        raise InvalidInputError(f"{entry.name}: options of {unknown[0]}, which is not in the chain")
    return tuple(step.with_options(entry.options.get(step.command, ())) for step in chain)


def files_in(steps: Iterable[Step]) -> tuple[tuple[str, str], ...]:
    """Return the files that options name, such as a model, with fingerprints of their contents."""
    words = {word for step in steps for word in step.arguments if "{" not in word}
    values = {value for word in words for value in (word, word.partition("=")[2]) if value}
    return tuple((value, fingerprint(Path(value))) for value in sorted(values) if Path(value).is_file())


def with_absolute_files(step: Step) -> Step:
    """Return a step whose options name files by absolute paths, for a worker with another current folder."""
    words = (str(Path(word).resolve()) if Path(word).is_file() else word for word in step.arguments)
    return Step(step.command, tuple(words))
