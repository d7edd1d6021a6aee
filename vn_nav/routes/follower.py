"""Along a route, goal to goal: which of its pictures the robot is shown, and when the next one.

No ROS, no torch. As topological navigation does it (Shah et al. 2023, ViNT; Sridhar et al. 2024,
NoMaD): the robot finds itself among the pictures, and is shown one further along. Those have
learned how many steps away a picture is; here the policy's own eyes say what is in view, and where
it was taken. A robot that sees nothing of the route is shown the last goal, and searches for it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vn_nav.routes.recognition import Sighting

Look = Callable[[np.ndarray], Sighting]  # at the pictures of these numbers [R]

# Probability from which on a picture is in view. Of hundreds of pictures some look alike, and the
# one nearest to the target is chosen, so it has to be nearly certain (bench/route_looks.py).
SEEN = 0.97
LOCATED = 1.5  # that a picture and half of each neighbour have together
WINDOW = 10  # pictures to either side that are looked at, while the robot knows where it is
REACH_M = 3.0  # a picture farther away is no goal yet
PASS_M = 0.8  # so near a picture the next one is shown
LOOK_EVERY = 4  # decisions, while it has no idea where its goal is
MOST_DECISIONS = 60  # for one picture
PATIENCE, PATIENCE_EACH = 200, 4  # decisions, and more for each picture, until it searches
TRIES = 3  # pictures in a row that it does not reach, before it is shown the last one


class RouteFollower:
    """One way along a route.

    Args:
        count: pictures of the route.
        target: the one to go to.

    Attributes:
        here: the picture that it believes to be nearest; None: it does not know.
        shown: the one that it drives to.
        passed: how many it has been shown before.
    """

    def __init__(self, count: int, target: int):
        self.count, self.target = count, target
        self.here: int | None = None
        self.shown = target
        self.passed = -1
        self._failures = 0
        self._since = 0  # decisions for the picture shown, when it last looked
        self._decided = 0  # decisions on pictures before the target
        self._searches = False  # for the target, whatever it sees of the route

    def begin(self, look: Look) -> int:
        """The first picture to show."""
        self._locate(look)
        return self._show(self._further(look))

    def decided(self, decisions: int, distance: float | None, look: Look) -> int | None:
        """Another picture to show, after a decision; None: go on.

        Args:
            decisions: for the picture shown.
            distance: to where the policy takes it to be [m]; None: it does not know.
            look: at the route, from where the robot is.
        """
        if self._searches:
            return None
        if self.shown != self.target:
            self._decided += 1
            if self._decided > PATIENCE + PATIENCE_EACH * self.count:
                return self._search()
            if distance is not None and distance < PASS_M:
                return self.arrived(look)
            if decisions >= MOST_DECISIONS:
                return self.failed(look)
        if distance is not None:
            self._since = decisions
        elif decisions - self._since >= LOOK_EVERY:
            self._since = decisions
            self._locate(look)
            found = self._further(look)
            if self.here is not None and found != self.shown:
                return self._show(found)
        return None

    def arrived(self, look: Look) -> int:
        """The next picture: the one shown is reached."""
        self._failures = 0
        self.here = self.shown
        return self._beyond(self.shown, look)

    def failed(self, look: Look) -> int | None:
        """What to show after a picture that was not reached; None: the route is given up."""
        if self.shown == self.target:
            return None
        self._failures += 1
        missed, self.here = self.shown, None
        if self._failures == TRIES:
            return self._search()
        return self._beyond(missed, look)

    def _search(self) -> int:
        self._searches = True
        return self._show(self.target)

    def _beyond(self, number: int, look: Look) -> int:
        """Show one that lies behind a picture on the way: not that one again, nor one before."""
        self._locate(look)
        found, way = self._further(look), self._way(number)
        return self._show(found if (found - number) * way > 0 else number + way)

    def _show(self, number: int) -> int:
        self.shown, self._since = number, 0
        self.passed += 1
        return number

    def _way(self, number: int) -> int:
        """Which way along the route leads to the target: 1, -1, or 0 there."""
        return int(np.sign(self.target - number))

    def _locate(self, look: Look) -> None:
        """Find the robot among the pictures about it, else among all of them."""
        if self.here is not None:
            about = np.arange(max(self.here - WINDOW, 0), min(self.here + WINDOW + 1, self.count))
            found = _nearest(about, look(about))
            if found is not None:
                self.here = found
                return
        everything = np.arange(self.count)
        self.here = _nearest(everything, look(everything))

    def _further(self, look: Look) -> int:
        """The farthest picture on the way that is in view and in reach; at least the next one."""
        if self.here is None or self.here == self.target:
            return self.target
        step = self._way(self.here)
        ahead = np.arange(self.here + step, self.target + step, step)
        sighting = look(ahead)
        seen = sighting.co_visible >= SEEN
        # One alone may be of another place that looks alike; the way may come back to this one.
        beside = np.append(seen[1:], False) | np.insert(seen[:-1], 0, True)
        found = np.flatnonzero(seen & beside & (sighting.distance <= REACH_M))
        return int(ahead[found[-1] if len(found) else 0])


def _nearest(rows: np.ndarray, sighting: Sighting) -> int | None:
    """The nearest picture of where the route is recognised best; None: nowhere.

    A picture alone may be of a place that looks alike: its neighbours show the same place, too.
    """
    seen = np.pad(sighting.co_visible, 1, mode='edge' if len(rows) > 1 else 'constant')
    support = seen[1:-1] + (seen[:-2] + seen[2:]) / 2
    best = int(support.argmax())
    if support[best] < LOCATED:
        return None
    first = last = best
    while first > 0 and sighting.co_visible[first - 1] >= SEEN:
        first -= 1
    while last + 1 < len(rows) and sighting.co_visible[last + 1] >= SEEN:
        last += 1
    return int(rows[first + sighting.distance[first:last + 1].argmin()])
