"""`MotionSource`: a motion of any length, in memory or in a file, read in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final, Self

from rtof_kin.body.observability import ObservationMasks
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.over_time import Sampled, Stream
from rtof_kin.data.corrections import Correction
from rtof_kin.data.poses import PoseSequence

BLOCK: Final = 3600  #: Frames of a block: a minute at 60 Hz


@dataclass(frozen=True)
class Block:
    """Consecutive frames of a motion."""

    motion: Motion  #: The frames, with a margin on either side as far as the motion goes
    start: int
    stop: int  #: Frames [start, stop) of the source, without the margin
    before: int  #: Number of frames of the margin before `start`

    @property
    def frames(self) -> slice:
        """The block in the source."""
        return slice(self.start, self.stop)

    @property
    def own(self) -> slice:
        """The block in `motion`."""
        return slice(self.before, self.before + self.stop - self.start)


class MotionSource(Sampled):
    """A motion that may be longer than memory allows; functions read it in blocks, as often as they need to.

    Attributes:
        skeleton: of the subject. times: (T,) s. corrections: by hand, of the recording.
    """

    _read: Callable[[int, int, bool], Motion]  #: Frames [start, stop), with their confidence if the third is True

    def __init__(
        self,
        skeleton: SkeletonModel,
        times: Array,
        read: Callable[[int, int, bool], Motion] | None = None,
        masks: ObservationMasks | None = None,
        corrections: tuple[Correction, ...] = (),
    ):
        """Read nothing yet.

        Args:
            times: (T,) s.
            read: as `_read`, which a subclass has as a method: kept here, that would be a cycle, and masks stay.
            masks: of all frames; by default the first pass over the motion collects them.
            corrections: by hand, of the recording.
        """
        self.skeleton, self.times = skeleton, times
        self._masks, self.corrections = masks, corrections
        if read is not None:
            self._read = read

    @classmethod
    def of(cls, motion: Motion | Self) -> MotionSource:
        """Return the source of a motion in memory; a source is returned as it is."""
        if isinstance(motion, MotionSource):
            return motion

        def read(start: int, stop: int, _: bool) -> Motion:
            return motion if stop - start == len(motion.q) else motion[start:stop]

        return MotionSource(motion.skeleton, motion.times, read, corrections=motion.corrections)

    def __getitem__(self, frames: slice) -> MotionSource:
        """Return consecutive frames."""
        first, last, _ = frames.indices(len(self))

        def read(start: int, stop: int, confidence: bool) -> Motion:
            return self._read(first + start, first + stop, confidence)

        return MotionSource(self.skeleton, self.times[first:last], read, self.masks[first:last], self.corrections)

    def read(self, start: int | None = None, stop: int | None = None, confidence: bool = True) -> Motion:
        """Return frames [start, stop), by default from the first to the last. `FileFormatError`: the file is damaged,
        or something in these frames is missing or invalid; `InvalidInputError`: there are no such frames.

        Args:
            confidence: whether to read it if there is one, which takes longest.
        """
        start, stop = start or 0, len(self) if stop is None else stop
        if not 0 <= start < stop <= len(self):
            raise InvalidInputError(f"motion: no frames {start} to {stop}; it has {len(self)}")
        return self._read(start, stop, confidence)

    @property
    def poses(self) -> Stream[PoseSequence]:
        """The poses alone."""
        return Stream(self.times, lambda rows: self.read(*rows.indices(len(self))[:2], confidence=False).poses)

    def with_times(self, times: Array) -> MotionSource:
        """Return the motion at other times, without confidence. times: (T,) s."""

        def read(start: int, stop: int, _: bool) -> Motion:
            motion = self._read(start, stop, False)
            return replace(motion, poses=replace(motion.poses, times=times[start:stop]), confidence=None)

        return MotionSource(self.skeleton, times, read, self.masks)

    @property
    def masks(self) -> ObservationMasks:
        """What was observed, of all frames."""
        if self._masks is None:
            for _ in self.blocks():
                pass
        assert self._masks is not None
        return self._masks

    def observed_blocks(self) -> Iterator[tuple[Motion, ObservationMasks]]:
        """Return the motion in blocks, with their masks."""
        masks = self.masks
        for block in self.blocks():
            yield block.motion, masks[block.frames]

    def blocks(self, margin: int = 0, confidence: bool = False) -> Iterator[Block]:
        """Return the motion in blocks of at most `BLOCK` frames; `margin`: number of frames before and after each block
        that its motion has too; `confidence`: whether their confidence is needed, which takes longest to read.
        """
        parts = []
        for start in range(0, len(self), BLOCK):
            stop = min(start + BLOCK, len(self))
            before = min(margin, start)
            motion = self._read(start - before, min(stop + margin, len(self)), confidence)
            return_free_memory()  # that reading needed
            block = Block(motion, start, stop, before)
            if self._masks is None:
                parts.append(ObservationMasks.of(block.motion)[block.own])
            yield block
            del motion, block  # before the next one is read
            return_free_memory()
        if self._masks is None:
            self._masks = ObservationMasks.joined(parts)
