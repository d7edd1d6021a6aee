"""Decodes the steps of a bag: pictures scaled in threads, arrays that grow on disk."""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vn_msgs_py.images import ImageError, decode_depth, decode_labels, decode_rgb
from vn_nav.bags.dataset import MAX_DEPTH, Wanted
from vn_nav.bags.drive import Frame, Report, find_topics, synchronise, timestamped_messages
from vn_nav.bags.goal_cameras import GoalCameras, read_goal_cameras
from vn_nav.bags.roles import Topics
from vn_nav.bags.segmenter import NO_ACTION, ActionSegmenter, Step
from vn_nav.bags.stamped import header_stamp
from vn_nav.bags.storage.stream import messages, summary
from vn_nav.calibration import is_rectified, read_calibration
from vn_nav.errors import UserError
from vn_nav.observation import crop_fraction, needed_side, preprocess, preprocess_map
from vn_nav.rectification import Camera, flatten_goal

FORMAT = 5  # of the files; another one is decoded anew
INDEX = 'index.json'
# Pictures in the decoders at once: bounds the memory.
MAX_PICTURES_IN_FLIGHT = 64


def decoded(steps: Iterable[Step], wanted: Wanted, camera: Camera | None
            ) -> Iterator[tuple[Step, dict[str, np.ndarray] | None]]:
    """Steps with their pictures, in order; None where a picture cannot be decoded.

    Decoding and scaling run in `wanted.threads` threads of their own: OpenCV releases the
    interpreter meanwhile. At most `MAX_PICTURES_IN_FLIGHT` steps are held.
    """
    pool = concurrent.futures.ThreadPoolExecutor(wanted.threads)
    flying: collections.deque = collections.deque()
    try:
        for step in steps:
            flying.append((step, pool.submit(_pictures, step.frame, wanted, camera)))
            if len(flying) >= MAX_PICTURES_IN_FLIGHT:
                step, future = flying.popleft()
                yield step, future.result()
        while flying:
            step, future = flying.popleft()
            yield step, future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def read_steps(bag: str | Path, wanted: Wanted, report: Report
               ) -> tuple[Iterator[Step], dict, Camera | None]:
    """The steps of a bag as they stream by, pictures not yet decoded, and facts of its camera.

    Returns:
        The steps; `topics` (as they are in the bag) and `fov` (rad, of the shorter side; None:
        the bag has no camera_info, or one that is not calibrated); and the camera.
    """
    topics = find_topics(bag, wanted.topics)
    camera = _camera(bag, topics, wanted.robot.camera_fov)
    frames = synchronise(timestamped_messages(bag, topics), topics, report)
    steps = (_each(frames) if wanted.every else ActionSegmenter(wanted.robot, report).cut(frames))
    return steps, {'topics': dataclasses.asdict(topics),
                   'fov': None if camera is None else camera.fov}, camera


def _each(frames) -> Iterator[Step]:
    for frame in frames:
        yield Step(frame, NO_ACTION, False)


def _pictures(frame, wanted: Wanted, camera: Camera | None) -> dict[str, np.ndarray] | None:
    """What the arrays of a step hold of pictures; depth and labels only if they can be read."""
    target = wanted.robot.camera_fov
    lens = {} if camera is None else {'fov': camera.fov, 'target_fov': target}
    try:
        smallest = (needed_side(wanted.size) if camera is None
                    else camera.needed_side(wanted.size, target))
        picture = decode_rgb(frame.image, smallest)
        if camera is not None:
            picture = camera.rectify(picture)
        shown = {'image': preprocess(picture, wanted.size, **lens)}
    except ImageError:
        return None
    with contextlib.suppress(ImageError):
        if frame.depth is not None:
            depth = preprocess_map(_map(decode_depth(frame.depth), camera), wanted.size, **lens)
            shown['depth'] = np.where(np.isfinite(depth), np.clip(
                np.nan_to_num(depth) * (255 / MAX_DEPTH), 1, 255), 0).astype(np.uint8)
    with contextlib.suppress(ImageError):
        if frame.labels is not None:
            shown['labels'] = preprocess_map(
                _map(decode_labels(frame.labels), camera), wanted.size, **lens)
    return shown


def _map(values: np.ndarray, camera: Camera | None) -> np.ndarray:
    """Depth or labels, which the picture's camera has taken."""
    if camera is None or not camera.fits(values):
        return values
    return camera.rectify(values, nearest=True)


def _camera(bag: str | Path, topics: Topics, target_fov: float) -> Camera | None:
    """By the first camera_info; None where there is none, or it is not calibrated."""
    if not topics.camera_info:
        return None
    for message in messages(bag, (topics.camera_info,)):
        calibration = read_calibration(message.message, rectified=is_rectified(topics.image))
        return None if calibration is None else Camera(calibration, target_fov)
    return None


def _label_type(bag: str | Path, topic: str) -> np.dtype:
    """Of the labels of a bag, as its first picture of them has it."""
    for message in messages(bag, (topic,)):
        with contextlib.suppress(ImageError):
            return decode_labels(message.message).dtype
        break
    return np.dtype(np.uint8)


def _label_names(bag: str | Path, topic: str) -> list[str]:
    """Behind the class ids, as the topic `names` next to theirs has them; empty: it has none."""
    names_topic = topic.rpartition('/')[0] + '/names'
    if names_topic not in summary(bag):
        return []
    for message in messages(bag, (names_topic,)):
        with contextlib.suppress(ValueError):
            names = json.loads(message.message.data)
            if isinstance(names, list) and all(isinstance(name, str) for name in names):
                return names
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


def decode_bag(bag: Path, wanted: Wanted, folder: Path, show: Callable[[float], None]) -> None:
    """Decode the steps of a bag into arrays and an index in a folder."""
    report, columns = Report(), _Columns(folder)
    steps, facts, camera = read_steps(bag, wanted, report)
    if camera is not None:
        crop_fraction(camera.fov, wanted.robot.camera_fov)  # or says that it is too narrow
    optional = {name: _Optional(name) for name in ('depth', 'labels') if facts['topics'][name]}
    if 'labels' in optional:
        optional['labels'].dtype = _label_type(bag, facts['topics']['labels'])
    goals = _Goals(wanted, camera, read_goal_cameras(
        bag, Topics(**facts['topics']), wanted.robot.camera_fov), columns)
    bad = 0
    rows: list[list[float]] = []
    held = summary(bag)[facts['topics']['image']].count or math.inf
    for step, pictures in decoded(steps, wanted, camera):
        show(report.pictures / held)
        frame = step.frame
        if pictures is None:
            bad += 1
            if rows and rows[-1][2] == frame.episode:
                rows[-1][1] = NO_ACTION  # where that action led to was not seen
            continue
        rows.append([frame.stamp, step.action, frame.episode, goals.number(frame.goal),
                     *frame.pose])
        columns.append('image', pictures['image'])
        for name, counted in optional.items():
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
    if 'labels' in optional:
        facts |= {'label_names': _label_names(bag, facts['topics']['labels']),
                  'classes': optional['labels'].most + 1}
    facts['notes'] = [note for counted in optional.values() if (note := counted.summary())]
    facts['notes'] += goals.notes()
    index = {'format': FORMAT, 'columns': columns.close(), 'facts': facts}
    (folder / INDEX).write_text(json.dumps(index, indent=1))


class _Optional:
    """Pictures of depth or of labels that come with the camera's, and why some are not there."""

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

    def summary(self) -> str:
        """That they are left out, and why; empty: they are all there."""
        faults = []
        if self._missing:
            faults.append(f'{self._missing:,} of {self._all:,} pictures have none within 50 ms')
        if self._unreadable:
            faults.append(f'{self._unreadable:,} of {self._all:,} cannot be read: {self._why}')
        return f'{self._role} left out: {"; ".join(faults)}' if faults else ''


class _Goals:
    """The goal pictures of a bag, each kept once.

    Args:
        wanted: of the pictures.
        camera: the robot's; None: unknown.
        others: that took some of the goals.
        columns: get the pictures.
    """

    def __init__(self, wanted: Wanted, camera: Camera | None, others: GoalCameras,
                 columns: _Columns):
        self._wanted, self._camera, self._others = wanted, camera, others
        self._columns = columns
        self._numbers: dict[bytes, int] = {}  # by the digest of a picture
        self._last: Any = None
        self._number = -1  # of the last one
        self._undecoded = self._narrow = 0

    def number(self, message: Any) -> int:
        """Of a goal picture; -1: there is none, or it cannot be used."""
        if message is not self._last:
            self._last = message
            self._number = self._keep(message)
        return self._number

    def _keep(self, message: Any) -> int:
        if message is None:
            return -1
        other = self._others.get(header_stamp(message))
        target = self._wanted.robot.camera_fov
        try:
            picture, fov = flatten_goal(decode_rgb(message), self._camera, other)
        except ImageError:
            self._undecoded += 1
            return -1
        try:
            picture = preprocess(picture, self._wanted.size, fov=fov, target_fov=target)
        except UserError:  # the robot's own camera was looked at before
            self._narrow += 1
            return -1
        digest = hashlib.sha256(picture.tobytes()).digest()
        if digest not in self._numbers:
            self._numbers[digest] = len(self._numbers)
            self._columns.append('goals', picture)
        return self._numbers[digest]

    def notes(self) -> list[str]:
        """How many were left out, and why."""
        fov = math.degrees(self._wanted.robot.camera_fov)
        return [f'{count} goal picture{"s" * (count > 1)} {why}' for count, why in (
            (self._undecoded, 'cannot be decoded'),
            (self._narrow, f'left out: of a camera that sees less than {fov:.0f} deg')) if count]
