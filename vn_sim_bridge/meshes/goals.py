"""Goals of a mesh: poses whose pictures show something, in every room or spread over the floor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.floor.floor_map import CELL, FloorMap
from vn_sim_bridge.houses.house import Room
from vn_sim_bridge.houses.viewpoints import CANDIDATES, VIEW, interest
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Goal

FLOOR_PER_GOAL = 10.0  # m^2, where no rooms are known
FEWEST, MOST = 4, 24  # goals then
ROOMY = 0.3  # m that a goal keeps from what is not free, if any cell of its room does
EMPTY_COST = 12.0  # of a picture that shows nothing at all
DETAIL = 0.1  # worth of a grey level of contrast, where instances tell nothing apart
# Classes that do not say where a picture was taken.
EVERYWHERE = {'nothing', 'wall', 'floor', 'ceiling', 'door', 'window', 'object', 'outside'}


def mesh_goals(scene: Scene, floor: FloorMap, rooms: Sequence[Room], label_names: Sequence[str],
               robot: RobotSpec, per_room: int = 1, seed: int = 0) -> tuple[Goal, ...]:
    """The best of some random views in every room; without rooms, of parts of the floor.

    Args:
        scene: with its floor at z = 0.
        floor: of the robot.
        rooms: several of one name are one room.
        label_names: for names of goals where there are no rooms.
        robot: its camera takes the pictures.
        per_room: goals in each.
        seed: of the views.

    Raises:
        UserError: there is no free floor.
    """
    cells = floor.centres()
    if not len(cells):
        raise UserError('a place has free floor', 'none', 'check its storey and scale')
    room_of = cv2.distanceTransform(np.pad(floor.free, 1).astype(np.uint8), cv2.DIST_L2, 5)
    roomy = room_of[1:-1, 1:-1][floor.free] * CELL > ROOMY
    renderer = Rasterizer([scene], VIEW)
    rng = np.random.default_rng([seed, 7])
    goals: list[Goal] = []
    taken: dict[str, int] = {}
    for name, inside in _parts(cells, rooms, rng):
        own = cells[inside & roomy] if (inside & roomy).any() else cells[inside]
        for _ in range(per_room):
            pose, thing = _best(renderer, own, robot, label_names, rng)
            called = name or thing
            taken[called] = taken.get(called, 0) + 1
            again = not name and taken[called] > 1
            goals.append(Goal(pose, f'{called} {taken[called]}' if again else called))
    return tuple(goals)


def _parts(cells: np.ndarray, rooms: Sequence[Room], rng: np.random.Generator):
    """Names ('' where there are no rooms) and masks [K] of the parts that get goals."""
    found: dict[str, np.ndarray] = {}
    for room in rooms:
        x0, y0, x1, y1 = room.rect
        inside = ((cells >= (x0, y0)) & (cells <= (x1, y1))).all(axis=1)
        found[room.name] = found.get(room.name, np.zeros(len(cells), bool)) | inside
    parts = [(name, inside) for name, inside in found.items() if inside.any()]
    if parts:
        return parts
    count = int(np.clip(len(cells) * CELL * CELL / FLOOR_PER_GOAL, FEWEST, MOST))
    # Centres as far from each other as they can be, then the cells that are nearest to each.
    centres = [cells[int(rng.integers(len(cells)))]]
    gap = np.full(len(cells), math.inf)
    nearest = np.zeros(len(cells), int)
    for k in range(count):
        own = np.hypot(*(cells - centres[k]).T)
        nearest[own < gap] = k
        gap = np.minimum(gap, own)
        centres.append(cells[int(np.argmax(gap))])
    return [('', nearest == k) for k in range(count) if (nearest == k).any()]


def _best(renderer: Rasterizer, cells: np.ndarray, robot: RobotSpec,
          label_names: Sequence[str], rng: np.random.Generator):
    """The pose of the best view from some cells, and what it shows."""
    xy = cells[rng.integers(len(cells), size=CANDIDATES)]
    yaw = rng.uniform(-math.pi, math.pi, CANDIDATES)
    cameras = np.column_stack([xy, np.full(CANDIDATES, robot.camera_height), yaw,
                               np.full(CANDIDATES, robot.camera_pitch)])
    rgb, depth, labels, instances = renderer.render(np.zeros(CANDIDATES, np.int64), cameras,
                                                    robot.camera_fov)
    score = interest(depth, instances) - EMPTY_COST * (depth == 0).mean(axis=(1, 2))
    score += DETAIL * np.minimum(rgb.astype(float).std(axis=(2, 3)).mean(axis=1), 40.0)
    best = int(np.argmax(score))
    pose = (float(xy[best, 0]), float(xy[best, 1]), float(yaw[best]), 0.0)
    return pose, _thing(labels[best], label_names)


def _thing(labels: np.ndarray, names: Sequence[str]) -> str:
    """The class that a picture shows most of, of those that say something."""
    counts = np.bincount(labels.reshape(-1), minlength=len(names))
    for k in np.argsort(-counts, kind='stable'):
        if counts[k] and names[k] not in EVERYWHERE:
            return names[k].replace('_', ' ')
    return 'view'
