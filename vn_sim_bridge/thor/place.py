"""A scene of AI2-THOR as a place: its floor from reachable positions, goals from its objects."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL, FloorMap, main_component
from vn_sim_bridge.simulator import Goal
from vn_sim_bridge.thor.agent import Agent, Scene
from vn_sim_bridge.thor.frame import point_to_ours
from vn_sim_bridge.thor.names import snake_case

GOALS = 6  # views of a scene that the image task drives to
LOOKED_AT = (0.6, 3.0)  # m from a view to the object that it faces
PORTRAIT = (0.7, 1.4)  # m from a camera to the object that a goal picture shows
STEEPEST = math.radians(50)  # rad, that such a picture looks down
CANDIDATES = 8  # poses that are tried for such a picture


class ThorPlace:
    """A room, or a ProcTHOR house (see `FloorPlace`).

    Args:
        name: of our scene; scene: what an engine loads for it.
        agent: a robot that is in it.
        portraits: also look for pictures of single objects, for the task `object`.
    """

    def __init__(self, name: str, scene: Scene, agent: Agent, *, portraits: bool):
        self.name, self.scene = name, scene
        cells = agent.reachable()
        self.camera_height = agent.camera_height
        self.floor = floor_of(cells)
        self._cells = self.floor.centres()
        objects = agent.objects
        self.goals = _views(self._cells, objects)
        self.object_goals: tuple[Goal, ...] = ()
        self.object_ids: tuple[str, ...] = ()  # of AI2-THOR, beside `object_goals`
        if portraits:
            self._take_portraits(agent, objects)

    def starts(self) -> tuple[np.ndarray, None]:
        """Where episodes may begin: [K,2] m, any heading."""
        return self._cells, None

    def distance_to(self, goal: Goal) -> FloorDistance:
        """Over the reachable positions, to a goal."""
        return FloorDistance(self.floor, *goal.pose[:2])

    def distance_to_object(self, x: float, y: float) -> FloorDistance:
        """To the reachable position that is nearest to an object at x, y [m]."""
        near = self._cells[np.argmin(np.hypot(*(self._cells - (x, y)).T))]
        return FloorDistance(self.floor, *map(float, near))

    def plan(self) -> dict:
        """What a map needs; walls are not known, only where a robot can stand."""
        x0, y0 = self.floor.origin
        rows, columns = self.floor.free.shape
        return {'scene': self.name, 'bounds': [x0, y0, x0 + columns * CELL, y0 + rows * CELL],
                'area': float(self.floor.free.sum() * CELL**2), 'rooms_list': [], 'walls': [],
                'obstacles': [], 'outside': [], 'goals': [goal._asdict() for goal in self.goals]}

    def _take_portraits(self, agent: Agent, objects: Sequence[dict]) -> None:
        kinds = [item['objectType'] for item in objects]
        found = []
        for item in objects:
            if not item.get('pickupable') or kinds.count(item['objectType']) != 1:
                continue
            for pose in _poses_before(self._cells, item, agent):
                agent.put(np.array(pose))
                if any(seen['objectId'] == item['objectId'] and seen['visible']
                       for seen in agent.objects):
                    found.append((Goal(pose, snake_case(item['objectType'])), item['objectId']))
                    break
        self.object_goals = tuple(goal for goal, _ in found)
        self.object_ids = tuple(name for _, name in found)


def floor_of(positions: np.ndarray) -> FloorMap:
    """The floor map whose free cells are around positions [K,2] m, a cell's side apart.

    What cannot be driven to from most of it is not free.
    """
    least = positions.min(axis=0)
    column, row = np.rint((positions - least) / CELL).astype(np.int64).T
    # One ring of cells around it is not free: distances beyond the edge lead back to it.
    free = np.zeros((row.max() + 3, column.max() + 3), bool)
    free[row + 1, column + 1] = True
    x, y = (least - 1.5 * CELL).tolist()
    return FloorMap((x, y), main_component(free))


def _views(cells: np.ndarray, objects: Sequence[dict]) -> tuple[Goal, ...]:
    """Views far from each other, each facing an object that stays where it is."""
    at = [(*point_to_ours(item['position'])[:2], item['objectType']) for item in objects
          if not item.get('pickupable')]
    chosen = [int(np.argmin(np.hypot(*(cells - cells.mean(axis=0)).T)))]
    while len(chosen) < min(GOALS, len(cells)):
        gap = np.min([np.hypot(*(cells - cells[k]).T) for k in chosen], axis=0)
        chosen.append(int(np.argmax(gap)))
    goals = []
    for k in chosen:
        x, y = map(float, cells[k])
        far = [math.hypot(ox - x, oy - y) for ox, oy, _ in at]
        facing = [(d, n) for n, d in enumerate(far) if LOOKED_AT[0] <= d <= LOOKED_AT[1]]
        ox, oy, kind = at[min(facing)[1]] if facing else (*cells.mean(axis=0), 'middle')
        goals.append(Goal((x, y, math.atan2(oy - y, ox - x), 0.0), snake_case(kind)))
    return tuple(goals)


def _poses_before(cells: np.ndarray, item: dict, agent: Agent
                  ) -> list[tuple[float, float, float, float]]:
    """Poses from which a picture of an object may be taken, the camera turned to it."""
    ox, oy, oz = point_to_ours(item['position'])
    far = np.hypot(*(cells - (ox, oy)).T)
    near = np.nonzero((far >= PORTRAIT[0]) & (far <= PORTRAIT[1]))[0]
    near = near[np.argsort(np.abs(far[near] - 1.0), kind='stable')]
    step = max(len(near) // CANDIDATES, 1)
    poses = []
    for k in near[::step][:CANDIDATES]:
        x, y = map(float, cells[k])
        down = math.atan2(agent.floor_height + agent.camera_height - oz, float(far[k]))
        pitch = min(max(down, 0.0), STEEPEST) - agent.camera_pitch
        poses.append((x, y, math.atan2(oy - y, ox - x), pitch))
    return poses
