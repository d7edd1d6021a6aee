"""What a drive teaches by itself: a later picture of an episode is a goal of the earlier ones.

Pairs of pictures and windows of steps out of `DriveSet`s, and their labels from the odometry:
where the goal stands, how far it is to drive, whether the robot has arrived, whether both pictures
show the same. Rows are steps of all drives in one count; K pairs, T steps, W windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vn_nav.arrival import arrived, heading_error
from vn_nav.bags.dataset import MAX_DEPTH
from vn_nav.bags.drive import NO_ACTION
from vn_nav.co_visibility import co_visible, co_visible_by_poses, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.labels import label_dtype
from vn_nav.robot import RobotSpec

if TYPE_CHECKING:
    from vn_nav.bags.dataset import DriveSet

# Half of the partners lie within so many steps: the others show the same place too seldom.
NEIGHBOURS = 8
LEAST = 2  # steps of a part of a drive to learn from, or to judge by

Span = tuple[int, int]  # first row of an episode, and the row after its last


class Labels(NamedTuple):
    """What relates K rows to their goals."""

    goal_pose: np.ndarray  # [K,4] float32, see `vn_nav.co_visibility.relative_pose`
    arrived: np.ndarray  # [K] bool, by the image task's rule on the straight distance
    distance: np.ndarray  # [K] float32 m along the drive


class Windows(NamedTuple):
    """W windows of T steps, each towards the goal picture of one row."""

    rows: np.ndarray  # [T,W] int64; past a window's end its last row again
    goal: np.ndarray  # [W] int64
    valid: np.ndarray  # [T,W] bool: steps of the window
    acts: np.ndarray  # [T,W] bool: an action of the robot begins there, and the goal comes later
    action: np.ndarray  # [T,W] int64, 0 where none does
    starts: np.ndarray  # [T,W] bool: the memory is emptied
    last_action: np.ndarray  # [T,W] int64, -1 where the memory is emptied


class Split(NamedTuple):
    """Episodes to learn from, and others to judge by."""

    train: list[Span]
    validation: list[Span]
    words: str  # how they were told apart


class Drives:
    """The steps of several bags in one count; pictures stay where they are.

    Args:
        sets: of one robot and size.
        robot: its camera.

    Raises:
        UserError: no bag, pictures of different sizes, or no episode of two steps.
    """

    def __init__(self, sets: Sequence[DriveSet], robot: RobotSpec):
        if not sets:
            raise UserError('pre-training learns from one bag at least', 'none', 'name bags')
        sizes = {part.image.shape[-1] for part in sets}
        if len(sizes) > 1:
            raise UserError('pictures of all bags have one size', sorted(sizes),
                            'decode them alike')
        self.sets, self.robot, (self.size,) = list(sets), robot, sizes
        self._first = np.cumsum([0, *map(len, sets)])
        self.pose = np.concatenate([part.pose for part in sets]).astype(np.float64)
        self.action = np.concatenate([part.action for part in sets]).astype(np.int64)
        step = np.hypot(*np.diff(self.pose[:, :2], axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(step)])  # differences within episodes count
        self.has = {name: np.repeat([getattr(part, name) is not None for part in sets],
                                    [len(part) for part in sets]) for name in ('depth', 'labels')}
        self.episodes: list[Span] = [
            (int(first + steps.start), int(first + steps.stop))
            for first, part in zip(self._first[:-1], sets, strict=True)
            for steps in part.episodes() if steps.stop - steps.start >= LEAST]
        if not self.episodes:
            raise UserError('bags to learn from hold an episode with two steps, where the robot '
                            'has moved in between', f'{len(self.action)} steps, each alone',
                            'see `vn_nav bag doctor`, or drive more')

    def __len__(self) -> int:
        return len(self.action)

    @property
    def label_names(self) -> tuple[str, ...]:
        """Behind the class ids, of the bags that have labels; empty: none of them says.

        Raises:
            UserError: they name different classes.
        """
        named = {tuple(part.facts.get('label_names', ())): part.facts.get('bag')
                 for part in self.sets if part.labels is not None}
        known = [names for names in named if names]
        if len(known) > 1:
            raise UserError('bags whose labels are learned together name the same classes',
                            ' and '.join(str(named[names]) for names in known[:2]),
                            'learn from them one after the other')
        return known[0] if known else ()

    @property
    def classes(self) -> int:
        """Of the labels in the bags."""
        return max((max(len(part.facts.get('label_names', ())), part.facts.get('classes', 0))
                    for part in self.sets if part.labels is not None), default=0)

    def pictures(self, name: str, rows: np.ndarray) -> np.ndarray:
        """`image`, `depth` or `labels` of some rows [K] (that have it), as in `DriveSet`."""
        number = np.searchsorted(self._first, rows, side='right') - 1
        found: np.ndarray | None = None
        for k in np.unique(number):
            here = number == k
            part = getattr(self.sets[k], name)[rows[here] - self._first[k]]
            if found is None:
                kind = (label_dtype(self.classes) if name == 'labels' else part.dtype)
                found = np.empty((len(rows), *part.shape[1:]), kind)
            found[here] = part
        assert found is not None  # there is a row
        return found

    def label(self, rows: np.ndarray, goals: np.ndarray) -> Labels:
        """Labels of rows [K] towards goals [K], rows of the same episodes."""
        pose, goal_pose = self.pose[rows], self.pose[goals]
        gap = np.hypot(*(goal_pose[:, :2] - pose[:, :2]).T)
        turn = heading_error(pose[:, 2], goal_pose[:, 2])
        return Labels(relative_pose(pose, goal_pose), arrived(gap, turn),
                      self._driven(rows, goals).astype(np.float32))

    def co_visibility(self, rows: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Share of what the goals' pictures show that the rows' show too, [K] float32; -1 unknown.

        Measured as the simulator does where the bag has depth, else `co_visibility_by_odometry`.
        """
        shown = self.co_visibility_by_odometry(rows, goals)
        measured = self.has['depth'][rows] & self.has['depth'][goals]
        if measured.any():
            shown[measured] = self._co_visibility_by_depth(rows[measured], goals[measured])
        return shown

    def co_visibility_by_odometry(self, rows: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """What the poses and the metres driven say, see `co_visibility.co_visible_by_poses`."""
        pose = relative_pose(self.pose[rows], self.pose[goals])
        return co_visible_by_poses(pose, self._driven(rows, goals), self.robot.camera_fov)

    def _driven(self, rows: np.ndarray, goals: np.ndarray) -> np.ndarray:
        return np.abs(self._along[goals] - self._along[rows])

    def _co_visibility_by_depth(self, rows: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """As the simulator measures it, with the depth pictures of the bag."""
        own, index = np.unique(goals, return_inverse=True)
        depth = self._metres(own)
        depth[depth >= MAX_DEPTH] = 0.0  # somewhere beyond
        points = lift(depth, *self._cameras(own))[index]
        return co_visible(points, self._metres(rows), *self._cameras(rows))

    def _metres(self, rows: np.ndarray) -> np.ndarray:
        stored = self.pictures('depth', rows)
        metres = (stored + np.float32(0.5)) * np.float32(MAX_DEPTH / 255)
        metres[stored == 0] = 0.0
        return metres

    def _cameras(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        robot, pose = self.robot, self.pose[rows]
        height, pitch, view = (np.full(len(rows), value) for value in (
            robot.camera_height, robot.camera_pitch, robot.camera_fov))
        return np.column_stack([pose[:, :2], height, pose[:, 2], pitch]), view


def split(drives: Drives, share: float, seed: int) -> Split:
    """Set a share of the steps aside, in whole episodes if those there are allow it.

    Where they do not (a single episode, or a long one beside short ones) the longest episode is
    cut in time, and its end is for validation. Episodes with and without actions are split apart:
    both are judged.

    Raises:
        UserError: too few steps for both.
    """
    acting = [bool((drives.action[first:stop] != NO_ACTION).any())
              for first, stop in drives.episodes]
    parts = [_split([span for span, acts in zip(drives.episodes, acting, strict=True)
                     if acts == kind], share, seed) for kind in (True, False) if kind in acting]
    return Split([span for part in parts for span in part.train],
                 [span for part in parts for span in part.validation],
                 '; '.join(part.words for part in parts))


def _split(episodes: list[Span], share: float, seed: int) -> Split:
    lengths = [stop - first for first, stop in episodes]
    wanted = share * sum(lengths)
    most = max(2 * wanted, sum(lengths) / 3)
    chosen: set[int] = set()
    taken = 0
    for k in np.random.default_rng(seed).permutation(len(episodes)):
        if taken < wanted and taken + lengths[k] <= most and len(chosen) + 1 < len(episodes):
            chosen.add(int(k))
            taken += lengths[k]
    train = [span for k, span in enumerate(episodes) if k not in chosen]
    validation = [span for k, span in enumerate(episodes) if k in chosen]
    if taken >= wanted / 2:
        return Split(train, validation, f'{len(validation)} of {len(episodes)} episodes '
                     f'({taken:,} steps) are for validation')
    first, stop = max(train, key=lambda span: span[1] - span[0])
    if stop - first < 2 * LEAST:
        raise UserError('a validation needs steps of its own',
                        f'{sum(lengths)} steps in {len(episodes)} episodes', 'drive more')
    cut = stop - min(max(round(wanted - taken), LEAST), stop - first - LEAST)
    train[train.index((first, stop))] = (first, cut)
    validation.append((cut, stop))
    few = 'there is one episode' if len(episodes) == 1 else (
        f'the {len(episodes)} episodes are too few, or too unequal, to set whole ones aside')
    return Split(train, validation, f'{few}: the last {stop - cut:,} steps of the longest are for '
                 'validation')


def rows_of(spans: Sequence[Span]) -> np.ndarray:
    """All rows of some spans, [K] int64."""
    return np.concatenate([np.arange(first, stop) for first, stop in spans])


def partners(spans: Sequence[Span], rng: np.random.Generator) -> np.ndarray:
    """For each of `rows_of(spans)` another row of the same span, to be its goal, [K] int64.

    Half of them are drawn among the `NEIGHBOURS` on either side.
    """
    rows = rows_of(spans)
    lengths = [stop - first for first, stop in spans]
    first, last = (np.repeat([span[k] - k for span in spans], lengths) for k in (0, 1))
    near = rng.random(len(rows)) < 0.5
    low = np.where(near, np.maximum(rows - NEIGHBOURS, first), first)
    high = np.where(near, np.minimum(rows + NEIGHBOURS, last), last)
    drawn = low + (rng.random(len(rows)) * (high - low)).astype(np.int64)
    return drawn + (drawn >= rows)  # every row of [low, high] but its own


def draw_windows(drives: Drives, spans: Sequence[Span], length: int, farthest: int,
                 rng: np.random.Generator) -> np.ndarray:
    """Windows that cover every step with an action once, [W,3]: first row, one after, goal.

    A window's goal is uniform among the `farthest` steps after its first, and ends it; the next
    one goes on from there. The first of a span is of random length, so that windows begin
    anywhere. Spans without any action of the robot have none.
    """
    found = []
    for first, stop in spans:
        if (drives.action[first:stop] == NO_ACTION).all():
            continue
        begin, end = first, first + 1 + int(rng.integers(length))
        while begin < stop - 1:
            goal = begin + 1 + int(rng.integers(min(farthest, stop - 1 - begin)))
            # The goal's own picture is seen, to learn what arriving looks like.
            found.append((begin, min(end, goal + 1), goal))
            begin = min(end, goal)
            end = begin + length
    return np.array(found, np.int64).reshape(-1, 3)


def fill_windows(drives: Drives, windows: np.ndarray, length: int) -> Windows:
    """The steps of windows [W,3] of `draw_windows`.

    The memory is empty at a window's first step, as it is where a robot is shown a new goal; and
    after a motion that was none of the robot's actions, because it cannot have been told of it.
    """
    begin, stop, goal = windows.T
    time = np.arange(length)[:, None]
    rows = np.minimum(begin + time, stop - 1)
    valid = begin + time < stop
    action = drives.action[rows]
    acts = valid & (action != NO_ACTION) & (rows < goal)
    before = np.concatenate([np.full((1, len(begin)), NO_ACTION), action[:-1]])
    starts = before == NO_ACTION
    return Windows(rows, goal, valid, acts, np.where(action == NO_ACTION, 0, action), starts,
                   np.where(starts, -1, before))
