"""`sim_bridge_node`: a simulator as a robot on ROS topics. It reads velocities alone.

Run: `ros2 run vn_nav sim_bridge_node --ros-args -p scene:=house:7`. Two of them on one
graph: each in a namespace, where its clock is too; nodes that live in its time are told so with
`-r /clock:=clock` (as `sim.launch.py` does).
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections import deque

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock as NodeClock
from rclpy.clock import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, LaserScan
from std_msgs.msg import Bool, Float32, String, UInt8
from std_srvs.srv import Trigger

from vn_msgs_py import images, motion
from vn_nav.errors import UserError
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.process import Ended, compiling, run_node
from vn_nav.nodes.qos import offered, qos
from vn_nav.robot import load_robot
from vn_sim_bridge import bridge_messages, bridge_sensors
from vn_sim_bridge.bridge_messages import Frames
from vn_sim_bridge.bridge_parameters import PARAMETERS, first_stamp, scene_of
from vn_sim_bridge.bridge_sensors import Sensors
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.goal_pictures import load_goal_pictures
from vn_sim_bridge.robot.simulated_robot import TICK, TRUNCATED, SimulatedRobot
from vn_sim_bridge.simulator import Frames as Pictures
from vn_sim_bridge.simulators import robot_for

COMMAND_TIMEOUT_S = 0.5  # s of the bridge's own time without a command: the base brakes
LOCK_STEP_TIMEOUT_S = 2.0  # s of wall time without a command in motion: the base brakes
STATEMENT_PATIENCE_S = 2.0  # s of wall time, see _on_arrived
# s after which a node has heard of the others: Fast DDS announces itself every 3 s.
DISCOVERY_S = 6.0
LINGER_S = 1.0  # s after the last episode; the policy would stop after 2 without a picture
REPORT_PERIOD_S = 1.0  # s of wall time between two messages on /diagnostics
LATE_TICKS = 2  # ticks lost between two of them that are worth a warning
OVERDUE_CALLBACKS = 10  # callbacks that are served when a tick is overdue
CLOCK_TOPIC = 'clock'  # a world each, and so a time each: /clock where there is no namespace
CLOCK_REMEDY = 'give each robot a namespace (-r __ns:=/robot2), and its nodes -r /clock:=clock'
TICK_NS = round(TICK * 1e9)


class SimBridgeNode(Node):
    """Publishes what a robot's drivers would, and judges episodes on the side."""

    def __init__(self, ended: Ended):
        super().__init__('sim_bridge_node')
        created = time.monotonic()
        values = parameters.declare(self, PARAMETERS, read_only=True,
                                    others=policy_parameters.PARAMETERS)
        self.lock_step = values['time'] == 'lock_step'
        self.pictures_in_motion = not self.lock_step or values['mode'] == 'continuous'
        self.continuous = values['mode'] == 'continuous'
        self.free = values['free_driving']
        self.episodes, self.exit_when_done = values['episodes'], values['exit_when_done']
        self.picture_ticks = max(1, round(1 / (values['camera_rate'] * TICK)))
        self.goals = load_goal_pictures(values['goals']) if values['goals'] else []
        scene = scene_of(values)
        robot = robot_for([scene], load_robot(values['robot']) if values['robot'] else None)
        work = f'opening {scene}; the first start compiles the renderer, a minute'
        with compiling(self, ended, work):
            self.robot = SimulatedRobot(
                scene, robot=robot, size=values['size'], aspect=values['aspect'],
                noise=values['noise'], seed=values['seed'],
                max_decisions=values['max_decisions'], stop=values['stop'],
                randomisation=load_randomisation(values['randomisation']),
                odometry_drift=values['odometry_drift'],
                goal_poses=[goal.pose for goal in self.goals] or None)
        if self.lock_step and self.robot.randomisation.varies_time:
            raise UserError('a base that is late is driven in real time',
                            f'time:=lock_step with randomisation:={values["randomisation"]}',
                            'set time to real_time, or leave out the delays')
        self.frames = Frames.with_prefix(values['frame_prefix'])
        self.start_ns = round(1e9 * first_stamp(
            values['start_time'], lock_step=self.lock_step, wall=time.time()))
        self.begun = time.monotonic()  # when that stamp was
        self.command = np.zeros(4)
        self.command_tick = 0  # when the newest command came, in ticks
        self.command_at: float | None = None  # the same on the steady clock [s]
        self.command_count = 0
        self.unanswered = False  # lock-step: nobody has sent a command for a while
        self.rest_ticks = 0  # since it came to rest
        # Pose from the goal_pose topic, for the next reset.
        self.next_goal: tuple[float, float, float] | None = None
        self.done = False
        self._taken: deque[tuple[int, Time, Pictures]] = deque()  # pictures to publish
        self.says_arrived = self.goal_taken = False  # the policy, in this episode
        self.goal_shown = 0.0  # steady time [s]
        self._clock_publisher: Publisher | None = None  # made once nobody else has one
        self._time_from = created + DISCOVERY_S
        self._make_interfaces(values)
        with compiling(self, ended, work):
            self.begin(0)
        self.get_logger().info(
            f'ready: {scene}, {values["time"]}; pictures on '
            f'{self.resolve_topic_name("image_raw")}, waits for commands on '
            f'{self._listener.topic_name}')
        self._skipped = 0  # ticks that the clock went on without the world
        self._lost_said = 0

    def close(self) -> None:
        """Let go of the simulator."""
        if hasattr(self, 'robot'):
            self.robot.close()

    def destroy_node(self) -> None:
        """Let go of the simulator as well."""
        self.close()
        super().destroy_node()

    def _other_clocks(self) -> list[str]:
        """Who else publishes on the clock's topic."""
        topic = self.resolve_topic_name(CLOCK_TOPIC)
        names = [f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                 for info in self.get_publishers_info_by_topic(topic)]
        # Two bridges may have one name: a name is this node's once, and only when it publishes.
        if self._clock_publisher is not None and (me := self.get_fully_qualified_name()) in names:
            names.remove(me)
        return sorted(set(names))

    def _publish_clock(self, stamp: Time) -> None:
        """Say the time, as soon as it is clear that nobody else does.

        Raises:
            UserError: somebody else does: this node, the newcomer, ends.
        """
        if self._clock_publisher is None:
            if time.monotonic() < self._time_from:
                return
            if others := self._other_clocks():
                raise UserError('one node alone publishes the simulated time',
                                f'{", ".join(others)} on {self.resolve_topic_name(CLOCK_TOPIC)}',
                                CLOCK_REMEDY)
            self._clock_publisher = self.create_publisher(Clock, CLOCK_TOPIC, offered('/clock'))
        self._clock_publisher.publish(Clock(clock=stamp))

    def _make_interfaces(self, values: dict) -> None:
        def publisher(kind, name):
            return self.create_publisher(kind, name, offered(name))

        kinds = dict(zip(bridge_sensors.TOPICS, (
            Image, CompressedImage, CameraInfo, Image, CameraInfo, Image, LaserScan, Odometry,
            Odometry), strict=True))
        can = self.robot.simulator.capabilities
        kinds = {name: kinds[name] for name in bridge_sensors.topics(can)}
        try:  # in no wheel
            transforms = importlib.import_module('tf2_msgs.msg').TFMessage
            kinds |= {'/tf': transforms, '/tf_static': transforms}
        except ModuleNotFoundError:
            self.get_logger().info('no /tf: tf2_msgs is not installed')
        self._sensors = Sensors(
            {name: publisher(kind, name) for name, kind in kinds.items()}, self.robot,
            self.frames, period=self.picture_ticks * TICK, localised=values['localised'],
            transform=TransformStamped)
        self._label_names = publisher(String, 'labels/names') if can.labels else None
        self._collision = publisher(Bool, 'collision')
        self._scene = publisher(String, 'scene')
        self._diagnostics = publisher(DiagnosticArray, '/diagnostics')
        if not self.free:
            self._goal_image = publisher(Image, 'goal_image')
            self._reward = publisher(Float32, 'reward')
            self._episode_end = publisher(UInt8, 'episode_end')
            self._episode = publisher(String, 'episode')
            self._episode_result = publisher(String, 'episode_result')
        self._command_type = TwistStamped if values['enable_stamped_cmd_vel'] else Twist
        self._listener = self.create_subscription(
            self._command_type, 'cmd_vel', self._on_command, qos('cmd_vel'))
        self.create_subscription(PoseStamped, 'goal_pose', self._on_goal_pose, qos('goal_pose'))
        if self.robot.stop_rule == 'declared':
            # Deeper than the contract: what is said of one goal and of the next are both heard.
            self.create_subscription(Bool, 'arrived', self._on_arrived, qos('arrived', depth=10))
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_timer(REPORT_PERIOD_S, self._report,
                          clock=NodeClock(clock_type=ClockType.STEADY_TIME))
        if self._label_names is not None:
            self._label_names.publish(String(data=json.dumps(
                list(self.robot.simulator.label_names))))
        self._scene.publish(String(data=json.dumps(bridge_messages.scene_facts(self.robot))))
        self._sensors.publish_mounts(self.stamp())

    # What comes in.

    def _on_command(self, message: Twist | TwistStamped) -> None:
        try:
            self.command = motion.twist_to_array(message)
        except motion.MotionError as error:
            self.command = np.zeros(4)
            self.get_logger().error(f'stopped: {error}', throttle_duration_sec=1.0)
        self.command_tick, self.command_at = self.robot.tick_count, time.monotonic()
        self.command_count += 1
        self.unanswered = False

    def _on_arrived(self, message: Bool) -> None:
        """What the robot says. It may still mean the goal before.

        A policy says false when it takes a goal; what it says after that is of this goal. True
        without false before it counts only when it has not been taken back for a while.
        """
        self.says_arrived = message.data
        self.goal_taken |= not message.data

    def _declares(self) -> bool:
        return self.says_arrived and (
            self.goal_taken or time.monotonic() - self.goal_shown > STATEMENT_PATIENCE_S)

    def _on_goal_pose(self, message: PoseStamped) -> None:
        if self.free:
            self.get_logger().warning('goal_pose is ignored: free_driving has no goals')
            return
        try:
            self.next_goal = bridge_messages.goal_in_map(
                message, self.frames, self.robot.pose, self.robot.odometry)
        except UserError as error:
            self.get_logger().error(f'goal_pose is ignored: {error}', throttle_duration_sec=1.0)

    def _on_reset(self, _request, response):
        """A new episode; towards the newest goal_pose, if one came since the last reset."""
        goal, self.next_goal = self.next_goal, None
        try:
            self.begin(self.index + 1, goal)
        except UserError as error:
            response.success, response.message = False, str(error)
            return response
        self.done = False
        response.success = True
        response.message = f'start {self.index}' if self.free else (
            f'episode {self.index} towards {self.robot.goal.room}')
        return response

    # What goes out.

    @property
    def nanoseconds(self) -> int:
        """The simulated time."""
        return self.start_ns + TICK_NS * self.robot.tick_count

    def stamp(self) -> Time:
        """The simulated time as a stamp."""
        return Time(sec=self.nanoseconds // 10**9, nanosec=self.nanoseconds % 10**9)

    def begin(self, index: int, goal_pose=None) -> None:
        """Move the robot to a new start; in episodes, show the new goal.

        Raises:
            UserError: a goal where the robot cannot stand; nothing has changed.
        """
        if self.free:
            self.robot.place_freely(index)
        else:
            self.robot.begin_episode(index, goal_pose)
        self.index = index
        self._taken.clear()
        self.command = np.zeros(4)
        self.rest_ticks = -1  # its first picture waits for a tick, see `tick`
        self.says_arrived = self.goal_taken = False
        self.goal_shown = time.monotonic()
        if not self.free:
            self._show_goal()

    def _show_goal(self) -> None:
        message = images.fill_image(Image(), self._goal_picture(), 'rgb8')
        message.header.stamp = self.stamp()
        message.header.frame_id = self.frames.optical
        self._episode.publish(String(data=json.dumps(
            bridge_messages.episode_facts(self.robot, self.nanoseconds * 1e-9))))
        self._goal_image.publish(message)

    def _goal_picture(self) -> np.ndarray:
        """The picture [H,W,3] of the episode's goal."""
        assert self.robot.episode is not None  # one has just begun
        goal = self.robot.episode.goal
        if self.goals and goal >= 0:
            return self.goals[goal].picture
        return np.ascontiguousarray(self.robot.goal_frames().rgb[0].transpose(1, 2, 0))

    @property
    def moves(self) -> bool:
        """A velocity is asked for, or the base still brakes."""
        return bool(self.command.any() or self.robot.moves)

    @property
    def behind(self) -> int:
        """Ticks by which the simulated time lags behind the wall clock."""
        return 0 if self.lock_step else self._ticks_late(self.robot.tick_count, time.monotonic())

    def _ticks_late(self, count: int, at: float) -> int:
        """Whole ticks by which tick `count` is late at steady time `at` [s]."""
        return max(0, int((at - self.begun) / TICK) - count - self._skipped)

    def catch_up(self, next_tick: float) -> None:
        """At rest, in real time: the clock goes on, so that the next tick is not late.

        A robot that stands may have stood for longer. In motion no tick can be left out: pictures
        and odometry stay late until it stands.

        Args:
            next_tick: steady time at which it comes [s].
        """
        late = self._ticks_late(self.robot.tick_count + 1, next_tick)
        if late and not self.lock_step and not self.moves:
            self._skipped += late
            self.start_ns += late * TICK_NS

    def give_up_waiting(self) -> None:
        """In lock-step nobody has answered: the base brakes, and time goes on."""
        self.command, self.unanswered = np.zeros(4), True
        self.get_logger().warning('no command for 2 s in motion: the base brakes')

    def tick(self) -> None:
        """Advance by one tick under the command in force, and publish what follows."""
        stale = (self.robot.tick_count - self.command_tick) * TICK >= COMMAND_TIMEOUT_S
        declares = self._declares()
        if stale or declares:
            self.command = np.zeros(4)
        decision = self.robot.drive(self.command)
        camera_due = self.robot.tick_count % self.picture_ticks == 0
        if self.continuous and camera_due and self.robot.in_decision:
            decision = self.robot.end_decision()
        stamp = self.stamp()
        at_rest = not self.robot.moves
        self.rest_ticks = self.rest_ticks + 1 if at_rest else -1
        begun = decision is not None and self._judge(decision)
        # Who says that it has arrived is judged where it has come to rest.
        if declares and at_rest and not begun and self.robot.episode is not None:
            begun = self._judge(self.robot.declare())
        self._publish_clock(stamp)
        if not self.pictures_in_motion:  # the first in the very tick that comes to rest
            camera_due = at_rest and self.rest_ticks % self.picture_ticks == 0
        # After a jump to a new start the first picture waits for a tick, so that the new goal
        # arrives before it.
        if camera_due and not begun:
            late = round(self.robot.camera_delay / TICK)
            self._taken.append((self.robot.tick_count + late, stamp, self.robot.observe()))
        while self._taken and self._taken[0][0] <= self.robot.tick_count:
            self._sensors.publish_pictures(*self._taken.popleft()[1:])
        if self.robot.tick_count % self.picture_ticks == 0:
            self._sensors.publish_scan(stamp)
        self._sensors.publish_odometry(stamp)

    def _judge(self, decision) -> bool:
        """Publish a decision's outcome; True when a new episode began."""
        self._collision.publish(Bool(data=decision.collided))
        if self.free:
            return False
        self._reward.publish(Float32(data=float(decision.success)))
        if not decision.end:
            return False
        episode = self.robot.episode
        assert episode is not None  # a decision ends one
        self._episode_result.publish(String(data=json.dumps(
            bridge_messages.result_facts(episode, decision))))
        self._episode_end.publish(UInt8(data=decision.end))
        outcome = ('gave up' if decision.end == TRUNCATED else
                   'arrived' if decision.success else 'stopped elsewhere')
        self.get_logger().info(
            f'episode {episode.index} ({self.robot.goal.room}): {outcome} after '
            f'{episode.decisions} decisions, {episode.path_length:.1f} m')
        if self.episodes and episode.index + 1 >= self.episodes:
            self.done = True
            self.robot.episode = None
            return True
        self.begin(episode.index + 1)
        return True

    def _report(self) -> None:
        """Say on /diagnostics how the simulated robot does."""
        now = time.monotonic()
        lost = self.behind + self._skipped
        state = ('all episodes done' if self.done else 'free driving' if self.free else
                 f'episode {self.index} to {self.robot.goal.room}')
        level, summary = DiagnosticStatus.OK, state
        if lost >= self._lost_said + LATE_TICKS:
            level, summary = DiagnosticStatus.WARN, (
                f'{state}: {lost - self._lost_said} ticks of {TICK} s late since the last '
                'report: give it more time, smaller pictures or lock_step')
        self._lost_said = lost
        if fault := self._misunderstandings():
            level, summary = DiagnosticStatus.ERROR, fault
            self.get_logger().error(fault, throttle_duration_sec=10.0)
        values = {
            'state': state, 'episode': self.index,
            'decisions': self.robot.episode.decisions if self.robot.episode else 0,
            'moves': self.moves, 'ticks': self.robot.tick_count, 'ticks_behind': self.behind,
            'last_command_age': ('no command yet' if self.command_at is None else
                                 f'{now - self.command_at:.2f}')}
        message = DiagnosticArray(status=[DiagnosticStatus(
            level=level, name=self.get_fully_qualified_name(), message=summary,
            hardware_id=self.robot.robot.name,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])])
        message.header.stamp = self.stamp()
        self._diagnostics.publish(message)

    def _misunderstandings(self) -> str:
        """Another clock, or commands of the type that this base does not read."""
        if self._clock_publisher is not None and (others := self._other_clocks()):
            return (f'{", ".join(others)} also publishes on {self._clock_publisher.topic_name}: '
                    f'time jumps; {CLOCK_REMEDY}')
        mine = f'geometry_msgs/msg/{self._command_type.__name__}'
        for info in self.get_publishers_info_by_topic(self._listener.topic_name):
            if info.topic_type != mine:
                other = str(mine == 'geometry_msgs/msg/Twist').lower()
                return (f'{info.node_name} sends {info.topic_type} where this base reads {mine}: '
                        f'set enable_stamped_cmd_vel to {other}')
        return ''


def run(node: SimBridgeNode, ended: Ended) -> None:
    """Tick until a signal comes or the last episode has ended.

    At rest a tick lasts 50 ms of wall time. In lock-step motion the next tick waits for a command.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    next_tick = time.monotonic()
    while not ended.is_set():
        if node.done and node.exit_when_done:
            # What was said is latched: a recorder that is still being matched gets it.
            linger = time.monotonic() + LINGER_S
            while time.monotonic() < linger and not ended.is_set():
                executor.spin_once(timeout_sec=0.05)
            return
        answered = node.command_count
        moving, now = node.moves, time.monotonic()
        waits = node.lock_step and moving and not node.unanswered
        if node.lock_step:
            next_tick = now + (LOCK_STEP_TIMEOUT_S if waits else TICK)
        else:
            next_tick = max(next_tick + TICK, now)  # no tick is left out: time falls behind
        if next_tick <= now:  # a late bridge still hears a stop
            for _ in range(OVERDUE_CALLBACKS):
                executor.spin_once(timeout_sec=0)
        node.catch_up(next_tick)
        while not ended.is_set():
            remaining = next_tick - time.monotonic()
            if remaining <= 0:
                if waits:
                    node.give_up_waiting()
                break
            executor.spin_once(timeout_sec=min(remaining, 0.2))
            if node.lock_step and node.command_count > answered and (
                    moving or node.command.any()):
                break  # in motion any command starts the tick; at rest one that moves
        node.tick()


def main(args=None) -> int:
    """Entry point. Exit code 2 and one line on standard error for bad parameters."""
    return run_node('sim_bridge_node', SimBridgeNode, run, args, about=__doc__,
                    parameters=PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
