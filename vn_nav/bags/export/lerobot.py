"""`vn_nav bag export --lerobot`: a drive as a dataset of LeRobot, format version 3.0.

Layout and columns follow huggingface/lerobot, `src/lerobot/datasets` (release 0.4.4 and later):
all episodes one after the other in one Parquet file and one video, and a table that says where
each begins. A row is an instant of a constant grid; the picture is the nearest one, the state is
what odometry says then, and the action is what was commanded from then until the next instant.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_msgs_py.motion import MotionError, odometry_to_array, twist_to_array
from vn_nav import __version__
from vn_nav.arrival import wrap_angle
from vn_nav.bags.drive import Frame, Report, TimestampedMessage, find_topics, hear, synchronise
from vn_nav.bags.export.lerobot_stats import Colours, describe, merge
from vn_nav.bags.poses import COMMAND_TIMEOUT_S
from vn_nav.bags.roles import Topics
from vn_nav.bags.stamped import set_back
from vn_nav.errors import UserError

VERSION = 'v3.0'
CAMERA, STATE, ACTION = 'observation.images.camera', 'observation.state', 'action'
STATES = ('x', 'y', 'yaw', 'vx', 'vy', 'wz')  # m, rad; m/s, rad/s in the robot's frame
ACTIONS = ('vx', 'vy', 'wz')  # m/s, rad/s
TO_GOAL, DRIVE = 'drive to where the goal picture was taken', 'drive'
FILE = 'chunk-{chunk_index:03d}/file-{file_index:03d}'
FIRST = FILE.format(chunk_index=0, file_index=0)
NUMBERS = {'timestamp': 'float32', 'frame_index': 'int64', 'episode_index': 'int64',
           'index': 'int64', 'task_index': 'int64'}
MAX_FPS = 120  # frames a second
# Velocities that wait for their picture: minutes at any rate.
MAX_WAITING_VELOCITIES = 65_536


CARD = """---
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

A drive of a mobile robot, exported from the ROS 2 bag `{bag}` by vn_nav {version} at {fps} Hz,
in LeRobot's format 3.0.

- `observation.images.camera`: the picture nearest to the instant.
- `observation.state`: x, y [m], yaw [rad] by {posed}; vx, vy [m/s], wz [rad/s] in the
  robot's frame (x forward, y left).
- `action`: mean vx, vy [m/s], wz [rad/s] from this instant until the next, as {acted}.
"""


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
        What was written, in words.

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
        said = _Dataset(temporary, fps, robot, names).write(bag)
        temporary.rename(out)
    except OSError as error:
        raise UserError('a dataset can be written', f'{error.filename or out}: {error.strerror}',
                        'free some space, or choose another folder') from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return f'{out}: {said}'


def _need_packages() -> None:
    try:
        import av  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise UserError('datasets for LeRobot are written by the packages av and pyarrow',
                        str(error), 'pip install "vn_nav[lerobot]"') from error


class _Velocities:
    """Received velocities, until they are no longer needed."""

    def __init__(self):
        # Rows come later than velocities: two runs, where a clock was set back in between.
        self._runs: list[collections.deque[tuple[float, np.ndarray]]] = [
            collections.deque(maxlen=MAX_WAITING_VELOCITIES)]

    def hear(self, at: float, velocity: np.ndarray) -> None:
        run = self._runs[-1]
        if run and set_back(at, run[-1][0]):
            self._runs = [run, collections.deque(maxlen=MAX_WAITING_VELOCITIES)]
            run = self._runs[-1]
        if not run or at > run[-1][0]:
            run.append((at, velocity))

    def _run(self, at: float) -> collections.deque[tuple[float, np.ndarray]]:
        """The run that a time lies in, or next to."""
        return min(self._runs, key=lambda run: max(
            run[0][0] - at, at - run[-1][0], 0.0) if run else np.inf)

    def forget(self, before: float) -> None:
        """Drop what is older than the last one at or before a time."""
        run = self._run(before)
        while len(run) > 1 and run[1][0] <= before:
            run.popleft()
        if run is self._runs[-1]:
            self._runs = [run]

    def near(self, at: float) -> np.ndarray:
        """The one nearest to a time, [3]; zero where there is none."""
        run = self._run(at)
        after = next((entry for entry in run if entry[0] >= at), None)
        before = next((entry for entry in reversed(run) if entry[0] <= at), None)
        both = [entry for entry in (before, after) if entry is not None]
        return (min(both, key=lambda entry: abs(entry[0] - at))[1] if both else np.zeros(3))

    def mean(self, begin: float, end: float) -> np.ndarray:
        """Of velocities that hold until the next one, or for `COMMAND_TIMEOUT_S` s.

        Args:
            begin: s.
            end: s; `begin` for what holds then.

        Returns:
            [3] vx, vy [m/s], wz [rad/s].
        """
        end = max(end, begin + 1e-3)  # times since 1970 are told apart to 2e-7 s
        span, total = end - begin, np.zeros(3)
        entries = [entry for entry in self._run(begin) if entry[0] < end]
        for k, (at, velocity) in enumerate(entries):
            until = entries[k + 1][0] if k + 1 < len(entries) else np.inf
            until = min(until, at + COMMAND_TIMEOUT_S, end)
            total += velocity * max(until - max(at, begin), 0.0) / span
        return total


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
        self._commands, self._odometry = _Velocities(), _Velocities()
        self._video, self._table = _Video(folder, fps), _Table(folder)
        self._states: list[np.ndarray] = []  # of the episode
        self._actions: list[np.ndarray] = []
        self._colours = Colours()
        self._shown: tuple[Frame, np.ndarray] | None = None  # the last picture of the episode
        self._undecodable = self._frames = 0
        self._episodes: list[dict[str, Any]] = []
        self._tasks: list[str] = []

    def write(self, bag: str | Path) -> str:
        """Everything; what it was, in words."""
        report, before = Report(), None
        with self._video, self._table:
            for row in self._grid(synchronise(self._heard(bag), self._topics, report)):
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

    def _heard(self, bag: str | Path) -> Iterator[TimestampedMessage]:
        for m in hear(bag, self._topics):
            try:
                if m.topic == self._topics.command:
                    self._commands.hear(m.time, twist_to_array(m.message)[:3])
                elif m.topic == self._topics.odometry:
                    values = odometry_to_array(m.message)
                    self._odometry.hear(values[6] or m.time, values[3:6])
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
        pyarrow.parquet.write_table(_tasks_table(self._tasks), meta / 'tasks.parquet')
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


class _Video:
    """The camera's video: H.264, every second picture whole, so that any can be read soon.

    Attributes:
        size: height, width [pixels]; None before the first picture.
    """

    def __init__(self, folder: Path, fps: int):
        self._path, self._fps = folder / 'videos' / CAMERA / f'{FIRST}.mp4', fps
        self.size: tuple[int, int] | None = None
        self._file: Any = None
        self._count = 0

    def __enter__(self) -> _Video:
        return self

    def add(self, picture: np.ndarray) -> None:
        """Append a picture [H,W,3] uint8 RGB.

        Raises:
            UserError: it has another size than the first.
        """
        import av
        # 4:2:0 has even sides: an odd row or column is left out.
        height, width = (side - side % 2 for side in picture.shape[:2])
        size = self.size or self._begin(height, width)
        if (height, width) != size:
            raise UserError('pictures of a dataset have one size', f'{width} x {height} after '
                            f'{size[1]} x {size[0]}', 'split the bag where the camera '
                            'changes')
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture[:height, :width]), format='rgb24')
        frame.pts, frame.time_base = self._count, Fraction(1, self._fps)
        self._count += 1
        self._file.mux(self._stream.encode(frame))

    def _begin(self, height: int, width: int) -> tuple[int, int]:
        import av
        if not (height and width):
            raise UserError('a video has two rows and columns at least', f'{width} x {height}',
                            'export a camera with larger pictures')
        self._path.parent.mkdir(parents=True)
        self.size = height, width
        self._file = av.open(str(self._path), 'w')
        self._stream = self._file.add_stream('libx264', rate=self._fps, options={
            'g': '2', 'bf': '0', 'crf': '20', 'preset': 'veryfast'})
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = 'yuv420p'
        return self.size

    def __exit__(self, *error) -> None:
        if self._file is None:
            return
        try:
            if error[0] is None:
                self._file.mux(self._stream.encode())
        finally:
            self._file.close()


class _Table:
    """The numbers of all rows, an episode at a time."""

    def __init__(self, folder: Path):
        self._path = folder / 'data' / f'{FIRST}.parquet'
        self._file: Any = None  # a ParquetWriter; pyarrow has no types

    def __enter__(self) -> _Table:
        return self

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Append an episode: columns [K] or [K,D]."""
        import pyarrow
        import pyarrow.parquet
        arrays = {}
        for name, values in columns.items():
            flat = pyarrow.array(values.ravel())
            arrays[name] = (flat if values.ndim == 1 else
                            pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1]))
        table = pyarrow.table(arrays)
        if self._file is None:
            self._path.parent.mkdir(parents=True)
            self._file = pyarrow.parquet.ParquetWriter(self._path, table.schema)
        self._file.write_table(table)

    def __exit__(self, *error) -> None:
        if self._file is not None:
            self._file.close()


def _tasks_table(tasks: list[str]):
    """Tasks as pandas reads them: the text is the index, as the metadata states."""
    import pyarrow
    columns = [{'name': name, 'field_name': name, 'pandas_type': kind, 'numpy_type': numpy,
                'metadata': None} for name, kind, numpy in (
                    ('task_index', 'int64', 'int64'), ('task', 'unicode', 'object'))]
    told = {'index_columns': ['task'], 'column_indexes': [], 'columns': columns,
            'creator': {'library': 'pyarrow', 'version': pyarrow.__version__},
            'pandas_version': None}
    table = pyarrow.table({'task_index': np.arange(len(tasks)), 'task': tasks})
    return table.replace_schema_metadata({'pandas': json.dumps(told)})
