"""Drives robots that search: `Eyes` see, a `Searcher` for each robot decides."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from vn_nav.lens import SAME, bearings_through
from vn_nav.measured_ranges import Scan, laser_scan
from vn_nav.policy.action_filter import UNCHANGED_GREY_LEVELS, thumbnails
from vn_nav.policy.search.costmap import Costmap
from vn_nav.policy.search.eyes import Eyes
from vn_nav.policy.search.key_pictures import KeyPictures, Mode
from vn_nav.policy.search.lens import in_metres, ranges_in_metres
from vn_nav.policy.search.local_features import compare
from vn_nav.policy.search.look import (
    BINS,
    COLUMNS,
    RANGE_EDGES,
    Look,
    column_bearings,
    goal_ranges,
)
from vn_nav.policy.search.recall import Recall
from vn_nav.policy.search.registration import Registration
from vn_nav.policy.search.searcher import Searcher, Sight
from vn_nav.policy.search.verification import verified
from vn_nav.policy.search.views import Pair


class SearchDriver:
    """Of N robots.

    Args:
        eyes: what sees.
        num_envs: robots, N.
        pitch: down, of the cameras [rad]; where local features are given alone.
        max_decisions: of an episode; None: nobody knows.

    Attributes:
        max_decisions: as given.
        searchers: [N], with map and hypotheses of each robot.
        recalls: [N], what each recalls of the place that the policy was taught; None: of none.
        arrival: [N] float32 probability that the robots have arrived, at the newest pictures.
    """

    def __init__(self, eyes: Eyes, num_envs: int, pitch: float = 0.0,
                 max_decisions: int | None = None):
        config = eyes.config
        self.eyes, self._pitch = eyes, pitch
        self._bearings = bearings = column_bearings(config.view)
        self.searchers = [Searcher(config.moves, bearings, RANGE_EDGES, config.footprint,
                                   eyes.rules)
                          for _ in range(num_envs)]
        place = eyes.taught
        self._keys = None if place is None else KeyPictures(eyes, place)
        self.recalls = None if place is None or self._keys is None else [
            Recall(place, self._keys) for _ in range(num_envs)]
        self._goal: tuple[np.ndarray, list[Mode]] | None = None
        self.arrival = np.full(num_envs, np.nan, np.float32)
        self._before: np.ndarray | None = None
        self.max_decisions = max_decisions
        self._renewed = np.zeros(num_envs, bool)  # another goal, and the map stays
        self._decided = np.zeros(num_envs, np.int64)  # in these episodes
        self._compile(Searcher(config.moves, bearings, RANGE_EDGES, config.footprint))

    @staticmethod
    def _compile(searcher: Searcher) -> None:
        """Decide a little: else the first decision on a robot would be seconds late."""
        # A goal that is nowhere, far and near: it explores, follows a guess, approaches it.
        for co_visible, away in ((0.0, 1.0), (0.99, 2.5), (0.99, 1.0)):
            searcher.reset()
            searcher.registration = Registration(
                searcher.bearings, np.full((COLUMNS, BINS), 1 / BINS))
            sight = Sight(np.eye(BINS, dtype=np.float32)[np.full(COLUMNS, BINS - 8)],
                          np.array([away, 0.0]), 0.3, np.array([1.0, 0.0]), co_visible, 0.0)
            for action in (-1, int(np.argmax(searcher.moves[:, 0]))):  # the second meets something
                searcher.step(sight, action, np.zeros(3))
            searcher.step(sight, -1, np.zeros(3), scan=laser_scan(np.ones(4), 0.0, 1.0, 0.1, 2.0))
        Costmap(searcher.grid).free_length(searcher.pose, 0.0, 0.5)  # of moves aside and back

    def prepare(self, goal_maps: np.ndarray) -> None:
        """Look for a goal [1,...] in the taught place now, so that the first `act` need not."""
        if self._keys is not None:
            self._goal = goal_maps, self._keys.poses_of_goal(goal_maps)

    def new_goals(self) -> None:
        """The next pictures begin searches for other goals, with the maps as they are.

        A robot without odometry begins an empty map: its last action may have been cut off.
        """
        self._renewed[:] = True

    def _poses_of_goal(self, keys: KeyPictures, goal_maps: np.ndarray) -> list[Mode]:
        if self._goal is not None and np.array_equal(goal_maps, self._goal[0]):
            return self._goal[1]
        return keys.poses_of_goal(goal_maps)

    def act(self, image: np.ndarray, goal_maps: np.ndarray, last_action: np.ndarray,
            starts: np.ndarray, odometry: np.ndarray | None,
            scans: Sequence[Scan | None] | None = None, zoom: float = 1.0,
            pairs: Sequence[Pair | None] | None = None) -> np.ndarray:
        """Actions [N] int64.

        Args:
            image: [N,3,S,S] uint8.
            goal_maps: [N,...] float32 of `Eyes.encode_goals`, of each robot's goal.
            last_action: [N], -1: none.
            starts: [N] bool, where an episode begins: map and hypotheses are empty.
            odometry: [N,3] x, y [m], yaw [rad]; None: nobody has any.
            zoom: how many times the lens of pictures and goals magnifies, see `lens`.
            scans: [N] measured ranges; None: of nobody, or not of this robot at this picture.
            pairs: [N] local features of full pictures, which verify what the network sees; None:
                of nobody, or not of this robot.

        Raises:
            FloatingPointError: what the networks say is not finite.
        """
        look = self.eyes.look(image, goal_maps)
        if not all(np.isfinite(part).all() for part in look):
            raise FloatingPointError('what the policy sees is not finite')
        sights = sights_of(in_metres(look, self._bearings, zoom))
        bearings = bearings_through(self._bearings, zoom)
        small = thumbnails(image)
        still = (np.zeros(len(image), bool) if self._before is None
                 else np.abs(small - self._before).mean(1) < UNCHANGED_GREY_LEVELS)
        self._before = small
        actions = np.empty(len(image), np.int64)
        for n, (searcher, sight) in enumerate(zip(self.searchers, sights, strict=True)):
            begins = bool(starts[n] or self._renewed[n])
            if begins:
                keeps = self._renewed[n] and not starts[n] and odometry is not None
                searcher.new_goal() if keeps else searcher.reset()
                self._renewed[n], self._decided[n] = False, 0
                ranges = ranges_in_metres(goal_ranges(goal_maps[n:n + 1]), self._bearings, zoom)
                searcher.registration = Registration(bearings, np.exp(ranges[0]))
            pair = None if pairs is None else pairs[n]
            if pair is not None:
                sight = verified(sight, compare(pair.own, pair.goal, self._pitch))
            recall = None
            # Through another lens the key pictures look different.
            if self.recalls is not None and self._keys is not None and (
                    abs(zoom / self.recalls[n].place.zoom[0] - 1) < SAME):
                own = self.recalls[n]
                if begins:
                    (own.new_goals if keeps else own.begin)(
                        self._poses_of_goal(self._keys, goal_maps[n:n + 1]))
                recall = functools.partial(own.look, image=image[n:n + 1])
            searcher.bearings = bearings
            actions[n] = searcher.step(sight, -1 if begins else int(last_action[n]),
                                       None if odometry is None else odometry[n],
                                       unmoved=bool(still[n]) and not begins,
                                       scan=None if scans is None else scans[n], recall=recall,
                                       remaining=None if self.max_decisions is None else
                                       self.max_decisions - int(self._decided[n]))
            self._decided[n] += 1
            self.arrival[n] = searcher.arrival
        return actions


def sights_of(look: Look) -> list[Sight]:
    """What is seen of each picture, as probabilities."""
    ranges = np.exp(look.ranges)
    co_visible, arrived = ((1 + np.tanh(part / 2)) / 2 for part in (look.co_visible, look.arrived))
    return [Sight(ranges[n], look.position[n], float(look.position_sigma[n]), look.heading[n],
                  float(co_visible[n]), float(arrived[n])) for n in range(len(ranges))]
