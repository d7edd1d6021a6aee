"""The package vn_interfaces: its action, what names it, and its way over Fast DDS."""

import json
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import cv2
import interface_build
import numpy as np
import pytest
import rclpy
from fake_robot import RELIABLE, FakeRobot
from lifecycle_msgs.msg import Transition
from paths import ROOT, TESTS
from ros_harness import PATIENT, child, wait_until, write_checkpoint
from std_srvs.srv import SetBool, Trigger

from vn_nav.policy.goal_record import Code

PACKAGE = ROOT / 'vn_interfaces'
ACTION = PACKAGE / 'action' / 'NavigateToImage.action'
TREE = ROOT / 'config' / 'behavior_trees' / 'navigate_to_image.xml'
CODES = range(10600, 10700)  # outside of what Nav2 keeps for itself; a hundred for each server
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6  # action_msgs/GoalStatus


@pytest.fixture(scope='module')
def action():
    """The action file as the generators of ROS read it."""
    from rosidl_adapter.parser import parse_action_file
    return parse_action_file('vn_interfaces', str(ACTION))


def fields(message):
    return {field.name: str(field.type) for field in message.fields}


@pytest.mark.ros
def test_the_fields(action):
    duration = 'builtin_interfaces/Duration'
    assert fields(action.goal) == {
        'image': 'sensor_msgs/Image', 'path': 'string', 'max_decisions': 'uint32',
        'time_allowance': duration}
    assert fields(action.result) == {
        'error_code': 'uint16', 'error_msg': 'string', 'decisions': 'uint32',
        'navigation_time': duration, 'arrival': 'float32'}
    assert fields(action.feedback) == {
        'distance_remaining': 'float32', 'arrival': 'float32', 'decisions': 'uint32',
        'state': 'string', 'navigation_time': duration,
        'goal_estimate': 'geometry_msgs/PoseStamped'}


@pytest.mark.ros
def test_the_codes_are_ours_and_the_page_has_them_all(action):
    codes = {constant.name: constant.value for constant in action.result.constants}
    assert codes.pop('NONE') == 0
    assert list(codes.values()) == list(CODES[:len(codes)])
    assert next(iter(codes)) == 'UNKNOWN'  # Nav2: the first one of a server
    page = (ROOT / 'docs' / 'nav2.md').read_text()
    listed = re.findall(r'^\| (\d+) \| `(\w+)` \|', page, re.MULTILINE)
    assert {name: int(code) for code, name in listed} == {'NONE': 0, **codes}


@pytest.mark.ros
def test_the_behavior_tree_gives_what_the_action_takes(action):
    root = ElementTree.parse(TREE).getroot()
    assert root.get('BTCPP_format') == '4'
    trees = {tree.get('ID') for tree in root.iter('BehaviorTree')}
    assert root.get('main_tree_to_execute') in trees
    model = next(node for node in root.find('TreeNodesModel') if node.get('ID') ==
                 'NavigateToImage')
    ports = {port.tag: {each.get('name') for each in model.findall(port.tag)} for port in model}
    assert ports['input_port'] == set(fields(action.goal)) - {'image'} | {
        'server_name', 'server_timeout'}
    assert ports['output_port'] == {'error_code_id', 'error_msg'}
    used = [node for node in root.iter('NavigateToImage')]
    assert used and all(set(node.attrib) <= ports['input_port'] | ports['output_port'] | {'name'}
                        for node in used)
    page = (ROOT / 'docs' / 'nav2.md').read_text()  # the plug-in's source
    assert set(re.findall(r'(?:Input|Output)Port<[^>]+>\("(\w+)"', page)) == (
        ports['input_port'] | ports['output_port']) - {'server_name', 'server_timeout'}


def test_the_manifest():
    manifest = ElementTree.parse(PACKAGE / 'package.xml').getroot()
    ours = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert manifest.find('version').text == ours.find('version').text
    used = set(re.findall(r'^(\w+)/', ACTION.read_text(), re.MULTILINE))
    assert used | {'action_msgs'} == {each.text for each in manifest.iter('depend')}
    named = re.search(r'DEPENDENCIES ([\w ]+)', (PACKAGE / 'CMakeLists.txt').read_text())
    assert set(named.group(1).split()) == used


@pytest.mark.slow
def test_colcon_finds_both_packages_by_the_documented_options(tmp_path):
    """Its crawler looks into no package: from the root alone it finds vn_nav only."""
    options = re.search(r'colcon build (--base-paths .+)', (ROOT / 'docs/nav2.md').read_text())
    listed = subprocess.run(
        [sys.executable, '-m', 'colcon', '--log-base', tmp_path, 'list', '--names-only',
         *options.group(1).split()],
        cwd=ROOT, capture_output=True, text=True, timeout=100)
    assert sorted(listed.stdout.split()) == ['vn_interfaces', 'vn_nav'], listed.stderr


@pytest.fixture(scope='module')
def built():
    """The environment of processes that import vn_interfaces."""
    if interface_build.what_is_missing():
        pytest.skip(f'expected: {interface_build.what_is_missing()}')
    return interface_build.environment()


@pytest.fixture
def with_action(built, monkeypatch):
    """Nodes that are started serve the action; the environment for its client."""
    for name in ('PYTHONPATH', 'AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH', 'CMAKE_PREFIX_PATH'):
        if name in built:
            monkeypatch.setenv(name, built[name])
    return built


@pytest.fixture
def robot():
    rclpy.init()
    robot = FakeRobot(odometry=RELIABLE)
    yield robot
    robot.close()
    rclpy.shutdown()


def results(robot, environment, goals, meanwhile=lambda: None):
    """What a client hears of goals that it sends, while the robot goes on."""
    client = subprocess.Popen([sys.executable, TESTS / 'image_action.py', json.dumps(goals)],
                              env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                              text=True)
    try:
        meanwhile()
        wait_until(lambda: client.poll() is not None, robot.spin, 300)
        said, error = client.communicate(timeout=60)
    finally:
        client.kill()
    assert client.returncode == 0, error
    return json.loads(said)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(interface_build.BUILD_SECONDS + 400)
def test_goals_of_the_action_arrive_fail_and_are_cancelled(with_action, robot, tmp_path):
    """policy_node, a robot of topics, and a client: three processes."""
    picture = tmp_path / 'goal.png'
    cv2.imwrite(str(picture), np.zeros((84, 84, 3), np.uint8))
    with child('vn_nav.nodes.policy_node', tmp_path / 'log',
               checkpoint=write_checkpoint(tmp_path / 'unsure'), **PATIENT):
        nowhere = {'path': str(tmp_path / 'none.png')}
        used_up, none, cancelled, replaced = results(robot, with_action, [
            {'max_decisions': 2}, nowhere, {'cancel_after': 4.0},
            {'interrupted_by': nowhere, 'after': 4.0}])
        # The goal before is over: the robot has none, and stands.
        robot.wait_for_zero()
        robot.spin_for(1.0)
        assert not robot.moving()
    assert (used_up['status'], used_up['code'], used_up['decisions']) == (
        ABORTED, Code.BUDGET, 2), used_up
    assert used_up['seconds'] > 0 and 'running' in used_up['states']
    assert (none['status'], none['code']) == (ABORTED, Code.GOAL_REFUSED)
    assert 'no such file' in none['message']
    assert (cancelled['status'], cancelled['code']) == (CANCELED, 0)
    assert (replaced['status'], replaced['code']) == (ABORTED, Code.STOPPED), replaced
    assert replaced['other']['code'] == Code.GOAL_REFUSED
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    with child('vn_nav.nodes.policy_node', tmp_path / 'log2', checkpoint=sure, **PATIENT):
        (there,) = results(robot, with_action, [{'path': str(picture)}])
    assert (there['status'], there['code'], there['decisions']) == (SUCCEEDED, 0, 1), there
    assert there['arrival'] == pytest.approx(0.93, abs=0.01)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(interface_build.BUILD_SECONDS + 400)
def test_a_client_hears_that_a_person_or_the_process_ends_it(with_action, robot, tmp_path):
    unsure = write_checkpoint(tmp_path / 'unsure')
    with child('vn_nav.nodes.policy_node', tmp_path / 'log', checkpoint=unsure, **PATIENT) as node:
        for end, words in ((lambda: robot.call(SetBool, 'enable', data=False), 'disabled'),
                           (lambda: robot.call(Trigger, 'stop'), '~/stop'),
                           (lambda: node.send_signal(signal.SIGINT), 'the process ends')):
            def end_motion(end=end):
                wait_until(robot.moving, robot.spin, 100)
                end()

            (left,) = results(robot, with_action, [{}], meanwhile=end_motion)
            assert (left['status'], left['code']) == (ABORTED, Code.STOPPED), left
            assert words in left['message']
            if robot.moving():
                robot.commands.clear()
            if '~/stop' in words:
                assert robot.call(Trigger, 'reset').success
    with child('vn_nav.nodes.policy_node', tmp_path / 'log2', checkpoint=unsure, **PATIENT):
        def shut_down():
            wait_until(robot.moving, robot.spin, 100)
            assert robot.transition(Transition.TRANSITION_ACTIVE_SHUTDOWN)

        (left,) = results(robot, with_action, [{}], meanwhile=shut_down)
        assert (left['status'], left['code']) == (ABORTED, Code.STOPPED), left
        assert 'shut down' in left['message']
        assert robot.state() == 'finalized'


@pytest.mark.ros
def test_the_codes_of_the_node_are_those_of_the_action(action):
    constants = {constant.name: constant.value for constant in action.result.constants}
    assert constants.pop('UNKNOWN') not in set(Code)
    assert constants == {code.name: int(code) for code in Code}
