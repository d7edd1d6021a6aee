"""The first stage of teach_and_drive.py: ten minutes with a joystick, recorded as a bag."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import yaml

from vn_msgs_py.images import decode_rgb
from vn_msgs_py.motion import fill_twist, odometry_to_array
from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS, wrap_angle
from vn_nav.bags.storage.reader import read_bag
from vn_nav.evaluation.evaluator import DECLARED
from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.resources import share_file
from vn_nav.scenes import house_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.robot.joystick import Joystick
from vn_sim_bridge.robot.simulated_robot import TICK
from vn_sim_bridge.tools.contact_sheet import MARGIN, SCALE, plan_map

TOPICS = ['image_raw', 'camera_info', 'odom', 'cmd_vel', 'collision', 'ground_truth/odom']
CAMERA_RATE_HZ = 5.0  # in the bag that is learned from
PATIENCE_S = 60.0  # without a message
RECORD_SEED = 1


def record(options) -> None:
    """Drive around a house with the joystick, and look at what the bag holds."""
    out, house = options.out, generate_house(options.house, rooms=options.rooms)
    _write_robot(options)
    shutil.rmtree(out / 'bag', ignore_errors=True)
    processes = Processes(out / 'logs')
    begun = time.monotonic()
    try:
        processes.start('recorder', 'vn_nav.nodes.recorder_node',
                        {'output': str(out / 'bag'), 'topics': TOPICS})
        processes.start('bridge', 'vn_sim_bridge.bridge_node', {
            **bridge_parameters(options), 'noise': False, 'seed': RECORD_SEED,
            'mode': 'continuous', 'camera_rate': CAMERA_RATE_HZ,
            # One long drive: nothing may put the robot elsewhere.
            'stop': DECLARED, 'max_decisions': 10**9})
        places = _with_joystick(processes, house, options)
    finally:
        processes.stop_all()
    if processes.killed:
        raise SystemExit(f'{processes.killed} did not end within 10 s of SIGINT')
    figures = _look_at(options, house) | places | {
        'wall_seconds': round(time.monotonic() - begun, 1), 'house': options.house,
        'rooms': options.rooms, 'camera_height': options.camera_height, 'drift': options.drift,
        'randomisation': options.randomisation, 'spacing': options.spacing,
        'turns': options.turns}
    write_figures(out / 'record.json', figures)
    print(json.dumps(figures, indent=1), flush=True)
    run_command('bag', 'doctor', str(out / 'bag'), '--robot', str(out / 'robot.yaml'))


def _with_joystick(processes: Processes, house, options) -> dict:
    """Answer every true pose with a Twist, for some simulated time."""
    os.environ.update(processes.environment)  # before rclpy reads them
    import rclpy
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from rclpy.executors import SingleThreadedExecutor

    from vn_nav.nodes.qos import qos
    rclpy.init()
    node = rclpy.create_node('joystick')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    received: list[np.ndarray] = []
    node.create_subscription(Odometry, 'ground_truth/odom',
                             lambda message: received.append(odometry_to_array(message)),
                             qos('ground_truth/odom', depth=10))
    command = node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))

    def pose() -> np.ndarray:
        """The newest one, once there is one; x, y, yaw, velocities, stamp."""
        until = time.monotonic() + PATIENCE_S
        while not received:
            executor.spin_once(timeout_sec=0.5)
            for name in ('recorder', 'bridge'):
                processes.check(name)
            if time.monotonic() > until:
                raise ProcessFailure(f'no odometry for {PATIENCE_S:.0f} s')
        newest = received[-1]
        received.clear()
        return newest

    try:
        now = pose()
        joystick = Joystick(house, *now[:2], spacing=options.spacing, turns=options.turns)
        until = time.monotonic() + PATIENCE_S
        while command.get_subscription_count() < 2:  # the bridge, and the recorder
            executor.spin_once(timeout_sec=0.1)
            if time.monotonic() > until:
                raise ProcessFailure('bridge or recorder do not listen to cmd_vel')
        now = pose()
        end, said = now[6] + 60 * options.simulated_minutes, now[6]
        while now[6] < end or now[3:6].any():
            command.publish(fill_twist(Twist(), joystick.velocity(now) if now[6] < end
                                       else np.zeros(4)))
            now = pose()
            if now[6] >= said + 60:
                said = now[6]
                print(f'{end - now[6]:.0f} simulated s to go, {joystick.visited} places visited '
                      f'of {len(joystick.places)}', flush=True)
        return {'places': len(joystick.places), 'visited': joystick.visited}
    finally:
        node.destroy_node()
        rclpy.shutdown()


def _write_robot(options) -> None:
    """The quick base of the demo, with the camera at another height."""
    robot = yaml.safe_load(share_file('config/robots/demo_base.yaml').read_text())
    robot |= {'name': 'teach_and_drive', 'camera_height': options.camera_height}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / 'robot.yaml').write_text(yaml.safe_dump(robot, sort_keys=False))


def bridge_parameters(options) -> dict:
    """Parameters of the bridge in both drives."""
    return {'scene': house_scene(options.house, options.rooms), 'size': options.size,
            'robot': str(options.out / 'robot.yaml'), 'randomisation': options.randomisation,
            'odometry_drift': options.drift, 'time': 'lock_step'}


@dataclasses.dataclass
class RecordedDrive:
    """What a bag shows."""

    stamps: np.ndarray  # [K] of true poses and odometry [s]
    truth: np.ndarray  # [K,3] x, y [m], yaw [rad] in the map
    odometry: np.ndarray  # [K,3] in its own frame
    pictures: list[np.ndarray]  # [H,W,3] uint8 RGB
    pictured: np.ndarray  # [P,3] true poses of the pictures
    contacts: int  # pictures since the one before which something was touched


def read_drive(bag: Path) -> RecordedDrive:
    """All of a bag, pictures with the true poses that carry their stamps."""
    rows = {name: [] for name in TOPICS}
    for message in read_bag(bag, ('image_raw', 'odom', 'ground_truth/odom', 'collision')):
        rows[message.topic].append(message.message)
    truth, odometry = (np.array([odometry_to_array(m) for m in rows[name]])
                       for name in ('ground_truth/odom', 'odom'))
    _, first, second = np.intersect1d(truth[:, 6], odometry[:, 6], return_indices=True)
    truth, odometry = truth[first], odometry[second]
    at = {round(values[6] / TICK): values[:3] for values in truth}
    seen = [(decode_rgb(m), at[tick]) for m in rows['image_raw']
            if (tick := round((m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec) / TICK)) in at]
    return RecordedDrive(truth[:, 6], truth[:, :3], odometry[:, :3], [image for image, _ in seen],
                 np.array([pose for _, pose in seen]), sum(m.data for m in rows['collision']))


def _look_at(options, house) -> dict:
    """Figures of the recorded drive; a map and some pictures for people."""
    shown = read_drive(options.out / 'bag')
    _draw_map(options.out / 'record.png', house, shown)
    some = np.linspace(0, len(shown.pictures) - 1, 40).astype(int)
    tiles = np.array([shown.pictures[k] for k in some])
    sheet = np.concatenate([np.concatenate(list(tiles[k:k + 10]), 1) for k in range(0, 40, 10)])
    cv2.imwrite(str(options.out / 'views.png'), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    ways = np.hypot(*np.diff(shown.truth[:, :2], axis=0).T)
    turns = wrap_angle(np.diff(shown.truth[:, 2]))
    aligned = _in_the_map(shown)
    errors = np.hypot(*(aligned[:, :2] - shown.truth[:, :2]).T)
    headings = np.degrees(wrap_angle(aligned[:, 2] - shown.truth[:, 2]))
    floor, poses = covered(house, shown.pictured)
    return {
        'simulated_seconds': round(float(shown.stamps[-1] - shown.stamps[0]), 1),
        'pictures': len(shown.pictures), 'metres': round(float(ways.sum()), 1),
        'full_turns': round(float(np.abs(turns).sum() / 2 / math.pi), 1),
        'fastest': [round(float(ways.max() / TICK), 2),
                    round(float(np.abs(turns).max() / TICK), 2)],
        'pictures_after_a_contact': int(shown.contacts),
        'odometry_error_m': {'end': round(float(errors[-1]), 2),
                             'worst': round(float(errors.max()), 2)},
        'odometry_error_deg': {'end': round(float(headings[-1]), 1),
                               'worst': round(float(np.abs(headings).max()), 1)},
        'floor_near_a_picture': round(floor, 3), 'poses_at_a_picture': round(poses, 3)}


def _in_the_map(shown: RecordedDrive) -> np.ndarray:
    """Odometry [K,3], put into the map where the drive begins."""
    turn = shown.truth[0, 2] - shown.odometry[0, 2]
    c, s = math.cos(turn), math.sin(turn)
    x, y = (shown.odometry[:, :2] - shown.odometry[0, :2]).T
    return np.column_stack([shown.truth[0, 0] + c * x - s * y, shown.truth[0, 1] + s * x + c * y,
                            shown.odometry[:, 2] + turn])


def covered(house, poses: np.ndarray) -> tuple[float, float]:
    """Of the floor, and of all poses on it, the share with a picture from within arrival's limits.

    Args:
        poses: [P,3] of the pictures.
    """
    cells, headings = house.floor.centres(), np.arange(-math.pi, math.pi, math.pi / 6)
    near = np.zeros((len(cells), len(headings)), bool)
    somewhere = np.zeros(len(cells), bool)
    for x, y, yaw in poses:
        here = np.hypot(*(cells - (x, y)).T) <= ARRIVAL_RADIUS
        somewhere |= here
        near[np.ix_(here, np.abs(wrap_angle(headings - yaw)) <= ARRIVAL_HEADING)] = True
    return float(somewhere.mean()), float(near.mean())


def _draw_map(path: Path, house, shown: RecordedDrive) -> None:
    """The way in red, what odometry says of it in grey."""
    plan = plan_map(house.plan())

    def line(poses, colour, width):
        points = np.column_stack([(poses[:, 0] - house.outline.x0 + MARGIN) * SCALE,
                                  len(plan) - (poses[:, 1] - house.outline.y0 + MARGIN) * SCALE])
        cv2.polylines(plan, [points.round().astype(np.int32)], False, colour, width, cv2.LINE_AA)
    line(_in_the_map(shown), (150, 150, 150), 1)
    line(shown.truth, (200, 60, 40), 2)
    cv2.imwrite(str(path), cv2.cvtColor(plan, cv2.COLOR_RGB2BGR))


def run_command(*arguments: str) -> None:
    """A command of the project; its failure is this program's."""
    print('$ vn_nav', *arguments, flush=True)
    done = subprocess.run([sys.executable, '-m', 'vn_nav.cli', *arguments])
    if done.returncode:
        raise SystemExit(f'vn_nav {arguments[0]} ended with code {done.returncode}')


def write_figures(path: Path, figures: dict) -> None:
    """Write a stage's figures as JSON."""
    path.write_text(json.dumps(figures, indent=2) + '\n')
