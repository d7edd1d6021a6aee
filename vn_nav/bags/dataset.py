"""Bags as arrays to learn from: decoded once into memory-mapped files, read at memory speed."""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import dataclasses
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from vn_msgs_py.camera import field_of_view
from vn_msgs_py.images import ImageError, decode_depth, decode_labels, decode_rgb
from vn_nav.bags.drive import (
    NO_ACTION,
    ActionSegmenter,
    Frame,
    Report,
    Step,
    find_topics,
    hear,
    synchronise,
)
from vn_nav.bags.roles import Topics
from vn_nav.bags.storage.bag_files import files_of
from vn_nav.bags.storage.stream import messages, summary
from vn_nav.errors import UserError
from vn_nav.observation import crop_fraction, needed_side, preprocess, preprocess_map
from vn_nav.robot import RobotSpec

FORMAT = 3  # of the files; another one is decoded anew
INDEX = 'index.json'
MAX_DEPTH = 10.0  # m, stored as 255; 0: unknown
# Pictures in the decoders at once: bounds the memory.
MAX_PICTURES_IN_FLIGHT = 64


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What to make of a bag."""

    robot: RobotSpec
    size: int = 84  # side of the square pictures [pixels]
    topics: Topics = Topics()
    every: bool = False  # every picture, and not only those where an action begins
    threads: int = 2  # that decode


class Pictures(Protocol):
    """Rows that are read when they are asked for: an array, or `one_place.Rows` of one."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __len__(self) -> int: ...

    def __getitem__(self, chosen: Any, /) -> np.ndarray: ...


@dataclasses.dataclass
class DriveSet:
    """The steps of a bag. N steps, S pixels a side, G goal pictures, A actions of the robot.

    A step is a picture at which an action begins, or with which an episode ends. Arrays are
    memory-mapped: what is not looked at takes no memory.
    """

    image: Pictures  # [N,3,S,S] uint8
    pose: np.ndarray  # [N,3] float64 x, y [m], yaw [rad] in the frame of the odometry
    time: np.ndarray  # [N] float64 s, stamps
    action: np.ndarray  # [N] int16, that begins here; `drive.NO_ACTION`: none, or the end
    episode: np.ndarray  # [N] int64
    goal: np.ndarray  # [N] int64 into goals, -1: no goal was shown
    goals: np.ndarray  # [G,3,S,S] uint8
    depth: Pictures | None  # [N,S,S] uint8, 255 at `MAX_DEPTH`, 0 where unknown
    labels: np.ndarray | None  # [N,S,S] class ids, uint8, or uint16 where the bag has them so
    facts: dict  # what the bag held and what did not fit

    def __len__(self) -> int:
        return len(self.image)

    def episodes(self) -> list[slice]:
        """The steps of each episode, in order."""
        edges = np.flatnonzero(np.diff(self.episode)) + 1
        return [slice(int(a), int(b)) for a, b in
                zip([0, *edges], [*edges, len(self.episode)], strict=True) if b > a]


def load_drives(bag: str | Path, wanted: Wanted, cache: str | Path,
                show: Callable[[float], None] = lambda share: None) -> DriveSet:
    """The steps of a bag, decoded now or from the cache.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        wanted: what to make of it.
        cache: folder of decoded bags. An entry is made whole or not at all, and belongs to the
            files as they are now: a bag that changes is decoded anew.
        show: receives the share of the pictures that is decoded.

    Raises:
        UserError: no readable bag, topics that it lacks, a camera narrower than the robot's, no
            usable picture, or a full disk.
    """
    bag = Path(bag)
    folder = Path(cache) / _key(bag, wanted)
    if not (folder / INDEX).is_file():
        temporary = folder.with_name(f'.{folder.name}.{os.getpid()}.tmp')
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            temporary.mkdir(parents=True)
            _decode(bag, wanted, temporary, show)
            if folder.exists():  # another process was faster, or a broken entry
                shutil.rmtree(folder)
            temporary.rename(folder)
        except OSError as error:
            raise UserError('decoded bags are kept in the cache',
                            f'{error.filename or folder}: {error.strerror}',
                            'free some space, or choose another --cache') from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return _open(folder)


def decoded(steps: Iterable[Step], wanted: Wanted, fov: float | None
            ) -> Iterator[tuple[Step, dict[str, np.ndarray] | None]]:
    """Steps with their pictures, in order; None where a picture cannot be decoded.

    Decoding and scaling run in `wanted.threads` threads beside the reading: OpenCV releases the
    interpreter meanwhile. At most `MAX_PICTURES_IN_FLIGHT` steps are held.
    """
    pool = concurrent.futures.ThreadPoolExecutor(wanted.threads)
    flying: collections.deque = collections.deque()
    try:
        for step in steps:
            flying.append((step, pool.submit(_pictures, step.frame, wanted, fov)))
            if len(flying) >= MAX_PICTURES_IN_FLIGHT:
                step, future = flying.popleft()
                yield step, future.result()
        while flying:
            step, future = flying.popleft()
            yield step, future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def read_steps(bag: str | Path, wanted: Wanted, report: Report) -> tuple[Iterator[Step], dict]:
    """The steps of a bag as they stream by, pictures not yet decoded, and facts of its camera.

    Returns:
        The steps; and `topics` (as they are in the bag) and `fov` (rad, of the shorter side;
        None: the bag has no camera_info).
    """
    topics = find_topics(bag, wanted.topics)
    fov = _field_of_view(bag, topics.camera_info)
    if fov is not None:
        crop_fraction(fov, wanted.robot.camera_fov)  # or says that the camera is too narrow
    frames = synchronise(hear(bag, topics), topics, report)
    steps = (_each(frames) if wanted.every else ActionSegmenter(wanted.robot, report).cut(frames))
    return steps, {'topics': dataclasses.asdict(topics), 'fov': fov}


def _each(frames) -> Iterator[Step]:
    for frame in frames:
        yield Step(frame, NO_ACTION, False)


def _pictures(frame, wanted: Wanted, fov: float | None) -> dict[str, np.ndarray] | None:
    """What the arrays of a step hold of pictures; depth and labels only if they can be read."""
    lens = {} if fov is None else {'fov': fov, 'target_fov': wanted.robot.camera_fov}
    try:
        smallest = needed_side(wanted.size, **lens)
        shown = {'image': preprocess(decode_rgb(frame.image, smallest), wanted.size, **lens)}
    except ImageError:
        return None
    with contextlib.suppress(ImageError):
        if frame.depth is not None:
            depth = preprocess_map(decode_depth(frame.depth), wanted.size, **lens)
            shown['depth'] = np.where(np.isfinite(depth), np.clip(
                np.nan_to_num(depth) * (255 / MAX_DEPTH), 1, 255), 0).astype(np.uint8)
    with contextlib.suppress(ImageError):
        if frame.labels is not None:
            shown['labels'] = preprocess_map(decode_labels(frame.labels), wanted.size, **lens)
    return shown


def _field_of_view(bag: str | Path, topic: str) -> float | None:
    """Of the shorter side [rad], by the first camera_info; None where there is none."""
    if not topic:
        return None
    for message in messages(bag, (topic,)):
        info = message.message
        focal = float(info.k[0])
        if focal > 0 and info.width > 0 and info.height > 0:
            return field_of_view(info.width, info.height, focal)
        break
    return None


def _label_type(bag: str | Path, topic: str) -> np.dtype:
    """Of the labels of a bag, as its first picture of them has it."""
    for message in messages(bag, (topic,)):
        with contextlib.suppress(ImageError):
            return decode_labels(message.message).dtype
        break
    return np.dtype(np.uint8)


def _label_names(bag: str | Path, topic: str) -> list[str]:
    """Behind the class ids, as the topic `names` beside theirs says; empty: it does not."""
    beside = topic.rpartition('/')[0] + '/names'
    if beside not in summary(bag):
        return []
    for message in messages(bag, (beside,)):
        with contextlib.suppress(ValueError):
            said = json.loads(message.message.data)
            if isinstance(said, list) and all(isinstance(name, str) for name in said):
                return said
    return []


class _Columns:
    """Arrays that grow on disk, row by row."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._files: dict[str, BinaryIO] = {}
        self._layout: dict[str, dict[str, Any]] = {}

    def append(self, name: str, row: np.ndarray) -> None:
        if name not in self._files:
            self._files[name] = open(self._folder / f'{name}.bin', 'wb')
            self._layout[name] = {'dtype': row.dtype.str, 'shape': [0, *row.shape]}
        layout = self._layout[name]
        if layout['shape'][1:] != list(row.shape) or layout['dtype'] != row.dtype.str:
            raise UserError(f'{name} of a bag have one shape and type',
                            f'{row.dtype} {row.shape}', 'split the bag where the camera changes')
        self._files[name].write(np.ascontiguousarray(row).tobytes())
        layout['shape'][0] += 1

    def close(self) -> dict:
        for file in self._files.values():
            file.flush()
            os.fsync(file.fileno())
            file.close()
        return self._layout


def _decode(bag: Path, wanted: Wanted, folder: Path, show: Callable[[float], None]) -> None:
    report, columns = Report(), _Columns(folder)
    steps, facts = read_steps(bag, wanted, report)
    beside = {name: _Beside(name) for name in ('depth', 'labels') if facts['topics'][name]}
    if 'labels' in beside:
        beside['labels'].dtype = _label_type(bag, facts['topics']['labels'])
    goals: dict[bytes, int] = {}
    shown_goal, number, bad, unseen = None, -1, 0, 0
    rows: list[list[float]] = []
    held = summary(bag)[facts['topics']['image']].count or math.inf
    for step, pictures in decoded(steps, wanted, facts['fov']):
        show(report.pictures / held)
        frame = step.frame
        if pictures is None:
            bad += 1
            if rows and rows[-1][2] == frame.episode:
                rows[-1][1] = NO_ACTION  # where that action led to was not seen
            continue
        if frame.goal is not shown_goal:
            shown_goal = frame.goal
            number = _keep_goal(shown_goal, wanted, facts['fov'], columns, goals)
            unseen += number < 0 and shown_goal is not None
        rows.append([frame.stamp, step.action, frame.episode, number, *frame.pose])
        columns.append('image', pictures['image'])
        for name, counted in beside.items():
            counted.look(frame, pictures)
            missing = np.zeros((wanted.size, wanted.size), np.uint8)
            columns.append(name, pictures.get(name, missing).astype(counted.dtype))
        columns.append('beside', np.array(['depth' in pictures, 'labels' in pictures]))
    if not rows:
        raise UserError('a bag for learning holds pictures with matching poses',
                        f'{bag}: {report.pictures} pictures, {report.without_pose} without a '
                        f'pose, {bad} that cannot be decoded', 'see `vn_nav bag doctor`')
    np.save(folder / 'rows.npy', np.array(rows, np.float64))
    facts |= {
        'bag': str(bag), 'pictures': report.pictures, 'without_pose': report.without_pose,
        'unordered': report.unordered, 'undecodable': bad, 'bad_motion': report.bad,
        'jumps': report.jumps, 'set_back': report.set_back, 'episodes': report.episodes,
        'misfits': report.misfits, 'misfit_share': report.misfit_share,
        'actions': {wanted.robot.action_names[k]: n for k, n in sorted(report.actions.items())}}
    if 'labels' in beside:
        facts |= {'label_names': _label_names(bag, facts['topics']['labels']),
                  'classes': beside['labels'].most + 1}
    facts['notes'] = [words for counted in beside.values() if (words := counted.words())]
    if unseen:
        facts['notes'].append(f'{unseen} goal picture{"s" * (unseen > 1)} cannot be decoded')
    index = {'format': FORMAT, 'columns': columns.close(), 'facts': facts}
    (folder / INDEX).write_text(json.dumps(index, indent=1))


class _Beside:
    """Pictures of depth or of labels beside those of the camera, and why some are not there."""

    def __init__(self, role: str):
        self._role, self._decode = role, decode_depth if role == 'depth' else decode_labels
        self._all = self._missing = self._unreadable = 0
        self._why = ''
        self.dtype = np.dtype(np.uint8)  # that they are stored in
        self.most = -1  # the highest number in the pictures

    def look(self, frame: Frame, pictures: dict[str, np.ndarray]) -> None:
        self._all += 1
        if self._role in pictures:
            self._count(pictures)
        message = getattr(frame, self._role)
        self._missing += message is None
        if message is None or self._role in pictures:
            return
        self._unreadable += 1
        if not self._why:
            try:
                self._decode(message)
            except ImageError as error:
                self._why = str(error)

    def _count(self, pictures: dict[str, np.ndarray]) -> None:
        """Look for the highest number; leave out what the type cannot hold."""
        most = int(pictures[self._role].max(initial=0))
        if most > np.iinfo(self.dtype).max:
            del pictures[self._role]
            self._why = self._why or (f'the first labels have {8 * self.dtype.itemsize} bits, '
                                      f'here is the class {most}')
        else:
            self.most = max(self.most, most)

    def words(self) -> str:
        """That they are left out, and why; empty: they are all there."""
        faults = []
        if self._missing:
            faults.append(f'{self._missing:,} of {self._all:,} pictures have none within 50 ms')
        if self._unreadable:
            faults.append(f'{self._unreadable:,} of {self._all:,} cannot be read: {self._why}')
        return f'{self._role} left out: {"; ".join(faults)}' if faults else ''


def _keep_goal(message: Any, wanted: Wanted, fov: float | None, columns: _Columns,
               goals: dict[bytes, int]) -> int:
    """Number of a goal picture, which is kept once; -1: it is none, or cannot be decoded."""
    lens = {} if fov is None else {'fov': fov, 'target_fov': wanted.robot.camera_fov}
    try:
        picture = None if message is None else decode_rgb(message)
    except ImageError:
        picture = None
    if picture is None:
        return -1
    picture = preprocess(picture, wanted.size, **lens)
    digest = hashlib.sha256(picture.tobytes()).digest()
    if digest not in goals:
        goals[digest] = len(goals)
        columns.append('goals', picture)
    return goals[digest]


def _open(folder: Path) -> DriveSet:
    index = json.loads((folder / INDEX).read_text())
    columns = {name: np.memmap(folder / f'{name}.bin', layout['dtype'], 'r',
                               shape=tuple(layout['shape']))
               for name, layout in index['columns'].items()}
    rows = np.load(folder / 'rows.npy')
    size = columns['image'].shape[-1]
    beside = columns['beside']
    return DriveSet(
        image=columns['image'], pose=rows[:, 4:], time=rows[:, 0],
        action=rows[:, 1].astype(np.int16), episode=rows[:, 2].astype(np.int64),
        goal=rows[:, 3].astype(np.int64),
        goals=columns.get('goals', np.zeros((0, 3, size, size), np.uint8)),
        # Only what every step has can be learned from in batches.
        depth=columns['depth'] if beside[:, 0].all() else None,
        labels=columns['labels'] if beside[:, 1].all() else None, facts=index['facts'])


def _key(bag: Path, wanted: Wanted) -> str:
    """Of a bag as it is now, and of what to make of it.

    Raises:
        BagError: no bag, or one that cannot be read whole.
    """
    files = files_of(bag).paths
    digest = hashlib.sha256(repr((
        FORMAT, [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files],
        str(bag.resolve()), wanted.robot.moves, wanted.robot.camera_fov, wanted.size,
        wanted.topics, wanted.every)).encode())
    return digest.hexdigest()[:24]
