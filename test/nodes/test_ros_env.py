"""Training over ROS topics: a real bridge in a process of its own, and the same learner."""

import contextlib
import dataclasses
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from geometry_msgs.msg import Twist
from ros_harness import PATIENCE, child, wait_until
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Bool, UInt8
from training_robot import Lively, Robot

from vn_msgs_py.camera import fill_camera_info
from vn_msgs_py.images import decode_rgb, fill_image
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.doctor.checks import diagnose
from vn_nav.bags.drive_cache import load_drives
from vn_nav.cli import main
from vn_nav.errors import EnvironmentLost, UserError
from vn_nav.learning.over_ros import config_over_ros
from vn_nav.learning.presets import ENVIRONMENT, preset
from vn_nav.learning.trainer import train
from vn_nav.learning.training import STATE
from vn_nav.nodes.qos import qos
from vn_nav.nodes.ros_env import RosEnv
from vn_nav.observation import preprocess
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.resources import share_file
from vn_nav.robot import DRIVE_ACTIONS, load_robot
from vn_nav.vector_env import NavigationVectorEnv
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.simulators.house import WORLD_VERSION

pytestmark = pytest.mark.ros
BASE = share_file('config/robots/demo_base.yaml')
ROBOT = load_robot(BASE).with_actions(DRIVE_ACTIONS)
FACTS = {'world_version': WORLD_VERSION, 'camera_fov_deg': 90.0, 'camera_height': 1.0}
SMALL = ['--size', '36', '--channels', '8', '8', '8', '--features', '24', '--hidden', '16',
         '--rollout-length', '8', '--robot', str(BASE), '--no-tensorboard']


@contextlib.contextmanager
def bridge(tmp_path, **parameters):
    """The simulated robot, in lock-step."""
    with child('vn_sim_bridge.bridge_node', tmp_path / 'bridge.log', **{
            'house': 7, 'rooms': 1, 'size': 36, 'robot': BASE, 'time': 'lock_step', 'seed': 3,
            'max_decisions': 6} | parameters) as process:
        yield process


@pytest.fixture
def robot():
    one = Robot()
    yield one
    one.close()


def train_words(out, *more):
    return [sys.executable, '-m', 'vn_nav.cli', 'train', '--env', 'ros', '--out', str(out),
            *SMALL, *more]


@contextlib.contextmanager
def training(tmp_path, *words):
    """`vn_nav train --env ros` as a process; what it says goes to a file."""
    with open(tmp_path / 'train.log', 'w') as log:
        process = subprocess.Popen(train_words(*words), stdout=log, stderr=subprocess.STDOUT,
                                   env=os.environ | {'OMP_NUM_THREADS': '1'})
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def said(tmp_path):
    return (tmp_path / 'train.log').read_text()


@pytest.mark.slow
def test_a_training_in_lock_step_is_recorded_and_resumed(tmp_path):
    """A few updates against the bridge; the bag is sound; it goes on where it was."""
    torch.set_num_threads(1)
    bag, rows, config = tmp_path / 'bag', [], preset(
        'fast', frames=20, rollout_length=8, channels=(8, 8, 8), features=24, hidden=16)

    def learn(env, config, **options):
        config, _ = config_over_ros(config, {}, env.offers, True)
        env.listen(config.privileged)
        return train(env, config, tmp_path / 'run', info=FACTS, on_update=rows.append, **options)
    with bridge(tmp_path):
        with RosEnv(ROBOT, 36, lock_step=True, record=bag) as env:
            loaded = load_checkpoint(learn(env, config))
            assert env.steps == loaded.info['frames'] >= 20 and env.scene['house'] == 7
        assert len(rows) >= 3 and all(np.isfinite(row['policy_loss']) for row in rows)
        assert loaded.info['world_version'] == WORLD_VERSION
        assert {'goal_pose', 'distance'} <= set(loaded.config.heads)
        goals = len(env.shown_goals)
        with RosEnv(ROBOT, 36, lock_step=True) as env:
            learn(env, dataclasses.replace(config, frames=30), resume=True)
            assert len(env.shown_goals) == goals
        assert rows[-1]['frames'] >= 30
    diagnosis = diagnose(bag, fov=ROBOT.camera_fov)
    assert diagnosis.usable, diagnosis
    drives = load_drives(bag, Wanted(ROBOT, 36), tmp_path / 'cache')
    assert len(drives) >= 15 and len(drives.goals) == goals
    driven = sum(drives.facts['actions'].values())
    assert driven >= 10 and drives.facts['misfit_share'] < 0.2, drives.facts


@pytest.mark.slow
def test_it_shows_what_the_simulator_itself_would_show(tmp_path):
    """In lock-step, noise off: the rows of `NavigationEnv` on the same starts, but for the last.

    Of an episode's end the bridge shows no picture: the one before stands in.
    """
    inner = NavigationEnv(EnvConfig(scenes=('house:7?rooms=1',), num_envs=1, size=36, noise=False,
                                    max_decisions=6, seed=3, odometry='commanded'),
                          load_robot(BASE))
    with bridge(tmp_path, noise=False), RosEnv(ROBOT, 36, lock_step=True) as env:
        assert env.num_envs == 1 and env.action_names == inner.action_names
        assert isinstance(env, NavigationVectorEnv) and env.simulator_name == 'house'
        assert env.scene_names == ['house:7?rooms=1'] and not env.restorable
        assert env.world_version == inner.world_version
        assert set(env.offers) == {'depth', 'segmentation'}
        env.listen(('depth', 'segmentation'))
        seen, info = env.reset(seed=3)
        shown, told = inner.reset(seed=3)
        assert info['reset'].all() and seen['last_action'][0] == -1
        goal = env.goals[seen['goal_index'][0]]
        assert np.array_equal(goal, inner.goals[shown['goal_index'][0]])
        assert np.array_equal(seen['image'], shown['image'])
        assert np.array_equal(seen['odometry'], np.zeros((1, 3)))
        for k, action in enumerate([2, 0, 3, 3, 0, 1]):
            before, (seen, reward, terminated, truncated, info) = seen, env.step([action])
            shown, wanted, ended, cut, told = inner.step([action])
            assert seen['last_action'][0] == action and not info['reset'].any()
            assert reward[0] == wanted[0] and terminated[0] == ended[0]
            assert truncated[0] == cut[0] == (k == 5)
            assert info['collided'][0] == told['collided'][0]
            if k < 5:
                difference = np.abs(seen['image'].astype(int) - shown['image'])
                assert (difference > 2).mean() < 0.01
                assert np.abs(seen['odometry'] - shown['odometry']).max() < 1e-3
                assert info['depth'].shape == (1, 36, 36) and info['depth'].dtype == np.float32
                assert (info['segmentation'] == seen_labels(inner)).mean() > 0.98
            else:
                assert np.array_equal(seen['image'], before['image'])
        seen, reward, terminated, truncated, info = env.step([0])
        assert info['reset'].all() and reward[0] == 0.0 and seen['last_action'][0] == -1
        assert not (terminated | truncated).any()
        assert len(env.shown_goals) >= 1 and env.steps == 6 and env.seconds > 0


def seen_labels(env):
    return env._look().labels


@pytest.mark.slow
def test_a_silent_camera_pauses_a_training_that_then_goes_on_and_at_last_ends(tmp_path):
    """The bridge is stopped (SIGSTOP), goes on, and is killed."""
    with bridge(tmp_path) as simulator, training(
            tmp_path, tmp_path / 'run', '--lock-step', '--frames', '100000', '--ros-args', '-p',
            'patience:=12.0') as process:
        wait_for(lambda: 'steps/s' in said(tmp_path), process, tmp_path)
        simulator.send_signal(signal.SIGSTOP)
        # Whatever it misses first. Not the pause of the beginning, when it has heard nothing yet.
        wait_for(lambda: re.search(
            'paused: (no (usable )?camera frame|no odometry|odometry fell silent)',
            said(tmp_path)), process, tmp_path)
        lines, pauses = (said(tmp_path).count(words) for words in ('steps/s', 'goes on after'))
        simulator.send_signal(signal.SIGCONT)
        wait_for(lambda: said(tmp_path).count('steps/s') > lines + 1, process, tmp_path)
        assert said(tmp_path).count('goes on after') > pauses
        simulator.kill()
        assert process.wait(PATIENCE) == 2, said(tmp_path)
    last = said(tmp_path).strip().splitlines()[-1]
    assert last.startswith('vn_nav: a robot is ready again within 12 s') and 'resume' in last
    assert load_checkpoint(tmp_path / 'run' / 'checkpoint').info['frames'] >= 16
    assert (tmp_path / 'run' / STATE).is_file()


def wait_for(condition, process, tmp_path, seconds=PATIENCE):
    """Until a condition holds, while the process runs."""
    until = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None and time.monotonic() < until, said(tmp_path)
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_zero_and_a_checkpoint(robot, tmp_path, number):
    """In real time, in the middle of a motion."""
    with training(tmp_path, tmp_path / 'run', '--frames', '100000', '--set',
                  'rollout_length=4') as process:
        robot.show_goal(30)

        def alive():
            assert process.poll() is None, said(tmp_path)
            robot.spin()
        wait_until(lambda: 'steps/s' in said(tmp_path) and robot.moves, alive)
        process.send_signal(number)
        sent = time.monotonic()
        wait_until(lambda: not robot.moves, robot.spin)
        assert robot.commands[-1][0] - sent < 0.5
        wait_until(lambda: process.poll() is not None, robot.spin)
        assert process.returncode == 0, said(tmp_path)
        assert not robot.moves
    assert 'goal_pose is left out' in said(tmp_path)
    assert load_checkpoint(tmp_path / 'run' / 'checkpoint').info['frames'] >= 3


@pytest.mark.parametrize('first', ['picture', 'camera'])
def test_a_goal_of_another_camera_is_cut_by_that_one(robot, first):
    """It sees 120 deg; the robot's own camera says nothing, and a policy sees 90."""
    goal = fill_image(Image(), np.random.default_rng(0).integers(0, 256, (60, 90, 3), np.uint8))
    goal.header.stamp = robot.node.get_clock().now().to_msg()
    lens = fill_camera_info(CameraInfo(header=goal.header), 90, 60, math.radians(120))
    said = [('goal_image', goal), ('goal_camera_info', lens)]
    expected = preprocess(decode_rgb(goal), 36, fov=math.radians(120), target_fov=math.radians(90))
    for name, message in said if first == 'picture' else reversed(said):
        robot.publishers[name].publish(message)
        time.sleep(0.1)
    with Lively(robot), RosEnv(ROBOT, 36) as env:
        seen, _ = env.reset()
        assert np.array_equal(env.goals[seen['goal_index'][0]], expected)
        assert len(env.shown_goals) == 1


def test_what_a_robot_and_its_judge_say(robot):
    robot.show_goal(30)
    with Lively(robot), RosEnv(ROBOT, 36, max_decisions=100, collision_reward=-0.5) as env:
        assert env.world_version == 'recorded' and env.offers == ('arrived',)
        env.reset()
        before = robot.pose.copy()
        seen, reward, terminated, truncated, info = env.step([0])
        assert not robot.moves and seen['last_action'][0] == 0
        assert np.hypot(*(robot.pose - before)[:2]) == pytest.approx(0.5, abs=0.15)
        assert reward[0] == 0.0 and not (terminated | truncated)[0]
        robot.publishers['collision'].publish(Bool(data=True))
        robot.publishers['episode_end'].publish(UInt8(data=2))
        seen, reward, terminated, truncated, info = env.step([2])
        assert info['collided'][0] and reward[0] == -0.5 and seen['last_reward'][0] == 0.0
        assert truncated[0] and not terminated[0]
        robot.show_goal(60)
        seen, reward, *_, info = env.step([0])
        assert info['reset'][0] and env.goals[seen['goal_index'][0]].min() == 60
        robot.publishers['arrived'].publish(Bool(data=True))
        seen, reward, terminated, truncated, info = env.step([3])
        assert terminated[0] and reward[0] == seen['last_reward'][0] == 1.0
        assert info['success'][0] and info['arrived'][0]
        robot.show_goal(30)  # known already
        seen, *_ = env.step([0])
        assert seen['goal_index'][0] == 0 and len(env.shown_goals) == 2
        commands = np.array([velocity for _, velocity in robot.commands])
        assert np.abs(commands[:, 0]).max() <= ROBOT.max_linear + 1e-9
    assert not robot.moves


@pytest.mark.slow
def test_a_robot_whose_eyes_or_command_are_in_doubt_stands_still(robot, capsys):
    def cover():
        robot.camera = False

    def uncover(_):
        robot.camera = True

    def intrude():
        return robot.node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))
    robot.show_goal(30)
    with Lively(robot), RosEnv(ROBOT, 36) as env:
        env.reset()
        for disturb, restore in ((cover, uncover), (intrude, robot.node.destroy_publisher)):
            outcomes = []

            def step(outcomes=outcomes):
                outcomes.append(env.step([0]))
            thread = threading.Thread(target=step)
            thread.start()
            wait_until(lambda: robot.moves, lambda: time.sleep(0.005))
            disturbed = disturb()
            wait_until(lambda: not robot.moves, lambda: time.sleep(0.005))
            heard = len(robot.commands)
            wait_until(lambda: 'paused' in capsys.readouterr().out, lambda: time.sleep(0.05))
            assert not any(velocity.any() for _, velocity in robot.commands[heard:])
            assert not outcomes
            restore(disturbed)
            thread.join(PATIENCE)
            assert outcomes[0][3][0], 'a motion that was broken off truncates the episode'
            env.step([0])  # the next one begins, towards the same goal
    assert not robot.moves


def test_what_no_topic_says_is_left_out_in_words():
    config, words = config_over_ros(preset('anywhere'), ENVIRONMENT['anywhere'], ('arrived',),
                                    False)
    assert config.tasks == ('arrival',) and config.teacher_share == 0.0
    assert set(config.extra_heads) == {'goal_pose', 'distance'}
    assert config.network(DRIVE_ACTIONS, 84, ROBOT.moves).heads == (
        'arrival', 'goal_pose', 'distance')
    assert len(words) == 5 and any('progress_reward' in line for line in words)
    thesis, _ = config_over_ros(preset('thesis'), {}, ('depth', 'segmentation'), True)
    assert 'depth' in thesis.tasks and 'goal_segmentation' not in thesis.tasks
    for wrong in ({'device': 'cuda:0'}, {'overlap': True}):
        with pytest.raises(UserError):
            config_over_ros(preset('fast', **wrong), {}, (), False)
    with pytest.raises(UserError, match='icra2017'):
        config_over_ros(preset('icra2017'), {}, (), True)


@pytest.mark.parametrize('words, part', [
    (['--env', 'ros', '--house', '3'], '--house'),
    (['--record', 'bag'], '--env ros'),
    (['--lock-step'], '--env ros'),
    (['--env', 'ros', '--ros-args', '-r', 'nonsense'], 'ros-args'),
    (['--env', 'ros', '--ros-args', '-p', 'patience:=-3.0'], 'patience'),
    (['--env', 'ros', '--ros-args', '-p', 'control_rate:=fast'], 'control_rate'),
])
def test_bad_options_are_one_line_and_exit_code_2(tmp_path, capsys, words, part):
    assert main(['train', '--out', str(tmp_path / 'run'), *words]) == 2
    error = capsys.readouterr().err
    assert part in error and len(error.strip().splitlines()) == 1


@pytest.mark.slow
def test_nobody_there_is_said(tmp_path):
    begun = time.monotonic()
    with pytest.raises(EnvironmentLost, match='image_raw, odom, goal_image'):
        RosEnv(ROBOT, 36, ros_arguments=('-p', 'patience:=2.0'))
    assert time.monotonic() - begun < 20


@pytest.mark.slow
def test_several_robots_train_one_policy(tmp_path):
    """Two bridges in namespaces of their own."""
    torch.set_num_threads(1)
    with contextlib.ExitStack() as stack:
        for name in 'ab':
            words = [sys.executable, '-m', 'vn_sim_bridge.bridge_node', '--ros-args', '-r',
                     f'__ns:=/{name}', '-p', 'house:=7', '-p', 'rooms:=1', '-p', 'size:=36', '-p',
                     f'robot:={BASE}', '-p', 'time:=lock_step']
            process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
        env = stack.enter_context(RosEnv(ROBOT, 36, namespaces=('a', 'b'), lock_step=True))
        config, _ = config_over_ros(
            preset('fast', frames=12, rollout_length=4, channels=(8, 8, 8), features=24,
                   hidden=16), {}, env.offers, True)
        rows = []
        train(env, config, tmp_path / 'run', info=FACTS, on_update=rows.append)
        assert rows[-1]['frames'] >= 12 and env.steps == rows[-1]['frames']
