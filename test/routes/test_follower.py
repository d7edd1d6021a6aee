"""Which picture of a route comes next: a robot in a corridor of pictures, seen by ideal eyes."""

import numpy as np
import pytest

from vn_nav.routes.follower import MOST_DECISIONS, PASS_M, REACH_M, RouteFollower
from vn_nav.routes.recognition import Sighting

SPACING, VIEW = 0.5, 2.0  # m between pictures; as far as they are recognised


class Corridor:
    """Pictures every half metre, which are seen from up to two metres away.

    Args:
        count: pictures; alike: a picture that looks like another one everywhere.
    """

    def __init__(self, count=40, alike=None):
        self.count, self.alike, self.robot, self.looks = count, alike, 0.0, []

    def look(self, rows):
        self.looks.append(len(rows))
        gap = np.abs(SPACING * np.asarray(rows) - self.robot)
        seen = np.where(gap <= VIEW, 0.98, 0.03)
        if self.alike is not None:
            seen[np.asarray(rows) == self.alike] = 0.99
        return Sighting(seen, np.minimum(gap, VIEW))

    def nearest(self):
        return round(self.robot / SPACING)

    def drive(self, follower, blind=False):
        """Go to what is shown, until the target is reached; the pictures shown."""
        shown = [follower.begin(self.look)]
        for _ in range(200):
            goal = SPACING * follower.shown
            for decisions in range(1, MOST_DECISIONS + 1):
                self.robot += np.clip(goal - self.robot, -0.25, 0.25)
                gap = abs(goal - self.robot)
                if gap < 1e-9:
                    break
                found = follower.decided(decisions, None if blind and gap > 1 else gap, self.look)
                if found is not None:
                    shown.append(found)
                    break
            else:
                raise AssertionError('never there')
            if gap < 1e-9:
                if follower.shown == follower.target:
                    return shown
                shown.append(follower.arrived(self.look))
        raise AssertionError(f'without end: {shown}')


@pytest.mark.parametrize('start, target', [(0, 39), (39, 0), (10, 30), (20, 20), (5, 6)])
def test_it_goes_from_picture_to_picture(start, target):
    corridor = Corridor()
    corridor.robot = SPACING * start
    shown = corridor.drive(RouteFollower(40, target))
    assert shown[-1] == target and corridor.nearest() == target
    way = np.diff([start, *shown])
    assert (np.sign(way) == np.sign(target - start)).all()  # never back
    assert np.abs(way).max() * SPACING <= REACH_M + PASS_M
    assert len(shown) <= 1 + abs(target - start) / 2  # not each of them


def test_it_looks_about_itself_once_it_knows_where_it_is():
    corridor = Corridor(200)
    corridor.robot = 30.0
    corridor.drive(RouteFollower(200, 180))
    assert corridor.looks[0] == 200 and min(corridor.looks[1:]) <= 21


def test_where_the_way_comes_back_to_it_takes_the_short_cut():
    # 40 pictures out, 40 back beside them: what it sees is at both.
    class Loop(Corridor):
        def look(self, rows):
            rows = np.asarray(rows)
            return super().look(np.where(rows < 40, rows, 79 - rows))

    corridor = Loop(80)
    corridor.robot = 3.0
    follower = RouteFollower(80, 77)
    assert 70 <= follower.begin(corridor.look) <= 77 and follower.here == 6


def test_one_picture_that_looks_like_everything_leads_nowhere():
    corridor = Corridor(alike=33)
    corridor.robot = 2.0
    follower = RouteFollower(40, 20)
    follower.begin(corridor.look)
    assert follower.here == 4 and 4 < follower.shown <= 10


def test_a_robot_that_sees_nothing_is_shown_the_target_until_it_sees_something():
    corridor = Corridor()
    corridor.robot = 100.0
    follower = RouteFollower(40, 39)
    assert follower.begin(corridor.look) == 39 and follower.here is None
    assert all(follower.decided(k, None, corridor.look) is None for k in range(1, 30))
    corridor.robot = 3.0
    found = [follower.decided(k, None, corridor.look) for k in range(30, 36)]
    shown = [number for number in found if number is not None]
    assert shown and follower.here == 6 and 6 < shown[0] < 14


def test_what_is_reached_is_not_shown_again():
    corridor = Corridor()
    follower = RouteFollower(40, 39)
    shown = [follower.begin(corridor.look)]
    for _ in range(3):  # it says so from where it stands
        shown.append(follower.decided(1, PASS_M / 2, corridor.look))
    assert shown == sorted(set(shown))


def test_what_is_not_reached_is_passed_over_and_then_given_up():
    corridor = Corridor()
    follower = RouteFollower(40, 39)
    first = follower.begin(corridor.look)
    second, third = follower.failed(corridor.look), follower.failed(corridor.look)
    assert first < second < third < 39
    assert follower.failed(corridor.look) == 39 == follower.shown
    assert follower.failed(corridor.look) is None
    # One that is reached in between begins the count anew.
    follower = RouteFollower(40, 39)
    follower.begin(corridor.look)
    for _ in range(5):
        follower.failed(corridor.look)
        follower.failed(corridor.look)
        assert follower.arrived(corridor.look) < 39


def test_a_picture_takes_so_many_decisions_at_most_but_the_target_any_number():
    corridor = Corridor()
    follower = RouteFollower(40, 39)
    follower.begin(corridor.look)
    assert follower.decided(MOST_DECISIONS - 1, 1.5, corridor.look) is None
    assert follower.decided(MOST_DECISIONS, 1.5, corridor.look) is not None
    corridor.robot = 19.5
    follower = RouteFollower(40, 39)
    assert follower.begin(corridor.look) == 39
    assert follower.decided(10 * MOST_DECISIONS, 1.5, corridor.look) is None


def test_a_way_that_gets_nowhere_ends_in_a_search_for_the_target():
    corridor = Corridor()
    follower = RouteFollower(40, 39)
    follower.begin(corridor.look)
    shown = [follower.shown]
    # It is carried to and fro: what it is shown is never reached, and never long enough to fail.
    for k in range(500):
        corridor.robot = 3.0 * (k // 4 % 2)
        found = follower.decided(1 + k % 4, None if k % 4 == 3 else 2.0, corridor.look)
        if found is not None:
            shown.append(found)
    assert shown[-1] == 39 and follower.shown == 39
    assert follower.decided(1000, 2.0, corridor.look) is None
    assert follower.failed(corridor.look) is None


def test_without_an_idea_of_the_goal_it_finds_itself_anew():
    corridor = Corridor()
    shown = corridor.drive(RouteFollower(40, 39), blind=True)
    assert shown[-1] == 39


def test_a_route_of_one_picture():
    corridor = Corridor(1)
    follower = RouteFollower(1, 0)
    assert follower.begin(corridor.look) == 0 and follower.failed(corridor.look) is None
