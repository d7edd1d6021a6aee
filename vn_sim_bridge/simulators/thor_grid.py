"""Grid scenes, `grid:bathroom_02` or `grid:/path/file.h5`: pictures of a file, whole actions.

The task of Zhu et al. (ICRA 2017): four headings a cell, success in the exact cell and heading,
distances in steps, nothing noisy. `vn_sim_bridge.grid` reads the files.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import Action, RobotSpec
from vn_nav.scenes import SceneName
from vn_sim_bridge.grid.grid_file import GridScene, read_facts, read_grid
from vn_sim_bridge.grid.states import BACKWARD, FORWARD, LEFT, RIGHT, walk
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Goal,
    Motion,
    Setup,
)

OFF = 0.1  # of a step or of a quarter turn: a robot farther from a state is not in it


class GridDistance:
    """Steps to one state: moves and turns, each of them one."""

    def __init__(self, place: GridPlace, state: int):
        self._place, self._to = place, place.scene.steps[:, state].astype(float)
        self._to[self._to < 0] = np.inf
        self.maximum = float(self._to[np.isfinite(self._to)].max())

    def at(self, poses: np.ndarray) -> np.ndarray:
        """Of poses [K,>=3] to the goal, [K] steps; of positions [K,2] from the best heading.

        A pose beside all states has a step more: it is none of them.
        """
        poses = np.asarray(poses, float)
        if poses.shape[1] == 2:
            cells = self._place.cells
            gap = np.hypot(*(poses[:, None] - cells[None]).transpose(2, 0, 1))
            best = np.full(len(cells), np.inf)
            np.minimum.at(best, self._place.cell_of, self._to)
            return best[gap.argmin(axis=1)]
        states, off = self._place.nearest(poses)
        return self._to[states] + (off > OFF)


class GridPlace:
    """A scene as a place."""

    def __init__(self, scene: GridScene):
        self.scene, self.name = scene, scene.name
        self.goals = tuple(Goal(tuple(scene.poses[state].tolist()), f'state {state}')
                           for state in scene.goals)
        self.cells, self.cell_of = np.unique(np.round(scene.poses[:, :2], 3), axis=0,
                                             return_inverse=True)
        self.cell_of = self.cell_of.ravel()
        self._distances = {goal.pose: GridDistance(self, state)
                           for goal, state in zip(self.goals, scene.goals, strict=True)}

    def nearest(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state nearest to poses [K,>=3], and how far off it is, in steps or quarter turns."""
        own = self.scene.poses
        gap = np.hypot(poses[:, None, 0] - own[:, 0], poses[:, None, 1] - own[:, 1])
        turn = (poses[:, None, 2] - own[:, 2] + math.pi) % (2 * math.pi) - math.pi
        off = np.maximum(gap / self.scene.step, np.abs(turn) / (math.pi / 2))
        states = off.argmin(axis=1)
        return states, off[np.arange(len(states)), states]

    def starts(self) -> tuple[np.ndarray, np.ndarray]:
        """Every state."""
        return self.scene.poses[:, :2], self.scene.poses[:, 2]

    def distance_to(self, goal: Goal) -> GridDistance:
        """Steps to a goal."""
        if goal.pose not in self._distances:
            state = int(self.nearest(np.array([goal.pose]))[0][0])
            self._distances[goal.pose] = GridDistance(self, state)
        return self._distances[goal.pose]

    def plan(self) -> dict:
        """Its cells; there are no walls but what the graph says."""
        half = self.scene.step / 2
        low, high = self.cells.min(axis=0) - half, self.cells.max(axis=0) + half
        return {'scene': self.name, 'bounds': [*low.tolist(), *high.tolist()],
                'area': len(self.cells) * self.scene.step**2, 'rooms_list': [], 'walls': [],
                'obstacles': [], 'outside': [], 'goals': [goal._asdict() for goal in self.goals]}


class GridPlanner:
    """The shortest ways, by counting steps."""

    def __init__(self, simulator: GridSimulator):
        self._simulator = simulator
        kinds = []
        for action in simulator.robot.actions:
            column = {'dx': (FORWARD, BACKWARD), 'dyaw': (LEFT, RIGHT)}[action.axis]
            kinds.append(column[0] if action.size > 0 else column[1])
        self._columns = np.array(kinds)  # of the graph, by action

    def regrets(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """[N,A] steps that each action costs more than the best one."""
        cost = np.empty((len(poses), len(self._columns)))
        for n, place_index in enumerate(self._simulator.place_index):
            place = self._simulator.places[place_index]
            state, goal = (int(place.nearest(part[[n]])[0][0]) for part in (poses, goal_poses))
            ends = place.scene.graph[state, self._columns]
            steps = place.scene.steps[np.where(ends < 0, state, ends), goal]
            cost[n] = np.where(steps < 0, np.inf, steps)
        best = cost.min(axis=1, keepdims=True)
        return cost - np.where(np.isfinite(best), best, 0.0)

    def actions(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """The first action [N] of a shortest way."""
        return self.regrets(poses, goal_poses).argmin(axis=1)


class GridSimulator(BaseSimulator):
    """N robots in scenes of states.

    A whole action leads from state to state, or nowhere. A robot that is driven by velocities may
    be on its way between two of them: it sees the nearer one, and can only go on or back.
    """

    capabilities = Capabilities(continuous=False, depth=False, labels=False, geodesic=True,
                                tilt=False, steps=True)
    places: list[GridPlace]

    def __init__(self, scenes: Sequence[GridScene], setup: Setup):
        super().__init__([GridPlace(scene) for scene in scenes], setup)
        counts = [len(scene.poses) for scene in scenes]
        self._first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self._poses = np.concatenate([scene.poses for scene in scenes])
        self._graph = np.concatenate([np.where(scene.graph < 0, -1, scene.graph + first)
                                      for scene, first in zip(scenes, self._first, strict=True)])
        self._step = np.array([scene.step for scene in scenes])
        self._rgb = np.concatenate([scene.rgb for scene in scenes])
        self._depth = _joined([scene.depth for scene in scenes])
        self._labels = _joined([scene.labels for scene in scenes])
        self._features = _joined([scene.features for scene in scenes])
        self.feature_size = 0 if self._features is None else self._features.shape[1]
        self.label_names = scenes[0].label_names if self._labels is not None else ()
        self.capabilities = dataclasses.replace(
            self.capabilities, depth=self._depth is not None, labels=self._labels is not None)
        self.planner = GridPlanner(self)
        self._state = self._first[self.place_index].copy()  # that each robot was in last
        self._along, self._turned = np.zeros((2, setup.num_envs))  # m, rad since
        self.place(self._all, self._poses[self._state])

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> GridSimulator:
        """See `BaseSimulator.open`.

        Raises:
            UserError: see `read_grid`; actions that are no whole moves of the grid.
        """
        robot, read = setup.robot, []
        for scene in scenes:
            read.append(read_grid(scene, setup.size, robot.camera_fov, robot.camera_height))
            for action in robot.actions:
                want = {'dx': read[-1].step, 'dyaw': math.pi / 2}.get(action.axis, math.nan)
                if not abs(abs(action.size) - want) < 0.01:
                    raise UserError(f'actions in {scene} move by {read[-1].step:g} m or turn by '
                                    '90 deg', f'{action.name}: {action.axis} {action.size:.3g}',
                                    'leave out the robot file, or use one such as '
                                    'config/robots/thor_grid.yaml')
        if len({grid.label_names for grid in read if grid.labels is not None}) > 1:
            raise UserError('scenes that are used together have the same classes',
                            ', '.join(map(str, scenes)), 'use them one by one')
        return cls(read, setup)

    @classmethod
    def own_robot(cls, scenes: Sequence[SceneName], robot: RobotSpec) -> RobotSpec:
        """A robot with the moves of the first scene's grid, and with its camera."""
        facts = read_facts(scenes[0])
        return dataclasses.replace(
            robot, name='grid', camera_fov=facts.fov or robot.camera_fov,
            camera_height=facts.height or robot.camera_height,
            actions=(Action('forward', dx=facts.step), Action('backward', dx=-facts.step),
                     Action('rotate_left', dyaw=math.pi / 2),
                     Action('rotate_right', dyaw=-math.pi / 2)))

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """See `Simulator`."""
        super().enter(env_ids, places)
        self.place(env_ids, self._poses[self._first[places]])

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Put robots [K] at poses [K,4]: into the states there."""
        super().place(env_ids, poses)
        self._state[env_ids] = self._nearest(self.place_index[env_ids], np.asarray(poses))
        own = self._poses[self._state[env_ids]]
        gap = self.poses[env_ids] - own
        self._along[env_ids] = np.cos(own[:, 2]) * gap[:, 0] + np.sin(own[:, 2]) * gap[:, 1]
        self._turned[env_ids] = (gap[:, 2] + math.pi) % (2 * math.pi) - math.pi

    def _nearest(self, places: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """States [K], numbered through all places."""
        states = np.empty(len(poses), np.int64)
        for place in np.unique(places):
            rows = np.nonzero(places == place)[0]
            states[rows] = self._first[place] + self.places[place].nearest(poses[rows])[0]
        return states

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """See `Simulator`; what is along two axes at once, or sideways, is a contact."""
        env_ids = self._all if env_ids is None else env_ids
        before = self.poses[env_ids].copy()
        states, along, turned = (part[env_ids] for part in (
            self._state, self._along, self._turned))
        delta = np.asarray(delta, float)
        hit = walk(states, along, turned, delta, self._graph,
                   self._step[self.place_index[env_ids]])
        moved = hit | (delta != 0).any(axis=1)
        after = before.copy()
        own = self._poses[states]
        after[moved, 0] = (own[:, 0] + np.cos(own[:, 2]) * along)[moved]
        after[moved, 1] = (own[:, 1] + np.sin(own[:, 2]) * along)[moved]
        after[moved, 2] = (own[:, 2] + turned)[moved]
        self._state[env_ids], self._along[env_ids], self._turned[env_ids] = states, along, turned
        self.poses[env_ids] = after
        done = np.zeros((len(env_ids), 4))
        done[:, 2] = (after[:, 2] - before[:, 2] + math.pi) % (2 * math.pi) - math.pi
        heading = before[:, 2] + done[:, 2] / 2
        c, s = np.cos(heading), np.sin(heading)
        gap = after[:, :2] - before[:, :2]
        done[:, 0], done[:, 1] = c * gap[:, 0] + s * gap[:, 1], c * gap[:, 1] - s * gap[:, 0]
        return Motion(done, hit)

    def draw(self, place_index: np.ndarray, poses: np.ndarray) -> Frames:
        """The pictures of the states nearest to poses [K,4]."""
        states = self._nearest(np.asarray(place_index), np.asarray(poses))
        rgb = self._rgb[states]
        blank = np.zeros((len(states), *rgb.shape[2:]))
        return Frames(rgb, blank.astype(np.float32) if self._depth is None
                      else self._depth[states],
                      blank.astype(np.uint8) if self._labels is None else self._labels[states],
                      blank.astype(np.uint16))

    def features(self, place_index: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """The files' features [K,F] float32 of the pictures at poses [K,4] in places [K]."""
        assert self._features is not None  # `feature_size` says so
        return self._features[self._nearest(np.asarray(place_index), np.asarray(poses))]


def _joined(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """The rows of all scenes; None: some have none."""
    found = [part for part in parts if part is not None]
    return np.concatenate(found) if len(found) == len(parts) else None


SIMULATOR = GridSimulator
