"""policy_node whose decisions, threads or callbacks fail: a real process, a robot of this one."""

import os
import signal
import time

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from fake_robot import broken_node
from lifecycle_msgs.msg import Transition
from ros_harness import wait_until, write_checkpoint
from sensor_msgs.msg import CameraInfo

pytestmark = [pytest.mark.ros, pytest.mark.slow]
ERROR = DiagnosticStatus.ERROR


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint')


SLOW = """
import time
from vn_nav.policy.runtime import PolicyRuntime
act = PolicyRuntime.act
calls = []
def slow(self, *seen):
    calls.append(1)
    time.sleep(1.5 if len(calls) > 8 else 0)
    return act(self, *seen)
PolicyRuntime.act = slow
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, None],
                         ids=['SIGINT', 'SIGTERM', 'deactivate'])
def test_the_last_zero_does_not_wait_for_a_decision(checkpoint, tmp_path, number):
    with broken_node(checkpoint, tmp_path, SLOW, mode='continuous',
                     inference_timeout='2.0', frame_timeout='5.0',
                     frame_stop_timeout='10.0') as (robot, process):
        robot.show_goal()
        robot.enable()
        wait_until(robot.moving, robot.spin)
        robot.spin_for(0.8)  # by now a decision is under way, and the last one's motion goes on
        assert robot.moving()
        asked = time.monotonic()
        if number is None:
            assert robot.transition(Transition.TRANSITION_DEACTIVATE)
        else:
            os.kill(process.pid, number)
        assert robot.wait_for_zero() - asked < 0.4
        if number is not None:
            wait_until(lambda: process.poll() is not None, robot.spin)
            assert process.returncode == 0, (tmp_path / 'log').read_text()
            assert 'abort' not in (tmp_path / 'log').read_text().lower()


BROKEN = """
from vn_nav.policy.runtime import PolicyRuntime
act = PolicyRuntime.act
calls = []
def broken(self, *seen):
    calls.append(1)
    if len(calls) == 5:
        raise RuntimeError('the accelerator is gone')
    return act(self, *seen)
PolicyRuntime.act = broken
"""


def test_a_thread_that_dies_takes_the_node_out_of_action(checkpoint, tmp_path):
    with broken_node(checkpoint, tmp_path, BROKEN, mode='continuous') as (robot, process):
        robot.show_goal()
        robot.enable()
        robot.says('the accelerator is gone')
        robot.wait_for_zero()
        refusal = robot.refusal()
        assert 'not active' in refusal and 'the accelerator is gone' in refusal
        robot.says('inactive: the inference thread failed')
        assert robot.statuses[-1][1] == ERROR
        assert process.poll() is None and 'Traceback' not in (tmp_path / 'log').read_text()
        assert robot.transition(Transition.TRANSITION_ACTIVATE)
        robot.enable()
        wait_until(robot.moving, robot.spin)


def test_inferences_that_take_too_long_are_discarded_and_stop(checkpoint, tmp_path):
    slow = SLOW.replace('1.5', '0.3').replace('> 8', '> 0')
    with broken_node(checkpoint, tmp_path, slow, inference_timeout='0.1') as (robot, _):
        robot.show_goal()
        robot.enable()
        robot.says('three inferences in a row took longer than 0.1 s')
        assert robot.commands and not any(velocity.any() for _, velocity in robot.commands)
        assert '~/reset' in robot.refusal()


NOT_A_NUMBER = """
import torch
from vn_nav.policy.network import Policy
forward = Policy.forward
calls = []
def broken(self, *args, **kwargs):
    output = forward(self, *args, **kwargs)
    calls.append(1)
    if len(calls) > 3:
        output[0].logits.fill_(torch.nan)
    return output
Policy.forward = broken
"""


def test_outputs_that_are_not_finite_stop(checkpoint, tmp_path):
    with broken_node(checkpoint, tmp_path, NOT_A_NUMBER, mode='continuous') as (robot, process):
        robot.show_goal()
        robot.enable()
        robot.says('stopped: logits of the policy are not finite')
        robot.wait_for_zero()
        assert '~/reset' in robot.refusal() and process.poll() is None


CALLBACK = """
from vn_nav.nodes.policy_inputs import PolicyInputs
receive = PolicyInputs._on_camera_info
def broken(self, message):
    if message.width == 1234:
        raise RuntimeError('the callback is broken')
    receive(self, message)
PolicyInputs._on_camera_info = broken
"""


def test_a_callback_that_fails_takes_the_node_out_of_action(checkpoint, tmp_path):
    with broken_node(checkpoint, tmp_path, CALLBACK) as (robot, process):
        robot.drive()
        robot.info.publish(CameraInfo(width=1234, height=84))
        robot.wait_for_zero()
        _, level, *_ = robot.says('inactive: a callback failed')
        assert level == ERROR and robot.state() == 'inactive' and process.poll() is None
        assert 'the callback is broken' in robot.refusal()
        assert robot.transition(Transition.TRANSITION_ACTIVATE)
        robot.enable()
        wait_until(robot.moving, robot.spin)
