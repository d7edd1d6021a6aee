"""Of a bag's drive what is surely one place in one frame; the rest is refused, not merged."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.bags.continuity import Break, divide, find_breaks
from vn_nav.bags.dataset import DriveSet
from vn_nav.bags.mapping.loop_closure import OptimisedOdometry
from vn_nav.bags.mapping.pose_graph import MAX_CHI2
from vn_nav.errors import UserError

RANGES = re.compile(r'\d+-\d+(,\d+-\d+)*')
MAX_LISTED_STRETCHES = 6  # stretches in an error, at most
RULE = 'place recognition is learned from a drive in one frame, or from stretches of one place'


class Rows:
    """Some rows of an array that is memory-mapped: read when they are asked for."""

    def __init__(self, array: Any, rows: np.ndarray):
        self._array, self._rows = array, rows
        self.shape = (len(rows), *array.shape[1:])

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, chosen: Any) -> np.ndarray:
        return self._array[self._rows[chosen]]


@dataclasses.dataclass
class Part:
    """What is asked for of a drive."""

    drives: DriveSet
    rows: np.ndarray  # [K] of the whole drive
    stretch: np.ndarray  # [K] int64, 0 and up: odometry connects each
    reasons: list[str]  # why each of them begins
    vouched: bool  # the user says that all lie in one frame

    def of(self, drives: DriveSet) -> DriveSet:
        """The same part of the drive with pictures of another size."""
        if len(self.rows) == len(drives):
            return drives
        depth = None if drives.depth is None else Rows(drives.depth, self.rows)
        return dataclasses.replace(
            drives, image=Rows(drives.image, self.rows), depth=depth, labels=None,
            **{name: getattr(drives, name)[self.rows]
               for name in ('pose', 'time', 'action', 'episode', 'goal')})


def parse_pictures(text: str) -> list[tuple[int, int]]:
    """The ranges of `--pictures`, such as 1-1560,2100-3000: numbers count from 1, ends included.

    Raises:
        UserError: none.
    """
    ranges = [(int(first), int(last)) for first, last in (
        part.split('-') for part in text.split(','))] if RANGES.fullmatch(text) else []
    if not ranges or any(not 1 <= first <= last for first, last in ranges) or any(
            one[1] >= other[0] for one, other in zip(ranges, ranges[1:], strict=False)):
        raise UserError('pictures of a drive are given as ranges in their order', text,
                        'write for example --pictures 1-1560 or --pictures 1-1560,2100-3000')
    return ranges


def choose(bag: Path, drives: DriveSet, pictures: str | None) -> Part:
    """What is asked for, divided where odometry breaks off.

    Args:
        bag: whose drive it is.
        drives: every picture of it.
        pictures: as `parse_pictures` takes it; None: all.

    Raises:
        UserError: no such pictures.
    """
    topic = drives.facts['topics']['odometry']
    breaks: list[Break] = find_breaks(bag, topic) if topic else []
    whole = divide(drives.time, breaks, bool(topic))
    asked, ranges = np.ones(len(drives), bool), parse_pictures(pictures) if pictures else []
    if ranges:
        if ranges[-1][1] > len(drives):
            raise UserError(f'the drive has {len(drives):,} pictures', pictures,
                            'correct --pictures')
        number = np.arange(1, len(drives) + 1)
        asked = np.any([(first <= number) & (number <= last) for first, last in ranges], axis=0)
    rows = np.flatnonzero(asked & whole.sound)
    if not len(rows):
        raise UserError('there are pictures with poses to learn from', f'{pictures or "all"} of '
                        f'{len(drives):,}, none of them between the breaks of odometry',
                        'see `vn_nav bag doctor`')
    held, stretch = np.unique(whole.number[rows], return_inverse=True)
    part = Part(drives, rows, stretch, [whole.reasons[k] for k in held], len(ranges) > 1)
    if len(rows) < len(drives):
        part.drives = part.of(drives)
    return part


def check_frame(part: Part) -> None:
    """Refuse stretches that nothing connects, where pictures are not asked.

    Raises:
        UserError: more than one stretch.
    """
    if not part.vouched and len(part.reasons) > 1:
        _refuse(part, part.stretch, np.arange(len(part.reasons)), part.reasons,
                ', or leave out --no-straighten: pictures may show that they are one place')


def check_place(part: Part, found: OptimisedOdometry) -> None:
    """Refuse what pictures do not show to be one place.

    Raises:
        UserError: stretches of several places, or pictures that contradict odometry.
    """
    if part.vouched:
        return
    if found.place.any():
        reasons = list(part.reasons)
        begins = np.flatnonzero(np.diff(found.stretch)) + 1
        hidden = [k for k in begins if part.stretch[k] == part.stretch[k - 1]]
        for k in hidden:
            reasons.insert(found.stretch[k], 'from here on no picture matches the earlier '
                           'pictures at the same poses')
        _refuse(part, found.stretch, found.place, reasons, '')
    if found.facts['strain'] > MAX_CHI2:
        k = found.facts['strained']
        raise UserError(
            'odometry agrees with the loop closures', f'they contradict each other after '
            f'picture {part.rows[k] + 1} ({_clock(part, k)}): poses would move by up to '
            f'{found.facts["moved"]:.1f} m', 'learn from the drive before or after it with '
            f'--pictures 1-{part.rows[k] + 1}, or use odometry unchanged with --no-straighten')


def _refuse(part: Part, stretch: np.ndarray, place: np.ndarray, reasons: Sequence[str],
            remedy: str) -> None:
    ranges, listed = [], []
    for number in range(int(stretch.max()) + 1):
        own = np.flatnonzero(stretch == number)
        ranges.append(f'{part.rows[own[0]] + 1}-{part.rows[own[-1]] + 1}')
        why = f', because {reasons[number]}' if reasons[number] else ''
        listed.append(f'{ranges[-1]} ({_clock(part, own[0])} to {_clock(part, own[-1])}{why})')
    unlisted = len(listed) - MAX_LISTED_STRETCHES
    more = f' and {unlisted} more' if unlisted > 0 else ''
    places = int(place.max()) + 1
    named = [','.join(r for r, p in zip(ranges, place, strict=True) if p == number)
             for number in range(places)]
    longest = max(named, key=lambda text: sum(b - a for a, b in parse_pictures(text)))
    raise UserError(
        RULE, f'{places} that have nothing in common: pictures '
        f'{"; ".join(listed[:MAX_LISTED_STRETCHES])}{more}',
        f'learn one place with --pictures {longest}, or, if you know that all are in one frame, '
        f'name them all: --pictures {",".join(ranges)}{remedy}')


def _clock(part: Part, k: int) -> str:
    """When a picture of a part was taken, min:s since the drive began."""
    seconds = part.drives.time[k] - part.drives.time[0]
    return f'{int(seconds // 60)}:{int(seconds % 60):02d}'
