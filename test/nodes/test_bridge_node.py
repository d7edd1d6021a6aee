"""sim_bridge_node as a robot: Twist alone, time-outs, episodes, and parity with NavigationEnv."""

import dataclasses
import itertools
import json
import math
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_harness import PATIENCE, ask, child, wait_until, write_checkpoint
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, LaserScan
from std_msgs.msg import Bool, Float32, String, UInt8
from std_srvs.srv import Trigger

from vn_msgs_py.images import decode_rgb
from vn_msgs_py.motion import fill_twist, odometry_to_array, yaw_to_quaternion
from vn_msgs_py.topics import LATCHED, topic
from vn_nav.bags.storage.reader import read_bag
from vn_nav.evaluation.bag_episodes import drives_from_bag
from vn_nav.nodes.qos import qos
from vn_nav.policy.motion import ActionExecutor
from vn_nav.resources import share_file
from vn_nav.robot import AXES, Action, RobotSpec, load_robot
from vn_sim_bridge.bridge_messages import odom_in_map
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.tasks import wrap_angle
from vn_sim_bridge.robot.goal_pictures import GoalPicture, save_goal_pictures
from vn_sim_bridge.robot.simulated_robot import TERMINATED, TICK, SimulatedRobot

pytestmark = pytest.mark.ros
DEMO_BASE = str(share_file('config/robots/demo_base.yaml'))
BRIDGE = 'vn_sim_bridge.bridge_node'
OUTCOMES = {'reward': Float32, 'episode_end': UInt8, 'episode_result': String}


class Listener:
    """Hears what a robot publishes, and can send any Twist."""

    def __init__(self):
        self.node = rclpy.create_node('listener')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.heard = {}
        for name, kind in (('odom', Odometry), ('ground_truth/odom', Odometry),
                           ('image_raw', Image), ('goal_image', Image), ('scene', String),
                           ('episode', String), ('camera_info', CameraInfo),
                           *OUTCOMES.items()):
            self.heard[name] = []
            self.node.create_subscription(kind, name, self.heard[name].append, qos(name, depth=50))
        self.command = self.node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))
        self.arrived = self.node.create_publisher(Bool, 'arrived', qos('arrived'))

    def spin(self):
        self.executor.spin_once(timeout_sec=0.01)

    def pause(self, seconds):
        end = time.monotonic() + seconds
        wait_until(lambda: time.monotonic() > end, self.spin)

    def hears(self, name, count):
        """Wait for so many messages on a topic; the newest."""
        wait_until(lambda: len(self.heard[name]) >= count, self.spin)
        assert len(self.heard[name]) == count
        return self.heard[name][-1]

    def drive(self, delta, robot):
        """One decision in lock-step: a displacement along one axis, under the robot's limits."""
        rewards = len(self.heard['reward'])
        axis = AXES[int(np.flatnonzero(delta)[0])]
        executor = ActionExecutor(dataclasses.replace(robot, actions=(
            Action('it', **{axis: float(delta[AXES.index(axis)])}),)), tolerance=1e-9, creep=0.0)
        executor.begin(0, None)
        over = False
        while not over:
            velocity, over = executor.velocity(TICK, None)
            before, moving = self.pose('odom')[6], self.pose('odom')[3:6].any()
            self.command.publish(fill_twist(Twist(), velocity))
            # One tick for one command; what still comes of the rest before is not its answer.
            wait_until(lambda: self.pose('odom')[6] > before and (  # noqa: B023
                moving or self.pose('odom')[3:6].any()), self.spin)  # noqa: B023
        # Each topic has its own way here: what stands on one may still be under way on another.
        wait_until(lambda: self.pose()[6] >= self.pose('odom')[6], self.spin)
        return self.hears('reward', rewards + 1).data

    def pose(self, name='ground_truth/odom'):
        return odometry_to_array(self.heard[name][-1])


@pytest.fixture
def listener():
    rclpy.init()
    listener = Listener()
    yield listener
    listener.node.destroy_node()
    rclpy.shutdown()


def test_any_twist_drives_it_and_silence_stops_it(listener, tmp_path):
    with child(BRIDGE, tmp_path / 'log', house=7, noise=False):
        wait_until(lambda: all(heard for name, heard in listener.heard.items()
                               if name not in OUTCOMES), listener.spin)
        scene = json.loads(listener.heard['scene'][0].data)
        assert scene['house'] == 7 and len(scene['goals']) == 5
        assert decode_rgb(listener.heard['image_raw'][-1]).shape == (84, 84, 3)
        assert listener.heard['camera_info'][-1].k[0] == pytest.approx(42.0)  # 90 degrees
        assert listener.heard['camera_info'][-1].k[2] == 41.5
        covariance = np.array(listener.heard['odom'][-1].pose.covariance).reshape(6, 6)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        before = listener.pose()
        message = Twist()
        message.angular.z = 0.5
        for _ in range(20):
            listener.command.publish(message)
            listener.pause(0.05)
        turned = wrap_angle(listener.pose()[2] - before[2])
        assert 0.25 < turned < 0.7  # a second at 0.5 rad/s, on a machine that may be busy
        listener.pause(1.2)  # half a second without a command, and 0.3 s to brake
        assert listener.pose()[5] == 0.0
        stands = listener.pose()
        listener.pause(0.5)
        assert np.array_equal(listener.pose()[:3], stands[:3])
        assert wrap_angle(stands[2] - before[2]) < 1.0
        stamps = [odometry_to_array(m)[6] for m in listener.heard['odom']]
        assert np.diff(stamps).min() > 0  # time never goes back


def test_reset_takes_the_goal_pose_and_refuses_a_wall(listener, tmp_path):
    with child(BRIDGE, tmp_path / 'log', house=7):
        wait_until(lambda: listener.heard['episode'], listener.spin)
        client = listener.node.create_client(Trigger, '/sim_bridge_node/reset')
        publisher = listener.node.create_publisher(PoseStamped, 'goal_pose', qos('goal_pose'))
        wait_until(lambda: client.service_is_ready() and publisher.get_subscription_count(),
                   listener.spin)
        ask(client, Trigger.Request(), listener.spin)  # from now on no answer is lost
        goal = json.loads(listener.heard['scene'][0].data)['goals'][2]['pose']

        def reset(x, y):
            message = PoseStamped()
            message.pose.position.x, message.pose.position.y = x, y
            publisher.publish(message)
            listener.pause(0.3)
            future = client.call_async(Trigger.Request())
            wait_until(future.done, listener.spin)
            return future.result()
        answer = reset(-5.0, 0.0)
        assert not answer.success and 'can stand' in answer.message
        goals = len(listener.heard['goal_image'])
        assert reset(goal[0], goal[1]).success
        wait_until(lambda: len(listener.heard['goal_image']) > goals, listener.spin)
        episode = json.loads(listener.heard['episode'][-1].data)
        assert episode['goal'] == -1 and episode['goal_pose'][:2] == goal[:2]


@pytest.mark.slow
def test_no_message_kills_it_and_limits_are_kept(listener, tmp_path):
    """Commands and goals of every kind; then it still drives, within the robot's limits."""
    with child(BRIDGE, tmp_path / 'log', house=7, noise=False) as bridge:
        publisher = listener.node.create_publisher(PoseStamped, 'goal_pose', qos('goal_pose'))
        wait_until(lambda: listener.heard['ground_truth/odom'] and listener.heard['scene']
                   and listener.command.get_subscription_count()
                   and publisher.get_subscription_count(), listener.spin)
        wild = (0.0, math.nan, math.inf, -math.inf, 1e308, -1e308)
        for x, w, frame in itertools.product(wild, wild, ('map', 'odom', '', 'elsewhere')):
            goal = PoseStamped()
            goal.header.frame_id, goal.pose.orientation.w = frame, w
            goal.pose.position.x = goal.pose.position.y = x
            publisher.publish(goal)
            twist = Twist()
            twist.linear.x = twist.angular.z = x
            twist.angular.x = w
            listener.command.publish(twist)
            listener.spin()
        client = listener.node.create_client(Trigger, '/sim_bridge_node/reset')
        ask(client, Trigger.Request(), listener.spin)  # from now on no answer is lost
        goals = [goal['pose'] for goal in json.loads(listener.heard['scene'][0].data)['goals']]

        def reset(frame, pose, *, scale=1.0):
            goal, q = PoseStamped(), yaw_to_quaternion(pose[2])
            goal.header.frame_id = frame
            goal.pose.position.x, goal.pose.position.y = pose[:2]
            goal.pose.orientation.z, goal.pose.orientation.w = scale * q[2], scale * q[3]
            publisher.publish(goal)
            listener.pause(0.3)
            count, future = len(listener.heard['episode']), client.call_async(Trigger.Request())
            wait_until(future.done, listener.spin)
            assert future.result().success
            wait_until(lambda: len(listener.heard['episode']) > count, listener.spin)
            return json.loads(listener.heard['episode'][-1].data)
        assert reset('map', goals[2])['goal_pose'][:3] == pytest.approx(goals[2][:3])
        # The same place as odometry knows it, once the new start has arrived here.
        listener.pause(0.3)
        true, said = listener.pose()[:3], listener.pose('odom')[:3]
        x, y, turn = odom_in_map(true, said)
        c, s, (gx, gy) = math.cos(turn), math.sin(turn), (goals[1][0] - x, goals[1][1] - y)
        in_odom = (c * gx + s * gy, c * gy - s * gx, goals[1][2] - turn)
        assert reset('odom', in_odom)['goal_pose'][:3] == pytest.approx(goals[1][:3], abs=1e-6)
        for frame, scale in (('base_link', 1.0), ('map', 0.0)):
            listener.pause(1.1)  # a second of silence, so that it is said of each
            assert reset(frame, goals[0], scale=scale)['goal'] >= 0, 'one of its own goals'
        message = Twist()
        message.linear.x, message.angular.z = 5.0, 20.0
        del listener.heard['ground_truth/odom'][:]
        for _ in range(30):
            listener.command.publish(message)
            listener.pause(0.05)
        speeds = np.array([odometry_to_array(m)[3:6] for m in listener.heard['ground_truth/odom']])
        assert 0.5 < speeds[:, 2].max() <= 0.8 and speeds[:, 0].max() <= 0.3
        assert np.abs(np.diff(speeds[:, 2])).max() <= 1.6 * TICK + 1e-6
        poses = np.array([odometry_to_array(m) for m in listener.heard['ground_truth/odom']])
        turns = np.abs(wrap_angle(np.diff(poses[:, 2])))
        assert turns.max() <= 0.8 * TICK + 1e-9
        assert bridge.poll() is None
    log = (tmp_path / 'log').read_text()
    assert 'Traceback' not in log and "'base_link'" in log and 'length 1' in log
    assert sum('goal_pose is ignored' in line for line in log.splitlines()) < 20


@pytest.mark.slow
def test_it_reads_stamped_commands_and_drives_freely(listener, tmp_path):
    with child(BRIDGE, tmp_path / 'log', house=7, noise=False, free_driving=True,
               enable_stamped_cmd_vel=True, camera_rate=5.0, frame_prefix='r2/') as bridge:
        # The topic has one type a node: the listener's own publisher is of the other one.
        listener.node.destroy_publisher(listener.command)
        command = listener.node.create_publisher(TwistStamped, 'cmd_vel', qos('cmd_vel'))
        scans, touched, status, compressed = [], [], [], []
        for kind, name, heard in ((LaserScan, 'scan', scans), (Bool, 'collision', touched),
                                  (CompressedImage, 'image_raw/compressed', compressed),
                                  (DiagnosticArray, '/diagnostics', status)):
            listener.node.create_subscription(kind, name, heard.append, qos(name, depth=50))
        wait_until(lambda: listener.heard['odom'] and scans and compressed and status
                   and command.get_subscription_count(), listener.spin)
        values = {v.key: v.value for v in status[-1].status[0].values}
        assert values['state'] == 'free driving' and values['last_command_age'] == 'no command yet'
        listener.pause(2.0)
        stamps = np.array([m.header.stamp.sec + m.header.stamp.nanosec * 1e-9
                           for m in listener.heard['image_raw']])
        assert len(stamps) > 4 and np.diff(stamps).min() > 0.19, 'the rate holds at rest'
        before = listener.pose()
        message = TwistStamped()
        message.twist.angular.z = 0.5
        for _ in range(20):
            command.publish(message)
            listener.pause(0.05)
        wait_until(lambda: touched and not listener.pose()[3:6].any(), listener.spin)
        assert wrap_angle(listener.pose()[2] - before[2]) > 0.2
        assert np.isfinite(scans[-1].ranges).all() and scans[-1].header.frame_id == 'r2/base_scan'
        assert decode_rgb(compressed[-1]).shape == (84, 84, 3)
        assert listener.heard['odom'][-1].header.frame_id == 'r2/odom'
        assert listener.heard['ground_truth/odom'][-1].header.frame_id == 'map'
        client = listener.node.create_client(Trigger, '/sim_bridge_node/reset')
        assert ask(client, Trigger.Request(), listener.spin)[0].success
        wait_until(lambda: math.dist(listener.pose()[:2], before[:2]) > 0.1, listener.spin)
        for name in ('goal_image', 'episode', *OUTCOMES):
            assert not listener.heard[name], f'{name} belongs to episodes'
        wait_until(lambda: float(dict((v.key, v.value) for v in status[-1].status[0].values)[
            'last_command_age']) > 1.0, listener.spin)
        # Who sends the other type is named.
        context = rclpy.Context()  # a participant of its own: in one a topic has one type
        rclpy.init(context=context)
        other = rclpy.create_node('mixer', context=context)
        other.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))
        wait_until(lambda: status[-1].status[0].level == DiagnosticStatus.ERROR, listener.spin)
        assert 'mixer' in status[-1].status[0].message
        assert 'enable_stamped_cmd_vel' in status[-1].status[0].message
        other.destroy_node()
        rclpy.shutdown(context=context)
        assert bridge.poll() is None


@pytest.mark.slow
def test_a_newcomer_is_up_to_date_and_may_ask_for_reliable(listener, tmp_path):
    """As an RViz display does; the truth of the last minutes is not poured over it."""
    with child(BRIDGE, tmp_path / 'log', house=7):
        wait_until(lambda: len(listener.heard['ground_truth/odom']) > 40, listener.spin)
        late = {'ground_truth/odom': [], 'image_raw': [], 'camera_info': [], 'scan': [],
                'depth/image_raw': [], 'depth/camera_info': [], 'labels/image_raw': []}
        kinds = {'camera_info': CameraInfo, 'depth/camera_info': CameraInfo, 'scan': LaserScan,
                 'ground_truth/odom': Odometry}
        begun = listener.pose()[6]
        for name, heard in late.items():
            # A latched topic would serve its history to whoever asks for it.
            durability = (DurabilityPolicy.TRANSIENT_LOCAL if topic(name).durability == LATCHED
                          else DurabilityPolicy.VOLATILE)
            listener.node.create_subscription(
                kinds.get(name, Image), name, heard.append, QoSProfile(
                    depth=50, reliability=ReliabilityPolicy.RELIABLE, durability=durability))
        wait_until(lambda: all(late.values()), listener.spin)
        for name, heard in late.items():
            stamp = heard[0].header.stamp.sec + heard[0].header.stamp.nanosec * 1e-9
            assert stamp > begun - (5.5 if name == 'ground_truth/odom' else 0.5), name
        assert late['depth/camera_info'][0].k[2] == 41.5


@pytest.mark.slow
def test_a_restarted_bridge_shows_a_goal_with_another_stamp(listener, tmp_path):
    stamps = []
    for mode in ('real_time', 'real_time', 'lock_step', 'lock_step'):
        with child(BRIDGE, tmp_path / 'log', house=7, time=mode) as bridge:
            wait_until(lambda: listener.heard['goal_image'], listener.spin)
            goal = listener.heard['goal_image'][-1]
            stamps.append((goal.header.stamp.sec, goal.header.stamp.nanosec))
            bridge.send_signal(signal.SIGINT)
            assert bridge.wait(PATIENCE) == 0
        listener.heard['goal_image'].clear()
    assert len(set(stamps)) == 4 and sorted(stamps[:2]) == stamps[:2]
    assert abs(stamps[0][0] - time.time()) < 300 and stamps[3][0] < 86_400


def test_a_robot_that_stands_is_never_late(listener, tmp_path):
    def age():
        return time.time() - odometry_to_array(listener.heard['odom'][-1])[6]
    with child(BRIDGE, tmp_path / 'log', house=7) as bridge:
        listener.hears('odom', 1)
        wait_until(lambda: age() < 0.5, listener.spin)
        bridge.send_signal(signal.SIGSTOP)
        listener.pause(1.5)
        assert age() > 1.0
        bridge.send_signal(signal.SIGCONT)
        wait_until(lambda: age() < 0.5, listener.spin, what='its stamps are those of the present')


@pytest.mark.slow
@pytest.mark.parametrize('aspect, size', [(4 / 3, (64, 48)), (0.75, (48, 64))])
def test_a_camera_of_another_format(listener, tmp_path, aspect, size):
    with child(BRIDGE, tmp_path / 'log', house=7, size=48, aspect=aspect):
        seen, info = listener.hears('image_raw', 1), listener.hears('camera_info', 1)
        goal = listener.hears('goal_image', 1)
    assert (seen.width, seen.height) == (info.width, info.height) == (goal.width, goal.height)
    assert (seen.width, seen.height) == size
    assert info.k[0] == pytest.approx(24)  # 90 deg along the shorter side


def test_a_base_that_is_late_is_no_robot_in_lock_step(listener, tmp_path):
    with child(BRIDGE, tmp_path / 'log', house=7, time='lock_step',
               randomisation='harsh') as bridge:
        assert bridge.wait(PATIENCE) == 2
    assert 'real_time' in (tmp_path / 'log').read_text().strip().splitlines()[-1]


@pytest.mark.slow
def test_late_pictures_have_the_stamps_of_when_they_were_taken(listener, tmp_path):
    late = tmp_path / 'late.yaml'
    late.write_text('camera_delay: [0.4, 0.4]\n')
    with child(BRIDGE, tmp_path / 'log', house=7, randomisation=str(late)):
        behind = []

        def look():
            count = len(listener.heard['image_raw'])
            listener.spin()
            if len(listener.heard['image_raw']) > count and listener.heard['odom']:
                stamp = listener.heard['image_raw'][-1].header.stamp
                now = odometry_to_array(listener.heard['odom'][-1])[6]
                behind.append(now - stamp.sec - 1e-9 * stamp.nanosec)
        wait_until(lambda: len(behind) >= 10, look)
    assert 0.3 < np.median(behind) < 1.5, behind  # a loaded machine hears late


@pytest.mark.slow
def test_two_bridges_have_a_clock_each_or_the_second_refuses(listener, tmp_path):
    clocks = {name: [] for name in ('/clock', '/robot2/clock')}
    for name, heard in clocks.items():
        listener.node.create_subscription(Clock, name, heard.append, qos('/clock', depth=100))
    with child(BRIDGE, tmp_path / 'one', house=7, start_time=5000.0):
        wait_until(lambda: clocks['/clock'], listener.spin)
        with child(BRIDGE, tmp_path / 'same', house=7) as same:
            wait_until(lambda: same.poll() is not None, listener.spin)
            assert same.returncode == 2
        lines = (tmp_path / 'same').read_text().strip().splitlines()
        assert '/clock:=clock' in lines[-1] and 'Traceback' not in str(lines)
        with child(BRIDGE, tmp_path / 'two', rules=('__ns:=/robot2',), house=7,
                   start_time=9.0) as two:
            wait_until(lambda: len(clocks['/robot2/clock']) > 20, listener.spin)
            listener.pause(0.5)
            assert two.poll() is None
    for name, first in (('/clock', 5000), ('/robot2/clock', 9)):
        times = [m.clock.sec + m.clock.nanosec * 1e-9 for m in clocks[name]]
        assert np.diff(times).min() > 0 and first <= times[0] < first + 100, name


@pytest.mark.slow
def test_in_lock_step_a_stop_at_full_speed_is_rest_within_the_limits(listener, tmp_path):
    """Every tick of braking waits for a command, so that it is the same on any machine."""
    with child(BRIDGE, tmp_path / 'log', house=7, noise=False, time='lock_step', seed=3):
        wait_until(lambda: listener.heard['odom']
                   and listener.command.get_subscription_count(), listener.spin)
        message = Twist()
        message.angular.z = 20.0

        def answer(message):
            before, moving = listener.pose('odom')[6], listener.pose('odom')[5] != 0
            listener.command.publish(message)
            wait_until(lambda: listener.pose('odom')[6] > before and (
                moving or listener.pose('odom')[5] != 0), listener.spin)
            return listener.pose('odom')[5]
        speeds = [answer(message) for _ in range(14)]
        assert speeds == pytest.approx([min(0.08 * (k + 1), 0.8) for k in range(14)])
        listener.pause(0.5)
        assert listener.pose('odom')[5] == speeds[-1], 'it waits'
        speeds = [answer(Twist()) for _ in range(10)]
        assert speeds == pytest.approx([0.8 - 0.08 * (k + 1) for k in range(10)], abs=1e-6)
        assert speeds[-1] == 0.0
        for _ in range(5):
            answer(message)
        begun = time.monotonic()
        wait_until(lambda: listener.pose('odom')[5] == 0.0, listener.spin)  # silence
        assert 1.5 < time.monotonic() - begun < 10.0


def test_odom_drifts_and_the_truth_does_not(listener, tmp_path):
    with child(BRIDGE, tmp_path / 'log', house=7, noise=False,
               time='lock_step', robot=DEMO_BASE, odometry_drift=30.0):
        wait_until(lambda: listener.heard['odom'] and listener.heard['ground_truth/odom']
                   and listener.command.get_subscription_count(), listener.spin)
        said, true = listener.pose('odom')[:3], listener.pose()[:3]
        for _ in range(3):
            listener.drive((0.0, 0.0, 0.4, 0.0), load_robot(DEMO_BASE))
        assert wrap_angle(listener.pose()[2] - true[2]) == pytest.approx(1.2, abs=1e-9)
        off = wrap_angle(listener.pose('odom')[2] - said[2]) - 1.2
        assert 0.001 < abs(off) < 0.6  # 6 deg are one standard deviation


def test_it_shows_the_goal_pictures_of_a_folder(listener, tmp_path):
    cells = generate_house(7, rooms=5).floor.centres()
    rng = np.random.default_rng(0)
    goals = [GoalPicture(rng.integers(0, 256, (30, 40, 3), np.uint8), (*cells[k], 0.25 * k))
             for k in range(0, 40, 20)]
    save_goal_pictures(tmp_path / 'goals', goals)
    with child(BRIDGE, tmp_path / 'log', house=7, goals=tmp_path / 'goals'):
        wait_until(lambda: listener.heard['episode'] and listener.heard['goal_image']
                   and listener.heard['scene'], listener.spin)
        episode = json.loads(listener.heard['episode'][0].data)
        goal = goals[episode['goal']]
        assert episode['goal_pose'][:3] == pytest.approx(goal.pose)
        assert np.array_equal(decode_rgb(listener.heard['goal_image'][0]), goal.picture)
        scene = json.loads(listener.heard['scene'][0].data)
        assert [own['pose'][:3] for own in scene['goals']] == [
            pytest.approx(goal.pose) for goal in goals]


@pytest.mark.slow
def test_bad_parameters_are_one_line_and_exit_code_2():
    for parameter, word in (('backend:=thor', 'backend'), ('house:=-3', 'seed'),
                            ('odometry_drift:=-1.0', 'odometry_drift'),
                            ('start_time:=-1.0', 'start_time'),
                            ('goals:=/nowhere', 'goals.json'),
                            ('stop:=never', 'stop'), ('time:=yesterday', 'time'),
                            ('rooms:=40', 'rooms')):
        done = subprocess.run(
            [sys.executable, '-m', BRIDGE, '--ros-args', '-p', parameter],
            capture_output=True, text=True, timeout=60)
        assert done.returncode == 2, done.stderr
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert word in done.stderr


@pytest.fixture(scope='module')
def journey():
    """`NavigationEnv` with declared stops: the oracle's way, and a false stop at once.

    Displacements of the first robot's decisions; whether it could have declared after each; and
    the decisions of both episodes, the declaration included.
    """
    env = NavigationEnv(EnvConfig(scenes=('house:7',), num_envs=2, noise=False, stop='declared'))
    _, info = env.reset(seed=5)
    deltas, arrived = [], []
    while True:
        actions = [env.oracle_actions()[0], env.declare_action]
        _, reward, ended, _, info = env.step(actions)
        if not deltas:
            assert ended[1] and not info['success'][1] and reward[1] == 0.0
            false_stop = int(info['decisions'][1])
        if ended[0]:
            assert info['success'][0] and reward[0] == 1.0
            return deltas, arrived, int(info['decisions'][0]), false_stop
        deltas.append(env._base.deltas[actions[0]])
        arrived.append(bool(info['arrived'][0]))


def test_a_declared_stop_is_judged_as_navigation_env_judges_it(journey):
    deltas, arrived, decisions, false_stop = journey
    robot = SimulatedRobot('house:7', robot=RobotSpec(), noise=False, seed=5, stop='declared')
    episode = robot.begin_episode(0)
    for delta in deltas:
        assert robot.tick(delta / TICK) is None
        judged = robot.tick(np.zeros(4))
        assert (judged.success, judged.end) == (False, 0)  # arriving alone is nothing
    assert arrived[-1] and not any(arrived[:-1])
    judged = robot.declare()
    assert (judged.success, judged.end, judged.collided) == (True, TERMINATED, False)
    assert episode.decisions == decisions == len(deltas) + 1
    episode = robot.begin_episode(1)
    judged = robot.declare()
    assert (judged.success, judged.end) == (False, TERMINATED)
    assert episode.decisions == false_stop == 1


def test_the_robot_ends_the_episode_when_stops_are_declared(listener, journey, tmp_path):
    deltas, _, decisions, _ = journey

    def say(arrived):
        listener.arrived.publish(Bool(data=arrived))

    def result():
        return json.loads(listener.heard['episode_result'][-1].data)
    with child(BRIDGE, tmp_path / 'log', house=7, noise=False, seed=5,
               time='lock_step', robot=DEMO_BASE, stop='declared', episodes=3,
               exit_when_done=True) as bridge:
        wait_until(lambda: listener.heard['odom'] and listener.heard['episode']
                   and listener.arrived.get_subscription_count()
                   and listener.command.get_subscription_count(), listener.spin)
        say(False)  # the goal is taken
        for delta in deltas:
            assert listener.drive(delta, load_robot(DEMO_BASE)) == 0.0
        listener.pause(0.3)
        assert not listener.heard['episode_end'], 'it stands at the goal and has not said so'
        say(True)
        assert listener.hears('episode_end', 1).data == 1
        assert listener.heard['reward'][-1].data == 1.0
        listener.hears('episode_result', 1)
        assert result()['success'] and result()['decisions'] == decisions
        say(True)  # as if it still meant the goal before
        listener.pause(0.5)
        assert len(listener.heard['episode_end']) == 1
        say(False)
        say(True)
        assert listener.hears('episode_end', 2).data == 1
        assert listener.heard['reward'][-1].data == 0.0
        listener.hears('episode_result', 2)
        assert not result()['success'] and result()['decisions'] == 1
        listener.hears('episode', 3)
        said = time.monotonic()
        say(True)  # nobody takes it back: it is meant
        assert listener.hears('episode_end', 3).data == 1
        assert time.monotonic() - said > 1.0
        assert bridge.wait(PATIENCE) == 0


@pytest.mark.slow
def test_fifty_action_sequences_end_where_navigation_env_ends(tmp_path):
    """The parity test: policy_node and bridge over ROS against NavigationEnv, noise off."""
    sequences, length = 50, 8
    checkpoint = write_checkpoint(tmp_path / 'checkpoint')
    with child('vn_nav.nodes.recorder_node', tmp_path / 'recorder.log',
               output=tmp_path / 'bag') as recorder, \
         child(BRIDGE, tmp_path / 'bridge.log', house=7, time='lock_step',
               robot=DEMO_BASE, noise=False, seed=5, episodes=sequences, max_decisions=length,
               exit_when_done=True) as bridge:
        # The true pose has no history: nobody drives before the recorder has met the bridge.
        wait_until(lambda: 'sim_bridge_node' in (tmp_path / 'recorder.log').read_text(),
                   lambda: time.sleep(0.1))
        with child('vn_nav.nodes.policy_node', tmp_path / 'policy.log', checkpoint=checkpoint,
                   time='lock_step', robot=DEMO_BASE, auto_enable=True, seed=5) as policy:
            bridge.wait(PATIENCE)
            for process in (policy, recorder):
                process.send_signal(signal.SIGINT)
                assert process.wait(PATIENCE) == 0
    drive = drives_from_bag(tmp_path / 'bag')[0]
    actions = [(record.stamp, record.message.data)
               for record in read_bag(tmp_path / 'bag', ('action',))]
    begins = [record.stamp for record in read_bag(tmp_path / 'bag', ('episode',))]
    assert len(drive.episodes) == sequences
    env = NavigationEnv(EnvConfig(scenes=('house:7',), num_envs=1, noise=False,
                                  max_decisions=1000))
    env.reset(seed=0)
    distances, turns = [], []
    for k, recorded in enumerate(drive.episodes):
        end = begins[k + 1] if k + 1 < len(begins) else np.inf
        chosen = [action for stamp, action in actions if begins[k] <= stamp < end]
        assert len(chosen) == recorded.episode.decisions
        env.simulator.place(np.array([0]), np.array([recorded.facts['start']]))
        for action in chosen:
            env.simulator.move(env._base.deltas[[action]])
        x, y, yaw = recorded.trajectory[-1]
        distances.append(np.hypot(*(env.simulator.poses[0, :2] - (x, y))))
        turns.append(abs(np.degrees(wrap_angle(env.simulator.poses[0, 2] - yaw))))
    assert max(distances) < 0.02 and max(turns) < 2.0, (max(distances), max(turns))
    print(f'largest difference {max(distances) * 1000:.2f} mm, {max(turns):.4f} deg')


def test_nothing_is_compiled_once_the_robot_runs():
    # A compilation takes seconds, in which the camera is silent and the policy stops the robot.
    code = """
import numba.core.dispatcher as dispatcher, numpy as np
from vn_nav.robot import RobotSpec
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot
robot = SimulatedRobot('house:7?rooms=2', robot=RobotSpec(), size=40,
                       randomisation=load_randomisation('rough'))
robot.begin_episode(0)
robot.goal_frames()
def compile(self, signature):
    raise SystemExit(f'compiles {self.py_func.__name__} {signature}')
dispatcher.Dispatcher.compile = compile
for index in range(3):
    for command in ((0.5, 0, 0, 0), (0, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 0)):
        robot.tick(np.array(command, float))
        robot.observe()
        robot.observe()
    robot.begin_episode(index + 1)
    robot.goal_frames()
print('done')
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stdout.strip() == 'done', done.stdout + done.stderr
