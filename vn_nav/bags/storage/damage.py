"""An account of what a damaged MCAP file has lost, stretch by stretch."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from vn_nav.bags.storage.salvage import Gap

MAX_LOSSES = 1000  # that are listed


@dataclasses.dataclass
class Loss:
    """A stretch of a file that could not be used, or another fault of it (0 bytes)."""

    path: Path
    offset: int
    size: int  # bytes
    reason: str
    chunks: int = 0  # that are known to have been there
    messages: int | None = None  # that are known to have been there
    harmless: bool = False  # no message can have been in it
    before: int | None = None  # ns, time of the last message before
    after: int | None = None  # ns, time of the first message after


class Account:
    """The losses of a file as it is read.

    Args:
        path: of the file.
        losses: those so far; more are appended.
    """

    def __init__(self, path: Path, losses: list[Loss]):
        self._path, self.losses = path, losses
        self.seen: int | None = None  # ns, the latest time of a message so far

    def go_on(self, span: tuple[int, int]) -> None:
        """Note that the messages of a time [ns] follow."""
        start, end = span
        if start > end or (start, end) == (0, 0):  # a chunk without messages
            return
        if self.losses and self.losses[-1].after is None and self.losses[-1].size:
            self.losses[-1].after = start
        self.seen = end if self.seen is None else max(self.seen, end)

    def fault(self, at: int, reason: str, *, harmless: bool = True) -> None:
        """Note a fault that cost no bytes."""
        if len(self.losses) < MAX_LOSSES:
            self.losses.append(Loss(self._path, at, 0, reason, harmless=harmless))
        elif not harmless:
            self.losses[-1].harmless = False

    def lose(self, start: int, end: int, fault: str, chunks: int, *, harmless: bool) -> None:
        """Note bytes of the file, and how many chunks are known to have been there."""
        last = self.losses[-1] if self.losses else None
        if last is not None and (len(self.losses) >= MAX_LOSSES or (
                last.size and last.offset + last.size == start)):
            last.size += end - start
            last.chunks += chunks
            last.after = last.messages = None
            last.harmless &= harmless
        else:
            self.losses.append(Loss(self._path, start, end - start, fault, chunks,
                                    harmless=harmless, before=self.seen))

    def lose_within(self, begin: int | None, chunk: int, gap: Gap, span: tuple[int, int]) -> None:
        """Note bytes of a chunk's records.

        Args:
            begin: where the records stand in the file; None: they are compressed.
            chunk: where the chunk begins.
            gap: the bytes.
            span: times [ns] of the chunk's first and last message.
        """
        at, place = chunk, f'byte {gap.start} of the records of a chunk: {gap.fault}'
        if begin is not None:
            at, place = begin + gap.start, f'in a chunk: {gap.fault}'
        if len(self.losses) >= MAX_LOSSES:
            self.losses[-1].size += gap.end - gap.start
            self.losses[-1].messages, self.losses[-1].harmless = None, False
        else:
            self.losses.append(Loss(self._path, at, gap.end - gap.start, place,
                                    messages=gap.messages, before=span[0], after=span[1]))
