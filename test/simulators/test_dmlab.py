"""DeepMind Lab with its engine: our levels, the contract, native rewards, engines that crash."""

import os
import signal
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from conformance import GROWTH_MB, SIZE, Conformance

from vn_nav import cli
from vn_nav.errors import EnvironmentLost, UserError
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.dmlab import install
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators.dmlab import LabSimulator

LACKING = install.missing()
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900), pytest.mark.skipif(
    bool(LACKING), reason=f'expected: {"; ".join(LACKING)} (vn_nav simulators install dmlab)')]
ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
KILLS = 10


def opened(*scenes, num_envs=1, size=SIZE):
    return LabSimulator.open([parse_scene(scene) for scene in scenes],
                             Setup(num_envs, ROBOT, size))


def environment(scene, num_envs=2, **options):
    return NavigationEnv(EnvConfig(scenes=(scene,), num_envs=num_envs, size=SIZE, **options))


def processes(simulator):
    return [engine.process for engine in simulator.engines.engines]


@pytest.fixture
def arena():
    simulator = opened('dmlab:arena?apples=5&lemons=4&decisions=40', num_envs=1)
    yield simulator
    simulator.close()


class TestMaze(Conformance):

    def make(self, num_envs, size=SIZE):
        return opened('dmlab:maze?seed=3', num_envs=num_envs, size=size)


class TestHouse(Conformance):

    def make(self, num_envs, size=SIZE):
        return opened('dmlab:house', num_envs=num_envs, size=size)


def test_fruit_pays_once_and_the_arena_ends_after_its_decisions(arena):
    arena.spawn(np.array([0]), np.array([7], np.uint64))
    cells, _ = arena.places[0].starts()
    paid, ends = [], []
    for x, y in cells[::len(cells) // 39][:40]:
        arena.place(np.array([0]), np.array([[x, y, 0.0, 0.0]]))
        motion = arena.move(np.zeros((1, 4)))
        paid.append(float(motion.reward[0]))
        ends.append(bool(motion.ended[0]))
    assert set(paid) <= {-2.0, -1.0, 0.0, 1.0, 2.0, 3.0} and min(paid) < 0 < max(paid)
    assert ends == [False] * 39 + [True]


def test_all_fruit_of_an_episode_is_found_and_a_seed_puts_it_there_again():
    simulator = opened('dmlab:arena?apples=5&lemons=2&decisions=5000')
    cells, _ = simulator.places[0].starts()
    sums = []
    for key in (11, 12, 11):
        simulator.spawn(np.array([0]), np.array([key], np.uint64))
        start, first = simulator.poses.copy(), simulator.observe().rgb.copy()
        total = 0.0
        for x, y in cells[(np.round(cells * 10) % 4 < 1.5).all(axis=1)]:
            simulator.place(np.array([0]), np.array([[x, y, 0.0, 0.0]]))
            total += float(simulator.move(np.zeros((1, 4))).reward[0])
        sums.append((start, first, total))
    assert [total for *_, total in sums] == [3.0] * 3
    assert np.array_equal(sums[0][0], sums[2][0]) and np.array_equal(sums[0][1], sums[2][1])
    assert not np.array_equal(sums[0][1], sums[1][1])
    simulator.close()


def test_an_episode_of_the_arena_is_the_engines():
    env = environment('dmlab:arena?decisions=12')
    env.reset(seed=1)
    rewards, ended = [], 0
    rng = np.random.default_rng(0)
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(rng.integers(0, 4, 2))
        assert not truncated.any()
        assert (info['decisions'][terminated] == 12).all()
        rewards.append(reward)
        ended += int(terminated.sum())
    assert ended >= 6 and np.abs(rewards).max() >= 1
    env.close()


def test_nothing_leads_the_robot_to_a_goal_where_fruit_is_the_task(tmp_path, capsys):
    with pytest.raises(UserError, match='pays itself takes no progress_reward'):
        environment('dmlab:arena', progress_reward=1.0)
    assert cli.main(['train', '--preset', 'fast', '--scene', 'dmlab:arena', '--envs', '2',
                     '--frames', '100', '--no-tensorboard', '--out', str(tmp_path)]) == 0
    told = capsys.readouterr().out
    for name in ('progress_reward', 'goal_pose', 'arrival', 'distance', 'pair_minutes'):
        assert f'{name} is left out' in told, name


@pytest.mark.parametrize('scene', ['dmlab:house', 'dmlab:maze?seed=5'])
def test_walls_of_the_engine_stand_where_the_map_says(scene):
    simulator = opened(scene)
    cells, _ = simulator.places[0].starts()
    rng = np.random.default_rng(1)
    worst = []
    for x, y in cells[rng.integers(0, len(cells), 30)]:
        simulator.place(np.array([0]), np.array([[x, y, 0.0, 0.0]]))
        headings = rng.uniform(-3, 3, 8)
        ours = np.hypot(*(simulator.reach(0, headings, 3.0) - (x, y)).T)
        theirs = np.minimum(simulator._free(np.array([0]), headings[None],
                                            np.array([3.0]))[0], 3.0)
        worst.append(np.abs(ours - theirs))
    # Rays side by side may miss a corner that is grazed.
    assert np.median(worst) < 0.005 and np.quantile(worst, 0.95) < 0.03
    simulator.close()


def test_depth_is_metres():
    simulator = opened('dmlab:maze?seed=3', size=84)
    cells, _ = simulator.places[0].starts()
    rng = np.random.default_rng(2)
    gaps = []
    for x, y in cells[rng.integers(0, len(cells), 40)]:
        for yaw in (0.0, np.pi / 2, np.pi, -np.pi / 2):
            simulator.place(np.array([0]), np.array([[x, y, yaw, 0.0]]))
            reach = simulator.reach(0, np.array([yaw]), 4.0)[0]
            wall = np.hypot(*(reach - (x, y))) + ROBOT.footprint_radius
            if wall < 2.0:
                gaps.append((simulator.observe().depth[0, 42, 42] - wall) / wall)
    # A corner may stop the robot's rim beside what its camera sees ahead.
    assert len(gaps) > 40 and np.abs(np.median(gaps)) < 0.03
    assert np.quantile(np.abs(gaps), 0.9) < 0.1
    simulator.close()


def test_a_size_that_the_engine_has_not_is_made_of_a_larger_one():
    one, other = opened('dmlab:house', size=42), opened('dmlab:house', size=84)
    poses = np.array([other.places[0].goals[0].pose])
    small, large = (simulator.view(np.array([0]), poses) for simulator in (one, other))
    assert small.rgb.shape == (1, 3, 42, 42) and small.depth.shape == (1, 42, 42)
    halved = large.rgb.reshape(1, 3, 42, 2, 42, 2).mean(axis=(3, 5))
    assert np.abs(small.rgb - halved).mean() < 12
    one.close()
    other.close()


def test_more_mazes_than_engines():
    env = NavigationEnv(EnvConfig(scenes=tuple(f'dmlab:maze?seed={k}&size=5' for k in range(4)),
                                  num_envs=2, size=SIZE, max_decisions=2))
    env.reset(seed=0)
    seen = set()
    for step in range(15):
        env.step(np.full(2, step % 4))
        seen |= set(env.place_index.tolist())
    assert seen == {0, 1, 2, 3}
    env.close()


def test_a_level_of_the_engine():
    simulator = opened('dmlab:custom/house', num_envs=2)
    assert not simulator.capabilities.geodesic and len(simulator.places[0].goals) >= 2
    start = np.array([goal.pose for goal in simulator.places[0].goals])[[0, 1]]
    simulator.place(np.arange(2), start)
    for _ in range(40):
        motion = simulator.move(np.array([[0.5, 0.0, 0.0, 0.0]] * 2))
    assert motion.collided.all() and np.abs(motion.delta[:, 0]).max() < 0.02
    assert np.hypot(*(simulator.poses[:, :2] - start[:, :2]).T).max() < 7.0  # of a room
    assert len(np.unique(simulator.observe().rgb)) > 20
    simulator.close()


def test_a_map_of_the_users_is_found_and_played(tmp_path, monkeypatch):
    opened('dmlab:arena').close()  # its compiled map is in the cache now
    for path in install.cache_folder().iterdir():
        with zipfile.ZipFile(path) as archive:
            if 'maps/vn_arena.bsp' in archive.namelist():
                (tmp_path / 'seekavoid_arena_01.bsp').write_bytes(
                    archive.read('maps/vn_arena.bsp'))
    monkeypatch.setenv(install.MAPS, str(tmp_path))
    env = environment('dmlab:seekavoid_arena_01', num_envs=1)
    env.reset(seed=0)
    poses, ended = [], False
    for step in range(200):
        *_, terminated, _, info = env.step(np.array([step % 3 and 2]))
        poses.append(info['pose'][0])
        ended = ended or bool(terminated[0])
    assert ended, 'the level itself ends after 60 s'
    assert np.ptp(np.array(poses)[:, :2], axis=0).max() > 0.5
    env.close()


def test_a_genuine_deepmind_lab_works_through_the_same_worker(tmp_path, monkeypatch):
    """A package of that name, around the engine that is here."""
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', str(tmp_path / 'own')],
                   check=True)
    (site,) = (tmp_path / 'own').glob('lib/python3*/site-packages')
    (installed,) = install.folder().glob('lib/python3*/site-packages')
    (site / 'engine.pth').write_text(f'{installed}\n')
    (site / 'deepmind_lab').mkdir()
    (site / 'deepmind_lab' / '__init__.py').write_text(f"""
import importlib.machinery, importlib.util, sys
loader = importlib.machinery.ExtensionFileLoader(
    'dmhouse', {str(installed / 'dmhouse' / 'deepmind_lab.so')!r})
engine = importlib.util.module_from_spec(importlib.util.spec_from_loader('dmhouse', loader))
sys.modules['dmhouse'] = engine
loader.exec_module(engine)
engine.set_runfiles_path({str(installed / 'dmhouse')!r})
Lab = engine.Lab
""")
    monkeypatch.setenv(install.PYTHON, str(tmp_path / 'own' / 'bin' / 'python'))
    simulator = opened('dmlab:house')
    simulator.place(np.array([0]), np.array([simulator.places[0].goals[0].pose]))
    assert len(np.unique(simulator.observe().rgb)) > 20
    simulator.close()


@pytest.mark.parametrize('scene', ['dmlab:house', 'dmlab:arena'])
def test_an_engine_that_crashes_truncates_its_episode_and_goes_on(scene):
    env = environment(scene)
    env.reset(seed=0)
    env.step(np.array([2, 2]))
    processes(env.simulator)[1].kill()
    _, reward, terminated, truncated, _ = env.step(np.array([2, 2]))
    assert truncated.tolist() == [False, True] and not terminated.any()
    *_, info = env.step(np.array([2, 2]))
    assert info['reset'].tolist() == [False, True]
    for _ in range(5):
        *_, truncated, _ = env.step(np.array([2, 2]))
        assert not truncated.any()
    assert env.simulator.engines.restarts == 1
    env.close()


def test_an_engine_that_hangs_counts_as_crashed():
    env = environment('dmlab:house')
    env.reset(seed=0)
    env.simulator.engines.patience = 5.0
    hung = processes(env.simulator)[0]
    os.kill(hung.pid, signal.SIGSTOP)
    *_, truncated, _ = env.step(np.array([2, 2]))
    assert truncated.tolist() == [True, False]
    assert hung.poll() is not None  # ended, not left behind
    env.close()


def test_engines_that_never_start_end_the_run_in_one_line(monkeypatch):
    simulator = opened('dmlab:house')
    simulator.engines.python = Path('/bin/false')
    processes(simulator)[0].kill()
    with pytest.raises(EnvironmentLost, match='failures in a row'):
        simulator.observe()
    simulator.close()


def test_closing_leaves_no_process_and_no_file():
    simulator = opened('dmlab:house', num_envs=2)
    folder, ours = simulator.engines._folder, processes(simulator)
    simulator.close()
    simulator.close()
    assert not folder.exists() and all(process.poll() is not None for process in ours)


def test_an_engine_does_not_grow():
    simulator = opened('dmlab:arena?decisions=50')
    (process,) = processes(simulator)

    def resident():
        status = Path(f'/proc/{process.pid}/status').read_text()
        return int(status.split('VmRSS:')[1].split()[0]) / 1024

    rng, begun = np.random.default_rng(0), 0.0
    for step in range(10_000):
        if step % 50 == 0:
            simulator.spawn(np.array([0]), np.array([step], np.uint64))
        turn = rng.uniform(-0.5, 0.5)
        simulator.move(np.array([[0.2, 0.0, turn, 0.0]]))
        if step == 2_000:
            begun = resident()
    assert resident() - begun < GROWTH_MB
    simulator.close()


def test_ten_kills_of_engines_lose_no_training(tmp_path):
    """While `vn_nav train` runs, its engines are killed one after the other."""
    command = [sys.executable, '-m', 'vn_nav.cli', 'train', '--preset', 'fast', '--scene',
               'dmlab:house', '--envs', '4', '--size', '36', '--frames', '12000',
               '--pair-minutes', '0', '--no-tensorboard', '--out', str(tmp_path / 'run')]
    training = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                                text=True, env=os.environ | {'OMP_NUM_THREADS': '1'})
    killed = set()

    def engines():
        found = []
        for folder in Path('/proc').glob('[0-9]*'):
            try:
                words = (folder / 'stat').read_text().rpartition(')')[2].split()
                line = (folder / 'cmdline').read_bytes()
            except OSError:
                continue
            if int(words[1]) == training.pid and b'worker.py' in line:
                found.append(int(folder.name))
        return sorted(set(found) - killed)

    def kill():
        rng = np.random.default_rng(0)
        while len(killed) < KILLS and training.poll() is None:
            if len(there := engines()) >= 4:
                time.sleep(rng.uniform(0.2, 1.0))
                victim = there[rng.integers(len(there))]
                os.kill(victim, signal.SIGKILL)
                killed.add(victim)
            time.sleep(0.2)

    killer = threading.Thread(target=kill)
    killer.start()
    said, _ = training.communicate()
    killer.join()
    assert training.returncode == 0, said[-3000:]
    assert len(killed) == KILLS
    assert list((tmp_path / 'run').rglob('*.safetensors')), said[-3000:]


def test_a_camera_that_the_engine_has_not_is_refused():
    import dataclasses
    robot = dataclasses.replace(ROBOT, camera_height=1.6)
    with pytest.raises(UserError, match='stands'):
        LabSimulator.open([parse_scene('dmlab:house')], Setup(1, robot, SIZE))
