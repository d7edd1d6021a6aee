"""AI2-THOR: the real client end to end, over a peer of ours in Unity's place (`thor_peer.py`)."""

import json
import math
import os
import signal
import stat
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conformance import ROBOT, SIZE, Conformance

from vn_nav import cli
from vn_nav.errors import UserError
from vn_nav.robot import THESIS_ACTIONS, RobotSpec
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator, simulator_class
from vn_sim_bridge.thor import client

ROOT = Path(__file__).resolve().parents[2]
SCENE = 'thor:FloorPlan227'
ALL = tuple(action.name for action in THESIS_ACTIONS)


def script(path, line):
    """An executable that the client may take for Unity."""
    path.write_text(f'#!/bin/sh\n{line}\n')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.fixture(scope='module', autouse=True)
def peer(tmp_path_factory):
    """Every engine of these tests is the peer; nothing is ever fetched."""
    pytest.importorskip('ai2thor', reason="expected: make test-all installs AI2-THOR's client")
    folder = tmp_path_factory.mktemp('thor peer')  # a space in the path is no trouble
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('HOME', str(folder))  # where the client keeps logs and builds
        patch.setenv('PYTHONPATH', str(ROOT))
        patch.setenv('OMP_NUM_THREADS', '1')
        patch.delenv('DISPLAY', raising=False)
        for proxy in ('http_proxy', 'https_proxy', 'HTTP_PROXY', 'HTTPS_PROXY'):
            patch.setenv(proxy, 'http://127.0.0.1:9')
        patch.setattr(client, 'PATIENCE', 300.0)  # a peer may have to compile its renderer first
        patch.setenv(client.BUILD, str(script(
            folder / 'unity', f'exec {sys.executable} {ROOT}/test/simulators/thor_peer.py "$@"')))
        yield folder


def make(num_envs=1, size=SIZE, scenes=(SCENE,), robot=ROBOT, **options):
    return open_simulator(list(scenes), Setup(num_envs, robot, size, **options))


@pytest.mark.slow
@pytest.mark.timeout(300)
class TestThor(Conformance):
    state_slack = 1e-6  # degrees there, radians here
    growth_robots = 1

    def make(self, num_envs, size=SIZE):
        return make(num_envs, size, (SCENE, 'thor:FloorPlan12'))


@pytest.mark.slow
@pytest.mark.timeout(300)
class TestThorWithAnArm(Conformance):
    state_slack = 1e-6
    test_ten_thousand_steps_do_not_grow = None  # the client is the same

    def make(self, num_envs, size=SIZE):
        return make(num_envs, size, (SCENE + '?moves=arm',))


@pytest.mark.slow
def test_pictures_are_those_of_the_house_that_the_peer_draws():
    from vn_sim_bridge.houses.labels import LABELS
    from vn_sim_bridge.houses.procedural import generate_house
    from vn_sim_bridge.simulators.house import HouseSimulator
    thor = make(2, 36)
    robot = RobotSpec(camera_height=1.5)
    house = HouseSimulator([generate_house(227, rooms=2)], [0], robot=robot, size=36)
    place = thor.places[0]
    # The peer's floor is the house's, turned by a quarter to Unity and back: the same again.
    assert np.allclose(np.sort(place.floor.centres(), axis=0),
                       np.sort(house.places[0].floor.centres(), axis=0))
    rng, alike, colours = np.random.default_rng(3), [], []
    for k in rng.integers(0, len(place.floor.centres()), 12):
        pose = np.array([[*place.floor.centres()[k], rng.uniform(-3, 3), rng.uniform(-0.5, 1)]])
        seen, drawn = thor.view(np.array([0]), pose), house.view(np.array([0]), pose)
        same = np.abs(seen.depth - drawn.depth) < 1e-3  # only the peer has movable objects about
        alike.append(same.mean())
        where = same & (seen.depth > 0)
        colours.append((np.abs(seen.rgb.astype(int) - drawn.rgb)[:, :, where[0]] <= 2).mean())
        names = np.array(thor.label_names)[seen.labels], np.array(LABELS)[drawn.labels]
        assert (names[0] == names[1])[where].mean() > 0.99
    # Those objects have shadows, too.
    assert np.median(alike) > 0.99 and min(alike) > 0.9
    assert np.median(colours) > 0.99 and min(colours) > 0.9
    thor.close()


@pytest.mark.slow
@pytest.mark.parametrize('moves', ['bisect', 'arm'])
def test_a_blocked_move_goes_up_to_the_contact(moves):
    from vn_sim_bridge.floor.contacts import World
    thor = make(1, robot=RobotSpec(), scenes=(f'{SCENE}?moves={moves}',))
    from vn_sim_bridge.houses.procedural import generate_house
    world = World([generate_house(227, rooms=2)], np.zeros(1, int), RobotSpec().footprint_radius)
    rng, cells, blocked = np.random.default_rng(1), thor.places[0].floor.centres(), 0
    for _ in range(40):
        pose = np.array([[*cells[rng.integers(len(cells))], rng.uniform(-3, 3), 0.0]])
        delta = np.zeros((1, 4))
        delta[0, rng.integers(2)] = rng.choice([0.5, -0.2, 0.35])
        thor.place(np.arange(1), pose)
        world.poses[:] = pose
        done, touched = world.move(delta, np.arange(1))
        motion = thor.move(delta)
        assert motion.collided[0] == touched[0]
        assert np.abs(motion.delta - done).max() < (0.02 if moves == 'bisect' else 1e-6)
        blocked += touched[0]
    assert blocked > 5
    thor.close()


@pytest.mark.slow
def test_the_thesis_task_is_solved_by_the_shortest_path():
    """Objects at random in every episode, within 1 m of one, all eight actions."""
    env = NavigationEnv(EnvConfig(scenes=(SCENE,), num_envs=2, size=SIZE, task='object',
                                  actions=ALL, max_decisions=60, noise=True))
    assert len(env.goal_rooms) > 4 and len(env.places[0].object_ids) == len(env.goal_rooms) - 1
    # A goal's picture shows the object: its class is in the picture's labels.
    names = np.array(env.simulator.label_names)
    for picture, kind in zip(env.goal_segmentation[:-1], env.goal_rooms[:-1], strict=True):
        assert kind in names[picture]
    env.reset(seed=5)
    lay, arrived, done = [], 0, 0
    for _ in range(120):
        agents = env.simulator.agents
        lay.append(tuple(round(item['position']['x'], 3) for item in agents[0].objects[:7]))
        _, _, terminated, truncated, info = env.step(env.oracle_actions())
        done += int((terminated | truncated).sum())
        arrived += int(terminated.sum())
        assert (info['distance'][terminated] <= 1.0).all()
    assert done >= 8 and arrived / done > 0.9
    assert len(set(lay)) > 3  # episodes
    # The counter alone says where things lie.
    env.reset(seed=5)
    assert tuple(round(item['position']['x'], 3) for item in
                 env.simulator.agents[0].objects[:7]) == lay[0]
    env.close()


@pytest.mark.slow
def test_tilt_ends_where_the_agent_cannot_look_farther():
    thor = make(1, robot=RobotSpec())
    thor.place(np.arange(1), np.array([[*thor.places[0].floor.centres()[99], 0.3, 0.0]]))
    steps = [thor.move(np.array([[0, 0, 0, math.radians(30)]])).delta[0, 3] for _ in range(3)]
    assert np.allclose(np.degrees(steps), [30, 30, 0]) and not thor.move(np.array(
        [[0, 0, 0, math.radians(30)]])).collided.any()
    steps = [thor.move(np.array([[0, 0, 0, -math.radians(30)]])).delta[0, 3] for _ in range(4)]
    assert np.allclose(np.degrees(steps), [-30, -30, -30, 0])
    thor.close()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_dead_and_a_hung_engine_end_an_episode_and_are_replaced(monkeypatch):
    monkeypatch.setattr(client, 'PATIENCE', 20.0)
    env = NavigationEnv(EnvConfig(scenes=(SCENE + '?objects=random',), num_envs=3, size=SIZE,
                                  actions=ROBOT.action_names, max_decisions=100))
    env.reset(seed=1)
    rotate = np.full(3, ROBOT.action_names.index('rotate_left'))
    for robot, how in ((1, signal.SIGKILL), (0, signal.SIGSTOP), (1, signal.SIGABRT)):
        env.step(rotate)
        agent = env.simulator.agents[robot]
        lost = agent.engine.process
        before, lay = env.simulator.poses.copy(), [i['position'] for i in agent.objects[:7]]
        os.kill(lost.pid, how)
        begun = time.monotonic()
        _, reward, terminated, truncated, info = env.step(rotate)
        assert time.monotonic() - begun < 60  # the client alone spins for 100 s
        assert not terminated.any() and truncated.tolist() == [n == robot for n in range(3)]
        assert not reward.any() and np.isfinite(info['distance']).all()
        assert np.array_equal(info['pose'][robot], before[robot])
        assert lost.poll() is not None and agent.engine.process.poll() is None
        assert [item['position'] for item in agent.objects[:7]] == lay  # as they lay
        _, _, _, truncated, info = env.step(rotate)
        assert info['reset'].tolist() == [n == robot for n in range(3)] and not truncated.any()
    # Lost between moves: nobody notices.
    before = env.simulator.poses.copy()
    os.kill(env.simulator.agents[2].engine.process.pid, signal.SIGKILL)
    env.simulator.place(np.arange(3), before)
    assert env.simulator.observe().rgb.any(axis=(1, 2, 3)).all()
    assert sum(agent.restarts for agent in env.simulator.agents) == 4
    processes = [agent.engine.process for agent in env.simulator.agents]
    env.close()
    assert all(process.poll() is not None for process in processes)


@pytest.mark.slow
def test_what_cannot_start_is_said_in_one_line(monkeypatch, tmp_path):
    def refused(match):
        with pytest.raises(UserError, match=match) as told:
            make()
        assert '\n' not in str(told.value)
    for line, patience, match in (('exit 3', 60, r'starts.*ended \(3\)'),
                                  ('exec sleep 100', 1.5, 'starts.*not answered for 1.5 s')):
        monkeypatch.setenv(client.BUILD, str(script(tmp_path / 'unity', line)))
        monkeypatch.setattr(client, 'START_PATIENCE', patience)
        refused(match)
    monkeypatch.setenv(client.BUILD, str(tmp_path))
    refused('VN_NAV_THOR_BUILD')
    monkeypatch.delenv(client.BUILD)
    monkeypatch.setattr(client.ctypes.util, 'find_library', lambda name: None)
    refused('DISPLAY.*Vulkan|no DISPLAY, no libvulkan')
    monkeypatch.setattr(client.ctypes.util, 'find_library', lambda name: 'libvulkan.so.1')
    refused('fetched')  # the proxy is nowhere
    monkeypatch.setenv('DISPLAY', ':97')
    refused('fetched')


@pytest.mark.slow
def test_the_commands_know_it(monkeypatch, capsys, tmp_path):
    assert cli.main(['simulators']) == 0
    assert 'thor' in capsys.readouterr().out
    assert cli.main(['train', '--scene', 'thor:FloorPlan31', '--out',
                     str(tmp_path / 'run')]) == 2
    assert 'FloorPlan1 to 30' in capsys.readouterr().err
    from vn_sim_bridge import simulators
    monkeypatch.setattr(simulators.importlib.util, 'find_spec', lambda name: None)
    with pytest.raises(UserError, match='vn_nav simulators install thor'):
        simulator_class('thor')


@pytest.mark.slow
def test_a_house_of_procthor_is_made_in_the_engine(tmp_path):
    path = tmp_path / 'house.json'
    path.write_text(json.dumps({'seed': 12, 'rooms': [{}], 'metadata': {'agent': {
        'position': {'x': -2.0, 'y': 0.9, 'z': 2.0}, 'rotation': {'x': 0, 'y': 90, 'z': 0},
        'horizon': 0, 'standing': True}}}))
    thor = make(1, scenes=(f'thor:procthor?file={path}',))
    assert len(thor.places[0].goals) > 1 and thor.places[0].floor.free.sum() > 100
    assert thor.observe().depth.any()
    thor.close()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_sixteen_engines_work_at_once():
    env = NavigationEnv(EnvConfig(scenes=(SCENE,), num_envs=16, size=SIZE,
                                  actions=ROBOT.action_names, max_decisions=20))
    assert len({agent.engine.process.pid for agent in env.simulator.agents}) == 16
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(40):
        _, _, _, _, info = env.step(rng.integers(0, 4, 16))
    assert len({tuple(pose) for pose in info['pose']}) == 16
    env.close()
