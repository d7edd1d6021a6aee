"""A simulator in one file of its own trains, is measured and driven; nothing else changes."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from examples import corridor
from vn_nav import cli
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import random_actor, run_episodes
from vn_nav.evaluation.metrics import summarise
from vn_nav.report.tables import row_line
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator, simulator_class, table

ROOT = Path(__file__).resolve().parents[2]
SCENE = 'examples.corridor:5'
ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
BASE = corridor.CorridorSimulator
CAN = BASE.capabilities


def make(kind=BASE, capabilities=None, **options):
    """An environment about a simulator that differs from the corridor."""
    options = {'num_envs': 4, 'size': 24} | options
    simulator = kind([corridor.Corridor(SCENE, 5)], Setup(
        options['num_envs'], ROBOT, options['size']))
    simulator.capabilities = capabilities or CAN
    return NavigationEnv(EnvConfig(scenes=(SCENE,), **options), ROBOT, simulator=simulator)


@pytest.mark.slow
def test_an_environment_opens_it_by_name_and_its_shortest_path_arrives():
    env = NavigationEnv(EnvConfig(scenes=(SCENE, 'examples.corridor:8'), num_envs=8, size=24,
                                  max_decisions=80, privileged=('depth', 'segmentation')))
    assert env.simulator_name == 'examples.corridor' and env.world_version == '1'
    episodes = run_episodes(env, lambda seen, reset: env.oracle_actions(), 16, seed=0,
                            robot=RobotSpec())
    figures = summarise(episodes)
    assert figures['success'] > 0.9 and figures['spl'] > 0.5
    assert {e.scene for e in episodes} == {SCENE, 'examples.corridor:8'}
    env.close()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_the_commands_train_and_measure_it(tmp_path, capsys):
    out, figures, page = tmp_path / 'run', tmp_path / 'figures.json', tmp_path / 'page.html'
    assert cli.main(['train', '--scene', SCENE, '--frames', '3000', '--size', '36', '--set',
                     'pair_minutes=0', '--threads', '1', '--no-tensorboard',
                     '--out', str(out)]) == 0
    assert cli.main(['evaluate', str(out / 'checkpoint'), '--episodes', '4', '--max-decisions',
                     '20', '--json', str(figures), '--html', str(page)]) == 0
    result = json.loads(figures.read_text())
    assert result['simulator'] == 'examples.corridor' and result['world_version'] == '1'
    assert list(result['splits']['seen_goals']['scenes']) == [SCENE]
    assert 'shortest path' in result['splits']['seen_goals']['rows']['arrival']
    assert SCENE in page.read_text() and page.read_text().count('<svg')
    assert SCENE in (out / 'checkpoint' / 'README.md').read_text()
    capsys.readouterr()
    assert cli.main(['evaluate', str(out / 'checkpoint'), '--split', 'unseen_goals']) == 2
    assert 'goal_seed' in capsys.readouterr().err  # other goals than its own it has not
    assert cli.main(['evaluate', str(out / 'checkpoint'), '--split', 'test']) == 2
    assert cli.main(['train', '--scene', SCENE, '--house', '3', '--out', str(tmp_path / 'x')]) == 2


def test_a_robot_drives_in_it_and_is_refused_where_it_cannot():
    robot = SimulatedRobot(SCENE, robot=RobotSpec(), size=24, noise=False, seed=1)
    robot.begin_episode(0)
    before = robot.pose.copy()
    for _ in range(20):
        robot.drive(np.array([0.0, 0.0, 0.5, 0.0]))
    assert robot.pose[2] != before[2] and np.array_equal(robot.pose[:2], before[:2])
    robot.close()
    with pytest.raises(UserError, match='light'):
        SimulatedRobot(SCENE, robot=RobotSpec(), randomisation=load_randomisation('standard'))


@pytest.mark.ros
@pytest.mark.slow
def test_the_bridge_drives_it_over_ros(tmp_path, monkeypatch):
    pytest.importorskip('rclpy')
    from bridged import bridged
    from geometry_msgs.msg import Twist
    from ros_harness import wait_until
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    with bridged(SCENE, tmp_path / 'log', size=24, noise=False) as bridge:
        facts, heard = bridge.facts, bridge.heard
        assert facts['scene'] == SCENE and facts['simulator'] == 'examples.corridor'
        assert facts['world_version'] == '1' and len(facts['goals']) == 4
        assert heard['image_raw'][-1].width == heard['goal_image'][-1].width == 24
        topics = {name for name, _ in bridge.node.get_topic_names_and_types()}
        assert '/labels/names' in topics and '/scan' not in topics  # it knows no walls
        turn = Twist()
        turn.angular.z = 0.5
        first = heard['ground_truth/odom'][0].pose.pose.orientation

        def turned():
            bridge.command.publish(turn)
            bridge.spin()
            now = heard['ground_truth/odom'][-1].pose.pose.orientation
            return abs(now.z - first.z) + abs(now.w - first.w) > 0.1
        wait_until(turned, lambda: None)


class Paying(BASE):
    """Pays a lap of its own: beyond 3 m; and ends at 4 m."""

    def move(self, delta, env_ids=None):
        motion = super().move(delta, env_ids)
        x = self.poses[self._all if env_ids is None else env_ids, 0]
        return motion._replace(reward=np.where(x > 3, 2.0, -0.5).astype(np.float32),
                               ended=x > 4)


def test_a_simulator_that_pays_itself_is_believed():
    env = make(Paying, dataclasses.replace(CAN, rewards=True), max_decisions=40, noise=False)
    env.reset(seed=0)
    ended = np.zeros(4, bool)
    for _ in range(60):
        seen, reward, terminated, truncated, info = env.step(env.oracle_actions())
        x, acting = info['pose'][:, 0], ~info['reset']
        assert np.array_equal(reward[acting], np.where(x > 3, 2.0, -0.5)[acting])
        assert np.array_equal(seen['last_reward'][acting], reward[acting])
        assert np.array_equal(terminated[acting], (x > 4)[acting]) and (~terminated[~acting]).all()
        assert np.array_equal(info['success'], terminated)
        ended |= terminated
    for options in ({'stop': 'declared'}, {'task': 'collect'}):
        with pytest.raises(UserError):
            make(Paying, dataclasses.replace(CAN, rewards=True), **options)


class Grid(BASE):
    """Writes down what it is asked for."""

    asked = ()

    def move(self, delta, env_ids=None):
        self.asked = (*self.asked, delta.copy())
        return super().move(delta, env_ids)


def test_on_a_grid_nothing_is_noisy_or_slips():
    rough = dataclasses.replace(load_randomisation('none'), motion_scale=(0.8, 0.9), slip=0.5)
    whole = np.array([[a.dx, a.dy, a.dyaw, a.dpitch] for a in ROBOT.actions])
    for continuous in (True, False):
        env = make(Grid, dataclasses.replace(CAN, continuous=continuous), randomisation=rough)
        env.reset(seed=0)
        for action in range(4):
            env.step(np.full(4, action))
        exact = [np.array_equal(delta, whole[[k] * 4])
                 for k, delta in enumerate(env.simulator.asked)]
        assert all(exact) if not continuous else not any(exact)


class Wayless(corridor.Corridor):
    """Nobody knows the ways."""

    def distance_to(self, goal):
        return None


def test_where_nobody_knows_the_ways_figures_are_dashes():
    can = dataclasses.replace(CAN, geodesic=False)
    simulator = BASE([Wayless(SCENE, 5)], Setup(4, ROBOT, 24))
    simulator.capabilities = can
    env = NavigationEnv(EnvConfig(num_envs=4, size=24, max_decisions=20, noise=False), ROBOT,
                        simulator=simulator)
    figures = summarise(run_episodes(env, random_actor(env, 0), 8, seed=0, robot=RobotSpec()))
    assert figures['spl'] is None and figures['start_distance'] is None
    assert 'SPL -' in row_line('random', figures, 'arrival')
    json.dumps(figures, allow_nan=False)
    _, info = env.reset(seed=1)  # arrival is judged by the straight line
    simulator.place(np.arange(4), env.goal_poses[info['goal']])
    assert env.step(np.full(4, env.action_names.index('backward')))[4]['success'].all()
    with pytest.raises(UserError, match='knows ways'):
        env.oracle_actions()
    for options in ({'progress_reward': 1.0}, {'privileged': ('oracle_action',)}):
        with pytest.raises(UserError, match='knows ways'):
            make(capabilities=can, **options)


class Spawning(BASE):
    """Puts its robots where it likes."""

    def spawn(self, env_ids, keys):
        self.poses[env_ids] = 0.0
        self.poses[env_ids, 0] = 1.0 + (keys % np.uint64(3)).astype(float)


def test_a_simulator_that_puts_its_robots_itself():
    can = dataclasses.replace(CAN, teleport=False)
    env = make(Spawning, can)
    _, info = env.reset(seed=0)
    assert set(info['pose'][:, 0]) <= {1.0, 2.0, 3.0} and not info['pose'][:, 1].any()
    assert np.array_equal(env.reset(seed=0)[1]['pose'], info['pose'])
    assert not env.restorable
    with pytest.raises(UserError, match='state'):
        env.get_state()
    with pytest.raises(UserError, match='spawn'):
        make(capabilities=can).reset(seed=0)


@pytest.mark.slow
def test_an_installed_package_adds_a_simulator_by_name(tmp_path):
    facts = tmp_path / 'corridors-0.1.dist-info'
    facts.mkdir()
    (facts / 'METADATA').write_text('Metadata-Version: 2.1\nName: corridors\nVersion: 0.1\n')
    (facts / 'entry_points.txt').write_text('[vn_nav.simulators]\ncorridor = examples.corridor\n')
    environment = {**os.environ, 'PYTHONPATH': f'{ROOT}{os.pathsep}{tmp_path}'}
    done = subprocess.run([sys.executable, '-c', 'from vn_nav.cli import main; import sys; '
                           'sys.exit(main(["simulators"]))'], capture_output=True, text=True,
                          env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 'corridor: of the package corridors' in done.stdout
    code = ('from vn_sim_bridge.simulators import open_simulator; '
            'from vn_sim_bridge.simulator import Setup; from vn_nav.robot import RobotSpec; '
            'print(open_simulator(["corridor:5"], Setup(1, RobotSpec(), 24)).places[0].name)')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          env=environment, cwd=tmp_path)
    assert done.stdout.strip() == 'corridor:5', done.stderr


def test_what_is_missing_is_one_line_with_the_command(monkeypatch, capsys):
    from vn_sim_bridge import simulators
    with pytest.raises(UserError, match='house, bag'):
        simulator_class('gazebo')
    with pytest.raises(UserError, match='PYTHONPATH'):
        simulator_class('nowhere.corridor')
    with pytest.raises(UserError, match='SIMULATOR'):
        simulator_class('vn_nav.robot')
    with pytest.raises(UserError, match='one simulator'):
        open_simulator(['house:1', SCENE], Setup(1, ROBOT))
    lacking = simulators.Entry('vn_sim_bridge.simulators.far', 'far away', 'far:away',
                               ('no_such_module',), "pip install 'vn_nav[far]'")
    monkeypatch.setitem(simulators.TABLE, 'far', lacking)
    with pytest.raises(UserError, match=r"no_such_module.*pip install 'vn_nav\[far\]'"):
        simulator_class('far')
    assert cli.main(['simulators']) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in table()) and "pip install 'vn_nav[far]'" in told
    assert max(map(len, told.splitlines())) <= 80


@pytest.mark.slow
def test_the_table_imports_nothing_before_it_is_asked():
    code = ('import sys; import vn_sim_bridge.simulators as s; s.table(); '
            'print([m for m in sys.modules if m.startswith("vn_sim_bridge.simulators.")])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == '[]', done.stderr


class ExactTurns(BASE):
    exact_turns = True


@pytest.mark.parametrize('kind', [BASE, ExactTurns])
def test_a_simulator_says_whether_motion_noise_is_on_turns(kind, monkeypatch):
    env = make(kind, actions=ROBOT.action_names)
    env.reset(seed=0)
    before = env.simulator.poses.copy()
    env.step(np.full(4, ROBOT.action_names.index('rotate_left')))
    turned = env.simulator.poses[:, 2] - before[:, 2]
    wanted = next(a.dyaw for a in ROBOT.actions if a.name == 'rotate_left')
    off = np.abs(np.sin((turned - wanted) / 2))
    assert (off < 1e-12).all() if kind.exact_turns else (off > 1e-5).all()
    before = env.simulator.poses.copy()
    _, _, _, _, info = env.step(np.full(4, ROBOT.action_names.index('backward')))
    gone = np.hypot(*(env.simulator.poses - before)[:, :2].T)
    free = ~info['collided']
    assert free.any() and (np.abs(gone[free] - 0.2) > 1e-6).all(), 'translations have it'
    env.close()
    # A robot that is driven by velocities likewise, and its odometry expects no other error.
    monkeypatch.setattr(corridor, 'SIMULATOR', kind)
    robot = SimulatedRobot(SCENE, robot=RobotSpec(), size=24, noise=True, seed=1)
    robot.begin_episode(0)
    for _ in range(20):
        robot.tick(np.array([0.0, 0.0, 0.5, 0.0]))
    drift = abs(float(np.sin((robot.pose[2] - robot.odometry[2]
                              - robot.episode.start[2]) / 2)))
    assert drift < 1e-9 if kind.exact_turns else drift > 1e-4
    assert (robot.uncertainty.pose[2, 2] < 1e-7) == kind.exact_turns
    robot.close()


def test_every_capability_is_read():
    sources = [path.read_text() for folder in ('navigation', 'robot', '.')
               for path in (ROOT / 'vn_sim_bridge' / folder).glob('*.py')]
    for field in dataclasses.fields(corridor.CorridorSimulator.capabilities):
        assert any(f'can.{field.name}' in text or f'capabilities.{field.name}' in text
                   for text in sources), f'nobody reads {field.name}'
