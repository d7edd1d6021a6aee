"""The map of a policy that searches, as a picture: what it has seen, and where it takes the goal.

White is free, dark is occupied, grey is unknown. Drawn in the frame of the place where its floor
plan is known, with the plan's outline: the robot's own map drifts against that as its odometry
does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from vn_nav.policy.search.snapshot import FREE, Snapshot
from vn_nav.report.maps import MARGIN_M
from vn_nav.report.page import LIGHT

FINE = 3  # cells are drawn so many times as fine, then averaged
SHIFT = 4  # fractional bits of cv2's coordinates: lines move by less than a pixel
STRONG = 12.0  # evidence of a hypothesis that is drawn in full size
SMALLEST = 0.35  # share of it of the weakest
MOST_GUESSES = 12  # drawn
OCCUPIED_FROM = 62  # percent: log-odds of 0.5


def rgb(colour: str) -> tuple[int, int, int]:
    """Of a colour of pages, '#rrggbb'."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


UNKNOWN_RGB, FREE_RGB, OCCUPIED_RGB = (203, 207, 213), (255, 255, 255), rgb(LIGHT['wall'])
WALL_RGB, THING_RGB = (158, 166, 178), (184, 188, 194)  # outlines of what is really there
TRACK_RGB, ROBOT_RGB = (120, 190, 160), rgb(LIGHT['good'])
GUESS_RGB, BEST_RGB, GOAL_RGB = (240, 176, 140), rgb(LIGHT['bad']), rgb(LIGHT['goal'])


class Window(NamedTuple):
    """The part of the plane that a picture shows."""

    left: float  # m
    bottom: float  # m
    width: int  # pixels
    height: int  # pixels
    scale: float  # pixels a metre

    @classmethod
    def about(cls, bounds: Sequence[float], width: int, height: int) -> Window:
        """So many pixels with some bounds (x0, y0, x1, y1) [m] and a margin in their middle."""
        x0, y0, x1, y1 = bounds
        scale = min(width / (x1 - x0 + 2 * MARGIN_M), height / (y1 - y0 + 2 * MARGIN_M))
        return cls((x0 + x1 - width / scale) / 2, (y0 + y1 - height / scale) / 2, width, height,
                   scale)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Points [K,2] m as cv2 takes them with `SHIFT`, [K,2] int32."""
        points = np.asarray(points, float).reshape(-1, 2)
        x = (points[:, 0] - self.left) * self.scale - 0.5
        y = self.height - (points[:, 1] - self.bottom) * self.scale - 0.5
        return np.round(np.stack([x, y], axis=1) * (1 << SHIFT)).astype(np.int32)


def known_bounds(seen: Snapshot, frame: np.ndarray) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) [m] of a snapshot's cells, its frame lying at a pose [3]."""
    rows, columns = seen.cells.shape
    corners = placed(frame, seen.origin + seen.cell * _corners(0, 0, columns, rows))
    return (*corners.min(0).tolist(), *corners.max(0).tolist())


def placed(frame: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [K,2] of a frame that lies at a pose [3], in the frame of that pose."""
    c, s = math.cos(frame[2]), math.sin(frame[2])
    return np.asarray(points, float) @ np.array([[c, s], [-s, c]]) + frame[:2]


def draw(seen: Snapshot, view: Window, frame: np.ndarray, *, plan: Mapping[str, Any] | None = None,
         track: np.ndarray | None = None, goal: Sequence[float] | None = None,
         fov: float | None = None) -> np.ndarray:
    """A picture of what a search knows, [height,width,3] uint8 RGB.

    Args:
        seen: what it knows.
        view: what of the plane to show.
        frame: [3] x, y [m], yaw [rad] of the snapshot's frame in that of the plane.
        plan: of the place, see `maps.floor_map`: its outline is drawn.
        track: [K,2] or [K,3] where the robot really was [m], in the frame of the plane; None: one
            does not know, and the robot is drawn where it takes itself to be.
        goal: x, y, yaw of the true goal in the frame of the plane, of which it knows nothing.
        fov: of the camera [rad]: what is in view is marked.
    """
    image = _cells(seen, view, frame)
    if plan is not None:
        _outline(image, view, plan)
    own = np.array([*placed(frame, seen.pose[None, :2])[0], frame[2] + seen.pose[2]])
    robot = own
    if track is not None and len(track):
        _line(image, view, track[:, :2], TRACK_RGB, 2)
        start = tuple(view.pixels(track[:1, :2])[0].tolist())
        cv2.circle(image, start, 5 << SHIFT, TRACK_RGB, cv2.FILLED, cv2.LINE_AA, SHIFT)
        if track.shape[1] > 2:
            robot = track[-1]
    if goal is not None:
        _arrow(image, view, np.array(goal[:3], float), 0.55, GOAL_RGB, filled=False)
    for k, guess in reversed(list(enumerate(seen.guesses[:MOST_GUESSES]))):
        unknown = math.isnan(guess.weight)  # their order is known all the same
        share = (0.0 if k else 1.0) if unknown else min(guess.weight / STRONG, 1.0)
        pose = np.array([*placed(frame, guess.pose[None, :2])[0], frame[2] + guess.pose[2]])
        _arrow(image, view, pose, 0.75 * (SMALLEST + (1 - SMALLEST) * math.sqrt(share)),
               BEST_RGB if k == 0 else GUESS_RGB, filled=True)
    _robot(image, view, robot, fov)
    return image


def _cells(seen: Snapshot, view: Window, frame: np.ndarray) -> np.ndarray:
    """The map's cells, turned into the plane of the picture."""
    colours = np.full((*seen.cells.shape, 3), UNKNOWN_RGB, np.uint8)
    colours[seen.cells >= FREE] = FREE_RGB
    colours[seen.cells >= OCCUPIED_FROM] = OCCUPIED_RGB
    if not seen.cells.size:
        return np.full((view.height, view.width, 3), UNKNOWN_RGB, np.uint8)
    # From a cell's (column, row) to metres in its frame, to metres in the plane, to pixels.
    fine = view._replace(width=FINE * view.width, height=FINE * view.height,
                         scale=FINE * view.scale)
    c, s = math.cos(frame[2]), math.sin(frame[2])
    start = seen.origin + 0.5 * seen.cell
    x0, y0 = placed(frame, start[None])[0]
    step = seen.cell * fine.scale
    forward = np.array([
        [step * c, -step * s, (x0 - fine.left) * fine.scale - 0.5],
        [-step * s, -step * c, fine.height - (y0 - fine.bottom) * fine.scale - 0.5]])
    drawn = cv2.warpAffine(colours, forward, (fine.width, fine.height), flags=cv2.INTER_NEAREST,
                           borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN_RGB)
    return cv2.resize(drawn, (view.width, view.height), interpolation=cv2.INTER_AREA)


def _outline(image: np.ndarray, view: Window, plan: Mapping[str, Any]) -> None:
    """The edges of walls and furniture, as thin lines: one sees what the map lacks."""
    wall = np.zeros(image.shape[:2], np.uint8)
    for x0, y0, x1, y1 in plan['walls']:
        cv2.fillPoly(wall, [view.pixels(_corners(x0, y0, x1, y1))], 255, cv2.LINE_8, SHIFT)
    for x0, y0, x1, y1, *_ in plan['obstacles']:
        cv2.polylines(image, [view.pixels(_corners(x0, y0, x1, y1))], True, THING_RGB, 1,
                      cv2.LINE_8, SHIFT)
    edges, _ = cv2.findContours(wall, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(image, edges, -1, WALL_RGB, 1)


def _corners(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def _line(image: np.ndarray, view: Window, points: np.ndarray, colour, width: int) -> None:
    cv2.polylines(image, [view.pixels(points)], False, colour, width, cv2.LINE_AA, SHIFT)


def _arrow(image: np.ndarray, view: Window, pose: np.ndarray, length: float, colour, *,
           filled: bool) -> None:
    """A pose as an arrow from its place along its heading [m]."""
    along = np.array([math.cos(pose[2]), math.sin(pose[2])])
    across = np.array([-along[1], along[0]])
    at, width = pose[:2], 0.17 * length
    shape = np.stack([
        at + width * 0.5 * across, at + 0.55 * length * along + width * 0.5 * across,
        at + 0.55 * length * along + 1.6 * width * across, at + length * along,
        at + 0.55 * length * along - 1.6 * width * across,
        at + 0.55 * length * along - width * 0.5 * across, at - width * 0.5 * across])
    points = [view.pixels(shape)]
    if filled:
        cv2.fillPoly(image, points, colour, cv2.LINE_AA, SHIFT)
        cv2.polylines(image, points, True, (255, 255, 255), 1, cv2.LINE_AA, SHIFT)
    else:
        cv2.polylines(image, points, True, colour, 2, cv2.LINE_AA, SHIFT)
    centre = tuple(view.pixels(at)[0].tolist())
    cv2.circle(image, centre, round(1.1 * width * view.scale * (1 << SHIFT)), colour,
               cv2.FILLED if filled else 2, cv2.LINE_AA, SHIFT)


def _robot(image: np.ndarray, view: Window, pose: np.ndarray, fov: float | None) -> None:
    """A disc with a nose; and what its camera has in view."""
    if fov is not None:
        rays = pose[2] + np.linspace(-fov / 2, fov / 2, 12)
        fan = np.concatenate([pose[None, :2], pose[:2] + 1.6 * np.stack(
            [np.cos(rays), np.sin(rays)], axis=1)])
        shade = image.copy()
        cv2.fillPoly(shade, [view.pixels(fan)], ROBOT_RGB, cv2.LINE_AA, SHIFT)
        cv2.addWeighted(shade, 0.22, image, 0.78, 0, image)
    along = np.array([math.cos(pose[2]), math.sin(pose[2])])
    across = np.array([-along[1], along[0]])
    body = np.stack([pose[:2] + 0.34 * along, pose[:2] - 0.2 * along + 0.24 * across,
                     pose[:2] - 0.1 * along, pose[:2] - 0.2 * along - 0.24 * across])
    cv2.fillPoly(image, [view.pixels(body)], ROBOT_RGB, cv2.LINE_AA, SHIFT)
    cv2.polylines(image, [view.pixels(body)], True, (255, 255, 255), 1, cv2.LINE_AA, SHIFT)
