"""The checks of `vn_nav doctor` on graphs as data: a sound one, and one fault at a time."""

import dataclasses
import math

import numpy as np
import pytest
import yaml
from paths import ROOT

from vn_msgs_py.topics import BEST_EFFORT, LATCHED, RELIABLE, VOLATILE, topic
from vn_nav.doctor.camera_checks import Policy
from vn_nav.doctor.checks import examine
from vn_nav.doctor.drive_checks import is_command_timeout
from vn_nav.doctor.page import graph_page
from vn_nav.doctor.seen import (
    ERROR,
    OK,
    WARNING,
    BaseStop,
    Endpoint,
    Graph,
    Lens,
    Middleware,
    Operation,
    SeenTopic,
    Stream,
)
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec, load_robot

VGA = 640 * 480 * 3
PICTURES = Stream(150, 0.033, 0.05, bytes=VGA, lag=0.03, pictures=('rgb8 640 x 480',))
ODOMETRY = Stream(250, 0.02, 0.03, lag=0.01, frames=(('odom', 'base_link'),))
WIDE = Lens(640, 480, 300.0)
PROFILE = Middleware('rmw_fastrtps_cpp', '/a/profile.xml')
STAMPED = 'geometry_msgs/msg/TwistStamped'


def end(node, contract, reliability=None, durability=None, kind=None, vendor=''):
    entry = topic(contract)
    return Endpoint(f'/{node}', kind or entry.type, reliability or entry.reliability,
                    durability or entry.durability, vendor)


def seen(contract, publishers=(), subscribers=(), stream=None):
    return SeenTopic(contract, f'/{contract}', tuple(publishers), tuple(subscribers), stream)


def graph(*changed, middleware=PROFILE, lens=WIDE, **fields):
    """A sound graph with other topics in place of some of its own."""
    topics = {t.contract: t for t in (
        seen('image_raw', [end('camera', 'image_raw')], stream=PICTURES),
        seen('image_raw/compressed'),
        seen('camera_info', [end('camera', 'camera_info')], stream=Stream(150, 0.033)),
        seen('goal_image', [end('goal_node', 'goal_image')],
             stream=Stream(1, pictures=('rgb8 640 x 480',))),
        seen('odom', [end('base', 'odom')], stream=ODOMETRY),
        seen('cmd_vel', subscribers=[end('base', 'cmd_vel')]), *changed)}
    timeouts = fields.pop('timeouts', (('/base', 'cmd_vel_timeout', 0.5),))
    return Graph(5.0, ('/base', '/camera', '/goal_node'), topics, fields.pop('others', {}),
                 middleware, lens=lens, timeouts=timeouts, **fields)


def image(**changes):
    return seen('image_raw', [end('camera', 'image_raw')],
                stream=dataclasses.replace(PICTURES, **changes))


def odom(**changes):
    return seen('odom', [end('base', 'odom')], stream=dataclasses.replace(ODOMETRY, **changes))


def command(publishers=(), subscribers=None):
    return seen('cmd_vel', publishers, [end('base', 'cmd_vel')] if subscribers is None
                else subscribers)


def test_a_sound_graph_has_no_warning_and_says_what_was_checked():
    findings = examine(graph())
    assert {finding.severity for finding in findings} == {OK}
    assert {'middleware', 'types', 'qos', 'pictures', 'rate', 'loss', 'time', 'clock', 'odometry',
            'command', 'base time-out', 'camera'} == {finding.check for finding in findings}


FAULTS = {
    'nobody': (dataclasses.replace(graph(), nodes=()), 'graph', ERROR, 'no other node',
               'ROS_DOMAIN_ID'),
    'no pictures': (graph(seen('image_raw'), others={
        '/oak/rgb': 'sensor_msgs/msg/Image', '/x': 'std_msgs/msg/String'}),
        'topics', ERROR, 'is not published', '-r image_raw:=/oak/rgb'),
    'compressed alone, raw chosen': (graph(
        seen('image_raw'), seen('image_raw/compressed', [end('camera', 'image_raw/compressed')])),
        'topics', ERROR, '/image_raw/compressed is', 'image_transport:=compressed'),
    'compressed alone': (graph(
        seen('image_raw'), seen('image_raw/compressed', [end('camera', 'image_raw/compressed')],
                                stream=PICTURES),
        operation=Operation(compressed=True, chosen=False)),
        'topics', WARNING, 'no raw picture', 'image_transport:=compressed'),
    'no odometry': (graph(seen('odom')), 'topics', ERROR, 'time alone', 'nav_msgs/msg/Odometry'),
    'no goal': (graph(seen('goal_image')), 'topics', WARNING, 'waits for a picture',
                'ros2 run vn_nav goal_node'),
    'no camera_info': (graph(seen('camera_info'), lens=None), 'topics', WARNING, 'cropped',
                       'CameraInfo'),
    'two cameras': (graph(seen('image_raw', [end('a', 'image_raw'), end('b', 'image_raw')],
                               stream=PICTURES)), 'topics', ERROR, '2 publishers', 'node info /b'),
    'nothing comes': (graph(seen('odom', [end('base', 'odom')], stream=Stream())), 'topics',
                      ERROR, 'nothing came', 'ros2 topic hz /odom'),
    'another type': (graph(seen('odom', [end('base', 'odom', kind='std_msgs/msg/String')])),
                     'types', ERROR, 'std_msgs/msg/String', '-r /odom:=/odom_other'),
    'reliable asked, best effort offered': (graph(
        seen('goal_image', [end('phone', 'goal_image', BEST_EFFORT)],
             [end('policy_node', 'goal_image', RELIABLE)], Stream())),
        'qos', ERROR, 'asks for reliable', 'subscription.reliability:=best_effort'),
    'history asked of commands': (graph(command(subscribers=[
        end('base', 'cmd_vel', durability=LATCHED)])),
        'qos', ERROR, 'asks for transient local and policy_node offers volatile',
        'subscription.durability:=volatile'),
    'a fleeting goal': (graph(seen('goal_image', [end('phone', 'goal_image',
                                                      durability=VOLATILE)])),
                        'qos', WARNING, 'never hears it', 'goal_node'),
    'odometry of best effort': (graph(seen('odom', [end('base', 'odom', BEST_EFFORT)],
                                           stream=ODOMETRY)),
                                'qos', WARNING, 'lock-step', 'to reliable'),
    'a missing profile': (graph(middleware=Middleware('rmw_fastrtps_cpp', '/gone.xml', False)),
                          'middleware', ERROR, '/gone.xml does not exist', 'fastdds_multihost'),
    'no profile': (graph(middleware=Middleware('rmw_fastrtps_cpp')), 'middleware', WARNING,
                   '0.9 MB', f'{share_file("config/fastdds_multihost.xml")}'),
    'a profile that is not read': (
        graph(middleware=Middleware('rmw_fastrtps_cpp',
                                    ignored_variable='FASTDDS_DEFAULT_PROFILES_FILE')),
        'middleware', WARNING, 'does not read',
        'export FASTRTPS_DEFAULT_PROFILES_FILE=$FASTDDS_DEFAULT_PROFILES_FILE'),
    'two middlewares': (graph(seen('odom', [end('base', 'odom', vendor='Cyclone DDS')],
                                   [end('rviz', 'odom', vendor='Fast DDS')], ODOMETRY)),
                        'middleware', WARNING, 'Cyclone DDS: /base', 'RMW_IMPLEMENTATION='),
    'an unreadable picture': (graph(image(fault='an encoding is known; received 8UC7')),
                              'pictures', ERROR, '8UC7', 'rgb8'),
    'a changing picture': (graph(image(pictures=('rgb8 640 x 480', 'rgb8 320 x 240'))),
                           'pictures', ERROR, 'changes between', 'topic info -v'),
    'a slow camera': (graph(image(period=0.5, worst_gap=0.6)), 'rate', ERROR,
                      '2.0 Hz', 'frame_timeout:=0.95'),
    'a camera with pauses': (graph(image(worst_gap=0.4)), 'rate', WARNING, '0.40 s apart',
                             'frame_timeout:='),
    'one picture': (graph(image(count=1, period=None)), 'rate', ERROR, 'came once', 'topic hz'),
    'slow odometry': (graph(odom(period=0.2)), 'rate', WARNING, '5.0 Hz', 'at 20 Hz'),
    'loss without a profile': (graph(image(lost=100), middleware=Middleware('rmw_fastrtps_cpp')),
                               'loss', WARNING, '100 of 250', 'FASTRTPS_DEFAULT_PROFILES_FILE'),
    'loss of large pictures': (graph(image(lost=100)), 'loss', WARNING, '100 of 250',
                               'image_transport:=compressed'),
    'loss of most': (graph(image(lost=300)), 'loss', ERROR, '300 of 450', 'compressed'),
    'loss of small messages': (graph(odom(lost=30)), 'loss', WARNING, '30 of 280', 'best effort'),
    'old pictures': (graph(image(lag=1.5)), 'clock', ERROR, '1.500 s behind', 'chronyc'),
    'late pictures': (graph(image(lag=0.2)), 'clock', WARNING, 'the limit is 0.25 s: on a busy',
                      'max_frame_age:=0.35'),
    'pictures of the future': (graph(image(lag=-0.2)), 'clock', ERROR, '0.200 s ahead',
                               'max_frame_ahead:=0.35'),
    'stamps of a simulator': (graph(image(lag=1.7e9)), 'clock', ERROR, 'another time',
                              'use_sim_time to true'),
    'two clocks': (graph(odom(lag=-0.8)), 'clock', ERROR, 'differ by 0.83 s', 'chronyc'),
    'stamps of zero': (graph(image(zero=150)), 'stamps', ERROR, '150 of 150', 'stamp what it'),
    'one stamp for all': (graph(image(repeated=149)), 'stamps', ERROR, '149 of 150', 'restart'),
    'stamps out of order': (graph(odom(back=3)), 'stamps', WARNING, '3 go back', 'topic info'),
    'no simulated time': (graph(operation=Operation(use_sim_time=True)), 'time', ERROR,
                          'nobody publishes /clock', 'use_sim_time:=false'),
    'simulated time unused': (graph(image(simulated_lag=0.01), clocks=('/gazebo',),
                                    operation=Operation(use_sim_time=False)), 'time', WARNING,
                              'use_sim_time is false', 'use_sim_time:=true'),
    'two simulators': (graph(image(simulated_lag=0.01), odom(simulated_lag=0.01),
                             clocks=('/a', '/b')), 'time', ERROR, '/a, /b', 'namespace'),
    'frames': (graph(odom(frames=(('odom', 'odom'),))), 'odometry', ERROR, 'to itself',
               'base_frame_id'),
    'no frames': (graph(odom(frames=(('', ''),))), 'odometry', WARNING, 'child_frame_id empty',
                  'base_link'),
    'several frames': (graph(odom(frames=(('odom', 'base_link'), ('map', 'base_link')))),
                       'odometry', ERROR, 'several frames', 'topic info'),
    'odometry in the map': (graph(odom(frames=(('map', 'base_link'),))), 'odometry', WARNING,
                            'jumps', '-r odom:='),
    'broken odometry': (graph(odom(fault='odometry is finite; received nan')), 'odometry', ERROR,
                        'finite', 'base driver'),
    'another driver': (graph(command([end('teleop', 'cmd_vel')])), 'command', ERROR,
                       '/teleop publishes', 'twist_mux'),
    'two policies': (graph(command([end('policy_node', 'cmd_vel')] * 2)), 'command',
                     ERROR, 'policy_node publishes', 'ros2 node info'),
    'no base': (graph(command(subscribers=())), 'command', ERROR, 'nobody subscribes',
                '-r cmd_vel:='),
    'a base for TwistStamped': (graph(command(subscribers=[end('base', 'cmd_vel', kind=STAMPED)])),
                                'command', ERROR, 'where policy_node sends',
                                'enable_stamped_cmd_vel:=true'),
    'a base for Twist': (graph(operation=Operation(stamped=True)), 'command', ERROR,
                         'where policy_node sends', 'enable_stamped_cmd_vel:=false'),
    'a base without a time-out': (graph(timeouts=(('/base', 'cmd_vel_timeout', 0.0),)),
                                  'base time-out', ERROR, 'for ever',
                                  'ros2 param set /base cmd_vel_timeout 0.5'),
    'a patient base': (graph(timeouts=(('/base', 'timeout', 10.0),)), 'base time-out', WARNING,
                       '10 s', 'ros2 param set'),
    'an unknown base': (graph(timeouts=()), 'base time-out', WARNING, 'unknown', '--base-check'),
    'a base that goes on': (graph(base_stop=BaseStop(0.3, None)), 'base time-out', ERROR,
                            'went on turning', 'cmd_vel_timeout'),
    'a base that is slow to stop': (graph(base_stop=BaseStop(0.3, 2.0)), 'base time-out', WARNING,
                                    '2.0 s after', 'cmd_vel_timeout'),
    'a base that is off': (graph(base_stop=BaseStop(0.0, 0.0)), 'base time-out', ERROR,
                           'did not turn', 'emergency stop'),
    'a base that turns the other way': (graph(base_stop=BaseStop(-0.3, 0.2)), 'base time-out',
                                        ERROR, 'to the right', 'REP 103'),
    'an uncalibrated camera': (graph(lens=Lens(640, 480, 0.0)), 'camera', WARNING,
                               'not calibrated', 'camera_calibration'),
    "another camera's calibration": (graph(lens=Lens(320, 240, 150.0)), 'camera', WARNING,
                                     'is of 320 x 240', 'camera_info:='),
}


@pytest.mark.parametrize('name', FAULTS)
def test_each_fault_is_found_with_its_fix(name):
    faulty, check, severity, what, fix = FAULTS[name]
    found = [f for f in examine(faulty) if f.check == check and f.severity == severity
             and what in f'{f.topic} {f.seen}']
    assert len(found) == 1, examine(faulty)
    assert fix in found[0].fix
    worst = {f.severity for f in examine(faulty)}
    assert (ERROR in worst) == (severity == ERROR), 'a fault makes no other worse'


def test_every_fault_has_something_to_type():
    for faulty, *_ in FAULTS.values():
        assert all(f.fix for f in examine(faulty) if f.severity != OK)


def test_simulated_time_is_judged_by_its_clock():
    simulated = graph(image(lag=1.7e9, simulated_lag=0.02), odom(lag=1.7e9, simulated_lag=0.0),
                      clocks=('/gazebo',))
    findings = examine(simulated)
    assert {f.severity for f in findings} == {OK}
    assert any('use_sim_time:=true' in f.fix for f in findings)


def names_of(parameters, before=''):
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from names_of(value, f'{before}{name}.')
        else:
            yield before + name


def test_a_time_out_of_commands_is_told_from_others():
    """By the files that we give: a time-out of twist_mux's lock would hold the robot for ever."""
    taken = {name for path in (ROOT / 'config' / 'graph').glob('*.yaml')
             for node in yaml.safe_load(path.read_text()).values()
             for name in names_of(node['ros__parameters']) if is_command_timeout(name)}
    assert taken == {'topics.policy.timeout', 'topics.joystick.timeout', 'velocity_timeout'}
    assert all(map(is_command_timeout, ('cmd_vel_timeout', 'cmd_timeout', 'timeout',
                                        'drive.watchdog_timeout')))


def test_a_base_that_stops_by_itself_is_trusted_over_parameters():
    findings = examine(graph(base_stop=BaseStop(0.3, 0.6), timeouts=()))
    assert [f.severity for f in findings if f.check == 'base time-out'] == [OK]


HOUSE, SEARCH = (Policy.read(ROOT / 'models' / name) for name in ('house', 'search'))


def focal(degrees, side):
    return side / 2 / math.tan(math.radians(degrees) / 2)


@pytest.mark.parametrize('policy, lens, severity, what, fix', [
    (HOUSE, Lens(640, 480, focal(90, 480)), OK, 'the middle 480 x 480 pixels', ''),
    # tan(45 deg) / tan(60 deg) of 480 rows
    (HOUSE, Lens(640, 480, focal(120, 480)), OK, 'the middle 277 x 277 pixels', ''),
    (HOUSE, Lens(640, 480, focal(54, 480)), ERROR, 'at least the 90 deg', 'wider lens'),
    (HOUSE, Lens(64, 48, focal(90, 48)), WARNING, 'enlarged to 84', 'larger picture'),
    # 69 deg across: 640 columns are taken, and 160 rows are grey
    (SEARCH, Lens(640, 480, focal(69, 640)), OK, 'grey in 160 rows', ''),
    (SEARCH, Lens(640, 480, focal(69, 640)), OK, 'magnified 1.46 times', ''),
    (SEARCH, Lens(640, 480, focal(40, 640)), ERROR, '50 to 120 deg', 'another lens'),
])
def test_the_camera_is_compared_with_the_policy(policy, lens, severity, what, fix):
    found = [f for f in examine(graph(image(pictures=(f'rgb8 {lens.width} x {lens.height}',)),
                                      lens=lens), policy)
             if f.check == 'camera' and f.severity == severity]
    assert len(found) == 1 and what in found[0].seen and fix in found[0].fix


def test_the_robot_file_is_compared_with_camera_and_policy():
    robot = load_robot(ROOT / 'config' / 'robots' / 'turtlebot4.yaml')
    found = [f for f in examine(graph(), SEARCH, robot) if f.severity == WARNING]
    assert any('0.25 m above the floor' in f.seen for f in found)
    assert any('says 54 deg' in f.seen and 'camera_fov_deg: 77.3' in f.fix for f in found)
    slow = dataclasses.replace(RobotSpec(), actions=tuple(
        dataclasses.replace(action, dx=0.3) if action.name == 'forward' else action
        for action in RobotSpec().actions))
    [error] = [f for f in examine(graph(), SEARCH, slow) if f.severity == ERROR]
    assert error.check == 'robot' and 'how far forward moves' in error.seen


def test_the_page_escapes_what_others_say():
    hostile = graph(image(fault='<script>alert(1)</script>'))
    text = graph_page(hostile, examine(hostile))
    assert '<script>' not in text and '&lt;script&gt;' in text and '<code>' in text


def headings(stops_at, end=5.0, speed=0.3):
    """Time and yaw at 50 Hz of a base that turns from 0 s to `stops_at`."""
    times = np.arange(0.0, end, 0.02)
    return np.stack([times, speed * np.minimum(times, stops_at)], axis=1)


@pytest.mark.ros
def test_the_trial_of_a_base_is_judged_by_its_headings():
    from vn_nav.nodes.base_check import judge
    stopped = judge(headings(1.5), silent=1.0, end=4.0)
    assert stopped.turned == pytest.approx(0.3, abs=0.02)
    assert stopped.seconds == pytest.approx(0.5, abs=0.05)
    assert judge(headings(9.0), silent=1.0, end=4.0).seconds is None
    assert judge(headings(0.0), silent=1.0, end=4.0).turned == 0.0
    assert judge(headings(1.5, speed=-0.3), silent=1.0, end=4.0).turned < 0
    assert judge(np.zeros((0, 2)), silent=1.0, end=4.0).seconds is None
