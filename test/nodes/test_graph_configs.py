"""The worked files for the rest of the graph, config/graph and config/view, against our contract.

None of those packages is installed here: what can be checked is that the files parse, that their
topics and frames are ours or those of the link before, and that their limits are the robot's.
"""

import json
import re
import shlex

import pytest
import yaml
from paths import ROOT

from vn_msgs_py.topics import TOPICS, topic
from vn_nav.nodes.policy_parameters import PARAMETERS as POLICY
from vn_nav.robot import load_robot
from vn_sim_bridge.bridge_messages import Frames
from vn_sim_bridge.bridge_node import COMMAND_TIMEOUT_S
from vn_sim_bridge.bridge_parameters import PARAMETERS as BRIDGE
from vn_sim_bridge.robot.lidar import FARTHEST, NEAREST

pytestmark = pytest.mark.ros  # the bridge's constants come with rclpy

GRAPH = sorted((ROOT / 'config' / 'graph').glob('*.yaml'))
RVIZ, FOXGLOVE = ROOT / 'config/view/vn_nav.rviz', ROOT / 'config/view/foxglove.json'
ROBOT = load_robot(ROOT / 'config/robots/turtlebot4.yaml')
FRAMES = Frames.with_prefix('')
NAMES = {entry.name for entry in TOPICS}
SERVICES = {'/policy_node/enable', '/policy_node/stop', '/policy_node/reset'}
# Executables of the packages that the comments start. Ours come from the parameters' tables.
EXECUTABLES = {
    'twist_mux': 'twist_mux', 'nav2_velocity_smoother': 'velocity_smoother',
    'nav2_collision_monitor': 'collision_monitor', 'nav2_lifecycle_manager': 'lifecycle_manager',
    'rtabmap_slam': 'rtabmap', 'rviz2': 'rviz2'}
OURS = {'policy_node': POLICY, 'sim_bridge_node': BRIDGE}
# rviz_default_plugins/plugins_description.xml and rviz_common's panels, of Jazzy.
DISPLAYS = {'AccelStamped', 'Axes', 'Camera', 'DepthCloud', 'CameraInfo', 'Effort', 'Grid',
            'GridCells', 'FluidPressure', 'Illuminance', 'Image', 'InteractiveMarkers',
            'LaserScan', 'Map', 'PointCloud', 'PointCloud2', 'Polygon', 'Pose',
            'PoseWithCovariance', 'Range', 'RelativeHumidity', 'RobotModel', 'Temperature', 'TF',
            'TwistStamped', 'Marker', 'MarkerArray', 'Odometry', 'PoseArray', 'Path',
            'PointStamped', 'Wrench'}
TOOLS = {'MoveCamera', 'PublishPoint', 'Select', 'SetGoal', 'Measure', 'FocusCamera',
         'SetInitialPose', 'Interact'}
VIEWS = {'FPS', 'Orbit', 'TopDownOrtho', 'XYOrbit', 'ThirdPersonFollower'}
PANELS = {'Displays', 'Selection', 'Tool Properties', 'Views', 'Time', 'Transformation'}
# What a display of RViz reads, where it is not the display's own name.
READS = {'Map': 'nav_msgs/msg/OccupancyGrid', 'Image': 'sensor_msgs/msg/Image',
         'LaserScan': 'sensor_msgs/msg/LaserScan', 'Odometry': 'nav_msgs/msg/Odometry',
         'PoseArray': 'geometry_msgs/msg/PoseArray',
         'Pose': 'geometry_msgs/msg/PoseStamped',
         'TwistStamped': 'geometry_msgs/msg/Twist'}  # with enable_stamped_cmd_vel


def parameters(name):
    """Parameters of one file's nodes: node to parameters."""
    return {node.rpartition('/')[2]: entry['ros__parameters'] for node, entry in
            yaml.safe_load((ROOT / f'config/graph/{name}.yaml').read_text()).items()}


def of(name):
    """Parameters of a file's only node."""
    (node, values), = parameters(name).items()
    assert node == name
    return values


def commands(path):
    """The commands in the comment at a file's head, each as its words."""
    lines = re.findall(r'^#   (.+)$', path.read_text(), re.MULTILINE)
    text = '\n'.join(lines).replace('\\\n', ' ')
    return [shlex.split(line) for line in text.splitlines() if not line.startswith('CONFIG=')]


def options(words, option):
    """The values behind an option, split at their `:=`."""
    return dict(words[k + 1].split(':=', 1) for k, word in enumerate(words) if word == option)


def remappings(name, executable):
    """What a file's comment remaps when it starts an executable."""
    found = [options(words, '-r') for words in commands(ROOT / f'config/graph/{name}.yaml')
             if words[:2] == ['ros2', 'run'] and words[3] == executable]
    assert found, f'{name}.yaml does not start {executable}'
    return found[0]


@pytest.mark.parametrize('path', GRAPH, ids=lambda path: path.stem)
def test_a_file_holds_parameters_and_the_command_that_runs_it(path):
    for node, values in parameters(path.stem).items():
        assert values['use_sim_time'] is True, f'{node}: the bridge is the clock'
    started = commands(path)
    assert any(f'/graph/{path.name}' in ' '.join(words) for words in started)


@pytest.mark.parametrize('path', [*GRAPH, RVIZ], ids=lambda path: path.stem)
def test_the_commands_name_what_there_is(path):
    for words in commands(path):
        assert words[0] == 'ros2' and words[1] in ('run', 'launch', 'service'), words
        for file in re.findall(r'config/[\w./]+|\$CONFIG/[\w./]+', ' '.join(words)):
            assert (ROOT / file.replace('$CONFIG', 'config')).is_file(), file
        if words[1] != 'run':
            continue
        package, executable = words[2:4]
        if package != 'vn_nav':
            assert EXECUTABLES[package] == executable
            continue
        known = {*OURS[executable], 'use_sim_time'}
        assert set(options(words, '-p')) <= known, words
        assert set(options(words, '-r')) <= NAMES, words


def test_the_chain_leads_from_the_policy_to_the_base():
    """Each link hears what the one before says, and the base hears the last alone."""
    mux, smoother, monitor = (of(name) for name in
                              ('twist_mux', 'velocity_smoother', 'collision_monitor'))
    policy = remappings('twist_mux', 'policy_node')['cmd_vel']
    assert policy == remappings('lifecycle_manager', 'policy_node')['cmd_vel']
    assert mux['topics']['policy']['topic'] == policy
    muxed = remappings('twist_mux', 'twist_mux')['cmd_vel_out']
    assert remappings('velocity_smoother', 'velocity_smoother') == {'cmd_vel': muxed}
    assert monitor['cmd_vel_in_topic'] == 'cmd_vel_smoothed'  # the smoother's own name for it
    assert monitor['cmd_vel_out_topic'] == topic('cmd_vel').name
    links = [policy, muxed, monitor['cmd_vel_in_topic'], monitor['cmd_vel_out_topic'],
             *(entry['topic'] for name, entry in mux['topics'].items() if name != 'policy')]
    assert len(set(links)) == len(links), 'two links publish on one topic'
    stamped = (mux['use_stamped'], smoother['enable_stamped_cmd_vel'],
               monitor['enable_stamped_cmd_vel'])
    assert stamped == (False,) * 3, 'the contract says Twist, where no parameter changes it'


def test_a_person_comes_before_the_policy():
    mux = of('twist_mux')
    topics, lock = mux['topics'], mux['locks']['pause']
    assert topics['policy']['priority'] < lock['priority'] < topics['joystick']['priority'] <= 255


def test_silence_stops_every_link_as_soon_as_it_stops_the_base():
    mux, smoother, monitor = (of(name) for name in
                              ('twist_mux', 'velocity_smoother', 'collision_monitor'))
    period = 1 / POLICY['control_rate'][0]
    for seconds in (*(entry['timeout'] for entry in mux['topics'].values()),
                    smoother['velocity_timeout'], monitor['source_timeout']):
        assert 2 * period < seconds <= COMMAND_TIMEOUT_S
    assert monitor['source_timeout'] > 2 / BRIDGE['camera_rate'][0], 'two scans may be missing'


@pytest.mark.parametrize('name', ['turtlebot4', 'standard'])
def test_the_limits_are_those_of_the_robot(name):
    robot, smoother = load_robot(ROOT / f'config/robots/{name}.yaml'), of('velocity_smoother')
    velocity = [robot.max_linear, 0.0, robot.max_angular]
    acceleration = [robot.linear_acceleration, 0.0, robot.angular_acceleration]
    assert smoother['max_velocity'] == pytest.approx(velocity)
    assert smoother['min_velocity'] == pytest.approx([-value for value in velocity])
    assert smoother['max_accel'] == pytest.approx(acceleration)
    # Signed, as Nav2 wants it, and never so weak that a zero of the policy comes late.
    assert all(braking <= -value for braking, value in
               zip(smoother['max_decel'], acceleration, strict=True))
    assert smoother['smoothing_frequency'] >= POLICY['control_rate'][0]


def test_the_collision_monitor_reads_our_scan_in_our_frames():
    monitor = of('collision_monitor')
    assert (monitor['base_frame_id'], monitor['odom_frame_id']) == (FRAMES.base, FRAMES.odom)
    for source in monitor['observation_sources']:
        assert topic(monitor[source]['topic']).type == 'sensor_msgs/msg/LaserScan'
    for zone in monitor['polygons']:
        assert monitor[zone]['action_type'] == 'approach'
        assert monitor[zone]['radius'] == pytest.approx(ROBOT.footprint_radius)


def test_slam_toolbox_reads_our_scan_in_our_frames():
    slam = of('slam_toolbox')
    assert topic(slam['scan_topic']).type == 'sensor_msgs/msg/LaserScan'
    assert (slam['map_frame'], slam['odom_frame'], slam['base_frame']) == (
        FRAMES.map, FRAMES.odom, FRAMES.base)
    assert (slam['min_laser_range'], slam['max_laser_range']) == (NEAREST, FARTHEST)
    assert slam['minimum_travel_distance'] < min(
        abs(action.dx) for action in ROBOT.actions if action.dx > 0)
    assert BRIDGE['localised'][0] is False, 'two nodes would say where odom lies'


def test_rtabmap_reads_our_pictures_in_our_frames():
    values = of('rtabmap')
    assert (values['frame_id'], values['map_frame_id']) == (FRAMES.base, FRAMES.map)
    read = remappings('rtabmap', 'rtabmap')
    assert set(read) == {'rgb/image', 'rgb/camera_info', 'depth/image'}
    assert {name: topic(ours).type for name, ours in read.items()} == {
        'rgb/image': 'sensor_msgs/msg/Image', 'depth/image': 'sensor_msgs/msg/Image',
        'rgb/camera_info': 'sensor_msgs/msg/CameraInfo'}
    levels = {'reliable': 1, 'best_effort': 2}
    for parameter, ours in (('qos_image', 'image_raw'), ('qos_camera_info', 'camera_info'),
                            ('qos_scan', 'scan'), ('qos_odom', 'odom')):
        assert values[parameter] == levels[topic(ours).reliability], parameter
    assert all(isinstance(value, str) for name, value in values.items() if '/' in name)
    assert float(values['Grid/RangeMax']) == FARTHEST


def test_rviz_shows_topics_of_the_contract_with_their_quality_of_service():
    whole = yaml.safe_load(RVIZ.read_text())
    manager = whole['Visualization Manager']
    assert {panel['Class'] for panel in whole['Panels']} <= {f'rviz_common/{n}' for n in PANELS}
    assert manager['Global Options']['Fixed Frame'] in FRAMES
    assert manager['Views']['Current']['Target Frame'] in FRAMES
    assert manager['Views']['Current']['Class'].removeprefix('rviz_default_plugins/') in VIEWS
    shown = set()
    for display in manager['Displays']:
        package, _, kind = display['Class'].partition('/')
        assert package == 'rviz_default_plugins' and kind in DISPLAYS, display['Class']
        assert display['Enabled'] == display['Value'], display['Name']
        if 'Topic' not in display:
            continue
        ours = topic(display['Topic']['Value'].removeprefix('/'))
        assert ours.type == READS[kind], display['Name']
        assert display['Topic']['Reliability Policy'].lower().replace(' ', '_') == (
            ours.reliability), display['Name']
        assert display['Topic']['Durability Policy'].lower().replace(' ', '_') == (
            ours.durability), display['Name']
        shown |= {ours.name} if display['Enabled'] else set()
    assert shown >= {'image_raw', 'goal_image', 'policy_node/map', 'policy_node/hypotheses',
                     'odom', 'scan'}
    for tool in manager['Tools']:
        assert tool['Class'].removeprefix('rviz_default_plugins/') in TOOLS
        if 'Topic' in tool:
            assert topic(tool['Topic']['Value'].removeprefix('/')).publisher == 'user'


def panels(layout):
    """The panels that a layout of Foxglove arranges."""
    if isinstance(layout, str):
        return [layout]
    return panels(layout['first']) + panels(layout['second'])


def texts(value):
    """Every text in a JSON value, keys included."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, dict):
        return [text for pair in value.items() for part in pair for text in texts(part)]
    return [text for part in value for text in texts(part)] if isinstance(value, list) else []


def test_foxglove_shows_topics_of_the_contract():
    whole = json.loads(FOXGLOVE.read_text())
    assert sorted(panels(whole['layout'])) == sorted(whole['configById'])
    # Kinds of panels by the names that a layout exported from the app has.
    assert {name.partition('!')[0] for name in whole['configById']} == {
        '3D', 'Image', 'StateTransitions', 'Plot', 'DiagnosticStatusPanel', 'CallService'}
    absolute = {name if name.startswith('/') else f'/{name}' for name in NAMES}
    shown = set()
    for text in texts(whole['configById']):
        if text.startswith('/') and text not in SERVICES and text != '/policy_node':
            name = text.partition('.')[0]  # a topic, or a path into its messages
            assert name in absolute, text
            shown.add(name)
    assert shown >= {'/image_raw', '/goal_image', '/arrived', '/policy_node/map', '/odom',
                     '/cmd_vel', '/diagnostics'}
    assert whole['configById']['3D!map']['followTf'] in FRAMES


def test_the_paths_into_messages_exist():
    """A plot of a field that its message lacks stays empty."""
    from importlib import import_module
    whole = json.loads(FOXGLOVE.read_text())
    paths = [path['value'] for panel in whole['configById'].values()
             for path in panel.get('paths', ())]
    assert len(paths) >= 6
    for path in paths:
        name, *fields = path.split('.')
        package, _, kind = topic(name.removeprefix('/')).type.split('/')
        value = getattr(import_module(f'{package}.msg'), kind)()
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, (bool, int, float)), path


def test_the_managers_bring_up_the_chain_and_the_policy():
    managers = parameters('lifecycle_manager')
    started = {options(words, '-r').get('__node') for words in
               commands(ROOT / 'config/graph/lifecycle_manager.yaml')
               if words[1] == 'run' and words[2] == 'nav2_lifecycle_manager'}
    assert started == set(managers)
    chain, policy = managers['lifecycle_manager_chain'], managers['lifecycle_manager_policy']
    files = {node for path in GRAPH for node in parameters(path.stem)}
    assert set(chain['node_names']) == {'velocity_smoother', 'collision_monitor'} <= files
    assert policy['node_names'] == ['policy_node']
    assert chain['bond_timeout'] > 0 == policy['bond_timeout']
    ours, = (words for words in commands(ROOT / 'config/graph/lifecycle_manager.yaml')
             if words[2] == 'vn_nav')
    assert options(ours, '-p')['autostart'] == 'false', 'else it configures itself'


def test_the_readme_has_every_parameter_with_its_default():
    rows = re.findall(r'^\| (`[^|]+) \|([^|]*)\|', (ROOT / 'README.md').read_text(), re.MULTILINE)
    listed = {name: defaults for names, defaults in rows for name in re.findall(r'`(\w+)`', names)}
    for name, (default, *_) in {**BRIDGE, **POLICY}.items():
        shown = json.dumps(default).strip('"') or '""'
        assert name in listed and (shown in listed[name] or name == 'scene'), name
