"""A base that cannot move sideways, and a policy that can: those actions are left out."""

import dataclasses
import time

import numpy as np
import pytest
from paths import ROOT
from ros_harness import PATIENCE, child, wait_until, write_checkpoint
from small_search import small_search

from vn_nav.errors import UserError
from vn_nav.policy.checkpoint import save_checkpoint
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import THESIS_ACTIONS, RobotSpec, load_robot
from vn_nav.teleop import limits_of
from vn_sim_bridge.robot.simulated_base import SimulatedBase
from vn_sim_bridge.simulators.house import WORLD_VERSION

NAMES = tuple(action.name for action in THESIS_ACTIONS[:6])  # without tilt
TURTLEBOT = load_robot(ROOT / 'config' / 'robots' / 'turtlebot4.yaml')


def test_a_turtlebot_takes_a_policy_with_sideways_actions():
    assert TURTLEBOT.differential and 'left' not in TURTLEBOT.action_names
    robot = TURTLEBOT.with_actions(NAMES)
    assert robot.action_names == NAMES
    assert [NAMES[k] for k in robot.impossible] == ['left', 'right']
    # As the policy says of them, whatever their names are.
    own = TURTLEBOT.with_actions(('forward', 'crab'), ((0.5, 0.0, 0.0), (0.0, 0.2, 0.0)))
    assert own.impossible == (1,) and own.moves[1] == (0.0, 0.2, 0.0)
    assert TURTLEBOT.with_actions(('forward', 'rotate_left')).impossible == ()


def test_what_it_does_not_take():
    for names, moves in ((('forward', 'look_up'), ()), (('forward', 'jump'), ()),
                         (('forward', 'leap'), ((0.5, 0, 0), (1.0, 0, 0)))):
        with pytest.raises(UserError, match='every action of the policy'):
            TURTLEBOT.with_actions(names, moves)
    with pytest.raises(UserError, match='every action'):
        dataclasses.replace(TURTLEBOT, differential=False).with_actions(NAMES)
    with pytest.raises(UserError, match='one of the actions'):
        TURTLEBOT.with_actions(('left', 'right'))
    with pytest.raises(UserError, match='differential'):
        RobotSpec(differential=1)


def test_a_base_that_is_told_to_move_sideways_does_not():
    robot = RobotSpec(differential=True)
    base = SimulatedBase(robot, 0.05)
    for _ in range(20):
        driven = base.follow(np.array([0.2, 0.2, 0.1, 0.0]), base.velocity)
    assert driven[1] == 0 and driven[0] == pytest.approx(0.2) and driven[2] == pytest.approx(0.1)
    assert limits_of(robot)[1] == 0 < limits_of(RobotSpec())[1]
    assert limits_of(robot)[0] > 0


@pytest.mark.parametrize('decoding', ['sample', 'greedy'])
def test_a_network_never_chooses_what_is_left_out(tmp_path, decoding):
    runtime = PolicyRuntime(write_checkpoint(tmp_path / 'policy', size=36, actions=NAMES),
                            decoding=decoding)
    rng = np.random.default_rng(0)
    runtime.set_goal(rng.integers(0, 255, (3, 36, 36), np.uint8))

    def actions():
        return {runtime.action_names[runtime.act(rng.integers(0, 255, (3, 36, 36), np.uint8))]
                for _ in range(150)}

    runtime.forbid([NAMES.index(name) for name in NAMES if name != 'backward'])
    assert actions() == {'backward'}
    runtime.forbid(TURTLEBOT.with_actions(NAMES).impossible)
    found = actions()
    assert not found & {'left', 'right'} and found <= set(NAMES)
    if decoding == 'sample':
        assert found == set(NAMES) - {'left', 'right'}
        runtime.forbid(())
        assert actions() == set(NAMES)


def test_nor_does_a_search(tmp_path):
    robot = RobotSpec().with_actions(NAMES)
    config = dataclasses.replace(small_search().config, actions=NAMES, moves=robot.moves)
    assert isinstance(config, NetworkConfig)
    save_checkpoint(tmp_path / 'search', build_policy(config), {
        'world_version': WORLD_VERSION, 'camera_fov_deg': 90.0, 'camera_height': 1.0,
        'scenes': ['house:7'], 'stop_threshold': 1.0})
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 255, (200, 3, 48, 48), np.uint8)
    chosen = []
    for impossible in ((), (2, 3)):
        runtime = PolicyRuntime(tmp_path / 'search')
        runtime.forbid(impossible)
        runtime.set_goal(pictures[0])
        pose = np.zeros(3)
        chosen.append(set())
        for picture in pictures:
            action = runtime.act(picture, pose)
            chosen[-1].add(NAMES[action])
            # It is stuck, and tries everything.
            pose = pose + (0, 0, robot.moves[action][2])
    assert chosen[0] & {'left', 'right'} and not chosen[1] & {'left', 'right'}


@pytest.mark.ros
@pytest.mark.slow
def test_policy_node_says_what_it_never_does(tmp_path):
    policy = write_checkpoint(tmp_path / 'policy', actions=NAMES)
    turtlebot = ROOT / 'config' / 'robots' / 'turtlebot4.yaml'
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=policy, robot=turtlebot):
        def said():
            return (tmp_path / 'log').read_text()
        wait_until(lambda: 'active: waits for' in said(), lambda: time.sleep(0.1), PATIENCE)
        assert 'turtlebot4 is a differential base: never left, right' in said()
