"""The simulator's half of `vn_nav teach`: a drive's pictures as a place to learn in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from vn_nav.robot import RobotSpec
from vn_sim_bridge.datasets.recorded_pairs import GraphPairs
from vn_sim_bridge.datasets.recorded_views import GraphViews
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import PRIVILEGED, EnvConfig
from vn_sim_bridge.recorded.image_graph import ImageGraph, build_graph
from vn_sim_bridge.simulators.recorded import RecordedSimulator

__all__ = ['build_graph', 'draw_map', 'held_out', 'make_env', 'make_pairs', 'make_views',
           'regrets']

SHARE, LEAST = 10, 2  # one goal in so many is held out, and at least so many are
STRETCH, STRETCHES = 10, 20  # one in so many stretches of so many pictures judges
PIXELS = 8  # a cell of the floor, in the map
BLOCKED, FLOOR, NODE, GOAL, OTHER = (  # colours, RGB
    (214, 216, 220), (250, 249, 245), (120, 128, 140), (42, 98, 201), (196, 87, 44))


def held_out(graph: ImageGraph) -> tuple[ImageGraph, ImageGraph | None]:
    """A place with the goals to learn, and with others to judge by; None: it has too few."""
    count = len(graph.goals)
    if count < 3 * LEAST:
        return graph, None
    # Goals come in an order that spreads them: so do some at even distances of it.
    others = np.linspace(1, count - 1, max(round(count / SHARE), LEAST)).astype(int).tolist()
    own = [k for k in range(count) if k not in others]
    return graph.with_goals(own), graph.with_goals(others)


def make_env(graph: ImageGraph, robot: RobotSpec, envs: int, *, privileged: tuple[str, ...] = (),
             draw: bool = True, light: bool = False, **options) -> NavigationEnv:
    """A `NavigationEnv` in a graph.

    Args:
        graph: the place, with the goals of the episodes.
        robot: with the policy's actions alone.
        envs: robots.
        privileged: outputs that are asked for; what any environment tells is none of them.
        draw, light: see `RecordedSimulator`.
        options: further fields of `EnvConfig`.
    """
    config = EnvConfig(
        num_envs=envs, size=graph.pictures.shape[-1], actions=robot.action_names,
        privileged=tuple(sorted(set(privileged) & set(PRIVILEGED))), **options)
    return NavigationEnv(config, robot,
                         simulator=RecordedSimulator(graph, envs, robot=robot, draw=draw,
                                                     light=light))


def make_pairs(own: ImageGraph, others: ImageGraph | None, robot: RobotSpec, seed: int
               ) -> tuple[GraphPairs, GraphPairs]:
    """Pairs to learn from, and pairs to judge by, towards goals that are held out."""
    rows = np.arange(len(own.poses))
    if others is None:
        return GraphPairs(own, robot, rows, seed), GraphPairs(own, robot, rows, seed + 1)
    return (GraphPairs(own, robot, np.setdiff1d(rows, others.goal_nodes), seed),
            GraphPairs(own, robot, others.goal_nodes, seed + 1))


def make_views(graph: ImageGraph, robot: RobotSpec, seed: int
               ) -> tuple[GraphViews, GraphViews]:
    """Pictures to know the place by, and others, stretches of the drive, to judge by."""
    judged = np.arange(len(graph.poses)) // STRETCH % STRETCHES == STRETCHES // 2
    return (GraphViews(graph, robot, np.flatnonzero(~judged), seed),
            GraphViews(graph, robot, np.flatnonzero(judged), seed + 1))


def regrets(graph: ImageGraph, poses: np.ndarray, until: float = math.inf,
            show: Callable[[float], None] = lambda share: None) -> np.ndarray:
    """What each first action costs more than the best, see `PoseMap.regrets_to`.

    Args:
        graph: the place.
        poses: [N,3] where ways begin.
        until: `time.monotonic()` after which no further goal is begun; the first goals are
            spread over the place as all of them are.
        show: is told the share of the goals that is done.

    Returns:
        [G,N,A] float16, from the poses to the first G of the goals, one at least.
    """
    found: list[np.ndarray] = []
    for goal in graph.goals:
        if found and time.monotonic() > until:
            break
        show(len(found) / len(graph.goals))
        found.append(graph.map.regrets_to(poses, goal.pose).astype(np.float16))
    return np.stack(found)


def draw_map(path: Path, own: ImageGraph, others: ImageGraph | None) -> None:
    """A map as PNG: floor, pictures, goals to learn (blue) and to judge by (orange); y upwards."""
    free = own.floor.free
    plan = np.where(free[:, :, None], np.array(FLOOR, np.uint8), np.array(BLOCKED, np.uint8))
    plan = np.ascontiguousarray(plan.repeat(PIXELS, axis=0).repeat(PIXELS, axis=1))

    def place(x: float, y: float) -> tuple[int, int]:
        x0, y0 = own.floor.origin
        return round((x - x0) / CELL * PIXELS), round((y - y0) / CELL * PIXELS)

    def arrow(pose, length: float, colour, width: int) -> None:
        tip = place(pose[0] + length * math.cos(pose[2]), pose[1] + length * math.sin(pose[2]))
        cv2.circle(plan, place(*pose[:2]), width, colour, -1, cv2.LINE_AA)
        cv2.line(plan, place(*pose[:2]), tip, colour, width, cv2.LINE_AA)

    for pose in own.poses:
        arrow(pose, 0.07, NODE, 1)
    for graph, colour in ((own, GOAL), (others, OTHER)):
        for goal in graph.goals if graph is not None else ():
            arrow(goal.pose, 0.25, colour, 3)
    cv2.imwrite(str(path), cv2.cvtColor(np.ascontiguousarray(plan[::-1]), cv2.COLOR_RGB2BGR))
