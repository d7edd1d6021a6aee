"""Where goal pictures are taken: poses from which a room shows a lot of itself."""

from __future__ import annotations

import math

import numpy as np

from vn_sim_bridge.floor.floor_map import FloorMap, Room
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import Scene

CAMERA_HEIGHT = 1.0  # m, the standard robot
FIELD_OF_VIEW = math.radians(90)
CANDIDATES = 24  # views looked at in each room
VIEW = 32  # pixels a side of what is looked at
WALL_DISTANCE = 0.45  # m that a goal keeps from the walls of its room


def choose_goals(scene: Scene, rooms: list[Room], floor: FloorMap, rng: np.random.Generator,
                 per_room: int = 1):
    """The best of some random views in every room, as (pose, room name), `per_room` of each.

    The best as `interest` says.
    """
    renderer = Rasterizer([scene], VIEW)
    centres = floor.centres()
    goals = []
    for room in (room for room in rooms for _ in range(per_room)):
        x0, y0, x1, y1 = room.rect
        inside = centres[(centres[:, 0] > x0 + WALL_DISTANCE)
                         & (centres[:, 0] < x1 - WALL_DISTANCE)
                         & (centres[:, 1] > y0 + WALL_DISTANCE)
                         & (centres[:, 1] < y1 - WALL_DISTANCE)]
        if len(inside) == 0:
            continue
        xy = inside[rng.integers(len(inside), size=CANDIDATES)]
        yaw = rng.uniform(-math.pi, math.pi, CANDIDATES)
        cameras = np.column_stack([xy, np.full(CANDIDATES, CAMERA_HEIGHT), yaw,
                                   np.zeros(CANDIDATES)])
        _, depth, _, instances = renderer.render(np.zeros(CANDIDATES, np.int64), cameras,
                                                 FIELD_OF_VIEW)
        best = int(np.argmax(interest(depth, instances)))
        goals.append(((float(xy[best, 0]), float(xy[best, 1]), float(yaw[best]), 0.0), room.name))
    return goals


def interest(depth: np.ndarray, instances: np.ndarray) -> np.ndarray:
    """How good views [K] of `VIEW` pixels a side are as goal pictures; greater is better.

    A view is good when it shows many different things at a few metres' distance: nobody
    photographs a blank wall to say where to go.

    Args:
        depth: [K,H,W] m; instances: [K,H,W].
    """
    variety = np.array([(np.unique(view, return_counts=True)[1] > 10).sum()
                        for view in instances])
    return variety + 3.0 * np.minimum(np.median(depth.reshape(len(depth), -1), axis=1), 2.5)
