"""A drive with a joystick in a small house: poses, pictures, a bag."""

import json

import numpy as np
from small_bags import (
    IMAGE,
    INFO,
    ODOMETRY,
    START,
    STRING,
    camera_info,
    make,
    odometry,
    picture,
    serialised,
)

from vn_msgs_py.topics import topic
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.robot.joystick import Joystick
from vn_sim_bridge.robot.simulated_robot import TICK
from vn_sim_bridge.simulators.house import WORLD_VERSION, HouseSimulator

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
SIZE = 36
TICKS_PER_PICTURE = 4  # ticks between two pictures


def drive(seconds, rooms=1, house=7, size=SIZE):
    """Poses [N,3] and pictures of somebody with a joystick in a small house."""
    built = generate_house(house, rooms=rooms)
    simulator = HouseSimulator([built], [0], robot=ROBOT, size=size)
    cells = built.floor.centres()
    start = cells[np.argmin(np.hypot(*(cells - built.goals[0].pose[:2]).T))]
    simulator.place(np.array([0]), np.array([[*start, 0.0, 0.0]]))
    person, poses, pictures = Joystick(built, *start), [], []
    for tick in range(int(seconds / TICK)):
        simulator.move(person.velocity(simulator.poses[0])[None] * TICK)
        if tick % TICKS_PER_PICTURE == 0:
            poses.append(simulator.poses[0, :3].copy())
            pictures.append(simulator.observe().rgb[0].copy())
    return np.array(poses), np.array(pictures)


def write_bag(folder, poses, pictures):
    """The drive as a recorder leaves it: pictures, odometry, calibration, and a world version."""
    size = pictures.shape[-1]
    with BagWriter(folder, [topic(n) for n in ('image_raw', 'odom', 'camera_info', 'scene')]) as (
            writer):
        def write(name, kind, time, message):
            writer.write(name, serialised(kind, message), time)
        write('scene', STRING, START, make(STRING, data=json.dumps(
            {'world_version': WORLD_VERSION})))
        for k, (x, y, yaw) in enumerate(poses):
            time = START + round(k * TICKS_PER_PICTURE * TICK * 1e9)
            measured = odometry(time, x, yaw)
            measured.pose.pose.position.y = float(y)
            write('odom', ODOMETRY, time, measured)
            write('camera_info', INFO, time, camera_info(time, size / 2, size))
            write('image_raw', IMAGE, time, picture(time, np.ascontiguousarray(
                pictures[k].transpose(1, 2, 0))))
    return folder
