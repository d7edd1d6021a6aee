"""Maps and hypotheses out of a bag, laid onto the place that the robot drove in."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import Pose, PoseArray
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import serialize_message

from vn_msgs_py.motion import fill_odometry, yaw_to_quaternion
from vn_msgs_py.topics import RELIABLE, Topic, topic
from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.evaluation.bag_searches import read_searches
from vn_nav.report.search_map import placed

TRUE_START = np.array([4.0, 2.0, 1.2])  # in the place
ODOMETRY_START = np.array([-7.0, 3.0, -2.0])  # in the odometry's frame
BEGIN = 100.0  # s


def pose(values):
    message = Pose()
    message.position.x, message.position.y = map(float, values[:2])
    (message.orientation.x, message.orientation.y, message.orientation.z,
     message.orientation.w) = yaw_to_quaternion(float(values[2]))
    return message


def stamped(message, seconds, frame='odom'):
    message.header.stamp.sec = int(seconds)
    message.header.stamp.nanosec = round((seconds - int(seconds)) * 1e9)
    message.header.frame_id = frame
    return message


def write(folder, frame='odom'):
    """A robot that drove 1 m ahead, and what it knew: a wall 3 m ahead of its start, the goal."""
    grid = OccupancyGrid()
    grid.info.resolution = 0.1
    grid.info.width, grid.info.height = 60, 40
    cells = np.full((40, 60), -1, np.int8)
    cells[10:30, 10:40], cells[10:30, 40] = 3, 97
    grid.data.frombytes(cells.tobytes())
    # The map's corner is 1 m behind the start and 2 m to its right.
    grid.info.origin = pose(compose(ODOMETRY_START, np.array([-1.05, -2.0, 0.0])))
    guess = pose(compose(ODOMETRY_START, np.array([2.0, 0.5, math.pi / 2])))
    topics = [topic('odom'), *(Topic(f'policy_unseen/{name}', kind, 'policy', '', RELIABLE)
                               for name, kind in (('map', 'nav_msgs/msg/OccupancyGrid'),
                                                  ('hypotheses', 'geometry_msgs/msg/PoseArray')))]
    writer = BagWriter(folder, topics)
    for k, seconds in enumerate((BEGIN, BEGIN + 0.5)):
        there = compose(ODOMETRY_START, np.array([float(k), 0.0, 0.0]))
        message = stamped(fill_odometry(Odometry(), *there, np.zeros(4)), seconds)
        writer.write('odom', serialize_message(message), int(seconds * 1e9))
    late = BEGIN + 0.5
    for name, message in (('map', stamped(grid, late, frame)),
                          ('hypotheses', stamped(PoseArray(poses=[guess]), late, frame))):
        writer.write(f'policy_unseen/{name}', serialize_message(message), int(late * 1e9) + 1)
    writer.close()
    return folder


def read(folder, nodes=('policy_unseen',)):
    return read_searches(folder, nodes, [0.0, BEGIN], [
        np.full(7, np.nan), np.array([*TRUE_START, 0, 0, 0, BEGIN])])


def test_a_map_lies_where_the_robot_really_began(tmp_path):
    before, own = read(write(tmp_path / 'bag'))
    assert before == [] and len(own) == 1
    (seen,) = own
    assert seen.stamp == pytest.approx(BEGIN + 0.5)
    assert seen.search.cells.shape == (20, 31) and seen.search.cells[:, -1].tolist() == [97] * 20

    def from_start(points):
        """In the frame of the robot as it began."""
        points = placed(seen.frame, np.atleast_2d(points))
        poses = np.column_stack([points, np.zeros(len(points))])
        return between(np.broadcast_to(TRUE_START, poses.shape), poses)[:, :2]
    wall = seen.search.origin + 0.1 * np.array([30.5, 10.0])
    assert from_start(wall)[0] == pytest.approx([3.0, 0.0], abs=0.06)
    assert from_start(seen.search.pose[:2])[0] == pytest.approx([1.0, 0.0], abs=1e-6)
    (guess,) = seen.search.guesses
    assert from_start(guess.pose[:2])[0] == pytest.approx([2.0, 0.5], abs=1e-6)
    turn = seen.frame[2] + guess.pose[2] - TRUE_START[2]
    assert math.cos(turn) == pytest.approx(0, abs=1e-6) and math.sin(turn) == pytest.approx(1)


def test_a_map_that_nobody_can_place_and_other_nodes_are_left_out(tmp_path):
    assert read(write(tmp_path / 'base', frame='base_link')) == [[], []]
    assert read(write(tmp_path / 'bag'), ('policy_trained',)) == [[], []]
    assert read(tmp_path / 'bag', ()) == [[], []]
