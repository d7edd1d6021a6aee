"""What a network sees of a robot's map: crops about the robot, and numbers of the newest look.

All of it is made by the planner's own code from pictures and odometry: `MapSearcher` keeps the map
and the goal hypotheses of `vn_nav.policy.search` while something else chooses the actions.

Shapes: N robots, S side of a grid [cells], P = `PIXELS`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch

from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.search.costmap import Costmap
from vn_nav.policy.search.grid import CELL, KNOWN, MOST, OccupancyGrid
from vn_nav.policy.search.hypotheses import AGAIN, Hypotheses, Hypothesis, apart
from vn_nav.policy.search.look import (
    COLUMNS,
    RANGE_EDGES,
    Look,
    column_bearings,
    median_ranges,
)
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.searcher import Searcher
from vn_nav.policy.search.torch_eyes import TorchEyes

PIXELS = 32  # a side of a crop; the robot stands in its middle and looks up
SCALES = 0.15, 0.45  # m of a pixel: 4.8 m for the next moves, 14.4 m for where to go
GRID_LAYERS = ('obstacle', 'free', 'looked_at', 'been', 'contact')
GOAL_LAYERS = ('goal', 'goal_cos', 'goal_sin')  # evidence, and its share of the goal's heading
CHANNELS = len(SCALES) * (len(GRID_LAYERS) + len(GOAL_LAYERS))
MIDDLE = 128  # of 8 bits: nothing is known of an obstacle; a cosine or sine of 0
HALF_EVIDENCE = 2.0  # evidence that shows as a half: from here on the planner drives there
ACTIONS = 4
NUMBERS = 7 + COLUMNS + ACTIONS + 1 + 10


class Views(NamedTuple):
    """What N robots are shown."""

    maps: np.ndarray  # [N,CHANNELS,P,P] uint8
    numbers: np.ndarray  # [N,NUMBERS] float32
    advice: np.ndarray  # [N] int64, the planner's action; -1: it was not asked
    arrival: np.ndarray  # [N] float32, probability of having arrived


class MapSearcher(Searcher):
    """A searcher that somebody else drives: map and hypotheses as the planner's.

    Args:
        plans: decide as well. Else hypotheses are still doubted and refuted where the robot stands
            on them in vain; none is given up because the way to it grows no shorter, for there is
            no way to compare with.

    Attributes:
        touched: whether odometry says that the last move was stopped.
        resting: nobody asks for this robot any more; it stays as it is.
    """

    def __init__(self, *args, plans: bool, **options):
        self.plans, self.touched, self.resting = plans, False, False
        super().__init__(*args, **options)

    def reset(self) -> None:
        """Begin a search."""
        if not self.resting:
            super().reset()
            self.touched = False

    def step(self, sight, last_action, *args, **options) -> int:
        """As `Searcher.step`; -1 without plans, 0 where it rests."""
        if self.resting:
            return 0
        self._last = last_action  # what was done need not be what it said
        return super().step(sight, last_action, *args, **options)

    def _move(self, action, odometry, unmoved) -> None:
        before = len(self._blocked)
        super()._move(action, odometry, unmoved)
        self.touched = len(self._blocked) > before

    def _decide(self) -> int:
        if self.plans:
            return super()._decide()
        self._blocked = self._blocked[-20:]
        near = [own for own in self.hypotheses.worth_trying(self.rules.follow_from)
                if apart(self.pose, own.pose)[0] <= self.rules.near_m]
        costmap = Costmap(self.grid) if near else None
        for own in near:
            move, worth = self._approach(own, costmap)
            if worth >= self.rules.near_worth and move < 0:
                self._doubt(own)
        return -1


class MapDriver:
    """The eyes of a checkpoint, and a map for each robot.

    Args:
        network: what sees.
        num_envs: robots, N.
        plans: ask the planner for its action as well (two thirds of the time).
    """

    def __init__(self, network: SearchPolicy, num_envs: int, plans: bool):
        self._policy = BatchedPolicy(network, num_envs, decoding='greedy')
        config = network.config
        assert self._policy.search is not None and len(config.actions) == ACTIONS
        self.searchers = [MapSearcher(config.moves, column_bearings(config.view), RANGE_EDGES,
                                      config.footprint, plans=plans) for _ in range(num_envs)]
        self._policy.search.searchers[:] = self.searchers
        self._policy.search.eyes = TorchEyes(
            OpenEyes(network, self.searchers))  # type: ignore[arg-type]
        self._maps = np.zeros((num_envs, CHANNELS, PIXELS, PIXELS), np.uint8)

    def advise(self, observation: dict, goals: np.ndarray, reset: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
        """Enter a picture of each robot into its map, as `BatchedPolicy.act`.

        Returns:
            The planner's actions [N] and probabilities of having arrived [N].
        """
        return self._policy.act(observation, goals, reset), self._policy.arrival

    def look(self, observation: dict, goals: np.ndarray, reset: np.ndarray) -> Views:
        """As `advise`, and show the maps."""
        advice, arrival = self.advise(observation, goals, reset)
        for n, own in enumerate(self.searchers):
            if not own.resting:
                self._maps[n] = map_crops(own.grid, own.hypotheses, own.pose)
        numbers = numbers_of(self.searchers, np.where(reset, -1, observation['last_action']))
        return Views(self._maps.copy(), numbers, advice, arrival)


class OpenEyes:
    """The networks of a `SearchPolicy`, which do not look where robots rest."""

    def __init__(self, network: SearchPolicy, searchers: list[MapSearcher]):
        self._network, self._searchers = network, searchers
        self.config, self.taught = network.config, network.taught
        self.compute_dtype = network.compute_dtype

    def look(self, image: torch.Tensor, goal_maps: torch.Tensor) -> Look:
        """As `SearchPolicy.look`; zeros of the others."""
        rows = torch.tensor([not own.resting for own in self._searchers])
        seen = self._network.look(image[rows], goal_maps[rows])
        return Look(*(torch.zeros(len(image), *part.shape[1:]).index_put((rows,), part)
                      for part in seen))


def map_crops(grid: OccupancyGrid, hypotheses: Hypotheses, pose: np.ndarray) -> np.ndarray:
    """Crops [CHANNELS,P,P] uint8 of a map about a pose [3] on it; scale by scale, see above.

    Row 0 is ahead, column 0 to the left. Hypotheses beyond a crop are shown at its edge.
    """
    layers = grid_layers(grid)
    crops = []
    for metres in SCALES:
        turn = to_grid(grid.origin, pose, metres)
        cells = round(metres / CELL)
        for name, layer in zip(GRID_LAYERS, layers, strict=True):
            mean = cv2.blur(layer, (cells, cells)) if cells > 2 else layer
            crops.append(cv2.warpAffine(
                mean, turn, (PIXELS, PIXELS), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderValue=MIDDLE if name == 'obstacle' else 0))
        crops.extend(goal_layers(hypotheses, pose, metres))
    return np.stack(crops)


def grid_layers(grid: OccupancyGrid) -> list[np.ndarray]:
    """`GRID_LAYERS` of a map, [S,S] uint8 each."""
    obstacle = (MIDDLE + (MIDDLE - 1) / MOST * grid.log_odds).astype(np.uint8)
    obstacle[grid.stood] = 1
    obstacle[grid.contacts] = 255
    free = ((grid.seen >= KNOWN) | grid.stood | grid.measured) & ~grid.obstacles()
    return [obstacle, *(np.where(layer, np.uint8(255), np.uint8(0))
                        for layer in (free, ~grid.unknown(), grid.been, grid.contacts))]


def to_grid(origin: np.ndarray, pose: np.ndarray, metres: float) -> np.ndarray:
    """The affine map [2,3] from pixels of a crop to cells of a grid, both by their centres.

    Args:
        origin: [2] m of the grid's corner; pose: [3] of the robot; metres: of a pixel.
    """
    c, s, scale, middle = math.cos(pose[2]), math.sin(pose[2]), metres / CELL, (PIXELS - 1) / 2
    x, y = (pose[:2] - origin) / CELL - 0.5
    return np.array([[scale * s, -scale * c, x + scale * middle * (c - s)],
                     [-scale * c, -scale * s, y + scale * middle * (s + c)]])


def goal_layers(hypotheses: Hypotheses, pose: np.ndarray, metres: float) -> list[np.ndarray]:
    """`GOAL_LAYERS` about a pose [3], [P,P] uint8 each: a blob as wide as a hypothesis is sure."""
    offset = metres * ((PIXELS - 1) / 2 - np.arange(PIXELS))
    edge = offset[0]
    goal, cosine, sine = np.zeros((3, PIXELS, PIXELS))
    for own in hypotheses.all:
        ahead, left, turn = relative(own.pose, pose)
        sigma = max(metres, min(own.precision ** -0.5, 0.5))
        blob = strength(own) * np.exp(-(
            (offset[:, None] - np.clip(ahead, -edge, edge)) ** 2
            + (offset[None] - np.clip(left, -edge, edge)) ** 2) / (2 * sigma**2))
        more = blob > goal
        goal[more], cosine[more] = blob[more], math.cos(turn) * blob[more]
        sine[more] = math.sin(turn) * blob[more]
    return [(255 * goal).astype(np.uint8), *(
        (MIDDLE + (MIDDLE - 1) * part).astype(np.uint8) for part in (cosine, sine))]


def relative(other: np.ndarray, pose: np.ndarray) -> tuple[float, float, float]:
    """Ahead [m], left [m] and turn [rad] of another pose [3], seen from a pose [3]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = other[:2] - pose[:2]
    return c * dx + s * dy, c * dy - s * dx, float(other[2] - pose[2])


def strength(own: Hypothesis) -> float:
    """Evidence of a hypothesis, less what attempts in vain ask for, from 0 to 1."""
    weight = own.weight / AGAIN**own.refuted
    return weight / (weight + HALF_EVIDENCE)


def numbers_of(searchers: list[MapSearcher], last_action: np.ndarray) -> np.ndarray:
    """[N,NUMBERS] float32: the newest look, ranges, last action [N], the best hypothesis."""
    seen = [own.seen for own in searchers]
    ranges = torch.from_numpy(np.stack([sight.ranges for sight in seen]))
    medians = np.log(median_ranges(ranges.clamp(min=1e-9).log().numpy()))
    rows = []
    for own, sight, action, median in zip(searchers, seen, last_action, medians, strict=True):
        best = max(own.hypotheses.all, key=strength, default=None)
        guess = np.zeros(10)
        if best is not None:
            ahead, left, turn = relative(best.pose, own.pose)
            far, bearing = math.hypot(ahead, left), math.atan2(left, ahead)
            guess[:] = (1, ahead / 5, left / 5, min(far, 3) / 3, math.cos(bearing),
                        math.sin(bearing), math.cos(turn), math.sin(turn), strength(best),
                        min(best.refuted, 3) / 3)
        rows.append(np.concatenate([
            sight.position / 3, [math.log(sight.sigma)], sight.heading,
            [sight.co_visible, sight.arrived], median, np.arange(ACTIONS) == action,
            [own.touched], guess]))
    return np.array(rows, np.float32)
