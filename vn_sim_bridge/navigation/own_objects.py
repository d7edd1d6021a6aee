"""The task `object` where places have movable objects of their own, as AI2-THOR's rooms do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.navigation.episodes import Starts, draw_goal, draw_wrong_goal
from vn_sim_bridge.navigation.tasks import (
    BLANK,
    OBJECT_RADIUS,
    WRONG,
    Episode,
    Judgement,
    Situation,
    View,
    sparse_reward,
)
from vn_sim_bridge.simulator import Goal, Place


@runtime_checkable
class ObjectPlace(Place, Protocol):
    """A place with movable objects of its own."""

    @property
    def object_goals(self) -> Sequence[Goal]:
        """A view of each object that may be looked for, where the place has it at first."""

    @property
    def object_ids(self) -> Sequence[str]:
        """Their names in `Simulator.scatter`."""

    def distance_to_object(self, x: float, y: float) -> FloorDistance:
        """How far it is to an object that lies at x, y [m]."""


class OwnObjectGoal:
    """To within 1 m of an object that lies somewhere else in every episode (thesis, 5.6).

    Args:
        places: of the robots.
        scatter: see `Simulator.scatter`.
        min_distance: that a start keeps from where the task is solved [m].

    Raises:
        UserError: a place without such objects.
    """

    def __init__(self, places: Sequence[Place],
                 scatter: Callable[[int, int], Mapping[str, tuple[float, float]]], *,
                 min_distance: float):
        self.places: list[ObjectPlace] = []
        self.views: list[View] = []
        self.ranges: list[tuple[int, int]] = []
        self.models: tuple[str, ...] = ()
        self.objects = 0
        self.state: dict[str, np.ndarray] = {}
        self._scatter, self._min_distance = scatter, min_distance + OBJECT_RADIUS
        for index, place in enumerate(places):
            if not isinstance(place, ObjectPlace) or not place.object_goals:
                raise UserError('a place for the task object has objects that can be looked for',
                                place.name, 'choose another scene, or the task image')
            self.places.append(place)
            self.ranges.append((len(self.views), len(place.object_goals)))
            self.views += [View(index, goal.pose, goal.room) for goal in place.object_goals]

    def begin(self, env: int, place: int, counter: tuple[int, int, int], tau: float,
              mode: str) -> Episode:
        """Draw the target, scatter the objects, draw the start."""
        seed, number, episode = counter
        first, count = self.ranges[place]
        local = draw_goal(count, *counter)
        shown = draw_wrong_goal(count, local, *counter) if mode == WRONG else local
        at = self._scatter(env, int(key(seed, Stream.OBJECT_PLACE, number, episode)))
        here = self.places[place]
        name = here.object_ids[local]
        if name not in at:
            raise UserError('the objects of a place stay in it',
                            f'{name} is gone from {here.name}', 'report this scene')
        field = here.distance_to_object(*at[name])
        start = Starts(here, field, self._min_distance).draw(tau, *counter)
        return Episode(first + local, -1 if mode == BLANK else first + shown, start, field, 0.0)

    def judge(self, situation: Situation) -> Judgement:
        """Close to the target."""
        success = (situation.distance <= OBJECT_RADIUS) & situation.acting
        return Judgement(success, sparse_reward(success),
                         np.zeros(situation.object_model.shape, bool))
