"""Gymnasium environments as scenes: native actions, rewards and ends; figures without ways."""

import contextlib
import functools
import importlib.util
import json

import gymnasium
import numpy as np
import pytest
from conformance import SIZE, OwnConformance
from gymnasium import spaces

from vn_nav import cli
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import measure, random_actor, run_episodes
from vn_nav.evaluation.metrics import summarise
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.report.tables import row_line
from vn_nav.robot import RobotSpec
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator, robot_for

CORRIDOR = 'test/Corridor-v0'
SCENE = f'gym:{CORRIDOR}'


class Corridor(gymnasium.Env):
    """Five squares in a row: 1 at the right end, -1 at the left one; cut off after nine steps.

    Args:
        kind: where the picture is: 'box', 'dict', 'render', or nowhere ('none').
    """

    metadata = {'render_modes': ['rgb_array'], 'render_fps': 10}

    def __init__(self, kind='box', render_mode=None, start=1, names=True, reward=1.0):
        self.kind, self.render_mode, self.reward = kind, render_mode, reward
        picture = spaces.Box(0, 255, (24, 32, 3), np.uint8)
        self.observation_space = {
            'box': picture, 'dict': spaces.Dict({'speed': spaces.Box(-1, 1, (2,)),
                                                 'view': picture})}.get(
            kind, spaces.Box(-1, 1, (2,)))
        self.action_space = spaces.Discrete(3, start=start)
        self.names = names

    def __getattr__(self, name):
        if name == 'get_action_meanings' and self.__dict__.get('names'):
            return lambda: ['LEFT', 'STAY', 'RIGHT']
        raise AttributeError(name)

    def _picture(self):
        return np.full((24, 32, 3), (40 * self.at, self.steps, 7), np.uint8)

    def _observation(self):
        return {'box': self._picture(), 'dict': {
            'speed': np.zeros(2, np.float32), 'view': self._picture()}}.get(
            self.kind, np.zeros(2, np.float32))

    def render(self):
        return self._picture() if self.kind != 'none' else np.zeros((3, 24, 24), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = int(self.np_random.integers(1, 4)), 0
        return self._observation(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.at, self.steps = self.at + int(action) - int(self.action_space.start) - 1, (
            self.steps + 1)
        ended = self.at in (0, 4)
        return (self._observation(), self.reward * {0: -1.0, 4: 1.0}.get(self.at, 0.0), ended,
                self.steps >= 9 and not ended, {})


@pytest.fixture(autouse=True, scope='module')
def registered():
    for name, options in (('Corridor', {}), ('Dict', {'kind': 'dict'}),
                          ('Render', {'kind': 'render'}), ('Blind', {'kind': 'none'}),
                          ('Nameless', {'names': False}), ('Nan', {'reward': np.nan})):
        gymnasium.register(f'test/{name}-v0', entry_point=Corridor, kwargs=options,
                           disable_env_checker=True)
    yield
    for name in [name for name in gymnasium.registry if name.startswith('test/')]:
        del gymnasium.registry[name]


class Own(OwnConformance):
    """The contract, of one or more scenes; their actions are the robot's."""

    scenes = (SCENE,)

    @functools.cached_property
    def robot(self):  # asking for it starts an environment
        return robot_for(self.scenes)

    def make(self, num_envs, size=SIZE):
        return open_simulator(self.scenes, Setup(num_envs, self.robot, size))


class TestGym(Own):
    scenes = (SCENE, 'gym:test/Render-v0')


def env_of(scene=SCENE, **options):
    return NavigationEnv(EnvConfig(scenes=(scene,), **{'num_envs': 4, 'size': 24} | options))


@pytest.mark.parametrize('name', ['Corridor', 'Dict', 'Render'])
def test_pictures_rewards_ends_and_actions_are_its_own(name):
    env = env_of(f'gym:test/{name}-v0')
    assert env.action_names == ('left', 'stay', 'right')
    seen, _ = env.reset(seed=0)
    assert env.observation_space.contains(seen)
    assert (env.goals == 128).all()
    at = seen['image'][:, 0, 0, 0] // 40
    assert set(at) <= {1, 2, 3}
    ends = np.zeros(3, int)
    rng = np.random.default_rng(0)
    steps = np.zeros(4, int)
    for _ in range(200):
        actions = rng.integers(0, 3, 4)
        seen, reward, terminated, truncated, info = env.step(actions)
        begun = info['reset']
        now = np.where(begun, seen['image'][:, 0, 0, 0] // 40, at + actions - 1)
        steps = np.where(begun, 0, steps + 1)
        assert np.array_equal(seen['image'][:, 0, 0, 0], 40 * now)
        assert np.array_equal(seen['image'][:, 1, 5, 5], steps)
        assert np.array_equal(reward, np.where(begun, 0, (now == 4) * 1.0 - (now == 0)))
        assert np.array_equal(terminated, ~begun & ((now == 4) | (now == 0)))
        assert np.array_equal(truncated, ~begun & ~terminated & (steps >= 9))
        assert np.array_equal(info['success'], ~begun & (now == 4))
        assert not info['collided'].any()
        ends += [terminated.sum(), truncated.sum(), info['success'].sum()]
        at = now
    assert (ends > 0).all()
    env.close()
    env.close()


def test_the_same_seed_is_the_same_again():
    found = []
    for _ in range(2):
        env = env_of()
        rows = [env.reset(seed=5)[0]['image']]
        rows += [env.step(np.full(4, k % 3))[0]['image'] for k in range(30)]
        found.append(np.stack(rows))
        env.close()
    assert np.array_equal(*found)


def test_what_it_has_not_is_refused():
    for options in ({'task': 'collect'}, {'privileged': ('oracle_action',)},
                    {'actions': ('forward', 'left')}):
        with pytest.raises(UserError):
            env_of(**options)
    env = env_of(actions=('right', 'left'))  # some of them, in another order
    seen, _ = env.reset(seed=0)
    moved = env.step(np.zeros(4, int))[0]['image'][:, 0, 0, 0] - seen['image'][:, 0, 0, 0]
    assert (moved == 40).all()
    env.close()
    with pytest.raises(UserError, match='actions of its own'):  # of no house
        NavigationEnv(EnvConfig(num_envs=1), robot_for([SCENE]))
    with pytest.raises(UserError, match='motions'):
        SimulatedRobot(SCENE, robot=robot_for([SCENE]))
    with pytest.raises(UserError, match='left, stay, right'):
        open_simulator([SCENE], Setup(1, RobotSpec(), 24))


def test_nameless_actions_have_numbers():
    assert robot_for(['gym:test/Nameless-v0']).action_names == ('action_0', 'action_1', 'action_2')


@pytest.mark.parametrize('name, words', [
    ('NoSuch-v0', 'NoSuch'), ('test/Blind-v0', 'picture'), ('CartPole-v1', 'pygame'),
    ('Pendulum-v1', 'discrete'), ('no_such_module:Thing-v0', 'no_such_module')])
def test_what_does_not_fit_is_one_line_at_the_start(tmp_path, capsys, name, words):
    if name == 'CartPole-v1' and importlib.util.find_spec('pygame'):
        words = ''  # it has no picture of its own, but draws one
        robot_for([f'gym:{name}'])
        return
    assert cli.main(['train', '--scene', f'gym:{name}', '--out', str(tmp_path / 'run')]) == 2
    told = capsys.readouterr().err
    assert told.count('\n') == 1 and words in told


def test_a_reward_that_is_no_number_is_refused():
    env = env_of('gym:test/Nan-v0')
    env.reset(seed=0)
    with pytest.raises(UserError, match='finite'):
        env.step(np.zeros(4, int))
    env.close()


def test_figures_without_ways_are_dashes():
    env = env_of()
    figures = summarise(run_episodes(env, random_actor(env, 0), 40, seed=0, robot=env.robot))
    assert 0 < figures['success'] < 1 and figures['return'] != 0
    for name in ('spl', 'start_distance', 'stop_error_m', 'stop_error_deg', 'seconds'):
        assert figures[name] is None, name
    line = row_line('random', figures, 'arrival')
    assert all(words in line for words in ('SPL -', 'stop error -', 'seconds -'))
    json.dumps(figures, allow_nan=False)
    env.close()


def test_no_stop_is_declared_where_the_simulator_ends_its_episodes():
    def make(scenes, environments, stop):
        return env_of(num_envs=environments, stop=stop, size=36)
    with contextlib.closing(env_of(size=36)) as env:
        network = build_policy(NetworkConfig(actions=env.action_names, size=36,
                                             heads=('arrival',)))
    with pytest.raises(UserError, match='progress_reward needs a simulator that knows ways'):
        env_of(progress_reward=1.0)
    rows = measure(make, network, [SCENE], decoding='sample', episodes=4, controls=())
    assert list(rows) == ['arrival']


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_commands_learn_it(tmp_path, capsys):
    """The right end pays: a policy that knows it gets there every time."""
    out, figures, page = tmp_path / 'run', tmp_path / 'figures.json', tmp_path / 'page.html'
    assert cli.main(['train', '--preset', 'fast', '--scene', SCENE, '--envs', '16', '--frames',
                     '20000', '--size', '36', '--no-tensorboard', '--out', str(out)]) == 0
    told = capsys.readouterr().out
    assert 'distance is left out' in told and 'arrival is left out' in told
    assert cli.main(['evaluate', str(out / 'checkpoint'), '--episodes', '32', '--json',
                     str(figures), '--html', str(page)]) == 0
    rows = json.loads(figures.read_text())['splits']['seen_goals']['rows']['arrival']
    assert list(rows) == ['right goal, sample', 'right goal, greedy', 'random actions']
    assert rows['right goal, sample']['success'] > 0.9 > rows['random actions']['success'] + 0.2
    assert 'SPL' in page.read_text()
    # A robot's file has no such actions.
    assert cli.main(['evaluate', str(out / 'checkpoint'), '--scene', 'house:3', '--episodes',
                     '1']) == 2


REAL = [('gym:MiniWorld-Hallway-v0', 'miniworld', 'turn_left'),
        ('gym:VizdoomBasic-v1', 'vizdoom', 'attack')]


def real(scene, module):
    """An environment of an extra, if this machine has it and what it draws with."""
    if importlib.util.find_spec(module) is None:
        pytest.skip(f'expected: {module} is an extra of its own')
    try:
        return env_of(scene, num_envs=3, size=42)
    except UserError as error:
        if 'ImportError' in str(error) or 'NoSuchConfig' in str(error):
            pytest.skip(f'expected: no OpenGL here ({error})')
        raise


class RealOne(Own):
    growth_robots = 1

    @classmethod
    def setup_class(cls):
        real(cls.scenes[0], cls.module).close()


@pytest.mark.slow
@pytest.mark.timeout(600)
class TestMiniWorld(RealOne):
    scenes, module = (REAL[0][0],), REAL[0][1]


@pytest.mark.slow
@pytest.mark.timeout(600)
class TestVizdoom(RealOne):
    scenes, module = (REAL[1][0],), REAL[1][1]


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize('scene, module, action', REAL)
def test_the_real_ones_step(scene, module, action):
    env = real(scene, module)
    assert action in env.action_names
    first = env.reset(seed=1)[0]['image'].copy()
    assert np.array_equal(env.reset(seed=1)[0]['image'], first)  # of equal seeds
    assert first.std() > 3
    rng, changed, ended, paid = np.random.default_rng(0), 0, 0, 0.0
    before = first
    for _ in range(400):
        seen, reward, terminated, truncated, info = env.step(
            rng.integers(0, len(env.action_names), 3))
        assert np.isfinite(reward).all()
        changed += int((seen['image'] != before).any())
        before, paid = seen['image'].copy(), paid + float(np.abs(reward).sum())
        ended += int((terminated | truncated).sum())
    assert changed > 100 and ended >= 1
    assert paid > 0
    env.close()
