"""`sim_bridge_node`: an embedded house as a robot on ROS topics. It reads Twist alone.

Run: `ros2 run vn_nav sim_bridge_node --ros-args -p house:=7 -p rooms:=5`.
"""

from __future__ import annotations

import json
import math
import sys
import time

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Bool, Float32, String, UInt8
from std_srvs.srv import Trigger

from vn_msgs_py import images, motion
from vn_nav.errors import UserError
from vn_nav.nodes import parameters, policy_parameters
from vn_nav.nodes.process import Ended, compiling, run_node
from vn_nav.nodes.qos import qos
from vn_nav.robot import RobotSpec, load_robot
from vn_sim_bridge import tasks
from vn_sim_bridge.env import STOPS
from vn_sim_bridge.goal_pictures import load_goal_pictures
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.randomisation import load_randomisation
from vn_sim_bridge.simulated_robot import TICK, TRUNCATED, SimulatedRobot
from vn_sim_bridge.world import WORLD_VERSION

COMMAND_TIMEOUT = 0.5  # s of the bridge's own time without a command: the base stops
LOCK_STEP_TIMEOUT = 2.0  # s of wall time without a command in motion: the base stops
STATEMENT_PATIENCE = 2.0  # s of wall time, see _on_arrived
OPTICAL_FRAME = 'camera_optical_frame'

# name: (default, meaning, limits), as in `vn_nav.nodes.parameters`.
PARAMETERS = {
    'backend': ('house', 'simulator behind the bridge: house', ('house',)),
    'house': (0, 'seed of the house'),
    'rooms': (5, 'number of rooms', (1, 12)),
    'robot': ('', 'YAML file of the robot; empty: the standard robot'),
    'size': (84, 'side of the square camera picture [pixels]', (16, 1024)),
    'noise': (True, 'Gaussian motion noise, which odom does not see'),
    'odometry_drift': (0.0, 'errors of odom: 0 none, 1 as of a good indoor robot, more: worse',
                       (0.0, 1000.0)),
    'randomisation': ('none', 'of light, camera and base: none, standard, rough or a YAML file'),
    'goals': ('', 'folder of goal pictures with their poses (goals.json); empty: the own ones'),
    'seed': (0, 'of starts, goals and noise'),
    'time': ('real_time', 'real_time or lock_step (docs/architecture.md, "Time")',
             ('real_time', 'lock_step')),
    'mode': ('stop_and_go', 'lock_step: stop_and_go shows pictures at rest, continuous always',
             ('stop_and_go', 'continuous')),
    'camera_rate': (10.0, 'pictures per simulated second in real_time and in continuous [Hz]',
                    (1.0, 1 / TICK)),
    'episodes': (0, 'episodes to run; 0: without end', (0, 2**31 - 1)),
    'max_decisions': (300, 'limit of an episode', (1, 2**31 - 1)),
    'stop': ('arrival', 'what ends an episode before its limit: arrival, or declared: `arrived`',
             tuple(STOPS)),
    'start_time': (1.0, 'first stamp [s]; zero would mean "no time yet"', (TICK, 2e9)),
    'exit_when_done': (False, 'exit after the last episode instead of standing still'),
}


class SimBridgeNode(Node):
    """Publishes what a robot's drivers would, and judges episodes on the side."""

    def __init__(self, ended: Ended):
        super().__init__('sim_bridge_node')
        values = parameters.declare(self, PARAMETERS, read_only=True,
                                    others=policy_parameters.PARAMETERS)
        self.lock_step = values['time'] == 'lock_step'
        self.pictures_in_motion = not self.lock_step or values['mode'] == 'continuous'
        self.continuous = values['mode'] == 'continuous'
        self.episodes, self.exit_when_done = values['episodes'], values['exit_when_done']
        self.picture_ticks = max(1, round(1 / (values['camera_rate'] * TICK)))
        robot = load_robot(values['robot']) if values['robot'] else RobotSpec()
        self.goals = load_goal_pictures(values['goals']) if values['goals'] else []
        work = f'making house {values["house"]}; the first start compiles the renderer, a minute'
        with compiling(self, ended, work):
            self.robot = SimulatedRobot(
                values['house'], values['rooms'], robot=robot, size=values['size'],
                noise=values['noise'], seed=values['seed'],
                max_decisions=values['max_decisions'], stop=values['stop'],
                randomisation=load_randomisation(values['randomisation']),
                odometry_drift=values['odometry_drift'],
                goal_poses=[goal.pose for goal in self.goals] or None)
        self.size, self.start_time = values['size'], values['start_time']
        self.command = np.zeros(4)
        self.command_tick = 0  # when the newest command came, in ticks
        self.command_count = 0
        self.next_goal = None  # pose from the goal_pose topic, for the next reset
        self.done = False
        self.says_arrived = self.goal_taken = False  # the policy, in this episode
        self.goal_shown = 0.0  # steady time [s]
        self._make_interfaces()
        with compiling(self, ended, work):
            self.begin_episode(0)
        self.get_logger().info(
            f'ready: house {values["house"]}, {values["time"]}; pictures on '
            f'{self._image.topic_name}, waits for commands on '
            f'{self.resolve_topic_name("cmd_vel")}')

    def _make_interfaces(self) -> None:
        def publisher(kind, name):
            return self.create_publisher(kind, name, qos(name))

        self._image = publisher(Image, 'image_raw')
        self._camera_info = publisher(CameraInfo, 'camera_info')
        self._depth = publisher(Image, 'depth/image_raw')
        self._labels = publisher(Image, 'labels/image_raw')
        self._label_names = publisher(String, 'labels/names')
        self._goal_image = publisher(Image, 'goal_image')
        self._odometry = publisher(Odometry, 'odom')
        self._truth = publisher(Odometry, 'ground_truth/odom')
        self._collision = publisher(Bool, 'collision')
        self._reward = publisher(Float32, 'reward')
        self._episode_end = publisher(UInt8, 'episode_end')
        self._scene = publisher(String, 'scene')
        self._episode = publisher(String, 'episode')
        self._episode_result = publisher(String, 'episode_result')
        self._clock = publisher(Clock, '/clock')
        self.create_subscription(Twist, 'cmd_vel', self._on_command, qos('cmd_vel'))
        self.create_subscription(PoseStamped, 'goal_pose', self._on_goal_pose, qos('goal_pose'))
        if self.robot.stop_rule == 'declared':
            # Deeper than the contract: what is said of one goal and of the next are both heard.
            self.create_subscription(Bool, 'arrived', self._on_arrived, qos('arrived', depth=10))
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._label_names.publish(String(data=json.dumps(list(LABELS))))
        self._scene.publish(String(data=json.dumps(self._scene_facts())))
        self._info_message = self._make_camera_info()
        self._odometry_message, self._truth_message = Odometry(), Odometry()
        self._odometry_message.header.frame_id = 'odom'
        self._truth_message.header.frame_id = 'map'
        for message in (self._odometry_message, self._truth_message):
            message.child_frame_id = 'base_link'

    def _scene_facts(self) -> dict:
        """What a viewer or a report needs to draw the house."""
        house = self.robot.house
        return {
            'world_version': WORLD_VERSION,
            'rooms': len(house.rooms),
            **house.floor_plan(),
            'goals': [{'room': field.goal.room, 'pose': list(field.goal.pose)}
                      for field in self.robot.fields],
            'arrival': {'radius': tasks.ARRIVAL_RADIUS,
                        'heading_deg': math.degrees(tasks.ARRIVAL_HEADING)},
            'camera_fov_deg': math.degrees(self.robot.robot.camera_fov),
            'stop': self.robot.stop_rule,
            'max_decisions': self.robot.max_decisions,
            'tick': TICK,
        }

    def _make_camera_info(self) -> CameraInfo:
        focal = self.size / 2 / math.tan(self.robot.robot.camera_fov / 2)
        centre = self.size / 2
        info = CameraInfo(width=self.size, height=self.size, distortion_model='plumb_bob')
        info.header.frame_id = OPTICAL_FRAME
        info.d = [0.0] * 5
        info.k = [focal, 0.0, centre, 0.0, focal, centre, 0.0, 0.0, 1.0]
        info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        info.p = [focal, 0.0, centre, 0.0, 0.0, focal, centre, 0.0, 0.0, 0.0, 1.0, 0.0]
        return info

    # What comes in.

    def _on_command(self, message: Twist) -> None:
        try:
            self.command = motion.twist_to_array(message)
        except motion.MotionError as error:
            self.command = np.zeros(4)
            self.get_logger().error(f'stopped: {error}', throttle_duration_sec=1.0)
        self.command_tick = self.robot.tick_count
        self.command_count += 1

    def _on_arrived(self, message: Bool) -> None:
        """What the robot says. It may still mean the goal before.

        A policy says false when it takes a goal; what it says after that is of this goal. True
        without false before it counts only when it has not been taken back for a while.
        """
        self.says_arrived = message.data
        self.goal_taken |= not message.data

    def _declares(self) -> bool:
        return self.says_arrived and (
            self.goal_taken or time.monotonic() - self.goal_shown > STATEMENT_PATIENCE)

    def _on_goal_pose(self, message: PoseStamped) -> None:
        q = message.pose.orientation
        self.next_goal = (message.pose.position.x, message.pose.position.y,
                          motion.quaternion_to_yaw(q.x, q.y, q.z, q.w))

    def _on_reset(self, _request, response):
        """A new episode; towards the newest goal_pose, if one came since the last reset."""
        goal, self.next_goal = self.next_goal, None
        try:
            self.begin_episode(self.robot.episode.index + 1, goal)
        except UserError as error:
            response.success, response.message = False, str(error)
            return response
        self.done = False
        response.success = True
        response.message = f'episode {self.robot.episode.index} towards {self.robot.goal.room}'
        return response

    # What goes out.

    def stamp(self) -> Time:
        """The simulated time."""
        nanoseconds = round((self.start_time + self.robot.time) * 1e9)
        return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)

    def begin_episode(self, index: int, goal_pose=None) -> None:
        """Move the robot to a new start and show the new goal."""
        episode = self.robot.begin_episode(index, goal_pose)
        self.command = np.zeros(4)
        self.says_arrived = self.goal_taken = False
        self.goal_shown = time.monotonic()
        message = images.fill_image(Image(), self._goal_picture(), 'rgb8')
        message.header.stamp = self.stamp()
        message.header.frame_id = OPTICAL_FRAME
        self._episode.publish(String(data=json.dumps({
            'episode': episode.index, 'goal': episode.goal, 'room': self.robot.goal.room,
            'goal_pose': list(self.robot.goal.pose), 'start': list(episode.start),
            'start_distance': episode.start_distance, 'stamp': self.start_time + episode.begun_at,
            'max_decisions': self.robot.max_decisions})))
        self._goal_image.publish(message)

    def _goal_picture(self) -> np.ndarray:
        """The picture [H,W,3] of the episode's goal."""
        goal = self.robot.episode.goal
        if self.goals and goal >= 0:
            return self.goals[goal].picture
        return np.ascontiguousarray(self.robot.goal_frames().rgb[0].transpose(1, 2, 0))

    def tick(self) -> None:
        """Advance by one tick under the command in force, and publish what follows."""
        stale = (self.robot.tick_count - self.command_tick) * TICK >= COMMAND_TIMEOUT
        declares = self._declares()
        if stale or declares:
            self.command = np.zeros(4)
        decision = self.robot.tick(self.command)
        shows_picture = self.robot.tick_count % self.picture_ticks == 0
        if self.continuous and shows_picture and self.robot.in_decision:
            decision = self.robot.end_decision()
        stamp = self.stamp()
        begun = decision is not None and self._judge(decision)
        if declares and not begun and self.robot.episode is not None:
            begun = self._judge(self.robot.declare())
        self._clock.publish(Clock(clock=stamp))
        # After a jump to a new start the first picture waits for a tick, so that the new goal
        # arrives before it.
        at_rest = not self.robot.velocity.any()
        if not begun and (at_rest or (self.pictures_in_motion and shows_picture)):
            self._publish_pictures(stamp)
        self._publish_odometry(stamp)

    def _judge(self, decision) -> bool:
        """Publish a decision's outcome; True when a new episode began."""
        self._collision.publish(Bool(data=decision.collided))
        self._reward.publish(Float32(data=float(decision.success)))
        if not decision.end:
            return False
        episode = self.robot.episode
        self._episode_result.publish(String(data=json.dumps({
            'episode': episode.index, 'success': decision.success,
            'decisions': episode.decisions, 'collisions': episode.collisions,
            'path_length': episode.path_length, 'distance': decision.distance,
            'heading_error_deg': math.degrees(decision.heading_error)})))
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
        self.begin_episode(episode.index + 1)
        return True

    def _publish_pictures(self, stamp: Time) -> None:
        frames = self.robot.observe()
        self._info_message.header.stamp = stamp
        self._camera_info.publish(self._info_message)
        streams = [(self._image, frames.rgb[0].transpose(1, 2, 0), 'rgb8')]
        if self._depth.get_subscription_count():
            streams.append((self._depth, frames.depth[0], '32FC1'))
        if self._labels.get_subscription_count():
            streams.append((self._labels, frames.labels[0], 'mono8'))
        for publisher, picture, encoding in streams:
            message = images.fill_image(Image(), np.ascontiguousarray(picture), encoding)
            message.header.stamp = stamp
            message.header.frame_id = OPTICAL_FRAME
            publisher.publish(message)

    def _publish_odometry(self, stamp: Time) -> None:
        velocity = self.robot.velocity
        self._odometry_message.header.stamp = stamp
        self._truth_message.header.stamp = stamp
        x, y, yaw = self.robot.odometry
        tx, ty, true_yaw, _ = self.robot.pose
        self._truth.publish(motion.fill_odometry(self._truth_message, tx, ty, true_yaw, velocity))
        self._odometry.publish(motion.fill_odometry(self._odometry_message, x, y, yaw, velocity))


def run(node: SimBridgeNode, ended: Ended) -> None:
    """Tick until a signal comes or the last episode has ended.

    At rest a tick lasts 50 ms of wall time. In lock-step motion the next tick waits for a command.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    next_tick = time.monotonic()
    while not ended.is_set():
        if node.done and node.exit_when_done:
            linger = time.monotonic() + 0.5  # the last messages are still on their way
            while time.monotonic() < linger and not ended.is_set():
                executor.spin_once(timeout_sec=0.05)
            return
        answered = node.command_count
        moving = bool(node.command.any())
        now = time.monotonic()
        if node.lock_step:
            next_tick = now + (LOCK_STEP_TIMEOUT if moving else TICK)
        else:
            next_tick = max(next_tick + TICK, now)  # late ticks are caught up, not skipped
        while not ended.is_set():
            remaining = next_tick - time.monotonic()
            if remaining <= 0:
                if node.lock_step and moving:
                    node.command = np.zeros(4)
                    node.get_logger().warning('no command for 2 s in motion: the base stops')
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
