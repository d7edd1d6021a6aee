"""Tasks as pure functions and small classes: goals, starts, success, rewards; no pixels.

| task | goal picture | success |
|---|---|---|
| `image` | a view in the place | at the pose it was taken from |
| `object` | an object, taken elsewhere | within 1 m of it, wherever it was put (thesis, 5.6) |
| `room` | a view in a room of some type | in any room of that type (thesis, 5.7) |
| `collect` | none | none: apples +1, lemons -1 until the limit (thesis, 5.4) |
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

# The rule of arrival is part of this module for those who use tasks.
from vn_nav.arrival import (  # noqa: F401
    ARRIVAL_HEADING,
    ARRIVAL_RADIUS,
    OBJECT_RADIUS,
    arrived,
    heading_error,
    wrap_angle,
)
from vn_nav.errors import UserError
from vn_sim_bridge.counter_random import Stream, uniform
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.places import RoomPlace
from vn_sim_bridge.navigation.episodes import (
    GoalField,
    Starts,
    draw_absent_goal,
    draw_goal,
    draw_index,
    draw_wrong_goal,
)
from vn_sim_bridge.simulator import Distance, Goal, Place, Placed, StraightDistance

COLLECT_RADIUS = 0.45  # m, straight: the robot's rim touches the fruit
VISIBLE_SHARE = 0.045  # of the picture that shows the room's objects (House3D)
VISIBLE_STEPS = 2  # decisions in a row
FIELDS_KEPT = 512  # of `ImageGoal`, 0.1 MB each; a thousand others take 0.7 s to solve again
# Goal pictures to show: the goal's; of another goal of the place; of another place; plain grey.
RIGHT, WRONG, ABSENT, BLANK = 'right', 'wrong', 'absent', 'blank'

# What tells a room's type, for the rule of House3D's code.
ROOM_OBJECTS = {
    'kitchen': ('counter', 'stove', 'fridge', 'sink', 'microwave'),
    'bathroom': ('toilet', 'bathtub', 'shower', 'washbasin'),
    'bedroom': ('bed', 'wardrobe', 'dresser', 'nightstand'),
    'living_room': ('sofa', 'tv', 'tv_stand', 'coffee_table', 'fireplace', 'piano'),
    'dining_room': ('table', 'chair'),
    'office': ('desk', 'whiteboard', 'bookshelf'),
    'hall': ('coat_rack', 'bench'),
}


def sparse_reward(success):
    """The thesis's reward: 1 at the goal, else 0. The only one that the network may see."""
    return np.asarray(success, np.float32)


def shaping_reward(before, after, collided, success=False, *, progress: float, collision: float,
                   step: float = 0.0, goal: float = 0.0):
    """Optional terms beside the sparse reward; they never reach the network.

    Args:
        before, after: geodesic distance to the goal around the decision [m]; where one of them is
            not finite, nothing is known of the progress.
        collided: [N] bool; success: [N] bool.
        progress: reward per metre of progress; collision: reward of a contact (negative).
        step: of a decision that does not reach the goal; goal: of one that does.
    """
    known = np.isfinite(before) & np.isfinite(after)
    gained = np.where(known, before, 0.0) - np.where(known, after, 0.0)
    return (progress * gained + collision * collided
            + np.where(success, goal, step)).astype(np.float32)


def room_classes(label_names: Sequence[str], kind: str,
                 objects: Mapping[str, Sequence[str]] = ROOM_OBJECTS) -> list[int]:
    """The classes that tell a room's type.

    Args:
        label_names: of the pictures.
        kind: of the room.
        objects: names of classes by type.

    Raises:
        UserError: a type that nobody knows objects of, or no object of it has a class.
    """
    wanted = objects.get(kind, ())
    found = [label for label, name in enumerate(label_names) if name in wanted]
    if not found:
        raise UserError('room_must_see needs classes of objects that tell the type of a room: '
                        + (', '.join(wanted) or f'it knows {", ".join(objects)}'),
                        kind, 'leave out room_must_see, or name the classes so')
    return found


def shows_room(labels: np.ndarray, classes: Sequence[int]) -> np.ndarray:
    """Whether pictures' labels [K,H,W] show enough of a room's objects, [K] bool."""
    return np.isin(labels, classes).mean(axis=(1, 2)) >= VISIBLE_SHARE


class View(NamedTuple):
    """A goal picture to take: where from, and what stands in the place meanwhile."""

    place: int
    pose: tuple[float, float, float, float]
    name: str  # of the goal, for people
    objects: tuple[Placed, ...] = ()


class Episode(NamedTuple):
    """What a task decides when an episode begins."""

    goal: int  # index of the view that names the true goal; -1: none
    shown: int  # index of the view that is shown; -1: none
    start: np.ndarray  # [4]
    field: Distance | None  # to the goal
    goal_yaw: float  # rad
    objects: tuple[Placed, ...] = ()


class Judgement(NamedTuple):
    """A task's verdict on N robots after a decision."""

    success: np.ndarray  # [N] bool: the episode ends well
    reward: np.ndarray  # [N] float32, sparse
    removed: np.ndarray  # [N,M] bool: objects that are gone now
    ended: np.ndarray | None = None  # [N] bool: the episode ends, well or not; None: `success`


class Situation(NamedTuple):
    """What a task may judge by."""

    acting: np.ndarray  # [N] bool: false on rows that are being reset
    distance: np.ndarray  # [N] geodesic, to the goal [m]
    heading_error: np.ndarray  # [N] rad
    poses: np.ndarray  # [N,4]
    labels: np.ndarray  # [N,H,W] uint8 or uint16, of the pictures
    object_model: np.ndarray  # [N,M] int64; -1: absent
    object_xy: np.ndarray  # [N,M,2] m
    declared: np.ndarray | None = None  # [N] bool: robots that say so; None: arriving is enough


class Task(Protocol):
    """Goals and rewards of N environments, of which i lives in place i modulo their number."""

    views: list[View]
    ranges: list[tuple[int, int]]  # first view and number of goals, by place
    models: tuple[str, ...]  # names of the objects that it places
    objects: int  # most objects at a time
    state: dict[str, np.ndarray]  # what changes from step to step

    def begin(self, env: int, place: int, counter: tuple[int, int, int], tau: float,
              mode: str) -> Episode:
        """A new episode of one environment; `mode` is which goal to show."""

    def judge(self, situation: Situation) -> Judgement:
        """Success and sparse reward after a decision."""


class _Pool:
    """The views of each place, side by side."""

    def __init__(self):
        self.views: list[View] = []
        self.ranges: list[tuple[int, int]] = []  # first view and their number, by place
        self.models: tuple[str, ...] = ()
        self.objects = 0
        self.state: dict[str, np.ndarray] = {}

    def pick(self, place: int, counter, mode: str, fixed: int | None = None) -> tuple[int, int]:
        """The true goal's view and the shown one (-1: blank)."""
        first, count = self.ranges[place]
        local = draw_goal(count, *counter) if fixed is None else fixed % count
        shown = first + local
        if mode == WRONG:
            shown = first + draw_wrong_goal(count, local, *counter)
        elif mode == ABSENT:
            shown = draw_absent_goal(self.ranges, place, *counter)
        return first + local, -1 if mode == BLANK else shown

    def nothing_removed(self, situation: Situation) -> np.ndarray:
        """[N,M] of False."""
        return np.zeros(situation.object_model.shape, bool)


class ImageGoal(_Pool):
    """To the pose from which a picture was taken (thesis, chapter 4)."""

    def __init__(self, places: Sequence[Place], num_envs: int, *, min_distance: float,
                 fixed_goals: bool = False):
        super().__init__()
        self.fixed_goals, self.places = fixed_goals, len(places)
        goals = []
        for index, place in enumerate(places):
            self.ranges.append((len(self.views), len(place.goals)))
            for goal in place.goals:
                self.views.append(View(index, goal.pose, goal.room))
                goals.append((place, goal))

        @functools.lru_cache(FIELDS_KEPT)
        def goal_field(view: int) -> GoalField:
            return GoalField(*goals[view], min_distance)

        self.goal_field = goal_field  # of a view

    def begin(self, env, place, counter, tau, mode) -> Episode:
        """Draw goal and start."""
        goal, shown = self.pick(place, counter, mode,
                                env // self.places if self.fixed_goals else None)
        entry = self.goal_field(goal)
        return Episode(goal, shown, entry.start(tau, *counter), entry.field, entry.goal.pose[2])

    def judge(self, situation) -> Judgement:
        """Arrival at the pose, declared if it has to be."""
        success = arrived(situation.distance, situation.heading_error) & situation.acting
        if situation.declared is not None:
            success &= situation.declared
        return Judgement(success, sparse_reward(success), self.nothing_removed(situation))


class ObjectGoal(_Pool):
    """To within 1 m of an object that lies somewhere else in every episode (thesis, 5.6)."""

    def __init__(self, places: Sequence[Place], num_envs: int, *, models: tuple[str, ...],
                 objects: int, pictures: int, min_distance: float, seed: int):
        super().__init__()
        self.places, self.models, self.objects = places, models, objects
        self.min_distance = min_distance + OBJECT_RADIUS
        self.pictures = pictures
        for index, place in enumerate(places):
            self.ranges.append((len(self.views), len(models)))
            for model, name in enumerate(models):
                for picture in range(pictures):
                    counter = (seed, -1 - index, model * 1000 + picture)
                    self.views.append(_portrait(index, place, model, name, counter))

    def pick(self, place, counter, mode, fixed=None) -> tuple[int, int]:
        """As `_Pool.pick`; every object has several pictures."""
        first, count = self.ranges[place]
        local = draw_goal(count, *counter)
        shown = draw_wrong_goal(count, local, *counter) if mode == WRONG else local
        seed, env, episode = counter
        picture = draw_index(self.pictures, seed, Stream.GOAL_VARIANT, env, episode, 1)
        right = first + local * self.pictures
        return right, -1 if mode == BLANK else first + shown * self.pictures + picture

    def begin(self, env, place, counter, tau, mode) -> Episode:
        """Draw the target, put it and other objects somewhere, draw the start."""
        goal, shown = self.pick(place, counter, mode)
        target = (goal - self.ranges[place][0]) // self.pictures
        others = [model for model in range(len(self.models)) if model != target]
        turn = draw_index(len(others), counter[0], Stream.OBJECT_KIND, *counter[1:]) if (
            others) else 0
        kinds = [target, *(others[turn:] + others[:turn])[:self.objects - 1]]
        placed = place_objects(self.places[place].starts()[0], kinds, counter)
        field = distance_to(self.places[place], placed[0].x, placed[0].y)
        starts = Starts(self.places[place], field, self.min_distance)
        return Episode(goal, shown, starts.draw(tau, *counter), field, 0.0, placed)

    def judge(self, situation) -> Judgement:
        """Close to the target."""
        success = (situation.distance <= OBJECT_RADIUS) & situation.acting
        return Judgement(success, sparse_reward(success), self.nothing_removed(situation))


class RoomGoal(_Pool):
    """Into any room of the picture's type (thesis, 5.7).

    Args:
        must_see: also require the rule of House3D's code: at least 4.5 % of the picture shows the
            room's objects, two decisions in a row.
        label_names: behind the labels that a robot sees; for `must_see` alone.
        room_objects: names of classes by type of room, likewise.

    Raises:
        UserError: a place without a room to go to. The kind '' is of rooms that are none.
    """

    def __init__(self, places: Sequence[RoomPlace], num_envs: int, *, must_see: bool,
                 min_distance: float, label_names: Sequence[str] = (),
                 room_objects: Mapping[str, Sequence[str]] | None = None):
        super().__init__()
        self.must_see = must_see
        self.kinds: list[str] = []  # of each view
        self.classes: dict[str, list[int]] = {}  # of the objects that tell a room's type
        self.inside: list[tuple] = []  # per place, kind: rectangles of the rooms
        self.fields: list[tuple[FloorDistance, Starts]] = []
        self.state = {'seen': np.zeros(num_envs, np.int64), 'goal': np.zeros(num_envs, np.int64)}
        for index, place in enumerate(places):
            by_kind: dict[str, list] = {}
            for room in place.rooms:
                if room.kind:
                    by_kind.setdefault(room.kind, []).append(room)
            shown = {goal.room for goal in place.goals}
            rows = [(kind, rooms, goal) for kind, rooms in by_kind.items()
                    for goal in place.goals
                    # of the first one that the robot can get into
                    if goal.room == next((r.name for r in rooms if r.name in shown), None)]
            if not rows:
                raise UserError('task room needs rooms of a type to go to', f'{place.name}: none',
                                'choose another scene')
            self.ranges.append((len(self.views), len(rows)))
            for kind, rooms, goal in rows:
                if must_see and kind not in self.classes:
                    self.classes[kind] = room_classes(label_names, kind,
                                                      room_objects or ROOM_OBJECTS)
                self.views.append(View(index, goal.pose, kind.replace('_', ' ')))
                self.kinds.append(kind)
                self.inside.append(tuple(room.rect for room in rooms))
                field = FloorDistance.to_rectangles(place.floor, [room.rect for room in rooms])
                self.fields.append((field, Starts(place, field, min_distance)))

    def begin(self, env, place, counter, tau, mode) -> Episode:
        """Draw a room type and a start outside it."""
        goal, shown = self.pick(place, counter, mode)
        self.state['seen'][env], self.state['goal'][env] = 0, goal
        field, starts = self.fields[goal]
        return Episode(goal, shown, starts.draw(tau, *counter), field, 0.0)

    def judge(self, situation) -> Judgement:
        """In such a room, and seeing it if the rule asks for it."""
        success = np.zeros(len(situation.acting), bool)
        for n in np.nonzero(situation.acting)[0]:
            goal = self.state['goal'][n]
            x, y = situation.poses[n, :2]
            inside = any(r.x0 <= x <= r.x1 and r.y0 <= y <= r.y1 for r in self.inside[goal])
            if self.must_see:
                sees = inside and shows_room(situation.labels[n:n + 1],
                                             self.classes[self.kinds[goal]])[0]
                self.state['seen'][n] = self.state['seen'][n] + 1 if sees else 0
                success[n] = self.state['seen'][n] >= VISIBLE_STEPS
            else:
                success[n] = inside
        return Judgement(success, sparse_reward(success), self.nothing_removed(situation))


class Collect(_Pool):
    """Apples are good, lemons are not, nothing is shown (thesis, 5.4: SeekAvoid)."""

    APPLE, LEMON = 0, 1

    def __init__(self, places: Sequence[Place], num_envs: int, *, models: tuple[str, ...],
                 objects: int):
        super().__init__()
        self.places, self.models, self.objects = places, models, objects
        self.ranges = [(0, 0)] * len(places)

    def begin(self, env, place, counter, tau, mode) -> Episode:
        """Scatter the fruit; half of it is sour."""
        kinds = [k % 2 for k in range(self.objects)]
        cells, headings = self.places[place].starts()
        placed = place_objects(cells, kinds, counter)
        index = draw_index(len(cells), counter[0], Stream.START_CELL, *counter[1:])
        cell = cells[index]
        yaw = ((uniform(counter[0], Stream.START_YAW, *counter[1:]) * 2 - 1) * math.pi
               if headings is None else headings[index])
        return Episode(-1, -1, np.array([*cell, float(yaw), 0.0]), None, 0.0, placed)

    def judge(self, situation) -> Judgement:
        """What the robot touches is eaten."""
        gap = situation.object_xy - situation.poses[:, None, :2]
        touched = ((np.hypot(gap[..., 0], gap[..., 1]) <= COLLECT_RADIUS)
                   & (situation.object_model >= 0) & situation.acting[:, None])
        value = np.where(situation.object_model == self.APPLE, 1.0, -1.0)
        reward = (touched * value).sum(axis=1).astype(np.float32)
        return Judgement(np.zeros(len(reward), bool), reward, touched)


def distance_to(place: Place, x: float, y: float) -> Distance:
    """To a point: over the floor where the place knows the ways, else the straight line."""
    goal = Goal((x, y, 0.0, 0.0), '')
    return place.distance_to(goal) or StraightDistance(goal)


def place_objects(cells: np.ndarray, kinds: list[int], counter: tuple[int, int, int]
                  ) -> tuple[Placed, ...]:
    """Objects at free cells [K,2] of a place, at least 0.8 m apart while there is room for it."""
    seed, env, episode = counter
    placed: list[Placed] = []
    for k, kind in enumerate(kinds):
        for attempt in range(20):
            cell = cells[draw_index(len(cells), seed, Stream.OBJECT_PLACE, env, episode,
                                    100 * k + attempt)]
            if all(math.hypot(p.x - cell[0], p.y - cell[1]) >= 0.8 for p in placed):
                break
        yaw = float(uniform(seed, Stream.OBJECT_PLACE, env, episode, 100 * k + 50)) * 2 * math.pi
        placed.append(Placed(kind, float(cell[0]), float(cell[1]), yaw))
    return tuple(placed)


def _portrait(index: int, place: Place, model: int, name: str, counter) -> View:
    """A picture of an object from 1 to 2 m, anywhere in a place."""
    cells, _ = place.starts()
    seed, env, episode = counter
    for attempt in range(40):
        (placed,) = place_objects(cells, [model], (seed, env, episode * 64 + attempt))
        gap = np.hypot(cells[:, 0] - placed.x, cells[:, 1] - placed.y)
        near = cells[(gap >= 1.0) & (gap <= 2.0)]
        if len(near) == 0:
            continue
        eye = near[draw_index(len(near), seed, Stream.OBJECT_PLACE, env, episode, 7000 + attempt)]
        walk = distance_to(place, placed.x, placed.y).at(eye[None])[0]
        if walk < 1.1 * math.hypot(eye[0] - placed.x, eye[1] - placed.y) + 0.05:  # in sight
            break
    yaw = math.atan2(placed.y - eye[1], placed.x - eye[0])
    return View(index, (float(eye[0]), float(eye[1]), yaw, math.radians(15)), name, (placed,))
