"""The map of the policy `search`, costmap on it, and hypotheses of where the goal is."""

import math

import numpy as np
import pytest

import vn_nav.policy.search.searcher as searcher_module
from vn_nav.measured_ranges import Scan, Scanner, laser_scan
from vn_nav.policy.search.approach import arrives, best_move
from vn_nav.policy.search.costmap import Costmap
from vn_nav.policy.search.grid import CELL, SIDE, OccupancyGrid, on_robot
from vn_nav.policy.search.hypotheses import Hypotheses, Hypothesis, apart, on_map
from vn_nav.policy.search.look import BINS, COLUMNS, RANGE_EDGES, column_bearings
from vn_nav.policy.search.measured import free_of_points
from vn_nav.policy.search.rules import Rules
from vn_nav.policy.search.searcher import Searcher, Sight
from vn_nav.policy.search.way import decisions_along

BEARINGS = column_bearings(math.pi / 2)
MOVES = ((0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.0, math.pi / 6), (0.0, 0.0, -math.pi / 6))
FORWARD, BACKWARD, LEFT, RIGHT = range(4)


def one_hot(ranges):
    """Distributions [C,B] that are sure of ranges [C] m."""
    return np.eye(BINS)[np.searchsorted(RANGE_EDGES, ranges)]


def wall_ahead(distance):
    """Ranges [C] to a wall across the robot's way."""
    return distance / np.cos(BEARINGS)


def room(pose, half=2.0):
    """Ranges [C] in a square room about the origin, seen from a pose [3]."""
    angles = pose[2] + BEARINGS
    with np.errstate(divide='ignore'):
        x = (np.sign(np.cos(angles)) * half - pose[0]) / np.cos(angles)
        y = (np.sign(np.sin(angles)) * half - pose[1]) / np.sin(angles)
    return np.minimum(np.abs(x), np.abs(y))


def looked_around(grid=None, place=(0.0, 0.0)):
    """A grid that knows the room."""
    grid = grid or OccupancyGrid(0.25)
    for yaw in np.arange(12) * math.pi / 6:
        pose = np.array([*place, yaw])
        grid.add_footprint(pose)
        grid.add_ranges(pose, BEARINGS, one_hot(room(pose)), RANGE_EDGES)
    return grid


def sight(**changes):
    return Sight(**{'ranges': one_hot(np.full(COLUMNS, 3.0)), 'position': np.array([1.0, 0.0]),
                    'sigma': 0.3, 'heading': np.array([1.0, 0.0]), 'co_visible': 0.05,
                    'arrived': 0.01, **changes})


def test_a_wall_is_occupied_before_it_is_free_and_behind_it_is_unknown():
    grid = OccupancyGrid(0.25)
    for _ in range(3):
        grid.add_ranges(np.zeros(3), BEARINGS, one_hot(wall_ahead(2.0)), RANGE_EDGES)
    row, _ = grid.cell(0.0, 0.0)
    for x in (0.3, 1.0, 1.5):
        assert grid.log_odds[grid.cell(x, 0.0)] < -1 and not grid.unknown()[grid.cell(x, 0.0)]
    at = [grid.cell(x, 0.0) for x in np.arange(1.7, 2.4, CELL)]
    assert any(grid.obstacles()[cell] for cell in at)
    assert grid.unknown()[grid.cell(3.0, 0.0)] and grid.unknown()[grid.cell(-1.0, 0.0)]
    assert not grid.obstacles()[row, :grid.cell(1.5, 0.0)[1]].any()


def test_a_doubtful_range_marks_nothing_as_an_obstacle():
    grid = OccupancyGrid(0.25)
    grid.add_ranges(np.zeros(3), BEARINGS, np.full((COLUMNS, BINS), 1 / BINS), RANGE_EDGES)
    assert not grid.obstacles().any()


def test_where_the_robot_stood_is_free_and_where_it_was_stopped_is_not():
    grid = OccupancyGrid(0.25)
    grid.add_contact(np.zeros(3), 0.0)
    assert grid.obstacles()[grid.cell(0.3, 0.0)]
    for _ in range(3):  # no look clears a contact
        grid.add_ranges(np.zeros(3), BEARINGS, one_hot(wall_ahead(3.0)), RANGE_EDGES)
    assert grid.obstacles()[grid.cell(0.3, 0.0)]
    grid.add_footprint(np.array([0.3, 0.0, 0.0]))  # but standing there does
    assert not grid.obstacles()[grid.cell(0.3, 0.0)]


def test_the_map_moves_along_with_the_robot():
    grid = OccupancyGrid(0.25)
    grid.add_ranges(np.zeros(3), BEARINGS, one_hot(wall_ahead(2.0)), RANGE_EDGES)
    before = grid.log_odds[grid.cell(1.0, 0.0)]
    grid.add_footprint(np.array([11.0, 0.0, 0.0]))
    assert grid.origin[0] > -CELL * SIDE / 2
    assert grid.log_odds[grid.cell(1.0, 0.0)] == before < 0
    grid.add_footprint(np.array([40.0, 0.0, 0.0]))  # farther than its side: all is forgotten
    assert not grid.log_odds.any()


def test_costmap_keep_the_footprint_off_obstacles_and_go_round_them():
    grid = looked_around()
    costmap = Costmap(grid)
    assert costmap.passable[grid.cell(0.0, 0.0)] and not costmap.passable[grid.cell(1.9, 0.0)]
    goal = np.array([grid.cell(1.0, 0.0)])
    here = grid.cell(-1.0, 0.0)
    straight = costmap.cost_to_go(goal, np.zeros(1), here, through_unknown=False)[here]
    assert straight == pytest.approx(2.0, abs=0.15)
    for y in np.arange(-0.6, 0.61, CELL):  # a wall of contacts across the way
        grid.add_contact(np.array([-0.3, y, 0.0]), 0.0)
    costmap = Costmap(grid)
    around = costmap.cost_to_go(goal, np.zeros(1), here, through_unknown=False)[here]
    assert straight + 0.5 < around < straight + 3.0
    got, _ = costmap.free_length(np.array([-1.0, 0.0, 0.0]), 0.0, 1.5)
    assert got < 1.0
    assert costmap.free_length(np.array([-1.0, 0.0, 0.0]), math.pi / 2, 0.5)[0] == 0.5


def test_an_opening_in_the_wall_is_a_frontier_and_a_whole_room_has_none():
    assert len(Costmap(looked_around()).frontiers()[0]) == 0
    grid = OccupancyGrid(0.25)
    for yaw in np.arange(12) * math.pi / 6:
        pose = np.array([0.0, 0.0, yaw])
        ranges = room(pose)
        open_door = np.abs(np.sin(yaw + BEARINGS)) < 0.35
        ranges[open_door & (np.cos(yaw + BEARINGS) > 0)] = 7.0
        grid.add_footprint(pose)
        grid.add_ranges(pose, BEARINGS, one_hot(ranges), RANGE_EDGES)
    cells, head_start = Costmap(grid).frontiers()
    x = grid.origin[0] + (cells[:, 1] + 0.5) * CELL
    assert len(cells) and (x > 1.5).all() and (head_start > 0).all()


def test_what_looks_never_show_is_no_more_looked_for():
    grid = looked_around()
    row, column = grid.cell(1.0, 1.0)
    hole = slice(row - 1, row + 2), slice(column - 1, column + 2)
    grid.seen[hole] = 0  # no picture fills it
    assert grid.look_gains(np.zeros(3), np.array([math.pi / 4]), BEARINGS)[0] > 0
    grid.missed[hole] = 3
    assert grid.look_gains(np.zeros(3), np.array([math.pi / 4]), BEARINGS)[0] == 0
    assert not grid.unknown()[grid.cell(1.0, 1.0)]
    grid.forget_looks()
    assert grid.unknown()[grid.cell(1.0, 1.0)] and grid.obstacles().any()


def test_votes_merge_near_ones_count_more_and_misses_refute():
    own = Hypotheses()
    far = np.array([4.5, 0.5]), 1.2
    own.look(np.zeros(3), far[0], far[1], np.array([1.0, 0.0]), 0.9)
    near_pose = np.array([3.0, 0.0, 0.0])
    own.look(near_pose, np.array([1.0, 0.0]), 0.2, np.array([1.0, 0.0]), 0.95)
    assert len(own.all) == 1
    assert np.hypot(*(own.best().pose[:2] - (4.0, 0.0))) < 0.15  # the near look has the say
    weight = own.best().weight
    own.look(np.array([3.5, 0.0, 0.0]), np.zeros(2), 1.0, np.array([1.0, 0.0]), 0.05)
    assert own.best().weight == weight / 2
    own.look(np.zeros(3), np.array([-3.0, 0.0]), 0.5, np.array([-1.0, 0.0]), 0.99)
    assert len(own.all) == 2
    for _ in range(12):
        own.look(near_pose + [0.6, 0, 0], np.zeros(2), 1.0, np.array([1.0, 0.0]), 0.05)
    assert len(own.all) == 1 and own.best().pose[0] == pytest.approx(-3.0)


def test_each_attempt_in_vain_asks_for_more_evidence():
    own = Hypotheses()
    for _ in range(4):
        own.look(np.zeros(3), np.array([2.0, 0.0]), 0.3, np.array([1.0, 0.0]), 0.95)
    best = own.best()
    assert own.worth_trying(2.0) == [best]
    own.refute(best)
    best.weight = 2.9 * 2.0
    assert own.worth_trying(2.0) == []
    best.weight = 3.1 * 2.0
    assert own.worth_trying(2.0) == [best]


def test_where_the_robot_stood_and_saw_nothing_of_the_goal_counts_for_hardly_anything():
    own = Hypotheses()
    for likeliest, left in ((0.5, 0.25), (0.05, 0.02)):
        hypothesis = Hypothesis(np.zeros(3), 100.0, 1.0, likeliest=likeliest)
        own.refute(hypothesis)
        assert hypothesis.weight == 100.0 * left and hypothesis.likeliest == 0
    own.all = [hypothesis]
    own.look(np.zeros(3), np.zeros(2), 0.3, np.array([1.0, 0.0]), 0.9)
    fresh = Hypotheses()
    fresh.look(np.zeros(3), np.zeros(2), 0.3, np.array([1.0, 0.0]), 0.9)
    assert hypothesis.weight == pytest.approx(2.0 + fresh.best().weight / 2)


@pytest.mark.parametrize('goal, wanted, decisions', [
    ((0.5, 0.0, 0.0), FORWARD, 1), ((-0.5, 0.0, 0.0), BACKWARD, 1),
    ((0.0, 0.0, math.pi / 3), LEFT, 2), ((0.1, 0.0, 0.1), -1, 0)])
def test_the_last_metre_takes_place_and_heading_together(goal, wanted, decisions):
    costmap = Costmap(looked_around())
    move, worth = best_move(costmap.passable, costmap.clearance, costmap.grid.origin, np.zeros(3),
                            np.array(goal), np.array(MOVES), 0.03, np.ones(4, bool))
    assert move == wanted
    at_end = 1.0 if decisions == 0 else worth + 0.03 * decisions
    assert arrives(0.1, 0.0) - 0.02 < at_end <= 1.0


def test_a_hypothesis_behind_a_wall_is_not_approached_through_it():
    grid = looked_around()
    for y in np.arange(-2.0, 2.01, CELL):
        grid.add_contact(np.array([0.2, y, 0.0]), 0.0)
    costmap = Costmap(grid)
    _, worth = best_move(costmap.passable, costmap.clearance, grid.origin, np.zeros(3),
                         np.array([1.3, 0.0, 0.0]), np.array(MOVES), 0.03, np.ones(4, bool))
    assert worth < 0.01


def test_a_robot_that_gets_nowhere_stops_looking_about_and_passes_obstacles_closer(monkeypatch):
    drives = []
    monkeypatch.setattr(searcher_module, 'Costmap',
                        lambda *args, **more: (drives.append(more), Costmap(*args, **more))[1])
    own, last, odometry = searcher(), -1, np.zeros(3)
    for _ in range(2 * searcher_module.STUCK):  # it stands in a niche: nothing moves but its head
        last = own.step(sight(ranges=one_hot(room(odometry, 0.35))), last, odometry)
        if last in (LEFT, RIGHT):
            odometry = odometry + [0, 0, MOVES[last][2]]
        if own._decisions == searcher_module.STUCK - 1:
            assert not own._stuck_for
            drives.clear()
    assert {'off': searcher_module.TIGHT} in drives and own._stuck_for
    assert own.aim != 'look'
    narrow = OccupancyGrid(0.25)
    for side in (math.pi / 2, -math.pi / 2):  # 0.6 m between what it has touched
        narrow.add_contact(np.array([1.0, 0.0, 0.0]), side)
    cell = narrow.cell(1.0, 0.0)
    assert not Costmap(narrow).passable[cell]
    assert Costmap(narrow, off=searcher_module.TIGHT).passable[cell]


def test_decisions_along_a_way_are_its_moves_and_turns():
    straight = np.array([[0.1 * k, 0.0] for k in range(21)])
    right = math.pi / 2
    for yaw, heading, wanted in ((0.0, 0.0, 4), (right, 0.0, 7), (0.0, math.pi, 10)):
        assert decisions_along(straight, yaw, heading, 0.5, math.pi / 6) == pytest.approx(wanted)
    corner = np.concatenate([straight, [[2.0, 0.1 * k] for k in range(1, 11)]])
    assert decisions_along(corner, 0.0, right, 0.5, math.pi / 6) == pytest.approx(9)
    assert decisions_along(straight[:1], 0.0, right, 0.5, math.pi / 6) == pytest.approx(3)


def doubtful(robot, goal, **changes):
    """A look that gives a goal pose [3] less evidence than the robot follows."""
    gap = goal[:2] - robot[:2]
    c, s = math.cos(robot[2]), math.sin(robot[2])
    turn = goal[2] - robot[2]
    return sight(position=np.array([c * gap[0] + s * gap[1], c * gap[1] - s * gap[0]]),
                 heading=np.array([math.cos(turn), math.sin(turn)]), co_visible=0.65, sigma=0.5,
                 **changes)


def hall(budget, decisions=40, **rules):
    """A search in a hall of 10 m with a guess in a corner: its aims, and metres off the guess."""
    own = Searcher(MOVES, BEARINGS, RANGE_EDGES, 0.25, Rules(**rules))
    guess, pose, last = np.array([3.0, -3.0, -math.pi / 2]), np.zeros(3), -1
    aims, gaps = [], []
    for k in range(decisions):
        ranges = one_hot(room(pose, 5.0))
        seen = sight(ranges=ranges) if k else doubtful(pose, guess, ranges=ranges)
        last = own.step(seen, last, pose, remaining=None if budget is None else budget - k)
        dx, dy, turn = MOVES[last]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        pose = pose + [c * dx - s * dy, s * dx + c * dy, turn]
        aims.append(own.aim)
        gaps.append(apart(pose, guess)[0])
    return aims, gaps


def test_it_turns_back_to_its_best_guess_while_there_is_budget_for_it():
    aims, gaps = hall(40)
    begun = aims.index('follow')
    assert begun > 5 and set(aims[:begun]) <= {'look', 'explore'}  # not before it has to
    assert min(gaps) < 1.2 and gaps.index(min(gaps)) < 40  # there, with decisions left
    there = next(k for k, gap in enumerate(gaps) if gap < 1.2)
    assert set(aims[begun:there]) <= {'follow', 'approach'}  # it does not waver
    early, _ = hall(20)
    assert early.index('follow') < begun
    # Who does not know, has time, or may not, explores.
    for other in (hall(None), hall(10_000), hall(40, returns=False)):
        assert other == hall(None) and 'follow' not in other[0]


def test_a_guess_that_was_tried_in_vain_is_nothing_to_return_to():
    own = Hypotheses()
    own.look(np.zeros(3), np.array([2.0, 0.0]), 0.3, np.array([1.0, 0.0]), 0.65)
    own.look(np.zeros(3), np.array([-2.0, 0.0]), 0.3, np.array([1.0, 0.0]), 0.70)
    weak, best = own.all
    assert own.best() is own.best(untried=True) is best
    best.refuted = 1
    assert own.best() is best and own.best(untried=True) is weak


def test_a_way_that_becomes_no_shorter_is_given_up():
    own = Hypotheses()
    own.look(np.zeros(3), np.array([2.0, 0.0]), 0.3, np.array([1.0, 0.0]), 0.95)
    assert not any(own.best().is_stuck(cost) for cost in np.arange(9.0, 1.0, -0.5))
    assert [own.best().is_stuck(2.0) for _ in range(12)].count(True) == 1


def test_a_frontier_that_shows_nothing_is_given_up():
    own = searcher()
    last, odometry = -1, np.zeros(3)
    hole = own.grid.cell(1.6, 0.0)
    for _ in range(60):  # all of the room is seen, and a wall looks open that is none
        own.step(sight(ranges=one_hot(room(odometry))), last, odometry)
        own.grid.log_odds[hole[0] - 5:hole[0] + 6, hole[1]:hole[1] + 6] = -2
        own.grid.seen[hole[0] - 5:hole[0] + 6, hole[1]:hole[1] + 6] = 1
    assert (own.grid.missed == 3).any()


def test_a_look_is_put_on_the_map_by_the_robots_pose():
    pose = on_map(np.array([1.0, 2.0, math.pi / 2]), np.array([2.0, 0.5]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(pose[:2], [0.5, 4.0])
    assert apart(pose, np.array([0.5, 4.0, math.pi]))[1] < 1e-9


def searcher():
    return Searcher(MOVES, BEARINGS, RANGE_EDGES, 0.25)


def test_it_drives_to_what_it_recognises_turns_and_then_gives_the_place_up():
    own = searcher()
    pose, actions = np.zeros(3), []
    goal = np.array([1.5, 0.0, math.pi / 2])
    for _ in range(8):
        gap = goal[:2] - pose[:2]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turn = goal[2] - pose[2]
        action = own.step(sight(
            ranges=one_hot(room(pose)), position=np.array([c * gap[0] + s * gap[1],
                                                           c * gap[1] - s * gap[0]]),
            heading=np.array([math.cos(turn), math.sin(turn)]), co_visible=0.97),
            actions[-1] if actions else -1, pose)
        actions.append(action)
        move = MOVES[action]
        pose = pose + [c * move[0], s * move[0], move[2]]
        if apart(pose, goal)[0] < 0.4 and apart(pose, goal)[1] < 0.3:
            break
    assert own.aim == 'approach' and apart(pose, goal)[0] < 0.4 and apart(pose, goal)[1] < 0.3
    # It is there, and the pictures do not say so: it looks again, and then goes elsewhere.
    aims = []
    for _ in range(12):
        aims.append((own.step(sight(ranges=one_hot(room(pose)), position=np.zeros(2),
                                    co_visible=0.97, arrived=0.3), -1, pose), own.aim)[1])
    assert 'doubt' in aims and own.hypotheses.best().refuted >= 1


def test_without_odometry_it_counts_on_its_moves_and_sees_that_it_stood_still():
    own = searcher()
    own.step(sight(), -1, None)
    own.step(sight(), FORWARD, None)
    np.testing.assert_allclose(own.pose, [0.5, 0.0, 0.0])
    own.step(sight(), LEFT, None)
    own.step(sight(), FORWARD, None, unmoved=True)
    np.testing.assert_allclose(own.pose, [0.5, 0.0, math.pi / 6])
    assert own.grid.contacts.any()


def test_odometry_counts_by_its_changes_and_gaps_by_the_nominal_moves():
    own = searcher()
    own.step(sight(), -1, np.array([7.0, -3.0, math.pi / 2]))
    own.step(sight(), FORWARD, np.array([7.0, -2.6, math.pi / 2]))
    np.testing.assert_allclose(own.pose, [0.4, 0.0, 0.0], atol=1e-9)
    own.step(sight(), FORWARD, None)  # unknown here, and so is the way to the next one
    own.step(sight(), FORWARD, np.array([7.0, -1.5, math.pi / 2]))
    np.testing.assert_allclose(own.pose, [1.4, 0.0, 0.0], atol=1e-9)
    own.reset_odometry()
    own.step(sight(), LEFT, np.array([0.0, 0.0, 0.0]))
    own.step(sight(), FORWARD, np.array([0.45, 0.0, 0.0]))
    np.testing.assert_allclose(own.pose, [1.4 + 0.45 * math.cos(math.pi / 6), 0.225, math.pi / 6],
                               atol=1e-9)
    assert not own.grid.contacts.any()
    own.step(sight(), FORWARD, np.array([0.5, 0.0, 0.0]))
    assert own.grid.contacts.any()


def test_a_move_that_met_something_is_not_tried_again_there():
    own = searcher()
    last, odometry = -1, np.zeros(3)
    for _ in range(40):
        ranges = np.full(COLUMNS, 6.0)  # the pictures say that all is free, and nothing moves
        last = own.step(sight(ranges=one_hot(ranges)), last, odometry)
        if last in (LEFT, RIGHT):
            odometry = odometry + [0, 0, MOVES[last][2]]
    directions = [round(own[2] / (math.pi / 6)) % 12 for own in own._blocked]
    assert len(directions) == len(set(directions)) <= 12


def test_a_turn_that_was_not_done_is_not_tried_again_there():
    own, pose, asked = searcher(), np.zeros(3), [-1]
    for _ in range(10):  # whatever it looks for, it cannot turn right
        asked.append(own.step(sight(ranges=one_hot(room(pose))), asked[-1], pose))
        dx, _, dyaw = MOVES[asked[-1]]
        pose = pose + (dx * math.cos(pose[2]), dx * math.sin(pose[2]), max(dyaw, 0.0))
    assert asked[1] == RIGHT and asked.count(LEFT) > 4
    assert not any(asked[k] == asked[k + 1] == RIGHT for k in range(10))


def test_the_same_looks_make_the_same_decisions():
    def drive():
        own, rng = searcher(), np.random.default_rng(3)
        last, actions = -1, []
        for _ in range(20):
            ranges = one_hot(rng.uniform(0.5, 6.0, COLUMNS))
            last = own.step(sight(ranges=ranges, co_visible=rng.uniform()), last, None)
            actions.append(last)
        return actions
    assert drive() == drive()


def scanned(pose, half=2.0, ray=1.0, mount=(0.0, 0.0, 0.0), **changes):
    """A laser scan [deg of a ray] in a square room about the origin, from a robot's pose [3]."""
    at = on_robot(pose, mount)
    bearings = -math.pi + np.radians(ray) * np.arange(round(360 / ray))
    angles = at[2] + bearings
    with np.errstate(divide='ignore', invalid='ignore'):
        x = (np.sign(np.cos(angles)) * half - at[0]) / np.cos(angles)
        y = (np.sign(np.sin(angles)) * half - at[1]) / np.sin(angles)
    return laser_scan(np.fmin(np.abs(x), np.abs(y)), -math.pi, math.radians(ray), 0.1, 12.0,
                      mount)


def ring(grid, half=2.0):
    """Cells [K,2] of the walls of the square room."""
    along = np.arange(-half + 0.05, half, CELL)
    return [grid.cell(*place) for a in along for place in (
        (half + 0.03, a), (-half - 0.03, a), (a, half + 0.03), (a, -half - 0.03))]


@pytest.mark.parametrize('mount', [(0.0, 0.0, 0.0), (0.15, -0.1, math.pi), (-0.2, 0.0, 0.7)])
def test_a_scan_is_certain_all_around_wherever_the_sensor_sits(mount):
    grid, pose = OccupancyGrid(0.18), np.array([0.3, -0.4, 0.5])
    grid.add_scan(pose, scanned(pose, half=2.03, mount=mount), BEARINGS)
    assert np.mean([grid.obstacles()[cell] for cell in ring(grid)]) > 0.9  # one look
    within = np.arange(-1.7, 1.8, 0.2)
    inside = [grid.cell(x, y) for x in within for y in within]
    assert all(grid.measured[cell] and not grid.obstacles()[cell] for cell in inside)
    assert not grid.measured[grid.cell(2.6, 0.0)] and grid.uncharted()[grid.cell(2.6, 0.0)]


def test_a_scan_shows_where_something_stands_and_the_camera_alone_has_looked():
    grid, pose = OccupancyGrid(0.18), np.zeros(3)
    grid.add_scan(pose, scanned(pose, half=2.03), BEARINGS)
    ahead, behind = grid.cell(1.0, 0.0), grid.cell(-1.0, 0.0)
    assert not grid.unknown()[ahead] and grid.unknown()[behind]
    assert not grid.uncharted()[behind]  # it may drive there all the same
    costmap = Costmap(grid)
    assert costmap.passable[behind] and costmap.cost[behind] == costmap.cost[ahead] == 1
    back = grid.look_gains(pose, np.array([0.0, math.pi]), BEARINGS)
    assert back[0] < 0.1 < 2.0 < back[1]
    field = costmap.cost_to_go(np.array([behind]), np.zeros(1), grid.cell(0.0, 0.0),
                               through_unknown=False)
    assert field[grid.cell(0.0, 0.0)] == pytest.approx(1.0, abs=0.15)
    for yaw in np.arange(1, 12) * math.pi / 6:  # a full turn, and everything is looked at
        turned = np.array([0.0, 0.0, yaw])
        grid.add_scan(turned, scanned(turned, half=2.03), BEARINGS)
    assert not any(grid.unknown()[cell] for cell in (ahead, behind))
    assert len(Costmap(grid).frontiers()[0]) == 0


def test_infinity_is_free_floor_less_than_the_least_range_is_not_and_nan_says_nothing():
    nan, inf = math.nan, math.inf
    for value, free, hit in ((inf, 5.9, None), (-inf, None, 0.3), (nan, None, None),
                             (3.0, 2.8, 3.0), (7.0, 5.9, None)):
        grid = OccupancyGrid(0.18)
        grid.add_scan(np.zeros(3), laser_scan([value] * 41, -0.1, 0.005, 0.3, 12.0), BEARINGS)
        reach = grid.measured[grid.cell(0.0, 0.05)[0]]
        x = grid.origin[0] + CELL * (np.flatnonzero(reach) + 0.5)
        ends = [place for place in x if grid.obstacles()[grid.cell(place, 0.05)]]
        clear = [place for place in x if grid.log_odds[grid.cell(place, 0.05)] < 0]
        assert (max(clear, default=None) is None) == (free is None)
        assert free is None or max(clear) == pytest.approx(free, abs=0.15)
        assert (not ends) == (hit is None)
        assert hit is None or ends[0] == pytest.approx(hit, abs=0.1)
    own = searcher()  # a scan that says nothing is as good as none: the picture's ranges count
    own.step(sight(), -1, None, scan=laser_scan([nan] * 41, -0.1, 0.005, 0.3, 12.0))
    assert not own.grid.measured.any() and own.grid.log_odds.any()


def test_a_depth_camera_does_not_clear_what_it_looks_over():
    grid = OccupancyGrid(0.18)
    grid.log_odds[grid.cell(0.5, 0.0)] = 2.0  # a stool
    grid.log_odds[grid.cell(1.5, 0.0)] = 2.0
    scanner = Scanner(BEARINGS[::-1], 0.0, 8.0, clear_from=0.85)
    for _ in range(3):
        grid.add_scan(np.zeros(3), Scan(scanner, wall_ahead(3.0)[::-1].astype(np.float32)),
                      BEARINGS)
    assert grid.obstacles()[grid.cell(0.5, 0.0)] and not grid.obstacles()[grid.cell(1.5, 0.0)]
    assert not grid.uncharted()[grid.cell(0.3, 0.1)]


def test_with_a_scan_it_drives_round_what_the_pictures_do_not_show():
    def contacts(with_scan):
        own, pose, last, met = searcher(), np.array([-1.0, 0.0, 0.0]), -1, 0
        for _ in range(40):  # the pictures say that all is free
            relative = np.array([pose[0] + 1.0, pose[1], pose[2]])
            last = own.step(sight(ranges=one_hot(np.full(COLUMNS, 6.0))), last, relative,
                            scan=scanned(pose) if with_scan else None)
            move = MOVES[last]
            moved = pose + [math.cos(pose[2]) * move[0], math.sin(pose[2]) * move[0], move[2]]
            if np.abs(moved[:2]).max() > 2.0 - 0.25:
                met += 1
            else:
                pose = moved
        return met
    assert contacts(with_scan=True) == 0 < contacts(with_scan=False)


def test_a_scan_says_exactly_how_far_a_straight_line_is_free():
    grid, pose = OccupancyGrid(0.18), np.array([0.0, 0.0, 0.0])
    grid.add_scan(pose, scanned(pose, half=0.601, ray=0.5), BEARINGS)
    grid.log_odds[grid.obstacles()] = 0.0  # by the map all is free
    costmap = Costmap(grid)
    got, clear = costmap.free_length(pose, 0.0, 0.5)
    assert (got, clear) == pytest.approx((0.601 - 0.195, 0.195), abs=1e-3)
    assert costmap.free_length(pose, 0.0, 0.3)[0] == 0.3
    grid.add_ranges(pose, BEARINGS, one_hot(np.full(COLUMNS, 6.0)), RANGE_EDGES)
    assert grid.points is None  # what a scan has shown exactly is of its picture alone


@pytest.mark.parametrize(('points', 'length', 'got', 'clear'), [
    ([[1.0, 0.0]], 0.5, 0.5, 0.5), ([[0.6, 0.0]], 0.5, 0.4, 0.2),
    ([[0.4, 0.19]], 0.5, 0.3376, 0.2), ([[0.4, 0.21]], 0.5, 0.5, 0.21),
    ([[-0.1, 0.0], [-0.05, 0.1]], 0.5, 0.5, math.inf), ([[0.1, 0.0]], 0.5, 0.0, 0.1)])
def test_a_disc_gets_as_far_as_the_first_point(points, length, got, clear):
    turn = 0.7
    turned = np.array(points) @ [[math.cos(turn), math.sin(turn)],
                                 [-math.sin(turn), math.cos(turn)]]
    found = free_of_points(turned + [3.0, -2.0], 3.0, -2.0, turn, length, 0.2)
    assert found == pytest.approx((got, clear), abs=1e-4)
