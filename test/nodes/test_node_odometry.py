"""The pose of odometry that policy_node gives its policy with a picture."""

import json
import math
import time

import numpy as np
import pytest
from fake_robot import broken_node
from inside_node import LONG, Inside
from ros_harness import wait_until, write_checkpoint
from std_msgs.msg import String

pytestmark = pytest.mark.ros


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp('policy') / 'checkpoint', size=36)


@pytest.fixture
def inside(checkpoint, request):
    parts = Inside(checkpoint, request.param)
    yield parts
    parts.close()


@pytest.mark.parametrize('inside', ['stop_and_go'], indirect=True)
def test_at_rest_the_newest_odometry_belongs_to_the_picture(inside, monkeypatch):
    assert inside.look(8.0) is None  # there is none yet
    inside.measure(10.0, 1.0, 2.0, 0.3)
    assert inside.look(9.0) == pytest.approx([1.0, 2.0, 0.3])  # its clock may be another
    inside.measure(10.1, 1.02, 2.0, 0.3)
    assert inside.look(12.0) == pytest.approx([1.02, 2.0, 0.3])
    assert inside.runtime.breaks == 0
    monkeypatch.setattr(inside.output, '_received', time.monotonic() - 2 * LONG)
    assert inside.look(13.0) is None  # silent
    inside.measure(10.2, 1.02, 2.0, 0.3)
    assert inside.look(14.0) is not None and inside.runtime.breaks == 0


@pytest.mark.parametrize('inside', ['stop_and_go'], indirect=True)
def test_a_jump_reaches_the_policy_before_the_pose_after_it(inside):
    inside.measure(10.0, 0.0, 0.0, 0.0)
    inside.look(10.0)
    inside.measure(10.05, 50.0, 0.0, 0.0)
    assert inside.look(11.0) == pytest.approx([50.0, 0.0, 0.0]) and inside.runtime.breaks == 1
    inside.measure(1.0, 50.0, 0.0, 0.0)  # its clock was set back
    assert inside.look(12.0) is not None and inside.runtime.breaks == 2
    assert inside.look(13.0) is not None and inside.runtime.breaks == 2


@pytest.mark.parametrize('inside', ['continuous'], indirect=True)
def test_in_motion_it_is_the_odometry_at_the_stamp(inside):
    inside.measure(1.0, 0.0, 0.0, 0.0)
    inside.measure(1.1, 0.05, 0.0, 0.1)
    assert inside.look(1.05) == pytest.approx([0.025, 0.0, 0.05])
    assert inside.look(1.2) == pytest.approx([0.05, 0.0, 0.1])
    assert inside.look(2.0) is None


@pytest.mark.parametrize('inside', ['shadow'], indirect=True)
def test_in_a_shadow_who_says_what_was_done_may_say_where(inside):
    inside.measure(1.0, 7.0, 0.0, 0.0)

    def executed(stamp, **more):
        inside.inputs._on_executed_action(String(data=json.dumps(
            {'stamp': divmod(round(stamp * 1e9), 10**9), 'action': None} | more)))
    for stamp, more, pose in ((1.05, {}, [7, 0, 0]), (1.1, {'odometry': [1, 2, 3]}, [1, 2, 3]),
                              (1.15, {'odometry': None}, None)):
        executed(stamp, **more)
        found = inside.look(stamp)
        assert found is pose or found == pytest.approx(pose)
    for wrong in ([1, 2], [1, 2, math.nan], 'here'):
        executed(1.17, odometry=wrong)  # refused: nothing is to be decided
    assert inside.worker._executed is None


TELLS = """
from vn_nav.policy.runtime import PolicyRuntime
act = PolicyRuntime.act
def telling(self, image, odometry=None, scan=None, zoom=1.0, view=None):
    print('pose', None if odometry is None else odometry.tolist(), flush=True)
    return act(self, image, odometry, scan, zoom, view)
PolicyRuntime.act = telling
"""


@pytest.mark.slow
def test_a_node_gives_its_policy_the_pose_where_the_robot_stands(checkpoint, tmp_path):
    def poses():
        lines = (tmp_path / 'log').read_text().splitlines()
        return [json.loads(line[5:]) for line in lines if line.startswith('pose [')]
    with broken_node(checkpoint, tmp_path, TELLS) as (robot, _):
        been = [robot.pose.copy()]

        def spin():
            robot.spin()
            been.append(robot.pose.copy())
        robot.show_goal()
        robot.enable()
        wait_until(lambda: len(poses()) >= 4, spin)
        been = np.array(been)
        for pose in poses()[:4]:
            gap = np.abs(been - pose)
            gap[:, 2] = np.abs(np.sin(gap[:, 2] / 2))  # a message's yaw is wrapped
            assert gap.max(axis=1).min() < 1e-6
