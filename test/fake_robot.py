"""A robot out of topics: a camera, odometry that follows the commands, and every Twist logged."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_harness import PATIENCE, ask, child, wait_until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from vn_msgs_py.images import fill_image
from vn_msgs_py.motion import fill_odometry, twist_to_array
from vn_nav.nodes.qos import qos

NODE = 'vn_nav.nodes.policy_node'
CAMERA_HZ = 30.0
ODOMETRY_HZ = 50.0
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

AFTER = {  # what a lifecycle node is after a transition
    Transition.TRANSITION_CONFIGURE: 'inactive', Transition.TRANSITION_ACTIVATE: 'active',
    Transition.TRANSITION_DEACTIVATE: 'inactive', Transition.TRANSITION_CLEANUP: 'unconfigured',
    Transition.TRANSITION_ACTIVE_SHUTDOWN: 'finalized',
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: 'finalized'}


class FakeRobot:
    """Publishes what a robot's drivers would while `spin` is called, and hears the commands.

    Args:
        size: width and height of the pictures; None: no camera of its own.
        odometry: quality of service of odom; None: there is none.
        goal: quality of service of goal_image.
        sim_time: stamps are `time`, which goes on with the steady clock, and /clock says it.

    Attributes:
        commands: (steady time, [4] velocity) of every Twist.
        statuses: (steady time, level, message, {key: value}) from /diagnostics.
        offset: added to the stamps of the pictures [s].
        focal: what camera_info says [pixels].
        sends: what is published: 'image', 'odom', 'clock'.
    """

    def __init__(self, size=(84, 84), *, odometry=None, goal=LATCHED, sim_time=False):
        self.node = rclpy.create_node('fake_robot')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.size, self.sim_time = size, sim_time
        self.image = self.info = self.odometry = self.clock = None
        if size:
            self.image = self.node.create_publisher(Image, 'image_raw', qos('image_raw'))
            self.info = self.node.create_publisher(CameraInfo, 'camera_info', qos('camera_info'))
        if odometry is not None:
            self.odometry = self.node.create_publisher(Odometry, 'odom', odometry)
        if sim_time:
            self.clock = self.node.create_publisher(Clock, '/clock', qos('/clock'))
        self.goal = self.node.create_publisher(Image, 'goal_image', goal)
        self.commands, self.statuses, self.arrived, self.images = [], [], [], 0
        self.node.create_subscription(Twist, 'cmd_vel', self._hear, qos('cmd_vel', depth=100))
        self.node.create_subscription(Bool, 'arrived', self._hear_arrived, qos('arrived'))
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnose,
                                      qos('/diagnostics'))
        self.sends = {'image', 'odom', 'clock'}
        self.offset, self.begun = 0.0, time.monotonic() - 10.0
        self.focal = min(size or (84, 84)) / 2  # 90 deg
        self._clients = {}
        self.pose = np.zeros(3)
        self._due = dict.fromkeys(self.sends, 0.0)
        self._rng = np.random.default_rng(0)
        self._pictures = [self._rng.integers(0, 255, (*reversed(size or (84, 84)), 3), np.uint8)
                          for _ in range(16)]

    def _hear(self, message):
        self.commands.append((time.monotonic(), twist_to_array(message)))

    def _hear_arrived(self, message):
        self.arrived.append(message.data)

    def _diagnose(self, message):
        status = message.status[0]
        if status.name.endswith('policy_node'):
            self.statuses.append((time.monotonic(), status.level, status.message,
                                  {entry.key: entry.value for entry in status.values}))

    @property
    def time(self):
        """Seconds since this robot's beginning, and a bit."""
        return time.monotonic() - self.begun

    def stamp(self, offset=0.0):
        """Now, on this robot's clock."""
        if not self.sim_time and not offset:
            return self.node.get_clock().now().to_msg()
        now = self.time if self.sim_time else self.node.get_clock().now().nanoseconds * 1e-9
        nanoseconds = round((now + offset) * 1e9)
        return rclpy.time.Time(nanoseconds=nanoseconds).to_msg()

    def picture(self, number=None, stamp=None):
        """The camera's next picture, of eight; or one of eight goals, which it never shows.

        A policy that recognises its goal is not there at once.
        """
        self.images += 1
        which = self.images % 8 if number is None else 8 + number % 8
        message = fill_image(Image(), self._pictures[which], 'rgb8')
        message.header.stamp = stamp or self.stamp(self.offset)
        return message

    def show_goal(self, number=0, stamp=None):
        """Publish a goal picture."""
        self.goal.publish(self.picture(number, stamp or self.stamp()))

    def _is_due(self, what, rate):
        now = time.monotonic()
        if what not in self.sends or now < self._due[what]:
            return False
        self._due[what] = max(self._due[what] + 1 / rate, now - 1 / rate)
        return True

    def spin(self):
        """Publish what is due, and take what has come."""
        if self.clock is not None and self._is_due('clock', 100.0):
            self.clock.publish(Clock(clock=self.stamp()))
        if self.odometry is not None and self._is_due('odom', ODOMETRY_HZ):
            self.publish_odometry()
        if self.image is not None and self._is_due('image', CAMERA_HZ):
            info = CameraInfo(width=self.size[0], height=self.size[1])
            info.k[0] = self.focal
            self.info.publish(info)
            self.image.publish(self.picture())
        self.executor.spin_once(timeout_sec=0.002)

    def publish_odometry(self):
        """Where the last command has brought the robot in a period."""
        velocity = self.commands[-1][1] if self.commands else np.zeros(4)
        dt = 1 / ODOMETRY_HZ
        self.pose += dt * np.array([velocity[0] * np.cos(self.pose[2]),
                                    velocity[0] * np.sin(self.pose[2]), velocity[2]])
        message = Odometry()
        message.header.stamp = self.stamp()
        self.odometry.publish(fill_odometry(message, *self.pose, velocity))

    def spin_for(self, seconds):
        """Spin for a while."""
        end = time.monotonic() + seconds
        wait_until(lambda: time.monotonic() > end, self.spin, seconds + 10)

    def _ask(self, kind, name, **fields):
        """`ros_harness.ask`; one client a service, for each new one has to be found."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, f'/policy_node/{name}')
        return ask(self._clients[name], kind.Request(**fields), self.spin)

    def call(self, kind, name, **fields):
        """Call a service of the policy while the robot goes on; its answer."""
        return self._ask(kind, name, **fields)[0]

    def state(self):
        """The node's lifecycle state, by its label."""
        return self.call(GetState, 'get_state').current_state.label

    def transition(self, number):
        """Ask for a lifecycle transition; whether it succeeded."""
        answer, asked = self._ask(ChangeState, 'change_state', transition=Transition(id=number))
        # Asked again because the first answer was lost: then it is done, and refused as unknown.
        return answer.success or (asked > 1 and self.state() == AFTER[number])

    def enable(self, seconds=PATIENCE):
        """Enable as soon as the node agrees; the last refusal before that."""
        answers = ['']

        def enabled():
            answer = self.call(SetBool, 'enable', data=True)
            if not answer.success:
                answers.append(answer.message)
                self.spin_for(0.1)
            return answer.success
        wait_until(enabled, self.spin, seconds)
        return answers[-1]

    def refusal(self):
        """What enabling answers now."""
        answer = self.call(SetBool, 'enable', data=True)
        assert not answer.success
        return answer.message

    def refuses(self, *words):
        """Ask to enable until it is refused with all of these words."""
        begun = time.monotonic()
        while not all(word in (refusal := self.refusal()) for word in words):
            assert time.monotonic() - begun < PATIENCE, (words, refusal)
            self.spin()

    def moving(self):
        """The last command moves it."""
        return bool(self.commands) and bool(self.commands[-1][1].any())

    def drive(self):
        """Show a goal, enable, and wait for the first motion."""
        self.show_goal()
        self.enable()
        begun = time.monotonic()
        while not self.moving():
            assert time.monotonic() - begun < PATIENCE, self.statuses[-1:]
            self.spin()

    def wait_for_zero(self, seconds=PATIENCE):
        """Spin until the last command is zero; when the first zero after the motion came."""
        wait_until(lambda: self.commands and not self.moving(), self.spin, seconds)
        first = self.commands[-1][0]
        for at, velocity in reversed(self.commands):
            if velocity.any():
                break
            first = at
        return first

    def says(self, *words, seconds=PATIENCE):
        """Spin until a status has one of these words in its message or values; that status.

        A loaded machine has more than one reason to stand still: name each that is right.
        """
        def matching():
            return [status for status in self.statuses if any(
                word in text for word in words for text in (status[2], *status[3].values()))]
        begun = time.monotonic()
        while not matching():
            assert time.monotonic() - begun < seconds, (words, self.statuses[-1:])
            self.spin()
        return matching()[-1]

    def close(self):
        """Take it off the graph."""
        self.executor.shutdown()
        self.node.destroy_node()


@contextmanager
def robot_and_node(checkpoint, tmp_path, *, node=None, robot=None):
    """A fake robot beside the node as a process: (robot, process)."""
    rclpy.init()
    fake = FakeRobot(**(robot or {}))
    try:
        with child(NODE, tmp_path / 'log', checkpoint=checkpoint, **(node or {})) as process:
            yield fake, process
    finally:
        fake.close()
        rclpy.shutdown()


@contextmanager
def broken_node(checkpoint, tmp_path, fault, **parameters):
    """A fake robot beside a node with a fault that is put into its process: (robot, process)."""
    words = [f'checkpoint:={checkpoint}', *(f'{k}:={v}' for k, v in parameters.items())]
    arguments = ['--ros-args', *(word for pair in words for word in ('-p', pair))]
    script = f'{fault}\nimport sys\nfrom vn_nav.nodes.policy_node import main\nsys.exit(main())'
    rclpy.init()
    fake = FakeRobot(odometry=RELIABLE)
    with open(tmp_path / 'log', 'w') as log:
        process = subprocess.Popen([sys.executable, '-c', script, *arguments], stdout=log,
                                   stderr=log, env=os.environ | {'OMP_NUM_THREADS': '1'})
    try:
        yield fake, process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        fake.close()
        rclpy.shutdown()


class OtherCamera:
    """A camera in a process of its own, to be stopped and killed."""

    def __init__(self, log):
        self._file = open(log, 'a')
        self.process = subprocess.Popen([sys.executable, __file__], stdout=self._file,
                                        stderr=subprocess.STDOUT)

    def signal(self, number):
        """Send a signal; when [s, steady]."""
        os.kill(self.process.pid, number)
        return time.monotonic()

    def close(self):
        """End it."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._file.close()


def camera():
    """The process behind `OtherCamera`: 640 x 480 at 30 Hz; SIGUSR1 pauses and resumes it."""
    rclpy.init()
    robot = FakeRobot((640, 480))

    def toggle(*_):
        robot.sends ^= {'image'}
    signal.signal(signal.SIGUSR1, toggle)
    while True:
        robot.spin()


if __name__ == '__main__':
    camera()
