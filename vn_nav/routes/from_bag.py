"""A route out of a recorded drive: a picture whenever the robot has moved or turned enough."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from vn_msgs_py.images import ImageError, decode_rgb
from vn_nav.arrival import wrap_angle
from vn_nav.bags.drive import Report, find_topics, synchronise, timestamped_messages
from vn_nav.bags.roles import Topics
from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.goal_picture import KEPT_SIDE_PX
from vn_nav.routes.route import MOST, Route, read_route

EVERY_M, EVERY_DEG = 0.5, 30.0
JPEG_QUALITY = 95


class RoutePicture(NamedTuple):
    """One of a drive."""

    picture: np.ndarray  # [H,W,3] uint8 RGB
    time: float  # since the drive began [s]
    way: float  # driven until then [m]


def pictures_along(bag: Path, topics: Topics, every_m: float = EVERY_M,
                   every_deg: float = EVERY_DEG) -> Iterator[RoutePicture]:
    """Pictures of a bag, in its order.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        topics: as wanted.
        every_m, every_deg: between two pictures, one of both at least.

    Raises:
        UserError: no readable bag, one without camera and odometry, or of several drives.
    """
    found = find_topics(bag, topics)
    kept: np.ndarray | None = None
    before: np.ndarray | None = None
    episode, begun, way = -1, 0.0, 0.0
    for frame in synchronise(timestamped_messages(bag, found), found, Report()):
        if episode < 0:
            episode, begun = frame.episode, frame.stamp
        if frame.episode != episode:
            raise UserError('a route is one drive', f'{bag}: the robot was elsewhere after '
                            f'{frame.stamp - begun:.0f} s, or the recording has a gap there',
                            'cut the bag, or record the way in one drive')
        if before is not None:
            way += math.dist(frame.pose[:2], before[:2])
        before = frame.pose
        if kept is not None and math.dist(frame.pose[:2], kept[:2]) < every_m and (
                abs(math.degrees(wrap_angle(float(frame.pose[2] - kept[2])))) < every_deg):
            continue
        try:
            picture = decode_rgb(frame.image, KEPT_SIDE_PX)
        except ImageError:
            continue
        kept = frame.pose
        yield RoutePicture(picture, frame.stamp - begun, way)


def write_route(bag: Path, out: Path, topics: Topics, every_m: float = EVERY_M,
                every_deg: float = EVERY_DEG) -> tuple[Route, list[tuple[float, float]]]:
    """Write a route's pictures; see `pictures_along`.

    Args:
        bag: the drive; out: folder, which is made.
        topics, every_m, every_deg: see `pictures_along`.

    Returns:
        The route, and for each picture the time [s] and the way driven [m] until then.

    Raises:
        UserError: as `pictures_along`; the folder exists, or there are too many pictures.
    """
    if out.exists():
        raise UserError('a route has a folder of its own', str(out),
                        'choose another --out, or remove it')
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f'.{out.name}.', dir=out.parent) as part:
        along = _write_pictures(bag, Path(part), topics, every_m, every_deg)
        Path(part).chmod(0o755)
        Path(part).rename(out)
        Path(part).mkdir()  # to be removed
    return read_route(out), along


def _write_pictures(bag: Path, folder: Path, topics: Topics, every_m: float, every_deg: float
                    ) -> list[tuple[float, float]]:
    along: list[tuple[float, float]] = []
    for number, own in enumerate(pictures_along(bag, topics, every_m, every_deg)):
        if number == MOST:
            raise UserError(f'a route has at most {MOST} pictures', f'{bag}: more than that',
                            'take fewer: --every, --turn')
        data = cv2.imencode('.jpg', own.picture[..., ::-1],
                            [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        write_file(folder / f'{number}.jpg', data)
        along.append((own.time, own.way))
    if not along:
        raise UserError('a bag for a route holds camera pictures and odometry', str(bag),
                        'see `vn_nav bag doctor`')
    return along
