"""A person with a joystick who shows a robot around a place: velocities alone, no actions.

The person sees the room, so the true pose and the floor map are known here. Places all over the
floor are visited one after the other, on curves that keep away from walls, and at each the robot
turns once around. Nobody steers like a machine: speeds differ, the hand is not quite still, turns
end a little early or late, and now and then the robot stands.
"""

from __future__ import annotations

import heapq
import math
import re
import zlib

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL, clearance
from vn_sim_bridge.floor.places import WalledPlace
from vn_sim_bridge.robot.simulated_robot import TICK

MAX_LINEAR, MAX_ANGULAR = 0.3, 0.8  # m/s, rad/s
LINEAR_RAMP, ANGULAR_RAMP = 0.4, 1.2  # m/s^2, rad/s^2 of a thumb on a stick
SLOWEST_DRIVE, SLOWEST_TURN = 0.22, 0.65  # m/s, rad/s, of the speeds that are drawn
COVER = 0.8  # of the spacing: how far, driving, the floor may lie from a place
LEFT_OVER = 0.1  # of a disc of that radius: less new floor is not worth a place
CANDIDATES = 3  # cells a side from one candidate for a place to the next
ROOM_TO_TURN = 0.08  # m that a place keeps from obstacles beyond what the floor map keeps
ELBOW_ROOM = 0.3  # m beyond the footprint below which the way avoids obstacles
AVOIDANCE = 4.0  # times the length, at an obstacle
LOOKAHEAD = 0.45  # m along the way that the person steers for
THERE, PASSED = 0.1, 0.3  # m to a place where the robot stops; where it only passes
LATE = math.radians(4.0)  # standard deviation of where a turn ends
PAUSE = 0.3  # probability of standing still after a turn
TREMOR = 0.1  # of a velocity: how much the hand takes away at times
STUCK = 1.5  # s without getting on, after which the robot backs off
BACKING = 0.8, -0.15  # s, m/s


class Joystick:
    """Drives one robot around a place.

    Args:
        place: that the person sees.
        x, y: where the robot stands [m].
        spacing: of the places [m], about one for each square of that side.
        turns: turn around at every place; else the robot only passes.
        seed: of the person.
        radius: of the robot's footprint [m].

    Attributes:
        places: [W,2] in the order in which they are visited [m].
        visited: how many have been; after the last one the way leads back, and counts on.
    """

    def __init__(self, place: WalledPlace, x: float, y: float, *, spacing: float = 1.0,
                 turns: bool = True, seed: int = 0,
                 radius: float = RobotSpec().footprint_radius):
        self._rng, self._turns = np.random.default_rng([seed, number_of(place.name)]), turns
        self._floor = place.floor
        self._gap = clearance(place.floor.origin, place.floor.free.shape, place.obstacle_rects
                              ) - radius
        places, fields = cover(place, self._gap, spacing)
        order = tour(places, fields, np.array([x, y]))
        self.places, self.visited = places[order], 0
        self._velocity, self._hand = np.zeros(2), np.zeros(2)  # vx [m/s], wz [rad/s]
        self._way: np.ndarray | None = None  # [K,2] to the next place
        self._to_turn = self._turned = 0.0  # rad, left: of the present turn, and done of it
        self._yaw: float | None = None  # before
        self._pause = self._backing = self._stuck = 0.0  # s
        self._nearest = math.inf  # m of the way that were left at best

    def velocity(self, pose: np.ndarray) -> np.ndarray:
        """What the stick says for the next tick.

        Args:
            pose: [3] true x, y [m], yaw [rad].

        Returns:
            [4] vx, vy [m/s], wz, tilt rate [rad/s], as in a Twist.
        """
        x, y, yaw = (float(value) for value in pose[:3])
        turned = 0.0 if self._yaw is None else float(wrap_angle(yaw - self._yaw))
        self._yaw = yaw
        if self._pause > 0:
            self._pause -= TICK
            wanted = np.zeros(2)
        elif self._backing > 0:
            self._backing -= TICK
            wanted = np.array([BACKING[1], 0.0])
        elif self._to_turn:
            wanted = self._turn(turned)
        else:
            wanted = self._drive(x, y, yaw)
        return self._move_stick(wanted)

    def _move_stick(self, wanted: np.ndarray) -> np.ndarray:
        self._hand = 0.95 * self._hand + 0.3 * self._rng.standard_normal(2)  # deviation about 1
        wanted = wanted * (1 - TREMOR * np.clip(np.abs(self._hand), 0, 1))
        step = np.array([LINEAR_RAMP, ANGULAR_RAMP]) * TICK
        self._velocity = self._velocity + np.clip(wanted - self._velocity, -step, step)
        return np.array([self._velocity[0], 0.0, self._velocity[1], 0.0])

    def _drive(self, x: float, y: float, yaw: float) -> np.ndarray:
        if self._way is None:
            self._set_out(x, y)
        assert self._way is not None  # it has set out
        self._way = self._way[int(np.argmin(np.hypot(*(self._way[:30] - (x, y)).T))):]
        left = math.hypot(*(self._way[0] - (x, y))) + CELL * (len(self._way) - 1)
        if left < (THERE if self._turns else PASSED):
            self._arrive()
            return self._velocity * (0.0 if self._turns else 1.0)
        if left < self._nearest - 0.02:
            self._nearest, self._stuck = left, 0.0
        ax, ay = self._ahead(x, y)
        aside = float(wrap_angle(math.atan2(ay - y, ax - x) - yaw))
        speed = self._speed * min(1.0, 0.4 + self._gap_at(x, y) / ELBOW_ROOM)
        if self._turns:  # it will stop there
            speed = min(speed, math.sqrt(2 * LINEAR_RAMP * max(left - THERE / 2, 0.005)))
        speed *= max(math.cos(aside), 0.0) ** 2 if abs(aside) < math.radians(50) else 0.0
        if speed > 0.02:  # turning first is no standstill
            self._stuck += TICK
            if self._stuck > STUCK + 0.3 / speed:
                self._back_off()
        return np.array([speed, float(np.clip(2.0 * aside, -MAX_ANGULAR, MAX_ANGULAR))])

    def _set_out(self, x: float, y: float) -> None:
        self._way = way(self._floor, self._gap, (x, y), self.places[self._next])
        self._speed = self._rng.uniform(SLOWEST_DRIVE, MAX_LINEAR)
        self._nearest, self._stuck = math.inf, 0.0

    @property
    def _next(self) -> int:
        """Index of the place that is driven to: there and back again."""
        count = len(self.places)
        if count == 1:
            return 0
        k = self.visited % (2 * count - 2)
        return k if k < count else 2 * count - 2 - k

    def _arrive(self) -> None:
        self.visited += 1
        self._way = None
        if self._turns:
            direction = 1 if self._rng.random() < 0.5 else -1
            self._to_turn = direction * (2 * math.pi + LATE * self._rng.standard_normal())
            self._turned = 0.0
            self._turn_speed = self._rng.uniform(SLOWEST_TURN, MAX_ANGULAR)

    def _turn(self, turned: float) -> np.ndarray:
        self._turned += turned
        left = abs(self._to_turn) - math.copysign(1.0, self._to_turn) * self._turned
        if left < math.radians(2):
            self._to_turn = 0.0
            if self._rng.random() < PAUSE:
                self._pause = self._rng.uniform(0.3, 0.8)
            return np.zeros(2)
        rate = min(self._turn_speed, math.sqrt(2 * ANGULAR_RAMP * left))
        return np.array([0.0, math.copysign(rate, self._to_turn)])

    def _back_off(self) -> None:
        """It touches something: back, and look for the way anew."""
        self._backing, self._way = BACKING[0], None

    def _ahead(self, x: float, y: float) -> np.ndarray:
        """The farthest point of the way, up to `LOOKAHEAD`, that a straight line leads to."""
        assert self._way is not None  # it drives along one
        choice = self._way[0]
        for point in self._way[1:round(LOOKAHEAD / CELL) + 1]:
            line = np.linspace((x, y), point, 6)[1:]
            if min(self._gap_at(*p) for p in line) < 0.5 * min(
                    ELBOW_ROOM, self._gap_at(*point), self._gap_at(x, y)):
                break
            choice = point
        return choice

    def _gap_at(self, x: float, y: float) -> float:
        """From the robot's rim to the nearest obstacle, if it stood there [m]."""
        i, j = _cell(self._floor, x, y)
        return float(self._gap[i, j])


def number_of(scene: str) -> int:
    """A number for the random draws in a scene: the one in its name, if there is one."""
    name = parse_scene(scene).place
    return int(name) if re.fullmatch(r'\d{1,18}', name) else zlib.crc32(scene.encode())


def cover(place: WalledPlace, gap: np.ndarray, spacing: float
          ) -> tuple[np.ndarray, list[FloorDistance]]:
    """Places from which all of the floor is near, except for what is left over in corners.

    Greedy: the next place is the one with the most floor within `COVER` spacings, driving, that no
    place before it has.

    Args:
        gap: [rows, columns] from a robot's rim to the nearest obstacle [m].

    Returns:
        [W,2] positions [m], and the distances to each.
    """
    cells = place.floor.centres()
    rows, columns = np.nonzero(place.floor.free)
    roomy = gap[rows, columns] >= ROOM_TO_TURN
    chosen = roomy & (rows % CANDIDATES == 0) & (columns % CANDIDATES == 0)
    candidates = cells[chosen if chosen.any() else roomy if roomy.any() else slice(None)]
    radius = COVER * spacing
    fields = [FloorDistance(place.floor, x, y) for x, y in candidates]
    near = np.array([field.at(cells) <= radius for field in fields])
    least = LEFT_OVER * math.pi * radius**2 / CELL**2
    open_floor = np.ones(len(cells), bool)
    picked: list[int] = []
    while True:
        gain = (near & open_floor).sum(axis=1)
        best = int(np.argmax(gain))
        if picked and gain[best] < least:
            return candidates[picked], [fields[k] for k in picked]
        picked.append(best)
        open_floor &= ~near[best]


def tour(places: np.ndarray, fields: list[FloorDistance], start: np.ndarray) -> list[int]:
    """A short order of places [W,2] from a start: the nearest next, then 2-opt.

    Args:
        fields: distances to each place.
        start: [2] m.
    """
    first = np.array([field.at(start[None])[0] for field in fields])
    between = np.array([field.at(places) for field in fields])
    order, left = [int(np.argmin(first))], set(range(len(places)))
    left.remove(order[0])
    while left:
        order.append(min(left, key=lambda k: between[order[-1], k]))
        left.remove(order[-1])

    def length(some: list[int]) -> float:
        return float(first[some[0]] + between[some[:-1], some[1:]].sum())

    best, better = length(order), True
    while better:
        better = False
        for i in range(len(order) - 1):
            for j in range(i + 2, len(order) + 1):
                other = order[:i] + order[i:j][::-1] + order[j:]
                if (metres := length(other)) < best - 1e-3:
                    order, best, better = other, metres, True
    return order


def way(floor, gap: np.ndarray, start: tuple[float, float], end: np.ndarray) -> np.ndarray:
    """A way over the floor map that keeps away from obstacles (Dijkstra, 1959).

    Args:
        floor: `FloorMap`; gap: as of `cover`.
        start, end: x, y [m].

    Returns:
        [K,2] points about a cell apart, from the start's cell to `end`.
    """
    cost = 1 + AVOIDANCE * np.clip(1 - gap / ELBOW_ROOM, 0, 1)
    source, target = _free_cell(floor, *end), _free_cell(floor, *start)
    rows, columns = floor.free.shape
    total, following, queue = {source: 0.0}, {}, [(0.0, source)]
    while queue:
        metres, cell = heapq.heappop(queue)
        if cell == target:
            break
        if metres > total[cell]:
            continue
        i, j = cell
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                a, b = near = i + di, j + dj
                # No cutting of corners: both cells beside a diagonal step are free.
                if not (0 <= a < rows and 0 <= b < columns and floor.free[near]
                        and floor.free[i, b] and floor.free[a, j]):
                    continue
                reached = metres + math.hypot(di, dj) * CELL * (cost[cell] + cost[near]) / 2
                if reached < total.get(near, math.inf):
                    total[near], following[near] = reached, cell
                    heapq.heappush(queue, (reached, near))
    cells = [target]
    while cells[-1] != source:
        cells.append(following[cells[-1]])
    points = np.array([(floor.origin[0] + (j + 0.5) * CELL, floor.origin[1] + (i + 0.5) * CELL)
                       for i, j in cells])
    points[-1] = end
    return points


def _cell(floor, x: float, y: float) -> tuple[int, int]:
    rows, columns = floor.free.shape
    return (min(max(int((y - floor.origin[1]) / CELL), 0), rows - 1),
            min(max(int((x - floor.origin[0]) / CELL), 0), columns - 1))


def _free_cell(floor, x: float, y: float) -> tuple[int, int]:
    """The free cell nearest to a point."""
    cell = _cell(floor, x, y)
    if floor.free[cell]:
        return cell
    rows, columns = np.nonzero(floor.free)
    nearest = int(np.argmin((rows - cell[0]) ** 2 + (columns - cell[1]) ** 2))
    return int(rows[nearest]), int(columns[nearest])
