"""`vn_nav bag export --lerobot`: a drive as a dataset of LeRobot, format version 3.0.

Layout and columns follow huggingface/lerobot, `src/lerobot/datasets` (release 0.4.4 and later):
all episodes one after the other in one Parquet file and one video, and a table that says where
each begins. A row is an instant of a constant grid; the picture is the nearest one, the state is
what odometry says then, and the action is what was commanded from then until the next instant.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_nav import __version__
from vn_nav.arrival import wrap_angle
from vn_nav.bags.drive import (
    Frame,
    Report,
    TimestampedMessage,
    find_topics,
    synchronise,
    timestamped_messages,
)
from vn_nav.bags.export.lerobot_files import Table, Video
from vn_nav.bags.export.lerobot_layout import (
    ACTION,
    ACTIONS,
    CAMERA,
    CARD,
    DRIVE,
    FILE,
    FIRST,
    NUMBERS,
    STATE,
    STATES,
    TO_GOAL,
    VERSION,
    tasks_table,
)
from vn_nav.bags.export.lerobot_stats import Colours, describe, merge
from vn_nav.bags.export.received_velocities import ReceivedVelocities
from vn_nav.bags.roles import Topics
from vn_nav.errors import UserError

MAX_FPS = 120  # frames a second


class Row(NamedTuple):
    """An instant of the grid."""

    episode: int
    frame: Frame  # whose picture is the nearest
    state: np.ndarray  # [6] `STATES`
    at: float  # s by the stamps
    time: float  # s of recording


def export(bag: str | Path, out: str | Path, *, topics: Topics, robot: str, fps: int) -> str:
    """Write a drive as a LeRobot dataset.

    Memory is bounded by the numbers of an episode; pictures stream into the video.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        out: new folder; it appears whole or not at all.
        topics: names in the bag.
        robot: its name, for the dataset.
        fps: frames a second of the dataset.

    Returns:
        A summary line of what was written.

    Raises:
        UserError: packages that are not installed, a rate out of range, a folder that exists, no
            readable bag, no usable picture, pictures of different sizes, or a full disk.
    """
    _need_packages()
    out = Path(out)
    if not 1 <= fps <= MAX_FPS:
        raise UserError(f'a dataset has 1 to {MAX_FPS} frames a second', fps, 'correct --fps')
    if out.exists():
        raise UserError('a dataset is written into a new folder', str(out),
                        'choose another one, or take that one away')
    names = find_topics(bag, dataclasses.replace(topics, depth='', labels=''))
    temporary = out.absolute().with_name(f'.{out.name}.{os.getpid()}.tmp')
    try:
        temporary.mkdir(parents=True)
        summary = _Dataset(temporary, fps, robot, names).write(bag)
        temporary.rename(out)
    except OSError as error:
        raise UserError('a dataset can be written', f'{error.filename or out}: {error.strerror}',
                        'free some space, or choose another folder') from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return f'{out}: {summary}'


def _need_packages() -> None:
    try:
        import av  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise UserError('datasets for LeRobot are written by the packages av and pyarrow',
                        str(error), 'pip install "vn_nav[lerobot]"') from error


class _Dataset:
    """A dataset as it grows.

    Args:
        folder: where.
        fps: frames a second.
        robot: its name.
        topics: as they are in the bag, without depth and labels.
    """

    def __init__(self, folder: Path, fps: int, robot: str, topics: Topics):
        self._folder, self._fps, self._robot, self._topics = folder, fps, robot, topics
        self._commands, self._odometry = ReceivedVelocities(), ReceivedVelocities()
        self._video, self._table = Video(folder, fps), Table(folder)
        self._states: list[np.ndarray] = []  # of the episode
        self._actions: list[np.ndarray] = []
        self._colours = Colours()
        self._shown: tuple[Frame, np.ndarray] | None = None  # the last picture of the episode
        self._undecodable = self._frames = 0
        self._episodes: list[dict[str, Any]] = []
        self._tasks: list[str] = []

    def write(self, bag: str | Path) -> str:
        """Write everything; a summary line of it."""
        report, before = Report(), None
        with self._video, self._table:
            for row in self._grid(synchronise(self._messages(bag), self._topics, report)):
                if before is not None:
                    self._add(before, row)
                before = row
            if before is not None:
                self._add(before, None)
        if not self._episodes:
            raise UserError('a bag to export holds pictures with matching poses',
                            f'{bag}: {report.pictures} pictures, {report.without_pose} without a '
                            f'pose, {self._undecodable} that cannot be decoded',
                            'see `vn_nav bag doctor`')
        self._finish(bag)
        bad = f'; {self._undecodable} pictures could not be decoded' if self._undecodable else ''
        return (f'{self._frames:,} frames at {self._fps} Hz in {len(self._episodes)} '
                f'episode{"s" * (len(self._episodes) != 1)}, actions as {self._acted}{bad}')

    @property
    def _acted(self) -> str:
        return 'commanded' if self._topics.command else 'measured (no commands were recorded)'

    def _messages(self, bag: str | Path) -> Iterator[TimestampedMessage]:
        for m in timestamped_messages(bag, self._topics):
            try:
                if m.topic == self._topics.command:
                    self._commands.add(m.time, twist_to_array(m.message)[:3])
                elif m.topic == self._topics.odometry:
                    values = odometry_to_array(m.message)
                    self._odometry.add(values[6] or m.time, values[3:6])
            except MotionError:
                pass  # as good as not sent
            yield m

    def _grid(self, frames: Iterable[Frame]) -> Iterator[Row]:
        """The instants of each episode, from its first picture on as far as pictures go."""
        before, first, number = None, 0.0, 0
        for frame in frames:
            if before is None or frame.episode != before.episode:
                before, first, number = frame, frame.stamp, 0
            while (at := first + number / self._fps) <= frame.stamp + 1e-6:
                yield self._row(before, frame, at)
                number += 1
            before = frame

    def _row(self, one: Frame, other: Frame, at: float) -> Row:
        """An instant from one picture's to the next one's."""
        span = other.stamp - one.stamp
        share = min((at - one.stamp) / span, 1.0) if span > 0 else 0.0
        pose = one.pose + share * (other.pose - one.pose)
        pose[2] = wrap_angle(one.pose[2] + share * wrap_angle(other.pose[2] - one.pose[2]))
        time = one.time + share * (other.time - one.time)
        velocity = (self._odometry.near(at) if self._topics.odometry
                    else self._commands.mean(time, time))
        return Row(one.episode, one if share <= 0.5 else other,
                   np.concatenate([pose, velocity]), at, time)

    def _add(self, row: Row, following: Row | None) -> None:
        """Write a row, now that the one after it is known."""
        ends = following is None or following.episode != row.episode
        until = row if following is None or ends else following
        picture = self._decode(row.frame)
        if picture is not None:
            self._video.add(picture)
            self._colours.add(picture)
            self._states.append(row.state)
            self._actions.append(
                self._commands.mean(row.time, until.time) if self._topics.command
                else self._odometry.mean(row.at, until.at))
        self._commands.forget(row.time)
        self._odometry.forget(row.at)
        if ends:
            self._end_episode(row)

    def _decode(self, frame: Frame) -> np.ndarray | None:
        """Its picture, or the one before where it is damaged; None: there is none yet."""
        if self._shown is None or self._shown[0] is not frame:
            try:
                self._shown = frame, decode_rgb(frame.image)
            except ImageError:
                self._undecodable += 1
                if self._shown is not None:
                    self._shown = frame, self._shown[1]
        return None if self._shown is None else self._shown[1]

    def _end_episode(self, row: Row) -> None:
        count, number, first = len(self._states), len(self._episodes), self._frames
        states = np.array(self._states, np.float32)
        actions = np.array(self._actions, np.float32)
        self._states, self._actions, self._shown = [], [], None
        if not count:
            return
        task = DRIVE if row.frame.goal is None else TO_GOAL
        if task not in self._tasks:
            self._tasks.append(task)
        frame = np.arange(count)
        numbers: dict[str, np.ndarray] = {
            'timestamp': (frame / self._fps).astype(np.float32), 'frame_index': frame,
            'episode_index': np.full(count, number), 'index': first + frame,
            'task_index': np.full(count, self._tasks.index(task))}
        columns: dict[str, np.ndarray] = {STATE: states, ACTION: actions, **numbers}
        self._table.add(columns)
        stats = {name: describe(values) for name, values in columns.items()}
        stats[CAMERA], self._colours = self._colours.describe(), Colours()
        self._frames += count
        self._episodes.append({
            'episode_index': number, 'tasks': [task], 'length': count,
            'data/chunk_index': 0, 'data/file_index': 0,
            'dataset_from_index': first, 'dataset_to_index': self._frames,
            f'videos/{CAMERA}/chunk_index': 0, f'videos/{CAMERA}/file_index': 0,
            f'videos/{CAMERA}/from_timestamp': first / self._fps,
            f'videos/{CAMERA}/to_timestamp': self._frames / self._fps,
            'meta/episodes/chunk_index': 0, 'meta/episodes/file_index': 0,
            **{f'stats/{name}/{key}': value for name, own in stats.items()
               for key, value in own.items()}})

    def _finish(self, bag: str | Path) -> None:
        """The files under meta/, and the card."""
        import pyarrow
        import pyarrow.parquet
        meta = self._folder / 'meta'
        (meta / 'episodes' / 'chunk-000').mkdir(parents=True)
        names = [name.split('/')[1] for name in self._episodes[0] if name.startswith('stats/')]
        stats = {name: merge([{key.rsplit('/', 1)[1]: value for key, value in row.items()
                               if key.startswith(f'stats/{name}/')} for row in self._episodes])
                 for name in dict.fromkeys(names)}
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(self._episodes),
                                    meta / 'episodes' / f'{FIRST}.parquet')
        pyarrow.parquet.write_table(tasks_table(self._tasks), meta / 'tasks.parquet')
        (meta / 'stats.json').write_text(json.dumps(stats, indent=4))
        (meta / 'info.json').write_text(json.dumps(self._info(), indent=4))
        (self._folder / 'README.md').write_text(CARD.format(
            bag=Path(bag).name, version=__version__, fps=self._fps, acted=self._acted,
            posed='odometry' if self._topics.odometry else 'the commands alone'))

    def _info(self) -> dict:
        assert self._video.size is not None  # there are frames
        height, width = self._video.size
        features = {
            CAMERA: {'dtype': 'video', 'shape': [height, width, 3],
                     'names': ['height', 'width', 'channels'],
                     'info': {'video.height': height, 'video.width': width,
                              'video.codec': 'h264', 'video.pix_fmt': 'yuv420p',
                              'video.is_depth_map': False, 'video.fps': self._fps,
                              'video.channels': 3, 'has_audio': False}},
            STATE: {'dtype': 'float32', 'shape': [len(STATES)], 'names': list(STATES)},
            ACTION: {'dtype': 'float32', 'shape': [len(ACTIONS)], 'names': list(ACTIONS)},
            **{name: {'dtype': kind, 'shape': [1], 'names': None}
               for name, kind in NUMBERS.items()}}
        return {
            'codebase_version': VERSION, 'robot_type': self._robot,
            'total_episodes': len(self._episodes), 'total_frames': self._frames,
            'total_tasks': len(self._tasks), 'chunks_size': 1000, 'data_files_size_in_mb': 100,
            'video_files_size_in_mb': 200, 'fps': self._fps,
            'splits': {'train': f'0:{len(self._episodes)}'},
            'data_path': f'data/{FILE}.parquet', 'video_path': f'videos/{{video_key}}/{FILE}.mp4',
            'features': features}
