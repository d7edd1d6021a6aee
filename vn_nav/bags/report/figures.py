"""What `vn_nav bag show` keeps of a drive while it streams by: bounded, however long it is."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_nav.arrival import wrap_angle
from vn_nav.bags.doctor.figures import ODOMETRY_NOISE_M_RAD
from vn_nav.bags.drive import Frame

MAX_BINS = 240  # stretches of time, at most
MAX_STRIP_PICTURES = 12  # pictures of the film strip, and goal pictures, at most
THUMBNAIL_PX = 132  # pixels of a thumbnail
MAX_PATH_POINTS = 4000  # of the path, at most
PATH_SPACING_M = 0.02  # m between points of the path
MIN_PROGRESS_M_RAD = 0.1  # m and rad added, between two pictures that might be shown
EPISODE_PROGRESS_M_RAD = 0.5  # the same, for a new episode: it begins elsewhere


class Timeline:
    """Numbers over time, by stretches of one width, which doubles when they do not suffice.

    Args:
        width: of a stretch, to begin with [s].

    Attributes:
        origin: time of the first number [ns]; None: there was none.
        width: of a stretch by now [s].
    """

    def __init__(self, width: float):
        self.origin: int | None = None
        self._end, self._width = 0, round(width * 1e9)
        self._rows: dict[str, np.ndarray] = {}  # [MAX_BINS,4] count, sum, lowest, highest

    @property
    def width(self) -> float:
        return self._width * 1e-9

    def add(self, name: str, at: int, value: float = 0.0) -> None:
        """Note a number of a kind at a time [ns]."""
        self.origin = at if self.origin is None else self.origin
        self._end = max(self._end, at - self.origin)
        while self._end >= MAX_BINS * self._width:
            self._double()
        rows = self._rows.setdefault(name, _empty(MAX_BINS))
        row = rows[max(at - self.origin, 0) // self._width]
        row[:] = row[0] + 1, row[1] + value, min(row[2], value), max(row[3], value)

    def _double(self) -> None:
        self._width *= 2
        for name, rows in self._rows.items():
            pairs, merged = rows.reshape(-1, 2, 4), _empty(MAX_BINS)
            merged[:MAX_BINS // 2] = np.concatenate([
                pairs[..., :2].sum(1), pairs[..., 2:3].min(1), pairs[..., 3:].max(1)], 1)
            self._rows[name] = merged

    def rate(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Centres of the stretches since the origin [K] s, and numbers a second in each [K]."""
        whole = max(int(self._end // self._width), 1)  # the last one is not over
        seconds = self.width if self._end >= self._width else max(self._end * 1e-9, 1e-3)
        return self._centres(whole), self._rows.get(name, _empty(MAX_BINS))[:whole, 0] / seconds

    def values(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """The same centres [K], and [K,3] mean, lowest and highest number; nan where is none."""
        used = int(self._end // self._width) + 1
        rows = self._rows.get(name, _empty(MAX_BINS))[:used]
        known = rows[:, :1] > 0
        mean = rows[:, 1:2] / np.maximum(rows[:, :1], 1)
        return self._centres(used), np.where(known, np.concatenate([mean, rows[:, 2:]], 1), np.nan)

    def _centres(self, count: int) -> np.ndarray:
        return (np.arange(count) + 0.5) * self.width


def _empty(count: int) -> np.ndarray:
    rows = np.zeros((count, 4))
    rows[:, 2], rows[:, 3] = np.inf, -np.inf
    return rows


class Odometer:
    """How far the robot has gone: `metres`, and `turned` [rad]; jumps between episodes apart."""

    def __init__(self):
        self.metres = self.turned = self.progress = 0.0
        self._last: Frame | None = None

    def go(self, frame: Frame) -> None:
        """Take the next frame."""
        if self._last is None or frame.episode != self._last.episode:
            self.progress += EPISODE_PROGRESS_M_RAD * (self._last is not None)
            self._last = frame
            return
        metres = math.dist(frame.pose[:2], self._last.pose[:2])
        turned = abs(wrap_angle(frame.pose[2] - self._last.pose[2]))
        if metres + turned >= ODOMETRY_NOISE_M_RAD:
            self.metres, self.turned = self.metres + metres, self.turned + turned
            self.progress += metres + turned
            self._last = frame


@dataclasses.dataclass
class Shot:
    """A picture of the film strip."""

    progress: float  # m and rad, and `EPISODE_PROGRESS_M_RAD` an episode, since the beginning
    time: float  # s of recording
    episode: int
    pose: np.ndarray  # [3] x, y [m], yaw [rad]
    picture: np.ndarray  # [H,W,3] uint8 RGB


class Film:
    """Pictures evenly along the way, so that a standing robot shows none."""

    def __init__(self):
        self._shots: list[Shot] = []
        self._stride, self._last = MIN_PROGRESS_M_RAD, None
        self.undecodable = 0

    def add(self, frame: Frame, progress: float) -> None:
        """Take the next frame."""
        self._last = frame, progress
        if self._shots and progress < self._shots[-1].progress + self._stride:
            return
        self._take(frame, progress)
        if len(self._shots) >= 4 * MAX_STRIP_PICTURES:
            self._stride *= 2
            kept = self._shots[:1]
            for shot in self._shots[1:]:
                if shot.progress >= kept[-1].progress + self._stride:
                    kept.append(shot)
            self._shots = kept

    def shots(self) -> list[Shot]:
        """At most `MAX_STRIP_PICTURES` in order, with the first and the last."""
        if self._last is not None and self._shots and self._last[1] > self._shots[-1].progress:
            self._take(*self._last)
        way = np.array([shot.progress for shot in self._shots])
        if not len(way):
            return []
        chosen = {int(np.abs(way - wanted).argmin())
                  for wanted in np.linspace(way[0], way[-1], MAX_STRIP_PICTURES)}
        return [self._shots[k] for k in sorted(chosen)]

    def _take(self, frame: Frame, progress: float) -> None:
        picture = thumbnail(frame.image)
        if picture is None:
            self.undecodable += 1
        else:
            self._shots.append(Shot(progress, frame.time, frame.episode, frame.pose, picture))


class Goals:
    """The goal pictures that were shown."""

    def __init__(self):
        self.shown: list[tuple[int, np.ndarray]] = []  # first episode, [H,W,3]
        self.count = 0
        self._last = None

    def add(self, frame: Frame) -> None:
        """Take the next frame."""
        if frame.goal is None:
            return
        stamp = frame.goal.header.stamp.sec, frame.goal.header.stamp.nanosec
        if stamp == self._last:
            return
        self._last = stamp
        self.count += 1
        if len(self.shown) < MAX_STRIP_PICTURES:
            picture = thumbnail(frame.goal)
            if picture is not None:
                self.shown.append((frame.episode, picture))


class Ways:
    """Where the robot went, episode by episode: points that lie apart, as many as fit."""

    def __init__(self):
        self._ways: dict[int, list[np.ndarray]] = {}
        self._spacing, self._points, self._most = PATH_SPACING_M, 0, MAX_PATH_POINTS
        self._last: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Take the next frame."""
        if self._last is not None and self._last.episode != frame.episode:
            self._finish()
        self._last = frame
        way = self._ways.get(frame.episode)
        if way is None:
            if self._points < MAX_PATH_POINTS:  # there may be more episodes than points
                self._ways[frame.episode] = [frame.pose]
                self._points += 1
        elif math.dist(way[-1][:2], frame.pose[:2]) >= self._spacing:
            way.append(frame.pose)
            self._points += 1
            if self._points >= self._most:
                self._thin()

    def ways(self) -> dict[int, np.ndarray]:
        """[K,3] poses of each episode; the last one is where it ended."""
        self._finish()
        return {episode: np.array(way) for episode, way in self._ways.items()}

    def _finish(self) -> None:
        """The end of an episode belongs to its way, however near to the point before."""
        if self._last is None:
            return
        way = self._ways.get(self._last.episode)
        if way is not None and way[-1] is not self._last.pose:
            way.append(self._last.pose)
            self._points += 1

    def _thin(self) -> None:
        self._spacing *= 2
        for episode, way in self._ways.items():
            kept = way[:1]
            for pose in way[1:]:
                if math.dist(kept[-1][:2], pose[:2]) >= self._spacing:
                    kept.append(pose)
            if kept[-1] is not way[-1]:
                kept.append(way[-1])
            self._ways[episode] = kept
        self._points = sum(map(len, self._ways.values()))
        self._most = max(MAX_PATH_POINTS, self._points + MAX_PATH_POINTS // 4)


def thumbnail(message) -> np.ndarray | None:
    """A small picture [H,W,3] uint8 of an image message; None: it cannot be decoded."""
    try:
        picture = decode_rgb(message, THUMBNAIL_PX)
    except ImageError:
        return None
    height, width = picture.shape[:2]
    size = max(round(width * THUMBNAIL_PX / height), 1), THUMBNAIL_PX
    if height <= THUMBNAIL_PX:
        return picture
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
