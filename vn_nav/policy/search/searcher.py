"""Searches a place for a goal: looks, maps, follows hypotheses of where it is, else explores.

One robot. Nothing here is learned: networks say what a picture shows (`look.Look`), this decides.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.measured_ranges import Scan
from vn_nav.policy.search.approach import best_move
from vn_nav.policy.search.costmap import ROOM, Costmap
from vn_nav.policy.search.grid import CELL, OccupancyGrid
from vn_nav.policy.search.hypotheses import MISS_BELOW, Hypotheses, Hypothesis, apart
from vn_nav.policy.search.lookahead import ENOUGH, best_turns, cost_at
from vn_nav.policy.search.registration import Registration
from vn_nav.policy.search.rules import Rules
from vn_nav.policy.search.way import decisions_along, way_down

# Decisions of exploring that show less new floor than this: where it leads there is none.
IDLE, IDLE_M2 = 12, 0.5
# So many decisions within so little space, and hardly any new floor: stuck.
STUCK, STUCK_M, STUCK_M2 = 24, 0.9, 1.0
TIGHT = 0.08  # m that obstacles are passed closer then
FORGET_EVERY = 60  # decisions
IN_VAIN = 2.5  # contacts of late: what it explores is out of reach
REGISTERED = 2  # hypotheses that are fitted to the map
BLOCKED_M, BLOCKED_RAD = 0.2, math.radians(20)  # a contact is remembered about its place


@dataclasses.dataclass
class Sight:
    """What the networks say of one picture, as probabilities."""

    ranges: np.ndarray  # [C,B]
    position: np.ndarray  # [2] m, of the goal in the robot's frame
    sigma: float  # m
    heading: np.ndarray  # [2] cos, sin
    co_visible: float
    arrived: float


class Searcher:
    """One robot's search for one goal.

    Args:
        moves: [A][3] dx, dy [m], dyaw [rad] of the actions.
        bearings: [C] rad of the columns of the ranges; edges: [B-1] m of their bins.
        footprint: radius of the robot [m].
        rules: numbers of the decisions.

    Attributes:
        pose: [3] x, y [m], yaw [rad] on the map.
        grid, hypotheses: what it knows.
        registration: fits the goal picture to the map; None: nobody has seen it.
        arrival: probability that the robot has arrived, by the newest picture.
        remaining: decisions that are left to it, the newest one included; None: nobody knows.
        aim: in a word, what it was about: 'follow', 'turn', 'explore', 'look' or 'lost'.
    """

    def __init__(self, moves: Sequence[Sequence[float]], bearings: np.ndarray, edges: np.ndarray,
                 footprint: float, rules: Rules | None = None):
        self.moves = np.array(moves, float)
        self.bearings, self.edges, self.footprint = bearings, edges, footprint
        self.rules = rules or Rules()
        self._forbidden = np.zeros(len(self.moves), bool)
        still = np.hypot(self.moves[:, 0], self.moves[:, 1]) < 1e-6
        self._left = int(np.argmax(np.where(still, self.moves[:, 2], -np.inf)))
        self._right = int(np.argmin(np.where(still, self.moves[:, 2], np.inf)))
        self._turn = float(self.moves[self._left, 2])
        self._drives = np.flatnonzero(~still)
        self._ahead = int(np.argmax(self.moves[:, 0]))
        self.reset()

    def forbid(self, actions: np.ndarray) -> None:
        """Never do these [A] bool: the base cannot."""
        self._forbidden = actions
        still = np.hypot(self.moves[:, 0], self.moves[:, 1]) < 1e-6
        self._drives = np.flatnonzero(~still & ~actions)

    def reset(self) -> None:
        """Begin a search: an empty map about the robot."""
        self.grid = OccupancyGrid(self.footprint)
        self.pose = np.zeros(3)
        self._odometry: np.ndarray | None = None
        self._blocked: list[np.ndarray] = []  # [3] places and directions of contacts
        self._unturned: list[tuple[np.ndarray, int]] = []  # [3] poses, and where it could not turn
        self.new_goal()

    def new_goal(self) -> None:
        """Search for another goal, from where the robot is on its map."""
        self.grid.forget_looks(prior=True)
        self.hypotheses = Hypotheses(self.rules.gathers, self.rules.refutes)
        self.registration: Registration | None = None
        self.aim, self.arrival = 'look', 0.0
        self.remaining: int | None = None
        self._returns = False  # the budget is just enough for the best guess
        self.seen: Sight | None = None
        self._last = -1
        self._known: list[float] = []  # m^2, at the decisions of exploring
        self._track: list[tuple[float, float, float]] = []  # x, y [m], m^2 known: the last ones
        self._contacts = 0.0  # of late, while it explored
        self._decisions, self._forgot, self._stuck_for = 0, -FORGET_EVERY, 0

    def step(self, sight: Sight, last_action: int, odometry: np.ndarray | None,
             unmoved: bool = False, scan: Scan | None = None,
             recall: Callable[[Searcher], None] | None = None,
             remaining: int | None = None) -> int:
        """The next action.

        Args:
            sight: of the newest picture.
            last_action: what was done before it; -1: nothing.
            odometry: [3] pose, if the robot has odometry; what counts is how it changes.
            unmoved: without odometry: the picture is as before the action.
            scan: measured where the picture was taken: the map takes it in place of the ranges
                that are seen.
            recall: brings to mind what is known of the place; called before the decision.
            remaining: decisions that are left, this one included; None: nobody knows.
        """
        self._move(last_action, odometry, unmoved)
        self.grid.add_footprint(self.pose)
        if scan is None or np.isnan(scan.ranges).all():
            self.grid.add_ranges(self.pose, self.bearings, sight.ranges, self.edges)
        else:
            self.grid.add_scan(self.pose, scan, self.bearings)
        self.hypotheses.look(self.pose, sight.position, sight.sigma, sight.heading,
                             sight.co_visible)
        self.arrival, self.seen, self.remaining = sight.arrived, sight, remaining
        if recall is not None:
            recall(self)
        self._register()
        action = self._decide()
        self._last = action
        return action

    def _register(self) -> None:
        """Say by the map where the likeliest hypotheses are."""
        if self.registration is None or not self.rules.registers:
            return
        for own in self.hypotheses.worth_trying(self.rules.follow_from)[:REGISTERED]:
            if not own.told:
                own.pose = self.registration.fit(self.grid, own.voted, own.precision)

    @property
    def goal_estimate(self) -> np.ndarray | None:
        """[3] x, y [m], yaw [rad] in the robot's frame of its best guess; None: there is none."""
        guesses = self.hypotheses.worth_trying(self.rules.follow_from)
        if not guesses:
            return None
        (dx, dy), yaw = guesses[0].pose[:2] - self.pose[:2], self.pose[2]
        c, s = math.cos(yaw), math.sin(yaw)
        return np.array([c * dx + s * dy, c * dy - s * dx,
                         wrap_angle(float(guesses[0].pose[2] - yaw))])

    def reset_odometry(self) -> None:
        """The next odometry is in another frame: the nominal move counts until then."""
        self._odometry = None

    def _move(self, action: int, odometry: np.ndarray | None, unmoved: bool) -> None:
        """Follow the robot on the map, and enter what stopped it."""
        before = self.pose
        move = self.moves[action] if action >= 0 else np.zeros(3)
        if odometry is not None and self._odometry is not None:
            last = self._odometry
            c, s = math.cos(last[2]), math.sin(last[2])
            dx, dy = odometry[:2] - last[:2]
            done = np.array([c * dx + s * dy, c * dy - s * dx,
                             wrap_angle(float(odometry[2] - last[2]))])
        else:
            done = np.zeros(3) if unmoved and np.hypot(*move[:2]) > 0 else move
        self._odometry = None if odometry is None else np.array(odometry, float)
        c, s = math.cos(before[2]), math.sin(before[2])
        self.pose = np.array([before[0] + c * done[0] - s * done[1],
                              before[1] + s * done[0] + c * done[1],
                              wrap_angle(before[2] + done[2])])
        if abs(done[2]) < 0.5 * abs(move[2]):
            self._unturned.append((self.pose.copy(), 1 if move[2] > 0 else -1))
        wanted = float(np.hypot(*move[:2]))
        if wanted > 0:
            if np.hypot(*done[:2]) < 0.75 * wanted:
                direction = before[2] + math.atan2(move[1], move[0])
                self.grid.add_contact(self.pose, direction)
                self._blocked.append(np.array([*self.pose[:2], direction]))
                self._contacts += 1

    def _decide(self) -> int:
        costmap = Costmap(self.grid)
        here = self.grid.cell(*self.pose[:2])
        for own in self.hypotheses.worth_trying(self.rules.follow_from):
            action = self._follow(own, costmap, here)
            if action is not None:
                return action
        action = self._return(costmap, here)
        if action is not None:
            return action
        # Where nothing is left to see, or the robot is stuck, it passes obstacles closer.
        self._watch()
        if not self._stuck_for:
            action = self._explore(costmap, here)
            if action is not None:
                return action
        tight = Costmap(self.grid, off=TIGHT)
        action = self._explore(tight, here, look=False)
        if action is not None:
            return action
        # All is seen: take the best guess, then look at everything again.
        best = self.hypotheses.best()
        if best is not None and (action := self._follow(best, costmap, here)) is not None:
            return action
        self.aim = 'lost'
        if self._decisions - self._forgot >= FORGET_EVERY:
            self._forgot = self._decisions
            self.grid.forget_looks()
        return self._away(Costmap(self.grid, off=TIGHT, felt=False))

    def _watch(self) -> None:
        """Notice that the robot has been about one place for too long and has seen nothing new."""
        self._decisions += 1
        self._contacts *= 0.95
        self._stuck_for = max(self._stuck_for - 1, 0)
        self._track.append((*self.pose[:2], self.grid.known_area()))
        if len(self._track) < STUCK:
            return
        track = np.array(self._track)
        spread = np.ptp(track[:, :2], axis=0).max()
        if (self.rules.unsticks and spread < STUCK_M
                and track[-1, 2] - track[0, 2] < STUCK_M2):
            self._stuck_for = STUCK
            self._blocked = self._blocked[-2:]
        self._track.pop(0)

    def _follow(self, own: Hypothesis, costmap: Costmap, here: tuple[int, int]) -> int | None:
        """Towards a hypothesis; None: there is no way, or the robot has been there."""
        gap, _ = apart(self.pose, own.pose)
        if gap <= self.rules.near_m:
            move, worth = self._approach(own, costmap)
            if worth >= self.rules.near_worth:
                if move >= 0:
                    self.aim = 'approach'
                    return move
                return self._doubt(own)
        field = self._field_to(own, costmap, here)
        if field is None:
            return None
        if own.is_stuck(float(field[here])):
            self.hypotheses.refute(own)
            return None
        self.aim = 'follow'
        return self._drive(field, costmap)

    def _field_to(self, own: Hypothesis, costmap: Costmap, here: tuple[int, int]
                  ) -> np.ndarray | None:
        """Cost to go to where the robot can stand about a hypothesis; None: nowhere."""
        row, column = self.grid.cell(*own.pose[:2])
        reach = 5
        rows, columns = np.mgrid[row - reach:row + reach + 1, column - reach:column + reach + 1]
        inside = (rows >= 0) & (columns >= 0) & (rows < len(costmap.passable)) & (
            columns < len(costmap.passable))
        cells = np.stack([rows[inside], columns[inside]], axis=1)
        far = np.hypot(*(cells - (row, column)).T)
        good = costmap.passable[cells[:, 0], cells[:, 1]] & (far <= reach)
        if not good.any():
            return None
        return costmap.cost_to_go(cells[good], 0.1 * 1.5 * far[good], here, through_unknown=True)

    def _return(self, costmap: Costmap, here: tuple[int, int]) -> int | None:
        """Towards the best guess, however weak, while the budget is enough to look there.

        None: there is time to explore, nobody knows the budget, or there is no guess left.
        """
        best = self.hypotheses.best(untried=True)
        if not self.rules.returns or self.remaining is None or best is None:
            self._returns = False
            return None
        if not self._returns:
            needed = self._decisions_to(best, costmap, here)
            self._returns = self.remaining <= self.rules.return_margin * needed < math.inf
        action = self._follow(best, costmap, here) if self._returns else None
        # Behind a guess that is given up there may be time to explore again.
        self._returns = action is not None
        return action

    def _decisions_to(self, own: Hypothesis, costmap: Costmap, here: tuple[int, int]) -> float:
        """Decisions that the robot takes to look from where a hypothesis is; inf: no way."""
        field = self._field_to(own, costmap, here)
        if field is None or not np.isfinite(field[here]):
            return math.inf
        way = self.grid.origin + CELL * (way_down(field, here)[:, ::-1] + 0.5)
        step = float(np.hypot(*self.moves[self._ahead, :2]))
        return decisions_along(way, float(self.pose[2]), float(own.pose[2]), step, self._turn) + 1

    def _approach(self, own: Hypothesis, costmap: Costmap) -> tuple[int, float]:
        """The move that brings the robot onto a near hypothesis, and what that is worth."""
        yaw = self.pose[2]
        ways = yaw + np.arctan2(self.moves[:, 1], self.moves[:, 0])
        still = np.hypot(self.moves[:, 0], self.moves[:, 1]) < 1e-6
        is_open = np.array([bool(s) or not self._is_blocked(angle)
                            for s, angle in zip(still, ways, strict=True)])
        is_open &= self._cut_off(costmap, ways, np.hypot(*self.moves[:, :2].T)) <= 0
        is_open &= ~self._cannot_turn(self.moves[:, 2]) & ~self._forbidden
        move, worth = best_move(costmap.passable, costmap.clearance, self.grid.origin, self.pose,
                                own.pose, self.moves, self.rules.decision_price, is_open)
        return int(move), float(worth)

    def _doubt(self, own: Hypothesis) -> int | None:
        """The robot stands where a hypothesis says, and the picture does not: look again, or not.

        None: it is given up.
        """
        own.doubted += 1
        own.likeliest = max(own.likeliest, self.arrival)
        assert self.seen is not None  # of this decision
        if own.doubted > self.rules.looks_in_doubt or self.seen.co_visible < MISS_BELOW:
            own.doubted = 0
            self.hypotheses.refute(own)
            return None
        self.aim = 'doubt'
        turn = wrap_angle(float(own.pose[2] - self.pose[2]))
        return self._left if turn > 0 else self._right

    def _explore(self, costmap: Costmap, here: tuple[int, int], look: bool = True) -> int | None:
        """Towards unknown floor, or, with `look`, a turn that shows some."""
        rules = self.rules
        turns = np.arange(-math.ceil(math.pi / self._turn), math.ceil(math.pi / self._turn) + 1)
        gains = self.grid.look_gains(self.pose, self.pose[2] + turns * self._turn, self.bearings)
        worth = np.minimum(rules.look_worth * gains, rules.look_most)
        price = rules.look_cost * np.abs(turns) - np.where(gains >= rules.look_from, worth, -99.0)
        price[(turns == 0) | (not look) | self._cannot_turn(turns)] = np.inf
        price += np.where(self._turns_back(turns), rules.back_cost, 0)
        best = int(np.argmin(price))
        cells, head_start = costmap.frontiers()
        drive = None
        if len(cells):
            most = head_start.max()
            field = costmap.cost_to_go(cells, most - head_start, here, through_unknown=False)
            away = field[here] - most
            if np.isfinite(away) and (price[best] > 50 or away < price[best]):
                if self._sees_nothing_new() or self._contacts >= IN_VAIN:
                    self._contacts = 0
                    row, column = way_down(field, here)[-1]
                    self.grid.give_up((int(row), int(column)), ROOM)
                drive = self._drive(field, costmap)
        if drive is not None:
            self.aim = 'explore'
            return drive
        if price[best] < 50:
            self.aim = 'look'
            return self._left if turns[best] > 0 else self._right
        return None

    def _sees_nothing_new(self) -> bool:
        """Whether exploring has shown hardly any floor for too long; asked once a decision."""
        known = self.grid.known_area()
        self._known.append(known)
        if len(self._known) <= IDLE or known - self._known[-1 - IDLE] > IDLE_M2:
            return False
        self._known.clear()
        return True

    def _drive(self, field: np.ndarray, costmap: Costmap) -> int | None:
        """The first action of turns and moves that lead on best; None: none does."""
        rules, most = self.rules, math.ceil(math.pi / self._turn)
        counts = np.arange(-most, most + 1)
        headings = self.pose[2] + counts * self._turn
        more = np.where(self._turns_back(counts), rules.back_cost, 0.0)
        more[[self._is_blocked(angle) for angle in headings]] = np.inf
        more[self._cannot_turn(counts)] = np.inf
        step = float(np.hypot(*self.moves[self._ahead, :2]))
        off = self._cut_off(costmap, headings, np.full(len(headings), step))
        more += np.where(off < (1 - ENOUGH) * step, rules.contact_cost * off, np.inf)
        prices = np.array([rules.turn_cost, rules.contact_cost, rules.graze_cost, rules.graze_m,
                           self.footprint])
        turns, best = best_turns(
            costmap.passable, costmap.clearance, costmap.metre, field, self.grid.origin, self.pose,
            self._turn, step, most, more, prices)
        chosen = self._ahead if turns == 0 else self._left if turns > 0 else self._right
        for action in self._drives:
            if action == self._ahead:
                continue
            dx, dy, _ = self.moves[action]
            length, angle = math.hypot(dx, dy), self.pose[2] + math.atan2(dy, dx)
            if self._is_blocked(angle):
                continue
            got, clear = costmap.free_length(self.pose, angle, length)
            if got <= ENOUGH * length:
                continue
            end = self.pose[:2] + got * np.array([math.cos(angle), math.sin(angle)])
            cost = (cost_at(field, self.grid.origin, end[0], end[1]) + got
                    + rules.contact_cost * (length - got) + rules.backward_cost
                    + rules.graze_cost * max(1 - (clear - self.footprint) / rules.graze_m, 0))
            if cost < best:
                best, chosen = cost, int(action)
        return int(chosen) if np.isfinite(best) else None

    def _cut_off(self, costmap: Costmap, angles: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Metres [K] by which a scan shows something in the way of straight lines from here."""
        return np.array([length - costmap.scanned_length(self.pose, angle, length)[0]
                         for angle, length in zip(angles, lengths, strict=True)])

    def _is_blocked(self, angle: float) -> bool:
        """Whether a move in this direction [rad] met something about here before."""
        here = np.array([*self.pose[:2], angle])
        return any(gap < BLOCKED_M and turn < BLOCKED_RAD
                   for gap, turn in (apart(here, own) for own in self._blocked))

    def _cannot_turn(self, turns: np.ndarray) -> np.ndarray:
        """Which numbers of turns begin with one that odometry says was not done about here."""
        ways = {way for pose, way in self._unturned
                if (off := apart(self.pose, pose))[0] < BLOCKED_M and off[1] < BLOCKED_RAD}
        return np.isin(np.sign(turns), list(ways))

    def _turns_back(self, turns: np.ndarray) -> np.ndarray:
        """Which numbers of turns begin by undoing the last action."""
        if self._last == self._left:
            return turns < 0
        return turns > 0 if self._last == self._right else np.zeros(len(turns), bool)

    def _away(self, costmap: Costmap) -> int:
        """Any move that seems possible; else a turn."""
        for action in self._drives:
            dx, dy, _ = self.moves[action]
            length = math.hypot(dx, dy)
            angle = self.pose[2] + math.atan2(dy, dx)
            free = not self._is_blocked(angle) and (
                costmap.free_length(self.pose, angle, length)[0] >= 0.9 * length)
            if free and (dx > 0 or self._last not in (self._left, self._right)):
                return int(action)
        right, left = self._cannot_turn(np.array([-1, 1]))
        if left != right:
            return self._left if right else self._right
        return self._right if self._last == self._right else self._left
