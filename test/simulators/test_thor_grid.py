"""Grid scenes: files of Zhu et al. and our own are read exactly, or refused by the data set."""

import json
import math

import h5py
import numpy as np
import pytest
import torch
from conformance import Conformance

from vn_nav import cli
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import PolicyActor, random_actor, run_episodes
from vn_nav.evaluation.metrics import summarise
from vn_nav.learning.presets import preset
from vn_nav.learning.rollout import Collector
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.report.tables import row_line
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.grid.grid_file import FOLDER, read_grid
from vn_sim_bridge.grid.states import BACKWARD, COLUMNS, FORWARD, LEFT, NAMES, RIGHT
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator, robot_for

AHEAD = ((0, 1), (1, 0), (0, -1), (-1, 0))  # x, z by rotation: 0 looks along z, 90 along x
WALLS = {(1, 1), (3, 0)}  # cells of the small grid without floor


def write_dump(path, columns=5, rows=4, crops=True, **changes):
    """A dump of columns x rows cells as Zhu et al. wrote them; `changes` replace data sets."""
    cells = [(x, z) for x in range(columns) for z in range(rows) if (x, z) not in WALLS]
    count = 4 * len(cells)
    graph = np.full((count, 4), -1, np.int64)
    for state in range(count):
        (x, z), quarter = cells[state // 4], state % 4
        for column, sign in ((0, 1), (3, -1)):
            end = x + sign * AHEAD[quarter][0], z + sign * AHEAD[quarter][1]
            if end in cells:
                graph[state, column] = 4 * cells.index(end) + quarter
        graph[state, 1] = state // 4 * 4 + (quarter + 1) % 4  # right: clockwise
        graph[state, 2] = state // 4 * 4 + (quarter - 1) % 4
    rng = np.random.default_rng(0)
    features = rng.standard_normal((count, 10, 2048)).astype(np.float32)
    data = {
        'observation': rng.integers(0, 256, (count, 30, 40, 3), np.uint8),
        'resnet_feature': features if crops else features[:, 0],
        'location': np.repeat(np.array(cells, float), 4, axis=0) * 0.5 + [3.0, -2.0],
        'rotation': np.tile(np.arange(4) * 90, len(cells)), 'graph': graph,
        'shortest_path_distance': walked(graph)} | changes
    with h5py.File(path, 'w') as file:
        for name, rows_ in data.items():
            if rows_ is not None:
                file[name] = rows_
    return data


def walked(graph):
    """Steps between all states, by another way than the package's: powers of the graph."""
    count = len(graph)
    steps = np.full((count, count), -1)
    near = np.eye(count, dtype=bool)
    link = np.zeros((count, count), bool)
    for state, ends in enumerate(graph):
        link[state, ends[ends >= 0]] = True
    for step in range(count):
        steps[near & (steps < 0)] = step
        near = near | (near.astype(np.float32) @ link > 0)
    return steps


@pytest.fixture(scope='module')
def dump(tmp_path_factory):
    path = tmp_path_factory.mktemp('dumps') / 'bathroom_02.h5'
    return path, write_dump(path)


def scene(path, options='goals=5,26,37'):
    return f'grid:{path}?{options}' if options else f'grid:{path}'


def grid(path, options='goals=5,26,37', size=24):
    return read_grid(parse_scene(scene(path, options)), size, math.pi / 2, 1.0)


class TestGrid(Conformance):
    """The contract of every simulator."""

    @pytest.fixture(autouse=True)
    def _robot(self, dump):
        self.path = dump[0]
        self.robot = robot_for([scene(self.path)])

    def make(self, num_envs, size=24):
        return open_simulator([scene(self.path)], Setup(num_envs, self.robot, size))


def test_a_dump_is_read_as_it_was_written(dump):
    path, data = dump
    read = grid(path, size=30)
    assert read.step == 0.5 and read.goals == (5, 26, 37)
    # Ours: x forward (their z), y left (minus their x), yaw left.
    assert np.allclose(read.poses[:, 0], data['location'][:, 1])
    assert np.allclose(read.poses[:, 1], -data['location'][:, 0])
    assert np.allclose(np.sin((read.poses[:, 2] + np.radians(data['rotation'])) / 2), 0)
    assert np.array_equal(read.rgb, data['observation'][:, :, 5:35].transpose(0, 3, 1, 2))
    assert np.array_equal(read.features, data['resnet_feature'][:, 0])
    assert np.array_equal(read.steps, data['shortest_path_distance'])
    order = [FORWARD, RIGHT, LEFT, BACKWARD]
    assert np.array_equal(read.graph[:, order], data['graph'])


def test_whole_actions_follow_the_graph(dump):
    path, data = dump
    simulator = open_simulator([scene(path)], Setup(4, robot_for([scene(path)]), 24))
    poses = simulator.places[0].scene.poses
    moves = np.array([[0.5, 0, 0, 0], [0, 0, -math.pi / 2, 0], [0, 0, math.pi / 2, 0],
                      [-0.5, 0, 0, 0]])  # in the order of the file's columns
    for state in range(len(poses)):
        simulator.place(np.arange(4), poses[[state] * 4])
        motion = simulator.move(moves)
        ends = data['graph'][state]
        assert np.array_equal(motion.collided, ends < 0)
        assert np.allclose(simulator.poses, poses[np.where(ends < 0, state, ends)])
        assert np.allclose(motion.delta, np.where(ends[:, None] < 0, 0, moves))
    simulator.close()


def test_columns_go_by_name(dump, tmp_path):
    _, data = dump
    order = [2, 0, 1]
    names = [COLUMNS[k] for k in order]
    path = tmp_path / 'other.h5'
    write_dump(path, graph=data['graph'][:, order], shortest_path_distance=None)
    with pytest.raises(UserError, match='graph.*3 columns.*actions'):
        grid(path)
    read = grid(path, f'goals=5&actions={",".join(names)}')
    assert np.array_equal(read.graph[:, [NAMES[name] for name in names]], data['graph'][:, order])
    assert (read.graph[:, BACKWARD] == -1).all()
    with h5py.File(path, 'a') as file:
        file.attrs['actions'] = names
    assert np.array_equal(grid(path).graph, read.graph)
    with pytest.raises(UserError, match='graph'):  # left is not right
        grid(path, f'goals=5&actions={",".join(COLUMNS[k] for k in (1, 0, 2))}')


def test_headings_come_from_the_graph_where_there_is_no_rotation(dump, tmp_path):
    path, data = dump
    write_dump(tmp_path / 'a.h5', rotation=None)
    assert np.array_equal(grid(tmp_path / 'a.h5').poses, grid(path).poses)
    mirrored = data['location'] * [-1, 1]  # turns to the right look like turns to the left
    write_dump(tmp_path / 'b.h5', rotation=None, location=mirrored)
    poses = grid(tmp_path / 'b.h5').poses
    simulator = open_simulator([scene(tmp_path / 'b.h5')], Setup(
        1, robot_for([scene(path)]), 24))
    for state in range(len(poses)):
        simulator.place(np.array([0]), poses[[state]])
        simulator.move(np.array([[0, 0, -math.pi / 2, 0]]))
        assert np.allclose(simulator.poses, poses[[data['graph'][state, 1]]])
    simulator.close()
    with pytest.raises(UserError, match='rotation.*state 0 cannot move'):
        alone = data['graph'].copy()
        alone[:4] = -1
        alone[np.isin(alone, range(4))] = -1
        write_dump(tmp_path / 'c.h5', rotation=None, graph=alone, shortest_path_distance=None)
        grid(tmp_path / 'c.h5')


def test_features_without_the_axis_of_crops(tmp_path):
    data = write_dump(tmp_path / 'a.h5', crops=False)
    assert np.array_equal(grid(tmp_path / 'a.h5').features, data['resnet_feature'])


WRONG = {
    'observation': lambda d: d['observation'].astype(np.float32),
    'location': lambda d: d['location'][:, :1],
    'rotation': lambda d: d['rotation'] + 1,
    'graph': lambda d: np.where(d['graph'] == 0, len(d['graph']), d['graph']),
    'shortest_path_distance': lambda d: d['shortest_path_distance'] + 1,
    'resnet_feature': lambda d: d['resnet_feature'][..., None],
    'depth': lambda d: np.zeros((len(d['graph']), 4, 4), np.float32),
    'semantic': lambda d: np.full(d['observation'].shape[:3], 3, np.uint8),
}
OTHER_WRONG = [
    ('observation', lambda d: d['observation'][:-1], 'a row for each of the'),
    ('observation', lambda d: None, 'is there'),
    ('location', lambda d: None, 'is there'),
    ('location', lambda d: d['location'] * [1, 2], 'equally long'),
    ('graph', lambda d: d['graph'].astype(float), 'whole numbers'),
    ('graph', lambda d: d['graph'] - 1, '-1'),
    ('graph', lambda d: d['graph'][:, 0], 'shape'),
    ('rotation', lambda d: -d['rotation'] % 360, 'clockwise'),
    ('rotation', lambda d: d['rotation'][:-3], 'a row for each of the'),
    ('shortest_path_distance', lambda d: d['shortest_path_distance'][:, :-1], 'shape'),
    ('shortest_path_distance', lambda d: d['shortest_path_distance'].T + np.eye(72, dtype=int),
     'differ'),
    ('resnet_feature', lambda d: d['resnet_feature'][:-2], 'a row for each of the'),
]


@pytest.mark.parametrize('name, change, words', [
    *((name, change, name) for name, change in WRONG.items()), *OTHER_WRONG])
def test_a_wrong_file_is_refused_by_its_data_set(dump, tmp_path, capsys, name, change, words):
    write_dump(tmp_path / 'bad.h5', **{name: change(dump[1])})
    with pytest.raises(UserError) as refused:
        grid(tmp_path / 'bad.h5')
    text = str(refused.value)
    assert name in text and words in text and '\n' not in text
    assert cli.main(['train', '--scene', scene(tmp_path / 'bad.h5'), '--out',
                     str(tmp_path / 'run')]) == 2
    told = capsys.readouterr().err
    assert name in told and told.count('\n') == 1


def test_what_is_not_there_is_said_at_once(dump, tmp_path, monkeypatch):
    monkeypatch.delenv(FOLDER, raising=False)
    robot = RobotSpec()
    with pytest.raises(UserError, match=FOLDER):
        robot_for(['grid:bathroom_02'])
    monkeypatch.setenv(FOLDER, str(tmp_path))
    with pytest.raises(UserError, match='no file'):
        robot_for(['grid:bathroom_02'])
    (tmp_path / 'bathroom_02.h5').write_bytes(b'version https://git-lfs')
    with pytest.raises(UserError, match='HDF5'):
        robot_for(['grid:bathroom_02'])
    path = dump[0]
    for options, words in (('goals=5,5', 'goals'), ('goals=72', 'goals'), ('goals=x', 'goals'),
                           ('rooms=3', 'options'), ('goals=5&distances=no', 'distances')):
        with pytest.raises(UserError, match=words):
            grid(path, options)
    with pytest.raises(UserError, match='90 deg'):  # turns of 30 deg
        open_simulator([scene(path)], Setup(1, robot, 24))
    write_dump(tmp_path / 'nameless.h5')
    with pytest.raises(UserError, match='goals=26,37'):
        grid(tmp_path / 'nameless.h5', '')


def test_the_targets_of_the_thesis_are_the_defaults(dump, monkeypatch):
    path = dump[0]
    monkeypatch.setenv(FOLDER, str(path.parent))
    assert read_grid(parse_scene('grid:bathroom_02'), 24, 1.5, 1.0).goals == (26, 37, 43, 53, 69)
    folder = f'grid:bathroom_02?folder={path.parent}&goals=1'
    assert read_grid(parse_scene(folder), 24, 1.5, 1.0).goals == (1,)


def env_of(path, options='goals=5,26,37', **more):
    return NavigationEnv(EnvConfig(scenes=(scene(path, options),), size=36, **{
        'num_envs': 6, 'max_decisions': 60} | more))


def test_success_is_the_exact_cell_and_heading(dump):
    env = env_of(dump[0])
    _, info = env.reset(seed=0)
    poses = env.simulator.places[0].scene.poses
    steps = env.simulator.places[0].scene.steps
    goals = [5, 26, 37]
    for state in range(len(poses)):
        env.reset(seed=state)
        env.simulator.place(np.arange(6), poses[[state] * 6])
        info = env.step(np.full(6, env.action_names.index('rotate_left')))[4]
        now = env.simulator.places[0].nearest(env.simulator.poses)[0]
        goal = np.array(goals)[info['goal']]
        assert np.array_equal(info['success'], now == goal)
        assert np.array_equal(info['distance'], steps[now, goal])
    env.close()


def test_the_shortest_path_takes_as_many_steps_as_the_file_says(dump):
    env = env_of(dump[0], randomisation=EnvConfig().randomisation, noise=True)
    episodes = run_episodes(env, lambda seen, reset: env.oracle_actions(), 36, seed=0,
                            robot=env.robot)
    for episode in episodes:
        assert episode.success and episode.unit == 'steps'
        assert episode.decisions == episode.path_length == episode.start_distance >= 1
    figures = summarise(episodes)
    assert figures['spl'] == 1.0 and figures['stop_error_steps'] == 0
    assert '0.00 steps 0 deg' in row_line('shortest path', figures, 'arrival')
    assert 'stop_error_m' not in json.loads(json.dumps(figures))
    wandering = summarise(run_episodes(env, random_actor(env, 0), 36, seed=0, robot=env.robot))
    assert wandering['spl'] < 0.5
    with pytest.raises(ValueError, match='steps'):
        summarise([*episodes, episodes[0].__class__(**{**vars(episodes[0]), 'unit': 'm'})])
    env.close()


def test_odometry_is_metres_though_distances_are_steps(dump):
    env = env_of(dump[0], odometry='true', stop='declared')
    _, info = env.reset(seed=0)
    start, rng, moved = info['pose'].copy(), np.random.default_rng(0), 0.0
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    for _ in range(40):
        seen, _, _, _, info = env.step(rng.integers(0, len(env.action_names), 6))
        x, y, yaw = seen['odometry'].T
        there = np.stack([c * x - s * y, s * x + c * y], 1) + start[:, :2]
        assert np.abs(there - info['pose'][:, :2]).max() < 1e-9
        turn = start[:, 2] + yaw - info['pose'][:, 2]
        assert np.abs(np.sin(turn / 2)).max() < 1e-9
        moved = max(moved, np.hypot(x, y).max())
    assert moved >= 0.5
    env.close()


def test_features_of_the_file_reach_the_network_uncomputed(dump):
    """The network has no encoder: a picture that reached it would be an error."""
    path, data = dump
    env = env_of(path, num_envs=4)
    seen, info = env.reset(seed=3)
    assert env.observation_space.contains(seen)
    now = env.simulator.places[0].nearest(info['pose'])[0]
    assert np.array_equal(seen['features'], data['resnet_feature'][now, 0])
    assert np.array_equal(env.goal_features[:3], data['resnet_feature'][[5, 26, 37], 0])
    assert not env.goal_features[-1].any()
    config = preset('icra2017', frozen_weights='scene')
    network = build_policy(config.network(env.action_names, 36))
    assert sum(part.numel() for part in network.parameters()) < 6e6  # ResNet-50 has 24 million
    collector = Collector(env, network, torch.Generator().manual_seed(0))
    collector.begin(0)
    rollout, _ = collector.collect(3)
    assert torch.equal(rollout.observation.goals, torch.from_numpy(env.goal_features))
    env.simulator.place(np.arange(4), env.simulator.places[0].scene.poses[:4])
    actor = PolicyActor(env, network, 'sample', 0)
    assert actor(seen, info['reset']).shape == (4,)
    with pytest.raises(UserError, match='files of its scenes'):
        network.look(torch.zeros(1, 3, 36, 36, dtype=torch.uint8))
    env.close()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_the_commands_train_and_measure_it(dump, tmp_path, capsys):
    out, figures, page = tmp_path / 'run', tmp_path / 'figures.json', tmp_path / 'page.html'
    name = scene(dump[0])
    assert cli.main(['train', '--preset', 'icra2017', '--scene', name, '--frames', '2000',
                     '--size', '36', '--frozen-weights', 'scene', '--no-tensorboard',
                     '--out', str(out)]) == 0
    assert cli.main(['evaluate', str(out / 'checkpoint'), '--episodes', '4', '--max-decisions',
                     '30', '--json', str(figures), '--html', str(page)]) == 0
    rows = json.loads(figures.read_text())['splits']['seen_goals']['rows']['arrival']
    assert rows['shortest path']['spl'] == 1.0
    assert 'steps' in capsys.readouterr().out and 'steps from the goal' in page.read_text()
    assert cli.main(['train', '--preset', 'icra2017', '--scene', 'house:3', '--frames', '2000',
                     '--size', '36', '--frozen-weights', 'scene', '--out',
                     str(tmp_path / 'no')]) == 2
    assert 'resnet_feature' in capsys.readouterr().err
    assert cli.main(['collect', '--scene', name, '--pictures', '40', '--size', '36', '--out',
                     str(tmp_path / 'bag')]) == 0
    assert '40 pictures' in capsys.readouterr().out
    # The heads of this preset that need depth and labels are left out, with a line each.
    assert cli.main(['train', '--preset', 'fast', '--scene', name, '--frames', '3000', '--size',
                     '36', '--envs', '8', '--set', 'pair_minutes=0', '--no-tensorboard', '--out',
                     str(tmp_path / 'fast')]) == 0
    assert 'left out' in capsys.readouterr().out


def test_a_robot_drives_over_the_grid_by_velocities(dump):
    """What the bridge does: a move in ticks ends in the state that the whole action leads to."""
    path, data = dump
    robot = robot_for([scene(path)])
    driven = SimulatedRobot(scene(path), robot=robot, size=24, seed=1)
    driven.begin_episode(0)
    assert not driven.noise and driven.episode.start_distance is None  # in metres nobody knows
    place = driven.place
    poses = place.scene.poses
    state = int(np.argmax(data['graph'][:, 0] >= 0))
    driven.simulator.place(np.array([0]), poses[[state]])
    for velocity, column in (((0.25, 0, 0), 0), ((0, 0, math.pi / 4), 2),
                             ((0, 0, -math.pi / 4), 1), ((-0.25, 0, 0), 3)):
        for tick in range(40):
            driven.tick(np.array([*velocity, 0.0]))
            if tick == 8:  # early on its way it still sees where it comes from
                assert np.array_equal(driven.simulator.observe().rgb[0], place.scene.rgb[state])
        state = int(data['graph'][state, column])
        assert driven.tick(np.zeros(4)) is not None
        assert np.allclose(np.sin((driven.pose - poses[state]) / 2), 0, atol=1e-6)
        assert np.array_equal(driven.simulator.observe().rgb[0], place.scene.rgb[state])
    driven.close()


@pytest.mark.ros
@pytest.mark.slow
def test_the_bridge_drives_over_the_grid(dump, tmp_path):
    """By Twist, at the speed of the robot: a cell ahead, and then a contact at the wall."""
    pytest.importorskip('rclpy')
    from bridged import bridged
    from geometry_msgs.msg import Twist
    from ros_harness import wait_until
    with bridged(scene(dump[0]), tmp_path / 'log', size=24) as bridge:
        assert bridge.facts['simulator'] == 'grid' and len(bridge.facts['goals']) == 3
        poses = grid(dump[0]).poses
        odom = bridge.heard['ground_truth/odom']
        odom_queue = len(odom)
        wait_until(lambda: bridge.command.get_subscription_count() > 0, bridge.spin)

        def at(message):
            return message.pose.pose.position.x, message.pose.pose.position.y
        for speed in (0.2, -0.2):  # to the end of the row, and back to the other
            twist = Twist()
            twist.linear.x = speed
            begun = len(odom)

            def stands(twist=twist, begun=begun):
                bridge.command.publish(twist)
                bridge.spin()
                return len(odom) > begun + 60 and at(odom[-1]) == at(odom[-20])
            wait_until(stands, lambda: None)
        places = np.array([at(message) for message in odom[odom_queue:]])
        gap = np.hypot(*(poses[:, None, :2] - places[None]).transpose(2, 0, 1))
        assert np.ptp(places, axis=0).max() >= 0.5 - 1e-6  # from cell to cell
        assert np.ptp(places, axis=0).min() < 1e-6  # along one axis
        assert gap.min(axis=0).max() <= 0.25 + 1e-6 and gap[:, -1].min() < 1e-6


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_dumped_house_is_the_house(tmp_path, capsys):
    """Round trip: the same pictures, depth, labels at the same poses; distances of its graph."""
    path = tmp_path / 'house.h5'
    house = 'house:3?rooms=2'
    words = ['simulators', 'dump', house, '--out', str(path), '--size', '48']
    assert cli.main(words) == 0
    assert cli.main(words) == 2 and 'new file' in capsys.readouterr().err
    assert cli.main(['simulators', 'dump', 'house:3', '--out', str(tmp_path / 'x.h5'), '--step',
                     '-1']) == 2
    name = f'grid:{path}'
    robot = robot_for([name])
    read = open_simulator([name], Setup(2, robot, 48))
    original = open_simulator([house], Setup(2, robot, 48))
    assert read.capabilities.depth and read.capabilities.labels
    assert tuple(read.label_names) == tuple(original.label_names)
    states = read.places[0].scene
    some = np.arange(0, len(states.poses), 7)
    ours = read.view(np.zeros(len(some), np.int64), states.poses[some])
    theirs = original.view(np.zeros(len(some), np.int64), states.poses[some])
    for mine, other in zip(ours[:3], theirs[:3], strict=True):
        assert np.array_equal(mine, other)
    # A move of the house leads where the graph says, or is cut off.
    for state in some[::5]:
        original.place(np.array([0]), states.poses[[state]])
        motion = original.move(np.array([[0.5, 0.0, 0.0, 0.0]]), np.array([0]))
        end = states.graph[state, FORWARD]
        assert motion.collided[0] == (end < 0)
        assert end < 0 or np.allclose(original.poses[0, :3], states.poses[end, :3])
    with h5py.File(path) as file:
        assert np.array_equal(file['shortest_path_distance'][()], walked(file['graph'][()]))
        assert len(file.attrs['goals']) == len(original.places[0].goals)
    # The ways over the grid are no shorter than those over the floor.
    goal = read.places[0].goals[0]
    floor = original.places[0].geodesic(*goal.pose[:2]).at(states.poses)
    cells = read.places[0].distance_to(goal).at(states.poses[:, :2]) * states.step
    assert (cells >= floor - 0.3).all()
    read.close()
    original.close()


def test_any_place_where_robots_can_be_put_is_dumped(dump, tmp_path, capsys):
    path = tmp_path / 'corridor.h5'
    assert cli.main(['simulators', 'dump', 'examples.corridor:4', '--out', str(path), '--size',
                     '24']) == 0
    assert 'steps' not in capsys.readouterr().err
    name = f'grid:{path}'
    simulator = open_simulator([name], Setup(1, robot_for([name]), 24))
    place = simulator.places[0]
    assert simulator.capabilities.depth and simulator.label_names == ('floor', 'ceiling', 'wall')
    # 4 m long and 2 m wide, less the robot: eight cells and more side by side, and no wall is one.
    assert len(place.scene.poses) // 4 >= 8 and place.cells[:, 0].max() <= 4 - 0.18
    assert np.abs(place.cells[:, 1]).max() <= 1 - 0.18
    assert len(place.goals) == 4
    simulator.close()
    for refused, words in ((scene(dump[0]), 'put anywhere'), ('nonsense', 'SIMULATOR:PLACE')):
        assert cli.main(['simulators', 'dump', refused, '--out', str(tmp_path / 'x.h5')]) == 2
        assert words in capsys.readouterr().err
    assert cli.main(['simulators', 'dump', 'house:3', '--out', str(tmp_path / 'no' / 'x.h5')]) == 2
    assert not list(tmp_path.glob('.*'))  # nothing half written
