"""A drive's pictures as a place: where a robot may be, what it sees there, and the environment."""

import dataclasses
import math

import numpy as np
import pytest
from corridor_drive import ROBOT, SIZE, corridor_graph, graph_of, line, show, spin

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.datasets.recorded_pairs import GraphPairs
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.recorded.image_graph import KEPT, build_graph
from vn_sim_bridge.recorded.lattice_graph import components
from vn_sim_bridge.recorded.open_poses import GAP, HEADING, TURNED_MOST
from vn_sim_bridge.simulators.house import HouseSimulator
from vn_sim_bridge.simulators.recorded import RecordedSimulator, turned
from vn_sim_bridge.teach_place import held_out, make_env, make_pairs

SLACK = CELL + HEADING


@pytest.fixture(scope='module')
def corridor():
    return corridor_graph()


def simulator(graph, *poses, **options):
    made = RecordedSimulator(graph, len(poses), robot=ROBOT, **options)
    made.place(np.arange(len(poses)), np.array([[*pose, 0.0] for pose in poses], float))
    return made


def test_the_floor_is_what_lies_beside_the_way(corridor):
    cells = corridor.floor.centres()
    aside = np.hypot(np.maximum(np.maximum(-cells[:, 0], cells[:, 0] - 4), 0), cells[:, 1])
    assert aside.max() <= 0.3 and len(cells) * CELL**2 > 0.9 * (4 * 0.6 + math.pi * 0.3**2)
    way = FloorDistance(corridor.floor, 0, 0).at(np.array([[4.0, 0.0]]))
    assert way[0] == pytest.approx(4, abs=0.1)
    wide = graph_of(line(4), spin(4, 0), spin(0, 0), margin=0.6)
    assert wide.floor.free.sum() > 1.8 * corridor.floor.free.sum()


def test_a_robot_sees_the_picture_taken_nearest_to_its_pose(corridor):
    made = simulator(corridor, *corridor.poses[[3, 40, 77]], draw=False)
    assert np.array_equal(made.observe().rgb, corridor.pictures[[3, 40, 77]])
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(0, 4, 60), rng.uniform(-0.2, 0.2, 60),
                             rng.uniform(-math.pi, math.pi, 60)])
    made = simulator(corridor, *poses, draw=False)
    made.observe()
    gap = np.hypot(*(poses[:, None, :2] - corridor.poses[None, :, :2]).transpose(2, 0, 1))
    turn = np.abs(wrap_angle(poses[:, None, 2] - corridor.poses[None, :, 2]))
    misfit = np.hypot(gap / 0.25, turn / math.radians(15))
    shown = np.argmin(np.hypot(*(made.seen_from[:, None, :2] - corridor.poses[None, :, :2])
                               .transpose(2, 0, 1)) + 1e-3 * misfit, axis=1)
    rows = np.arange(60)
    assert np.allclose(misfit[rows, shown], misfit.min(axis=1))
    assert np.array_equal(made.seen_from[:, 2], poses[:, 2])


def test_which_of_the_near_pictures_is_shown_is_drawn_by_the_key(corridor):
    made = simulator(corridor, *[(1.05, 0.02, 0.05)] * 64)
    keys = np.arange(64).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    first = made.observe(keys=keys).rgb
    assert np.array_equal(first, made.observe(keys=keys).rgb)
    some = np.array([5, 9])
    assert np.array_equal(made.observe(some, keys[some]).rgb, first[some])
    assert len(np.unique(first.reshape(64, -1), axis=0)) >= 3
    assert np.ptp(made.seen_from[:, 0]) <= 0.5  # near ones
    still = simulator(corridor, *[(1.05, 0.02, 0.05)] * 64, draw=False)
    assert len(np.unique(still.observe(keys=keys).rgb.reshape(64, -1), axis=0)) == 1


@pytest.mark.parametrize('pitch', [0.0, 15.0])
def test_a_picture_is_turned_as_the_camera_would_have_been(pitch):
    robot = dataclasses.replace(ROBOT, camera_pitch=math.radians(pitch))
    house = generate_house(7, rooms=2)
    drawn = HouseSimulator([house], [0], robot=robot, size=64)
    poses = np.array([goal.pose for goal in house.goals])
    where = np.zeros(len(poses), int)
    before = drawn.view(where, poses).rgb.copy()
    for degrees in (12, -12):
        poses[:, 2] += math.radians(degrees)
        after = drawn.view(where, poses).rgb.astype(float)
        poses[:, 2] -= math.radians(degrees)
        made = turned(before, np.full(len(poses), math.radians(degrees)), robot)
        known = slice(16, None) if degrees > 0 else slice(None, -16)
        off, still = (np.abs(pictures[..., known] - after[..., known]).mean()
                      for pictures in (made.astype(float), before.astype(float)))
        assert off < 0.35 * still
    assert np.array_equal(turned(before, np.zeros(len(before)), robot), before)


def test_where_nobody_looked_a_robot_cannot_turn():
    graph = graph_of(line(4), goals=5)  # one way, and never turned
    made = simulator(graph, (2.0, 0.0, 0.0))
    most = math.radians(30)
    motion = made.move(np.array([[0, 0, 2 * most, 0]]))
    assert motion.collided[0]
    assert TURNED_MOST - SLACK <= made.poses[0, 2] <= TURNED_MOST + SLACK
    assert motion.delta[0, 2] == pytest.approx(made.poses[0, 2])
    assert made.move(np.array([[0, 0, most, 0]])).collided[0]
    assert not made.move(np.array([[0, 0, -most, 0]])).collided[0]
    assert made.poses[0, 2] == pytest.approx(0, abs=SLACK)
    # Back it can drive, and so all of the corridor is one place.
    for _ in range(5):
        made.move(np.array([[-0.2, 0, 0, 0]]))
    assert made.poses[0, 0] == pytest.approx(1.0, abs=0.01)
    # A small gap between two headings is none: a robot would be trapped there.
    parts = [line(4), *[line(4, x=0) + [0, 0, math.radians(a)] for a in (
        60 + GAP * math.degrees(HEADING) - 1,)]]
    made = simulator(graph_of(*parts, goals=5), (2.0, 0.0, 0.0))
    assert not made.move(np.array([[0, 0, math.radians(80), 0]])).collided[0]


def test_a_move_that_leaves_the_floor_slides_along_it_or_ends(corridor):
    made = simulator(corridor, (1.0, 0.0, math.radians(30)), (1.0, 0.0, math.pi / 2))
    motion = made.move(np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]]))
    assert motion.collided.tolist() == [False, True]
    assert 1.6 < made.poses[0, 0] < 2.0 and 0.2 < made.poses[0, 1] <= 0.3 + CELL
    assert made.poses[1, 1] <= 0.3 + CELL and made.poses[1, 0] == pytest.approx(1.0, abs=0.02)
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    dx, dy = motion.delta[0, :2]
    assert np.allclose(made.poses[0, :2], (1 + c * dx - s * dy, s * dx + c * dy))
    assert made.poses[0, 2] == pytest.approx(math.radians(30))


def test_reached_points_are_those_of_moves(corridor):
    headings = np.linspace(-math.pi, math.pi, 9)[:-1]
    ends = simulator(corridor, (2.0, 0.1, 0.3)).reach(0, headings, 0.5)
    for heading, end in zip(headings, ends, strict=True):
        made = simulator(corridor, (2.0, 0.1, heading))
        made.move(np.array([[0.5, 0, 0, 0]]))
        assert np.allclose(made.poses[0, :2], end)


def test_what_cannot_be_driven_to_and_back_is_left_out():
    far = line(3, y=9)  # never driven to
    poses = [spin(0, 0), line(4), spin(4, 0), line(4, math.pi, x=4)]
    episode = np.concatenate([np.zeros(sum(map(len, poses)), int), np.ones(len(far), int)])
    graph = graph_of(*poses, far, episode=episode)
    assert (np.abs(graph.poses[:, 1]) < 1).all() and FloorDistance(graph.floor, 0, 0).maximum < 6
    words = ' '.join(graph.words)
    assert f'{len(far)} are left out' in words
    assert all(abs(goal.pose[1]) < 1 for goal in graph.goals)
    assert (graph.map.states(graph.poses) >= 0).all()
    # Apart, the larger piece is a place of its own.
    only = graph_of(far, *[spin(1, 9)], line(3, math.pi, x=3, y=9), goals=4)
    assert len(only.poses) > 60


@pytest.mark.parametrize('poses', [spin(0, 0), line(1.2), np.zeros((40, 3)), line(0.0)])
def test_a_drive_that_leads_nowhere_is_refused(poses):
    with pytest.raises(UserError, match='leads through a place.*received'):
        graph_of(poses)


def test_bad_margins_are_refused():
    for margin in (0, -1, 3, math.nan):
        with pytest.raises(UserError, match='margin'):
            graph_of(line(4), margin=margin)


def test_many_pictures_of_one_pose_are_few_nodes():
    waiting = np.repeat([[2.0, 0.0, 0.0]], 200, axis=0)
    graph = graph_of(spin(0, 0), line(2), waiting, line(2, x=2), spin(4, 0))
    near = np.hypot(*(graph.poses[:, :2] - (2, 0)).T) < 0.01
    assert near.sum() == KEPT and f'{202 - KEPT} show a pose once more' in graph.words[0]


def test_goals_lie_apart_and_show_something():
    poses = np.concatenate([spin(0, 0), line(4), spin(4, 0)])
    pictures = show(poses)
    pictures[:len(spin(0, 0))] = 90  # a wall
    graph = build_graph(pictures, poses, np.zeros(len(poses), int), ROBOT, goals=64,
                        world_version='recorded')
    assert 4 <= len(graph.goals) < 64
    assert all(graph.pictures[node].std() > 0 for node in graph.goal_nodes)
    for k, one in enumerate(graph.goals):
        for other in graph.goals[k + 1:]:
            gap = math.dist(one.pose[:2], other.pose[:2])
            turn = abs(wrap_angle(one.pose[2] - other.pose[2]))
            assert gap >= 0.25 or turn >= math.radians(15) - 1e-6
    own, others = held_out(graph)
    assert len(own.goals) + len(others.goals) == len(graph.goals) and len(others.goals) >= 2
    assert not set(own.goal_nodes) & set(others.goal_nodes)


def test_a_goal_picture_that_the_drive_has_seen_becomes_a_goal():
    poses = np.concatenate([spin(0, 0), line(4), spin(4, 0)])
    pictures = show(poses)
    shown = np.stack([pictures[50] // 2 + 60, show(range(999))[-1]])  # in another light; a new one
    graph = build_graph(pictures, poses, np.zeros(len(poses), int), ROBOT, goals=6,
                        goal_pictures=shown, world_version='recorded')
    assert np.allclose(graph.goals[0].pose[:3], poses[50]) and len(graph.goals) in (6, 7)
    assert '1 of 2 goal pictures' in ' '.join(graph.words)


def test_components_are_those_of_a_search():
    rng = np.random.default_rng(0)
    for count in (1, 7, 40, 120):
        to = rng.integers(0, count, (count, 2)).astype(np.int32)
        reach = np.eye(count, dtype=bool)
        for _ in range(count):
            reach = reach | reach[to].any(axis=1)
        number = components(to)
        assert np.array_equal(number[:, None] == number[None, :], reach & reach.T)


# The environment.


def env_of(graph, envs=6, **options):
    return make_env(graph, ROBOT, envs, **{'max_decisions': 60} | options)


@pytest.mark.parametrize('stop', ['arrival', 'declared'])
def test_the_shortest_path_arrives(corridor, stop):
    env = env_of(corridor, stop=stop)
    env.reset(seed=0)
    ends, contacts = [], 0
    for _ in range(120):
        _, reward, terminated, truncated, info = env.step(env.oracle_actions())
        assert np.array_equal(info['success'], reward == 1)
        contacts += info['collided'].sum()
        ends += info['success'][terminated | truncated].tolist()
    assert len(ends) > 30 and np.mean(ends) > 0.95 and contacts < 0.1 * 120 * 6


def test_where_robots_cannot_turn_the_shortest_path_backs_up():
    env = env_of(graph_of(line(4), goals=5), noise=False, max_decisions=100)
    env.reset(seed=1)
    ends, used = [], set()
    for _ in range(150):
        actions = env.oracle_actions()
        used |= set(actions.tolist())
        _, _, terminated, truncated, info = env.step(actions)
        ends += info['success'][terminated | truncated].tolist()
    assert ROBOT.action_names.index('backward') in used and len(ends) > 10
    assert np.mean(ends) > 0.95


@pytest.mark.parametrize(('kind', 'noise'), [('true', True), ('commanded', False)])
def test_odometry_is_the_pose_also_where_turns_are_cut_off(kind, noise):
    env = env_of(graph_of(line(4), goals=5), odometry=kind, noise=noise, stop='declared')
    _, info = env.reset(seed=1)
    start, rng, cut = info['pose'].copy(), np.random.default_rng(0), 0
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    for _ in range(40):
        actions = rng.integers(0, len(env.action_names), 6)
        observation, _, _, _, info = env.step(actions)
        x, y, yaw = observation['odometry'].T
        assert np.abs(start[:, 0] + c * x - s * y - info['pose'][:, 0]).max() < 1e-9
        assert np.abs(start[:, 1] + s * x + c * y - info['pose'][:, 1]).max() < 1e-9
        assert np.abs(wrap_angle(start[:, 2] + yaw - info['pose'][:, 2])).max() < 1e-9
        cut += (info['collided'] & (actions == env.action_names.index('rotate_left'))).sum()
    assert cut


def test_episodes_begin_at_pictures_and_lead_to_pictures(corridor):
    env = env_of(corridor, 32)
    observation, info = env.reset(seed=0)
    assert env.world_version == 'recorded' and env.observation_space.contains(observation)
    gap = np.abs(info['pose'][:, None, :3] - corridor.poses[None]).max(axis=2).min(axis=1)
    assert (gap < 1e-12).all() and (info['start_distance'] >= 1.0).all()
    for goal, node in enumerate(corridor.goal_nodes):
        assert np.array_equal(env.goals[goal], corridor.pictures[node])
    env.set_difficulty(0.3)
    _, info = env.reset(seed=0)
    assert info['start_distance'].max() <= 0.3 * 4.2 + 0.1


def test_results_do_not_depend_on_the_number_of_robots_and_go_on_when_saved(corridor):
    options = dict(privileged=('goal_pose', 'overlap', 'oracle_action'), max_decisions=9)
    small, large, other = (env_of(corridor, n, **options) for n in (2, 5, 5))
    one, _ = small.reset(seed=3)
    many, _ = large.reset(seed=3)
    rng = np.random.default_rng(0)
    for step in range(30):
        for key in one:
            assert np.array_equal(one[key], many[key][:2]), key
        actions = rng.integers(0, 4, 5)
        one, *_ = small.step(actions[:2])
        many, _, _, _, told = large.step(actions)
        if step > 15:
            same, _, _, _, also = other.step(actions)
            for rows, others in ((many, same), (told, also)):
                assert all(np.array_equal(rows[key], others[key]) for key in rows)
        elif step == 15:
            other.reset(seed=8)
            other.set_state(large.get_state())


def test_labels_belong_to_the_picture_that_is_shown(corridor):
    env = env_of(corridor, 16, privileged=('goal_pose', 'overlap'))
    _, info = env.reset(seed=0)
    rng = np.random.default_rng(0)
    known = 0
    for _ in range(30):
        x, y, c, s = info['goal_pose'].T
        seen_from, goal = env.simulator.seen_from, env.goal_poses[info['goal']]
        assert np.allclose(np.hypot(x, y), np.hypot(*(goal - seen_from)[:, :2].T), atol=1e-5)
        assert np.allclose(np.abs(np.arctan2(s, c)), info['heading_error'], atol=1e-5)
        assert set(np.unique(info['overlap'])) <= {-1.0, 0.0, 1.0}
        known += (info['overlap'] >= 0).sum()
        _, _, _, _, info = env.step(rng.integers(0, 4, 16))
    assert known > 40
    env.simulator.place(np.arange(16), env.goal_poses[info['goal']])
    env.set_shown_goal('blank')
    _, info = env.reset(seed=0)
    assert (info['overlap'] == 0).all()


def test_depth_of_the_bag_measures_the_overlap():
    house = generate_house(7, rooms=1)
    x, y = house.floor.centres()[house.floor.free.sum() // 2]
    poses = np.concatenate([spin(x, y), [[x, y, 0]]])
    drawn = HouseSimulator([house], [0], robot=ROBOT, size=32).view(
        np.zeros(len(poses), int), np.column_stack([poses, np.zeros(len(poses))]))
    stored = np.clip(drawn.depth * 25.5, 1, 255).astype(np.uint8)
    poses = np.concatenate([poses, poses + [0, 3, 0], line(3, math.pi / 2, x=x, y=y)])
    several = [0] * 37 + [0] * 37 + [0] * 31  # the rest of the drive shows whatever
    shown, depth = (np.concatenate([part, part, part[several[:31]]])
                    for part in (drawn.rgb, stored))
    graph = build_graph(shown, poses, np.zeros(len(poses), int), ROBOT, depth=depth, goals=8,
                        world_version='2')
    made = RecordedSimulator(graph, 2, robot=ROBOT)
    assert made.capabilities.depth
    env = NavigationEnv(EnvConfig(num_envs=2, size=32, privileged=('overlap', 'depth')), ROBOT,
                        simulator=made)
    _, info = env.reset(seed=0)
    assert info['depth'].dtype == np.float32
    env.simulator.place(np.arange(2), env.goal_poses[info['goal']])
    env.simulator._draw = False

    def shares(env):
        return env._views.co_visibility(env._picture, env._shown_goal,
                                        env.simulator.observe().depth)

    assert (shares(env) > 0.95).all()
    away = env.goal_poses[info['goal']].copy()
    away[:, 2] = wrap_angle(away[:, 2] + math.pi)
    env.simulator.place(np.arange(2), away)
    assert (shares(env) < 0.1).all()


@pytest.mark.parametrize('options', [
    {'task': 'object'}, {'task': 'room'}, {'task': 'collect'}, {'num_envs': 3},
    {'privileged': ('explorer_action',)}, {'privileged': ('depth',)},
    {'privileged': ('segmentation',)}, {'actions': ('forward', 'look_up')},
])
def test_what_pictures_cannot_do_is_refused(corridor, options):
    with pytest.raises(UserError, match='correct the environment'):
        NavigationEnv(EnvConfig(**{'num_envs': 2, 'size': SIZE} | options),
                      simulator=RecordedSimulator(corridor, 2, robot=ROBOT))


def test_an_environment_takes_a_simulator_instead_of_houses():
    config = EnvConfig(scenes=('house:7?rooms=2',), num_envs=2, size=24)
    given = NavigationEnv(config, simulator=HouseSimulator(
        [generate_house(7, rooms=2)], [0, 0], robot=RobotSpec(), size=24))
    plain = NavigationEnv(config)
    one, two = plain.reset(seed=1), given.reset(seed=1)
    for _ in range(10):
        for part in (0, -1):
            assert all(np.array_equal(one[part][key], two[part][key]) for key in one[part])
        actions = plain.oracle_actions()
        one, two = plain.step(actions), given.step(actions)


def test_a_floor_plan_covers_the_place(corridor):
    plan = corridor.plan()
    outside = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in plan['outside'])
    x0, y0, x1, y1 = plan['bounds']
    assert outside + plan['area'] == pytest.approx((x1 - x0) * (y1 - y0))
    assert len(plan['goals']) == len(corridor.goals)


# Pairs.


def test_pairs_do_not_depend_on_how_they_are_batched_and_their_labels_are_true(corridor):
    sampler = GraphPairs(corridor, ROBOT, range(len(corridor.poses)), seed=4)
    whole = sampler.draw(24)
    sampler.count = 0
    parts = [sampler.draw(k) for k in (5, 12, 7)]
    for name, rows in whole.items():
        assert np.array_equal(rows, np.concatenate([part[name] for part in parts])), name
    sampler.count = 0
    groups = sampler.draw_groups(24, 1)
    to, back = groups['goal_pose'][groups['first'] % 2 == 1], groups['goal_pose'][
        groups['first'] % 2 == 0]
    assert np.allclose(np.hypot(*to[:, :2].T), np.hypot(*back[:, :2].T), atol=1e-5)
    assert np.allclose(to[:, 3], -back[:, 3], atol=1e-6)
    groups = sampler.draw_groups(300, 3)
    assert groups['image'].shape == (1200, 3, SIZE, SIZE) and len(groups['first']) == 3600
    assert (groups['first'] // 4 == groups['second'] // 4).all()
    assert set(np.unique(groups['overlap'])) == {-1.0, 0.0, 1.0}
    gap = np.hypot(*groups['goal_pose'][:, :2].T)
    assert (gap < 1).mean() > 0.2 and (gap > 2).mean() > 0.1


def test_pairs_to_judge_by_lead_to_goals_of_their_own(corridor):
    own, others = held_out(corridor)
    source, validation = make_pairs(own, others, ROBOT, 0)
    seen = {tuple(corridor.pictures[node, :, 0, 0]) for node in others.goal_nodes}
    assert not {*source._goals.tolist()} & set(others.goal_nodes)
    assert {*validation._goals.tolist()} == set(others.goal_nodes)
    assert len(seen) == len(others.goal_nodes)
    with pytest.raises(UserError, match='at least one group'):
        source.draw_groups(0)
    with pytest.raises(UserError, match='goals'):
        GraphPairs(corridor, ROBOT, [])
